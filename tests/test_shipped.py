"""Measures of probabilities and doubts, and futures that know how far off they may be."""

import numpy as np
import pytest

from foretrace.experiments.shipped import auroc, calibration_error, draw
from foretrace.imagined import LEVELS, Futures


def futures(probability: float, apart: float, spread: float) -> Futures:
    """Two futures that part at once, one of them probable."""
    states = np.zeros((1, 2, 5, 6))
    states[0, 1, :, 0] = apart
    return Futures(
        probability=np.array([[probability, 1 - probability]]),
        outcome=("levered", "slipped"),
        states=states,
        spread=np.full((1, 2, 5), spread),
        support_points=np.full((1, 2, 2, 2), np.nan),
        quantiles=np.full(len(LEVELS), np.nan),
    )


def test_the_expected_error_counts_spread_and_other_futures():
    assert futures(1.0, 0.1, 0.002).expected_error()[0] == pytest.approx(0.002)
    assert futures(0.75, 0.1, 0.0).expected_error()[0] == pytest.approx(0.025)
    assert futures(0.75, 0.03, 0.04).expected_error()[0] == pytest.approx(0.75 * 0.04 + 0.25 * 0.05)
    assert np.isnan(futures(0.75, 0.1, np.nan).expected_error()[0])


def test_auroc_counts_pairs_in_the_right_order():
    rng = np.random.default_rng(0)
    scores, positive = np.round(rng.normal(size=60), 1), rng.random(60) < 0.3
    pairs = [np.sign(a - b) / 2 + 0.5 for a in scores[positive] for b in scores[~positive]]
    assert auroc(scores, positive) == pytest.approx(np.mean(pairs))


def test_calibration_error_of_exaggerated_confidence():
    right = np.arange(1000) % 10 < 7
    assert calibration_error(np.full(1000, 0.7), right) == pytest.approx(0.0, abs=1e-9)
    assert calibration_error(np.full(1000, 0.95), right) == pytest.approx(0.25)


def test_drawn_motions_follow_futures_as_often_as_they_are_probable_and_stray_by_their_spread():
    drawn = draw(futures(0.75, 0.1, 0.002), 4000)[0]
    second = drawn[..., 0].mean(axis=1) > 0.05
    assert second.mean() == pytest.approx(0.25, abs=0.03)
    off = drawn[~second]
    assert np.sqrt((off**2).sum(axis=-1).mean()) == pytest.approx(0.002, rel=0.05)
    assert np.allclose(off, off[:, :1])  # one offset for the whole motion
