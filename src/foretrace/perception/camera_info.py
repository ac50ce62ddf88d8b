"""The camera that a bag's ``camera_info`` names: which of several belongs to an image topic, and what it says."""

import re
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from foretrace.errors import PerceptionError, shown
from foretrace.interactions.lens_models import lens_of
from foretrace.interactions.pinhole import PinholeCamera

TRANSPORTS = ("compressed", "compresseddepth", "theora", "ffmpeg", "zstd", "raw")
"""Last parts of topics that image_transport adds to that of the images."""
RECTIFIED = re.compile(r"(^|_)(rect|rectified|undist|undistorted)(_|$)")
"""In a part of the topic of images without distortion."""
SIDES = ({"left"}, {"right"})
MOST_SHOWN = 4
SHORTEST = 0.05
"""Shortest focal length of a camera [width]: drivers without a calibration write a matrix of ones, too."""


class Info(NamedTuple):
    """The first message of a camera_info topic."""

    topic: str
    """Its topic."""
    message: Any
    """What it says."""

    @property
    def frame(self) -> str:
        """Name of the frame of its camera."""
        return _frame(self.message.header.frame_id)


class Images(NamedTuple):
    """What is known of the images."""

    topic: str
    """Their topic."""
    frame: str
    """Name of the frame that they were taken in."""
    size: tuple[int, int]
    """Columns and rows."""


def camera_of(images: Images, infos: Sequence[Info]) -> PinholeCamera:
    """The camera that took the images.

    Args:
        images: The images.
        infos: What the bag has.

    Raises:
        PerceptionError: No camera_info belongs to them, or the one that does cannot be used.
    """
    if not infos:
        raise PerceptionError("there is no camera_info")
    images = images._replace(frame=_frame(images.frame))
    chosen = _own(images, infos)
    cameras: list[PinholeCamera] = []
    for info in chosen:
        try:
            cameras.append(_read(info.message, images))
        except PerceptionError as error:
            raise PerceptionError(f"{info.topic}: {error}") from error
    if len(set(cameras)) > 1:
        raise PerceptionError(
            f"{_shown(info.topic for info in chosen)} differ, all in frame {shown(images.frame)}, none beside "
            f"{images.topic}"
        )
    return cameras[0]


def _own(images: Images, infos: Sequence[Info]) -> list[Info]:
    """The camera_info beside the images, or those of the same frame; topics of one namespace belong together."""
    by_topic = {info.topic.strip("/"): info for info in infos}
    for name in _beside(images.topic):
        if (info := by_topic.get(name)) is None:
            continue
        if info.frame and images.frame and info.frame != images.frame:
            raise PerceptionError(
                f"{info.topic} is of frame {shown(info.frame[:40])}, {images.topic} of {shown(images.frame[:40])}"
            )
        return [info]
    same = [
        info for info in infos if info.frame and info.frame == images.frame and not _other_side(images, info)
    ]
    if not same:
        found = _shown(f"{info.topic} (frame {shown(info.frame[:40])})" for info in infos)
        raise PerceptionError(
            f"no camera_info belongs to {images.topic} (frame {shown(images.frame[:40])}): {found}"
        )
    return same


def _beside(topic: str) -> list[str]:
    """Topics of the camera_info beside an image topic, which may end in what image_transport adds."""
    above, _, last = topic.strip("/").rpartition("/")
    folders = [above, above.rpartition("/")[0]] if last.lower() in TRANSPORTS else [above]
    return [f"{folder}/camera_info".strip("/") for folder in folders]


def _other_side(images: Images, info: Info) -> bool:
    """Whether it is of the other camera of a stereo pair, which may share the frame."""
    ours, theirs = (set(re.split(r"[/_]", topic.lower())) for topic in (images.topic, info.topic))
    shifted = bool(_numbers(info.message, "p", 12)[3] != 0)
    return shifted or any(side & ours and other & theirs for side, other in (SIDES, SIDES[::-1]))


def _frame(name: str) -> str:
    """Name of a frame, which ROS 1 also wrote with a slash before it."""
    return name.removeprefix("/")


def _shown(topics: Iterable[str]) -> str:
    names = list(topics)
    more = f" and {len(names) - MOST_SHOWN} more" if len(names) > MOST_SHOWN else ""
    return ", ".join(names[:MOST_SHOWN]) + more


def _read(message: Any, images: Images) -> PinholeCamera:
    """What a message says, for images of the size that binning and region of interest leave."""
    full = int(message.width), int(message.height)
    k, p = _numbers(message, "k", 9), _numbers(message, "p", 12)
    if not all(full) or not k.any():
        raise PerceptionError(f"it is not calibrated (all zeros, {full[0]} x {full[1]} pixels)")
    model, d = str(message.distortion_model), np.asarray(_either(message, "d"), dtype=float).ravel()
    matrix, lens = k.reshape(3, 3), ((), False)
    if not any(RECTIFIED.search(part) for part in images.topic.lower().split("/")):
        lens = lens_of(model, d.tolist())
    elif p.any():
        matrix = p.reshape(3, 4)[:, :3]
    elif lens_of(model, d.tolist()) != lens:
        raise PerceptionError("it has no matrix P for rectified images")
    if abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
        raise PerceptionError(f"its skew is {matrix[0, 1]:g} pixels, which cannot be used")
    if 0 < matrix[0, 0] < SHORTEST * full[0]:
        raise PerceptionError(f"it is not calibrated (focal length of {matrix[0, 0]:g} pixels)")
    return PinholeCamera(*images.size, *_on_sensor(message, matrix, full, images.size), *lens)


def _on_sensor(
    message: Any, matrix: np.ndarray, full: tuple[int, int], size: tuple[int, int]
) -> tuple[float, float, float, float]:
    """Focal lengths and centre in images of a part of the sensor, several of whose pixels may be one."""
    binning = max(1, int(message.binning_x)), max(1, int(message.binning_y))
    region = message.roi
    offset, part = (int(region.x_offset), int(region.y_offset)), (int(region.width), int(region.height))
    part = part if all(part) else full
    wanted = tuple(side / bins for side, bins in zip(part, binning, strict=True))
    if any(abs(one - other) >= 1 for one, other in zip(wanted, size, strict=True)):
        raise PerceptionError(
            f"it is of images of {wanted[0]:g} x {wanted[1]:g} pixels, these have {size[0]} x {size[1]}"
        )
    focus = [float(matrix[axis, axis]) / binning[axis] for axis in (0, 1)]
    # Pixel centres are whole numbers; that of binned pixels lies between those of the sensor.
    centre = [(float(matrix[axis, 2]) - offset[axis] + 0.5) / binning[axis] - 0.5 for axis in (0, 1)]
    return focus[0], focus[1], centre[0], centre[1]


def _numbers(message: Any, name: str, count: int) -> np.ndarray:
    values = np.asarray(_either(message, name), dtype=float).ravel()
    if len(values) != count:
        raise PerceptionError(f"its {name.upper()} has {len(values)} numbers, not {count}")
    return values


def _either(message: Any, name: str) -> Any:
    """A field that ROS 2 writes small and ROS 1 writes large."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())
