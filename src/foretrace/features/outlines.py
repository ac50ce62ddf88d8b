"""What the eye sees of an object's shape: outlines and corners from the view's mask."""

import cv2
import numpy as np
from jaxtyping import Float

from foretrace.errors import PredictionError
from foretrace.geometry import convex_hull
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.topdown import METRES_PER_PIXEL, TopDownView

CORNER_TOLERANCE = 1.25 * METRES_PER_PIXEL
"""A hull's corners are left out as long as the outline moves by less than this [m].

With one and a quarter pixels, the paper's prisms keep about as many corners as they have, on average 0.2 more.
"""


def mask_contour(batch: InteractionBatch, row: int) -> Float[np.ndarray, "k 2"]:
    """Outline of one interaction's mask, counter-clockwise in the action frame [m].

    Raises:
        PredictionError: The mask is empty.
    """
    if not batch.mask[row].any():
        raise PredictionError(
            f"the mask of interaction {batch.ids[row]} is empty and has no outline: leave it out or see that "
            "the camera sees the object"
        )
    return TopDownView(batch.mask[row], batch.height[row]).contour()


def approximate_corners(contour: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "n 2"]:
    """Corners of a polygon near the convex hull of an outline, counter-clockwise [m].

    The hull of a mask has a corner at every step of its pixels; those within ``CORNER_TOLERANCE`` of the sides
    of a coarser polygon are left out.
    """
    hull = cv2.convexHull(contour.astype(np.float32)[:, None])
    coarse = cv2.approxPolyDP(hull, CORNER_TOLERANCE, closed=True)
    return convex_hull((coarse if len(coarse) >= 3 else hull)[:, 0].astype(float))
