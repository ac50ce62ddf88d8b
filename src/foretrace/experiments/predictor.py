"""Errors of one trained predictor as the paper defines them: over the full trajectory and at its end (section 5.2)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from matplotlib.figure import Figure
from tyro.conf import Positional

from foretrace.evaluation.charts import BLUE, SKY, finish, grid
from foretrace.evaluation.experiment import Experiment, Row, Trial
from foretrace.evaluation.metrics import evaluate_predictor
from foretrace.evaluation.tables import markdown_table, number
from foretrace.experiments import SUMMARIES
from foretrace.files import short_hash
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.pictures.style import new_figure, styled
from foretrace.predictor import load_predictor, part_of
from foretrace.predictor.checkpoint import read_config
from foretrace.predictor.run_folder import fingerprint

METRICS = {"full": "Over the full trajectory", "final": "At its end"}
STATISTICS = {"mean_cm": "mean", "median_cm": "median", "p95_cm": "95 %"}


@dataclass(frozen=True)
class PartTrial(Trial):
    """A part of the data."""

    part: str
    """Name of the part."""


@dataclass(frozen=True)
class Predictor(Experiment):
    """Errors of a predictor as the paper defines them: over the full trajectory and at its end, in cm."""

    run_folder: Positional[Path]
    """Folder of the training."""
    data: Path
    """Folder of the data set that it was trained on, or of any other with --part all."""
    part: Literal["train", "validation", "test", "all"] = "test"
    """Which part of the training's split to evaluate on; all: every interaction of the data set, as of one that the
    training never saw, such as imported recordings."""

    label = "predictor"
    summary = SUMMARIES["predictor"]
    trial = PartTrial
    needs_folder = False

    def trials(self) -> Sequence[PartTrial]:
        """One."""
        return [PartTrial(self.part)]

    def identity(self) -> dict[str, Any]:
        """The weights, and the interactions."""
        read_config(self.run_folder)
        model = self.run_folder / "model.safetensors"
        weights = short_hash([model.read_bytes()]) if model.is_file() else None
        return {"model": weights, "data": fingerprint(self._batch)}

    def run(self, trial: PartTrial, folder: Path) -> Sequence[Row]:
        """As from `foretrace.evaluation.metrics.evaluate_predictor`."""
        return evaluate_predictor(load_predictor(self.run_folder), self._batch)

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By part, start, group and metric: number of interactions; mean, median and 95th percentile of errors [cm]."""
        summary: dict[str, Any] = {}
        for row in rows.to_dict("records"):
            place = summary
            for name in ("part", "start", "group"):
                place = place.setdefault(row[name], {})
            place.setdefault("count", {})[row["metric"]] = int(row["count"])
            place[row["metric"]] = {name: round(row[name], 5) for name in STATISTICS}
        return summary

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """Tables of the errors that start from the observed first sample, and the overall ones from the view."""
        parts = [f"# Errors of {self.run_folder}"]
        for part, starts in summary.items():
            where = f"all of {self.data}" if part == "all" else f"{part} part of {self.data}"
            parts += [f"## {where}, in cm", errors_tables(starts)]
        return "\n\n".join(parts) + "\n"

    @styled
    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Mean and 95th percentile of the errors over the full trajectory by group."""
        full = rows.loc[rows["metric"].eq("full") & rows["start"].eq("observed") & rows["part"].eq(self.part)]
        if full.empty:
            return {}
        fig = new_figure(max(6.4, 0.8 * len(full)), 4.2)
        ax = fig.subplots()
        ax.bar(range(len(full)), full["p95_cm"], color=SKY, alpha=0.35, label="95th percentile")
        ax.bar(range(len(full)), full["mean_cm"], color=BLUE, label="mean", width=0.6)
        ax.set_xticks(
            range(len(full)), [f"{g}\n({n})" for g, n in zip(full["group"], full["count"], strict=True)]
        )
        grid(ax, ylim=(0, None), ylabel="error, full trajectory [cm]")
        fig.legend(loc="outside lower center", ncols=2)
        finish(fig, "Errors by outcome and number of corners", "number of interactions in brackets")
        return {"errors": fig}

    @cached_property
    def _batch(self) -> InteractionBatch:
        dataset = Dataset.open(self.data)
        return dataset.batch() if self.part == "all" else part_of(self.run_folder, dataset, self.part)


def errors_tables(starts: Mapping[str, Any]) -> str:
    """Errors by group [cm], a table for each metric; of those that start from the view, the overall ones only."""
    parts = []
    for metric, title in METRICS.items():
        lines = []
        for start, groups in starts.items():
            for group, found in groups.items():
                if start == "estimated" and group != "all":
                    continue
                name = group + (", start from view" if start == "estimated" else "")
                numbers = [number(found[metric][key], 2) for key in STATISTICS]
                lines.append([name, str(found["count"][metric]), *numbers])
        head = ["interactions", "number", *STATISTICS.values()]
        parts += [f"### {title}", markdown_table(head, lines)]
    return "\n\n".join(parts)
