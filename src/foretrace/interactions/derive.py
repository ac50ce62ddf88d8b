"""Data sets made of others: merged, split, sampled. One shard at a time is in memory, whatever their size.

The new data set appears under its name when it is complete. Its interactions are numbered anew. Objects keep their
numbers where a data set is split or sampled; merged, an object of one recipe and seed has one number, whichever data
set it comes from.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from foretrace.errors import DatasetError, counted, is_number, is_whole, shown
from foretrace.files import as_path, atomic_folder, make_folder
from foretrace.interactions import storage
from foretrace.interactions.recorded import CONFIGURATION
from foretrace.interactions.shards import write_shard
from foretrace.interactions.soundness import check_shard
from foretrace.urls import Url, as_place

RESULTS = ("outcome", "slip_index", "fall_index", *storage.TRAJECTORIES, "joint_trajectory", "num_joints")
RESULTS += ("support_points", "support_corners", "path_error", "mask", "height", "metres_per_pixel")
TRIAL = [name for name in storage.SCHEMA.names if name not in ("id", "object_id", "versions", *RESULTS)]
"""Columns that make an interaction what it is: object, action, physics, seed, how it was simulated."""
SOURCES = "sources"
"""Entry of the configuration that says what a data set was made of."""
MADE = "made"
"""Entry that says how; `storage.Configuration` has it, too."""
MERGED, SPLIT, SAMPLED = "merged", "split", "sampled"
PARTS = ("train", "validation", "test")


@dataclass(frozen=True)
class _Source:
    """A data set that is read."""

    path: Path | Url
    manifest: dict[str, Any]

    @classmethod
    def open(cls, path: str | Path | Url) -> "_Source":
        path = as_place(path, DatasetError)
        manifest = storage.read_manifest(path)
        if manifest["configuration"] == CONFIGURATION:
            raise DatasetError(
                f"{path} holds recordings, which stay with their notes: merge them by importing into one folder"
            )
        remedy = storage.how_to_restore(path)
        if not manifest["shards"]:
            raise DatasetError(f"{path} is empty: {remedy}")
        if missing := len(storage.missing_shards(manifest)):
            total = counted(missing + len(manifest["shards"]), "shard")
            raise DatasetError(f"{path} lacks {missing} of {total}: {remedy}")
        return cls(path, manifest)

    def shards(self, columns: list[str] | None = None) -> Iterator[pa.Table]:
        """The rows of each shard, verified."""
        start = 0
        for name, entry in sorted(self.manifest["shards"].items(), key=lambda item: (len(item[0]), item[0])):
            table, _ = storage.read_shard(self.path, name, entry.get("sha256"), columns=columns)
            check_shard(table, str(self.path / name), entry.get("rows"))
            stop = min(start + self.manifest["shard_size"], self.manifest["num_trials"])
            if "id" in table.column_names and sorted(table["id"].to_pylist()) != list(range(start, stop)):
                raise DatasetError(
                    f"shard {self.path / name} does not have each id from {start} to {stop - 1} once: "
                    f"`foretrace data {self.path}` lists all faults"
                )
            start = stop
            yield table

    def column(self, name: str) -> np.ndarray:
        """A column of whole numbers."""
        parts = [table[name].to_numpy() for table in self.shards([name])]
        return np.concatenate([np.zeros(0, dtype=np.int64), *parts])

    @property
    def numbering(self) -> str:
        """What decides which object has which number."""
        configuration = self.manifest["configuration"]
        while configuration.get(MADE, {}).get("how") in (SPLIT, SAMPLED):  # which keep the numbers
            configuration = configuration[SOURCES][0]["configuration"]
        chosen = (
            configuration if MADE in configuration else [configuration.get(n) for n in ("recipe", "seed")]
        )
        return json.dumps(chosen, sort_keys=True)


@dataclass
class _Writer:
    """A data set that is written: rows in, whole shards out."""

    folder: Path
    size: int
    objects: dict[tuple[str, int], int] = field(default_factory=dict)
    entries: dict[str, dict[str, Any]] = field(default_factory=dict)
    waiting: list[pa.Table] = field(default_factory=list)
    rows: int = 0

    def add(self, table: pa.Table, numbering: str | None = None) -> None:
        """Append rows of a source; with a numbering, its objects get numbers of their own."""
        if table.num_rows == 0:
            return
        columns: dict[str, Any] = {"id": np.arange(self.rows, self.rows + table.num_rows)}
        if numbering is not None:
            columns["object_id"] = [
                self.objects.setdefault((numbering, number), len(self.objects))
                for number in table["object_id"].to_pylist()
            ]
        for name, values in columns.items():
            table = table.set_column(table.column_names.index(name), name, pa.array(values, pa.int64()))
        self.rows += table.num_rows
        self.waiting.append(table)
        while sum(part.num_rows for part in self.waiting) >= self.size:
            self._write(self.size)

    def _write(self, rows: int) -> None:
        together = pa.concat_tables(self.waiting)
        name = storage.shard_name(len(self.entries))
        self.entries[name] = write_shard(self.folder, name, together.slice(0, rows))
        self.waiting = [together.slice(rows)]

    def finish(self, configuration: Mapping[str, Any], versions: Mapping[str, str]) -> int:
        """Write what is left, and the manifest; number of interactions."""
        if left := sum(part.num_rows for part in self.waiting):
            self._write(left)
        manifest = storage.new_manifest(configuration, self.rows, self.size, versions)
        storage.write_manifest(self.folder, manifest | {"shards": self.entries})
        return self.rows


def merge(
    paths: Sequence[str | Path | Url], out: str | Path, skip_duplicates: bool = False
) -> tuple[int, int]:
    """One data set of several.

    Args:
        paths: Folders or URLs of the data sets, in the order of their interactions in the new one.
        out: Folder of the new data set; it must not exist.
        skip_duplicates: Leave out interactions that were there before, instead of refusing them.

    Returns:
        Number of its interactions, and of those that were left out.

    Raises:
        DatasetError: A data set cannot be read, or has an interaction of another one.
    """
    if len(paths) < 2:
        raise DatasetError(f"{counted(len(paths), 'data set')} to merge: give two or more")
    sources = [_Source.open(path) for path in paths]
    out = _new_folder(out)
    seen: dict[bytes, tuple[int, int]] = {}
    skipped = 0
    with atomic_folder(out) as draft:
        writer = _begin(draft, sources)
        for number, source in enumerate(sources):
            for table in source.shards():
                kept = []
                for row, (key, id) in enumerate(zip(_keys(table), table["id"].to_pylist(), strict=True)):
                    if (there := seen.setdefault(key, (number, id))) == (number, id):
                        kept.append(row)
                    elif not skip_duplicates:
                        raise DatasetError(
                            f"interaction {id} of {source.path} is interaction {there[1]} of {sources[there[0]].path}: "
                            "the same object, action, physics and seed (data sets of one recipe and --seed begin "
                            "alike); leave such out with --skip-duplicates, or simulate with another --seed"
                        )
                skipped += table.num_rows - len(kept)
                writer.add(table.take(pa.array(kept, pa.int64())), source.numbering)
        rows = _finish(writer, sources, MERGED, {"skipped": skipped})
    return rows, skipped


def split(
    path: str | Path | Url,
    out: str | Path,
    shares: Sequence[float],
    names: Sequence[str] = PARTS,
    by: str = "object",
    seed: int = 0,
) -> dict[str, int]:
    """Several data sets of one.

    Args:
        path: Folder or URL of the data set.
        out: Folder of the new ones, a folder each; it must not exist.
        shares: Share of each; they sum to 1.
        names: Names of their folders.
        by: ``object``: no object is in two of them, and the shares are those of objects. ``interaction``: interactions
            are drawn at random.
        seed: Decides which of them get what.

    Returns:
        Number of interactions of each.

    Raises:
        DatasetError: The data set cannot be read, shares do not sum to 1, or a part would be empty.
    """
    names = tuple(names)[: len(shares)] if tuple(names) == PARTS else tuple(names)
    numeric = all(is_number(share) and share > 0 for share in shares)
    if not (len(shares) > 1 and numeric and np.isclose(sum(shares), 1)):
        raise DatasetError(f"shares {shown(list(shares))}: give two or more positive numbers that sum to 1")
    if len(names) != len(shares) or len(set(names)) < len(names) or not all(map(_is_name, names)):
        raise DatasetError(
            f"names {shown(list(names))}: give {len(shares)} different names of folders, without a path"
        )
    if by not in ("object", "interaction"):
        raise DatasetError(f"split by {shown(by)}: choose from object, interaction")
    source = _Source.open(path)
    units = source.column("object_id" if by == "object" else "id")
    choices = np.random.default_rng(_seed(seed)).permutation(np.unique(units))
    ends = np.round(np.cumsum(shares) * len(choices)).astype(int)
    drawn = np.split(choices, ends[:-1])
    if len(choices) < len(shares):
        remedy = "divide them with --by interaction, or give" if by == "object" else "give"
        raise DatasetError(
            f"{path} has {counted(len(choices), by)} for {len(shares)} parts: {remedy} fewer shares"
        )
    if empty := [name for name, part in zip(names, drawn, strict=True) if len(part) == 0]:
        raise DatasetError(
            f"part {empty[0]} of {counted(len(choices), by)} would be empty: give it a larger share"
        )
    masks = {name: np.isin(units, part) for name, part in zip(names, drawn, strict=True)}
    out = _new_folder(out)
    with atomic_folder(out) as draft:
        writers = {name: _begin(draft / name, [source]) for name in names}
        _pour(source, writers, masks)
        about = {"by": by, "seed": seed, "shares": list(shares)}
        return {
            name: _finish(writer, [source], SPLIT, about | {"part": name}) for name, writer in writers.items()
        }


def sample(path: str | Path | Url, out: str | Path, number: int, seed: int = 0) -> int:
    """A data set of some interactions of another one, drawn at random, in their order.

    Args:
        path: Folder or URL of the data set.
        out: Folder of the new one; it must not exist.
        number: Number of interactions.
        seed: Decides which ones.

    Raises:
        DatasetError: The data set cannot be read, or has fewer interactions.
    """
    source = _Source.open(path)
    units = source.column("id")
    if not is_whole(number, 1, len(units)):
        raise DatasetError(f"{shown(number)} interactions of {path}: give a number from 1 to {len(units)}")
    mask = np.zeros(len(units), dtype=bool)
    mask[np.random.default_rng(_seed(seed)).choice(len(units), number, replace=False)] = True
    out = _new_folder(out)
    with atomic_folder(out) as draft:
        writer = _begin(draft, [source])
        _pour(source, {"": writer}, {"": mask})
        return _finish(writer, [source], SAMPLED, {"seed": seed})


def _pour(source: _Source, writers: Mapping[str, _Writer], masks: Mapping[str, np.ndarray]) -> None:
    """Hand each writer its rows."""
    start = 0
    for table in source.shards():
        rows = slice(start, start + table.num_rows)
        for name, writer in writers.items():
            writer.add(table.filter(pa.array(masks[name][rows])))
        start = rows.stop


def _begin(folder: Path, sources: Sequence[_Source]) -> _Writer:
    (folder / storage.SHARD_FOLDER).mkdir(parents=True)
    return _Writer(folder, sources[0].manifest["shard_size"])


def _finish(writer: _Writer, sources: Sequence[_Source], how: str, about: Mapping[str, Any]) -> int:
    """Finish a data set; its configuration has what its sources have in common, and what each of them was."""
    configurations = [source.manifest["configuration"] for source in sources]
    common = {
        name: value
        for name, value in configurations[0].items()
        if all(name in other and other[name] == value for other in configurations)
    }
    origins = [
        {"name": source.path.resolve().name, "configuration": configuration}
        for source, configuration in zip(sources, configurations, strict=True)
    ]
    return writer.finish(
        {**common, MADE: {"how": how, **about}, SOURCES: origins}, sources[0].manifest["versions"]
    )


def _keys(table: pa.Table) -> list[bytes]:
    """What tells interactions apart, a checksum each."""
    return [
        hashlib.blake2b(repr(list(row.values())).encode(), digest_size=16).digest()
        for row in table.select(TRIAL).to_pylist()
    ]


def _new_folder(out: str | Path) -> Path:
    out = as_path(out, DatasetError)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out} exists: choose a new folder")
    make_folder(out.resolve().parent, DatasetError)
    return out


def _is_name(name: object) -> bool:
    return isinstance(name, str) and name not in ("", ".", "..") and Path(name).name == name


def _seed(seed: object) -> int:
    if not is_whole(seed, 0, 2**63 - 1):
        raise DatasetError(f"seed is {shown(seed)}: give a whole number from 0 on")
    return int(str(seed))
