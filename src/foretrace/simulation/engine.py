"""The contract of a physics engine: play one lever-up, report what was seen."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from foretrace.actions import LeverUp, ToolPath
from foretrace.geometry import pose_to_matrix
from foretrace.interactions.record import Physics
from foretrace.objects import ObjectModel
from foretrace.simulation.tool import Tool

ENGINES = ("mujoco", "bullet")
"""Every engine by its name."""
SPEED_LIMIT = 60.0
"""An object faster than this [m/s or rad/s] has been thrown by a numerical blow-up, not by a slow blade."""
STANDING_DEPTH = 2e-4
"""A contact of object and table counts while they are closer than this [m]."""


@dataclass(frozen=True)
class Motion:
    """What an engine saw of one lever-up, in the action frame."""

    times: Float[np.ndarray, " time"]
    """Sample times [s]."""
    object_pose: Float[np.ndarray, "time 7"]
    """Object frame: position [m], quaternion (w, x, y, z)."""
    tool_pose: Float[np.ndarray, "time 7"]
    """Blade tip frame: position [m], quaternion (w, x, y, z)."""
    joints: Float[np.ndarray, "time joints"]
    """Joint angles of the arm [rad]; no columns for the tool alone."""
    on_blade: Bool[np.ndarray, " time"]
    """Whether blade or shaft touched the object."""
    table_contacts: tuple[Float[np.ndarray, "_ 3"], ...]
    """Per sample, the points where the object stood on the table, in the object frame [m]."""
    path_error: float
    """Largest distance of the blade tip from its planned path [m]."""
    diverged: bool
    """Whether the numbers blew up."""


@runtime_checkable
class Engine(Protocol):
    """Plays lever-ups. Implementations are deterministic: equal arguments give equal motions."""

    name: str
    library: str
    """Distribution whose version shapes the numbers."""

    def play(self, obj: ObjectModel, action: LeverUp, path: ToolPath, tool: Tool, physics: Physics) -> Motion:
        """Plays one lever-up from the moment before the blade moves until the end of the path."""
        ...


def tip_transforms(path: ToolPath, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 4 4"]:
    """Planned blade tip in the action frame: x along the blade, y to the left, z out of its upper face."""
    x, z, pitch = path.at(times).T
    pose = np.zeros((len(times), 7))
    pose[:, 0], pose[:, 2] = x, z
    pose[:, 3], pose[:, 5] = np.cos(pitch / 2), np.sin(pitch / 2)
    return pose_to_matrix(pose)
