"""A film on disk: frames as pictures, their time stamps, and what is known about the camera and the markers.

``timestamps.csv`` has a line for every frame: time [s], file of the colour picture, and file of the depth picture or
nothing. ``camera.json``, ``markers.json``, ``film.json`` (unit of the depth pictures, time at which the blade starts),
``background.png`` (the table before the object was put there) and ``object.json`` are optional.
"""

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.errors import PerceptionError

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
"""Unit of the depth pictures that are written [m]."""
JPEG_QUALITY = 95


@dataclass(frozen=True)
class Frame:
    """One moment of a film."""

    time: float
    """Time stamp [s]."""
    picture: UInt8[np.ndarray, "rows columns 3"]
    """Colour: blue, green, red."""
    depth: Float[np.ndarray, "rows columns"] | None = None
    """Distance along the optical axis, pixel by pixel of the colour picture [m]; 0: nothing seen."""


@dataclass(frozen=True)
class FilmNotes:
    """What a film says about itself."""

    depth_unit: float = 0.001
    """Unit of the depth pictures [m]."""
    action_start: float | None = None
    """Time stamp at which the blade's path starts [s]; None: not known."""

    @classmethod
    def load(cls, folder: Path) -> "FilmNotes":
        """The notes in a folder; the defaults where there are none.

        Raises:
            PerceptionError: They are damaged.
        """
        path = folder / NOTES
        if not path.is_file():
            return cls()
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            start = values.get("action_start")
            return cls(float(values["depth_unit"]), None if start is None else float(start))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise PerceptionError(f"{path} cannot be read ({error!r}): give depth_unit in metres") from error


def write_picture(path: Path, picture: np.ndarray, options: Sequence[int] = ()) -> None:
    """Write a picture, in the format that its name ends in.

    Raises:
        PerceptionError: It cannot be written there.
    """
    if not cv2.imwrite(str(path), picture, options):
        raise PerceptionError(f"cannot write {path}: check the folder, its permissions and the free space")


def write_film(folder: Path, frames: Iterable[Frame], notes: FilmNotes) -> int:
    """Write a film's frames into a folder; returns how many.

    Args:
        folder: An empty or new folder.
        frames: The frames, in order.
        notes: What the film says about itself; its depth unit is that of `DEPTH_UNIT`.

    Raises:
        PerceptionError: A picture cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[tuple[str, str, str]] = []
    for number, frame in enumerate(frames):
        names = [f"colour-{number:05d}.jpg", "" if frame.depth is None else f"depth-{number:05d}.png"]
        write_picture(folder / names[0], frame.picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if frame.depth is not None:
            steps = np.clip(np.rint(frame.depth / DEPTH_UNIT), 0, 65535).astype(np.uint16)
            write_picture(folder / names[1], steps, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        rows.append((f"{frame.time:.6f}", names[0], names[1]))
    with open(folder / TIMES, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
    content: dict[str, Any] = {"depth_unit": DEPTH_UNIT, "action_start": notes.action_start}
    (folder / NOTES).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return len(rows)
