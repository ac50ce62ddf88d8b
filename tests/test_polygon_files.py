"""Outlines in files as spreadsheets, editors and GIS programs write them: read as meant, or refused with the place."""

import json

import numpy as np
import pytest

from foretrace.errors import ShapeError
from foretrace.objects import Prism
from foretrace.objects.polygon_files import read_polygon
from foretrace.objects.shape_files import read_shape

CORNERS = [[0.11, 0.0], [0.03, 0.07], [-0.06, 0.05], [-0.02, -0.09]]
RING = [*CORNERS, CORNERS[0]]


def rows(form, sep="\n", unit=1.0):
    return sep.join(
        form.format(round(x / unit, 9), round(y / unit, 9), k) for k, (x, y) in enumerate(CORNERS)
    )


def geojson(ring=RING, kind="Polygon", **more):
    return {"type": kind, "coordinates": [ring], **more}


def feature(geometry):
    return {"type": "Feature", "properties": {"name": "box"}, "geometry": geometry}


POLYGON = geojson()
WKT = ", ".join(f"{x} {y}" for x, y in RING)
READ = {
    "blanks": rows("{} {}"),
    "commas": rows("{},{}"),
    "commas and blanks": rows("  {} , {} "),
    "semicolons": rows("{};{}"),
    "commas or blanks": "0.11 0\n0.03, 0.07\n-0.06,0.05\n-0.02\t-0.09",
    "tabs": rows("{}\t{}"),
    "Windows, with a mark": "\ufeff" + rows("{},{}", "\r\n"),
    "carriage returns": rows("{},{}", "\r"),
    "decimal commas, semicolons": rows("{};{}").replace(".", ","),
    "decimal commas, tabs": rows("{}\t{}").replace(".", ","),
    "decimal commas, blanks": rows("{} {}").replace(".", ","),
    "decimal commas, quotes": rows('"{}","{}"').replace(".", ","),
    "quotes": rows("'{}' \"{}\""),
    "headings": "x,y\n" + rows("{},{}"),
    "headings with blanks": "x [m]  y [m]\n" + rows("{} {}"),
    "headings of blanks": "x y\n" + rows("{} {}").replace(".", ",") + "\n0,11 0",
    "headings of blanks, commas": "x y\n" + rows("{},{}"),
    "a title and headings": "Outline of a box\n\nX;Y;Z\n" + rows("{};{};0.5"),
    "headings in another order": "id\ty\tx\n" + rows("{2}\t{1}\t{0}").replace("0\t0.0\t", "a0\t0.0\t", 1),
    "an index": ",x,y\n" + rows("{2},{0},{1}"),
    "millimetres by name": "x_mm;y_mm\n" + rows("{};{}", unit=0.001),
    "centimetres in a line": "x,y\ncm,cm\n" + rows("{},{}", unit=0.01),
    "the same z": rows("{} {} 0.02"),
    "trailing commas": rows("{},{},,") + "\n,,\n\n",
    "comments": "# corners\n% of a box\n" + rows("{} {} // here"),
    "exponents and signs": rows("{:e} {:+E}"),
    "a typographic minus": rows("{} {}").replace("-", "\u2212"),
    "closed": rows("{} {}") + "\n" + "0.11 0",
    "nearly closed": rows("{} {}") + "\n" + "0.1100001 0",
    "a corner twice": "0.11 0\n" + rows("{} {}"),
    "a list": json.dumps(CORNERS),
    "tuples": str([tuple(corner) for corner in RING]),
    "an array": str(np.array(CORNERS)),
    "GeoJSON": json.dumps(POLYGON, indent=1),
    "a feature": json.dumps(feature(POLYGON)),
    "a collection of one": json.dumps({"type": "FeatureCollection", "features": [feature(POLYGON)]}),
    "one of many": json.dumps(geojson([RING], "MultiPolygon")),
    "level GeoJSON": json.dumps(geojson([[*corner, 0.5] for corner in RING])),
    "WKT": f"POLYGON (({WKT}))",
    "EWKT": f"srid=25832;multipolygon((({WKT})))",
}
REFUSED = {
    "holds no corners": "# nothing\n\n",
    "line 2, column 2: '0.O7' is no number": rows("{} {}").replace("0.07", "0.O7"),
    "line 1, column 1: 'O.11' is no number": rows("{} {}").replace("0.11", "O.11").replace("0.0\n", "O\n"),
    "line 3, column 1: 'nan' is no number": rows("{};{}").replace("-0.06", "nan"),
    "line 5, column 2: '1e999' is no number": "x y\n" + rows("{} {}").replace("-0.09", "1e999"),
    "line 1, column 1: '1.100,5' is no number": "1.100,5;2\n3;4\n5;6",
    "line 1, column 2: '0,02' is no number": "0.05;0,02\n0.01;0,05\n-0.1;0.2",
    "line 3: '-0.06' has 1 entries": rows("{} {}").replace("-0.06 0.05", "-0.06"),
    "line 1: '1 2 3 4 5' has 5 entries": "1 2 3 4 5\n6 7 8 9 10",
    "line 1: '0,05,0,02' has 4 entries: columns parted by \";\"": "0,05,0,02\n0,01,0,05\n0,1,0,2",
    "line 2: '9,0,0,0' has 4 entries: columns parted by \";\"": "x,y\n9,0,0,0\n2,0,8,0\n-7,0,5,0\n",
    "polygon with 1 corners": "1 2",
    "line 2, column 3: z is not 3 as above": "1 2 3\n4 5 6\n7 8 3",
    "170 across, which looks like millimetres: give --scale 0.001": rows("{} {}", unit=0.001),
    "17 across, which looks like centimetres or inches: give --scale 0.01 or 0.0254": rows("{} {}", unit=0.01),
    "units cm and mm": "x_cm y_mm\n" + rows("{} {}"),
    "has a column lat": "lat,lon\n" + rows("{},{}"),
    "they look like degrees": json.dumps(geojson([[8.5 + x * 1e-5, 47 + y * 1e-5] for x, y in RING])),
    "0.17 across, 47.01 from the origin: they look": json.dumps(geojson([[8.5 + x, 47 + y] for x, y in RING])),
    "holds 2 geometries": json.dumps({"type": "GeometryCollection", "geometries": [POLYGON, POLYGON]}),
    "holds a LineString": json.dumps({"type": "LineString", "coordinates": RING}),
    "holds a Point": "POINT (1 2)",
    "with a hole": json.dumps({"type": "Polygon", "coordinates": [RING, [[0, 0], [0.01, 0], [0, 0.01], [0, 0]]]}),
    "that is not level": json.dumps(geojson([[x, y, x] for x, y in RING])),
    "an empty polygon": "POLYGON EMPTY",
    "do not form a closed": json.dumps(geojson(CORNERS)),
    "line 1 column 42": json.dumps(POLYGON)[:41],
    "without a type of geometry": json.dumps({"kind": "box"}),
    "maximum recursion": '{"type":' + 100_000 * "[",
    "read as WKT": "POLYGON ((0 0, 1 1",
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_corners_are_read_as_they_are_meant(name, tmp_path):
    file = tmp_path / "outline.txt"
    file.write_bytes(READ[name].encode())
    np.testing.assert_allclose(Prism(read_polygon(file)).corners, CORNERS, rtol=0, atol=2e-7)


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_be_read_is_named(message, tmp_path):
    file = tmp_path / "outline.txt"
    file.write_text(REFUSED[message], encoding="utf-8")
    with pytest.raises(ShapeError) as caught:
        Prism(read_polygon(file))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_the_scale_of_corners(tmp_path):
    file = tmp_path / "outline.csv"
    file.write_text("x;y\n" + rows("{};{}", unit=0.001))
    np.testing.assert_allclose(read_polygon(file, 0.001), CORNERS, atol=1e-12)
    with pytest.raises(ShapeError, match=r"scale of -1\.0 metres per unit"):
        read_polygon(file, -1.0)


def test_letters_of_an_old_encoding_in_a_comment(tmp_path):
    file = tmp_path / "outline.txt"
    file.write_bytes(("# Größe\n" + rows("{} {}")).encode("latin-1"))
    np.testing.assert_array_equal(read_polygon(file), CORNERS)


def test_geojson_as_an_object_of_a_recording(tmp_path):
    for name in ("box.geojson", "box.json"):
        (tmp_path / name).write_text(json.dumps(POLYGON))
        np.testing.assert_array_equal(read_shape(tmp_path / name).corners, CORNERS)
