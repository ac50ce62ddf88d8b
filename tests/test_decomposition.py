"""Convex pieces of meshes: they have the mesh's volume, do not overlap, are few, and are kept."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from manifold3d import CrossSection, Manifold, OpType
from scipy.spatial import ConvexHull

from foretrace.errors import ShapeError
from foretrace.objects import NO_BEVEL, MeshObject, Prism, decomposition
from foretrace.objects.decomposition import as_solid, cached_pieces, decompose, surface_of


def extruded(outline: shapely.Geometry, height: float) -> Manifold:
    mesh = trimesh.creation.extrude_polygon(outline, height)
    return as_solid(mesh.vertices, mesh.faces)


def bracket() -> Manifold:
    body = Manifold.cube((0.1, 0.06, 0.006)) + Manifold.cube((0.006, 0.06, 0.06))
    for x, y in ((0.03, 0.015), (0.03, 0.045), (0.08, 0.03)):
        body -= Manifold.cylinder(0.02, 0.004, 0.004, 24, True).translate((x, y, 0.003))
    return body - Manifold.cylinder(0.03, 0.006, 0.006, 24, True).rotate((0, 90, 0)).translate(
        (0, 0.03, 0.04)
    )


ELL = shapely.Polygon([(0, 0), (0.1, 0), (0.1, 0.04), (0.04, 0.04), (0.04, 0.1), (0, 0.1)])
DISC = shapely.Point(0, 0).buffer(0.06)


def shape(name: str) -> tuple[Manifold, int]:
    """A solid, and the most pieces that it may have."""
    return SHAPES[name]()


SHAPES = {
    "L": lambda: (extruded(ELL, 0.03), 2),
    "U": lambda: (
        extruded(shapely.box(0, 0, 0.12, 0.08).difference(shapely.box(0.02, 0.02, 0.1, 0.09)), 0.02),
        3,
    ),
    "ring": lambda: (extruded(DISC.difference(shapely.Point(0, 0).buffer(0.04)), 0.02), 60),
    "bracket": lambda: (bracket(), 60),
    "cup": lambda: (
        Manifold.cylinder(0.09, 0.04, 0.04, 48)
        - Manifold.cylinder(0.1, 0.036, 0.036, 48).translate((0, 0, 0.004)),
        70,
    ),
    "torus": lambda: (CrossSection.circle(0.02, 24).translate((0.05, 0)).revolve(32), 40),
    "hollow": lambda: (
        Manifold.cube((0.1, 0.08, 0.05)) - Manifold.cube((0.08, 0.06, 0.03)).translate((0.01, 0.01, 0.01)),
        40,
    ),
    "step": lambda: (Manifold.cube((0.1, 0.08, 0.02)) + Manifold.cube((0.04, 0.08, 0.05)), 2),
}


@pytest.mark.parametrize("name", SHAPES)
def test_pieces_have_the_volume_of_the_mesh(name):
    solid, most = shape(name)
    pieces = decompose(solid)
    assert len(pieces) <= most
    hulls = [ConvexHull(piece) for piece in pieces]
    assert sum(hull.volume for hull in hulls) == pytest.approx(solid.volume(), rel=0.0025)
    vertices, faces = surface_of(solid)
    obj = MeshObject(vertices, faces, bevel=NO_BEVEL)
    # The pieces fill the mesh, and nothing else: their union less the mesh, and the mesh less their union, are small.
    union = Manifold.batch_boolean([Manifold.hull_points(piece) for piece in obj.convex_pieces()], OpType.Add)
    mesh = as_solid(obj.vertices, obj.faces)
    assert (union - mesh).volume() < 0.0025 * mesh.volume()
    assert (mesh - union).volume() < 0.001 * mesh.volume()


@pytest.mark.parametrize("name", ["L", "bracket"])
def test_a_bevelled_mesh_has_the_volume_of_the_prism_or_less(name):
    solid, _ = shape(name)
    obj = MeshObject(*surface_of(solid))
    volume = sum(ConvexHull(piece).volume for piece in obj.convex_pieces())
    assert 0.8 * solid.volume() < volume < solid.volume()


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(5, 12))
def test_outlines_that_are_not_convex_are_cut_exactly(seed, num_corners):
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * (np.arange(num_corners) + rng.uniform(0.0, 0.6, num_corners)) / num_corners
    radii = rng.uniform(0.03, 0.1, num_corners)
    prism = Prism(np.column_stack([radii * np.cos(angles), radii * np.sin(angles)]), 0.03, NO_BEVEL)
    mesh = trimesh.creation.extrude_polygon(shapely.Polygon(prism.corners), 0.03)
    obj = MeshObject(mesh.vertices, mesh.faces, bevel=NO_BEVEL)
    volume = sum(ConvexHull(piece).volume for piece in obj.convex_pieces())
    assert volume == pytest.approx(prism.mass_properties(1.0).mass, rel=0.0025)


def test_pieces_are_the_same_each_time():
    solid, _ = shape("bracket")
    for one, other in zip(decompose(solid), decompose(solid), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_volume_that_pieces_miss_is_refused(monkeypatch):
    monkeypatch.setattr(decomposition, "MOST_PIECES", 4)
    vertices, faces = surface_of(shape("cup")[0])
    with pytest.raises(
        ShapeError, match=r"4 convex pieces of the mesh miss its volume by \+\d.* %: thin curved walls"
    ):
        MeshObject(vertices * 1.01, faces).convex_pieces()


def test_a_mesh_too_fine_to_be_cut_is_refused(monkeypatch):
    monkeypatch.setattr(decomposition, "MOST_TRIANGLES", 50)
    with pytest.raises(ShapeError, match="too fine to be cut"):
        decompose(shape("torus")[0])


def test_pieces_are_kept_in_the_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    solid = surface_of(shape("L")[0])
    first = cached_pieces(*solid)
    (file,) = (tmp_path / "foretrace" / "pieces").iterdir()
    monkeypatch.setattr(decomposition, "decompose", lambda _: pytest.fail("cut again"))
    for one, other in zip(first, cached_pieces(*solid), strict=True):
        np.testing.assert_array_equal(one, other)
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    content = file.read_bytes()
    for damaged in (b"", content[:-100], content.replace(content[200:220], bytes(20)), b"PK" + bytes(500)):
        file.write_bytes(damaged)
        for one, other in zip(first, cached_pieces(*solid), strict=True):
            np.testing.assert_array_equal(one, other)
        assert file.read_bytes() == content


def test_no_cache_is_no_error(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert len(cached_pieces(*surface_of(shape("L")[0]))) == 2


def test_a_picture_cuts_nothing(monkeypatch):
    from foretrace.actions import LeverUp
    from foretrace.interactions.topdown import TopDownView
    from foretrace.pictures.scene import silhouette

    obj = MeshObject(*surface_of(shape("bracket")[0]))
    monkeypatch.setattr(decomposition, "decompose", lambda _: pytest.fail("cut"))
    action = LeverUp.at_edge(obj, 0)
    TopDownView.of(obj, action)
    rings = silhouette(obj, np.array([0.0, 0, 0, 1, 0, 0, 0]))
    low, high = np.concatenate(rings).min(axis=0), np.concatenate(rings).max(axis=0)
    np.testing.assert_allclose([low[1], high[1]], [0, obj.height], atol=1e-9)
    np.testing.assert_allclose(
        [low[0], high[0]], [obj.corners[:, 0].min(), obj.corners[:, 0].max()], atol=1e-6
    )
    assert obj.support_corners.shape == obj.corners.shape
    assert not obj.is_round


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_cutting_hears_ctrl_c_and_kill(number):
    code = (
        "from manifold3d import Manifold; from foretrace.objects.decomposition import decompose\n"
        "bowl = Manifold.sphere(0.06, 160).trim_by_plane((0, 0, -1), 0) - Manifold.sphere(0.055, 160)\n"
        "print('cutting', flush=True)\n"
        "while True: decompose(bowl)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(0.5)
    process.send_signal(number)
    assert process.wait(timeout=20) != 0
