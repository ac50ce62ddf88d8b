"""From one photograph to what a predictor needs: the object, the lever-up and the view from above.

The camera's pose comes from markers on the table, or from the table in a depth image; the object from a background
image, from depth, or from the photograph alone.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, UInt8

from foretrace.errors import PerceptionError, check_choices, is_whole, shown
from foretrace.geometry import invert_transform, transform_points
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recording_folder import CAMERA, MARKERS, read_depth, read_image
from foretrace.objects import BEVEL
from foretrace.objects.prism import DEFAULT_HEIGHT
from foretrace.perception import masks
from foretrace.perception.markers import LEAST_SLANT, MarkerLayout, align_patterns, detect_markers
from foretrace.perception.overlay import PREDICTED, draw_overlay
from foretrace.perception.views import (
    Observation,
    check_height,
    contact_at_pixel,
    observe,
    place_object,
    view_of_depth,
)

MaskMethod = Literal["background", "threshold", "colour", "grabcut", "depth"]
Mask = Bool[np.ndarray, "rows columns"] | Float[np.ndarray, "rows columns"]
"""Pixels of an object, or which part of each it covers."""


@dataclass(frozen=True)
class PhotoConfig:
    """How an object is found in a photograph."""

    mask: MaskMethod | None = None
    """Method; by default grabcut if there is a box, otherwise background or depth, whichever image there is."""
    box: tuple[int, int, int, int] | None = None
    """Left column, upper row, width and height of a box round the object, for grabcut [pixel]."""
    height: float | None = None
    """Height of the object [m]; by default measured in the depth image, 0.02 without one."""
    hull: bool = False
    """Take the convex hull of the outline (paper, section 5.4)."""
    shadows: bool = True
    """Whether shadows are told from the object, for background."""
    flat: bool = True
    """Whether the object's top is level; otherwise the view has the heights of the depth image."""

    def __post_init__(self) -> None:
        check_choices(PerceptionError, self)
        if self.mask is not None and self.mask not in get_args(MaskMethod):
            raise PerceptionError(
                f"mask is {shown(self.mask)}: choose from {', '.join(get_args(MaskMethod))}"
            )
        if self.box is not None and not _is_box(self.box):
            raise PerceptionError(f"box is {shown(self.box)}: give column, row, width and height in pixels")
        if self.height is not None:
            check_height(self.height)


def _is_box(box: object) -> bool:
    return isinstance(box, tuple | list) and len(box) == 4 and all(is_whole(n, -(2**31), 2**31) for n in box)


@dataclass(frozen=True)
class PhotoView(Observation):
    """Object, lever-up and view of a photograph, and the camera that took it."""

    image: UInt8[np.ndarray, "rows columns 3"]
    """The photograph: blue, green, red."""
    camera: PinholeCamera
    """The camera."""
    T_table_camera: Float[np.ndarray, "4 4"]
    """Pose of the camera in the table frame."""
    flat: bool = True
    """Whether the object is a prism: otherwise its centre of mass is not known from its outline."""

    @property
    def height(self) -> float:
        """Height of the object [m]."""
        return self.placed.object.height

    @property
    def com(self) -> Float[np.ndarray, "3"] | None:
        """Centre of mass at rest in the action frame [m]; None where only the view determines it."""
        return self.com_in_action if self.flat else None

    @property
    def outline(self) -> Float[np.ndarray, "n 3"]:
        """Outline of the object's upper face in the action frame [m]."""
        return transform_points(invert_transform(self.T_table_action), self.placed.outline(self.height))

    @property
    def T_action_camera(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the camera in the action frame."""
        return invert_transform(self.T_table_action) @ self.T_table_camera

    def overlay(
        self,
        predicted: Float[np.ndarray, "time 3"] | None = None,
        radius: Float[np.ndarray, " time"] | None = None,
    ) -> UInt8[np.ndarray, "rows columns 3"]:
        """The photograph with the outline, and a predicted path, drawn into it.

        Args:
            predicted: Positions of the centre of mass in the action frame [m].
            radius: Radius of the prediction region about each of them [m].
        """
        paths = {} if predicted is None else {"predicted": (predicted, PREDICTED)}
        radii = None if radius is None or predicted is None else {"predicted": radius}
        return draw_overlay(self.image, self.camera, self.T_action_camera, self.outline, paths, radii=radii)


def observe_photo(
    image: UInt8[np.ndarray, "rows columns 3"],
    camera: PinholeCamera,
    contact: tuple[float, float] | None,
    *,
    layout: MarkerLayout | None = None,
    T_table_camera: Float[np.ndarray, "4 4"] | None = None,
    depth: Float[np.ndarray, "depth_rows depth_columns"] | None = None,
    background: UInt8[np.ndarray, "other_rows other_columns 3"] | None = None,
    config: PhotoConfig = PhotoConfig(),
) -> PhotoView:
    """Observe the object in a photograph.

    Args:
        image: The photograph: blue, green, red.
        camera: The camera that took it.
        contact: Column and row of the contact, on the object's upper rim. None: the largest object, at the middle of
            its longest edge.
        layout: Markers, of which those on the table place the camera.
        T_table_camera: Pose of the camera, if it is known; takes the place of a layout.
        depth: Distance along the optical axis, pixel by pixel of the photograph [m]; 0: not measured.
        background: The table without the object.
        config: How the object is found.

    Raises:
        PerceptionError: No camera pose or no object is found.
    """
    camera.check_image(image, "the photograph")
    if depth is None and not config.flat:
        raise PerceptionError(
            "an object whose top is not level needs a depth image: give one, or leave flat on"
        )
    if T_table_camera is None:
        T_table_camera = locate_camera(image, camera, layout, depth)
    heights = None if depth is None else masks.heights_above_table(depth, camera, T_table_camera)
    if contact is not None:
        _check_sight(camera, T_table_camera, contact)
    mask, rim = _find(image, contact, background, heights, config)
    if contact is None:
        rows, columns = np.nonzero(mask > 0.5)
        _check_sight(camera, T_table_camera, (float(columns.mean()), float(rows.mean())))
    height = config.height
    if height is None:
        height = DEFAULT_HEIGHT if heights is None else masks.object_height(heights, mask > 0.5)
    placed = place_object(mask, camera, T_table_camera, height, min(rim, 0.5 * height), config.hull)
    if contact is None:
        corners = placed.object.corners
        edges = np.roll(corners, -1, axis=0) - corners
        longest = int(np.linalg.norm(edges, axis=1).argmax())
        found = observe(placed, corners[longest] + edges[longest] / 2)
    else:
        found = observe(placed, contact_at_pixel(placed, contact, camera, T_table_camera))
    view = found.view
    if depth is not None and not config.flat:
        T_action_camera = invert_transform(found.T_table_action) @ T_table_camera
        view = view_of_depth(depth, mask > 0.5, camera, T_action_camera)
    return PhotoView(found.placed, found.action, view, image, camera, T_table_camera, config.flat)


def _check_sight(
    camera: PinholeCamera, T_table_camera: Float[np.ndarray, "4 4"], contact: tuple[float, float]
) -> None:
    """Refuse a photograph that is taken too flat: errors of height and outline then grow along the line of sight."""
    ray = T_table_camera[:3, :3] @ camera.rays(np.array([contact], dtype=float))[0]
    above = np.arcsin(-ray[2] / np.linalg.norm(ray))
    if above < LEAST_SLANT:
        raise PerceptionError(
            f"the photograph is taken from {np.rad2deg(above):.0f} degrees above the table, "
            f"{np.rad2deg(LEAST_SLANT):.0f} are needed: take it from higher up"
        )


def locate_camera(
    image: UInt8[np.ndarray, "rows columns 3"],
    camera: PinholeCamera,
    layout: MarkerLayout | None,
    depth: Float[np.ndarray, "depth_rows depth_columns"] | None,
) -> Float[np.ndarray, "4 4"]:
    """T_table_camera by the table's markers; by the table in the depth image where none are found.

    Without markers the table frame is that of `masks.find_table`.

    Raises:
        PerceptionError: Neither markers nor depth show the table.
    """
    if layout is not None:
        seen = align_patterns(image, detect_markers(image, layout.dictionary), layout.dictionary)
        try:
            from foretrace.perception.tracking import still_pose  # a quarter of a second to import

            return invert_transform(still_pose([seen], layout.table, camera))
        except PerceptionError as error:
            if depth is None:
                raise
            warnings.warn(f"the table is found by depth, since by markers: {error}", stacklevel=2)
    if depth is None:
        raise PerceptionError("neither a marker layout nor a depth image shows the table: give one of them")
    return masks.find_table(depth, camera)


def _find(
    image: UInt8[np.ndarray, "rows columns 3"],
    contact: tuple[float, float] | None,
    background: UInt8[np.ndarray, "other_rows other_columns 3"] | None,
    heights: Float[np.ndarray, "rows columns"] | None,
    config: PhotoConfig,
) -> tuple[Mask, float]:
    """The object, and the height at which it begins [m]."""
    method: MaskMethod = "grabcut" if config.box is not None or heights is None else "depth"
    if config.box is None and background is not None:
        method = "background"
    if config.mask is None and method == "grabcut" and config.box is None:
        raise PerceptionError(
            "nothing tells the object from the table: give --box LEFT TOP WIDTH HEIGHT round it, --background, "
            "--depth, or --mask colour or threshold"
        )
    method = config.mask or method
    if method == "background":
        if background is None:
            raise PerceptionError(
                "--mask background needs --background, an image of the table without the object"
            )
        return masks.find_by_background(image, background, contact, config.shadows), BEVEL.height
    if method == "depth":
        if heights is None:
            raise PerceptionError("--mask depth needs --depth, a depth image of the photograph's size")
        return masks.find_by_height(heights, contact), masks.DEPTH_RIM
    if method == "grabcut":
        if config.box is None:
            raise PerceptionError("--mask grabcut needs --box LEFT TOP WIDTH HEIGHT round the object")
        found = masks.mask_by_grabcut(image, config.box)
    elif method == "colour":
        if contact is None:
            raise PerceptionError(
                "--mask colour needs --contact-px COLUMN ROW, a pixel on the object's upper rim"
            )
        found = masks.mask_by_colour(image, contact)
    else:
        found = masks.mask_by_threshold(image)
    return masks.pick_object(found, contact), BEVEL.height


def open_photo(
    photo: Path,
    contact: tuple[float, float] | None,
    *,
    camera: Path | None = None,
    markers: Path | None = None,
    depth: Path | None = None,
    background: Path | None = None,
    config: PhotoConfig = PhotoConfig(),
) -> PhotoView:
    """Observe the object in the files of a photograph.

    Args:
        photo: The photograph.
        contact: Column and row of the contact, on the object's upper rim; None: as of `observe_photo`.
        camera: The camera's JSON file; by default ``camera.json`` beside the photograph.
        markers: Marker layout; by default ``markers.json`` beside the photograph. Not needed with a depth image.
        depth: Depth image: PNG of 16 bits in millimetres, or ``.npy`` in metres.
        background: Image of the table without the object.
        config: How the object is found.

    Raises:
        PerceptionError: A file is missing or damaged, or no camera pose or no object is found.
    """
    beside = photo.parent / MARKERS
    if markers is None and (depth is None or beside.is_file()):
        markers = beside
    return observe_photo(
        read_image(photo),
        PinholeCamera.load(camera or photo.parent / CAMERA),
        contact,
        layout=None if markers is None else MarkerLayout.load(markers),
        depth=None if depth is None else read_depth(depth),
        background=None if background is None else read_image(background),
        config=config,
    )
