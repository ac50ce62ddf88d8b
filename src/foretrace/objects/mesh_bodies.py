"""One solid from a mesh: bodies that overlap or touch are united, what bounds no single body is refused."""

from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.errors import ShapeError
from foretrace.objects.decomposition import Faces, Points, as_solid, surface_of

NO_VOLUME = "mesh encloses no volume: give the surface of a closed body"
DEBRIS = 1e-3
"""Loose shells below this share of the volume are left out."""
TOUCHING = 2e-6
"""Bodies nearer than this share of the mesh's size may touch: an STL file's rounding is smaller."""
SMALLEST_FACE = 2e-5
"""Smallest face by which bodies touch, relative to the square of the mesh's size."""
LINES = 64
"""Vertical lines along each axis on which the mesh is looked at for crossing itself."""
LARGEST_FAULT = 1e-3
"""Share of the volume that may be bounded twice or inside out."""
MOST_FACES = 500_000
"""Meshes with more faces are refused: they would take minutes."""


def one_solid(vertices: Points, faces: Faces) -> tuple[Points, Faces]:
    """Vertices and outward faces of the one body that a mesh bounds; unchanged where there is nothing to mend.

    A cavity is no second body. Faces are turned where that is needed. Faces with a corner twice are left out.

    Raises:
        ShapeError: The mesh is not closed, crosses itself, or bounds several bodies that do not touch.
    """
    if len(faces) > MOST_FACES:
        raise ShapeError(
            f"mesh with {len(faces)} faces: simplify it in a mesh editor to {MOST_FACES} or fewer"
        )
    twice = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    faces = faces[~twice]
    import trimesh  # a second to import, and most objects are prisms

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    plain = mesh.is_watertight and mesh.is_winding_consistent
    with np.errstate(divide="ignore", invalid="ignore"):  # the middle of no volume
        nothing = abs(mesh.volume) < 1e-9 * np.ptp(vertices, axis=0).max() ** 3
    if plain and not nothing and is_convex_body(mesh):
        return vertices, faces if mesh.volume > 0 else faces[:, ::-1]
    solid = as_solid(vertices, faces)
    if solid.is_empty() or (not plain and solid.status().name != "NoError"):
        trimesh.repair.fix_winding(mesh)
        faces = np.array(mesh.faces)
        solid = as_solid(vertices, faces)
    shells = solid.decompose()
    if plain and nothing and len(shells) < 2:  # of two alike, one may be inside out
        raise ShapeError(NO_VOLUME)
    if solid.is_empty():
        raise ShapeError(_open_edges(faces))
    if plain and len(shells) == 1:
        faces = faces if mesh.volume > 0 else faces[:, ::-1]
    else:
        # Faces that coincide but for rounding are cut anew once or twice; then a stored mesh comes back as it was.
        for _ in range(4):
            before = vertices, faces
            vertices, faces = _united(vertices, faces, as_solid(vertices, faces).decompose())
            if np.array_equal(before[0], vertices) and np.array_equal(before[1], faces):
                break
    if (fault := _crossing_share(vertices[faces])) > LARGEST_FAULT:
        raise ShapeError(
            f"mesh crosses itself: {100 * fault:.2g} % of its volume is bounded twice or inside out; "
            "repair it in a mesh editor"
        )
    return vertices, faces


def is_convex_body(mesh: Any) -> bool:
    """Whether a ``trimesh.Trimesh`` is its own hull; trimesh itself overlooks that two bodies touch in a corner."""
    from scipy.spatial import ConvexHull

    return bool(mesh.is_convex and abs(mesh.volume) > 0.999 * ConvexHull(mesh.vertices).volume)


def _open_edges(faces: Faces) -> str:
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    return (
        f"mesh is not watertight ({int((uses != 2).sum())} edges without exactly two faces): "
        "close its holes in a mesh editor"
    )


def _united(vertices: Points, faces: Faces, shells: list[Any]) -> tuple[Points, Faces]:
    """The union of all shells, less the cavities in them."""
    from manifold3d import Manifold, OpType

    volumes = [shell.volume() for shell in shells]
    turned = sum(volumes) < 0
    if turned:
        shells, volumes = [_inside_out(shell) for shell in shells], [-volume for volume in volumes]
    whole = sum(abs(volume) for volume in volumes)
    kept = [(shell, v) for shell, v in zip(shells, volumes, strict=True) if abs(v) > 1e-9 * whole]
    bodies = [shell for shell, v in kept if v > 0]
    if not kept:
        raise ShapeError(NO_VOLUME)
    same = len(kept) == len(shells)
    cavities = [_inside_out(shell) for shell, v in kept if v < 0]
    for cavity in cavities:
        around = [body for body in bodies if (cavity - body).volume() < 1e-6 * cavity.volume()]
        if around:
            innermost = min(around, key=lambda body: body.hull().volume())
            bodies[bodies.index(innermost)] = innermost - cavity
        else:
            bodies.append(cavity)
            same = False
    solid = Manifold.batch_boolean(bodies, OpType.Add)
    parts = _separate(solid)
    volume = solid.volume()
    if volume < 1e-9 * whole:
        raise ShapeError(NO_VOLUME)
    large = [part for part in parts if part.volume() > DEBRIS * volume]
    if len(large) > 1:
        _one_body(large)
    same = same and len(large) == len(parts) == len(bodies)
    if same and abs(volume - sum(v for _, v in kept)) < 1e-6 * whole:
        return vertices, faces[:, ::-1] if turned else faces
    return surface_of(Manifold.compose(large) if len(large) > 1 else large[0])


def _inside_out(shell: Any) -> Any:
    vertices, faces = surface_of(shell)
    return as_solid(vertices, faces[:, ::-1])


def _separate(solid: Any) -> list[Any]:
    """The parts of a solid that are not connected, each with its cavities."""
    shells = solid.decompose()
    parts = [shell for shell in shells if shell.volume() > 0]
    for cavity in (_inside_out(shell) for shell in shells if shell.volume() < 0):
        around = [k for k, part in enumerate(parts) if (cavity - part).volume() < 1e-6 * cavity.volume()]
        if around:
            innermost = min(around, key=lambda k: parts[k].hull().volume())
            parts[innermost] = parts[innermost] - cavity
    return parts


def _one_body(parts: list[Any]) -> None:
    """Check that each part touches the next with a face, but for rounding.

    Raises:
        ShapeError: They lie apart, or touch along an edge or in a corner only.
    """
    low, high = np.split(np.array([part.bounding_box() for part in parts]), 2, axis=1)
    size = float((high.max(axis=0) - low.min(axis=0)).max())
    reached, left = [parts[0]], parts[1:]
    while left:
        found = next((part for part in left if any(_touch(part, other, size) for other in reached)), None)
        if found is None:
            gap = min(part.min_gap(other, 2 * size) for part in left for other in reached) / size
            how = (
                "touch only along edges or in corners"
                if gap <= TOUCHING
                else f"lie apart, by {gap:.2g} of their extent"
            )
            raise ShapeError(
                f"mesh holds {len(parts)} bodies that {how}: give a file of one body, or join them in CAD"
            )
        left.remove(found)
        reached.append(found)


def _touch(one: Any, other: Any, size: float) -> bool:
    """Whether two bodies share a face: moved against each other by a step, they overlap by its area times the step."""
    step = TOUCHING * size
    steps = step * np.concatenate([np.eye(3), -np.eye(3)])
    return any(
        (one ^ other.translate(tuple(each))).volume() > step * SMALLEST_FACE * size**2 for each in steps
    )


def _crossing_share(triangles: Float[np.ndarray, "f 3 3"]) -> float:
    """Share of the volume that is bounded twice or inside out, as vertical lines through the mesh meet it."""
    a, b, c = triangles.swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    extent = np.ptp(triangles.reshape(-1, 3), axis=0)
    upright = np.abs(normals[:, 2]) > 1e-12 * (extent[:2] ** 2).sum()
    a, normals, triangles = a[upright], normals[upright], triangles[upright]
    low = triangles.reshape(-1, 3).min(axis=0)
    # Off the middle, and by other shares along each line, so that they miss vertices and edges.
    steps = (np.arange(LINES) + 0.5 + 0.1 * np.sqrt(2)) / (LINES + 0.5)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    lines = (
        low[:2]
        + np.stack([x + 1e-3 * np.sqrt(3) * y, y - 1e-3 * np.sqrt(5) * x], axis=-1).reshape(-1, 2)
        * extent[:2]
    )
    tree = shapely.STRtree(np.asarray(shapely.polygons(triangles[:, :, :2]), dtype=object))
    line, face = tree.query(shapely.points(lines), predicate="intersects")
    away = lines[line] - a[face, :2]
    heights = a[face, 2] - (away * normals[face, :2]).sum(axis=1) / normals[face, 2]
    order = np.lexsort((heights, line))
    line, heights, entering = line[order], heights[order], np.where(normals[face[order], 2] < 0, 1, -1)
    winding = np.cumsum(entering)[:-1]
    lengths = np.where(line[1:] == line[:-1], np.diff(heights), 0.0)
    faulty = lengths[(winding < 0) | (winding > 1)].sum()
    total = lengths[winding > 0].sum()
    return float(faulty / total) if total > 0 else 1.0
