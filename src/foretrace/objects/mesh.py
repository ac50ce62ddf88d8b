"""Objects given as closed triangle meshes."""

import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Int

from foretrace.errors import ShapeError, is_number, shown
from foretrace.files import as_path
from foretrace.geometry import Numbers, convex_hull, finite_array, inward_normals, polygon_area
from foretrace.objects.decomposition import as_solid, cached_pieces, surface_of
from foretrace.objects.mesh_bodies import is_convex_body, one_solid
from foretrace.objects.mesh_files import check_precision, check_unit, read_mesh
from foretrace.objects.model import (
    Bevel,
    MassProperties,
    ObjectModel,
    check_size,
    fitting_bevel,
    inner_radius,
    read_only,
)
from foretrace.objects.silhouette import simplify_outline

OUTLINE_TOLERANCE = 0.0005
"""How far the outline's polygon may leave the mesh's projection [m]."""
FOOT_HEIGHT = 0.0005
"""Points of the mesh below this height are taken to stand on the table [m]."""
ON_PLANE = 1e-12
"""A vertex nearer to a cutting plane lies on it [m]."""
VOLUME_TOLERANCE = 0.005
"""Largest difference between what collides and the mesh, relative to the mesh's volume."""
TOUCHING = 1e-6
"""Parts of the outline nearer than twice this are one [m]."""
TOPPLING = ((np.deg2rad(3.0), 1e-4), (np.deg2rad(15.0), 0.015))
"""A mesh topples where each of these tilts lowers its centre of mass by this share. A ball's facets do not."""
MOST_POLYGONS = 20_000
"""The outline of a mesh of more faces is taken from its solid, which is quicker."""
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, eq=False, init=False)
class MeshObject(ObjectModel):
    """A closed triangle mesh of uniform density, standing as its file has it.

    The mesh is moved so that its lowest point lies on the table and the origin below its centre of mass.
    Bodies that overlap or touch are united. Mass, centre of mass, inertia and view come from the mesh itself;
    collisions from convex pieces of its volume, whose lower rim is chamfered along the hull of the outline so that a
    blade gets under it.

    Raises:
        ShapeError: if the mesh is not watertight, crosses itself, holds several bodies or has no believable size.
    """

    kind = "mesh"
    vertices: Float[np.ndarray, "v 3"]
    """Vertices in the object frame [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex indices of each triangle."""
    bevel: Bevel
    """Chamfer of the collision pieces' lower rim."""
    corners: Float[np.ndarray, "n 2"]
    """Outline of the mesh seen from above, simplified, counter-clockwise [m]."""
    height: float
    """Largest height above the table [m]."""

    def __init__(self, vertices: Numbers, faces: Numbers, bevel: Bevel | None = None) -> None:
        mesh = check_mesh(vertices, faces)
        low = mesh.bounds[0]
        if np.abs(low).max() > 10.0:  # the integrals behind the centre of mass would lose digits
            mesh.apply_translation(-low)
        shift = np.array([*mesh.center_mass[:2], mesh.bounds[0, 2]])
        # A mesh that lies right already is kept to the last digit: a stored object comes back as it was.
        in_place = mesh.vertices if np.abs(shift).max() < 1e-9 else mesh.vertices - shift
        object.__setattr__(self, "vertices", read_only(in_place))
        object.__setattr__(self, "faces", read_only(mesh.faces, np.int64))
        object.__setattr__(self, "height", float(self.vertices[:, 2].max()))
        object.__setattr__(self, "corners", read_only(project_outline(self.vertices, self.faces)))
        object.__setattr__(self, "bevel", bevel or fitting_bevel(self.corners, self.height))
        radius = inner_radius(self.corners)
        if self.bevel.height >= self.height or self.bevel.width >= radius:
            raise ShapeError(
                f"bevel of {self.bevel.width} m x {self.bevel.height} m on a mesh of height "
                f"{self.height:.4g} m and inner radius {radius:.4g} m: leave it out for one that fits"
            )

    @classmethod
    def load(
        cls, path: str | Path, scale: float = 1.0, bevel: Bevel | None = None, rest: bool = False
    ) -> "MeshObject":
        """A mesh from an STL, OBJ, PLY or OFF file.

        Warns if the mesh would topple as it stands.

        Args:
            path: the file; z must point up, unless ``rest`` is set.
            scale: metres per unit of the file, e.g. 0.001 for a file in millimetres.
            bevel: chamfer of the collision pieces' lower rim; by default one that fits.
            rest: whether to turn the mesh onto the side on which its centre of mass is lowest. Of several such sides
                it takes the one that needs the smallest turn.

        Raises:
            ShapeError: if the file cannot be read or the mesh is not usable.
        """
        if not (is_number(scale) and 0 < scale < np.inf):
            raise ShapeError(f"scale is {shown(scale)}: give the metres per unit of the mesh, e.g. 0.001")
        vertices, faces = read_mesh(as_path(path, ShapeError))
        try:
            check_precision(vertices)
            vertices, faces = one_solid(vertices, faces)
            check_unit(np.ptp(vertices, axis=0), scale)
            vertices = vertices * scale
            if rest:
                vertices = vertices @ resting_rotation(vertices, faces).T
            obj = cls(vertices, faces, bevel)
        except ShapeError as error:
            raise ShapeError(f"{path}: {error}") from error
        if not obj.stands:
            warnings.warn(
                f"{path}: the mesh topples as it stands: turn it, or give --rest (in Python rest=True)",
                stacklevel=2,
            )
        return obj

    def convex_pieces(self) -> list[Float[np.ndarray, "_ 3"]]:
        """Vertices of the convex parts, in the object frame [m].

        A convex mesh is one piece; any other is cut into pieces whose hulls have its volume, to half a percent.

        Raises:
            ShapeError: if no 256 pieces do.
        """
        return self._pieces

    @property
    def is_round(self) -> bool:
        """False: facets do not roll."""
        return False

    @cached_property
    def stands(self) -> bool:
        """Whether the mesh stays as it stands: no small tilt lets its centre of mass sink, and a larger one further."""
        from scipy.spatial import ConvexHull

        com = np.array([*self._mesh.center_mass])
        points = self.vertices[ConvexHull(self.vertices).vertices] - com
        heading = np.arange(0.0, 2 * np.pi, np.pi / 16)
        around = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))])
        sinks = np.ones(len(heading), dtype=bool)
        for tilt, share in TOPPLING:
            upwards = np.sin(tilt) * around + [0.0, 0.0, np.cos(tilt)]
            sinks &= -(points @ upwards.T).min(axis=0) < (1 - share) * com[2]
        return not sinks.any()

    def side_view(self, T_view_object: Float[np.ndarray, "4 4"]) -> list[Float[np.ndarray, "_ 2"]]:
        """Outlines of the mesh, bevelled, seen along the y axis of a view: closed rings of x and z [m]."""
        turned = as_solid(*self._bevelled).transform(T_view_object[[0, 2, 1], :] * [[1.0], [1.0], [-1.0]])
        rings = [np.asarray(ring) for ring in turned.project().to_polygons()]
        return [np.concatenate([ring, ring[:1]]) for ring in rings if polygon_area(ring) > 0]

    def mass_properties(self, density: float) -> MassProperties:
        """Mass, centre of mass and inertia of the mesh itself, without the bevel, for a density [kg/m^3]."""
        mesh = self._mesh
        mesh.density = density
        properties = mesh.mass_properties
        return MassProperties(
            float(properties.mass), np.array(properties.center_mass), np.array(properties.inertia)
        )

    def height_at(self, points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
        """Height of the upper surface [m] above points given in the object frame [m]; 0 beside the object."""
        triangles = self.vertices[self.faces]
        origin, second, third = np.moveaxis(triangles, 1, 0)
        normals = np.cross(second - origin, third - origin)
        facing_up = normals[:, 2] > 1e-12
        origin, normals = origin[facing_up], normals[facing_up]
        tree = shapely.STRtree(flat_polygons(triangles[facing_up]))
        index, face = tree.query(shapely.points(points), predicate="intersects")
        away = points[index] - origin[face, :2]
        heights = origin[face, 2] - (away * normals[face, :2]).sum(axis=1) / normals[face, 2]
        surface = np.zeros(len(points))
        np.maximum.at(surface, index, heights)
        return surface

    @cached_property
    def _mesh(self) -> Any:
        import trimesh

        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    @cached_property
    def _convex(self) -> bool:
        return is_convex_body(self._mesh)

    @cached_property
    def _chamfer(self) -> list[tuple[Float[np.ndarray, "3"], float]]:
        """Normal n and offset of the planes ``n . x >= offset`` below which the body recedes."""
        if self.bevel.height == 0:
            return []
        rim = convex_hull(np.array(self.corners))
        slope = self.bevel.width / self.bevel.height
        return [
            (np.array([*normal, slope]), float(normal @ corner) + self.bevel.width)
            for corner, normal in zip(rim, inward_normals(rim), strict=True)
        ]

    @cached_property
    def _bevelled(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces of the bevelled mesh. Its solid is not kept: it could not be sent to another process."""
        solid = as_solid(self.vertices, self.faces)
        for normal, offset in self._chamfer:
            length = float(np.linalg.norm(normal))
            solid = solid.trim_by_plane(tuple(normal / length), offset / length)
        return surface_of(solid)

    @cached_property
    def _pieces(self) -> list[np.ndarray]:
        from scipy.spatial import ConvexHull

        pieces = [np.array(self.vertices)] if self._convex else cached_pieces(self.vertices, self.faces)
        bevelled, volume = [], 0.0
        for vertices in pieces:
            piece = vertices
            for normal, offset in self._chamfer:
                piece = clip_polytope(piece, normal, offset)
            if len(piece) >= 4:
                hull = ConvexHull(piece)
                bevelled.append(read_only(piece[hull.vertices]))
                volume += hull.volume
        fault = (volume - as_solid(*self._bevelled).volume()) / float(self._mesh.volume)
        if not abs(fault) <= VOLUME_TOLERANCE:
            raise ShapeError(
                f"{len(pieces)} convex pieces of the mesh miss its volume by {100 * fault:+.2g} %: thin curved walls "
                "need too many; thicken them, or give a coarser mesh"
            )
        return bevelled

    @cached_property
    def support_corners(self) -> Float[np.ndarray, "n 2"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The footprint's point nearest to each corner of the outline, in the object frame [m]."""
        points = self._pieces[0] if self._convex else self._bevelled[0]
        lowest = points[:, 2].min()
        foot = shapely.MultiPoint(points[points[:, 2] < lowest + FOOT_HEIGHT, :2]).convex_hull
        return read_only(
            shapely.get_coordinates(shapely.shortest_line(foot, shapely.points(self.corners)))[::2]
        )


def check_mesh(vertices: Numbers, faces: Numbers) -> Any:
    """A ``trimesh.Trimesh`` of usable size, closed, with its faces' normals outwards.

    Raises:
        ShapeError: naming the fault, if the mesh bounds no body.
    """
    vertices = finite_array("a table of vertices [m]", vertices, (None, 3), ShapeError)
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ShapeError(f"faces have the shape {faces.shape}: give three numbers of vertices for each")
    if len(vertices) == 0 or len(faces) == 0:
        raise ShapeError(
            f"mesh with {len(vertices)} vertices and {len(faces)} faces is empty: give a closed surface"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ShapeError(
            f"mesh faces name vertices {faces.min()} to {faces.max()}: there are {len(vertices)}"
        )
    extents = np.ptp(vertices, axis=0)
    check_size(float(extents.max()), float(extents[2]))
    vertices, faces = one_solid(vertices, faces)
    import trimesh  # a second to import, and most objects are prisms

    return trimesh.Trimesh(vertices, faces, process=False)


def resting_rotation(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "3 3"]:
    """Smallest rotation that puts a solid onto a side on which its centre of mass is lowest: it rests there."""
    import trimesh
    from scipy.spatial import ConvexHull

    middle = vertices.mean(axis=0)  # far from the origin, the integrals lose digits
    com = middle + trimesh.Trimesh(vertices - middle, faces, process=False).center_mass
    sides = ConvexHull(vertices).equations
    heights = -(sides[:, :3] @ com + sides[:, 3])
    lowest = sides[heights < heights.min() * (1 + 1e-6), :3]
    down = lowest[np.argmin(lowest[:, 2])]
    axis, along = np.cross(down, DOWN), float(down @ DOWN)
    if np.linalg.norm(axis) < 1e-9:  # it lies there, or on the opposite side
        return np.eye(3) if along > 0 else np.diag([1.0, -1.0, -1.0])
    across = np.cross(axis, np.eye(3)).T
    return np.eye(3) + across + across @ across / (1 + along)


def project_outline(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "n 2"]:
    """Outline of a closed mesh seen from above, counter-clockwise, simplified and without holes [m].

    Raises:
        ShapeError: if it is in several parts.
    """
    if len(faces) > MOST_POLYGONS:
        rings = [np.asarray(ring) for ring in as_solid(vertices, faces).project().to_polygons()]
        flat = np.array([shapely.Polygon(ring) for ring in rings if polygon_area(ring) > 0], dtype=object)
    else:
        flat = flat_polygons(vertices[faces])
    # On a grid of 0.1 um, so that rounding leaves no slivers between neighbours.
    union = shapely.union_all(flat[shapely.area(flat) > 1e-12], grid_size=1e-7)
    if len(shapely.get_parts(union)) > 1:  # bodies that touch within rounding
        union = shapely.buffer(
            shapely.buffer(union, TOUCHING, join_style="mitre"), -TOUCHING, join_style="mitre"
        )
    parts = shapely.get_parts(union)
    areas = shapely.area(parts)
    if areas.max() < 0.999 * areas.sum():
        raise ShapeError(
            f"mesh whose {len(parts)} parts touch only in a point or an edge seen from above: give a file of one body"
        )
    ring = shapely.get_coordinates(shapely.get_exterior_ring(parts[np.argmax(areas)]))[:-1]
    corners = ring[simplify_outline(ring, OUTLINE_TOLERANCE)]
    return corners if polygon_area(corners) > 0 else corners[::-1]


def flat_polygons(triangles: Float[np.ndarray, "f 3 3"]) -> np.ndarray:
    """The triangles' projections onto the table, as shapely polygons."""
    return np.asarray(shapely.polygons(triangles[:, :, :2]), dtype=object)


def clip_polytope(
    vertices: Float[np.ndarray, "k 3"], normal: Float[np.ndarray, "3"], offset: float
) -> Float[np.ndarray, "m 3"]:
    """Vertices of the part of a convex body where ``normal . x >= offset``; no rows where nothing is left."""
    from scipy.spatial import ConvexHull

    depth = vertices @ normal - offset
    depth[np.abs(depth) <= ON_PLANE] = 0.0
    kept, cut = depth >= 0, depth < 0
    if not cut.any():
        return vertices
    if not (depth > 0).any():
        return np.zeros((0, 3))
    inner, outer = vertices[kept], vertices[cut]
    # Every segment between a kept and a dropped vertex lies in the body, and the true edges are among them.
    share = depth[kept][:, None] / (depth[kept][:, None] - depth[cut][None])
    crossings = inner[:, None] + share[..., None] * (outer[None] - inner[:, None])
    points = np.concatenate([inner, crossings.reshape(-1, 3)])
    return points[ConvexHull(points).vertices]
