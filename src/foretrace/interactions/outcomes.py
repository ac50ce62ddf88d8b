"""What became of an object, told from its motion: the same rules for simulated and for filmed lever-ups."""

import numpy as np
from jaxtyping import Bool, Float

from foretrace.geometry import quaternion_to_matrix, tilt
from foretrace.interactions.record import Outcome
from foretrace.objects import ObjectModel

LIFTED_TILT = np.deg2rad(3.0)
"""An object tilted by more than this counts as lifted [rad]."""
ROLLED_TURN = np.deg2rad(30.0)
"""An object that turns by more than this about horizontal axes, its height unchanged, has rolled [rad]."""
ROLLED_RISE = 0.05
"""Rolling changes the height of the centre of mass by less than this part of its height at rest."""
UPRIGHT_TILT = np.deg2rad(80.0)
"""An object that rests, off the blade, with a larger tilt than this lies on another side [rad]."""
DROP = 0.004
"""A blade never lowers its end of the object: if that falls by more than this, it was lost [m]."""


def lifted_samples(
    obj: ObjectModel, rotation: Float[np.ndarray, "time 3 3"], com_z: Float[np.ndarray, " time"]
) -> Bool[np.ndarray, " time"]:
    """When an object is lifted, of its rotation and the height of its centre of mass [m]."""
    lifted = tilt(rotation) > LIFTED_TILT
    if obj.is_round:  # turning about its own axis is no lifting
        lifted &= com_z > (1 + ROLLED_RISE) * com_z[0]
    return lifted


def name_outcome(
    rotation: Float[np.ndarray, "time 3 3"],
    com_z: Float[np.ndarray, " time"],
    lifted: Bool[np.ndarray, " time"],
    on_blade_at_end: bool,
    slip: int | None,
) -> Outcome:
    """What became of an object, of its motion and of when it left the blade."""
    angle = tilt(rotation)
    if _rolling_turn(rotation, com_z) > ROLLED_TURN:
        return Outcome.ROLLED
    if angle.max() > np.pi / 2 or (angle[-1] > UPRIGHT_TILT and not on_blade_at_end):
        return Outcome.TUMBLED
    if not lifted.any():
        return Outcome.MISSED
    return Outcome.LEVERED if slip is None else Outcome.SLIPPED


def judge_motion(
    obj: ObjectModel, poses: Float[np.ndarray, "time 7"], com: Float[np.ndarray, "time 3"]
) -> tuple[Outcome, int | None]:
    """Outcome and first sample off the blade, of the object's motion in the action frame alone.

    Where nobody saw whether the blade touched the object, it is lost when the end that the blade carried drops.
    """
    rotation = quaternion_to_matrix(poses[:, 3:])
    carried = -rotation[0].T @ poses[0, :3]  # the action frame's origin, in the object frame
    height = poses[:, 2] + (rotation @ carried)[:, 2]
    lifted = lifted_samples(obj, rotation, com[:, 2])
    summit = np.maximum.accumulate(height)
    dropped = (summit - height > DROP) & (np.cumsum(lifted) > 0)
    slip = None
    if dropped.any():
        slip = int(height[: int(dropped.argmax())].argmax()) + 1
    outcome = name_outcome(rotation, com[:, 2], lifted, slip is None, slip)
    return outcome, None if outcome in (Outcome.ROLLED, Outcome.TUMBLED) else slip


def _rolling_turn(rotation: Float[np.ndarray, "time 3 3"], com_z: Float[np.ndarray, " time"]) -> float:
    """Largest turn about horizontal axes within samples in a row at the height at rest [rad]."""
    level = np.abs(com_z - com_z[0]) < ROLLED_RISE * com_z[0]
    starts = np.flatnonzero(np.diff(level.astype(int), prepend=0) == 1)
    stops = np.flatnonzero(np.diff(level.astype(int), append=0) == -1) + 1
    turns = [
        tilt(rotation[start:stop] @ rotation[start].T).max()
        for start, stop in zip(starts, stops, strict=True)
    ]
    return float(max(turns))
