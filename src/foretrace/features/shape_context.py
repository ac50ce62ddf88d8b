"""Shape contexts about the contact point: where the outline runs, in log-polar cells (paper, section 3.2.1)."""

from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from foretrace.errors import PredictionError, TrainingError
from foretrace.features.base import FeatureExtractor
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.hull import mask_contour

NUM_POINTS = 500
"""Points sampled along an outline."""
INNER_RADIUS = 0.125
"""Inner radius of the rings, in mean distances; what lies nearer counts in the first ring."""
OUTER_RADIUS = 2.2
"""Outer radius of the rings, in mean distances; what lies farther counts in the last ring."""


def sample_contour(contour: Float[np.ndarray, "k 2"], num_points: int) -> Float[np.ndarray, "points 2"]:
    """Points at equal distances along a closed outline [m]."""
    closed = np.concatenate([contour, contour[:1]])
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(closed, axis=0), axis=1).cumsum()])
    places = (np.arange(num_points) + 0.5) / num_points * along[-1]
    return np.stack([np.interp(places, along, coordinate) for coordinate in closed.T], axis=1)


def shape_context(
    contour: Float[np.ndarray, "k 2"],
    num_rings: int,
    num_wedges: int,
    num_points: int = NUM_POINTS,
    half_plane: bool = False,
) -> Float[np.ndarray, "rings wedges"]:
    """Share of an outline's points in each cell of a log-polar grid about the contact point.

    Distances are divided by their mean, so that the size of the object does not matter. Rings grow
    geometrically from ``INNER_RADIUS`` to ``OUTER_RADIUS`` mean distances. Wedges of 360 / ``num_wedges``
    degrees begin along the levered edge, to the right of the action, and go counter-clockwise: the first half
    of them lies ahead of the edge. The mirror image of an object about the action's axis has the same matrix
    with the wedges of each half in reverse order.

    Args:
        contour: Outline in the action frame [m], closed from its last point to its first.
        num_rings: Rings.
        num_wedges: Wedges of the full circle, an even number.
        num_points: Points sampled along the outline.
        half_plane: Count only what lies ahead of the edge, as the paper's code does: ``num_wedges / 2 + 1``
            wedges, centred on -90 to 90 degrees from the action, so that the edge itself is seen.

    Returns:
        Shares that sum to 1.

    Raises:
        PredictionError: The outline is a single point, or nothing of it lies ahead of the edge.
    """
    points = sample_contour(contour, num_points)
    distance = np.hypot(points[:, 0], points[:, 1])
    if not distance.mean() > 0:
        raise PredictionError("the outline is one point, the contact point: give the outline of an object")
    with np.errstate(divide="ignore"):  # the contact point itself counts in the first ring
        depth = np.log(distance / distance.mean() / INNER_RADIUS) / np.log(OUTER_RADIUS / INNER_RADIUS)
    ring = np.clip(depth * num_rings, 0, num_rings - 1).astype(int)
    # In wedges, counter-clockwise from the right-hand end of the edge.
    turned = (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.25) * num_wedges
    columns = num_wedges
    if half_plane:
        turned, columns = turned + 0.5, num_wedges // 2 + 1
    wedge = np.floor(turned).astype(int) % num_wedges
    ahead = wedge < columns
    if not ahead.any():
        raise PredictionError("nothing of the outline lies ahead of the edge: check the action's direction")
    cell = ring[ahead] * columns + wedge[ahead]
    return np.bincount(cell, minlength=num_rings * columns).reshape(num_rings, columns) / ahead.sum()


def shape_contexts(
    batch: InteractionBatch,
    num_rings: int,
    num_wedges: int,
    num_points: int = NUM_POINTS,
    half_plane: bool = False,
) -> Float[Tensor, "batch rings wedges"]:
    """``shape_context`` of the outline of every mask.

    Raises:
        PredictionError: A mask is empty.
    """
    matrices = [
        shape_context(mask_contour(batch, row), num_rings, num_wedges, num_points, half_plane)
        for row in range(len(batch))
    ]
    columns = num_wedges // 2 + 1 if half_plane else num_wedges
    return torch.from_numpy(np.array(matrices, dtype=np.float32).reshape(len(batch), num_rings, columns))


class ShapeContext(FeatureExtractor, abstract=True):
    """The flattened shape context of the mask's outline (paper, section 3.2.1); its entries define the grid.

    Args:
        num_points: Points sampled along the outline.
        half_plane: Whether only what lies ahead of the levered edge is counted, as in the paper's code.
    """

    num_rings: ClassVar[int]
    """Rings of the grid."""
    num_wedges: ClassVar[int]
    """Wedges of the full circle."""

    def __init__(self, num_points: int = NUM_POINTS, half_plane: bool = False):
        if num_points < 1:
            raise TrainingError(f"num_points must be at least 1, not {num_points}: the paper's code has 500")
        super().__init__(num_points=num_points, half_plane=half_plane)
        self.num_points, self.half_plane = num_points, half_plane

    @property
    def num_columns(self) -> int:
        """Wedges that are counted."""
        return self.num_wedges // 2 + 1 if self.half_plane else self.num_wedges

    @property
    def num_features(self) -> int:
        """Cells of the grid."""
        return self.num_rings * self.num_columns

    def inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch rings wedges"]:
        """One histogram per mask; each sums to 1."""
        return shape_contexts(batch, self.num_rings, self.num_wedges, self.num_points, self.half_plane)

    def forward(self, inputs: Float[Tensor, "batch rings wedges"]) -> Float[Tensor, "batch features"]:
        """The flat histogram times a constant."""
        return inputs.flatten(1) * unit_scale(self.num_rings, self.num_wedges)


def unit_scale(num_rings: int, num_wedges: int) -> float:
    """The factor that brings a histogram's cells to a root mean square of about 1.

    An outline crosses each wedge about once: a sum of 1 is spread over about ``num_wedges`` of the
    ``num_rings * num_wedges`` cells.
    """
    return num_wedges * num_rings**0.5


class ShapeContext200(ShapeContext):
    """``sc-200``: 10 rings, 20 wedges."""

    label = "sc-200"
    num_rings, num_wedges = 10, 20


class ShapeContext800(ShapeContext):
    """``sc-800``: 20 rings, 40 wedges."""

    label = "sc-800"
    num_rings, num_wedges = 20, 40


class ShapeContext3200(ShapeContext):
    """``sc-3200``: 40 rings, 80 wedges."""

    label = "sc-3200"
    num_rings, num_wedges = 40, 80
