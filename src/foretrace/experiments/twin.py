"""The twin, which simulates the object that it sees, beside the direct trajectory predictor, which has learned.

Truths are simulations of the whole arm, but for part ``bullet``: there another engine moves the blade alone. Errors are
those of the centre of mass up to where an object slips off the blade. Constants are told to the twin: they are nominal.
The direct predictor is trained on the same split, as is the residual, over the twin of the blade alone; for silhouettes
and for ``bullet``, on that of part ``shuffled``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator
from tyro.conf import Fixed, Suppress

from foretrace.errors import ResultsError, ViewError
from foretrace.evaluation.charts import GREEN, ORANGE, PURPLE, SKY, VERMILLION, finish, grid
from foretrace.evaluation.experiment import Experiment, Row, Trial, checked_seeds, chosen, kept_folder
from foretrace.evaluation.metrics import METRICS
from foretrace.evaluation.statistics import interval
from foretrace.evaluation.storage import read_rows
from foretrace.evaluation.tables import markdown_table, mean_with_interval, number
from foretrace.experiments import SUMMARIES
from foretrace.experiments.kept_motions import imagine_once, rows_of
from foretrace.experiments.paper_comparisons import CORNERS, SIZES
from foretrace.experiments.training import Recipe, load_levered
from foretrace.experiments.transfer_objects import read_silhouettes
from foretrace.imagined import Imaginer
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.splits import PAPER_SIZES, Split, split_by_corner_count, split_by_seed
from foretrace.objects import Box, Cylinder
from foretrace.pictures.style import INK, new_figure, styled
from foretrace.predictor import load_predictor
from foretrace.predictor.run_folder import fingerprint, processor_independent_fingerprint
from foretrace.predictor.states import valid_lengths, valid_samples
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.twin import TwinConfig, TwinImaginer
from foretrace.twin.residual import train_residual
from foretrace.twin.residual_network import ResidualConfig

PARTS = {
    "shuffled": "paper, shuffled",
    **{pair: f"corners {pair.replace('&', ' and ')} held out" for pair in CORNERS},
    "silhouettes": "silhouettes",
    "not-flat": "not flat",
    "bullet": "Bullet",
}
"""What imaginers are compared on, in words."""
IMAGINERS = {
    "twin": GREEN,
    "twin, arm": VERMILLION,
    "twin in Bullet": ORANGE,
    "residual": PURPLE,
    "one-shot": SKY,
}
"""What is compared, with its colour."""
TWINS: dict[str, tuple[str, str]] = {
    "twin": ("mujoco", "tool"),
    "twin, arm": ("mujoco", "arm"),
    "twin in Bullet": ("bullet", "tool"),
}
"""Engine and embodiment of the twins."""
STATISTICS: dict[str, Callable[[np.ndarray], Any]] = {
    "mean": np.mean,
    "median": np.median,
    "p95": lambda values: np.percentile(values, 95),
}
KEPT, PRIORS = "trainings", "priors"
"""Folders within the results: the trainings, and the motions of twins that residuals learn from."""
PAPER_METRICS = {"full_mean": "full", "final_mean": "final"}
"""Errors by their names in the paper's comparisons."""
CM = 100.0


class Task(NamedTuple):
    """What is to be imagined, and what may be learned from."""

    test: InteractionBatch
    """Actions to imagine."""
    batch: InteractionBatch
    """Where a predictor is trained."""
    split: Split
    """Its parts."""


@dataclass(frozen=True)
class TwinTrial(Trial):
    """One imaginer on one part."""

    part: str
    """One of PARTS."""
    imaginer: str
    """One of IMAGINERS."""
    seed: int
    """Seed of the split and of the training."""


def rows_of_twins(folder: Path) -> pd.DataFrame:
    """What simulates, on the paper's split and novel corner counts, in the form of results of the paper's comparisons.

    A twin learns nothing, so that its error is the same whatever the size of the training part.

    Args:
        folder: Results of this experiment.

    Raises:
        ResultsError: They are missing, or of another experiment.
    """
    rows = read_rows(folder, TwinTrial)
    rows = rows[rows["metric"].isin(PAPER_METRICS) & rows["imaginer"].ne("one-shot")]
    metrics = [PAPER_METRICS[name] for name in rows["metric"]]
    rows = rows.assign(features=rows["imaginer"], setting=rows["part"], metric=metrics)
    shuffled, novel = rows[rows["part"].eq("shuffled")], rows[rows["part"].isin(CORNERS)]
    unlearned = shuffled[shuffled["imaginer"].isin(TWINS)]
    parts = [
        shuffled.assign(experiment="features"),
        novel.assign(experiment="novel-corners"),
        *(unlearned.assign(experiment="training-size", setting=size) for size in SIZES),
    ]
    return pd.concat(parts).drop(columns=["part", "imaginer"])


@dataclass(frozen=True)
class Twin(Experiment):
    """Compare the twin with the direct trajectory predictor, on known and novel shapes and in another engine."""

    data: Path | None = None
    """Folder of the paper's data set. Without one nothing is run: results that are there are drawn again."""
    bullet: Path | None = None
    """Folder of the same lever-ups in Bullet: `foretrace simulate --engine bullet --embodiment tool`."""
    everyday: Path | None = None
    """Folder of a data set with cylinders and boxes, such as that of `foretrace simulate --recipe everyday`."""
    silhouettes: Path | None = None
    """Folder of pictures of silhouettes."""
    parts: tuple[str, ...] = ()
    """Which parts; by default all that there are data for."""
    imaginers: tuple[str, ...] = ()
    """Which imaginers; by default all."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of splits and trainings."""
    proportional: bool = False
    """Split in the paper's proportions instead of its 1400, 100 and 300 interactions."""
    recipe: Suppress[Fixed[Recipe | None]] = None
    """Other settings of the trainings than the predictor's."""

    label = "twin"
    summary = SUMMARIES["twin"]
    trial = TwinTrial

    def trials(self) -> Sequence[TwinTrial]:
        """Part by part; none without data. What there are no data for is left out."""
        if self.data is None:
            return []
        there = {"silhouettes": self.silhouettes, "not-flat": self.everyday, "bullet": self.bullet}
        parts, imaginers = (
            chosen("part", self.parts, tuple(PARTS)),
            chosen("imaginer", self.imaginers, tuple(IMAGINERS)),
        )
        for part in self.parts:
            if there.get(part, self.data) is None:
                option = {"not-flat": "everyday"}.get(part, part)
                raise ResultsError(f"part {part} needs data: give --{option}, or leave it out")
        return [
            TwinTrial(part, imaginer, seed)
            for part in parts
            if there.get(part, self.data) is not None
            for imaginer in imaginers
            # The arm exists in MuJoCo alone, and Bullet is compared where it is the truth.
            # Residuals learn from levered objects.
            if {"twin in Bullet": part == "bullet", "twin, arm": part != "bullet"}.get(imaginer, True)
            and (imaginer, part) != ("residual", "not-flat")
            for seed in checked_seeds(self.seeds)
        ]

    def identity(self) -> dict[str, Any] | None:
        """The data, and how predictors are trained."""
        if self.data is None:
            return None
        return {
            "data": processor_independent_fingerprint(self._levered),
            "recipe": self._recipe("shuffled", 0).describe(),
            "proportional": self.proportional,
        }

    def run(self, trial: TwinTrial, folder: Path) -> Sequence[Row]:
        """Errors [cm], share of outcomes that are right, and seconds for each action."""
        task = self._task(trial.part, trial.seed)
        imaginer = self._imaginer(trial, task, folder)
        started = perf_counter()
        imagined = imaginer.imagine_batch(task.test)
        seconds = (perf_counter() - started) / len(task.test)
        valid = valid_samples(task.test)
        count = min(valid.shape[1], imagined.com.shape[1])
        truth = np.where(valid[:, :count, None], task.test.com[:, :count], np.nan)
        rows: list[Row] = []
        for metric, distance in METRICS.items():
            errors = CM * np.asarray(distance(imagined.com[:, :count], truth))
            rows += [
                {"metric": f"{metric}_{name}", "value": float(of(errors))} for name, of in STATISTICS.items()
            ]
        futures = imagined.futures
        said = np.array(futures.outcome)[futures.probability.argmax(axis=1)]
        right = float((said == task.test.outcome).mean())
        rows += [{"metric": "right", "value": right}, {"metric": "count", "value": len(task.test)}]
        return [*rows, {"metric": "seconds", "value": seconds}]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By part, imaginer and metric: mean over the seeds, and its 95 % interval."""
        summary: dict[str, Any] = {}
        for part in (name for name in PARTS if name in set(rows["part"])):
            for imaginer in IMAGINERS:
                mine = rows.loc[rows["part"].eq(part) & rows["imaginer"].eq(imaginer)]
                if mine.empty:
                    continue
                found: dict[str, Any] = {"seeds": int(mine["seed"].nunique())}
                for metric, values in mine.groupby("metric", sort=False)["value"]:
                    found[str(metric)] = interval(values).as_dict(5)
                summary.setdefault(part, {})[imaginer] = found
        return summary

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """A table of errors."""
        head = [
            "",
            "Seeds",
            "Actions",
            "Full, mean [cm]",
            "Full, median",
            "Final, mean",
            "Final, median",
            "Right",
        ]
        parts = ["# The twin beside the direct trajectory predictor"]
        for part, by_imaginer in summary.items():
            lines = [
                [
                    imaginer,
                    str(found["seeds"]),
                    number(found["count"]["mean"], 0),
                    *(mean_with_interval(found[name]) for name in ("full_mean", "full_median")),
                    *(mean_with_interval(found[name]) for name in ("final_mean", "final_median")),
                    f"{100 * found['right']['mean']:.1f} %",
                ]
                for imaginer, found in by_imaginer.items()
            ]
            parts += [f"## {PARTS[part]}", markdown_table(head, lines)]
        return "\n\n".join(parts) + "\n"

    @styled
    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Means and medians of the errors over the full trajectory, part by part."""
        summary = self.summarise(rows)
        if not summary:
            return {}
        fig = new_figure(max(7.0, 1.5 + 1.15 * len(summary)), 4.6)
        ax = fig.subplots()
        for k, (name, color) in enumerate(IMAGINERS.items()):
            at, means, medians = [], [], []
            for place, found in enumerate(summary.values()):
                there = [each for each in IMAGINERS if each in found]
                if name in found:
                    at.append(place + 0.8 * ((there.index(name) + 0.5) / len(there) - 0.5))
                    means.append(found[name]["full_mean"]["mean"])
                    medians.append(found[name]["full_median"]["mean"])
            if at:
                ax.bar(
                    at, means, width=0.24, color=color, alpha=0.6, edgecolor=color, label=name, zorder=2 + k
                )
                ax.plot(at, medians, "_", color=INK, markersize=11, markeredgewidth=1.6, zorder=9)
        ax.plot([], [], "_", color=INK, markersize=11, markeredgewidth=1.6, label="median")
        ax.set_xticks(range(len(summary)), [PARTS[part].replace(" held", "\nheld") for part in summary])
        ax.set_yscale("log")
        ax.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        for label_ticks in (ax.yaxis.set_major_formatter, ax.yaxis.set_minor_formatter):
            label_ticks(FormatStrFormatter("%g"))
        grid(ax, ylabel="error, full trajectory [cm]")
        fig.legend(loc="outside lower center", ncols=5)
        finish(
            fig, "The twin beside the direct trajectory predictor", "bars: means, lines: medians; logarithmic"
        )
        return {"errors": fig}

    # --- data and imaginers -------------------------------------------------------------------------------

    def _task(self, part: str, seed: int) -> Task:
        levered = self._levered
        split = split_by_seed(len(levered), seed, None if self.proportional else PAPER_SIZES)
        if part in CORNERS:
            split = split_by_corner_count(
                levered.num_corners, [int(count) for count in part.split("&")], seed
            )
        elif part == "silhouettes":
            return Task(self._silhouettes, levered, split)
        elif part == "bullet":
            assert self.bullet is not None
            other = load_levered(self.bullet)
            return Task(other[np.isin(other.ids, levered.ids[split.test])], levered, split)
        elif part == "not-flat":
            batch, solid = self._solids
            split = split_by_seed(len(batch), seed, None)
            return Task(batch[split.test[solid[split.test]]], batch, split)
        return Task(levered[split.test], levered, split)

    def _imaginer(self, trial: TwinTrial, task: Task, folder: Path) -> Imaginer:
        if trial.imaginer in TWINS:
            engine, embodiment = TWINS[trial.imaginer]
            nominal = TwinImaginer().sample_times[-1]
            watched = max(0.0, float(task.test.times[-1]) - float(nominal))
            return TwinImaginer(engine, TwinConfig(embodiment=embodiment, watch_time=watched, workers=1))
        if trial.imaginer == "residual":
            return self._residual(trial, task, folder)
        same = "shuffled" if trial.part in ("silhouettes", "bullet") else trial.part
        out = kept_folder(folder, KEPT) / f"{same.replace('&', '-')}-{trial.seed}"
        recipe = self._recipe(same, trial.seed)
        if trial.part == "not-flat":
            recipe = recipe.change(outcomes=tuple(np.unique(task.batch.outcome).tolist()))
        return load_predictor(recipe.train(task.batch, task.split, out))

    def _residual(self, trial: TwinTrial, task: Task, folder: Path) -> Imaginer:
        """A residual over the twin of the blade alone, learned from the training part."""
        twin = TwinImaginer(config=TwinConfig(workers=1))
        file = kept_folder(folder, PRIORS) / f"{fingerprint(task.batch)[:12]}.npz"
        imagined = imagine_once(twin, task.batch, file)
        parts = (task.split.train, task.split.validation)
        learned, other = (rows_of(imagined, rows) for rows in parts)
        batch, validation = (task.batch[rows] for rows in parts)
        config = ResidualConfig(seed=trial.seed)
        return train_residual(batch, validation, twin, config, imagined=(learned, other))

    def _recipe(self, part: str, seed: int) -> Recipe:
        recipe = self.recipe or Recipe.of("one-shot")
        if part == "not-flat":
            recipe = recipe.change(feature_options={"heights": True})
        return recipe.change(seed=seed)

    @cached_property
    def _levered(self) -> InteractionBatch:
        assert self.data is not None
        return load_levered(self.data)

    @cached_property
    def _solids(self) -> tuple[InteractionBatch, np.ndarray]:
        """All interactions with everyday objects, and which of them are cylinders and boxes (batch,)."""
        assert self.everyday is not None
        dataset = Dataset.open(self.everyday)
        batch = dataset.batch()
        batch = batch[valid_lengths(batch) >= 2]
        solid = {int(id): isinstance(dataset.with_id(int(id)).object, Box | Cylinder) for id in batch.ids}
        return batch, np.array([solid[int(id)] for id in batch.ids])

    @cached_property
    def _silhouettes(self) -> InteractionBatch:
        """Lever-ups of silhouettes at points all around them, those that levered."""
        assert self.silhouettes is not None
        found = []
        for subject in read_silhouettes(self.silhouettes):
            for action in subject.actions:
                try:
                    found.append(simulate_lever_up(subject.obj, action, SimulationConfig(), id=len(found)))
                except ViewError:  # it does not fit into the view from that point
                    continue
        batch = InteractionBatch.from_interactions(found)
        return batch[(batch.outcome == "levered") & (valid_lengths(batch) >= 2)]
