"""The columns of a data set that are always at hand, with the parameters of its actions.

Each shard carries those of its rows in its footer, where they are read without the rest. Those of a large data set are
kept together in a file beside it, which is not read but mapped; of a data set at a URL, in the user's cache.
"""

import json
from base64 import b64decode, b64encode
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from foretrace.errors import DatasetError
from foretrace.files import atomic_path, cache_folder, make_folder, short_hash
from foretrace.interactions import storage
from foretrace.interactions.parameters import parameter_values
from foretrace.urls import Url, names_in, read_each

INDEX = "index.arrow"
"""File of the columns; it is made again wherever it is missing or does not fit."""
SHARDS = b"foretrace-shards"
"""Entry of its metadata with name, checksum and rows of each shard that it covers, in its order."""
SCHEMA = pa.schema([field for field in storage.SCHEMA if field.name not in storage.LARGE_COLUMNS])
"""Columns of few bytes: some 300 in all, with the parameters."""
PARAMETER = "parameter "
"""Beginning of the names of the other columns, with a parameter of the actions each."""
TOGETHER = 500
"""Shards whose columns are put together at once: many small tables take more memory than what is in them."""

Entries = Sequence[tuple[str, storage.ShardEntry]]


def index_of(table: pa.Table) -> pa.Table:
    """The columns of some rows, with the parameters of their actions."""
    index = table.select(SCHEMA.names).cast(SCHEMA)
    for name, values in parameter_values(table).items():
        index = index.append_column(PARAMETER + name, pa.array(values, pa.float64()))
    return index


def pack(index: pa.Table, rows: bytes) -> str:
    """An index as text, bound to the bytes of the rows that it is of."""
    sink = pa.BufferOutputStream()
    with pa.CompressedOutputStream(sink, "zstd") as packed, pa.ipc.new_stream(packed, index.schema) as stream:
        # Built anew: equal arrays may have other bytes below nulls.
        stream.write_table(pa.Table.from_pylist(index.to_pylist(), index.schema))
    content = b64encode(sink.getvalue()).decode()
    return json.dumps([content, short_hash([content.encode()]), len(rows), short_hash([rows])])


def unpack(text: bytes) -> pa.Table | None:
    """The index in a text of `pack`; None if it is damaged, or has other columns than those of today."""
    with suppress(ValueError, TypeError, OSError, pa.ArrowException):
        content, digest, *_ = json.loads(text)
        if digest == short_hash([content.encode()]):
            stream = pa.CompressedInputStream(pa.BufferReader(b64decode(content)), "zstd")
            table = pa.ipc.open_stream(stream).read_all()
            if table.schema.names[: len(SCHEMA)] == SCHEMA.names:
                return table
    return None


def is_of(text: bytes, content: bytes) -> bool:
    """Whether a text of `pack` is bound to the rows in the bytes of a shard."""
    with suppress(ValueError, TypeError):
        *_, size, digest = json.loads(text)
        return short_hash([content[:size]]) == digest
    return False


def kept_index(
    folder: Path | Url, entries: Entries, read: Callable[[int], pa.Table]
) -> tuple[pa.Table, list[int]]:
    """The index of all shards, and the number of rows of each.

    Only shards that are not in the file are read.

    Args:
        folder: The data set's folder, or its URL.
        entries: Name and entry of each shard.
        read: The index of a shard by its place among them.

    Raises:
        DatasetError: A shard is missing, or cannot be read.
    """
    there = {f"{storage.SHARD_FOLDER}/{name}" for name in names_in(folder / storage.SHARD_FOLDER)}
    if absent := next((name for name, _ in entries if name not in there), None):
        raise DatasetError(f"shard {folder / absent} is missing: {storage.how_to_restore(folder)}")
    home = _home(folder)
    kept, covered = _read(home)
    keys = [(name, entry.get("sha256")) for name, entry in entries]
    if kept is not None and list(covered) == keys:
        return kept, list(covered.values())
    starts = dict(zip(covered, np.cumsum([0, *covered.values()]).tolist(), strict=False))

    def table_of(number: int) -> pa.Table:
        key = keys[number]
        if kept is not None and key in covered and key[1] is not None:
            return kept.slice(starts[key], covered[key])
        return read(number)

    parts, rows = [], []
    for start in range(0, len(keys), TOGETHER):
        tables = read_each(table_of, range(start, min(start + TOGETHER, len(keys))), folder)
        parts.append(pa.concat_tables(tables, promote_options="default").combine_chunks())
        rows += [table.num_rows for table in tables]
    index = pa.concat_tables(parts, promote_options="default")
    about = json.dumps([[*key, count] for key, count in zip(keys, rows, strict=True)]).encode()
    with suppress(OSError):  # a folder that cannot be written to is read each time
        _write(home, index.replace_schema_metadata({SHARDS: about}))
        return _read(home)[0] or index, rows
    return index, rows


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


def _read(folder: Path) -> tuple[pa.Table | None, dict[tuple[str, str | None], int]]:
    """The columns in the file, and which shards with how many rows they are of; None if there is no sound one."""
    with suppress(OSError, pa.ArrowException, ValueError, TypeError, KeyError):
        file = pa.ipc.open_file(pa.memory_map(str(folder / INDEX)))
        table = file.read_all()
        table.validate(full=True)  # since nothing else looks at offsets before they are used
        covered = {(name, sum): rows for name, sum, rows in json.loads(table.schema.metadata[SHARDS])}
        names = [name for name in table.column_names if not name.startswith(PARAMETER)]
        if names == SCHEMA.names and sum(covered.values()) == table.num_rows:
            return table.replace_schema_metadata(None), covered
    return None, {}


def places_of(rows: Sequence[int]) -> Int[np.ndarray, "n 2"]:
    """Shard, and row within it, of each interaction."""
    counts = np.array(rows, dtype=np.int64)
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    return np.stack([np.repeat(np.arange(len(counts)), counts), np.arange(len(starts)) - starts], axis=1)
