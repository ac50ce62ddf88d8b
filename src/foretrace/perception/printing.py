"""Sheets of markers to print at their true size: PDF, SVG or PNG, in millimetres."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from foretrace.errors import PerceptionError, shown
from foretrace.files import atomic_path, make_folder
from foretrace.interactions.marker_patterns import dictionary, draw_marker

SUFFIXES = (".pdf", ".svg", ".png")
PAGES = ((210.0, 297.0), (297.0, 420.0), (420.0, 594.0), (594.0, 841.0), (841.0, 1189.0))
"""Pages from A4 to A0; the smallest that holds the largest marker is taken [mm]."""
EDGE = 12.0
"""Border of a page that printers leave white [mm]."""
CAPTION = 9.0
"""Room for what is written below a marker, and above it [mm]."""
SCALE = 100.0
"""Length of the scale bar [mm]."""
FOOT = 12.0
"""Room for the scale bar [mm]."""
INCH = 25.4
RESOLUTION = 300
"""Dots per inch of a PNG file."""


def print_markers(path: str | Path, name: str, sides: Mapping[int, float]) -> int:
    """Write markers upright, each with its number, dictionary and axes, and a scale bar on every page.

    Args:
        path: File to write, .pdf, .svg or .png.
        name: Dictionary of the markers.
        sides: Side of each marker's black square [m], by its number.

    Returns:
        The number of pages.

    Raises:
        PerceptionError: There is no such marker, the name has another ending, or the markers do not fit.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise PerceptionError(
            f"cannot write markers to {path}: choose a name that ends in {', '.join(SUFFIXES)}"
        )
    if not sides:
        raise PerceptionError("no markers to print: give the number of one at least (--ids)")
    for id, side in sides.items():
        if not 0.005 <= side <= 0.6:
            raise PerceptionError(f"marker {id} has a side of {shown(side)} m: give 0.005 to 0.6 m")
    modules = dictionary(name).markerSize + 2
    cells = {id: 1000 * side * (modules + 2) / modules for id, side in sides.items()}
    largest = max(cells.values())
    page = next((page for page in PAGES if largest + 2 * EDGE <= page[0]), PAGES[-1])
    sheets = list(_arrange(cells, page))
    if suffix != ".pdf" and len(sheets) > 1:
        raise PerceptionError(f"{len(cells)} markers fill {len(sheets)} pages: write them to a .pdf file")
    make_folder(path.parent, PerceptionError)
    figures = [_draw(name, {id: 1000 * sides[id] for id in sheet}, sheet, page) for sheet in sheets]
    with atomic_path(path) as partial:
        if suffix == ".pdf":
            with PdfPages(partial, metadata={"CreationDate": None}) as pages:
                for figure in figures:
                    pages.savefig(figure)
        else:
            figures[0].savefig(partial, format=suffix[1:], dpi=RESOLUTION)
    return len(figures)


def _arrange(
    cells: Mapping[int, float], page: tuple[float, float]
) -> Iterator[dict[int, tuple[float, float]]]:
    """Markers with their white margins in rows: the lower left corner of each, page by page [mm]."""
    width, height = page
    sheet: dict[int, tuple[float, float]] = {}
    x, top, row = EDGE, height - EDGE, 0.0
    for id, cell in cells.items():
        if x + cell > width - EDGE:
            x, top, row = EDGE, top - row, 0.0
        if top - cell - 2 * CAPTION < EDGE + FOOT and sheet:
            yield sheet
            sheet, x, top, row = {}, EDGE, height - EDGE, 0.0
        sheet[id] = (x, top - CAPTION - cell)
        x, row = x + cell + CAPTION, max(row, cell + 2 * CAPTION)
    yield sheet


def _draw(
    name: str,
    sides: Mapping[int, float],
    places: Mapping[int, tuple[float, float]],
    page: tuple[float, float],
) -> Figure:
    figure = Figure(figsize=(page[0] / INCH, page[1] / INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, page[0]), ylim=(0.0, page[1]))
    axes.set_axis_off()
    for id, (x, y) in places.items():
        pattern = draw_marker(name, id)
        module = sides[id] / len(pattern)
        cell = module * (len(pattern) + 2)
        axes.add_patch(_black(pattern, (x + module, y + module), module))
        cut = [(x, y), (x + cell, y), (x + cell, y + cell), (x, y + cell), (x, y)]
        axes.plot(*zip(*cut, strict=True), color="0.75", linewidth=0.3)
        write = {"fontsize": 7, "va": "center", "color": "0.3"}
        axes.text(x, y - 3, f"{name}  id {id}", **write)
        axes.text(x, y - 6.5, f"side {sides[id]:.1f} mm", **write)
        axes.text(x + cell / 2, y + cell + 3, "↑ y", ha="center", **write)
        axes.text(x + cell + 1, y + cell / 2, "→ x", **write)
    _scale_bar(axes)
    return figure


def _black(pattern: np.ndarray, corner: tuple[float, float], module: float) -> PathPatch:
    """A marker's black modules as one shape, so that no seam is left between them."""
    rows, columns = np.nonzero(pattern == 0)
    shape = shapely.unary_union(
        [
            shapely.box(c, len(pattern) - r - 1, c + 1, len(pattern) - r)
            for r, c in zip(rows, columns, strict=True)
        ]
    )
    rings: list[Outline] = []
    for part in shapely.get_parts(shape):
        part = shapely.geometry.polygon.orient(part)
        rings += [
            Outline(np.asarray(ring.coords) * module + corner, closed=True)
            for ring in (part.exterior, *part.interiors)
        ]
    return PathPatch(Outline.make_compound_path(*rings), facecolor="black", linewidth=0)


def _scale_bar(axes: Axes) -> None:
    y = EDGE + 2
    axes.plot([EDGE, EDGE + SCALE], [y, y], color="black", linewidth=0.6)
    for x in (EDGE, EDGE + SCALE / 2, EDGE + SCALE):
        axes.plot([x, x], [y - 1.5, y + 1.5], color="black", linewidth=0.6)
    axes.text(
        EDGE, y + 4, f'{SCALE:.0f} mm: print at 100 % ("actual size") and measure', fontsize=7, va="center"
    )
