"""Prisms: an outline drawn on the table and extruded, with a bevelled lower rim."""

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Float, Shaped

from foretrace.errors import ShapeError, check_type, is_number, is_whole, shown
from foretrace.geometry import (
    Numbers,
    clip_polygon,
    convex_hull,
    finite_array,
    inward_normals,
    is_convex,
    polygon_area,
)
from foretrace.objects.model import (
    BEVEL,
    SIZE_LIMITS,
    Bevel,
    MassProperties,
    ObjectModel,
    check_size,
    convex_mass_properties,
    fitting_bevel,
    inner_radius,
    largest_distance,
    read_only,
)
from foretrace.objects.silhouette import likelier_scale, silhouette_polygon

DEFAULT_HEIGHT = 0.02
"""Height of a prism [m]."""
CIRCLE_RADIUS = 0.10
"""Radius of the circle on which sampled corners lie [m] (paper, section 4)."""
CORNER_COUNTS = (3, 4, 5, 6, 7, 8, 9, 10)
"""Corner counts of the paper's objects (section 4)."""
LARGEST_GAP = np.deg2rad(165.0)
"""Largest angle between neighbouring sampled corners [rad]: keeps the centre 13 mm inside."""
SMALLEST_GAP = np.deg2rad(12.0)
"""Smallest angle between neighbouring sampled corners [rad]: no edge under 2.1 cm."""
SAME_CORNER = 1e-6
"""Corners nearer than this are the same corner [m]."""
MOST_CORNERS = 2000
"""More take minutes to build."""
LARGEST_COORDINATE = 1e9
"""Corners beyond are no object of any unit [m]: their distances would overflow."""
SMALLEST_PIECE = 1e-7
"""Convex parts below this area are left out [m^2]: collision meshes need a volume."""


@dataclass(frozen=True, eq=False, init=False)
class Prism(ObjectModel):
    """A polygon extruded upwards, standing on a bottom face that a bevel makes smaller than the outline.

    Corners may be given clockwise: they are reordered counter-clockwise, keeping the first corner first. A corner that
    repeats the one before it, or closes the polygon, is left out.

    Raises:
        ShapeError: for fewer than three corners, values that are not finite, corners that meet again, no area,
            self-intersection, a size or height beyond belief, or a bevel that leaves no bottom face.
    """

    kind = "prism"
    corners: Float[np.ndarray, "n 2"]
    """Corners of the simple polygon, convex or not, in the object frame [m]."""
    height: float = DEFAULT_HEIGHT
    """Height of the extrusion [m]."""
    bevel: Bevel = BEVEL
    """Chamfer of the lower rim."""

    def __init__(self, corners: Numbers, height: float = DEFAULT_HEIGHT, bevel: Bevel = BEVEL) -> None:
        object.__setattr__(self, "corners", check_polygon(corners))
        if not is_number(height):
            raise ShapeError(f"height is {shown(height)}: give a number of metres")
        check_type("bevel", bevel, Bevel, ShapeError)
        object.__setattr__(self, "height", float(height))
        object.__setattr__(self, "bevel", bevel)
        check_size(self.size, self.height)
        if self.bevel.height >= self.height:
            raise ShapeError(
                f"bevel of height {self.bevel.height} m on an object of height {self.height} m: "
                "pass a lower bevel=Bevel(width, height) or NO_BEVEL"
            )
        if shapely.is_empty(self._bottom):
            raise ShapeError(
                f"bevel of width {self.bevel.width} m leaves no bottom face (widest inner circle has radius "
                f"{inner_radius(self.corners):.4g} m): pass a narrower bevel=Bevel(width, height) or NO_BEVEL"
            )

    @classmethod
    def from_mask(
        cls,
        mask: Shaped[np.ndarray, "rows columns"],
        metres_per_pixel: float,
        height: float = DEFAULT_HEIGHT,
        bevel: Bevel | None = None,
        tolerance: float | None = None,
        blunted: float = 0.0,
    ) -> "Prism":
        """The prism whose outline is a silhouette.

        Args:
            mask: the object white (or True) on black. Holes are filled; specks below 1 % of the object's
                area are ignored.
            metres_per_pixel: scale of the image [m].
            height: height of the prism [m].
            bevel: chamfer of the lower rim; by default the usual one, smaller for slender or flat objects.
            tolerance: how far the polygon may leave the outline [m]; 1 mm by default, never below 0.75 pixel.
            blunted: how much of a right-angled corner blur may have taken [m]; at least 3 pixels.

        Returns:
            The prism, origin at the silhouette's centroid, x to the right in the image and y up.

        Raises:
            ShapeError: for a mask that is empty, shows several objects or an object cut off by the border.
        """
        if not is_number(height):
            raise ShapeError(f"height is {shown(height)}: give a number of metres")
        check_size(SIZE_LIMITS[0], height)
        corners = silhouette_polygon(mask, metres_per_pixel, tolerance, blunted)
        size = largest_distance(corners)
        likelier = likelier_scale(size, metres_per_pixel)
        check_size(size, height, "check unit (metres) or scale" + (f": {likelier}" if likelier else ""))
        if likelier is not None:
            warnings.warn(
                f"the object is {100 * size:.3g} cm long, check --scale (metres_per_pixel): {likelier}",
                stacklevel=2,
            )
        return cls(corners, height, bevel or fitting_bevel(corners, height))

    def convex_pieces(self) -> list[Float[np.ndarray, "_ 3"]]:
        """Vertices of the convex parts, in the object frame [m].

        A convex polygon of at most ten corners around the origin is built as the paper's wedges between
        centre and edges (figure 7), any other convex polygon in one piece, and a polygon that is not convex
        from its constrained Delaunay triangles, merged where the union stays convex.
        """
        return self._pieces

    def mass_properties(self, density: float) -> MassProperties:
        """Exact mass, centre of mass and inertia of the bevelled body for a uniform density [kg/m^3]."""
        return self._unit_mass_properties.scaled(density)

    def height_at(self, points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
        """Height of the upper surface [m] above points given in the object frame [m]; 0 beside the object."""
        return np.where(shapely.intersects_xy(self._polygon, points[:, 0], points[:, 1]), self.height, 0.0)

    @cached_property
    def _unit_mass_properties(self) -> MassProperties:
        return convex_mass_properties(self._pieces, density=1.0)

    @cached_property
    def _bottom(self) -> shapely.Geometry:
        """The bottom face: the outline shrunk by the bevel, in one or several parts."""
        if is_convex(self.corners):
            inset = clip_edges(self.corners, self.corners, range(len(self.corners)), self.bevel.width)
            return shapely.Polygon(inset)
        return self._polygon.buffer(-self.bevel.width, join_style="mitre")

    @cached_property
    def _pieces(self) -> list[np.ndarray]:
        pieces = []
        for part, own_edges in self._parts():
            layers = [(part, self.bevel.height), (part, self.height)]
            if self.bevel.height > 0 and len(lower := self._lower(part, own_edges)) >= 3:
                layers.insert(0, (lower, 0.0))
            piece = np.concatenate([np.column_stack([xy, np.full(len(xy), z)]) for xy, z in layers])
            pieces.append(read_only(np.unique(piece, axis=0)))
        return pieces

    def _lower(self, part: np.ndarray, own_edges: range | list[int]) -> np.ndarray:
        """What the bevel leaves of a convex part at the table."""
        lower = clip_edges(part, self.corners, own_edges, self.bevel.width)
        if len(lower) == 0 or is_convex(self.corners):
            return lower
        polygon = shapely.Polygon(lower)
        # Rounding may make a sliver cross itself.
        polygon = polygon if polygon.is_valid else polygon.convex_hull
        return convex_hull(shapely.get_coordinates(polygon.intersection(self._bottom)))

    def _parts(self) -> list[tuple[np.ndarray, range | list[int]]]:
        """Convex parts of the outline, each with the edges of the outline that bevel it."""
        num_corners = len(self.corners)
        if is_convex(self.corners):
            every_edge = range(num_corners)
            centre = np.zeros(2)
            clear = shapely.contains_xy(self._bottom, 0.0, 0.0)
            if not clear or num_corners > CORNER_COUNTS[-1]:
                return [(self.corners, every_edge)]
            following = np.roll(self.corners, -1, axis=0)
            return [
                (np.array([centre, a, b]), every_edge) for a, b in zip(self.corners, following, strict=True)
            ]
        parts = []
        for indices in convex_parts(self.corners):
            part = self.corners[indices]
            if polygon_area(part) > SMALLEST_PIECE:
                following = [*indices[1:], indices[0]]
                own = [i for i, j in zip(indices, following, strict=True) if j == (i + 1) % num_corners]
                parts.append((part, own))
        return parts

    @cached_property
    def support_corners(self) -> Float[np.ndarray, "n 2"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Where the bottom face has its corners, one for each corner of the outline, in the object frame [m].

        A corner whose inset lies beyond the bottom face, as at a thin tip, gets the face's nearest point.
        """
        normals = inward_normals(self.corners)
        before = np.roll(normals, 1, axis=0)
        # The mitre point m solves normal . m = normal . corner + width for both edges of the corner.
        bisector = normals + before
        opening = np.maximum(1 + (normals * before).sum(axis=1), 1e-9)  # vanishes at an infinitely sharp tip
        mitred = self.corners + bisector * (self.bevel.width / opening)[:, None]
        inset = shapely.points(mitred)
        near = shapely.distance(inset, self._bottom) < SAME_CORNER
        nearest = shapely.get_coordinates(shapely.shortest_line(self._bottom, shapely.points(self.corners)))[
            ::2
        ]
        return read_only(np.where(near[:, None], mitred, nearest))


def check_polygon(corners: Numbers) -> Float[np.ndarray, "n 2"]:
    """A simple polygon's corners, counter-clockwise and read-only [m].

    Raises:
        ShapeError: naming the fault, if the corners do not bound a simple polygon.
    """
    corners = finite_array("a table of corners [m]", corners, (None, 2), ShapeError)
    if len(corners) < 3:
        raise ShapeError(f"polygon with {len(corners)} corners: at least 3 are needed")
    if len(corners) > MOST_CORNERS:
        raise ShapeError(
            f"polygon with {len(corners)} corners: give at most {MOST_CORNERS}, say every tenth of them"
        )
    if (far := float(np.abs(corners).max())) > LARGEST_COORDINATE:
        raise ShapeError(f"a corner lies {far:.3g} m from the origin: check unit (metres) or scale")
    apart = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1) > SAME_CORNER
    if apart.sum() >= 3:  # a polygon that is closed, or a corner given twice in a row
        corners = corners[apart]
    if (pair := _find_same(corners)) is not None:
        first, second = pair
        raise ShapeError(
            f"corners {first} and {second} are both {corners[first].tolist()}: give each corner once, in order"
        )
    size = largest_distance(corners)
    centred = corners - corners.mean(axis=0)
    if np.linalg.svd(centred, compute_uv=False)[1] < 1e-6 * size:
        raise ShapeError(f"polygon with {len(corners)} corners on one line has no area: check the corners")
    polygon = shapely.Polygon(corners)
    if not polygon.is_valid:
        raise ShapeError(
            f"polygon is not simple ({shapely.is_valid_reason(polygon)}): give the corners in order"
        )
    if polygon_area(corners) < 0:
        corners = np.roll(corners[::-1], 1, axis=0)
    return read_only(corners)


def _find_same(corners: Float[np.ndarray, "n 2"]) -> tuple[int, int] | None:
    """Numbers of two corners that are the same."""
    _, first, inverse = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    if len(first) < len(corners):  # exactly, perhaps all of them
        earlier = first[inverse.reshape(-1)]
        second = int(np.flatnonzero(earlier != np.arange(len(corners)))[0])
        return int(earlier[second]), second
    points = np.asarray(shapely.points(corners))
    same = shapely.STRtree(points).query(points, predicate="dwithin", distance=SAME_CORNER).T
    same = same[same[:, 0] < same[:, 1]]
    return tuple(min(same.tolist())) if len(same) else None


def clip_edges(
    part: Float[np.ndarray, "k 2"], corners: Float[np.ndarray, "n 2"], edges: range | list[int], width: float
) -> Float[np.ndarray, "m 2"]:
    """What is left of a convex part at a distance of at least ``width`` [m] from the lines of some edges."""
    normals = inward_normals(corners)
    for k in edges:
        part = clip_polygon(part, normals[k], float(normals[k] @ corners[k]) + width)
    return part


def convex_parts(corners: Float[np.ndarray, "n 2"]) -> list[list[int]]:
    """Corner indices of convex parts that tile a simple polygon, each counter-clockwise.

    The exact constrained Delaunay triangles are merged across inner diagonals, longest first, wherever
    the union stays convex.
    """
    index_of = {(x, y): k for k, (x, y) in enumerate(corners.tolist())}
    triangles = shapely.constrained_delaunay_triangles(shapely.Polygon(corners)).geoms
    parts: list[list[int]] = []
    for triangle in triangles:
        indices = [index_of[x, y] for x, y in shapely.get_coordinates(triangle)[:3].tolist()]
        parts.append(indices if polygon_area(corners[indices]) > 0 else indices[::-1])
    owner = {edge: part for part in parts for edge in directed_edges(part)}
    diagonals = [edge for edge in owner if edge[0] < edge[1] and edge[::-1] in owner]
    diagonals.sort(key=lambda edge: (-np.linalg.norm(corners[edge[0]] - corners[edge[1]]), edge))
    for i, j in diagonals:
        left, right = owner[i, j], owner[j, i]
        if left is right:
            continue
        left_from_j = left[left.index(j) :] + left[: left.index(j)]
        right_from_i = right[right.index(i) :] + right[: right.index(i)]
        merged = left_from_j + right_from_i[1:-1]
        if is_convex(corners[merged]):
            parts = [part for part in parts if part is not left and part is not right] + [merged]
            owner.update({edge: merged for edge in directed_edges(merged)})
    return parts


def directed_edges(indices: list[int]) -> list[tuple[int, int]]:
    """The edges of a closed chain of corner indices."""
    return list(zip(indices, [*indices[1:], indices[0]], strict=True))


def sample_prism(rng: np.random.Generator, num_corners: int) -> Prism:
    """One of the paper's random objects (section 4): corners at random angles on a circle of 10 cm radius.

    The circle's centre lies strictly inside: draws with a gap over 165 or under 12 degrees are rejected.

    Raises:
        ShapeError: The corners are fewer than three, or too many to keep their smallest gap.
    """
    most = int(0.5 * 2 * np.pi / SMALLEST_GAP)
    check_type("rng", rng, np.random.Generator, ShapeError)
    if not is_whole(num_corners, 3, most):
        raise ShapeError(f"sampled polygon with {shown(num_corners)} corners: choose 3 to {most}")
    while True:
        angles = np.sort(rng.uniform(0.0, 2 * np.pi, num_corners))
        gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
        if gaps.min() >= SMALLEST_GAP and gaps.max() <= LARGEST_GAP:
            return Prism(CIRCLE_RADIUS * np.column_stack([np.cos(angles), np.sin(angles)]))


def paper_objects(seed: int = 0, per_corner_count: int = 20) -> list[Prism]:
    """The paper's object set (section 4): 20 random prisms for each corner count from 3 to 10.

    Each object has its own random stream, so object i can be made again without the others: it is
    ``sample_prism(np.random.default_rng([seed, i]), CORNER_COUNTS[i % len(CORNER_COUNTS)])``.

    Raises:
        ShapeError: The seed or the count is no whole number from 0 on.
    """
    for name, value in (("seed", seed), ("per_corner_count", per_corner_count)):
        if not is_whole(value, 0, 2**63 - 1):
            raise ShapeError(f"{name} is {shown(value)}: give a whole number from 0 on")
    counts = CORNER_COUNTS * per_corner_count
    return [sample_prism(np.random.default_rng([seed, i]), count) for i, count in enumerate(counts)]
