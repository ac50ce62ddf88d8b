"""How far to trust a predictor of several futures: probabilities, regions, samples, observed beginnings.

Whole records of all outcomes are learned and evaluated: an object that slips off the blade falls back, and that is an
effect, too. Split ``shuffled`` is the paper's. In ``novel-shapes``, objects of some corner counts are tested and the
others learned from, so regions whose widths were measured on known shapes meet shapes that they were not made for.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from tyro.conf import Fixed, Suppress

from foretrace.errors import DatasetError, ResultsError
from foretrace.evaluation.experiment import Experiment, Row, Trial, checked_seeds, kept_folder
from foretrace.evaluation.statistics import TEST_TO_TRAIN, interval
from foretrace.evaluation.tables import markdown_table, mean_with_interval
from foretrace.experiments import SUMMARIES
from foretrace.experiments.training import Recipe
from foretrace.experiments.uncertainty_figures import (
    BEGINNING_WORDS,
    SPLIT_WORDS,
    confusion_figure,
    observed_figure,
    reliability_figure,
)
from foretrace.experiments.uncertainty_metrics import (
    ALL,
    BEGINNINGS,
    FORECASTS,
    OBSERVED,
    SCORES,
    SHOWN_LEVELS,
    UNLIKE,
    measure,
)
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.splits import PAPER_SIZES, Split, split_by_corner_count, split_by_seed
from foretrace.predictor import OneShotPredictor, load_predictor
from foretrace.predictor.config import Device
from foretrace.predictor.run_folder import fingerprint
from foretrace.predictor.states import valid_lengths
from foretrace.predictor.trajectory_basis import FEW

Setting = Literal["shuffled", "novel-shapes"]
"""How the split is drawn."""
HELD_OUT = (5, 6)
"""Corner counts of novel shapes, by default."""
KEPT = "trainings"
"""Folder of the trainings within the results."""
PARTS = ("train", "validation", "test")
ERRORS = {
    "full": "Full [cm]",
    "final": "Final [cm]",
    "full_median": "Full, median [cm]",
    "until_slip_full": "Full, until slip [cm]",
    "until_slip_final": "Final, until slip [cm]",
    "nearest_full": "Nearest, full [cm]",
    "nearest_final": "Nearest, final [cm]",
    "futures": "Futures",
    "rotation": "Rotation, median [°]",
    "final_rotation": "Final rotation, median [°]",
}
DIGITS = 4


@dataclass(frozen=True)
class UncertaintyTrial(Trial):
    """One training and all that is measured of it."""

    split: str
    """A `Setting`."""
    seed: int
    """Seed of split, training and samples."""


@dataclass(frozen=True)
class Uncertainty(Experiment):
    """Evaluate what the one-shot predictor predicts: probabilities, regions, samples, and observed beginnings."""

    data: Path | None = None
    """Folder of the data set; all outcomes in it are learned and evaluated. Without one nothing is trained: results
    that are there are drawn again."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of splits, trainings and samples."""
    splits: tuple[Setting, ...] = ("shuffled", "novel-shapes")
    """shuffled: the paper's sizes, any interaction in any part. novel-shapes: tested on corner counts that were not
    learned from."""
    held_out: tuple[int, ...] = HELD_OUT
    """Corner counts of the novel shapes."""
    epochs: int | None = None
    """Passes over the training part, as in `foretrace train`."""
    samples: int = 100
    """Motions drawn at random for each interaction."""
    unlike: Path | None = None
    """Folder of a data set with other physics, sampled at the same times, for instance simulated with `--randomise`.
    The gain by observed beginnings is measured on it, too, for shuffled splits."""
    device: Device = "auto"
    """Where to train."""
    recipe: Suppress[Fixed[Recipe | None]] = None
    """Other settings of the trainings than the predictor's."""

    label = "uncertainty"
    summary = SUMMARIES["uncertainty"]
    trial = UncertaintyTrial
    formats = ("png", "svg")

    def __post_init__(self) -> None:
        checked_seeds(self.seeds)
        if not self.splits:
            raise ResultsError("no split is given: give shuffled, novel-shapes or both")
        if self.samples < 2:
            raise ResultsError(f"--samples is {self.samples}: give a number from 2")

    def trials(self) -> Sequence[UncertaintyTrial]:
        """Split by split, seed by seed; none without data."""
        if self.data is None:
            return []
        trials = [UncertaintyTrial(name, seed) for name in self.splits for seed in checked_seeds(self.seeds)]
        for trial in trials:
            self._split(trial)
        return trials

    def identity(self) -> dict[str, Any] | None:
        """The data, how predictors are trained, and what is measured."""
        if self.data is None:
            return None
        other = None if self._unlike is None else fingerprint(self._unlike)
        about = {"data": fingerprint(self._batch), "unlike": other, "recipe": self._recipe.describe()}
        return about | {"held_out": list(self.held_out), "samples": self.samples}

    def run(self, trial: UncertaintyTrial, folder: Path) -> Sequence[Row]:
        """As `measure`."""
        split = self._split(trial)
        outcomes = tuple(np.unique(self._batch.outcome).tolist())
        recipe = self._recipe.change(outcomes=outcomes, seed=trial.seed)
        out = kept_folder(folder, KEPT) / f"{trial.split}-{trial.seed}"
        predictor = load_predictor(recipe.train(self._batch, split, out))
        assert isinstance(predictor, OneShotPredictor)
        unlike = self._unlike if trial.split == "shuffled" else None
        return measure(predictor, self._batch, split, trial.seed, self.samples, unlike).to_dict("records")

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """Means over the seeds and their 95 % intervals.

        By split: ``seeds``; ``values``, by metric, group and, if there are any, level; ``few``: outcomes of which some
        part has fewer than `FEW` examples. Regions are shown at `SHOWN_LEVELS` only.
        """
        summary: dict[str, Any] = {}
        shown = rows.loc[rows["metric"].ne("coverage") | rows["level"].isin(SHOWN_LEVELS)]
        for split in dict.fromkeys(shown["split"]):
            mine = shown.loc[shown["split"].eq(split)]
            values: dict[str, Any] = {}
            ratio = test_to_train(mine)
            places = mine.groupby(["metric", "group", "level"], dropna=False, sort=False)
            for (metric, group, level), part in places:
                numbers = _numbers(part.sort_values("seed")["value"].to_numpy(float), ratio)
                place = values.setdefault(metric, {})
                if np.isfinite(level):
                    place.setdefault(group, {})[f"{level:g}"] = numbers
                else:
                    place[group] = numbers
            counts = mine.loc[mine["metric"].str.startswith("count_")]
            few = sorted(set(counts.loc[counts["value"].lt(FEW), "group"]))
            summary[split] = {"seeds": sorted(map(int, set(mine["seed"]))), "few": few, "values": values}
        return summary

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """All tables, split by split."""
        parts = ["# Several futures, evaluated", "Means over the seeds, 95 % intervals in brackets."]
        for split, found in summary.items():
            values = found["values"]
            seeds = ", ".join(map(str, found["seeds"]))
            parts += [f"## {SPLIT_WORDS.get(split, split)}, seeds {seeds}", *_examples(values, found["few"])]
            parts += ["### Outcomes", *_outcomes(values)]
            parts += ["### Errors of the most probable and of the nearest future", _errors(values)]
            parts += ["### Regions", *_regions(values)]
            parts += ["### Scores of samples; less is better", _scores(values)]
            parts += ["### The rest of the motion, after some samples were observed", *_observed(values)]
            if f"{UNLIKE}{BEGINNINGS[0]}_rest" in values:
                parts += ["### The same of lever-ups with other physics than those learned from"]
                parts += _observed(values, UNLIKE)
        return "\n\n".join(parts) + "\n"

    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Coverage of regions, gain by observed samples, and confusion of outcomes."""
        return {
            "reliability": reliability_figure(rows),
            "observed": observed_figure(rows),
            "confusion": confusion_figure(rows),
        }

    @cached_property
    def _batch(self) -> InteractionBatch:
        assert self.data is not None
        return load(self.data)

    @cached_property
    def _unlike(self) -> InteractionBatch | None:
        return None if self.unlike is None else load(self.unlike, like=self._batch)

    @cached_property
    def _recipe(self) -> Recipe:
        recipe = Recipe.of(OneShotPredictor.label) if self.recipe is None else self.recipe
        return recipe.change(epochs=self.epochs, device=self.device)

    def _split(self, trial: UncertaintyTrial) -> Split:
        return split_of(self._batch, trial.split, trial.seed, self.held_out)


def load(data: str | Path, like: InteractionBatch | None = None) -> InteractionBatch:
    """All interactions that have a motion to learn from, sampled at the same times as the other ones, if any.

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


def split_of(batch: InteractionBatch, setting: str, seed: int, held_out: Collection[int] = HELD_OUT) -> Split:
    """Parts of the paper's sizes, or its proportions of fewer data; or with novel shapes as the test part."""
    if setting == "novel-shapes":
        return split_by_corner_count(batch.num_corners, held_out, seed)
    return split_by_seed(len(batch), seed, PAPER_SIZES if len(batch) >= sum(PAPER_SIZES) else None)


def test_to_train(rows: pd.DataFrame) -> float:
    """Size of the test part divided by that of the training part."""
    test, train = (rows.loc[rows["metric"].eq(f"count_{part}"), "value"].sum() for part in ("test", "train"))
    return float(test / train) if test and train else TEST_TO_TRAIN


def _numbers(values: np.ndarray, ratio: float) -> dict[str, float | None]:
    if not np.isfinite(values).all():  # a region that is everything has no width
        return dict.fromkeys(("mean", "low", "high"))
    return interval(values, ratio).as_dict(DIGITS)


def _examples(values: Mapping[str, Any], few: Sequence[str]) -> list[str]:
    lines = [
        [_name(outcome), *(f"{values[f'count_{part}'][outcome]['mean']:.4g}" for part in PARTS)]
        for outcome in values["count_test"]
    ]
    named = ", ".join(map(_name, few))
    notes = [f"Too few examples (fewer than {FEW} in some part of some split) of: {named}."] if few else []
    return ["Interactions in each part:", markdown_table(["Outcome", *PARTS], lines), *notes]


def _outcomes(values: Mapping[str, Any]) -> list[str]:
    macro, right, common, brier = (
        _cell(values[name][ALL]) for name in ("macro_f1", "accuracy", "accuracy_of_most_common", "brier")
    )
    text = (
        f"Macro-F1 {macro}; accuracy {right} ({common} for naming the most common one); Brier score {brier}."
    )
    names, lines = list(values["count_test"]), []
    for name in names:
        counts = (f"{values['confusion'][f'{name}, predicted {other}']['mean']:.4g}" for other in names)
        lines.append([_name(name), *counts, _cell(values["f1"].get(name))])
    return [text, markdown_table(["Happened", *(f"predicted `{name}`" for name in names), "F1"], lines)]


def _errors(values: Mapping[str, Any]) -> str:
    lines = [[_name(group), *(_cell(values[m][group]) for m in ERRORS)] for group in values["full"]]
    return markdown_table(["", *ERRORS.values()], lines)


def _regions(values: Mapping[str, Any]) -> list[str]:
    found = []
    for metric, words, digits in (
        ("coverage", "Share of motions that stay within a tube all the time:", 3),
        ("tube", "Median radius of the most probable future's tube [cm]:", 2),
    ):
        lines = [
            [_name(group), *(_cell(by_level[f"{level:g}"], digits) for level in SHOWN_LEVELS)]
            for group, by_level in values[metric].items()
        ]
        found += [words, markdown_table(["", *(f"{level:.0%}" for level in SHOWN_LEVELS)], lines)]
    return found


def _scores(values: Mapping[str, Any]) -> str:
    lines = [
        [words, _name(group), *(_cell(values[f"{forecast}_{name}"][group]) for name in SCORES)]
        for forecast, words in FORECASTS.items()
        for group in values[f"{forecast}_crps"]
    ]
    return markdown_table(["Samples of", "", *SCORES.values()], lines)


def _observed(values: Mapping[str, Any], prefix: str = "") -> list[str]:
    found = []
    for name in BEGINNINGS:
        rest, ratio, f1 = (values[f"{prefix}{name}_{m}"] for m in ("rest", "rest_ratio", "macro_f1"))
        levels = [f"{k}" for k in OBSERVED if f"{k}" in rest.get(ALL, {})]
        rows = {}
        for group in rest:
            rows[f"{_name(group)}, error [cm]"] = rest[group]
            rows[f"{_name(group)}, ÷ unobserved"] = ratio[group]
        rows["Macro-F1 of outcomes"] = f1[ALL]
        lines = [[words, *(_cell(by_level.get(k)) for k in levels)] for words, by_level in rows.items()]
        table = markdown_table(["Observed samples", *levels], lines)
        found += [f"Samples counted {BEGINNING_WORDS[name]}:", table]
    return found


def _name(group: str) -> str:
    return "All" if group == ALL else f"`{group}`"


def _cell(numbers: Mapping[str, float | None] | None, digits: int = 3) -> str:
    return mean_with_interval(numbers, digits, missing="-")
