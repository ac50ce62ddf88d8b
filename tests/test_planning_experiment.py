"""The experiment on plans: what a robot has seen of the other world before it plans there."""

from dataclasses import replace

import numpy as np
import pytest

import foretrace as ft
from foretrace.errors import ForetraceError, ResultsError
from foretrace.experiments import planning
from foretrace.experiments.planning import BELIEVED, FAMILIES, Planning, PlanningTrial, without_outcomes
from foretrace.interactions.recording_folder import write_image
from foretrace.interactions.topdown import TopDownView
from foretrace.planning import PlanConfig, goals
from foretrace.predictor import LstmConfig, save_checkpoint
from foretrace.predictor.loading import default_checkpoint


def test_one_lever_up_in_the_other_world_is_learned_from(monkeypatch: pytest.MonkeyPatch):
    experiment = Planning(objects=1, contacts=16, worlds=("other",))
    case = experiment._draw(PlanningTrial("polygon", 0), np.random.default_rng(1))
    good, bad = (ft.simulate(case.obj, action, embodiment="tool") for action in case.placed[:2])
    failed = replace(bad, effect=replace(bad.effect, outcome="failed"))
    case.__dict__["elsewhere"] = [good] + [failed] * (len(case.placed) - 1)
    given = []
    monkeypatch.setattr(planning, "identify", lambda *a, **k: given.append(a) or BELIEVED)
    imaginer = ft.load_predictor()
    assert case.identified(imaginer) is case.identified(imaginer) is BELIEVED
    ((view, action, motion, prior),) = given
    assert action is case.placed[0], "whatever failed in the simulation is not learned from"
    np.testing.assert_array_equal(view.mask, TopDownView.of(case.obj, action).mask)
    assert prior.ranges["com_x"] == (0.0, 0.0)
    rows = np.searchsorted(good.effect.times, motion.times)
    off = np.linalg.norm(motion.poses[:, :3] - good.effect.pose_trajectory[rows, :3], axis=1)
    assert 0 < off.max() < 0.002, "as a tracker sees it"


def test_silhouettes_are_a_family_where_there_are_pictures_of_them(tmp_path):
    disc = np.hypot(*np.mgrid[-60:60, -60:60]) < 40
    write_image(tmp_path / "disc.png", np.repeat(255 * disc[..., None], 3, axis=2).astype(np.uint8))
    given, none = (Planning(objects=2, silhouettes=folder) for folder in (tmp_path, None))
    assert {each.family for each in none.trials()} == {"polygon", "outline", "box"}
    assert {each.family for each in given.trials()} == {*FAMILIES}
    case = given._draw(PlanningTrial("silhouette", 1), np.random.default_rng(0))
    assert 0.9 < case.obj.corners.max() / -case.obj.corners.min() < 1.1, "the disc"
    with pytest.raises(ForetraceError, match="is no folder: give one with pictures of silhouettes"):
        replace(none, silhouettes=tmp_path / "nowhere").trials()
    with pytest.raises(ResultsError, match="needs pictures: give their folder with --silhouettes"):
        replace(none, families=("silhouette",)).trials()


def test_a_predictor_of_motions_alone_plans_for_every_goal(tmp_path):
    poses, positions = tmp_path / "poses", tmp_path / "positions"
    trained = LstmConfig(features="none", state="pose", hidden=8).make(60)
    trained.learned_from = ("levered", "slipped")
    save_checkpoint(poses, trained)
    save_checkpoint(positions, LstmConfig(features="none", hidden=8).make(60))
    experiment = Planning(objects=1, contacts=16, baseline=poses)
    case = experiment._draw(PlanningTrial("box", 0), np.random.default_rng(0))
    quick = PlanConfig(0.02, directions=1, refine=0, check=0)
    for goal in case.goals.values():
        made = ft.plan(case.scene.view, without_outcomes(goal), experiment._im_cnn, config=quick)
        assert np.isfinite(made.cost)
    without = replace(experiment, baseline=None).identity()
    assert without == {name: value for name, value in experiment.identity().items() if name != "baseline"}
    with pytest.raises(ResultsError, match="predicts positions alone: train it with --state pose"):
        replace(experiment, baseline=positions).trials()
    with pytest.raises(ResultsError, match="is a training of one-shot: give one of lstm"):
        replace(experiment, baseline=default_checkpoint()).trials()


def test_goals_lose_only_what_needs_outcomes():
    case = Planning(objects=1)._draw(PlanningTrial("box", 0), np.random.default_rng(0))
    given = {name: without_outcomes(goal) for name, goal in case.goals.items()}
    assert given["move"] is case.goals["move"]
    assert given["tilt"] == goals.Tilt(0.5, max_slip=None)
    assert "tumbled" not in given["turn-over"].needed_outcomes()
