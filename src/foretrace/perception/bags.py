"""Films in bags of ROS 1 and ROS 2, read without ROS (``pip install foretrace[ros]``)."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from foretrace.errors import PerceptionError
from foretrace.interactions.film_folder import Frame
from foretrace.interactions.pinhole import PinholeCamera

PICTURES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TO_BGR = {"rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR, "bgra8": cv2.COLOR_BGRA2BGR}
CHANNELS = {"bgr8": 3, "rgb8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}


def open_bag(path: Path, topic: str | None) -> tuple[Callable[[], Iterator[Frame]], PinholeCamera | None]:
    """Frames of a bag's colour images, and the camera that its camera_info names.

    Args:
        path: The bag.
        topic: Topic of the images; needed if there are several.

    Raises:
        PerceptionError: The bag is damaged or has no such topic, or rosbags is not installed.
    """
    with _reader(path) as reader:
        topics = {
            c.topic: c.msgtype for c in reader.connections if c.msgtype in PICTURES and "depth" not in c.topic
        }
        if topic is None and len(topics) == 1:
            topic = next(iter(topics))
        if topic is None or topic not in topics:
            asked = "no image topic" if topic is None else f"no image topic {topic}"
            found = ", ".join(sorted(topics)) or "none"
            raise PerceptionError(
                f"bag {path}: {asked} is chosen; image topics are {found}: name one with --topic"
            )
        camera = _camera(reader, topic)
    chosen: str = topic
    return lambda: _frames(path, chosen), camera


def _reader(path: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise PerceptionError("bags need rosbags: `pip install foretrace[ros]`") from error
    folder = (
        path.parent
        if path.suffix.lower() in (".db3", ".mcap") and (path.parent / "metadata.yaml").exists()
        else path
    )
    try:
        return _Opened(AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)), path)
    except Exception as error:  # every kind of damage has an exception of its own there
        raise _damaged(path, error) from error


class _Opened:
    """A reader whose errors name the bag."""

    def __init__(self, reader: Any, path: Path):
        self._reader, self._path = reader, path

    def __enter__(self) -> Any:
        try:
            return self._reader.__enter__()
        except Exception as error:
            raise _damaged(self._path, error) from error

    def __exit__(self, *exception: Any) -> None:
        self._reader.__exit__(*exception)


def _damaged(path: Path, error: Exception) -> PerceptionError:
    return PerceptionError(
        f"bag {path} cannot be read ({error}): it is cut off or no bag; record or copy it again"
    )


def _messages(reader: Any, path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    connections = [c for c in reader.connections if c.topic == topic]
    try:
        for connection, stamp, raw in reader.messages(connections=connections):
            yield stamp, reader.deserialize(raw, connection.msgtype)
    except PerceptionError:
        raise
    except Exception as error:
        raise _damaged(path, error) from error


def _camera(reader: Any, topic: str) -> PinholeCamera | None:
    """The first camera_info beside the image topic, or the only one."""
    infos = [c for c in reader.connections if c.msgtype == CAMERA_INFO]
    namespace = topic.rsplit("/", 1)[0]
    near = [c for c in infos if c.topic.startswith(namespace)] or infos
    if not near or (len({c.topic for c in near}) > 1):
        return None
    for connection, _, raw in reader.messages(connections=near):
        message = reader.deserialize(raw, connection.msgtype)
        k, d = (np.asarray(_either(message, name), dtype=float).ravel() for name in ("k", "d"))
        fx, fy, cx, cy = (float(v) for v in k[[0, 4, 2, 5]])
        distortion = tuple(float(v) for v in d) if d.any() else ()
        return PinholeCamera(int(message.width), int(message.height), fx, fy, cx, cy, distortion)
    return None


def _either(message: Any, name: str) -> Any:
    """A field that ROS 2 writes small and ROS 1 writes large."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())


def _frames(path: Path, topic: str) -> Iterator[Frame]:
    with _reader(path) as reader:
        for stamp, message in _messages(reader, path, topic):
            header = message.header.stamp
            time = header.sec + 1e-9 * header.nanosec
            yield Frame(float(time or 1e-9 * stamp), _picture(message, path))


def _picture(message: Any, path: Path) -> np.ndarray:
    data = np.asarray(message.data, dtype=np.uint8)
    if not hasattr(message, "encoding"):
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
        if picture is None:
            raise PerceptionError(
                f"bag {path} holds a compressed image ({message.format}) that cannot be decoded"
            )
        return picture
    if message.encoding not in CHANNELS:
        raise PerceptionError(
            f"bag {path} has images of encoding {message.encoding}: {', '.join(CHANNELS)} can be read"
        )
    channels = CHANNELS[message.encoding]
    if len(data) < message.height * message.step or message.step < message.width * channels:
        raise PerceptionError(f"bag {path} holds an image of {len(data)} bytes, too few for its size")
    rows = data[: message.height * message.step].reshape(message.height, message.step)
    picture = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    if channels == 1:
        return cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_GRAY2BGR)
    code = TO_BGR.get(message.encoding)
    return (
        np.ascontiguousarray(picture) if code is None else cv2.cvtColor(np.ascontiguousarray(picture), code)
    )
