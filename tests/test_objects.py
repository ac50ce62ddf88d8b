import json

import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from foretrace.errors import ShapeError
from foretrace.geometry import is_convex, polygon_area
from foretrace.objects import (
    BEVEL,
    CIRCLE_RADIUS,
    CORNER_COUNTS,
    NO_BEVEL,
    OBJECTS,
    Bevel,
    MeshObject,
    Prism,
    object_from_dict,
    paper_objects,
    sample_prism,
)
from foretrace.objects.prism import convex_parts

RECTANGLE = np.array([[-0.1, -0.05], [0.1, -0.05], [0.1, 0.05], [-0.1, 0.05]])
L_SHAPE = np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.06], [0.06, 0.06], [0.06, 0.2], [0.0, 0.2]])

seeds = st.integers(0, 2**32 - 1)
corner_counts = st.integers(3, 10)


def star(seed: int, num_corners: int) -> np.ndarray:
    """A random star-shaped polygon, usually not convex, off the origin."""
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * (np.arange(num_corners) + rng.uniform(0.0, 0.6, num_corners)) / num_corners
    radii = rng.uniform(0.04, 0.1, num_corners)
    return np.column_stack([0.05 + radii * np.cos(angles), 0.02 + radii * np.sin(angles)])


def hull_mesh(points: np.ndarray) -> trimesh.Trimesh:
    return trimesh.convex.convex_hull(points)


def assert_same_mass(properties, mesh: trimesh.Trimesh, density: float, rtol: float = 1e-9) -> None:
    mesh.density = density
    expected = mesh.mass_properties
    np.testing.assert_allclose(properties.mass, expected.mass, rtol=rtol)
    np.testing.assert_allclose(properties.com, expected.center_mass, atol=rtol * 0.1)
    scale = np.abs(expected.inertia).max()
    np.testing.assert_allclose(properties.inertia, expected.inertia, atol=rtol * scale)


# --- prisms -----------------------------------------------------------------------------------------------


def test_box_without_bevel_has_the_textbook_inertia():
    properties = Prism(RECTANGLE, height=0.04, bevel=NO_BEVEL).mass_properties(density=1000.0)
    a, b, c = 0.2, 0.1, 0.04
    mass = 1000.0 * a * b * c
    assert properties.mass == pytest.approx(mass, rel=1e-12)
    np.testing.assert_allclose(properties.com, [0.0, 0.0, 0.02], atol=1e-15)
    inertia = mass / 12 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
    np.testing.assert_allclose(properties.inertia, inertia, rtol=1e-12, atol=1e-15)


def test_a_closing_corner_and_one_given_twice_count_once():
    closed = Prism([*RECTANGLE[:2], *RECTANGLE[1:], RECTANGLE[0] + 1e-7])
    np.testing.assert_allclose(closed.corners, Prism(RECTANGLE).corners, rtol=0, atol=2e-7)


@settings(max_examples=30, deadline=None)
@given(seeds, corner_counts)
def test_mass_properties_of_bevelled_prisms(seed, num_corners):
    prism = sample_prism(np.random.default_rng(seed), num_corners)
    # Independently: the convex hull of the inset at z = 0 and the outline at both ends of the wall.
    inset = shapely.get_coordinates(shapely.Polygon(prism.corners).buffer(-BEVEL.width, join_style="mitre"))
    layers = [(inset, 0.0), (prism.corners, BEVEL.height), (prism.corners, 0.02)]
    points = np.concatenate([np.column_stack([xy, np.full(len(xy), z)]) for xy, z in layers])
    assert_same_mass(prism.mass_properties(700.0), hull_mesh(points), 700.0)


@settings(max_examples=20, deadline=None)
@given(seeds, corner_counts)
def test_wedges_share_the_centre_and_do_not_overlap(seed, num_corners):
    prism = sample_prism(np.random.default_rng(seed), num_corners)
    pieces = prism.convex_pieces()
    assert len(pieces) == num_corners
    for piece, a, b in zip(pieces, prism.corners, np.roll(prism.corners, -1, axis=0), strict=True):
        top = {tuple(xy) for xy in piece[piece[:, 2] == prism.height, :2].tolist()}
        assert top == {(0.0, 0.0), tuple(a.tolist()), tuple(b.tolist())}
    assert sum(ConvexHull(piece).volume for piece in pieces) == pytest.approx(
        ConvexHull(np.concatenate(pieces)).volume, rel=1e-9
    )


@settings(max_examples=40, deadline=None)
@given(seeds, st.integers(4, 25))
def test_polygons_that_are_not_convex_are_cut_exactly(seed, num_corners):
    corners = star(seed, num_corners)
    prism = Prism(corners, bevel=NO_BEVEL)
    parts = convex_parts(prism.corners)
    assert all(is_convex(prism.corners[part]) for part in parts)
    areas = [polygon_area(prism.corners[part]) for part in parts]
    assert min(areas) > 0
    assert sum(areas) == pytest.approx(polygon_area(prism.corners), rel=1e-12)
    # An exact volume and inertia, against the extruded mesh.
    body = trimesh.creation.extrude_polygon(shapely.Polygon(prism.corners), prism.height)
    assert_same_mass(prism.mass_properties(500.0), body, 500.0, rtol=1e-6)


@pytest.mark.parametrize(("seed", "num_corners"), [(60, 59), (124, 40), (262, 40)])
def test_outlines_with_slivers_are_cut_without_a_bevel(seed, num_corners):
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, num_corners))
    radii = rng.uniform(0.02, 0.1, num_corners)
    prism = Prism(radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]), bevel=NO_BEVEL)
    volume = prism.height * polygon_area(prism.corners)
    assert prism.mass_properties(1.0).mass == pytest.approx(volume, rel=1e-4)


def test_merging_leaves_few_parts():
    assert len(convex_parts(L_SHAPE)) == 2
    comb = [
        (0.0, 0.0),
        (0.2, 0.0),
        (0.2, 0.1),
        (0.16, 0.03),
        (0.12, 0.1),
        (0.08, 0.03),
        (0.04, 0.1),
        (0.0, 0.03),
    ]
    # Each reflex corner costs at most two parts (Hertel and Mehlhorn).
    assert len(convex_parts(np.array(comb))) <= 5


@settings(max_examples=20, deadline=None)
@given(seeds, st.integers(5, 15))
def test_bevel_stays_inside_the_outline_and_reaches_the_table(seed, num_corners):
    prism = Prism(star(seed, num_corners), bevel=Bevel(0.003, 0.004))
    outline = shapely.Polygon(prism.corners)
    inset = outline.buffer(-0.003, join_style="mitre")
    for piece in prism.convex_pieces():
        assert set(np.unique(piece[:, 2])) <= {0.0, 0.004, 0.02}
        assert shapely.distance(shapely.points(piece[:, :2]), outline).max() < 1e-12
        foot = piece[piece[:, 2] == 0.0, :2]
        if len(foot):
            assert shapely.distance(shapely.points(foot), inset).max() < 1e-6


def test_bevel_opens_the_rim_beside_a_reflex_corner():
    pieces = Prism(L_SHAPE, bevel=Bevel(0.005, 0.005)).convex_pieces()
    # Nothing of the body may lie in the gap that the blade enters, half way along the two inner edges.
    for probe in ([0.13, 0.058, 0.001], [0.058, 0.13, 0.001], [0.07, 0.058, 0.001], [0.058, 0.07, 0.001]):
        for piece in pieces:
            hull = ConvexHull(piece)
            assert (hull.equations[:, :3] @ probe + hull.equations[:, 3]).max() > 0, probe


def test_convex_polygon_away_from_the_origin_is_one_piece():
    pieces = Prism(RECTANGLE + 0.5).convex_pieces()
    assert len(pieces) == 1
    assert len(Prism(RECTANGLE).convex_pieces()) == 4


@settings(max_examples=40, deadline=None)
@given(seeds, corner_counts)
def test_support_corners_belong_to_their_corners(seed, num_corners):
    prism = sample_prism(np.random.default_rng(seed), num_corners)
    support = prism.support_corners
    assert support.shape == prism.corners.shape
    nearest = np.argmin(np.linalg.norm(support[:, None] - prism.corners[None], axis=-1), axis=1)
    np.testing.assert_array_equal(nearest, np.arange(num_corners))
    outline = shapely.Polygon(prism.corners)
    np.testing.assert_allclose(
        shapely.distance(shapely.points(support), outline.exterior), BEVEL.width, atol=1e-9
    )
    bottom = np.concatenate(prism.convex_pieces())
    bottom = bottom[bottom[:, 2] == 0.0, :2]
    assert np.linalg.norm(support[:, None] - bottom[None], axis=-1).min(axis=1).max() < 1e-9


def test_support_corner_of_a_thin_tip_lies_on_the_bottom_face():
    arrow = np.array([[-0.1, -0.05], [0.15, 0.0], [-0.1, 0.05], [-0.095, 0.0]])
    prism = Prism(arrow, bevel=Bevel(0.005, 0.005))
    bottom = shapely.Polygon(arrow).buffer(-0.005, join_style="mitre")
    assert shapely.distance(shapely.points(prism.support_corners), bottom).max() < 1e-6


def test_clockwise_corners_are_reordered_from_the_same_first_corner():
    prism = Prism(RECTANGLE[::-1])
    np.testing.assert_array_equal(prism.corners[0], RECTANGLE[-1])
    assert polygon_area(prism.corners) == pytest.approx(0.02)
    assert {tuple(c) for c in prism.corners.tolist()} == {tuple(c) for c in RECTANGLE.tolist()}


def test_height_at():
    prism = Prism(L_SHAPE, height=0.03)
    points = np.array([[0.03, 0.03], [0.19, 0.05], [0.1, 0.1], [-0.01, 0.0]])
    np.testing.assert_array_equal(prism.height_at(points), [0.03, 0.03, 0.0, 0.0])


def test_prism_arrays_are_read_only():
    corners = RECTANGLE.copy()
    prism = Prism(corners)
    corners[0] = 9.0
    assert prism.corners[0, 0] == -0.1
    with pytest.raises(ValueError, match="read-only"):
        prism.corners[0] = 0.0


def test_lists_are_accepted():
    assert Prism([[0, 0], [0.1, 0], [0, 0.1]]).size == pytest.approx(0.1 * np.sqrt(2))


BAD_PRISMS = {
    "2 corners": dict(corners=[[0, 0], [0.1, 0]]),
    "shape": dict(corners=[0.0, 0.1, 0.2]),
    "must be numbers in the shape": dict(corners=[[0, 0], [0.1, "wide"], [0, 0.1]]),
    "corners .* not finite, nan at .1, ": dict(corners=[[0, 0], [0.1, np.nan], [0, 0.1]]),
    "check unit": dict(corners=[[0, 0], [1e300, 0], [0, 1e300]]),
    "finite": dict(corners=[[0, 0], [np.inf, 0], [0, 0.1]]),
    "Self-intersection": dict(corners=[[0, 0], [0.1, 0.1], [0.1, 0], [0, 0.11]]),
    "on one line": dict(corners=[[0, 0], [0.1, 0.1], [0.2, 0.2]]),
    "2001 corners: give at most 2000": dict(corners=np.zeros((2001, 2))),
    "corners 0 and 1 are both": dict(corners=np.zeros((1900, 2))),
    "corners 0 and 3 are both": dict(corners=[[0, 0], [0.1, 0], [0.1, 0.1], [1e-8, 0], [0, 0.1]]),
    "corners 1 and 3 are both": dict(corners=[[0, 0], [0.1, 0], [0, 0.1], [0.1, 0]]),
    "size 0.008": dict(corners=RECTANGLE * 0.008 / np.hypot(0.2, 0.1)),
    "size 200": dict(corners=RECTANGLE * 200 / np.hypot(0.2, 0.1)),
    "height 2 m": dict(corners=RECTANGLE, height=2.0),
    "height 0 m": dict(corners=RECTANGLE, height=0.0),
    "height nan m": dict(corners=RECTANGLE, height=np.nan),
    "bevel of height 0.005 m on an object of height 0.004 m": dict(
        corners=RECTANGLE, height=0.004, bevel=Bevel(0.005, 0.005)
    ),
    "bevel of width 0.06 m .* radius 0.05": dict(corners=RECTANGLE, bevel=Bevel(0.06, 0.005)),
}


@pytest.mark.parametrize("fault", BAD_PRISMS)
def test_bad_prisms_are_refused(fault):
    with pytest.raises(ShapeError, match=fault) as caught:
        Prism(**BAD_PRISMS[fault])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("width", "height"), [(-0.001, 0.005), (0.005, np.nan), (0.005, 0.0), (0.0, 0.005)])
def test_bad_bevels_are_refused(width, height):
    with pytest.raises(ShapeError, match="bevel"):
        Bevel(width, height)


# --- the paper's objects ----------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(seeds, corner_counts)
def test_sampled_prisms_are_the_papers(seed, num_corners):
    prism = sample_prism(np.random.default_rng(seed), num_corners)
    assert prism.corners.shape == (num_corners, 2)
    np.testing.assert_allclose(np.linalg.norm(prism.corners, axis=1), CIRCLE_RADIUS)
    angles = np.unwrap(np.arctan2(prism.corners[:, 1], prism.corners[:, 0]))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    assert np.deg2rad(12) <= gaps.min()
    assert gaps.max() <= np.deg2rad(165)
    assert shapely.contains_xy(shapely.Polygon(prism.corners), 0.0, 0.0)


def test_paper_objects_are_160_and_each_is_reproducible_alone():
    objects = paper_objects(seed=3)
    assert [len(o.corners) for o in objects] == 20 * list(CORNER_COUNTS)
    alone = sample_prism(np.random.default_rng([3, 41]), CORNER_COUNTS[41 % 8])
    np.testing.assert_array_equal(alone.corners, objects[41].corners)
    assert not np.array_equal(paper_objects(seed=4, per_corner_count=1)[0].corners, objects[0].corners)
    assert sum(2 * len(o.corners) for o in objects) == 2080


@pytest.mark.parametrize("num_corners", [2, 40])
def test_impossible_corner_counts_are_refused(num_corners):
    with pytest.raises(ShapeError, match=f"{num_corners} corners"):
        sample_prism(np.random.default_rng(0), num_corners)


# --- storage ----------------------------------------------------------------------------------------------


BALL = trimesh.creation.icosphere(subdivisions=1, radius=0.05)


@pytest.mark.parametrize(
    "obj",
    [
        sample_prism(np.random.default_rng(0), 7),
        Prism(L_SHAPE, height=0.031, bevel=Bevel(0.002, 0.003)),
        MeshObject(np.array(BALL.vertices), np.array(BALL.faces)),
    ],
    ids=["prism", "bevel", "mesh"],
)
def test_objects_survive_json_to_the_last_digit(obj):
    values = json.loads(json.dumps(obj.to_dict()))
    again = object_from_dict(values)
    assert type(again) is type(obj)
    assert again.to_dict() == obj.to_dict()
    np.testing.assert_array_equal(again.corners, obj.corners)
    for a, b in zip(again.convex_pieces(), obj.convex_pieces(), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"kind": "blob"}, "unknown object 'blob'; available: .*box"),
        ({}, "unknown object None"),
        ({"kind": "prism"}, "prism is not usable"),
        ({"kind": "mesh", "vertices": [], "faces": [], "bevel": [1]}, "mesh is not usable"),
    ],
)
def test_unusable_descriptions_are_refused(values, fault):
    with pytest.raises(ShapeError, match=fault):
        object_from_dict(values)


def test_a_family_of_ones_own_registers_itself_and_is_recorded():
    class Tile(Prism):
        kind = "tile"

    try:
        tile = Tile([(0.0, 0.0), (0.1, 0.0), (0.1, 0.1)], 0.02)
        again = object_from_dict(json.loads(json.dumps(tile.to_dict())))
        assert type(again) is Tile
        np.testing.assert_array_equal(again.corners, tile.corners)
    finally:
        del OBJECTS._entries["tile"]
    with pytest.raises(ShapeError, match="unknown object 'tile'"):
        object_from_dict(tile.to_dict())
