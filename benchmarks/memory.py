"""Peak memory while a data set larger than memory is described, and while the direct predictor is trained on it.

The data set repeats a few hundred simulated lever-ups: its size counts, not its variety.

    python benchmarks/memory.py --interactions 100000
"""

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import tyro

from foretrace.interactions import shards, storage
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.simulation.lever_up import SimulationConfig

WATCH = """
import re, threading, time
peak = 0
def watch():
    global peak
    while True:
        status = open("/proc/self/status").read()
        peak = max(peak, int(re.search(r"RssAnon:\\s+(\\d+)", status)[1]))
        time.sleep(0.02)
threading.Thread(target=watch, daemon=True).start()
"""
DESCRIBE = """
from foretrace.interactions.description import describe_dataset
describe_dataset(Dataset.open({path!r}))
"""
TRAIN = """
from foretrace.predictor import OneShotConfig, TrainConfig, train_predictor
names = ("levered", "slipped", "tumbled", "rolled", "missed")
loop = TrainConfig(epochs=1, min_steps=1, split={split!r}, outcomes=names, threads=1)
train_predictor(Dataset.open({path!r}), OneShotConfig(outcomes=names), {run!r}, loop, progress=False)
"""


@dataclass(frozen=True)
class Options:
    """What is measured."""

    interactions: int = 100_000
    """Interactions in the data set; whole hundreds."""


def main(options: Options) -> None:
    """Print seconds and peak memory of each job, in a process of its own."""
    number = options.interactions // 100 * 100
    parts = round(0.78 * number), round(0.05 * number), round(0.16 * number)
    with tempfile.TemporaryDirectory() as folder:
        path, run = f"{folder}/data", f"{folder}/run"
        repeat(Path(folder) / "few", Path(path), number)
        for name, code in (("describe", DESCRIBE), ("train one-shot, 1 epoch", TRAIN)):
            code = "from foretrace.interactions.dataset import Dataset\n" + code.format(
                path=path, run=run, split=parts
            )
            begun = time.monotonic()
            peak = peak_of(code)
            print(
                f"{name}, {number} interactions: {peak:.0f} MB, {time.monotonic() - begun:.0f} s", flush=True
            )


def peak_of(code: str) -> float:
    """Peak memory of a Python process [MB]; pages of mapped files are not counted, which the system may take back."""
    done = subprocess.run(
        [sys.executable, "-c", WATCH + code + "\nprint(peak)"], capture_output=True, text=True, check=True
    )
    return int(done.stdout.splitlines()[-1]) / 1024


def repeat(few: Path, out: Path, number: int) -> None:
    """A data set of repeated lever-ups of objects of all kinds."""
    tool = SimulationConfig(embodiment="tool")
    collect(CollectConfig(objects=50, recipe="everyday", simulation=tool), few)
    manifest = storage.read_manifest(few)
    names = sorted(manifest["shards"])
    rows = pa.concat_tables(storage.read_shard(few, name)[0] for name in names).slice(0, 400)
    (out / storage.SHARD_FOLDER).mkdir(parents=True)
    manifest |= {"num_trials": number, "shards": {}}
    for k in range(number // 100):
        ids = pa.array(np.arange(100 * k, 100 * (k + 1)))
        table = rows.slice(k % 4 * 100, 100).set_column(0, storage.SCHEMA.field("id"), ids)
        name = storage.shard_name(k)
        manifest["shards"][name] = shards.write_shard(out, name, table)
    storage.write_manifest(out, manifest)


if __name__ == "__main__":
    main(tyro.cli(Options))
