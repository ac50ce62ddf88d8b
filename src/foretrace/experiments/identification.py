"""What lever-ups of an object tell of frictions and centre of mass, and what that is worth for the next ones.

Objects with a centre of mass that is off, in worlds with other frictions, are levered, tracked with noise, and
identified; other lever-ups of the same object are then imagined: told nothing, with what was learned, and told all.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter
from scipy.stats import kstest

from foretrace.actions import LeverUp
from foretrace.errors import ResultsError, ShapeError, ViewError
from foretrace.evaluation.charts import GREEN, ORANGE, SKY, finish, grid
from foretrace.evaluation.experiment import Experiment, Row, Trial
from foretrace.evaluation.statistics import interval
from foretrace.evaluation.tables import markdown_table, mean_with_interval, number
from foretrace.experiments import SUMMARIES
from foretrace.experiments.executions import PERIOD, Scene, track
from foretrace.experiments.monitor_calibration import predictor
from foretrace.files import short_hash
from foretrace.geometry import quaternion_to_matrix
from foretrace.imagined import Belief, ObservedMotion
from foretrace.imagined.belief import RANGES
from foretrace.interactions.record import ExecutionOffset, Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.monitoring import identify
from foretrace.objects import Prism, Weighted, sample_prism
from foretrace.pictures.style import new_figure, styled
from foretrace.predictor.loading import default_checkpoint
from foretrace.twin import TwinConfig, TwinImaginer

LEARNED_FROM, TRIED = 3, 3
"""Lever-ups of each object that are learned from, and others that are imagined."""
SHOWN = (1, 3)
"""Numbers of lever-ups after which results are looked at."""
LARGEST_OFFSET = 0.02
"""Largest offset of the centre of mass [m]."""
NAMES = ("friction", "tool_friction", "density", "com_x", "com_y")
CM, MM = 100.0, 1000.0


@dataclass(frozen=True)
class IdentificationTrial(Trial):
    """One object in one world."""

    object: int
    """Its number."""


@dataclass(frozen=True)
class Identification(Experiment):
    """Learn constants from lever-ups of one object, and imagine others."""

    objects: int = 24
    """Number of objects."""
    seed: int = 911
    """Seed of objects and worlds."""
    exact: bool = False
    """Whether the twin plays the best worlds again."""

    label = "identification"
    summary = SUMMARIES["identification"]
    trial = IdentificationTrial

    def trials(self) -> Sequence[IdentificationTrial]:
        """One for each object."""
        if self.objects < 1:
            raise ResultsError(f"objects is {self.objects}: give at least 1")
        return [IdentificationTrial(k) for k in range(self.objects)]

    def identity(self) -> dict[str, Any] | None:
        """The predictor and the seed."""
        config = (default_checkpoint() / "config.json").read_bytes()
        own = {"predictor": short_hash([config]), "seed": self.seed}
        return own | {"exact": True} if self.exact else own

    def run(self, trial: IdentificationTrial, folder: Path) -> Sequence[Row]:
        """Errors of the centre of mass, ranks of the true constants, errors of other lever-ups."""
        rng = np.random.default_rng([self.seed, trial.object])
        case = _draw(rng)
        rows: list[Row] = []
        belief: Belief | None = None
        begin = time.process_time()
        twin = TwinImaginer(config=TwinConfig(workers=1)) if self.exact else None
        for k, action in enumerate(case.actions[:LEARNED_FROM]):
            poses = case.play(action, rng)
            tracked = track(poses, PERIOD * np.arange(len(poses)), "", rng)
            seen = np.array([j for j, pose in enumerate(tracked) if pose is not None])
            motion = ObservedMotion(PERIOD * seen, np.array([tracked[j] for j in seen]))
            belief = identify(
                TopDownView.of(case.prism, action),
                action,
                motion,
                belief,
                imaginer=predictor(),
                exact=twin,
                seed=k,
            )
            if k + 1 in SHOWN:
                rows += _about(belief, case, k + 1)
                kept = {f"after {k + 1}": belief}
                rows += _errors(case, kept, rng_of(self.seed, trial.object))
        rows.append({"metric": "seconds", "value": (time.process_time() - begin) / LEARNED_FROM})
        return [*rows, *_errors(case, {}, rng_of(self.seed, trial.object))]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """Means with intervals by metric; calibration of ranks; shares of the gain."""
        values = {str(name): np.asarray(each, dtype=float) for name, each in rows.groupby("metric")["value"]}
        summary: dict[str, Any] = {"objects": len(set(np.asarray(rows["object"]).tolist()))}
        summary["metrics"] = {
            name: interval(each, 0.0).as_dict(4) | {"median": float(np.median(each))}
            for name, each in values.items()
            if not name.startswith("rank")
        }
        summary["ranks"] = {
            name.removeprefix("rank "): float(kstest(each, "uniform").pvalue)
            for name, each in values.items()
            if name.startswith("rank")
        }
        if {"error nothing", "error told"} <= set(values):
            gain = values["error nothing"].mean() - values["error told"].mean()
            summary["gain"] = {
                str(count): float(
                    (values["error nothing"].mean() - values[f"error after {count}"].mean()) / gain
                )
                for count in SHOWN
                if f"error after {count}" in values
            }
        return summary

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """Tables of errors and of calibration."""
        found = summary["metrics"]
        words = {
            "error nothing": "told nothing",
            "error after 1": "after 1 lever-up",
            "error after 3": "after 3 lever-ups",
            "error told": "told everything",
        }
        lines = [
            [words[name], mean_with_interval(found[name]), number(found[name]["median"])]
            for name in words
            if name in found
        ]
        parts = [
            "# Identification",
            f"{summary['objects']} objects, {TRIED} other lever-ups of each.",
            markdown_table(["Error of other lever-ups [cm]", "Mean", "Median"], lines),
        ]
        if "gain" in summary:
            shares = ", ".join(f"{100 * each:.0f} % after {count}" for count, each in summary["gain"].items())
            parts.append(f"Share of the gain that being told everything gives: {shares}.")
        lines = [
            [
                f"after {count}",
                mean_with_interval(found[f"com {count}"], 2),
                number(found[f"com {count}"]["median"], 2),
            ]
            for count in SHOWN
            if f"com {count}" in found
        ]
        parts.append(markdown_table(["Error of the centre of mass [mm]", "Mean", "Median"], lines))
        lines = [
            [
                name,
                *(number(found[f"std {name} {count}"]["mean"], 2) for count in SHOWN),
                *(number(summary["ranks"][f"{name} {count}"], 3) for count in SHOWN),
            ]
            for name in NAMES
        ]
        head = ["", *(f"Spread after {count}, of the prior's" for count in SHOWN)]
        head += [f"Ranks after {count}: p" for count in SHOWN]
        parts.append(markdown_table(head, lines))
        parts.append(f"One identification: {found['seconds']['median']:.1f} s of processor time.")
        return "\n\n".join(parts) + "\n"

    @styled
    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Errors of other lever-ups, object by object."""
        values = {str(name): np.asarray(each, dtype=float) for name, each in rows.groupby("metric")["value"]}
        names = [
            name
            for name in ("error nothing", "error after 1", "error after 3", "error told")
            if name in values
        ]
        if len(names) < 2:
            return {}
        fig = new_figure(6.5, 4.2)
        ax = fig.subplots()
        for k, (name, color) in enumerate(zip(names, ("#8b93a1", SKY, ORANGE, GREEN), strict=False)):
            ax.plot(np.full(len(values[name]), k), values[name], "o", color=color, alpha=0.4, markersize=4)
            ax.plot([k - 0.25, k + 0.25], [values[name].mean()] * 2, color=color, linewidth=2.5)
        ax.set_xticks(range(len(names)), [name.removeprefix("error ") for name in names])
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        grid(ax, ylabel="error of other lever-ups [cm]")
        finish(
            fig, "What was learned, on other lever-ups of the same object", "lines: means; points: objects"
        )
        return {"errors": fig}


@dataclass(frozen=True, eq=False)
class Case:
    """One object in its world."""

    prism: Prism
    """The object as it is seen."""
    object: Weighted
    """The object as it is."""
    physics: Physics
    """Its world."""
    actions: tuple[LeverUp, ...]
    """Lever-ups: those to learn from, then the others."""

    def play(self, action: LeverUp, rng: np.random.Generator) -> np.ndarray:
        """(time, 7) Poses of the object frame in the action frame, with an execution error."""
        offset = ExecutionOffset(
            *(rng.uniform(*RANGES[name]) for name in ("contact_ahead", "contact_left", "contact_turn"))
        )
        poses = Scene(self.object, self.physics, action, offset).play()
        if poses is None:
            raise ResultsError("a simulation blew up: choose another seed")
        return poses


def rng_of(seed: int, number: int) -> np.random.Generator:
    """Random numbers of the other lever-ups: the same ones for whatever imagines them."""
    return np.random.default_rng([seed, number, 1])


def _draw(rng: np.random.Generator) -> Case:
    """An object, its world, and lever-ups of it that fit into a view."""
    while True:
        prism = sample_prism(rng, int(rng.integers(4, 9)))
        angle, far = rng.uniform(0, 2 * np.pi), LARGEST_OFFSET * np.sqrt(rng.random())
        physics = Physics(*(rng.uniform(*RANGES[name]) for name in ("density", "friction", "tool_friction")))
        actions = [
            LeverUp.at_edge(prism, int(rng.integers(len(prism.corners))), rng.uniform(0.25, 0.75))
            for _ in range(LEARNED_FROM + TRIED)
        ]
        try:
            for action in actions:
                TopDownView.of(prism, action)
            loaded = Weighted(prism, far * np.array([np.cos(angle), np.sin(angle)]))
        except (ViewError, ShapeError):
            continue
        return Case(prism, loaded, physics, tuple(actions))


def _about(belief: Belief, case: Case, count: int) -> list[Row]:
    """Error of the centre of mass, spreads, and ranks of the true constants."""
    truth = {name: getattr(case.physics, name) for name in NAMES[:3]}
    truth |= dict(zip(NAMES[3:], case.object.com_offset.tolist(), strict=True))
    off = [belief.mean[name] - truth[name] for name in NAMES[3:]]
    rows: list[Row] = [{"metric": f"com {count}", "value": MM * float(np.linalg.norm(off))}]
    for name in NAMES:
        values = belief.values[:, belief.names.index(name)]
        rank = float(belief.weights[values < truth[name]].sum())
        rows.append({"metric": f"rank {name} {count}", "value": rank})
        rows.append({"metric": f"std {name} {count}", "value": belief.std[name] / belief.prior_std[name]})
    return rows


def _errors(case: Case, beliefs: Mapping[str, Belief], rng: np.random.Generator) -> list[Row]:
    """Mean errors of other lever-ups [cm]: with beliefs, or told nothing and told everything."""
    found: dict[str, list[float]] = {}
    told = {name: getattr(case.physics, name) for name in NAMES[:3]}
    for action in case.actions[LEARNED_FROM:]:
        view = TopDownView.of(case.prism, action)
        poses = case.play(action, rng)
        if beliefs:
            effects = {
                name: predictor().imagine(view, action, context=belief) for name, belief in beliefs.items()
            }
        else:
            own = case.object.mass_properties(case.physics.density).com
            T = action.T_action_object
            effects = {
                "nothing": predictor().imagine(view, action, context="unknown"),
                "told": predictor().imagine(view, action, context=told, com=T[:3, :3] @ own + T[:3, 3]),
            }
        for name, effect in effects.items():
            turns = quaternion_to_matrix(poses[:, 3:]) @ quaternion_to_matrix(poses[0, 3:]).T
            truth = poses[:, :3] + turns @ (effect.com_trajectory[0] - poses[0, :3])
            count = min(len(truth), len(effect.times))
            off = np.linalg.norm(effect.com_trajectory[:count] - truth[:count], axis=1).mean()
            found.setdefault(name, []).append(CM * float(off))
    return [{"metric": f"error {name}", "value": float(np.mean(each))} for name, each in found.items()]
