import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from foretrace import geometry

SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])
L_SHAPE = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]])

seeds = st.integers(0, 2**32 - 1)


def random_rotations(seed: int, count: int = 8) -> np.ndarray:
    return Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix()


def random_poses(seed: int, count: int = 8) -> np.ndarray:
    rng = np.random.default_rng(seed)
    quaternions = geometry.matrix_to_quaternion(random_rotations(seed, count))
    return np.concatenate([rng.normal(size=(count, 3)), quaternions], axis=1)


def test_area_and_centroid_of_known_polygons():
    assert geometry.polygon_area(SQUARE) == pytest.approx(2.0)
    assert geometry.polygon_area(SQUARE[::-1]) == pytest.approx(-2.0)
    np.testing.assert_allclose(geometry.polygon_centroid(SQUARE), [1.0, 0.5])
    np.testing.assert_allclose(geometry.polygon_centroid(SQUARE[::-1]), [1.0, 0.5])
    # Two rectangles: 3 x 1 around (1.5, 0.5) and 1 x 2 around (0.5, 2).
    np.testing.assert_allclose(geometry.polygon_centroid(L_SHAPE), [(4.5 + 1.0) / 5, (1.5 + 4.0) / 5])


def test_centroid_keeps_its_digits_far_from_the_origin():
    far = SQUARE * 1e-3 + 1e5
    np.testing.assert_allclose(geometry.polygon_centroid(far) - 1e5, [1e-3, 0.5e-3], atol=1e-10)


def test_convexity():
    assert geometry.is_convex(SQUARE)
    assert not geometry.is_convex(L_SHAPE)
    with_straight_corner = np.insert(SQUARE, 1, [1.0, 0.0], axis=0)
    assert geometry.is_convex(with_straight_corner)


@given(arrays(float, (12, 2), elements=st.floats(-1, 1).map(lambda x: round(x, 3))))
def test_convex_hull_holds_all_points_and_is_convex(points):
    hull = geometry.convex_hull(points)
    if len(hull) < 3:
        return
    assert geometry.polygon_area(hull) > 0
    assert geometry.is_convex(hull)
    normals = geometry.inward_normals(hull)
    depth = ((points[:, None] - hull[None]) * normals[None]).sum(axis=-1)
    assert depth.min() > -1e-12


def test_convex_hull_leaves_out_collinear_points():
    points = np.concatenate([SQUARE, [[1.0, 0.0], [1.0, 0.5]]])
    assert len(geometry.convex_hull(points)) == 4


def test_clip_polygon():
    half = geometry.clip_polygon(SQUARE, np.array([1.0, 0.0]), 0.5)
    assert geometry.polygon_area(half) == pytest.approx(1.5)
    assert len(geometry.clip_polygon(SQUARE, np.array([1.0, 0.0]), 3.0)) == 0
    np.testing.assert_array_equal(geometry.clip_polygon(SQUARE, np.array([1.0, 0.0]), -1.0), SQUARE)


def test_mask_outline_measures_whole_pixels():
    mask = np.zeros((20, 30), dtype=bool)
    mask[4:14, 7:17] = True
    outline = geometry.mask_outline(mask)
    np.testing.assert_allclose(outline.min(axis=0), [3.5, 6.5])
    np.testing.assert_allclose(outline.max(axis=0), [13.5, 16.5])
    assert len(outline) == 40
    # Each corner of the square loses the triangle between two middles of pixel sides.
    assert abs(geometry.polygon_area(outline)) == pytest.approx(100 - 4 * 0.125)


def test_mask_outline_ignores_holes_and_joins_diagonal_pixels():
    ring = np.ones((5, 5), dtype=bool)
    ring[2, 2] = False
    np.testing.assert_array_equal(
        geometry.mask_outline(ring), geometry.mask_outline(np.ones((5, 5), dtype=bool))
    )
    assert len(geometry.mask_outline(np.eye(4, dtype=bool))) == 16
    assert geometry.mask_outline(np.zeros((3, 3), dtype=bool)).shape == (0, 2)


def test_mask_outline_runs_clockwise_in_the_picture():
    outline = geometry.mask_outline(np.ones((4, 6), dtype=bool))
    x_right_y_up = outline[:, ::-1] * [1.0, -1.0]
    assert geometry.polygon_area(x_right_y_up) < 0


@given(seeds)
def test_quaternions_agree_with_scipy_and_return(seed):
    rotations = random_rotations(seed)
    quaternions = geometry.matrix_to_quaternion(rotations)
    assert (quaternions[:, 0] >= 0).all()
    expected = Rotation.from_matrix(rotations).as_quat(scalar_first=True)
    expected *= np.where(expected[:, :1] < 0, -1, 1)
    np.testing.assert_allclose(quaternions, expected, atol=1e-12)
    np.testing.assert_allclose(geometry.quaternion_to_matrix(quaternions), rotations, atol=1e-12)
    np.testing.assert_allclose(geometry.quaternion_to_matrix(3.0 * quaternions), rotations, atol=1e-12)


def test_half_turns_have_a_quaternion():
    half_turns = np.array([np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])
    back = geometry.quaternion_to_matrix(geometry.matrix_to_quaternion(half_turns))
    np.testing.assert_allclose(back, half_turns, atol=1e-15)


@given(seeds)
def test_poses_and_transforms(seed):
    poses = random_poses(seed)
    transforms = geometry.pose_to_matrix(poses)
    np.testing.assert_allclose(geometry.matrix_to_pose(transforms), poses, atol=1e-12)
    unit = geometry.invert_transform(transforms) @ transforms
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(4), unit.shape), atol=1e-12)
    points = np.random.default_rng(seed).normal(size=(5, 3))
    moved = geometry.transform_points(transforms, points)
    assert moved.shape == (8, 5, 3)
    back = geometry.transform_points(geometry.invert_transform(transforms), moved)
    np.testing.assert_allclose(back, np.broadcast_to(points, back.shape), atol=1e-12)


def test_transform_points_of_a_single_transform():
    transform = geometry.pose_to_matrix(np.array([1.0, 2.0, 3.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]))
    np.testing.assert_allclose(
        geometry.transform_points(transform, np.array([[1.0, 0.0, 0.0]])), [[1.0, 3.0, 3.0]]
    )


@given(seeds)
def test_rotation_6d_round_trip_and_projection(seed):
    rotations = random_rotations(seed)
    columns = geometry.rotation_6d(rotations)
    np.testing.assert_allclose(columns[:, :3], rotations[:, :, 0])
    np.testing.assert_allclose(geometry.rotation_from_6d(columns), rotations, atol=1e-12)
    noisy = geometry.rotation_from_6d(columns + 0.1 * np.random.default_rng(seed).normal(size=columns.shape))
    unit = noisy @ np.swapaxes(noisy, -1, -2)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(3), unit.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(noisy), 1.0)


@given(seeds, st.floats(0.0, np.pi))
def test_rotation_angle_is_the_turn(seed, angle):
    start = random_rotations(seed, 1)[0]
    axis = np.random.default_rng(seed).normal(size=3)
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    assert float(geometry.rotation_angle(start, start @ turn)) == pytest.approx(angle, abs=1e-7)


def test_small_rotation_angles_keep_their_digits():
    turn = Rotation.from_rotvec([0.0, 1e-9, 0.0]).as_matrix()
    assert float(geometry.rotation_angle(np.eye(3), turn)) == pytest.approx(1e-9, rel=1e-6)


def test_tilt():
    rotations = Rotation.from_euler("zx", [[0.3, 0.0], [1.0, 0.7], [2.0, 2.5]]).as_matrix()
    np.testing.assert_allclose(geometry.tilt(rotations), [0.0, 0.7, 2.5], atol=1e-12)


@settings(max_examples=20)
@given(seeds)
def test_continuous_quaternions_never_jump(seed):
    rng = np.random.default_rng(seed)
    path = Rotation.from_rotvec(np.linspace(0, 4 * np.pi, 100)[:, None] * [0.0, 0.0, 1.0])
    quaternions = geometry.matrix_to_quaternion(path.as_matrix()) * rng.choice([-1.0, 1.0], size=(100, 1))
    smooth = geometry.continuous_quaternions(quaternions)
    assert np.linalg.norm(np.diff(smooth, axis=0), axis=1).max() < 0.1
    np.testing.assert_allclose(np.abs((smooth * quaternions).sum(axis=1)), 1.0)
    np.testing.assert_array_equal(smooth[0], quaternions[0])


def test_support_edge_of_a_square():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    centre = np.array([0.5, 0.5])
    assert geometry.support_edge(square, np.array([0.5, 0.0]), centre) == (2, 3)
    assert geometry.support_edge(square, np.array([0.0, 0.3]), centre) == (1, 2)
    assert geometry.support_edge(square, np.array([1.0, 0.6]), centre) == (0, 3)


@given(st.integers(0, 10_000), st.integers(3, 10))
def test_support_edge_is_crossed_by_the_ray_and_survives_mirroring(seed, num_corners):
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * (np.arange(num_corners) + rng.uniform(0.1, 0.9, num_corners)) / num_corners
    corners = np.column_stack([np.cos(angles), np.sin(angles)])
    com = corners.mean(axis=0)
    edge = rng.integers(num_corners)
    lift = corners[edge] + rng.uniform(0.1, 0.9) * (corners[(edge + 1) % num_corners] - corners[edge])
    i, j = geometry.support_edge(corners, lift, com)
    # Where the line through lift point and centre of mass meets the edge, behind the centre of mass.
    t, u = np.linalg.solve(np.column_stack([com - lift, corners[i] - corners[j]]), corners[i] - lift)
    assert t > 1
    assert -1e-9 <= u <= 1 + 1e-9
    mirrored = geometry.support_edge(corners * [1, -1], lift * [1, -1], com * [1, -1])
    assert mirrored == (i, j)
