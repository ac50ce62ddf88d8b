"""The paper's comparisons carried out: trainings, what is measured, and where it is kept (sections 5.1 to 5.3)."""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import joblib
import torch
from rich.console import Console
from torch import Tensor

from foretrace.errors import ResultsError
from foretrace.evaluation.metrics import measure_errors
from foretrace.evaluation.results import Metrics, ResultsTable, Trial, describe_machine, finished_trials
from foretrace.evaluation.runner import Failure, run_trials
from foretrace.experiments.paper_trials import ABLATIONS, EXPERIMENTS, ONE_SHOT, plan, shuffled, split_of
from foretrace.experiments.support import support_point_metrics
from foretrace.features import Option, make_features
from foretrace.features.base import fast_precision
from foretrace.interactions.dataset import Dataset, InteractionBatch
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import PAPER_SIZES, Split
from foretrace.predictor import RECIPES, TrainConfig
from foretrace.predictor.checkpoint import settings_of
from foretrace.predictor.run_folder import fingerprint
from foretrace.predictor.runtime import find_device, thread_count
from foretrace.predictor.states import valid_lengths
from foretrace.predictor.training import fit_predictor

FITTED = "fitted"
"""Folder within the results for what features have learned on their own."""
Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class Recipe:
    """What decides the results beside data and trial."""

    training: TrainConfig = field(default_factory=TrainConfig)
    """Settings of all trainings; features, steps ahead, seed and surroundings are replaced by the trial's."""
    feature_options: Mapping[str, Mapping[str, Option]] = field(default_factory=dict)
    """Settings of features, by label."""
    proportional: bool = False
    """Whether splits have the paper's proportions instead of its sizes."""
    one_shot: TrainConfig = RECIPES[ONE_SHOT]
    """Settings of the trainings of whole motions; seed and surroundings are replaced likewise."""

    def describe(self) -> dict[str, Any]:
        """As one level of JSON-able settings."""
        replaced = {"features", "feature_options", "steps_ahead", "outcomes", "split", "seed"}
        replaced |= {"device", "precision", "threads"}
        settings, one_shot = (
            {name: value for name, value in settings_of(config).items() if name not in replaced}
            for config in (self.training, self.one_shot)
        )
        options = {label: dict(chosen) for label, chosen in self.feature_options.items()}
        more = {"feature_options": options, "proportional": self.proportional, "one_shot": one_shot}
        return settings | more

    def options(self, trial: Trial) -> dict[str, Option]:
        """Settings of one trial's features."""
        own = EXPERIMENTS[trial.experiment].options.get(trial.features, {})
        return {**self.feature_options.get(trial.features, {}), **own}

    def configure(self, trial: Trial) -> TrainConfig:
        """Settings of one trial's training."""
        experiment = EXPERIMENTS[trial.experiment]
        if trial.features == ONE_SHOT or trial.features in ABLATIONS:
            surroundings = {name: getattr(self.training, name) for name in ("device", "threads", "precision")}
            options = ABLATIONS.get(trial.features, {})
            return replace(
                self.one_shot, predictor_options=options, seed=trial.seed, split=None, **surroundings
            )
        options = self.options(trial)
        config = replace(
            self.training, features=trial.features, feature_options=options, seed=trial.seed, split=None
        )
        return replace(config, steps_ahead=int(trial.setting)) if experiment.varies_steps else config


@dataclass(frozen=True)
class PaperWork:
    """Carries out a trial, in whatever process it finds itself."""

    data: str
    """Folder of the data set."""
    fingerprint: str
    """Of its levered interactions."""
    out: str
    """The results folder."""
    recipe: Recipe
    """What all trials have in common."""

    def __call__(self, trial: Trial) -> Metrics:
        """What the trial found: accuracies, or errors [cm]; and the seconds that it took to train."""
        batch = _levered_once(self.data, self.fingerprint)
        split = split_of(trial, batch, self.recipe.proportional)
        named = EXPERIMENTS[trial.experiment].names_corners
        config = self.recipe.training if named else self.recipe.configure(trial)
        with thread_count(config.threads):
            if named:
                started = perf_counter()
                options = self.recipe.options(trial)
                found = support_point_metrics(trial.features, batch, split, trial.seed, **options)
                return found | {"seconds": perf_counter() - started}
            return self._train(trial, config, batch, split)

    def _train(self, trial: Trial, config: TrainConfig, batch: InteractionBatch, split: Split) -> Metrics:
        options = tuple(sorted(config.feature_options.items()))
        inputs = _inputs_once(self.data, self.fingerprint, config.features, options)
        # The only split that several trainings share.
        shared = EXPERIMENTS[trial.experiment].split is shuffled or trial.setting == "shuffled"
        fitted = Path(self.out) / FITTED if shared else None
        started = perf_counter()
        predictor, progress = fit_predictor(batch, config, split, inputs=inputs, fitted=fitted)
        seconds = perf_counter() - started
        metrics = measure_errors(predictor, batch[split.test], inputs[split.test])
        return metrics | {"best_epoch": progress.best_epoch, "epochs": progress.epoch, "seconds": seconds}


def load_levered(data: str | Path) -> InteractionBatch:
    """The interactions of a data set that the paper learns from: levered, and at least two samples long."""
    batch = Dataset.open(data).where(outcome=str(Outcome.LEVERED)).batch()
    return batch[valid_lengths(batch) >= 2]


@lru_cache(maxsize=1)
def _levered_once(data: str, fingerprint: str) -> InteractionBatch:
    """`load_levered`, once per process; the fingerprint tells a data set from another at the same place."""
    with warnings.catch_warnings(action="ignore"):  # the parent has warned
        return load_levered(data)


@lru_cache(maxsize=32)
def _inputs_once(data: str, fingerprint: str, label: str, options: tuple[tuple[str, Option], ...]) -> Tensor:
    """Inputs of features for the whole data set, once per process."""
    return make_features(label, **dict(options)).inputs(_levered_once(data, fingerprint))


def run_protocol(
    data: str | Path,
    out: str | Path,
    trials: Sequence[Trial] | None = None,
    recipe: Recipe | None = None,
    *,
    workers: int | None = None,
    threads: int = 1,
    device: Device = "auto",
    console: Console | None = None,
) -> list[Failure]:
    """Carry out the paper's comparisons, or what is missing of them.

    It may be stopped at any time; the same call goes on. What a trial finds depends on the data, the recipe and the
    number of threads, and neither on the number of workers nor on what else was asked for.

    Args:
        data: Folder of the data set.
        out: Folder of the results; `foretrace.evaluation.results.read_results` reads it.
        trials: What to carry out; by default all of `plan`.
        recipe: What they have in common; the paper's by default.
        workers: Processes; by default one for each core, and a single one with a CUDA device.
        threads: Threads of PyTorch in each of them.
        device: Where to compute.
        console: Where progress is reported; standard error by default.

    Returns:
        The trials that failed.

    Raises:
        ResultsError: The data is smaller than the paper's, or the folder is in use or holds other results.
    """
    trials = plan() if trials is None else trials
    found = find_device(device).type
    if workers is None:
        workers = 1 if found == "cuda" else joblib.cpu_count()
    for name, value in (("workers", workers), ("threads", threads)):
        if value < 1:
            raise ResultsError(f"{name} is {value}, it must be at least 1")
    recipe = recipe or Recipe()
    recipe = replace(recipe, training=replace(recipe.training, device=found, threads=threads))
    identity = _identity(data, recipe)
    precision = recipe.training.precision
    precision = fast_precision(torch.device(found)) if precision == "auto" else precision
    machine = describe_machine(found, workers, threads) | {"precision": precision}
    with ResultsTable(out, identity, machine) as table:
        fitted = Path(out) / FITTED
        fitted.mkdir(exist_ok=True)
        (fitted / ".gitignore").write_text("*\n", encoding="utf-8")
        work = PaperWork(str(data), identity["data"], str(out), recipe)
        return run_trials(trials, work, table, workers=workers, threads=threads, console=console)


def count_missing(
    data: str | Path, out: str | Path, trials: Sequence[Trial], recipe: Recipe | None = None
) -> dict[str, int]:
    """How many of the trials of each experiment `run_protocol` would carry out.

    Raises:
        ResultsError: As `run_protocol`.
    """
    done = finished_trials(out, _identity(data, recipe or Recipe()))
    missing = Counter(trial.experiment for trial in trials if trial not in done)
    return {name: missing[name] for name in dict.fromkeys(trial.experiment for trial in trials)}


def _identity(data: str | Path, recipe: Recipe) -> dict[str, Any]:
    batch = load_levered(data)
    if not recipe.proportional and len(batch) < sum(PAPER_SIZES):
        raise ResultsError(
            f"{data} has {len(batch)} levered interactions, the paper's comparisons need {sum(PAPER_SIZES)}: simulate "
            "more objects, or take the same proportions of what there is (--proportional)"
        )
    return {"data": fingerprint(batch), "recipe": recipe.describe()}
