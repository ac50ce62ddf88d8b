"""Is a data set whole and sound? What is not, and what of it can be repaired."""

import fnmatch
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa

from foretrace.actions import ToolPath
from foretrace.errors import ActionError, DatasetError, ShapeError, shown
from foretrace.files import partial_files, remove_partial, sole_writer
from foretrace.interactions import recorded, storage
from foretrace.interactions.dataset import count_outcomes
from foretrace.interactions.parameters import parameter_values
from foretrace.interactions.shards import STRANGE, has_own_index
from foretrace.interactions.soundness import find_faults
from foretrace.objects import object_from_json
from foretrace.urls import Url, as_place, names_in


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a data set."""

    file: str
    """The file that it concerns."""
    problem: str
    """What is wrong, and what can be done."""
    repaired: bool = False
    """Whether it has been put right."""


@dataclass(frozen=True)
class Diagnosis:
    """What `examine` found."""

    findings: tuple[Finding, ...]
    """Everything that is wrong; empty for a sound data set."""
    num_interactions: int
    """Interactions in readable shards."""
    outcomes: dict[str, int]
    """How often each outcome occurs, failed simulations included."""


def examine(path: str | Path | Url, repair: bool = False) -> Diagnosis:
    """Check checksums, schema, numbers, ids and stray files of a data set.

    Args:
        path: The data set's folder, or its URL.
        repair: Remove what an interrupted run left behind, set corrupt shards aside so that
            ``foretrace simulate`` makes them again, and enter whole shards that merely miss their checksum.

    Raises:
        DatasetError: There is no data set, or its manifest cannot be read.
    """
    path = as_place(path, DatasetError)
    if not repair:
        path.exists()  # which is refused where a store does not answer
        return _examine(path, repair=False)
    if isinstance(path, Url):
        raise DatasetError(
            f"{path} cannot be repaired, since a store has no locks: repeat `foretrace simulate`"
        )
    storage.read_manifest(path)  # before the lock, which would leave its file in any folder
    with sole_writer(path, DatasetError):
        return _examine(path, repair=True)


def _examine(path: Path | Url, repair: bool) -> Diagnosis:
    findings = list(_stray_files(path, repair))
    try:
        manifest = storage.read_manifest(path)
    except DatasetError as error:
        if repair or not (path / storage.MANIFEST).is_file():
            raise
        findings.append(Finding(storage.MANIFEST, str(error)))
        manifest = None
    ids: dict[str, list[int]] = {}
    outcomes: Counter[str] = Counter()
    there = fnmatch.filter(names_in(path / storage.SHARD_FOLDER), "shard-*.parquet")
    on_disk = {f"{storage.SHARD_FOLDER}/{name}" for name in there}
    shards = {} if manifest is None else manifest["shards"]
    for name in sorted(on_disk | set(shards)):
        entry = shards.get(name, {})
        try:
            table, content = storage.read_shard(path, name, entry.get("sha256"))
        except DatasetError as error:
            findings.append(_set_aside(path, name, shards, str(error), repair))
            continue
        ids[name] = table["id"].drop_null().to_pylist()
        outcomes.update(table["outcome"].drop_null().to_pylist())
        if has_own_index(content) is False:
            findings.append(Finding(name, f"it {STRANGE}"))
        faults = list(_unsound_rows(name, table))
        findings += faults
        if manifest is None:
            continue
        findings += [] if faults else _out_of_range(name, table, manifest)
        if entry.get("rows", table.num_rows) != table.num_rows:
            findings.append(Finding(name, f"it has {table.num_rows} rows, the manifest says {entry['rows']}"))
        if entry.get("sha256") is None:
            findings.append(Finding(name, "no checksum in the manifest (an interrupted run)", repair))
            if repair:
                shards[name] = storage.shard_entry(content, table)
    if manifest is not None:
        reported = {finding.file for finding in findings if not finding.repaired} - ids.keys()
        problems = _unsound_ids(ids, manifest, storage.how_to_restore(path))
        findings += [problem for problem in problems if problem.file not in reported]
        if manifest["configuration"] == recorded.CONFIGURATION:
            findings += _unsound_notes(path, chain.from_iterable(ids.values()))
    if repair and manifest is not None:
        storage.write_manifest(path, manifest)
    return Diagnosis(tuple(findings), outcomes.total(), count_outcomes(outcomes))


def _stray_files(path: Path | Url, repair: bool) -> Iterator[Finding]:
    if isinstance(path, Url):  # which has none
        return
    for folder in (path, path / storage.SHARD_FOLDER, path / recorded.NOTES_FOLDER):
        for file in remove_partial(folder) if repair else partial_files(folder):
            yield Finding(str(file.relative_to(path)), "temporary file of an interrupted run", repair)


def _set_aside(path: Path | Url, name: str, shards: dict, problem: str, repair: bool) -> Finding:
    if repair and isinstance(path, Path):
        shards.pop(name, None)
        done = "removed from the manifest"
        if (path / name).exists():
            (path / name).replace(path / f"{name}.corrupt")
            done = "set aside"
        problem = f"{problem.split(';')[0]}; {done}: {storage.how_to_restore(path)}"
    return Finding(name, problem, repair)


def _unsound_rows(name: str, table: pa.Table) -> Iterator[Finding]:
    ids = table["id"].to_pylist()
    for row, problem in find_faults(table):
        yield Finding(name, f"interaction {ids[row]}: {problem}")
    for text in table["object"].unique().drop_null().to_pylist():
        try:
            object_from_json(text)
        except ShapeError as error:
            row = table["object"].to_pylist().index(text)
            yield Finding(name, f"interaction {ids[row]}: its object cannot be read: {error}")


def _out_of_range(name: str, table: pa.Table, manifest: dict) -> Iterator[Finding]:
    """What is drawn anew for every interaction, outside of the range that the configuration gives."""
    ranges = manifest["configuration"].get("randomisation") or {}
    ranges = {column: drawn for column, drawn in ranges.items() if drawn is not None}
    drawn_columns = [f.name for f in table.schema if pa.types.is_floating(f.type) and f.name in ranges]
    columns = {column: table[column].to_numpy() for column in drawn_columns}
    try:
        columns |= parameter_values(table)
        nominal = ToolPath(**manifest["configuration"].get("path", {})).parameters()["speed"]
    except (ActionError, TypeError):
        return
    for column in ranges.keys() & columns.keys():
        drawn, values = ranges[column], columns[column]
        low, high = (-drawn, drawn) if isinstance(drawn, int | float) else drawn
        if column == "speed":  # drawn as a multiple of the configured path's
            values = np.round(values / nominal, 9)
        for row in np.flatnonzero((values < low) | (values > high)):
            who = f"interaction {table['id'][int(row)]}"
            yield Finding(name, f"{who}: {column} = {values[row]:g} was not drawn from {low:g} to {high:g}")


def _without_gaps(ids: Iterable[int], start: int, stop: int) -> bool:
    found = sorted(set(ids))
    return len(found) == stop - start > 0 and found[0] == start and found[-1] == stop - 1


def _unsound_notes(path: Path | Url, ids: Iterable[int]) -> Iterator[Finding]:
    """Notes beside recordings that are missing or damaged."""
    for id in ids:
        try:
            recorded.read_notes(path, id)
        except DatasetError as error:
            yield Finding(f"{recorded.NOTES_FOLDER}/{id:05d}.json", str(error))


def _unsound_ids(ids: dict[str, list[int]], manifest: dict, remedy: str) -> Iterator[Finding]:
    """Duplicate ids, ids in the wrong shard, and shards that are still to come."""
    size, num_trials = manifest["shard_size"], manifest["num_trials"]
    starts = {storage.shard_name(k): start for k, start in enumerate(range(0, num_trials, size))}
    seen: set[int] = set()
    for name, found in ids.items():
        counts = Counter(found)
        if twice := sorted(id for id, count in counts.items() if id in seen or count > 1):
            yield Finding(name, f"duplicate ids {shown(twice)}")
        seen.update(counts)
        if name not in starts:
            yield Finding(name, f"does not belong to a data set of {num_trials} interactions; remove it")
        elif not _without_gaps(counts, starts[name], min(starts[name] + size, num_trials)):
            yield Finding(name, f"its ids do not run from {starts[name]} on without gaps")
    for name in starts:
        if name not in ids:
            yield Finding(name, f"not there; {remedy}")
