"""The columns of a large data set that are always at hand, kept in a file beside it, which is not read but mapped.

Of a data set at a URL, the file is in the user's cache.
"""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from foretrace.errors import DatasetError
from foretrace.files import atomic_path, cache_folder, make_folder, short_hash
from foretrace.interactions import storage
from foretrace.interactions.parameters import PARAMETER, with_parameters
from foretrace.urls import Url, names_in, read_each

INDEX = "index.arrow"
"""File of the columns; it is made again wherever it is missing or does not fit."""
SHARDS = b"foretrace-shards-with-parameters"
"""Entry of its metadata with name, checksum and rows of each shard that it covers, in its order."""

Entries = Sequence[tuple[str, storage.ShardEntry]]


def kept_index(
    folder: Path | Url, entries: Entries, read: Callable[[int], pa.Table], columns: Sequence[str]
) -> tuple[pa.Table, list[int]]:
    """Some columns of all shards, with parameters of the actions, and the number of rows of each.

    Only shards that are not in the file are read.

    Args:
        folder: The data set's folder, or its URL.
        entries: Name and entry of each shard.
        read: The columns of a shard by its place among them.
        columns: Names of the columns.

    Raises:
        DatasetError: A shard is missing, or cannot be read.
    """
    there = {f"{storage.SHARD_FOLDER}/{name}" for name in names_in(folder / storage.SHARD_FOLDER)}
    if absent := next((name for name, _ in entries if name not in there), None):
        raise DatasetError(f"shard {folder / absent} is missing: {storage.how_to_restore(folder)}")
    home = _home(folder)
    kept, covered = _read(home, columns)
    if kept is not None and list(covered) == [(name, entry.get("sha256")) for name, entry in entries]:
        return kept, list(covered.values())
    starts = dict(zip(covered, np.cumsum([0, *covered.values()]).tolist(), strict=False))

    def table_of(number: int) -> pa.Table:
        key = entries[number][0], entries[number][1].get("sha256")
        if kept is not None and key in covered and key[1] is not None:
            return kept.slice(starts[key], covered[key])
        return with_parameters(read(number))

    tables = read_each(table_of, range(len(entries)), folder)
    keys = ((name, entry.get("sha256")) for name, entry in entries)
    rows = {key: table.num_rows for key, table in zip(keys, tables, strict=True)}
    index = pa.concat_tables(tables, promote_options="default").unify_dictionaries().combine_chunks()
    about = json.dumps([[*key, count] for key, count in rows.items()]).encode()
    with suppress(OSError):  # a folder that cannot be written to is read each time
        _write(home, index.replace_schema_metadata({SHARDS: about}))
        return _read(home, columns)[0] or index, list(rows.values())
    return index, list(rows.values())


def _home(folder: Path | Url) -> Path:
    """Folder of the file: that of the data set, or one of the user's cache."""
    if isinstance(folder, Path):
        return folder
    home = cache_folder("index") / short_hash([str(folder).encode()])
    with suppress(DatasetError):
        make_folder(home, DatasetError)
    return home


def _write(folder: Path, index: pa.Table) -> None:
    with atomic_path(folder / INDEX) as draft, pa.ipc.new_file(str(draft), index.schema) as writer:
        writer.write_table(index)


def _read(folder: Path, columns: Sequence[str]) -> tuple[pa.Table | None, dict[tuple[str, str | None], int]]:
    """The columns in the file, and which shards with how many rows they are of; None if there is no sound one."""
    with suppress(OSError, pa.ArrowException, ValueError, TypeError, KeyError):
        file = pa.ipc.open_file(pa.memory_map(str(folder / INDEX)))
        table = file.read_all()
        table.validate(full=True)  # since nothing else looks at offsets before they are used
        covered = {(name, sum): rows for name, sum, rows in json.loads(table.schema.metadata[SHARDS])}
        names = [name for name in table.column_names if not name.startswith(PARAMETER)]
        if names == list(columns) and sum(covered.values()) == table.num_rows:
            return table.replace_schema_metadata(None), covered
    return None, {}


def places_of(rows: Sequence[int]) -> Int[np.ndarray, "n 2"]:
    """Shard, and row within it, of each interaction."""
    counts = np.array(rows, dtype=np.int64)
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    return np.stack([np.repeat(np.arange(len(counts)), counts), np.arange(len(starts)) - starts], axis=1)
