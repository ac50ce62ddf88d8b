"""A recording on disk: frames as images, their time stamps, and what is known about the camera and the markers.

``timestamps.csv`` has a line for every frame: time [s], file of the colour image, and file of the depth image or
nothing. ``camera.json``, ``markers.json``, ``film.json`` (unit of the depth images, time at which the blade starts),
``background.png`` (the table before the object was put there) and ``object.json`` are optional.
"""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from msgspec import Meta

from foretrace import images
from foretrace.errors import PerceptionError
from foretrace.files import atomic_path, read_json, write_json
from foretrace.schema import Finite

TIMES = "timestamps.csv"
COLUMNS = ("time_s", "colour", "depth")
CAMERA, MARKERS, NOTES, BACKGROUND, OBJECT = (
    "camera.json",
    "markers.json",
    "film.json",
    "background.png",
    "object.json",
)
DEPTH_UNIT = 0.0001
"""Unit of the depth images that are written [m]."""
NEAREST, FARTHEST = 0.01, 20.0
"""Median depths beyond are of another unit [m]."""
JPEG_QUALITY = 95


@dataclass(frozen=True)
class Frame:
    """One moment of a film."""

    time: float
    """Time stamp [s]."""
    image: UInt8[np.ndarray, "rows columns 3"]
    """Colour: blue, green, red."""
    depth: Float[np.ndarray, "rows columns"] | None = None
    """Distance along the optical axis, pixel by pixel of the colour image [m]; 0: nothing seen."""


class Notes(TypedDict):
    """Schema of the notes."""

    depth_unit: Annotated[float, Meta(gt=0, le=1)]
    action_start: NotRequired[Finite | None]


@dataclass(frozen=True)
class RecordingNotes:
    """Unit of the depth images and start of the action."""

    depth_unit: float = 0.001
    """Unit of the depth images [m]."""
    action_start: float | None = None
    """Time stamp at which the blade's path starts [s]; None: not known."""

    @classmethod
    def load(cls, folder: Path) -> "RecordingNotes":
        """The notes in a folder; the defaults where there are none.

        Raises:
            PerceptionError: They are damaged.
        """
        path = folder / NOTES
        if not path.is_file():
            return cls()
        values = read_json(path, Notes, PerceptionError, "give depth_unit in metres")
        return cls(values["depth_unit"], values.get("action_start"))

    def save(self, folder: Path) -> None:
        """Write the notes into a folder."""
        write_json(folder / NOTES, asdict(self))


def read_image(path: str | Path) -> UInt8[np.ndarray, "rows columns 3"]:
    """An image as blue, green and red, its pixels as the sensor gave them.

    Raises:
        PerceptionError: It is missing or cannot be read.
    """
    return images.read_colour(path, PerceptionError)


def read_depth(path: Path) -> Float[np.ndarray, "rows columns"]:
    """A depth image [m], 0 where nothing was measured.

    From a PNG or TIFF, or a ``.npy`` array: whole numbers in millimetres, or in the unit that the notes beside it name,
    fractions in metres (REP 118).

    Raises:
        PerceptionError: It is missing, cannot be read, is no such image, or its unit cannot be right.
    """
    remedy = "give a PNG of 16 bits per pixel in millimetres, or a .npy array of fractions in metres"
    if not path.is_file():
        raise PerceptionError(f"depth image {path} does not exist: {remedy}")
    if path.suffix.lower() == ".npy":
        try:
            values: Any = np.load(path, allow_pickle=False, mmap_mode="r")  # whose size is that of the file
        except (OSError, ValueError, TypeError, EOFError) as error:
            raise PerceptionError(f"cannot read a depth image from {path} ({error}): {remedy}") from error
    else:
        values = images.read_image(path, PerceptionError, remedy=remedy).values
    if getattr(values, "ndim", 0) != 2:
        raise PerceptionError(
            f"{path} has shape {np.shape(values)}, a depth image has rows and columns: {remedy}"
        )
    if values.dtype.kind not in "iuf" or values.dtype.itemsize < 2:
        raise PerceptionError(
            f"cannot read a depth image from {path}, which holds an image of {values.dtype}: {remedy}"
        )
    images.check_pixels(path, values.shape[0], values.shape[1], PerceptionError)
    unit = 1.0 if values.dtype.kind == "f" else RecordingNotes.load(path.parent).depth_unit
    metres = np.array(values, dtype=float) * unit
    metres = np.where(np.isfinite(metres) & (metres > 0), metres, 0.0)
    usual = float(np.median(metres[metres > 0])) if metres.any() else NEAREST
    if not NEAREST <= usual <= FARTHEST:
        raise PerceptionError(
            f"{path} has a median depth of {usual:.3g} m, in units of {unit:g} m: write fractions in metres or whole "
            f"numbers in millimetres, or name their depth_unit in {NOTES}"
        )
    return metres


def write_image(path: Path, image: np.ndarray, options: Sequence[int] = ()) -> None:
    """Write an image, in the format that its name ends in.

    Raises:
        PerceptionError: It cannot be written there.
    """
    if not cv2.imwrite(str(path), image, options):
        raise PerceptionError(f"cannot write {path}: check the folder, its permissions and the free space")


def write_recording(folder: Path, frames: Iterable[Frame], notes: RecordingNotes) -> int:
    """Write a recording's frames into a folder; returns how many. What was written stays, whatever ends it.

    Args:
        folder: An empty or new folder.
        frames: The frames, in order.
        notes: Start of the action; the depth unit becomes `DEPTH_UNIT`.

    Raises:
        PerceptionError: An image cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[tuple[str, str, str]] = []
    try:
        for number, frame in enumerate(frames):
            names = [f"colour-{number:05d}.jpg", "" if frame.depth is None else f"depth-{number:05d}.png"]
            write_image(folder / names[0], frame.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            if frame.depth is not None:
                steps = np.clip(np.rint(frame.depth / DEPTH_UNIT), 0, 65535).astype(np.uint16)
                write_image(folder / names[1], steps, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            rows.append((f"{frame.time:.6f}", names[0], names[1]))
    finally:
        with atomic_path(folder / TIMES) as partial, open(partial, "w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([COLUMNS, *rows])
        RecordingNotes(DEPTH_UNIT, notes.action_start).save(folder)
    return len(rows)
