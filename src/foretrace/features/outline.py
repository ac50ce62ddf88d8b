"""The convex hull of an object as features."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from foretrace.features.base import FeatureExtractor
from foretrace.interactions.batch import Candidates, InteractionBatch
from foretrace.interactions.hull import HEIGHT_CELLS, MAX_CORNERS, UNIT, coarse_heights, hull_rows
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE


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
        corners = torch.from_numpy(hull_rows(batch) / UNIT).float().flatten(1)
        if not self.heights:
            return corners
        cells = coarse_heights(batch.height)
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


def pixel_error(corners: Float[Tensor, "batch corners 2"]) -> Float[Tensor, " batch"]:
    """Expected error (root mean square) of the centres of outlines that are known from pixels [m].

    A side that is parallel to the pixels' sides may lie anywhere within one of them, and moves the centre of the area
    by its length times its distance from there, over the area. A slanted one crosses many pixels, which tell where it
    is.

    Args:
        corners: Corners of convex outlines in the action frame [m], counter-clockwise; the first one fills the row.
    """
    other = corners.roll(-1, dims=1)
    twice = corners[..., 0] * other[..., 1] - corners[..., 1] * other[..., 0]
    area = (twice.sum(dim=1) / 2).clamp(min=1e-6)
    middle = (corners + other) / 2
    # Twice the areas of triangles with the origin, and their centres.
    centre = (twice[..., None] * middle).sum(dim=1) / (3 * area[:, None])
    side = other - corners
    across = side.abs().amin(dim=2) / METRES_PER_PIXEL
    unsure = METRES_PER_PIXEL / 12**0.5 * (1 - across).clamp(min=0) ** 1.5
    # The contact point lies on the levered side, and tells where that is.
    levered = (corners[..., 0].abs() < METRES_PER_PIXEL) & (other[..., 0].abs() < METRES_PER_PIXEL)
    unsure = unsure.masked_fill(levered, 0.0)
    moved = unsure * side.norm(dim=2) * (middle - centre[:, None]).norm(dim=2) / area[:, None]
    return moved.square().sum(dim=1).sqrt()


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
