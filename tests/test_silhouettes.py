import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from foretrace.errors import ShapeError
from foretrace.geometry import polygon_area
from foretrace.objects import (
    Prism,
    object_from_dict,
    read_silhouette,
    sample_prism,
)
from foretrace.objects.prism import convex_parts

DATA = Path(__file__).parents[1].parent / "shared" / "data"
SILHOUETTES = sorted((DATA / "silhouettes").glob("*.png"))

seeds = st.integers(0, 2**32 - 1)
corner_counts = st.integers(3, 10)


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


# Always the same examples: the next test has one of another kind.
@settings(max_examples=25, deadline=None, derandomize=True)
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
    # The outline may be left by a millimetre; on average, to either side, it is by far less than half of that.
    allowed = 0.0005 * shapely.LinearRing(outline).length
    assert polygon_area(prism.corners) == pytest.approx(polygon_area(outline), abs=allowed)


@pytest.mark.xfail(strict=True, reason="the area of this polygon is 1.7 % too small, where 1.1 % are allowed")
def test_a_polygon_that_does_not_survive_well_enough():
    case = test_corners_survive_the_way_through_a_mask.hypothesis.inner_test
    case(seed=9, num_corners=9, metres_per_pixel=0.000795360540794061)


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
@example(1000000)
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
    "scale of 1.0 m per pixel": (square_mask(20), 1.0),
    "size 2.*check unit": (square_mask(20), 0.09),
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
