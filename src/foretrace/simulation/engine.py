"""The contract of a physics engine, and every engine by its name."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from foretrace.actions import Motion, Tool
from foretrace.errors import SimulationError
from foretrace.interactions.motions import ContactParameters
from foretrace.interactions.record import Physics
from foretrace.objects import ObjectModel
from foretrace.objects.body import Body
from foretrace.registry import Registry

SPEED_LIMIT = 60.0
"""An object faster than this [m/s or rad/s] has been thrown by a numerical blow-up, not by a slow tool."""
STANDING_DEPTH = 2e-4
"""A contact of object and table counts while they are closer than this [m]."""
COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Coordinates of a tool's frame: position and rotation vector in the action frame."""

ToolMotion = Callable[[Float[np.ndarray, " time"]], Float[np.ndarray, "time 6"]]
"""Position [m] and rotation vector [rad] of a tool at given times [s], as `Action.tool_motion`."""
FreePlay = tuple[Float[np.ndarray, "time 7"], Float[np.ndarray, "time 6"]]
"""Poses of the object frame, and velocities of the centre of mass and about it, table frame."""


@dataclass(frozen=True, eq=False)
class Play:
    """One action to play: the arguments of `Engine.play`."""

    obj: ObjectModel
    """The object."""
    T_action_object: Float[np.ndarray, "4 4"]
    """Pose of the object frame at rest in the action frame."""
    tool: Tool
    """The tool."""
    tool_motion: ToolMotion
    """Pose of the tool over time."""
    duration: float
    """Time to play [s]."""
    physics: Physics
    """Friction and density."""


class Engine(ABC):
    """Plays what a tool does to an object; it knows no action.

    Implementations are deterministic: equal arguments give equal motions. They are made with an embodiment, a time
    step [s] and a sample period [s], and refuse what they cannot play. A subclass registers itself by its name.
    """

    name: ClassVar[str]
    """Name in records and commands."""
    library: ClassVar[str]
    """Distribution whose version shapes the numbers."""
    at_once: ClassVar[int] = 1
    """Actions that it is fastest to play in one call of `play_many`."""

    @abstractmethod
    def __init__(self, embodiment: str, timestep: float, sample_period: float) -> None: ...

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        ENGINES.add(cls.name, cls)

    @abstractmethod
    def play(
        self,
        obj: ObjectModel,
        T_action_object: Float[np.ndarray, "4 4"],
        tool: Tool,
        tool_motion: ToolMotion,
        duration: float,
        physics: Physics,
    ) -> Motion:
        """Plays an action, from the moment before the tool moves.

        Args:
            obj: The object.
            T_action_object: Pose of the object frame at rest in the action frame.
            tool: The tool.
            tool_motion: Pose of the tool over time.
            duration: Time to play [s].
            physics: Friction and density.

        Raises:
            SimulationError: The tool's motion is not finite, or turns about more than one axis.
            ActionError: The arm cannot follow the tool's motion.
        """

    def check_physics(self, physics: Physics) -> None:  # noqa: B027
        """Refuse physics that the engine cannot play, with a `SimulationError`; most play any."""

    def play_many(self, plays: Sequence[Play]) -> list[Motion]:
        """Plays actions that have nothing to do with each other, in their order; raises as `play` does."""
        return [self.play(**vars(play)) for play in plays]

    @staticmethod
    @abstractmethod
    def play_freely(
        body: Body,
        pose: Float[np.ndarray, " 7"],
        velocity: Float[np.ndarray, " 6"],
        contact_parameters: ContactParameters,
        steps: int,
        timestep: float,
    ) -> FreePlay:
        """Plays the motion of a free body, as `simulate_free_motion` describes it."""


ENGINES: Registry[type[Engine]] = Registry("engine", "foretrace.engines", SimulationError)
"""Every engine by its name; the built-in ones are imported on first use."""
ENGINES.declare("mujoco", "foretrace.simulation.mujoco_engine")
ENGINES.declare("bullet", "foretrace.simulation.bullet_engine")
ENGINES.declare("warp", "foretrace.simulation.warp_engine")


@lru_cache(maxsize=4)
def make_engine(name: str, embodiment: str, timestep: float, sample_period: float) -> Engine:
    """An engine, ready to play.

    Args:
        name: One of ENGINES.
        embodiment: ``arm`` or ``tool``.
        timestep: Time step [s].
        sample_period: Time between recorded samples [s].

    Raises:
        SimulationError: If there is no such engine, or it cannot play that.
    """
    return ENGINES.find(name)(embodiment, timestep, sample_period)


def check_divides(timestep: float, *periods: float) -> None:
    """Refuse a time step [s] of which periods [s] are no multiples.

    Raises:
        SimulationError: Naming both.
    """
    for period in periods:
        if not 0 < timestep <= period or abs(period / timestep - round(period / timestep)) > 1e-9:
            raise SimulationError(
                f"timestep = {timestep} s does not divide {period} s: take 0.002 s or a half of it"
            )


def sample_tool(tool_motion: ToolMotion, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 6"]:
    """A tool's motion at given times [s], checked.

    Raises:
        SimulationError: It has another shape, is not finite, or turns about more than one axis of the action frame.
    """
    coordinates = np.asarray(tool_motion(times), dtype=float)
    if coordinates.shape != (len(times), 6) or not np.isfinite(coordinates).all():
        raise SimulationError(
            f"the tool's motion has the shape {coordinates.shape}, or is not finite: "
            f"give {len(times)} rows of position [m] and rotation vector [rad]"
        )
    axes = [COORDINATES[k] for k in used_coordinates(coordinates) if k >= 3]
    if len(axes) > 1:
        raise SimulationError(
            f"the tool turns about more than one axis ({', '.join(axes)}): keep two of them at 0"
        )
    return coordinates


def used_coordinates(coordinates: Float[np.ndarray, "time 6"]) -> tuple[int, ...]:
    """Numbers of the coordinates that a tool's motion uses: those that are not always 0."""
    return tuple(int(k) for k in np.flatnonzero((coordinates != 0).any(axis=0)))
