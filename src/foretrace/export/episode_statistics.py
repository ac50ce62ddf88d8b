"""The statistics that a LeRobot data set keeps of every feature, per episode and in all."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
PIXEL_STRIDE = 4
"""Of an image's rows and columns every such one is counted."""

Statistics = dict[str, np.ndarray]
"""Minimum, maximum, mean, standard deviation, count and quantiles of a feature."""


def vector_statistics(values: Shaped[np.ndarray, "frames *size"]) -> Statistics:
    """Of numbers, over an episode's frames; of a single number they keep one entry."""
    rows = np.asarray(values, dtype=float).reshape(len(values), -1)
    return _statistics(rows, len(values))


def image_statistics(images: Shaped[np.ndarray, "frames rows columns channels"]) -> Statistics:
    """Of images, per channel over frames and pixels, shaped (channels, 1, 1).

    Colours (uint8) are counted from 0 to 1, depths in their own unit.
    """
    few = images[:, ::PIXEL_STRIDE, ::PIXEL_STRIDE]
    scale = 255.0 if images.dtype == np.uint8 else 1.0
    pixels = few.reshape(-1, images.shape[-1]) / scale
    found = _statistics(pixels, len(images))
    return {name: value if name == "count" else value[:, None, None] for name, value in found.items()}


def _statistics(rows: Float[np.ndarray, "n k"], count: int) -> Statistics:
    quantiles = np.quantile(rows, list(QUANTILES.values()), axis=0)
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([count]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def all_statistics(episodes: Sequence[Statistics]) -> Statistics:
    """Of all episodes together.

    Mean and standard deviation are exact. A quantile is the outermost of the episodes', as the format has it: the
    smallest up to the median, the largest above.
    """
    stacked = {name: np.stack([each[name] for each in episodes]) for name in episodes[0]}
    weights = stacked["count"].reshape(-1, *[1] * (stacked["mean"].ndim - 1)) / stacked["count"].sum()
    mean = (weights * stacked["mean"]).sum(axis=0)
    variance = (weights * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(axis=0)
    return {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": stacked["count"].sum(axis=0),
        **{
            name: stacked[name].min(axis=0) if level <= 0.5 else stacked[name].max(axis=0)
            for name, level in QUANTILES.items()
        },
    }
