"""Interactions as bags of ROS 1 and ROS 2, written without ROS, and the RViz configurations that show them.

Frames follow REP 103: right-handed, metres, z up in ``action``; the camera's has z forward, x right, y down.
"""

import importlib.resources
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.typesys import Stores

from foretrace.export.delivery import delivered, watched
from foretrace.export.episodes import Episode
from foretrace.export.images import RenderedImages, images_of_samples
from foretrace.export.messages import TRANSFORMS, Messages
from foretrace.export.scenery import IMAGINED, OBJECT, OBSERVED
from foretrace.geometry import matrix_to_pose
from foretrace.objects.surface import triangles_of

RosVersion = Literal[1, 2]
ACTION, THING, TOOL, GHOST = "action", "object", "tool", "object_imagined"
"""Frames: the action frame, which is the root, and what moves in it."""
CAMERA = "camera_optical_frame"
START = 1.0
"""Time stamp of an interaction's time 0 [s]: in ROS, a stamp of 0 means that there is none."""
MARKER_PERIOD = 1.0
"""Markers that hang on a frame are sent anew so often [s], for viewers that join late."""
MOST_PATHS = 60
"""Most messages with the observed path, each longer than the one before."""
DOT = np.full(3, 0.012)
"""Size of the dots at the centres of mass [m]."""
TOPICS = {
    "/tf_static": TRANSFORMS,
    "/tf": TRANSFORMS,
    "/observed/path": "nav_msgs/msg/Path",
    "/imagined/path": "nav_msgs/msg/Path",
    "/markers": "visualization_msgs/msg/MarkerArray",
    "/view/height": "sensor_msgs/msg/Image",
    "/camera/color/image_raw": "sensor_msgs/msg/Image",
    "/camera/color/camera_info": "sensor_msgs/msg/CameraInfo",
    "/camera/depth/image_rect_raw": "sensor_msgs/msg/Image",
    "/camera/depth/camera_info": "sensor_msgs/msg/CameraInfo",
}
"""What a bag may hold, by topic."""
LATCHED = ("/tf_static", "/imagined/path", "/view/height")
"""Topics whose last message is kept for those who come later."""
CONFIGURATIONS: dict[RosVersion, str] = {1: "ros1.rviz", 2: "ros2.rviz"}


@dataclass(frozen=True)
class Stamped:
    """A message, and when and where it is sent."""

    stamp: int
    """Time [ns]."""
    topic: str
    """One of `TOPICS`."""
    message: Any
    """What is sent."""


def export_rosbags(
    episodes: Sequence[Episode], out: Path, version: RosVersion = 2, camera: bool = True
) -> None:
    """Write one bag for each interaction, and the RViz configuration that shows them.

    Args:
        episodes: What to write.
        out: Folder to make: ``interaction-000012`` for ROS 2 (MCAP), ``interaction-000012.bag`` for ROS 1.
        version: Version of ROS.
        camera: Whether simulated interactions get the images of a camera beside the table.

    Raises:
        ExportError: The folder exists, or the machine cannot render.
    """
    make = Messages(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    with delivered(out) as folder:
        for episode in watched(episodes, "bags"):
            path = folder / f"interaction-{episode.interaction.id:06d}"
            if version == 1:
                _write_ros1(path.with_suffix(".bag"), make, stamped_messages(episode, make, camera))
            else:
                _write_ros2(path, make, stamped_messages(episode, make, camera))
        name = CONFIGURATIONS[version]
        configuration = importlib.resources.files("foretrace.export") / "rviz" / name
        (folder / "foretrace.rviz").write_bytes(configuration.read_bytes())


def stamped_messages(episode: Episode, make: Messages, camera: bool) -> list[Stamped]:
    """Everything that a bag holds, in the order of time."""
    interaction = episode.interaction
    seen = images_of_samples(interaction) if camera else None
    messages = [
        *_at_rest(episode, make, seen),
        *_moving_frames(episode, make),
        *_observed_paths(episode, make),
        *_markers(episode, make),
        *_images(interaction.effect.times, make, seen),
    ]
    return sorted(messages, key=lambda each: each.stamp)


def stamps_of(times: Float[np.ndarray, " time"]) -> list[int]:
    """Time stamps [ns] of an interaction's times [s]."""
    return [round((START + float(time)) * 1e9) for time in times]


def _at_rest(episode: Episode, make: Messages, seen: RenderedImages | None) -> Iterator[Stamped]:
    """What is known before the blade moves: the view from above, the imagined path, where the camera is."""
    interaction, first = episode.interaction, stamps_of(episode.interaction.effect.times)[0]
    yield Stamped(first, "/view/height", make.image(first, ACTION, interaction.view.height))
    if episode.imagined is not None:
        poses = _with_rotation(episode.imagined.com_trajectory, episode.imagined_pose)
        path = make.path(stamps_of(episode.imagined.times), ACTION, poses)
        path.header.stamp = make.header(first, ACTION).stamp
        yield Stamped(first, "/imagined/path", path)
    if seen is not None:
        there = make.transform(first, ACTION, CAMERA, matrix_to_pose(seen.T_action_camera))
        yield Stamped(first, "/tf_static", make.make(TRANSFORMS, transforms=[there]))


def _moving_frames(episode: Episode, make: Messages) -> Iterator[Stamped]:
    effect, ghost = episode.interaction.effect, episode.imagined_pose
    for k, stamp in enumerate(stamps_of(effect.times)):
        moving = {THING: effect.pose_trajectory[k], TOOL: effect.tool_trajectory[k]}
        if ghost is not None:
            moving[GHOST] = ghost[_nearest(episode, k)]
        frames = [make.transform(stamp, ACTION, child, pose) for child, pose in moving.items()]
        yield Stamped(stamp, "/tf", make.make(TRANSFORMS, transforms=frames))


def _observed_paths(episode: Episode, make: Messages) -> Iterator[Stamped]:
    effect = episode.interaction.effect
    stamps = stamps_of(effect.times)
    poses = _with_rotation(effect.com_trajectory, effect.pose_trajectory)
    ends = np.unique(np.linspace(1, len(stamps), min(len(stamps), MOST_PATHS)).round().astype(int))
    for end in ends:
        yield Stamped(stamps[end - 1], "/observed/path", make.path(stamps[:end], ACTION, poses[:end]))


def _markers(episode: Episode, make: Messages) -> Iterator[Stamped]:
    effect, last = episode.interaction.effect, -np.inf
    for k, stamp in enumerate(stamps_of(effect.times)):
        centres = [(effect.com_trajectory[k], OBSERVED)]
        if episode.imagined is not None:
            centres.append((episode.imagined.com_trajectory[_nearest(episode, k)], IMAGINED))
        dots = [
            make.solid(
                stamp, ACTION, "centre of mass", id, "sphere", np.array([*com, 1, 0, 0, 0]), DOT, colour
            )
            for id, (com, colour) in enumerate(centres)
        ]
        if effect.times[k] - last >= MARKER_PERIOD:
            last = effect.times[k]
            dots += _bodies(episode, make, stamp)
        yield Stamped(stamp, "/markers", make.make(TOPICS["/markers"], markers=dots))


def _bodies(episode: Episode, make: Messages, stamp: int) -> Iterator[Any]:
    """Object, imagined object and screwdriver, each hanging on its frame."""
    surface = triangles_of(episode.interaction.object)
    yield make.mesh(stamp, THING, "object", 0, surface, OBJECT, 0.35)
    if episode.imagined_pose is not None:
        yield make.mesh(stamp, GHOST, "imagined object", 0, surface, IMAGINED, 0.3)
    for id, part in enumerate(episode.interaction.action.tool.parts()):
        yield make.part(stamp, TOOL, "tool", id, part)


def _images(
    times: Float[np.ndarray, " time"], make: Messages, seen: RenderedImages | None
) -> Iterator[Stamped]:
    if seen is None:
        return
    for k, stamp in enumerate(stamps_of(times)):
        info = make.camera_info(stamp, CAMERA, seen.camera)
        for stream, pixels in (("color/image_raw", seen.rgb[k]), ("depth/image_rect_raw", seen.depth[k])):
            yield Stamped(stamp, f"/camera/{stream}", make.image(stamp, CAMERA, pixels))
            yield Stamped(stamp, f"/camera/{stream.split('/')[0]}/camera_info", info)


def _nearest(episode: Episode, k: int) -> int:
    """The imagined sample that is nearest to an observed one in time; the last stays."""
    assert episode.imagined is not None
    return int(np.abs(episode.imagined.times - episode.interaction.effect.times[k]).argmin())


def _with_rotation(
    com: Float[np.ndarray, "time 3"], pose: Float[np.ndarray, "time 7"] | None
) -> Float[np.ndarray, "time 7"]:
    """The centre of mass with the object's rotation, or with none where that is not known."""
    still = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (len(com), 4))
    return np.concatenate([com, still if pose is None else pose[:, 3:]], axis=1)


def _write_ros1(path: Path, make: Messages, messages: Sequence[Stamped]) -> None:
    # Not compressed: ROS 1 cannot read the frames of lz4 that rosbags writes, and bz2 takes half a minute for a bag.
    with rosbag1.Writer(path) as writer:
        topics = {}
        for topic in _topics(messages):
            latching = int(topic in LATCHED)
            topics[topic] = writer.add_connection(
                topic, TOPICS[topic], typestore=make.store, callerid="/foretrace", latching=latching
            )
        for each in messages:
            data = make.store.serialize_ros1(each.message, TOPICS[each.topic])
            writer.write(topics[each.topic], each.stamp, data)


def _write_ros2(path: Path, make: Messages, messages: Sequence[Stamped]) -> None:
    # Version 8 of the metadata is the newest that does without the profiles' new layout.
    writer = rosbag2.Writer(path, version=8, storage_plugin=rosbag2.StoragePlugin.MCAP)
    writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    writer.set_custom_data("made by", "foretrace")
    with writer:
        topics = {}
        for topic in _topics(messages):
            profiles = [_kept()] if topic in LATCHED else []
            topics[topic] = writer.add_connection(
                topic, TOPICS[topic], typestore=make.store, offered_qos_profiles=profiles
            )
        for each in messages:
            data = make.store.serialize_cdr(each.message, TOPICS[each.topic])
            writer.write(topics[each.topic], each.stamp, data)


def _topics(messages: Sequence[Stamped]) -> list[str]:
    used = {each.topic for each in messages}
    return [topic for topic in TOPICS if topic in used]


def _kept() -> Qos:
    """The profile of a topic whose last message is kept for those who come later."""
    never = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        False,
    )
