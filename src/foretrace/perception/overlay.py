"""Drawn onto a camera's image: markers, the object's outline, predicted and observed paths."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.errors import PerceptionError
from foretrace.geometry import invert_transform, transform_points
from foretrace.interactions.pinhole import PinholeCamera

PREDICTED, OBSERVED, OUTLINE, MARKER = (48, 39, 215), (80, 152, 26), (255, 255, 255), (0, 200, 255)
"""Blue, green, red: the paper's red and green, white and yellow."""
SHIFT = 4
"""Fractional bits of OpenCV's drawing."""
TUBE = 0.3
"""Opacity of a tube."""


def draw_overlay(
    image: UInt8[np.ndarray, "rows columns 3"],
    camera: PinholeCamera,
    T_frame_camera: Float[np.ndarray, "4 4"],
    outline: Float[np.ndarray, "n 3"] | None = None,
    paths: Mapping[str, tuple[Float[np.ndarray, "time 3"], tuple[int, int, int]]] | None = None,
    markers: Float[np.ndarray, "k 4 2"] | None = None,
    radii: Mapping[str, Float[np.ndarray, " time"]] | None = None,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """A copy of an image with what is known of the scene drawn into it.

    Args:
        image: The image.
        camera: The camera that took it.
        T_frame_camera: Its pose in the frame of outline and paths.
        outline: Closed line round the object [m].
        paths: By their names, positions over time [m] and a colour (blue, green, red).
        markers: Corners of markers [pixel].
        radii: For some of the paths, how far off each position may be [m]: drawn as a translucent tube.
    """
    drawn = image.copy()
    T_camera_frame = invert_transform(T_frame_camera)
    width = max(1, round(camera.width / 640))
    for corners in np.zeros((0, 4, 2)) if markers is None else markers:
        _line(drawn, corners, MARKER, width, closed=True)
    if outline is not None:
        _line(drawn, camera.project(outline, T_camera_frame), OUTLINE, width, closed=True)
    for name, radius in (radii or {}).items():
        path, colour = (paths or {})[name]
        _tube(drawn, camera, transform_points(T_camera_frame, path), radius, colour)
    scale, font = camera.width / 1280, cv2.FONT_HERSHEY_SIMPLEX
    for row, (name, (path, colour)) in enumerate((paths or {}).items()):
        # Each path thinner than the one before, so that none hides another.
        thin = max(2, 4 * width - 3 * width * row)
        _line(drawn, camera.project(path, T_camera_frame), colour, thin, closed=False)
        place = (round(24 * scale), round((40 + 38 * row) * scale))
        # A thicker text as its border would be wider, too: OpenCV 5 spaces bold letters farther apart.
        text = np.zeros(drawn.shape[:2], dtype=np.uint8)
        cv2.putText(text, name, place, font, scale, 255, max(1, round(2 * scale)), cv2.LINE_AA)
        border = cv2.dilate(text, np.ones((1 + 2 * max(1, round(1.5 * scale)),) * 2, dtype=np.uint8))
        for cover, ink in ((border, OUTLINE), (text, colour)):
            where = cover > 0
            share = cover[where][:, None] / 255
            drawn[where] = np.rint((1 - share) * drawn[where] + share * np.array(ink))
    return drawn


def _line(
    image: np.ndarray, pixels: np.ndarray, colour: tuple[int, int, int], width: int, closed: bool
) -> None:
    there = pixels[np.isfinite(pixels).all(axis=1)]
    points = np.rint(there * 2**SHIFT).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(image, [points], closed, colour, width, cv2.LINE_AA, SHIFT)


def _tube(
    image: np.ndarray,
    camera: PinholeCamera,
    path: Float[np.ndarray, "time 3"],
    radius: Float[np.ndarray, " time"],
    colour: tuple[int, int, int],
) -> None:
    """A path in the camera frame as thick as it is uncertain: spheres, and what lies between neighbours."""
    there = np.isfinite(path).all(axis=1) & np.isfinite(radius) & (path[:, 2] > 0)
    centres, sizes = camera.project(path[there], np.eye(4)), camera.fx * radius[there] / path[there, 2]
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.column_stack([np.cos(around), np.sin(around)])
    discs = centres[:, None] + sizes[:, None, None] * circle  # (time, 24, 2)
    covered = np.zeros(image.shape[:2], dtype=np.uint8)
    for pair in zip(discs, [*discs[1:], *discs[-1:]], strict=True):
        hull = cv2.convexHull(np.concatenate(pair).astype(np.float32))
        cv2.fillConvexPoly(covered, np.rint(hull * 2**SHIFT).astype(np.int32), 255, cv2.LINE_8, SHIFT)
    inside = covered > 0
    image[inside] = np.rint((1 - TUBE) * image[inside] + TUBE * np.array(colour)).astype(np.uint8)


def write_video(path: Path, images: Iterable[UInt8[np.ndarray, "rows columns 3"]], rate: float) -> int:
    """Writes images (blue, green, red) of one size as an MP4; returns how many.

    Args:
        path: The file.
        images: The images, in order.
        rate: Images per second.

    Raises:
        PerceptionError: The library that writes videos is not installed, or the file cannot be written.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise PerceptionError(f"cannot write {path}: MP4 needs `pip install foretrace[video]`") from error
    writer: Any = None
    count = 0
    try:
        for image in images:
            if writer is None:
                path.parent.mkdir(parents=True, exist_ok=True)
                size: Any = (image.shape[1], image.shape[0])
                fps: Any = rate  # whole numbers are asked for, fractions taken
                writer = imageio_ffmpeg.write_frames(str(path), size, fps=fps, macro_block_size=2)
                writer.send(None)
            try:
                writer.send(np.ascontiguousarray(image[..., ::-1]))
            except OSError as error:  # with all that ffmpeg had to say
                raise PerceptionError(
                    f"cannot write {path}: check the folder, its permissions and the free space"
                ) from error
            count += 1
    finally:
        if writer is not None:
            writer.close()
    return count
