"""Pushes that are imagined, planned and watched by the sliding twin."""

import numpy as np
import pytest

import foretrace as ft
from factories import write_push_table
from foretrace.errors import PlanningError, PredictionError
from foretrace.interactions.pushes import read_pushes
from foretrace.interactions.pushes_data import end_time, push_interaction
from foretrace.objects import NO_BEVEL
from foretrace.simulation.sliding import Footprint, slide, slide_along
from foretrace.twin.sliding import SlidingTwin
from foretrace.twin.sliding_constants import NAMES

SIDE = 0.09
PLATE = ft.Prism(SIDE / 2 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]), 0.013, NO_BEVEL)
QUICK = ft.PlanConfig(spacing=0.015, directions=3, refine=3, samples=48)
TWIN = SlidingTwin(worlds=8)


def imagine(push: ft.Push, **settings):
    return TWIN.imagine(ft.TopDownView.of(PLATE, push), push, **settings)


def test_a_push_through_the_middle_is_imagined_straight():
    imagined = imagine(ft.Push.at_edge(PLATE, 0, path=ft.PushPath(distance=0.03)))
    moved = imagined.com_trajectory[-1] - imagined.com_trajectory[0]
    np.testing.assert_allclose(moved, [0.03, 0, 0], atol=5e-4)
    assert imagined.futures.outcomes()["pushed"] == 1
    assert np.isnan(imagined.futures.radius(0.9)).all()  # one world tells no spread


@pytest.mark.parametrize("fraction", [0.2, 0.7])
def test_an_imagined_push_is_that_of_the_quasi_static_model(fraction):
    """Seen from the object or from the push, with the outline from the view or known: the same motion."""
    push = ft.Push.at_edge(PLATE, 1, fraction).moved(0.0, 0.0, 0.2)
    from foretrace.objects.footed import feet_of

    start = push.contact - (push.path.approach + push.tool.radius) * push.direction
    footprint = Footprint(PLATE.corners, feet_of(PLATE.corners, "uniform"))
    shift, turn = slide(
        footprint, start[None], (push.path.length * push.direction)[None], push.tool.radius, 0.2, 40
    )
    imagined = imagine(push)
    moved = imagined.com_trajectory[-1, :2] - imagined.com_trajectory[0, :2]
    np.testing.assert_allclose(moved, push.T_action_object[:2, :2] @ shift[0], atol=1e-3)
    np.testing.assert_allclose(imagined.futures.states[0, 0, -1, 5], turn[0], atol=0.02)


def test_regions_hold_pushes_that_were_carried_out(tmp_path):
    """Known at their ends alone, and pushed farther and less exactly than the twin says."""
    pushes = read_pushes(*write_push_table(tmp_path, 260, farther=0.002, noise=0.002))[0]
    order = np.random.default_rng(0).permutation(len(pushes))
    twin = ft.SlidingTwin(steps=8).calibrated(pushes[order[60:]])
    end, rows = end_time(pushes), order[:60].tolist()
    held = []
    for made in (push_interaction(pushes, row, end, row) for row in rows):
        if made is None:
            continue
        imagined = twin.imagine(made.view, made.action)
        last = int(np.searchsorted(imagined.times, made.action.path.duration)) - 1
        off = np.linalg.norm(imagined.com_trajectory[last] - made.effect.com_trajectory[-1])
        held.append([off <= imagined.futures.radius(level)[0, 0, last] for level in (0.5, 0.9)])
    half, most = np.mean(held, axis=0)
    assert 0.3 < half < 0.7
    assert 0.78 < most < 1.0
    at_rest = imagined.futures.radius(0.9)[0, 0, 0]
    assert at_rest < 0.5 * imagined.futures.radius(0.9)[0, 0, -1]
    with pytest.raises(PredictionError, match="no push to calibrate with"):
        ft.SlidingTwin().calibrated(pushes[:0])


def test_what_is_not_told_widens_the_regions():
    push = ft.Push.at_edge(PLATE, 0, 0.8)
    unknown, friction = imagine(push, context="unknown"), imagine(push, context={"contact_error": 0.0})
    wide, narrow = (np.nanmax(each.futures.spread[0, 0]) for each in (unknown, friction))
    assert wide > narrow > 1e-3
    assert np.isfinite(unknown.futures.radius(0.5)[0, 0]).all()


def test_ranges_that_make_no_difference_are_pointed_out():
    push = ft.Push.at_edge(PLATE, 0)
    told = imagine(push, context=ft.Belief({"friction": (0.3, 0.9), "density": (500.0, 600.0)}, worlds=2))
    assert "friction and density make no difference" in told.warnings[-1]
    assert not imagine(push, context=ft.Belief({"tool_friction": (0.3, 0.4)}, worlds=2)).warnings


def test_a_rod_beside_the_object_loses_it():
    far = ft.Push.at_edge(PLATE, 0, 0.95, path=ft.PushPath(distance=0.11))
    assert imagine(far).futures.outcomes()["turned away"] == 1


def test_frictions_and_feet_may_differ_between_pushes():
    feet = Footprint(PLATE.corners, np.array([[0.03, 0.0], [-0.03, 0.0], [0.0, 0.03], [0.0, -0.03]]))
    start, motion = np.tile([-0.052, 0.02], (2, 1)), np.tile([0.03, 0.01], (2, 1))
    both = slide_along(feet, start, motion, 0.00475, np.array([0.1, 0.4]))
    for row, friction in enumerate((0.1, 0.4)):
        one = slide(feet, start[:1], motion[:1], 0.00475, friction)
        np.testing.assert_allclose(both.position[row, -1], one[0][0], atol=1e-9)
    assert np.abs(both.position[0, -1] - both.position[1, -1]).max() > 1e-3


def test_a_plan_pushes_the_object_where_it_shall_be(tmp_path):
    goal = ft.goals.MoveTo((0.03, 0.0), turn=0.0, tolerance=0.005, turn_tolerance=0.09)
    plan = ft.plan(PLATE, goal, TWIN, config=QUICK)
    assert isinstance(plan.action, ft.Push)
    assert plan.reached == 1
    assert not plan.note
    again = ft.Plan.open(plan.save(tmp_path / "plan.json"))
    assert again.action.to_dict() == plan.action.to_dict()
    assert "push at" in repr(again)


BAD = {
    "a push of another time": (
        lambda: imagine(ft.Push.at_edge(PLATE, 0, path=ft.PushPath(distance=0.4))),
        PredictionError,
        "the push takes 20.5 s, the twin imagines 6 s: give a shorter one",
    ),
    "a lever-up": (
        lambda: TWIN.imagine(
            ft.TopDownView.of(PLATE, ft.LeverUp.at_edge(PLATE, 0)), ft.LeverUp.at_edge(PLATE, 0)
        ),
        PredictionError,
        "the sliding twin imaginer imagines a push, not a lever-up: give an imaginer of a lever-up, such as ft.Twin",
    ),
    "a lift": (
        lambda: ft.plan(PLATE, ft.goals.Lift(), TWIN, config=QUICK),
        PlanningError,
        "about the outcome levered, the sliding twin imaginer tells pushed, turned away, missed",
    ),
    "two kinds": (
        lambda: ft.plan(PLATE, ft.goals.MoveTo((0.03, 0)), TWIN, checker=ft.TwinImaginer()),
        PlanningError,
        "the sliding twin imagines a push, the checker twin a lever-up: give two",
    ),
    "friction of the table": (
        lambda: imagine(ft.Push.at_edge(PLATE, 0), context={"friction": 0.5}),
        PredictionError,
        "not on 'friction': leave it out of context",
    ),
    "a negative friction of the rod": (
        lambda: imagine(ft.Push.at_edge(PLATE, 0), context={"tool_friction": -5.0}),
        PredictionError,
        "context tool_friction is -5.0: give a value from 0 to 10",
    ),
    "a friction of 50": (
        lambda: imagine(ft.Push.at_edge(PLATE, 0), context={"tool_friction": 50.0}),
        PredictionError,
        "context tool_friction is 50.0: give a value from 0 to 10",
    ),
    "a belief in a negative friction": (
        lambda: ft.Belief({"tool_friction": (-0.1, 0.3)}),
        PredictionError,
        r"tool_friction has the range \(-0.1, 0.3\): give numbers from 0 to 10",
    ),
    "worlds": (
        lambda: SlidingTwin(worlds=1),
        PredictionError,
        "worlds is 1, duration 6.0: give a whole number from 2",
    ),
    "a shape that was never pushed": (
        lambda: TWIN.of_shape("abs", "rect1"),
        PredictionError,
        "shape 'rect1' on 'abs' was never pushed: choose from none",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_is_named_in_a_line(name):
    make, kind, text = BAD[name]
    with pytest.raises(kind, match=text) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_the_constants_of_a_shape_decide_its_pushes():
    values = np.zeros(len(NAMES))
    values[0] = np.log(0.4 / 0.2)
    twin = SlidingTwin(own={("", "plate"): values}).of_shape("", "plate")
    assert twin.friction == pytest.approx(0.4)
    push = ft.Push.at_edge(PLATE, 0, 0.7).moved(0.0, 0.0, 0.4)
    told = imagine(push, context={"tool_friction": 0.4, "contact_error": 0.0})
    own = twin.imagine(ft.TopDownView.of(PLATE, push), push)
    np.testing.assert_allclose(own.com_trajectory, told.com_trajectory, atol=1e-9)


def tracked(push: ft.Push, friction: float):
    """Times and poses of the simulated push."""
    from foretrace.objects import Footed

    physics = ft.Physics(tool_friction=friction)
    effect = ft.simulate(
        Footed(PLATE), push, embodiment="tool", physics=physics, timestep=0.004, sample_period=0.04
    ).effect
    return effect.times, effect.pose_trajectory


def watch(push: ft.Push, times, poses):
    """The last verdict, or the first alarm."""
    belief = ft.Belief({"tool_friction": (0.1, 0.5)}, worlds=32)
    monitor = ft.Monitor(imagine(push, context=belief))
    for t, pose in zip(times, poses, strict=True):
        verdict = monitor.update(float(t), pose)
        if verdict.alarm:
            return verdict
    return verdict


def test_a_push_is_watched():
    """As imagined: no alarm. Blocked half way, or turned away by another rod's path: an alarm."""
    push = ft.Push.at_edge(PLATE, 0, 0.7)
    times, poses = tracked(push, 0.25)
    calm = watch(push, times, poses)
    assert not calm.alarm
    assert calm.outcomes["pushed"] > 0.9
    half = len(times) // 2
    blocked = watch(push, times, np.where(np.arange(len(times))[:, None] < half, poses, poses[half]))
    assert blocked.alarm
    assert times[half] < blocked.time < times[-1] - 0.1
    beside = push.moved(0.0, 0.035, 0.0)  # it turns out of the rod's way
    _, other = tracked(beside, 0.25)
    T = push.T_action_object @ np.linalg.inv(beside.T_action_object)
    from foretrace.geometry import matrix_to_pose, pose_to_matrix

    assert watch(push, times, matrix_to_pose(T @ pose_to_matrix(other))).alarm


@pytest.mark.slow
def test_a_push_tells_the_friction_of_the_rod():
    """Observed in a world like the twin's, slanting enough for the friction to decide."""
    push = ft.Push.at_edge(PLATE, 0, 0.75, path=ft.PushPath(0.03, speed=0.1)).moved(0.0, 0.0, 0.5)
    twin, view = ft.SlidingTwin(steps=8, duration=1.0), ft.TopDownView.of(PLATE, push)
    seen = twin.imagine(view, push, context={"tool_friction": 0.45, "contact_error": 0.0})
    poses = seen.object_poses(push.T_action_object)
    prior = ft.Belief({"tool_friction": (0.05, 0.6)} | dict.fromkeys(("com_x", "com_y"), (-0.001, 0.001)))
    belief = ft.identify(view, push, ft.ObservedMotion(seen.times, poses), prior, imaginer=twin)
    assert belief.mean["tool_friction"] > prior.mean["tool_friction"] + 0.03


@pytest.mark.slow
def test_constants_are_identified_from_pushes_that_were_carried_out():
    from foretrace.errors import DatasetError
    from foretrace.interactions.pushes import RecordedPushes
    from foretrace.objects import Footed

    made = []
    for k in range(2):
        push = ft.Push.at_edge(PLATE, k, 0.75, path=ft.PushPath(0.03, speed=0.05)).moved(0.0, 0.0, 0.5)
        made.append(
            ft.simulate(
                Footed(PLATE), push, embodiment="tool", physics=ft.Physics(tool_friction=0.5), timestep=0.004,
                sample_period=0.04,
            )
        )  # fmt: skip
    pushes = RecordedPushes.of(made, "table")
    assert len(pushes) == 2
    assert [shape.name for shape in pushes.shapes] == ["object 0"]
    end = made[0].effect.com_trajectory[-1] - made[0].effect.com_trajectory[0]
    np.testing.assert_allclose(
        pushes.displacement()[0, :2], made[0].action.T_action_object[:2, :2].T @ end[:2], atol=1e-5
    )
    twin = SlidingTwin.identified(pushes).of_shape("table", "object 0")
    assert twin.friction != SlidingTwin().friction
    off, nominal = (
        np.abs(each.predict(pushes) - pushes.displacement())[:, :2].max()
        for each in (SlidingTwin.identified(pushes), SlidingTwin())
    )
    assert off < nominal
    assert np.all(np.diag(twin.doubt) <= np.diag(SlidingTwin().doubt) + 1e-9)
    lever = ft.simulate(
        ft.Box(0.1, 0.1, 0.03), ft.LeverUp.at_edge(ft.Box(0.1, 0.1, 0.03), 0), embodiment="tool"
    )
    with pytest.raises(
        DatasetError, match=r"is a lever-up that ended .*: give pushes that left their objects flat"
    ):
        RecordedPushes.of([lever])
