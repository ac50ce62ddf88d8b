"""What a predictor says beside one motion: what else may happen, how sure it is, and what is unusual."""

from typing import TYPE_CHECKING

import numpy as np

from foretrace.cli.console import say

if TYPE_CHECKING:
    from foretrace.imagined import Futures, ImaginedEffect
    from foretrace.pictures.bands import PredictionBand

LEVEL = 0.9
"""Probability of the region that is told of."""
LARGEST_RADIUS = 0.5
"""A wider region says nothing and is not drawn [m]."""
SUREST = 0.995
"""Probabilities beyond are not told more exactly: they were fitted to a few thousand lever-ups."""
LEAST_PROBABLE = 0.01
"""Futures less probable than this are not drawn."""
LEAST_MOVING = 0.05
"""The object is not shown moving in futures less probable than this."""


def prediction_band(imagined: "ImaginedEffect") -> "PredictionBand":
    """What to draw beside the path."""
    from foretrace.pictures.bands import PredictionBand

    futures, radius = imagined.futures, radius_of(imagined)
    if futures.is_point:
        return PredictionBand()
    others = [k for k in _in_order(futures)[1:] if futures.probability[0, k] >= LEAST_PROBABLE]
    if radius is not None and radius.max() > LARGEST_RADIUS:
        radius = None
    return PredictionBand(
        imagined.com_trajectory,
        radius,
        LEVEL,
        [(f"{futures.outcome[k]} {futures.probability[0, k]:.0%}", futures.com[0, k]) for k in others],
    )


def other_motions(imagined: "ImaginedEffect", T_action_object: np.ndarray) -> list[np.ndarray]:
    """Poses of the object's frame (time, 7) in the futures beside the most probable one, which are probable enough.

    Args:
        imagined: What is predicted.
        T_action_object: Object frame -> action frame at rest.
    """
    from foretrace.imagined.futures import carried_poses

    futures = imagined.futures
    if futures.is_point:
        return []
    others = [k for k in _in_order(futures)[1:] if futures.probability[0, k] >= LEAST_MOVING]
    return [carried_poses(futures.pose[0, k], T_action_object) for k in others]


def _in_order(futures: "Futures") -> list[int]:
    """Futures, the most probable one first."""
    return np.argsort(-futures.probability[0], kind="stable").tolist()


def radius_of(imagined: "ImaginedEffect") -> np.ndarray | None:
    """Radius of the region about the path [m]; None where the predictor does not tell, or nobody knows."""
    radius = imagined.futures.radius(LEVEL)[0, _in_order(imagined.futures)[0]]
    return radius if np.isfinite(radius).all() else None


def percentage(probability: float) -> str:
    """A probability as it is printed: nothing is certain."""
    if probability > SUREST:
        return f"over {SUREST:.1%}"
    return f"{probability:.1%}" if probability > 1 - SUREST else f"under {1 - SUREST:.1%}"


def say_futures(imagined: "ImaginedEffect") -> None:
    """Print outcomes, support edge and radius; what is unusual goes to the terminal as warnings."""
    for warning in imagined.warnings:
        say(f"warning: {warning}")
    futures = imagined.futures
    if futures.is_point:
        return
    probable = sorted(futures.outcomes().items(), key=lambda item: -item[1][0])
    print("outcome: " + ", ".join(f"{name} {percentage(probability[0])}" for name, probability in probable))
    (x0, y0), (x1, y1) = 100 * futures.support_points[0, _in_order(futures)[0]]
    print(
        f"turns about the edge from x {x0:.1f}, y {y0:.1f} to x {x1:.1f}, y {y1:.1f} cm in the action frame"
    )
    radius = radius_of(imagined)
    told = "not known: the validation part was too small" if radius is None else f"{100 * radius[-1]:.2f} cm"
    print(f"radius of the {LEVEL:.0%} region at the end: {told}")
