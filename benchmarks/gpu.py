"""MuJoCo Warp against MuJoCo: the same lever-ups in both, and how many of them an hour brings onto the disk.

Agreement is of lever-ups played in both engines. The rate is of a whole data set: views, play, judgement and files. On
a GPU the kernels are compiled before the clock starts; on a processor the rate says nothing.

Usage: python benchmarks/gpu.py [--lever-ups 2000] [--recipe paper] [--objects 2000] [--out gpu.json]
"""

import argparse
import json
import os
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import warp

from foretrace.simulation.collect import CollectConfig, collect, num_trials, trial
from foretrace.simulation.lever_up import SimulationConfig, Trial, simulate_trials

ENGINES = ("mujoco", "warp")


def compare(lever_ups: int, recipe: str) -> dict[str, object]:
    """Outcomes and motions of the same lever-ups in both engines."""
    made = {}
    for engine in ENGINES:
        config = CollectConfig(recipe=recipe, simulation=SimulationConfig(engine, "tool"))
        ids = np.linspace(0, num_trials(config) - 1, lever_ups).astype(int).tolist()
        trials = [
            Trial(obj, action, config.simulation, seed)
            for obj, action, seed in (trial(config, id) for id in ids)
        ]
        flat = [one for one in trials if not one.obj.is_round]
        start = time.perf_counter()
        made[engine] = simulate_trials(flat)
        print(f"{engine}: {len(flat)} lever-ups in {time.perf_counter() - start:.1f} s")
    pairs = list(zip(*(made[engine] for engine in ENGINES), strict=True))
    off = np.array(
        [
            1e3 * np.linalg.norm(a.effect.com_trajectory[:num] - b.effect.com_trajectory[:num], axis=1).mean()
            for a, b in pairs
            if (num := min(len(a.effect.times), len(b.effect.times)))
        ]
    )
    low, median, high = np.quantile(off, [0.05, 0.5, 0.95]).round(4).tolist()
    same = [a.effect.outcome == b.effect.outcome for a, b in pairs]
    return {
        "lever_ups": len(pairs),
        "recipe": recipe,
        "outcomes_equal": round(float(np.mean(same)), 4),
        "path_difference_mm": {"median": median, "p5": low, "p95": high, "mean": round(float(off.mean()), 4)},
    }


def rate(objects: int, recipe: str) -> dict[str, object]:
    """Lever-ups an hour, from nothing to a data set on the disk."""
    config = CollectConfig(objects=objects, recipe=recipe, simulation=SimulationConfig("warp", "tool"))
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        collect(config, Path(folder) / "data", workers=1)
        seconds = time.perf_counter() - start
        size = sum(file.stat().st_size for file in Path(folder).rglob("*.parquet"))
    num = num_trials(config)
    return {
        "lever_ups": num,
        "seconds": round(seconds, 1),
        "lever_ups_per_hour": round(3600 * num / seconds),
        "steps_per_second": round(num * trial(config, 0)[1].duration / config.simulation.timestep / seconds),
        "bytes_per_lever_up": round(size / num),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--lever-ups", type=int, default=2000, help="lever-ups of the comparison")
    parser.add_argument("--recipe", default="paper", help="kind of objects")
    parser.add_argument("--objects", type=int, default=2000, help="objects of the data set; 0 for no rate")
    parser.add_argument("--out", type=Path, help="file for the numbers")
    arguments = parser.parse_args()
    device = warp.get_device()
    found: dict[str, object] = {
        "device": device.name,
        "gpu": device.is_cuda,
        "versions": {name: version(name) for name in ("mujoco", "mujoco-warp", "warp-lang")},
        "processors": os.cpu_count(),
        "agreement": compare(arguments.lever_ups, arguments.recipe),
    }
    if arguments.objects:
        found["rate"] = rate(arguments.objects, arguments.recipe)
    text = json.dumps(found, indent=2)
    print(text)
    if arguments.out:
        arguments.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
