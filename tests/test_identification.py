"""Identification: what a motion tells of frictions and centre of mass, and what it does not."""

import json
from dataclasses import replace

import numpy as np
import pytest

import foretrace as ft
from foretrace.errors import MonitoringError, PredictionError
from foretrace.imagined import Futures, ImaginedBatch, Imaginer, Scenes
from foretrace.imagined.belief import NOMINAL_BEVEL
from foretrace.monitoring import identification

TIMES = 0.1 * np.arange(20)
PRISM = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
ACTION = ft.LeverUp.at_edge(PRISM, edge=2)
VIEW = ft.TopDownView.of(PRISM, ACTION)


class Slider(Imaginer):
    """Slides an object ahead, by a distance that falls with friction, and lifts it by its centre of mass's place."""

    context = ("friction",)
    marginal = True

    @property
    def sample_times(self):
        return TIMES

    def imagine_scenes(self, scenes: Scenes) -> ImaginedBatch:
        phase = np.clip(TIMES, 0, 1)
        friction = np.nan_to_num(scenes.context[:, 0], nan=0.8)
        com = np.repeat(scenes.com[:, None], len(TIMES), axis=1)
        com[..., 0] += np.outer(0.06 * (1.2 - friction), phase)
        turned = np.zeros_like(com)
        turned[..., 1] = np.outer(-4 * (scenes.com[:, 0] - 0.02), phase)
        futures = replace(
            Futures.point(com, turned, "levered"), spread=np.full((len(scenes), 1, len(TIMES)), 1e-3)
        )
        return ImaginedBatch(TIMES, com, futures.pose[:, 0], futures)


def observed(friction: float, ahead: float) -> ft.ObservedMotion:
    """What the slider does to an object whose centre of mass lies ahead of where it is seen, noisily."""
    com = Slider().imagine(VIEW).com_trajectory[0] + [ahead, 0, 0]
    pose = Slider().imagine(VIEW, ACTION, context={"friction": friction}, com=com).pose_trajectory
    assert pose is not None
    noisy = pose.copy()
    noisy[:, :3] += np.random.default_rng(0).normal(scale=3e-4, size=(len(TIMES), 3))
    return ft.ObservedMotion(TIMES, noisy)


def ahead_of(belief: ft.Belief) -> float:
    return float(ACTION.T_action_object[0, :2] @ [belief.mean["com_x"], belief.mean["com_y"]])


def test_what_decides_the_motion_is_learned_and_all_else_keeps_its_prior():
    belief = ft.identify(VIEW, ACTION, observed(0.65, 0.012), imaginer=Slider())
    assert belief.mean["friction"] == pytest.approx(0.65, abs=3 * belief.std["friction"] + 0.01)
    assert belief.std["friction"] < 0.06
    assert ahead_of(belief) == pytest.approx(0.012, abs=0.004)
    assert "friction" in belief.learned
    assert "density" not in belief.learned
    assert belief.std["density"] == pytest.approx(belief.prior_std["density"], rel=0.2)
    assert "friction" in repr(belief)


def test_beliefs_multiply():
    once = ft.identify(VIEW, ACTION, observed(0.65, 0.012), imaginer=Slider())
    twice = ft.identify(VIEW, ACTION, observed(0.65, 0.012), once, imaginer=Slider(), seed=1)
    assert twice.std["friction"] < once.std["friction"]
    assert twice.std["contact_ahead"] > 0.5 * twice.prior_std["contact_ahead"]  # drawn anew
    assert twice.prior_std == once.prior_std
    assert twice.learned == once.learned or set(twice.learned) >= {"friction"}


def test_the_contact_of_an_execution_to_come_may_be_off_by_as_much_as_before():
    belief = ft.identify(VIEW, ACTION, observed(0.65, 0.012), imaginer=Slider())
    found = belief.updated(0.01 * belief.values + 0.99 * np.array([*belief.mean.values()]), belief.weights)
    assert found.sample(512)["contact_left"].std() < 2e-4
    drawn = found.sample_ahead(512)
    low, high = found.ranges["contact_left"]
    assert np.allclose(np.sort(drawn["contact_left"]), np.linspace(low, high, 512), atol=(high - low) / 256)
    assert drawn["friction"].std() < 0.1 * found.prior_std["friction"]
    worlds = Slider().imagine(VIEW, ACTION, context=found).worlds
    assert np.ptp(worlds.values["contact_left"][:256]) > 0.98 * (high - low)


def test_of_another_object_in_the_same_world_the_frictions_alone_are_known():
    belief = ft.identify(VIEW, ACTION, observed(0.65, 0.012), imaginer=Slider())
    other = belief.of_another_object()
    prior = identification.first_prior()
    assert other.mean["friction"] == pytest.approx(belief.mean["friction"], abs=0.01)
    assert other.std["friction"] == pytest.approx(belief.std["friction"], rel=0.1)
    for name in set(belief.names) - {"friction", "tool_friction"}:
        assert other.mean[name] == pytest.approx(prior.mean[name], abs=0.02 * prior.std[name])
        assert other.std[name] == pytest.approx(prior.std[name], rel=0.02)
    kept = belief.of_another_object(("com_x", "com_y"))
    assert ahead_of(kept) == pytest.approx(ahead_of(belief), abs=0.001)
    assert kept.std["friction"] == pytest.approx(prior.std["friction"], rel=0.02)
    with pytest.raises(PredictionError, match="'colour' is no constant"):
        belief.of_another_object(("colour",))


@pytest.mark.parametrize("learned", [False, True])
def test_a_belief_comes_back_from_its_file(tmp_path, learned):
    belief = ft.Belief({"com_x": (-0.025, 0.025)}, particles=64, seed=3)
    if learned:
        belief = ft.identify(VIEW, ACTION, observed(0.65, 0.012), imaginer=Slider())
    belief.save(tmp_path / "belief.json")
    again = ft.Belief.load(tmp_path / "belief.json")
    assert again.is_prior is not learned
    assert again.mean == belief.mean
    assert again.learned == belief.learned
    assert again.prior_std == belief.prior_std
    for name, values in belief.sample_ahead(16).items():
        np.testing.assert_array_equal(again.sample_ahead(16)[name], values)


def test_weights_that_say_nothing_are_refused():
    belief = ft.Belief(particles=4)
    for weights in (np.zeros(4), np.full(4, np.nan), -np.ones(4)):
        with pytest.raises(PredictionError, match=r"weights are .*: give finite ones"):
            belief.updated(belief.values, weights)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "version"),
        ({"weights": [1.0]}, "no belief"),
        ({"values": {}}, "no belief"),
        ({"weights": [-1.0] * 4096}, "no belief"),
        ({"weights": [1e308] * 4096}, "no belief"),
        ({"ranges": {"friction": [0.9, 1.0]}}, "out of its range"),
        ({"ranges": {"colour": [0.0, 1.0]}}, r"belief\.json: 'colour' is no constant"),
        ({"worlds": 0}, r"belief\.json: worlds is 0"),
    ],
)
def test_a_file_that_holds_no_belief_is_refused(tmp_path, change, words):
    file = tmp_path / "belief.json"
    ft.Belief().save(file)
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(PredictionError, match=words):
        ft.Belief.load(file)


def test_a_bevel_is_believed_in_as_all_else():
    fixed, open_ = ft.Belief(NOMINAL_BEVEL), ft.Belief({"bevel_height": (0.002, 0.004)})
    assert set(fixed.sample(50)["bevel_height"]) == {0.003}
    assert np.ptp(open_.sample(50)["bevel_height"]) > 0.0015
    assert "bevel_height" not in repr(fixed)
    assert "bevel_height" in repr(open_)
    assert 0.0005 < np.ptp(ft.Belief().sample(50)["bevel_height"]) < 0.0012
    note = Slider().imagine(VIEW, ACTION, context=open_).warnings
    assert any("bevel_height makes no difference" in line for line in note)


def test_an_exact_imaginer_has_the_last_word():
    belief = ft.identify(VIEW, ACTION, observed(0.65, 0.0), imaginer=Slider(), exact=Slider())
    assert len(belief.values) == identification.BEST
    assert belief.mean["friction"] == pytest.approx(0.65, abs=0.05)


def test_a_motion_that_did_not_begin_tells_nothing():
    motion = observed(0.65, 0.0)
    still = ft.ObservedMotion(motion.times, np.tile(motion.poses[:1], (len(TIMES), 1)))
    belief = ft.identify(VIEW, ACTION, still, imaginer=Slider())
    assert belief.learned == ()


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ((VIEW, ACTION, 3), PredictionError, "give an Effect"),
        ((3, ACTION, observed(0.8, 0.0)), MonitoringError, "view of type int"),
        ((VIEW, 3, observed(0.8, 0.0)), MonitoringError, "action of type int"),
    ],
)
def test_what_cannot_be_used(monkeypatch, arguments, error, words):
    plain = getattr(identification.identify, "__wrapped__", identification.identify)
    with pytest.raises(Exception) as caught:  # noqa: PT011
        plain(*arguments, imaginer=Slider())
    assert isinstance(caught.value, error) or type(caught.value).__name__ == "TypeCheckError"


@pytest.mark.slow
def test_the_centre_of_mass_of_a_loaded_object_is_found():
    loaded = ft.Weighted(PRISM, (0.015, -0.01))
    belief = None
    for edge in (2, 0, 4):
        action = ft.LeverUp.at_edge(PRISM, edge=edge)
        effect = ft.simulate(loaded, action, embodiment="tool").effect
        belief = ft.identify(ft.TopDownView.of(PRISM, action), action, effect, belief)
    assert belief is not None
    assert {"com_x", "com_y"} <= set(belief.learned)
    off = np.array([belief.mean["com_x"], belief.mean["com_y"]]) - [0.015, -0.01]
    assert np.linalg.norm(off) < 0.008
