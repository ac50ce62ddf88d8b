"""From an object's mask in an image to its outline on the table, the lever-up and the view from above.

A slanted camera sees the upper face shifted away from it, and the sides that face it. Both are undone for prisms: the
mask is laid onto the plane of the upper face and onto the plane of the lower rim, and the object is where both agree.
That is exact for convex outlines. What is assumed: vertical sides, the height that is given, and a lower rim at the
height of the nominal bevel.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float

from foretrace.actions import LeverUp
from foretrace.errors import ActionError, PerceptionError, ShapeError, fault, is_number, shown
from foretrace.geometry import convex_hull, invert_transform, planar_transform, transform_points
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import BEVEL, ObjectModel, Prism, read_silhouette, silhouette_origin
from foretrace.objects.model import USUAL_SIZES, check_size, fitting_bevel, largest_distance
from foretrace.objects.silhouette import silhouette_polygon
from foretrace.perception.masks import DEPTH_RIM
from foretrace.perception.shadows import filled

GRID = 0.00025
"""Side of a pixel of the rectified mask [m]."""
TOLERANCE = 0.002
"""Largest distance of the polygon from the outline [m]: less follows the noise of the edge."""
BLUNTED = 3.0
"""Length that a lens may take from a right-angled corner [pixel]."""
SMOOTHING = 1.0
"""Standard deviation by which the steps of a mask's border are smoothed [pixel]."""
HIGHEST = 10.0
"""Greatest height of an object [m]."""
LARGEST_OBJECT = 1.0
"""No object is larger than this [m]."""
LENGTHS = "check the sides of the markers as printed, or the unit of the depth image"
"""What gives the table its scale."""


@dataclass(frozen=True)
class PlacedObject:
    """An object and where it lies."""

    object: ObjectModel
    """The object, in its own frame."""
    T_table_object: Float[np.ndarray, "4 4"]
    """Where its frame lies on the table."""

    def outline(self, height: float = 0.0) -> Float[np.ndarray, "n 3"]:
        """Its outline in the table frame at a height above the table [m]."""
        corners = np.column_stack([self.object.corners, np.full(len(self.object.corners), height)])
        return transform_points(self.T_table_object, corners)


@dataclass(frozen=True)
class Observation:
    """Object, lever-up and view in an image."""

    placed: PlacedObject
    """The object on the table."""
    action: LeverUp
    """The lever-up, in the object frame."""
    view: TopDownView
    """The object from above, in the action frame."""

    @property
    def T_table_action(self) -> Float[np.ndarray, "4 4"]:
        """The action frame in the table frame."""
        return self.placed.T_table_object @ invert_transform(self.action.T_action_object)

    @property
    def com_in_action(self) -> Float[np.ndarray, "3"]:
        """Centre of mass of the object at rest, uniform density assumed, in the action frame [m]."""
        com = self.placed.object.mass_properties(1.0).com
        return transform_points(self.action.T_action_object, com[None])[0]


def check_height(height: Any) -> None:
    """Refuse what is no height of an object [m].

    Raises:
        PerceptionError: It is no number, or not above 0 and at most `HIGHEST`.
    """
    if not (is_number(height) and 0 < height <= HIGHEST):
        raise fault(PerceptionError, is_number(height))(
            f"height is {shown(height)}: give metres, above 0 and at most {HIGHEST:g}"
        )


def place_object(
    mask: Bool[np.ndarray, "rows columns"] | Float[np.ndarray, "rows columns"],
    camera: PinholeCamera,
    T_table_camera: Float[np.ndarray, "4 4"],
    height: float,
    rim: float = BEVEL.height,
    hull: bool = False,
) -> PlacedObject:
    """The prism that a mask shows, on the table.

    Args:
        mask: The object in the image, as the camera sees it; or, which is finer, how much of each pixel it covers.
        camera: The camera.
        T_table_camera: Its pose.
        height: Height of the object's upper face [m].
        rim: Height of its lower rim, where the mask begins [m].
        hull: Take the convex hull of the outline (paper, section 5.4).

    Raises:
        PerceptionError: The mask is empty, of another camera, or leads to no believable object.
    """
    camera.check_image(mask, "mask")
    if not mask.any():
        raise PerceptionError("the mask is empty: no object to place")
    if not 0 <= rim < height < T_table_camera[2, 3]:
        raise PerceptionError(
            f"object from {rim} to {height} m high below a camera at {T_table_camera[2, 3]:.3f} m: check both"
        )
    rows, columns = np.nonzero(mask)
    pixels = np.stack([columns, rows], axis=-1)[convex_hull_indices(columns, rows)].astype(float)
    reach = np.concatenate([camera.on_plane(pixels, T_table_camera, level) for level in (rim, height)])
    if not np.isfinite(reach).all() or np.ptp(reach, axis=0).max() > LARGEST_OBJECT:
        raise PerceptionError(
            f"the mask reaches to the horizon or over a metre of table: check mask and camera pose; {LENGTHS}"
        )
    low, high = reach.min(axis=0) - 4 * GRID, reach.max(axis=0) + 4 * GRID
    size = np.ceil((high - low) / GRID).astype(int)
    smooth = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), SMOOTHING)
    flat = _lay_out(smooth, camera, T_table_camera, low, size, height)
    flat &= _lay_out(smooth, camera, T_table_camera, low, size, rim)
    try:
        blunted = BLUNTED * pixel_size(camera, T_table_camera, reach.mean(axis=0))
        flat = filled(flat)
        corners = silhouette_polygon(flat, GRID, TOLERANCE, blunted)
        check_size(largest_distance(corners), height, LENGTHS)
        bevel = fitting_bevel(corners, height)
        prism = Prism(convex_hull(corners) if hull else corners, height, bevel)
    except ShapeError as error:
        raise PerceptionError(f"the mask shows no usable object: {error}") from error
    if not USUAL_SIZES[0] <= prism.size <= USUAL_SIZES[1]:
        warnings.warn(f"the object is {100 * prism.size:.3g} cm long on the table: {LENGTHS}", stacklevel=2)
    origin = silhouette_origin(read_silhouette(flat))  # of the largest patch, without holes
    shift = low + GRID * np.array([origin[1] + 0.5, size[1] - 1 - origin[0] + 0.5])
    return PlacedObject(prism, planar_transform(shift, 0.0))


def pixel_size(
    camera: PinholeCamera, T_table_camera: Float[np.ndarray, "4 4"], point: Float[np.ndarray, "2"]
) -> float:
    """How much of the table a pixel covers at a point, along the line of sight, where it covers most [m]."""
    away = T_table_camera[:3, 3] - [*point, 0.0]
    return float(away @ away / away[2] / camera.fx)


def convex_hull_indices(columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Which of many pixels are corners of their convex hull."""
    points = np.stack([columns, rows], axis=-1).astype(np.int32)
    return np.ravel(cv2.convexHull(points, returnPoints=False))


def _lay_out(
    mask: Float[np.ndarray, "image_rows image_columns"],
    camera: PinholeCamera,
    T_table_camera: np.ndarray,
    low: np.ndarray,
    size: np.ndarray,
    height: float,
) -> Bool[np.ndarray, "rows columns"]:
    """A mask laid onto the plane at a height: x to the right, y up, pixels of `GRID`."""
    width, length = (int(n) for n in size)
    T_camera_table = invert_transform(T_table_camera)
    # From (column, row, 1) of the grid to points in the table frame, then in the camera frame.
    grid = [
        [GRID, 0.0, low[0] + 0.5 * GRID],
        [0.0, -GRID, low[1] + GRID * (length - 0.5)],
        [0.0, 0.0, height],
    ]
    rays = T_camera_table[:3, :3] @ np.array(grid)
    rays[:, 2] += T_camera_table[:3, 3]
    columns, rows = camera.undistortion(rays, (width, length))
    return cv2.remap(mask, columns, rows, cv2.INTER_LINEAR) >= 0.5


def fit_object(mask_object: PlacedObject, obj: ObjectModel) -> PlacedObject:
    """Where a known object lies whose outline was seen: the turn and shift that make the outlines agree best.

    Raises:
        PerceptionError: The outline is not the object's, or several turns explain it equally well.
    """
    seen = shapely.Polygon(mask_object.outline()[:, :2])
    known = shapely.Polygon(obj.corners)
    starts = [_start(seen, known, angle) for angle in np.linspace(-np.pi, np.pi, 36, endpoint=False)]
    starts.sort(key=lambda pose: -_overlap(seen, obj.corners, pose))
    refined = [_refine(seen, obj.corners, pose) for pose in starts[:8]]
    best = sorted(
        ((_overlap(seen, obj.corners, pose), pose) for pose in refined), key=lambda entry: -entry[0]
    )
    overlap, pose = best[0]
    if overlap < 0.9:
        raise PerceptionError(
            f"the outline that is seen overlaps the given object's by {100 * overlap:.0f} % only (areas "
            f"{1e4 * seen.area:.1f} and {1e4 * known.area:.1f} cm2): check shape, unit and mask"
        )
    turns = [abs((other[2] - pose[2] + np.pi) % (2 * np.pi) - np.pi) for _, other in best]
    twins = [
        entry for entry, turn in zip(best, turns, strict=True) if turn > 0.2 and entry[0] > overlap - 0.01
    ]
    if twins:
        raise PerceptionError(
            f"the object fits its outline in several ways (turned by {np.rad2deg(abs(twins[0][1][2] - pose[2])):.0f} "
            "degrees as well): give object_pose, the marker's place on it, in the marker layout"
        )
    return PlacedObject(obj, planar_transform(pose[:2], float(pose[2])))


def _moved(corners: np.ndarray, pose: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return corners @ np.array([[cosine, sine], [-sine, cosine]]) + pose[:2]


def _overlap(seen: shapely.Polygon, corners: np.ndarray, pose: np.ndarray) -> float:
    """Intersection over union."""
    other = shapely.Polygon(_moved(corners, pose))
    return float(seen.intersection(other).area / seen.union(other).area)


def _start(seen: shapely.Polygon, known: shapely.Polygon, angle: float) -> np.ndarray:
    """x, y and angle that put one centroid onto the other."""
    turned = _moved(np.array(known.centroid.coords), np.array([0.0, 0.0, angle]))[0]
    return np.array([*(np.array(seen.centroid.coords[0]) - turned), angle])


def _refine(seen: shapely.Polygon, corners: np.ndarray, start: np.ndarray) -> np.ndarray:
    """x, y and angle near a start for which points of one outline lie on the other, by least squares."""
    from scipy.optimize import least_squares

    ring = shapely.LinearRing(corners)
    along = np.linspace(0, 1, 80, endpoint=False)
    points = shapely.get_coordinates(shapely.line_interpolate_point(seen.exterior, along, normalized=True))

    def away(pose: np.ndarray) -> np.ndarray:

        cosine, sine = np.cos(pose[2]), np.sin(pose[2])
        back = (points - pose[:2]) @ np.array([[cosine, -sine], [sine, cosine]])
        return np.asarray(shapely.distance(ring, shapely.points(back)))

    return least_squares(away, start, loss="soft_l1", f_scale=0.002, max_nfev=40).x


def contact_at_pixel(
    placed: PlacedObject,
    pixel: tuple[float, float],
    camera: PinholeCamera,
    T_table_camera: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "2"]:
    """The point of an image as a point in the object frame [m]: it is taken to lie on the upper face's rim.

    Raises:
        PerceptionError: The line of sight does not meet that plane.
    """
    on_top = camera.on_plane(np.array([pixel], dtype=float), T_table_camera, placed.object.height)[0]
    if not np.isfinite(on_top).all():
        raise PerceptionError(f"pixel {pixel} looks past the table: give a pixel on the object's upper rim")
    in_table = np.array([*on_top, 0.0])
    return transform_points(invert_transform(placed.T_table_object), in_table[None])[0, :2]


def observe(placed: PlacedObject, contact: Float[np.ndarray, "2"]) -> Observation:
    """The lever-up at the outline's point nearest to a contact, and the exact view of it.

    Args:
        placed: The object on the table.
        contact: Where to lever, in the object frame [m].

    Raises:
        PerceptionError: The contact lies far from the outline.
    """
    try:
        action = LeverUp.nearest(placed.object, contact)
    except ActionError as error:
        raise PerceptionError(str(error)) from None
    return Observation(placed, action, TopDownView.of(placed.object, action))


def view_of_depth(
    depth: Float[np.ndarray, "rows columns"],
    mask: Bool[np.ndarray, "rows columns"],
    camera: PinholeCamera,
    T_action_camera: Float[np.ndarray, "4 4"],
    minimal_height: float = DEPTH_RIM,
) -> TopDownView:
    """The depth-enriched view (paper, section 5.5): what the mask's pixels see, of any shape, in the action frame.

    Raises:
        PerceptionError: The images do not match the camera.
        ViewError: No point of the object lies in the window.
    """
    camera.check_image(depth, "depth image")
    points = camera.deproject(np.where(mask, depth, 0.0), T_action_camera)
    return TopDownView.from_points(points, minimal_height)
