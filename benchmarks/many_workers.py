"""A million lever-ups on up to 10,000 workers, on paper: who waits for whom, and what breaks first.

    python benchmarks/many_workers.py

Workers take shards one after the other. A shard takes as long as its lever-ups, which vary, on workers that vary and
some of which are slow or die. The command hands out one shard after the other and keeps the manifest, for whose
writing it takes a twentieth of its time at most; that time is measured here.
"""

import heapq
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from foretrace.files import write_json
from foretrace.interactions import storage

ROOT = Path(__file__).parents[1]
AHEAD = 2
"""Shards that each worker has been handed, the one that it simulates included."""


@dataclass(frozen=True)
class Options:
    """What is assumed."""

    rows: int = 1_000_000
    """Lever-ups."""
    shard: int = 100
    """Lever-ups in a shard."""
    rate: float = 45.0
    """Lever-ups that a worker simulates in a second (benchmarks/simulate.py: 35 with the arm, 49 without)."""
    spread: float = 0.15
    """Spread of the time of a shard, and of the speed of workers: standard deviation of the logarithm."""
    slow_share: float = 0.01
    """Share of workers that are three times slower."""
    deaths_per_hour: float = 0.1
    """Deaths of each worker."""
    hand_out: float = 1 / 240
    """Time that the command needs for a shard [s] (benchmarks/cluster.py --part speed)."""
    workers: tuple[int, ...] = (8, 100, 1_000, 10_000)
    """Numbers of workers."""
    seed: int = 0
    """Seed of times and deaths."""
    out: Path = ROOT / "docs" / "results" / "scale" / "many-workers.json"
    """File of the results."""


def manifest_seconds(shards: int) -> tuple[float, int]:
    """Time to write a manifest of a number of shards [s], and its size [bytes]."""
    entry = {"sha256": 64 * "0", "rows": 100}
    manifest = storage.new_manifest({}, shards * 100, 100, {})
    manifest["shards"] = {storage.shard_name(k): entry for k in range(shards)}
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        storage.write_manifest(Path(folder), manifest)
        return time.perf_counter() - begun, (Path(folder) / storage.MANIFEST).stat().st_size


def play(options: Options, workers: int, write: float) -> dict[str, float]:
    """One run."""
    rng = np.random.default_rng(options.seed)
    shards = -(-options.rows // options.shard)
    speed = np.exp(rng.normal(0, options.spread, workers))
    speed[rng.random(workers) < options.slow_share] /= 3
    seconds = options.shard / options.rate * np.exp(rng.normal(0, options.spread, 4 * shards))
    waiting, drawn, deaths, clerk, busy, wrote = shards, 0, 0, 0.0, 0.0, 0.0
    handed: list[list[float]] = [[] for _ in range(workers)]
    ends: list[float] = []
    running: list[tuple[float, int, bool]] = []

    def hand_out(worker: int, at: float) -> None:
        nonlocal waiting, clerk
        clerk = max(clerk, at) + options.hand_out
        handed[worker].append(clerk)
        waiting -= 1

    def begin(worker: int, at: float) -> None:
        nonlocal drawn, busy
        took = seconds[drawn % len(seconds)] / speed[worker]
        drawn += 1
        busy += took
        dies = bool(rng.random() < options.deaths_per_hour * took / 3600)
        heapq.heappush(running, (max(at, handed[worker].pop(0)) + took, worker, dies))

    for _ in range(AHEAD):
        for worker in range(min(workers, waiting)):
            hand_out(worker, 0.0)
    for worker in range(workers):
        if handed[worker]:
            begin(worker, 0.0)
    while running:
        end, worker, dies = heapq.heappop(running)
        if dies:
            deaths += 1
            waiting += 1
        else:
            if end - wrote > max(1.0, 20 * write):
                clerk, wrote = max(clerk, end) + write * len(ends) / shards, end
            ends.append(end)
        if waiting:
            hand_out(worker, end)
        if handed[worker]:
            begin(worker, end + 30.0 * dies)  # after a death another process starts
    end = max(ends)
    return {
        "workers": workers,
        "minutes": round(end / 60, 2),
        "efficiency": round(busy / (end * workers), 3),
        "seconds_until_the_last_tenth": round(float(np.quantile(ends, 0.9)), 1),
        "seconds_of_the_last_tenth": round(end - float(np.quantile(ends, 0.9)), 1),
        "shards_written_per_second": round(shards / end, 1),
        "megabytes_written_per_second": round(options.rows * 9.9e-3 / end, 1),
        "shards_done_again": deaths,
    }


def main(options: Options) -> None:
    """All runs."""
    shards = -(-options.rows // options.shard)
    write, size = manifest_seconds(shards)
    runs = [play(options, workers, write) for workers in options.workers]
    results = {
        "assumed": {"rate": options.rate, "hand_out": options.hand_out, "seed": options.seed},
        "files": shards,
        "manifest_megabytes": round(size / 1e6, 2),
        "manifest_seconds": round(write, 3),
        "runs": runs,
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(options.out, results, indent=2)
    print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
