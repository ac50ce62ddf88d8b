"""Data sets of format version 1, upgraded in place."""

import json
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from foretrace.actions import LeverUp, Screwdriver, ToolPath
from foretrace.errors import ActionError, DatasetError, shown
from foretrace.files import as_path, remove_partial, sole_writer
from foretrace.interactions import recorded, storage
from foretrace.interactions.record import ExecutionOffset, Physics, Provenance
from foretrace.interactions.shards import write_shard

OLD_EXECUTION = "misplaced_"
"""Beginning of the names that version 1 gave to execution errors."""
OLD_PARAMETERS = LeverUp.nominal_parameters()
"""Columns of version 1 that its path has now, and their values where an early data set lacks them."""
EXECUTION_COLUMNS = tuple(storage.EXECUTION + field.name for field in fields(ExecutionOffset))
EARLY: dict[str, Any] = {
    "fall_index": None,
    "rolling_friction": Physics.rolling_friction,
    "table_edge": None,
    **{f"{OLD_EXECUTION}{name}": 0.0 for name in ("ahead", "left", "turn")},
    **OLD_PARAMETERS,
}
"""Columns that early data sets of version 1 lack, and their values."""
RANGES = (
    "friction",
    "tool_friction",
    "density",
    "thickness_factor",
    "bevel_width_factor",
    "bevel_height_factor",
    "com_offset",
    "execution_share",
    "distance",
)


def upgrade(path: str | Path) -> int:
    """Bring a data set of format version 1 to today's; nothing is lost if it is interrupted: repeat it.

    All shards are read and converted before the first one is written; then each is replaced as a whole, and the
    manifest at the end. Missing shards stay missing: ``foretrace simulate`` makes them.

    Args:
        path: The data set's folder.

    Returns:
        Number of upgraded interactions; 0 if it is of today's version already.

    Raises:
        DatasetError: There is no data set, or a shard is damaged.
    """
    path = as_path(path, DatasetError)
    storage.read_manifest(path, older=(1,))  # before the lock, which would leave its file in any folder
    with sole_writer(path, DatasetError):
        manifest = storage.read_manifest(path, older=(1,))
        if manifest["format_version"] != 1:
            return 0
        for folder in (path, path / storage.SHARD_FOLDER):
            remove_partial(folder)
        names = [name for name in sorted(manifest["shards"]) if (path / name).exists()]
        for name in names:
            _converted(path, name, manifest)
        objects: dict[str, int] = {}
        shards, rows = {}, 0
        for name in names:
            table, content = _converted(path, name, manifest)
            entry = content and storage.shard_entry(content, table)
            shards[name] = entry or write_shard(path, name, table)
            rows += table.num_rows
            objects |= dict(zip(table["object"].to_pylist(), table["object_id"].to_pylist(), strict=True))
        configuration = _configuration(manifest["configuration"])
        renewed = storage.new_manifest(
            configuration, manifest["num_trials"], manifest["shard_size"], manifest["versions"]
        )
        if configuration == recorded.CONFIGURATION:
            renewed[recorded.OBJECTS] = recorded.numbered(objects)
        storage.write_manifest(path, renewed | {"shards": shards})
    return rows


def _converted(folder: Path, name: str, manifest: Mapping[str, Any]) -> tuple[pa.Table, bytes | None]:
    """A shard in today's form, and its bytes if an interrupted upgrade has written it already."""
    remedy = (
        f"remove the file, upgrade, and `foretrace simulate` makes it again; or restore {folder} from a copy"
    )
    table, content = storage.read_shard(folder, name, schema=None)
    if table.schema.equals(storage.SCHEMA):
        return table, content
    storage.read_shard(folder, name, manifest["shards"][name].get("sha256"), schema=None)
    try:
        rows = [_row(row, manifest["configuration"]) for row in table.to_pylist()]
        return storage.to_table(rows), None
    except (KeyError, TypeError, ValueError, ActionError, pa.ArrowException) as reason:
        raise DatasetError(
            f"shard {folder / name} cannot be upgraded ({shown(reason)}): {remedy}"
        ) from reason


def _row(row: dict[str, Any], configuration: Mapping[str, Any]) -> dict[str, Any]:
    """A row of version 1 with today's columns."""
    row = EARLY | row
    simulation = configuration.get("simulation", {})
    path = _path(row, ToolPath(**simulation.get("path", {})), configuration.get("randomisation") or {})
    tool = Screwdriver(**simulation.get("tool", {}))
    settings = asdict(Provenance()) | simulation
    if row["source"] != "simulated":
        settings |= {"camera": row["source"], "timestep": 0.0}
    return {
        **{name: value for name, value in row.items() if name in storage.COLUMNS},
        **{name: settings[name] for name in ("camera", "timestep", "sample_period", "watch_time")},
        **{name: row[name.replace(storage.EXECUTION, OLD_EXECUTION)] for name in EXECUTION_COLUMNS},
        "action": LeverUp.label,
        "path": json.dumps(asdict(path)),
        "tool": json.dumps(tool.to_dict()),
    }


def _path(row: Mapping[str, Any], configured: ToolPath, randomisation: Mapping[str, Any]) -> ToolPath:
    """The path of a row: as configured, but with the row's own parameters."""
    path = replace(configured, **{name: row[name] for name in ("insertion", "arc_radius", "sweep")})
    if (speeds := randomisation.get("speed")) is None:
        if row["source"] == "simulated" or row["speed"] == configured.parameters()["speed"]:
            return path
        return path.faster(row["speed"] / configured.parameters()["speed"])
    faster = path.faster(row["speed"] / configured.parameters()["speed"])
    # All of a data set's paths end when the slowest one does.
    rest = path.faster(speeds[0]).duration - faster.duration
    return replace(faster, hold_time=path.hold_time + rest)


def _configuration(old: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of a simulated data set in today's form; that of recordings stays as it is."""
    new = deepcopy(dict(old))
    if "simulation" not in new:
        return new
    simulation = new["simulation"]
    for name, default in (("path", asdict(ToolPath())), ("tool", asdict(Screwdriver()))):
        new[name] = default | simulation.pop(name, {})
    simulation["watch_time"] = simulation.get("watch_time", 0.0)
    simulation["physics"] = asdict(Physics()) | simulation.get("physics", {})
    new["recipe"] = new.get("recipe", "paper")
    ranges = new.get("randomisation") or {}
    renamed = {name.replace(OLD_EXECUTION, storage.EXECUTION): value for name, value in ranges.items()}
    none = dict.fromkeys((*RANGES, *OLD_PARAMETERS)) | {
        f"{storage.EXECUTION}{n}": 0.0 for n in ("ahead", "left", "turn")
    }
    new["randomisation"] = none | renamed
    return new
