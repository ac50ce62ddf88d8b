"""Distances between trajectories: full, final, rotation (paper, section 5.2), after time warping (5.4)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from foretrace.errors import ForetraceError
from foretrace.extras import named_extras

UNIT_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's length from 1."""


class Alignment(NamedTuple):
    """Two trajectories in step with each other."""

    distance: float
    """Mean Euclidean distance of the samples that belong together, in the trajectories' unit."""
    path: Int[np.ndarray, "pairs 2"]
    """Which sample of the first belongs to which of the second, from both beginnings to both ends."""


def warped_distance(a: Float[np.ndarray, "time_a dims"], b: Float[np.ndarray, "time_b dims"]) -> Alignment:
    """Distance of two trajectories whose samples were taken at other times (paper, section 5.4).

    Dynamic time warping (Sakoe and Chiba, 1978), exact: of all monotone ways to pair the samples, that with the
    least sum of Euclidean distances; its mean distance is what the paper calls the distance of trajectories.

    Args:
        a: Positions, one row per sample.
        b: Positions, any number of samples, at any rate.

    Raises:
        ValueError: One of them is empty or has values that are not finite.
    """
    with named_extras():
        from dtaidistance import dtw, dtw_ndim

    for name, values in (("first", a), ("second", b)):
        if len(values) == 0 or not np.isfinite(values).all():
            raise ValueError(f"the {name} trajectory has {len(values)} samples, all must be there and finite")
    one, other = (np.ascontiguousarray(values, dtype=np.double) for values in (a, b))
    costs = dtw_ndim.warping_paths_fast(one, other, inner_dist="euclidean")[1]
    path = np.array(dtw.best_path(costs))
    return Alignment(float(np.linalg.norm(one[path[:, 0]] - other[path[:, 1]], axis=1).mean()), path)


def mean_distance(
    a: Float[np.ndarray, "*batch time dims"], b: Float[np.ndarray, "*batch time dims"]
) -> Float[np.ndarray, "*batch"] | np.floating:
    """Full-trajectory error: the Euclidean distance averaged over time, in the inputs' unit.

    Args:
        a: Positions, one row per sample.
        b: Positions at the same times.

    Returns:
        The mean over the samples that both trajectories have (those without NaN); NaN where they share none.
    """
    distances = _distances(a, b)
    shared = np.isfinite(distances)
    total = np.where(shared, distances, 0.0).sum(axis=-1)
    count = shared.sum(axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)[()]


def final_distance(
    a: Float[np.ndarray, "*batch time dims"], b: Float[np.ndarray, "*batch time dims"]
) -> Float[np.ndarray, "*batch"] | np.floating:
    """Final-position error: the Euclidean distance at the last sample that both have, in the inputs' unit.

    Args:
        a: Positions, one row per sample.
        b: Positions at the same times.

    Returns:
        One distance per pair; NaN where the two share no sample.
    """
    distances = _distances(a, b)
    shared = np.isfinite(distances)
    last = shared.shape[-1] - 1 - np.argmax(shared[..., ::-1], axis=-1)
    return np.take_along_axis(distances, last[..., None], axis=-1)[..., 0][()]


def rotation_error(
    a: Float[np.ndarray, "*batch 4"], b: Float[np.ndarray, "*batch 4"]
) -> Float[np.ndarray, "*batch"] | np.floating:
    """Angle of the rotation that takes one orientation into the other.

    Args:
        a: Unit quaternions (w, x, y, z).
        b: Unit quaternions (w, x, y, z); their sign does not matter.

    Returns:
        Geodesic angles between 0 and pi [rad].
    """
    # Distances of unit quaternions keep small angles exact, where the arc cosine of a dot product would not.
    apart = np.linalg.norm(a - b, axis=-1)
    together = np.linalg.norm(a + b, axis=-1)
    return 4 * np.arctan2(np.minimum(apart, together), np.maximum(apart, together))


def check_poses(
    times: Float[np.ndarray, " time"], poses: Float[np.ndarray, "n 7"], error: type[ForetraceError]
) -> None:
    """Refuse what is no motion sampled over time.

    Args:
        times: Times [s].
        poses: Positions [m] and quaternions (w, x, y, z).
        error: The class to raise.

    Raises:
        ForetraceError: Of the given class: there is no time or not one pose for each, times do not rise, or a
            quaternion has another length than 1.
    """
    if len(times) != len(poses) or len(times) == 0:
        raise error(f"{len(times)} times and {len(poses)} poses: give one pose for each time")
    if (steps := np.diff(times)).size and steps.min() <= 0:
        k = int((steps <= 0).argmax())
        raise error(f"times must rise: {times[k + 1]:g} s follows {times[k]:g} s")
    lengths = np.linalg.norm(poses[:, 3:], axis=1)
    if (wrong := np.abs(lengths - 1) > UNIT_TOLERANCE).any():
        k = int(wrong.argmax())
        raise error(
            f"the quaternion (w, x, y, z) of pose {k} has length {lengths[k]:.4g}, not 1: normalise it"
        )


def interpolate(
    times: Float[np.ndarray, " known"], values: Float[np.ndarray, "known k"], at: Float[np.ndarray, " time"]
) -> Float[np.ndarray, "time k"]:
    """Values between known ones, linearly; constant beyond the first and the last. Times in seconds."""
    return np.column_stack([np.interp(at, times, column) for column in values.T])


def interpolate_poses(
    times: Float[np.ndarray, " known"],
    transforms: Float[np.ndarray, "known 4 4"],
    at: Float[np.ndarray, " time"],
) -> Float[np.ndarray, "time 4 4"]:
    """Poses between known ones: positions linear, rotations the shortest way, constant beyond the first and the last.

    Args:
        times: Increasing times of the known poses [s].
        transforms: The known poses.
        at: Times of the wanted poses [s].
    """
    from scipy.spatial.transform import Rotation, Slerp

    if len(times) == 1:
        return np.repeat(transforms, len(at), axis=0)
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, :3, 3] = interpolate(times, transforms[:, :3, 3], at)
    between = Slerp(times, Rotation.from_matrix(transforms[:, :3, :3]))
    poses[:, :3, :3] = between(np.clip(at, times[0], times[-1])).as_matrix()
    return poses


def rhythm(times: Float[np.ndarray, " time"]) -> str:
    """Sample times [s] in words: their period, and the last of them."""
    periods = np.unique(np.round(np.diff(times), 6))
    every = (
        " to ".join(f"{period:g}" for period in dict.fromkeys((periods[0], periods[-1])))
        if len(periods)
        else "0"
    )
    return f"every {every} s up to {times[-1]:g} s"


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.asarray(a, dtype=float) - np.asarray(b, dtype=float), axis=-1)
