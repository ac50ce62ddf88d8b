import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from factories import fake_batch
from foretrace.errors import PredictionError, TrainingError
from foretrace.features import ShapeContext200, ShapeContext800, ShapeContext3200, ShapeContextCnn
from foretrace.features.shape_context import sample_contour, shape_context

GRIDS = [(10, 20), (20, 40), (40, 80)]
SQUARE = np.array([[0.0, -0.05], [0.1, -0.05], [0.1, 0.05], [0.0, 0.05]])
every_grid = pytest.mark.parametrize("grid", GRIDS)
both_planes = pytest.mark.parametrize("half_plane", [False, True])
seeds = st.integers(0, 10_000)


@pytest.fixture(scope="module")
def batch():
    torch.set_num_threads(1)
    return fake_batch(np.random.default_rng(3), 8, num_samples=12)


def outline(seed: int) -> np.ndarray:
    """A random polygon around a centre ahead of the contact point, which lies on its first edge [m]."""
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 11)))
    corners = rng.uniform(0.05, 0.1, (len(angles), 1)) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    contact = corners[0] + rng.uniform(0.2, 0.8) * (corners[1] - corners[0])
    along = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
    return (corners - contact) @ np.array([[-along[1], along[0]], [-along[0], -along[1]]]).T


def test_the_number_of_features_is_in_the_name():
    assert [e().num_features for e in (ShapeContext200, ShapeContext800, ShapeContext3200)] == [
        200,
        800,
        3200,
    ]
    halves = [e(half_plane=True).num_features for e in (ShapeContext200, ShapeContext800, ShapeContext3200)]
    assert halves == [110, 420, 1640]  # as in the paper's code


def test_points_are_sampled_uniformly_along_the_outline():
    points = sample_contour(SQUARE, 8)
    expected = [[1, -2], [3, -2], [4, -1], [4, 1], [3, 2], [1, 2], [0, 1], [0, -1]]
    np.testing.assert_allclose(points, np.array(expected) * 0.025, atol=1e-12)


def test_a_square_by_hand():
    # Eight points at 0.025 x (1, 3, 4 ... ahead; -2 ... 2 aside); four wedges, from the right.
    matrix = shape_context(SQUARE, 1, 4, num_points=8)
    # The two points on the edge lie at -90 and 90 degrees, where the first and the third wedge begin.
    np.testing.assert_array_equal(matrix, [[4 / 8, 3 / 8, 1 / 8, 0]])
    half = shape_context(SQUARE, 1, 4, num_points=8, half_plane=True)
    # Centred on -90, 0 and 90 degrees: aside, ahead (those within 45 degrees), aside.
    np.testing.assert_array_equal(half, [[2 / 8, 4 / 8, 2 / 8]])
    rings = shape_context(SQUARE, 40, 4, num_points=8).sum(axis=1)
    radii = np.linalg.norm(sample_contour(SQUARE, 8), axis=1)
    assert np.count_nonzero(rings) == len(np.unique(radii.round(9)))


@every_grid
@both_planes
@settings(deadline=None, max_examples=25)
@given(seed=seeds)
def test_shares_sum_to_one(grid, half_plane, seed):
    matrix = shape_context(outline(seed), *grid, half_plane=half_plane)
    assert matrix.sum() == pytest.approx(1)
    assert (matrix >= 0).all()


@both_planes
@settings(deadline=None, max_examples=25)
@given(seed=seeds, scale=st.sampled_from([0.25, 0.5, 2.0, 8.0]))
def test_size_does_not_matter(half_plane, seed, scale):
    # Powers of two, so that no point crosses a cell's border by rounding.
    one = shape_context(outline(seed), 20, 40, half_plane=half_plane)
    np.testing.assert_array_equal(one, shape_context(scale * outline(seed), 20, 40, half_plane=half_plane))


@settings(deadline=None, max_examples=25)
@given(seed=seeds, num_points=st.integers(300, 3000))
def test_the_number_of_points_hardly_matters(seed, num_points):
    # The first sample may lie anywhere; so does the start of the outline.
    fine = shape_context(outline(seed), 10, 20, num_points=20_000)
    coarse = shape_context(outline(seed), 10, 20, num_points=num_points)
    crossed = np.count_nonzero(fine)
    assert np.abs(fine - coarse).max() < 4 / num_points + 1e-3
    assert np.abs(fine - coarse).sum() < 2 * crossed / num_points + 1e-2


@both_planes
@settings(deadline=None, max_examples=25)
@given(seed=seeds)
def test_the_mirror_image_has_the_wedges_reversed(half_plane, seed):
    contour = outline(seed)
    # Turned by less than a degree, so that the edge does not lie on a border between wedges.
    turn = np.array([[np.cos(0.01), -np.sin(0.01)], [np.sin(0.01), np.cos(0.01)]])
    contour = contour @ turn.T
    mirrored = contour[::-1] * [1.0, -1.0]
    matrix = shape_context(contour, 10, 20, num_points=5000, half_plane=half_plane)
    other = shape_context(mirrored, 10, 20, num_points=5000, half_plane=half_plane)
    halves = [other] if half_plane else [other[:, :10], other[:, 10:]]
    flipped = np.concatenate([half[:, ::-1] for half in halves], axis=1)
    assert np.abs(matrix - flipped).sum() < 0.01


def test_mirrored_views_have_the_wedges_reversed(batch):
    extractor = ShapeContext200(half_plane=True)
    mirrored = replace(batch, mask=batch.mask[:, :, ::-1])
    apart = (extractor.inputs(batch) - extractor.inputs(mirrored).flip(-1)).abs().sum(dim=(1, 2))
    assert apart.max() < 0.05


def test_inputs_are_histograms_and_features_of_unit_scale(batch):
    for kind in (ShapeContext200, ShapeContext800, ShapeContext3200):
        extractor = kind()
        inputs = extractor.inputs(batch)
        torch.testing.assert_close(inputs.sum(dim=(1, 2)), torch.ones(len(batch)))
        assert 0.5 < extractor(inputs).square().mean().sqrt() < 2
        assert not extractor.trainable


def test_the_cnn_reads_the_matrix_of_sc_3200(batch):
    inputs = ShapeContextCnn().inputs(batch)
    assert inputs.shape == (len(batch), 1, 40, 80)
    torch.testing.assert_close(inputs[:, 0], 80 * ShapeContext3200().inputs(batch))
    extractor = ShapeContextCnn(width=7)
    assert extractor.num_features == 7
    assert extractor.trainable


def test_a_view_takes_milliseconds(batch):
    extractor = ShapeContext3200()
    seconds = []
    for _ in range(5):
        started = time.process_time()
        extractor.inputs(batch)
        seconds.append(time.process_time() - started)
    assert min(seconds) / len(batch) < 0.003 * 5  # five times the aim, for slow machines


def test_an_empty_mask_is_refused_by_its_number(batch):
    mask = batch.mask.copy()
    mask[2] = False
    empty = replace(batch, mask=mask)
    with pytest.raises(PredictionError, match=r"mask of interaction 2 is empty"):
        ShapeContext200().inputs(empty)


def test_what_has_no_shape_context_is_refused():
    with pytest.raises(PredictionError, match="one point"):
        shape_context(np.zeros((3, 2)), 10, 20)
    with pytest.raises(PredictionError, match="ahead of the edge"):
        shape_context(np.array([[-0.1, 0.01], [-0.2, 0.0], [-0.1, -0.01]]), 10, 20, half_plane=True)
    with pytest.raises(TrainingError, match="num_points must be at least 1, not 0"):
        ShapeContext200(num_points=0)
