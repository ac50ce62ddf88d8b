"""Executions that go wrong in simulation, and what a monitor says of them sample by sample."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foretrace.actions import LeverUp
from foretrace.errors import StudioError, shown
from foretrace.experiments.executions import CAUSES, FAULTS, PERIOD, Scene, track, with_fault
from foretrace.imagined import ImaginedEffect
from foretrace.interactions.record import ExecutionOffset, Interaction, Physics
from foretrace.monitoring import Monitor, Verdict
from foretrace.objects import ObjectModel, Prism

SURPRISE, NOTHING = "surprise me", "nothing"
"""Any fault at random; none."""
WISHES = (SURPRISE, NOTHING, *FAULTS)
"""What a visitor can wish to go wrong."""


@dataclass(frozen=True, eq=False)
class Watched:
    """One simulated execution, as a monitor saw it."""

    fault: str
    """What went wrong; empty: nothing."""
    action: LeverUp
    """The lever-up as commanded."""
    times: Float[np.ndarray, " time"]
    """Time of each sample [s]."""
    poses: Float[np.ndarray, "time 7"]
    """True poses of the object's frame in the action frame."""
    verdicts: tuple[Verdict, ...]
    """What the monitor said after each sample."""
    outcome: str = ""
    """Of an interaction of a data set, its outcome there; nothing was made to go wrong."""

    @property
    def alarm(self) -> Verdict | None:
        """The first verdict with an alarm."""
        return next((each for each in self.verdicts if each.alarm), None)

    @property
    def truth(self) -> str:
        """What went wrong, and the cause that a monitor calls it by."""
        if self.outcome:
            return f"{self.outcome}, as the data set has it"
        return f"{self.fault} (cause: {CAUSES[self.fault]})" if self.fault else "nothing went wrong"


def watch_again(interaction: Interaction, imagined: ImaginedEffect) -> Watched:
    """Let a monitor watch an interaction of a data set.

    Raises:
        StudioError: It is no lever-up, or has no motion.
    """
    action, effect = interaction.action, interaction.effect
    if not isinstance(action, LeverUp) or len(effect.times) < 2:
        raise StudioError("the row is no lever-up with a motion: choose another one")
    monitor = Monitor(imagined)
    verdicts = [
        monitor.update(float(t), pose) for t, pose in zip(effect.times, effect.pose_trajectory, strict=True)
    ]
    return Watched("", action, effect.times, effect.pose_trajectory, tuple(verdicts), str(effect.outcome))


def watch(
    obj: ObjectModel,
    action: LeverUp,
    imagined: ImaginedEffect,
    world: tuple[Physics, ExecutionOffset],
    wish: str,
    rng: np.random.Generator,
) -> Watched:
    """Simulate an execution in which something goes wrong, and let a monitor watch it.

    Args:
        obj: The object.
        action: The lever-up as commanded.
        imagined: What was imagined of it.
        world: Constants, and execution error.
        wish: One of `WISHES`.
        rng: Decides what goes wrong, when and how much.

    Raises:
        StudioError: There is no such wish, or it cannot be had with this object.
    """
    if wish not in WISHES:
        raise StudioError(f"{shown(wish)} cannot go wrong: choose from {', '.join(WISHES)}")
    possible = FAULTS if isinstance(obj, Prism) else tuple(each for each in FAULTS if each != "other shape")
    fault = str(rng.choice(possible)) if wish == SURPRISE else "" if wish == NOTHING else wish
    if fault and fault not in possible:
        raise StudioError(f"a {obj.kind} cannot have an {fault}: choose another fault")
    scene = Scene(obj, world[0], action, world[1])
    poses = with_fault(scene, fault, rng).play()
    if poses is None:
        raise StudioError(f"the simulation of the fault {shown(fault)} blew up: try again")
    times = PERIOD * np.arange(len(poses))
    monitor = Monitor(imagined)
    tracked = track(poses, times, fault, rng)
    verdicts = [monitor.update(float(t), pose) for t, pose in zip(times, tracked, strict=True)]
    return Watched(fault, action, times, poses, tuple(verdicts))
