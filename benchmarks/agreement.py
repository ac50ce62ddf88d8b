"""How far simulated lever-ups depend on choices that should not matter: the time step, and arm or tool alone.

Every so many of the paper's 2080 trials; mean distance of the centre-of-mass trajectories over interactions that are
levered in both.
"""

import argparse
import json
from dataclasses import replace
from functools import partial

import numpy as np
from joblib import Parallel, delayed

from foretrace.interactions.record import Effect, Outcome
from foretrace.simulation.collect import CollectConfig, num_trials, simulate_trial
from foretrace.simulation.lever_up import SimulationConfig


def effects(simulation: SimulationConfig, every: int) -> list[Effect]:
    config = CollectConfig(simulation=simulation)
    ids = range(0, num_trials(config), every)
    simulate = delayed(partial(simulate_trial, config))
    return [
        interaction.effect for interaction in Parallel(n_jobs=-1, batch_size=10)(simulate(id) for id in ids)
    ]


def compare(first: list[Effect], second: list[Effect]) -> dict[str, float]:
    pairs = list(zip(first, second, strict=True))
    both = [(a, b) for a, b in pairs if a.outcome == b.outcome == Outcome.LEVERED]
    apart = [1e3 * np.linalg.norm(a.com_trajectory - b.com_trajectory, axis=1).mean() for a, b in both]
    return {
        "trials": len(pairs),
        "same_outcome": float(np.mean([a.outcome is b.outcome for a, b in pairs])),
        "median_mm": float(np.median(apart)),
        "p95_mm": float(np.percentile(apart, 95)),
        "largest_mm": float(max(apart)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=10, help="take one of so many trials")
    every = parser.parse_args().every
    arm, tool = SimulationConfig(), SimulationConfig(embodiment="tool")
    by_arm, by_tool = effects(arm, every), effects(tool, every)
    result = {
        "arm_and_tool": compare(by_arm, by_tool),
        "arm_and_half_the_time_step": compare(
            by_arm, effects(replace(arm, timestep=arm.timestep / 2), every)
        ),
        "tool_and_half_the_time_step": compare(
            by_tool, effects(replace(tool, timestep=tool.timestep / 2), every)
        ),
    }
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
