"""Convex pieces of a solid, cut by planes until the volume of their hulls is the solid's own."""

import heapq
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from foretrace.errors import ShapeError
from foretrace.files import atomic_path, cache_folder, make_folder, short_hash, versions_of

GOAL = 0.002
"""Cutting ends where the hulls are larger than the solid by this share of its volume."""
MOST_PIECES = 256
"""Cutting ends with this number of pieces."""
MOST_TRIANGLES = 20_000
"""Finer surfaces are simplified before they are cut."""
SIMPLIFIED = (1e-4, 3e-4, 1e-3)
"""How far simplifying may move the surface, relative to the solid's largest extent: the first that is enough."""
REFLEX_PLANES = 8
"""Planes through reflex edges that are tried for each cut."""
GRID_PLANES = 3
"""Planes across each axis that are tried for each cut."""
MOST_EDGES = 500
"""Reflex edges of a piece that are looked at, longest and sharpest first."""
SMALLEST_ANGLE = 2e-3
"""Edges bent inwards by less are flat [rad]."""
THINNEST = 1e-5
"""Thinner pieces are left out [m]: engines build no hull from them."""
VERSION = b"plane cuts, 1"
"""Named in the cache: another way to cut has another one."""

Points = Float[np.ndarray, "_ 3"]
Faces = Int[np.ndarray, "_ 3"]


def as_solid(vertices: Points, faces: Faces) -> Any:
    """The ``manifold3d.Manifold`` that a closed, consistently wound mesh bounds."""
    from manifold3d import Manifold, Mesh64

    return Manifold(Mesh64(np.array(vertices, dtype=float), np.array(faces, dtype=np.uint64, order="C")))


def surface_of(solid: Any) -> tuple[Points, Faces]:
    """Vertices and faces of a ``manifold3d.Manifold``."""
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(np.int64)


def cached_pieces(vertices: Points, faces: Faces) -> list[Points]:
    """Vertices of the convex pieces of the solid that a mesh bounds [m], kept in the user's cache.

    Raises:
        ShapeError: The mesh is too fine to be cut.
    """
    versions = versions_of("manifold3d")
    key = short_hash([VERSION, str(versions).encode(), vertices.tobytes(), faces.tobytes()])
    file = cache_folder("pieces") / f"{key}.npz"
    try:
        with np.load(file, allow_pickle=False) as content:
            points, ends = content["points"].astype(float), content["ends"].astype(int)
        if (
            points.ndim == 2
            and points.shape[1] == 3
            and np.isfinite(points).all()
            and ends[-1] == len(points)
        ):
            return np.split(points, ends[:-1])
    except Exception:  # whatever is wrong with an entry of the cache: it is made again
        pass
    pieces = decompose(as_solid(vertices, faces))
    try:
        make_folder(file.parent, ShapeError)
        ends = np.cumsum([len(piece) for piece in pieces])
        with atomic_path(file) as partial, open(partial, "wb") as target:
            np.savez(target, points=np.concatenate(pieces), ends=ends)
    except (OSError, ShapeError):
        pass  # no room or no right to write: the next one cuts again
    return pieces


def decompose(solid: Any) -> list[Points]:
    """Vertices of the hulls of pieces that a solid is cut into, at least 4 each [m].

    The piece whose hull is largest against its own volume is cut next, by the plane that leaves least of that excess.
    The planes tried contain the longest and deepest reflex edges, along a face or halving the angle (as notches are
    cut in B. Chazelle, Convex partitions of polyhedra, 1984), or stand across an axis. Pieces do not overlap and their
    hulls contain them, so that the hulls' union is larger than the solid by the sum of the excesses at most.

    Raises:
        ShapeError: The surface is too fine to be cut.
    """
    solid = _simplified(solid)
    whole = solid.volume()
    waiting = [_Piece(part, _excess(part)) for part, _ in _connected(solid, whole)]
    heapq.heapify(waiting)
    done: list[_Piece] = []
    excess = sum(piece.excess for piece in waiting)
    while waiting and excess > GOAL * whole and len(waiting) + len(done) < MOST_PIECES:
        piece = heapq.heappop(waiting)
        parts = _cut(piece.solid, whole)
        if not parts:
            done.append(piece)
            continue
        excess += sum(part.excess for part in parts) - piece.excess
        for part in parts:
            heapq.heappush(waiting, part)
    hulls = [piece.solid.hull() for piece in [*done, *sorted(waiting)]]
    thick = [hull for hull in hulls if 2 * hull.volume() > THINNEST * hull.surface_area()]
    return [surface_of(hull)[0] for hull in thick]


@dataclass
class _Piece:
    """A part of the solid, with the volume by which its hull is larger [m^3]. The largest excess sorts first."""

    solid: Any
    excess: float

    def __lt__(self, other: "_Piece") -> bool:
        return self.excess > other.excess


def _simplified(solid: Any) -> Any:
    """The solid with fewer triangles, where it has more than are worth their while."""
    low, high = np.split(np.array(solid.bounding_box()), 2)
    size = float((high - low).max())
    if solid.num_tri() <= 1000:
        return solid
    for tolerance in SIMPLIFIED:
        simple = solid.simplify(tolerance * size)
        if simple.num_tri() <= MOST_TRIANGLES:
            return simple
    raise ShapeError(
        f"mesh with {solid.num_tri()} faces is too fine to be cut into convex pieces: simplify it in a mesh editor "
        f"to {MOST_TRIANGLES}"
    )


def _excess(solid: Any) -> float:
    return max(solid.hull().volume() - solid.volume(), 0.0)


def _connected(solid: Any, whole: float) -> list[tuple[Any, int]]:
    """Connected parts of a solid, each with its number of handles and cavities; specks are left out."""
    shells = solid.decompose()
    volumes = [shell.volume() for shell in shells]
    if min(volumes, default=0.0) < -1e-9 * whole:  # a cavity's surface is a shell of its own
        return [(solid, sum(shell.genus() + (v < 0) for shell, v in zip(shells, volumes, strict=True)))]
    return [(shell, shell.genus()) for shell, v in zip(shells, volumes, strict=True) if v > 1e-9 * whole]


def _cut(solid: Any, whole: float) -> list[_Piece]:
    """The parts of a piece after the best cut; none where no plane parts it."""
    best: tuple[tuple[int, float, float], list[_Piece]] | None = None
    for normal, offset in _planes(solid):
        halves = solid.split_by_plane(tuple(normal), float(offset))
        parts = [part for half in halves for part in _connected(half, whole)]
        if len(parts) < 2:
            continue
        pieces = [_Piece(part, _excess(part)) for part, _ in parts]
        sizes = [piece.excess for piece in pieces]
        # A ring's first cut leaves the hulls as large as before: opening it comes first, then a cut in the middle.
        score = (sum(holes for _, holes in parts), round(sum(sizes) / whole, 5), max(sizes))
        if best is None or score < best[0]:
            best = score, pieces
    return [] if best is None else best[1]


def _planes(solid: Any) -> list[tuple[np.ndarray, float]]:
    """Normals and offsets of the planes that may cut a piece."""
    vertices, faces = surface_of(solid)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    planes = _reflex_planes(solid, vertices, faces)
    for axis in np.eye(3):
        shares = np.arange(1, GRID_PLANES + 1) / (GRID_PLANES + 1)
        planes += [(axis, float(axis @ (low + share * (high - low)))) for share in shares]
    return planes


def _reflex_planes(solid: Any, vertices: Points, faces: Faces) -> list[tuple[np.ndarray, float]]:
    """The planes in which most of the reflex edges lie, weighted by length, angle and depth below the hull."""
    normals = _unit_normals(vertices[faces])
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    opposite, owner = np.roll(faces, -2, axis=1).ravel(), np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 0] < edges[:, 1], edges.max(axis=1), edges.min(axis=1)))
    here, there = order[::2], order[1::2]  # both halves of each edge
    n, m = normals[owner[here]], normals[owner[there]]
    start, end = vertices[edges[here]].swapaxes(0, 1)
    angle = np.arctan2(np.linalg.norm(np.cross(n, m), axis=1), (n * m).sum(axis=1))
    inwards = ((vertices[opposite[there]] - start) * n).sum(axis=1) > 0
    reflex = np.flatnonzero(inwards & (angle > SMALLEST_ANGLE))
    if len(reflex) == 0:
        return []
    weight = np.linalg.norm(end - start, axis=1) * angle
    reflex = reflex[np.argsort(-weight[reflex], kind="stable")[:MOST_EDGES]]
    middle = (start[reflex] + end[reflex]) / 2
    hull, sides = surface_of(solid.hull())
    outwards = _unit_normals(hull[sides])
    depth = -(middle @ outwards.T - (outwards * hull[sides[:, 0]]).sum(axis=1)).max(axis=1)
    weight = weight[reflex] * np.maximum(depth, 1e-9)
    n, m = n[reflex], m[reflex]
    candidates = np.concatenate([n, m, (n - m) / np.linalg.norm(n - m, axis=1, keepdims=True)])
    largest = np.abs(candidates).argmax(axis=1)
    candidates *= np.sign(candidates[np.arange(len(candidates)), largest])[:, None]
    offsets = (candidates * np.tile(middle, (3, 1))).sum(axis=1)
    # Edges in the same plane, to a thousandth, speak for it together.
    alike = np.round(1e3 * np.column_stack([candidates, offsets / np.ptp(vertices, axis=0).max()]))
    _, first, group = np.unique(alike, axis=0, return_index=True, return_inverse=True)
    votes = np.bincount(group.ravel(), np.tile(weight, 3))
    best = first[np.argsort(-votes, kind="stable")[:REFLEX_PLANES]]
    return [(candidates[k], float(offsets[k])) for k in best]


def _unit_normals(triangles: Float[np.ndarray, "f 3 3"]) -> Points:
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
