"""From a binary image of one object to its outline in metres."""

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float, Shaped

from foretrace.errors import ShapeError
from foretrace.geometry import cross, mask_outline

SPECK = 0.01
"""Objects below this share of the largest one's area are taken for noise."""
CUT_OFF = 0.25
"""An object that touches the border along more than this share of its extent is taken to be cut off."""
TOLERANCE = 0.001
"""How far a polygon may leave the outline that it simplifies [m]."""
TOLERANCE_PIXELS = 0.75
"""The same in pixels, whichever is larger: less would draw the pixels' own steps."""


def read_silhouette(mask: Shaped[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """The one object in a binary image, without specks and with its holes filled.

    Args:
        mask: the object not 0 (or True), the background 0.

    Raises:
        ShapeError: if there is no object, more than one, or one that the border cuts off.
    """
    if mask.size == 0 or not mask.any():
        raise ShapeError(
            f"mask of {mask.shape[1]} x {mask.shape[0]} pixels is empty: draw the object white on black"
        )
    binary = (np.nan_to_num(mask) != 0).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(binary, connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    num_objects = int((areas >= SPECK * areas.max()).sum())
    if num_objects > 1:
        raise ShapeError(f"mask shows {num_objects} separate objects: keep one, or join its parts")
    found = labels == 1 + int(np.argmax(areas))
    _check_border(found)
    contours, _ = cv2.findContours(found.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros_like(binary), contours, -1, 1, cv2.FILLED)
    return filled.astype(bool)


def _check_border(found: Bool[np.ndarray, "rows columns"]) -> None:
    rows, columns = int(found.any(axis=1).sum()), int(found.any(axis=0).sum())
    sides = {
        "top": (found[0], columns),
        "bottom": (found[-1], columns),
        "left": (found[:, 0], rows),
        "right": (found[:, -1], rows),
    }
    # A tight crop touches the border with a few pixels of each extreme; a cut leaves a long straight side.
    for side, (pixels, extent) in sides.items():
        if pixels.sum() > CUT_OFF * extent:
            raise ShapeError(
                f"object touches the {side} border of the mask along {int(pixels.sum())} of {extent} pixels: "
                "show it whole, white on black, and add a black margin if it only fills the image"
            )


def silhouette_origin(silhouette: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "2"]:
    """Centroid (row, column) of a silhouette's pixels: the origin of the object frame."""
    return np.argwhere(silhouette).mean(axis=0)


def silhouette_polygon(
    mask: Shaped[np.ndarray, "rows columns"], metres_per_pixel: float, tolerance: float | None = None
) -> Float[np.ndarray, "n 2"]:
    """The polygon of the object in a binary image, origin at its centroid, x right and y up [m].

    The outline is simplified; then a line is fitted to the outline along each side and neighbouring lines are
    intersected, which finds the corners to a fraction of a pixel.

    Raises:
        ShapeError: if the image does not show one whole object, or the scale is not positive.
    """
    if not (np.isfinite(metres_per_pixel) and metres_per_pixel > 0):
        raise ShapeError(f"scale of {metres_per_pixel} m per pixel: it must be a positive length")
    silhouette = read_silhouette(mask)
    rows_columns = mask_outline(silhouette) - silhouette_origin(silhouette)
    outline = np.ascontiguousarray(
        rows_columns[::-1, ::-1] * [1.0, -1.0]
    )  # (column, -row), counter-clockwise
    pixels = max((TOLERANCE if tolerance is None else tolerance) / metres_per_pixel, TOLERANCE_PIXELS)
    chosen = simplify_outline(outline, pixels)
    if len(chosen) < 3:
        raise ShapeError(
            f"object of {int(silhouette.sum())} pixels is too small for an outline: use a finer image"
        )
    corners = outline[chosen]
    refined = refine_corners(outline, chosen, pixels)
    if shapely.Polygon(refined).is_valid:
        corners = refined
    return corners * metres_per_pixel


def simplify_outline(outline: Float[np.ndarray, "k 2"], tolerance: float) -> list[int]:
    """Indices of the outline points that a polygon within the tolerance needs (Douglas and Peucker)."""
    start = int(np.argmax(np.linalg.norm(outline - outline.mean(axis=0), axis=1)))
    order = np.roll(np.arange(len(outline)), -start)
    closed = shapely.LineString(outline[[*order, start]])
    kept = shapely.get_coordinates(closed.simplify(tolerance, preserve_topology=True))[:-1]
    index_of = {tuple(point): k for k, point in enumerate(outline.tolist())}
    return [index_of[tuple(point)] for point in kept.tolist()]


def refine_corners(
    outline: Float[np.ndarray, "k 2"], chosen: list[int], tolerance: float
) -> Float[np.ndarray, "n 2"]:
    """Corners where lines fitted to neighbouring sides meet; a corner that would move far stays."""
    anchors, directions = [], []
    for start, stop in zip(chosen, [*chosen[1:], chosen[0] + len(outline)], strict=True):
        indices = np.arange(start, stop + 1 if stop > start else stop + len(outline) + 1) % len(outline)
        # The outline's points at a corner belong to neither side.
        side = outline[indices[1:-1]] if len(indices) > 4 else outline[indices]
        anchors.append(side.mean(axis=0))
        directions.append(np.linalg.svd(side - anchors[-1])[2][0])
    corners = outline[chosen].copy()
    for k in range(len(chosen)):
        turn = float(cross(directions[k - 1], directions[k]))
        if abs(turn) < 0.05:
            continue
        along = float(cross(anchors[k] - anchors[k - 1], directions[k])) / turn
        meeting = anchors[k - 1] + along * directions[k - 1]
        if np.linalg.norm(meeting - corners[k]) <= 2 * tolerance:
            corners[k] = meeting
    return corners
