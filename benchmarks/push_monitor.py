"""False alarms of monitors on pushes that go as they should, and how soon a blocked object is noticed.

Pushes of the recipe ``pushes`` in MuJoCo, with the rod's friction drawn from the belief's range, tracked with noise and
dropouts. Half of them calibrate a monitor of their own.

Usage: python benchmarks/push_monitor.py [--pushes 200] [--out FILE.json]
"""

import argparse
import json
from pathlib import Path

import numpy as np

import foretrace as ft
from foretrace.errors import SimulationError
from foretrace.experiments.executions import track
from foretrace.monitoring import MonitorCalibration
from foretrace.simulation.collect import CollectConfig, num_trials, simulate_trial
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.randomisation import Randomisation

FRICTION = (0.1, 0.5)
FALSE_ALARMS, SEED = 0.05, 11


def main() -> None:
    """Print the rates, and write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pushes", type=int, default=200)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    simulation = SimulationConfig(embodiment="tool", timestep=0.004, sample_period=0.04)
    config = CollectConfig(
        options.pushes, 1, SEED, simulation, "pushes", Randomisation(tool_friction=FRICTION)
    )
    rng = np.random.default_rng(SEED)
    numbers = rng.permutation(num_trials(config))[: options.pushes]
    rows = [found for number in numbers if (found := _watch(config, int(number), rng)) is not None]
    scores, threshold = np.array([row["score"] for row in rows]), rows[0]["threshold"]
    half = len(rows) // 2
    own = MonitorCalibration.of(scores[:half]).threshold(FALSE_ALARMS)
    delays = np.array([row["delay"] for row in rows])
    summary = {
        "pushes": len(rows),
        "false_alarms_shipped_calibration": float(np.mean(scores > threshold)),
        "false_alarms_own_calibration": float(np.mean(scores[half:] > own)),
        "thresholds": [float(threshold), float(own)],
        "blocked_noticed": float(np.isfinite(delays).mean()),
        "delay_s": np.nanpercentile(delays, [50, 95]).round(3).tolist(),
    }
    print(json.dumps(summary, indent=2))
    if options.out:
        options.out.write_text(json.dumps(summary, indent=2) + "\n")


def _watch(config: CollectConfig, number: int, rng: np.random.Generator) -> dict[str, float] | None:
    """Score of one push, and delay after which its object is seen to be blocked [s]; NaN: never."""
    try:
        made = simulate_trial(config, number)
    except SimulationError:
        return None
    times, poses = made.effect.times, made.effect.pose_trajectory
    belief = ft.Belief({"tool_friction": FRICTION}, worlds=64)
    imagined = ft.SlidingTwin(duration=float(times[-1])).imagine(made.view, made.action, context=belief)
    monitor, score = ft.Monitor(imagined, FALSE_ALARMS), 0.0
    for t, pose in zip(times, track(poses, times, "", rng), strict=True):
        score = monitor.update(float(t), pose).score
    half = len(times) // 2
    blocked = poses.copy()
    blocked[half:] = poses[half]
    watcher, delay = ft.Monitor(imagined, FALSE_ALARMS), np.nan
    for t, pose in zip(times, track(blocked, times, "", rng), strict=True):
        if watcher.update(float(t), pose).alarm:
            delay = float(t - times[half])
            break
    return {"score": score, "threshold": monitor.threshold, "delay": delay}


if __name__ == "__main__":
    main()
