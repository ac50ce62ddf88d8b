"""Drawn onto a camera's picture: markers, the object's outline, predicted and observed paths."""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.geometry import invert_transform
from foretrace.interactions.pinhole import PinholeCamera

PREDICTED, OBSERVED, OUTLINE, MARKER = (48, 39, 215), (80, 152, 26), (255, 255, 255), (0, 200, 255)
"""Blue, green, red: the paper's red and green, white and yellow."""
SHIFT = 4
"""Fractional bits of OpenCV's drawing."""


def draw_overlay(
    picture: UInt8[np.ndarray, "rows columns 3"],
    camera: PinholeCamera,
    T_frame_camera: Float[np.ndarray, "4 4"],
    outline: Float[np.ndarray, "n 3"] | None = None,
    paths: Mapping[str, tuple[Float[np.ndarray, "time 3"], tuple[int, int, int]]] | None = None,
    markers: Float[np.ndarray, "k 4 2"] | None = None,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """A copy of a picture with what is known of the scene drawn into it.

    Args:
        picture: The picture.
        camera: The camera that took it.
        T_frame_camera: Its pose in the frame of outline and paths.
        outline: Closed line round the object [m].
        paths: By their names, positions over time [m] and a colour (blue, green, red).
        markers: Corners of markers [pixel].
    """
    drawn = picture.copy()
    T_camera_frame = invert_transform(T_frame_camera)
    width = max(1, round(camera.width / 640))
    for corners in np.zeros((0, 4, 2)) if markers is None else markers:
        _line(drawn, corners, MARKER, width, closed=True)
    if outline is not None:
        _line(drawn, camera.project(outline, T_camera_frame), OUTLINE, width, closed=True)
    for row, (name, (path, colour)) in enumerate((paths or {}).items()):
        # Each path thinner than the one before, so that none hides another.
        _line(
            drawn,
            camera.project(path, T_camera_frame),
            colour,
            max(2, 4 * width - 3 * width * row),
            closed=False,
        )
        scale = camera.width / 1280
        place = (round(24 * scale), round((40 + 38 * row) * scale))
        for thick, ink in ((5, (255, 255, 255)), (2, colour)):
            cv2.putText(
                drawn,
                name,
                place,
                cv2.FONT_HERSHEY_SIMPLEX,
                scale,
                ink,
                max(1, round(thick * scale)),
                cv2.LINE_AA,
            )
    return drawn


def _line(
    picture: np.ndarray, pixels: np.ndarray, colour: tuple[int, int, int], width: int, closed: bool
) -> None:
    there = pixels[np.isfinite(pixels).all(axis=1)]
    points = np.rint(there * 2**SHIFT).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(picture, [points], closed, colour, width, cv2.LINE_AA, SHIFT)
