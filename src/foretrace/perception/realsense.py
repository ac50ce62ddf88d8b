"""RealSense cameras and their recordings, through the maker's library (``pip install foretrace[realsense]``).

Depth is aligned with the colour images by that library, which has the poses of the two sensors. Tested on
recordings of a virtual camera only.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from foretrace.errors import PerceptionError, check_ranges
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recording_folder import Frame
from foretrace.perception.bags import TOGETHER

LOOK = 1 << 22
"""Bytes at either end of a bag that are searched for the names of its topics."""
SILENCE = 5000
"""Longest time without an image [ms]."""
GLANCE = 200
"""Time between two checks whether a recording has ended [ms]."""
WARM_UP = 30
"""Frames after the start that are thrown away: a camera needs them to find its exposure."""


@dataclass(frozen=True)
class CaptureConfig:
    """How a camera records.

    Raises:
        PerceptionError: A value is out of its range.
    """

    width: int = 1280
    """Columns of the images."""
    height: int = 720
    """Rows of the images."""
    frames_per_second: int = 30
    """Frames per second."""
    depth_every: int = 10
    """Colour images from one with depth to the next; 0: no depth."""
    serial: str | None = None
    """Serial number of the camera; None: the only one."""

    def __post_init__(self) -> None:
        limits = dict.fromkeys(("width", "height"), (1, 10_000))
        limits |= {"frames_per_second": (1, 1000), "depth_every": (0, 10_000)}
        check_ranges(PerceptionError, "capture", self, limits, "give a whole number")


def is_recording(path: Path) -> bool:
    """Whether a file was recorded by a RealSense camera: its topics begin with the device."""
    with open(path, "rb") as file:
        ends = file.read(LOOK)
        file.seek(max(0, path.stat().st_size - LOOK))
        ends += file.read(LOOK)
    return b"/device_0/" in ends


def open_realsense(path: Path) -> tuple[Callable[[], Iterator[Frame]], PinholeCamera | None]:
    """Frames of a RealSense recording, and its colour camera as the maker calibrated it.

    Args:
        path: The recording: ``.db3``, or ``.bag`` from before 2026.

    Raises:
        PerceptionError: The recording is damaged or has no colour, or the library is not installed.
    """
    with _Playing(path) as playing:
        camera = playing.camera
    return lambda: _recorded(path), camera


def _recorded(path: Path) -> Iterator[Frame]:
    with _Playing(path) as playing:
        yield from playing.frames()


def _library() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        raise PerceptionError(
            f"RealSense cameras and their recordings need pyrealsense2 ({error}): `pip install foretrace[realsense]`, "
            "and the system's libusb 1.0"
        ) from error
    return pyrealsense2


def hold(recorded: Any) -> None:
    """Hold a recording before the pipeline that plays it starts: until all streams are open, frames are lost."""
    recorded.set_real_time(False)
    recorded.pause()


def release(recorded: Any) -> None:
    """Let the frames of a recording come. The library waits until they are read, so it waits in a thread."""

    def resume() -> None:
        with suppress(RuntimeError):  # where reading has ended before
            recorded.resume()

    Thread(target=resume, daemon=True).start()


class _Playing:
    """A recording being played, as fast as it is read."""

    def __init__(self, path: Path):
        self._path, self._rs = path, _library()
        self._pipeline = self._rs.pipeline()

    def __enter__(self) -> "_Playing":
        config = self._rs.config()
        try:
            config.enable_device_from_file(str(self._path), repeat_playback=False)
            found = config.resolve(self._rs.pipeline_wrapper(self._pipeline))
            hold(found.get_device().as_playback())
            self._profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise PerceptionError(
                f"RealSense recording {self._path} cannot be read ({error}): it is cut off; record or copy it again"
            ) from error
        return self

    def __exit__(self, *exception: object) -> None:
        self._pipeline.stop()

    @property
    def camera(self) -> PinholeCamera | None:
        """The colour camera."""
        return _camera(self._rs, self._profile, str(self._path))

    def frames(self) -> Iterator[Frame]:
        """The frames, to the recording's end."""
        align = self._rs.align(self._rs.stream.color)
        return (_frame(frames, align) for frames in _once_each(self._framesets()))

    def _framesets(self) -> Iterator[Any]:
        recorded, silence = self._profile.get_device().as_playback(), 0
        release(recorded)
        while silence < SILENCE:
            there, frames = self._pipeline.try_wait_for_frames(GLANCE)
            if there:
                silence = 0
                yield frames
            elif recorded.current_status() == self._rs.playback_status.stopped:
                return
            silence += 0 if there else GLANCE
        raise PerceptionError(
            f"RealSense recording {self._path} gives no more images before its end: record or copy it again"
        )


def _once_each(framesets: Iterator[Any]) -> Iterator[Any]:
    """One set for each colour image: the library repeats one image beside the next of the other kind."""
    held: Any = None
    for frames in framesets:
        colour = frames.get_color_frame()
        if not colour:
            continue
        if held is not None and held.get_color_frame().get_frame_number() == colour.get_frame_number():
            held = min(held, frames, key=_apart)
            continue
        if held is not None:
            yield held
        held = frames
    if held is not None:
        yield held


def _apart(frames: Any) -> float:
    """Time between a set's colour and depth [s]."""
    depth = frames.get_depth_frame()
    return abs(depth.get_timestamp() - frames.get_color_frame().get_timestamp()) / 1000 if depth else np.inf


def _frame(frames: Any, align: Any) -> Frame:
    """A set as a frame; its depth as the colour camera would see it, unless there is nothing to align it with."""
    metres = None
    if align is not None and _apart(frames) <= TOGETHER:
        frames = align.process(frames)
        depth = frames.get_depth_frame()
        metres = np.array(depth.get_data()).astype(float) * depth.get_units()
    colour = frames.get_color_frame()
    image, kind = np.array(colour.get_data()), colour.get_profile().format().name
    if kind not in ("rgb8", "bgr8"):
        raise PerceptionError(f"RealSense recording has colour as {kind}: record it as rgb8 or bgr8")
    ordered = image if kind == "bgr8" else np.ascontiguousarray(image[..., ::-1])
    return Frame(colour.get_timestamp() / 1000, ordered, metres)


def _camera(rs: Any, profile: Any, name: str) -> PinholeCamera | None:
    """The colour camera as its maker calibrated it; None where its lens is described in another way than OpenCV's."""
    colours = [one for one in profile.get_streams() if one.stream_type() == rs.stream.color]
    if not colours:
        raise PerceptionError(f"{name} has no colour stream: record with colour and depth")
    found = colours[0].as_video_stream_profile().get_intrinsics()
    bent = any(found.coeffs)
    if bent and found.model != rs.distortion.brown_conrady:
        return None
    lens = tuple(float(value) for value in found.coeffs) if bent else ()
    return PinholeCamera(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy, lens)


class LiveCamera:
    """A RealSense camera that records within a ``with`` block.

    Args:
        config: How it records.

    Raises:
        PerceptionError: There is no such camera, it cannot record so, or the library is not installed.
    """

    def __init__(self, config: CaptureConfig = CaptureConfig()):
        self._config, self._rs = config, _library()
        self.lost = 0
        """Frames that came too fast to be kept."""

    def __enter__(self) -> "LiveCamera":
        rs, config = self._rs, self._rs.config()
        if not len(rs.context().query_devices()):  # the pipeline would look for a quarter of a minute
            raise PerceptionError(
                "no RealSense camera is connected: plug it into a USB 3 port; on Linux, librealsense's udev rules let "
                "you use it"
            )
        size = (self._config.width, self._config.height)
        if self._config.serial is not None:
            config.enable_device(self._config.serial)
        config.enable_stream(rs.stream.color, *size, rs.format.bgr8, self._config.frames_per_second)
        if self._config.depth_every:
            config.enable_stream(rs.stream.depth, rs.format.z16, self._config.frames_per_second)
        self._pipeline = rs.pipeline()
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            which = "" if self._config.serial is None else f" {self._config.serial}"
            raise PerceptionError(
                f"no RealSense camera{which} records {size[0]} x {size[1]} pixels {self._config.frames_per_second} "
                f"times a second ({error}): close other programs that use it, check its serial number and the USB 3 "
                "port, or choose another size"
            ) from error
        self.camera = _camera(rs, profile, "the RealSense camera")
        """Its colour camera, as its maker calibrated it; None where its lens is described otherwise."""
        return self

    def __exit__(self, *exception: object) -> None:
        self._pipeline.stop()

    def frames(self, until: Callable[[float], bool]) -> Iterator[Frame]:
        """Frames as they come.

        Args:
            until: Whether to stop, from the time since the first frame [s].

        Raises:
            PerceptionError: The camera falls silent.
        """
        align, first, last = self._rs.align(self._rs.stream.color), None, None
        for number, frames in enumerate(_once_each(iter(self._next, None)), -WARM_UP):
            if number < 0:
                continue
            with_depth = self._config.depth_every and number % self._config.depth_every == 0
            frame = _frame(frames, align if with_depth else None)
            first = frame.time if first is None else first
            if until(frame.time - first):
                return
            shown = frames.get_color_frame().get_frame_number()
            self.lost += 0 if last is None else shown - last - 1
            last = shown
            yield frame

    def _next(self) -> Any:
        try:
            return self._pipeline.wait_for_frames(SILENCE)
        except RuntimeError as error:
            raise PerceptionError(
                f"the RealSense camera gives no images ({error}): plug it in again"
            ) from error
