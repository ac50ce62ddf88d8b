"""What randomised training data do for transfer, and what it helps to know what was drawn (paper, section 6).

Three predictors per seed are trained on equally many interactions: of the plain data, of the randomised data, and of
the randomised data with what varies known: friction and density, or the action's parameters. All are judged by plain
and by randomised test interactions and, if wanted, by the stand-in for the real robot, which is another engine with
other constants and with senses that err.

Objects are split, not interactions: no object of a test part was learned from, in either data set.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from foretrace.errors import ResultsError
from foretrace.evaluation.metrics import measure_errors
from foretrace.evaluation.results import Metrics, ResultsTable, Trial, describe_machine
from foretrace.evaluation.runner import Failure, run_trials
from foretrace.experiments.paper_protocol import Recipe, load_levered
from foretrace.experiments.transfer import distance_until_slip
from foretrace.experiments.transfer_objects import Subject, everyday_objects, play, printed_shapes
from foretrace.features import FEATURES, make_features
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.record import Physics
from foretrace.interactions.splits import Split, split_by_object
from foretrace.predictor import EffectPredictor, TrainConfig
from foretrace.predictor.context import CONSTANTS, KNOWN, check_names, true_values
from foretrace.predictor.run_folder import fingerprint
from foretrace.predictor.runtime import thread_count
from foretrace.predictor.training import fit_predictor
from foretrace.simulation.stand_in import Observation, StandIn, hull_of

EXPERIMENT = "randomisation"
PLAIN, VARIED, KNOWING = "plain", "randomised", "knowing"
SETTINGS = (PLAIN, VARIED, KNOWING)
"""What is learned from: plain data; randomised data; the same, with what varies known."""
NAMES = tuple(CONSTANTS)
"""What is known by default."""
GROUPS = ("printed", "everyday")
"""Objects of the stand-in."""


@dataclass(frozen=True)
class RandomisationRecipe:
    """What decides the results beside the data and a trial itself."""

    training: TrainConfig = field(default_factory=TrainConfig)
    """Settings of all trainings; features, known constants and seed are the trial's."""
    stand_in: StandIn = field(default_factory=StandIn)
    """What stands in for the real robot."""
    repeats: int = 3
    """Lever-ups by the stand-in at every contact; with 0 it judges nothing."""
    known: tuple[str, ...] = NAMES
    """What varies, and is known to the predictors that are told."""

    def __post_init__(self) -> None:
        check_names(self.known)
        if not self.known:
            raise ResultsError(f"nothing is known to anybody: name what varies, of {', '.join(KNOWN)}")
        if self.repeats < 0:
            raise ResultsError(
                f"repeats is {self.repeats}, it must not be negative: 0 leaves out the stand-in"
            )

    def describe(self) -> dict[str, Any]:
        """As JSON-able settings."""
        training = Recipe(self.training).describe()
        described = {"training": training, "stand_in": asdict(self.stand_in), "repeats": self.repeats}
        return described if self.known == NAMES else described | {"known": self.known}


class Both(NamedTuple):
    """The levered interactions of both data sets."""

    plain: InteractionBatch
    """As told."""
    varied: InteractionBatch
    """Randomised."""


class Shown(NamedTuple):
    """One lever-up by the stand-in, and its object."""

    subject: Subject
    observed: Observation


def open_both(plain: str | Path, varied: str | Path, names: Sequence[str] = NAMES) -> Both:
    """Read both data sets.

    Args:
        plain: Folder of the data as told.
        varied: Folder of the randomised data.
        names: What must vary in the second only.

    Raises:
        DatasetError: One of them is missing or damaged.
        ResultsError: The first varies, the second does not, or they are sampled at different times.
    """
    both = Both(load_levered(plain), load_levered(varied))
    for name in names:
        remedy = "--randomise" if name in CONSTANTS else "--vary-action"
        spans = [np.ptp(batch.parameters[name]) if len(batch) else 0.0 for batch in both]
        if spans[0] > 0:
            raise ResultsError(f"{name} varies in {plain}: simulate the plain data without {remedy}")
        if spans[1] == 0:
            raise ResultsError(f"{name} is the same all over {varied}: simulate it with {remedy}")
    if not np.array_equal(both.plain.times, both.varied.times):
        raise ResultsError(
            f"{plain} and {varied} are sampled at different times: simulate both alike, with "
            "--watch-time until the slowest blade has stopped"
        )
    return both


def split_both(both: Both, seed: int) -> tuple[Split, Split]:
    """Parts of both data sets in the paper's proportions of objects.

    Objects of the same number are in the same part of both. To learn from and to validate with, both have equally many
    interactions: the data set that has more of them is thinned at random.

    Raises:
        TrainingError: There are fewer than three objects.
    """
    whole = split_by_object(np.concatenate([batch.object_ids for batch in both]), seed)
    first = len(both.plain)
    parts: list[dict[str, np.ndarray]] = [{}, {}]
    for k, name in enumerate(("train", "validation", "test")):
        rows = getattr(whole, name)
        pair = rows[rows < first], rows[rows >= first] - first
        size = max(map(len, pair)) if name == "test" else min(map(len, pair))
        for own, chosen in zip(parts, pair, strict=True):
            own[name] = np.sort(np.random.default_rng([seed, k]).permutation(chosen)[:size])
    return Split(**parts[0]), Split(**parts[1])


@dataclass(frozen=True)
class RandomisationWork:
    """Carries out a trial, in whatever process it finds itself."""

    plain: str
    """Folder of the plain data."""
    varied: str
    """Folder of the randomised data."""
    recipe: RandomisationRecipe
    """What all trials have in common."""

    def __call__(self, trial: Trial) -> Metrics:
        """Errors over the full trajectory on both test parts, distances from the stand-in [cm], and seconds."""
        both = _both_once(self.plain, self.varied, self.recipe.known)
        splits = split_both(both, trial.seed)
        source = 0 if trial.setting == PLAIN else 1
        known = self.recipe.known if trial.setting == KNOWING else ()
        config = replace(self.recipe.training, features=trial.features, known=known, seed=trial.seed)
        inputs = _inputs_once(self.plain, self.varied, self.recipe.known, trial.features)
        with thread_count(config.threads):
            started = perf_counter()
            predictor, _ = fit_predictor(both[source], config, splits[source], inputs=inputs[source])
            seconds = perf_counter() - started
            found: Metrics = {}
            for name, batch, all_inputs, split in zip((PLAIN, VARIED), both, inputs, splits, strict=True):
                test, test_inputs = batch[split.test], all_inputs[split.test]
                errors = measure_errors(predictor, test, test_inputs)
                found |= {f"{name}_full": errors["full"], f"{name}_final": errors["final"]}
                if predictor.known:
                    errors = measure_errors(predictor, _nominal(test), test_inputs)
                    found[f"{name}_nominal_full"] = errors["full"]
            if self.recipe.repeats:
                found |= self._stand_in_distances(predictor)
        return found | {"train": len(splits[source].train), "seconds": seconds}

    def _stand_in_distances(self, predictor: EffectPredictor) -> Metrics:
        """Distances from the stand-in [cm], told the true and the usual values."""
        shown = _shown_once(self.recipe.stand_in, self.recipe.repeats)
        found = distances(predictor, shown)
        if predictor.known:
            told = distances(predictor, shown, nominal=True)
            found |= {f"{name}_nominal": value for name, value in told.items()}
        return found


def distances(predictor: EffectPredictor, shown: Sequence[Shown], nominal: bool = False) -> Metrics:
    """Mean distance of imagined paths from those of the stand-in after dynamic time warping [cm].

    Args:
        predictor: The predictor; it starts where the marker is seen before the action.
        shown: The stand-in's lever-ups.
        nominal: Whether a predictor that knows constants is told the usual ones, instead of the stand-in's.
    """
    views = [hull_of(each.observed.view) if each.subject.hull else each.observed.view for each in shown]
    times = predictor.times.cpu().numpy()
    batch = InteractionBatch.from_views(views, times)
    start: Float[np.ndarray, "batch 3"] = np.array([each.observed.com[0] for each in shown])
    told = [Physics(density=each.subject.density) if nominal else each.observed.physics for each in shown]
    values = [true_values(physics, tuple(KNOWN)) for physics in told]
    known = {name: np.array([each[name] for each in values]) for name in KNOWN}
    batch = replace(batch, com=np.repeat(start[:, None], len(times), axis=1), parameters=known)
    imagined = predictor.imagine_batch(batch).com
    values = np.array(
        [distance_until_slip(each.observed, times, path) for each, path in zip(shown, imagined, strict=True)]
    )
    groups = np.array([each.subject.group for each in shown])
    return {f"stand_in_{group}": float(values[groups == group].mean()) for group in GROUPS}


def run_randomisation(
    plain: str | Path,
    varied: str | Path,
    out: str | Path,
    features: Iterable[str] = ("sp-rule", "sc-800", "im-cnn"),
    seeds: Iterable[int] = (0, 1, 2),
    recipe: RandomisationRecipe | None = None,
    *,
    workers: int = 1,
    console: Console | None = None,
) -> list[Failure]:
    """Carry out the comparison, or what is missing of it; it may be stopped at any time.

    Args:
        plain: Folder of the data as told.
        varied: Folder of the randomised data.
        out: Folder of the results; `foretrace.evaluation.results.read_results` reads it.
        features: What the predictors know about the object.
        seeds: Seeds of splits and trainings.
        recipe: What all trainings have in common.
        workers: Processes.
        console: Where progress is reported; standard error by default.

    Returns:
        The trials that failed.

    Raises:
        ResultsError: The data do not fit together, features are unknown, or the folder holds other results.
    """
    recipe = recipe or RandomisationRecipe()
    seeds = list(dict.fromkeys(seeds))
    labels = list(dict.fromkeys(features))
    for label in labels:
        if label not in FEATURES or FEATURES[label].oracle:
            usable = ", ".join(name for name, kind in FEATURES.items() if not kind.oracle)
            raise ResultsError(f"features {label!r} cannot be had from a view: choose from {usable}")
    if wrong := [seed for seed in seeds if seed < 0]:
        raise ResultsError(f"seed {wrong[0]} is negative: choose seeds from 0")
    if workers < 1:
        raise ResultsError(f"workers is {workers}, it must be at least 1")
    both = open_both(plain, varied, recipe.known)
    identity: Mapping[str, Any] = {
        "data": {
            name: fingerprint(batch, recipe.known) for name, batch in zip((PLAIN, VARIED), both, strict=True)
        },
        "recipe": recipe.describe(),
    }
    trials = [
        Trial(EXPERIMENT, label, seed, setting) for label in labels for seed in seeds for setting in SETTINGS
    ]
    work = RandomisationWork(str(plain), str(varied), recipe)
    threads = recipe.training.threads or 1
    with ResultsTable(out, identity, describe_machine(recipe.training.device, workers, threads)) as table:
        return run_trials(trials, work, table, workers=workers, threads=threads, console=console)


def _nominal(batch: InteractionBatch) -> InteractionBatch:
    """The same interactions as if the usual constants and the usual action were all that is known of them."""
    usual = true_values(Physics(), tuple(KNOWN))
    constant = {name: np.full(len(batch), value) for name, value in usual.items()}
    return replace(batch, parameters=batch.parameters | constant)


@lru_cache(maxsize=1)
def _both_once(plain: str, varied: str, names: tuple[str, ...]) -> Both:
    """`open_both`, once per process."""
    return open_both(plain, varied, names)


@lru_cache(maxsize=4)
def _inputs_once(plain: str, varied: str, names: tuple[str, ...], label: str) -> tuple[Tensor, Tensor]:
    """Inputs of features for both data sets, once per process."""
    extractor = make_features(label)
    first, second = (extractor.inputs(batch) for batch in _both_once(plain, varied, names))
    return first, second


@lru_cache(maxsize=1)
def _shown_once(stand_in: StandIn, repeats: int) -> list[Shown]:
    """All lever-ups of the stand-in that have a path, once per process; drawn by seed 0, as in `evaluate transfer`."""
    return [
        Shown(subject, observed)
        for subject in printed_shapes() + everyday_objects()
        for contact in range(len(subject.actions))
        for observed in play(subject, contact, stand_in, repeats, seed=0).observed
        if len(observed.com)
    ]
