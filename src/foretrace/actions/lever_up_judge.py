"""What became of a levered object, from its motion: the same rules for simulated and for recorded lever-ups."""

from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int

from foretrace.actions.motion import FAILED, Judgement, Motion
from foretrace.geometry import quaternion_to_matrix, tilt, transform_points
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
"""A blade never lowers its end of the object: if that end falls by more than this, it has slipped [m]."""
OFF_SAMPLES = 2
"""Consecutive samples off the blade that are a slip; a single one is a bounce."""
CORNER_REACH = 0.004
"""A table contact belongs to a corner within this distance [m]."""
SUPPORT_SHARE = 0.5
"""A support corner carries the object in at least this share of the lifted samples."""


class Outcome(StrEnum):
    """What became of the object of a lever-up, judged once the tool has come to rest."""

    LEVERED = "levered"
    """Lifted along the whole path and still on the blade at its end."""
    SLIPPED = "slipped"
    """Lifted, then lost from the blade before the path's end."""
    TUMBLED = "tumbled"
    """Turned over its support edge, onto another side."""
    ROLLED = "rolled"
    """Rolled away instead of being lifted."""
    MISSED = "missed"
    """Never lifted: the blade passed beside or only pushed it."""
    FAILED = FAILED
    """The simulation diverged; there is no effect to learn from."""


def judge_lever_up(
    motion: Motion,
    obj: ObjectModel,
    com: Float[np.ndarray, "time 3"],
    T_action_object: Float[np.ndarray, "4 4"],
) -> Judgement:
    """Outcome, slip and support points of a lever-up.

    Args:
        motion: What was seen.
        obj: The object.
        com: Centre of mass in the action frame [m].
        T_action_object: Transform from the object frame at rest to the action frame.
    """
    rotation = quaternion_to_matrix(motion.object_pose[:, 3:])
    lifted = _lifted_samples(obj, rotation, com[:, 2])
    if motion.on_tool is None:
        slip = _drop_index(motion.object_pose, rotation, lifted)
        on_blade_at_end = slip is None
    else:
        slip = _slip_index(lifted, motion.on_tool)
        on_blade_at_end = bool(motion.on_tool[-1])
    outcome = _name_outcome(rotation, com[:, 2], lifted, on_blade_at_end, slip)
    corners, points = (), None
    end = len(com) if slip is None else slip
    if motion.table_contacts and lifted[:end].any() and outcome != Outcome.ROLLED:
        counts = _corner_counts(motion, obj, np.flatnonzero(lifted[:end]))
        shares = counts / max(int(lifted[:end].sum()), 1)
        corners = tuple(int(k) for k in np.flatnonzero(shares >= SUPPORT_SHARE))
        busiest = np.argsort(-counts, kind="stable")[:2]
        if (counts[busiest] > 0).all():
            at_rest = np.column_stack([obj.support_corners[np.sort(busiest)], np.zeros(2)])
            points = transform_points(T_action_object, at_rest)[:, :2]
    # Leaving the blade is what a rolling or tumbling object does; it is no slip.
    slip = None if outcome in (Outcome.ROLLED, Outcome.TUMBLED) else slip
    return Judgement(outcome, slip, points, corners)


def _lifted_samples(
    obj: ObjectModel, rotation: Float[np.ndarray, "time 3 3"], com_z: Float[np.ndarray, " time"]
) -> Bool[np.ndarray, " time"]:
    lifted = tilt(rotation) > LIFTED_TILT
    if obj.is_round:  # turning about its own axis is no lifting
        lifted &= com_z > (1 + ROLLED_RISE) * com_z[0]
    return lifted


def _name_outcome(
    rotation: Float[np.ndarray, "time 3 3"],
    com_z: Float[np.ndarray, " time"],
    lifted: Bool[np.ndarray, " time"],
    on_blade_at_end: bool,
    slip: int | None,
) -> Outcome:
    angle = tilt(rotation)
    if _rolling_turn(rotation, com_z) > ROLLED_TURN:
        return Outcome.ROLLED
    if angle.max() > np.pi / 2 or (angle[-1] > UPRIGHT_TILT and not on_blade_at_end):
        return Outcome.TUMBLED
    if not lifted.any():
        return Outcome.MISSED
    return Outcome.LEVERED if slip is None else Outcome.SLIPPED


def _slip_index(lifted: Bool[np.ndarray, " time"], on_blade: Bool[np.ndarray, " time"]) -> int | None:
    """First sample of the first lasting loss of contact after the object was first lifted."""
    if not lifted.any():
        return None
    off = ~on_blade
    off[: int(lifted.argmax())] = False
    lasting = off.copy()
    for k in range(1, OFF_SAMPLES):
        # At the record's end the missing samples count as off.
        lasting &= np.append(off[k:], np.ones(k, dtype=bool))
    return int(lasting.argmax()) if lasting.any() else None


def _drop_index(
    poses: Float[np.ndarray, "time 7"],
    rotation: Float[np.ndarray, "time 3 3"],
    lifted: Bool[np.ndarray, " time"],
) -> int | None:
    """First sample off a blade that was not observed: after it, the end that the blade carried drops."""
    carried = -rotation[0].T @ poses[0, :3]  # the action frame's origin, in the object frame
    height = poses[:, 2] + (rotation @ carried)[:, 2]
    dropped = (np.maximum.accumulate(height) - height > DROP) & (np.cumsum(lifted) > 0)
    return int(height[: int(dropped.argmax())].argmax()) + 1 if dropped.any() else None


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


def _corner_counts(
    motion: Motion, obj: ObjectModel, samples: Int[np.ndarray, " samples"]
) -> Int[np.ndarray, " corners"]:
    """Number of the given samples in which each corner of the object stood on the table."""
    counts = np.zeros(len(obj.corners), dtype=int)
    # With growing tilt the object passes from the bevel's inner to its outer edge: a corner is the segment between.
    start, along = obj.support_corners, obj.corners - obj.support_corners
    length2 = np.maximum((along**2).sum(axis=1), 1e-18)
    for i in samples:
        points = motion.table_contacts[i][:, None, :2] - start  # (contacts, corners, 2)
        t = np.clip((points * along).sum(axis=-1) / length2, 0.0, 1.0)
        distance = np.linalg.norm(points - t[..., None] * along, axis=-1)
        counts += (distance < CORNER_REACH).any(axis=0)
    return counts
