"""Questions put to predictors, one function each; the answers are rows, which tables and figures read."""

from typing import Any

import numpy as np

from foretrace.interactions.dataset import InteractionBatch
from foretrace.predictor import EffectPredictor
from foretrace.predictor.base import Start
from foretrace.predictor.states import valid_samples
from foretrace.trajectories import final_distance, mean_distance

STARTS: tuple[Start, ...] = ("observed", "estimated")
METRICS = {"full": mean_distance, "final": final_distance}


def evaluate_predictor(predictor: EffectPredictor, batch: InteractionBatch) -> list[dict[str, Any]]:
    """How far imagined trajectories are from observed ones (paper, section 5.2).

    Trajectories are judged up to where the object slipped off the blade.

    Args:
        predictor: The predictor.
        batch: The interactions to judge it by.

    Returns:
        Rows with ``group`` (``all``, ``outcome``, ``corners``) and ``value`` (which outcome, how many corners),
        ``metric`` (``full``: mean distance over the trajectory; ``final``: at its end), ``start`` (``observed``:
        the first sample was given; ``estimated``: it was guessed from the view), ``count`` of interactions, and
        the error's ``mean_cm``, ``median_cm``, ``p95_cm``.
    """
    truth = np.where(valid_samples(batch)[..., None], batch.com, np.nan)
    rows = []
    for start in STARTS:
        imagined = predictor.imagine_batch(batch, start).com
        for metric, distance in METRICS.items():
            errors = 100 * np.asarray(distance(imagined, truth))
            for group, value, chosen in _groups(batch):
                row = {"group": group, "value": value, "metric": metric, "start": start}
                rows.append(row | _summary(errors[chosen]))
    return rows


def _groups(batch: InteractionBatch) -> list[tuple[str, str, np.ndarray]]:
    """Name, value and members (batch,) of each group of interactions."""
    groups = [("all", "", np.ones(len(batch), dtype=bool))]
    groups += [("outcome", str(outcome), batch.outcome == outcome) for outcome in np.unique(batch.outcome)]
    groups += [("corners", str(n), batch.num_corners == n) for n in np.unique(batch.num_corners)]
    return groups


def _summary(errors: np.ndarray) -> dict[str, float | int]:
    known = errors[np.isfinite(errors)]
    if len(known) == 0:
        return {"count": 0, "mean_cm": np.nan, "median_cm": np.nan, "p95_cm": np.nan}
    mean, median, p95 = np.mean(known), np.median(known), np.percentile(known, 95)
    return {"count": len(known), "mean_cm": float(mean), "median_cm": float(median), "p95_cm": float(p95)}
