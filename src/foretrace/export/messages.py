"""ROS messages, made alike for ROS 1 and ROS 2."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from foretrace.actions.tool import Colour, ToolPart
from foretrace.interactions.pinhole import PinholeCamera

TRANSFORMS = "tf2_msgs/msg/TFMessage"
SHAPES = {"box": 1, "sphere": 2, "cylinder": 3, "triangles": 11}
"""Numbers of `visualization_msgs/Marker`."""


class Messages:
    """Makes messages of one version of ROS.

    Args:
        store: The version's message definitions.
    """

    def __init__(self, store: Stores):
        self.store = get_typestore(store)
        if TRANSFORMS not in self.store.types:  # ROS 1 keeps it apart from the common messages
            definition = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(definition, TRANSFORMS))

    def make(self, kind: str, **values: Any) -> Any:
        """A message with some fields set and the others zero, empty or false.

        Args:
            kind: Such as ``nav_msgs/msg/Path``.
            **values: Fields by name; ROS 1 writes some in capitals, here all are in small letters.
        """
        fields = {}
        for name, description in self.store.fielddefs[kind][1]:
            given = values.pop(name.lower(), None)
            fields[name] = self._zero(description) if given is None else given
        assert not values, f"{kind} has no {list(values)}"
        return self.store.types[kind](**fields)

    def _zero(self, description: Any) -> Any:
        node, content = description
        if node == Nodetype.NAME:
            return self.make(content)
        if node == Nodetype.BASE:
            return {"string": "", "bool": False}.get(content[0], 0)
        (element, inner), count = content
        if element == Nodetype.NAME:
            return []
        return np.zeros(count if node == Nodetype.ARRAY else 0, dtype=inner[0])

    def header(self, stamp: int, frame: str) -> Any:
        """A header with a time stamp [ns] and a frame."""
        seconds, nanoseconds = divmod(stamp, 10**9)
        time = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def point(self, xyz: Shaped[np.ndarray, "3"]) -> Any:
        """A point [m]."""
        x, y, z = map(float, xyz)
        return self.make("geometry_msgs/msg/Point", x=x, y=y, z=z)

    def vector(self, xyz: Sequence[float] | np.ndarray) -> Any:
        """A vector."""
        x, y, z = map(float, xyz)
        return self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def quaternion(self, wxyz: Sequence[float] | np.ndarray) -> Any:
        """A rotation from w, x, y, z; ROS keeps w last."""
        w, x, y, z = map(float, wxyz)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, pose: Float[np.ndarray, "7"]) -> Any:
        """A pose from position [m] and quaternion (w, x, y, z)."""
        position, orientation = self.point(pose[:3]), self.quaternion(pose[3:])
        return self.make("geometry_msgs/msg/Pose", position=position, orientation=orientation)

    def transform(self, stamp: int, parent: str, child: str, pose: Float[np.ndarray, "7"]) -> Any:
        """Where a child frame is in its parent's."""
        placed = self.make(
            "geometry_msgs/msg/Transform",
            translation=self.vector(pose[:3]),
            rotation=self.quaternion(pose[3:]),
        )
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp, parent),
            child_frame_id=child,
            transform=placed,
        )

    def path(self, stamps: Sequence[int], frame: str, poses: Float[np.ndarray, "n 7"]) -> Any:
        """A path, stamped with its last time."""
        stamped = [
            self.make("geometry_msgs/msg/PoseStamped", header=self.header(at, frame), pose=self.pose(pose))
            for at, pose in zip(stamps, poses, strict=True)
        ]
        return self.make("nav_msgs/msg/Path", header=self.header(stamps[-1], frame), poses=stamped)

    def marker(self, stamp: int, frame: str, name: str, id: int, **fields: Any) -> Any:
        """A marker that stays fixed to its frame until it is replaced."""
        fields.setdefault("pose", self.pose(np.array([0.0, 0, 0, 1, 0, 0, 0])))
        return self.make(
            "visualization_msgs/msg/Marker",
            header=self.header(stamp, frame),
            ns=name,
            id=id,
            frame_locked=True,
            **fields,
        )

    def solid(
        self,
        stamp: int,
        frame: str,
        name: str,
        id: int,
        shape: str,
        pose: Float[np.ndarray, "7"],
        size: Float[np.ndarray, "3"],
        colour: Colour,
    ) -> Any:
        """A marker in the shape of a box, a sphere, or a cylinder along z; sizes are whole lengths [m]."""
        return self.marker(
            stamp,
            frame,
            name,
            id,
            type=SHAPES[shape],
            pose=self.pose(pose),
            scale=self.vector(size),
            color=self.colour(colour),
        )

    def part(self, stamp: int, frame: str, name: str, id: int, part: ToolPart) -> Any:
        """A part of a tool; a cylinder stands for a capsule, which RViz does not have."""
        if part.shape == "box":
            shape, size = "box", 2 * np.array(part.end)
        else:
            shape, size = "cylinder", 2 * part.radius + np.array([0.0, 0.0, part.length])
        return self.solid(stamp, frame, name, id, shape, part.pose, size, part.colour)

    def mesh(
        self,
        stamp: int,
        frame: str,
        name: str,
        id: int,
        surface: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]],
        colour: Colour,
        opacity: float,
    ) -> Any:
        """A marker made of triangles: vertices [m] and the indices of each triangle's corners."""
        vertices, triangles = surface
        return self.marker(
            stamp,
            frame,
            name,
            id,
            type=SHAPES["triangles"],
            scale=self.vector([1.0, 1.0, 1.0]),
            color=self.colour(colour, opacity),
            points=[self.point(vertex) for vertex in vertices[triangles].reshape(-1, 3)],
        )

    def colour(self, colour: Colour, opacity: float = 1.0) -> Any:
        """A colour."""
        r, g, b = colour
        return self.make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=opacity)

    def image(self, stamp: int, frame: str, pixels: np.ndarray) -> Any:
        """An image: (rows, columns, 3) uint8 in colour, or (rows, columns) float32 in metres."""
        height, width = pixels.shape[:2]
        little_endian = pixels if pixels.dtype == np.uint8 else pixels.astype("<f4")
        data: UInt8[np.ndarray, " bytes"] = np.frombuffer(little_endian.tobytes(), dtype=np.uint8)
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp, frame),
            height=height,
            width=width,
            encoding="rgb8" if pixels.ndim == 3 else "32FC1",
            step=len(data) // height,
            data=data,
        )

    def camera_info(self, stamp: int, frame: str, camera: PinholeCamera) -> Any:
        """Intrinsics of a camera without distortion; pixel centres are whole numbers, as in ROS."""
        k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=float)
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(stamp, frame),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=k.ravel(),
            r=np.eye(3).ravel(),
            p=np.column_stack([k, np.zeros(3)]).ravel(),
        )
