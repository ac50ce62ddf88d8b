"""What every object offers, and the checks that all objects share."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from typing import Any, ClassVar

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.errors import ForetraceError, ShapeError, check_type, is_number, shown
from foretrace.geometry import convex_hull
from foretrace.registry import Registry
from foretrace.schema import parse_json

SIZE_LIMITS = (0.01, 1.0)
"""Smallest and largest believable length of an object [m]: anything else is a wrong unit or scale."""
USUAL_SIZES = (0.02, 0.4)
"""Smaller and larger objects are unusual, and pointed out [m]."""
HEIGHT_LIMITS = (0.001, 1.0)
"""Smallest and largest believable height of an object [m]."""


@dataclass(frozen=True)
class Bevel:
    """A chamfer all round an object's lower rim, which lets a blade get under it."""

    width: float = 0.009
    """How far the bottom face lies inside the outline [m]."""
    height: float = 0.003
    """Height above the table at which the outline is reached [m]."""

    def __post_init__(self) -> None:
        if not (is_number(self.width) and is_number(self.height)):
            raise ShapeError(
                f"bevel of {shown(self.width)} x {shown(self.height)}: give two numbers of metres"
            )
        if not (np.isfinite([self.width, self.height]).all() and min(self.width, self.height) >= 0):
            raise ShapeError(f"bevel of {self.width} m x {self.height} m: both must be finite and at least 0")
        if (self.width == 0) != (self.height == 0):
            raise ShapeError(
                f"bevel of {self.width} m x {self.height} m: use positive values, or NO_BEVEL for a sharp rim"
            )


BEVEL = Bevel()
NO_BEVEL = Bevel(0.0, 0.0)


@dataclass(frozen=True)
class MassProperties:
    """How an object's mass is distributed, in its own frame."""

    mass: float
    """Mass [kg]."""
    com: Float[np.ndarray, "3"]
    """Centre of mass in the object frame [m]."""
    inertia: Float[np.ndarray, "3 3"]
    """Inertia about the centre of mass, along the object's axes [kg m^2]."""

    def scaled(self, factor: float) -> "MassProperties":
        """The same body at a multiple of its density."""
        return MassProperties(factor * self.mass, self.com, factor * self.inertia)


@dataclass(frozen=True)
class HullShape:
    """A convex body given by points: the hull of its vertices."""

    vertices: Float[np.ndarray, "v 3"]
    """Vertices in the object frame [m]."""


@dataclass(frozen=True)
class CylinderShape:
    """A true cylinder, round to the last digit."""

    radius: float
    """Radius [m]."""
    length: float
    """Length [m]."""
    T_object_shape: Float[np.ndarray, "4 4"]
    """The cylinder's frame, origin in its middle and z along its axis -> object frame."""


CollisionShape = HullShape | CylinderShape
"""What a physics engine builds objects from, in terms that every engine knows."""


OBJECTS: Registry[type["ObjectModel"]] = Registry("object", "foretrace.objects", ShapeError)
"""Every family of objects by its kind."""


class ObjectModel(ABC):
    """A rigid object at rest on the table, of uniform density unless it is `Weighted`.

    The object frame is the one its corners are given in; z points up and z = 0 is the table side.
    Objects are frozen and their arrays read-only. A subclass registers itself by its kind.
    """

    kind: ClassVar[str]
    """Name of the family in records."""
    corners: Float[np.ndarray, "n 2"]
    """Outline seen from above, counter-clockwise, object frame [m]. Edge k runs from corner k to k + 1."""
    height: float
    """Largest height above the table [m]."""

    @abstractmethod
    def convex_pieces(self) -> list[Float[np.ndarray, "_ 3"]]:
        """Vertices of the convex parts that make up the object for collisions, in the object frame [m]."""

    def collision_shapes(self) -> list[CollisionShape]:
        """The object's parts as a physics engine should collide them: hulls, or true cylinders."""
        return [HullShape(vertices) for vertices in self.convex_pieces()]

    @property
    def shape(self) -> "ObjectModel":
        """The object of the same shape and of uniform density: what pictures show."""
        return self

    @property
    def is_round(self) -> bool:
        """Whether the object can roll, so that friction against rolling counts."""
        return any(isinstance(shape, CylinderShape) for shape in self.collision_shapes())

    @property
    @abstractmethod
    def support_corners(self) -> Float[np.ndarray, "n 2"]:
        """Where the object stands on the table near each of its corners, in the object frame [m]."""

    @abstractmethod
    def mass_properties(self, density: float) -> MassProperties:
        """Mass, centre of mass and inertia for a uniform density [kg/m^3]."""

    @abstractmethod
    def height_at(self, points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
        """Height of the upper surface [m] above points given in the object frame [m]; 0 beside the object."""

    def to_dict(self) -> dict[str, Any]:
        """``kind`` and the constructor's arguments, which the object keeps under their names, as plain JSON values."""
        return {"kind": self.kind} | {
            name: _plain(getattr(self, name)) for name in signature(type(self)).parameters
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "ObjectModel":
        """The object that ``to_dict`` described."""
        arguments = {name: values[name] for name in signature(cls).parameters}
        if "bevel" in arguments:
            arguments["bevel"] = Bevel(*arguments["bevel"])
        return cls(**arguments)

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if "kind" in cls.__dict__:
            OBJECTS.add(cls.kind, cls)

    @cached_property
    def size(self) -> float:
        """Largest distance between two corners [m]."""
        return largest_distance(self.corners)

    @cached_property
    def _polygon(self) -> shapely.Polygon:
        polygon = shapely.Polygon(self.corners)
        shapely.prepare(polygon)
        return polygon


def object_from_dict(values: Mapping[str, Any]) -> ObjectModel:
    """The object that ``ObjectModel.to_dict`` described.

    Raises:
        ShapeError: If the kind is unknown, a value is missing or the geometry is not usable.
    """
    check_type("description of an object", values, Mapping, ShapeError, "a dictionary, as of to_dict")
    family = OBJECTS.find(values.get("kind"))
    try:
        return family.from_dict(values)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        if isinstance(error, ForetraceError):
            raise
        reason = f"is not usable ({shown(error)}): write it with to_dict"
        raise ShapeError(f"description of a {family.kind} {reason}") from error


def object_from_json(text: str) -> ObjectModel:
    """The object of ``object_from_dict`` whose description is a JSON text.

    Raises:
        ShapeError: If it is none, or describes no usable object.
    """
    try:
        values = parse_json(text)
    except ValueError as reason:
        raise ShapeError(f"description of an object is no JSON ({reason}): write it with to_dict") from None
    return object_from_dict(values)


def _plain(value: Any) -> Any:
    """A constructor's argument as JSON has it."""
    if isinstance(value, Bevel):
        return [value.width, value.height]
    return value.tolist() if isinstance(value, np.ndarray) else value


def largest_distance(points: Float[np.ndarray, "n 2"]) -> float:
    """Largest distance between any two points [m]."""
    hull = convex_hull(points)
    return float(np.linalg.norm(hull[:, None] - hull[None], axis=-1).max())


def check_size(size: float, height: float, remedy: str = "check unit (metres) or scale") -> None:
    """Refuse objects that are too small or too large to be meant.

    Raises:
        ShapeError: if the size or the height [m] lies outside its limits.
    """
    for name, value, (low, high) in (("size", size, SIZE_LIMITS), ("height", height, HEIGHT_LIMITS)):
        if not low <= value <= high:
            raise ShapeError(f"object of {name} {value:.4g} m: expected {low} to {high} m; {remedy}")


def inner_radius(corners: Float[np.ndarray, "n 2"]) -> float:
    """Radius of the widest circle inside a polygon [m]."""
    return float(shapely.length(shapely.maximum_inscribed_circle(shapely.Polygon(corners))))


def fitting_bevel(corners: Float[np.ndarray, "n 2"], height: float) -> Bevel:
    """The default bevel, scaled down to what a slender or flat object bears.

    Its width is at most half the radius of the widest circle inside the outline, its height at most half
    the object's.
    """
    scale = min(1.0, 0.5 * inner_radius(corners) / BEVEL.width, 0.5 * height / BEVEL.height)
    return Bevel(BEVEL.width * scale, BEVEL.height * scale)


def read_only(values: Any, dtype: type = float) -> np.ndarray:
    """A read-only copy of an array."""
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def convex_mass_properties(pieces: list[Float[np.ndarray, "_ 3"]], density: float) -> MassProperties:
    """Exact mass properties of convex pieces that do not overlap [kg, m].

    Each piece is cut into tetrahedra between an inner point and the triangles of its hull.
    """
    from scipy.spatial import ConvexHull

    tetrahedra = []
    for piece in pieces:
        apex = piece.mean(axis=0)
        faces = piece[ConvexHull(piece).simplices]  # (face, corner, xyz)
        tetrahedra.append(np.concatenate([faces, np.broadcast_to(apex, (len(faces), 1, 3))], axis=1))
    corners = np.concatenate(tetrahedra)
    masses = density * np.abs(np.linalg.det(corners[:, :3] - corners[:, 3:])) / 6
    mass = masses.sum()
    com = masses @ corners.mean(axis=1) / mass
    local = corners - com
    total = local.sum(axis=1)
    # Second moments of a tetrahedron: (sum of v v^T over its corners + (sum of v)(sum of v)^T) / 20.
    moments = np.einsum("t,tci,tcj->ij", masses, local, local) + np.einsum(
        "t,ti,tj->ij", masses, total, total
    )
    moments /= 20
    return MassProperties(float(mass), com, np.trace(moments) * np.eye(3) - moments)
