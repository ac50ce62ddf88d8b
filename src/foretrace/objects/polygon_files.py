"""Outlines from text files: tables of corners as editors and spreadsheets write them, GeoJSON and WKT."""

import csv
import json
import math
import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.errors import ShapeError, shown
from foretrace.files import read_text
from foretrace.objects.model import SIZE_LIMITS

REMEDY = 'write one "x y" per line [m]'
COMMENT = re.compile(r"#|%|//")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE)
WORD = re.compile(r"[^\W\d_]+")
VALUE = re.compile(r"""(^|[\s,;"'])[+-]?\d|[.,]\d|\b(nan|inf|infinity|none|null|na)\b""", re.IGNORECASE)
"""What no line of headings holds."""
WKT = re.compile(r"(SRID=\d+;)?\s*(MULTI|GEOMETRY)?(POLYGON|COLLECTION|LINESTRING|POINT)\b", re.IGNORECASE)
MIXED = r"\s*,\s*|\s+"
"""What parts columns where some lines have commas and others blanks."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Units that headings name [m]."""
OTHER_UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254}
"""Units that are guessed of corners too large for metres [m]."""
DEGREES = {"lon", "lat", "lng", "long", "longitude", "latitude"}
NOT_DEGREES = "project them to metres, or move the origin to the object"
FAR = 10.0
"""Coordinates of a map lie this many sizes of the polygon from the origin, or farther."""
PLAUSIBLE = (0.02, 0.5)
"""Usual sizes of an object [m]: a guess of the unit must lead there."""


class Row(NamedTuple):
    """A line of a table that is not empty."""

    line: int
    text: str


def read_polygon(file: Path, scale: float | None = None) -> Float[np.ndarray, "n 2"]:
    """Corners [m] from a text file.

    It is a table with one corner per line, or one polygon as GeoJSON or WKT. A table's columns are parted by blanks,
    commas, semicolons or tabs; numbers may have decimal commas where that leaves one reading. Headings may name the
    columns x and y, and the unit: m, cm or mm. ``#``, ``%`` and ``//`` start a comment.

    Args:
        file: The file.
        scale: Metres per unit; by default 1, or what the headings say.

    Raises:
        ShapeError: The file is missing, is no such table or polygon, or its corners are in another unit.
    """
    text = read_text(file, ShapeError, REMEDY, fallback="latin-1")
    if mapped := text.lstrip().startswith("{") or bool(WKT.match(text.lstrip())):
        corners, unit = _geometry(file, text), None
    else:
        corners, unit = _table(file, text)
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        raise ShapeError(f"scale of {shown(scale)} metres per unit: give a positive number")
    corners = corners * (scale or unit or 1.0)
    if scale is None and unit is None and len(corners) > 2:
        _check_unit(file, corners, mapped)
    return corners


def _check_unit(file: Path, corners: Float[np.ndarray, "n 2"], mapped: bool) -> None:
    """Refuse corners that are not metres by all appearance; a map's are more likely to be degrees."""
    size, away = float(np.ptp(corners, axis=0).max()), float(np.abs(corners.mean(axis=0)).max())
    across = f"{file} has corners {size:.4g} across"
    on_globe = bool((np.abs(corners) <= [180, 90]).all())
    if on_globe and away > 1 and away > FAR * size and (mapped or size < SIZE_LIMITS[0]):
        raise ShapeError(
            f"{across}, {away:.4g} from the origin: they look like degrees of longitude and latitude: {NOT_DEGREES}"
        )
    if size > SIZE_LIMITS[1]:
        likely = {name: s for name, s in OTHER_UNITS.items() if PLAUSIBLE[0] <= size * s <= PLAUSIBLE[1]}
        if likely:
            scales = " or ".join(f"{value:g}" for value in likely.values())
            raise ShapeError(
                f"{across}, which looks like {' or '.join(likely)}: give --scale {scales}, or write metres"
            )


# --- GeoJSON and WKT ----------------------------------------------------------------------------------------


def _geometry(file: Path, text: str) -> Float[np.ndarray, "n 2"]:
    """Corners of the one polygon in GeoJSON or WKT."""
    text = text.strip()
    kind = "GeoJSON" if text.startswith("{") else "WKT"
    try:
        # Python's reader names the place of a fault, and refuses what is nested too deeply.
        if kind == "GeoJSON":
            content = json.loads(text)
            if "type" not in content:
                raise ShapeError(f"{file} is JSON without a type of geometry: give GeoJSON with one Polygon")
            found = shapely.from_geojson(json.dumps(content))
        else:
            found = shapely.from_wkt(re.sub(r"^SRID=\d+;", "", text, flags=re.IGNORECASE))
    except (ValueError, RecursionError, shapely.errors.ShapelyError) as error:
        reason = " ".join(str(error).split())
        raise ShapeError(
            f"{file} cannot be read as {kind} ({reason:.80}): give one Polygon in metres"
        ) from error
    parts = np.array([found])
    while (shapely.get_type_id(parts) > shapely.GeometryType.POLYGON).any():
        parts = shapely.get_parts(parts)
    kinds = [part.geom_type for part in parts]
    if kinds != ["Polygon"]:
        what = f"a {kinds[0]}" if len(kinds) == 1 else f"{len(kinds)} geometries"
        raise ShapeError(f"{file} holds {what}: give one Polygon")
    polygon = parts[0]
    if shapely.get_num_interior_rings(polygon):
        raise ShapeError(f"{file} holds a polygon with a hole: leave the inner ring out to have it filled")
    corners = shapely.get_coordinates(polygon.exterior, include_z=polygon.has_z)
    if len(corners) == 0:
        raise ShapeError(f"{file} holds an empty polygon: give its corners")
    if np.ptp(corners[:, 2:], axis=0).any():
        raise ShapeError(
            f"{file} holds a polygon that is not level: give corners of the same z, or x and y alone"
        )
    return corners[:, :2]


# --- tables -------------------------------------------------------------------------------------------------


def _table(file: Path, text: str) -> tuple[Float[np.ndarray, "n 2"], float | None]:
    """Corners in a table, and the unit [m] that its headings name."""
    if text.lstrip().startswith("["):
        try:  # a list of pairs, in one line or in several
            pairs = json.loads(text.translate({ord("("): "[", ord(")"): "]"}))
            text = "\n".join(" ".join(map(json.dumps, pair)) for pair in pairs)
        except (ValueError, TypeError, RecursionError):
            pass  # rows in brackets, as numpy prints them
    blank = str.maketrans({"\u2212": "-"} | dict.fromkeys("[](){}", " "))
    lines = (COMMENT.split(line)[0].translate(blank) for line in text.splitlines())
    rows = [Row(number, line.strip(" \r").rstrip(",;\t ")) for number, line in enumerate(lines, 1)]
    rows = [row for row in rows if row.text.strip(',;\t" ')]
    first = next((k for k, row in enumerate(rows) if VALUE.search(row.text)), len(rows))
    head, rows = [row.text for row in rows[:first]], rows[first:]
    if not rows:
        raise ShapeError(f"{file} holds no corners: {REMEDY}")
    words = {word.lower() for line in head for word in WORD.findall(line)}
    if words & DEGREES:
        raise ShapeError(f"{file} has a column {min(words & DEGREES)}: degrees are no lengths: {NOT_DEGREES}")
    units = sorted(words & UNITS.keys())
    if len(units) > 1:
        raise ShapeError(f"{file} has headings with the units {' and '.join(units)}: write one unit")
    readings = [_read(rows, head, *way) for way in product((";", "\t", ",", None, MIXED), ".,")]
    corners = [found for _, found in readings if isinstance(found, np.ndarray)]
    if not corners:
        _, fault = max(readings, key=lambda reading: reading[0])
        raise ShapeError(f"{file}, {fault}")
    # The first ways give the same corners, if any: a number holds no blank, and a decimal comma stands between digits.
    return corners[0], UNITS[units[0]] if units else None


def _read(
    rows: Sequence[Row], head: Sequence[str], delimiter: str | None, decimal: str
) -> tuple[tuple[int, bool], Float[np.ndarray, "n 2"] | str]:
    """A table read in one way: how far that leads, and the corners or the first fault."""
    columns, most = _named_columns(head, delimiter)
    found, fault, width = [], "", 0
    for row in rows:
        place = f"line {row.line}"
        cells = _split(row.text, delimiter)
        width = width or len(cells)
        chosen = columns or range(len(cells))
        values = [_number(cells[k], decimal) if k < len(cells) else None for k in chosen]
        odd = len(cells) > most if columns else len(cells) not in (2, 3) or len(cells) != width
        if odd:
            wanted = 'columns parted by ";" where numbers have decimal commas'
            parted = delimiter == "," and "." not in row.text
            fault = fault or (
                f"{place}: {shown(row.text)} has {len(cells)} entries: {wanted if parted else REMEDY}"
            )
        elif None in values:
            column = chosen[values.index(None)]
            cell = cells[column] if column < len(cells) else ""
            fault = fault or f"{place}, column {column + 1}: {shown(cell)} is no number: {REMEDY}"
        else:
            found.append(values)
    far = len(found), width > 1
    if fault:
        return far, fault
    corners = np.array(found, dtype=float)
    if np.ptp(corners[:, 2:], axis=0).any():
        differs = rows[int(np.argmax(corners[:, 2] != corners[0, 2]))]
        return far, (
            f"line {differs.line}, column 3: z is not {corners[0, 2]:g} as above: 3 numbers per line are an outline "
            f"where z is the same everywhere: {REMEDY}"
        )
    return far, corners[:, :2]


def _named_columns(head: Sequence[str], delimiter: str | None) -> tuple[list[int], int]:
    """Columns x, y and perhaps z by the headings, and how many there are; nothing if these do not name them."""
    for line in reversed(head):
        cells = [[word.lower() for word in WORD.findall(cell)] for cell in _split(line, delimiter)]
        if delimiter is None:  # a unit in brackets is no column
            cells = [cell for cell in cells if not cell or not UNITS.keys() >= set(cell)]
        named = [[k for k, cell in enumerate(cells) if axis in cell] for axis in "xyz"]
        columns = [k for each in named for k in each]
        if [len(each) for each in named[:2]] == [1, 1] and len(set(columns)) == len(columns) < 4:
            return columns, len(cells)
    return [], 0


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    if delimiter == MIXED:
        return re.split(MIXED, line)
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    except csv.Error:  # a cell of 130,000 letters
        return [line]


def _number(cell: str, decimal: str) -> float | None:
    cell = cell.strip().strip("\"'").strip()
    if decimal == ",":
        cell = "" if "." in cell else re.sub(r"(?<=\d),(?=\d)", ".", cell)
    if not NUMBER.fullmatch(cell):
        return None
    return value if math.isfinite(value := float(cell)) else None
