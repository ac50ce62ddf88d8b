"""Outline of an object to a fraction of a pixel: straight sides, or the level line of the blurred mask."""

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float

from foretrace.geometry import mask_outline
from foretrace.interactions.hull import fit_hull
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL

BAND = 2
"""Pixels that are compared with an outline lie no further than this from it [pixels]."""
CLEARLY = 0.15
"""A pixel contradicts an outline if its centre lies on the wrong side, and further from it than this [pixels]."""
FEW = 3
"""An outline with straight sides may contradict this many pixels."""
FRAYED = 2
"""In a noisy mask, it may contradict this many times the pixels of the level line, which follows some of the noise."""
MOST_SIDES = 11
"""An outline of more sides is taken to be curved."""
BLUR = 1.0
"""Standard deviation of the blur whose level line is the outline of a curved object [pixels]."""
ROUNDS = 3
"""Newton steps from the pixels' sides to that line."""
SIMPLIFIED = 0.0003
"""How far the polygon may leave a curved outline [m]."""


def fit_outline(mask: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "n 2"]:
    """Outline of the one object in a view's mask, counter-clockwise in the action frame [m].

    The convex polygon of `fit_hull`, if it explains the pixels with few sides; otherwise the object has dents or curves
    and its outline is the level line of the blurred mask.
    """
    straight = fit_hull(mask)
    wrong = count_contradictions(straight, mask) if 3 <= len(straight) <= MOST_SIDES else np.inf
    if wrong <= FEW:
        return straight
    curved = _level_line(mask)
    if curved is None or wrong <= FEW + FRAYED * count_contradictions(curved, mask):
        return straight
    return curved


def count_contradictions(corners: Float[np.ndarray, "n 2"], mask: Bool[np.ndarray, "rows columns"]) -> int:
    """Number of pixels whose centre lies clearly on the wrong side of an outline [m]."""
    points, inside = near_rim(mask)
    depth = signed_distance(corners, points)
    return int((np.where(inside, depth, -depth) < -CLEARLY * METRES_PER_PIXEL).sum())


def near_rim(
    mask: Bool[np.ndarray, "rows columns"],
) -> tuple[Float[np.ndarray, "k 2"], Bool[np.ndarray, " k"]]:
    """Centres of the pixels near an object's rim [m], and whether they belong to it."""
    pixels, box = mask.astype(np.uint8), np.ones((2 * BAND + 1,) * 2, dtype=np.uint8)
    near = np.argwhere(np.asarray(cv2.dilate(pixels, box)) > np.asarray(cv2.erode(pixels, box)))
    return (CONTACT_PIXEL - near) * METRES_PER_PIXEL, mask[near[:, 0], near[:, 1]]


def signed_distance(
    corners: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, " k"]:
    """Distance of points from an outline [m], positive inside."""
    polygon = shapely.Polygon(corners)
    shapely.prepare(polygon)
    apart = shapely.distance(shapely.get_exterior_ring(polygon), shapely.points(points))
    return np.where(shapely.contains_xy(polygon, points[:, 0], points[:, 1]), apart, -apart)


def _level_line(mask: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "n 2"] | None:
    """The line on which the blurred mask is one half, as a polygon [m]; None where it is none."""
    blurred = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), BLUR, borderType=cv2.BORDER_CONSTANT)
    images = (blurred, *(np.asarray(each, dtype=np.float32) for each in np.gradient(blurred)))
    points = mask_outline(mask)[::-1]
    for _ in range(ROUNDS):
        rows, columns = points.T.astype(np.float32)
        value, down, right = (
            np.ravel(cv2.remap(image, columns, rows, cv2.INTER_LINEAR)).astype(float) for image in images
        )
        step = (0.5 - value) / np.maximum(down**2 + right**2, 1e-4)
        moved = np.stack([step * down, step * right], axis=1)
        points = points + moved / np.maximum(np.linalg.norm(moved, axis=1), 1.0)[:, None]
    line = shapely.Polygon((CONTACT_PIXEL - points) * METRES_PER_PIXEL)
    line = line if line.is_valid else line.buffer(0.0)
    kept = shapely.simplify(line, SIMPLIFIED)
    if not isinstance(kept, shapely.Polygon) or kept.is_empty or not kept.is_valid:
        return None
    corners = shapely.get_coordinates(shapely.get_exterior_ring(kept))[:-1]
    return corners if shapely.is_ccw(shapely.get_exterior_ring(kept)) else corners[::-1]
