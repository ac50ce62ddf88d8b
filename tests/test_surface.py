import numpy as np
import pytest
import trimesh

from foretrace.objects import NO_BEVEL, Box, Cylinder, MeshObject, Prism, sample_prism
from foretrace.objects.surface import faces_of, triangles_of

ELL = [[0, 0], [0.1, 0], [0.1, 0.04], [0.04, 0.04], [0.04, 0.1], [0, 0.1]]
CONE = trimesh.creation.cone(0.04, 0.06)
OBJECTS = {
    "triangle": sample_prism(np.random.default_rng(0), 3),
    "ten corners": sample_prism(np.random.default_rng(1), 10),
    "not convex": Prism(ELL),
    "sharp rim": Prism(ELL, 0.03, NO_BEVEL),
    "box": Box(0.08, 0.05, 0.03),
    "mesh": MeshObject(CONE.vertices, CONE.faces),
}


@pytest.mark.parametrize("name", OBJECTS)
def test_triangles_close_around_the_object(name):
    obj = OBJECTS[name]
    vertices, triangles = triangles_of(obj)
    mesh = trimesh.Trimesh(vertices, triangles)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(obj.mass_properties(1.0).mass, rel=1e-6)
    np.testing.assert_allclose(mesh.bounds[1, 2], obj.height)


def test_a_cylinder_has_its_own_volume_but_for_the_facets():
    cylinder = Cylinder(0.03, 0.1)
    mesh = trimesh.Trimesh(*triangles_of(cylinder))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(cylinder.mass_properties(1.0).mass, rel=0.01)


@pytest.mark.parametrize("name", OBJECTS)
def test_polygons_and_triangles_cover_one_surface(name):
    obj = OBJECTS[name]
    vertices, triangles = triangles_of(obj)
    area = 0.0
    for face in faces_of(obj):
        area += np.linalg.norm(np.cross(face, np.roll(face, -1, axis=0)).sum(axis=0)) / 2
    assert area == pytest.approx(trimesh.Trimesh(vertices, triangles).area, rel=1e-9)
