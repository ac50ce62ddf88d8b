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
BLUNTED = 3.0
"""How many pixels of a sharp corner may be missing in the image and are put back [pixels]."""


def read_silhouette(mask: Shaped[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """The one object in a binary image, without specks and with its holes filled.

    Args:
        mask: the object white (or True) on black; grey is white above half of the brightest value.

    Raises:
        ShapeError: if there is no object, more than one, or one that the border cuts off.
    """
    if mask.ndim != 2:
        raise ShapeError(f"mask has shape {mask.shape}: give one channel, rows x columns")
    if mask.size == 0 or not mask.any():
        raise ShapeError(
            f"mask of {mask.shape[1]} x {mask.shape[0]} pixels is empty: draw the object white on black"
        )
    grey = np.nan_to_num(mask.astype(np.float32))
    binary = (grey > 0.5 * grey.max()).astype(np.uint8)
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
    rows, columns = (mask_outline(silhouette) - silhouette_origin(silhouette)).T
    outline = np.column_stack([columns, -rows])[::-1]  # x, y in pixels, counter-clockwise
    pixels = max((TOLERANCE if tolerance is None else tolerance) / metres_per_pixel, TOLERANCE_PIXELS)
    chosen = simplify_outline(outline, pixels)
    corners = outline[chosen]
    refined = refine_corners(outline, chosen, pixels)
    if len(refined) >= 3 and shapely.Polygon(refined).is_valid:
        corners = refined
    return corners * metres_per_pixel


def simplify_outline(outline: Float[np.ndarray, "k 2"], tolerance: float) -> list[int]:
    """Indices of the outline points that a polygon within the tolerance needs (Douglas and Peucker)."""
    start = int(np.argmax(np.linalg.norm(outline - outline.mean(axis=0), axis=1)))
    order = np.roll(np.arange(len(outline)), -start)
    kept = shapely.get_coordinates(shapely.Polygon(outline[order]).simplify(tolerance))[:-1]
    index_of = {tuple(point): k for k, point in enumerate(outline.tolist())}
    return [index_of[tuple(point)] for point in kept.tolist()]


def refine_corners(
    outline: Float[np.ndarray, "k 2"], chosen: list[int], tolerance: float
) -> Float[np.ndarray, "n 2"]:
    """Corners where lines fitted to neighbouring sides meet; a corner that would move far stays.

    A short side between two lines that meet close to it is a corner that the pixels have blunted: it is
    dropped. All in pixels.
    """
    reach = max(1.5 * tolerance, BLUNTED)
    stops = [*chosen[1:], chosen[0]]
    sides = [fit_line(outline, start, stop) for start, stop in zip(chosen, stops, strict=True)]
    lengths = np.linalg.norm(outline[stops] - outline[chosen], axis=1)
    kept: list[int] = []
    for k in range(len(sides)):
        after = sides[(k + 1) % len(sides)]
        before = sides[k - 1]
        blunted = lengths[k] < 2 * tolerance and (k == 0 or kept[-1:] == [k - 1])
        meeting = meeting_point(before, after) if blunted else None
        middle = outline[[chosen[k], stops[k]]].mean(axis=0)
        if meeting is None or np.linalg.norm(meeting - middle) > reach:
            kept.append(k)
    if len(kept) < 3:
        kept = list(range(len(sides)))
    corners = outline[[chosen[k] for k in kept]]
    for i, k in enumerate(kept):
        meeting = meeting_point(sides[kept[i - 1]], sides[k])
        if meeting is not None and np.linalg.norm(meeting - corners[i]) <= reach:
            corners[i] = meeting
    # Lines of three sides in a row may meet in one point.
    return corners[np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) > 0.5]


Line = tuple[np.ndarray, np.ndarray]
"""A point of the line and its unit direction."""


def fit_line(outline: Float[np.ndarray, "k 2"], start: int, stop: int) -> Line:
    """The line nearest to the outline's points between two indices, in the sense of least squares."""
    indices = np.arange(start, stop + 1 if stop > start else stop + len(outline) + 1) % len(outline)
    # The points at a corner belong to neither side.
    points = outline[indices[1:-1]] if len(indices) > 4 else outline[indices]
    anchor = points.mean(axis=0)
    scatter = (points - anchor).T @ (points - anchor)
    return anchor, np.linalg.eigh(scatter)[1][:, 1]


def meeting_point(first: Line, second: Line) -> Float[np.ndarray, "2"] | None:
    """Where two lines cross, or None where they are nearly parallel."""
    turn = float(cross(first[1], second[1]))
    if abs(turn) < 0.05:
        return None
    return first[0] + first[1] * float(cross(second[0] - first[0], second[1])) / turn
