"""Synthetic interactions for tests: plausible, quick to make, and without a physics engine.

Each object is a random polygon turned rigidly about the closed-form support edge: there is something to learn.
"""

import numpy as np

from foretrace.interactions.dataset import InteractionBatch

HEIGHT = 0.02
SAMPLE_PERIOD = 0.05
METRES_PER_PIXEL = 0.0032
VIEW_SIZE = 128
ORIGIN_ROW = 96.0
ORIGIN_COLUMN = 64.0


def fake_polygon(rng: np.random.Generator, num_corners: int) -> np.ndarray:
    """(n, 2) corners on a circle of 10 cm, counter-clockwise, the centre strictly inside."""
    while True:
        angles = np.sort(rng.uniform(0, 2 * np.pi, num_corners))
        gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
        if gaps.min() > 0.2 and gaps.max() < 0.9 * np.pi:
            return 0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def fake_placement(corners: np.ndarray, edge: int, fraction: float) -> np.ndarray:
    """(4, 4) object -> action frame for a contact at ``fraction`` of ``edge``, x along the inward normal."""
    start, end = corners[edge], corners[(edge + 1) % len(corners)]
    contact = start + fraction * (end - start)
    along = (end - start) / np.linalg.norm(end - start)
    x_axis = np.array([-along[1], along[0]])  # inward: the corners run counter-clockwise
    transform = np.eye(4)
    transform[:2, :2] = np.stack([x_axis, [-x_axis[1], x_axis[0]]])
    transform[:2, 3] = -transform[:2, :2] @ contact
    return transform


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def centroid(corners: np.ndarray) -> np.ndarray:
    """(2,) centroid of a convex polygon."""
    following = np.roll(corners, -1, axis=0)
    cross = _cross(corners, following)
    return ((corners + following) * cross[:, None]).sum(axis=0) / (3 * cross.sum())


def support_corners(corners: np.ndarray) -> tuple[int, int]:
    """The edge of a convex outline hit by the ray from the origin (the contact) through the centroid."""
    normal = np.array([-centroid(corners)[1], centroid(corners)[0]])
    side = corners @ normal
    beyond = corners @ centroid(corners) > 0
    n = len(corners)
    for i in range(n):
        j = (i + 1) % n
        hit = (side[i] * corners[j] - side[j] * corners[i]) / (side[i] - side[j] + 1e-12)
        if side[i] * side[j] <= 0 and (beyond[i] or beyond[j]) and hit @ centroid(corners) > 1e-3:
            return (i, j)
    raise AssertionError("the ray through the centroid left no edge")


def axis_rotation(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """(time, 3, 3) rotations about a unit axis."""
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    a = angles[:, None, None]
    return np.eye(3) + np.sin(a) * skew + (1 - np.cos(a)) * skew @ skew


def axis_quaternion(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """(time, 4) unit quaternions w, x, y, z of rotations about a unit axis."""
    return np.concatenate([np.cos(angles / 2)[:, None], np.sin(angles / 2)[:, None] * axis], axis=1)


def _quaternion_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    w, v = a[:, :1], a[:, 1:]
    return np.concatenate(
        [w * b[0] - (v @ b[1:])[:, None], w * b[1:] + b[0] * v + np.cross(v, b[1:])], axis=1
    )


def fake_motion(
    placement: np.ndarray, corners_in_action: np.ndarray, num_samples: int
) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Centre of mass (time, 3), pose (time, 7), support corners: 40 degrees about the support edge."""
    i, j = support_corners(corners_in_action)
    pivot = np.append(corners_in_action[i], 0.0)
    axis = np.append(corners_in_action[j] - corners_in_action[i], 0.0)
    axis /= np.linalg.norm(axis)
    angles = np.radians(40) * np.clip(np.linspace(-0.2, 1.1, num_samples), 0, 1)
    rotations = axis_rotation(axis, angles)
    centre = np.append(centroid(corners_in_action), HEIGHT / 2)
    com = pivot + np.einsum("tij,j->ti", rotations, centre - pivot)
    position = pivot + np.einsum("tij,j->ti", rotations, placement[:3, 3] - pivot)
    yaw = np.arctan2(placement[1, 0], placement[0, 0])
    rest = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    quaternion = _quaternion_product(axis_quaternion(axis, angles), rest)
    return com, np.concatenate([position, quaternion], axis=1), (i, j)


def fake_mask(corners_in_action: np.ndarray) -> np.ndarray:
    """(128, 128) mask of a convex outline, forward up and left to the left."""
    rows, columns = np.mgrid[:VIEW_SIZE, :VIEW_SIZE]
    points = np.stack([ORIGIN_ROW - rows - 0.5, ORIGIN_COLUMN - columns - 0.5], axis=-1) * METRES_PER_PIXEL
    mask = np.ones((VIEW_SIZE, VIEW_SIZE), dtype=bool)
    for a, b in zip(corners_in_action, np.roll(corners_in_action, -1, axis=0), strict=True):
        mask &= _cross(b - a, points - a) >= 0
    return mask


def fake_batch(rng: np.random.Generator, n: int, num_samples: int = 60) -> InteractionBatch:
    """A batch of ``n`` levered interactions; every tenth has slipped, every tenth is ten samples shorter."""
    corners = np.full((n, 10, 2), np.nan)
    com = np.full((n, num_samples, 3), np.nan)
    pose = np.full((n, num_samples, 7), np.nan)
    length = np.full(n, num_samples)
    slip_index = length.copy()
    outcome = np.full(n, "levered", dtype="<U8")
    mask = np.zeros((n, VIEW_SIZE, VIEW_SIZE), dtype=bool)
    support = np.zeros((n, 2, 2))
    num_corners = 3 + np.arange(n) % 8
    for k in range(n):
        outline = fake_polygon(rng, int(num_corners[k]))
        placement = fake_placement(outline, int(rng.integers(len(outline))), rng.uniform(0.2, 0.8))
        in_action = outline @ placement[:2, :2].T + placement[:2, 3]
        length[k] -= 10 if k % 10 == 9 else 0
        com[k], pose[k], (i, j) = fake_motion(placement, in_action, num_samples)
        com[k, length[k] :], pose[k, length[k] :] = np.nan, np.nan
        slip_index[k] = length[k]
        if k % 10 == 4:
            outcome[k], slip_index[k] = "slipped", num_samples // 2
        corners[k, : len(outline)] = in_action
        mask[k] = fake_mask(in_action)
        support[k] = in_action[[i, j]]
    return InteractionBatch(
        ids=np.arange(n),
        mask=mask,
        height=np.where(mask, np.float32(HEIGHT), np.float32(0)),
        corners=corners,
        num_corners=num_corners,
        object_ids=np.arange(n) // 2,
        times=SAMPLE_PERIOD * np.arange(num_samples),
        com=com,
        pose=pose,
        length=length,
        slip_index=slip_index,
        support_points=support,
        outcome=outcome,
        density=np.full(n, 500.0),
        friction=np.full(n, 0.6),
        tool_friction=np.full(n, 0.6),
    )
