"""Active learning: how many selected lever-ups are worth as much as random ones?

The pool is a data set without the objects of the test part, so that choosing a lever-up and simulating it are the same.
All methods begin with the same hundred random lever-ups and double what they have: by lever-ups at random, by those
whose expected motions the networks of the predictor disagree about most, or by those that
`foretrace.predictor.active.choose_actions` chooses. Every predictor is trained from nothing on what there is. A hundred
lever-ups more decide the widths of regions, which errors do not depend on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from tyro.conf import Fixed, Suppress

from foretrace.errors import ResultsError
from foretrace.evaluation.charts import GREEN, ORANGE, SKY, finish, grid
from foretrace.evaluation.experiment import Experiment, Row, Trial, checked_seeds, chosen
from foretrace.evaluation.metrics import METRICS
from foretrace.evaluation.statistics import Interval, interval
from foretrace.evaluation.tables import markdown_table, mean_with_interval
from foretrace.experiments import SUMMARIES
from foretrace.experiments.training import Recipe
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import Split
from foretrace.pictures.style import new_figure, styled
from foretrace.predictor import OneShotConfig, TrainConfig
from foretrace.predictor.active import choose_actions
from foretrace.predictor.one_shot import OneShotPredictor
from foretrace.predictor.run_folder import fingerprint
from foretrace.predictor.states import valid_lengths, valid_samples

METHODS = {
    "random": SKY,
    "disagreement": ORANGE,
    "chosen": GREEN,
}
"""How the next lever-ups are found, with a colour."""
WORDS = {
    "random": "random",
    "disagreement": "ensemble disagreement",
    "chosen": "diversity",
}
SHOWN = {
    "full_mean": "Error [cm], mean over the full trajectory",
    "levered_mean": "The same of those levered",
    "full_median": "Error [cm], median over the full trajectory",
    "right": "Share of outcomes predicted right",
}
"""Metrics with their headings."""
TESTED, VALIDATION = 5, 100
"""One in so many objects tests; lever-ups that calibrate, at the most."""
CM = 100.0


def usual_recipe() -> Recipe:
    """The settings of the direct predictor for the paper's objects and nominal physics, with 40 epochs."""
    config = OneShotConfig(components=48, outcomes=("levered", "slipped"), error_weighting=0.5)
    return Recipe(config, TrainConfig(epochs=40, learning_rate=config.training.learning_rate))


@dataclass(frozen=True)
class ActiveTrial(Trial):
    """One method, from the first lever-ups to the last."""

    method: str
    """One of METHODS."""
    seed: int
    """Seed of the split, the first lever-ups and the trainings."""


@dataclass(frozen=True)
class Active(Experiment):
    """Learn from lever-ups that are chosen, and from random ones."""

    data: Path | None = None
    """Folder of a data set: `foretrace simulate --objects 500 --embodiment tool`. Without one nothing is run: what is
    there is drawn again."""
    methods: tuple[str, ...] = ()
    """Which methods; by default all."""
    counts: tuple[int, ...] = (100, 200, 400, 800)
    """Numbers of lever-ups after each of which the next ones are chosen."""
    random_counts: tuple[int, ...] = (200, 400, 800, 2000)
    """Numbers of random lever-ups that predictors are trained on."""
    seeds: tuple[int, ...] = tuple(range(10))
    """Seeds of splits and trainings."""
    recipe: Suppress[Fixed[Recipe]] = field(default_factory=usual_recipe)
    """Settings of the trainings."""

    label = "active"
    summary = SUMMARIES["active"]
    trial = ActiveTrial

    def __post_init__(self) -> None:
        checked_seeds(self.seeds)
        for name in ("counts", "random_counts"):
            if not (found := getattr(self, name)) or min(found) < 2 or list(found) != sorted(set(found)):
                option = "--" + name.replace("_", "-")
                raise ResultsError(f"{option} is {found}: give growing numbers of lever-ups from 2 on")

    def trials(self) -> Sequence[ActiveTrial]:
        """Seed by seed; none without data."""
        if self.data is None:
            return []
        methods = chosen("method", self.methods, tuple(METHODS))
        return [ActiveTrial(method, seed) for seed in checked_seeds(self.seeds) for method in methods]

    def identity(self) -> dict[str, Any] | None:
        """The data, how predictors are trained, and after how many lever-ups."""
        if self.data is None:
            return None
        counts = {"counts": list(self.counts), "random_counts": list(self.random_counts)}
        return {"data": fingerprint(self._batch), "recipe": self.recipe.describe(), **counts}

    def run(self, trial: ActiveTrial, folder: Path) -> Sequence[Row]:
        """Errors [cm] on other objects, by the number of lever-ups."""
        rng = np.random.default_rng(trial.seed)
        objects = np.unique(self._batch.object_ids)
        others = np.isin(self._batch.object_ids, rng.permutation(objects)[: len(objects) // TESTED])
        test, rest = np.flatnonzero(others), rng.permutation(np.flatnonzero(~others))
        held = min(VALIDATION, len(rest) // TESTED)
        validation, pool = rest[:held], rest[held:]
        counts = self.random_counts if trial.method == "random" else self.counts
        if counts[-1] > len(pool):
            raise ResultsError(
                f"{counts[-1]} lever-ups are to be learned from, the data has {len(pool)} beside {len(test)} of the "
                f"test part and {held} more: simulate more objects, or choose smaller numbers"
            )
        recipe, rows = self.recipe.change(seed=trial.seed), []
        learned, predictor = pool[: counts[0]], None
        for count in counts:
            if predictor is not None:
                learned = self._more(trial.method, predictor, learned, pool, count)
            split = Split(*(np.sort(part) for part in (learned, validation, test)))
            predictor, _ = recipe.fit(self._batch, split, self._inputs)
            assert isinstance(predictor, OneShotPredictor)
            rows += [
                {"lever_ups": count, "metric": name, "value": value}
                for name, value in _measured(predictor, self._batch[split.test]).items()
            ]
        return rows

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By method, number of lever-ups and metric: mean over the seeds and its interval; ratios of errors."""
        summary: dict[str, Any] = {}
        for keys, mine in rows.groupby(["method", "lever_ups", "metric"], sort=False):
            method, count, metric = map(str, cast(tuple[str, ...], keys))
            found = _interval(mine["value"].to_numpy(float)).as_dict(5) | {"seeds": len(mine)}
            summary.setdefault(method, {}).setdefault(count, {})[metric] = found
        full = rows.loc[rows["metric"].eq("full_mean")].pivot(
            index="seed", columns=["method", "lever_ups"], values="value"
        )
        ratios = {}
        if "random" in summary:
            for method in (name for name in METHODS if name in summary):
                last = max(map(int, summary[method]))
                for count in sorted(map(int, summary["random"])):
                    if count >= last and (method, count) != ("random", last):
                        ratio = (full[method, last] / full["random", count]).dropna()
                        name = f"{last} {method} / {count} random"
                        ratios[name] = _interval(ratio.to_numpy(float)).as_dict(4) | {"seeds": len(ratio)}
        return {"methods": summary, "ratios": ratios}

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """A table a metric, and the ratios."""
        methods = summary["methods"]
        counts = sorted({int(count) for found in methods.values() for count in found})
        parts = ["# Active learning"]
        for metric, title in SHOWN.items():
            lines = [
                [
                    WORDS[name],
                    *(
                        mean_with_interval(methods[name].get(str(n), {}).get(metric), missing="-")
                        for n in counts
                    ),
                ]
                for name in METHODS
                if name in methods
            ]
            parts += [
                f"## {title}, by the number of lever-ups",
                markdown_table(["", *map(str, counts)], lines),
            ]
        if summary["ratios"]:
            lines = [
                [name, mean_with_interval(found), str(found["seeds"])]
                for name, found in summary["ratios"].items()
            ]
            parts += ["## Ratios of mean errors", markdown_table(["", "ratio", "seeds"], lines)]
        return "\n\n".join(parts) + "\n"

    @styled
    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Errors over the number of lever-ups, both logarithmic."""
        methods = self.summarise(rows)["methods"]
        if not methods:
            return {}
        fig = new_figure(6.4, 4.4)
        ax = fig.subplots()
        for shift, name in enumerate(each for each in METHODS if each in methods):
            counts = sorted(map(int, methods[name]))
            found = [methods[name][str(count)]["full_mean"] for count in counts]
            means, color = [each["mean"] for each in found], METHODS[name]
            ax.plot(counts, means, "o-", color=color, label=WORDS[name], linewidth=1.8)
            for count, each in zip(counts, found, strict=True):
                if each["low"] is not None:
                    x = count * (1 + 0.03 * (shift - 1))  # beside each other
                    ax.plot([x, x], [max(each["low"], 1e-3), each["high"]], color=color, linewidth=1)
        ax.set_xscale("log")
        ax.set_yscale("log")
        counts = sorted({int(count) for found in methods.values() for count in found})
        ax.set_xticks(counts, [str(count) for count in counts])
        ax.set_yticks(ticks := [0.05, 0.1, 0.2, 0.5, 1.0], [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()
        means = [each["full_mean"]["mean"] for found in methods.values() for each in found.values()]
        ax.set_ylim(0.8 * min(means), 1.25 * max(means))
        grid(ax, xlabel="lever-ups learned from", ylabel="error on other objects, full trajectory [cm]")
        fig.legend(loc="outside lower center", ncols=3)
        seeds = rows["seed"].nunique()
        finish(fig, "Active learning", f"means over {seeds} seeds, 95 % intervals")
        return {"active": fig}

    # --- what is learned from -----------------------------------------------------------------------------

    def _more(
        self, method: str, predictor: OneShotPredictor, learned: np.ndarray, pool: np.ndarray, count: int
    ) -> np.ndarray:
        """Rows that are learned from, so many; the pool is in random order."""
        if method == "random":
            return pool[:count]
        candidates, number = np.setdiff1d(pool, learned), count - len(learned)
        batch = self._batch[candidates]
        if method == "chosen":
            rows = choose_actions(predictor, self._batch[np.sort(learned)], batch, number)
        else:
            weights = predictor.expected_weights(predictor.network_inputs(batch)[:, 0])
            apart = (weights - weights.mean(dim=0)).square().sum(dim=2).mean(dim=0)
            rows = np.asarray(apart.argsort(descending=True)[:number])
        return np.concatenate([learned, candidates[rows]])

    @cached_property
    def _batch(self) -> InteractionBatch:
        assert self.data is not None
        batch = Dataset.open(self.data).batch()
        known = np.isin(batch.outcome, self.recipe.predictor.make(2).outcomes)
        return batch[known & (valid_lengths(batch) >= 2)]

    @cached_property
    def _inputs(self) -> torch.Tensor:
        return self.recipe.inputs(self._batch)


def _interval(values: np.ndarray) -> Interval:
    """Of seeds that draw test objects anew from one data set."""
    return interval(values, 1 / (TESTED - 1))


def _measured(predictor: OneShotPredictor, test: InteractionBatch) -> dict[str, float]:
    imagined = predictor.imagine_batch(test, context="recorded" if predictor.context else None)
    truth = np.where(valid_samples(test)[..., None], test.com, np.nan)
    errors = CM * np.asarray(METRICS["full"](imagined.com, truth))
    outcome = np.array(imagined.futures.outcome)[imagined.futures.probability.argmax(axis=1)]
    levered = test.outcome == str(Outcome.LEVERED)
    return {
        "full_mean": float(errors.mean()),
        "full_median": float(np.median(errors)),
        "levered_mean": float(errors[levered].mean()),
        "right": float((outcome == test.outcome).mean()),
    }
