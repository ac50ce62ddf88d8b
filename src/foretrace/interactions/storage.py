"""Interactions on disk: Parquet shards (one row per interaction) and a JSON manifest beside them.

A shard appears under its name only when it is complete (written aside, synchronised, renamed); its checksum
enters the manifest soon after. So a crash at any moment leaves whole shards, the last ones without a checksum.
Positions and angles are kept as float64, exactly as observed; the height map in steps of 0.1 mm.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Meta

from foretrace.actions import FAILED, Action
from foretrace.errors import DatasetError
from foretrace.files import read_versioned, write_json
from foretrace.interactions.record import Effect, ExecutionOffset, Interaction, Physics, Provenance
from foretrace.interactions.topdown import VIEW_SIZE, TopDownView
from foretrace.objects import ObjectModel, object_from_json
from foretrace.schema import MOST, Count, Finite, Vector2, parse_json
from foretrace.urls import Url, is_url

FORMAT = "foretrace-interactions"
FORMAT_VERSION = 2
MANIFEST = "manifest.json"
SHARD_FOLDER = "shards"
HEIGHT_STEP = 1e-4
"""Resolution of stored height maps [m]."""
COMMANDS = {"merged": "merge", "split": "split", "sampled": "sample"}
"""Command of `foretrace data` that makes data sets of others, by what it notes in the configuration."""
MOST_SHARDS = 1_000_000
"""A data set that asks for more shards is a mistake."""


class Configuration(TypedDict, total=False):
    """What shapes the rows of a data set, as far as it is read back."""

    randomisation: dict[str, Finite | Vector2 | None] | None
    """Range of each quantity that is drawn anew, or how far it may be off."""
    path: dict[str, Finite]
    """Parameters of the tool's path."""
    simulation: dict[str, Any]
    """How each action was simulated."""
    made: dict[str, Any]
    """How it was made of other data sets: ``how`` is merged, split or sampled."""


class ShardEntry(TypedDict, total=False):
    """What the manifest says about a shard."""

    sha256: str | None
    """Checksum; missing after an interrupted run."""
    rows: Count
    """Number of rows."""


class Manifest(TypedDict):
    """Schema of the manifest."""

    format_version: int
    configuration: Configuration
    num_trials: Count
    shard_size: Annotated[int, Meta(ge=1, le=MOST)]
    versions: dict[str, str]
    shards: dict[Annotated[str, Meta(pattern=rf"^{SHARD_FOLDER}/shard-\d{{5,}}\.parquet$")], ShardEntry]
    objects: NotRequired[dict[str, Count]]
    """Number of each object of a data set of recordings, by the hash of its description."""


_FLOATS = pa.list_(pa.float64())
COLUMNS: dict[str, tuple[pa.DataType, str, str]] = {
    "id": (pa.int64(), "", "number of the interaction within its data set"),
    "object_id": (pa.int64(), "", "equal numbers are the same object; its thickness and bevel may vary"),
    "num_corners": (pa.int64(), "", "corners of the object's outline"),
    "object": (pa.string(), "m", "the object in its own frame, as JSON"),
    "action": (pa.string(), "", "label of the commanded action"),
    "contact": (_FLOATS, "m", "contact point in the object frame (2)"),
    "direction": (_FLOATS, "", "unit direction of the action in the object frame (2)"),
    "path": (pa.string(), "SI", "parameters of the tool's path, as JSON"),
    "tool": (pa.string(), "m", "the tool and its dimensions, as JSON"),
    "outcome": (pa.string(), "", "what became of the object"),
    "slip_index": (pa.int64(), "", "first sample off the tool after having been lifted, or null"),
    "fall_index": (pa.int64(), "", "first sample falling off the table, or null"),
    "times": (_FLOATS, "s", "sample times"),
    "pose_trajectory": (_FLOATS, "m", "object frame: position, quaternion w x y z (time x 7)"),
    "com_trajectory": (_FLOATS, "m", "centre of mass (time x 3)"),
    "tool_trajectory": (_FLOATS, "m", "tool frame, at its tip: position, quaternion w x y z (time x 7)"),
    "joint_trajectory": (_FLOATS, "rad", "joint angles (time x num_joints)"),
    "num_joints": (pa.int64(), "", "columns of joint_trajectory, 0 when the tool moved alone"),
    "support_points": (_FLOATS, "m", "the two corners turned about (2 x 2), NaN where not observed"),
    "support_corners": (pa.list_(pa.int64()), "", "indices of the corners that stood on the table"),
    "path_error": (pa.float64(), "m", "largest distance of the tool's tip from its planned path"),
    "mask": (pa.binary(), "", "top-down mask, bits packed row by row"),
    "height": (pa.binary(), "0.1 mm", "top-down height map, little-endian uint16 row by row"),
    "metres_per_pixel": (pa.float64(), "m", "scale of mask and height"),
    "density": (pa.float64(), "kg/m^3", "density of the object"),
    "friction": (pa.float64(), "", "friction coefficient between object and table"),
    "tool_friction": (pa.float64(), "", "friction coefficient between object and tool"),
    "rolling_friction": (pa.float64(), "m", "lever arm of the resistance to rolling of a round object"),
    "table_edge": (pa.float64(), "m", "distance of the table's edge ahead of the contact point, or null"),
    "execution_ahead": (pa.float64(), "m", "distance of the executed contact ahead of the commanded one"),
    "execution_left": (
        pa.float64(),
        "m",
        "distance of the executed contact to the left of the commanded one",
    ),
    "execution_turn": (
        pa.float64(),
        "rad",
        "angle of the executed direction to the left of the commanded one",
    ),
    "source": (pa.string(), "", "simulated or recorded"),
    "engine": (pa.string(), "", "physics engine, empty for a recording"),
    "embodiment": (pa.string(), "", "arm or tool"),
    "camera": (pa.string(), "", "how the view was made: exact, grid, rgbd or recorded"),
    "seed": (pa.int64(), "", "seed of this interaction's random draws"),
    "timestep": (pa.float64(), "s", "time step of the simulation, 0 for a recording"),
    "sample_period": (pa.float64(), "s", "time between samples"),
    "watch_time": (pa.float64(), "s", "time of observation after the end of the tool's path"),
    "versions": (pa.string(), "", "versions that shaped the numbers, as JSON"),
}
"""Every column: type, unit, meaning. Vectors are in the action frame unless their meaning says otherwise."""
OPTIONAL_COLUMNS = ("slip_index", "fall_index", "table_edge")
"""Numbers that may be null."""
PHYSICS_COLUMNS = tuple(field.name for field in fields(Physics))
ACTION_COLUMNS = ("action", "contact", "direction", "path", "tool")
PROVENANCE_COLUMNS = tuple(field.name for field in fields(Provenance) if field.name != "versions")
EXECUTION = "execution_"
"""Beginning of the columns of an `ExecutionOffset`."""
_HEIGHTS = (np.arange(65536) * HEIGHT_STEP).astype(np.float32)
"""Height of each number of steps [m]; 200 steps are 0.02 exactly."""
SCHEMA = pa.schema([pa.field(name, kind) for name, (kind, _, _) in COLUMNS.items()])
TRAJECTORIES = {"times": 1, "pose_trajectory": 7, "com_trajectory": 3, "tool_trajectory": 7}
"""Numbers per sample of each trajectory column; the joints' count is a column of its own."""

LARGE_COLUMNS = (*TRAJECTORIES, "joint_trajectory", "support_points", "support_corners", "mask", "height")
LARGE_COLUMNS += ("object", "path", "tool", "versions")
"""Columns of many bytes a row: what is not always at hand."""


def encode(interaction: Interaction, object_id: int) -> dict[str, Any]:
    """One interaction as one row.

    Args:
        interaction: What to store. Of a failed simulation no trajectory is kept.
        object_id: Number of its object; equal numbers are the same object.
    """
    effect, action, view = interaction.effect, interaction.action, interaction.view
    kept = slice(0, 0) if effect.outcome == FAILED else slice(None)
    return {
        "id": interaction.id,
        "object_id": object_id,
        "num_corners": len(interaction.object.corners),
        "object": json.dumps(interaction.object.to_dict()),
        "action": action.label,
        "contact": action.contact,
        "direction": action.direction,
        "path": json.dumps(asdict(action.path)),
        "tool": json.dumps(action.tool.to_dict()),
        "outcome": str(effect.outcome),
        "slip_index": effect.slip_index,
        "fall_index": effect.fall_index,
        **{name: np.ravel(getattr(effect, name)[kept]) for name in (*TRAJECTORIES, "joint_trajectory")},
        "num_joints": effect.joint_trajectory.shape[1],
        "support_points": np.ravel(effect.support_points),
        "support_corners": list(effect.support_corners),
        "path_error": effect.path_error,
        "mask": np.packbits(view.mask).tobytes(),
        "height": np.rint(np.clip(view.height / HEIGHT_STEP, 0, 65535)).astype("<u2").tobytes(),
        "metres_per_pixel": view.metres_per_pixel,
        **asdict(interaction.physics),
        **{EXECUTION + name: value for name, value in asdict(interaction.execution_error).items()},
        **asdict(interaction.provenance),
        "versions": json.dumps(interaction.provenance.versions, sort_keys=True),
    }


def decode(row: Mapping[str, Any], known_object: ObjectModel | None = None) -> Interaction:
    """The interaction in one row; ``known_object`` saves building the same object again."""
    arrays = {name: np.array(row[name], float).reshape(-1, width) for name, width in TRAJECTORIES.items()}
    times = arrays.pop("times")[:, 0]
    effect = Effect(
        times=times,
        **arrays,
        joint_trajectory=np.array(row["joint_trajectory"], float).reshape(len(times), row["num_joints"]),
        support_points=np.array(row["support_points"], float).reshape(2, 2),
        support_corners=tuple(row["support_corners"]),
        outcome=row["outcome"],
        slip_index=row["slip_index"],
        fall_index=row["fall_index"],
        path_error=row["path_error"],
    )
    return Interaction(
        object=known_object if known_object is not None else object_from_json(row["object"]),
        action=decode_action(row),
        view=TopDownView(
            mask=unpack_masks([row["mask"]])[0],
            height=unpack_heights([row["height"]])[0],
            metres_per_pixel=row["metres_per_pixel"],
        ),
        effect=effect,
        physics=Physics(**{name: row[name] for name in PHYSICS_COLUMNS}),
        provenance=Provenance(
            **{name: row[name] for name in PROVENANCE_COLUMNS}, versions=parse_json(row["versions"])
        ),
        execution_error=ExecutionOffset(**{f.name: row[EXECUTION + f.name] for f in fields(ExecutionOffset)}),
        id=row["id"],
    )


def decode_action(row: Mapping[str, Any]) -> Action:
    """The commanded action in one row."""
    place = {name: row[name] for name in ("contact", "direction")}
    settings = {name: parse_json(row[name]) for name in ("path", "tool")}
    return Action.from_dict({"label": row["action"], **place, **settings})


def unpack_masks(packed: Sequence[bytes]) -> np.ndarray:
    """(n, 128, 128) masks from their stored form."""
    bits = np.frombuffer(b"".join(packed), dtype=np.uint8)
    return np.unpackbits(bits).astype(bool).reshape(len(packed), VIEW_SIZE, VIEW_SIZE)


def unpack_heights(packed: Sequence[bytes]) -> np.ndarray:
    """(n, 128, 128) float32 height maps [m] from their stored form."""
    return _HEIGHTS[np.frombuffer(b"".join(packed), dtype="<u2")].reshape(len(packed), VIEW_SIZE, VIEW_SIZE)


def to_table(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Rows from `encode` as one table."""
    columns = [pa.array([row[f.name] for row in rows], type=f.type) for f in SCHEMA]
    return pa.Table.from_arrays(columns, schema=SCHEMA)


def shard_name(index: int) -> str:
    """Name of a shard within the data set's folder, ``shards/shard-00000.parquet``."""
    return f"{SHARD_FOLDER}/shard-{index:05d}.parquet"


def shard_entry(content: bytes, table: pa.Table) -> dict[str, Any]:
    """What the manifest says about a shard."""
    return {"sha256": hashlib.sha256(content).hexdigest(), "rows": table.num_rows}


def read_shard(
    folder: Path | Url,
    name: str,
    sha256: str | None = None,
    schema: pa.Schema | None = SCHEMA,
    columns: Sequence[str] | None = None,
) -> tuple[pa.Table, bytes]:
    """A shard as a table, and its bytes.

    Args:
        folder: The data set's folder, or its URL.
        name: The shard's name in the manifest.
        sha256: The checksum that it must have, or None to accept any.
        schema: The schema that it must have, or None to accept any.
        columns: Columns to read; all by default.

    Raises:
        DatasetError: The file is missing, damaged, or of another schema.
    """
    path = folder / name

    def damaged(problem: str) -> DatasetError:
        return DatasetError(f"shard {path} {problem}; {how_to_restore(folder, path.is_file())}")

    try:
        content = path.read_bytes()
    except OSError as error:
        raise damaged(f"cannot be read ({error.strerror})") from error
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise damaged("is corrupt: its checksum is not the manifest's")
    try:
        # In this thread: another may let go of Python's bytes later than the interpreter can bear, when it ends.
        file = pq.ParquetFile(pa.BufferReader(content))
        table = file.read(columns=None if columns is None else list(columns), use_threads=False)
        table = table.replace_schema_metadata(None)  # an index in it is of this file alone
    except (pa.ArrowException, OSError, ValueError) as error:
        raise damaged(f"is not readable Parquet ({str(error).splitlines()[0]})") from error
    if schema is not None and not file.schema_arrow.equals(schema):
        found, wanted = ({field.name: field.type for field in each} for each in (file.schema_arrow, schema))
        odd = ", ".join(name for name in {**wanted, **found} if found.get(name) != wanted.get(name))
        raise damaged(f"has another schema (differs in {odd})")
    return table, content


def new_manifest(
    configuration: Mapping[str, Any], num_trials: int, shard_size: int, versions: Mapping[str, str]
) -> dict:
    """The manifest of a data set that has no shard yet.

    Args:
        configuration: Everything that shapes the rows, JSON-able.
        num_trials: Interactions in the finished data set.
        shard_size: Interactions per shard.
        versions: Versions of the software that makes the rows.
    """
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "configuration": dict(configuration),
        "num_trials": num_trials,
        "shard_size": shard_size,
        "versions": dict(versions),
        "columns": {
            name: {"type": str(kind), "unit": unit, "meaning": meaning}
            for name, (kind, unit, meaning) in COLUMNS.items()
        },
        "shards": {},
    }


def write_manifest(folder: Path | Url, manifest: Mapping[str, Any]) -> None:
    """Replace the manifest, atomically; shards in the order of their names, whichever was finished first."""
    write_json(folder / MANIFEST, {**manifest, "shards": dict(sorted(manifest["shards"].items()))})


def read_manifest(folder: Path | Url, older: tuple[int, ...] = ()) -> dict[str, Any]:
    """The manifest of a data set.

    Args:
        folder: The data set's folder, or its URL.
        older: Older format versions that are accepted as well.

    Raises:
        DatasetError: No data set is there, its manifest is damaged, or it is of another format version.
    """
    path = folder / MANIFEST
    free = not folder.exists()
    remedy = f"make one with `foretrace simulate --out {folder if free else 'data/NAME'}`"
    if not folder.is_dir() and not free:
        raise DatasetError(f"{folder} is a file: give the folder of a data set, or {remedy}")
    if free:
        raise DatasetError(
            f"no data set at {folder}: no such folder{' or bucket' * is_url(folder)}; {remedy}"
        )
    if not path.is_file():
        raise DatasetError(
            f"{folder} is not a data set: it has no {MANIFEST}; give the folder of one, or {remedy}"
        )
    remedy = "simulate again into a new folder"
    manifest = read_versioned(path, Manifest, FORMAT, FORMAT_VERSION, DatasetError, remedy, older=(1,))
    if manifest["format_version"] not in (FORMAT_VERSION, *older):
        raise DatasetError(
            f"{path} has format version {manifest['format_version']}, this foretrace reads version {FORMAT_VERSION}: "
            f"upgrade it in place with `foretrace data {folder} --upgrade`"
        )
    if manifest["num_trials"] > MOST_SHARDS * manifest["shard_size"]:
        raise DatasetError(
            f"{path}: num_trials {manifest['num_trials']} in shards of {manifest['shard_size']} are more than "
            f"{MOST_SHARDS} shards: {remedy}"
        )
    return dict(manifest)


def how_to_restore(folder: Path | Url, damaged: bool = False) -> str:
    """What to do about a shard that is lost, or there and damaged."""
    with suppress(DatasetError):
        if made := read_manifest(folder)["configuration"].get("made"):
            return f"{COMMANDS.get(str(made.get('how')), 'make')} again into a new folder, or restore a copy"
    aside = damaged and not is_url(folder)
    first = f"set it aside with `foretrace data {folder} --repair`, then " if aside else ""
    return f"{first}repeat the same `foretrace simulate` command"


def missing_shards(manifest: Mapping[str, Any]) -> list[str]:
    """Names of the shards that the finished data set would have and that the manifest does not list yet."""
    count = -(-manifest["num_trials"] // manifest["shard_size"])
    return [name for name in map(shard_name, range(count)) if name not in manifest["shards"]]
