"""What every physics engine owes: rest, symmetry, time step, repeatability, the tool's path; and that they agree."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from engines_at_hand import WITHOUT_BULLET, every_engine
from foretrace.actions import LeverUp, ToolPath
from foretrace.errors import SimulationError
from foretrace.geometry import quaternion_to_matrix, tilt
from foretrace.interactions.record import Effect, Outcome
from foretrace.objects import Prism, paper_objects
from foretrace.simulation.engine import Engine
from foretrace.simulation.lever_up import SimulationConfig, make_engine, simulate_lever_up

TIMESTEP = 0.002
NUM_TRIALS = 12
IN_ANOTHER_PROCESS = """
import sys
sys.path.insert(0, {folder!r})
from test_engines import effect
print(effect({engine!r}, 3).pose_trajectory.tobytes().hex())
"""


def trial(k: int) -> tuple[Prism, LeverUp]:
    """One of twelve lever-ups, near the middle of edges of sampled prisms of 3 to 8 corners."""
    obj = paper_objects(seed=1, per_corner_count=2)[k]
    return obj, LeverUp.at_edge(obj, edge=k % 3, fraction=0.45)


@lru_cache(maxsize=64)
def effect(engine: str, k: int, timestep: float = TIMESTEP, mirrored: bool = False) -> Effect:
    obj, action = trial(k)
    if mirrored:
        obj = Prism(obj.corners * [1, -1])
        action = LeverUp(action.contact * [1, -1], action.direction * [1, -1])
    config = SimulationConfig(engine=engine, embodiment="tool", timestep=timestep)
    return simulate_lever_up(obj, action, config).effect


def apart(a: Effect, b: Effect, mirror: bool = False) -> float:
    """Mean distance of two centre-of-mass trajectories [mm]."""
    other = b.com_trajectory * ([1, -1, 1] if mirror else 1)
    return float(1e3 * np.linalg.norm(a.com_trajectory - other, axis=1).mean())


@every_engine
def test_engines_follow_the_contract(engine: str) -> None:
    made = make_engine(engine, "tool", TIMESTEP, 0.05)
    assert isinstance(made, Engine)
    assert made.name == engine


@every_engine
def test_an_object_out_of_reach_stays(engine: str) -> None:
    """Within 0.1 mm, a tenth of the smallest error of a predictor."""
    obj, action = trial(5)
    path = ToolPath(insertion=0.0, sweep=0.0)
    config = SimulationConfig(engine=engine, embodiment="tool")
    seen = simulate_lever_up(obj, replace(action, path=path), config).effect
    assert seen.outcome == Outcome.MISSED
    np.testing.assert_allclose(seen.com_trajectory, seen.com_trajectory[:1].repeat(60, 0), atol=1e-4)
    turned = (
        quaternion_to_matrix(seen.pose_trajectory[:, 3:])
        @ quaternion_to_matrix(seen.pose_trajectory[0, 3:]).T
    )
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-3)


@every_engine
def test_records_are_finite_and_start_at_rest_in_the_action_frame(engine: str) -> None:
    for k in range(NUM_TRIALS):
        seen, (obj, action) = effect(engine, k), trial(k)
        expected = action.T_action_object @ np.append(obj.mass_properties(600.0).com, 1)
        np.testing.assert_allclose(seen.com_trajectory[0], expected[:3], atol=1e-7)
        np.testing.assert_allclose(np.linalg.norm(seen.pose_trajectory[:, 3:], axis=1), 1, atol=1e-9)
        for values in (seen.pose_trajectory, seen.com_trajectory, seen.tool_trajectory):
            assert values.shape[0] == 60
            assert np.isfinite(values).all()


@every_engine
def test_the_blade_follows_its_path(engine: str) -> None:
    """Within 0.1 mm, a tenth of the blade's thickness."""
    assert max(effect(engine, k).path_error for k in range(NUM_TRIALS)) < 1e-4


@every_engine
def test_the_mirrored_object_gives_the_mirrored_effect(engine: str) -> None:
    """The order of contacts differs, so the numbers do; the median stays under a third of a millimetre."""
    differences = []
    for k in range(0, NUM_TRIALS, 2):
        first, second = effect(engine, k), effect(engine, k, mirrored=True)
        assert first.outcome == second.outcome
        if first.outcome == Outcome.LEVERED:
            differences.append(apart(first, second, mirror=True))
    assert len(differences) >= 4
    assert np.median(differences) < 0.3
    assert max(differences) < 3


@every_engine
def test_half_the_time_step_agrees(engine: str) -> None:
    """MuJoCo's soft contacts hardly notice; Bullet's errors are of the first order in the step."""
    differences = []
    for k in range(0, NUM_TRIALS, 2):
        full, fine = effect(engine, k), effect(engine, k, TIMESTEP / 2)
        if full.outcome == fine.outcome == Outcome.LEVERED:
            differences.append(apart(full, fine))
    assert len(differences) >= 4
    assert np.median(differences) < (0.1 if engine == "mujoco" else 0.3)


@every_engine
def test_equal_arguments_give_equal_effects_in_this_process_and_another(engine: str) -> None:
    first = effect(engine, 3)
    effect(engine, 4, TIMESTEP / 2)
    second = effect.__wrapped__(engine, 3)
    np.testing.assert_array_equal(first.pose_trajectory, second.pose_trajectory)
    np.testing.assert_array_equal(first.tool_trajectory, second.tool_trajectory)
    assert first.support_corners == second.support_corners
    folder = __file__.rpartition("/")[0]
    program = IN_ANOTHER_PROCESS.format(folder=folder, engine=engine)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert bytes.fromhex(done.stdout.strip()) == first.pose_trajectory.tobytes()
    assert done.stderr == ""


@WITHOUT_BULLET
def test_threads_play_on_one_object_at_once() -> None:
    obj, _ = trial(3)
    actions = [LeverUp.at_edge(obj, edge) for edge in range(len(obj.corners))]
    config = SimulationConfig(embodiment="tool")

    def play(action: LeverUp) -> np.ndarray:
        return simulate_lever_up(obj, action, config).effect.pose_trajectory

    with ThreadPoolExecutor(len(actions)) as threads:
        together = list(threads.map(play, actions))
    for poses, action in zip(together, actions, strict=True):
        np.testing.assert_array_equal(poses, play(action))


def test_engines_agree() -> None:
    """Outcomes and support corners, and paths to about the blade's thickness.

    MuJoCo's blade acts from 1 mm away and Bullet's where it touches, so one object is lifted a little higher.
    """
    same_outcome, same_corners, differences, tilts = 0, 0, [], []
    for k in range(NUM_TRIALS):
        first, second = effect("mujoco", k), effect("bullet", k)
        same_outcome += first.outcome == second.outcome
        same_corners += first.support_corners == second.support_corners
        if first.outcome == second.outcome == Outcome.LEVERED:
            differences.append(apart(first, second))
            ends = [tilt(quaternion_to_matrix(seen.pose_trajectory[-1, 3:])) for seen in (first, second)]
            tilts.append(np.rad2deg(abs(ends[0] - ends[1])))
    assert same_outcome >= 10
    assert same_corners >= 10
    assert len(differences) >= 6
    assert np.median(differences) < 1.5
    assert np.median(tilts) < 1.5


@every_engine
def test_a_thrown_object_counts_as_failed(engine: str) -> None:
    """A blade at 60 m/s throws the object: the record says failed and holds no data."""
    obj, action = trial(6)
    path = ToolPath(lift_time=0.05, arc_radius=1.0, sweep=1.5)
    config = SimulationConfig(engine=engine, embodiment="tool")
    seen = simulate_lever_up(obj, replace(action, path=path), config).effect
    assert seen.outcome == Outcome.FAILED
    assert len(seen.times) == len(seen.pose_trajectory) == 0


@every_engine
def test_provenance_names_the_engine(engine: str) -> None:
    obj, action = trial(2)
    config = SimulationConfig(engine=engine, embodiment="tool")
    provenance = simulate_lever_up(obj, action, config).provenance
    assert provenance.engine == engine
    assert {"mujoco": "mujoco", "bullet": "pybullet"}[engine] in provenance.versions


@pytest.mark.parametrize("name", ["ode", ""])
def test_an_unknown_engine_is_refused(name: str) -> None:
    with pytest.raises(SimulationError, match="available: mujoco, bullet"):
        make_engine(name, "tool", TIMESTEP, 0.05)
