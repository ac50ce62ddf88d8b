import numpy as np
import pytest
from scipy import stats

from foretrace.evaluation.statistics import TEST_TO_TRAIN, bootstrap, interval
from foretrace.evaluation.tables import markdown_table, mean_with_interval, number


def test_without_overlap_it_is_the_t_interval():
    values = np.random.default_rng(0).normal(size=10)
    expected = stats.t.interval(0.95, 9, values.mean(), stats.sem(values))
    found = interval(values, test_to_train=0.0)
    assert (found.low, found.high) == pytest.approx(expected)
    assert (found.mean, found.seeds) == (pytest.approx(values.mean()), 10)


def test_overlap_widens_it_as_nadeau_and_bengio_say():
    values = np.random.default_rng(0).normal(size=10)
    plain, corrected = interval(values, 0.0), interval(values)
    wider = (corrected.high - corrected.low) / (plain.high - plain.low)
    assert wider == pytest.approx(np.sqrt((1 / 10 + 300 / 1400) / (1 / 10)))
    assert TEST_TO_TRAIN == 300 / 1400
    assert interval(values, 46.0) == interval(values, 1.0), "the approximation is for small test parts"


def test_it_moves_and_grows_with_the_values_and_the_level():
    values = np.random.default_rng(0).normal(size=10)
    found, moved, surer = interval(values), interval(3 * values + 1), interval(values, level=0.99)
    np.testing.assert_allclose(moved[:3], 3 * np.array(found[:3]) + 1)
    assert surer.low < found.low < found.mean < found.high < surer.high


def test_too_few_values_have_no_interval():
    np.testing.assert_equal(interval([2.0]), (2.0, np.nan, np.nan, 1))
    np.testing.assert_equal(interval([]), (np.nan, np.nan, np.nan, 0))
    assert interval([2.0]).as_dict(2) == {"mean": 2.0, "low": None, "high": None}


@pytest.mark.parametrize("n", [3, 10])
def test_intervals_cover_the_true_mean_as_often_as_stated(n):
    rng = np.random.default_rng(1)
    found = [interval(rng.normal(size=n), 0.0) for _ in range(2000)]
    assert np.mean([each.low <= 0 <= each.high for each in found]) == pytest.approx(0.95, abs=0.015)


def test_seeds_that_share_objects_are_covered_where_the_plain_interval_is_not():
    """Means of random test parts of one sample, about the mean of all samples."""
    rng = np.random.default_rng(2)
    hits = np.zeros(2)
    for _ in range(400):
        sample = rng.normal(size=90)
        values = [sample[rng.permutation(90)[:15]].mean() for _ in range(10)]
        for k, ratio in enumerate((0.0, 15 / 75)):
            found = interval(values, ratio)
            hits[k] += found.low <= 0 <= found.high
    assert hits[0] / 400 < 0.85 < 0.9 < hits[1] / 400


def test_the_bootstrap_is_about_as_wide_as_the_t_interval_of_many_values():
    values = np.random.default_rng(3).normal(2.0, 0.5, 200)
    found, plain = bootstrap(values), interval(values, 0.0)
    assert found.mean == plain.mean
    assert found.low == pytest.approx(plain.low, abs=0.005)
    assert found.high == pytest.approx(plain.high, abs=0.005)
    assert bootstrap(values, 0.5).high < found.high
    assert np.isnan(bootstrap([1.0]).low)


def test_tables():
    table = markdown_table(["", "a"], [["x", number(1 / 3)], ["y", number(None)]])
    assert table.splitlines() == ["|  | a |", "| --- | ---: |", "| x | 0.333 |", "| y |  |"]
    assert mean_with_interval({"mean": 0.5, "low": 0.4, "high": 0.6}, 2, sign="+") == "+0.50 [+0.40, +0.60]"
    assert mean_with_interval({"mean": 0.5, "low": None, "high": None}) == "0.500"
    assert mean_with_interval(None, missing="-") == "-"
