"""Files of several bodies, and surfaces that bound none."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from manifold3d import OpType
from scipy.spatial import ConvexHull

from foretrace.errors import ShapeError
from foretrace.objects import NO_BEVEL, MeshObject, object_from_dict
from foretrace.objects.decomposition import as_solid
from foretrace.objects.mesh_bodies import one_solid


def box(size, at=(0.0, 0.0, 0.0), inwards=False) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(at)
    if inwards:
        mesh.invert()
    return mesh


def together(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh = trimesh.util.concatenate(meshes)
    assert isinstance(mesh, trimesh.Trimesh)
    mesh.merge_vertices()
    return mesh


def flipped(mesh: trimesh.Trimesh, faces) -> trimesh.Trimesh:
    turned = mesh.faces.copy()
    turned[faces] = turned[faces][:, ::-1]
    return trimesh.Trimesh(mesh.vertices, turned, process=False)


def crossed() -> trimesh.Trimesh:
    mesh = box((0.1, 0.1, 0.1))
    vertices = mesh.vertices.copy()
    vertices[7] = [-0.09, -0.02, 0.0]
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


CUBE = box((0.1, 0.1, 0.1))
SMALL = (0.1, 0.04, 0.04)
ONE_BODY = {
    "overlap": (together(CUBE, box(SMALL, (0.07, 0, 0))), 0.001 + 0.07 * 0.04**2),
    "same face": (together(CUBE, box((0.1, 0.1, 0.1), (0.1, 0, 0))), 0.002),
    "smaller face": (together(CUBE, box(SMALL, (0.1, 0, 0))), 0.00116),
    "nested": (together(CUBE, box((0.04, 0.04, 0.04))), 0.001),
    "twice": (together(CUBE, CUBE), 0.001),
    "cavity": (together(CUBE, box((0.04, 0.04, 0.04), inwards=True)), 0.001 - 0.04**3),
    "inside out": (together(box((0.1, 0.1, 0.1), inwards=True), box((0.04, 0.04, 0.04))), 0.001 - 0.04**3),
    "one inside out": (together(CUBE, box(SMALL, (0.07, 0, 0), inwards=True)), 0.001 + 0.07 * 0.04**2),
    "one of two alike inside out": (
        together(CUBE, box((0.1, 0.1, 0.1), (0.07, 0, 0), inwards=True)),
        0.0017,
    ),
    "piercing a cavity": (
        together(CUBE, box((0.06, 0.06, 0.06), inwards=True), box((0.02, 0.02, 0.1))),
        0.001 - 0.06**3 + 0.06 * 0.02**2,
    ),
    "debris": (together(CUBE, box((0.002, 0.002, 0.002), (0.2, 0.1, 0))), 0.001),
    "one face turned": (flipped(CUBE, [3]), 0.001),
    "thin faces": (trimesh.Trimesh(CUBE.vertices, [*CUBE.faces.tolist(), [0, 0, 1]], process=False), 0.001),
}
APART = {
    "apart": (together(CUBE, box(SMALL, (0.2, 0, 0))), "holds 2 bodies that lie apart"),
    "three": (
        together(CUBE, box(SMALL, (0.2, 0, 0)), box(SMALL, (0, 0.2, 0))),
        "holds 3 bodies that lie apart",
    ),
    "lid above": (together(box((0.1, 0.1, 0.02)), box((0.1, 0.1, 0.005), (0, 0, 0.04))), "lie apart"),
    "edge": (together(CUBE, box((0.1, 0.1, 0.1), (0.1, 0.1, 0))), "touch only along edges or in corners"),
    "corner": (together(CUBE, box((0.1, 0.1, 0.1), (0.1, 0.1, 0.1))), "touch only along edges or in corners"),
    "loose in a cavity": (
        together(CUBE, box((0.06, 0.06, 0.06), inwards=True), box((0.02, 0.02, 0.02))),
        "lie apart",
    ),
    "crossed": (crossed(), r"crosses itself: \d+ % of its volume"),
    "open": (trimesh.Trimesh(CUBE.vertices, CUBE.faces[1:], process=False), "not watertight"),
}


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.15])
@pytest.mark.parametrize("name", ONE_BODY)
def test_one_body_has_its_volume(name, angle):
    mesh, volume = ONE_BODY[name]
    rotation = trimesh.transformations.rotation_matrix(angle, [0.3, 1, 0.2])
    turned = trimesh.transform_points(mesh.vertices, rotation).astype(np.float32).astype(float)
    vertices, faces = one_solid(turned, np.array(mesh.faces))
    solid = trimesh.Trimesh(vertices, faces, process=False)
    assert solid.volume == pytest.approx(volume, rel=1e-5)
    # A stored object comes back as it was.
    again = one_solid(vertices, faces)
    np.testing.assert_array_equal(again[0], vertices)
    np.testing.assert_array_equal(again[1], faces)


@pytest.mark.parametrize("name", APART)
def test_what_is_no_body_is_refused(name):
    mesh, message = APART[name]
    with pytest.raises(ShapeError, match=message):
        one_solid(np.array(mesh.vertices), np.array(mesh.faces))


def test_bodies_that_overlap_have_one_mass_centre_and_outline():
    mesh, _ = ONE_BODY["overlap"]
    obj = MeshObject(mesh.vertices, mesh.faces)
    mass = obj.mass_properties(1000.0)
    assert mass.mass == pytest.approx(1.112)
    shift = (0.112 * 0.085) / 1.112  # the part beyond the cube reaches from 5 to 12 cm
    assert obj.corners[:, 0].max() == pytest.approx(0.12 - shift)
    assert len(obj.corners) == 8
    copy = object_from_dict(obj.to_dict())
    assert isinstance(copy, MeshObject)
    np.testing.assert_array_equal(copy.vertices, obj.vertices)


def test_a_hollow_body_collides_as_a_hollow_body():
    mesh, volume = ONE_BODY["cavity"]
    pieces = MeshObject(mesh.vertices, mesh.faces, bevel=NO_BEVEL).convex_pieces()
    assert sum(ConvexHull(piece).volume for piece in pieces) == pytest.approx(volume, rel=0.005)


@given(st.integers(0, 2**32 - 1))
def test_boxes_in_a_row_are_one_body_of_their_union(seed):
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(0.03, 0.1, (3, 3))
    places = np.cumsum([np.zeros(3), *rng.uniform(-0.02, 0.02, (2, 3))], axis=0)
    boxes = [box(size, at) for size, at in zip(sizes, places, strict=True)]
    solids = [as_solid(each.vertices, each.faces) for each in boxes]
    truth = type(solids[0]).batch_boolean(solids, OpType.Add).volume()
    mesh = together(*boxes)
    vertices, faces = one_solid(np.array(mesh.vertices), np.array(mesh.faces))
    assert trimesh.Trimesh(vertices, faces, process=False).volume == pytest.approx(truth, rel=1e-9)
