"""Errors of predictors."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from foretrace.geometry import matrix_to_quaternion, quaternion_to_matrix
from foretrace.imagined import STARTS, ImaginedBatch
from foretrace.imagined.context import recorded_context
from foretrace.interactions.batch import InteractionBatch
from foretrace.predictor import EffectPredictor
from foretrace.predictor.states import valid_samples
from foretrace.trajectories import final_distance, mean_distance, rotation_error

METRICS = {"full": mean_distance, "final": final_distance}


def evaluate_predictor(predictor: EffectPredictor, batch: InteractionBatch) -> list[dict[str, Any]]:
    """Distances of imagined trajectories from observed ones (paper, section 5.2).

    Trajectories count up to where the object slipped off the blade.

    Returns:
        Rows with ``group`` (``all``, an outcome, or a number of corners such as ``4 corners``), ``metric`` (``full``:
        mean distance over the trajectory; ``final``: at its end), ``start`` (``observed``: the first sample was given;
        ``estimated``: from the view), ``count`` of interactions, and the error's ``mean_cm``, ``median_cm``,
        ``p95_cm``.
    """
    truth = np.where(valid_samples(batch)[..., None], batch.com, np.nan)
    rows = []
    for start in STARTS:
        imagined = at_times(predictor.imagine_batch(batch, start), batch.times)
        for metric, distance in METRICS.items():
            errors = 100 * np.asarray(distance(imagined, truth))
            for group, chosen in _groups(batch):
                row = {"group": group, "metric": metric, "start": start}
                rows.append(row | _summary(errors[chosen]))
    return rows


def at_times(imagined: ImaginedBatch, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "batch time 3"]:
    """Imagined centres of mass at the times of a recording [m]: on straight lines between samples, NaN past them."""
    if len(times) == len(imagined.times) and np.allclose(times, imagined.times, rtol=0, atol=1e-9):
        return imagined.com
    last = len(imagined.times) - 1
    places = np.clip(np.interp(times, imagined.times, np.arange(last + 1)), 0, last)
    before = np.minimum(places.astype(int), last - 1)
    share = (places - before)[:, None]
    found = (1 - share) * imagined.com[:, before] + share * imagined.com[:, before + 1]
    return np.where((times <= imagined.times[-1] + 1e-9)[:, None], found, np.nan)


def pose_errors(
    imagined: Float[np.ndarray, "batch time 7"],
    batch: InteractionBatch,
    valid: Bool[np.ndarray, "batch time"],
) -> dict[str, Float[np.ndarray, " batch"]]:
    """Distances of imagined poses from observed ones, averaged over time.

    Returns:
        ``rotation``: geodesic angle [degrees]. ``add``: mean distance of the object's lower and upper corners [cm]
        (Hinterstoisser et al., 2012).
    """
    observed = np.where(valid[..., None], batch.pose[..., 3:], batch.pose[:, :1, 3:])
    rotations = quaternion_to_matrix(observed)
    since_rest = rotations @ np.swapaxes(rotations[:, :1], -1, -2)
    told = quaternion_to_matrix(imagined[..., 3:])
    count = valid.sum(axis=1)
    angle = np.degrees(rotation_error(imagined[..., 3:], matrix_to_quaternion(since_rest)))
    height = batch.height.max(axis=(1, 2))
    apart = []
    for top in (0.0, 1.0):
        level = np.broadcast_to((top * height)[:, None, None], (*batch.corners.shape[:2], 1))
        points = np.concatenate([batch.corners, level], axis=2) - batch.com[:, :1]  # (batch, corners, 3)
        there = batch.com[:, :, None] + np.einsum("btij,bcj->btci", since_rest, points)
        here = imagined[:, :, None, :3] + np.einsum("btij,bcj->btci", told, points)
        apart.append(np.linalg.norm(here - there, axis=-1))
    distance = np.nanmean(np.concatenate(apart, axis=2), axis=2, where=valid[..., None])
    return {
        "rotation": np.where(valid, angle, 0.0).sum(axis=1) / count,
        "add": 100 * np.where(valid, distance, 0.0).sum(axis=1) / count,
    }


def _groups(batch: InteractionBatch) -> list[tuple[str, np.ndarray]]:
    """Name and members (batch,) of each group of interactions."""
    groups = [("all", np.ones(len(batch), dtype=bool))]
    groups += [(str(outcome), batch.outcome == outcome) for outcome in np.unique(batch.outcome)]
    groups += [(f"{n} corners", batch.num_corners == n) for n in np.unique(batch.num_corners)]
    return groups


def _summary(errors: np.ndarray) -> dict[str, float | int]:
    known = errors[np.isfinite(errors)]
    if len(known) == 0:
        return {"count": 0, "mean_cm": np.nan, "median_cm": np.nan, "p95_cm": np.nan}
    mean, median, p95 = np.mean(known), np.median(known), np.percentile(known, 95)
    return {"count": len(known), "mean_cm": float(mean), "median_cm": float(median), "p95_cm": float(p95)}


def measure_errors(
    predictor: EffectPredictor, batch: InteractionBatch, inputs: Shaped[Tensor, "batch ..."]
) -> dict[str, float]:
    """Errors of trajectories imagined from the observed first sample (paper, section 5.2), in cm.

    Returns:
        ``full`` and ``final``, means over the interactions; ``full_median`` and ``final_median``. Of a predictor of
        poses also ``rotation`` and ``rotation_median`` [degrees], and ``add`` and ``add_median`` [cm].
    """
    context = recorded_context(batch, predictor.context)
    features = predictor.add_context(predictor.compute_features(inputs), context)
    imagined = predictor.imagine_effects(features, batch.com[:, 0])
    valid = valid_samples(batch)
    truth = np.where(valid[..., None], batch.com, np.nan)
    errors = {name: 100 * np.asarray(distance(imagined.com, truth)) for name, distance in METRICS.items()}
    if imagined.pose is not None:
        errors |= pose_errors(imagined.pose, batch, valid)
    means = {name: float(np.mean(values)) for name, values in errors.items()}
    return means | {f"{name}_median": float(np.median(values)) for name, values in errors.items()}
