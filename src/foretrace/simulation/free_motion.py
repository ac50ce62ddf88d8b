"""A rigid body on the table without a tool: it falls, slides, rolls, tips and comes to rest.

What both engines are checked with against mechanics in closed form, and what recorded motions are replayed with.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from foretrace.errors import SimulationError
from foretrace.geometry import Numbers, continuous_quaternions, quaternion_to_matrix
from foretrace.objects import CollisionShape, CylinderShape, HullShape, MassProperties, ObjectModel
from foretrace.objects.model import convex_mass_properties
from foretrace.simulation.engine import ENGINES

GRAVITY = (0.0, 0.0, -9.81)
"""Gravity on a level table [m/s^2]."""
FLAT = "{} vertices enclose no volume: give at least four, not in one plane"


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body: convex pieces or one cylinder, and how its mass is distributed."""

    mass: MassProperties
    """Mass, centre of mass and inertia, in the object frame."""
    shapes: tuple[CollisionShape, ...]
    """What it collides with: hulls of vertices, cylinders, or both, in the object frame."""

    def __post_init__(self) -> None:
        inertia = np.linalg.eigvalsh(self.mass.inertia)
        if not 0 < self.mass.mass < np.inf:
            raise SimulationError(f"a body of mass {self.mass.mass:g} kg: it must be finite and above 0")
        # No body has more inertia about one axis than about the two others together.
        if not (inertia[0] > 0 and inertia[2] <= (inertia[0] + inertia[1]) * (1 + 1e-6)):
            raise SimulationError(f"no body has the principal inertia {inertia.tolist()} kg m^2")
        for hull in (shape for shape in self.shapes if isinstance(shape, HullShape)):
            try:
                ConvexHull(hull.vertices)
            except (QhullError, ValueError) as error:
                raise SimulationError(FLAT.format(len(hull.vertices))) from error

    @classmethod
    def box(cls, size: Sequence[float], mass: float) -> "Body":
        """A box of uniform density around the origin, by the lengths of its sides [m] and its mass [kg]."""
        x, y, z = (float(length) for length in size)
        signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
        inertia = mass / 12 * np.diag([y * y + z * z, x * x + z * z, x * x + y * y])
        hull = HullShape(signs * [x / 2, y / 2, z / 2])
        return cls(MassProperties(float(mass), np.zeros(3), inertia), (hull,))

    @classmethod
    def cylinder(cls, radius: float, length: float, mass: float) -> "Body":
        """A cylinder of uniform density around the z axis, centred at the origin [m, kg]."""
        across = mass * (3 * radius**2 + length**2) / 12
        inertia = np.diag([across, across, mass * radius**2 / 2])
        shape = CylinderShape(float(radius), float(length), np.eye(4))
        return cls(MassProperties(float(mass), np.zeros(3), inertia), (shape,))

    @classmethod
    def hull(cls, vertices: Float[np.ndarray, "n 3"], mass: float) -> "Body":
        """The convex hull of points [m], of uniform density and a mass [kg]."""
        try:
            corners = vertices[ConvexHull(vertices).vertices]
        except (QhullError, ValueError, IndexError) as error:
            raise SimulationError(FLAT.format(len(vertices))) from error
        uniform = convex_mass_properties([corners], 1.0)
        return cls(uniform.scaled(mass / uniform.mass), (HullShape(corners),))

    @classmethod
    def of(cls, obj: ObjectModel, density: float) -> "Body":
        """An object of the lever-ups, of a uniform density [kg/m^3]."""
        return cls(obj.mass_properties(density), tuple(obj.collision_shapes()))

    def lowest(self, pose: Float[np.ndarray, " 7"]) -> float:
        """Height of the body's lowest point above the table in a pose [m]; negative where it is below."""
        down = quaternion_to_matrix(pose[3:])[2]
        return float(pose[2]) + min(_reach(shape, down) for shape in self.shapes)


def _reach(shape: CollisionShape, direction: Float[np.ndarray, " 3"]) -> float:
    """Smallest coordinate of a shape's points along a direction of the object frame [m]."""
    if isinstance(shape, HullShape):
        return float((shape.vertices @ direction).min())
    along = float(shape.T_object_shape[:3, 2] @ direction)
    across = float(np.sqrt(max(1 - along**2, 0)))
    middle = float(shape.T_object_shape[:3, 3] @ direction)
    return middle - shape.radius * across - shape.length / 2 * abs(along)


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """Where a body was, in the table frame."""

    times: Float[np.ndarray, " time"]
    """Times since the start [s]."""
    poses: Float[np.ndarray, "time 7"]
    """Object frame: position [m], quaternion (w, x, y, z) without jumps of sign."""
    velocities: Float[np.ndarray, "time 6"]
    """Velocity of the centre of mass [m/s], and angular velocity [rad/s]."""

    def at(self, times: Float[np.ndarray, " sample"]) -> "FreeMotion":
        """The motion at other times, interpolated between two steps."""
        columns = np.concatenate([self.poses, self.velocities], axis=1)
        values = np.column_stack([np.interp(times, self.times, column) for column in columns.T])
        values[:, 3:7] /= np.linalg.norm(values[:, 3:7], axis=1, keepdims=True)
        return FreeMotion(np.asarray(times, dtype=float), values[:, :7], values[:, 7:])


@dataclass(frozen=True)
class Surroundings:
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


def simulate_free_motion(
    body: Body,
    start: Numbers,
    duration: float,
    *,
    velocity: Numbers = (0.0,) * 6,
    surroundings: Surroundings = Surroundings(),
    engine: str = "mujoco",
    timestep: float = 0.002,
) -> FreeMotion:
    """Lets a body go and follows it.

    Args:
        body: The body.
        start: Pose of its object frame in the table frame: position [m], quaternion (w, x, y, z).
        duration: How long to follow it [s]; rounded up to whole time steps.
        velocity: Velocity of its centre of mass [m/s] and angular velocity [rad/s] at the start, table frame.
        surroundings: Friction, restitution and gravity.
        engine: One of ENGINES.
        timestep: Time step [s].

    Returns:
        The motion at every time step.

    Raises:
        SimulationError: If the engine is unknown or not installed, a value is out of range, or the numbers blow up.
    """
    pose, speed = np.array(start, dtype=float), np.array(velocity, dtype=float)
    if pose.shape != (7,) or speed.shape != (6,) or not np.isfinite([*pose, *speed]).all():
        raise SimulationError("a start is seven finite numbers (pose) and six (velocity)")
    if abs(np.linalg.norm(pose[3:]) - 1) > 1e-3:
        raise SimulationError(f"quaternion {pose[3:].tolist()} has not the length 1")
    if not (0 < timestep <= 0.02 and 0 <= duration <= 3600):
        raise SimulationError(
            f"timestep = {timestep} s, duration = {duration} s: choose at most 0.02 s and an hour"
        )
    steps = int(np.ceil(duration / timestep - 1e-9))
    poses, velocities = _player(engine)(body, pose, speed, surroundings, steps, timestep)
    if not np.isfinite(poses).all():
        raise SimulationError("the numbers blew up: take a smaller time step")
    poses[:, 3:] = continuous_quaternions(poses[:, 3:])
    return FreeMotion(np.arange(steps + 1) * timestep, poses, velocities)


def _player(engine: str) -> Any:
    if engine == "mujoco":
        from foretrace.simulation.mujoco_free_motion import play_freely
    elif engine == "bullet":
        from foretrace.simulation.bullet_engine import play_freely
    else:
        raise SimulationError(f"engine {engine!r} is unknown: choose one of {', '.join(ENGINES)}")
    return play_freely
