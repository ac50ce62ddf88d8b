"""Flat objects that stand on feet: how their weight is spread over the table."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.errors import ShapeError, check_type, shown
from foretrace.objects.model import (
    CollisionShape,
    HullShape,
    MassProperties,
    ObjectModel,
    object_from_dict,
    read_only,
)

FOOTINGS = ("corners", "rim", "uniform")
"""``corners``: feet at the outline's corners; ``rim``: evenly along the outline; ``uniform``: over the whole face."""
RIM_FEET = 12
"""Feet along an outline."""
UNIFORM_FEET = 16
"""About as many feet stand under a whole face."""
MOST_CORNERS = 12
"""Outlines with more corners are round: their feet at the corners are those along the rim."""
INSET = 0.0015
"""Distance of the outermost feet from the outline [m]."""
FOOT_HEIGHT = 0.0005
"""How far the face lies above the table [m]."""
FOOT_WIDTH = 0.001
"""Half width of a foot where it meets the face [m]."""

CONVEX_TOLERANCE = 1e-6
"""Pieces whose hull has no more than their volume, to this share, are one convex body."""


@dataclass(frozen=True, eq=False, init=False)
class Footed(ObjectModel):
    """An object that touches the table with small feet instead of its whole lower face.

    No real face is flat: how an object that slides on it turns depends on where it carries its weight (its pressure
    distribution). Shape, mass and height are those of the object without feet.

    Raises:
        ShapeError: The object stands on feet already, or there is no such footing.
    """

    kind = "footed"
    object: ObjectModel
    """The object without feet."""
    footing: str
    """One of `FOOTINGS`."""
    feet: Float[np.ndarray, "feet 2"]
    """Where it touches the table, in the object frame [m]."""

    def __init__(self, object: ObjectModel, footing: str = "uniform") -> None:
        check_type("object", object, ObjectModel, ShapeError)
        if isinstance(object, Footed):
            raise ShapeError(f"object of type Footed: give {type(object.object).__name__} and one footing")
        if not all(isinstance(shape, HullShape) for shape in object.collision_shapes()):
            raise ShapeError(
                f"a lying {object.kind} has no face to put feet under: give a prism, a box or a mesh"
            )
        if footing not in FOOTINGS:
            raise ShapeError(f"footing {shown(footing)}: choose one of {', '.join(FOOTINGS)}")
        vars(self).update(
            object=object,
            footing=footing,
            corners=object.corners,
            height=object.height,
            feet=read_only(feet_of(object.support_corners, footing)),
        )

    @property
    def shape(self) -> ObjectModel:
        """The object without feet."""
        return self.object.shape

    @property
    def support_corners(self) -> Float[np.ndarray, "n 2"]:
        """Where the object stands on the table near each of its corners, in the object frame [m]."""
        return self.object.support_corners

    def convex_pieces(self) -> list[Float[np.ndarray, "_ 3"]]:
        """Vertices of the convex parts, as of the object without feet [m]."""
        return self.object.convex_pieces()

    def collision_shapes(self) -> list[CollisionShape]:
        """The object's parts, cut off at the feet's height, and a pyramid on its tip for each foot."""
        hulls = [np.array(s.vertices) for s in self.object.collision_shapes() if isinstance(s, HullShape)]
        together = convex_union(hulls)
        if together is not None:  # without seams between the parts, and faster
            hulls = [together]
        for vertices in hulls:
            vertices[:, 2] = np.maximum(vertices[:, 2], FOOT_HEIGHT)
        parts: list[CollisionShape] = [HullShape(vertices) for vertices in hulls]
        square = FOOT_WIDTH * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        for foot in self.feet:
            top = np.column_stack([foot + square, np.full(4, 2 * FOOT_HEIGHT)])
            parts.append(HullShape(np.vstack([[*foot, 0.0], top])))
        return parts

    def height_at(self, points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
        """Height of the upper surface [m], as of the object without feet."""
        return self.object.height_at(points)

    def mass_properties(self, density: float) -> MassProperties:
        """Mass, centre of mass and inertia, as of the object without feet."""
        return self.object.mass_properties(density)

    def to_dict(self) -> dict[str, Any]:
        """The object without feet and the footing as plain JSON values."""
        return {"kind": self.kind, "object": self.object.to_dict(), "footing": self.footing}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Footed":
        """The object that ``to_dict`` described."""
        return cls(object_from_dict(values["object"]), values["footing"])


def convex_union(pieces: list[Float[np.ndarray, "_ 3"]]) -> Float[np.ndarray, "_ 3"] | None:
    """The corners of the pieces' union if that is convex; None otherwise."""
    from scipy.spatial import ConvexHull

    points = np.unique(np.concatenate(pieces), axis=0)
    whole = ConvexHull(points)
    volume = sum(ConvexHull(piece).volume for piece in pieces)
    return points[whole.vertices] if whole.volume <= volume * (1 + CONVEX_TOLERANCE) else None


def feet_of(face: Float[np.ndarray, "n 2"], footing: str) -> Float[np.ndarray, "feet 2"]:
    """Where an object with a given lower face touches the table, in its own frame [m]."""
    inner = shapely.Polygon(face).buffer(-INSET, join_style="mitre")
    if not isinstance(inner, shapely.Polygon) or inner.is_empty:
        raise ShapeError("the lower face is too slender for feet: give an object that is wider than 3 mm")
    ring = inner.exterior
    if footing == "corners" and len(face) <= MOST_CORNERS:
        return shapely.get_coordinates(ring)[:-1]
    if footing in ("corners", "rim"):
        at = (np.arange(RIM_FEET) + 0.5) / RIM_FEET
        return shapely.get_coordinates(shapely.line_interpolate_point(ring, at, normalized=True))
    return _grid(inner)


def _grid(inner: shapely.Polygon) -> Float[np.ndarray, "feet 2"]:
    """Middles of the parts of a face that a square grid cuts out of it, which are about equally large."""
    pitch = np.sqrt(inner.area / UNIFORM_FEET)
    x0, y0, x1, y1 = inner.bounds
    columns, rows = (max(1, round((high - low) / pitch)) for low, high in ((x0, x1), (y0, y1)))
    xs, ys = (np.linspace(low, high, count + 1) for low, high, count in ((x0, x1, columns), (y0, y1, rows)))
    cells = [
        shapely.intersection(inner, shapely.box(xs[i], ys[j], xs[i + 1], ys[j + 1]))
        for i in range(columns)
        for j in range(rows)
    ]
    kept = [cell for cell in cells if cell.area > 0.3 * pitch**2]
    return shapely.get_coordinates(shapely.centroid(np.array(kept)))
