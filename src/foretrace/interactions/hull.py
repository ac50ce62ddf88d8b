"""Outline, corners and convex hull of an object from the mask of its view."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from foretrace.errors import PredictionError
from foretrace.geometry import convex_hull
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, largest_object, outline_of

CORNER_TOLERANCE = 1.25 * METRES_PER_PIXEL
"""A hull's corners are left out as long as the outline moves by less than this [m].

With one and a quarter pixels, the paper's prisms keep about as many corners as they have, on average 0.2 more.
"""
MAX_CORNERS = 24
"""Corners of a hull, at most; finer ones are simplified."""
CORNER_PENALTY = 1.6
"""A corner has to lower the sum of squared distances between outline and polygon by this [pixels^2].

Measured on prisms of 3 to 10 corners: eight hulls in ten get exactly as many corners as they have.
"""
HULL_MARGIN = 1.6
"""Points of the outline further inside the hull than this lie in a notch and do not count [pixels]."""
FARTHEST_CORNER = 4.0
"""Lines that meet further than this from where the outline turns do not make its corner [pixels]."""

UNIT = 0.1
"""Lengths in features are divided by this to be of unit scale [m]."""
HEIGHT_CELLS = 32
"""Cells along a side of a coarse height map."""

Moments = Float[np.ndarray, "*batch 6"]
"""Of points: their number and the sums of x, y, xx, xy, yy."""


def mask_of(batch: InteractionBatch, row: int) -> Bool[np.ndarray, "128 128"]:
    """The mask of one interaction.

    Raises:
        PredictionError: It is empty.
    """
    if not batch.mask[row].any():
        raise PredictionError(
            f"the mask of interaction {batch.ids[row]} is empty and has no outline: leave it out or see that "
            "the camera sees the object"
        )
    return batch.mask[row]


def mask_contour(batch: InteractionBatch, row: int) -> Float[np.ndarray, "k 2"]:
    """Outline of one interaction's mask, counter-clockwise in the action frame [m].

    Raises:
        PredictionError: The mask is empty.
    """
    return outline_of(mask_of(batch, row))


def approximate_corners(contour: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "n 2"]:
    """Corners of a polygon near the convex hull of an outline, counter-clockwise [m].

    The hull of a mask has a corner at every step of its pixels; those within ``CORNER_TOLERANCE`` of the sides
    of a coarser polygon are left out.
    """
    hull = cv2.convexHull(contour.astype(np.float32)[:, None])
    coarse = cv2.approxPolyDP(hull, CORNER_TOLERANCE, closed=True)
    return convex_hull((coarse if len(coarse) >= 3 else hull)[:, 0].astype(float))


def fit_hull(mask: Bool[np.ndarray, "128 128"]) -> Float[np.ndarray, "n 2"]:
    """Corners of the largest object's convex hull, counter-clockwise in the action frame [m].

    The middles of the pixel sides around the object are cut into runs, and each run gets its line of least squared
    distance. Where to cut is chosen among the corners of the pixels' own hull, by dynamic programming, such that
    the squared distances and a penalty for each cut sum up to the least. Neighbouring lines meet in the corners.
    A line fitted to many pixels is far finer than one of them.

    Args:
        mask: A view's mask, not empty.
    """
    points, nodes = _around(largest_object(mask))
    centre = points.mean(axis=0)  # sums of squares about it lose no digits
    points -= centre
    near = _near_hull(points, nodes)
    x, y = points.T
    terms = np.stack([np.ones(len(points)), x, y, x * x, x * y, y * y], axis=1) * near[:, None]
    sums = np.concatenate([np.zeros((1, 6)), terms.cumsum(axis=0)])
    distances = _squared_distance(sums[nodes + 1] - sums[nodes][:, None])  # (from node, to node)
    penalty = CORNER_PENALTY
    while len(cuts := nodes[_cheapest_cuts(distances + penalty)]) - 1 > MAX_CORNERS:
        penalty *= 2
    if len(cuts) < 4:  # a sliver: no two lines of it meet
        return _metres(points[nodes[:-1]][:MAX_CORNERS] + centre)
    first, last = cuts[:-1], cuts[1:]
    # The outermost points of a run belong to its neighbour as much as to itself.
    inner = np.minimum(1, (last - first) // 4)
    middle, along = _lines(sums[last + 1 - inner] - sums[first + inner])
    corners = _meeting_points(np.roll(middle, 1, axis=0), np.roll(along, 1, axis=0), middle, along)
    strayed = np.linalg.norm(corners - points[first], axis=1) > FARTHEST_CORNER
    return _metres(np.where(strayed[:, None], points[first], corners) + centre)


def hull_rows(batch: InteractionBatch) -> Float[np.ndarray, "batch 24 2"]:
    """Corners of each object's convex hull as of `fit_hull` [m]; the first one fills its row.

    Raises:
        PredictionError: A mask is empty.
    """
    rows = np.empty((len(batch), MAX_CORNERS, 2))
    for number, row in enumerate(rows):
        hull = fit_hull(mask_of(batch, number))
        row[:] = hull[0]
        row[: len(hull)] = hull
    return rows


def coarse_heights(
    height: Float[np.ndarray, "batch 128 128"],
) -> Float[np.ndarray, "batch 32 32"]:
    """Mean heights over 4 x 4 pixels [m], 0 beside the object."""
    side = height.shape[1] // HEIGHT_CELLS
    rows = height.reshape(len(height), HEIGHT_CELLS, side, -1).mean(axis=2)
    return rows.reshape(len(height), HEIGHT_CELLS, HEIGHT_CELLS, side).mean(axis=3)


def _metres(corners: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "k 2"]:
    return convex_hull(corners * METRES_PER_PIXEL)


def _around(mask: np.ndarray) -> tuple[Float[np.ndarray, "points 2"], Int[np.ndarray, " nodes"]]:
    """Outline and hull of an object.

    Returns:
        Middles of the pixel sides that are seen from ahead, behind, left or right, in pixels from the contact point,
        counter-clockwise, the first one again at the end; which of them are corners of their convex hull, the first
        and the last among them.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    low, high = mask[rows], mask[:, columns]
    sides = [
        np.stack([rows, low.argmax(axis=1) - 0.5], axis=1),
        np.stack([rows, mask.shape[1] - 0.5 - low[:, ::-1].argmax(axis=1)], axis=1),
        np.stack([high.argmax(axis=0) - 0.5, columns], axis=1),
        np.stack([mask.shape[0] - 0.5 - high[::-1].argmax(axis=0), columns], axis=1),
    ]
    points = CONTACT_PIXEL - np.concatenate(sides)
    from_inside = points - points.mean(axis=0)
    points = points[np.argsort(np.arctan2(from_inside[:, 1], from_inside[:, 0]), kind="stable")]
    hull = cv2.convexHull(points.astype(np.float32)[:, None], returnPoints=False)
    hull = np.sort(np.ravel(hull).astype(int))
    # Cut first where the outline surely turns: at the point farthest from the middle.
    start = hull[np.argmax(((points[hull] - points.mean(axis=0)) ** 2).sum(axis=1))]
    points = np.roll(points, -start, axis=0)
    nodes = np.append(np.sort((hull - start) % len(points)), len(points))
    return np.concatenate([points, points[:1]]), nodes


def _near_hull(points: np.ndarray, nodes: np.ndarray) -> Bool[np.ndarray, " points"]:
    """Which points are no further than ``HULL_MARGIN`` from the chord of the hull that they lie below."""
    chord = np.clip(np.searchsorted(nodes, np.arange(len(points)), side="right") - 1, 0, len(nodes) - 2)
    start = points[nodes[chord]]
    along, offset = points[nodes[chord + 1]] - start, points - start
    depth = along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0]
    return np.abs(depth) <= HULL_MARGIN * np.linalg.norm(along, axis=1)


def _deviations(moments: Moments) -> tuple[np.ndarray, ...]:
    """Mean x and y; sums of squared deviations xx, xy, yy."""
    n, x, y, xx, xy, yy = np.moveaxis(moments, -1, 0)
    n = np.maximum(n, 1.0)
    return x / n, y / n, xx - x * x / n, xy - x * y / n, yy - y * y / n


def _squared_distance(moments: Moments) -> Float[np.ndarray, "*batch"]:
    """Sum of squared distances of points from their line: their smaller eigenvalue."""
    _, _, xx, xy, yy = _deviations(moments)
    return np.maximum((xx + yy) / 2 - np.hypot((xx - yy) / 2, xy), 0.0)


def _lines(moments: Moments) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch 2"]]:
    """A point and a unit vector of the lines of least squared distance."""
    x, y, xx, xy, yy = _deviations(moments)
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return np.stack([x, y], axis=-1), np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _cheapest_cuts(costs: Float[np.ndarray, "nodes nodes"]) -> Int[np.ndarray, " cuts"]:
    """The nodes, first and last among them, on the cheapest way from the first to the last."""
    total, before = np.zeros(len(costs)), np.zeros(len(costs), dtype=int)
    for node in range(1, len(costs)):
        ways = total[:node] + costs[:node, node]
        before[node] = ways.argmin()
        total[node] = ways[before[node]]
    cuts = [len(costs) - 1]
    while cuts[-1]:
        cuts.append(before[cuts[-1]])
    return np.array(cuts[::-1])


def _meeting_points(
    a: Float[np.ndarray, "n 2"],
    along_a: Float[np.ndarray, "n 2"],
    b: Float[np.ndarray, "n 2"],
    along_b: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n 2"]:
    """Where lines through a and b cross; far away if they are parallel."""
    normal = np.stack([-along_b[:, 1], along_b[:, 0]], axis=1)
    slope = (along_a * normal).sum(axis=1)
    slope = np.where(np.abs(slope) < 1e-9, 1e-9, slope)
    return a + (((b - a) * normal).sum(axis=1) / slope)[:, None] * along_a
