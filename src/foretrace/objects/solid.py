"""Boxes and lying cylinders: objects that look alike from above and move differently (paper, section 5.5)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.errors import ShapeError, shown
from foretrace.objects.model import (
    Bevel,
    CollisionShape,
    CylinderShape,
    MassProperties,
    ObjectModel,
    check_size,
    fitting_bevel,
    read_only,
)
from foretrace.objects.prism import DEFAULT_HEIGHT, Prism

FACETS = 64
"""Sides of the polygon that stands for a cylinder's circle where a true cylinder cannot be used."""
RADII = (0.012, 0.04)
"""Smallest and largest radius of a sampled cylinder [m]."""
LENGTHS = (0.06, 0.20)
"""Smallest and largest length of a sampled cylinder, or long side of a sampled box [m]."""
SLENDERNESS = 1.25
"""Least length of a sampled solid over its width: its long side can be told from its end."""
HEIGHT_RATIOS = (0.5, 1.25)
"""Height of a sampled box over its depth: from lying flat to standing upright without falling over by itself."""


@dataclass(frozen=True, eq=False, init=False)
class Box(Prism):
    """A rectangular block around the origin: ``width`` along x, ``depth`` along y, ``height`` along z.

    Raises:
        ShapeError: if a side is not a believable length, or the bevel leaves no bottom face.
    """

    kind = "box"
    width: float
    """Side along x [m]."""
    depth: float
    """Side along y [m]."""

    def __init__(self, width: float, depth: float, height: float, bevel: Bevel | None = None) -> None:
        """A block; without a bevel given, its lower rim gets one that fits, and ``NO_BEVEL`` leaves it sharp."""
        check_lengths("box", width=width, depth=depth, height=height)
        check_size(float(np.hypot(width, depth)), height)
        corners = rectangle(width, depth)
        object.__setattr__(self, "width", float(width))
        object.__setattr__(self, "depth", float(depth))
        super().__init__(corners, height, fitting_bevel(corners, height) if bevel is None else bevel)

    def _parts(self) -> list[tuple[np.ndarray, range | list[int]]]:
        """One convex part: a block needs no wedges."""
        return [(self.corners, range(len(self.corners)))]


@dataclass(frozen=True, eq=False, init=False)
class Cylinder(ObjectModel):
    """A cylinder that lies on its side: its axis runs along x, above the origin. Its rims are sharp.

    Seen from above it is a rectangle, ``length`` by twice the radius; only the height tells it from a box.

    Raises:
        ShapeError: if radius or length is not believable.
    """

    kind = "cylinder"
    radius: float
    """Radius [m]."""
    length: float
    """Length along the axis [m]."""
    corners: Float[np.ndarray, "4 2"]
    """The rectangle that it covers seen from above, counter-clockwise [m]."""
    height: float
    """Twice the radius [m]."""

    def __init__(self, radius: float, length: float) -> None:
        check_lengths("cylinder", radius=radius, length=length)
        object.__setattr__(self, "radius", float(radius))
        object.__setattr__(self, "length", float(length))
        object.__setattr__(self, "height", 2 * self.radius)
        object.__setattr__(self, "corners", read_only(rectangle(self.length, 2 * self.radius)))
        check_size(self.size, self.height)

    def convex_pieces(self) -> list[Float[np.ndarray, "_ 3"]]:
        """The vertices of a 64-sided bar within the cylinder [m]: for pictures, and engines without cylinders."""
        return [self._bar]

    def collision_shapes(self) -> list[CollisionShape]:
        """A true cylinder, so that it rolls smoothly."""
        along_x = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, self.radius], [0, 0, 0, 1]])
        return [CylinderShape(self.radius, self.length, read_only(along_x))]

    @property
    def support_corners(self) -> Float[np.ndarray, "4 2"]:
        """For each corner the end of the line on which the cylinder lies, in the object frame [m]."""
        return read_only(self.corners * [1.0, 0.0])

    def mass_properties(self, density: float) -> MassProperties:
        """Exact mass, centre of mass and inertia for a uniform density [kg/m^3]."""
        mass = density * np.pi * self.radius**2 * self.length
        across = self.radius**2 / 4 + self.length**2 / 12
        inertia = mass * np.diag([self.radius**2 / 2, across, across])
        return MassProperties(float(mass), np.array([0.0, 0.0, self.radius]), inertia)

    def height_at(self, points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
        """Height of the curved surface [m] above points given in the object frame [m]; 0 beside the object."""
        # The same test as a prism's: where outlines are equal, so are masks, to the pixel.
        inside = shapely.intersects_xy(self._polygon, points[:, 0], points[:, 1])
        bulge = np.sqrt(np.maximum(self.radius**2 - points[:, 1] ** 2, 0.0))
        return np.where(inside, self.radius + bulge, 0.0)

    @cached_property
    def _bar(self) -> np.ndarray:
        angles = 2 * np.pi * np.arange(FACETS) / FACETS
        rim = self.radius * np.column_stack([np.sin(angles), 1 - np.cos(angles)])  # (facets, y and z)
        ends = [np.column_stack([np.full(FACETS, x), rim]) for x in (-self.length / 2, self.length / 2)]
        return read_only(np.concatenate(ends))


def rectangle(width: float, depth: float) -> Float[np.ndarray, "4 2"]:
    """Corners of a rectangle around the origin, counter-clockwise from the lower left [m]."""
    return 0.5 * np.array([[-width, -depth], [width, -depth], [width, depth], [-width, depth]])


def check_lengths(kind: str, **lengths: float) -> None:
    """Refuse lengths that are no numbers above zero.

    Raises:
        ShapeError: naming the length.
    """
    for name, value in lengths.items():
        if not (isinstance(value, int | float | np.number) and np.isfinite(value) and value > 0):
            raise ShapeError(f"{kind} of {name} {shown(value)}: give a positive length in metres")


def sample_cylinder(rng: np.random.Generator) -> Cylinder:
    """A lying cylinder of random size."""
    radius = rng.uniform(*RADII)
    return Cylinder(radius, rng.uniform(max(LENGTHS[0], SLENDERNESS * 2 * radius), LENGTHS[1]))


def sample_box(rng: np.random.Generator) -> Box:
    """A box of random size with a bevelled lower rim; its long side lies along x."""
    depth = 2 * rng.uniform(*RADII)
    width = rng.uniform(max(LENGTHS[0], SLENDERNESS * depth), LENGTHS[1])
    return Box(width, depth, depth * rng.uniform(*HEIGHT_RATIOS))


def look_alikes(cylinder: Cylinder) -> tuple[Cylinder, Box, Prism]:
    """Three objects with one outline: a cylinder, the box that it just fits into, and a flat prism.

    Their top-down masks are equal in every pixel; their height maps are not.
    """
    box = Box(cylinder.length, cylinder.height, cylinder.height)
    flat = min(DEFAULT_HEIGHT, 0.5 * cylinder.height)
    return cylinder, box, Prism(cylinder.corners, flat, fitting_bevel(box.corners, flat))


def sample_look_alikes(rng: np.random.Generator) -> tuple[Cylinder, Box, Prism]:
    """`look_alikes` of a random size."""
    return look_alikes(sample_cylinder(rng))
