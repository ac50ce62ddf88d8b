"""Calibrate the monitor that comes with foretrace: `python -m foretrace.experiments.monitor_calibration`.

Normal executions decide its thresholds, and executions with injected faults how causes are told apart. Their seed is
that of no other experiment.
"""

import argparse
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from foretrace.errors import ResultsError
from foretrace.experiments.executions import CAUSES, FAULTS, MOVED, Execution, make_execution
from foretrace.experiments.push_executions import KIND, push_executions
from foretrace.files import write_json
from foretrace.geometry import quaternion_to_matrix
from foretrace.imagined import LEVELS, Belief, ImaginedEffect, conformal_scores
from foretrace.monitoring import Monitor, MonitorCalibration
from foretrace.monitoring.calibration import FORMAT, SHIPPED, VERSION, shipped
from foretrace.monitoring.causes import CauseModel
from foretrace.predictor import EffectPredictor, load_predictor
from foretrace.workers import count_workers, run_jobs

SEED = 20_000
"""Seed of the executions."""
KINDS = ("worlds", "futures")
"""What is monitored: an effect imagined with a belief, or with no constant told."""
OPEN = MonitorCalibration(0, np.full(len(LEVELS), 1e9))
"""No alarm ever."""
LATER = (0, 3, 6, 1000)
"""Samples after an alarm at which causes are learned."""
CHUNK = 10
FALSE_ALARMS = 0.05


@cache
def predictor() -> EffectPredictor:
    """The predictor that comes with foretrace, once for each process."""
    return load_predictor()


def imagine(execution: Execution, kind: str) -> ImaginedEffect:
    """The effect of an execution, as a monitor is given it."""
    context = Belief() if kind == "worlds" else "unknown"
    return predictor().imagine(execution.view, execution.action, context=context)


def path_of(execution: Execution, imagined: ImaginedEffect, poses: np.ndarray) -> np.ndarray:
    """(time, 3) Path of the point that an effect takes to be the centre of mass, as poses have it [m]."""
    point = imagined.com_trajectory[0] - execution.poses[0, :3]
    turns = quaternion_to_matrix(poses[:, 3:]) @ quaternion_to_matrix(execution.poses[0, 3:]).T
    return poses[:, :3] + turns @ point


def normal_scores(numbers: Sequence[int]) -> list[dict[str, tuple[float, float]]]:
    """Scores of normal executions, and of the rests of their motions after a random time, by kind."""
    executions = [(number, make_execution(SEED, number)) for number in numbers]
    return [{kind: _normal_score(number, each, kind) for kind in KINDS} for number, each in executions]


def _normal_score(number: int, execution: Execution, kind: str) -> tuple[float, float]:
    imagined = imagine(execution, kind)
    monitor = Monitor(imagined, calibration=OPEN)
    stop = int(np.random.default_rng([SEED, number, 99]).integers(8, 45))
    rest, verdict = 0.0, None
    for k, (t, pose) in enumerate(zip(execution.times, execution.tracked, strict=True)):
        verdict = monitor.update(float(t), pose)
        if k == stop and verdict.rest is not None:
            truth = path_of(execution, imagined, execution.poses)[k + 1 :]
            count = min(len(truth), len(verdict.rest.times))
            cut = verdict.rest.futures
            states, spread = cut.states[:, :, :count], cut.spread[:, :, :count]
            short = type(cut)(cut.probability, cut.outcome, states, spread, cut.support_points, cut.quantiles)
            rest = float(conformal_scores(short, truth[None, :count], np.array([count]))[0])
    assert verdict is not None
    return verdict.score, rest


def fault_evidence(
    jobs: Sequence[tuple[str, int]], quantiles: tuple[float, ...]
) -> list[tuple[str, np.ndarray]]:
    """Evidence at alarms and after, with the causes."""
    found = []
    calibration = MonitorCalibration(len(quantiles), np.array(quantiles))
    for fault, number in jobs:
        execution = make_execution(SEED, number, fault)
        if execution.deviation[-1] < MOVED:
            continue
        monitor = Monitor(imagine(execution, "worlds"), FALSE_ALARMS, calibration=calibration)
        since = -1
        for k, (t, pose) in enumerate(zip(execution.times, execution.tracked, strict=True)):
            verdict = monitor.update(float(t), pose)
            since += verdict.score > verdict.threshold
            last = k == len(execution.times) - 1
            if since >= 0 and verdict.score > verdict.threshold and (since in LATER or last):
                found.append((CAUSES[fault], monitor.evidence()))
    return found


def calibrate(executions: int, faults: int, workers: int) -> tuple[dict[str, MonitorCalibration], CauseModel]:
    """Calibrations by kind, and the model of causes.

    Args:
        executions: Number of normal executions.
        faults: Number of executions with each fault.
        workers: Processes.
    """
    rows = [tuple(range(k, min(k + CHUNK, executions))) for k in range(0, executions, CHUNK)]
    found: dict[str, MonitorCalibration] = {}
    parts = run_jobs(normal_scores, rows, workers, error=ResultsError, ordered=True)
    normal = [each for part in parts for each in part]
    for kind in KINDS:
        scores, rests = zip(*(each[kind] for each in normal), strict=True)
        about = f"{kind}, seed {SEED}"
        found[kind] = MonitorCalibration.of(scores, rests, about)
    jobs = [(fault, number) for fault in FAULTS for number in range(faults)]
    chunks = [tuple(jobs[k : k + CHUNK]) for k in range(0, len(jobs), CHUNK)]
    quantiles = tuple(found["worlds"].quantiles.tolist())
    parts = run_jobs(
        partial(fault_evidence, quantiles=quantiles), chunks, workers, error=ResultsError, ordered=True
    )
    pairs = [pair for part in parts for pair in part]
    return found, CauseModel.fit(np.array([each for _, each in pairs]), [cause for cause, _ in pairs])


def main() -> None:
    """Write the calibration that comes with foretrace."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--executions", type=int, default=1000)
    parser.add_argument("--faults", type=int, default=60)
    parser.add_argument("--pushes", type=int, default=300)
    parser.add_argument("--pushes-only", action="store_true", help="keep what the file has of lever-ups")
    parser.add_argument("--out", type=Path, default=SHIPPED)
    options = parser.parse_args()
    workers = count_workers(None, ResultsError)
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION, **shipped()}
    if not options.pushes_only:
        found, causes = calibrate(options.executions, options.faults, workers)
        content |= {
            "kinds": {kind: each.entries() for kind, each in found.items()},
            "causes": causes.entries(),
        }
    rows = [tuple(range(k, min(k + CHUNK, options.pushes))) for k in range(0, options.pushes, CHUNK)]
    parts = run_jobs(push_scores, rows, workers, error=ResultsError, ordered=True)
    pushed = MonitorCalibration.of([score for part in parts for score in part], about=f"{KIND}, seed {SEED}")
    write_json(options.out, content | {"kinds": content["kinds"] | {KIND: pushed.entries()}})


def push_scores(numbers: tuple[int, ...]) -> list[float]:
    """Scores of monitors of normal pushes."""
    return [
        Monitor(free.imagined, calibration=OPEN).score_of(free.times, free.tracked)
        for free, _ in (push_executions(SEED, number) for number in numbers)
    ]


if __name__ == "__main__":
    from foretrace.experiments import monitor_calibration

    monitor_calibration.main()  # functions of the main module do not reach other processes
