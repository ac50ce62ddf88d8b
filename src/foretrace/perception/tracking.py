"""The path of a body with markers through a recording: one pose per frame, smooth, without delay, with its uncertainty.

Every frame gives up to two poses that explain it. Which one is meant is decided for the whole recording at once, by the
least reprojection error and the least turning from frame to frame (Viterbi, 1967). From there all frames are fitted
together: the corners where they were seen, the motion with as little acceleration as they allow, outliers and
impacts forgiven (Huber, 1964). The fit of the whole recording has no delay.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from foretrace.errors import PerceptionError, is_number, shown
from foretrace.geometry import rotation_angle
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.markers import LEAST_SLANT, Detections, MarkerBody, PoseCandidate
from foretrace.trajectories import interpolate_poses

Matches = tuple[np.ndarray, np.ndarray]
"""Points of the body and where they were seen."""
NOTHING: Matches = (np.zeros((0, 3)), np.zeros((0, 2)))
ITERATIONS = 12
CLEARER = 2.0
"""How many times a second pose must err more than the best one for that to be the right one."""
CORNER_NOISE = 0.02
"""Least error of a pose that is compared [pixel]."""
LEAST_APART = np.deg2rad(8.0)
"""Two poses that differ by less are as good as one [rad]."""
HUBER = 1.5
"""Largest residual that counts in full [standard deviations]."""

MOST = 1e6
"""Greatest setting, in SI units."""


@dataclass(frozen=True)
class TrackConfig:
    """How markers are followed.

    Raises:
        PerceptionError: A value is not positive.
    """

    largest_gap: float = 0.25
    """Gaps up to this long are bridged [s]; in longer ones the pose is NaN."""
    largest_error: float = 3.0
    """A frame whose best pose misses the corners by more counts as not seen [pixel]."""
    turning: float = 6.0
    """Nominal speed of turning, by which the right one of two poses is chosen [rad/s]."""
    acceleration: float = 0.3
    """Nominal acceleration [m/s^2]; impacts are outliers."""
    angular_acceleration: float = 3.0
    """The same for rotations [rad/s^2]."""
    least_noise: float = 0.05
    """Least standard deviation of a corner [pixel]."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not is_number(value) or not 0 < value < MOST:
                raise PerceptionError(
                    f"tracking: {name} = {shown(value)}: give a number above 0, in SI units"
                )


@dataclass(frozen=True)
class Track:
    """A body's path in the camera frame."""

    times: Float[np.ndarray, " frame"]
    """Time stamps [s]."""
    T_camera_body: Float[np.ndarray, "frame 4 4"]
    """The body in the camera frame; NaN in gaps that were not bridged."""
    seen: Bool[np.ndarray, " frame"]
    """Where markers were seen; the other poses are bridged or NaN."""
    errors: Float[np.ndarray, " frame"]
    """Root mean square of the reprojection error [pixel]; NaN where nothing was seen."""
    covariance: Float[np.ndarray, "frame 6 6"]
    """Covariance of rotation and position: a small turn about the camera's axes [rad], then metres."""
    noise: float
    """Standard deviation of the corners, estimated from the recording [pixel]."""

    def gaps(self) -> list[tuple[float, float]]:
        """Beginning and end of each stretch without a pose [s]."""
        lost = ~np.isfinite(self.T_camera_body[:, 0, 0])
        return [(float(self.times[a]), float(self.times[b - 1])) for a, b in _runs(lost)]


def track(
    times: Float[np.ndarray, " frame"],
    detections: Sequence[Detections],
    body: MarkerBody,
    camera: PinholeCamera,
    config: TrackConfig = TrackConfig(),
) -> Track:
    """Follows a body through a film.

    Args:
        times: Time stamps [s], increasing.
        detections: What was seen in each frame.
        body: The markers on the body.
        camera: The camera, which stands still.
        config: How.

    Raises:
        PerceptionError: The times do not increase, or fewer than two frames show the body.
    """
    check_times(times)
    candidates = [
        [pose for pose in body.poses(seen, camera) if pose.error <= config.largest_error]
        for seen in detections
    ]
    seen = np.array([bool(poses) for poses in candidates])
    if seen.sum() < 2:
        raise PerceptionError(
            f"markers {body.ids} are seen in {int(seen.sum())} of {len(times)} frames, two are needed: "
            "check ids, dictionary and light"
        )
    poses = np.full((len(times), 4, 4), np.nan)
    covariance = np.full((len(times), 6, 6), np.nan)
    indices = np.flatnonzero(seen)
    chosen = choose_poses(times[indices], [candidates[k] for k in indices], config)
    matches = [
        body.matches(found) if there else NOTHING for found, there in zip(detections, seen, strict=True)
    ]
    noise = _corner_noise(
        [candidates[k][0].error for k in indices], [len(matches[k][0]) for k in indices], config
    )
    deviations = np.full(len(times), noise.min())
    deviations[indices] = noise
    pieces = np.split(
        np.arange(len(indices)), np.flatnonzero(np.diff(times[indices]) > config.largest_gap) + 1
    )
    for piece in pieces:
        inside = np.arange(int(indices[piece[0]]), int(indices[piece[-1]]) + 1)
        start = interpolate_poses(times[indices[piece]], chosen[piece], times[inside])
        poses[inside], covariance[inside] = _smooth(
            times[inside], start, [matches[k] for k in inside], camera, deviations[inside], config
        )
    errors = np.full(len(times), np.nan)
    for k in indices:
        points, pixels = matches[k]
        errors[k] = np.sqrt(((camera.project(points, poses[k]) - pixels) ** 2).sum(axis=1).mean())
    # What the smooth path does not explain after all was something else.
    strange = errors > config.largest_error
    poses[strange], covariance[strange] = np.nan, np.nan
    return Track(times, poses, seen & ~strange, errors, covariance, float(np.median(noise)))


def check_times(times: Float[np.ndarray, " frame"], of: str = "") -> None:
    """Refuse time stamps that do not increase.

    Args:
        times: Time stamps [s].
        of: What they belong to, for the message.


    Raises:
        PerceptionError: Naming the first frame that is not later than the one before.
    """
    if not np.isfinite(times).all():
        raise PerceptionError(f"frame {int((~np.isfinite(times)).argmax())}{of} has no time stamp")
    if (np.diff(times) <= 0).any():
        k = int((np.diff(times) <= 0).argmax())
        raise PerceptionError(
            f"time stamps{of} do not increase: frame {k + 1} at {times[k + 1]:.6f} s follows {times[k]:.6f} s; "
            "sort or record again"
        )


def choose_poses(
    times: Float[np.ndarray, " frame"], candidates: Sequence[Sequence[PoseCandidate]], config: TrackConfig
) -> Float[np.ndarray, "frame 4 4"]:
    """One pose per frame: the sequence of least reprojection error and least turning (Viterbi, 1967)."""
    noise = max(config.least_noise, float(np.median([poses[0].error for poses in candidates])))
    costs = [np.array([(pose.error / noise) ** 2 for pose in poses]) for poses in candidates]
    total, back = costs[0], []
    for k in range(1, len(candidates)):
        pairs = [[pose.T_camera_body[:3, :3] for pose in candidates[j]] for j in (k - 1, k)]
        turns = rotation_angle(np.array(pairs[0])[:, None], np.array(pairs[1])[None])
        scale = config.turning * (times[k] - times[k - 1])
        reached = total[:, None] + (turns / scale) ** 2
        back.append(reached.argmin(axis=0))
        total = reached.min(axis=0) + costs[k]
    best = [int(total.argmin())]
    for pointers in reversed(back):
        best.append(int(pointers[best[-1]]))
    return np.array([poses[b].T_camera_body for poses, b in zip(candidates, reversed(best), strict=True)])


def _corner_noise(
    errors: Sequence[float], counts: Sequence[int], config: TrackConfig
) -> Float[np.ndarray, " frame"]:
    """Standard deviation of a corner's coordinates in each frame, from how well it fits itself [pixel].

    Eight coordinates less a pose's six leave little to judge by: no frame is believed better than most are.
    """
    corners = np.asarray(counts)
    freed = np.asarray(errors) * np.sqrt(corners / np.maximum(2 * corners - 6, 1))
    return np.maximum(freed, max(config.least_noise, float(np.median(freed))))


def _smooth(
    times: np.ndarray,
    poses: Float[np.ndarray, "frame 4 4"],
    matches: Sequence[Matches],
    camera: PinholeCamera,
    noise: Float[np.ndarray, " frame"],
    config: TrackConfig,
) -> tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame 6 6"]]:
    """All poses of a stretch fitted together by Gauss-Newton steps, and the covariance of each."""
    poses = poses.copy()
    information: Any = None
    for _ in range(ITERATIONS):
        jacobian, residual = _linearise(times, poses, matches, camera, noise, config)
        # A little damping holds what neither corners nor neighbours determine.
        information = (jacobian.T @ jacobian + 1e-6 * sparse.eye(6 * len(times))).tocsc()
        step = splu(information).solve(-(jacobian.T @ residual)).reshape(-1, 6)
        poses[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += step[:, 3:]
        if np.abs(step).max() < 1e-7:
            break
    return poses, _diagonal_blocks(information)


def _linearise(
    times: np.ndarray,
    poses: np.ndarray,
    matches: Sequence[Matches],
    camera: PinholeCamera,
    noise: Float[np.ndarray, " frame"],
    config: TrackConfig,
) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Jacobian and residuals, each in its standard deviations, weighted against outliers."""
    rows, columns, values, residuals = [], [], [], []
    count = 0

    def add(residual: np.ndarray, blocks: Sequence[tuple[int, np.ndarray]]) -> None:
        nonlocal count
        size = np.linalg.norm(residual) / np.sqrt(len(residual))
        weight = np.sqrt(min(1.0, HUBER / max(size, 1e-12)))
        residuals.append(weight * residual)
        for start, block in blocks:
            i, j = np.indices(block.shape)
            rows.append((count + i).ravel())
            columns.append((start + j).ravel())
            values.append((weight * block).ravel())
        count += len(residual)

    for k, match in enumerate(matches):
        if len(match[0]):
            residual, block = _corner_terms(poses[k], *match, camera)
            add(residual / noise[k], [(6 * k, block / noise[k])])
    for part, scale in ((slice(0, 3), config.angular_acceleration), (slice(3, 6), config.acceleration)):
        speeds = _speeds(times, poses, turning=part.start == 0)
        for k in range(1, len(times) - 1):
            before, after = times[k] - times[k - 1], times[k + 1] - times[k]
            middle = (before + after) / 2
            share = np.eye(3) / (middle * scale)
            terms = ((k - 1, share / before), (k, -share / before - share / after), (k + 1, share / after))
            blocks = [(6 * frame + part.start, block) for frame, block in terms]
            add((speeds[k] - speeds[k - 1]) / (middle * scale), blocks)
    shape = (count, 6 * len(times))
    triplets = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_matrix(triplets, shape=shape), np.concatenate(residuals)


def _speeds(times: np.ndarray, poses: np.ndarray, turning: bool) -> Float[np.ndarray, "steps 3"]:
    if turning:
        steps = Rotation.from_matrix(poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)).as_rotvec()
    else:
        steps = np.diff(poses[:, :3, 3], axis=0)
    return np.asarray(steps / np.diff(times)[:, None])


def _corner_terms(
    pose: np.ndarray, points: np.ndarray, pixels: np.ndarray, camera: PinholeCamera
) -> tuple[np.ndarray, np.ndarray]:
    """Reprojection error, and its change with a small turn about the camera's axes and a small shift."""
    turned = points @ pose[:3, :3].T
    projected, by_shift = camera.project_with_slopes(turned + pose[:3, 3])
    x, y, z = turned.T
    zero = np.zeros_like(x)
    by_turn = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 0, 1)  # -[turned]x
    block = np.concatenate([by_shift @ by_turn, by_shift], axis=2).reshape(-1, 6)
    return (projected - pixels).ravel(), block


def _diagonal_blocks(information: Any) -> Float[np.ndarray, "frame 6 6"]:
    """The 6 x 6 blocks on the diagonal of the inverse."""
    factors, size = splu(information), information.shape[0]
    blocks = np.empty((size // 6, 6, 6))
    for first in range(0, size, 600):
        width = min(600, size - first)
        unit = np.zeros((size, width))
        unit[np.arange(first, first + width), np.arange(width)] = 1.0
        solved = factors.solve(unit)
        for j in range(0, width, 6):
            blocks[(first + j) // 6] = solved[first + j : first + j + 6, j : j + 6]
    return blocks


def still_pose(
    detections: Sequence[Detections],
    body: MarkerBody,
    camera: PinholeCamera,
    config: TrackConfig = TrackConfig(),
) -> Float[np.ndarray, "4 4"]:
    """T_camera_body of a body that stands still, from all frames together: each corner at its median place.

    Raises:
        PerceptionError: No frame shows it well enough.
    """
    ids = np.concatenate([[id for id in body.ids if seen.of(id) is not None] for seen in detections])
    # A marker counts that is seen at least half as often as the one seen most.
    counts = {id: int((ids == id).sum()) for id in body.ids}
    often = [id for id, count in counts.items() if count > 0 and 2 * count >= max(counts.values())]
    places = [
        np.median([corners for seen in detections if (corners := seen.of(id)) is not None], axis=0)
        for id in often
    ]
    middle = Detections(np.array(often, dtype=int), np.array(places).reshape(-1, 4, 2))
    poses = body.poses(middle, camera, least_slant=0.0)
    if not poses or poses[0].error > config.largest_error:
        state = f"explained to {poses[0].error:.1f} pixels only" if poses else "not seen"
        remedy = "check their layout, sides, dictionary and light"
        upside_down = body.turned().poses(middle, camera)
        if len(often) > 1 and upside_down and upside_down[0].error < config.largest_error:
            state = "not where the layout has them"
            remedy = (
                "they fit if each is turned by 180 degrees (OpenCV draws AprilTags so): "
                'add "angle_deg": 180 to each in the layout'
            )
        raise PerceptionError(f"markers {body.ids} on the table are {state}: {remedy}")
    _check_sight(poses, often)
    return poses[0].T_camera_body


def _check_sight(poses: Sequence[PoseCandidate], ids: Sequence[int]) -> None:
    """Refuse a still body that is seen too flat, or whose other pose explains the image as well."""
    if poses[0].slant < LEAST_SLANT:
        raise PerceptionError(
            f"markers {list(ids)} are seen at {np.rad2deg(poses[0].slant):.0f} degrees above their plane, "
            f"{np.rad2deg(LEAST_SLANT):.0f} are needed: take the image from higher up"
        )
    if len(poses) < 2:
        return
    apart = rotation_angle(poses[0].T_camera_body[:3, :3], poses[1].T_camera_body[:3, :3])
    if apart > LEAST_APART and poses[1].error < CLEARER * max(poses[0].error, CORNER_NOISE):
        raise PerceptionError(
            f"markers {list(ids)} are seen alike from two directions {np.rad2deg(apart):.0f} degrees apart: go nearer, "
            "or lay out more markers"
        )


def _runs(flags: Bool[np.ndarray, " n"]) -> list[tuple[int, int]]:
    """Beginning and end (excluded) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
