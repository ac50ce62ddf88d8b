"""Polygons, mask outlines and rigid transforms, in numpy alone.

A pose is a row of seven numbers ``x y z qw qx qy qz``; a transform is a 4 x 4 matrix. Polygons are (n, 2)
corners without a repeated closing corner. Lengths are in metres and angles in radians unless stated.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from foretrace.errors import ForetraceError, shown, wrong_type

Numbers = np.ndarray | Sequence[Any]
"""What users may give for an array: an array, or lists or tuples of numbers, nested."""


def finite_array(
    name: str, values: Any, shape: Sequence[int | None], error: type[ForetraceError]
) -> Float[np.ndarray, "..."]:
    """Finite numbers in a shape, as an array of their own.

    Args:
        name: Name of the values in messages.
        values: What was given.
        shape: The shape; None in it stands for any length.
        error: The class to raise.

    Raises:
        ForetraceError: Of the given class: the values are no numbers, have another shape, or are not finite.
    """
    wanted = f"numbers in the shape {tuple('n' if n is None else n for n in shape)}" if shape else "a number"
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise wrong_type(error)(f"{name} must be {wanted}, not {shown(values)}") from None
    if np.asarray(values).dtype.kind not in "biuf":
        raise wrong_type(error)(f"{name} must be {wanted}, not {shown(values)}")
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        raise error(f"{name} must be {wanted}, not in the shape {array.shape}")
    if not (finite := np.isfinite(array)).all():
        bad = tuple(np.argwhere(~finite)[0].tolist())
        place = f" at {bad}" if bad else ""
        raise error(
            f"{name} holds a value that is not finite, {array[bad]}{place}: leave it out or correct it"
        )
    return array


def cross(
    a: Float[np.ndarray, "*#batch 2"], b: Float[np.ndarray, "*#batch 2"]
) -> Float[np.ndarray, "*#batch"]:
    """Signed area of the parallelogram that two plane vectors span."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


# --- polygons ---------------------------------------------------------------------------------------------


def polygon_area(corners: Float[np.ndarray, "n 2"]) -> float:
    """Signed area [m^2], positive for counter-clockwise corners."""
    local = corners - corners[0]
    return 0.5 * float(cross(local, np.roll(local, -1, axis=0)).sum())


def polygon_centroid(corners: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """Centroid of the enclosed area [m]; the area must not vanish."""
    # Relative to a corner, so that an object far from the origin loses no digits.
    local = corners - corners[0]
    following = np.roll(local, -1, axis=0)
    weights = cross(local, following)
    return corners[0] + ((local + following) * weights[:, None]).sum(axis=0) / (3 * weights.sum())


def convex_hull(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "k 2"]:
    """Corners of the convex hull, counter-clockwise, collinear points left out (monotone chain)."""
    ordered = sorted(set(map(tuple, points.tolist())))
    if len(ordered) < 3:
        return np.array(ordered).reshape(-1, 2)

    # Plain numbers: arrays of two would take twenty times as long.
    def chain(sequence: list[tuple[float, float]]) -> list[tuple[float, float]]:
        kept: list[tuple[float, float]] = []
        for x, y in sequence:
            while len(kept) >= 2:
                (ax, ay), (bx, by) = kept[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                kept.pop()
            kept.append((x, y))
        return kept[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


def is_convex(corners: Float[np.ndarray, "n 2"]) -> bool:
    """Whether a simple counter-clockwise polygon is convex; straight corners count as convex."""
    edges = np.roll(corners, -1, axis=0) - corners
    following = np.roll(edges, -1, axis=0)
    lengths = np.linalg.norm(edges, axis=1) * np.linalg.norm(following, axis=1)
    return bool((cross(edges, following) >= -1e-9 * lengths).all())


def inward_normals(corners: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Unit normals of the edges (corner k to corner k + 1), into a counter-clockwise polygon."""
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def clip_polygon(
    corners: Float[np.ndarray, "n 2"], normal: Float[np.ndarray, "2"], offset: float
) -> Float[np.ndarray, "k 2"]:
    """The part of a convex polygon where ``normal . x >= offset``; no rows where nothing is left."""
    if len(corners) == 0:
        return corners
    depth = corners @ normal - offset
    kept: list[np.ndarray] = []
    for k in range(len(corners)):
        here, there = depth[k - 1], depth[k]
        if (here < 0) != (there < 0):
            kept.append(corners[k - 1] + (corners[k] - corners[k - 1]) * here / (here - there))
        if there >= 0:
            kept.append(corners[k])
    return np.array(kept) if len(kept) >= 3 else np.zeros((0, 2))


def mask_outline(mask: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "k 2"]:
    """Outer outline of the first object in a mask, as (row, column) with pixel centres at whole numbers.

    The outline runs through the middles of the pixel sides that part object from background, so a square of
    10 x 10 pixels measures 10 pixels across. Pixels that touch at a corner belong together; holes are not
    seen. In the picture, rows downwards, the outline runs clockwise.
    """
    if not mask.any():
        return np.zeros((0, 2))
    padded = np.pad(mask, 1)
    width = padded.shape[1]
    cells = padded.tobytes()  # by rows, whatever the mask's order; far smaller than a list
    # Vertices are named by the pixel to their lower right; headings are east, south, west, north.
    steps = (1, width, -1, -width)
    ahead_left = (-width, 0, -1, -width - 1)
    ahead_right = (0, -1, -width - 1, -width)
    start = int(np.argmax(padded))  # the first pixel, row by row: its upper side is on the outer outline
    vertex, heading = start, 0
    path: list[tuple[int, int]] = []
    while not path or (vertex, heading) != (start, 0):
        path.append((vertex, heading))
        vertex += steps[heading]
        if cells[vertex + ahead_left[heading]]:
            heading = (heading - 1) % 4
        elif not cells[vertex + ahead_right[heading]]:
            heading = (heading + 1) % 4
    vertices, headings = np.array(path).T
    middles = np.array([[0.0, 0.5], [0.5, 0.0], [0.0, -0.5], [-0.5, 0.0]])[headings]
    # From padded pixel corners to the mask's pixel centres: one pixel of padding, half a pixel to the centre.
    return np.stack(np.divmod(vertices, width), axis=1) + middles - 1.5


# --- rotations and rigid transforms -----------------------------------------------------------------------


def quaternion_to_matrix(quaternion: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrix of a quaternion ``w, x, y, z``, which is normalised first."""
    w, x, y, z = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternion ``w, x, y, z`` of a rotation matrix, with w >= 0."""
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    zy, xz, yx = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, zx, yz = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    # Four times the outer product q q^T: its row of largest diagonal is q, scaled, without cancellation.
    outer = np.stack(
        [
            np.stack([1 + xx + yy + zz, zy, xz, yx], axis=-1),
            np.stack([zy, 1 + xx - yy - zz, xy, zx], axis=-1),
            np.stack([xz, xy, 1 - xx + yy - zz, yz], axis=-1),
            np.stack([yx, zx, yz, 1 - xx - yy + zz], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    quaternion = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def pose_to_matrix(pose: Float[np.ndarray, "*batch 7"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Transform of a pose ``x y z qw qx qy qz`` [m]."""
    transform = np.zeros((*pose.shape[:-1], 4, 4))
    transform[..., :3, :3] = quaternion_to_matrix(pose[..., 3:])
    transform[..., :3, 3] = pose[..., :3]
    transform[..., 3, 3] = 1.0
    return transform


def matrix_to_pose(transform: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 7"]:
    """Pose ``x y z qw qx qy qz`` [m] of a transform, with qw >= 0."""
    return np.concatenate([transform[..., :3, 3], matrix_to_quaternion(transform[..., :3, :3])], axis=-1)


def rigid_transform(
    rotation: Float[np.ndarray, "3 3"], position: Float[np.ndarray, "3"] | Sequence[float]
) -> Float[np.ndarray, "4 4"]:
    """Transform that turns, then shifts [m]."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, position
    return transform


def planar_transform(
    position: Float[np.ndarray, "2"] | Float[np.ndarray, "3"] | Sequence[float], angle: float
) -> Float[np.ndarray, "4 4"]:
    """Transform that turns about z [rad], then shifts [m]; two coordinates shift within the plane z = 0."""
    transform = np.eye(4)
    transform[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    transform[: len(position), 3] = position
    return transform


def invert_transform(transform: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Inverse of a rigid transform: ``T_b_a`` from ``T_a_b``."""
    inverse = np.zeros_like(transform)
    rotation = np.swapaxes(transform[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ transform[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def transform_points(
    transform: Float[np.ndarray, "*batch 4 4"], points: Float[np.ndarray, "*#batch k 3"]
) -> Float[np.ndarray, "*batch k 3"]:
    """Points [m] carried through a rigid transform: ``T_a_b`` takes them from frame b to frame a."""
    return points @ np.swapaxes(transform[..., :3, :3], -1, -2) + transform[..., None, :3, 3]


def rotation_6d(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 6"]:
    """The first two columns of a rotation matrix, a continuous representation (Zhou et al., 2019)."""
    return np.concatenate([matrix[..., 0], matrix[..., 1]], axis=-1)


def rotation_from_6d(columns: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 3 3"]:
    """The rotation matrix nearest to two given columns in the sense of Gram and Schmidt."""
    first = columns[..., :3] / np.linalg.norm(columns[..., :3], axis=-1, keepdims=True)
    second = columns[..., 3:] - (first * columns[..., 3:]).sum(axis=-1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=-1)


def rotation_vector_to_quaternion(vector: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternion ``w, x, y, z`` of axis times angle [rad], with w >= 0."""
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    quaternion = np.concatenate([np.cos(half), vector / 2 * np.sinc(half / np.pi)], axis=-1)
    return np.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def continuous_rotation_vectors(
    matrices: Float[np.ndarray, "*batch time 3 3"],
) -> Float[np.ndarray, "*batch time 3"]:
    """Axis times angle [rad] of rotations over time, starting near none, without the jumps at half a turn."""
    quaternions = matrix_to_quaternion(matrices)
    axes, length = quaternions[..., 1:], np.linalg.norm(quaternions[..., 1:], axis=-1, keepdims=True)
    angles = 2 * np.arctan2(length, quaternions[..., :1])
    vectors = np.where(length > 1e-12, axes / np.maximum(length, 1e-12) * angles, 0.0)
    for k in range(1, vectors.shape[-2]):
        before, here = vectors[..., k - 1, :], vectors[..., k, :]
        angle = np.linalg.norm(here, axis=-1, keepdims=True)
        unturned = angle < 1e-9  # the axis of a whole turn is that of the sample before
        along = np.where(unturned, before, here)
        axis = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12)
        turns = np.round(((before * axis).sum(axis=-1, keepdims=True) - angle) / (2 * np.pi))
        vectors[..., k, :] = axis * (angle + 2 * np.pi * turns)
    return vectors


def rotation_angle(
    rotation_a: Float[np.ndarray, "*#batch 3 3"], rotation_b: Float[np.ndarray, "*#batch 3 3"]
) -> Float[np.ndarray, "*batch"]:
    """Geodesic distance of two rotations [rad], between 0 and pi."""
    relative = np.swapaxes(rotation_a, -1, -2) @ rotation_b
    axis = np.stack(
        [
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ],
        axis=-1,
    )
    # The arc tangent keeps its digits near 0 and pi, where the arc cosine of the trace loses half of them.
    return np.asarray(
        np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(relative, axis1=-2, axis2=-1) - 1),
    )


def wrap_angle(angle: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """The same angles between -pi and pi [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def rotate_plane(
    vectors: Float[np.ndarray, "*n 2"], angle: Float[np.ndarray, "*m"] | float
) -> Float[np.ndarray, "*k 2"]:
    """Vectors in the plane, each rotated to the left [rad]; shapes are broadcast."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def tilt(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    """Angle between the body's z axis and the world's [rad]."""
    return np.asarray(np.arctan2(np.hypot(rotation[..., 0, 2], rotation[..., 1, 2]), rotation[..., 2, 2]))


def continuous_quaternions(quaternions: Float[np.ndarray, "time 4"]) -> Float[np.ndarray, "time 4"]:
    """The same rotations with signs chosen so that no quaternion lies opposite to the one before it."""
    if len(quaternions) == 0:
        return quaternions
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=-1) < 0, -1.0, 1.0)
    return quaternions * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def support_edge(
    corners: Float[np.ndarray, "n 2"], lift: Float[np.ndarray, "2"], com: Float[np.ndarray, "2"]
) -> tuple[int, int]:
    """The two corners that a body turns about when it is lifted gently at one point.

    Statics: with a growing vertical force at the lift point, the table's reaction moves from below the centre of
    mass away from that point, until it leaves the footprint. There the body turns: about the edge of the
    footprint's convex hull that the ray from lift point through centre of mass crosses.

    Args:
        corners: Corners of the footprint [m].
        lift: Where the body is lifted [m].
        com: Its centre of mass from above, strictly inside the hull [m].

    Returns:
        Indices of the two corners, the smaller one first.
    """
    hull = convex_hull(corners)
    following = np.roll(hull, -1, axis=0)
    ray = com - lift
    # Counter-clockwise, the hull passes from the ray's right to its left where the ray leaves it.
    edge = int(np.flatnonzero((cross(ray, hull - lift) < 0) & (cross(ray, following - lift) >= 0))[0])
    ends = [int(np.linalg.norm(corners - end, axis=1).argmin()) for end in (hull[edge], following[edge])]
    return min(ends), max(ends)
