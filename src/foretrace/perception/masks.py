"""Where the object is in an image: by what changed, brightness, colour or GrabCut; by height in a depth image."""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from foretrace.errors import PerceptionError
from foretrace.geometry import invert_transform, rigid_transform
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.topdown import MINIMAL_HEIGHT
from foretrace.perception.shadows import Shadow, filled, find_shadow, grown, opened, patches

LEAST_CHANGE = 14.0
"""A pixel whose colour differs by more than this from the background's belongs to something new [of 255]."""
EDGE_DEPTH = 4
"""Pixels within which a blurred edge rises to the object's own colour."""
BORDER = 3
"""Distance from a mask's border in which pixels may be covered in part [pixel]."""
SMALLEST_OBJECT = 400
"""An object of fewer pixels is taken for noise."""
DEPTH_RIM = 2 * MINIMAL_HEIGHT
"""Height above the table from which depth shows an object [m]."""
PLANE_SAMPLES = 20000
"""Points that a plane is fitted to; more tell no more."""
PLANE_TRIALS = 300
"""Triples of points that are tried."""
PLANE_REACH = 0.006
"""Points closer to the plane than this belong to it [m]."""
LEAST_PLANE = 0.3
"""The table must hold at least this share of the points."""


def cover_by_background(
    image: UInt8[np.ndarray, "rows columns 3"],
    background: UInt8[np.ndarray, "other_rows other_columns 3"],
    least_change: float = LEAST_CHANGE,
    shadows: bool = True,
) -> Float[np.ndarray, "rows columns"]:
    """Which part of each pixel something covers that an image of the same place without the object does not show.

    A change of the light as a whole is taken out first: the one gain for each colour that most pixels agree on; then
    shadows, which darken the background and keep its colour and pattern.

    Args:
        image: The image.
        background: The same place before.
        least_change: By how much a colour must differ [of 255].
        shadows: Whether there may be shadows; without any, whatever differs is an object, of the table's colour, too.

    Raises:
        PerceptionError: The images differ in size or in nearly everything, or what differs may be object or shadow.
    """
    if image.shape != background.shape:
        raise PerceptionError(
            f"image of {image.shape[1]} x {image.shape[0]} pixels and background of {background.shape[1]} x "
            f"{background.shape[0]}: take both with one camera"
        )
    now, before = (cv2.GaussianBlur(one.astype(np.float32), (0, 0), 0.8) for one in (image, background))
    gain = np.median((now + 1.0) / (before + 1.0), axis=(0, 1))
    before = gain * before
    mask = np.abs(now - before).max(axis=2) > least_change
    if mask.mean() > 0.6:
        raise PerceptionError(
            f"{100 * mask.mean():.0f} % of the image differ from the background: was the camera moved or the light "
            "switched? take both anew"
        )
    shadow = find_shadow(now, before, mask) if shadows else None
    if shadow is not None:
        before = shadow.light * before
        mask = np.abs(now - before).max(axis=2) > least_change
    return np.where(mask, np.clip(_coverage(now, before, mask, shadow), 0.0, 1.0), 0.0)


def _coverage(
    now: Float[np.ndarray, "rows columns 3"],
    before: Float[np.ndarray, "rows columns 3"],
    mask: Bool[np.ndarray, "rows columns"],
    shadow: Shadow | None,
) -> Float[np.ndarray, "rows columns"]:
    """Which part of each pixel something new covers: blur mixes its colour with that of the background behind it.

    Its colour is that of the nearest pixel well inside the mask; 1 where none is close, or where the two look alike.
    Where there are shadows, only what makes the colours differ other than in brightness counts, if that is much.
    """
    size = 2 * EDGE_DEPTH + 1
    inside = mask if shadow is None else mask & ~shadow.pixels
    inside = cv2.erode(inside.astype(np.uint8), np.ones((size, size), np.uint8))
    away, labels = cv2.distanceTransformWithLabels(1 - inside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    nearest: Any = labels
    rows, columns = np.nonzero(mask & (inside == 0) & (away <= 2 * size))
    colours = np.zeros((int(nearest.max()) + 1, 3), dtype=now.dtype)
    colours[nearest[inside > 0]] = now[inside > 0]
    behind = before[rows, columns]
    apart = colours[nearest[rows, columns]] - behind
    change = now[rows, columns] - behind
    if shadow is not None:
        hue = behind / np.maximum(np.linalg.norm(behind, axis=1, keepdims=True), 1e-9)
        across, changed = (v - (v * hue).sum(axis=1, keepdims=True) * hue for v in (apart, change))
        distinct = (across**2).sum(axis=1, keepdims=True) > (2 * LEAST_CHANGE) ** 2
        apart, change = np.where(distinct, across, apart), np.where(distinct, changed, change)
    length = (apart**2).sum(axis=1)
    mixed = (change * apart).sum(axis=1)
    coverage = np.ones(mask.shape)
    coverage[rows, columns] = np.where(length > LEAST_CHANGE**2, mixed / np.maximum(length, 1e-9), 1.0)
    return coverage


def mask_by_threshold(
    image: UInt8[np.ndarray, "rows columns *channels"], dark_object: bool | None = None
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels on the object's side of the brightness that parts the image best (Otsu, 1979).

    Args:
        image: The image.
        dark_object: Whether the object is darker than the table; by default what touches the border less is the object.
    """
    values = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    _, bright = cv2.threshold(values, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    bright = bright > 0
    if dark_object is None:
        dark_object = np.concatenate([bright[0], bright[-1], bright[:, 0], bright[:, -1]]).mean() > 0.5
    return ~bright if dark_object else bright


def mask_by_colour(
    image: UInt8[np.ndarray, "rows columns 3"], point: tuple[float, float], tolerance: float = 40.0
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels of about the colour at a point (column, row), in the CIELAB space, brightness counting half.

    Raises:
        PerceptionError: The point lies outside the image.
    """
    column, row = _inside(point, image.shape)
    lab = cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 1.0), cv2.COLOR_BGR2LAB).astype(np.float32)
    patch = lab[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3].reshape(-1, 3)
    away = (lab - np.median(patch, axis=0)) * np.array([0.5, 1.0, 1.0], dtype=np.float32)
    return np.linalg.norm(away, axis=2) < tolerance


def mask_by_grabcut(
    image: UInt8[np.ndarray, "rows columns 3"], box: tuple[int, int, int, int], iterations: int = 5
) -> Bool[np.ndarray, "rows columns"]:
    """The object in a box by colours and edges (Rother, Kolmogorov and Blake, 2004).

    Args:
        image: The image.
        box: Left column, upper row, width and height of a box round the whole object, some background in it.
        iterations: Rounds of learning the colours and cutting.

    Raises:
        PerceptionError: The box leaves the image or holds no object.
    """
    left, top, width, height = box
    rows, columns = image.shape[:2]
    if left < 0 or top < 0 or width < 8 or height < 8 or left + width > columns or top + height > rows:
        raise PerceptionError(
            f"box {box} in an image of {columns} x {rows} pixels: give left, top, width and height within it"
        )
    if width * height == rows * columns:
        raise PerceptionError(f"box {box} is the whole image: leave some of the table beside it")
    labels = np.zeros((rows, columns), dtype=np.uint8)
    models = [np.zeros((1, 65)) for _ in range(2)]
    cv2.setRNGSeed(0)
    cv2.grabCut(
        image, labels, (left, top, width, height), models[0], models[1], iterations, cv2.GC_INIT_WITH_RECT
    )
    mask = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    if not mask.any():
        raise PerceptionError(f"GrabCut finds no object in the box {box}: draw it round the object")
    return mask


def find_by_background(
    image: UInt8[np.ndarray, "rows columns 3"],
    background: UInt8[np.ndarray, "other_rows other_columns 3"],
    point: tuple[float, float] | None = None,
    shadows: bool = True,
) -> Float[np.ndarray, "rows columns"]:
    """Which part of each pixel one object covers: `cover_by_background` near the border of its mask, all of it inside.

    Args:
        image: The image.
        background: The same place without the object.
        point: Column and row on or near the object; by default the largest object.
        shadows: Whether there may be shadows.

    Raises:
        PerceptionError: As `cover_by_background` and `pick_object`.
    """
    cover = cover_by_background(image, background, shadows=shadows)
    whole = pick_object(cover > 0.5, point)
    near = np.ones((2 * BORDER - 1,) * 2, np.uint8)
    inside = cv2.erode(whole.astype(np.uint8), near) > 0
    return np.where(inside, 1.0, np.where(grown(whole, BORDER), cover, 0.0))


def find_by_height(
    heights: Float[np.ndarray, "rows columns"], point: tuple[float, float] | None = None
) -> Bool[np.ndarray, "rows columns"]:
    """One object that stands out of the table; pixels without depth take part with their neighbours.

    Args:
        heights: Heights above the table [m], as `heights_above_table` gives them.
        point: Column and row on or near the object; by default the largest object.

    Raises:
        PerceptionError: As `pick_object`.
    """
    filled = cv2.medianBlur(np.where(np.isfinite(heights), heights, -1.0).astype(np.float32), 5)
    return pick_object(filled > DEPTH_RIM, point)


def pick_object(
    mask: Bool[np.ndarray, "rows columns"], point: tuple[float, float] | None = None, reach: float = 30.0
) -> Bool[np.ndarray, "rows columns"]:
    """One whole object of a mask, its holes filled and its specks removed.

    Args:
        mask: Pixels of objects.
        point: Column and row on or near the object that is meant; by default the largest.
        reach: How far from it the point may lie [pixel].

    Raises:
        PerceptionError: There is none, or none near the point, or the border cuts it off.
    """
    # Holes first: a marker on the object may look like the table, and have islands in it.
    labels, areas = patches(filled(opened(mask, 3)))
    large = 1 + np.flatnonzero(areas >= SMALLEST_OBJECT)
    if len(large) == 0:
        raise PerceptionError(
            f"the mask is empty: its largest patch has {int(areas.max(initial=0))} pixels, an object has at least "
            f"{SMALLEST_OBJECT}; check light and background, or move the camera nearer"
        )
    if point is None:
        chosen = int(large[np.argmax(areas[large - 1])])
    else:
        column, row = _inside(point, mask.shape)
        rows, columns = np.nonzero(np.isin(labels, large))
        distance = np.hypot(rows - row, columns - column)
        if distance.min() > reach:
            raise PerceptionError(
                f"point ({point[0]:.0f}, {point[1]:.0f}) lies {distance.min():.0f} pixels from the nearest of "
                f"{len(large)} objects: give a point on the object"
            )
        nearest = int(distance.argmin())
        chosen = int(labels[rows[nearest], columns[nearest]])
    found = labels == chosen
    sides = {"top": found[0], "bottom": found[-1], "left": found[:, 0], "right": found[:, -1]}
    for side, pixels in sides.items():
        if pixels.any():
            raise PerceptionError(f"the object is cut off by the {side} border of the image: show it whole")
    return found


def find_table(
    depth: Float[np.ndarray, "rows columns"], camera: PinholeCamera, seed: int = 0
) -> Float[np.ndarray, "4 4"]:
    """T_table_camera over the plane that most points of a depth image lie on.

    By RANSAC (Fischler and Bolles, 1981), then least squares. The table frame has z out of the table, its origin below
    the camera, and x along the image's columns.

    Raises:
        PerceptionError: The image holds no depth, is another camera's, or shows no table.
    """
    camera.check_image(depth, "depth image")
    points = camera.deproject(depth, np.eye(4))
    if len(points) < 0.05 * depth.size:
        raise PerceptionError(
            f"the depth image is empty: {len(points)} of {depth.size} pixels have depth; check the sensor's range "
            "(0.3 to 3 m) and that nothing glossy fills the image"
        )
    rng = np.random.default_rng(seed)
    points = points[rng.choice(len(points), min(PLANE_SAMPLES, len(points)), replace=False)]
    corners = points[rng.integers(len(points), size=(PLANE_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    corners, normals = corners[lengths > 1e-9], normals[lengths > 1e-9] / lengths[lengths > 1e-9, None]
    away = np.abs(points @ normals.T - (corners[:, 0] * normals).sum(axis=1))
    best = int((away < PLANE_REACH).sum(axis=0).argmax())
    inside = away[:, best] < PLANE_REACH
    for _ in range(5):
        middle, normal = _fit_plane(points[inside])
        distance = (points - middle) @ normal
        inside = np.abs(distance) < PLANE_REACH
    middle, normal = _fit_plane(points[inside])
    if inside.mean() < LEAST_PLANE:
        raise PerceptionError(
            f"no table: the largest plane holds {100 * inside.mean():.0f} % of the points, at least "
            f"{100 * LEAST_PLANE:.0f} % are needed; look down on the table"
        )
    normal = -normal if normal @ middle > 0 else normal  # towards the camera
    along = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    along /= np.linalg.norm(along)
    axes = np.column_stack([along, np.cross(normal, along), normal])
    return invert_transform(rigid_transform(axes, normal * (middle @ normal)))


def _fit_plane(points: Float[np.ndarray, "k 3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Middle and normal of the plane nearest to points in the sense of least squares."""
    middle = points.mean(axis=0)
    return middle, np.linalg.svd(points - middle, full_matrices=False)[2][2]


def heights_above_table(
    depth: Float[np.ndarray, "rows columns"], camera: PinholeCamera, T_table_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "rows columns"]:
    """Height above the table of the point in each pixel [m]; NaN without depth."""
    camera.check_image(depth, "depth image")
    heights = np.full(depth.shape, np.nan)
    seen = np.isfinite(depth) & (depth > 0)
    heights[seen] = camera.deproject(depth, T_table_camera)[:, 2]
    return heights


def object_height(
    heights: Float[np.ndarray, "rows columns"], mask: Bool[np.ndarray, "rows columns"]
) -> float:
    """Height of a flat object's top [m]: the median over the middle of its mask.

    Raises:
        PerceptionError: No pixel of the mask has depth.
    """
    inner = cv2.erode(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    values = heights[inner & np.isfinite(heights)]
    if len(values) == 0:
        raise PerceptionError("no pixel of the object has depth: check that depth and colour images match")
    top = values[values > 0.5 * np.median(values)]
    return float(np.median(top))


def _inside(point: tuple[float, float], shape: tuple[int, ...]) -> tuple[int, int]:
    """A point's nearest pixel (column, row)."""
    if not np.isfinite(point).all():
        raise PerceptionError(f"point ({point[0]:g}, {point[1]:g}) is no pixel: give column and row")
    column, row = round(point[0]), round(point[1])
    if not (0 <= column < shape[1] and 0 <= row < shape[0]):
        raise PerceptionError(
            f"point ({point[0]:g}, {point[1]:g}) lies outside an image of {shape[1]} x {shape[0]} pixels: give column "
            "and row"
        )
    return column, row
