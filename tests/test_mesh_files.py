"""Mesh files as CAD programs and scanners write them: formats, units, precision, polygons, faults."""

import warnings

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from trimesh.exchange import ply, stl

from foretrace.cli import main
from foretrace.errors import ShapeError
from foretrace.objects import MeshObject, Prism
from foretrace.objects.shape_files import read_shape

SIZE = np.array([120.0, 80.0, 20.0])
BOX = trimesh.creation.box(SIZE)
L_SHAPE = [(0, 0), (100, 0), (100, 40), (40, 40), (40, 100), (0, 100)]


def with_solid_header(mesh: trimesh.Trimesh) -> bytes:
    return b"solid " + stl.export_stl(mesh)[6:]


def obj_text(mesh: trimesh.Trimesh) -> str:
    """An OBJ file in two groups, with materials that are not there."""
    lines = ["mtllib missing.mtl", *(f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist())]
    for name, faces in zip(("one", "two"), np.array_split(mesh.faces + 1, 2), strict=True):
        lines += [f"g {name}", f"usemtl {name}", *(f"f {a} {b} {c}" for a, b, c in faces)]
    return "\n".join(lines)


WRITERS = {
    "binary.stl": stl.export_stl,
    "ascii.stl": stl.export_stl_ascii,
    "solid.STL": with_solid_header,
    "groups.obj": obj_text,
    "binary.ply": ply.export_ply,
    "ascii.ply": lambda mesh: ply.export_ply(mesh, encoding="ascii"),
    "off.off": lambda mesh: mesh.export(file_type="off"),
}


def write(folder, name: str, mesh: trimesh.Trimesh):
    content = WRITERS[name](mesh)
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@settings(max_examples=25)
@given(
    name=st.sampled_from(sorted(WRITERS)),
    unit=st.sampled_from([0.001, 0.01, 0.0254, 1.0]),
    turn=st.sampled_from([0.0, 0.3, 1.1, 2.9, 5.3]),
    away=st.sampled_from([0.0, 0.3, 20.0, 5000.0]),
)
def test_a_box_is_the_same_in_every_format_unit_and_place(tmp_path_factory, name, unit, turn, away):
    mesh = BOX.copy()
    mesh.apply_scale(0.001 / unit)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
    mesh.apply_translation(np.array([1.0, -0.7, 0.2]) * away / unit)
    path = write(tmp_path_factory.mktemp("box"), name, mesh)
    single = name.endswith((".STL", ".ply")) or name == "binary.stl"
    whole = np.abs(mesh.vertices - np.round(mesh.vertices)).max() < 1e-6  # such numbers keep their digits
    if away == 5000.0 and single and not whole:
        with pytest.raises(ShapeError, match="units from the origin, where its coordinates are rounded to"):
            MeshObject.load(path, scale=unit)
        return
    obj = MeshObject.load(path, scale=unit)
    rtol = 1e-3 if single else 2e-4  # 20 m away, single precision keeps 2 micrometres
    mass = obj.mass_properties(1000.0)
    length, width, height = SIZE / 1000
    assert mass.mass == pytest.approx(0.192, rel=rtol)
    np.testing.assert_allclose(mass.com, [0, 0, 0.01], atol=1e-5)
    inertia = 0.192 / 12 * np.array([width**2 + height**2, length**2 + height**2, length**2 + width**2])
    np.testing.assert_allclose(np.linalg.eigvalsh(mass.inertia), np.sort(inertia), rtol=4 * rtol)
    assert trimesh.convex.convex_hull(np.concatenate(obj.convex_pieces())).volume == pytest.approx(
        Prism(obj.corners, obj.height, obj.bevel).mass_properties(1.0).mass, rel=rtol
    )


@pytest.mark.parametrize("first", range(6))
def test_polygons_that_are_not_convex_are_cut_right(tmp_path, first):
    ring = L_SHAPE[first:] + L_SHAPE[:first]
    corners = [f"v {x} {y} {z}" for z in (0, 30) for x, y in ring]
    walls = [f"f {k + 1} {(k + 1) % 6 + 1} {(k + 1) % 6 + 7} {k + 7}" for k in range(6)]
    path = tmp_path / "ell.obj"
    path.write_text("\n".join([*corners, "f 6 5 4 3 2 1", "f 7 8 9 10 11 12", *walls]))
    obj = MeshObject.load(path, scale=0.001)
    assert len(obj.corners) == 6
    assert Prism(obj.corners).mass_properties(1000.0).mass < 0.13
    assert len(obj.convex_pieces()) == 2


BAD_FILES = {
    ".glb": (b"glTF", r"holds a scene.*: export it as STL"),
    ".3mf": (b"PK", r"holds a print job: export it as STL"),
    ".step": (b"ISO-10303-21;", r"holds a CAD model: export it as STL"),
    ".xyz1": (b"hello", r"ends in '\.xyz1': export it as STL"),
    ".stl": (b"", r"holds no triangles"),
    "-zero.stl": (bytes(84), r"holds no triangles"),
    "-empty.stl": (b"solid a\nendsolid a\n", r"holds no triangles"),
    "-short.stl": (stl.export_stl(BOX)[:-60], r"holds no triangles|cannot be read"),
    "-nan.obj": (obj_text(BOX).replace("-60.0", "nan", 1).encode(), r"1 of its vertices are not finite"),
    "-far.obj": (obj_text(BOX).replace("-60.0", "1e30", 1).encode(), r"reaches 1e\+30 units"),
    "-plane.stl": (
        stl.export_stl(trimesh.Trimesh(0.013 * BOX.vertices, BOX.faces[:1])),
        r"not watertight",
    ),
    "-flat.stl": (
        stl.export_stl(trimesh.Trimesh(BOX.vertices * [1, 1, 0], BOX.faces)),
        r"encloses no volume",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_mesh_files_are_refused(tmp_path, name):
    content, message = BAD_FILES[name]
    path = tmp_path / f"part{name}"
    path.write_bytes(content)
    with pytest.raises(ShapeError, match=message) as caught:
        MeshObject.load(path, scale=0.001)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("size", "scale", "message"),
    [
        (
            SIZE,
            1.0,
            r"mesh is 120 x 80 x 20 m: looks like millimetres: give --scale 0\.001 \(in Python scale=0\.001\)",
        ),
        ((12, 8, 2), 1.0, r"looks like centimetres or inches: give --scale 0\.01 or 0\.0254"),
        ((0.12, 0.08, 0.02), 0.001, r"looks like metres: give --scale 1 "),
        ((1e5, 1e5, 1e5), 1.0, r"objects of 0\.01 to 1\.0 m are expected; give its unit as --scale"),
        (SIZE, 0.0, r"scale is 0\.0: give the metres per unit"),
    ],
)
def test_the_unit_is_guessed(tmp_path, size, scale, message):
    path = write(tmp_path, "binary.stl", trimesh.creation.box(size))
    with pytest.raises(ShapeError, match=message):
        MeshObject.load(path, scale)


def test_an_unusual_size_is_pointed_out(tmp_path):
    path = write(tmp_path, "binary.stl", trimesh.creation.box((12, 8, 2)))
    with pytest.warns(
        UserWarning, match=r"mesh is 0\.012 x 0\.008 x 0\.002 m at a scale of 0\.001: check its unit"
    ):
        MeshObject.load(path, 0.001)


def turned(mesh: trimesh.Trimesh, angle: float, axis) -> trimesh.Trimesh:
    mesh = mesh.copy()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(angle, axis))
    return mesh


LYING = {
    "box": (BOX, 20.0),
    "torus": (trimesh.creation.torus(50, 20, 32, 24), 40.0),
    "cone": (trimesh.creation.cone(40, 60), 60.0),
}


@pytest.mark.parametrize("name", LYING)
@pytest.mark.parametrize(("angle", "axis"), [(0.0, [0, 0, 1]), (1.0, [1, 0.3, 0]), (np.pi, [1, 0, 0])])
def test_rest_puts_a_mesh_down(tmp_path, name, angle, axis):
    mesh, height = LYING[name]
    path = write(tmp_path, "binary.stl", turned(mesh, angle, axis))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        obj = MeshObject.load(path, scale=0.001, rest=True)
    assert obj.height == pytest.approx(height / 1000, rel=1e-4)
    assert obj.stands
    again = MeshObject.load(path, scale=0.001, rest=True)
    np.testing.assert_array_equal(obj.vertices, again.vertices)


def test_rest_leaves_what_lies_right_as_it_is(tmp_path):
    path = write(tmp_path, "binary.stl", BOX)
    np.testing.assert_array_equal(
        MeshObject.load(path, scale=0.001).vertices, MeshObject.load(path, scale=0.001, rest=True).vertices
    )


@pytest.mark.parametrize("name", ["torus", "cone"])
def test_a_mesh_that_topples_is_pointed_out(tmp_path, name):
    path = write(tmp_path, "binary.stl", turned(LYING[name][0], np.pi if name == "cone" else 1.0, [1, 0, 0]))
    with pytest.warns(UserWarning, match="topples as it stands: turn it, or give --rest"):
        MeshObject.load(path, scale=0.001)


@pytest.mark.parametrize("mesh", [trimesh.creation.icosphere(3, 40), trimesh.creation.box((20, 80, 120))])
def test_balls_and_tall_boxes_stand(tmp_path, mesh):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        MeshObject.load(write(tmp_path, "binary.stl", mesh), scale=0.001)


def test_scale_and_rest_reach_the_mesh_of_an_import(tmp_path):
    path = write(tmp_path, "binary.stl", turned(BOX, np.pi / 2, [1, 0, 0]))
    assert read_shape(path, scale=0.001).height == pytest.approx(0.08)
    assert read_shape(path, scale=0.001, rest=True).height == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("import film --edge 0 --out r --scale 0.001", "--scale and --rest go with --object"),
        ("predict --polygon a.txt --edge 0 --rest", "--rest goes with --mesh"),
    ],
)
def test_options_of_meshes_go_with_meshes(capsys, command, message):
    assert main(command.split()) == 2
    assert message in capsys.readouterr().err
