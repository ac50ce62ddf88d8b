"""Objects given as closed triangle meshes."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from foretrace.errors import ShapeError
from foretrace.geometry import Numbers, convex_hull, finite_array, inward_normals, polygon_area
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
DECOMPOSITION: dict[str, Any] = {
    "threshold": 0.04,
    "preprocess_mode": "off",
    "mcts_iterations": 60,
    "mcts_max_depth": 2,
    "mcts_nodes": 12,
    "resolution": 800,
    "seed": 0,
}
"""Settings of the convex decomposition: concavity left in a piece, relative to the mesh, and a short search.

The mesh is known to be watertight, so it is cut as it is, not remeshed first."""


@dataclass(frozen=True, eq=False, init=False)
class MeshObject(ObjectModel):
    """A closed triangle mesh of uniform density, standing as its file has it.

    The mesh is moved so that its lowest point lies on the table and the origin below its centre of mass.
    Mass, centre of mass, inertia and view come from the mesh itself; collisions from convex pieces, whose
    lower rim is chamfered along the hull of the outline so that a blade gets under it.

    Raises:
        ShapeError: if the mesh is not watertight or has no believable size.
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
        shift = np.array([*mesh.center_mass[:2], mesh.bounds[0, 2]])
        # A mesh that lies right already is kept to the last digit: a stored object comes back as it was.
        in_place = mesh.vertices if np.abs(shift).max() < 1e-9 else mesh.vertices - shift
        object.__setattr__(self, "vertices", read_only(in_place))
        object.__setattr__(self, "faces", read_only(mesh.faces, np.int64))
        object.__setattr__(self, "height", float(self.vertices[:, 2].max()))
        object.__setattr__(self, "corners", read_only(project_outline(self.vertices[self.faces])))
        object.__setattr__(self, "bevel", bevel or fitting_bevel(self.corners, self.height))
        radius = inner_radius(self.corners)
        if self.bevel.height >= self.height or self.bevel.width >= radius:
            raise ShapeError(
                f"bevel of {self.bevel.width} m x {self.bevel.height} m on a mesh of height "
                f"{self.height:.4g} m and inner radius {radius:.4g} m: leave it out for one that fits"
            )

    @classmethod
    def load(cls, path: str | Path, scale: float = 1.0, bevel: Bevel | None = None) -> "MeshObject":
        """A mesh from an STL or OBJ file.

        Args:
            path: the file; z must point up.
            scale: metres per unit of the file, e.g. 0.001 for a file in millimetres.
            bevel: chamfer of the collision pieces' lower rim; by default one that fits.

        Raises:
            ShapeError: if the file cannot be read or the mesh is not usable.
        """
        import trimesh

        path = Path(path)
        if not path.is_file():
            raise ShapeError(f"mesh file {path} does not exist: check the path")
        try:
            mesh = trimesh.load_mesh(path, process=True)
        except Exception as error:  # trimesh's readers raise whatever the broken file makes them stumble over
            raise ShapeError(f"mesh file {path} cannot be read ({error}): give an STL or OBJ file") from error
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            raise ShapeError(f"mesh file {path} holds no triangles: give an STL or OBJ file of a closed body")
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        try:
            return cls(np.array(mesh.vertices) * scale, np.array(mesh.faces, dtype=np.int64), bevel)
        except ShapeError as error:
            raise ShapeError(f"{path}: {error}") from error

    def convex_pieces(self) -> list[Float[np.ndarray, "_ 3"]]:
        """Vertices of the convex parts, in the object frame [m].

        A convex mesh is one piece; any other is decomposed approximately (CoACD, fixed seed).
        """
        return self._pieces

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
    def _pieces(self) -> list[np.ndarray]:
        if self._mesh.is_convex:
            pieces = [np.array(self.vertices)]
        else:
            import coacd

            coacd.set_log_level("error")
            found = coacd.run_coacd(coacd.Mesh(self.vertices, self.faces), **DECOMPOSITION)
            pieces = [np.asarray(vertices, dtype=float) for vertices, _ in found]
        rim = convex_hull(np.array(self.corners))
        normals = inward_normals(rim)
        bevelled = []
        for vertices in pieces:
            piece = vertices
            if self.bevel.height > 0:
                slope = self.bevel.width / self.bevel.height
                for corner, normal in zip(rim, normals, strict=True):
                    # The body recedes below the bevel's height: n . x + slope z >= n . corner + width.
                    plane = np.array([*normal, slope])
                    piece = clip_polytope(piece, plane, float(normal @ corner) + self.bevel.width)
            if len(piece) >= 4:
                bevelled.append(read_only(piece[ConvexHull(piece).vertices]))
        return bevelled

    @cached_property
    def support_corners(self) -> Float[np.ndarray, "n 2"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The footprint's point nearest to each corner of the outline, in the object frame [m]."""
        points = np.concatenate(self._pieces)
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
    import trimesh  # a second to import, and most objects are prisms

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not mesh.is_watertight:
        _, uses = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
        raise ShapeError(
            f"mesh is not watertight ({int((uses != 2).sum())} edges without exactly two faces): "
            "close its holes in a mesh editor"
        )
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def project_outline(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "n 2"]:
    """Outline of the triangles seen from above, counter-clockwise, simplified and without holes [m]."""
    flat = flat_polygons(triangles)
    # On a grid of 0.1 um, so that rounding leaves no slivers between neighbours.
    union = shapely.union_all(flat[shapely.area(flat) > 1e-12], grid_size=1e-7)
    parts = shapely.get_parts(union)
    ring = shapely.get_coordinates(shapely.get_exterior_ring(parts[np.argmax(shapely.area(parts))]))[:-1]
    corners = ring[simplify_outline(ring, OUTLINE_TOLERANCE)]
    return corners if polygon_area(corners) > 0 else corners[::-1]


def flat_polygons(triangles: Float[np.ndarray, "f 3 3"]) -> np.ndarray:
    """The triangles' projections onto the table, as shapely polygons."""
    return np.asarray(shapely.polygons(triangles[:, :, :2]), dtype=object)


def clip_polytope(
    vertices: Float[np.ndarray, "k 3"], normal: Float[np.ndarray, "3"], offset: float
) -> Float[np.ndarray, "m 3"]:
    """Vertices of the part of a convex body where ``normal . x >= offset``; no rows where nothing is left."""
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
