"""A large data set: opening, filtering, random access, an epoch, memory; beside LeRobot's layout and mapped Arrow.

    python benchmarks/data.py --rows 1000000        # 10 GB, and half an hour to make

A few hundred lever-ups are simulated; the others are copies with numbers, seeds and paths of their own. Every time is
measured in a process of its own, whose peak memory is noted as well.
"""

import json
import os
import random
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tyro
from rich.console import Console

import foretrace as ft
from foretrace.files import write_json
from foretrace.interactions import storage
from foretrace.interactions.dataset import INDEX_COLUMNS
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.simulation.randomisation import RANDOMISED

ROOT = Path(__file__).parents[1]
BATCHES, BATCH = 20, 100
"""Rows of the epoch that is timed; the rest is extrapolated."""
ACCESSES = 50


@dataclass(frozen=True)
class Options:
    """What is measured."""

    rows: int = 200_000
    """Interactions."""
    layout_rows: int = 5_000
    """Interactions that the layouts are compared on."""
    folder: Path = ROOT / "build" / "data"
    """Folder of the data sets."""
    out: Path = ROOT / "docs" / "results" / "scale" / "data.json"
    """File of the results."""
    task: str = ""
    """One measurement, in this process."""


def make(options: Options) -> Path:
    """The data set, unless it is there."""
    folder = options.folder / f"rows-{options.rows}"
    if (folder / storage.MANIFEST).is_file():
        return folder
    base = options.folder / "base"
    config = CollectConfig(
        24, recipe="all", simulation=ft.SimulationConfig(embodiment="tool"), randomisation=RANDOMISED
    )
    collect(config, base, console=Console(quiet=True))
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
        entries[name] = storage.write_shard(folder, name, part)
    manifest = storage.read_manifest(base)
    fresh = storage.new_manifest(manifest["configuration"], options.rows, 100, manifest["versions"])
    storage.write_manifest(folder, fresh | {"shards": entries})
    return folder


def measure(task: str, folder: Path, options: Options) -> dict[str, Any]:
    """One measurement."""
    begun = time.perf_counter()
    rng = np.random.default_rng(0)

    def lap() -> float:
        nonlocal begun
        seconds, begun = time.perf_counter() - begun, time.perf_counter()
        return round(seconds, 4)

    if task == "open":
        found: dict[str, Any] = {"rows": len(ft.Dataset.open(folder)), "open_s": lap()}
    elif task == "filter":
        dataset = ft.Dataset.open(folder)
        lap()
        found = {"levered": len(dataset.where(outcome="levered")), "filter_outcome_s": lap()}
        found |= {
            "friction": len(dataset.where(friction=lambda value: value > 0.5)),
            "filter_friction_s": lap(),
        }
        found |= {
            "insertion": len(dataset.where(insertion=lambda value: value > 0.015)),
            "filter_insertion_s": lap(),
        }
    elif task == "access":
        dataset = ft.Dataset.open(folder)
        rows = rng.choice(len(dataset), ACCESSES)
        lap()
        for row in rows:
            dataset[int(row)]
        found = {"random_access_ms": round(1000 * lap() / ACCESSES, 2)}
    elif task == "epoch":
        dataset = ft.Dataset.open(folder)
        _ = dataset[: BATCHES * BATCH].times
        lap()
        read = sum(len(batch) for batch in dataset[: BATCHES * BATCH].batches(BATCH))
        found = {"read": read, "epoch_s_per_1000": round(1000 * lap() / (BATCHES * BATCH), 3)}
    else:
        return layouts(folder, options)
    return found | {"peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)}


def layouts(folder: Path, options: Options) -> dict[str, Any]:
    """Images and trajectories in three layouts: shards, an episode a row group (LeRobot v3), mapped Arrow."""
    shards = [folder / storage.shard_name(k) for k in range(options.layout_rows // 100)]
    names = ["com_trajectory", "pose_trajectory", "mask", "height"]
    episodes, mapped = options.folder / "episodes.parquet", options.folder / "mapped.arrow"
    schema = pa.schema([storage.SCHEMA.field(name) for name in names])
    with (
        pq.ParquetWriter(episodes, schema, compression="zstd") as rows,
        pa.ipc.new_file(str(mapped), schema) as arrow,
    ):
        for shard in shards:
            table = pq.read_table(shard, columns=names)
            arrow.write_table(table)
            for k in range(len(table)):
                rows.write_table(table.slice(k, 1), row_group_size=1)
    chosen = np.random.default_rng(0).choice(100 * len(shards), ACCESSES)
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
            "epoch_s_per_1000": round(1000 * (time.perf_counter() - end) / (100 * len(shards)), 4),
            "kb_per_row": round(size / (100 * len(shards)) / 1000, 2),
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
        sum(column_bytes(shard, names) for shard in shards),
        lambda: shards,
        lambda files, k: touch(pq.read_table(files[k // 100], columns=names).slice(k % 100, 1)),
        lambda files: [
            storage.unpack_heights(pq.read_table(f, columns=names)["height"].to_pylist()) for f in files
        ],
    )
    timed(
        "a row group an episode",
        episodes.stat().st_size,
        lambda: pq.ParquetFile(episodes),
        lambda file, k: touch(file.read_row_group(k)),
        lambda file: [
            storage.unpack_heights(file.read_row_groups(range(k, k + 100))["height"].to_pylist())
            for k in range(0, 100 * len(shards), 100)
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
    shards = [folder / storage.shard_name(k) for k in range(10)]
    each = {name: sum(column_bytes(s, [name]) for s in shards) / 1000 for name in storage.SCHEMA.names}
    large = {
        name: round(value) for name, value in sorted(each.items(), key=lambda pair: -pair[1]) if value > 50
    }
    whole = sum(s.stat().st_size for s in shards) / 1000
    return {"all": round(whole), **large, "others": round(whole - sum(large.values()))}


def main(options: Options) -> None:
    """Make the data set, and measure."""
    folder = make(options)
    if options.task:
        print(json.dumps(measure(options.task, folder, options)))
        return
    results: dict[str, Any] = {"rows": options.rows, "bytes_per_interaction": sizes(folder)}
    (folder / "index.arrow").unlink(missing_ok=True)
    for name, task in (
        ("first_opening", "open"),
        *((each, each) for each in ("open", "filter", "access", "epoch")),
    ):
        words = [
            sys.executable,
            __file__,
            "--task",
            task,
            "--rows",
            str(options.rows),
            "--folder",
            str(options.folder),
        ]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        results[name] = json.loads(done.stdout)
        print(name, results[name], flush=True)
    results["index_bytes_per_row"] = round((folder / "index.arrow").stat().st_size / options.rows)
    results["layouts"] = layouts(folder, options)
    results["index_columns"] = len(INDEX_COLUMNS)
    results["load_of_the_machine"] = round(os.getloadavg()[0], 1)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(options.out, results, indent=2)
    print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
