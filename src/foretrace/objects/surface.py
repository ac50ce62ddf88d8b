"""An object's surface, for pictures and for other tools: as polygons, or as triangles."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from foretrace.geometry import is_convex
from foretrace.objects.mesh import MeshObject
from foretrace.objects.model import ObjectModel
from foretrace.objects.prism import convex_parts
from foretrace.objects.solid import Cylinder

SMALLEST_AREA = 1e-12
"""Triangles below this area are left out [m^2]: a rim without a bevel has such."""


def faces_of(obj: ObjectModel, every: int = 1) -> list[Float[np.ndarray, "_ 3"]]:
    """The surface as polygons, counter-clockwise from outside, in the object frame [m].

    Args:
        obj: The object.
        every: Neighbours among the 64 facets of a cylinder that become one facet.
    """
    obj = obj.shape
    if isinstance(obj, MeshObject):
        return list(obj.vertices[obj.faces])
    if isinstance(obj, Cylinder):
        layers = [end[::every] for end in np.split(obj.convex_pieces()[0], 2)]
    else:
        layers = _layers(obj)
    faces = [layers[0][::-1], layers[-1]]
    for lower, upper in pairwise(layers):
        corners = zip(lower, np.roll(lower, -1, axis=0), np.roll(upper, -1, axis=0), upper, strict=True)
        faces += [np.stack(quad) for quad in corners]
    return faces


def triangles_of(obj: ObjectModel) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]:
    """The surface as triangles.

    Returns:
        Vertices in the object frame [m], and the indices of each triangle's corners, counter-clockwise from outside.
    """
    obj = obj.shape
    if isinstance(obj, MeshObject):
        return obj.vertices, obj.faces
    layers = np.split(obj.convex_pieces()[0], 2) if isinstance(obj, Cylinder) else _layers(obj)
    n = len(layers[0])
    # The bottom is cut like the top: its corners may coincide, where those of the outline do not.
    cut = (
        [list(range(n))] if isinstance(obj, Cylinder) or is_convex(obj.corners) else convex_parts(obj.corners)
    )
    end = np.array([[part[0], a, b] for part in cut for a, b in pairwise(part[1:])])
    here = np.arange(n)
    following = np.roll(here, -1)
    side = np.concatenate(
        [np.column_stack([here, following, following + n]), np.column_stack([here, following + n, here + n])]
    )
    sides = [side + n * k for k in range(len(layers) - 1)]
    triangles = np.concatenate([end[:, ::-1], *sides, end + n * (len(layers) - 1)])
    vertices = np.concatenate(layers)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return vertices, triangles[areas > SMALLEST_AREA]


def _layers(obj: ObjectModel) -> list[Float[np.ndarray, "n 3"]]:
    """Bottom face, the outline where the bevel ends, and the outline on top, of a prism."""
    rim = min((piece[piece[:, 2] > 0, 2].min() for piece in obj.convex_pieces()), default=0.0)
    bottom, top = obj.support_corners, obj.corners
    return [
        np.column_stack([xy, np.full(len(xy), z)]) for xy, z in ((bottom, 0.0), (top, rim), (top, obj.height))
    ]
