import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foretrace.actions import LeverUp
from foretrace.errors import PredictionError
from foretrace.features import Outline
from foretrace.geometry import convex_hull, is_convex, polygon_area
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.hull import MAX_CORNERS, fit_hull
from foretrace.interactions.topdown import METRES_PER_PIXEL, TopDownView
from foretrace.objects import sample_prism


def seen(seed: int, num_corners: int) -> tuple[np.ndarray, np.ndarray]:
    """Mask of a random prism, and its corners in the action frame [m]."""
    rng = np.random.default_rng(seed)
    obj = sample_prism(rng, num_corners)
    action = LeverUp.at_edge(obj, int(rng.integers(num_corners)), rng.uniform(0.2, 0.8))
    corners = obj.corners @ action.T_action_object[:2, :2].T + action.T_action_object[:2, 3]
    return TopDownView.of(obj, action).mask, corners


def distance_to_outline(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance of each point from the nearest side of a polygon [m]."""
    side = np.roll(corners, -1, axis=0) - corners
    share = ((points[:, None] - corners) * side).sum(axis=-1) / (side**2).sum(axis=-1)
    nearest = corners + np.clip(share, 0, 1)[..., None] * side
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)


def test_hulls_are_finer_than_pixels():
    errors, counts = [], []
    for seed in range(40):
        mask, corners = seen(seed, 3 + seed % 8)
        hull = fit_hull(mask)
        middles = (corners + np.roll(corners, -1, axis=0)) / 2
        errors.extend(distance_to_outline(middles, hull))
        counts.append(len(hull) == len(corners))
    assert np.median(errors) < METRES_PER_PIXEL / 20
    assert np.mean(errors) < METRES_PER_PIXEL / 8
    assert np.mean(counts) > 0.6


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), num_corners=st.integers(3, 10))
def test_hulls_are_convex_and_as_large_as_the_mask(seed, num_corners):
    mask, _ = seen(seed, num_corners)
    hull = fit_hull(mask)
    assert is_convex(hull)
    assert polygon_area(hull) == pytest.approx(mask.sum() * METRES_PER_PIXEL**2, rel=0.03)


def test_notches_and_specks_do_not_count():
    mask = np.zeros((128, 128), dtype=bool)
    mask[40:90, 30:80] = True
    square = fit_hull(mask)
    assert len(square) == 4
    mask[60:70, 30:60] = False  # a notch
    mask[5:7, 5:7] = True  # a speck
    notched = fit_hull(mask)
    assert len(notched) == 4
    apart = np.linalg.norm(square[:, None] - notched, axis=-1).min(axis=1)
    assert apart.max() < METRES_PER_PIXEL / 4


def test_a_circle_keeps_to_the_largest_number_of_corners():
    row, column = np.mgrid[:128, :128]
    hull = fit_hull((row - 60) ** 2 + (column - 64) ** 2 < 50**2)
    assert 8 <= len(hull) <= MAX_CORNERS


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (1, 20), (2, 20), (3, 3)])
def test_slivers_have_a_hull(rows, columns):
    mask = np.zeros((128, 128), dtype=bool)
    mask[60 : 60 + rows, 50 : 50 + columns] = True
    hull = fit_hull(mask)
    assert len(hull) >= 3
    assert np.isfinite(hull).all()
    assert len(convex_hull(hull)) == len(hull)


def test_an_empty_mask_is_refused():
    empty = TopDownView(np.zeros((128, 128), dtype=bool), np.zeros((128, 128)))
    with pytest.raises(PredictionError, match="mask of interaction 0 is empty"):
        Outline().inputs(InteractionBatch.from_views([empty]))
