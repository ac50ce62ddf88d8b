"""A large data set: opening, filtering, random access, an epoch, memory; beside LeRobot's layout and mapped Arrow.

    python benchmarks/data.py --rows 1000000        # 10 GB, and half an hour to make

A few hundred lever-ups are simulated; the others are copies with numbers, seeds and paths of their own, written as
simulated ones are. Every measurement is made in a process of its own, whose peak memory is noted as well: elapsed time,
and processor time, which says more where other processes wait for the same cores.
"""

import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
import warnings
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tyro
from rich.console import Console

import foretrace as ft
from foretrace.files import write_json
from foretrace.interactions import index, shards, storage
from foretrace.simulation.collect import CollectConfig, collect, num_trials, simulate_trial
from foretrace.simulation.randomisation import RANDOMISED

ROOT = Path(__file__).parents[1]
BATCHES, BATCH = 20, 100
"""Rows of the epoch that is timed; the rest is extrapolated."""
ACCESSES = 200
CONFIG = CollectConfig(
    24, recipe="all", simulation=ft.SimulationConfig(embodiment="tool"), randomisation=RANDOMISED
)
TASKS = {
    "first_opening": "open",
    **{name: name for name in ("open", "list", "filter", "access", "epoch", "grown", "repeat")},
}
"""What is measured, by its name in the results."""


@dataclass(frozen=True)
class Options:
    """What is measured."""

    rows: int = 200_000
    """Interactions."""
    campaign_rows: int = 1_000_000
    """Interactions of the simulation of which the command's own memory is measured."""
    aged_rows: int = 20_000
    """Interactions of which the first opening is timed without indices in the shards, too."""
    layout_rows: int = 5_000
    """Interactions that the layouts are compared on."""
    folder: Path = ROOT / "build" / "data"
    """Folder of the data sets."""
    out: Path = ROOT / "docs" / "results" / "scale" / "data.json"
    """File of the results."""
    task: str = ""
    """One measurement, in this process."""
    measured: Path = Path()
    """Folder of the data set that it is of."""


def make(options: Options) -> Path:
    """The data set, unless it is there."""
    folder = options.folder / f"rows-{options.rows}"
    if (folder / storage.MANIFEST).is_file():
        return folder
    base = options.folder / "base"
    collect(CONFIG, base, console=Console(quiet=True))
    table = ft.Dataset.open(base, failed=True).table.combine_chunks()
    (folder / storage.SHARD_FOLDER).mkdir(parents=True, exist_ok=True)
    rng, entries = random.Random(0), {}
    for number, start in enumerate(range(0, options.rows, 100)):
        part = table.take(pa.array([(start + k) % len(table) for k in range(min(100, options.rows - start))]))
        paths = [
            json.dumps(json.loads(p) | {"insertion": rng.uniform(0.01, 0.02)})
            for p in part["path"].to_pylist()
        ]
        columns = {
            "id": pa.array(range(start, start + len(part))),
            "object_id": pa.array([start // 1000 + k % 10 for k in range(len(part))]),
            "seed": pa.array([rng.getrandbits(32) for _ in range(len(part))]),
            "path": pa.array(paths),
        }
        for name, values in columns.items():
            part = part.set_column(part.column_names.index(name), name, values)
        name = storage.shard_name(number)
        entries[name] = shards.write_shard(folder, name, part)
    manifest = storage.read_manifest(base)
    fresh = storage.new_manifest(manifest["configuration"], options.rows, 100, manifest["versions"])
    storage.write_manifest(folder, fresh | {"shards": entries})
    return folder


def beginning(folder: Path, rows: int, aged: bool) -> Path:
    """The first rows of the data set as one of their own; aged: without indices in its shards."""
    part = folder.parent / f"{'aged' if aged else 'part'}-{rows}"
    (part / storage.SHARD_FOLDER).mkdir(parents=True, exist_ok=True)
    manifest = storage.read_manifest(folder)
    entries = {}
    for name in map(storage.shard_name, range(rows // 100)):
        table, content = storage.read_shard(folder, name)
        if aged:
            pq.write_table(table, part / name, compression="zstd", use_dictionary=False)
            content = (part / name).read_bytes()
        (part / name).write_bytes(content)
        entries[name] = storage.shard_entry(content, table)
    storage.write_manifest(part, manifest | {"num_trials": rows, "shards": entries})
    return part


@cache
def one(config: CollectConfig) -> ft.Interaction:
    """The first lever-up of a configuration."""
    return simulate_trial(config, 0)


def repeated(config: CollectConfig, id: int) -> ft.Interaction:
    """The first lever-up under another number: what simulating takes is not measured."""
    return replace(one(config), id=id)


def campaign(options: Options) -> dict[str, Any]:
    """A simulation of many lever-ups, by two processes: what the command itself takes."""
    from data import repeated as by_name  # so that the processes keep what they simulated

    config = CollectConfig(options.campaign_rows // 13, simulation=CONFIG.simulation)
    shutil.rmtree(options.measured, ignore_errors=True)
    laps = Laps()
    collect(config, options.measured, 2, Console(quiet=True), by_name)
    laps("campaign")
    return laps.found | {"rows": num_trials(config), "peak_mb": peak_mb()}


class Laps:
    """Seconds since the last call, elapsed and of the processor."""

    def __init__(self):
        self.found: dict[str, Any] = {}
        self._begun = time.perf_counter(), time.process_time()

    def __call__(self, name: str = "", times: float = 1.0) -> None:
        """Note the seconds, times a factor, under a name."""
        spent = (time.perf_counter() - self._begun[0], time.process_time() - self._begun[1])
        if name:
            self.found |= {
                f"{name}{kind}_s": round(times * s, 4) for kind, s in zip(("", "_cpu"), spent, strict=True)
            }
        self._begun = time.perf_counter(), time.process_time()


def measure(task: str, folder: Path) -> dict[str, Any]:
    """One measurement."""
    laps = Laps()
    if task == "repeat":  # of a command that has nothing left to do
        laps.found["outcomes"] = collect(CONFIG, folder, console=Console(quiet=True))
        laps("repeat")
    elif task == "grown":
        manifest = storage.read_manifest(folder)
        fewer = dict(list(manifest["shards"].items())[: -max(1, len(manifest["shards"]) // 100)])
        storage.write_manifest(folder, manifest | {"shards": fewer})
        with warnings.catch_warnings(action="ignore"):  # it is not finished
            laps.found["before"] = len(ft.Dataset.open(folder))
        storage.write_manifest(folder, manifest)
        laps()
        laps.found["rows"] = len(ft.Dataset.open(folder))
        laps("open")
    else:
        read(task, folder, laps)
    return laps.found | {"peak_mb": peak_mb()}


def peak_mb() -> int:
    """Peak memory of this process, mapped files included; what the system notes of a child begins with its parent's."""
    return int(re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())[0]) // 1024


def read(task: str, folder: Path, laps: Laps) -> None:
    """One measurement of a data set that is opened first."""
    dataset = ft.Dataset.open(folder)
    if task == "open":
        laps.found["rows"] = len(dataset)
        laps("open")
    laps()
    if task == "list":
        laps.found["shown"] = repr(dataset).partition(": ")[2].rstrip(")")
        laps.found["objects"] = len(np.unique(dataset.index["object_id"]))
        laps("list")
    elif task == "filter":
        laps.found["levered"] = len(dataset.where(outcome="levered"))
        laps("filter_outcome")
        for name, least in (("friction", 0.5), ("insertion", 0.015)):
            laps.found[name] = len(dataset.where(**{name: lambda value, least=least: value > least}))
            laps(f"filter_{name}")
    elif task == "access":
        for row in np.random.default_rng(0).choice(len(dataset), ACCESSES):
            dataset[int(row)]
        laps("random_access", 1 / ACCESSES)
    elif task == "epoch":
        _ = dataset[: BATCHES * BATCH].times
        laps()
        laps.found["read"] = sum(len(batch) for batch in dataset[: BATCHES * BATCH].batches(BATCH))
        laps("epoch_of_1000", 1000 / (BATCHES * BATCH))


def apart(task: str, folder: Path, *more: str) -> dict[str, Any]:
    """One measurement, in a process of its own."""
    words = [sys.executable, __file__, "--task", task, "--measured", str(folder), *more]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    print(task, done.stdout.strip(), flush=True)
    return json.loads(done.stdout)


def layouts(folder: Path, options: Options) -> dict[str, Any]:
    """Images and trajectories in three layouts: shards, an episode a row group (LeRobot v3), mapped Arrow."""
    files = [folder / storage.shard_name(k) for k in range(options.layout_rows // 100)]
    names = ["com_trajectory", "pose_trajectory", "mask", "height"]
    episodes, mapped = options.folder / "episodes.parquet", options.folder / "mapped.arrow"
    schema = pa.schema([storage.SCHEMA.field(name) for name in names])
    with (
        pq.ParquetWriter(episodes, schema, compression="zstd") as rows,
        pa.ipc.new_file(str(mapped), schema) as arrow,
    ):
        for file in files:
            table = pq.read_table(file, columns=names)
            arrow.write_table(table)
            for k in range(len(table)):
                rows.write_table(table.slice(k, 1), row_group_size=1)
    chosen = np.random.default_rng(0).choice(100 * len(files), ACCESSES)
    found: dict[str, Any] = {}

    def timed(name: str, size: int, begin, row, everything) -> None:
        start = time.perf_counter()
        opened = begin()
        middle = time.perf_counter()
        for k in chosen:
            row(opened, int(k))
        end = time.perf_counter()
        everything(opened)
        found[name] = {
            "open_ms": round(1000 * (middle - start), 2),
            "random_access_ms": round(1000 * (end - middle) / ACCESSES, 3),
            "epoch_s_per_1000": round(1000 * (time.perf_counter() - end) / (100 * len(files)), 4),
            "kb_per_row": round(size / (100 * len(files)) / 1000, 2),
        }

    def touch(table: pa.Table) -> None:
        for name in names:
            table[name].to_pylist() if len(table) == 1 else storage.unpack_heights(
                table["height"].to_pylist()
            )
            break

    def every_batch(opened: pa.RecordBatchFileReader) -> None:
        for k in range(opened.num_record_batches):
            storage.unpack_heights(opened.get_batch(k).column("height").to_pylist())

    timed(
        "shards of 100 rows",
        sum(column_bytes(file, names) for file in files),
        lambda: files,
        lambda opened, k: touch(pq.read_table(opened[k // 100], columns=names).slice(k % 100, 1)),
        lambda opened: [
            storage.unpack_heights(pq.read_table(f, columns=names)["height"].to_pylist()) for f in opened
        ],
    )
    timed(
        "a row group an episode",
        episodes.stat().st_size,
        lambda: pq.ParquetFile(episodes),
        lambda file, k: touch(file.read_row_group(k)),
        lambda file: [
            storage.unpack_heights(file.read_row_groups(range(k, k + 100))["height"].to_pylist())
            for k in range(0, 100 * len(files), 100)
        ],
    )
    timed(
        "mapped Arrow",
        mapped.stat().st_size,
        lambda: pa.ipc.open_file(pa.memory_map(str(mapped))),
        lambda file, k: touch(pa.Table.from_batches([file.get_batch(k // 100).slice(k % 100, 1)])),
        every_batch,
    )
    return found


def column_bytes(shard: Path, names: list[str]) -> int:
    """Bytes of some columns of a shard."""
    about = pq.ParquetFile(shard).metadata
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    columns = [group.column(k) for group in groups for k in range(group.num_columns)]
    return sum(c.total_compressed_size for c in columns if c.path_in_schema.split(".")[0] in names)


def sizes(folder: Path) -> dict[str, float]:
    """Bytes of each column per interaction, on disk."""
    files = [folder / storage.shard_name(k) for k in range(10)]
    each = {name: sum(column_bytes(file, [name]) for file in files) / 1000 for name in storage.SCHEMA.names}
    large = {
        name: round(value) for name, value in sorted(each.items(), key=lambda pair: -pair[1]) if value > 50
    }
    whole = sum(file.stat().st_size for file in files) / 1000
    footers = (pq.read_metadata(file).metadata[shards.FOOTER] for file in files)
    large["index"] = round(sum(map(len, footers)) / 1000)
    return {"all": round(whole), **large, "others": round(whole - sum(large.values()))}


def main(options: Options) -> None:
    """Make the data set, and measure."""
    if options.task:
        found = campaign(options) if options.task == "campaign" else measure(options.task, options.measured)
        print(json.dumps(found))
        return
    folder = make(options)
    results: dict[str, Any] = {"rows": options.rows, "bytes_per_interaction": sizes(folder)}
    for aged in (True, False):
        part = beginning(folder, options.aged_rows, aged)
        (part / index.INDEX).unlink(missing_ok=True)
        results[f"first_opening_{'without' if aged else 'with'}_footers"] = apart("open", part)
        shutil.rmtree(part)
    (folder / index.INDEX).unlink(missing_ok=True)
    results |= {name: apart(task, folder) for name, task in TASKS.items()}
    drafts = options.folder / "campaign"
    results["campaign"] = apart("campaign", drafts, "--campaign-rows", str(options.campaign_rows))
    shutil.rmtree(drafts)
    results["index_bytes_per_row"] = round((folder / index.INDEX).stat().st_size / options.rows)
    results["layouts"] = layouts(folder, options)
    results["load_of_the_machine"] = round(os.getloadavg()[0], 1)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(options.out, results, indent=2)
    print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
