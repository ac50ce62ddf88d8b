"""A rigid body by its mass and collision shapes, for motions without a tool."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foretrace.errors import SimulationError
from foretrace.geometry import quaternion_to_matrix
from foretrace.objects.model import (
    CollisionShape,
    CylinderShape,
    HullShape,
    MassProperties,
    ObjectModel,
    convex_mass_properties,
)

FLAT = "{} vertices enclose no volume: give at least four, not in one plane"


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body: convex pieces or one cylinder, and how its mass is distributed."""

    mass: MassProperties
    """Mass, centre of mass and inertia, in the object frame."""
    shapes: tuple[CollisionShape, ...]
    """What it collides with: hulls of vertices, cylinders, or both, in the object frame."""

    def __post_init__(self) -> None:
        from scipy.spatial import ConvexHull, QhullError

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
        from scipy.spatial import ConvexHull, QhullError

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
