"""Record a motion while it happens, into the folder format that `interactions.recording_folder` defines."""

import re
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2

from foretrace.errors import PerceptionError, RobotError
from foretrace.interactions.recording_folder import DEPTH_UNIT, Frame, RecordingNotes, write_recording

PATIENCE = 5.0
"""How long the first and the last frame may take [s]."""


class VideoRecorder:
    """A camera that records between the beginning and the end of a ``with`` block, beside everything else.

    Args:
        source: Number of a camera, or whatever else OpenCV opens: a device, a stream's address, a video file.
        folder: An empty or new folder for the frames.

    Raises:
        RobotError: If the camera gives no image, or the folder is in use.
    """

    def __init__(self, source: str, folder: Path) -> None:
        if folder.exists() and any(folder.iterdir()):
            raise RobotError(f"{folder} is in use: choose another folder")
        number = int(source) if re.fullmatch(r"[0-9]{1,3}", source) else None
        self._capture = cv2.VideoCapture()
        opened = bool(source) and self._capture.open(source if number is None else number)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # the sensor's pixels, as everywhere
        if not opened or not self._capture.grab():
            raise RobotError(
                f"camera {source[:80]!r} gives no image: choose a number, a device or a file that OpenCV opens"
            )
        self._folder, self._first, self._finish = folder, threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._record, daemon=True)
        self.action_start: float | None = None
        """When the blade's path started, by this machine's monotonic clock [s]."""

    def __enter__(self) -> "VideoRecorder":
        self._thread.start()
        self._first.wait(PATIENCE)
        return self

    def __exit__(self, *exception: object) -> None:
        if not self._thread.is_alive():
            warnings.warn(
                f"the camera gave no more images before the motion was over: {self._folder}", stacklevel=2
            )
        self._finish.set()
        self._thread.join(PATIENCE)
        self._capture.release()
        RecordingNotes(DEPTH_UNIT, self.action_start).save(self._folder)

    def _record(self) -> None:
        try:
            write_recording(self._folder, self._frames(), RecordingNotes())
        except PerceptionError as error:  # the motion matters more than its recording
            warnings.warn(str(error), stacklevel=2)

    def _frames(self) -> Iterator[Frame]:
        """Frames as they come, stamped with this machine's monotonic clock."""
        while not self._finish.is_set():
            seen, image = self._capture.read()
            if not seen:
                return
            yield Frame(time.monotonic(), image)
            self._first.set()
