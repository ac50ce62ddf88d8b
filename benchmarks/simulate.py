"""Interactions per second: the pipeline against raw stepping of the same models, and one worker against two.

Raw stepping is ``mujoco.rollout`` with the same set points from the same states, nothing else. Pipeline and raw
stepping take turns, so that a machine whose speed drifts changes both. Run it on an idle machine.
"""

import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np
from mujoco import rollout
from rich.console import Console

from foretrace.geometry import matrix_to_pose
from foretrace.simulation.collect import CollectConfig, collect, num_trials, trial
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.mujoco_engine import STATE, plan_arm, plan_carriage
from foretrace.simulation.scene import build_scene

OBJECTS = 16


def time_raw(config: CollectConfig, ids: range) -> float:
    """Seconds that bare stepping takes for one object's trials, its model compiled before."""
    simulation = config.simulation
    obj, action, _ = trial(config, ids[0])
    num_samples = round(action.duration / simulation.sample_period)
    samples = action.tool_motion(np.arange(num_samples + 1) * simulation.sample_period)
    steps = num_samples * round(simulation.sample_period / simulation.timestep)
    plan = plan_arm if simulation.embodiment == "arm" else plan_carriage
    control = plan(action.tool_motion, samples, action.tool, steps, simulation.timestep)
    place = (simulation.embodiment, simulation.timestep, control.coordinates)
    model = build_scene(obj, simulation.physics, action.tool, *place).compile()
    data, seconds = mujoco.MjData(model), 0.0
    for id in ids:
        mujoco.mj_resetData(model, data)
        data.qpos[:7] = matrix_to_pose(trial(config, id)[1].T_action_object)
        data.qpos[7:] = control.start
        state = np.empty(mujoco.mj_stateSize(model, STATE))
        mujoco.mj_getState(model, data, state, STATE)
        start = time.perf_counter()
        rollout.rollout(model, data, initial_state=state[None], control=control.setpoints[None])
        seconds += time.perf_counter() - start
    return seconds


def time_pipeline(config: CollectConfig, ids: range) -> float:
    """Seconds that whole interactions take for one object's trials: compiled, viewed, stepped, judged."""
    start = time.perf_counter()
    for id in ids:
        obj, action, seed = trial(config, id)
        simulate_lever_up(obj, action, config.simulation, seed=seed, id=id)
    return time.perf_counter() - start


def compare_with_raw(embodiment: str) -> None:
    config = CollectConfig(objects=OBJECTS, simulation=SimulationConfig(embodiment=embodiment))
    ids, groups = 0, []
    for k in range(OBJECTS):
        count = config.contacts_per_edge * (3 + k % 8)
        groups.append(range(ids, ids + count))
        ids += count
    time_pipeline(config, groups[0])
    pairs = np.array([(time_pipeline(config, group), time_raw(config, group)) for group in groups])
    pipeline, raw = pairs.sum(axis=0)
    print(
        f"{embodiment:>5}: {ids / pipeline:5.1f} interactions/s on one core ({1e3 * pipeline / ids:.1f} ms each); "
        f"raw stepping {ids / raw:5.1f}/s; pipeline / raw = {pipeline / raw:.2f} "
        f"(median over objects {np.median(pairs[:, 0] / pairs[:, 1]):.2f})"
    )


def compare_workers(embodiment: str = "arm", objects: int = 48) -> None:
    config = CollectConfig(objects=objects, simulation=SimulationConfig(embodiment=embodiment))
    rates = {}
    for workers in (1, 2, 1, 2):
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            collect(config, Path(folder) / "data", workers, Console(quiet=True))
            rates.setdefault(workers, []).append(num_trials(config) / (time.perf_counter() - start))
    one, two = max(rates[1]), max(rates[2])
    print(
        f"collect, {embodiment}: {one:.1f}/s with one worker, {two:.1f}/s with two: {two / one:.2f} times as fast"
    )


if __name__ == "__main__":
    for name in ("arm", "tool"):
        compare_with_raw(name)
    compare_workers()
