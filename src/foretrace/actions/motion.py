"""What is seen of an action, and what an action's judge concludes from it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from foretrace.geometry import pose_to_matrix

FAILED = "failed"
"""Outcome of any action whose simulation diverged: there is no effect to learn from."""


@dataclass(frozen=True)
class Motion:
    """What an engine or a camera saw of one action, in the action frame."""

    times: Float[np.ndarray, " time"]
    """Sample times [s]."""
    object_pose: Float[np.ndarray, "time 7"]
    """Object frame: position [m], quaternion (w, x, y, z)."""
    tool_pose: Float[np.ndarray, "time 7"]
    """Tool frame, at its tip: position [m], quaternion (w, x, y, z)."""
    joints: Float[np.ndarray, "time joints"]
    """Joint angles of the arm [rad]; no columns for the tool alone."""
    on_tool: Bool[np.ndarray, " time"] | None = None
    """Whether the tool touched the object; None where that was not observed, as in a recording."""
    table_contacts: tuple[Float[np.ndarray, "_ 3"], ...] = ()
    """Per sample, the points where the object stood on the table, in the object frame [m]; empty where not observed."""
    path_error: float = 0.0
    """Largest distance of the tool's tip from its planned path [m]."""
    diverged: bool = False
    """Whether the numbers blew up."""


@dataclass(frozen=True)
class Judgement:
    """What an action's judge concludes from a motion."""

    outcome: str
    """One of the action's outcomes."""
    slip_index: int | None = None
    """First sample at which the object was off the tool for good, or None."""
    support_points: Float[np.ndarray, "2 2"] | None = None
    """The two points that the object turned about, in the action frame at rest [m]; None where not observed."""
    support_corners: tuple[int, ...] = ()
    """Indices into the object's corners of all that carried it."""


def tool_transforms(coordinates: Float[np.ndarray, "time 6"]) -> Float[np.ndarray, "time 4 4"]:
    """Poses of a tool as matrices.

    Args:
        coordinates: Position [m] and rotation vector [rad] of the tool's frame, as `Action.tool_motion` gives them.
    """
    return pose_to_matrix(tool_poses(coordinates))


def tool_poses(coordinates: Float[np.ndarray, "time 6"]) -> Float[np.ndarray, "time 7"]:
    """Poses of a tool as positions [m] and quaternions (w, x, y, z), from positions and rotation vectors [rad]."""
    angle = np.linalg.norm(coordinates[:, 3:], axis=1, keepdims=True)
    axis = coordinates[:, 3:] / np.where(angle == 0, 1.0, angle)
    return np.hstack([coordinates[:, :3], np.cos(angle / 2), np.sin(angle / 2) * axis])
