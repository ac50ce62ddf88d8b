"""Is a data set whole and sound? What is not, and what of it can be repaired."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from foretrace.actions import FAILED, ToolPath
from foretrace.errors import ActionError, DatasetError
from foretrace.files import partial_files, remove_partial, sole_writer
from foretrace.interactions import recorded, storage
from foretrace.interactions.dataset import count_outcomes

QUATERNION_TOLERANCE = 1e-6


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


def examine(path: str | Path, repair: bool = False) -> Diagnosis:
    """Check checksums, schema, numbers, ids and stray files of a data set.

    Args:
        path: The data set's folder.
        repair: Remove what an interrupted run left behind, set corrupt shards aside so that
            ``foretrace simulate`` makes them again, and enter whole shards that merely miss their checksum.

    Raises:
        DatasetError: There is no data set, or its manifest cannot be read.
    """
    path = Path(path)
    if not repair:
        return _examine(path, repair=False)
    storage.read_manifest(path)  # before the lock, which would leave its file in any folder
    with sole_writer(path, DatasetError):
        return _examine(path, repair=True)


def _examine(path: Path, repair: bool) -> Diagnosis:
    manifest = storage.read_manifest(path)
    findings = list(_stray_files(path, repair))
    tables: dict[str, pa.Table] = {}
    on_disk = {f.relative_to(path).as_posix() for f in path.glob(f"{storage.SHARD_FOLDER}/shard-*.parquet")}
    for name in sorted(on_disk | set(manifest["shards"])):
        entry = manifest["shards"].get(name, {})
        try:
            table, content = storage.read_shard(path, name, entry.get("sha256"))
        except DatasetError as error:
            findings.append(_set_aside(path, name, manifest, str(error), repair))
            continue
        tables[name] = table
        findings += _unsound_numbers(name, table)
        findings += _out_of_range(name, table, manifest)
        if "sha256" not in entry:
            findings.append(Finding(name, "no checksum in the manifest (an interrupted run)", repair))
            if repair:
                manifest["shards"][name] = storage.shard_entry(content, table)
    findings += _unsound_ids(tables, manifest)
    if repair:
        storage.write_manifest(path, manifest)
    outcomes = [outcome for table in tables.values() for outcome in table["outcome"].to_pylist()]
    return Diagnosis(tuple(findings), len(outcomes), count_outcomes(outcomes))


def _stray_files(path: Path, repair: bool) -> Iterator[Finding]:
    for folder in (path, path / storage.SHARD_FOLDER, path / recorded.NOTES_FOLDER):
        for file in remove_partial(folder) if repair else partial_files(folder):
            yield Finding(str(file.relative_to(path)), "temporary file of an interrupted run", repair)


def _set_aside(path: Path, name: str, manifest: dict, problem: str, repair: bool) -> Finding:
    if repair:
        manifest["shards"].pop(name, None)
        if (path / name).exists():
            (path / name).replace(path / f"{name}.corrupt")
        problem = f"{problem.split(';')[0]}; set aside, `foretrace simulate` makes it again"
    return Finding(name, problem, repair)


def _unsound_numbers(name: str, table: pa.Table) -> Iterator[Finding]:
    """NaN, infinities, wrong lengths and quaternions that are no rotations."""
    scalars = [
        f.name
        for f in storage.SCHEMA
        if pa.types.is_floating(f.type) and f.name not in storage.OPTIONAL_COLUMNS
    ]
    columns = [*storage.TRAJECTORIES, "joint_trajectory", "num_joints", "id", "outcome", *scalars]
    columns += storage.ACTION_COLUMNS
    for row in table.select(columns).to_pylist():
        who = f"interaction {row['id']}"
        num_samples = len(row["times"])
        widths = {**storage.TRAJECTORIES, "joint_trajectory": row["num_joints"]}
        if num_samples == 0 and row["outcome"] != FAILED:
            yield Finding(name, f"{who} has no samples although its outcome is {row['outcome']}")
        try:
            outcomes = storage.decode_action(row).outcomes
        except ActionError as error:
            yield Finding(name, f"{who}: {error}")
        else:
            if row["outcome"] not in (*outcomes, FAILED):
                yield Finding(name, f"{who} has the unknown outcome {row['outcome']!r}")
        for column, width in widths.items():
            values = np.array(row[column], dtype=float)
            if len(values) != num_samples * width:
                yield Finding(name, f"{who}: {column} has {len(values)} numbers for {num_samples} samples")
            elif not np.isfinite(values).all():
                yield Finding(name, f"{who}: {column} holds NaN or infinity")
            elif width == 7:
                norms = np.linalg.norm(values.reshape(-1, 7)[:, 3:], axis=1)
                worst = np.abs(norms - 1).max(initial=0)
                if worst > QUATERNION_TOLERANCE:
                    yield Finding(name, f"{who}: a quaternion of {column} has a norm {worst:.2g} away from 1")
        if unknown := [scalar for scalar in scalars if row[scalar] is None or not np.isfinite(row[scalar])]:
            yield Finding(name, f"{who}: {', '.join(unknown)} is not a number")
        if np.any(np.diff(row["times"]) <= 0):
            yield Finding(name, f"{who}: its times do not rise")


def _out_of_range(name: str, table: pa.Table, manifest: dict) -> Iterator[Finding]:
    """What is drawn anew for every interaction, outside of the range that the configuration gives."""
    ranges = manifest["configuration"].get("randomisation") or {}
    ranges = {column: drawn for column, drawn in ranges.items() if drawn is not None}
    columns = {column: table[column].to_numpy() for column in ranges if column in table.column_names}
    try:
        columns |= storage.parameter_values(table)
        nominal = ToolPath(**manifest["configuration"].get("path", {})).parameters()["speed"]
    except (ActionError, TypeError):
        return  # reported with the numbers
    for column in ranges.keys() & columns.keys():
        drawn, values = ranges[column], columns[column]
        low, high = (-drawn, drawn) if isinstance(drawn, int | float) else drawn
        if column == "speed":  # drawn as a multiple of the configured path's
            values = np.round(values / nominal, 9)
        for row in np.flatnonzero((values < low) | (values > high)):
            who = f"interaction {table['id'][int(row)]}"
            yield Finding(name, f"{who}: {column} = {values[row]:g} was not drawn from {low:g} to {high:g}")


def _unsound_ids(tables: dict[str, pa.Table], manifest: dict) -> Iterator[Finding]:
    """Duplicate ids, ids in the wrong shard, and shards that are still to come."""
    size, num_trials = manifest["shard_size"], manifest["num_trials"]
    starts = {storage.shard_name(k): start for k, start in enumerate(range(0, num_trials, size))}
    seen: set[int] = set()
    for name, table in tables.items():
        ids = table["id"].to_pylist()
        if twice := sorted({id for id in ids if id in seen or ids.count(id) > 1}):
            yield Finding(name, f"duplicate ids {twice}")
        seen.update(ids)
        if name not in starts:
            yield Finding(name, f"does not belong to a data set of {num_trials} interactions; remove it")
        elif sorted(set(ids)) != list(range(starts[name], min(starts[name] + size, num_trials))):
            yield Finding(name, f"its ids do not run from {starts[name]} on without gaps")
    for name in starts:
        if name not in tables:
            yield Finding(name, "not there; the same `foretrace simulate` command makes it")
