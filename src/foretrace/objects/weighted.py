"""Objects whose mass is not spread evenly: a hard disk, a loaded tray."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from foretrace.errors import ShapeError, check_type, shown
from foretrace.geometry import Numbers, finite_array
from foretrace.objects.model import CollisionShape, MassProperties, ObjectModel, object_from_dict, read_only

LARGEST_OFFSET = 0.2
"""Largest offset of a centre of mass [m]."""
CORE = 1 / 3
"""Size of the heavy core, as a share of the object's."""


@dataclass(frozen=True, eq=False, init=False)
class Weighted(ObjectModel):
    """An object whose centre of mass is not where it would be at uniform density.

    Its mass is that of the uniform object. Half of it is spread evenly, half of it in a core of the same shape and a
    third of the size, on the far side of the new centre of mass.

    Raises:
        ShapeError: The object is weighted already, or the offset is not two numbers of at most 0.2 m.
    """

    kind = "weighted"
    object: ObjectModel
    """The object as it would be at uniform density."""
    com_offset: Float[np.ndarray, "2"]
    """Offset of the centre of mass in the object frame [m]."""

    def __init__(self, object: ObjectModel, com_offset: Numbers) -> None:
        check_type("object", object, ObjectModel, ShapeError)
        if isinstance(object, Weighted):
            raise ShapeError(f"object of type Weighted: give {type(object.object).__name__} and one offset")
        offset = finite_array("com_offset (x, y) [m]", com_offset, (2,), ShapeError)
        if np.linalg.norm(offset) > LARGEST_OFFSET:
            raise ShapeError(
                f"com_offset of {shown(offset.tolist())} m: give two numbers of metres, at most {LARGEST_OFFSET} m away"
            )
        vars(self).update(
            object=object,
            com_offset=read_only(offset),
            corners=object.corners,
            height=object.height,
        )

    @property
    def shape(self) -> ObjectModel:
        """The uniform object of the same shape."""
        return self.object

    @property
    def support_corners(self) -> Float[np.ndarray, "n 2"]:
        """Where the object stands on the table near each of its corners, in the object frame [m]."""
        return self.object.support_corners

    def convex_pieces(self) -> list[Float[np.ndarray, "_ 3"]]:
        """Vertices of the convex parts, as of the uniform object [m]."""
        return self.object.convex_pieces()

    def collision_shapes(self) -> list[CollisionShape]:
        """Collision shapes of the uniform object."""
        return self.object.collision_shapes()

    def height_at(self, points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
        """Height of the upper surface [m], as of the uniform object."""
        return self.object.height_at(points)

    def mass_properties(self, density: float) -> MassProperties:
        """Mass, centre of mass and inertia, for a mean density [kg/m^3]."""
        even = self.object.mass_properties(density)
        offset = np.append(self.com_offset, 0.0)
        # Shell and core are equally heavy and lie at opposite offsets from the common centre of mass.
        apart = even.mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        inertia = (1 + CORE**2) / 2 * even.inertia + apart
        return MassProperties(even.mass, even.com + offset, inertia)

    def to_dict(self) -> dict[str, Any]:
        """The uniform object and the offset as plain JSON values."""
        return {
            "kind": self.kind,
            "object": self.object.to_dict(),
            "com_offset": self.com_offset.tolist(),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Weighted":
        """The object that ``to_dict`` described."""
        return cls(object_from_dict(values["object"]), values["com_offset"])
