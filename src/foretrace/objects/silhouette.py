"""From a binary image of one object to its outline in metres."""

import warnings
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float, Int, Shaped

from foretrace.errors import ForetraceError, ShapeError, fault, is_number, shown
from foretrace.geometry import cross, mask_outline, polygon_area
from foretrace.images import StoredImage, check_pixels
from foretrace.objects.model import USUAL_SIZES
from foretrace.objects.object_pixels import MOST_PIXELS, SPECK, Label, object_pixels

CUT_OFF = 0.25
"""An object that touches the border along more than this share of its extent is taken to be cut off."""
INVERT = "invert it (--invert, or read_silhouette(mask, invert=True))"
"""Remedy for an object that is black on white."""
LARGE_HOLE = 0.02
"""A hole of this share of the object's area may be the object itself, drawn black on white."""
RECTANGLE = 0.9
"""An outline that fills this share of the smallest rectangle round it may be a page."""
TOLERANCE = 0.001
"""How far a polygon may leave the outline that it simplifies [m]."""
TOLERANCE_PIXELS = 0.75
"""The same in pixels, whichever is larger: less would draw the pixels' own steps."""
BLUNTED = 3.0
"""How many pixels of a sharp corner may be missing in the image and are put back [pixels]; the sharper, the more."""
ODD = 1.0
"""Points of a side that are further off than this count less [pixels]: a dent bends no side."""
STRAIGHT, STRAIGHT_SHARE = 0.5, 0.2
"""Points form one side with a line if their root mean square distance from it is less than this [pixels], or than this
share of the tolerance: the pixels' steps and the noise of an edge leave about half of that."""
CORNER_SHARE = 0.2
"""Points at either end of a side that may be left out, as a share of all."""
LEAST_SINE = 0.17
"""Corners sharper than 20 degrees are put back no further than one of these."""
FINEST, COARSEST = 1e-6, 0.1
"""Sides of the smallest and of the largest pixels of images [m]."""
LOST_AREA = 0.03
"""Refined corners that lose or gain more than this share of the object's area have lost a part of it."""
FIT_ROUNDS = 5
"""Rounds of fitting a line and weighing its points anew."""


def read_silhouette(
    mask: Shaped[np.ndarray, "rows columns"], label: Label | None = None, invert: bool = False
) -> Bool[np.ndarray, "rows columns"]:
    """The one object in an image, without specks and with its holes filled.

    Args:
        mask: the object white (or True) on black; grey is white above the middle between darkest and brightest value.
        label: the object's value in an image of several labels.
        invert: the object is black on white; a dark frame round the page is left out.

    Raises:
        ShapeError: if there is no object, more than one, or one that the border cuts off, or labels leave it open.
    """
    if not isinstance(mask, np.ndarray) or mask.dtype.kind not in "buif":
        raise ShapeError(f"mask of type {type(mask).__name__}: give an array of numbers, rows x columns")
    if mask.ndim != 2:
        raise ShapeError(
            f"mask has shape {mask.shape}: give one channel, rows x columns, such as a cut-out's last, its alpha"
        )
    check_pixels("mask", mask.shape[0], mask.shape[1], ShapeError, MOST_PIXELS)
    return _one_object(object_pixels(StoredImage(mask), label, invert))


def _one_object(white: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """The largest part of what is white, its holes filled."""
    binary = np.ascontiguousarray(white, dtype=np.uint8)
    if not binary.any():
        raise ShapeError(
            f"mask of {binary.shape[1]} x {binary.shape[0]} pixels is empty: draw the object white on black"
        )
    _, labels, stats, _ = cv2.connectedComponentsWithStats(binary, connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    large = 1 + np.flatnonzero(areas >= SPECK * areas.max())
    if len(large) > 1:
        border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
        hint = f", or, if it is black on white, {INVERT}" if np.isin(large, border).all() else ""
        raise ShapeError(f"mask shows {len(large)} separate objects: keep one, or join its parts{hint}")
    found = labels == large[0]
    contours, _ = cv2.findContours(found.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros_like(binary), contours, -1, 1, cv2.FILLED).astype(bool)
    area = np.count_nonzero(filled)
    hole = 1 - float(areas.max()) / area
    _check_border(found, hole)
    sides = np.add(cv2.minAreaRect(contours[0])[1], 1)  # the contour runs through the pixels' centres
    if hole >= LARGE_HOLE and area > RECTANGLE * sides.prod():
        warnings.warn(
            f"the object is a rectangle with holes of {100 * hole:.0f} % of its area, which are filled: if it is the "
            f"page and the object is black on it, {INVERT}",
            stacklevel=1,
        )
    return filled


def _check_border(found: Bool[np.ndarray, "rows columns"], hole: float) -> None:
    """Refuse an object that the border cuts off, or that is what surrounds the object."""
    rows, columns = int(found.any(axis=1).sum()), int(found.any(axis=0).sum())
    sides = {
        "top": (found[0], columns),
        "bottom": (found[-1], columns),
        "left": (found[:, 0], rows),
        "right": (found[:, -1], rows),
    }
    # A tight crop touches the border with a few pixels of each extreme; a cut leaves a long straight side.
    touched = {side: at for side, at in sides.items() if at[0].sum() > CUT_OFF * at[1]}
    if not touched:
        return
    if hole >= LARGE_HOLE or (len(touched) > 2 and not found.all()):
        raise ShapeError(
            f"white touches the {', '.join(touched)} border of the mask: if the object is black on white, {INVERT}; "
            "if it is white and fills the image, add a black margin"
        )
    side, (pixels, extent) = next(iter(touched.items()))
    raise ShapeError(
        f"object touches the {side} border of the mask along {int(pixels.sum())} of {extent} pixels: "
        "show it whole, white on black, and add a black margin if it only fills the image"
    )


def check_scale(metres_per_pixel: Any, error: type[ForetraceError]) -> None:
    """Refuse an image's scale [m] that no image has, by an error of the given class."""
    if not is_number(metres_per_pixel) or not FINEST <= metres_per_pixel <= COARSEST:
        raise fault(error, is_number(metres_per_pixel))(
            f"scale of {shown(metres_per_pixel)} m per pixel: give a length from {FINEST:g} to {COARSEST:g} m"
        )


def likelier_scale(size: float, metres_per_pixel: float) -> str | None:
    """Which scale is likelier than the one [m] that gives an object its size [m]; None where the size is usual."""
    low, high = USUAL_SIZES
    if low <= size <= high:
        return None
    power = float(10.0 ** np.round(np.log10(np.sqrt(low * high) / size)))
    return (
        f"{power * metres_per_pixel:g} m per pixel in place of {metres_per_pixel:g} would make it "
        f"{100 * power * size:.3g} cm"
    )


def silhouette_origin(silhouette: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "2"]:
    """Centroid (row, column) of a silhouette's pixels: the origin of the object frame."""
    along = [np.count_nonzero(silhouette, axis=axis) for axis in (1, 0)]
    return np.array([np.arange(len(counts)) @ counts / counts.sum() for counts in along])


def silhouette_polygon(
    mask: Shaped[np.ndarray, "rows columns"],
    metres_per_pixel: float,
    tolerance: float | None = None,
    blunted: float = 0.0,
) -> Float[np.ndarray, "n 2"]:
    """The polygon of the object in a binary image, origin at its centroid, x right and y up [m].

    The outline is simplified; then a line is fitted to the outline along each side and neighbouring lines are
    intersected, which finds the corners to a fraction of a pixel.

    Args:
        mask: The object white (or True) on black.
        metres_per_pixel: Scale of the image [m].
        tolerance: How far the polygon may leave the outline [m]; `TOLERANCE` by default.
        blunted: How much of a right-angled corner may be missing [m], if more than `BLUNTED` pixels.

    Raises:
        ShapeError: if the image does not show one whole object, or the scale is not positive.
    """
    check_scale(metres_per_pixel, ShapeError)
    for name, value in (("tolerance", tolerance), ("blunted", blunted)):
        if value is not None and not (is_number(value) and 0 <= value < COARSEST):
            raise ShapeError(f"{name} is {shown(value)}: give a length from 0 to {COARSEST:g} m")
    silhouette = read_silhouette(mask)
    rows, columns = (mask_outline(silhouette) - silhouette_origin(silhouette)).T
    outline = np.column_stack([columns, -rows])[::-1]  # x, y in pixels, counter-clockwise
    pixels = max((TOLERANCE if tolerance is None else tolerance) / metres_per_pixel, TOLERANCE_PIXELS)
    # Rather too many sides than too few: those that are none are dropped again.
    chosen = simplify_outline(outline, max(pixels / 2, TOLERANCE_PIXELS))
    corners = outline[chosen]
    refined = refine_corners(outline, chosen, pixels, max(blunted / metres_per_pixel, BLUNTED))
    if len(refined) >= 3 and shapely.Polygon(refined).is_valid:
        area = np.count_nonzero(silhouette)
        off, usual = (abs(polygon_area(polygon) - area) for polygon in (refined, corners))
        if off <= max(LOST_AREA * area, usual):
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
    outline: Float[np.ndarray, "k 2"], chosen: list[int], tolerance: float, blunted: float = BLUNTED
) -> Float[np.ndarray, "n 2"]:
    """Corners where lines fitted to neighbouring sides meet; a corner that would move far stays.

    A side is dropped if its points lie on its neighbours as well, or if it is short and cuts off a corner that pixels
    or lens have blunted. All in pixels.

    Args:
        outline: The outline, counter-clockwise.
        chosen: Indices of points near the corners.
        tolerance: How far the polygon may leave the outline.
        blunted: How much of a corner may be missing.
    """
    splits, corners = sorted(chosen), outline[sorted(chosen)]
    splits, corners = split_sides(outline, splits, corners, range(len(splits)), tolerance, blunted)
    shortest, straight = 2 * max(tolerance, blunted), max(STRAIGHT, STRAIGHT_SHARE * tolerance)
    tried: set[tuple[int, ...]] = set()
    dropped = True
    while dropped and len(splits) > 3:
        dropped = False
        lengths = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        for k in np.argsort(lengths, kind="stable").tolist():
            # Side k lies between splits k and k + 1: one split in its middle takes their place.
            order = [(k + step) % len(splits) for step in range(len(splits))]
            start, stop = splits[k], splits[order[1]]
            stretch = (splits[order[-1]], start, stop, splits[order[2]])
            if stretch in tried:
                continue
            tried.add(stretch)
            side = indices_between(outline, start, stop)
            fewer = [int(side[len(side) // 2]), *(splits[m] for m in order[2:])]
            rest = np.concatenate([corners[[k]], corners[order[2:]]])
            trial = split_sides(outline, fewer, rest, [0], tolerance, blunted)
            if lies_on(outline, stretch, trial[1], straight, blunted if lengths[k] < shortest else None):
                splits, corners = split_sides(
                    outline, *trial, sorted({0, 1, len(fewer) - 1}), tolerance, blunted
                )
                dropped = True
                break
    # Lines of three sides in a row may meet in one point.
    return corners[np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) > 0.5]


def lies_on(
    outline: Float[np.ndarray, "k 2"],
    stretch: tuple[int, ...],
    corners: Float[np.ndarray, "n 2"],
    straight: float,
    blunted: float | None,
) -> bool:
    """Whether a side's points lie on a polygon without it.

    Args:
        outline: The outline.
        stretch: Indices of its points where the side before begins, the side, the side after, and where that ends.
        corners: The polygon.
        straight: Largest root mean square distance from it.
        blunted: How far the side itself may lie off, where it may be a blunted corner; otherwise all three count.
    """
    ring = shapely.LinearRing(corners)
    gaps = [
        shapely.distance(ring, shapely.points(outline[indices_between(outline, a, b)]))
        for a, b in pairwise(stretch)
    ]
    if blunted is not None:
        return bool(gaps[1].max() <= blunted)
    return bool(max((gap**2).mean() for gap in gaps) <= straight**2)


def split_sides(
    outline: Float[np.ndarray, "k 2"],
    splits: list[int],
    corners: Float[np.ndarray, "n 2"],
    moving: Sequence[int],
    tolerance: float,
    blunted: float,
) -> tuple[list[int], Float[np.ndarray, "n 2"]]:
    """Best split of an outline into straight sides, near given indices, and the corners where these sides meet.

    Args:
        outline: The outline.
        splits: Indices of its points where sides meet, in order.
        corners: The corners there.
        moving: Which of them are looked for anew.
        tolerance: How far the polygon may leave the outline.
        blunted: How much of a corner may be missing.
    """
    corners = corners.copy()
    for _ in range(FIT_ROUNDS):
        sides = {
            k: fit_line(outline, splits[k], splits[(k + 1) % len(splits)], blunted)
            for k in {side % len(splits) for i in moving for side in (i - 1, i)}
        }
        moved = list(splits)
        for i in moving:
            before, after = sides[(i - 1) % len(splits)], sides[i]
            corners[i], meeting = outline[splits[i]], meeting_point(before, after)
            around = indices_between(outline, splits[i - 1], splits[(i + 1) % len(splits)])[1:-1]
            if meeting is None or len(around) == 0:
                continue
            away = np.linalg.norm(outline[around] - meeting, axis=1)
            if away.min() <= reach_of(before, after, tolerance, blunted):
                corners[i], moved[i] = meeting, int(around[away.argmin()])
        if moved == splits or len(set(moved)) < len(moved):
            break
        splits = moved
    return splits, corners


def indices_between(outline: Float[np.ndarray, "k 2"], start: int, stop: int) -> Int[np.ndarray, " m"]:
    """Indices of a closed outline's points from one to another, both included."""
    return np.arange(start, stop + 1 if stop > start else stop + len(outline) + 1) % len(outline)


Line = tuple[np.ndarray, np.ndarray]
"""A point of the line and its unit direction."""


def fit_line(outline: Float[np.ndarray, "k 2"], start: int, stop: int, blunted: float) -> Line:
    """The line nearest to most of the outline's points between two indices, along the outline (Huber, 1964)."""
    indices = indices_between(outline, start, stop)
    margin = min(
        int(blunted), int(CORNER_SHARE * len(indices))
    )  # the points at a corner belong to neither side
    points = outline[indices[margin : len(indices) - margin]]
    weights, anchor, along = np.ones(len(points)), points[0], points[-1] - points[0]
    for _ in range(FIT_ROUNDS):
        anchor = weights @ points / weights.sum()
        away = points - anchor
        across, along = np.linalg.eigh((weights[:, None] * away).T @ away)[1].T
        weights = ODD / np.maximum(np.abs(away @ across), ODD)
    return anchor, along if along @ (outline[stop] - outline[start]) > 0 else -along


def reach_of(before: Line, after: Line, tolerance: float, blunted: float) -> float:
    """How far from what is seen of a corner its two sides may meet [pixels]: blur takes more of a sharper one."""
    # Sine of half the angle between the sides: directions run along the outline.
    sharpness = np.sqrt((1 + np.clip(before[1] @ after[1], -1, 1)) / 2)
    return float(max(1.5 * tolerance, blunted / max(sharpness, LEAST_SINE)))


def meeting_point(first: Line, second: Line) -> Float[np.ndarray, "2"] | None:
    """Where two lines cross, or None where they are nearly parallel."""
    turn = float(cross(first[1], second[1]))
    if abs(turn) < 0.05:
        return None
    return first[0] + first[1] * float(cross(second[0] - first[0], second[1])) / turn
