"""Convex pieces of common shapes: number, volume against the shape's, and time.

    python benchmarks/mesh_pieces.py

Prints a table in Markdown.
"""

import time

import shapely
from manifold3d import CrossSection, Manifold
from scipy.spatial import ConvexHull

from foretrace.objects.decomposition import decompose

Z_TO_Y = (90, 0, 0)


def _cylinder(height: float, radius: float, facets: int = 64) -> Manifold:
    return Manifold.cylinder(height, radius, radius, facets)


def _bracket() -> Manifold:
    body = Manifold.cube((0.1, 0.06, 0.006)) + Manifold.cube((0.006, 0.06, 0.06))
    for x, y in ((0.03, 0.015), (0.03, 0.045), (0.08, 0.015), (0.08, 0.045)):
        body -= _cylinder(0.02, 0.004, 32).translate((x, y, -0.005))
    return body - _cylinder(0.03, 0.006, 32).rotate((0, 90, 0)).translate((-0.01, 0.03, 0.04))


def _mug() -> Manifold:
    inside = _cylinder(0.1, 0.036).translate((0, 0, 0.004))
    handle = CrossSection.circle(0.005, 24).translate((0.022, 0)).revolve(48)
    return _cylinder(0.09, 0.04) + handle.rotate(Z_TO_Y).translate((0.04, 0, 0.045)) - inside


def _spanner() -> Manifold:
    outline = shapely.LineString([(0, 0), (0.14, 0)]).buffer(0.01).union(shapely.Point(0.16, 0).buffer(0.022))
    outline = outline.difference(shapely.box(0.16, -0.008, 0.2, 0.008)).union(
        shapely.Point(0, 0).buffer(0.02)
    )
    section = CrossSection([shapely.get_coordinates(shapely.orient_polygons(outline))[:-1]])
    return (section - CrossSection.circle(0.01, 64)).extrude(0.006)


def _blob() -> Manifold:
    def height(x: float, y: float, z: float) -> float:
        centres = (
            (0, 0, 0, 4e-4),
            (0.05, 0, 0.01, 2e-4),
            (0.07, 0.02, 0.04, 1e-4),
            (-0.03, 0.03, 0.02, 1e-4),
        )
        return sum(k / ((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 + 1e-9) for a, b, c, k in centres) - 1

    return Manifold.level_set(height, [-0.1, -0.1, -0.1, 0.15, 0.1, 0.12], 0.003, 0)


def shapes() -> dict[str, Manifold]:
    """Solids of a few centimetres [m]."""
    cube, disc = Manifold.cube, CrossSection.circle
    legs = [cube((0.012, 0.012, 0.055)).translate((x, y, 0)) for x in (0, 0.108) for y in (0, 0.068)]
    table = cube((0.12, 0.08, 0.01)).translate((0, 0, 0.05))
    for leg in legs:
        table += leg
    bars = _cylinder(0.1, 0.008, 32).translate((0, 0, -0.05))
    bowl = Manifold.sphere(0.06, 96).trim_by_plane((0, 0, -1), 0) - Manifold.sphere(0.055, 96)
    return {
        "L": cube((0.2, 0.06, 0.03)) + cube((0.06, 0.2, 0.03)),
        "U": cube((0.12, 0.08, 0.02)) - cube((0.08, 0.06, 0.03)).translate((0.02, 0.02, -0.005)),
        "ring": _cylinder(0.02, 0.06) - _cylinder(0.02, 0.04),
        "bracket with holes": _bracket(),
        "spanner": _spanner(),
        "table": table,
        "cup": _cylinder(0.09, 0.04) - _cylinder(0.1, 0.036).translate((0, 0, 0.004)),
        "mug": _mug(),
        "torus": disc(0.02, 32).translate((0.05, 0)).revolve(64),
        "caltrop": bars + bars.rotate((90, 0, 0)) + bars.rotate((0, 90, 0)),
        "hollow box": cube((0.1, 0.08, 0.05)) - cube((0.08, 0.06, 0.03)).translate((0.01, 0.01, 0.01)),
        "blob": _blob(),
        "bent pipe": (disc(0.02, 32) - disc(0.016, 32)).translate((0.05, 0)).revolve(48, 90),
        "bowl": bowl,
    }


def main() -> None:
    print("| shape | triangles | pieces | volume too large by | seconds |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for name, solid in shapes().items():
        start = time.process_time()
        pieces = decompose(solid)
        seconds = time.process_time() - start
        fault = sum(ConvexHull(piece).volume for piece in pieces) / solid.volume() - 1
        print(
            f"| {name} | {solid.num_tri()} | {len(pieces)} | {100 * fault:.2f} % | {seconds:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
