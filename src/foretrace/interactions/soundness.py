"""Faults of the rows in a shard: what nothing that reads a data set should meet."""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from foretrace.actions import FAILED
from foretrace.actions.base import UNIT_TOLERANCE
from foretrace.errors import ActionError, DatasetError, shown
from foretrace.interactions import storage
from foretrace.interactions.parameters import action_of
from foretrace.interactions.topdown import VIEW_SIZE
from foretrace.schema import conform, parse_json

QUATERNION_TOLERANCE = 1e-6
LENGTHS = {"contact": 2, "direction": 2, "support_points": 4}
"""Numbers in each list of fixed length."""
SIZES = {"mask": VIEW_SIZE**2 // 8, "height": 2 * VIEW_SIZE**2}
"""Bytes of each image."""
COUNTS = ("id", "object_id", "num_corners", "num_joints")
"""Whole numbers that are not negative."""
INDICES = ("slip_index", "fall_index")
"""Numbers of samples."""


def find_faults(table: pa.Table) -> Iterator[tuple[int, str]]:
    """Row and description of everything that is wrong in a shard, in the columns that there are."""
    numbers = np.arange(table.num_rows)
    whole = np.ones(table.num_rows, dtype=bool)
    for name in table.column_names:
        if name not in storage.OPTIONAL_COLUMNS and table[name].null_count:
            missing = table[name].is_null().to_numpy(zero_copy_only=False)
            yield from _at(numbers, missing, f"{name} is missing")
            whole &= ~missing
        elif pa.types.is_list(table.schema.field(name).type):
            values = table[name].combine_chunks()
            if values.values.null_count:
                holes = _rows_with(values, values.values.is_null().to_numpy(zero_copy_only=False))
                yield from _at(numbers, holes, f"{name} holds a null")
                whole &= ~holes
    if not whole.all():
        table, numbers = table.filter(pa.array(whole)), numbers[whole]
    if table.num_rows:
        yield from _of_whole_rows(table, numbers)


def check_shard(table: pa.Table, name: str, rows: int | None) -> None:
    """Refuse a shard with a fault.

    Args:
        table: The shard, with all or some of its columns.
        name: Path of the shard, for the message.
        rows: Number of rows that the manifest says it has; None: it does not say.

    Raises:
        DatasetError: Naming the first row with a fault.
    """
    remedy = "`foretrace data` lists all faults; restore the file from a copy, or make the data set again"
    if rows not in (None, table.num_rows):
        raise DatasetError(f"shard {name} has {table.num_rows} rows, the manifest says {rows}: {remedy}")
    if fault := next(find_faults(table), None):
        raise DatasetError(f"shard {name}, row {fault[0]}: {fault[1]}: {remedy}")


def _of_whole_rows(table: pa.Table, numbers: np.ndarray) -> Iterator[tuple[int, str]]:
    """Faults of rows without nulls."""
    names = table.column_names
    for name in filter(names.__contains__, LENGTHS):
        lengths = _lengths(table, name)
        text = f"{name} has another number of values than {LENGTHS[name]}"
        yield from _at(numbers, lengths != LENGTHS[name], text)
    for name in filter(names.__contains__, SIZES):
        sizes = pc.binary_length(table[name]).to_numpy()  # pyright: ignore[reportAttributeAccessIssue]
        yield from _at(numbers, sizes != SIZES[name], f"{name} has another size than {SIZES[name]} bytes")
    for name in filter(names.__contains__, COUNTS):
        yield from _at(numbers, table[name].to_numpy() < 0, f"{name} is negative")
    for field in table.schema:
        if pa.types.is_floating(field.type):
            values = table[field.name].to_numpy().astype(float)
            odd = np.isinf(values) if field.name in storage.OPTIONAL_COLUMNS else ~np.isfinite(values)
            yield from _at(numbers, odd, f"{field.name} is not a number")
        elif field.type == pa.list_(pa.float64()):
            values = table[field.name].combine_chunks()
            flat = values.values.to_numpy()
            odd = np.isinf(flat) if field.name == "support_points" else ~np.isfinite(flat)
            if odd.any():
                yield from _at(numbers, _rows_with(values, odd), f"{field.name} holds NaN or infinity")
    if "times" in names:
        yield from _of_trajectories(table, numbers)
    if "direction" in names and (_lengths(table, "direction") == 2).all():
        directions = table["direction"].combine_chunks().flatten().to_numpy().reshape(-1, 2)
        off = np.abs(np.hypot(*directions.T) - 1) > UNIT_TOLERANCE
        yield from _at(numbers, off, "direction has not the length 1")
    if set(storage.ACTION_COLUMNS) <= {*names}:
        yield from _of_actions(table, numbers)
    if "versions" in names:
        for text, row in _firsts(table["versions"].to_pylist()):
            if problem := _odd_versions(text):
                yield int(numbers[row]), problem


def _of_trajectories(table: pa.Table, numbers: np.ndarray) -> Iterator[tuple[int, str]]:
    names = table.column_names
    samples = _lengths(table, "times")
    times = table["times"].combine_chunks()
    steps = np.diff(times.values.to_numpy(), prepend=-np.inf)
    firsts = times.offsets.to_numpy()[:-1]
    steps[firsts[samples > 0]] = np.inf
    if (steps <= 0).any():
        yield from _at(numbers, _rows_with(times, steps <= 0), "its times do not rise")
    if "outcome" in names:
        failed = np.array(table["outcome"].to_pylist()) == FAILED
        yield from _at(numbers, (samples == 0) & ~failed, "it has no samples although it did not fail")
    widths = {**storage.TRAJECTORIES, "joint_trajectory": 0}
    for name in filter(names.__contains__, widths):
        width = table["num_joints"].to_numpy() if name == "joint_trajectory" else widths[name]
        lengths = _lengths(table, name)
        for row in np.flatnonzero(lengths != samples * width):
            yield int(numbers[row]), f"{name} has {lengths[row]} numbers for {samples[row]} samples"
        if widths[name] == 7 and (lengths == 7 * samples).all():
            values = table[name].combine_chunks()
            quaternions = values.values.to_numpy().reshape(-1, 7)[:, 3:]
            with np.errstate(all="ignore"):
                norms = np.sqrt(np.einsum("ij,ij->i", quaternions, quaternions))
            if (odd := np.abs(norms - 1) > QUATERNION_TOLERANCE).any():
                text = f"a quaternion of {name} has a norm other than 1"
                yield from _at(numbers, _rows_with(values, np.repeat(odd, 7)), text)
    for name in filter(names.__contains__, INDICES):
        index = table[name].to_numpy(zero_copy_only=False).astype(float)
        yield from _at(numbers, (index < 0) | (index > samples), f"{name} is no sample of it")


def _of_actions(table: pa.Table, numbers: np.ndarray) -> Iterator[tuple[int, str]]:
    texts = (table[name].to_pylist() for name in ("action", "path", "tool"))
    kinds = list(zip(*texts, strict=True))
    outcomes = table["outcome"].to_pylist() if "outcome" in table.column_names else [FAILED] * len(kinds)
    allowed: dict[tuple[str, str, str], tuple[str, ...]] = {}
    for kind, row in _firsts(kinds):
        try:
            allowed[kind] = _outcomes_of(*kind)
        except (ActionError, ValueError) as reason:
            yield int(numbers[row]), str(reason)
    for row, (kind, outcome) in enumerate(zip(kinds, outcomes, strict=True)):
        if kind in allowed and outcome not in allowed[kind]:
            yield int(numbers[row]), f"it has the unknown outcome {shown(outcome)}"


def _outcomes_of(action: str, path: str, tool: str) -> tuple[str, ...]:
    return (*action_of(action, path, tool).outcomes, FAILED)


@lru_cache(maxsize=64)
def _odd_versions(text: str) -> str | None:
    try:
        conform(parse_json(text), dict[str, str], "versions", DatasetError, "simulate again")
    except (ValueError, DatasetError) as reason:
        return f"versions cannot be read ({reason})"
    return None


def _at(numbers: np.ndarray, wrong: np.ndarray, problem: str) -> Iterator[tuple[int, str]]:
    return ((int(number), problem) for number in (numbers[wrong] if wrong.any() else ()))


def _firsts(values: list) -> Iterator[tuple]:
    """Each different value, and the first row that has it."""
    rows: dict = {}
    for row, value in enumerate(values):
        rows.setdefault(value, row)
    return iter(rows.items())


def _lengths(table: pa.Table, name: str) -> np.ndarray:
    return pc.list_value_length(table[name]).to_numpy()  # pyright: ignore[reportAttributeAccessIssue]


def _rows_with(lists: pa.ListArray, flags: np.ndarray) -> np.ndarray:
    """Which lists hold a flagged value."""
    rows = np.searchsorted(lists.offsets.to_numpy(), np.flatnonzero(flags), side="right") - 1
    return np.isin(np.arange(len(lists)), rows)
