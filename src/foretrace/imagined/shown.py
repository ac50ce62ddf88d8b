"""How futures are told and drawn: in which order, how exactly, with which region."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from foretrace.imagined.futures import Futures, ImaginedEffect

LEVEL = 0.9
"""Probability of the region that is told of."""
SUREST = 0.995
"""Probabilities beyond are not told more exactly: they were fitted to a few thousand lever-ups."""


def in_order(futures: "Futures") -> list[int]:
    """Futures, the most probable one first."""
    return np.argsort(-futures.probability[0], kind="stable").tolist()


def radius_of(imagined: "ImaginedEffect") -> np.ndarray | None:
    """Radius of the region about the path [m]; None where it is not known."""
    radius = imagined.futures.radius(LEVEL)[0, in_order(imagined.futures)[0]]
    return radius if np.isfinite(radius).all() else None


def percentage(probability: float) -> str:
    """A probability as it is printed: nothing is certain."""
    if probability > SUREST:
        return f"over {SUREST:.1%}"
    return f"{probability:.1%}" if probability > 1 - SUREST else f"under {1 - SUREST:.1%}"
