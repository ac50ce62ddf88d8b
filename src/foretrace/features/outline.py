"""The convex hull of an object as a polygon, finer than the pixels that it was seen in."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from foretrace.errors import PredictionError
from foretrace.features.base import FeatureExtractor
from foretrace.geometry import convex_hull
from foretrace.interactions.candidates import Candidates
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE

UNIT = 0.1
"""Coordinates are divided by this to be of unit scale [m]."""
MAX_CORNERS = 24
"""Corners of a hull, at most; finer ones are simplified."""
CORNER_PENALTY = 1.6
"""A corner has to lower the sum of squared distances between outline and polygon by this [pixels^2].

Measured on prisms of 3 to 10 corners: eight hulls in ten get exactly as many corners as they have.
"""
HULL_MARGIN = 1.6
"""Points of the outline further inside the hull than this lie in a notch and do not count [pixels]."""
HEIGHT_CELLS = 32
"""Cells along a side of the coarse height map."""
FARTHEST_CORNER = 4.0
"""Lines that meet further than this from where the outline turns do not make its corner [pixels]."""

Moments = Float[np.ndarray, "*batch 6"]
"""Of points: their number and the sums of x, y, xx, xy, yy."""


class Outline(FeatureExtractor):
    """``outline``: corners of the convex hull of what the view shows, counter-clockwise; not in the paper.

    x and y of ``MAX_CORNERS`` corners in the action frame, in units of 10 cm. The first corner, repeated, fills the
    row. The hull is fitted to the mask's outline, see `fit_hull`.

    Args:
        heights: Whether a coarse height map follows the corners: means over 4 x 4 pixels, 0 beside the object, row
            by row, in units of 10 cm.
    """

    label = "outline"

    def __init__(self, heights: bool = False):
        super().__init__(heights=heights)
        self.heights = heights

    @property
    def num_features(self) -> int:
        """Two coordinates for each corner, and the heights."""
        return 2 * MAX_CORNERS + self.heights * HEIGHT_CELLS**2

    def inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch features"]:
        """The corners, and the heights.

        Raises:
            PredictionError: A mask is empty.
        """
        rows = np.empty((len(batch), MAX_CORNERS, 2))
        for row, mask, id in zip(rows, batch.mask, batch.ids, strict=True):
            if not mask.any():
                raise PredictionError(
                    f"the mask of interaction {id} is empty and has no outline: leave it out or see that the "
                    "camera sees the object"
                )
            hull = fit_hull(mask)
            row[:] = hull[0]
            row[: len(hull)] = hull
        corners = torch.from_numpy(rows / UNIT).float().flatten(1)
        if not self.heights:
            return corners
        side = batch.height.shape[1] // HEIGHT_CELLS
        rows = batch.height.reshape(len(batch), HEIGHT_CELLS, side, -1).mean(axis=2)
        cells = rows.reshape(len(batch), HEIGHT_CELLS, HEIGHT_CELLS, side).mean(axis=3)
        return torch.cat([corners, torch.from_numpy(cells / UNIT).float().flatten(1)], dim=1)

    def candidate_inputs(self, candidates: Candidates) -> Float[Tensor, "batch features"]:
        """The same for several actions on one object, whose outline is fitted once and moved into each frame."""
        seen = self.inputs(InteractionBatch.from_views([candidates.view]))
        axes, origins = (torch.from_numpy(a).to(seen) for a in (candidates.axes, candidates.contacts))
        corners = seen[:, : 2 * MAX_CORNERS].unflatten(1, (-1, 2)) - origins[:, None] / UNIT
        moved = (corners @ axes.mT).flatten(1)
        if not self.heights:
            return moved
        cells = seen[:, 2 * MAX_CORNERS :].unflatten(1, (1, HEIGHT_CELLS, HEIGHT_CELLS))
        heights = _moved_maps(cells.expand(len(axes), -1, -1, -1), axes, origins)
        return torch.cat([moved, heights.flatten(1)], dim=1)

    def measure(self, inputs: Float[Tensor, "batch features"]) -> dict[str, Float[np.ndarray, " batch"]]:
        """The number of corners."""
        return {"corners": count_corners(inputs).cpu().numpy().astype(float)}

    def forward(self, inputs: Float[Tensor, "batch features"]) -> Float[Tensor, "batch features"]:
        """Hand them on."""
        return inputs


def count_corners(features: Float[Tensor, "batch features"]) -> Int[Tensor, " batch"]:
    """Number of corners of the hulls in ``outline`` features."""
    corners = features[:, : 2 * MAX_CORNERS].unflatten(1, (-1, 2))
    return 1 + (corners[:, 1:] != corners[:, :1]).any(dim=2).sum(dim=1)


def _moved_maps(
    maps: Float[Tensor, "n 1 rows columns"], axes: Float[Tensor, "n 2 2"], origins: Float[Tensor, "n 2"]
) -> Float[Tensor, "n rows columns"]:
    """Maps over a whole view as seen from other frames, of which the axes and origins in the view's are given [m]."""
    # Lengths in units of half a view, positions from its middle; below, columns come first.
    contact = (2 * maps.new_tensor(CONTACT_PIXEL) + 1) / VIEW_SIZE - 1
    origins = contact - contact @ axes - origins / (VIEW_SIZE * METRES_PER_PIXEL / 2)
    unmoved = F.affine_grid(torch.eye(2, 3)[None].to(maps), [1, *maps.shape[1:]], align_corners=False)
    # All maps' places come from one product, pixels last: in long rows.
    places = axes.mT.flip(1, 2) @ unmoved.flatten(0, 2).T + origins.flip(1)[..., None]
    places = places.unflatten(2, maps.shape[2:]).permute(0, 2, 3, 1)
    return F.grid_sample(maps, places, align_corners=False)[:, 0]


def fit_hull(mask: Bool[np.ndarray, "128 128"]) -> Float[np.ndarray, "n 2"]:
    """Corners of the largest object's convex hull, counter-clockwise in the action frame [m].

    The middles of the pixel sides around the object are cut into runs, and each run gets its line of least squared
    distance. Where to cut is chosen among the corners of the pixels' own hull, by dynamic programming, such that
    the squared distances and a penalty for each cut sum up to the least. Neighbouring lines meet in the corners.
    A line fitted to many pixels is far finer than one of them.

    Args:
        mask: A view's mask, not empty.
    """
    points, nodes = _around(_largest(mask))
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


def _largest(mask: np.ndarray) -> np.ndarray:
    pixels = np.ascontiguousarray(mask).view(np.uint8)
    outlines, _ = cv2.findContours(pixels, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    if len(outlines) == 1:  # one object without holes, as nearly always: labels would take longer to find
        return mask
    _, labels, stats, _ = cv2.connectedComponentsWithStats(pixels, connectivity=8)
    return labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))


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
