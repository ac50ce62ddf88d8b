"""How unlike a motion is to those of successes: a baseline of monitors that knows neither object nor action.

It is learned from successes alone, as in Xu et al., Can We Detect Failures Without Failure Data? (FAIL-Detect, 2025),
with the distance to the nearest windows of successes as its density.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from foretrace.experiments.executions import PERIOD, make_execution
from foretrace.imagined.observed import rotations_since_rest
from foretrace.monitoring.motions import TURN_LENGTH

OFFSETS = (0, 3, 6, 9)
"""Samples of a window, counted from its first."""
NEIGHBOURS = 5
"""A window is as unlike as this neighbour among those of successes is far."""
TIME = 0.05
"""Distance that a second counts as: windows are compared with those of about the same time [m/s]."""


def windows_of(tracked: Sequence[Float[np.ndarray, "7"] | None]) -> Float[np.ndarray, "windows numbers"]:
    """Way and turn since rest at the samples of each window [m], and its time.

    Args:
        tracked: Poses; one that was lost counts as the one before.
    """
    first = next(pose for pose in tracked if pose is not None)
    poses = [first]
    for pose in tracked:
        poses.append(poses[-1] if pose is None else pose)
    known = np.array(poses[1:])
    moved = np.concatenate([known[:, :3] - first[:3], TURN_LENGTH * rotations_since_rest(known)], axis=1)
    starts = np.arange(max(0, len(moved) - OFFSETS[-1]))
    parts = [moved[starts + offset] for offset in OFFSETS]
    return np.concatenate([*parts, TIME * PERIOD * starts[:, None]], axis=1)


@lru_cache(maxsize=1)
def successes(count: int, seed: int) -> KDTree:
    """Windows of normal executions."""
    return KDTree(np.concatenate([windows_of(make_execution(seed, k).tracked) for k in range(count)]))


def unlikeness(tracked: Sequence[Float[np.ndarray, "7"] | None], known: KDTree) -> float:
    """Largest distance of a window to those of successes [m]."""
    windows = windows_of(tracked)
    if not len(windows):
        return 0.0
    distances, _ = known.query(windows, k=NEIGHBOURS)
    return float(distances[:, -1].max())
