"""Recordings to read: a folder of frames with time stamps, a video, or a ROS bag."""

import csv
import io
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from foretrace.errors import PerceptionError, shown
from foretrace.files import read_text
from foretrace.interactions import recording_folder
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recording_folder import Frame, RecordingNotes, read_depth, read_image
from foretrace.perception import realsense
from foretrace.perception.videos import VIDEOS, check_whole, video_frames

BAGS = (".bag", ".mcap", ".db3")
UNREADY = {
    ".active": "was never closed: repair it with `rosbag reindex`, and rename it to .bag",
    ".zstd": "is compressed: unpack it with `zstd -d`, or give the bag's folder with its metadata.yaml",
}
"""Endings of bags that cannot be read as they are."""


@dataclass(frozen=True)
class Recording:
    """Frames in order, and what lies beside them."""

    path: Path
    """Where it was read from."""
    frames: Callable[[], Iterator[Frame]]
    """Reads the frames, from the beginning each time."""
    notes: RecordingNotes = field(default_factory=RecordingNotes)
    """Its notes."""
    camera: PinholeCamera | None = None
    """The camera, if the recording names it."""
    no_camera: str = ""
    """Why it names none, where there is a reason."""

    def beside(self, name: str) -> Path | None:
        """A file that belongs to the recording, if it is there."""
        folders = [self.path] if self.path.is_dir() else []
        if not (self.path / recording_folder.TIMES).is_file():  # a file, or a bag that is a folder
            folders.append(self.path.parent)
        return next((folder / name for folder in folders if (folder / name).is_file()), None)

    def background(self) -> UInt8[np.ndarray, "rows columns 3"] | None:
        """The table before the object was put there, if the recording has it."""
        path = self.beside(recording_folder.BACKGROUND)
        return None if path is None else read_image(path)


def open_recording(path: str | Path, topic: str | None = None, depth_topic: str | None = None) -> Recording:
    """A recording of any of the kinds that are read.

    Args:
        path: A folder with ``timestamps.csv``, a video file, a bag of ROS 1 or ROS 2, or a RealSense
            recording.
        topic: Image topic of a bag; needed if it has several.
        depth_topic: Topic of a bag's depth images; by default the one that is aligned with the images, if any.

    Raises:
        PerceptionError: There is none, or it is of no known kind.
    """
    path = Path(path)
    if not path.exists():
        raise PerceptionError(f"no recording at {path}: check the path")
    if path.suffix.lower() in BAGS and path.is_file() and realsense.is_recording(path):
        frames, camera = realsense.open_realsense(path)
        return Recording(path, frames, camera=camera)
    if (bag := _bag_at(path)) is not None:
        from foretrace.perception.bags import open_bag

        frames, camera, no_camera = open_bag(bag, topic, depth_topic)
        return Recording(path, frames, camera=camera, no_camera=no_camera)
    if path.is_dir():
        notes = RecordingNotes.load(path)
        stored = path / recording_folder.CAMERA
        camera = PinholeCamera.load(stored) if stored.is_file() else None
        rows = _read_times(path)
        return Recording(path, lambda: _folder_frames(path, rows), notes, camera)
    if path.suffix.lower() in VIDEOS:
        check_whole(path)
        return Recording(path, lambda: video_frames(path))
    kinds = (
        f"a folder with {recording_folder.TIMES}, a video ({', '.join(VIDEOS)}) or a bag ({', '.join(BAGS)})"
    )
    raise PerceptionError(f"{path} is no recording that can be read: give {kinds}")


def _bag_at(path: Path) -> Path | None:
    """The bag that a path means, if any: itself, or the only one in a folder that says nothing else."""
    if path.suffix.lower() in BAGS or (path.is_dir() and (path / "metadata.yaml").is_file()):
        return path
    if closed := UNREADY.get(path.suffix.lower()):
        raise PerceptionError(f"{path} {closed}")
    if not path.is_dir() or (path / recording_folder.TIMES).exists():
        return None
    inside = sorted(file for file in path.iterdir() if file.suffix.lower() in BAGS)
    if len(inside) > 1:
        names = ", ".join(file.name for file in inside[:3])
        raise PerceptionError(
            f"{path} has {len(inside)} bags ({names}) and no metadata.yaml: name one of them"
        )
    return inside[0] if inside else None


def _read_times(folder: Path) -> list[tuple[float, str, str]]:
    """Time [s], image and depth image of each frame; spreadsheets write ``;`` and decimal commas, too."""
    path, names = folder / recording_folder.TIMES, ", ".join(recording_folder.COLUMNS)
    text = read_text(path, PerceptionError, f"write a line per frame with {names}")
    delimiter = max(",;\t", key=text.partition("\n")[0].count)
    lines = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True)
    try:
        head = [name.strip().lower() for name in next(lines, [])]
        if missing := [name for name in ("time_s", "colour") if name not in head]:
            raise PerceptionError(
                f"{path} lacks the column {missing[0]} (its first line is {shown(','.join(head))}): "
                f"its columns are {names}"
            )
        found = [(lines.line_num, line) for line in lines if any(line)]
    except csv.Error as error:
        raise PerceptionError(
            f"{path}, line {lines.line_num} cannot be read ({error}): its columns are {names}"
        ) from error
    if not found:
        raise PerceptionError(f"{path} lists no frame: write a line per frame with {names}")
    return [_time_and_images(f"{path}, line {number}", head, line) for number, line in found]


def _time_and_images(place: str, head: list[str], line: list[str]) -> tuple[float, str, str]:
    if len(line) > len(head):
        raise PerceptionError(
            f"{place} has {len(line)} entries, the first line {len(head)}: write times with a point, "
            "and names with a comma in quotes"
        )
    row = dict(zip(head, line, strict=False))
    stated = row.get("time_s", "").strip()
    try:
        time = float(stated.replace(",", "."))
    except ValueError:
        time = math.nan
    if not math.isfinite(time):
        raise PerceptionError(f"{place}: time_s is {shown(stated)}: give the time in seconds")
    if not (colour := row.get("colour", "").strip()):
        raise PerceptionError(f"{place}: colour is empty: name the frame's image")
    return time, colour, row.get("depth", "").strip()


def _folder_frames(folder: Path, rows: list[tuple[float, str, str]]) -> Iterator[Frame]:
    for time, colour, depth in rows:
        yield Frame(time, read_image(folder / colour), read_depth(folder / depth) if depth else None)
