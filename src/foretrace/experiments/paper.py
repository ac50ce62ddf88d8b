"""The paper's comparisons carried out: trainings, what is measured, claims and figures (sections 5.1 to 5.3)."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from torch import Tensor
from tyro.conf import Fixed, Suppress

from foretrace.errors import ResultsError
from foretrace.evaluation.claims import by_cell, cell_table, claims_markdown
from foretrace.evaluation.experiment import Experiment, Row, kept_folder
from foretrace.evaluation.metrics import measure_errors
from foretrace.evaluation.storage import read_rows
from foretrace.evaluation.tables import markdown_table, mean_with_interval
from foretrace.experiments import SUMMARIES
from foretrace.experiments.paper_claims import CLAIMS
from foretrace.experiments.paper_comparisons import (
    COMPARISONS,
    SEEDS,
    PaperTrial,
    plan,
    ratio_of,
    shuffled,
    split_of,
)
from foretrace.experiments.paper_figures import FIGURES
from foretrace.experiments.support_points import support_point_metrics
from foretrace.experiments.training import BASE, Recipe, load_levered
from foretrace.experiments.twin import rows_of_twins
from foretrace.features import FEATURES, Option
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.splits import PAPER_SIZES
from foretrace.predictor import PREDICTORS
from foretrace.predictor.config import Device
from foretrace.predictor.run_folder import processor_independent_fingerprint

FITTED = "fitted"
"""Folder within the results for what features have learned on their own."""
KEY = ["experiment", "features", "seed", "setting", "metric"]
MEASURED = ("full", "accuracy")
"""The metrics that the report shows: error over the full trajectory [cm], share of right support points."""


@dataclass(frozen=True)
class Paper(Experiment):
    """The paper's comparisons of features, training sizes, steps ahead and novel shapes, its claims and its figures."""

    data: Path | None = None
    """Folder of the data set. Without one nothing is trained: results that are there are judged and drawn again."""
    experiments: tuple[str, ...] = ()
    """Which comparisons, in this order; by default all. An unknown one lists the choices."""
    features: tuple[str, ...] = ()
    """Which features; by default all."""
    settings: tuple[str, ...] = ()
    """Which settings of the comparisons; by default all."""
    seeds: tuple[int, ...] = SEEDS
    """Seeds of splits and trainings."""
    epochs: int | None = None
    """Passes over the training part, as in `foretrace train`."""
    proportional: bool = False
    """Split in the paper's proportions instead of its 1400, 100 and 300 interactions."""
    results: tuple[Path, ...] = ()
    """Folders of further results, which claims and figures take in."""
    twins: tuple[Path, ...] = ()
    """Folders of results of `foretrace evaluate twin`, which the figures show beside the predictors; what
    is in two of them counts once."""
    device: Device = "auto"
    """Where to compute."""
    recipes: Suppress[Fixed[Mapping[str, Recipe]]] = field(default_factory=dict)
    """Other settings than usual, by predictor."""
    feature_options: Suppress[Fixed[Mapping[str, Mapping[str, Option]]]] = field(default_factory=dict)
    """Settings of features, by label."""

    label = "paper"
    summary = SUMMARIES["paper"]
    trial = PaperTrial
    workers = None
    formats = ("png", "svg")

    def trials(self) -> Sequence[PaperTrial]:
        """Comparison by comparison, all of one seed before the next one; none without data."""
        trials = plan(self.experiments, self.features, self.settings, self.seeds)
        return [] if self.data is None else trials

    def identity(self) -> dict[str, Any] | None:
        """The levered interactions, and how predictors are trained."""
        if self.data is None:
            return None
        found = len(self._levered)
        if not self.proportional and found < sum(PAPER_SIZES):
            raise ResultsError(
                f"{self.data} has {found} levered interactions, the paper's comparisons need {sum(PAPER_SIZES)}: "
                "simulate more objects, or take the same proportions of what there is (--proportional)"
            )
        # Those of foretrace itself: a package that adds a predictor must not make a table another one.
        own = [name for name, kind in PREDICTORS.items() if kind.__module__.startswith("foretrace.")]
        recipes = {name: self._recipe(name).describe() for name in own}
        options = {label: dict(chosen) for label, chosen in self.feature_options.items()}
        recipe = {"predictors": recipes, "feature_options": options, "proportional": self.proportional}
        return {"data": processor_independent_fingerprint(self._levered), "recipe": recipe}

    def run(self, trial: PaperTrial, folder: Path) -> Sequence[Row]:
        """Accuracies, or errors [cm]; and the seconds of the training."""
        batch = self._levered
        split = split_of(trial, batch, self.proportional)
        if COMPARISONS[trial.experiment].of_corners:
            started = perf_counter()
            found = support_point_metrics(trial.features, batch, split, trial.seed, **self._options(trial))
            return _rows(found | {"seconds": perf_counter() - started})
        recipe = self.recipe_of(trial)
        inputs = self._inputs(recipe)
        # The only split that several trainings share.
        shared = COMPARISONS[trial.experiment].split is shuffled or trial.setting == "shuffled"
        fitted = kept_folder(folder, FITTED) if shared else None
        started = perf_counter()
        predictor, progress = recipe.fit(batch, split, inputs, fitted)
        seconds = perf_counter() - started
        metrics = measure_errors(predictor, batch[split.test], inputs[split.test])
        return _rows(
            metrics | {"best_epoch": progress.best_epoch, "epochs": progress.epoch, "seconds": seconds}
        )

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By comparison, features, setting and metric: mean over the seeds, 95 % interval, standard deviation."""
        summary: dict[str, Any] = {}
        for line in cell_table(self._with_more(rows), ratio_of).to_dict("records"):
            place = summary
            for name in ("experiment", "features", "setting"):
                place = place.setdefault(line[name], {})
            numbers = {name: float(f"{line[name]:.6g}") for name in ("mean", "low", "high", "std")}
            place[line["metric"]] = numbers | {"seeds": line["seeds"]}
        return summary

    def judge(self, rows: pd.DataFrame) -> list[dict[str, Any]]:
        """The paper's claims."""
        values = by_cell(self._with_more(rows))
        return [claim.evaluate(values, ratio_of) for claim in CLAIMS]

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """The claims, and a table for each comparison."""
        parts = ["# The paper's comparisons", "## The paper's claims", *claims_markdown(self.judge(rows))]
        for experiment, by_features in summary.items():
            measured = {m for settings in by_features.values() for cells in settings.values() for m in cells}
            metric = next((name for name in MEASURED if name in measured), None)
            if metric is None:
                continue
            unit = "share with both support points right" if metric == "accuracy" else "mean error in cm"
            settings = sorted(set(chain(*by_features.values())), key=lambda setting: (len(setting), setting))
            lines = [
                [f"`{label}`", *(_cell(cells.get(setting, {}).get(metric)) for setting in settings)]
                for label, cells in by_features.items()
            ]
            parts.append(f"## {experiment}: {unit}, 95 % interval (seeds)")
            parts.append(markdown_table(["features", *settings], lines))
        return "\n\n".join(parts) + "\n"

    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """The paper's figures 9 to 13, with what twins imagine of the same lever-ups."""
        simulated = [rows_of_twins(folder) for folder in self.twins]
        rows = pd.concat([self._with_more(rows), *simulated], ignore_index=True).drop_duplicates(KEY)
        drawn = {name: draw(rows) for name, draw in FIGURES.items()}
        return {name: figure for name, figure in drawn.items() if figure is not None}

    def recipe_of(self, trial: PaperTrial) -> Recipe:
        """How a trial's predictor is made and trained."""
        comparison = COMPARISONS[trial.experiment]
        where = {"seed": trial.seed, "device": self.device}
        if trial.features in FEATURES:
            steps = int(trial.setting) if comparison.varies_steps else None
            features = {"features": trial.features, "feature_options": self._options(trial)}
            varied = comparison.varied.get(trial.setting, {})
            return self._recipe(BASE).change(**features, steps_ahead=steps, **varied, **where)
        predictor, options = comparison.predictors.get(trial.features, (trial.features, {}))
        return self._recipe(predictor).change(**options, **where)

    @cached_property
    def _levered(self) -> InteractionBatch:
        assert self.data is not None
        return load_levered(self.data)

    @cached_property
    def _known_inputs(self) -> dict[str, Tensor]:
        return {}

    def _inputs(self, recipe: Recipe) -> Tensor:
        """Inputs of features for the whole data set, once in each process."""
        key = json.dumps([recipe.features, recipe.predictor.make_features().options], sort_keys=True)
        if key not in self._known_inputs:
            self._known_inputs[key] = recipe.inputs(self._levered)
        return self._known_inputs[key]

    def _recipe(self, predictor: str) -> Recipe:
        return self.recipes.get(predictor, Recipe.of(predictor)).change(epochs=self.epochs)

    def _options(self, trial: PaperTrial) -> dict[str, Option]:
        own = COMPARISONS[trial.experiment].options.get(trial.features, {})
        return {**self.feature_options.get(trial.features, {}), **own}

    def _with_more(self, rows: pd.DataFrame) -> pd.DataFrame:
        """The rows with those of further folders.

        Raises:
            ResultsError: A trial is in two of them.
        """
        table = pd.concat([rows, *(read_rows(folder) for folder in self.results)], ignore_index=True)
        if (twice := table.duplicated(KEY)).any():
            row = table[twice].iloc[0]
            raise ResultsError(
                f"{row.experiment}, {row.features}, seed {row.seed}, setting {row.setting} is in two folders: "
                "leave one out"
            )
        return table


def _rows(metrics: Mapping[str, float]) -> list[Row]:
    return [{"metric": name, "value": float(value)} for name, value in metrics.items()]


def _cell(numbers: Mapping[str, Any] | None) -> str:
    if numbers is None:
        return ""
    found = {name: None if pd.isna(numbers[name]) else numbers[name] for name in ("mean", "low", "high")}
    mean, _, ends = mean_with_interval(found).partition(" ")
    return f"{mean} ({numbers['seeds']}) {ends}".strip()
