"""What actions are expected to tell, against what they then do tell."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import foretrace as ft
from foretrace.errors import MonitoringError, PlanningError, PredictionError
from foretrace.imagined import Futures, ImaginedBatch, Imaginer, Scenes
from foretrace.imagined.belief import NOMINAL_BEVEL
from foretrace.imagined.context import nominal_constants
from foretrace.monitoring.information import OBJECTS, information_gain
from foretrace.planning.plan import LEARNING

PRISM = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
VIEW, T_VIEW_OBJECT = ft.TopDownView.around(PRISM)
goals = ft.goals
ZONE = [(-0.3, -0.2), (-0.1, -0.2), (-0.1, 0.2), (-0.3, 0.2)]
STILL = {name: (0.0, 0.0) for name in ("contact_ahead", "contact_left", "contact_turn")}
FIXED = NOMINAL_BEVEL | {"friction": (0.8, 0.8), "tool_friction": (0.3, 0.3), "density": (600.0, 600.0)}
ONE = ft.Belief(FIXED | STILL | {"friction": (0.5, 1.1)})
"""Friction alone is not known."""


def at_edges(fraction: float = 0.5) -> list[ft.LeverUp]:
    """A lever-up at each edge, in the object's frame."""
    return [ft.LeverUp.at_edge(PRISM, edge, fraction) for edge in range(5)]


def in_view(actions: Sequence[ft.Action]) -> list[ft.Action]:
    turn, shift = T_VIEW_OBJECT[:2, :2], T_VIEW_OBJECT[:2, 3]
    return [replace(a, contact=turn @ a.contact + shift, direction=turn @ a.direction) for a in actions]


class Slide(Imaginer):
    """Slides an object ahead, the further the less friction, and the more the farther its centre of mass is ahead."""

    context = ("friction",)
    marginal = True

    def __init__(
        self, of_friction: float = 1.0, of_contact: float = 0.0, slips: bool = False, turns: bool = True
    ):
        self.of_friction, self.of_contact, self.slips, self.turns = of_friction, of_contact, slips, turns

    @property
    def sample_times(self) -> np.ndarray:
        return np.linspace(0.0, 3.0, 31)

    def imagine_scenes(self, scenes: Scenes) -> ImaginedBatch:
        times, count = self.sample_times, len(scenes)
        phase = np.clip(times, 0, 1)
        friction = np.nan_to_num(scenes.context[:, 0], nan=0.8)
        ahead = self.of_friction * (1.1 - friction) * np.clip(scenes.com[:, 0] - 0.03, 0.0, None)
        assert scenes.actions is not None
        contacts = np.array([action.contact[1] for action in scenes.actions])
        ahead = 0.01 + ahead + (self.of_contact * contacts if self.of_contact else 0.0)
        com = np.repeat(scenes.com[:, None], len(times), axis=1)
        com[..., 0] += np.outer(ahead, phase)
        futures = Futures.point(com, np.zeros_like(com) if self.turns else None, "levered")
        futures = replace(futures, spread=np.full((count, 1, len(times)), 1e-3))
        if self.slips:
            other = com.copy()
            other[..., 1] += 0.03 * phase
            states = np.concatenate([futures.states, futures.states], axis=1)
            states[:, 1, :, :3] = other
            chance = (friction < 0.8).astype(float)
            futures = Futures(
                np.stack([1 - chance, chance], axis=1), ("levered", "slipped"), states,
                np.full((count, 2, len(times)), 1e-3), np.full((count, 2, 2, 2), np.nan), futures.quantiles,
            )  # fmt: skip
        return ImaginedBatch(times, com, futures.pose[:, 0], futures)


unchecked: Any = getattr(information_gain, "__wrapped__", information_gain)


def gains(imaginer: Imaginer, belief: ft.Belief, **arguments: Any) -> np.ndarray:
    return information_gain(VIEW, in_view(at_edges()), belief, imaginer=imaginer, **arguments)


def test_worlds_that_move_alike_tell_nothing():
    assert gains(Slide(of_friction=0.0), ONE).max() < 1e-6
    assert gains(Slide(), ft.Belief(FIXED | STILL)).max() < 1e-6


def test_what_the_error_of_the_contact_explains_is_not_learned():
    """Motions differ by as much as with friction, but with what the next execution draws anew."""
    belief = ft.Belief(FIXED)
    assert gains(Slide(of_friction=0.0, of_contact=10.0), belief).max() < 0.05
    confounded = gains(Slide(of_contact=10.0), ft.Belief(FIXED | {"friction": (0.5, 1.1)}))
    assert (confounded < gains(Slide(), ONE)).all()


def test_two_outcomes_that_friction_decides_tell_one_bit():
    found = gains(Slide(of_friction=0.0, slips=True), ONE)
    np.testing.assert_allclose(found, np.log(2), atol=0.02)


def test_the_estimate_is_that_of_a_fine_grid():
    """Friction moves the object by up to 4 cm, known within millimetres: the information is near that of a channel."""
    found = gains(Slide(), ONE)
    assert (found < np.log(OBJECTS)).all()
    reach = np.array([float((T @ np.r_[PRISM.mass_properties(1.0).com, 1])[0]) - 0.03 for T in frames()])
    assert (
        np.argsort(found).tolist() == np.argsort(reach).tolist()
    )  # the farther it slides, the more it tells
    assert found[reach < 0].max(initial=0.0) < 1e-6


def frames() -> list[np.ndarray]:
    return [action.T_action_object for action in at_edges()]


def test_the_most_informative_narrows_the_posterior_more():
    found = gains(Slide(), ONE)
    spread = []
    for k in (int(found.argmax()), int(found.argmin())):
        action = at_edges()[k]
        view = ft.TopDownView.of(PRISM, action)
        seen = Slide().imagine(view, action, context={"friction": 0.65})
        assert seen.pose_trajectory is not None
        motion = ft.ObservedMotion(seen.times, seen.pose_trajectory)
        spread.append(ft.identify(view, action, motion, ONE, imaginer=Slide()).std["friction"])
    assert spread[0] < 0.9 * spread[1]
    known = ONE.updated(ONE.values[:2], np.array([0.5, 0.5]))
    assert gains(Slide(), known).max() < 0.7  # two particles: not more than a bit


def test_the_planner_takes_the_most_informative_within_limits():
    found = ft.plan(PRISM, goals.Learn(), Slide(), ONE)
    expected = information_gain(VIEW, in_view([found.action]), ONE, imaginer=Slide(), com=centre_in_view())
    assert -found.cost == pytest.approx(expected[0])
    assert -found.cost >= gains(Slide(), ONE, com=centre_in_view()).max() - 0.1
    assert found.reached == 1
    assert [stage.name for stage in found.stages] == ["imagined"]  # as LEARNING says, and without the twin
    assert LEARNING.refine == 0
    few = ft.PlanConfig(spacing=0.08, directions=1, refine=0)
    limited = ft.plan(PRISM, goals.Learn() + goals.Avoid(ZONE), Slide(), ONE, config=few)
    assert limited.risk == 0
    assert (
        found.action.contact[0] < -0.03 < limited.action.contact[0]
    )  # the blade would come through the zone
    nothing = ft.plan(PRISM, goals.Learn(), Slide(of_friction=0.0), ONE, config=few)
    assert nothing.reached == 0
    assert "nothing reaches the goal Learn()" in nothing.note


def centre_in_view() -> np.ndarray:
    return T_VIEW_OBJECT[:3, :3] @ PRISM.mass_properties(1.0).com + T_VIEW_OBJECT[:3, 3]


def test_the_same_seed_gives_the_same():
    once, again, other = (gains(Slide(), ONE, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(once, other)


@pytest.mark.parametrize(
    ("ask", "error", "words"),
    [
        (lambda: ft.plan(PRISM, goals.Learn(), Slide()), PlanningError, "give a Belief as context"),
        (lambda: ft.plan(PRISM, goals.Lift() + goals.Learn(), Slide(), "unknown"), PlanningError, "a Belief"),
        (lambda: ft.plan_sequence(PRISM, goals.Learn(), 2, Slide(), ONE), PlanningError, "about one action"),
        (lambda: goals.Learn(at_least=-1.0), PlanningError, "at_least is -1.0"),
        (lambda: information_gain(VIEW, [], ONE, imaginer=Slide()), PredictionError, "no candidate"),
        (lambda: gains(Slide(turns=False), ONE), MonitoringError, "positions alone"),
        (lambda: unchecked(VIEW, [], ONE, seed="a"), MonitoringError, "seed is 'a': give a whole number"),
        (
            lambda: information_gain(VIEW, [], ONE, seed=-1),
            MonitoringError,
            "seed is -1: give a whole number",
        ),
        (lambda: unchecked(VIEW, [], {"friction": 1}), MonitoringError, "belief of type dict"),
    ],
)
def test_what_cannot_be_asked(ask, error, words):
    with pytest.raises(error, match=words):
        ask()


BLADE = ft.Belief(FIXED | STILL | {"tool_friction": (0.2, 0.45)})
"""The blade's friction alone is not known."""
TABLE = ft.Belief(FIXED | STILL | {"friction": (0.5, 1.1)})
"""The table's friction alone is not known."""


def test_the_predictor_that_comes_with_foretrace():
    actions, predictor = in_view(at_edges(0.35)[:1]), ft.load_predictor()
    assert information_gain(VIEW, actions, BLADE, imaginer=predictor)[0] > 0.05
    assert information_gain(VIEW, actions, ft.Belief(FIXED | STILL), imaginer=predictor)[0] < 1e-6


@pytest.mark.slow
def test_its_most_informative_lever_up_narrows_the_posterior_more():
    predictor, actions = ft.load_predictor(), at_edges(0.35)
    found = information_gain(VIEW, in_view(actions), TABLE, imaginer=predictor, com=centre_in_view())
    spread = []
    for k in (int(found.argmax()), int(found.argmin())):
        view, own = ft.TopDownView.of(PRISM, actions[k]), []
        for friction in (0.6, 0.75, 0.9):
            told = nominal_constants() | {"friction": friction}
            seen = predictor.imagine(view, actions[k], context=told)
            assert seen.pose_trajectory is not None
            motion = ft.ObservedMotion(seen.times, seen.pose_trajectory)
            own.append(ft.identify(view, actions[k], motion, TABLE, imaginer=predictor).std["friction"])
        spread.append(np.mean(own))
    assert found.max() > found.min() + 0.1
    assert spread[0] < spread[1]
