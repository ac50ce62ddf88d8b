"""Distances between trajectories: full, final, rotation (paper, section 5.2)."""

import numpy as np
from jaxtyping import Float


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


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.asarray(a, dtype=float) - np.asarray(b, dtype=float), axis=-1)
