"""Interactions on disk and in memory."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class InteractionBatch:
    """Many interactions as arrays, in the action frame; what every feature and predictor reads."""

    ids: Int[np.ndarray, " batch"]
    """Number of each interaction within its data set."""
    mask: Bool[np.ndarray, "batch 128 128"]
    """Top-down masks."""
    height: Float[np.ndarray, "batch 128 128"]
    """Top-down height maps [m], 0 outside the object."""
    corners: Float[np.ndarray, "batch corners 2"]
    """Corners of each object in the action frame at rest [m], counter-clockwise, NaN-padded."""
    num_corners: Int[np.ndarray, " batch"]
    """How many of them each object has."""
    object_ids: Int[np.ndarray, " batch"]
    """Which object was levered: equal numbers are the same object."""
    times: Float[np.ndarray, " time"]
    """Sample times [s], common to all."""
    com: Float[np.ndarray, "batch time 3"]
    """Centre-of-mass trajectories [m]; NaN past the end of a shorter one."""
    pose: Float[np.ndarray, "batch time 7"]
    """Pose trajectories of the object frame: position [m], quaternion (w, x, y, z)."""
    length: Int[np.ndarray, " batch"]
    """Number of valid samples of each trajectory."""
    slip_index: Int[np.ndarray, " batch"]
    """First sample off the blade after having been lifted; ``length`` where that never happened."""
    support_points: Float[np.ndarray, "batch 2 2"]
    """Observed support points in the action frame [m]; NaN where not observed."""
    outcome: np.ndarray
    """(batch,) array of outcome names (str)."""
    density: Float[np.ndarray, " batch"]
    """Density [kg/m^3]."""
    friction: Float[np.ndarray, " batch"]
    """Friction coefficient between object and table."""
    tool_friction: Float[np.ndarray, " batch"]
    """Friction coefficient between object and blade."""

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, rows: Any) -> "InteractionBatch":
        """The given rows (slice, index array or boolean array) as a batch; ``times`` stays common to all."""
        kept = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "times"}
        return replace(self, **kept)
