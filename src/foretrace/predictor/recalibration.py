"""Calibrating a trained predictor anew, on interactions that it has not learned from."""

from pathlib import Path

import numpy as np
import torch

from foretrace.errors import TrainingError, check_type
from foretrace.files import as_path, write_json
from foretrace.imagined import STARTS, conformal_scores
from foretrace.interactions.dataset import Dataset
from foretrace.predictor.checkpoint import CALIBRATION, CONFIG, read_config, read_predictor, write_tensors
from foretrace.predictor.parts import effects_of, features_of, outcome_of, prepare, usable_lengths
from foretrace.predictor.run_folder import MODEL, RunFolder, fingerprint
from foretrace.trajectories import rhythm

FEWEST = 200
"""Fewer interactions say little about a 95 % region."""
SHOWN_LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Levels of the regions that are shown to people."""


def recalibrate(run: str | Path, data: Dataset) -> dict[str, list[float]]:
    """Fit the probabilities and prediction regions of a trained predictor to interactions that it did not learn from.

    Its motions stay as they are. Interactions like those that it will be used for make its regions hold for these.

    Args:
        run: Folder of the finished training; its model is replaced.
        data: The interactions, of which those are taken whose outcome the predictor distinguishes.

    Returns:
        For a start that was observed, and one that was estimated from the view: shares of the motions that stayed in
        regions of 50, 80, 90 and 95 % before.

    Raises:
        TrainingError: The training is not finished, its predictor has no regions, or the data are those that it was
            trained on, or too few.
        CheckpointError: The folder holds no predictor.
    """
    folder = RunFolder(as_path(run, TrainingError))
    check_type("data", data, Dataset, TrainingError)
    config, predictor = read_config(folder.path), read_predictor(folder.path)
    if not folder.finished:
        raise TrainingError(
            f"the training in {folder.path} is not finished: the command that began it goes on"
        )
    known = predictor.outcomes or predictor.learned_from
    usable = np.isin(outcome_of(data), known) & (usable_lengths(data) >= 2)
    if usable.sum() < FEWEST:
        raise TrainingError(
            f"{usable.sum()} interactions have an outcome that the predictor distinguishes: give at least {FEWEST}"
        )
    identity = fingerprint(data, predictor.context)
    if identity == config.get("training", {}).get("data"):
        raise TrainingError("the predictor was trained on these data: give others, as of another --seed")
    chosen = data[np.flatnonzero(usable)].batch()
    if not np.array_equal(np.round(chosen.times, 9), np.round(predictor.sample_times, 9)):
        raise TrainingError(
            f"the data are sampled {rhythm(chosen.times)}, the predictor imagines motions "
            f"{rhythm(predictor.sample_times)}: simulate with the same --sample-period and --watch-time"
        )
    part = prepare(chosen, predictor)
    uniform = np.isfinite(part.estimated_com).all(axis=1)
    held = {}
    for start in STARTS:
        futures = predictor.imagine_batch(chosen, start, context="recorded").futures
        scores = conformal_scores(futures, np.nan_to_num(chosen.com), predictor.lengths(chosen))
        rows = uniform if start == "estimated" else np.ones(len(chosen), dtype=bool)
        held[start] = [float(np.mean((scores <= futures.width(level))[rows])) for level in SHOWN_LEVELS]
    with folder.claimed(), torch.no_grad():
        predictor.calibrate(features_of(part, predictor), effects_of(part, predictor))
        write_tensors(folder.path / MODEL, predictor.state_dict())
        write_json(
            folder.path / CONFIG,
            config | {CALIBRATION: {"data": identity, "interactions": len(chosen)}},
        )
    return held
