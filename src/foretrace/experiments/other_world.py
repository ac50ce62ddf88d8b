"""How many real lever-ups a predictor needs in a world that is not the simulator's.

Truth is a data set from another engine, with other frictions than the nominal ones. Learned from few of its lever-ups:
the direct trajectory predictor alone; the predictor that comes with foretrace, fine-tuned, which has learned from
simulations and is told the frictions of the other world; and residuals over a twin, which simulates what it sees in its
own engine, told the nominal frictions or those of the other world. A hundred lever-ups more decide the widths of
regions, which errors do not depend on.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from tyro.conf import Fixed, Suppress

from foretrace.errors import ResultsError
from foretrace.evaluation.charts import GREEN, ORANGE, PURPLE, SKY, finish, grid
from foretrace.evaluation.experiment import Experiment, Row, Trial, checked_seeds, chosen, kept_folder
from foretrace.evaluation.metrics import METRICS
from foretrace.evaluation.statistics import TEST_TO_TRAIN, interval
from foretrace.evaluation.tables import markdown_table, mean_with_interval
from foretrace.experiments import SUMMARIES
from foretrace.experiments.kept_motions import imagine_once, rows_of
from foretrace.experiments.training import Recipe, load_levered, weights_of
from foretrace.imagined import ImaginedBatch
from foretrace.imagined.context import CONSTANTS
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.record import Physics
from foretrace.interactions.splits import PAPER_SIZES, Split, scaled_sizes
from foretrace.pictures.style import new_figure, styled
from foretrace.predictor import fit_predictor
from foretrace.predictor.checkpoint import read_predictor
from foretrace.predictor.config import FINE_TUNING
from foretrace.predictor.loading import default_checkpoint
from foretrace.predictor.run_folder import fingerprint, processor_independent_fingerprint
from foretrace.predictor.states import valid_samples
from foretrace.twin import TwinConfig, TwinImaginer
from foretrace.twin.residual import train_residual
from foretrace.twin.residual_network import ResidualConfig

METHODS = {
    "learned alone": SKY,
    "fine-tuned": PURPLE,
    "residual, nominal": ORANGE,
    "residual, told": GREEN,
}
"""What is compared, with its colour. With no lever-up, a residual is its twin, and what is fine-tuned is as it was."""
WORDS = {
    "learned alone": "direct predictor alone",
    "fine-tuned": "predictor that comes with foretrace, told the frictions, fine-tuned",
    "residual, nominal": "residual over the twin, nominal frictions",
    "residual, told": "residual over the twin, told the frictions",
}
COUNTS = (0, 10, 30, 100, 300, 1300)
STATISTICS: dict[str, Callable[[np.ndarray], Any]] = {"mean": np.mean, "median": np.median}
PRIORS = "priors"
"""Folder of the twins' motions within the results."""
CM = 100.0


@dataclass(frozen=True)
class OtherWorldTrial(Trial):
    """One method with some lever-ups."""

    method: str
    """One of METHODS."""
    lever_ups: int
    """Number of real lever-ups that are learned from."""
    seed: int
    """Seed of the split and of the training."""


@dataclass(frozen=True)
class OtherWorld(Experiment):
    """Learn from few lever-ups of another world: alone, or over a twin."""

    data: Path | None = None
    """Folder of the other world's data set: `foretrace simulate --engine bullet --embodiment tool --friction 0.6
    --tool-friction 0.4`. Without one nothing is run: results that are there are drawn again."""
    methods: tuple[str, ...] = ()
    """Which methods; by default all."""
    lever_ups: tuple[int, ...] = COUNTS
    """Numbers of real lever-ups to learn from."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of splits and trainings."""
    proportional: bool = False
    """Test and validate on the paper's shares instead of its 300 and 100 interactions."""
    recipe: Suppress[Fixed[Recipe | None]] = None
    """Other settings of the direct predictor's trainings."""
    residual: Suppress[Fixed[ResidualConfig]] = field(default_factory=ResidualConfig)
    """Settings of residuals."""

    label = "other-world"
    summary = SUMMARIES["other-world"]
    trial = OtherWorldTrial

    def __post_init__(self) -> None:
        checked_seeds(self.seeds)
        if not self.lever_ups or min(self.lever_ups) < 0:
            raise ResultsError(f"--lever-ups is {self.lever_ups}: give numbers from 0 on")

    def trials(self) -> Sequence[OtherWorldTrial]:
        """Seed by seed, the few lever-ups first; none without data."""
        if self.data is None:
            return []
        methods = chosen("method", self.methods, tuple(METHODS))
        return [
            OtherWorldTrial(method, count, seed)
            for seed in checked_seeds(self.seeds)
            for count in dict.fromkeys(self.lever_ups)
            for method in methods
            if count or method != "learned alone"
        ]

    def identity(self) -> dict[str, Any] | None:
        """The data, and how predictors are trained."""
        if self.data is None:
            return None
        own = {name: value for name, value in vars(self.residual).items() if name != "seed"}
        recipe = {"predictor": self._recipe.describe(), "residual": own, "proportional": self.proportional}
        recipe["initial"] = weights_of(None)
        return {"data": processor_independent_fingerprint(self._levered), "recipe": recipe}

    def run(self, trial: OtherWorldTrial, folder: Path) -> Sequence[Row]:
        """Errors [cm] on lever-ups that were not learned from."""
        batch, split = self._levered, self._split(trial)
        test = batch[split.test]
        if trial.method == "learned alone":
            predictor, _ = self._recipe.change(seed=trial.seed).fit(batch, split)
            com = predictor.imagine_batch(test).com
        elif trial.method == "fine-tuned":
            predictor = read_predictor(default_checkpoint())
            if trial.lever_ups:
                predictor, _ = fit_predictor(batch, predictor, split, replace(FINE_TUNING, seed=trial.seed))
            com = predictor.imagine_batch(test, context="recorded").com[:, : test.com.shape[1]]
        else:
            twin, imagined = self._imagined(trial.method, folder)
            com = imagined.com[split.test]
            if trial.lever_ups:
                learned, other = (rows_of(imagined, rows) for rows in (split.train, split.validation))
                config = replace(self.residual, seed=trial.seed)
                residual = train_residual(
                    batch[split.train], batch[split.validation], twin, config, imagined=(learned, other)
                )
                com = residual.correct(test, test.com[:, 0], rows_of(imagined, split.test)).com
        truth = np.where(valid_samples(test)[..., None], test.com, np.nan)
        rows: list[Row] = []
        for metric, distance in METRICS.items():
            errors = CM * np.asarray(distance(com, truth))
            rows += [
                {"metric": f"{metric}_{name}", "value": float(of(errors))} for name, of in STATISTICS.items()
            ]
        return [*rows, {"metric": "count", "value": len(test)}]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By method, number of lever-ups and metric: mean over the seeds and its 95 % interval."""
        summary: dict[str, Any] = {}
        for method in METHODS:
            mine = rows.loc[rows["method"].eq(method)]
            for count in sorted(int(number) for number in set(mine["lever_ups"])):
                there = mine.loc[mine["lever_ups"].eq(count)]
                found: dict[str, Any] = {"seeds": int(there["seed"].nunique())}
                ratio = PAPER_SIZES[2] / count if count else TEST_TO_TRAIN
                for metric, values in there.groupby("metric", sort=False)["value"]:
                    found[str(metric)] = interval(values, ratio).as_dict(5)
                summary.setdefault(method, {})[str(count)] = found
        return summary

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """A table of means, and one of medians."""
        counts = sorted({int(count) for found in summary.values() for count in found})
        seeds = sorted({each["seeds"] for found in summary.values() for each in found.values()})
        parts = ["# Few real lever-ups in another world", f"Seeds: {', '.join(map(str, seeds))}."]
        for metric, words in (
            ("full_mean", "mean"),
            ("full_median", "median"),
            ("final_mean", "mean, at the end"),
        ):
            lines = [
                [
                    WORDS[method],
                    *(
                        mean_with_interval(found.get(str(count), {}).get(metric), missing="-")
                        for count in counts
                    ),
                ]
                for method, found in summary.items()
            ]
            title = f"## Error [cm], {words}, by the number of real lever-ups"
            parts += [title, markdown_table(["", *map(str, counts)], lines)]
        return "\n\n".join(parts) + "\n"

    @styled
    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Errors over the number of lever-ups, both logarithmic."""
        summary = self.summarise(rows)
        if not summary:
            return {}
        fig = new_figure(7.0, 4.6)
        ax = fig.subplots()
        counts = sorted({int(count) for found in summary.values() for count in found})
        nothing = 10 ** (np.log10(min((c for c in counts if c), default=10)) - 0.6)
        place = {count: count or nothing for count in counts}
        for method, found in summary.items():
            at = [place[int(count)] for count in found]
            mean = np.array([each["full_mean"]["mean"] for each in found.values()])
            ax.plot(at, mean, "o-", color=METHODS[method], label=WORDS[method], linewidth=1.8, markersize=5)
            for x, each in zip(at, found.values(), strict=True):
                low, high = (each["full_mean"][end] for end in ("low", "high"))
                if low is not None:
                    ax.plot([x, x], [max(low, 1e-3), high], color=METHODS[method], linewidth=1.1)
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_xticks(list(place.values()), [str(count) for count in place])
        ax.set_yticks(ticks := [0.05, 0.1, 0.2, 0.5, 1.0], [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()
        means = [each["full_mean"]["mean"] for found in summary.values() for each in found.values()]
        ax.set_ylim(0.6 * min(means), 1.5 * max(means))  # intervals of two seeds would stretch it
        grid(ax, xlabel="real lever-ups learned from", ylabel="error, full trajectory [cm]")
        fig.legend(loc="outside lower center", ncols=1)
        seeds = max(each["seeds"] for found in summary.values() for each in found.values())
        finish(fig, "Few real lever-ups in another world", f"means over up to {seeds} seeds, 95 % intervals")
        return {"lever-ups": fig}

    # --- data and twins -----------------------------------------------------------------------------------

    def _split(self, trial: OtherWorldTrial) -> Split:
        """Test and validation parts of a seed, the same for all; fewer lever-ups are part of more."""
        count = len(self._levered)
        _, validation, test = scaled_sizes(count) if self.proportional else PAPER_SIZES
        if (needed := trial.lever_ups + validation + test) > count:
            raise ResultsError(
                f"{trial.lever_ups} lever-ups to learn from need {needed} levered interactions, the data has {count}: "
                "simulate more objects, or choose smaller numbers"
            )
        order = np.random.default_rng(trial.seed).permutation(count)
        parts = np.split(order, np.cumsum([validation, test, trial.lever_ups]))
        return Split(train=np.sort(parts[2]), validation=np.sort(parts[0]), test=np.sort(parts[1]))

    def _imagined(self, method: str, folder: Path) -> tuple[TwinImaginer, ImaginedBatch]:
        """What the twin of a method imagines of all lever-ups: simulated once, and kept beside the results."""
        twin, batch = TwinImaginer(config=TwinConfig(workers=1)), self._levered
        if method == "residual, nominal":
            nominal = Physics()
            told = {
                name: np.full(len(batch), getattr(nominal, name))
                for name in CONSTANTS
                if hasattr(nominal, name)
            }
            batch = replace(batch, parameters=batch.parameters | told)
        if method not in self._known:
            file = kept_folder(folder, PRIORS) / f"{method.split(', ')[1]}-{fingerprint(batch)[:12]}.npz"
            self._known[method] = imagine_once(twin, batch, file)
        return twin, self._known[method]

    @cached_property
    def _levered(self) -> InteractionBatch:
        assert self.data is not None
        return load_levered(self.data)

    @cached_property
    def _known(self) -> dict[str, ImaginedBatch]:
        return {}

    @cached_property
    def _recipe(self) -> Recipe:
        return self.recipe or Recipe.of("one-shot")
