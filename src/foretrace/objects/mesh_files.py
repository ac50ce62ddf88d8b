"""Triangle meshes from files, their unit and their precision."""

import logging
import warnings
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.errors import ForetraceError, ShapeError, shown
from foretrace.geometry import polygon_area
from foretrace.objects.decomposition import Faces, Points
from foretrace.objects.model import SIZE_LIMITS, USUAL_SIZES

READABLE = (".stl", ".obj", ".ply", ".off")
"""Endings of mesh files that are read; z is up in all of them."""
OTHERS = {
    **dict.fromkeys((".3mf", ".amf"), "a print job"),
    **dict.fromkeys(
        (".glb", ".gltf", ".dae", ".usd", ".usdz", ".fbx", ".x3d", ".wrl"), "a scene, often with y up"
    ),
    **dict.fromkeys(
        (".step", ".stp", ".iges", ".igs", ".brep", ".sldprt", ".fcstd", ".f3d", ".ipt"), "a CAD model"
    ),
    **dict.fromkeys((".blend", ".scad", ".xyz", ".pcd", ".gcode", ".dxf"), "no surface"),
}
"""Endings of files that are taken for meshes, and what such a file holds."""
LARGEST_FILE = 200_000_000
"""Larger mesh files are refused [bytes]."""
UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "metres": 1.0}
"""Units of mesh files [m]."""
PLAUSIBLE = (0.03, 0.5)
"""An object is expected to be as long as this when its unit is guessed [m]."""
LARGEST_COORDINATE = 1e9
"""Coordinates beyond are no object of any unit: their products would overflow."""
FLAT = 1 - 1e-6
"""Cosine of the angle between faces in one plane."""
COARSEST = 2e-3
"""Largest rounding of coordinates, relative to the mesh's smallest extent."""

logging.getLogger("trimesh").addHandler(
    logging.NullHandler()
)  # a texture that is missing is printed, otherwise


def is_mesh_file(path: Path) -> bool:
    """Whether a file's ending is that of a mesh, also of one that is not read."""
    return path.suffix.lower() in (*READABLE, *OTHERS)


def read_mesh(path: Path, error: type[ForetraceError] = ShapeError) -> tuple[Points, Faces]:
    """Vertices, in the file's unit, and faces of all bodies of an STL, OBJ, PLY or OFF file.

    Raises:
        ForetraceError: Of the given class: the file cannot be read, or holds no triangles with finite corners.
    """
    import trimesh

    kind = path.suffix.lower()
    if not path.is_file():
        raise error(f"mesh file {path} does not exist: check the path")
    if kind not in READABLE:
        held = f" holds {OTHERS[kind]}" if kind in OTHERS else f" ends in {shown(kind)}"
        raise error(f"mesh file {path}{held}: export it as STL, OBJ, PLY or OFF")
    if (size := path.stat().st_size) > LARGEST_FILE:
        raise error(f"mesh file {path} has {size / 1e6:.0f} MB: simplify it in a mesh editor")
    options = {"skip_materials": True} if kind == ".obj" else {}
    try:
        mesh = trimesh.load_mesh(path, process=False, **options)
    except Exception as reason:  # trimesh's readers raise whatever the broken file makes them stumble over
        why = " ".join(str(reason).split())[:80]
        raise error(f"mesh file {path} cannot be read ({why}): give an STL, OBJ, PLY or OFF file") from reason
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise error(f"mesh file {path} holds no triangles: give the surface of a closed body")
    wrong = ~np.isfinite(mesh.vertices[np.unique(mesh.faces)]).all(axis=1)
    if wrong.any():
        raise error(
            f"mesh file {path}: {int(wrong.sum())} of its vertices are not finite numbers: export it again"
        )
    if (far := float(np.abs(mesh.vertices).max())) > LARGEST_COORDINATE:
        raise error(f"mesh file {path} reaches {far:.3g} units from the origin: export it again")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    vertices = np.array(mesh.vertices)
    return vertices, unfolded(vertices, np.array(mesh.faces, dtype=np.int64))


def unfolded(vertices: Points, faces: Faces) -> Faces:
    """Faces in which polygons that are not convex are cut right.

    Readers cut every polygon into a fan, whose triangles overlap where the polygon is not convex: some lie on their
    backs. Flat groups of faces with such a fold are cut anew.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    triangles = vertices[faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges.max(axis=1), edges.min(axis=1)))
    sorted_edges = np.sort(edges[order], axis=1)
    pairs = np.flatnonzero((sorted_edges[1:] == sorted_edges[:-1]).all(axis=1))
    left, right = owner[order[pairs]], owner[order[pairs + 1]]
    aligned = (normals[left] * normals[right]).sum(axis=1)
    if not (aligned < -FLAT).any():
        return faces
    flat = np.abs(aligned) > FLAT
    graph = coo_array((np.ones(flat.sum()), (left[flat], right[flat])), shape=(len(faces),) * 2)
    _, group = connected_components(graph, directed=False)
    done, mended = np.zeros(len(faces), dtype=bool), []
    for number in np.unique(group[left[aligned < -FLAT]]):
        members = np.flatnonzero(group == number)
        cut = _cut_polygon(vertices, faces[members])
        if cut is not None:
            done[members] = True
            mended.append(cut)
    return np.concatenate([faces[~done], *mended])


def _cut_polygon(vertices: Points, faces: Faces) -> Faces | None:
    """Triangles of the flat polygon that the faces of a fan cover; None where they bound no simple one."""
    edges = {
        tuple(edge) for face in faces.tolist() for edge in zip(face, np.roll(face, -1).tolist(), strict=True)
    }
    following = {start: end for start, end in edges if (end, start) not in edges}
    loop = [next(iter(following), -1)]
    while len(loop) <= len(following) and (after := following.get(loop[-1], -1)) not in (-1, loop[0]):
        loop.append(after)
    if len(loop) < 3 or len(loop) != len(following):
        return None
    ring = vertices[loop]
    normal = np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)
    keep = np.roll([0, 1, 2], -int(np.abs(normal).argmax()) - 1)[:2]
    flat = ring[:, keep]
    if not shapely.Polygon(flat).is_valid:
        return None
    forwards = polygon_area(flat) > 0
    index_of = {(x, y): k for k, (x, y) in zip(loop, flat.tolist(), strict=True)}
    cut = []
    for triangle in shapely.constrained_delaunay_triangles(shapely.Polygon(flat)).geoms:
        corners = shapely.get_coordinates(triangle)[:3]
        indices = [index_of[x, y] for x, y in corners.tolist()]
        cut.append(indices if (polygon_area(corners) > 0) == forwards else indices[::-1])
    return np.array(cut)


def check_unit(extents: Float[np.ndarray, "3"], scale: float) -> None:
    """Refuse a mesh whose unit is another one, and point out an unusual size.

    Args:
        extents: Extents of the mesh in the file's unit.
        scale: Metres per unit that were given.

    Raises:
        ShapeError: It would be too large or too small; the message names the units that it may have.
    """
    size = float(extents.max())
    lengths = " x ".join(f"{length * scale:.4g}" for length in extents)
    if USUAL_SIZES[0] <= size * scale <= USUAL_SIZES[1]:
        return
    if SIZE_LIMITS[0] <= size * scale <= SIZE_LIMITS[1]:
        warnings.warn(f"mesh is {lengths} m at a scale of {scale:g}: check its unit", stacklevel=3)
        return
    for low, high in (PLAUSIBLE, SIZE_LIMITS):
        guesses = [name for name, unit in UNITS.items() if low <= size * unit <= high]
        if guesses:
            names = " or ".join(guesses)
            scales = " or ".join(f"{UNITS[name]:g}" for name in guesses)
            raise ShapeError(
                f"mesh is {lengths} m: looks like {names}: give --scale {scales} (in Python scale={scales})"
            )
    raise ShapeError(
        f"mesh is {lengths} m: objects of {SIZE_LIMITS[0]} to {SIZE_LIMITS[1]} m are expected; give its unit "
        "as --scale (in Python scale=), e.g. 0.001 for millimetres"
    )


def check_precision(vertices: Points) -> None:
    """Refuse coordinates that lie so far from the origin that a file of single precision has rounded them.

    Raises:
        ShapeError: The rounding is large beside the mesh.
    """
    far = float(np.abs(vertices).max())
    step = float(np.spacing(np.float32(far)))
    smallest = float(np.ptp(vertices, axis=0).min())
    rounded = np.array_equal(vertices, vertices.astype(np.float32))
    # Whole numbers below 2^24 are exact in single precision.
    if rounded and step > COARSEST * smallest > 0 and (step >= 1 or (vertices % 1 != 0).any()):
        raise ShapeError(
            f"mesh lies {far:.3g} units from the origin, where its coordinates are rounded to {step:.2g}, and is "
            f"{smallest:.3g} units thick: export it nearer to the origin"
        )
