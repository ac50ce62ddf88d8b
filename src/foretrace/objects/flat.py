"""Flat objects as they lie about: prisms of many sizes, and round, organic and dented outlines."""

from collections.abc import Callable

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.objects.model import fitting_bevel
from foretrace.objects.prism import CIRCLE_RADIUS, Prism, sample_prism

HALF_LENGTHS = (0.04, 0.1)
"""Smallest and largest half length of a sampled object [m]; of a prism the radius of its corners' circle.

Longer objects would not fit into a view where they are levered at an end.
"""
HEIGHTS = (0.008, 0.04)
"""Smallest and largest height of a sampled flat object [m]."""
DISC_SHARE = 1 / 3
"""Share of ovals that are circles."""
ROUNDED_CORNERS = (3, 8)
"""Fewest and most corners of a polygon before it is rounded."""
WAVES = np.arange(2, 7)
"""How often each wave of an organic outline goes round it."""
SMOOTHING = 0.004
"""Smallest radius of curvature at a dent [m]."""
POINTS = 360
"""Points of a curve before those that it does not need are left out."""
CURVE_TOLERANCE = 0.0002
"""How far the polygon may leave the curve [m]."""
NECK = 0.004
"""Smallest width of the bottom face [m]."""

Curve = Float[np.ndarray, "points 2"]


def sample_sized_prism(rng: np.random.Generator, num_corners: int) -> Prism:
    """One of the paper's random prisms in another size and height."""
    corners = sample_prism(rng, num_corners).corners * (rng.uniform(*HALF_LENGTHS) / CIRCLE_RADIUS)
    height = rng.uniform(*HEIGHTS)
    return Prism(corners, height, fitting_bevel(corners, height))


def sample_oval(rng: np.random.Generator) -> Prism:
    """A disc or an ellipse, standing on its flat face."""
    ratio = 1.0 if rng.random() < DISC_SHARE else rng.uniform(0.4, 1.0)
    return _flat(_superellipse(rng.uniform(*HALF_LENGTHS), ratio, 2.0), rng.uniform(*HEIGHTS))


def sample_rounded(rng: np.random.Generator) -> Prism:
    """A convex outline between round and straight: a superellipse, a capsule or a polygon with round corners."""
    half, height = rng.uniform(*HALF_LENGTHS), rng.uniform(*HEIGHTS)
    kind = rng.integers(3)
    if kind == 0:
        return _flat(_superellipse(half, rng.uniform(0.35, 1.0), rng.uniform(2.5, 6.0)), height)
    if kind == 1:
        radius = half * rng.uniform(0.25, 0.7)
        return _flat(shapely.LineString([(radius - half, 0), (half - radius, 0)]).buffer(radius, 90), height)
    corners = sample_prism(rng, int(rng.integers(*ROUNDED_CORNERS))).corners * (half / CIRCLE_RADIUS)
    polygon = shapely.Polygon(corners)
    radius = rng.uniform(0.2, 0.7) * float(shapely.length(shapely.maximum_inscribed_circle(polygon)))
    return _flat(polygon.buffer(-radius, join_style="mitre").buffer(radius, 90), height)


def sample_organic(rng: np.random.Generator) -> Prism:
    """A smooth outline without symmetry, like a leaf, a stone or a pear: a circle with waves, stretched."""

    def draw() -> shapely.Geometry:
        sizes = rng.uniform(0.0, 0.35) * rng.dirichlet(np.ones(len(WAVES)))
        phases, ratio = rng.uniform(0, 2 * np.pi, len(WAVES)), rng.uniform(0.5, 1.0)
        angles = _angles()
        radii = 1 + (sizes * np.cos(np.outer(angles, WAVES) + phases)).sum(axis=1)
        return shapely.Polygon(rng.uniform(*HALF_LENGTHS) * radii[:, None] * _circle() * [1.0, ratio])

    return _flat(_sound(draw), rng.uniform(*HEIGHTS))


def sample_dented(rng: np.random.Generator) -> Prism:
    """A round outline with one or two dents, like an apple's, a kidney's or a spanner's end."""

    def draw() -> shapely.Geometry:
        half = rng.uniform(*HALF_LENGTHS)
        whole: shapely.Geometry = _superellipse(half, rng.uniform(0.5, 1.0), rng.uniform(1.8, 4.0))
        for _ in range(rng.integers(1, 3)):
            ring = shapely.get_exterior_ring(whole)
            rim = shapely.line_interpolate_point(ring, rng.random(), normalized=True)
            at = shapely.get_coordinates(rim)[0]
            size = half * rng.uniform(0.15, 0.5)
            middle = at + size * rng.uniform(0.0, 0.8) * (at / np.linalg.norm(at))
            whole = shapely.difference(whole, shapely.Point(middle).buffer(size, 90))
        # Opening and closing: corners get round, and slits narrower than twice the radius are filled.
        for distance in (-SMOOTHING, 2 * SMOOTHING, -SMOOTHING):
            whole = shapely.buffer(whole, distance, quad_segs=24)
        return whole

    return _flat(_sound(draw), rng.uniform(*HEIGHTS))


def _sound(draw: Callable[[], shapely.Geometry]) -> shapely.Polygon:
    """The first drawn outline in one part and without a neck too narrow to stand on."""
    while True:
        outline = draw()
        if (
            not isinstance(outline, shapely.Polygon)
            or not outline.is_valid
            or outline.is_empty
            or outline.interiors
        ):
            continue
        width = fitting_bevel(np.array(outline.exterior.coords[:-1]), np.inf).width
        if isinstance(bottom := outline.buffer(-width - NECK / 2), shapely.Polygon) and not bottom.is_empty:
            return outline


def _flat(outline: shapely.Polygon, height: float) -> Prism:
    """The prism of an outline, around its centroid."""
    from scipy.spatial.distance import pdist

    kept = shapely.simplify(outline, CURVE_TOLERANCE)
    corners = shapely.get_coordinates(kept)[:-1] - shapely.get_coordinates(shapely.centroid(kept))
    corners *= min(1.0, 2 * HALF_LENGTHS[1] / pdist(corners).max())
    return Prism(corners, height, fitting_bevel(corners, height))


def _superellipse(half: float, ratio: float, power: float) -> shapely.Polygon:
    """The curve ``|x / a|^p + |y / b|^p = 1``: an ellipse for a power of 2, near a rectangle for larger ones."""
    unit = np.sign(_circle()) * np.abs(_circle()) ** (2 / power)
    return shapely.Polygon(half * unit * [1.0, ratio])


def _circle() -> Curve:
    return np.column_stack([np.cos(_angles()), np.sin(_angles())])


def _angles() -> Float[np.ndarray, " points"]:
    return 2 * np.pi * np.arange(POINTS) / POINTS
