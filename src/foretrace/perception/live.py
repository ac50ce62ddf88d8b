"""Poses of an object with markers while it is filmed: the tracker of recordings, over the last moments alone."""

import re
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.errors import PerceptionError
from foretrace.geometry import invert_transform
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recording_folder import Frame
from foretrace.perception.markers import Detections, MarkerLayout, align_patterns, detect_markers
from foretrace.perception.recordings import open_recording
from foretrace.perception.tracking import TrackConfig, still_pose, track

WINDOW = 0.5
"""The last frames within this time are followed together [s]."""
TABLE_TIME = 0.2
"""The table's markers are looked at for this long [s]; the camera stands still."""


def live_frames(source: str) -> Iterator[Frame]:
    """Frames of a camera as they come, stamped with this machine's monotonic clock; or those of a recording.

    Args:
        source: Number of a camera for OpenCV, or the path of a video or folder of frames, which stands for one.

    Raises:
        PerceptionError: The camera gives no image, or the recording cannot be read.
    """
    if not re.fullmatch(r"[0-9]{1,3}", source):
        yield from open_recording(Path(source)).frames()
        return
    capture = cv2.VideoCapture(int(source))
    try:
        seen, image = capture.read()
        if not seen:
            raise PerceptionError(f"camera {source} gives no image: choose the number of another one")
        while seen:
            yield Frame(time.monotonic(), image)
            seen, image = capture.read()
    finally:
        capture.release()


class LiveTracker:
    """Follows the object frame by frame; a pose is known as soon as its frame is.

    Args:
        camera: The camera, which stands still.
        layout: The markers on table and object.
        config: How they are followed; by default as in recordings.
    """

    def __init__(
        self, camera: PinholeCamera, layout: MarkerLayout, config: TrackConfig | None = None
    ) -> None:
        self._camera, self._layout, self._config = camera, layout, config or TrackConfig()
        self._recent: deque[tuple[float, Detections]] = deque()
        self._table: list[Detections] = []
        self._first: float | None = None
        self._T_table_camera: Float[np.ndarray, "4 4"] | None = None

    def update(
        self, time: float, image: UInt8[np.ndarray, "rows columns 3"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """The object's markers in the table frame; None where they are not seen, or the table is not yet known.

        Args:
            time: When the image was taken [s]; later than the one before.
            image: The image.

        Raises:
            PerceptionError: The image has another size than the camera's, or the table's markers are not where the
                layout has them.
        """
        self._camera.check_image(image, f"the image at {time:.3f} s")
        self._first = time if self._first is None else self._first
        known, layout = self._T_table_camera is not None, self._layout
        wanted = {*layout.object.ids} | (set() if known else {*layout.table.ids})
        seen = align_patterns(image, detect_markers(image, layout.dictionary), layout.dictionary, wanted)
        self._recent.append((time, seen))
        while self._recent[0][0] < time - WINDOW:
            self._recent.popleft()
        if not known:
            self._table.append(seen)
            if time - self._first < TABLE_TIME:
                return None
            self._T_table_camera = invert_transform(
                still_pose(self._table, layout.table, self._camera, self._config)
            )
        times = np.array([each for each, _ in self._recent])
        try:
            followed = track(
                times, [each for _, each in self._recent], layout.object, self._camera, self._config
            )
        except PerceptionError:  # the markers are seen in fewer than two frames
            return None
        if not followed.seen[-1]:
            return None
        assert self._T_table_camera is not None
        return self._T_table_camera @ followed.T_camera_body[-1]
