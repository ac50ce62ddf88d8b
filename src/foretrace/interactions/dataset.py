"""Interactions on disk, read as they are needed."""

import warnings
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float, Int

from foretrace.actions import ACTIONS, FAILED
from foretrace.errors import DatasetError, RowError, ShapeError, check_type, is_whole, shown
from foretrace.extras import named_extras
from foretrace.interactions import storage
from foretrace.interactions.batch import InteractionBatch as InteractionBatch
from foretrace.interactions.batch import chosen_rows
from foretrace.interactions.index import PARAMETER, SCHEMA, kept_index, places_of
from foretrace.interactions.record import Interaction
from foretrace.interactions.shards import Shards
from foretrace.interactions.tables import batch_of, common_times
from foretrace.objects import ObjectModel, object_from_json
from foretrace.schema import parse_json
from foretrace.urls import Url, as_place, read_each

if TYPE_CHECKING:
    import pandas as pd

ROWS_AT_ONCE = 100
"""Interactions that are read together where a data set is gone through: those of a shard."""
MOST_OBJECTS = 2000
"""Objects that are kept built."""


class Dataset:
    """Interactions in the order of their ids; open one with `Dataset.open`.

    ``dataset[3]`` is the fourth interaction; ``dataset[10:20]`` and ``dataset[indices]`` are data sets again.

    Images and trajectories are read from disk when they are needed, and kept in memory if all fit into
    `shards.CACHE_BYTES`: a data set may be larger than memory, as long as it is read by iteration or by `batches`.
    """

    def __init__(
        self,
        shards: Shards,
        index: pa.Table,
        places: np.ndarray,
        manifest: Mapping[str, Any],
        chosen: np.ndarray | None = None,
    ):
        self.manifest = manifest
        """Configuration, versions, units and shards of the folder."""
        self.path = shards.path
        """The folder that it was read from, or its URL."""
        self._shards, self._places = shards, places
        self._whole, self._chosen = index, chosen
        self._objects: dict[str, ObjectModel] = {}

    @classmethod
    def open(cls, path: str | Path | Url, failed: bool = False) -> "Dataset":
        """Open a data set; checksums of all shards are verified.

        Of one that does not fit into memory, shards are verified when they are read, and where they lack the index of
        their rows. The indices of all are kept beside it, in ``index.arrow``; of a URL, in the user's cache.

        Args:
            path: The folder written by ``foretrace simulate``, or its URL, as ``s3://bucket/set``.
            failed: Keep the failed simulations too; they have no effect to learn from.

        Raises:
            DatasetError: Nothing there, another format version, or a missing or corrupt shard.
        """
        path = as_place(path, DatasetError)
        check_type("failed", failed, bool, DatasetError, "True or False")
        manifest = storage.read_manifest(path)
        shards = Shards(path, manifest["shards"])
        if missing := storage.missing_shards(manifest):
            warnings.warn(
                f"{path} is not finished: {len(missing)} of {len(missing) + len(shards)} shards are missing; "
                + storage.how_to_restore(path),
                stacklevel=2,
            )
        if shards.fit:
            read_each(shards.table, range(len(shards)), path)
            parts = [SCHEMA.empty_table(), *map(shards.index, range(len(shards)))]
            index = pa.concat_tables(parts, promote_options="default")
            rows = [part.num_rows for part in parts[1:]]
        else:
            index, rows = kept_index(path, shards.entries, shards.index)
            shards.indexed = True
        dataset = cls(shards, index, places_of(rows), manifest)
        ids, counts = np.unique(dataset.ids, return_counts=True)
        if (counts > 1).any():
            raise DatasetError(
                f"{path} has interaction {ids[counts > 1][0]} more than once: `foretrace data {path}` names the shards"
            )
        return dataset if failed else dataset.where(outcome=lambda outcome: outcome != FAILED)

    @cached_property
    def index(self) -> pa.Table:
        """Columns of a few numbers a row, as a pyarrow table; `storage.COLUMNS` and `parameters` explain them."""
        return self._whole if self._chosen is None else self._whole.take(pa.array(self._chosen))

    def __repr__(self) -> str:
        outcomes = ", ".join(f"{count} {outcome}" for outcome, count in self.outcomes().items())
        return f"Dataset({str(self.path)!r}: {len(self)} interactions{f': {outcomes}' if outcomes else ''})"

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, rows: Any) -> Any:
        if isinstance(rows, int | np.integer) and not isinstance(rows, bool):
            if not -len(self) <= rows < len(self):
                raise RowError(f"there is no row {rows} among {len(self)}: take 0 to {len(self) - 1}")
            number, row = self._places[rows]
            return self._decode(self._shards.table(int(number)).slice(row, 1).to_pylist()[0])
        return self._view(chosen_rows(len(self), rows))

    def __iter__(self) -> Iterator[Interaction]:
        for table in self._pieces():
            yield from map(self._decode, table.to_pylist())

    @property
    def table(self) -> pa.Table:
        """All columns of all rows, in memory; `storage.COLUMNS` explains them."""
        return self._rows(slice(None))

    def where(self, **conditions: Any) -> "Dataset":
        """The interactions that meet every condition.

        Args:
            **conditions: For a column (``outcome``, ``num_corners``, ``object_id``...) or a parameter of the
                actions (``insertion``...): the value that it must have, several allowed values, or a function from
                the column (an array) to booleans.

        Raises:
            DatasetError: There is no such column, or no such outcome.
        """
        kept = np.ones(len(self), dtype=bool)
        for name, wanted in conditions.items():
            column = self._column(name)
            if callable(wanted):
                try:
                    found = np.asarray(wanted(column))
                except Exception as error:
                    raise DatasetError(
                        f"the function for {name} ends with {type(error).__name__} ({error}): let it take an array of "
                        f"shape {column.shape}"
                    ) from error
                if found.dtype != bool or found.shape not in ((), column.shape):
                    raise DatasetError(
                        f"the function for {name} returns {found.dtype} of shape {found.shape}: let it return "
                        f"booleans of shape {column.shape}"
                    )
                kept &= found
                continue
            several = isinstance(wanted, list | tuple | set | frozenset | range | np.ndarray)
            several = several and np.ndim(wanted) > 0 if isinstance(wanted, np.ndarray) else several
            values = list(wanted) if several else [wanted]
            if name == "outcome" and (
                odd := [value for value in values if str(value) not in self._outcome_names()]
            ):
                raise DatasetError(
                    f"no outcome {shown(odd[0])}: choose from {', '.join(self._outcome_names())}"
                )
            texts = column.dtype.kind in "OU"
            for value in values:
                if isinstance(value, str) != texts or not np.isscalar(value):
                    raise DatasetError(
                        f"{name} is compared with {shown(value)}: give {'a text' if texts else 'a number'}"
                    )
            kept &= np.isin(column, values)
        return self if kept.all() else self._view(np.flatnonzero(kept))

    def with_id(self, id: int) -> Interaction:
        """The interaction of that number.

        Raises:
            DatasetError: It is not among these.
        """
        check_type("id", id, (int, np.integer), DatasetError, "a whole number")
        found = np.flatnonzero(self.ids == id)
        if len(found) == 0:
            raise DatasetError(f"{self.path} has no interaction {id} among the {len(self)} selected")
        return self[found[0]]

    def batch(self) -> InteractionBatch:
        """All of them as arrays.

        Raises:
            DatasetError: Two of them were sampled at different times.
        """
        return self._batch(slice(None))

    def batches(self, size: int = ROWS_AT_ONCE) -> Iterator[InteractionBatch]:
        """All of them as arrays, a number of rows at a time; sample times are common to all.

        Raises:
            DatasetError: Two of them were sampled at different times.
        """
        if not is_whole(size, 1, 2**63 - 1):
            raise DatasetError(f"size of a batch is {shown(size)}: give a number of rows from 1 on")
        for start in range(0, len(self), size):
            yield self._batch(slice(start, start + size))
            pa.default_memory_pool().release_unused()

    @property
    def complete_until(self) -> int | None:
        """Number of its first interactions that are there while others are still to come; None: all are there."""
        if not (missing := storage.missing_shards(self.manifest)):
            return None
        return int(missing[0].removesuffix(".parquet").rpartition("-")[2]) * self.manifest["shard_size"]

    @property
    def ids(self) -> Int[np.ndarray, " batch"]:
        """Number of each interaction within its data set."""
        return self._indexed("id").to_numpy()

    @cached_property
    def lengths(self) -> Int[np.ndarray, " batch"]:
        """Number of samples of each trajectory."""
        parts = [
            pc.list_value_length(table["times"]).to_numpy()  # pyright: ignore[reportAttributeAccessIssue]
            for table in self._pieces(["times"])
        ]
        return np.concatenate([np.zeros(0, dtype=np.int64), *parts]).astype(np.int64)

    @cached_property
    def times(self) -> Float[np.ndarray, " time"]:
        """Sample times [s] of the longest interaction, with which all others agree.

        Raises:
            DatasetError: Two of them were sampled at different times.
        """
        return common_times(self._pieces(["id", "times"]))

    def to_pandas(self) -> "pd.DataFrame":
        """The rows as a data frame, trajectories flattened, images packed."""
        with named_extras():
            return self.table.to_pandas()

    def outcomes(self) -> dict[str, int]:
        """Number of interactions with each outcome that occurs, in the order in which actions name them."""
        return count_outcomes(dict(zip(*self._distinct("outcome"), strict=True)))

    def objects(self) -> Iterator[dict[str, Any]]:
        """Descriptions of the objects, row by row, as of ``ObjectModel.to_dict``."""
        for table in self._pieces(["object"]):
            yield from map(parse_json, table["object"].to_pylist())

    def _outcome_names(self) -> list[str]:
        """Outcomes that its actions can have, and any other that it holds."""
        known = [name for label in self._distinct("action")[0] for name in ACTIONS.find(label).outcomes]
        return list(dict.fromkeys([*known, FAILED, *self._distinct("outcome")[0]]))

    def _distinct(self, name: str) -> tuple[list[Any], list[int]]:
        """Values of a column of the index, in the order in which they first occur, and how often each of them does."""
        found = self._indexed(name).value_counts()
        return found.field("values").to_pylist(), found.field("counts").to_pylist()

    def _indexed(self, name: str) -> pa.ChunkedArray:
        """A column of the index."""
        column = self._whole[name]
        return column if self._chosen is None else column.take(pa.array(self._chosen))

    def _column(self, name: str) -> np.ndarray:
        """A column of single values, or a parameter of the actions."""
        scalars = [f.name for f in storage.SCHEMA if not pa.types.is_nested(f.type)]
        if name in scalars:
            column = self._indexed(name) if name in SCHEMA.names else self._rows(slice(None), [name])[name]
            if not pa.types.is_string(column.type):
                return column.to_numpy()
            texts = (
                column.combine_chunks().dictionary_encode()
            )  # of which few differ: one object for all that are equal
            return np.array([*texts.dictionary.to_pylist(), ""], dtype=object)[texts.indices.to_numpy()]
        if name not in self.parameters:
            names = [*scalars, *self.parameters]
            close = get_close_matches(name, names, n=3) or names
            raise DatasetError(f"no column {shown(name)} to filter by: choose from {', '.join(close)}")
        return self.parameters[name]

    @cached_property
    def parameters(self) -> dict[str, np.ndarray]:
        """Parameters of the actions by name [SI], one number a row; NaN where an action lacks one."""
        names = [name for name in self._whole.column_names if name.startswith(PARAMETER)]
        return _occurring({name.removeprefix(PARAMETER): self._indexed(name).to_numpy() for name in names})

    def _view(self, rows: np.ndarray) -> "Dataset":
        chosen = rows if self._chosen is None else self._chosen[rows]
        view = Dataset(self._shards, self._whole, self._places[rows], self.manifest, chosen)
        view._objects = self._objects
        if "times" in self.__dict__:  # common to all that come from the same data set
            view.__dict__["times"] = self.times
        return view

    def _rows(self, chosen: slice, columns: list[str] | None = None) -> pa.Table:
        """Rows with all or some columns, in the data set's order."""
        names = storage.SCHEMA.names if columns is None else columns
        places = self._places[chosen]
        starts = np.flatnonzero(np.diff(places[:, 0], prepend=-1))
        parts = [
            self._shards.table(int(run[0, 0]), columns).take(pa.array(run[:, 1]))
            for run in np.split(places, starts[1:])
            if len(run)
        ]
        return pa.concat_tables([storage.SCHEMA.empty_table().select(names), *parts])

    def _pieces(self, columns: list[str] | None = None, size: int = ROWS_AT_ONCE) -> Iterator[pa.Table]:
        """All rows with all or some columns, a number of rows at a time."""
        return (self._rows(slice(start, start + size), columns) for start in range(0, len(self), size))

    def _batch(self, rows: slice) -> InteractionBatch:
        table = self._rows(rows)
        descriptions = table["object"].unique().to_pylist()
        objects = {description: self._object(description) for description in descriptions}
        parameters = _occurring({name: values[rows] for name, values in self.parameters.items()})
        return batch_of(table, objects, self.times, parameters)

    def _decode(self, row: dict[str, Any]) -> Interaction:
        return storage.decode(row, self._object(row["object"]))

    def _object(self, description: str) -> ObjectModel:
        if description not in self._objects:
            if len(self._objects) >= MOST_OBJECTS:
                self._objects.clear()
            try:
                self._objects[description] = object_from_json(description)
            except ShapeError as reason:
                raise DatasetError(
                    f"{self.path} describes an object that cannot be read ({reason}): check it with `foretrace data`"
                ) from reason
        return self._objects[description]


def _occurring(parameters: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Parameters that some action has."""
    return {name: values for name, values in parameters.items() if not np.isnan(values).all()}


def count_outcomes(counts: Mapping[str, int]) -> dict[str, int]:
    """How often each outcome occurs, in the order in which actions name them."""
    known = [str(name) for action in ACTIONS.values() for name in action.outcomes]
    return {name: counts[name] for name in dict.fromkeys([*known, FAILED, *counts]) if counts.get(name)}
