"""How long a prediction takes: one view, many contacts of one object, and the same lever-ups simulated instead.

Prediction and simulation take turns on one core, so that a machine whose speed drifts changes both. Times are those of
the processor, medians over objects. Of one view, all futures are told with positions and turns; of many contacts all
with positions, the most probable one with turns. Run it on an idle machine.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from foretrace.actions import LeverUp, sample_contacts
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Prism, sample_prism
from foretrace.predictor import OneShotPredictor, load_predictor
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up

CONTACTS = 512
SIMULATED = 4
"""Lever-ups of each object that are simulated for comparison."""


def seconds(work: Callable[[], object], repeats: int = 1) -> float:
    """Processor time of one call, in the mean over repeats."""
    start = time.process_time()
    for _ in range(repeats):
        work()
    return (time.process_time() - start) / repeats


def all_futures(predictor: OneShotPredictor, view: TopDownView) -> np.ndarray:
    """Whole motions of all futures, including the poses, which are computed on demand."""
    return predictor.imagine(view).futures.pose


def candidates_of(prism: Prism, first: LeverUp, rng: np.random.Generator) -> list[LeverUp]:
    """Lever-ups around a prism, in the action frame of its first one."""
    per_edge = -(-CONTACTS // len(prism.corners))
    actions = sample_contacts(prism, rng, per_edge=per_edge)[:CONTACTS]
    frames = [first.T_action_object @ np.linalg.inv(action.T_action_object) for action in actions]
    return [LeverUp(frame[:2, 3], frame[:2, 0]) for frame in frames]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a training of the one-shot predictor")
    parser.add_argument("--objects", type=int, default=12)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    predictor = load_predictor(arguments.run)
    if not isinstance(predictor, OneShotPredictor):
        raise SystemExit(f"{arguments.run} holds a {predictor.label} predictor: give a one-shot one")
    rows = []
    for k in range(arguments.objects + 1):
        rng = np.random.default_rng(k)
        prism = sample_prism(rng, 3 + k % 8)
        actions = sample_contacts(prism, rng, per_edge=2)
        view = TopDownView.of(prism, actions[0])
        candidates = candidates_of(prism, actions[0], rng)
        one = seconds(lambda: all_futures(predictor, view), 20)  # noqa: B023
        many = seconds(lambda: predictor.imagine_candidates(view, candidates), 2)  # noqa: B023
        simulated = [
            seconds(lambda: simulate_lever_up(prism, action, SimulationConfig(embodiment="tool")))  # noqa: B023
            for action in actions[:SIMULATED]
        ]
        if k:  # the first object warms up
            rows.append((one, many, float(np.mean(simulated))))
    one, many, simulated = 1e3 * np.median(rows, axis=0)
    print(
        f"one view to futures:      {one:8.2f} ms, simulated {simulated:.1f} ms: {simulated / one:.0f} times as fast"
    )
    each = many / CONTACTS
    print(
        f"{CONTACTS} contacts, one view:   {many:8.1f} ms, {each:.3f} ms each: {simulated / each:.0f} times as fast as "
        "simulating them, the blade alone"
    )


if __name__ == "__main__":
    main()
