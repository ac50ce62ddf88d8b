import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from foretrace.errors import ShapeError
from foretrace.geometry import is_convex, polygon_area
from foretrace.objects import (
    BEVEL,
    CIRCLE_RADIUS,
    CORNER_COUNTS,
    NO_BEVEL,
    Bevel,
    MeshObject,
    Prism,
    object_from_dict,
    paper_objects,
    read_silhouette,
    sample_prism,
)
from foretrace.objects.prism import convex_parts

DATA = Path(__file__).parents[1].parent / "shared" / "data"
SILHOUETTES = sorted((DATA / "silhouettes").glob("*.png"))

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
    "table of numbers": dict(corners=[[0, 0], [0.1, "wide"], [0, 0.1]]),
    "corner 1 is .*nan": dict(corners=[[0, 0], [0.1, np.nan], [0, 0.1]]),
    "finite": dict(corners=[[0, 0], [np.inf, 0], [0, 0.1]]),
    "Self-intersection": dict(corners=[[0, 0], [0.1, 0.1], [0.1, 0], [0, 0.11]]),
    "on one line": dict(corners=[[0, 0], [0.1, 0.1], [0.2, 0.2]]),
    "corners 0 and 3 are both": dict(corners=[[0, 0], [0.1, 0], [0, 0.1], [0, 0]]),
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


# --- silhouettes ------------------------------------------------------------------------------------------


def square_mask(side: int = 10, margin: int = 6) -> np.ndarray:
    return np.pad(np.full((side, side), 255, dtype=np.uint8), margin)


def test_a_pixel_is_an_area():
    prism = Prism.from_mask(square_mask(), 0.005)
    assert prism.corners.shape == (4, 2)
    np.testing.assert_allclose(np.sort(prism.corners, axis=0)[[0, -1]], [[-0.025, -0.025], [0.025, 0.025]])


def test_image_rows_go_down_and_y_goes_up():
    mask = np.zeros((60, 60), dtype=bool)
    mask[10:50, 10:20] = True
    mask[40:50, 10:40] = True
    prism = Prism.from_mask(mask, 0.003)
    # The foot of the L points right and lies low.
    assert prism.height_at(np.array([[0.05, -0.03], [0.05, 0.03]])).tolist() == [0.02, 0.0]
    assert len(prism.corners) == 6


@settings(max_examples=25, deadline=None)
@given(seeds, corner_counts, st.floats(0.0003, 0.001))
def test_corners_survive_the_way_through_a_mask(seed, num_corners, metres_per_pixel):
    source = sample_prism(np.random.default_rng(seed), num_corners)
    grid = np.arange(-0.11, 0.11, metres_per_pixel)
    x, y = np.meshgrid(grid, grid[::-1])
    mask = shapely.contains_xy(shapely.Polygon(source.corners), x, y)
    prism = Prism.from_mask(mask, metres_per_pixel)
    # The mask's frame has its origin at the centroid.
    outline = source.corners - np.array(shapely.Polygon(source.corners).centroid.coords[0])
    apart = np.linalg.norm(prism.corners[:, None] - outline[None], axis=-1)
    # Usually a tenth of a pixel, in 99 of 100 polygons below 0.4; very sharp and very blunt corners are the hard ones.
    assert np.median(apart.min(axis=0)) < metres_per_pixel
    assert shapely.hausdorff_distance(shapely.LinearRing(prism.corners), shapely.LinearRing(outline)) < 0.003
    assert polygon_area(prism.corners) == pytest.approx(polygon_area(outline), rel=0.01)


def test_tolerance_decides_the_corner_count():
    y, x = np.indices((200, 200)) - 100
    disc = np.hypot(x, y) < 80
    coarse = Prism.from_mask(disc, 0.001, tolerance=0.005)
    fine = Prism.from_mask(disc, 0.001)
    assert len(coarse.corners) < len(fine.corners) < 80
    assert polygon_area(fine.corners) == pytest.approx(np.pi * 0.08**2, rel=0.005)


def test_holes_are_filled_and_specks_ignored():
    mask = np.pad(square_mask(60), 10)
    solid = Prism.from_mask(mask, 0.002)
    mask[40:50, 40:50] = 0
    mask[2, 2] = 255
    np.testing.assert_allclose(Prism.from_mask(mask, 0.002).corners, solid.corners)


def test_grey_noise_counts_as_background():
    mask = square_mask(60)
    noise = np.random.default_rng(0).integers(0, 60, mask.shape)
    noisy = np.clip(mask.astype(int) - noise, 0, 255) + np.where(mask == 0, noise, 0)
    np.testing.assert_allclose(
        Prism.from_mask(noisy.astype(np.uint8), 0.002).corners, Prism.from_mask(mask, 0.002).corners
    )


def test_tight_crops_are_accepted():
    y, x = np.indices((161, 161)) - 80
    assert Prism.from_mask(np.hypot(x, y) < 80.5, 0.001).size == pytest.approx(0.161, rel=0.01)


def test_thin_objects_get_a_narrower_bevel():
    prism = Prism.from_mask(np.pad(np.ones((8, 180), dtype=bool), 5), 0.001)
    assert prism.bevel.width == pytest.approx(0.002)
    assert Prism.from_mask(square_mask(60), 0.002, height=0.004).bevel.height == pytest.approx(0.002)


@settings(max_examples=8, deadline=None)
@given(seeds)
@example(51)
@example(122)
def test_random_blobs_become_prisms(seed):
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(size=(160, 200)), (0, 0), rng.uniform(4, 14))
    blobs = np.pad(noise > rng.uniform(-0.3, 0.5) * noise.std(), 20).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(blobs)
    blob = labels == 1 + np.argmax(stats[1:, cv2.CC_STAT_AREA])
    rows, columns = np.nonzero(blob)
    metres_per_pixel = 0.18 / max(np.ptp(rows), np.ptp(columns))
    prism = Prism.from_mask(blob, metres_per_pixel)
    assert np.isfinite(prism.support_corners).all()
    assert (np.linalg.eigvalsh(prism.mass_properties(500.0).inertia) > 0).all()
    filled = read_silhouette(blob).sum() * metres_per_pixel**2
    assert polygon_area(prism.corners) == pytest.approx(filled, rel=0.03)
    assert object_from_dict(prism.to_dict()).to_dict() == prism.to_dict()


TWO_OBJECTS = np.hstack([square_mask(20), square_mask(20)])
BAD_MASKS = {
    "empty": (np.zeros((20, 20), dtype=bool), 0.005),
    "0 x 0 pixels is empty": (np.zeros((0, 0), dtype=bool), 0.005),
    "2 separate objects": (TWO_OBJECTS, 0.005),
    "touches the left border": (square_mask()[:, 8:], 0.005),
    "touches the top border.*add a black margin": (np.ones((20, 20), dtype=bool), 0.005),
    "scale of 0.0 m per pixel": (square_mask(), 0.0),
    "scale of nan m per pixel": (square_mask(), np.nan),
    "size 28.*check unit": (square_mask(20), 1.0),
    "size 0.00": (square_mask(20), 0.0001),
}


@pytest.mark.parametrize("fault", BAD_MASKS)
def test_bad_masks_are_refused(fault):
    mask, metres_per_pixel = BAD_MASKS[fault]
    with pytest.raises(ShapeError, match=fault):
        Prism.from_mask(mask, metres_per_pixel)


@pytest.mark.skipif(not SILHOUETTES, reason="the real silhouettes are not on this machine")
@pytest.mark.parametrize("path", SILHOUETTES, ids=lambda path: path.stem)
def test_real_silhouettes_become_prisms(path):
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    rows, columns = np.nonzero(mask)
    metres_per_pixel = 0.18 / (1 + max(np.ptp(rows), np.ptp(columns)))
    prism = Prism.from_mask(mask, metres_per_pixel)
    extents = np.ptp(prism.corners, axis=0) / metres_per_pixel
    np.testing.assert_allclose(
        extents, [1 + np.ptp(columns), 1 + np.ptp(rows)], atol=2 * max(0.001 / metres_per_pixel, 1)
    )
    assert len(prism.corners) < 150
    parts = [polygon_area(prism.corners[part]) for part in convex_parts(prism.corners)]
    assert sum(parts) == pytest.approx(polygon_area(prism.corners), rel=1e-9)
    properties = prism.mass_properties(500.0)
    assert (np.linalg.eigvalsh(properties.inertia) > 0).all()
    np.testing.assert_allclose(properties.com[:2], 0.0, atol=0.002)


@pytest.mark.skipif(not (DATA / "prisms.json").exists(), reason="the real prisms are not on this machine")
def test_real_prisms():
    for values in json.loads((DATA / "prisms.json").read_text()).values():
        prism = Prism(values["corners_m"])
        assert prism.mass_properties(500.0).mass > 0.03


# --- meshes -----------------------------------------------------------------------------------------------


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
    "vertex 0 is .*nan": (np.where(np.indices((8, 3))[0] == 0, np.nan, BOX.vertices), BOX.faces),
    "faces name vertices 0 to 107": (BOX.vertices, BOX.faces + np.where(BOX.faces == 7, 100, 0)),
    "empty": (np.zeros((0, 3)), np.zeros((0, 3), dtype=int)),
    "expected .v, 3.": (BOX.vertices[:, :2], BOX.faces),
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


# --- storage ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "obj",
    [
        sample_prism(np.random.default_rng(0), 7),
        Prism(L_SHAPE, height=0.031, bevel=Bevel(0.002, 0.003)),
        mesh_object(trimesh.creation.icosphere(subdivisions=1, radius=0.05)),
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
        ({"kind": "blob"}, "kind 'blob': available are prism, mesh"),
        ({}, "kind None"),
        ({"kind": "prism"}, "prism is not usable"),
        ({"kind": "mesh", "vertices": [], "faces": [], "bevel": [1]}, "mesh is not usable"),
    ],
)
def test_unusable_descriptions_are_refused(values, fault):
    with pytest.raises(ShapeError, match=fault):
        object_from_dict(values)
