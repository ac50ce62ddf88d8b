"""What randomised training data do for transfer, and what it helps to know what was drawn (paper, section 6).

Three predictors per seed are trained on equally many interactions: of the plain data, of the randomised data, and of
the randomised data conditioned on what varies: friction and density, or the action's parameters. All are evaluated on
plain and on randomised test interactions and, if wanted, against the stand-in for the real robot, which is another
engine with other constants and with senses that err.

Objects are split, not interactions: no object of a test part was learned from, in either data set.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor
from tyro.conf import Fixed, Suppress

from foretrace.actions import LeverUp
from foretrace.errors import ResultsError, shown
from foretrace.evaluation.experiment import Experiment, Row, Trial, checked_seeds
from foretrace.evaluation.metrics import measure_errors
from foretrace.evaluation.statistics import interval
from foretrace.evaluation.tables import markdown_table, mean_with_interval
from foretrace.experiments import SUMMARIES
from foretrace.experiments.randomisation_figures import (
    BARS,
    CONTRASTS,
    KNOWING,
    PLAIN,
    SETTINGS,
    VARIED,
    randomisation_figure,
    tests_of,
    values_of,
)
from foretrace.experiments.training import BASE, Recipe, load_levered
from foretrace.experiments.transfer import distance_until_slip
from foretrace.experiments.transfer_objects import Subject, everyday_objects, play, printed_shapes
from foretrace.features import FEATURES
from foretrace.imagined.context import BEVELS, CONSTANTS, EXACT, check_names, column_of, true_context
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.record import Physics
from foretrace.interactions.splits import Split, split_by_object
from foretrace.predictor import EffectPredictor
from foretrace.predictor.run_folder import fingerprint
from foretrace.simulation.stand_in import Observation, StandIn, hull_of

CONTEXT = (*(name for name in CONSTANTS if name not in BEVELS), *LeverUp.units)
"""Everything that may vary."""
NAMES = tuple(
    name for name in CONSTANTS if name not in (EXACT, *BEVELS)
)  # which is not known where it varies
"""What predictors are conditioned on by default."""
GROUPS = ("printed", "everyday")
"""Objects of the stand-in."""
FEATURES_OF_BASE = ("sp-rule", "sc-800", "im-cnn")
"""Features that the paper's predictor is compared with by default; other predictors have their own."""


class Both(NamedTuple):
    """The levered interactions of both data sets."""

    plain: InteractionBatch
    """With nominal constants and actions."""
    varied: InteractionBatch
    """Randomised."""


class Shown(NamedTuple):
    """One lever-up by the stand-in, and its object."""

    subject: Subject
    observed: Observation


def open_both(plain: str | Path, varied: str | Path, names: Sequence[str] = NAMES) -> Both:
    """Read plain and randomised data; the names are of what must vary in the second only.

    Raises:
        DatasetError: One of them is missing or damaged.
        ResultsError: The first varies, the second does not, or they are sampled at different times.
    """
    both = Both(load_levered(plain), load_levered(varied))
    for name in names:
        remedy = "--randomise" if name in CONSTANTS else "--vary-action"
        spans = [np.ptp(column_of(batch, name)) if len(batch) else 0.0 for batch in both]
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
class RandomisationTrial(Trial):
    """One training, and all that it is evaluated on."""

    features: str
    """What the predictor is told about an object."""
    seed: int
    """Seed of the split and of the training."""
    setting: str
    """One of SETTINGS."""


@dataclass(frozen=True)
class RandomisationExperiment(Experiment):
    """What randomised training data do for transfer, and what it helps to know what was drawn.

    Predictors learn from plain data, from randomised data, and from those conditioned on friction, tool friction and
    density, or on what else varies: the action's parameters. All are evaluated on plain and randomised interactions
    with objects that none of them has learned from, and against the stand-in of `evaluate transfer`.
    """

    plain: Path | None = None
    """Folder of the plain data set. Without data nothing is trained: results that are there are drawn again."""
    varied: Path | None = None
    """Folder of a data set that was simulated with --randomise or --vary-action."""
    features: tuple[str, ...] = ()
    """Features of the predictors; by default sp-rule, sc-800 and im-cnn for lstm, and its own
    features for another predictor."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of splits and trainings."""
    repeats: int = 3
    """Lever-ups by the stand-in at every contact; 0 leaves it out. It levers with the nominal action."""
    context: tuple[str, ...] = NAMES
    """What varies, and is the context of some of the predictors: as in `foretrace train`."""
    predictor: str = BASE
    """Kind of predictor: lstm or one-shot."""
    epochs: int | None = None
    """Passes over the training part, as in `foretrace train`."""
    recipe: Suppress[Fixed[Recipe | None]] = None
    """Other settings of the trainings than those of the predictor."""
    stand_in: Suppress[Fixed[StandIn]] = field(default_factory=StandIn)
    """What stands in for the real robot."""

    label = "randomisation"
    summary = SUMMARIES["randomisation"]
    trial = RandomisationTrial

    def __post_init__(self) -> None:
        check_names(self.context)
        if not self.context:
            raise ResultsError(f"no varying quantity is named: name what varies, of {', '.join(CONTEXT)}")
        if self.repeats < 0:
            raise ResultsError(
                f"repeats is {self.repeats}, it must not be negative: 0 leaves out the stand-in"
            )

    def trials(self) -> Sequence[RandomisationTrial]:
        """Features by features, seed by seed; none without data."""
        usual = FEATURES_OF_BASE if self.predictor == BASE else (self._recipe.features,)
        labels = list(dict.fromkeys(self.features or usual))
        for label in labels:
            if label not in FEATURES or FEATURES[label].oracle:
                usable = ", ".join(name for name, kind in FEATURES.items() if not kind.oracle)
                raise ResultsError(f"features {shown(label)} cannot be had from a view: choose from {usable}")
        seeds = checked_seeds(self.seeds)
        if self.plain is None and self.varied is None:
            return []
        return [RandomisationTrial(label, seed, s) for label in labels for seed in seeds for s in SETTINGS]

    def identity(self) -> dict[str, Any] | None:
        """Both data sets, how predictors are trained, and the stand-in."""
        if self.plain is None and self.varied is None:
            return None
        data = {
            name: fingerprint(batch, self.context)
            for name, batch in zip((PLAIN, VARIED), self._both, strict=True)
        }
        described = {"training": self._recipe.describe(), "stand_in": asdict(self.stand_in)}
        described |= {"repeats": self.repeats, "context": list(self.context)}
        return {"data": data, "recipe": described}

    def run(self, trial: RandomisationTrial, folder: Path) -> Sequence[Row]:
        """Errors over the full trajectory on both test parts, distances from the stand-in [cm], and seconds."""
        splits = split_both(self._both, trial.seed)
        source = 0 if trial.setting == PLAIN else 1
        context = self.context if trial.setting == KNOWING else ()
        recipe = self._recipe.change(features=trial.features, context=context, seed=trial.seed)
        inputs = self._inputs(recipe)
        started = perf_counter()
        predictor, _ = recipe.fit(self._both[source], splits[source], inputs[source])
        seconds = perf_counter() - started
        found: dict[str, float] = {}
        for name, batch, all_inputs, split in zip((PLAIN, VARIED), self._both, inputs, splits, strict=True):
            test, test_inputs = batch[split.test], all_inputs[split.test]
            errors = measure_errors(predictor, test, test_inputs)
            found |= {f"{name}_full": errors["full"], f"{name}_final": errors["final"]}
            if predictor.context:
                errors = measure_errors(predictor, _nominal(test), test_inputs)
                found[f"{name}_nominal_full"] = errors["full"]
        if self.repeats:
            found |= distances(predictor, self._shown)
            if predictor.context:
                nominal = distances(predictor, self._shown, nominal=True)
                found |= {f"{name}_nominal": value for name, value in nominal.items()}
        found |= {"train": float(len(splits[source].train)), "seconds": seconds}
        return [{"metric": name, "value": float(value)} for name, value in found.items()]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By features and test: errors of every predictor [cm], and differences within the same seeds."""
        summary: dict[str, Any] = {}
        for features in dict.fromkeys(rows["features"]):
            summary[features] = {}
            for test, metric in tests_of(rows).items():
                values = {bar: values_of(rows, features, bar, metric) for bar in BARS}
                apart = {name: (values[a] - values[b]).dropna() for name, (a, b) in CONTRASTS.items()}
                summary[features][test] = {
                    part: {name: _interval(each) for name, each in found.items() if len(each)}
                    for part, found in (("errors", values), ("differences", apart))
                }
        return summary

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """Errors and differences as two tables."""
        parts = ["# Plain and varied training data"]
        below = "Differences in cm within the same seeds; below zero is an improvement."
        for part, columns, sign, words in (
            ("errors", BARS, "", "Errors in cm, means over the seeds [95 % interval]."),
            ("differences", CONTRASTS, "+", below),
        ):
            lines = [
                [
                    f"`{label}`",
                    test,
                    *(mean_with_interval(found[part].get(name), sign=sign) for name in columns),
                ]
                for label, tests in summary.items()
                for test, found in tests.items()
            ]
            parts += [words, markdown_table(["Features", "Evaluated on", *columns], lines)]
        return "\n\n".join(parts) + "\n"

    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Errors of all predictors."""
        return {"randomisation": randomisation_figure(rows)}

    @cached_property
    def _recipe(self) -> Recipe:
        recipe = Recipe.of(self.predictor) if self.recipe is None else self.recipe
        return recipe.change(epochs=self.epochs, device="cpu")

    @cached_property
    def _both(self) -> Both:
        if self.plain is None or self.varied is None:
            raise ResultsError("one of the two data sets is missing: give both --plain and --varied")
        return open_both(self.plain, self.varied, self.context)

    def _inputs(self, recipe: Recipe) -> tuple[Tensor, ...]:
        """Inputs of features for both data sets, once in each process."""
        if recipe.features not in self._inputs_by_features:
            self._inputs_by_features[recipe.features] = tuple(recipe.inputs(batch) for batch in self._both)
        return self._inputs_by_features[recipe.features]

    @cached_property
    def _inputs_by_features(self) -> dict[str, tuple[Tensor, ...]]:
        return {}

    @cached_property
    def _shown(self) -> list[Shown]:
        """All lever-ups of the stand-in that have a path; drawn by seed 0, as in `evaluate transfer`."""
        return play_all(self.stand_in, self.repeats)


def play_all(stand_in: StandIn, repeats: int) -> list[Shown]:
    """Lever-ups of printed and everyday objects by a stand-in that have a path."""
    return [
        Shown(subject, observed)
        for subject in printed_shapes() + everyday_objects()
        for contact in range(len(subject.actions))
        for observed in play(subject, contact, stand_in, repeats, seed=0).observed
        if len(observed.com)
    ]


def distances(predictor: EffectPredictor, shown: Sequence[Shown], nominal: bool = False) -> dict[str, float]:
    """Mean distance of imagined paths from those of the stand-in after dynamic time warping [cm].

    Args:
        predictor: The predictor; it starts where the marker is seen before the action.
        shown: The stand-in's lever-ups.
        nominal: Whether the context is the nominal values instead of the stand-in's.
    """
    views = [hull_of(each.observed.view) if each.subject.hull else each.observed.view for each in shown]
    times = predictor.times.cpu().numpy()
    batch = InteractionBatch.from_views(views, times)
    start: Float[np.ndarray, "batch 3"] = np.array([each.observed.com[0] for each in shown])
    told = [Physics(density=each.subject.density) if nominal else each.observed.physics for each in shown]
    values = [true_context(physics, CONTEXT) for physics in told]
    context = {name: np.array([each[name] for each in values]) for name in CONTEXT}
    batch = replace(batch, com=np.repeat(start[:, None], len(times), axis=1), parameters=context)
    imagined = predictor.imagine_batch(batch).com
    values = np.array(
        [distance_until_slip(each.observed, times, path) for each, path in zip(shown, imagined, strict=True)]
    )
    groups = np.array([each.subject.group for each in shown])
    return {f"stand_in_{group}": float(values[groups == group].mean()) for group in GROUPS}


def _nominal(batch: InteractionBatch) -> InteractionBatch:
    """The same interactions with the nominal constants and action parameters."""
    values = true_context(Physics(), CONTEXT)
    constant = {name: np.full(len(batch), value) for name, value in values.items()}
    return replace(batch, parameters=batch.parameters | constant)


def _interval(values: pd.Series) -> dict[str, Any]:
    found = interval(values)
    return {**found.as_dict(4), "seeds": found.seeds}
