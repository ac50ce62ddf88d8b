"""MuJoCo Warp plays what MuJoCo plays: on a GPU, or slowly on the processor."""

from dataclasses import replace

import numpy as np
import pytest

from engines_at_hand import WITHOUT_WARP
from foretrace.actions import Motion, ToolPath
from foretrace.errors import SimulationError
from foretrace.interactions.record import Physics
from foretrace.objects import Cylinder, Prism
from foretrace.simulation.collect import CollectConfig, trial
from foretrace.simulation.engine import Engine, Play, make_engine
from foretrace.simulation.lever_up import SimulationConfig, Trial, simulate_lever_up, simulate_trials

SQUARE = Prism([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]])
TOOL = SimulationConfig(embodiment="tool")


def some_trials(count: int, config: SimulationConfig = TOOL) -> list[Trial]:
    """Lever-ups of prisms with different numbers of corners."""
    made = [trial(CollectConfig(objects=16, simulation=config), 13 * k) for k in range(count)]
    return [Trial(obj, action, config, seed) for obj, action, seed in made]


def distance(one: Motion, other: Motion) -> float:
    """Mean distance of two motions while both last [m]."""
    num = min(len(one.times), len(other.times))
    return float(np.linalg.norm(one.object_pose[:num, :3] - other.object_pose[:num, :3], axis=1).mean())


def test_actions_played_at_once_are_those_played_one_by_one() -> None:
    trials = some_trials(3)
    together = simulate_trials(trials)
    for one, other in zip(trials, together, strict=True):
        alone = simulate_lever_up(one.obj, one.action, one.config, seed=one.seed)
        assert alone.effect.pose_trajectory.tobytes() == other.effect.pose_trajectory.tobytes()
    assert simulate_trials([]) == []


@WITHOUT_WARP
def test_worlds_with_other_objects_and_physics_move_as_in_mujoco() -> None:
    trials = some_trials(6)
    slippery = SimulationConfig(embodiment="tool", physics=Physics(friction=0.5, tool_friction=0.2))
    trials.append(Trial(trials[0].obj, trials[0].action, slippery))
    short = replace(trials[1].action, path=ToolPath().faster(1.5))  # type: ignore[call-arg]
    trials.append(Trial(trials[1].obj, short, TOOL))
    plays = [one.play() for one in trials]
    mujoco, warp = (make_engine(name, "tool", 0.002, 0.05).play_many(plays) for name in ("mujoco", "warp"))
    between = np.array([[distance(ours, theirs) for theirs in mujoco] for ours in warp])
    np.testing.assert_array_equal(
        between.argmin(axis=1), np.arange(len(plays))
    )  # no world is taken for another
    assert np.median(np.diag(between)) < 2e-4
    assert [len(motion.times) for motion in warp] == [len(motion.times) for motion in mujoco]


@WITHOUT_WARP
@pytest.mark.parametrize(
    ("obj", "physics", "wanted"),
    [
        (Cylinder(0.03, 0.1), Physics(), "round surfaces"),
        (
            Prism([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]),
            Physics(table_edge=0.1),
            "table_edge = 0.1 m",
        ),
    ],
)
def test_what_warp_cannot_play_is_refused(obj: object, physics: Physics, wanted: str) -> None:
    first = some_trials(1)[0].play()
    play = Play(obj, first.T_action_object, first.tool, first.tool_motion, first.duration, physics)  # type: ignore[arg-type]
    with pytest.raises(SimulationError, match=wanted):
        make_engine("warp", "tool", 0.002, 0.05).play_many([play])


@WITHOUT_WARP
def test_warp_moves_no_arm() -> None:
    with pytest.raises(SimulationError, match="embodiment 'tool'"):
        make_engine("warp", "arm", 0.002, 0.05)


def test_engines_play_one_at_a_time_unless_they_say_so() -> None:
    assert Engine.at_once == 1
