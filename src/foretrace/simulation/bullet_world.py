"""Bodies in Bullet, the paper's physics engine: table, objects and tools.

Bullet puts a body's frame at its centre of mass, along its principal axes, and multiplies the friction coefficients
of two surfaces. Objects therefore have friction 1, and table and blade the coefficient of their pair.
"""

import os
import sys
import tempfile
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from foretrace.actions import Tool
from foretrace.errors import SimulationError
from foretrace.geometry import (
    invert_transform,
    matrix_to_pose,
    pose_to_matrix,
    rigid_transform,
    transform_points,
)
from foretrace.objects import CollisionShape, CylinderShape, HullShape
from foretrace.objects.body import Body
from foretrace.objects.footed import convex_union
from foretrace.simulation.scene import TABLE_HEIGHT, TABLE_SIZE, TABLE_THICKNESS

COLLISION_MARGIN = 2e-5
"""Bullet rounds shapes by this radius, so an object rests so far above the table [m]."""
SOLVER_ITERATIONS = 50
CONTACT_BREAKING = 0.001
"""Bullet forgets contacts that open by more than this [m]."""
BOUNCE_SPEED = 0.01
"""Slower impacts do not bounce [m/s]."""
TOOL_MASS = 1e6
"""So heavy that no object disturbs the tool's path [kg, kg m^2]."""


class Client:
    """The library's functions, each with the number of one connection."""

    def __init__(self, library: Any) -> None:
        self._library, self._number = library, library.connect(library.DIRECT)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._library, name)
        return partial(value, physicsClientId=self._number) if callable(value) else value


@lru_cache(maxsize=1)
def connect() -> Client:
    """This process's Bullet, without a window; one for all simulations, as connecting takes longer than they do.

    Raises:
        SimulationError: If pybullet is not installed.
    """
    sys.stderr.flush()
    # On import pybullet announces its date of birth on standard error, from C.
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        import pybullet
    except ImportError as error:
        raise SimulationError(
            "engine 'bullet' needs the library pybullet: pip install 'foretrace[bullet]'"
        ) from error
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
    return Client(pybullet)


class World:
    """An empty Bullet world, as good as new: equal calls give equal numbers.

    Args:
        timestep: Time step [s].
        gravity: Gravity [m/s^2].

    Raises:
        SimulationError: If pybullet is not installed.
    """

    def __init__(self, timestep: float, gravity: tuple[float, float, float]) -> None:
        self.bullet = connect()
        self.timestep, self.gravity = timestep, gravity
        self._frames: dict[int, Float[np.ndarray, "4 4"]] = {}
        self.bullet.resetSimulation()
        self.bullet.setPhysicsEngineParameter(
            fixedTimeStep=timestep,
            numSubSteps=0,
            numSolverIterations=SOLVER_ITERATIONS,
            solverResidualThreshold=0.0,  # always all iterations
            deterministicOverlappingPairs=1,
            contactBreakingThreshold=CONTACT_BREAKING,
            restitutionVelocityThreshold=BOUNCE_SPEED,
            enableFileCaching=0,
        )
        self.bullet.setGravity(*gravity)

    def add_table(
        self, friction: float, rolling_friction: float = 0.0, edge: float | None = None
    ) -> tuple[int, ...]:
        """A table, endless or with a far edge above a floor.

        Args:
            friction: Friction coefficient between it and objects.
            rolling_friction: Lever arm of its resistance to rolling [m].
            edge: Distance of its far edge [m]; None for an endless one.

        Returns:
            Number of the table, and of the floor if there is one.
        """
        b = self.bullet
        plane = b.createCollisionShape(b.GEOM_PLANE, planeNormal=[0, 0, 1])
        if edge is None:
            bodies = (b.createMultiBody(0, plane),)
        else:
            half = [(TABLE_SIZE[0] + edge) / 2, TABLE_SIZE[1], TABLE_THICKNESS / 2]
            board = b.createCollisionShape(b.GEOM_BOX, halfExtents=half)
            table = b.createMultiBody(0, board, basePosition=[edge - half[0], 0, -half[2]])
            bodies = (table, b.createMultiBody(0, plane, basePosition=[0, 0, -TABLE_HEIGHT]))
        for body in bodies:
            self._surface(body, friction, rolling_friction)
        return bodies

    def add_object(
        self, body: Body, T_world_object: Float[np.ndarray, "4 4"], restitution: float = 0.0
    ) -> int:
        """A free body.

        Returns:
            Its number.

        Raises:
            SimulationError: If Bullet cannot build its shape.
        """
        inertia, axes = np.linalg.eigh(body.mass.inertia)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        frame = rigid_transform(axes, body.mass.com)
        pose = matrix_to_pose(T_world_object @ frame)
        with tempfile.TemporaryDirectory() as folder:
            number = self.bullet.createMultiBody(
                body.mass.mass,
                self._shape(body.shapes, invert_transform(frame), Path(folder)),
                basePosition=pose[:3].tolist(),
                baseOrientation=pose[[4, 5, 6, 3]].tolist(),
            )
        self._surface(number, 1.0)
        self.bullet.changeDynamics(number, -1, localInertiaDiagonal=inertia.tolist(), restitution=restitution)
        self._frames[number] = invert_transform(frame)
        return number

    def add_tool(self, tool: Tool, friction: float, not_against: tuple[int, ...]) -> int:
        """A tool as one heavy body with the tool's frame.

        Args:
            tool: The tool.
            friction: Friction coefficient between it and objects.
            not_against: Bodies that it passes through.

        Returns:
            Its number.
        """
        b, parts = self.bullet, tool.parts()
        shape = b.createCollisionShapeArray(
            shapeTypes=[b.GEOM_BOX if part.shape == "box" else b.GEOM_CAPSULE for part in parts],
            halfExtents=[part.end if part.shape == "box" else [0, 0, 0] for part in parts],
            radii=[part.radius for part in parts],
            lengths=[part.length for part in parts],
            collisionFramePositions=[part.pose[:3].tolist() for part in parts],
            collisionFrameOrientations=[part.pose[[4, 5, 6, 3]].tolist() for part in parts],
        )
        number = b.createMultiBody(TOOL_MASS, shape)
        self._surface(number, friction)
        b.changeDynamics(number, -1, localInertiaDiagonal=[TOOL_MASS] * 3)
        for other in not_against:
            b.setCollisionFilterPair(other, number, -1, -1, 0)
        self._frames[number] = np.eye(4)
        return number

    def pin(self, body: int, point: Float[np.ndarray, " 3"]) -> None:
        """Holds a point of a body's own frame [m] where it is."""
        inside = transform_points(self._frames[body], point[None])[0]
        here = transform_points(pose_to_matrix(self.pose(body)), point[None])[0]
        self.bullet.createConstraint(
            body, -1, -1, -1, self.bullet.JOINT_POINT2POINT, [0, 0, 0], inside.tolist(), here.tolist()
        )

    def push(self, body: int, force: Float[np.ndarray, " 3"]) -> None:
        """Pushes a body at its centre of mass during the next step [N]."""
        position, _ = self.bullet.getBasePositionAndOrientation(body)
        self.bullet.applyExternalForce(body, -1, force.tolist(), position, self.bullet.WORLD_FRAME)

    def centred_pose(self, body: int) -> list[float]:
        """Pose of a body's principal axes in its centre of mass, as `to_object_frame` takes it."""
        position, (x, y, z, w) = self.bullet.getBasePositionAndOrientation(body)
        return [*position, w, x, y, z]

    def to_object_frame(self, body: int, poses: list[list[float]]) -> Float[np.ndarray, "time 7"]:
        """Poses of a body's own frame: position [m], quaternion (w, x, y, z)."""
        return matrix_to_pose(pose_to_matrix(np.array(poses)) @ self._frames[body])

    def pose(self, body: int) -> Float[np.ndarray, " 7"]:
        """Pose of a body's own frame now: position [m], quaternion (w, x, y, z)."""
        return self.to_object_frame(body, [self.centred_pose(body)])[0]

    def velocity(self, body: int) -> Float[np.ndarray, " 6"]:
        """Velocity of the centre of mass [m/s], and angular velocity [rad/s]."""
        return np.concatenate(self.bullet.getBaseVelocity(body))

    def set_velocity(self, body: int, velocity: Float[np.ndarray, " 6"]) -> None:
        """Sets velocity of the centre of mass [m/s] and angular velocity [rad/s]."""
        self.bullet.resetBaseVelocity(body, velocity[:3].tolist(), velocity[3:].tolist())

    def _surface(self, body: int, friction: float, rolling_friction: float = 0.0) -> None:
        self.bullet.changeDynamics(
            body,
            -1,
            lateralFriction=friction,
            rollingFriction=rolling_friction,
            spinningFriction=0.0,
            restitution=1.0,
            linearDamping=0.0,
            angularDamping=0.0,
            collisionMargin=COLLISION_MARGIN,
        )

    def _shape(
        self, shapes: tuple[CollisionShape, ...], T_body_object: Float[np.ndarray, "4 4"], folder: Path
    ) -> int:
        """The collision shape of a body, in its own frame; a folder takes the files that it may need."""
        b = self.bullet
        hulls = [transform_points(T_body_object, s.vertices) for s in shapes if isinstance(s, HullShape)]
        cylinders = [s for s in shapes if isinstance(s, CylinderShape)]
        if (hulls and cylinders) or len(cylinders) > 1:
            raise SimulationError(
                "engine 'bullet' builds objects from convex pieces or from one cylinder alone"
            )
        if cylinders:
            pose = matrix_to_pose(T_body_object @ cylinders[0].T_object_shape)
            return b.createCollisionShape(
                b.GEOM_CYLINDER,
                radius=cylinders[0].radius,
                height=cylinders[0].length,
                collisionFramePosition=pose[:3].tolist(),
                collisionFrameOrientation=pose[[4, 5, 6, 3]].tolist(),
            )
        together = convex_union(hulls)
        if together is not None:
            return b.createCollisionShape(b.GEOM_MESH, vertices=together.tolist())
        # Only a file can hold several hulls. Bullet reads it once more when the body is made.
        file = folder / "pieces.obj"
        file.write_text(_wavefront(hulls), encoding="ascii")
        return b.createCollisionShape(b.GEOM_MESH, fileName=str(file))


def _wavefront(pieces: list[Float[np.ndarray, "_ 3"]]) -> str:
    """The pieces' hulls as objects of one Wavefront OBJ file."""
    lines, first = [], 1
    for i, piece in enumerate(pieces):
        lines.append(f"o piece_{i}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in piece]
        lines += [f"f {a + first} {b + first} {c + first}" for a, b, c in ConvexHull(piece).simplices]
        first += len(piece)
    return "\n".join(lines) + "\n"
