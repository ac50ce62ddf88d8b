"""Physics of simulated lever-ups: rest, symmetry, time step, embodiment, outcomes."""

from typing import Any

import numpy as np
import pytest

from foretrace.actions import LeverUp, ToolPath
from foretrace.errors import ActionError, SimulationError
from foretrace.geometry import quaternion_to_matrix, tilt
from foretrace.interactions.record import Outcome, Physics
from foretrace.objects import Prism, paper_objects
from foretrace.simulation.engine import Motion
from foretrace.simulation.lever_up import SimulationConfig, effect_of, simulate_lever_up

TOOL = SimulationConfig(embodiment="tool")


def regular_prism(num_corners: int = 6) -> Prism:
    angle = 2 * np.pi * (np.arange(num_corners) + 0.5) / num_corners
    return Prism(0.1 * np.column_stack([np.cos(angle), np.sin(angle)]))


def path_difference(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance of two trajectories [mm]."""
    return float(1e3 * np.linalg.norm(a - b, axis=1).mean())


def some_trials() -> list[tuple[Prism, LeverUp]]:
    """Twelve lever-ups, near the middle of edges of sampled prisms of every corner count."""
    objects = paper_objects(seed=1, per_corner_count=2)
    return [(obj, LeverUp.at_edge(obj, edge=k % 3, fraction=0.45)) for k, obj in enumerate(objects[:12])]


def test_an_object_out_of_reach_stays_where_it_is() -> None:
    obj = regular_prism()
    before_the_rim = LeverUp.at_edge(obj, 2, path=ToolPath(insertion=0.0, sweep=0.0))
    effect = simulate_lever_up(obj, before_the_rim, TOOL).effect
    assert effect.outcome == Outcome.MISSED
    np.testing.assert_allclose(effect.com_trajectory, effect.com_trajectory[:1].repeat(60, 0), atol=1e-4)


@pytest.mark.parametrize("embodiment", ["tool", "arm"])
def test_a_hexagon_is_levered_about_its_far_edge(embodiment: str) -> None:
    obj = regular_prism()
    action = LeverUp.at_edge(obj, edge=2)
    effect = simulate_lever_up(obj, action, SimulationConfig(embodiment=embodiment)).effect
    assert effect.outcome == Outcome.LEVERED
    assert effect.slip_index is None
    assert effect.support_corners == (0, 5)
    assert len(effect.times) == 60
    assert effect.times[1] == pytest.approx(0.05)
    assert effect.path_error < 1e-3
    angle = tilt(quaternion_to_matrix(effect.pose_trajectory[:, 3:]))
    assert np.rad2deg(angle[-1]) > 25
    # It turns about the far edge, whose corners lie ahead on either side.
    np.testing.assert_allclose(effect.support_points[:, 0].mean(), 0.1732 - 0.009, atol=1e-3)
    np.testing.assert_allclose(effect.support_points[:, 1].sum(), 0, atol=1e-9)
    assert effect.joint_trajectory.shape == (60, 6 if embodiment == "arm" else 0)
    assert effect.com_trajectory[-1, 2] > 0.04


def test_the_record_starts_at_rest_in_the_action_frame() -> None:
    obj = Prism(np.array([[0.0, 0.0], [0.16, 0.0], [0.16, 0.1], [0.0, 0.1]]))
    action = LeverUp.at_edge(obj, edge=1, fraction=0.3)
    interaction = simulate_lever_up(obj, action, TOOL)
    effect = interaction.effect
    com = obj.mass_properties(600.0).com
    expected = action.T_action_object @ np.append(com, 1)
    np.testing.assert_allclose(effect.com_trajectory[0], expected[:3], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(effect.pose_trajectory[:, 3:], axis=1), 1, atol=1e-9)
    rotation = quaternion_to_matrix(effect.pose_trajectory[:, 3:])
    np.testing.assert_allclose(
        effect.com_trajectory, effect.pose_trajectory[:, :3] + rotation @ com, atol=1e-12
    )


def test_equal_arguments_give_equal_interactions() -> None:
    obj, action = some_trials()[3]
    first = simulate_lever_up(obj, action, seed=4).effect
    simulate_lever_up(regular_prism(), LeverUp.at_edge(regular_prism(), 0))
    second = simulate_lever_up(obj, action, seed=4).effect
    np.testing.assert_array_equal(first.pose_trajectory, second.pose_trajectory)
    np.testing.assert_array_equal(first.joint_trajectory, second.joint_trajectory)


def test_a_turned_object_gives_the_same_effect() -> None:
    obj, action = some_trials()[5]
    angle = 0.7
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = Prism(obj.corners @ R.T + [0.02, -0.01])
    moved = LeverUp(R @ action.contact + [0.02, -0.01], R @ action.direction)
    first, second = (simulate_lever_up(*pair, TOOL).effect for pair in ((obj, action), (turned, moved)))
    assert path_difference(first.com_trajectory, second.com_trajectory) < 1.0


def test_the_mirrored_object_gives_the_mirrored_effect() -> None:
    mirror = np.array([1.0, -1.0, 1.0])
    differences = []
    for obj, action in some_trials():
        flipped = Prism(obj.corners * [1, -1])
        mirrored = LeverUp(action.contact * [1, -1], action.direction * [1, -1])
        first = simulate_lever_up(obj, action, TOOL).effect
        second = simulate_lever_up(flipped, mirrored, TOOL).effect
        assert first.outcome == second.outcome
        if first.outcome == Outcome.LEVERED:
            differences.append(path_difference(first.com_trajectory, second.com_trajectory * mirror))
    assert len(differences) >= 6
    assert np.median(differences) < 0.3


def test_arm_and_tool_alone_have_the_same_effect() -> None:
    compared = 0
    for obj, action in some_trials():
        arm, tool = simulate_lever_up(obj, action).effect, simulate_lever_up(obj, action, TOOL).effect
        assert arm.path_error < 1e-3
        if arm.outcome == tool.outcome == Outcome.LEVERED:
            compared += 1
            assert path_difference(arm.com_trajectory, tool.com_trajectory) < 2.0
    assert compared >= 6


def test_half_the_time_step_agrees() -> None:
    half = SimulationConfig(embodiment="tool", timestep=0.001)
    differences = []
    for obj, action in some_trials():
        full, fine = simulate_lever_up(obj, action, TOOL).effect, simulate_lever_up(obj, action, half).effect
        if full.outcome == fine.outcome == Outcome.LEVERED:
            differences.append(path_difference(full.com_trajectory, fine.com_trajectory))
    assert len(differences) >= 6
    assert np.median(differences) < 0.1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"engine": "ode"}, "unknown engine 'ode'; available: mujoco"),
        ({"embodiment": "hand"}, "embodiment 'hand' is unknown: choose one of arm, tool"),
        ({"camera": "fisheye"}, "camera 'fisheye' is unknown: choose one of exact, grid, rgbd"),
        ({"timestep": 0.003}, r"timestep = 0\.003 s does not divide"),
    ],
)
def test_unknown_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SimulationError, match=message):
        SimulationConfig(**settings)


def test_a_contact_off_the_outline_is_refused() -> None:
    with pytest.raises(ActionError, match=r"contact \(0\.0000, 0\.0000\) m lies 86\.6 mm"):
        simulate_lever_up(regular_prism(), LeverUp(contact=(0.0, 0.0), direction=(1.0, 0.0)))


def test_a_thrown_object_counts_as_failed() -> None:
    """A blade at 60 m/s throws the object: the record says failed and holds no data."""
    obj = regular_prism()
    path = ToolPath(lift_time=0.05, arc_radius=1.0, sweep=1.5)
    effect = simulate_lever_up(obj, LeverUp.at_edge(obj, 2, path=path), TOOL).effect
    assert effect.outcome == Outcome.FAILED
    assert len(effect.times) == len(effect.pose_trajectory) == len(effect.com_trajectory) == 0


def synthetic_motion(
    angles_deg: np.ndarray, on_blade: np.ndarray, height: np.ndarray | None = None
) -> Motion:
    """An object turned about the y axis at its frame's origin, by the given angles."""
    num = len(angles_deg)
    pose = np.zeros((num, 7))
    half = np.deg2rad(angles_deg) / 2
    pose[:, 3], pose[:, 5] = np.cos(half), np.sin(half)
    if height is not None:
        pose[:, 2] = height
    contacts = tuple(np.array([[0.091, 0.0, 0.0]]) for _ in range(num))
    return Motion(np.arange(num) * 0.05, pose, pose, np.empty((num, 0)), on_blade, contacts, 0.0, False)


@pytest.mark.parametrize(
    ("angles", "touches", "outcome", "slip"),
    [
        ([0, 1, 2, 2, 1, 0], "111111", Outcome.MISSED, None),
        ([0, 5, 20, 30, 40, 40], "011111", Outcome.LEVERED, None),
        ([0, 5, 20, 30, 40, 40], "110111", Outcome.LEVERED, None),
        ([0, 5, 20, 30, 10, 0], "111000", Outcome.SLIPPED, 3),
        ([0, 5, 20, 30, 40, 40], "111110", Outcome.SLIPPED, 5),
        ([0, 5, 60, 95, 170, 180], "111000", Outcome.TUMBLED, None),
        ([0, 5, 40, 60, 85, 85], "111000", Outcome.TUMBLED, None),
        ([0, 5, 40, 60, 85, 85], "111111", Outcome.LEVERED, None),
        ([0, 5, 10, 15, 20, 25], "000000", Outcome.SLIPPED, 1),
    ],
)
def test_outcomes(angles: list[int], touches: str, outcome: Outcome, slip: int | None) -> None:
    obj = regular_prism()
    on_blade = np.array([t == "1" for t in touches])
    rise = 0.03 * np.arange(6.0)
    motion = synthetic_motion(np.array(angles), on_blade, None if outcome is Outcome.MISSED else rise)
    effect = effect_of(motion, obj, LeverUp.at_edge(obj, 2), Physics())
    assert effect.outcome == outcome
    assert effect.slip_index == slip
