"""Recordings in bags of ROS 1 and ROS 2, read without ROS (``pip install foretrace[ros]``)."""

import io
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from foretrace.errors import PerceptionError, shown
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recording_folder import Frame
from foretrace.perception.bag_images import is_depth, read_colour, read_depth
from foretrace.perception.camera_info import Images, Info, camera_of

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TOGETHER = 0.02
"""Largest time between a colour image and the depth that belongs to it [s]."""
PATIENCE = 0.5
"""Time for which a colour image waits for a later depth image [s]."""
MCAP_HEADER = 17
"""Place of the profile's name in an MCAP file."""
FAULTS = {
    "Profile is not": "it is of ROS 1 or no recording of ROS; give one of ROS 2, or the .bag of ROS 1",
    "Unrecognized storage": "give it an ending in small letters: .mcap, .db3 or .bag",
    "timestamp order": "sort it with `mcap sort`",
    "KeyError": "it has messages that are not of ROS 2; leave them out with `mcap filter`",
    "not indexed": "it was never closed; repair it with `rosbag reindex`",
}
"""What to do by what rosbags says; otherwise the file is taken for damaged."""
REPAIRS = {".mcap": "`mcap recover`", ".bag": "`rosbag reindex`"}
OTHER_REPAIR = "`ros2 bag reindex`"


class _Stream(NamedTuple):
    """A topic with images."""

    depth: bool
    """Whether they are of depth."""
    frame: str
    """Name of the frame that they were taken in."""
    first: Any
    """The first message."""


class Bag(NamedTuple):
    """What is read of a bag."""

    frames: Callable[[], Iterator[Frame]]
    """Reads the colour images with the depth that belongs to them."""
    camera: PinholeCamera | None
    """The camera that took them, as its camera_info says; None where that cannot be used."""
    no_camera: str
    """Why not, in words."""


def open_bag(path: Path, topic: str | None = None, depth_topic: str | None = None) -> Bag:
    """A bag's colour images with the depth that belongs to them, and the camera that its camera_info names.

    Args:
        path: The bag.
        topic: Topic of the colour images; needed if there are several.
        depth_topic: Topic of the depth images; by default the one whose frame is that of the colour images, if any.

    Raises:
        PerceptionError: The bag is damaged or has no such topic, or rosbags is not installed.
    """
    with open_reader(path) as reader:
        streams = _streams(reader, path)
        colours = [name for name, stream in streams.items() if not stream.depth]
        depths = [name for name, stream in streams.items() if stream.depth]
        if not streams:
            raise PerceptionError(f"bag {path} has no image topic: it has {_contents(reader)}")
        colour = choose_topic(path, topic, colours, "image topic", "--topic")
        frame = streams[colour].frame
        aligned = [name for name in depths if streams[name].frame == frame and (frame or name == depth_topic)]
        if depth_topic is not None or len(aligned) > 1:
            depth_topic = choose_topic(path, depth_topic, depths, "depth topic", "--depth-topic")
            if depth_topic not in aligned:
                raise PerceptionError(
                    f"bag {path}: {depth_topic} is in frame {shown(streams[depth_topic].frame)}, {colour} in "
                    f"{shown(frame)}: record depth that is aligned with the colour images"
                )
        depth = depth_topic or next(iter(aligned), None)
        camera, no_camera = _camera(reader, path, colour, streams[colour])
    return Bag(lambda: _frames(path, colour, depth), camera, no_camera)


def _streams(reader: Any, path: Path) -> dict[str, _Stream]:
    """The topics with images, each by its first message; those without a message are left out."""
    found: dict[str, _Stream] = {}
    for topic in sorted({c.topic for c in reader.connections if c.msgtype in IMAGES}):
        for _, _, message in read_messages(reader, path, [topic]):
            found[topic] = _Stream(is_depth(message), message.header.frame_id, message)
            break
    return found


def _contents(reader: Any) -> str:
    """What a bag has, in words: images may be of a kind that is not read, such as video."""
    topics = sorted({(c.topic, c.msgtype) for c in reader.connections})
    shown = ", ".join(f"{topic} ({kind})" for topic, kind in topics[:4]) or "nothing"
    return f"{shown}{' and more' if len(topics) > 4 else ''}; record images raw or as JPEG or PNG"


def choose_topic(path: Path, asked: str | None, topics: list[str], kind: str, option: str) -> str:
    """The topic that was asked for, or the only one."""
    if asked is None and len(topics) == 1:
        return topics[0]
    if asked is None or asked not in topics:
        wanted = f"no {kind}" if asked is None else f"no {kind} {asked} with messages"
        found = f"{kind}s are {', '.join(topics)}: name one with {option}" if topics else f"it has no {kind}"
        raise PerceptionError(f"bag {path}: {wanted} is chosen; {found}")
    return asked


@contextmanager
def open_reader(path: Path) -> Iterator[Any]:
    """An open reader of a bag."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise PerceptionError("bags need rosbags: `pip install foretrace[ros]`") from error
    try:
        reader = AnyReader([_whole(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except PerceptionError:
        raise
    except Exception as error:  # every kind of damage has an exception of its own there
        raise _damaged(path, error) from error
    with closing(reader):
        yield reader


def _whole(path: Path) -> Path:
    """What is read of a path: the folder of a bag of several files, or the file itself."""
    description = path.parent / "metadata.yaml"
    if path.is_dir() or path.suffix.lower() == ".bag":
        return path
    if description.is_file() and path.name in description.read_text(encoding="utf-8", errors="replace"):
        return path.parent
    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size:
        raise PerceptionError(
            f"bag {path} was never closed, messages are still in {log.name}: close it with `sqlite3 {path.name} vacuum`"
        )
    return _McapPath(path) if path.suffix.lower() == ".mcap" else path


class _McapPath(type(Path())):
    """A file that names ROS 2 as its profile where it names none, as merged ones do; rosbags asks for it."""

    def open(self, *args: Any, **options: Any) -> Any:
        return _McapFile(io.FileIO(self))


class _McapFile(io.BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        start, data = self.tell(), super().read(size)
        nameless = start == MCAP_HEADER and data[:4] == bytes(4)
        return b"\4\0\0\0ros2" + data[8:] if nameless else data


def _damaged(path: Path, error: Exception) -> PerceptionError:
    reason = f"{type(error).__name__}: {error}"
    known = next((remedy for words, remedy in FAULTS.items() if words in reason), None)
    repair = REPAIRS.get(path.suffix.lower(), OTHER_REPAIR)
    remedy = (
        known or f"it is cut off, was never closed or is no bag; copy it again, or repair it with {repair}"
    )
    return PerceptionError(f"bag {path} cannot be read ({' '.join(str(error).split())[:120]}): {remedy}")


def read_messages(reader: Any, path: Path, topics: list[str]) -> Iterator[tuple[str, float, Any]]:
    """The messages of some topics in the order of their recording: topic, time of recording [s], content."""
    connections = [c for c in reader.connections if c.topic in topics]
    try:
        for connection, recorded, raw in reader.messages(connections=connections):
            yield connection.topic, 1e-9 * recorded, reader.deserialize(raw, connection.msgtype)
    except PerceptionError:
        raise
    except Exception as error:
        raise _damaged(path, error) from error


def _camera(reader: Any, path: Path, topic: str, stream: _Stream) -> tuple[PinholeCamera | None, str]:
    """The camera of an image topic, or why it is not known."""
    infos = []
    for name in sorted({c.topic for c in reader.connections if c.msgtype == CAMERA_INFO}):
        infos += [Info(name, message) for _, _, message in islice(read_messages(reader, path, [name]), 1)]
    rows, columns = read_colour(stream.first, path).shape[:2]
    try:
        return camera_of(Images(topic, stream.frame, (columns, rows)), infos), ""
    except PerceptionError as error:
        return None, str(error)


def _frames(path: Path, colour: str, depth: str | None) -> Iterator[Frame]:
    """The colour images in the order of the bag, each with the depth image nearest in time."""
    waiting: deque[Frame] = deque()
    before: tuple[float, np.ndarray] | None = None

    def join(frame: Frame, after: tuple[float, np.ndarray] | None = None) -> Frame:
        near = [one for one in (before, after) if one is not None and abs(one[0] - frame.time) <= TOGETHER]
        nearest = min(near, key=lambda one: abs(one[0] - frame.time), default=(0.0, None))
        return Frame(frame.time, frame.image, nearest[1])

    with open_reader(path) as reader:
        for topic, recorded, message in read_messages(
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
