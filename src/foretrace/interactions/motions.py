"""Recorded motions of rigid bodies: the file format, and the checks of what is read."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from foretrace.errors import DatasetError, ForetraceError, SimulationError
from foretrace.files import read_versioned
from foretrace.geometry import continuous_quaternions, finite_array
from foretrace.objects import NO_BEVEL, MassProperties, Prism
from foretrace.objects.body import Body
from foretrace.trajectories import check_poses

FORMAT = "foretrace-motion"
VERSION = 1
UNITS = "m, kg, s"
REMEDY = "give a file of recorded motions"
DEEPEST_START = 0.005
"""Noise may put a body this far into the table at the start [m]; it is lifted out."""
SHAPES = ("box", "cylinder", "hull", "prism", "mesh")


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
    content = read_versioned(path, FORMAT, VERSION, DatasetError, REMEDY, key="version")
    if content.get("units") != UNITS:
        raise DatasetError(f'{path} has units {content.get("units")!r}: convert it to "{UNITS}"')
    entries = content.get("recordings")
    if not isinstance(entries, list) or not entries:
        raise DatasetError(f'{path}: "recordings" must be a list with at least one recording')
    result = []
    for index, entry in enumerate(entries):
        name = str(entry.get("name", f"{path.stem}-{index}")) if isinstance(entry, dict) else str(index)
        try:
            result.append(_recording(entry, name, path.parent))
        except ForetraceError as error:
            raise DatasetError(f"{path}: recording {name}: {error}") from error
    names = [recording.name for recording in result]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DatasetError(f"{path}: two recordings are called {twice}")
    return result


def _recording(entry: Any, name: str, folder: Path) -> Recording:
    if not isinstance(entry, dict):
        raise DatasetError("it is no JSON object")
    body = _body(entry, folder)
    times, poses = _motion(entry)
    gravity = _numbers(entry, "gravity", (3,), default=GRAVITY)
    contact_parameters = ContactParameters(
        friction=_number(entry, "friction"),
        restitution=_number(entry, "restitution", 0.0),
        rolling_friction=_number(entry, "rolling_friction", 0.0),
        gravity=(float(gravity[0]), float(gravity[1]), float(gravity[2])),
    )
    velocity = None
    if "linear_velocity" in entry or "angular_velocity" in entry:
        parts = [_numbers(entry, key, (3,)) for key in ("linear_velocity", "angular_velocity")]
        velocity = np.concatenate(parts)
    depth = -body.lowest(poses[0])
    if depth > DEEPEST_START:
        raise DatasetError(
            f"in the first frame the object is {1e3 * depth:.1f} mm deep in the table, "
            f"noise explains at most {1e3 * DEEPEST_START:.0f} mm: check pose, size and the table's height"
        )
    return Recording(
        name, body, contact_parameters, times, poses, velocity, entry["object"]["kind"] == "cylinder"
    )


def _motion(entry: dict[str, Any]) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, "time 7"]]:
    times = _numbers(entry, "times", (None,))
    poses = _numbers(entry, "poses", (None, 7))
    check_poses(times, poses, DatasetError)
    if len(times) < 2:
        raise DatasetError("a motion needs at least two frames")
    lengths = np.linalg.norm(poses[:, 3:], axis=1)
    quaternions = continuous_quaternions(poses[:, 3:] / lengths[:, None])
    return times - times[0], np.concatenate([poses[:, :3], quaternions], axis=1)


def _body(entry: dict[str, Any], folder: Path) -> Body:
    shape = entry.get("object")
    if not isinstance(shape, dict) or shape.get("kind") not in SHAPES:
        kind = shape.get("kind") if isinstance(shape, dict) else shape
        raise DatasetError(f"object of kind {kind!r} is unknown: choose one of {', '.join(SHAPES)}")
    mass = _number(entry, "mass")
    if mass <= 0:
        raise DatasetError(f"mass is {mass:g} kg, it must be above 0")
    body = _uniform(shape, mass, folder)
    com = _numbers(entry, "com", (3,), default=body.mass.com)
    inertia = _numbers(entry, "inertia", (3, 3), default=body.mass.inertia)
    return Body(MassProperties(mass, com, (inertia + inertia.T) / 2), body.shapes)


def _uniform(shape: dict[str, Any], mass: float, folder: Path) -> Body:
    """The body of a description, its mass spread evenly."""
    kind = shape["kind"]
    if kind == "box":
        return Body.box(_positive(shape, "size", (3,)).tolist(), mass)
    if kind == "cylinder":
        radius, length = (float(_positive(shape, key, ())) for key in ("radius", "length"))
        return Body.cylinder(radius, length, mass)
    if kind == "prism":
        corners, height = _numbers(shape, "corners", (None, 2)), float(_positive(shape, "height", ()))
        prism = Prism(corners, height, NO_BEVEL)
        return Body.of(prism, mass / prism.mass_properties(1.0).mass)
    if kind == "hull":
        return Body.hull(_numbers(shape, "vertices", (None, 3)), mass)
    import trimesh

    file = folder / str(shape.get("file", ""))
    try:
        mesh = trimesh.load_mesh(file)
        vertices = np.array(mesh.vertices, dtype=float) * _number(shape, "scale", 1.0)
    except Exception as error:  # trimesh's readers raise whatever the file makes them stumble over
        raise DatasetError(f"mesh file {file} cannot be read ({error}): give an STL or OBJ file") from error
    return Body.hull(vertices, mass)


def _number(entry: dict[str, Any], key: str, default: float | None = None) -> float:
    return float(_numbers(entry, key, (), default))


def _positive(entry: dict[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray:
    values = _numbers(entry, key, shape)
    if not (values > 0).all():
        raise DatasetError(f"{key} is {values.tolist()}: lengths in metres must be above 0")
    return values


def _numbers(
    entry: dict[str, Any], key: str, shape: tuple[int | None, ...], default: Any = None
) -> np.ndarray:
    """Finite numbers in a shape; None in the shape stands for any length."""
    if entry.get(key) is None and default is None:
        raise DatasetError(f'"{key}" is missing')
    values = default if entry.get(key) is None else entry[key]
    return finite_array(f'"{key}"', values, shape, DatasetError)
