"""Executions of pushes that a monitor watches: simulated in MuJoCo, with the rod's friction drawn, and tracked."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from foretrace.experiments.executions import track
from foretrace.imagined import Belief, ImaginedEffect
from foretrace.interactions.record import Interaction
from foretrace.monitoring import Monitor
from foretrace.simulation.collect import CollectConfig, num_trials, simulate_trial
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.randomisation import Randomisation
from foretrace.twin.sliding import SlidingTwin

FRICTION = (0.1, 0.5)
"""Friction coefficients of the rod, of executions and of the belief."""
WORLDS = 64
"""Worlds of the belief."""
KIND = "push worlds"
"""Kind of the calibration."""
SIMULATION = SimulationConfig(embodiment="tool", timestep=0.004, sample_period=0.04)


@dataclass(frozen=True, eq=False)
class PushExecution:
    """One push, what was imagined of it, and how it was tracked."""

    imagined: ImaginedEffect
    """Imagined with a belief about the rod's friction."""
    times: Float[np.ndarray, " time"]
    """Time of each sample [s]."""
    tracked: tuple[Float[np.ndarray, "7"] | None, ...]
    """Poses of the object frame in the action frame; None: lost."""

    def alarm(self, false_alarms: float) -> float:
        """Time of the first alarm [s]; NaN: none."""
        monitor = Monitor(self.imagined, false_alarms)
        for t, pose in zip(self.times, self.tracked, strict=True):
            if monitor.update(float(t), pose).alarm:
                return float(t)
        return float("nan")


def push_executions(seed: int, number: int) -> tuple[PushExecution, PushExecution]:
    """A push as it should go, and the same with the object blocked from half of the time on.

    Args:
        seed: Seed of the set.
        number: Number within the set.
    """
    rng = np.random.default_rng([seed, number])
    made = _simulated(seed, number)
    times, poses = made.effect.times, made.effect.pose_trajectory
    belief = Belief({"tool_friction": FRICTION}, worlds=WORLDS)
    twin = SlidingTwin(duration=float(times[-1]))
    imagined = twin.imagine(made.view, made.action, context=belief)
    blocked = poses.copy()
    blocked[len(times) // 2 :] = poses[len(times) // 2]
    free, held = (PushExecution(imagined, times, track(each, times, "", rng)) for each in (poses, blocked))
    return free, held


@lru_cache(maxsize=1)
def _config(seed: int) -> CollectConfig:
    return CollectConfig(
        objects=1000, contacts_per_edge=1, seed=seed, simulation=SIMULATION, recipe="pushes",
        randomisation=Randomisation(tool_friction=FRICTION),
    )  # fmt: skip


def _simulated(seed: int, number: int) -> Interaction:
    """One push of an object of its own."""
    config = _config(seed)
    order = np.random.default_rng(seed).permutation(num_trials(config))
    return simulate_trial(config, int(order[number]))
