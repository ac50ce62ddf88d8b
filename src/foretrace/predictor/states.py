"""The state of a predictor, and the way from recorded trajectories to states and back."""

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foretrace.geometry import (
    continuous_rotation_vectors,
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotation_6d,
    rotation_from_6d,
    rotation_vector_to_quaternion,
)
from foretrace.interactions.batch import InteractionBatch

StateKind = Literal["position", "pose", "turn"]
"""``position``: the centre of mass. ``pose``: the centre of mass and the rotation since rest (6-D). ``turn``: the same
with the rotation as axis times angle, which grows beyond half a turn where an object rolls on."""

STATE_GROUPS: dict[StateKind, tuple[int, ...]] = {"position": (3,), "pose": (3, 6), "turn": (3, 3)}
"""Sizes of the parts of a state that share one unit, and therefore one scale."""

STATES_IN_MIRROR: dict[StateKind, tuple[int, ...]] = {
    "position": (1, -1, 1),
    "pose": (1, -1, 1, 1, -1, 1, -1, 1, -1),
    "turn": (1, -1, 1, -1, 1, -1),
}
"""Factors of a state's coordinates in a mirror along the action axis."""

PIECE = 2048
"""Trajectories of a large part that are looked at together."""


@dataclass(frozen=True)
class Effects:
    """Effects to learn from."""

    states: Float[Tensor, "batch time state"]
    """Normalised states; zeros past the end of a shorter trajectory."""
    lengths: Int[Tensor, " batch"]
    """Samples of each trajectory that count."""
    outcomes: Int[Tensor, " batch"]
    """Number of each one's outcome among those that the predictor distinguishes."""
    estimated_com: Float[Tensor, "batch 3"]
    """Centres of mass at rest as estimated from the views [m]; NaN: not to be estimated, the object is weighted."""
    execution: Float[Tensor, "batch 3"]
    """Executed actions relative to the commanded ones: ahead and to the left [m], turned to the left [rad]; zeros where
    that is not known."""

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, rows: Tensor) -> "Effects":
        return Effects(*(getattr(self, each.name)[rows] for each in fields(self)))


def state_size(kind: StateKind) -> int:
    """Numbers in one state."""
    return sum(STATE_GROUPS[kind])


def valid_lengths(batch: InteractionBatch) -> Int[np.ndarray, " batch"]:
    """Samples of each trajectory that are learned and evaluated: up to where the object slipped."""
    return np.minimum(batch.length, batch.slip_index)


def valid_samples(
    batch: InteractionBatch, lengths: Int[np.ndarray, " batch"] | None = None
) -> Bool[np.ndarray, "batch time"]:
    """Whether a sample lies within its trajectory's length, by default the valid one."""
    return np.arange(batch.com.shape[1]) < (valid_lengths(batch) if lengths is None else lengths)[:, None]


def encode_states(
    batch: InteractionBatch, kind: StateKind, lengths: Int[np.ndarray, " batch"] | None = None
) -> Float[np.ndarray, "batch time state"]:
    """Recorded trajectories as states in the action frame [m]; zeros past their length, by default the valid one.

    The rotation is the object's since rest, the same whatever the object frame: none in the first sample.
    """
    states = batch.com
    valid = valid_samples(batch, lengths)
    if kind != "position":
        # Unit quaternions in place of the missing: a rotation matrix cannot be made from NaN.
        quaternions = np.where(valid[..., None], batch.pose[..., 3:], batch.pose[:, :1, 3:])
        rotations = quaternion_to_matrix(quaternions)
        since_rest = rotations @ np.swapaxes(rotations[:, :1], -1, -2)  # (batch, time, 3, 3)
        turned = rotation_6d(since_rest) if kind == "pose" else continuous_rotation_vectors(since_rest)
        states = np.concatenate([states, turned], axis=-1)
    return np.where(valid[..., None], states, 0.0)


def rest_states(com: Float[np.ndarray, "batch 3"], kind: StateKind) -> Float[np.ndarray, "batch state"]:
    """States of objects at rest with their centres of mass at ``com`` in the action frame [m]."""
    if kind == "position":
        return com
    unturned = rotation_6d(np.eye(3)) if kind == "pose" else np.zeros(3)
    return np.concatenate([com, np.broadcast_to(unturned, (len(com), len(unturned)))], axis=-1)


def decode_poses(states: Float[np.ndarray, "*batch state"]) -> Float[np.ndarray, "*batch 7"]:
    """``pose`` or ``turn`` states as centre of mass [m] and quaternion (w, x, y, z) of the rotation since rest."""
    turned = states[..., 3:]
    if turned.shape[-1] == 3:
        quaternions = rotation_vector_to_quaternion(turned)
    else:
        quaternions = matrix_to_quaternion(rotation_from_6d(turned))
    return np.concatenate([states[..., :3], quaternions], axis=-1)


def decode_turns(states: Float[np.ndarray, "*batch time state"]) -> Float[np.ndarray, "*batch time 3"] | None:
    """Rotation vectors since rest [rad] in states; None if they are positions."""
    turned = states[..., 3:]
    if turned.shape[-1] == 6:
        return continuous_rotation_vectors(rotation_from_6d(turned))
    return turned if turned.shape[-1] else None


def state_statistics(
    states: Float[np.ndarray, "batch time state"], valid: np.ndarray, kind: StateKind
) -> tuple[Float[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """Mean and scale for normalising states, over the valid samples of the training part.

    All coordinates of one unit share one scale, their pooled standard deviation: the squared error then
    weighs every direction alike, as the reported distance does, and a coordinate that hardly moves is not
    blown up.
    """
    if states.dtype == np.float64:
        rows = states[valid]
        mean = rows.mean(axis=0)
        deviation = rows - mean
    else:  # a large part, of which there is no room for a copy: means of pieces, and of their squares
        pieces = [slice(k, k + PIECE) for k in range(0, len(states), PIECE)]
        count = valid.sum()
        mean = sum(states[k][valid[k]].sum(axis=0, dtype=float) for k in pieces) / count
        squares = sum(((states[k][valid[k]] - mean) ** 2).sum(axis=0) for k in pieces) / count
        deviation = np.sqrt(squares)[None]
    scale, first = [], 0
    for size in STATE_GROUPS[kind]:
        group = deviation[:, first : first + size]
        scale += [max(float(np.sqrt(np.mean(group**2))), 1e-6)] * size
        first += size
    return mean, np.array(scale)
