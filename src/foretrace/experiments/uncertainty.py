"""How far to trust a predictor that tells of several futures: probabilities, regions, samples, observed beginnings.

Whole records of all outcomes are learned and judged: an object that slips off the blade falls back, and that is an
effect, too. Split ``shuffled`` is the paper's. In ``novel-shapes``, objects of some corner counts are tested and the
others learned from, so regions whose widths were measured on known shapes meet shapes that they were not made for.
"""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from foretrace.errors import DatasetError
from foretrace.experiments.uncertainty_metrics import (
    UNLIKE,
    Part,
    futures_of,
    judge_errors,
    judge_observed,
    judge_outcomes,
    judge_regions,
)
from foretrace.experiments.uncertainty_scores import constant_deviations, draw, score
from foretrace.interactions.dataset import Dataset, InteractionBatch
from foretrace.interactions.splits import PAPER_SIZES, Split, split_by_corner_count, split_by_seed
from foretrace.predictor import RECIPES, OneShotPredictor, TrainConfig, train_predictor
from foretrace.predictor.states import valid_lengths

Setting = Literal["shuffled", "novel-shapes"]
SETTINGS: tuple[Setting, ...] = ("shuffled", "novel-shapes")
"""How the split is drawn."""
HELD_OUT = (5, 6)
"""Corner counts of novel shapes, by default."""
RECIPE = RECIPES[OneShotPredictor.label]
"""What predictors are trained with; outcomes and seed are replaced."""


def load(data: str | Path, like: InteractionBatch | None = None) -> InteractionBatch:
    """All interactions that have a motion to learn from, whatever became of the objects.

    Args:
        data: Folder of the data set.
        like: Others that have to be sampled at the same times.

    Raises:
        DatasetError: There is no data set, none of its interactions has two samples, or they are sampled otherwise.
    """
    batch = Dataset.open(data).batch()
    batch = batch[valid_lengths(batch) >= 2]
    if len(batch) == 0:
        raise DatasetError(f"no interaction of {data} has a motion of two samples: simulate more objects")
    if like is not None and not np.array_equal(batch.times, like.times):
        raise DatasetError(
            f"{data} has {len(batch.times)} samples up to {batch.times[-1]:g} s, the data that are learned from "
            f"{len(like.times)} up to {like.times[-1]:g} s: simulate both with the same settings"
        )
    return batch


def split_of(
    batch: InteractionBatch, setting: Setting, seed: int, held_out: Collection[int] = HELD_OUT
) -> Split:
    """Parts of the paper's sizes, or its proportions of fewer data; or with novel shapes as the test part."""
    if setting == "novel-shapes":
        return split_by_corner_count(batch.num_corners, held_out, seed)
    return split_by_seed(len(batch), seed, PAPER_SIZES if len(batch) >= sum(PAPER_SIZES) else None)


def train(
    batch: InteractionBatch, out: Path, seed: int, split: Split, config: TrainConfig, progress: bool = True
) -> Path:
    """Train on all outcomes that occur, unless that is done already.

    Args:
        batch: The interactions.
        out: Folder of the training; one that was cut short goes on.
        seed: Of the training.
        split: As from `split_of`.
        config: Further settings; outcomes and seed are replaced.
        progress: Show a progress bar.

    Returns:
        The folder.

    Raises:
        TrainingError: It holds another training.
    """
    outcomes = tuple(np.unique(batch.outcome).tolist())
    return train_predictor(
        batch, replace(config, outcomes=outcomes, seed=seed), out, split=split, progress=progress
    )


def measure(
    predictor: OneShotPredictor,
    batch: InteractionBatch,
    split: Split,
    seed: int,
    samples: int = 100,
    unlike: InteractionBatch | None = None,
) -> pd.DataFrame:
    """All that is to be told about one predictor.

    Args:
        predictor: The predictor.
        batch: The interactions.
        split: Those of its training. The validation part fits the forecasts that its samples are compared with.
        seed: Seed of the samples.
        samples: Motions drawn at random for each interaction.
        unlike: Interactions with other physics than those learned from, sampled alike. Of these, only what observed
            samples are worth is judged; their metrics begin with `UNLIKE`.

    Returns:
        ``metric``, ``group`` (`uncertainty_metrics.ALL` or an outcome; of ``confusion``, what happened and what was
        said), ``level`` (of a region, or the number of observed samples; else NaN), ``value``. The page on uncertainty
        tells what metrics mean.
    """
    test, validation = (Part.of(predictor, batch[rows]) for rows in (split.test, split.validation))
    parts = {"train": split.train, "validation": split.validation, "test": split.test}
    found = [
        (f"count_{name}", outcome, np.nan, float(np.sum(batch.outcome[rows] == outcome)))
        for outcome in predictor.outcomes
        for name, rows in parts.items()
    ]
    imagined = test.imagine(predictor)
    found += judge_outcomes(futures_of(imagined).outcomes(), test.batch.outcome)
    found += judge_errors(imagined, test)
    found += judge_regions(futures_of(imagined), test)
    mixture = test.mixture(predictor)
    deviations = constant_deviations(validation.imagine(predictor).com - validation.com, validation.valid)
    for name, drawn in draw(mixture, imagined.com, deviations, samples, seed):
        for metric, values in score(drawn, test.com, test.valid).items():
            found += test.means(f"{name}_{metric}", values)
    found += judge_observed(predictor, test)
    if unlike is not None:
        other = Part.of(predictor, unlike[np.isin(unlike.outcome, predictor.outcomes)])
        found += [(UNLIKE + metric, *row) for metric, *row in judge_observed(predictor, other)]
    return pd.DataFrame(found, columns=["metric", "group", "level", "value"])
