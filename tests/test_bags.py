"""Bags of ROS 1 and ROS 2 with colour and depth, raw and compressed; damaged ones are refused with a reason."""

import dataclasses
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from foretrace.errors import PerceptionError
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.recordings import open_recording

pytest.importorskip("rosbags")

CAMERA = PinholeCamera(40, 30, 30.0, 31.0, 19.0, 14.0, (0.05, -0.1, 0.0005, -0.0005, 0.02))
COLOUR, DEPTH, INFO = "/camera/color/image_raw", "/camera/depth/image", "/camera/color/camera_info"
BOTH = pytest.mark.parametrize("ros1", [True, False], ids=["ros1", "ros2"])


@dataclass(frozen=True)
class Said:
    """A message to write: raw or compressed image, or the camera."""

    topic: str
    time: float
    data: np.ndarray | bytes
    encoding: str = "bgr8"
    """Of a raw image; the format of a compressed one."""
    frame: str = "colour_frame"
    recorded: float | None = None
    """When the bag got it [s]; by default at once."""
    step: int | None = None


def images(number: int, topic: str = COLOUR) -> list[Said]:
    rng = np.random.default_rng(0)
    shape = (CAMERA.height, CAMERA.width, 3)
    return [Said(topic, 5 + 0.1 * k, rng.integers(0, 255, shape, dtype=np.uint8)) for k in range(number)]


def depth_of(number: int) -> list[np.ndarray]:
    """Depth [m] in whole millimetres, with pixels that saw nothing."""
    rng = np.random.default_rng(1)
    found = rng.integers(400, 900, (number, CAMERA.height, CAMERA.width)) / 1000
    found[:, :3, :5] = 0.0
    return list(found)


def steps_of(depth: np.ndarray) -> np.ndarray:
    return np.rint(1000 * depth).astype(np.uint16)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def write_bag(path: Path, said: Sequence[Said], ros1: bool, plugin: str = "mcap", infos: bool = True) -> Path:
    """Writes a bag of what is said, in the order given, as ROS would."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    serialise = store.serialize_ros1 if ros1 else store.serialize_cdr
    writer: Any = (
        Writer1(path)
        if ros1
        else Writer2(
            path, version=9, storage_plugin={"mcap": StoragePlugin.MCAP, "db3": StoragePlugin.SQLITE3}[plugin]
        )
    )
    with writer:
        connections: dict[str, Any] = {}
        for one in said:
            message = _message(store.types, one, ros1)
            if one.topic not in connections:
                connections[one.topic] = writer.add_connection(
                    one.topic, message.__msgtype__, typestore=store
                )
            when = one.time if one.recorded is None else one.recorded
            writer.write(connections[one.topic], round(1e9 * when), serialise(message, message.__msgtype__))
        if infos:
            info = _camera_info(store.types, ros1)
            connection = writer.add_connection(INFO, info.__msgtype__, typestore=store)
            writer.write(connection, round(5e9), serialise(info, info.__msgtype__))
    return path


def _header(types: Any, time: float, frame: str, ros1: bool) -> Any:
    stamp = types["builtin_interfaces/msg/Time"](sec=int(time), nanosec=round(1e9 * (time % 1)))
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **({"seq": 0} if ros1 else {}))


def _message(types: Any, said: Said, ros1: bool) -> Any:
    header = _header(types, said.time, said.frame, ros1)
    if isinstance(said.data, bytes):
        data = np.frombuffer(said.data, dtype=np.uint8)
        return types["sensor_msgs/msg/CompressedImage"](header=header, format=said.encoding, data=data)
    rows, columns = said.data.shape[:2]
    return types["sensor_msgs/msg/Image"](
        header=header,
        height=rows,
        width=columns,
        encoding=said.encoding,
        is_bigendian=int(said.data.dtype.byteorder == ">"),
        step=said.step or said.data.strides[0],
        data=np.frombuffer(said.data.tobytes(), dtype=np.uint8),
    )


def _camera_info(types: Any, ros1: bool) -> Any:
    region = types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    numbers = (np.array(CAMERA.distortion), CAMERA.matrix.ravel(), np.eye(3).ravel(), np.zeros(12))
    return types["sensor_msgs/msg/CameraInfo"](
        header=_header(types, 5.0, "colour_frame", ros1),
        height=CAMERA.height,
        width=CAMERA.width,
        distortion_model="plumb_bob",
        binning_x=0,
        binning_y=0,
        roi=region,
        **dict(zip("DKRP" if ros1 else "dkrp", numbers, strict=True)),
    )


def bag_of(folder: Path, said: Sequence[Said], ros1: bool = False, **options: Any) -> Path:
    return write_bag(folder / ("film.bag" if ros1 else "film"), said, ros1, **options)


@BOTH
def test_colour_images_and_camera(tmp_path: Path, ros1: bool) -> None:
    said = images(6)
    film = open_recording(bag_of(tmp_path, said, ros1))
    assert film.camera == CAMERA
    frames = list(film.frames())
    np.testing.assert_allclose([frame.time for frame in frames], [one.time for one in said], atol=1e-6)
    np.testing.assert_array_equal(frames[2].image, said[2].data)
    assert all(frame.depth is None for frame in frames)


@BOTH
def test_files_lie_beside_a_bag_or_in_its_folder(tmp_path: Path, ros1: bool) -> None:
    film = open_recording(bag_of(tmp_path, images(2), ros1))
    assert film.beside("markers.json") is None
    (tmp_path / "markers.json").write_text("{}")
    assert film.beside("markers.json") == tmp_path / "markers.json"
    if film.path.is_dir():
        (film.path / "markers.json").write_text("{}")
        assert film.beside("markers.json") == film.path / "markers.json"


@pytest.mark.parametrize("encoding", ["rgb8", "bgra8", "rgba8", "mono8"])
def test_colours_of_every_encoding(tmp_path: Path, encoding: str) -> None:
    image = np.asarray(images(1)[0].data)
    code = {"rgb8": cv2.COLOR_BGR2RGB, "bgra8": cv2.COLOR_BGR2BGRA, "rgba8": cv2.COLOR_BGR2RGBA}
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    sent = grey if encoding == "mono8" else cv2.cvtColor(image, code[encoding])
    read = next(open_recording(bag_of(tmp_path, [Said(COLOUR, 5.0, sent, encoding)])).frames()).image
    np.testing.assert_array_equal(
        read, image if encoding != "mono8" else np.repeat(grey[..., None], 3, axis=2)
    )


@BOTH
@pytest.mark.parametrize("kind", ["16UC1", "32FC1", "png", "inverse", "big endian"])
def test_depth(tmp_path: Path, ros1: bool, kind: str) -> None:
    depths = depth_of(3)
    with np.errstate(divide="ignore"):
        inverse = [np.where(depth > 0, 10100 / depth - 1009 + 0.5, 0).astype(np.uint16) for depth in depths]
    sent = {
        "16UC1": lambda k: Said(DEPTH, 5 + 0.1 * k, steps_of(depths[k]), "16UC1"),
        "big endian": lambda k: Said(DEPTH, 5 + 0.1 * k, steps_of(depths[k]).astype(">u2"), "16UC1"),
        "32FC1": lambda k: Said(
            DEPTH, 5 + 0.1 * k, np.where(depths[k] > 0, depths[k], np.nan).astype(np.float32), "32FC1"
        ),
        "png": lambda k: Said(
            DEPTH, 5 + 0.1 * k, bytes(12) + png(steps_of(depths[k])), "16UC1; compressedDepth png"
        ),
        "inverse": lambda k: Said(
            DEPTH,
            5 + 0.1 * k,
            struct.pack("<iff", 0, 10100, -1009) + png(inverse[k]),
            "32FC1; compressedDepth",
        ),
    }[kind]
    said = [entry for k, one in enumerate(images(3)) for entry in (one, sent(k))]
    frames = list(open_recording(bag_of(tmp_path, said, ros1)).frames())
    for frame, depth in zip(frames, depths, strict=True):
        assert frame.depth is not None
        np.testing.assert_allclose(frame.depth, depth, atol=1e-4 if kind == "inverse" else 1e-6)
        np.testing.assert_array_equal(frame.depth == 0, depth == 0)


@pytest.mark.parametrize("image_format", ["jpeg", "rgb8; png compressed bgr8"])
def test_compressed_colours(tmp_path: Path, image_format: str) -> None:
    smooth = cv2.GaussianBlur(np.asarray(images(1)[0].data), (0, 0), 4)
    ending = ".jpg" if "jpeg" in image_format else ".png"
    data = cv2.imencode(ending, smooth)[1].tobytes()
    topic = f"{COLOUR}/compressed"
    film = open_recording(bag_of(tmp_path, [Said(topic, 5.0, data, image_format)]))
    assert film.camera == CAMERA
    assert np.abs(next(film.frames()).image.astype(int) - smooth).mean() < 3
    (tmp_path / "broken").mkdir()
    broken = bag_of(tmp_path / "broken", [Said(topic, 5.0, data[:20], image_format)])
    with pytest.raises(PerceptionError, match="cannot be decoded"):
        list(open_recording(broken).frames())


def test_depth_joins_the_colour_image_nearest_in_time(tmp_path: Path) -> None:
    """Depth at a third of the rate, a little late, one of them before its colour image in the bag."""
    depths = depth_of(2)
    late = [
        Said(DEPTH, 5.012, steps_of(depths[0]), "16UC1"),
        Said(DEPTH, 5.295, steps_of(depths[1]), "16UC1", recorded=5.29),
    ]
    said = sorted([*images(6), *late], key=lambda one: one.recorded or one.time)
    frames = list(open_recording(bag_of(tmp_path, said)).frames())
    assert [frame.depth is not None for frame in frames] == [True, False, False, True, False, False]
    assert frames[3].depth is not None
    np.testing.assert_allclose(frames[3].depth, depths[1], atol=1e-6)
    np.testing.assert_allclose([frame.time for frame in frames], 5 + 0.1 * np.arange(6), atol=1e-6)


def test_depth_of_another_camera_is_left_alone(tmp_path: Path) -> None:
    """Depth that is not aligned would put every pixel in the wrong place, in silence."""
    other = Said(DEPTH, 5.0, steps_of(depth_of(1)[0]), "16UC1", frame="depth_frame")
    path = bag_of(tmp_path, [*images(2), other])
    assert next(open_recording(path).frames()).depth is None
    with pytest.raises(PerceptionError, match=r"is in frame 'depth_frame', .* in 'colour_frame'"):
        open_recording(path, depth_topic=DEPTH)
    with pytest.raises(PerceptionError, match=f"no depth topic /gone .* depth topics are {DEPTH}"):
        open_recording(path, depth_topic="/gone")
    (tmp_path / "two").mkdir()
    twins = [Said(name, 5.0, steps_of(depth_of(1)[0]), "16UC1") for name in ("/a", "/b")]
    path = bag_of(tmp_path / "two", [*images(2), *twins])
    with pytest.raises(PerceptionError, match="depth topics are /a, /b: name one with --depth-topic"):
        open_recording(path)
    assert next(open_recording(path, depth_topic="/b").frames()).depth is not None


def test_topics_that_are_missing(tmp_path: Path) -> None:
    path = bag_of(tmp_path, [*images(2), *images(2, "/second/image")])
    with pytest.raises(
        PerceptionError, match=f"image topics are {COLOUR}, /second/image: name one with --topic"
    ):
        open_recording(path)
    assert len(list(open_recording(path, "/second/image").frames())) == 2
    with pytest.raises(PerceptionError, match="no image topic /gone with messages"):
        open_recording(path, "/gone")
    (tmp_path / "none").mkdir()
    with pytest.raises(
        PerceptionError, match=rf"has no image topic: it has {INFO} .sensor_msgs/msg/CameraInfo.; record"
    ):
        open_recording(bag_of(tmp_path / "none", []))
    (tmp_path / "depth").mkdir()
    with pytest.raises(PerceptionError, match="it has no image topic"):
        open_recording(bag_of(tmp_path / "depth", [Said(DEPTH, 5.0, steps_of(depth_of(1)[0]), "16UC1")]))


def test_time_stamps(tmp_path: Path) -> None:
    """The driver's stamps count, not the recorder's; without them the recorder's."""
    from foretrace.perception.importing import Contact, import_recording
    from foretrace.perception.markers import MarkerBody, MarkerLayout

    backwards = [dataclasses.replace(one, time=6 - one.time / 10, recorded=one.time) for one in images(3)]
    layout = MarkerLayout("4x4_50", MarkerBody.single(0, 0.05), MarkerBody.single(1, 0.05))
    with pytest.raises(PerceptionError, match=r"time stamps of .* do not increase: frame 1 at"):
        import_recording(open_recording(bag_of(tmp_path, backwards)), CAMERA, layout, Contact(edge=(0, 0.5)))
    (tmp_path / "none").mkdir()
    unstamped = [dataclasses.replace(one, time=0.0, recorded=one.time) for one in images(3)]
    frames = list(open_recording(bag_of(tmp_path / "none", unstamped)).frames())
    np.testing.assert_allclose([frame.time for frame in frames], [5.0, 5.1, 5.2], atol=1e-6)


@pytest.mark.parametrize("kind", ["ros1", "mcap", "db3"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_bags_that_are_cut_off(tmp_path: Path, kind: str, share: float) -> None:
    path = bag_of(tmp_path, images(8), kind == "ros1", plugin=kind)
    content = path if kind == "ros1" else next(path.glob(f"*.{kind}"))
    content.write_bytes(content.read_bytes()[: round(share * content.stat().st_size)])
    with pytest.raises(PerceptionError, match=r"bag .* cannot be read .*cut off"):
        list(open_recording(path).frames())


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_file_of_a_bag_without_its_folder(tmp_path: Path, kind: str) -> None:
    """As Foxglove and `mcap merge` write them; a description of another bag beside it does not count."""
    path = bag_of(tmp_path, images(2), plugin=kind)
    file = next(path.glob(f"*.{kind}"))
    assert len(list(open_recording(file).frames())) == 2
    (path / "metadata.yaml").unlink()
    for there in (file, path):
        found = open_recording(there)
        assert found.camera == CAMERA
        assert len(list(found.frames())) == 2
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: of a bag that was here")
    other = file.rename(path / f"other.{kind}")
    assert len(list(open_recording(other).frames())) == 2


def mcap_of(folder: Path) -> Path:
    """A bag's only file, without its folder."""
    return next(bag_of(folder, images(3)).glob("*.mcap")).rename(folder / "one.mcap")


def test_a_file_that_names_no_profile(tmp_path: Path) -> None:
    file = mcap_of(tmp_path)
    content = bytearray(file.read_bytes())
    assert content[17:25] == b"\4\0\0\0ros2"
    # As long as before, since the places of all that follows are in the file.
    content[17:25] = bytes(4) + (int.from_bytes(content[25:29], "little") + 4).to_bytes(4, "little")
    file.write_bytes(content)
    assert len(list(open_recording(file).frames())) == 3
    content[17:25] = b"\4\0\0\0ros1"
    file.write_bytes(content)
    with pytest.raises(PerceptionError, match=r"Profile is not ros2.*: it is of ROS 1"):
        open_recording(file)


def test_bags_that_are_not_ready(tmp_path: Path) -> None:
    file = mcap_of(tmp_path)
    file.with_name("two.mcap").write_bytes(file.read_bytes())
    with pytest.raises(PerceptionError, match=r"has 2 bags \(one.mcap, two.mcap\) and no metadata.yaml"):
        open_recording(tmp_path)
    for name, reason in (
        ("a.bag.active", "never closed: .*reindex"),
        ("a.mcap.zstd", "compressed: unpack it"),
    ):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(PerceptionError, match=reason):
            open_recording(tmp_path / name)
    (tmp_path / "a.db3").write_bytes(b"")
    (tmp_path / "a.db3-wal").write_bytes(b"messages")
    with pytest.raises(PerceptionError, match=r"never closed, messages are still in a.db3-wal"):
        open_recording(tmp_path / "a.db3")


def test_a_camera_info_that_cannot_be_used_counts_as_none(tmp_path: Path) -> None:
    said = [dataclasses.replace(one, frame="other") for one in images(2)]
    found = open_recording(bag_of(tmp_path, said))
    assert found.camera is None
    assert "is of frame 'colour_frame'" in found.no_camera
    (tmp_path / "none").mkdir()
    assert (
        open_recording(bag_of(tmp_path / "none", images(2), infos=False)).no_camera
        == "there is no camera_info"
    )


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        (Said(COLOUR, 5.0, np.zeros((30, 40, 2), np.uint8), "yuv422"), "encoding yuv422: bgr8, rgb8"),
        (Said(COLOUR, 5.0, np.zeros((30, 40, 3), np.uint8), step=400), "3600 bytes, too few"),
        (Said(DEPTH, 5.0, b"123", "16UC1; compressedDepth"), "depth image of 3 bytes"),
        (Said(DEPTH, 5.0, bytes(40), "16UC1; compressedDepth rvl"), "compressed as RVL"),
        (
            Said(DEPTH, 5.0, bytes(12) + png(np.zeros((9, 9), np.uint8)), "16UC1; compressedDepth"),
            "depth of uint8",
        ),
    ],
)
def test_images_that_cannot_be_read(tmp_path: Path, said: Said, reason: str) -> None:
    others = images(2) if said.topic == DEPTH else []
    with pytest.raises(PerceptionError, match=reason):
        list(open_recording(bag_of(tmp_path, [*others, said])).frames())
