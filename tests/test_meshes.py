import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from foretrace.actions import LeverUp
from foretrace.errors import ShapeError
from foretrace.geometry import polygon_area
from foretrace.objects import (
    NO_BEVEL,
    Bevel,
    Box,
    MeshObject,
    Prism,
    sample_prism,
)
from foretrace.objects.model import fitting_bevel
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up

L_SHAPE = np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.06], [0.06, 0.06], [0.06, 0.2], [0.0, 0.2]])


def mesh_object(mesh: trimesh.Trimesh, **options) -> MeshObject:
    return MeshObject(np.array(mesh.vertices), np.array(mesh.faces), **options)


def test_mesh_is_set_on_the_table_around_its_centre_of_mass():
    box = trimesh.creation.box((0.2, 0.1, 0.06))
    box.apply_translation([3.0, -2.0, 7.0])
    obj = mesh_object(box)
    properties = obj.mass_properties(1000.0)
    np.testing.assert_allclose(properties.com, [0.0, 0.0, 0.03], atol=1e-12)
    assert properties.mass == pytest.approx(1.2)
    assert obj.height == pytest.approx(0.06)
    np.testing.assert_allclose(obj.corners.max(axis=0), [0.1, 0.05])
    assert polygon_area(obj.corners) == pytest.approx(0.02)
    assert len(obj.corners) == 4


def test_convex_mesh_is_one_bevelled_piece():
    obj = mesh_object(trimesh.creation.box((0.2, 0.1, 0.06)), bevel=Bevel(0.005, 0.005))
    (piece,) = obj.convex_pieces()
    np.testing.assert_allclose(np.ptp(piece[piece[:, 2] < 1e-9], axis=0), [0.19, 0.09, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.ptp(piece[piece[:, 2] > 0.0049], axis=0), [0.2, 0.1, 0.055], atol=1e-9)
    sharp = mesh_object(trimesh.creation.box((0.2, 0.1, 0.06)), bevel=NO_BEVEL)
    assert ConvexHull(sharp.convex_pieces()[0]).volume == pytest.approx(0.2 * 0.1 * 0.06)


def test_mesh_and_prism_bevel_alike():
    prism = sample_prism(np.random.default_rng(1), 6)
    body = trimesh.creation.extrude_polygon(shapely.Polygon(prism.corners), prism.height)
    volume = ConvexHull(mesh_object(body).convex_pieces()[0]).volume
    assert volume == pytest.approx(prism.mass_properties(1.0).mass, rel=1e-6)
    support = mesh_object(body).support_corners + body.center_mass[:2]
    for corner in prism.support_corners:
        assert np.linalg.norm(support - corner, axis=1).min() < 1e-6


@settings(max_examples=60, deadline=None)
@given(
    size=st.tuples(st.integers(20, 300), st.integers(20, 300), st.integers(2, 100)),
    turn=st.sampled_from([0.0, np.pi / 2, 0.3, 2.5]),
    shift=st.tuples(*[st.integers(-500, 500)] * 3),
)
def test_box_in_millimetres_is_the_prism(size, turn, shift):
    box = trimesh.creation.box(size)
    box.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
    box.apply_translation(shift)
    vertices = np.asarray(box.vertices, dtype=np.float32).astype(float) * 0.001  # as an STL file keeps them
    obj = MeshObject(vertices, np.array(box.faces))
    length, width, height = np.array(size) * 0.001
    corners = np.array([[0, 0], [length, 0], [length, width], [0, width]])
    prism = Prism(corners, height, fitting_bevel(corners, height))
    (piece,) = obj.convex_pieces()
    assert ConvexHull(piece).volume == pytest.approx(prism.mass_properties(1.0).mass, rel=1e-4)
    assert obj.mass_properties(1.0).mass == pytest.approx(length * width * height, rel=1e-4)


def test_mesh_that_is_not_convex_is_decomposed_the_same_way_each_time():
    body = trimesh.creation.extrude_polygon(shapely.Polygon(L_SHAPE), 0.03)
    obj = mesh_object(body, bevel=NO_BEVEL)
    pieces = obj.convex_pieces()
    assert 2 <= len(pieces) <= 5
    assert sum(ConvexHull(piece).volume for piece in pieces) == pytest.approx(body.volume, rel=0.01)
    again = mesh_object(body, bevel=NO_BEVEL).convex_pieces()
    assert all(np.array_equal(a, b) for a, b in zip(pieces, again, strict=True))
    # The notch stays open.
    probe = np.array([0.15, 0.15, 0.015]) - [*body.center_mass[:2], 0.0]
    for piece in pieces:
        hull = ConvexHull(piece)
        assert (hull.equations[:, :3] @ probe + hull.equations[:, 3]).max() > 0.01


def test_ball_stands_on_a_point():
    obj = mesh_object(trimesh.creation.icosphere(subdivisions=3, radius=0.05))
    assert np.linalg.norm(obj.support_corners, axis=1).max() < 0.01
    assert obj.height_at(np.array([[0.0, 0.0], [0.06, 0.0]])).tolist() == pytest.approx([0.1, 0.0])


def test_bevel_of_a_mesh_fits_it():
    plate = mesh_object(trimesh.creation.box((0.1, 0.1, 0.002)))
    assert plate.bevel.height == pytest.approx(0.001)
    with pytest.raises(ShapeError, match=r"bevel of 0\.004 m x 0\.003 m on a mesh of height 0\.002 m"):
        mesh_object(trimesh.creation.box((0.1, 0.1, 0.002)), bevel=Bevel(0.004, 0.003))
    with pytest.raises(ShapeError, match=r"inner radius 0\.01 m"):
        mesh_object(trimesh.creation.box((0.1, 0.02, 0.02)), bevel=Bevel(0.02, 0.003))


@pytest.mark.parametrize("suffix", [".stl", ".obj"])
def test_files_are_loaded_in_their_unit(tmp_path, suffix):
    path = tmp_path / f"part{suffix}"
    trimesh.creation.cylinder(radius=40.0, height=50.0).export(path)
    obj = MeshObject.load(path, scale=0.001)
    assert obj.height == pytest.approx(0.05)
    assert obj.mass_properties(1000.0).mass == pytest.approx(np.pi * 0.04**2 * 0.05 * 1000, rel=0.02)


def test_unreadable_files_are_refused(tmp_path):
    with pytest.raises(ShapeError, match=r"missing\.stl does not exist"):
        MeshObject.load(tmp_path / "missing.stl")
    for name, content in (("broken.stl", b"solid nothing"), ("odd.xyz1", b"hello"), ("empty.obj", b"")):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(ShapeError, match=name):
            MeshObject.load(path)


def test_open_meshes_are_refused(tmp_path):
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    with pytest.raises(ShapeError, match=r"not watertight \(3 edges"):
        MeshObject(np.array(box.vertices), np.array(box.faces)[1:])
    path = tmp_path / "open.stl"
    trimesh.Trimesh(box.vertices, box.faces[1:]).export(path)
    with pytest.raises(ShapeError, match=r"open\.stl: .*not watertight"):
        MeshObject.load(path)


BOX = trimesh.creation.box((0.1, 0.1, 0.1))
BAD_MESHES = {
    "size 100 m": (BOX.vertices * 1000, BOX.faces),
    "size 0.001 m": (BOX.vertices * 0.01, BOX.faces),
    "height 0 m": (BOX.vertices * [1, 1, 0], BOX.faces),
    "vertices .* not finite, nan at .0, ": (
        np.where(np.indices((8, 3))[0] == 0, np.nan, BOX.vertices),
        BOX.faces,
    ),
    "faces name vertices 0 to 107": (BOX.vertices, BOX.faces + np.where(BOX.faces == 7, 100, 0)),
    "empty": (np.zeros((0, 3)), np.zeros((0, 3), dtype=int)),
    "must be numbers in the shape": (BOX.vertices[:, :2], BOX.faces),
}


@pytest.mark.parametrize("fault", BAD_MESHES)
def test_bad_meshes_are_refused(fault):
    vertices, faces = BAD_MESHES[fault]
    with pytest.raises(ShapeError, match=fault):
        MeshObject(np.array(vertices), np.array(faces))


def test_inside_out_mesh_is_turned():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    obj = MeshObject(np.array(box.vertices), np.array(box.faces)[:, ::-1])
    assert obj.mass_properties(1000.0).mass == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [0.001, 0.01, 1.0])
@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_a_box_is_levered_as_mesh_prism_and_box(tmp_path, unit, turn):
    size = (0.12, 0.08, 0.02)
    mesh = trimesh.creation.box(np.array(size) / unit)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
    mesh.export(tmp_path / "box.stl")
    obj = MeshObject.load(tmp_path / "box.stl", scale=unit)
    prism = Prism(obj.corners, obj.height, obj.bevel)
    box = Box(*size)
    short = [int(np.argmin(np.linalg.norm(np.diff(o.corners, axis=0), axis=1))) for o in (obj, prism, box)]
    effects = [
        simulate_lever_up(o, LeverUp.at_edge(o, edge), SimulationConfig(embodiment="tool")).effect
        for o, edge in zip((obj, prism, box), short, strict=True)
    ]
    assert len({str(effect.outcome) for effect in effects}) == 1
    heights = [effect.com_trajectory[:, 2].max() for effect in effects]
    np.testing.assert_allclose(heights, heights[0], atol=5e-4)
