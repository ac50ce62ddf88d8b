"""Shards as they are written, each with the index of its rows in its footer, and as a data set reads them."""

from collections.abc import Mapping
from contextlib import suppress
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from foretrace.errors import DatasetError
from foretrace.files import write_bytes
from foretrace.interactions import storage
from foretrace.interactions.index import SCHEMA, index_of, is_of, pack, unpack
from foretrace.interactions.soundness import check_shard, find_faults
from foretrace.urls import Url

CACHE_BYTES = 256 * 2**20
"""A data set of up to this size is kept in memory once it was read: about 5,000 interactions."""
FOOTER = b"foretrace-index"
"""Entry of a shard's metadata with the index of its rows. A shard with a fault has none, nor has an old one."""
STRANGE = f"was changed, and has the index of other rows: write it without the entry {FOOTER.decode()} of its metadata"
"""What is wrong with a shard that has another one's index."""
ACTION = ("path", "tool")
"""Columns that are decoded to be checked."""


def write_shard(folder: Path | Url, name: str, table: pa.Table) -> dict[str, Any]:
    """Write one shard; returns its entry for the manifest (checksum and number of rows)."""
    content = shard_content(table)
    write_bytes(folder / name, content)
    return storage.shard_entry(content, table)


def shard_content(table: pa.Table) -> bytes:
    """The bytes of a shard; the same for equal rows, also for those that were read from one."""
    sink, todays = BytesIO(), table.schema.equals(storage.SCHEMA)
    # Items of lists have other names once they were read, and metadata of a shard is of its rows alone.
    table = (table.cast(storage.SCHEMA) if todays else table.replace_schema_metadata(None)).combine_chunks()
    with pq.ParquetWriter(sink, table.schema, compression="zstd", use_dictionary=False) as writer:
        writer.write_table(table)
        if todays and next(find_faults(table), None) is None:
            writer.add_key_value_metadata({FOOTER.decode(): pack(index_of(table), sink.getvalue())})
    return sink.getvalue()


class Shards:
    """Tables of a data set's shards, kept in memory if all of them fit; otherwise only the last one that was read."""

    def __init__(self, path: Path | Url, entries: Mapping[str, storage.ShardEntry]):
        self.path = path
        self.entries = sorted(entries.items())
        self._kept: dict[int, pa.Table] = {}
        self._sound: set[int] = set()
        self.indexed = False
        """Whether the columns of the index were checked, of shards that still have their checksum."""

    def __len__(self) -> int:
        return len(self.entries)

    @cached_property
    def fit(self) -> bool:
        """Whether all of them fit into memory, to judge by the first one."""
        return len(self) == 0 or self.table(0).nbytes * len(self) <= CACHE_BYTES

    def index(self, number: int) -> pa.Table:
        """The index of a shard: from its footer, or else of its rows.

        Raises:
            DatasetError: It is missing or corrupt.
        """
        name, entry = self.entries[number]
        with suppress(OSError, pa.ArrowException, DatasetError):
            found = unpack(_metadata(self.path / name).get(FOOTER, b""))
            if found is not None and entry.get("rows") in (None, found.num_rows):
                return found
        return index_of(self.table(number, [*SCHEMA.names, *ACTION]))

    def table(self, number: int, columns: list[str] | None = None) -> pa.Table:
        """The rows of a shard, with all or some of its columns.

        Raises:
            DatasetError: It is missing or corrupt.
        """
        table = self._kept.get(number)
        if table is None:
            name, entry = self.entries[number]
            table, content = storage.read_shard(self.path, name, entry.get("sha256"), columns=columns)
            if number not in self._sound and not self._was_sound(number, table, content):
                decoded = self.indexed and entry.get("sha256") is not None  # the slowest of what is checked
                rest = table.drop_columns([n for n in ACTION if decoded and n in table.column_names])
                check_shard(rest, str(self.path / name), entry.get("rows"))
            if columns is None:
                self._sound.add(number)
                if not self.__dict__.get("fit", False):
                    self._kept.clear()
                self._kept[number] = table
        return table if columns is None else table.select(columns)

    def _was_sound(self, number: int, table: pa.Table, content: bytes) -> bool:
        """Whether a shard was found sound when it was written, and its rows are still those.

        Raises:
            DatasetError: It has the index of other rows.
        """
        name, entry = self.entries[number]
        own = has_own_index(content)
        if own is False:
            raise DatasetError(f"shard {self.path / name} {STRANGE}, or {storage.how_to_restore(self.path)}")
        return own is True and entry.get("rows") in (None, table.num_rows)


def has_own_index(content: bytes) -> bool | None:
    """Whether the index in the bytes of a shard is of its rows; None: it has none."""
    text = _metadata(pa.BufferReader(content)).get(FOOTER)
    return None if text is None else is_of(text, content)


def _metadata(file: Path | Url | pa.NativeFile) -> Mapping[bytes, bytes]:
    """The entries of a shard's metadata."""
    if not isinstance(file, Url):
        return pq.read_metadata(file).metadata or {}
    with file.opened() as opened:
        return pq.read_metadata(opened).metadata or {}
