"""How sure a mean over seeds is: one interval for all experiments."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.stats import t as student

from foretrace.interactions.splits import PAPER_SIZES

TEST_TO_TRAIN = PAPER_SIZES[2] / PAPER_SIZES[0]
"""Size of the test part divided by that of the training part in the paper's split."""
LARGEST_RATIO = 1.0
RESAMPLED = 10_000
"""Samples of a bootstrap."""


class Interval(NamedTuple):
    """Mean over the seeds, and between which values the true mean lies."""

    mean: float
    """NaN without a value."""
    low: float
    """Lower end; NaN with fewer than two seeds."""
    high: float
    """Upper end."""
    seeds: int
    """Number of values."""

    def as_dict(self, digits: int | None = None) -> dict[str, Any]:
        """JSON-able; what is not finite is None."""
        numbers = {name: getattr(self, name) for name in ("mean", "low", "high")}
        return {
            name: None if not np.isfinite(x) else x if digits is None else round(x, digits)
            for name, x in numbers.items()
        }


def interval(
    values: Sequence[float] | Float[np.ndarray, " n"] | pd.Series,
    test_to_train: float = TEST_TO_TRAIN,
    level: float = 0.95,
) -> Interval:
    """Mean over seeds that split one set of objects anew, and its confidence interval.

    Test parts and training parts of such seeds overlap, so the plain variance of their mean is too small. It is
    corrected as by Nadeau and Bengio (2003, "Inference for the generalization error"): the variance of the values is
    multiplied by 1/J + n_test/n_train instead of 1/J, and Student's t with J - 1 degrees of freedom gives the width.

    Args:
        values: One number for each of the J seeds.
        test_to_train: Size of the test part divided by the size of the training part; by default that of the paper's
            split. 0 for independent data sets: that is the plain t interval. The approximation is meant for test parts
            that are smaller than training parts; a larger ratio counts as 1.
        level: Confidence level.
    """
    sample = np.asarray(values, dtype=float)
    count = len(sample)
    if count < 2:
        return Interval(float(sample[0]) if count else np.nan, np.nan, np.nan, count)
    mean = float(sample.mean())
    factor = 1 / count + min(test_to_train, LARGEST_RATIO)
    half = float(student.ppf((1 + level) / 2, count - 1) * np.sqrt(factor * sample.var(ddof=1)))
    return Interval(mean, mean - half, mean + half, count)


def bootstrap(values: Sequence[float] | Float[np.ndarray, " n"] | pd.Series, level: float = 0.95) -> Interval:
    """Mean of independent values and its percentile bootstrap interval.

    Args:
        values: One number for each independent draw.
        level: Confidence level.
    """
    sample = np.asarray(values, dtype=float)
    count = len(sample)
    if count < 2:
        return Interval(float(sample[0]) if count else np.nan, np.nan, np.nan, count)
    drawn = np.random.default_rng(0).integers(count, size=(RESAMPLED, count))
    low, high = np.percentile(sample[drawn].mean(axis=1), [50 * (1 - level), 50 * (1 + level)])
    return Interval(float(sample.mean()), float(low), float(high), count)
