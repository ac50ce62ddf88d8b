"""Trajectories at other times than they were sampled at."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from foretrace.errors import ExportError
from foretrace.geometry import matrix_to_pose, pose_to_matrix
from foretrace.interactions.record import Effect
from foretrace.trajectories import interpolate_poses

EVEN = 1e-3
"""Sampling counts as even if no sample is off its time by more than this [s]."""


def frames_per_second(effects: Sequence[tuple[int, Effect]]) -> int:
    """The rate at which all of them were sampled.

    Args:
        effects: Ids, and what was observed.

    Raises:
        ExportError: One was sampled unevenly, at another rate than the first, or not at a whole rate.
    """
    first: int | None = None
    for id, effect in effects:
        period = float(np.median(np.diff(effect.times))) if len(effect.times) > 1 else 0.0
        rate = round(1 / period) if period > 0 else 0
        grid = effect.times[0] + np.arange(len(effect.times)) / max(rate, 1)
        if rate < 1 or np.abs(effect.times - grid).max() > EVEN:
            said = f"{1 / period:.4g}" if period > 0 else "0"
            raise ExportError(
                f"interaction {id} is not sampled evenly at a whole number of frames per second (about {said}): "
                "give --fps, to which all are resampled"
            )
        first = rate if first is None else first
        if rate != first:
            raise ExportError(
                f"interaction {id} has {rate} frames per second, interaction {effects[0][0]} has {first}: give --fps, "
                "to which all are resampled"
            )
    assert first is not None
    return first


def frame_times(times: Float[np.ndarray, " time"], fps: int) -> Float[np.ndarray, " frame"]:
    """Times of frames since the first sample [s], up to the last sample."""
    return np.arange(int(np.floor((times[-1] - times[0]) * fps + EVEN * fps)) + 1) / fps


def resample_poses(
    times: Float[np.ndarray, " time"], poses: Float[np.ndarray, "time 7"], at: Float[np.ndarray, " frame"]
) -> Float[np.ndarray, "frame 7"]:
    """Poses between samples: positions [m] linearly, quaternions (w, x, y, z) on the shortest way."""
    found = matrix_to_pose(interpolate_poses(times, pose_to_matrix(poses), at))
    # Of a quaternion's two signs the one nearer to the recorded quaternion, so that rows stay continuous.
    nearest = poses[np.abs(times[None] - at[:, None]).argmin(axis=1), 3:]
    found[:, 3:] *= np.where((found[:, 3:] * nearest).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    return found
