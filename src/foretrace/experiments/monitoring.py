"""The monitor on executions that nothing was fitted to: normal ones, and ones in which something goes wrong.

Executions are simulated anew; their seeds are not those of the monitor's calibration. Baselines are calibrated on
executions of a third seed.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from foretrace.actions import LeverUp
from foretrace.errors import ResultsError
from foretrace.evaluation.charts import GREEN, ORANGE, SKY, VERMILLION, finish, grid
from foretrace.evaluation.experiment import Experiment, Row, Trial
from foretrace.experiments import SUMMARIES
from foretrace.experiments.executions import (
    FAULTS,
    Execution,
    draw_polygon,
    draw_round,
    make_execution,
    reachable,
)
from foretrace.experiments.monitor_calibration import SEED, imagine, path_of
from foretrace.experiments.monitoring_tables import (
    CALIBRATION,
    CM,
    NORMAL,
    PROBES,
    RECORDED,
    about_faults,
    about_rests,
    auroc,
    columns,
    drift_after,
    is_wrong,
    pick,
    recalibrated,
    report_of,
    scores_of,
)
from foretrace.experiments.transfer_objects import read_silhouettes
from foretrace.experiments.window_density import successes, unlikeness
from foretrace.files import short_hash
from foretrace.imagined import ImaginedEffect, conformal_scores
from foretrace.monitoring import Monitor, MonitorCalibration, Verdict
from foretrace.monitoring.calibration import SHIPPED
from foretrace.objects import Prism
from foretrace.pictures.style import new_figure, styled
from foretrace.predictor.loading import default_checkpoint

MUJOCO = "mujoco"
"""The engine of all calibrations."""
CHUNK = 5
"""Executions of a trial."""
SEEDS = {CALIBRATION: SEED + 1, NORMAL: SEED + 2, RECORDED: SEED + 4}
"""Seeds of the executions; those with faults have that of the normal ones, but draws of their own."""
LATER = 6
"""Samples after an alarm after which its cause is asked for again."""
IN_MOTION = 10
"""Samples in motion after which the rest is imagined."""
DEVIATES = 0.002
"""Delays are counted from the first deviation by more than this [m]."""
METHODS = {
    "monitor": ORANGE,
    "futures alone": VERMILLION,
    "distance": SKY,
    "quantile of each sample": GREEN,
    "regions": "#cc79a7",
    "final height": "#8b93a1",
    "density of windows": "#5b3a8e",
}
"""What is compared, with its colour."""
OUTLINES, SILHOUETTES = "round and dented outlines", "silhouettes"
OTHERS = (OUTLINES, SILHOUETTES)
"""Other objects than those that the monitor was calibrated with; nothing goes wrong with them."""
FEWER = 4
"""Times that there are fewer executions with them."""
NONE = -1.0
"""There is no such number."""


@dataclass(frozen=True)
class MonitoringTrial(Trial):
    """Some executions of one kind."""

    part: str
    """``calibration``, ``normal``, one of OTHERS, or a fault."""
    chunk: int
    """Which of them."""


@dataclass(frozen=True)
class Monitoring(Experiment):
    """Watch normal executions and injected faults."""

    executions: int = 200
    """Normal executions, and as many to calibrate the baselines with."""
    faults: int = 25
    """Executions with each fault."""
    parts: tuple[str, ...] = ()
    """Which parts; by default all."""
    false_alarms: float = 0.05
    """Share of normal executions that may alarm."""
    successes: int = 200
    """Normal executions that the density of windows is learned from."""
    engine: Literal["mujoco", "bullet"] = "mujoco"
    """What simulates the executions; all calibration stays that on MuJoCo's."""
    recorded: int = 60
    """Normal executions of another engine that the monitor is then calibrated anew with."""
    silhouettes: Path | None = None
    """Folder of pictures of silhouettes, of which there are normal executions, too; without one, they are left out."""

    label = "monitoring"
    summary = SUMMARIES["monitoring"]
    trial = MonitoringTrial

    def trials(self) -> Sequence[MonitoringTrial]:
        """Normal executions first."""
        if min(self.executions, self.faults, self.successes, self.recorded) < 1:
            raise ResultsError(
                f"executions is {self.executions}, faults is {self.faults}, successes is {self.successes}, recorded is "
                f"{self.recorded}: give at least 1 of each"
            )
        if not 0.01 <= self.false_alarms <= 0.5:
            raise ResultsError(
                f"false_alarms is {self.false_alarms}: give a share of executions from 0.01 to 0.5"
            )
        known = (
            CALIBRATION,
            NORMAL,
            *((RECORDED,) if self.engine != MUJOCO else ()),
            *(part for part in OTHERS if part != SILHOUETTES or self.silhouettes),
            *FAULTS,
        )
        if unknown := [part for part in self.parts if part not in known]:
            raise ResultsError(f"part {unknown[0]!r} is unknown: choose from {', '.join(known)}")
        return [
            MonitoringTrial(part, chunk)
            for part in self.parts or known
            for chunk in range(-(-self._count(part) // CHUNK))
        ]

    def identity(self) -> dict[str, Any] | None:
        """The predictor, the monitor's calibration, and the seeds."""
        config = (default_checkpoint() / "config.json").read_bytes()
        made = {"predictor": short_hash([config]), "calibration": short_hash([SHIPPED.read_bytes()])}
        own = {"false_alarms": self.false_alarms, "successes": self.successes}
        pictures = {} if self.silhouettes is None else {"silhouettes": short_hash([*self._pictures()])}
        engine = {} if self.engine == MUJOCO else {"engine": self.engine}
        seeds = {part: seed for part, seed in SEEDS.items() if part != RECORDED or engine}
        return {**made, "seeds": seeds, **own, **engine, **pictures}

    def run(self, trial: MonitoringTrial, folder: Path) -> Sequence[Row]:
        """Scores, alarms, causes and errors of executions."""
        fault = trial.part if trial.part in FAULTS else ""
        numbers = range(CHUNK * trial.chunk, min(CHUNK * (trial.chunk + 1), self._count(trial.part)))
        seed = SEEDS.get(trial.part, SEEDS[NORMAL])
        known = successes(self.successes, SEED + 3)
        engine = MUJOCO if trial.part == CALIBRATION else self.engine
        draw = {OUTLINES: draw_round, SILHOUETTES: self._draw_silhouette}.get(trial.part, draw_polygon)
        return [
            watch(made, k, self.false_alarms) | {"windows": CM * unlikeness(made.tracked, known)}
            for k, made in ((k, make_execution(seed, k, fault, draw, engine)) for k in numbers)
        ]

    def _count(self, part: str) -> int:
        """Number of executions of a part."""
        if part in FAULTS:
            return self.faults
        if part == RECORDED:
            return self.recorded
        return -(-self.executions // FEWER) if part in OTHERS else self.executions

    def _pictures(self) -> list[bytes]:
        assert self.silhouettes is not None
        return [repr(prism.corners.tolist()).encode() for prism in self._silhouettes]

    @cached_property
    def _silhouettes(self) -> list[Prism]:
        assert self.silhouettes is not None
        return [subject.obj for subject in read_silhouettes(self.silhouettes)]

    def _draw_silhouette(self, rng: np.random.Generator) -> tuple[Prism, LeverUp]:
        return reachable(self._silhouettes[int(rng.integers(len(self._silhouettes)))], rng)

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """False alarms, AUROC, detections, delays, causes and rests."""
        table = columns(rows)
        normal, wrong = table["part"] == NORMAL, is_wrong(table)
        if not normal.any():
            return {}
        summary: dict[str, Any] = {"normal": int(normal.sum()), "faults": {}, "methods": {}}
        alarmed = table["score"] > table["threshold"]
        of = {fault: wrong & (table["part"] == fault) for fault in FAULTS}
        of = {fault: mine for fault, mine in of.items() if mine.any()}
        for method, (values, threshold) in scores_of(table).items():
            summary["methods"][method] = {
                "false_alarms": float(np.mean(values[normal] > threshold)),
                "detected": float(np.mean(values[wrong] > threshold)) if wrong.any() else None,
                "auroc": auroc(values[normal], values[wrong]) if wrong.any() else None,
                "auroc_of": {fault: auroc(values[normal], values[mine]) for fault, mine in of.items()},
            }
        summary["faults"] = {fault: about_faults(pick(table, mine)) for fault, mine in of.items()}
        summary["all_faults"] = about_faults(pick(table, wrong)) if wrong.any() else {}
        summary["others"] = {
            part: {"executions": int(mine.sum()), "false_alarms": float(np.mean(alarmed[mine]))}
            for part in OTHERS
            if (mine := table["part"] == part).any()
        }
        if again := recalibrated(table, self.false_alarms):
            summary["recalibrated"] = again
        summary["rest"] = about_rests(pick(table, normal))
        summary["drift"] = drift_after(table, MonitorCalibration.shipped("worlds"))
        summary["update_ms"] = float(np.median(table["update_ms"]))
        summary["transitions"] = float(table["transition"][normal].mean())
        return summary

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """Tables of methods, faults, causes and rests."""
        return report_of(summary, columns(rows)) if summary else "# Monitoring\n\nNo normal executions.\n"

    @styled
    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """AUROC of each fault, by method."""
        summary = self.summarise(rows)
        if not summary or not summary["faults"]:
            return {}
        fig = new_figure(8.0, 4.4)
        ax = fig.subplots()
        names = list(summary["faults"])
        for k, (method, color) in enumerate(METHODS.items()):
            areas = [summary["methods"][method]["auroc_of"].get(name, np.nan) for name in names]
            ax.plot(
                np.arange(len(names)) + 0.1 * (k - 3), areas, "o", color=color, label=method, markersize=5
            )
        ax.axhline(0.5, color="#8b93a1", linewidth=0.8)
        ax.set_xticks(range(len(names)), [name.replace(" ", "\n") for name in names])
        ax.set_ylim(0.35, 1.02)
        grid(ax, ylabel="AUROC")
        fig.legend(loc="outside lower center", ncols=3)
        finish(fig, "Faults told from normal executions", "faults that move the object by more than 3 mm")
        return {"auroc": fig}


def watch(execution: Execution, number: int, false_alarms: float) -> dict[str, Any]:
    """What a monitor and the baselines make of one execution."""
    imagined = imagine(execution, "worlds")
    plain = imagine(execution, "futures")
    begin = time.process_time()
    verdicts = _verdicts(Monitor(imagined, false_alarms), execution)
    spent = time.process_time() - begin
    alone = _verdicts(Monitor(plain, false_alarms), execution)
    truth = path_of(execution, imagined, execution.poses)
    first = next((k for k, each in enumerate(verdicts) if each.alarm), -1)
    deviates = np.flatnonzero(execution.deviation > DEVIATES)
    start = execution.times[deviates[0]] if len(deviates) else NONE
    later = min(first + LATER, len(verdicts) - 1)
    found: dict[str, Any] = {
        "execution": number,
        "moved": CM * float(execution.deviation[-1]),
        "score": verdicts[-1].score,
        "threshold": verdicts[-1].threshold,
        "alarm": float(execution.times[first]) if first >= 0 else NONE,
        "deviates": float(start),
        "cause": (verdicts[first].cause or "none") if first >= 0 else "none",
        "cause_later": (verdicts[later].cause or "none") if first >= 0 else "none",
        "transition": int(any(each.transition for each in verdicts) and first < 0),
        "alone": alone[-1].score,
        "alone_threshold": alone[-1].threshold,
        "update_ms": 1000 * spent / len(verdicts),
        **_rest(verdicts[first] if first >= 0 else None, imagined, truth, first, "alarm"),
    }
    moving = np.flatnonzero(np.linalg.norm(truth - truth[0], axis=1) > 0.001)
    ten = int(moving[0]) + IN_MOTION if len(moving) else len(verdicts)
    ten_verdict = verdicts[ten] if ten < len(verdicts) - 5 else None
    found |= _rest(ten_verdict, imagined, truth, ten, "ten")
    found["ten_slip"] = ten_verdict.outcomes.get("slipped", 0.0) if ten_verdict else NONE
    height = truth[:, 2] - truth[0, 2]
    dropped = bool(height.max() > 0.005 and height[-1] < 0.5 * height.max())
    found["ten_drops"] = int(dropped and ten_verdict is not None and int(height.argmax()) > ten)
    return found | _baselines(execution, plain)


def _verdicts(monitor: Monitor, execution: Execution) -> list[Verdict]:
    return [
        monitor.update(float(t), pose) for t, pose in zip(execution.times, execution.tracked, strict=True)
    ]


def _rest(
    verdict: Verdict | None, imagined: ImaginedEffect, truth: np.ndarray, k: int, name: str
) -> dict[str, float]:
    """Mean error of the rest [cm], as imagined anew and as imagined before, and whether the 90 % region holds it."""
    rest = verdict.rest if verdict is not None else None
    count = 0 if rest is None else min(len(truth) - k - 1, len(rest.times))
    if rest is None or count < 3:
        return {f"{name}_rest": NONE, f"{name}_before": NONE, f"{name}_held": NONE}
    path = truth[k + 1 : k + 1 + count]
    anew = np.linalg.norm(rest.com_trajectory[:count] - path, axis=1).mean()
    before = np.linalg.norm(imagined.com_trajectory[k + 1 : k + 1 + count] - path, axis=1).mean()
    cut = rest.futures
    short = type(cut)(
        cut.probability,
        cut.outcome,
        cut.states[:, :, :count],
        cut.spread[:, :, :count],
        cut.support_points,
        cut.quantiles,
    )
    score = conformal_scores(short, path[None], np.array([count]))[0]
    return {
        f"{name}_rest": CM * anew,
        f"{name}_before": CM * before,
        f"{name}_held": int(score <= cut.width(0.9)),
    }


def _baselines(execution: Execution, plain: ImaginedEffect) -> dict[str, float]:
    """Scores of what is simpler; poses that were lost count as the ones before."""
    shown = [pose for pose in execution.tracked if pose is not None]
    kept = np.maximum.accumulate([k if pose is not None else 0 for k, pose in enumerate(execution.tracked)])
    poses = np.array([execution.tracked[k] for k in kept])
    assert shown
    seen = path_of(execution, plain, poses) - poses[0, :3] + execution.poses[0, :3]
    count = min(len(seen), len(plain.times))
    off = np.linalg.norm(seen[:count] - plain.com_trajectory[:count], axis=1)
    rise, expected = seen[count - 1, 2], plain.com_trajectory[count - 1, 2]
    futures = plain.futures
    cut = type(futures)(
        futures.probability,
        futures.outcome,
        futures.states[:, :, :count],
        futures.spread[:, :, :count],
        futures.support_points,
        futures.quantiles,
    )
    score = float(conformal_scores(cut, seen[None, :count], np.array([count]))[0])
    return {
        "distance": CM * float(off.max()),
        "regions": score / float(futures.width(0.95).ravel()[0]),
        "final_height": CM * abs(float(rise - expected)),
        **{f"d{k}": CM * float(off[k]) for k in PROBES},
    }
