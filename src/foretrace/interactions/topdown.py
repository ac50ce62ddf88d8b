"""The object seen from above in the action frame: what the paper's predictors look at.

The picture has 128 x 128 pixels of 3.2 mm. The action direction (x) points up, y to the left. The contact
point lies between two rows and two columns, so that the grid is its own mirror image about the action axis.
"""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from foretrace.actions import Action, LeverUp
from foretrace.errors import ActionError, ShapeError, ViewError, check_type, is_number, shown, wrong_type
from foretrace.geometry import Numbers, mask_outline
from foretrace.objects import ObjectModel
from foretrace.objects.silhouette import check_scale, read_silhouette, silhouette_origin

VIEW_SIZE = 128
"""Rows and columns of a view."""
METRES_PER_PIXEL = 0.0032
"""Side of a pixel [m]."""
ROWS_AHEAD = 96
"""Rows of pixels ahead of the contact point; the rest lies behind it."""
CONTACT_PIXEL = np.array([ROWS_AHEAD - 0.5, VIEW_SIZE / 2 - 0.5])
"""Row and column of the contact point, with pixel centres at whole numbers."""
LOOK_AHEAD = (ROWS_AHEAD - VIEW_SIZE / 2) * METRES_PER_PIXEL
"""The middle of a view lies this far ahead of its frame's origin [m]."""
MINIMAL_HEIGHT = 0.004
"""Points of a cloud below this height belong to the table [m]."""


@dataclass(frozen=True, eq=False)
class TopDownView:
    """Mask and height map of an object from above, in the action frame."""

    mask: Bool[np.ndarray, "128 128"]
    """Where the object is."""
    height: Float[np.ndarray, "128 128"]
    """Height of its upper surface above the table [m], 0 beside it."""
    metres_per_pixel: float = METRES_PER_PIXEL
    """Side of a pixel [m]. Pictures of another scale, with the contact point at the same place among their pixels, are
    resampled: a view has pixels of ``METRES_PER_PIXEL``."""

    def __post_init__(self) -> None:
        for name, dtype in (("mask", bool), ("height", np.float32)):
            try:
                values = np.array(getattr(self, name), dtype=dtype)
            except (TypeError, ValueError):
                wrong = wrong_type(ViewError)
                raise wrong(f"{name} is {shown(getattr(self, name))}: give an array of numbers") from None
            given = np.asarray(getattr(self, name))
            if given.dtype.kind not in "biuf":
                raise wrong_type(ViewError)(
                    f"{name} has values of type {given.dtype}: give an array of numbers"
                )
            if name == "mask" and np.isnan(given).any():
                raise ViewError(
                    f"mask has {np.isnan(given).sum()} values that are NaN: give 0 beside the object"
                )
            if values.shape != (VIEW_SIZE, VIEW_SIZE):
                raise ViewError(f"{name} of shape {values.shape}: expected ({VIEW_SIZE}, {VIEW_SIZE}) pixels")
            object.__setattr__(self, name, values)
        scale = self.metres_per_pixel
        if not is_number(scale) or scale != METRES_PER_PIXEL:
            check_scale(scale, ViewError)
            if self.mask[[0, -1]].any() or self.mask[:, [0, -1]].any():
                raise ViewError(
                    f"the object touches the border of a view of {scale} m per pixel, a part of it may not be seen: "
                    "choose a larger scale or another contact point"
                )
            mask, height = self._resampled(_pixels_of(_pixel_centres(), scale))
            object.__setattr__(self, "mask", mask)
            object.__setattr__(self, "height", height)
            object.__setattr__(self, "metres_per_pixel", METRES_PER_PIXEL)
        for values in (self.mask, self.height):
            values.setflags(write=False)

    def __repr__(self) -> str:
        area = 1e4 * self.mask.sum() * self.metres_per_pixel**2
        return f"TopDownView(object of {area:.0f} cm2, up to {100 * self.height.max():.1f} cm high)"

    @classmethod
    def of(cls, obj: ObjectModel, action: Action) -> "TopDownView":
        """The exact view of a known object: a pixel shows what lies at its centre.

        Raises:
            ViewError: if the object does not fit into the window.
        """
        check_type("obj", obj, ObjectModel, ViewError)
        check_type("action", action, Action, ViewError)
        _check_window(_to_action(obj.corners, action))
        # Only the pixels of the outline's bounding box are asked about.
        first, last = np.sort(_pixels_of(_to_action(obj.corners, action)), axis=0)[[0, -1]]
        low = np.maximum(np.floor(first).astype(int), 0)
        high = np.minimum(np.ceil(last).astype(int), VIEW_SIZE - 1) + 1
        centres = _pixel_centres()[low[0] : high[0], low[1] : high[1]]
        heights = obj.height_at(_to_object(centres.reshape(-1, 2), action))
        height = np.zeros((VIEW_SIZE, VIEW_SIZE), dtype=np.float32)
        height[low[0] : high[0], low[1] : high[1]] = heights.reshape(centres.shape[:2])
        return cls(height > 0, height)

    @classmethod
    def around(cls, obj: ObjectModel) -> tuple["TopDownView", Float[np.ndarray, "4 4"]]:
        """The exact view of a known object in the middle of the window, and the object's frame in that of the view.

        Raises:
            ViewError: The object does not fit into the window.
        """
        check_type("obj", obj, ObjectModel, ViewError)
        middle = (obj.corners.min(axis=0) + obj.corners.max(axis=0)) / 2
        camera = LeverUp(middle - np.array([LOOK_AHEAD, 0.0]), (1.0, 0.0))
        return cls.of(obj, camera), camera.T_action_object

    @classmethod
    def from_mask(
        cls,
        mask: Shaped[np.ndarray, "rows columns"],
        metres_per_pixel: float,
        contact: Numbers,
        direction: Numbers,
        height: float = 0.02,
    ) -> "TopDownView":
        """The view of an object known by its silhouette alone.

        Args:
            mask: the object white (or True) on black. Holes are filled.
            metres_per_pixel: scale of the image [m].
            contact: contact point in the frame of ``Prism.from_mask``: metres from the silhouette's centroid,
                x to the right in the image and y up.
            direction: action direction in the same frame.
            height: height to assume [m].

        Raises:
            ViewError: if the image does not show one whole object, or it does not fit into the window.
        """
        check_scale(metres_per_pixel, ViewError)
        if not is_number(height) or not 0 < height < np.inf:
            raise ViewError(f"height is {shown(height)}: give a positive number of metres")
        try:
            silhouette = read_silhouette(mask)
            action = LeverUp(contact, direction)
        except (ShapeError, ActionError) as error:
            raise ViewError(str(error)) from error
        origin = silhouette_origin(silhouette)
        outline = (mask_outline(silhouette) - origin)[:, ::-1] * [metres_per_pixel, -metres_per_pixel]
        _check_window(_to_action(outline, action))
        in_object = _to_object(_pixel_centres().reshape(-1, 2), action)
        in_image = (in_object * [1.0, -1.0] / metres_per_pixel)[:, ::-1] + origin  # (row, column)
        rows, columns = (in_image.T + 1.0).astype(np.float32).reshape(2, VIEW_SIZE, VIEW_SIZE)
        padded = np.pad(silhouette, 1).astype(np.float32)
        seen = cv2.remap(padded, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) >= 0.5
        return cls(seen, np.where(seen, np.float32(height), np.float32(0)))

    @classmethod
    def from_points(
        cls, points: Float[np.ndarray, "k 3"], minimal_height: float = MINIMAL_HEIGHT
    ) -> "TopDownView":
        """The view of a point cloud, as depth cameras see it.

        A pixel belongs to the object if it holds at least half as many of its points as most do, so that an
        outline neither grows nor shrinks; its height is their mean. Gaps of a pixel between points are closed.

        Args:
            points: points in the action frame [m]; those outside the window are left out.
            minimal_height: points below it belong to the table [m].

        Raises:
            ViewError: if no point of the object lies in the window.
        """
        if not is_number(minimal_height):
            raise wrong_type(ViewError)(f"minimal_height is {shown(minimal_height)}: give a number of metres")
        points = as_points(points)
        points = points[np.isfinite(points).all(axis=1)]
        pixels = np.rint(_pixels_of(points[:, :2])).astype(int)
        inside = ((pixels >= 0) & (pixels < VIEW_SIZE)).all(axis=1)
        inside &= points[:, 2] > minimal_height
        if not inside.any():
            raise ViewError(
                f"no point of {len(points)} is in the window above {minimal_height} m: check the camera pose"
            )
        index = pixels[inside] @ [VIEW_SIZE, 1]
        count = np.bincount(index, minlength=VIEW_SIZE**2)
        mean = np.bincount(index, weights=points[inside, 2], minlength=VIEW_SIZE**2) / np.maximum(count, 1)
        filled = 2 * count >= np.median(count[count > 0])
        height = np.where(filled, mean, 0.0).astype(np.float32).reshape(VIEW_SIZE, VIEW_SIZE)
        closed = cv2.morphologyEx(height, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        height = np.where(count.reshape(VIEW_SIZE, VIEW_SIZE) == 0, closed, height)
        return cls(height > 0, height)

    def seen_from(self, action: Action) -> "TopDownView":
        """The object as seen in the frame of another action; parts beyond this view stay unseen.

        Args:
            action: The action, in this view's frame.
        """
        centres = _pixel_centres().reshape(-1, 2)
        return TopDownView(
            *self._resampled(_pixels_of(_to_object(centres, action)).reshape(VIEW_SIZE, VIEW_SIZE, 2))
        )

    def _resampled(
        self, pixels: Float[np.ndarray, "128 128 2"]
    ) -> tuple[Bool[np.ndarray, "128 128"], Float[np.ndarray, "128 128"]]:
        """Mask and height map at other places (row, column), between pixels by bilinear interpolation."""
        rows, columns = np.moveaxis(pixels, -1, 0).astype(np.float32)
        share, height = (
            cv2.remap(values, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            for values in (self.mask.astype(np.float32), np.where(self.mask, self.height, np.float32(0)))
        )
        mask = share >= 0.5
        return mask, np.where(mask, height / np.where(mask, share, 1), 0).astype(np.float32)

    def to_pixels(self, points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 2"]:
        """Pixels (row, column) of points in the action frame [m]; pixel centres are whole numbers."""
        return _pixels_of(points)

    def to_metres(self, pixels: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 2"]:
        """Points in the action frame [m] of pixel coordinates (row, column)."""
        return _metres_of(pixels)

    def contour(self) -> Float[np.ndarray, "k 2"]:
        """Outline of the largest object in the mask, counter-clockwise in the action frame [m]."""
        if not self.mask.any():
            raise ViewError("the view's mask is empty: it has no contour")
        return outline_of(self.mask)


def largest_object(mask: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """The largest of the objects in a mask; pixels that touch at a corner belong together."""
    pixels = np.ascontiguousarray(mask).view(np.uint8)
    outlines, _ = cv2.findContours(pixels, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    if len(outlines) == 1:  # one object without holes, as nearly always: labels would take longer to find
        return mask
    _, labels, stats, _ = cv2.connectedComponentsWithStats(pixels, connectivity=8)
    return labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))


def outline_of(mask: Bool[np.ndarray, "128 128"]) -> Float[np.ndarray, "k 2"]:
    """Outline of the largest object in a view's mask, counter-clockwise in the action frame [m]."""
    return _metres_of(mask_outline(largest_object(mask))[::-1])


def _pixels_of(
    points: Float[np.ndarray, "*batch 2"], metres_per_pixel: float = METRES_PER_PIXEL
) -> Float[np.ndarray, "*batch 2"]:
    return CONTACT_PIXEL - points / metres_per_pixel


def _metres_of(pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    return (CONTACT_PIXEL - pixels) * METRES_PER_PIXEL


@cache
def _pixel_centres() -> Float[np.ndarray, "128 128 2"]:
    grid = np.stack(np.meshgrid(np.arange(VIEW_SIZE), np.arange(VIEW_SIZE), indexing="ij"), axis=-1)
    return _metres_of(grid.astype(float))


def _to_action(points: Float[np.ndarray, "k 2"], action: Action) -> Float[np.ndarray, "k 2"]:
    transform = action.T_action_object
    return points @ transform[:2, :2].T + transform[:2, 3]


def _to_object(points: Float[np.ndarray, "k 2"], action: Action) -> Float[np.ndarray, "k 2"]:
    return points @ action.T_action_object[:2, :2] + action.contact


def as_points(points: object) -> Float[np.ndarray, "k 3"]:
    """Points as an array.

    Raises:
        ViewError: They are no numbers in the shape (k, 3).
    """
    try:
        array = np.array(points, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros((0, 0))
    if array.ndim != 2 or array.shape[1] != 3:
        raise ViewError(f"points of shape {np.shape(points)}: give numbers in the shape (k, 3) [m]")  # pyright: ignore
    return array


def _check_window(outline: Float[np.ndarray, "k 2"]) -> None:
    """Refuse outlines (action frame) that leave the window."""
    high = _metres_of(np.array([-0.5, -0.5]))
    low = _metres_of(np.array([VIEW_SIZE - 0.5, VIEW_SIZE - 0.5]))
    if (outline < low).any() or (outline > high).any():
        (x0, y0), (x1, y1) = outline.min(axis=0), outline.max(axis=0)
        raise ViewError(
            f"object reaches x {x0:.3f} to {x1:.3f} m and y {y0:.3f} to {y1:.3f} m in the action frame: "
            f"the window covers x {low[0]:.3f} to {high[0]:.3f} and y {low[1]:.3f} to {high[1]:.3f}; "
            "choose another contact or check the scale"
        )
