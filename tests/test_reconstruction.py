import numpy as np
import pytest

from factories import QUICK_OPTIONS, fake_batch
from foretrace.errors import PredictionError
from foretrace.experiments.reconstruction import overlap, reconstruct_masks, reconstruction_figure
from foretrace.predictor import LstmConfig


@pytest.fixture(scope="module")
def batch():
    return fake_batch(np.random.default_rng(4), 5, num_samples=12)


def test_masks_come_back_in_their_shape(batch):
    predictor = LstmConfig(features="ae-256", feature_options=dict(QUICK_OPTIONS["ae-256"]), hidden=8).make(
        12
    )
    restored = reconstruct_masks(predictor, batch)
    assert restored.shape == batch.mask.shape
    assert restored.dtype == bool


def test_other_features_have_nothing_to_restore_from(batch):
    predictor = LstmConfig(features="none", hidden=8).make(12)
    with pytest.raises(PredictionError, match="features 'none' have no code"):
        reconstruct_masks(predictor, batch)


def test_overlap():
    one = np.zeros((3, 128, 128), dtype=bool)
    other = one.copy()
    one[0, :, :64], other[0, :, 32:96] = True, True
    one[1], other[1] = True, False
    np.testing.assert_allclose(overlap(one, other), [1 / 3, 0, 1])


def test_the_figure_has_a_row_for_each_code_and_tells_lost_from_added(batch):
    made = np.roll(batch.mask, 5, axis=2)
    figure = reconstruction_figure(batch.mask, {"ae-256": made, "ae-512": batch.mask})
    assert len(figure.axes) == 15
    shown = np.asarray(figure.axes[5].images[0].get_array())
    np.testing.assert_array_equal(shown == 2, batch.mask[0] & ~made[0])
    np.testing.assert_array_equal(shown == 3, made[0] & ~batch.mask[0])
    assert set(np.unique(figure.axes[10].images[0].get_array())) == {0, 1}
