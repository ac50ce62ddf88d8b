"""Sequences of actions: composed, carried out, and planned again."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest

import foretrace as ft
from foretrace.errors import PlanningError, SimulationError
from foretrace.geometry import planar_transform, transform_points
from foretrace.imagined import Futures, ImaginedBatch
from foretrace.objects import NO_BEVEL
from foretrace.planning import Motions, execute_sequence, plan_sequence
from foretrace.planning.lessons import Lesson, taught
from foretrace.planning.motions import placed
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.world import SimulatedWorld

SIDE = 0.09
PLATE = ft.Prism(SIDE / 2 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]), 0.013, NO_BEVEL)
QUICK = ft.PlanConfig(spacing=0.04, directions=3, refine=2, samples=16)
TWIN = ft.SlidingTwin(steps=16)
FAR = ft.goals.MoveTo((0.06, 0.06), turn=0.6, tolerance=0.012, turn_tolerance=0.2)
T = planar_transform([0.02, -0.01, 0.0], 0.7)


class Moved:
    """A world in which pushes end as the twin imagines them, turned a little further."""

    def __init__(self, extra: float = 0.0) -> None:
        self.T, self.extra, self.acted = np.eye(4), extra, 0

    def observe(self):
        return PLATE

    def locate(self):
        return self.T

    def act(self, action, T_table_object):
        self.acted += 1
        imagined = TWIN.imagine_candidates(*_view(action))
        motions = Motions.of(imagined, [action], PLATE.corners, PLATE.height, whole=True)
        step = motions.resting_frames()[0][0]
        self.T = T_table_object @ step @ planar_transform([0.0, 0.0, 0.0], self.extra)
        return "pushed"


class Lost(Moved):
    def locate(self):
        return np.full((4, 4), np.nan)


class Blind(Moved):
    def observe(self) -> Any:
        return None


def _view(action):
    from foretrace.planning.candidates import Scene

    scene = Scene.of(PLATE)
    return scene.view, scene.in_view([action])


def motions(shift=(0.03, 0.01), turn=0.4, tilt=0.0):
    """One push whose object moves and turns, from the frame of the object."""
    push = ft.Push((-0.045, 0.0), (1.0, 0.0))
    times = np.linspace(0, push.duration, 11)
    com = np.array([0.045, 0.0, 0.0065]) + np.linspace(0, 1, 11)[:, None] * [*shift, 0.0]
    turned = np.linspace(0, 1, 11)[:, None] * [0.0, tilt, turn]
    futures = Futures.point(com[None], turned[None], "pushed")
    return Motions.of(
        ImaginedBatch(times, com[None], None, futures), [push], PLATE.corners, PLATE.height, whole=True
    )


def test_where_an_object_rests_is_its_frame_after_the_motion():
    frames, flat = motions().resting_frames()
    com = np.array([[0.0, 0.0, 0.0]])
    np.testing.assert_allclose(transform_points(frames[0], com)[0, :2], [0.03, 0.01], atol=1e-12)
    np.testing.assert_allclose(frames[0][:2, 0], [np.cos(0.4), np.sin(0.4)])
    assert flat.all()
    assert not motions(tilt=1.5, turn=0.0).resting_frames()[1].any()


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_motions_continue_from_where_the_object_lies(tilt):
    """What is wanted from the very start is what is wanted now, seen from the new frame."""
    found = motions(tilt=tilt)
    com = np.array([0.0, 0.0, 0.0065])
    after = found.continuing(T, com)
    here = transform_points(T, com[None])[0]
    np.testing.assert_allclose(after.com[0, 0, 0], com)
    np.testing.assert_allclose(after.com[0, 0, 1], here, atol=1e-12)
    np.testing.assert_allclose(after.end_com[0, 0], transform_points(T, found.end_com[0])[0], atol=1e-12)
    np.testing.assert_allclose(after.tilt[0, 0, 1:], found.tilt[0, 0], atol=1e-7)
    if not tilt:
        assert after.heading[0, 0] == pytest.approx(found.heading[0, 0] + 0.7)
    np.testing.assert_allclose(after.actions[0].contact, placed(found.actions[0], T).contact)


def test_thinned_motions_keep_start_and_end():
    found = motions()
    few = found.thinned(4)
    assert few.com.shape == (1, 1, 4, 3)
    np.testing.assert_allclose(few.end_com, found.end_com)
    np.testing.assert_allclose(few.heading, found.heading)
    np.testing.assert_allclose(few.shift, found.shift)


def test_an_action_that_was_seen_to_end_elsewhere_is_expected_there():
    found = motions()
    action, imagined = found.actions[0], found.resting_frames()[0][0]
    observed = imagined @ planar_transform([0.004, -0.002, 0.0], -0.3)
    lesson = Lesson.of(action, imagined, observed)
    again = taught(found, [lesson])
    np.testing.assert_allclose(again.resting_frames()[0][0], observed, atol=1e-12)
    np.testing.assert_allclose(again.com[0, 0, 0], found.com[0, 0, 0], atol=1e-12)
    twice = taught(found, [lesson, Lesson.of(action, imagined, imagined)])
    np.testing.assert_allclose(twice.heading, found.heading - 0.15)
    unlike = [action.moved(0.0, 0.08, 0.0), replace(action, path=ft.PushPath(distance=0.02))]
    for other in unlike:
        np.testing.assert_allclose(taught(found, [replace(lesson, action=other)]).com, found.com, atol=1e-9)
    np.testing.assert_allclose(Lesson.of(action, imagined, np.diag([1.0, -1.0, -1.0, 1.0])).error, 0.0)


class Stubborn(Moved):
    """A world in which the first push that is tried moves nothing."""

    stuck = None

    def act(self, action, T_table_object):
        self.stuck = self.stuck or action
        if np.linalg.norm(action.contact - self.stuck.contact) < 0.005:
            self.T = T_table_object
            return "missed"
        return super().act(action, T_table_object)


def test_what_did_not_work_is_not_tried_again_and_again():
    goal = ft.goals.MoveTo((0.0, 0.03), tolerance=0.01)
    config = replace(QUICK, refine=0, directions=1, vary_path=False)
    found = execute_sequence(Stubborn(), goal, 4, TWIN, config=config)
    tried = [np.linalg.norm(each.contact - found.actions[0].contact) < 0.005 for each in found.actions]
    assert sum(tried) == 1
    assert found.reached


def test_a_sequence_goes_where_one_push_does_not(tmp_path):
    one = plan_sequence(PLATE, FAR, 1, TWIN, config=QUICK)
    several = plan_sequence(PLATE, FAR, 3, TWIN, config=QUICK)
    assert "one action does not reach the goal MoveTo" in one.note
    assert not several.note
    assert several.reached >= 0.5 > one.reached
    assert len(several.actions) == len(several.frames) - 1 >= 2
    end = transform_points(several.frames[-1], np.zeros((1, 3)))[0, :2]
    np.testing.assert_allclose(end, [0.06, 0.06], atol=0.013)
    content = json.loads(several.save(tmp_path / "sequence.json").read_text())
    assert len(content["actions"]) == len(several.actions)
    with pytest.raises(PlanningError, match=r"sequence\.json"):
        ft.Plan.open(tmp_path / "sequence.json")


def test_planning_again_makes_up_for_what_the_world_adds():
    """Every push turns the object by 0.15 rad more than imagined."""
    again, blind = (
        execute_sequence(Moved(0.15), FAR, 5, TWIN, config=QUICK, replan=r) for r in (True, False)
    )
    assert again.reached
    assert not blind.reached
    assert again.cost < blind.cost
    assert len(again.sequences) == len(again.actions) == len(again.frames) - 1
    assert len(blind.sequences) == 1
    exact = execute_sequence(Moved(), FAR, 5, TWIN, config=QUICK, replan=False)
    assert exact.reached


def test_a_simulated_world_keeps_where_the_object_lies():
    world = SimulatedWorld(PLATE, SimulationConfig(embodiment="tool", timestep=0.004, sample_period=0.04))
    world.T_table_object = T
    push = ft.Push.at_edge(PLATE, 0, path=ft.PushPath(distance=0.02, speed=0.1))
    assert world.act(push, T) == "pushed"
    moved = np.linalg.inv(T) @ world.locate()
    np.testing.assert_allclose(moved[:2, 3], 0.02 * push.direction, atol=1.5e-3)
    assert world.act(push, T) == "missed"  # it is not there any more
    world.T_table_object = T @ planar_transform([*(-0.01 * push.direction), 0.0], 0.0)
    assert world.act(push, T) == "failed"  # the rod would begin in the object
    world.T_table_object = np.diag([1.0, -1.0, -1.0, 1.0])
    with pytest.raises(SimulationError, match="lies on another side"):
        world.observe()


def test_a_lever_up_is_set_down_again():
    """The twin that plays to rest: flat at the end, with the outcome of the lift."""
    from foretrace.twin import TwinConfig

    box = ft.Box(0.12, 0.08, 0.04)
    lever = ft.LeverUp.at_edge(box, 0)
    twin = ft.TwinImaginer(config=TwinConfig(set_down=True))
    assert twin.rests
    imagined = twin.imagine(ft.TopDownView.of(box, lever), lever)
    tilt = np.linalg.norm(
        imagined.futures.states[0, imagined.futures.probability[0].argmax(), :, 3:5], axis=1
    )
    assert tilt.max() > 0.2
    assert tilt[-1] < 0.02
    plain = ft.TwinImaginer().imagine(ft.TopDownView.of(box, lever), lever)
    assert imagined.futures.outcomes() == plain.futures.outcomes()


BAD = {
    "steps": (lambda: plan_sequence(PLATE, FAR, 0, TWIN), "steps is 0: give a whole number from 1 to 20"),
    "an imaginer that lifts": (
        lambda: plan_sequence(PLATE, FAR, 2, ft.TwinImaginer()),
        "the twin imaginer does not tell how an object comes to rest",
    ),
    "a goal that is reached": (
        lambda: plan_sequence(PLATE, ft.goals.MoveTo((0.0, 0.0)), 2, TWIN),
        r"the goal MoveTo\(position=\(0, 0\)\) is reached already: give another one",
    ),
    "a function": (
        lambda: plan_sequence(PLATE, lambda motions: -motions.shift[..., 0], 2, TWIN),
        "is a function, which does not tell when it is reached",
    ),
    "a lift": (
        lambda: plan_sequence(PLATE, ft.goals.Lift(), 2),
        r"the goal Lift\(\) is about an object that is levered, a sequence ends with the object at rest",
    ),
    "a world that has lost the object": (
        lambda: execute_sequence(Lost(), FAR, 2, TWIN),
        r"the frame that the world's locate\(\) returns",
    ),
    "a world that sees nothing": (
        lambda: execute_sequence(Blind(), FAR, 2, TWIN),
        r"the world's observe\(\) returned a value of type NoneType: give ObjectModel or TopDownView",
    ),
    "far away": (
        lambda: plan_sequence(PLATE, ft.goals.MoveTo((3.0, 0.0)), 2, TWIN),
        "outside what one view shows",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_sequences_that_cannot_be_are_named_in_a_line(name):
    make, text = BAD[name]
    with pytest.raises((PlanningError, TypeError), match=text) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_every_method_of_the_experiment_has_its_bar():
    from foretrace.experiments import sequences

    rows = pd.DataFrame(
        [
            {"kind": "", "number": k, "task": task, "method": method, "reached": k > 0, "actions": 2}
            | dict.fromkeys(sequences.MEDIANS, 1.0)
            for task, methods in sequences.METHODS.items()
            for method in methods
            for k in range(3)
        ]
    )
    (figure,) = sequences.draw(sequences.summary_of(rows)).values()
    assert [len(ax.patches) for ax in figure.axes] == [len(each) for each in sequences.METHODS.values()]


def test_lessons_are_about_what_was_imagined(monkeypatch):
    """Not about what was expected after earlier lessons: then a second one would deny the first."""
    learned = []
    monkeypatch.setattr(
        "foretrace.planning.sequence.taught",
        lambda motions, lessons: learned.append(lessons) or taught(motions, lessons),
    )
    goal = ft.goals.MoveTo((0.2, 0.0), tolerance=0.01)
    config = replace(QUICK, refine=0, directions=1, vary_path=False)
    found = execute_sequence(Moved(0.05), goal, 4, TWIN, config=config)
    errors = [lesson.error for lesson in max(learned, key=len)]
    assert len(errors) == len(found.actions) - 1 >= 2
    np.testing.assert_allclose(errors, [[0.0, 0.0, 0.05]] * len(errors), atol=1e-9)
