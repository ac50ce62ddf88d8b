"""Does the predictor notice that a family of objects is new to it?

A direct trajectory predictor is trained without one family, and asked about that one and about those that it has
learned from. Two scores are to tell errors above a centimetre: the error that it expects, which grows where networks
disagree, and the distance of what they are given from the nearest actions of the training part. Starts are estimated
from views, so that objects of uniform density alone are asked about.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.spatial import KDTree
from tyro.conf import Fixed, Suppress

from foretrace.errors import PredictionError, ResultsError
from foretrace.evaluation.charts import ORANGE, SKY, finish, grid
from foretrace.evaluation.experiment import Experiment, Row, Trial, checked_seeds, chosen
from foretrace.evaluation.metrics import METRICS
from foretrace.evaluation.statistics import interval
from foretrace.evaluation.tables import markdown_table, mean_with_interval, number
from foretrace.experiments import SUMMARIES
from foretrace.experiments.shipped import auroc, measure
from foretrace.experiments.training import Recipe
from foretrace.imagined.context import column_of
from foretrace.imagined.domain import OWN, check_contacts
from foretrace.imagined.imaginer import UNSURE
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.splits import Split
from foretrace.pictures.style import new_figure, styled
from foretrace.predictor import OneShotConfig, TrainConfig
from foretrace.predictor.one_shot import OneShotPredictor
from foretrace.predictor.run_folder import fingerprint
from foretrace.predictor.states import valid_lengths

FAMILIES = {
    "few corners": "prisms of 3 and 4 corners",
    "many corners": "prisms of 9 and 10 corners",
    "round": "round, organic and dented outlines",
    "solid": "boxes and cylinders",
}
"""Families that are held out, in words."""
PARTS = {"known": SKY, "held out": ORANGE}
"""What a predictor is asked about, with its colour."""
SHARES = (0.85, 0.06)
"""Shares of the other families' actions for training and validation; the others test."""
NEIGHBOURS = 5
"""The distance is that to the nearest actions of the training part, of this many the farthest."""
CONTEXT = (
    *("friction", "tool_friction", "density", "contact_error", "bevel_width", "bevel_height"),
    *("insertion", "arc_radius", "sweep", "speed"),
)
OUTCOMES = ("levered", "slipped", "tumbled", "rolled", "missed")
SHOWN = {
    "count": "Lever-ups",
    "levered_full": "Levered [cm]",
    "right": "Right",
    "held_0.5": "In 50 %",
    "held_0.9": "In 90 %",
    "wrong": "Above 1 cm",
    "warned": "Warned",
    "auroc": "AUROC, expected error",
    "auroc_distance": "AUROC, distance",
    "auroc_both": "AUROC, both",
}
"""Metrics of the table, with their headings."""


@dataclass(frozen=True)
class NovelFamiliesTrial(Trial):
    """One family held out."""

    family: str
    """One of FAMILIES."""
    seed: int
    """Seed of the split and of the training."""


def usual_recipe() -> Recipe:
    """The settings of the predictor that comes with foretrace, with smaller networks and fewer epochs."""
    config = OneShotConfig(
        feature_options={"heights": True}, components=48, context=CONTEXT, hidden_share=0.6,
        error_weighting=0.5, phase_time=True, outcomes=OUTCOMES,
    )  # fmt: skip
    return Recipe(config, TrainConfig(epochs=40, learning_rate=config.training.learning_rate))


@dataclass(frozen=True)
class NovelFamilies(Experiment):
    """Train without a family of objects, and see whether errors on it are foretold."""

    data: Path | None = None
    """Folder of a data set with several families: `foretrace simulate --recipe all`. Without one nothing is run: what
    is there is drawn again."""
    families: tuple[str, ...] = ()
    """Which families are held out; by default all, one by one."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of splits and trainings."""
    recipe: Suppress[Fixed[Recipe]] = field(default_factory=usual_recipe)
    """Settings of the trainings."""

    label = "novel-families"
    summary = SUMMARIES["novel-families"]
    trial = NovelFamiliesTrial

    def trials(self) -> Sequence[NovelFamiliesTrial]:
        """Seed by seed; none without data."""
        if self.data is None:
            return []
        families = chosen("family", self.families, tuple(FAMILIES))
        return [NovelFamiliesTrial(family, seed) for seed in checked_seeds(self.seeds) for family in families]

    def identity(self) -> dict[str, Any] | None:
        """The data, and how predictors are trained."""
        if self.data is None:
            return None
        return {"data": fingerprint(self._batch), "recipe": self.recipe.describe()}

    def run(self, trial: NovelFamiliesTrial, folder: Path) -> Sequence[Row]:
        """As `foretrace.experiments.shipped.measure`, and how well the distance tells errors above a centimetre."""
        batch, mine = self._batch, self._families == trial.family
        if not mine.any() or mine.all():
            raise ResultsError(
                f"{self.data} has {mine.sum()} of {len(mine)} actions on the family {trial.family!r}: "
                "give a data set with several families"
            )
        others = np.random.default_rng(trial.seed).permutation(np.flatnonzero(~mine))
        train, validation, known = np.split(others, np.cumsum(np.array(SHARES) * len(others)).astype(int))
        predictor, _ = self.recipe.change(seed=trial.seed).fit(
            batch, Split(np.sort(train), np.sort(validation), np.sort(known))
        )
        assert isinstance(predictor, OneShotPredictor)
        learned = KDTree(_described(predictor, batch[np.sort(train)]))
        rows: list[Row] = []
        for part, numbers in (("known", np.sort(known)), ("held out", np.flatnonzero(mine))):
            test = batch[numbers[self._askable[numbers]]]
            imagined = predictor.imagine_batch(test, "estimated", context="recorded")
            found = {name: value for name, (value, *_) in measure(imagined, test).items()}
            valid = np.arange(test.com.shape[1]) < test.length[:, None]
            error = np.asarray(METRICS["full"](imagined.com, np.where(valid[..., None], test.com, np.nan)))
            distance = learned.query(_described(predictor, test), k=NEIGHBOURS)[0][:, -1]
            found["count"] = len(test)
            found |= foretold(imagined.futures.expected_error(), distance, error > UNSURE)
            rows += [{"part": part, "metric": name, "value": value} for name, value in found.items()]
        return rows

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By family, part and metric: mean over the seeds, and its 95 % interval."""
        summary: dict[str, Any] = {}
        for keys, mine in rows.groupby(["family", "part", "metric"], sort=False):
            family, part, metric = map(str, cast(tuple[str, ...], keys))
            found = interval(mine["value"].to_numpy(float)).as_dict(5)
            summary.setdefault(family, {}).setdefault(part, {})[metric] = found
        return summary

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """A table for each family."""
        parts = ["# Families of objects that are new to the predictor"]
        for family, by_part in summary.items():
            lines = [
                [
                    part,
                    *(
                        mean_with_interval(found.get(name), missing="-")
                        if name == "levered_full"
                        else number((found.get(name) or {}).get("mean"), 0 if name == "count" else 3)
                        for name in SHOWN
                    ),
                ]
                for part, found in by_part.items()
            ]
            parts += [f"## Without {FAMILIES[family]}", markdown_table(["", *SHOWN.values()], lines)]
        return "\n\n".join(parts) + "\n"

    @styled
    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """How well each score tells errors above a centimetre, on the family that was held out."""
        summary = self.summarise(rows)
        if not summary:
            return {}
        fig = new_figure(7.2, 4.0)
        ax = fig.subplots()
        names = ("auroc", "auroc_distance", "auroc_both")
        for k, part in enumerate(PARTS):
            for j, name in enumerate(names):
                at = [place + 0.27 * (j - 1) + 0.1 * (k - 0.5) for place in range(len(summary))]
                values = [found[part].get(name, {"mean": np.nan})["mean"] for found in summary.values()]
                marker = "os^"[j]
                label = f"{SHOWN[name].removeprefix('AUROC, ')}, {part}"
                ax.plot(at, values, marker, color=PARTS[part], markersize=7, label=label, zorder=3)
        ax.axhline(0.5, color="#999999", linewidth=1)
        ax.set_xticks(
            range(len(summary)), [FAMILIES[family].replace(" and ", "\nand ") for family in summary]
        )
        grid(ax, ylim=(0.3, 1.02), ylabel="AUROC of errors above 1 cm")
        fig.legend(loc="outside lower center", ncols=3)
        finish(fig, "Are errors foretold on a family that was held out?", "0.5: chance; 1: every error")
        return {"auroc": fig}

    @cached_property
    def _askable(self) -> np.ndarray:
        """(batch,) bool: actions on objects of uniform density, at whose rim they begin."""
        uniform = np.nan_to_num(column_of(self._batch, "com_offset")) == 0
        return uniform & np.array([_at_rim(mask) for mask in self._batch.mask])

    @cached_property
    def _data(self) -> tuple[InteractionBatch, np.ndarray]:
        assert self.data is not None
        dataset = Dataset.open(self.data)
        batch, family = dataset.batch(), np.array([family_of(obj) for obj in dataset.objects()])
        rows = (valid_lengths(batch) >= 2) & np.isin(batch.outcome, self.recipe.predictor.make(2).outcomes)
        return batch[rows], family[rows]

    @property
    def _batch(self) -> InteractionBatch:
        return self._data[0]

    @property
    def _families(self) -> np.ndarray:
        return self._data[1]


def _described(predictor: OneShotPredictor, batch: InteractionBatch) -> Float[np.ndarray, "batch values"]:
    """What networks are given about actions, without the context."""
    inputs = predictor.network_inputs(batch)[:, 0, : len(predictor.value_mean)]
    return np.asarray(inputs.double().cpu())


def _at_rim(mask: np.ndarray) -> bool:
    try:
        check_contacts(mask, *OWN)
    except PredictionError:
        return False
    return True


def family_of(obj: Mapping[str, Any]) -> str:
    """The family of an object, from its description; empty: one that is never held out."""
    inner = obj
    while "object" in inner:  # weighted, or on feet
        inner = inner["object"]
    if inner["kind"] in ("box", "cylinder"):
        return "solid"
    corners = len(inner.get("corners", ()))
    if corners == 0:
        return ""
    if corners > 10:
        return "round"
    return "few corners" if corners <= 4 else "many corners" if corners >= 9 else ""


def foretold(
    expected: Float[np.ndarray, " n"], distance: Float[np.ndarray, " n"], wrong: np.ndarray
) -> dict[str, float]:
    """How well scores tell what is wrong; both together by the sum of their logarithms' standard scores."""
    if not 0 < wrong.sum() < len(wrong):
        return {}
    logs = [np.log(np.maximum(score, 1e-9)) for score in (expected, distance)]
    both = sum((each - each.mean()) / max(each.std(), 1e-9) for each in logs)
    return {"auroc_distance": auroc(distance, wrong), "auroc_both": auroc(np.asarray(both), wrong)}
