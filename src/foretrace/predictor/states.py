"""What a predictor's state is made of, and the way from recorded trajectories to states and back."""

from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from foretrace.geometry import matrix_to_quaternion, quaternion_to_matrix, rotation_6d, rotation_from_6d
from foretrace.interactions.dataset import InteractionBatch

StateKind = Literal["position", "pose"]
"""``position``: the centre of mass. ``pose``: the centre of mass and the rotation since rest (6-D)."""

STATE_GROUPS: dict[StateKind, tuple[int, ...]] = {"position": (3,), "pose": (3, 6)}
"""Sizes of the parts of a state that share one unit, and therefore one scale."""


def state_size(kind: StateKind) -> int:
    """Numbers in one state."""
    return sum(STATE_GROUPS[kind])


def valid_lengths(batch: InteractionBatch) -> Int[np.ndarray, " batch"]:
    """Samples of each trajectory that are learned and judged: up to where the object slipped."""
    return np.minimum(batch.length, batch.slip_index)


def valid_samples(batch: InteractionBatch) -> np.ndarray:
    """(batch, time) bool: whether a sample lies within its trajectory's valid length."""
    return np.arange(batch.com.shape[1]) < valid_lengths(batch)[:, None]


def encode_states(batch: InteractionBatch, kind: StateKind) -> Float[np.ndarray, "batch time state"]:
    """Recorded trajectories as states in the action frame [m]; zeros past the valid length.

    The rotation of a ``pose`` state is the object's rotation since rest, the same whatever the object frame:
    the identity in the first sample.
    """
    states = batch.com
    valid = valid_samples(batch)
    if kind == "pose":
        # Unit quaternions in place of the missing: a rotation matrix cannot be made from NaN.
        quaternions = np.where(valid[..., None], batch.pose[..., 3:], batch.pose[:, :1, 3:])
        rotations = quaternion_to_matrix(quaternions)
        since_rest = rotations @ np.swapaxes(rotations[:, :1], -1, -2)  # (batch, time, 3, 3)
        states = np.concatenate([states, rotation_6d(since_rest)], axis=-1)
    return np.where(valid[..., None], states, 0.0)


def rest_states(com: Float[np.ndarray, "batch 3"], kind: StateKind) -> Float[np.ndarray, "batch state"]:
    """States of objects at rest with their centres of mass at ``com`` in the action frame [m]."""
    if kind == "position":
        return com
    identity = rotation_6d(np.broadcast_to(np.eye(3), (len(com), 3, 3)))
    return np.concatenate([com, identity], axis=-1)


def decode_poses(states: Float[np.ndarray, "*batch 9"]) -> Float[np.ndarray, "*batch 7"]:
    """``pose`` states as centre of mass [m] and quaternion (w, x, y, z) of the rotation since rest."""
    quaternions = matrix_to_quaternion(rotation_from_6d(states[..., 3:]))
    return np.concatenate([states[..., :3], quaternions], axis=-1)


def state_statistics(
    states: Float[np.ndarray, "batch time state"], valid: np.ndarray, kind: StateKind
) -> tuple[Float[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """Mean and scale for normalising states, over the valid samples of the training part.

    All coordinates of one unit share one scale, their pooled standard deviation: the squared error then
    weighs every direction alike, as the reported distance does, and a coordinate that hardly moves is not
    blown up.
    """
    rows = states[valid]
    mean = rows.mean(axis=0)
    deviation = rows - mean
    scale, first = [], 0
    for size in STATE_GROUPS[kind]:
        group = deviation[:, first : first + size]
        scale += [max(float(np.sqrt(np.mean(group**2))), 1e-6)] * size
        first += size
    return mean, np.array(scale)
