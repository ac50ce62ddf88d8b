"""Paths of markers from corners with noise: precise, right side up, with stated gaps and honest uncertainty."""

import numpy as np
import pytest

from foretrace.errors import PerceptionError
from foretrace.geometry import pose_to_matrix, rotation_angle
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.markers import Detections, MarkerBody
from foretrace.perception.tracking import Track, TrackConfig, still_pose, track

CAMERA = PinholeCamera(1280, 720, 920.0, 920.0, 640.0, 360.0, (0.09, -0.2, 0.001, -0.001, 0.1))
BODY = MarkerBody.single(4, 0.045)
NOISE = 0.15


def motion(num: int = 90, tilt: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Times, and T_camera_body of a marker that is lifted slowly at 0.7 m."""
    times = 100.0 + np.arange(num) / 30
    s = np.clip((times - times[0] - 0.7) / 1.7, 0, 1)
    phase = s**3 * (10 - 15 * s + 6 * s**2)
    half = (np.pi + tilt + 0.6 * phase) / 2
    poses = np.zeros((num, 7))
    poses[:, :3] = [0.02, -0.01, 0.7] + phase[:, None] * [0.05, -0.03, -0.05]
    poses[:, 3], poses[:, 4] = np.cos(half), np.sin(half)
    return times, pose_to_matrix(poses)


def seen(T: np.ndarray, rng: np.random.Generator, noise: float = NOISE) -> list[Detections]:
    corners = [CAMERA.project(BODY.corners(4), pose) + rng.normal(0, noise, (4, 2)) for pose in T]
    return [Detections(np.array([4]), c[None]) for c in corners]


def errors(found: Track, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    apart = np.linalg.norm(found.T_camera_body[:, :3, 3] - T[:, :3, 3], axis=1)
    return apart, np.rad2deg(rotation_angle(found.T_camera_body[:, :3, :3], T[:, :3, :3]))


def nothing() -> Detections:
    return Detections(np.zeros(0, dtype=int), np.zeros((0, 4, 2)))


def test_a_track_is_precise_and_knows_how_precise() -> None:
    times, T = motion()
    found = track(times, seen(T, np.random.default_rng(0)), BODY, CAMERA)
    position, angle = errors(found, T)
    assert np.median(position) < 0.002
    assert np.median(angle) < 0.5
    assert found.noise == pytest.approx(NOISE, rel=0.5)
    # Normalised by its own covariance the error has the size that it should have: 3 degrees of freedom.
    shift = found.T_camera_body[:, :3, 3] - T[:, :3, 3]
    normalised = [d @ np.linalg.solve(c[3:, 3:], d) for d, c in zip(shift, found.covariance, strict=True)]
    assert 0.3 < np.median(normalised) < 9


def test_a_track_beats_single_frames_and_does_not_lag() -> None:
    times, T = motion()
    detections = seen(T, np.random.default_rng(1))
    found = track(times, detections, BODY, CAMERA)
    single = np.array([BODY.poses(d, CAMERA)[0].T_camera_body[:3, 3] for d in detections])
    alone = np.linalg.norm(single - T[:, :3, 3], axis=1)
    assert np.median(errors(found, T)[0]) < 0.7 * np.median(alone)
    # A delay would show as an offset along the motion.
    speed = np.gradient(T[:, :3, 3], times, axis=0)
    moving = np.linalg.norm(speed, axis=1) > 0.03
    offset = ((found.T_camera_body[:, :3, 3] - T[:, :3, 3]) * speed).sum(axis=1)[moving]
    delay = -offset.mean() / (speed[moving] ** 2).sum(axis=1).mean()
    assert abs(delay) < 0.01


def test_the_two_poses_of_a_marker_are_told_apart_by_the_whole_film() -> None:
    times, T = motion(tilt=0.25)  # slightly slanted at first: many single frames are flipped
    detections = seen(T, np.random.default_rng(2), noise=0.6)
    single = np.array([BODY.poses(d, CAMERA)[0].T_camera_body[:3, :3] for d in detections])
    flipped = np.rad2deg(rotation_angle(single, T[:, :3, :3])) > 15
    assert flipped.sum() >= 5
    found = track(times, detections, BODY, CAMERA)
    assert errors(found, T)[1].max() < 8


def test_short_gaps_are_bridged_and_long_ones_marked() -> None:
    times, T = motion()
    detections = seen(T, np.random.default_rng(3))
    for k in [*range(20, 25), *range(50, 70)]:
        detections[k] = nothing()
    found = track(times, detections, BODY, CAMERA, TrackConfig(largest_gap=0.25))
    position, _ = errors(found, T)
    assert np.isfinite(position[:50]).all()
    assert position[20:25].max() < 0.006
    assert np.isnan(position[50:70]).all()
    assert np.isnan(found.errors[20:25]).all()
    (gap,) = found.gaps()
    assert gap == pytest.approx((times[50], times[69]))
    # What was bridged is less certain than what was seen.
    assert found.covariance[22, 5, 5] > found.covariance[15, 5, 5]


def test_a_body_at_rest_is_found_from_all_frames() -> None:
    _, T = motion(tilt=0.7)
    rng = np.random.default_rng(4)
    many = [seen(T[:1], rng)[0] for _ in range(40)]
    pose = still_pose(many, BODY, CAMERA)
    assert np.linalg.norm(pose[:3, 3] - T[0, :3, 3]) < 0.002
    with pytest.raises(PerceptionError, match="not seen"):
        still_pose([nothing()], BODY, CAMERA)


def test_what_cannot_be_tracked_is_refused() -> None:
    times, T = motion(10)
    detections = seen(T, np.random.default_rng(5))
    backwards = times.copy()
    backwards[[4, 5]] = backwards[[5, 4]]
    with pytest.raises(PerceptionError, match="do not increase: frame 5"):
        track(backwards, detections, BODY, CAMERA)
    with pytest.raises(PerceptionError, match=r"markers \[9\] are seen in 0 of 10 frames"):
        track(times, detections, MarkerBody.single(9, 0.045), CAMERA)
    with pytest.raises(PerceptionError, match="turning = 0"):
        TrackConfig(turning=0.0)
