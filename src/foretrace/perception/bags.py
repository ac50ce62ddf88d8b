"""Recordings in bags of ROS 1 and ROS 2, read without ROS (``pip install foretrace[ros]``)."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from foretrace.errors import PerceptionError
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recording_folder import Frame
from foretrace.perception.bag_images import is_depth, read_colour, read_depth

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TOGETHER = 0.02
"""Largest time between a colour image and the depth that belongs to it [s]."""
PATIENCE = 0.5
"""Time for which a colour image waits for a later depth image [s]."""


class _Stream(NamedTuple):
    """A topic with images."""

    depth: bool
    """Whether they are of depth."""
    frame: str
    """Name of the frame that they were taken in."""


def open_bag(
    path: Path, topic: str | None = None, depth_topic: str | None = None
) -> tuple[Callable[[], Iterator[Frame]], PinholeCamera | None]:
    """Frames of a bag's colour images with the depth that belongs to them, and the camera that its camera_info names.

    Args:
        path: The bag.
        topic: Topic of the colour images; needed if there are several.
        depth_topic: Topic of the depth images; by default the one whose frame is that of the colour images, if any.

    Raises:
        PerceptionError: The bag is damaged or has no such topic, or rosbags is not installed.
    """
    with _reader(path) as reader:
        streams = _streams(reader, path)
        colours = [name for name, stream in streams.items() if not stream.depth]
        depths = [name for name, stream in streams.items() if stream.depth]
        colour = _chosen(path, topic, colours, "image topic", "--topic")
        frame = streams[colour].frame
        aligned = [name for name in depths if streams[name].frame == frame]
        if depth_topic is not None or len(aligned) > 1:
            depth_topic = _chosen(path, depth_topic, depths, "depth topic", "--depth-topic")
            if depth_topic not in aligned:
                raise PerceptionError(
                    f"bag {path}: {depth_topic} is in frame {streams[depth_topic].frame!r}, {colour} in {frame!r}: "
                    "record depth that is aligned with the colour images"
                )
        depth = depth_topic or next(iter(aligned), None)
        camera = _camera(reader, path, colour)
    return lambda: _frames(path, colour, depth), camera


def _streams(reader: Any, path: Path) -> dict[str, _Stream]:
    """The topics with images, each by its first message; those without a message are left out."""
    found: dict[str, _Stream] = {}
    for topic in sorted({c.topic for c in reader.connections if c.msgtype in IMAGES}):
        for _, _, message in _messages(reader, path, [topic]):
            found[topic] = _Stream(is_depth(message), message.header.frame_id)
            break
    return found


def _chosen(path: Path, asked: str | None, topics: list[str], kind: str, option: str) -> str:
    """The topic that was asked for, or the only one."""
    if asked is None and len(topics) == 1:
        return topics[0]
    if asked is None or asked not in topics:
        wanted = f"no {kind}" if asked is None else f"no {kind} {asked} with messages"
        found = f"{kind}s are {', '.join(topics)}: name one with {option}" if topics else f"it has no {kind}"
        raise PerceptionError(f"bag {path}: {wanted} is chosen; {found}")
    return asked


@contextmanager
def _reader(path: Path) -> Iterator[Any]:
    """An open reader of a bag."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise PerceptionError("bags need rosbags: `pip install foretrace[ros]`") from error
    folder = path
    if path.suffix.lower() in (".db3", ".mcap"):
        folder = path.parent
        if not (folder / "metadata.yaml").is_file():
            raise PerceptionError(
                f"bag {path} has no metadata.yaml beside it: copy the bag's whole folder, or make one with "
                "`ros2 bag reindex`"
            )
    try:
        reader = AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:  # every kind of damage has an exception of its own there
        raise _damaged(path, error) from error
    with closing(reader):
        yield reader


def _damaged(path: Path, error: Exception) -> PerceptionError:
    return PerceptionError(
        f"bag {path} cannot be read ({error}): it is cut off or no bag; record or copy it again"
    )


def _messages(reader: Any, path: Path, topics: list[str]) -> Iterator[tuple[str, float, Any]]:
    """The messages of some topics in the order of their recording: topic, time of recording [s], content."""
    connections = [c for c in reader.connections if c.topic in topics]
    try:
        for connection, recorded, raw in reader.messages(connections=connections):
            yield connection.topic, 1e-9 * recorded, reader.deserialize(raw, connection.msgtype)
    except PerceptionError:
        raise
    except Exception as error:
        raise _damaged(path, error) from error


def _camera(reader: Any, path: Path, topic: str) -> PinholeCamera | None:
    """The first camera_info beside the image topic, or the only one."""
    infos = [c for c in reader.connections if c.msgtype == CAMERA_INFO]
    namespace = topic.rsplit("/", 1)[0]
    near = [c for c in infos if c.topic.startswith(namespace)] or infos
    if not near or (len({c.topic for c in near}) > 1):
        return None
    for _, _, message in _messages(reader, path, [near[0].topic]):
        k, d = (np.asarray(_either(message, name), dtype=float).ravel() for name in ("k", "d"))
        fx, fy, cx, cy = (float(v) for v in k[[0, 4, 2, 5]])
        distortion = tuple(float(v) for v in d) if d.any() else ()
        return PinholeCamera(int(message.width), int(message.height), fx, fy, cx, cy, distortion)
    return None


def _either(message: Any, name: str) -> Any:
    """A field that ROS 2 writes small and ROS 1 writes large."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())


def _frames(path: Path, colour: str, depth: str | None) -> Iterator[Frame]:
    """The colour images in the order of the bag, each with the depth image nearest in time."""
    waiting: deque[Frame] = deque()
    before: tuple[float, np.ndarray] | None = None

    def join(frame: Frame, after: tuple[float, np.ndarray] | None = None) -> Frame:
        near = [one for one in (before, after) if one is not None and abs(one[0] - frame.time) <= TOGETHER]
        nearest = min(near, key=lambda one: abs(one[0] - frame.time), default=(0.0, None))
        return Frame(frame.time, frame.image, nearest[1])

    with _reader(path) as reader:
        for topic, recorded, message in _messages(
            reader, path, [colour] if depth is None else [colour, depth]
        ):
            stamp = message.header.stamp
            time = stamp.sec + 1e-9 * stamp.nanosec or recorded
            if topic == depth:
                after = (time, read_depth(message, path))
                while waiting and waiting[0].time <= time:
                    yield join(waiting.popleft(), after)
                before = after
                continue
            waiting.append(Frame(time, read_colour(message, path)))
            while waiting and (depth is None or waiting[0].time < time - PATIENCE):
                yield join(waiting.popleft())
        while waiting:
            yield join(waiting.popleft())
