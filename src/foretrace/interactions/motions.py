"""Recorded motions of rigid bodies: the file format, and the checks of what is read."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import numpy as np
from jaxtyping import Float
from msgspec import Meta

from foretrace.errors import DatasetError, ForetraceError, SimulationError, shown
from foretrace.files import read_versioned
from foretrace.geometry import continuous_quaternions
from foretrace.objects import NO_BEVEL, MassProperties, Prism
from foretrace.objects.body import Body
from foretrace.objects.mesh_files import read_mesh
from foretrace.schema import Finite, Pose, Positive, Vector2, Vector3, conform
from foretrace.trajectories import check_poses

FORMAT = "foretrace-motion"
VERSION = 1
UNITS = "m, kg, s"
REMEDY = "give a file of recorded motions"
DEEPEST_START = 0.005
"""Noise may put a body this far into the table at the start [m]; it is lifted out."""


class BoxEntry(TypedDict):
    """Schema of a box."""

    size: Annotated[list[Positive], Meta(min_length=3, max_length=3)]


class CylinderEntry(TypedDict):
    """Schema of a cylinder along z."""

    radius: Positive
    length: Positive


class HullEntry(TypedDict):
    """Schema of a convex body."""

    vertices: list[Vector3]


class PrismEntry(TypedDict):
    """Schema of a prism."""

    corners: list[Vector2]
    height: Positive


class MeshEntry(TypedDict):
    """Schema of a body in a mesh file."""

    file: str
    scale: NotRequired[Positive]


SHAPES = {
    "box": BoxEntry,
    "cylinder": CylinderEntry,
    "hull": HullEntry,
    "prism": PrismEntry,
    "mesh": MeshEntry,
}
"""Schema of each kind of object; lengths in metres."""


class RecordingEntry(TypedDict):
    """Schema of one recording; SI units."""

    object: dict[str, Any]
    mass: Positive
    friction: Finite
    times: list[Finite]
    poses: list[Pose]
    restitution: NotRequired[Finite | None]
    rolling_friction: NotRequired[Finite | None]
    gravity: NotRequired[Vector3 | None]
    linear_velocity: NotRequired[Vector3 | None]
    angular_velocity: NotRequired[Vector3 | None]
    com: NotRequired[Vector3 | None]
    inertia: NotRequired[Annotated[list[Vector3], Meta(min_length=3, max_length=3)] | None]


class Motions(TypedDict):
    """Schema of the file."""

    units: str
    recordings: Annotated[list[dict[str, Any]], Meta(min_length=1)]


GRAVITY = (0.0, 0.0, -9.81)
"""Gravity on a level table [m/s^2]."""


@dataclass(frozen=True)
class ContactParameters:
    """What a body moves in."""

    friction: float = 0.8
    """Coulomb friction coefficient between body and table."""
    restitution: float | None = None
    """Share of the speed that is left after an impact on the table; None: contacts as in lever-ups.

    Lever-ups in MuJoCo have soft contacts, into which a body that falls at 1 m/s sinks by 5 mm. With a number
    contacts are as stiff as the time step bears. Bullet's contacts are rigid either way.
    """
    rolling_friction: float = 0.0
    """Lever arm of the table's resistance to rolling [m]; felt by cylinders alone."""
    gravity: tuple[float, float, float] = GRAVITY
    """Gravity in the table frame [m/s^2]: tilted, it makes the table an incline."""

    def __post_init__(self) -> None:
        if not 0 <= self.friction <= 10:
            raise SimulationError(f"friction coefficient {self.friction}: choose one between 0 and 10")
        if self.restitution is not None and not 0 <= self.restitution <= 1:
            raise SimulationError(f"restitution {self.restitution}: choose one between 0 and 1")
        if not 0 <= self.rolling_friction <= 0.1:
            raise SimulationError(f"rolling friction {self.rolling_friction} m: choose one between 0 and 0.1")
        if len(self.gravity) != 3 or not np.isfinite(self.gravity).all():
            raise SimulationError(f"gravity {self.gravity}: give three finite numbers")


@dataclass(frozen=True, eq=False)
class Recording:
    """One object's recorded motion on a table."""

    name: str
    """What it is called in results."""
    body: Body
    """The object."""
    contact_parameters: ContactParameters
    """Friction, restitution and gravity."""
    times: Float[np.ndarray, " time"]
    """Times since the first frame [s]."""
    poses: Float[np.ndarray, "time 7"]
    """Object frame in the table frame: position [m], quaternion (w, x, y, z)."""
    velocity: Float[np.ndarray, " 6"] | None
    """Velocity of the centre of mass [m/s] and angular velocity [rad/s] at the first frame; None: not recorded."""
    is_round: bool
    """Whether the object is a cylinder, the same after any turn about its axis."""


def read_recordings(path: str | Path) -> list[Recording]:
    """The recordings in a file.

    Raises:
        DatasetError: If the file cannot be read or does not hold what the format asks for.
    """
    path = Path(path)
    content = read_versioned(path, Motions, FORMAT, VERSION, DatasetError, REMEDY, key="version")
    if content["units"] != UNITS:
        raise DatasetError(f'{path} has units {shown(content["units"])}: convert it to "{UNITS}"')
    result = []
    for index, entry in enumerate(content["recordings"]):
        name = str(entry.get("name", f"{path.stem}-{index}"))
        where = f"{path}: recording {name:.80}"
        found = conform(entry, RecordingEntry, where, DatasetError, "see the format in the documentation")
        try:
            result.append(_recording(found, name, path.parent))
        except ForetraceError as error:
            raise DatasetError(f"{where}: {error}") from error
    names = [recording.name for recording in result]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DatasetError(f"{path}: two recordings are called {twice}")
    return result


def _recording(entry: RecordingEntry, name: str, folder: Path) -> Recording:
    body = _body(entry, folder)
    times, poses = _motion(entry)
    gravity = entry.get("gravity") or GRAVITY
    contact_parameters = ContactParameters(
        friction=float(entry["friction"]),
        restitution=float(entry.get("restitution") or 0.0),
        rolling_friction=float(entry.get("rolling_friction") or 0.0),
        gravity=(float(gravity[0]), float(gravity[1]), float(gravity[2])),
    )
    velocities = [entry.get(key) for key in ("linear_velocity", "angular_velocity")]
    if (velocities[0] is None) != (velocities[1] is None):
        raise DatasetError("it has a linear_velocity or an angular_velocity: give both, or none")
    velocity = None if velocities[0] is None else np.array(velocities, dtype=float).ravel()
    depth = -body.lowest(poses[0])
    if depth > DEEPEST_START:
        raise DatasetError(
            f"in the first frame the object is {1e3 * depth:.1f} mm deep in the table, "
            f"noise explains at most {1e3 * DEEPEST_START:.0f} mm: check pose, size and the table's height"
        )
    return Recording(
        name, body, contact_parameters, times, poses, velocity, entry["object"]["kind"] == "cylinder"
    )


def _motion(entry: RecordingEntry) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, "time 7"]]:
    times, poses = (np.array(entry[key], dtype=float) for key in ("times", "poses"))
    poses = poses.reshape(-1, 7)
    check_poses(times, poses, DatasetError)
    if len(times) < 2:
        raise DatasetError("a motion needs at least two frames")
    lengths = np.linalg.norm(poses[:, 3:], axis=1)
    quaternions = continuous_quaternions(poses[:, 3:] / lengths[:, None])
    return times - times[0], np.concatenate([poses[:, :3], quaternions], axis=1)


def _body(entry: RecordingEntry, folder: Path) -> Body:
    shape = entry["object"]
    kind = shape.get("kind")
    if kind not in list(SHAPES):
        raise DatasetError(f"object of kind {shown(kind)} is unknown: choose one of {', '.join(SHAPES)}")
    described = conform(
        shape, SHAPES[kind], "it", DatasetError, "lengths in metres must be above 0", "object"
    )
    mass = float(entry["mass"])
    body = _uniform(described, kind, mass, folder)
    com = np.array(body.mass.com if (com := entry.get("com")) is None else com, dtype=float)
    inertia = np.array(body.mass.inertia if (found := entry.get("inertia")) is None else found, dtype=float)
    return Body(MassProperties(mass, com, (inertia + inertia.T) / 2), body.shapes)


def _uniform(shape: Mapping[str, Any], kind: str, mass: float, folder: Path) -> Body:
    """The body of a description, its mass spread evenly."""
    if kind == "box":
        return Body.box(list(map(float, shape["size"])), mass)
    if kind == "cylinder":
        return Body.cylinder(float(shape["radius"]), float(shape["length"]), mass)
    if kind == "prism":
        prism = Prism(np.array(shape["corners"], dtype=float), float(shape["height"]), NO_BEVEL)
        return Body.of(prism, mass / prism.mass_properties(1.0).mass)
    if kind == "hull":
        return Body.hull(np.array(shape["vertices"], dtype=float), mass)
    vertices, _ = read_mesh(folder / shape["file"], DatasetError)
    return Body.hull(vertices * shape.get("scale", 1.0), mass)
