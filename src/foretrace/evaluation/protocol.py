"""The paper's comparisons: which trainings each needs, and what is measured (sections 5.1 to 5.3)."""

import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import joblib
import numpy as np
import torch
from jaxtyping import Shaped
from rich.console import Console
from torch import Tensor

from foretrace.errors import ResultsError
from foretrace.evaluation.experiments import METRICS, pose_errors
from foretrace.evaluation.results import Metrics, ResultsTable, Trial, describe_machine, finished_trials
from foretrace.evaluation.runner import Failure, run_trials
from foretrace.evaluation.support import support_point_metrics
from foretrace.features import FEATURES, Option, Outline, make_features
from foretrace.features.base import fast_precision
from foretrace.interactions.dataset import Dataset, InteractionBatch
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import (
    PAPER_SIZES,
    Split,
    scaled_sizes,
    split_by_corner_count,
    split_by_object,
    split_by_seed,
)
from foretrace.predictor import RECIPES, EffectPredictor, OneShotPredictor, TrainConfig
from foretrace.predictor.checkpoint import settings_of
from foretrace.predictor.known import observed_values
from foretrace.predictor.run_folder import fingerprint
from foretrace.predictor.states import valid_lengths, valid_samples
from foretrace.predictor.surroundings import find_device, thread_count
from foretrace.predictor.training import fit_predictor

SEEDS = tuple(range(10))
"""The paper's ten randomisation seeds."""
FITTED = "fitted"
"""Folder within the results for what features have learned on their own."""
Device = Literal["auto", "cpu", "cuda"]


# --- what is compared -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Experiment:
    """One of the paper's comparisons."""

    features: tuple[str, ...]
    """What is compared."""
    settings: tuple[str, ...]
    """What is varied."""
    split: Callable[[InteractionBatch, str, int, bool], Split]
    """Parts of the levered interactions, by setting and seed; in the paper's sizes, or proportions if true."""
    options: Mapping[str, Mapping[str, Option]] = field(default_factory=dict)
    """Options of features that make the difference, by label."""
    names_corners: bool = False
    """Whether naming the support corners is judged, and no predictor trained."""
    varies_steps: bool = False
    """Whether the setting is the number of states predicted per iteration."""
    on_request: bool = False
    """Whether it is only carried out where somebody names it: it needs more data than the paper's."""


def _shuffled(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    return split_by_seed(len(batch), seed, None if proportional else PAPER_SIZES)


def _shuffled_or_by_object(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    if setting == "by-object":
        return split_by_object(batch.object_ids, seed)
    return _shuffled(batch, setting, seed, proportional)


def _share_of_training(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """So many percent of the training part; the smaller share is part of the larger."""
    whole = _shuffled(batch, setting, seed, proportional)
    order = np.random.default_rng([seed, 1]).permutation(whole.train)
    return replace(whole, train=np.sort(order[: _percent(setting, len(order))]))


def _share_of_all(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """So many percent train, 100 validate, all others test; the smaller training part is part of the larger."""
    order = np.random.default_rng(seed).permutation(len(batch))
    validation = scaled_sizes(len(batch))[1] if proportional else PAPER_SIZES[1]
    parts = np.split(order, [validation, validation + _percent(setting, len(batch))])
    return Split(train=np.sort(parts[1]), validation=np.sort(parts[0]), test=np.sort(parts[2]))


def _count_of_all(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """So many train, and 100 validate and 300 test, the same for all; the smaller part is part of the larger."""
    _, validation, test = scaled_sizes(len(batch)) if proportional else PAPER_SIZES
    if (needed := int(setting) + validation + test) > len(batch):
        raise ResultsError(
            f"setting {setting} needs {needed} levered interactions, the data has {len(batch)}: simulate more objects, "
            "or choose smaller settings"
        )
    order = np.random.default_rng(seed).permutation(len(batch))
    ends = np.cumsum([validation, test, int(setting)])
    return Split(
        train=np.sort(order[ends[1] : ends[2]]),
        validation=np.sort(order[: ends[0]]),
        test=np.sort(order[ends[0] : ends[1]]),
    )


def _novel_corners(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    return split_by_corner_count(batch.num_corners, [int(count) for count in setting.split("&")], seed)


def _percent(setting: str, whole: int) -> int:
    return max(1, round(int(setting) / 100 * whole))


_CORNERS = ("3&4", "5&6", "7&8", "9&10")
_SUPPORT = ("sp-pred", "sp-rule", "chance")
_SHAPE_CONTEXTS = ("sc-200", "sc-800", "sc-3200")
_PLAIN_SUPPORT: dict[str, dict[str, Option]] = {
    "sp-pred": {"aligned": False, "snapped": False, "epochs": 500, "batch_size": 32},
    "sp-rule": {"setback": 0.0, "half_width": 0.0},
}
_ALL = tuple(label for label in FEATURES if label != Outline.label)
ONE_SHOT = OneShotPredictor.label
"""Compared as if it was another feature: the predictor of whole motions, which reads outlines."""
_ABLATIONS: dict[str, dict[str, Option]] = {
    "one hinge": {"hinges": 1},
    "one network": {"members": 1},
    "no mirror": {"mirrored": False},
    "8 motions": {"motions": 8},
}
"""What the predictor of whole motions is without one of its parts, by its options."""

EXPERIMENTS: dict[str, Experiment] = {
    "support-points": Experiment(
        _SUPPORT, ("5", "10", "25", "50", "75", "100"), _share_of_training, names_corners=True
    ),
    "support-points-novel": Experiment(_SUPPORT, _CORNERS, _novel_corners, names_corners=True),
    "support-points-plain": Experiment(
        tuple(_PLAIN_SUPPORT), ("100",), _share_of_training, _PLAIN_SUPPORT, names_corners=True
    ),
    "features": Experiment((*_ALL, ONE_SHOT), ("shuffled", "by-object"), _shuffled_or_by_object),
    "half-plane": Experiment(
        _SHAPE_CONTEXTS, ("shuffled",), _shuffled, {name: {"half_plane": True} for name in _SHAPE_CONTEXTS}
    ),
    "training-size": Experiment((*_ALL, ONE_SHOT), ("2", "4", "8", "16", "32", "64"), _share_of_all),
    "steps-ahead": Experiment(_ALL, ("2", "3", "4", "5"), _shuffled, varies_steps=True),
    "novel-corners": Experiment((*_ALL, ONE_SHOT), _CORNERS, _novel_corners),
    "more-data": Experiment(
        ("none", ONE_SHOT), ("2000", "5000", "10000", "20000"), _count_of_all, on_request=True
    ),
    "ablation": Experiment(tuple(_ABLATIONS), ("shuffled",), _shuffled),
}
"""The paper's comparisons by name: figures 9a, 9b, 10, 11, 12 and 13.

Two ask what our choices change: in ``support-points-plain`` the network sees corners in the action frame and says
points as they are, and the rule lifts at the contact point; ``half-plane`` counts only what of an outline lies ahead of
the levered edge.

``more-data``, on request, goes on from figure 11 with a data set of more objects than the paper's. ``ablation`` takes
parts away from the predictor of whole motions.

One state ahead, the first setting of figure 12, is ``features`` ``shuffled``.
"""


def plan(
    experiments: Iterable[str] | None = None,
    features: Iterable[str] | None = None,
    settings: Iterable[str] | None = None,
    seeds: Iterable[int] = SEEDS,
) -> list[Trial]:
    """The trials that the paper's comparisons consist of.

    Experiment by experiment, in each of them all that one seed asks for before the next seed: whenever it is
    interrupted, what is there can be compared.

    Args:
        experiments: Which of EXPERIMENTS, in this order; by default all but those on request.
        features: Which features; all by default.
        settings: Which settings; all by default.
        seeds: Seeds of splits and trainings.

    Raises:
        ResultsError: One of them is unknown, or they do not go together.
    """
    usual = [name for name, experiment in EXPERIMENTS.items() if not experiment.on_request]
    names = _chosen("experiment", usual if experiments is None else experiments, list(EXPERIMENTS))
    compared = [EXPERIMENTS[name] for name in names]
    labels = _chosen("features", features, [label for e in compared for label in e.features])
    values = _chosen("setting", settings, [setting for e in compared for setting in e.settings])
    seeds = list(dict.fromkeys(seeds))
    if wrong := [seed for seed in seeds if seed < 0]:
        raise ResultsError(f"seed {wrong[0]} is negative: choose seeds from 0")
    trials = [
        Trial(name, label, seed, setting)
        for name, experiment in zip(names, compared, strict=True)
        for seed in seeds
        for setting in experiment.settings
        if setting in values
        for label in experiment.features
        if label in labels
    ]
    if not trials:
        raise ResultsError(
            f"no training of {', '.join(names)} has features {', '.join(labels)}, setting {', '.join(values)} and a "
            "seed: choose what goes together"
        )
    return trials


def _chosen(kind: str, wanted: Iterable[str] | None, known: list[str]) -> list[str]:
    wanted = list(dict.fromkeys(known if wanted is None else wanted))
    if unknown := [name for name in wanted if name not in known]:
        raise ResultsError(f"{kind} {unknown[0]!r} is unknown: choose from {', '.join(dict.fromkeys(known))}")
    return wanted


def split_of(trial: Trial, batch: InteractionBatch, proportional: bool = False) -> Split:
    """Training, validation and test part of a trial.

    Args:
        trial: The trial.
        batch: The levered interactions.
        proportional: Take the paper's proportions instead of its 1400, 100 and 300 interactions.
    """
    return EXPERIMENTS[trial.experiment].split(batch, trial.setting, trial.seed, proportional)


# --- how a trial is carried out ---------------------------------------------------------------------------


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
        if trial.features == ONE_SHOT or trial.features in _ABLATIONS:
            surroundings = {name: getattr(self.training, name) for name in ("device", "threads", "precision")}
            options = _ABLATIONS.get(trial.features, {})
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
        shared = EXPERIMENTS[trial.experiment].split is _shuffled or trial.setting == "shuffled"
        fitted = Path(self.out) / FITTED if shared else None
        started = perf_counter()
        predictor, progress = fit_predictor(batch, config, split, inputs=inputs, fitted=fitted)
        seconds = perf_counter() - started
        metrics = measure_errors(predictor, batch[split.test], inputs[split.test])
        return metrics | {"best_epoch": progress.best_epoch, "epochs": progress.epoch, "seconds": seconds}


def measure_errors(
    predictor: EffectPredictor, batch: InteractionBatch, inputs: Shaped[Tensor, "batch ..."]
) -> Metrics:
    """Errors of trajectories imagined from the observed first sample (paper, section 5.2), in cm.

    Args:
        predictor: The predictor.
        batch: What it is judged by.
        inputs: The inputs of its features for that.

    Returns:
        ``full`` and ``final``, means over the interactions; ``full_median`` and ``final_median``. Of a predictor of
        poses also ``rotation`` and ``rotation_median`` [degrees], and ``add`` and ``add_median`` [cm].
    """
    features = predictor.add_known(
        predictor.compute_features(inputs), observed_values(batch, predictor.known)
    )
    imagined = predictor.imagine_effects(features, batch.com[:, 0])
    valid = valid_samples(batch)
    truth = np.where(valid[..., None], batch.com, np.nan)
    errors = {name: 100 * np.asarray(distance(imagined.com, truth)) for name, distance in METRICS.items()}
    if imagined.pose is not None:
        errors |= pose_errors(imagined.pose, batch, valid)
    means = {name: float(np.mean(values)) for name, values in errors.items()}
    return means | {f"{name}_median": float(np.median(values)) for name, values in errors.items()}


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


# --- the whole of it --------------------------------------------------------------------------------------


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
