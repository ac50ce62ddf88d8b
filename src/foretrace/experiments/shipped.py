"""The predictor that comes with foretrace, and the twin, on lever-ups that nothing was trained on.

Every part is simulated anew, with the blade alone and nominal physics, but for one part, whose physics and contact are
random; the seed of its objects is not that of the training data. Errors are those of the centre of mass over whole
records. Intervals are over objects.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.stats import rankdata

from foretrace.errors import ResultsError, ViewError
from foretrace.evaluation.charts import GREEN, PURPLE, SKY, VERMILLION, finish, grid
from foretrace.evaluation.experiment import Experiment, Row, Trial
from foretrace.evaluation.metrics import METRICS
from foretrace.evaluation.statistics import interval
from foretrace.evaluation.tables import markdown_table, mean_with_interval, number
from foretrace.experiments import SUMMARIES
from foretrace.experiments.transfer_objects import read_silhouettes
from foretrace.experiments.uncertainty_metrics import score
from foretrace.imagined import STARTS, Futures, ImaginedBatch, Imaginer, Start, conformal_scores
from foretrace.imagined.context import UNKNOWN, Context
from foretrace.imagined.imaginer import UNSURE
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.record import Outcome
from foretrace.pictures.style import new_figure, styled
from foretrace.predictor import load_predictor
from foretrace.predictor.loading import default_checkpoint
from foretrace.predictor.run_folder import fingerprint
from foretrace.simulation.collect import CollectConfig, num_trials, simulate_trial
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.randomisation import NOTHING, RANDOMISED, Randomisation
from foretrace.twin import TwinImaginer

RANDOM = "polygons, random physics"
PARTS = {"polygons": "paper", "boxes and cylinders": "solids", RANDOM: "paper", "silhouettes": ""}
"""What imaginers are tried on, and the recipe that it is simulated by."""
CONTEXTS: dict[str, Context | Literal["recorded"]] = {
    "recorded": "recorded",
    "unknown": UNKNOWN,
    "nominal": None,
}
"""What they are told: everything, no constant, or nominal constants where these are not the true ones."""
DRAWN = 100
"""Motions that are drawn from the futures of an action, for its energy score."""
SHOWN_LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Levels of regions that are looked at."""
BINS = 15
"""Bins of the expected calibration error."""
WATCHED = 1.5
"""Time for which objects are watched after the blade has stopped [s]."""
CM = 100.0


@dataclass(frozen=True)
class ShippedTrial(Trial):
    """One imaginer on one part, told something."""

    part: str
    """One of PARTS."""
    imaginer: str
    """``shipped`` or ``twin``."""
    start: str
    """Where the centre of mass at rest comes from."""
    context: str
    """One of CONTEXTS."""


@dataclass(frozen=True)
class Shipped(Experiment):
    """Try the predictor that comes with foretrace on objects that it was not trained on."""

    run_folder: Path | None = None
    """Folder of another predictor; by default the one that comes with foretrace."""
    silhouettes: Path | None = None
    """Folder of pictures of silhouettes; without one, that part is left out."""
    objects: int = 40
    """Objects of each of the other parts."""
    seed: int = 101
    """Seed of these objects."""
    twin: bool = True
    """Whether the twin is tried, too, with everything told."""

    label = "shipped"
    summary = SUMMARIES["shipped"]
    trial = ShippedTrial

    def trials(self) -> Sequence[ShippedTrial]:
        """Part by part; predictors that need all constants are told all."""
        if self.objects < 1:
            raise ResultsError(f"objects is {self.objects}: give at least 1")
        parts = [part for part in PARTS if part != "silhouettes" or self.silhouettes is not None]
        found = [
            ShippedTrial(part, "shipped", start, context)
            for part in parts
            for start in STARTS
            for context in CONTEXTS
            if context == "recorded"
            or (self._predictor.marginal and (context == "unknown" or part == RANDOM))
        ]
        twins = [part for part in parts if self.twin and part != RANDOM]
        return found + [ShippedTrial(part, "twin", "observed", "recorded") for part in twins]

    def identity(self) -> dict[str, Any] | None:
        """The predictor, and the objects."""
        folder = default_checkpoint() if self.run_folder is None else self.run_folder
        config = (folder / "config.json").read_text()
        return {"predictor": config, "objects": self.objects, "seed": self.seed} | {
            f"data: {part}": fingerprint(batch) for part, batch in self._batches.items()
        }

    def run(self, trial: ShippedTrial, folder: Path) -> Sequence[Row]:
        """Errors [cm], outcomes, probabilities and regions."""
        batch = self._batches[trial.part]
        imaginer: Imaginer = self._predictor if trial.imaginer == "shipped" else TwinImaginer()
        (start,) = (each for each in get_args(Start) if each == trial.start)
        imagined = imaginer.imagine_batch(batch, start, context=CONTEXTS[trial.context])
        return [
            {"metric": name, "value": value, "low": low, "high": high, "count": count}
            for name, (value, low, high, count) in measure(imagined, batch).items()
        ]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By part and kind of trial: every metric with its interval and the number of lever-ups."""
        summary: dict[str, Any] = {}
        for keys, mine in rows.groupby(["part", "imaginer", "start", "context"], sort=False):
            part, imaginer, start, context = map(str, cast(tuple[str, ...], keys))
            found = {
                str(row["metric"]): {
                    name: None if np.isnan(row[column]) else round(float(row[column]), 5)
                    for name, column in (
                        ("mean", "value"),
                        ("low", "low"),
                        ("high", "high"),
                        ("count", "count"),
                    )
                }
                for row in mine.to_dict("records")
            }
            summary.setdefault(part, {})[f"{imaginer}, start {start}, context {context}"] = found
        return summary

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """A table of errors and one of probabilities and regions, part by part."""
        lines = ["# The predictor that comes with foretrace, on lever-ups that it was not trained on"]
        errors = {
            "Levered, mean [cm]": "levered_full",
            "median": "levered_full_median",
            "final": "levered_final",
            "All, mean [cm]": "full",
        }
        shares = {
            "Energy score [cm]": "energy_full",
            "Right": "right",
            "F1 of slips": "f1_slipped",
            "Brier": "brier",
            "constant": "brier_constant",
        }
        shares |= {"ECE": "ece", "ECE of edges": "ece_edge"}
        doubts = {"Error above 1 cm": "wrong", "warned of one": "warned", "AUROC": "auroc"}
        held = {f"{level:.0%}": f"held_{level:g}" for level in SHOWN_LEVELS}
        for part, kinds in summary.items():
            count = next(iter(kinds.values()))["full"]["count"]
            lines.append(f"## {part.capitalize()}: {count:.0f} lever-ups")
            for columns in (errors, shares | doubts, held | {"Radius at 50% [cm]": "radius_0.5"}):
                table = [
                    [
                        kind,
                        *(
                            mean_with_interval(found.get(name))
                            if columns is errors
                            else number((found.get(name) or {}).get("mean"))
                            for name in columns.values()
                        ),
                    ]
                    for kind, found in kinds.items()
                ]
                lines.append(markdown_table(["", *columns], table))
        return "\n\n".join(lines) + "\n"

    @styled
    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """How often regions hold, against their level."""
        parts = [part for part in PARTS if part in set(rows["part"])]
        if not parts:
            return {}
        fig = new_figure(3.4 * len(parts) + 0.6, 3.9)
        for ax, part in zip(np.atleast_1d(fig.subplots(1, len(parts), sharey=True)), parts, strict=True):
            ax.plot([0.4, 1], [0.4, 1], color="#999999", linewidth=1, label="exact")
            for (start, context), color in {
                ("observed", "recorded"): GREEN,
                ("estimated", "recorded"): SKY,
                ("estimated", "unknown"): VERMILLION,
                ("estimated", "nominal"): PURPLE,
            }.items():
                mine = rows[rows["part"].eq(part) & rows["start"].eq(start) & rows["context"].eq(context)]
                mine = mine[mine["imaginer"].eq("shipped")].set_index("metric")["value"]
                shown = mine.reindex([f"held_{level:g}" for level in SHOWN_LEVELS])
                if np.isfinite(shown.to_numpy(float)).any():
                    ax.plot(SHOWN_LEVELS, shown, "o-", color=color, label=f"start {start}, context {context}")
            ax.set_title(part.capitalize())
            ax.set_xlabel("level of the region")
            grid(ax, ylabel="whole motions within it" if part == parts[0] else "")
        named = {
            label: line
            for ax in fig.axes
            for line, label in zip(*ax.get_legend_handles_labels(), strict=True)
        }
        fig.legend(list(named.values()), list(named), loc="outside lower center", ncols=5)
        finish(fig, "Prediction regions on lever-ups that were not trained on", "")
        return {"regions": fig}

    @cached_property
    def _predictor(self) -> Imaginer:
        return load_predictor(self.run_folder)

    @cached_property
    def _batches(self) -> dict[str, InteractionBatch]:
        """The lever-ups of each part."""
        found = {}
        for part, recipe in PARTS.items():
            if recipe:
                found[part] = self._simulated(recipe, RANDOMISED if part == RANDOM else NOTHING)
            elif self.silhouettes is not None:
                found[part] = _levered_silhouettes(self.silhouettes)
        return found

    def _simulated(self, recipe: str, drawn: Randomisation) -> InteractionBatch:
        watched = 0.0 if recipe == "paper" else WATCHED
        simulation = SimulationConfig(embodiment="tool", watch_time=watched)
        config = CollectConfig(
            self.objects, recipe=recipe, seed=self.seed, simulation=simulation, randomisation=drawn
        )
        made = [simulate_trial(config, id) for id in range(num_trials(config))]
        made = [each for each in made if each.object.kind != "prism" or recipe == "paper"]
        return InteractionBatch.from_interactions([each for each in made if len(each.effect.times)])


def _levered_silhouettes(folder: Path) -> InteractionBatch:
    """Lever-ups of silhouettes at points all around them."""
    found, simulation = [], SimulationConfig(embodiment="tool")
    for subject in read_silhouettes(folder):
        for action in subject.actions:
            try:
                found.append(simulate_lever_up(subject.obj, action, simulation, id=len(found)))
            except ViewError:  # it does not fit into the view from that point
                continue
    return InteractionBatch.from_interactions([each for each in found if len(each.effect.times)])


Found = dict[str, tuple[float, float, float, int]]
"""Value, lower and upper end of its 95 % interval, and number of lever-ups, by metric."""


def measure(imagined: ImaginedBatch, batch: InteractionBatch) -> Found:
    """Errors [cm], outcomes, probabilities and regions of imagined effects.

    Returns:
        ``full`` and ``final``, means, and ``full_median``; with ``levered_`` in front, of those that were levered.
        ``energy_full``: energy score of motions drawn from the futures.
        ``right``: outcomes that were the most probable ones; ``f1_slipped``; ``brier`` and ``brier_constant`` of the
        shares of the outcomes; ``ece``: expected calibration error of the most probable outcome, ``ece_edge``: of the
        pivot edge. ``wrong``: errors above a centimetre, ``warned``: expected to be, and ``auroc``: how well the
        expected error tells them. ``held_``: motions that stay in regions; ``radius_0.5``: median radius at the end
        [cm].
    """
    count = min(len(imagined.times), batch.com.shape[1])
    lengths = np.minimum(batch.length, count)
    valid = np.arange(count) < lengths[:, None]
    truth = np.where(valid[..., None], batch.com[:, :count], np.nan)
    levered = batch.outcome == str(Outcome.LEVERED)
    found: Found = {}

    def note(name: str, values: Float[np.ndarray, " n"], rows: np.ndarray) -> None:
        by_object = [
            values[rows & (batch.object_ids == id)].mean() for id in np.unique(batch.object_ids[rows])
        ]
        spread = interval(by_object, 0.0)
        half = (spread.high - spread.low) / 2
        mean = float(values[rows].mean())
        found[name] = mean, mean - half, mean + half, len(values[rows])

    every = np.ones(len(batch), dtype=bool)
    for metric, distance in METRICS.items():
        errors = CM * np.asarray(distance(imagined.com[:, :count], truth))
        for start, rows in (("", every), ("levered_", levered)):
            if rows.any():
                note(f"{start}{metric}", errors, rows)
                median = float(np.median(errors[rows]))
                found[f"{start}{metric}_median"] = median, np.nan, np.nan, int(rows.sum())
    futures = imagined.futures
    if np.isfinite(futures.spread).all():
        note("energy_full", score(draw(futures, DRAWN)[:, :, :count], truth, valid)["energy_full"], every)
    chances = futures.outcomes()
    names, probability = np.array(list(chances)), np.stack(list(chances.values()), axis=1)
    best = names[probability.argmax(axis=1)]
    note("right", (best == batch.outcome).astype(float), every)
    slipped, said = batch.outcome == "slipped", best == "slipped"
    single = {"f1_slipped": 2 * (slipped & said).sum() / max(1, slipped.sum() + said.sum())}
    happened = (batch.outcome[:, None] == names).astype(float)
    note("brier", ((probability - happened) ** 2).sum(axis=1), every)
    single["brier_constant"] = 1 - float((happened.mean(axis=0) ** 2).sum())
    single["ece"] = calibration_error(probability.max(axis=1), best == batch.outcome)
    edges = _edges(imagined, batch, levered)
    single |= {} if edges is None else {"ece_edge": calibration_error(*edges)}
    error = np.asarray(METRICS["full"](imagined.com[:, :count], truth))
    doubt, wrong = futures.expected_error(), error > UNSURE
    if np.isfinite(doubt).all() and 0 < wrong.sum() < len(wrong):
        single |= {"wrong": wrong.mean(), "warned": (doubt > UNSURE).mean(), "auroc": auroc(doubt, wrong)}
    if np.isfinite(futures.quantiles).any():
        cut = replace(futures, states=futures.states[:, :, :count], spread=futures.spread[:, :, :count])
        scores = conformal_scores(cut, np.nan_to_num(truth), lengths)
        rows, likeliest = np.arange(len(batch)), futures.probability.argmax(axis=1)
        for level in SHOWN_LEVELS:
            note(f"held_{level:g}", (scores <= futures.width(level)).astype(float), every)
        single["radius_0.5"] = CM * float(np.median(futures.radius(0.5)[rows, likeliest, lengths - 1]))
    return found | {name: (float(value), np.nan, np.nan, len(batch)) for name, value in single.items()}


def draw(futures: Futures, num: int, seed: int = 0) -> Float[np.ndarray, "batch num time 3"]:
    """Motions of centres of mass drawn from futures [m]: each is off by its future's spread, in one direction.

    Args:
        futures: The futures; their spreads must be known.
        num: Motions for each action.
        seed: Seed of the draw.
    """
    rng = np.random.default_rng(seed)
    rows = np.arange(len(futures))[:, None]
    passed = futures.probability.cumsum(axis=1)[:, None] < rng.random((len(futures), num, 1))
    chosen = np.minimum(passed.sum(axis=2), futures.probability.shape[1] - 1)
    off = rng.standard_normal((len(futures), num, 1, 3)) / 3**0.5
    return futures.com[rows, chosen] + off * futures.spread[rows, chosen][..., None]


def auroc(scores: Float[np.ndarray, " n"], positive: np.ndarray) -> float:
    """Area under the receiver operating characteristic: chance that a positive has the higher score (Mann-Whitney)."""
    ranks, count = rankdata(scores), int(positive.sum())
    return float((ranks[positive].sum() - count * (count + 1) / 2) / (count * (len(scores) - count)))


def calibration_error(confidence: Float[np.ndarray, " n"], right: np.ndarray) -> float:
    """Expected calibration error: mean distance of confidence and share that is right, over equally wide bins."""
    bins = np.minimum((confidence * BINS).astype(int), BINS - 1)
    shares = [(bins == k) for k in range(BINS) if (bins == k).any()]
    return float(sum(abs(confidence[mine].mean() - right[mine].mean()) * mine.mean() for mine in shares))


def _edges(
    imagined: ImaginedBatch, batch: InteractionBatch, levered: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Probability of the likeliest pivot edge, and whether the observed support points lie on it.

    Of levered objects whose support points were observed; None: there are none.
    """
    futures = imagined.futures
    rows = levered & np.isfinite(batch.support_points).all(axis=(1, 2))
    middle = futures.support_points.mean(axis=2)
    if not rows.any() or not np.isfinite(middle).any():
        return None
    mine = np.array([name == str(Outcome.LEVERED) for name in futures.outcome])
    probability = (
        futures.probability[:, mine] / np.maximum(futures.probability[:, mine].sum(axis=1), 1e-9)[:, None]
    )
    off = np.linalg.norm(middle[:, mine] - batch.support_points.mean(axis=1)[:, None], axis=2)
    likeliest = probability.argmax(axis=1)
    right = np.nan_to_num(off, nan=np.inf).argmin(axis=1) == likeliest
    return probability.max(axis=1)[rows], right[rows]
