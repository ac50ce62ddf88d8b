"""Plans: goals, candidates, the three stages, and the file."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import foretrace as ft
from foretrace.errors import ForetraceError, PlanningError, PredictionError
from foretrace.geometry import cross, planar_transform, rigid_transform
from foretrace.imagined import Futures, ImaginedBatch, Imaginer
from foretrace.planning import Motions
from foretrace.planning.candidates import Rim, Scene, find_free, place
from foretrace.planning.goals import GOALS, Constraint, Goal
from foretrace.planning.reasons import why_lost
from foretrace.planning.scores import Scores, score, tail_mean

goals = ft.goals
PRISM = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
ZONE = [(0.2, -0.1), (0.3, -0.1), (0.3, 0.1), (0.2, 0.1)]
END = ft.ToolPath().duration
QUICK = ft.PlanConfig(check=0, refine=0)
EVERY = {
    "lift": goals.Lift(),
    "tilt": goals.Tilt(0.5),
    "tumble": goals.Tumble(),
    "turn-over": goals.TurnOver(edge=1),
    "move": goals.Move((1.0, 0.5)),
    "move-to": goals.MoveTo((0.05, 0.02), turn=0.1),
    "turn": goals.Turn(0.4),
    "slide-off": goals.SlideOff((0.1, 0.0), (1.0, 0.0)),
    "avoid": goals.Avoid(ZONE),
    "keep-upright": goals.KeepUpright(),
    "learn": goals.Learn(),
}


class Lever(Imaginer):
    """Raises an object by 0.3 of the distance to its centre of mass; it slips where the blade is far off it."""

    def __init__(
        self, gain: float = 0.3, outcomes: tuple[str, ...] = ("levered", "slipped"), name: str = "lever"
    ):
        self.gain, self.told, self._name = gain, outcomes, name
        self.asked = 0

    @property
    def name(self) -> str:
        return self._name

    @property
    def sample_times(self) -> np.ndarray:
        return np.linspace(0.0, END, 31)

    def imagine_scenes(self, scenes) -> ImaginedBatch:
        self.asked += len(scenes)
        n, time, kinds = len(scenes), len(self.sample_times), len(self.told)
        states = np.zeros((n, kinds, time, 6))
        states[..., :3] = scenes.com[:, None, None]
        reach = scenes.com[:, 0]
        states[:, 0, :, 2] += self.gain * reach[:, None] * self.sample_times / END
        states[:, 0, :, 4] = -np.minimum(4 * reach[:, None], 1.0) * self.sample_times / END
        probability = np.zeros((n, kinds))
        slip = np.clip(np.abs(scenes.com[:, 1]) / 0.05, 0.0, 1.0) if kinds > 1 else np.zeros(n)
        probability[:, 0], probability[:, 1:2] = 1 - slip, slip[:, None]
        futures = Futures(
            probability, self.told, states, np.full((n, kinds, time), 0.001),
            np.full((n, kinds, 2, 2), np.nan), np.ones(99),
        )  # fmt: skip
        return ImaginedBatch(self.sample_times, states[:, 0, :, :3], None, futures)


def motions_of(
    outcome=("levered", "slipped"), probability=(0.9, 0.1), shift=(0.0, 0.0, 0.03), turned=(0.0, -0.5, 0.0)
):
    """One action at the prism's left end; the first future moves, the second stays."""
    action = ft.LeverUp((-0.08, 0.0), (1.0, 0.0))
    times = np.linspace(0.0, END, 31)
    states = np.zeros((1, 2, 31, 6))
    states[..., :3] = [0.08, 0.0, 0.01]
    states[0, 0, :, :3] += np.linspace(0, 1, 31)[:, None] * shift
    states[0, 0, :, 3:] = np.linspace(0, 1, 31)[:, None] * turned
    futures = Futures(
        np.array([probability]),
        outcome,
        states,
        np.full((1, 2, 31), 0.001),
        np.full((1, 2, 2, 2), np.nan),
        np.ones(99),
    )
    batch = ImaginedBatch(times, states[:, 0, :, :3], None, futures)
    return replace(Motions.of(batch, [action], PRISM.corners, PRISM.height), gain=np.array([0.7]))


# Goals


def test_every_registered_goal_has_an_example():
    assert set(EVERY) == set(GOALS)


@pytest.mark.parametrize("label", EVERY)
def test_goal_gives_a_finite_cost_for_every_future(label):
    motions = motions_of()
    goal = EVERY[label]
    cost, reached = goal.cost(motions), goal.reached(motions)
    assert cost.shape == reached.shape == (1, 2)
    assert np.isfinite(cost).all()
    assert reached.dtype == bool
    for constraint in goal.constraints():
        assert isinstance(constraint, Constraint)
        assert np.asarray(constraint.happens(motions)).shape == (1, 2)


@pytest.mark.parametrize("label", EVERY)
def test_goal_moves_with_the_object(label):
    """Turned object, turned goal: the same costs."""
    T = planar_transform([0.05, -0.02], 1.1)
    turn, shift = T[:2, :2], T[:2, 3]
    plain = motions_of(shift=(0.02, 0.01, 0.03), turned=(0.3, -0.9, 0.2))
    action = plain.actions[0]
    moved_action = ft.LeverUp(turn @ action.contact + shift, turn @ action.direction)
    batch = ImaginedBatch(plain.times, plain.futures.com[:, 0], None, plain.futures)
    moved = Motions.of(batch, [moved_action], PRISM.corners @ turn.T + shift, PRISM.height)
    moved = replace(moved, gain=plain.gain)
    other = {
        "move": goals.Move(turn @ [1.0, 0.5]),
        "move-to": goals.MoveTo(turn @ [0.05, 0.02] + shift, turn=0.1),
        "turn": goals.Turn(0.4),
        "slide-off": goals.SlideOff(turn @ [0.1, 0.0] + shift, turn @ [1.0, 0.0]),
        "avoid": goals.Avoid(np.array(ZONE) @ turn.T + shift),
    }.get(label, EVERY[label])
    np.testing.assert_allclose(other.cost(moved), EVERY[label].cost(plain), atol=1e-12)
    np.testing.assert_array_equal(other.reached(moved), EVERY[label].reached(plain))


def test_costs_by_hand():
    motions = motions_of(shift=(0.02, 0.0, 0.03))
    np.testing.assert_allclose(goals.Lift().cost(motions), [[-0.3, 0.0]])
    np.testing.assert_allclose(goals.Tilt(0.5).cost(motions), [[0.0, 0.5 / (np.pi / 2)]], atol=1e-9)
    np.testing.assert_allclose(goals.Move((2.0, 0.0)).cost(motions), [[-0.2, 0.0]])
    np.testing.assert_allclose(goals.MoveTo((0.02, 0.04)).cost(motions), [[0.4, np.hypot(0.2, 0.4)]])
    np.testing.assert_allclose(goals.SlideOff((0.05, 0.3), (1, 0)).cost(motions), [[0.3, 0.5]])
    np.testing.assert_allclose((goals.Lift() + 2 * goals.Move((1, 0))).cost(motions), [[-0.7, 0.0]])


def test_an_object_turned_over_leans_away_from_the_blade():
    """Lifted at its left end, the object turns over towards the right, and over no other edge."""
    motions = motions_of(outcome=("tumbled", "slipped"), turned=(0.0, 1.7, 0.0))
    np.testing.assert_allclose(goals.TurnOver(direction=(1, 0)).cost(motions), [[0.0, 1.0]], atol=1e-9)
    np.testing.assert_allclose(goals.TurnOver(direction=(-1, 0)).cost(motions), [[1.0, 1.0]])
    assert goals.TurnOver(direction=(1, 0)).reached(motions).tolist() == [[True, False]]
    assert goals.TurnOver(direction=(0, 1)).reached(motions).tolist() == [[False, False]]
    assert goals.Tumble().cost(motions)[0, 0] == 0
    assert goals.TurnOver(edge=0).cost(motions)[0, 0] < goals.TurnOver(edge=2).cost(motions)[0, 0]


def test_a_turn_about_the_vertical_is_read_off_a_tilted_object():
    heading = motions_of(turned=(0.0, 0.0, 0.7)).heading
    np.testing.assert_allclose(heading, [[0.7, 0.0]], atol=1e-12)
    assert (
        goals.MoveTo((0.0, 0.0), turn=0.7).cost(motions_of(shift=(0, 0, 0), turned=(0, 0, 0.7)))[0, 0] < 1e-9
    )


def test_zone_is_entered_by_the_object_its_region_and_the_blade():
    near = [(0.10, -0.1), (0.2, -0.1), (0.2, 0.1), (0.10, 0.1)]
    (entered,) = goals.Avoid(near, level=None).constraints()
    assert entered.happens(motions_of(shift=(0.02, 0, 0))).tolist() == [[True, False]]
    assert not entered.happens(motions_of(shift=(0.005, 0, 0), turned=(0, 0, 0))).any()
    (region,) = goals.Avoid(near, level=0.9).constraints()
    wide = motions_of(shift=(0.0, 0, 0), turned=(0, 0, 0))
    assert not region.happens(wide).any()
    wide.futures.spread[:] = 0.02
    assert region.happens(wide).all()
    (blade,) = goals.Avoid([(-0.3, -0.1), (-0.2, -0.1), (-0.2, 0.1), (-0.3, 0.1)]).constraints()
    assert blade.happens(motions_of()).all()


def test_own_goal_is_any_function_of_motions():
    motions = motions_of()
    np.testing.assert_allclose(
        goals.as_goal(lambda m: m.end_com[..., 0]).cost(motions), motions.end_com[..., 0]
    )
    np.testing.assert_allclose(goals.as_goal(lambda m: np.array([3.0])).cost(motions), [[3.0, 3.0]])
    for function in (lambda m: np.zeros(7), lambda m: np.full((1, 2), np.nan), lambda m: "no"):
        with pytest.raises(PlanningError, match="return"):
            goals.as_goal(function).cost(motions)


@pytest.mark.parametrize(("cost", "wrong"), [(np.nan, "not finite"), (np.zeros(7), r"the shape \(7,\)")])
def test_a_goal_with_odd_costs_is_refused(monkeypatch, untyped, cost, wrong):
    whole = np.ndim(cost) == 0
    monkeypatch.setattr(
        goals.Lift, "cost", lambda self, motions: np.full(motions.probability.shape, cost) if whole else cost
    )
    with pytest.raises(PlanningError, match=f"the costs of the goal .* have .*{wrong}"):
        ft.plan(PRISM, goals.Lift(), Lever(), config=QUICK)


POSES = {
    "zeros": np.zeros((4, 4)),
    "a mirror": np.diag([1.0, -1.0, 1.0, 1.0]),
    "scaled": np.diag([2.0, 2.0, 2.0, 1.0]),
    "raised": planar_transform([0.5, 0.2, 0.5], 0.4),
    "tilted": rigid_transform(np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]), [0.5, 0.2, 0.0]),
    "far": planar_transform([1e6, 0.0, 0.0], 0.4),
}


@pytest.mark.parametrize("name", POSES)
def test_a_pose_that_is_none_on_the_table_is_refused(name, tmp_path):
    with pytest.raises(PlanningError, match=r"give a pose on the table|give metres"):
        ft.plan(PRISM, goals.Lift(), Lever(), config=QUICK, T_table_object=POSES[name])
    file = ft.plan(PRISM, goals.Lift(), Lever(), config=QUICK).save(tmp_path / "plan.json")
    file.write_text(json.dumps(json.loads(file.read_text()) | {"T_table_object": POSES[name].tolist()}))
    with pytest.raises(PlanningError, match="cannot be read"):
        ft.Plan.open(file)


def test_pipes_are_not_written_over_and_links_are_followed(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    found = ft.plan(PRISM, goals.Lift(), Lever(), config=QUICK)
    with pytest.raises(OSError, match="it is a device or a pipe"):
        found.save(tmp_path / "pipe")
    assert (tmp_path / "pipe").is_fifo()
    (tmp_path / "link.json").symlink_to(tmp_path / "plan.json")
    found.save(tmp_path / "link.json")
    assert (tmp_path / "link.json").is_symlink()
    assert repr(ft.Plan.open(tmp_path / "plan.json")) == repr(found)


def test_a_goal_of_another_package_registers_itself():
    class Flip(Goal):
        label = "flip"

        def cost(self, motions):
            return np.zeros(motions.probability.shape)

        def reached(self, motions):
            return np.ones(motions.probability.shape, dtype=bool)

    assert GOALS.find("flip") is Flip
    del GOALS._entries["flip"]


# Criteria


def test_expected_cost_tail_and_likeliest_future():
    motions = motions_of(probability=(0.6, 0.4), shift=(0, 0, 0.05))
    expected, tail, likeliest = (
        score(goals.Lift(), motions, each, 0.5) for each in ("expected", "cvar", "likeliest")
    )
    assert expected.cost[0] == pytest.approx(-0.3)
    assert tail.cost[0] == pytest.approx(0.1 / 0.5 * -0.5)
    assert likeliest.cost[0] == pytest.approx(-0.5)
    assert expected.risk[0] == pytest.approx(0.4)
    assert likeliest.risk[0] == 0
    assert expected.reached[0] == pytest.approx(0.6)


def test_tail_of_everything_is_the_mean():
    rng = np.random.default_rng(0)
    costs, weights = rng.normal(size=(5, 7)), rng.random((5, 7))
    weights /= weights.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(tail_mean(costs, weights, 1.0), (costs * weights).sum(axis=1))
    assert (tail_mean(costs, weights, 0.1) >= tail_mean(costs, weights, 0.5)).all()
    assert tail_mean(costs, weights, 1e-3) == pytest.approx(costs.max(axis=1))


def test_kept_constraints_come_before_costs():
    scores = Scores(
        np.array([-1.0, -0.2, -0.5]),
        np.ones(3),
        np.array([[0.3], [0.01], [0.05]]),
        np.array([0.05]),
        ("slip",),
    )
    assert scores.order().tolist() == [2, 1, 0]


# Candidates


def test_contacts_go_round_the_outline_and_look_inwards():
    rim = Rim(PRISM.corners)
    along = np.linspace(0, 2 * rim.length, 200)
    found = place(ft.LeverUp, rim, along, np.zeros(200), [ft.ToolPath()] * 200)
    for action in found.actions:
        action.check_contact(PRISM)
        nearest = ft.LeverUp.nearest(PRISM, action.contact)
        np.testing.assert_allclose(action.direction, nearest.direction, atol=1e-6)


def test_normal_of_a_curved_outline_is_that_of_the_blade_wide_chord():
    angles = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    circle = 0.08 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rng = np.random.default_rng(0)
    rim = Rim(circle + rng.normal(scale=2e-4, size=circle.shape))
    along = np.linspace(0, rim.length, 50)
    inward = -rim.points(along) / np.linalg.norm(rim.points(along), axis=1, keepdims=True)
    assert ((rim.normals(along) * inward).sum(axis=1) > np.cos(0.15)).all()


def test_no_blade_gets_into_a_narrow_dent():
    half = [(0.1, -0.08), (0.1, 0.08), (0.004, 0.08), (0.002, 0.0)]
    dented = ft.Prism([*half, *((-x, y) for x, y in half[::-1])])
    scene, rim = Scene.of(dented), Rim(dented.corners)
    along = np.linspace(0, rim.length, 150)
    found = place(ft.LeverUp, rim, along, np.zeros(150), [ft.ToolPath()] * 150)
    free, lost = find_free(scene, found)
    x, y = found.contacts.T
    inside = (np.abs(x) < 0.004) & (y > -0.05) & (y < 0.075)
    assert inside.any()
    assert not free[inside].any()
    assert free[~inside].mean() > 0.9
    assert lost["no tool gets there"] >= inside.sum()


def test_view_and_object_have_the_same_candidates():
    scene = Scene.of(PRISM)
    seen = Scene.of(scene.view)
    points = PRISM.corners @ scene.T_view_object[:2, :2].T + scene.T_view_object[:2, 3]
    for corner in points:
        assert np.linalg.norm(seen.outline - corner, axis=1).min() < 0.002


# Plans


def test_plan_takes_the_contact_with_the_longest_lever_that_does_not_slip():
    imaginer = Lever()
    found = ft.plan(PRISM, goals.Lift(max_slip=0.05), imaginer, config=QUICK)
    com = PRISM.mass_properties(1.0).com[:2]
    ahead = (com - found.action.contact) @ found.action.direction
    aside = abs(cross(found.action.direction, com - found.action.contact))
    assert aside <= 0.05 * 0.05 + 1e-9
    assert found.risk <= 0.05
    assert found.cost == pytest.approx(-(1 - found.risk) * 3 * ahead, abs=1e-3)
    rim = Rim(PRISM.corners)
    every = place(ft.LeverUp, rim, np.linspace(0, rim.length, 2000), np.zeros(2000), [ft.ToolPath()] * 2000)
    fine = [
        (com - each.contact) @ each.direction
        for each in every.actions
        if abs(cross(each.direction, com - each.contact)) < 0.0025
    ]
    assert ahead > 0.95 * max(fine)
    assert not found.note
    assert found.reached > 0.5


def test_refinement_never_makes_it_worse_and_says_what_it_changed():
    coarse = ft.PlanConfig(spacing=0.05, directions=1, check=0, refine=0)
    fine = ft.PlanConfig(spacing=0.05, directions=1, check=0, refine=3)
    first = ft.plan(PRISM, goals.Lift(), Lever(), config=coarse)
    second = ft.plan(PRISM, goals.Lift(), Lever(), config=fine)
    assert second.cost < first.cost
    assert [stage.name for stage in second.stages] == ["imagined", "refined"]
    assert second.stages[1].before == pytest.approx(second.stages[0].cost)
    assert second.stages[1].moved > 0
    assert "before" in str(second.stages[1])


def test_checker_has_the_last_word():
    """It finds that the object rises the less, the longer the lever: the plan's contact is the nearest it was asked."""
    checker = Lever(gain=-0.3, name="checker")
    alone = ft.plan(PRISM, goals.Lift(max_slip=None), Lever(), config=QUICK)
    config = ft.PlanConfig(refine=0, check=8)
    checked = ft.plan(PRISM, goals.Lift(max_slip=None), Lever(), checker=checker, config=config)
    assert checker.asked == 8
    assert [stage.name for stage in checked.stages] == ["imagined", "checked"]
    assert np.linalg.norm(checked.action.contact - alone.action.contact) > 0.005
    assert checked.stages[1].before is not None
    assert checked.cost <= checked.stages[1].before
    assert checked.futures.com[0, 0, -1, 2] < checked.futures.com[0, 0, 0, 2]


def test_robot_that_does_not_reach_is_asked_on():
    right = lambda action: None if action.contact[0] > 0 else "too far left"  # noqa: E731
    free = ft.plan(PRISM, goals.Move((1, 0)), Lever(), config=QUICK)
    found = ft.plan(PRISM, goals.Lift(), Lever(), config=QUICK, reach=right)
    assert found.action.contact[0] > 0
    assert free.lost.get("the robot does not reach it") is None
    with pytest.raises(PlanningError, match=r"reaches none of the \d+ best contacts \(the best: too far\)"):
        ft.plan(PRISM, goals.Lift(), Lever(), config=QUICK, reach=lambda action: "too far")


def test_nothing_reaches_the_goal_is_said_with_the_best_there_is():
    found = ft.plan(PRISM, goals.Lift(at_least=0.5), Lever(), config=QUICK)
    assert "nothing reaches the goal Lift(at_least=0.5)" in found.note
    assert found.cost < 0
    never = ft.plan(PRISM, goals.Lift(max_slip=0.0), Lever(), config=QUICK)
    assert "no contact keeps slip to 0%" in never.note
    assert "no contact keeps" in repr(never)


def test_alternatives_differ_and_say_why_they_lost():
    found = ft.plan(PRISM, goals.Lift(max_slip=0.01), Lever(), config=QUICK)
    contacts = [found.action.contact, *(each.action.contact for each in found.alternatives)]
    for k, one in enumerate(contacts):
        assert all(np.linalg.norm(one - other) > 0.015 for other in contacts[:k])
    assert any("slip" in each.lost for each in found.alternatives)
    assert len(found.rim.points) == len(found.rim.cost) > 50
    assert found.lost["slip is too probable"] > 0


@pytest.mark.parametrize(
    ("goal", "cost", "words"),
    [
        (goals.Lift(), -0.531, "rises 5.3 cm; reached from 1 cm on"),
        (goals.Tilt(0.5), 0.1, "9 degrees off the angle; reached within 5.2 degrees"),
        (goals.Tumble(), 0.3, "between 0, where it tumbles, and 1, where it stays flat"),
        (
            goals.TurnOver(edge=0),
            0.2,
            "18 degrees short of a quarter turn; reached where it tumbles that way",
        ),
        (goals.Move((1, 0), at_least=0.02), -0.3, "moves 3 cm that way; reached from 2 cm on"),
        (goals.MoveTo((0.05, 0)), 0.04, "ends 0.4 cm from the place; reached within 1 cm"),
        (goals.Turn(0.3), 0.01, "0.9 degrees off the angle; reached within 9.7 degrees"),
        (goals.SlideOff((0.2, 0), (1, 0)), 0.5, "5 cm short of the edge; reached beyond it"),
        (goals.Learn(), -1.2, "tells 1.2 nat; reached from 0.5 nat on"),
    ],
)
def test_a_cost_is_told_in_plain_words(goal, cost, words):
    assert goal.in_words(cost) == words


def test_a_plan_says_what_its_cost_is_worth(tmp_path):
    found = ft.plan(PRISM, goals.Lift(), Lever(), config=QUICK)
    assert found.worth == f"expected: {goals.Lift().in_words(found.cost)}"
    assert ft.plan(PRISM, goals.Lift() + goals.Avoid(ZONE), Lever(), config=QUICK).worth == ""
    file = found.save(tmp_path / "plan.json")
    assert ft.Plan.open(file).worth == found.worth
    content = json.loads(file.read_text())
    del content["worth"]
    file.write_text(json.dumps(content))
    assert ft.Plan.open(file).worth == ""


def test_a_cheaper_alternative_says_why_it_lost():
    config = ft.PlanConfig(refine=0, check=1)
    found = ft.plan(
        PRISM, goals.Lift(max_slip=None), Lever(), checker=Lever(gain=-0.3, name="checker"), config=config
    )
    cheaper = [each for each in found.alternatives if each.cost < found.cost]
    assert cheaper
    for each in cheaper:
        assert each.lost.startswith(f"costs {found.cost - each.cost:.2g} less, but as the ")
        assert each.lost.endswith("has it: it is not among those that the checker checked")
    assert not any("costs -" in each.lost for each in found.alternatives)
    assert sum(found.lost.values()) >= len(found.alternatives)
    one = Scores(np.array([0.2]), np.ones(1), np.array([[0.3]]), np.array([0.5]), ("slip",))
    assert why_lost(one, 0.201, "").startswith("costs as much to within 0.005, but more where")
    assert why_lost(one, 0.15, "") == "costs 0.05 more"


def test_same_seed_same_plan():
    config = ft.PlanConfig(check=0, vary_path=False, seed=5)
    one, other = (ft.plan(PRISM, goals.Lift(), Lever(), config=config) for _ in range(2))
    assert one.action.to_dict() == other.action.to_dict()
    assert one.cost == other.cost


def test_shipped_imaginers_lift_higher_than_other_contacts():
    """By default the shipped predictor looks, and the twin checks; the truth is simulated."""
    found = ft.plan(PRISM, goals.Lift())
    assert [stage.name for stage in found.stages] == ["imagined", "refined", "checked"]
    config = ft.SimulationConfig(embodiment="tool")
    truth = ft.simulate_lever_up(PRISM, found.action, config).effect
    assert truth.outcome == "levered"
    rise = truth.com_trajectory[-1, 2] - truth.com_trajectory[0, 2]
    likeliest = found.futures.probability[0].argmax()
    np.testing.assert_allclose(found.futures.com[0, likeliest, -1], truth.com_trajectory[-1], atol=0.004)
    others = [
        ft.simulate_lever_up(PRISM, ft.LeverUp.at_edge(PRISM, edge), config).effect for edge in range(5)
    ]
    heights = [
        float(each.com_trajectory[-1, 2] - each.com_trajectory[0, 2]) if each.outcome == "levered" else 0.0
        for each in others
    ]
    # The rise is what is expected with an execution error; the highest of the others may be a risky one.
    assert rise > max(np.mean(heights), 0.9 * max(heights))


def test_path_varies_where_the_imaginer_is_told_of_it():
    config = ft.PlanConfig(check=0, vary_path=True, seed=1)
    found = ft.plan(PRISM, goals.Tilt(0.35), config=config)
    assert found.action.path != ft.ToolPath()
    fixed = ft.plan(PRISM, goals.Tilt(0.35), config=ft.PlanConfig(check=0))
    assert found.cost < fixed.cost
    assert fixed.action.path == ft.ToolPath()
    with pytest.raises(PlanningError, match="conditioned on no parameter"):
        ft.plan(PRISM, goals.Lift(), Lever(), config=config)


# The file


def test_plan_is_saved_and_opened_again(tmp_path):
    T = planar_transform([0.5, 0.2, 0.0], 0.4)
    found = ft.plan(PRISM, goals.Lift() + goals.Avoid(ZONE), Lever(), config=QUICK, T_table_object=T)
    again = ft.Plan.open(found.save(tmp_path / "plan.json"))
    assert again.to_dict() == found.to_dict()
    assert repr(again) == repr(found)
    content = json.loads((tmp_path / "plan.json").read_text())
    np.testing.assert_allclose(content["table"]["contact"], (T @ [*found.action.contact, 0, 1])[:2])
    np.testing.assert_allclose(content["table"]["direction"], T[:2, :2] @ found.action.direction)
    np.testing.assert_allclose(again.table_action.contact, content["table"]["contact"])


def test_plan_of_a_view_is_opened_without_an_object(tmp_path):
    view = ft.TopDownView.of(PRISM, ft.LeverUp.at_edge(PRISM, 0))
    found = ft.plan(view, goals.Lift(), Lever(), config=QUICK)
    again = ft.Plan.open(found.save(tmp_path / "plan.json"))
    assert again.object is None
    assert again.T_table_action is None
    with pytest.raises(PlanningError, match="where the object lies"):
        _ = again.table_action


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, "does not describe a foretrace-plan"),
        ({"format_version": 2}, "format version 2"),
        ({"cost": "high"}, "entry cost"),
        ({"action": {"label": "lever-up"}}, "cannot be read"),
        ({"futures": None}, "entry futures"),
        ({"times": [0.0]}, "shape"),
        ({"rim": {"points": [[0.0, 0.0]], "cost": [1.0, 2.0], "risk": [0.0]}}, "rim.cost has the shape"),
    ],
)
def test_damaged_plan_is_refused_in_one_line(tmp_path, change, message):
    file = ft.plan(PRISM, goals.Lift(), Lever(), config=QUICK).save(tmp_path / "plan.json")
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(PlanningError, match=message) as error:
        ft.Plan.open(file)
    assert "\n" not in str(error.value)


# Mistakes


EMPTY = ft.TopDownView(np.zeros((128, 128), bool), np.zeros((128, 128)))


def planned(goal, imaginer=None, context=None, **settings):
    return ft.plan(PRISM, goal, Lever() if imaginer is None else imaginer, context, config=QUICK, **settings)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: planned(goals.Lift), TypeError, "give a goal such as"),
        (lambda: ft.plan(ft.Box(0.01, 0.001, 0.02), goals.Lift()), PredictionError, "mask is empty"),
        (lambda: ft.plan(EMPTY, goals.Lift()), PredictionError, "mask is empty"),
        (
            lambda: planned(goals.Lift(), Lever(outcomes=("levered",))),
            PlanningError,
            "about the outcome slipped",
        ),
        (lambda: planned(goals.Tumble()), PlanningError, "about the outcome tumbled"),
        (lambda: planned(goals.Lift(), context={"friction": 0.5}), PredictionError, "friction"),
        (lambda: planned(goals.Lift(), com=(1, 1, 1)), PredictionError, "outside the object"),
        (lambda: planned(goals.MoveTo((3, 0))), PlanningError, "outside what one view shows"),
        (lambda: planned(goals.TurnOver(edge=9)), PlanningError, "with 5 edges"),
        (lambda: planned(goals.Avoid([(0, 0), (0.1, 0), (0, 0.1)])), PlanningError, "lies in the zone"),
        (lambda: planned(goals.SlideOff((-1, 0), (1, 0))), PlanningError, "beyond the table's edge"),
        (lambda: goals.Avoid([(0, 0), (1, 1)]), PlanningError, "three corners"),
        (lambda: goals.Avoid("zone"), TypeError, "zone"),
        (lambda: goals.Avoid(ZONE, level=2.0), PlanningError, r"level 2\.0"),
        (lambda: goals.Lift(max_slip=2.0), PlanningError, r"max_slip is 2\.0"),
        (lambda: goals.Tilt(30.0), PlanningError, r"angle is 30\.0: give radians"),
        (lambda: goals.Move((0, 0)), PlanningError, "no length"),
        (lambda: goals.Move((1, 2, 3)), PlanningError, "direction"),
        (lambda: goals.MoveTo((1000, 0)), PlanningError, "give metres"),
        (lambda: goals.TurnOver(), PlanningError, "either an edge or a direction"),
        (lambda: goals.Lift() * -1.0, PlanningError, "weight"),
        (lambda: goals.Lift() + 3, TypeError, "give a goal"),
        (lambda: ft.PlanConfig(spacing=0.0), PlanningError, "spacing"),
        (lambda: ft.PlanConfig(check=-1), PlanningError, "check is -1"),
        (lambda: ft.Plan.open("nowhere.json"), PlanningError, "does not exist"),
    ],
)
def test_mistakes_are_told_in_one_line(make, error, message):
    with pytest.raises(error, match=message) as found:
        make()
    assert isinstance(found.value, ForetraceError)
    assert "\n" not in str(found.value)


PROGRAM = """
import foretrace as ft
goals, box = ft.goals, ft.Box(0.15, 0.14, 0.02)
for call in (
    lambda: ft.plan(box, "lift"),
    lambda: ft.plan([1, 2], goals.Lift()),
    lambda: ft.plan(box, goals.Lift(), "twin"),
    lambda: ft.plan(box, goals.Lift(), config=3),
    lambda: ft.plan(box, goals.Lift(), reach=3),
    lambda: ft.plan(box, goals.Lift(), T_table_object=[1, 2]),
    lambda: goals.Lift(max_slip="no"),
    lambda: goals.KeepUpright(chance=None),
    lambda: goals.TurnOver(edge=1.5),
    lambda: goals.Avoid([(0, 0), (1, 0), (0, 1)], level="high"),
    lambda: ft.PlanConfig(criterion="best"),
    lambda: ft.PlanConfig(cone="wide"),
    lambda: ft.Plan.open(3),
):
    try:
        call()
    except ft.ForetraceError as error:
        print(error)
"""
EXPECTED = """\
goal 'lift': give a goal such as ft.goals.Lift(), or a function of motions
what is planned for of type list: give ObjectModel or TopDownView
imaginer of type str: give an imaginer, such as a predictor
config of type int: give PlanConfig
reach is 3: give a function of an action, or None
T_table_object must be numbers in the shape (4, 4), not in the shape (2,)
max_slip is 'no': give a probability, 0 to 1
chance is None: give a probability, 0 to 1
edge is 1.5: give the number of an edge, from 0 on
level 'high' of a region: choose one from 0.01 to 0.99
criterion is 'best': choose from expected, cvar, likeliest
plan: cone = 'wide' is outside 0 to 0.8: give SI units
3 is no path: give the name of a file or folder
"""


def test_wrong_types_are_named_with_the_remedy():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert done.stdout == EXPECTED


def test_object_without_a_free_contact():
    wide = ft.Prism([(-0.19, -0.19), (0.19, -0.19), (0.19, 0.19), (-0.19, 0.19)])
    with pytest.raises(PlanningError, match=r"no contact of the object is free .* beyond the view"):
        ft.plan(
            wide, goals.Lift(), Lever(), config=ft.PlanConfig(check=0, cone=0.8, directions=1, spacing=0.1)
        )
