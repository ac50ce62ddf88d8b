import numpy as np
import pandas as pd
import pytest
from foretrace.evaluation.results import COLUMNS

from foretrace.errors import ResultsError
from foretrace.evaluation.statistics import mean_interval, paired_difference


def table(values: dict[str, dict[int, float]]) -> pd.DataFrame:
    rows = [("e", label, seed, "s", "m", value) for label, by in values.items() for seed, value in by.items()]
    others = [("e", "a", 0, "s", "other", 99.0), ("e", "a", 0, "t", "m", 99.0), ("f", "a", 0, "s", "m", 99.0)]
    return pd.DataFrame([*rows, *others], columns=list(COLUMNS))


def test_the_interval_of_two_values_is_known():
    # Means of resamples are 0, 1, 2 with shares of a quarter, a half, a quarter.
    assert mean_interval([0.0, 2.0]) == (1.0, 0.0, 2.0)
    assert mean_interval([0.0, 2.0], level=0.4) == (1.0, 1.0, 1.0)


def test_an_interval_grows_with_level_and_spread_and_moves_with_the_values():
    values = np.random.default_rng(0).normal(size=10)
    mean, low, high = mean_interval(values)
    assert mean == pytest.approx(values.mean())
    assert low < mean < high
    _, lower, higher = mean_interval(values, level=0.99)
    assert lower < low < high < higher
    np.testing.assert_allclose(mean_interval(3 * values + 1), 3 * np.array([mean, low, high]) + 1)


def test_the_same_seed_gives_the_same_interval():
    values = np.random.default_rng(0).normal(size=10)
    assert mean_interval(values) == mean_interval(values)
    assert mean_interval(values) != mean_interval(values, seed=1)


def test_too_few_values_have_no_interval():
    np.testing.assert_equal(mean_interval([2.0]), (2.0, np.nan, np.nan))
    np.testing.assert_equal(mean_interval([]), (np.nan, np.nan, np.nan))


@pytest.mark.parametrize(("n", "lowest", "highest"), [(10, 0.86, 0.94), (50, 0.92, 0.97)])
def test_intervals_cover_the_true_mean_about_as_often_as_stated(n, lowest, highest):
    rng = np.random.default_rng(1)
    intervals = np.array([mean_interval(rng.normal(size=n), resamples=1000) for _ in range(1000)])
    share = np.mean((intervals[:, 1] <= 0) & (intervals[:, 2] >= 0))
    assert lowest < share < highest


def test_pairing_takes_only_seeds_that_both_have_and_cancels_what_they_share():
    shared = {seed: 100.0 * seed for seed in range(6)}
    first = {seed: value + 1 for seed, value in shared.items()} | {7: 1e6}
    second = {**shared, 8: -1e6}
    found = paired_difference(table({"a": first, "b": second}), "e", "s", "m", "a", "b")
    assert found == (1.0, 1.0, 1.0, 6)
    assert paired_difference(table({"a": first, "b": second}), "e", "s", "m", "b", "a").mean == -1.0


def test_a_paired_interval_is_that_of_the_differences():
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 10))
    found = paired_difference(
        table({"a": dict(enumerate(first)), "b": dict(enumerate(second))}), "e", "s", "m", "a", "b"
    )
    assert found[:3] == mean_interval(first - second)
    assert found.num_seeds == 10


def test_nothing_in_common_is_an_error():
    with pytest.raises(ResultsError, match="no seed of e s has m of both a and b"):
        paired_difference(table({"a": {0: 1.0}, "b": {1: 1.0}}), "e", "s", "m", "a", "b")
