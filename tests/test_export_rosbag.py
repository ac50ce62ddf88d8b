"""ROS bags as other libraries than their writer read them: mcap for ROS 2; for ROS 1 the records of format 2.0 as
documented, their messages decoded by mcap-ros1-support from the definitions in the bag."""

import struct
from pathlib import Path

import numpy as np
import pytest

import factories
from export_samples import fake_data, fake_run, write_data
from foretrace import cli
from foretrace.errors import ExportError
from foretrace.export.episodes import Episodes, choose
from foretrace.geometry import pose_to_matrix
from foretrace.interactions.dataset import Dataset

pytest.importorskip("rosbags", reason="no rosbags: ROS bags cannot be written")

from foretrace.export.rosbag import export_rosbags

MD5 = {
    "nav_msgs/Path": "6227e2b7e9cce15051f669a5e197bbf7",
    "sensor_msgs/CameraInfo": "c9a58c1b0b154e0e6da7578cb991d214",
    "sensor_msgs/Image": "060021388200f6f0f447d0fcd9c64743",
    "tf2_msgs/TFMessage": "94810edda583a504dfda3829e70d7eec",
    "visualization_msgs/MarkerArray": "d155b9ce5188fbaf89745847fd5882d7",
}
"""What ROS Noetic gives for its messages: RViz takes no others."""


@pytest.fixture(scope="module")
def episodes(tmp_path_factory) -> Episodes:
    data = fake_data(tmp_path_factory.mktemp("data"))
    return choose(data, [1], fake_run(tmp_path_factory.mktemp("run")))


def read_ros2(bag: Path) -> dict[str, list]:
    """Messages by topic: (log time [ns], message)."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found: dict[str, list] = {}
    with bag.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def read_ros1(bag: Path) -> dict[str, list]:
    """Messages by topic: (time [ns], message), by the documentation of bag format 2.0."""
    from mcap_ros1._vendor.genpy.dynamic import generate_dynamic

    content, found, types, topics = bag.read_bytes(), {}, {}, {}
    assert content.startswith(b"#ROSBAG V2.0\n")

    def records(data: bytes):
        at = 0
        while at < len(data):
            parts = []
            for _ in range(2):
                (size,) = struct.unpack_from("<I", data, at)
                parts.append(data[at + 4 : at + 4 + size])
                at += 4 + size
            yield fields(parts[0]), parts[1]

    def fields(data: bytes) -> dict[str, bytes]:
        at, values = 0, {}
        while at < len(data):
            (size,) = struct.unpack_from("<I", data, at)
            name, value = data[at + 4 : at + 4 + size].split(b"=", 1)
            values[name.decode()] = value
            at += 4 + size
        return values

    ops = []
    for header, data in records(content[13:]):
        ops.append(header["op"][0])
        if header["op"] != b"\x05":
            continue
        assert header["compression"] == b"none"
        for inner, body in records(data):
            connection = inner["conn"]
            if inner["op"] == b"\x07":
                about = fields(body)
                kind = about["type"].decode()
                assert about["md5sum"].decode() == MD5[kind], kind
                types[connection] = generate_dynamic(kind, about["message_definition"].decode())[kind]
                topics[connection] = inner["topic"].decode()
            else:
                seconds, nanoseconds = struct.unpack("<II", inner["time"])
                message = types[connection]()
                message.deserialize(body)
                found.setdefault(topics[connection], []).append((seconds * 10**9 + nanoseconds, message))
    assert ops[0] == 3, "the bag header comes first"
    assert ops.count(5) == ops.count(6), "one index entry for each chunk"
    return found


def nanoseconds(stamp) -> int:
    """Of a time stamp: ROS 1 calls its fields secs and nsecs, ROS 2 sec and nanosec."""
    if hasattr(stamp, "secs"):
        return stamp.secs * 10**9 + stamp.nsecs
    return stamp.sec * 10**9 + stamp.nanosec


def position(point) -> list[float]:
    return [point.x, point.y, point.z]


@pytest.fixture(scope="module", params=[1, 2])
def bag(request, episodes, tmp_path_factory):
    version, out = request.param, tmp_path_factory.mktemp("bags") / "out"
    try:
        export_rosbags(episodes, out, version)
    except ExportError:
        export_rosbags(episodes, out, version, camera=False)
    name = {1: "interaction-000001.bag", 2: "interaction-000001"}[version]
    assert sorted(path.name for path in out.iterdir()) == ["foretrace.rviz", name]
    return read_ros1(out / name) if version == 1 else read_ros2(out / name / f"{name}.mcap")


def test_frames_move_as_observed_and_imagined(bag, episodes):
    episode = episodes[0]
    effect = episode.interaction.effect
    expected = {"object": effect.pose_trajectory, "tool": effect.tool_trajectory}
    expected["object_imagined"] = episode.imagined_pose
    assert len(bag["/tf"]) == len(effect.times)
    for k, (time, message) in enumerate(bag["/tf"]):
        assert time == round(1e9 * (1 + effect.times[k]))
        assert {each.child_frame_id for each in message.transforms} == set(expected)
        for each in message.transforms:
            t, q = each.transform.translation, each.transform.rotation
            found = pose_to_matrix(np.array([t.x, t.y, t.z, q.w, q.x, q.y, q.z]))
            np.testing.assert_allclose(found, pose_to_matrix(expected[each.child_frame_id][k]), atol=1e-12)
            assert each.header.frame_id == "action"
            assert nanoseconds(each.header.stamp) == time


def test_paths_are_those_of_the_centre_of_mass(bag, episodes):
    episode = episodes[0]
    effect = episode.interaction.effect
    ((start, imagined),) = bag["/imagined/path"]
    assert start == 10**9
    found = [position(each.pose.position) for each in imagined.poses]
    np.testing.assert_allclose(found, episode.imagined.com_trajectory, atol=1e-12)
    lengths = [len(message.poses) for _, message in bag["/observed/path"]]
    assert lengths == list(range(1, len(effect.times) + 1)), "it grows"
    end, whole = bag["/observed/path"][-1]
    np.testing.assert_allclose([position(each.pose.position) for each in whole.poses], effect.com_trajectory)
    stamps = [nanoseconds(each.header.stamp) for each in whole.poses]
    np.testing.assert_allclose(stamps, 1e9 * (1 + effect.times), atol=1)
    assert stamps[-1] == end


def test_markers_show_object_and_tool_on_their_frames(bag, episodes):
    interaction = episodes[0].interaction
    first = {(each.ns, each.id): each for each in bag["/markers"][0][1].markers}
    mesh = first["object", 0]
    assert (mesh.type, mesh.header.frame_id, mesh.frame_locked) == (11, "object", True)
    corners = np.array([position(point) for point in mesh.points]).reshape(-1, 3, 3)
    volume = np.linalg.det(corners).sum() / 6
    assert volume == pytest.approx(interaction.object.mass_properties(1.0).mass, rel=1e-6)
    for id in range(3):
        assert first["tool", id].header.frame_id == "tool"
    blade, shaft, handle = (first["tool", id] for id in range(3))
    assert (blade.type, shaft.type, handle.type) == (1, 3, 3)
    reach = blade.pose.position.x - blade.scale.x / 2
    assert reach == pytest.approx(shaft.pose.position.x + shaft.scale.z / 2), (
        "the shaft begins where the blade ends"
    )
    dots = [each for _, message in bag["/markers"] for each in message.markers if each.ns == "centre of mass"]
    green, red = dots[0::2], dots[1::2]
    np.testing.assert_allclose(
        [position(each.pose.position) for each in green], interaction.effect.com_trajectory
    )
    assert all(each.color.g > 0.6 > each.color.r for each in green)
    assert all(each.color.r > 0.8 > each.color.g for each in red)


def test_the_view_from_above_comes_first(bag, episodes):
    ((time, image),) = bag["/view/height"]
    assert time == 10**9
    assert (image.height, image.width, image.encoding, image.step) == (128, 128, "32FC1", 512)
    found = np.frombuffer(bytes(image.data), "<f4").reshape(128, 128)
    np.testing.assert_array_equal(found, episodes[0].interaction.view.height)


def test_images_come_with_intrinsics_and_pose(bag, episodes):
    if "/camera/color/image_raw" not in bag:
        pytest.skip("this machine cannot render")
    count = len(episodes[0].interaction.effect.times)
    for stream, encoding, bytes_per_pixel in (
        ("color/image_raw", "rgb8", 3),
        ("depth/image_rect_raw", "32FC1", 4),
    ):
        images = bag[f"/camera/{stream}"]
        assert len(images) == count
        for (time, image), (at, info) in zip(
            images, bag[f"/camera/{stream.split('/')[0]}/camera_info"], strict=True
        ):
            assert time == at == nanoseconds(image.header.stamp) == nanoseconds(info.header.stamp)
            assert (image.encoding, image.header.frame_id) == (encoding, "camera_optical_frame")
            assert (
                len(image.data) == image.height * image.step == image.height * image.width * bytes_per_pixel
            )
    k = np.reshape(info.K if hasattr(info, "K") else info.k, (3, 3))
    ((_, there),) = bag["/tf_static"]
    t, q = there.transforms[0].transform.translation, there.transforms[0].transform.rotation
    pose = pose_to_matrix(np.array([t.x, t.y, t.z, q.w, q.x, q.y, q.z]))
    # What the depth camera sees beside the object is the table: z = 0 in the action frame.
    depth = np.frombuffer(bytes(bag["/camera/depth/image_rect_raw"][0][1].data), "<f4").reshape(240, 320)
    rows, columns = np.mgrid[200:240:8, 0:320:40]
    z = depth[rows, columns]
    rays = np.stack([(columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1], np.ones(z.shape)], axis=-1)
    points = (rays * z[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(points[..., 2], 0, atol=1e-3)


def test_recordings_have_no_invented_images(tmp_path):
    from dataclasses import replace

    interaction = factories.fake_interaction(np.random.default_rng(0), 5)
    recorded = replace(interaction, provenance=replace(interaction.provenance, source="recorded", engine=""))
    export_rosbags(Episodes(Dataset.open(write_data(tmp_path / "data", [recorded]))), tmp_path / "out")
    topics = read_ros2(tmp_path / "out" / "interaction-000005" / "interaction-000005.mcap")
    assert set(topics) == {"/tf", "/observed/path", "/markers", "/view/height"}


def test_command_line(tmp_path, capsys):
    data = fake_data(tmp_path / "data", 2)
    out = tmp_path / "out"
    command = ["export", "rosbag", "--data", str(data), "--ids", "0", "1", "--out", str(out), "--no-camera"]
    assert cli.main(command) == 0
    assert capsys.readouterr().out.split() == [
        str(out / name) for name in ("foretrace.rviz", "interaction-000000", "interaction-000001")
    ]
    metadata = (out / "interaction-000001" / "metadata.yaml").read_text()
    assert "storage_identifier: mcap" in metadata
    assert cli.main(command) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize("version", [1, 2])
def test_the_rviz_configuration_names_topics_of_the_bags(version):
    import yaml

    from foretrace.export import rosbag

    file = Path(rosbag.__file__).parent / "rviz" / rosbag.CONFIGURATIONS[version]
    shown = yaml.safe_load(file.read_text())["Visualization Manager"]["Displays"]
    topics = {
        value["Value"] if isinstance(value, dict) else value
        for each in shown
        for key, value in each.items()
        if key.endswith("Topic")
    }
    assert topics == {
        "/markers",
        "/observed/path",
        "/imagined/path",
        "/camera/color/image_raw",
        "/view/height",
    }
    assert topics <= set(rosbag.TOPICS)
