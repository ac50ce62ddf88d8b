"""The experiment on plans: what a robot has seen of the other world before it plans there."""

from dataclasses import replace

import numpy as np
import pytest

import foretrace as ft
from foretrace.experiments import planning
from foretrace.experiments.planning import BELIEVED, Planning, PlanningTrial
from foretrace.interactions.topdown import TopDownView


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
