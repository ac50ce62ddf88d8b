"""Data sets of recorded interactions, which grow one by one; read by `Dataset.open` like any other."""

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from foretrace.errors import DatasetError
from foretrace.files import (
    first_stranger,
    make_folder,
    read_json,
    remove_partial,
    short_hash,
    sole_writer,
    write_json,
)
from foretrace.interactions import storage
from foretrace.interactions.record import Interaction
from foretrace.interactions.shards import shard_content, write_shard
from foretrace.schema import Finite, Transform
from foretrace.urls import Url

CONFIGURATION = {"source": "recorded"}
OBJECTS = "objects"
"""Entry of the manifest with the number of each object, by the hash of its description."""
REPEAT = "import the recording again"
"""Remedy for damaged notes."""
NOTES_FOLDER = "recordings"
"""Folder with a JSON file for each interaction: its camera, and how well it was seen."""


class Notes(TypedDict):
    """Schema of those files: what they hold at least."""

    recording: str
    """Path of the recording, seen from the data set."""
    recording_path: NotRequired[str]
    """Its absolute path."""
    topic: NotRequired[str | None]
    """Topic of its images that was asked for, of a bag."""
    camera: dict[str, Any]
    """Its camera."""
    T_action_camera: Transform
    """Pose of the camera in the action frame."""
    start: Finite
    """Time stamp at which the action starts [s]."""
    frame_times: list[Finite]
    """Time stamp of each frame [s]."""


def read_notes(folder: Path | Url, id: int) -> Notes:
    """What is kept beside a recorded interaction.

    Raises:
        DatasetError: There is no such interaction, or its file is damaged.
    """
    path = folder / NOTES_FOLDER / f"{id:05d}.json"
    if not path.is_file():
        raise DatasetError(f"{folder} has no recording {id}: give a data set that `foretrace import` made")
    return read_json(path, Notes, DatasetError, REPEAT)


def place_of(recording: Path, folder: Path) -> dict[str, str]:
    """What the notes of a data set in a folder say about where a recording lies."""
    here = recording.resolve()
    try:
        seen_from = Path(os.path.relpath(here, folder.resolve())).as_posix()
    except ValueError:  # on another drive
        seen_from = str(here)
    return {"recording": seen_from, "recording_path": str(here)}


def find_recording(folder: Path, notes: Mapping[str, Any]) -> Path:
    """The recording that an interaction is from, seen from its data set or where it was when it was imported.

    Args:
        folder: The data set's folder.
        notes: What `read_notes` gives. Older ones name the recording as it was named to `import`, seen from a folder
            that may be above the data set.

    Raises:
        DatasetError: It is at none of these places.
    """
    noted = Path(notes["recording"])
    above = [parent / noted for parent in folder.resolve().parents]
    places = [folder / noted, Path(notes.get("recording_path", noted)), noted, *above]
    found = next((place for place in places if place.exists()), None)
    if found is None:
        raise DatasetError(
            f"the recording is no longer at {places[0]} or {places[1]}: say where it is with --recording"
        )
    return found


def find_recorded(folder: Path, interaction: Interaction, notes: Mapping[str, Any]) -> int | None:
    """Number of an interaction in a data set of recordings; None: it is not there.

    It is there if an import is repeated that was stopped after its last write. The same recording read in another way,
    as another object or at another contact, is another interaction.

    Args:
        folder: The data set's folder.
        interaction: What was recorded.
        notes: What would be kept beside it.

    Raises:
        DatasetError: The data set is damaged.
    """
    manifest = storage.read_manifest(folder) if (folder / storage.MANIFEST).is_file() else {}
    object_id = manifest.get(OBJECTS, {}).get(_object_key(interaction))
    if object_id is None:
        return None
    wanted = _without_place(json.loads(json.dumps(notes)))
    for id in range(manifest["num_trials"]):
        path = folder / NOTES_FOLDER / f"{id:05d}.json"
        if path.is_file() and _without_place(read_json(path, dict[str, Any], DatasetError, REPEAT)) == wanted:
            row = storage.to_table([storage.encode(replace(interaction, id=id), object_id)])
            name = storage.shard_name(id)
            there, _ = storage.read_shard(folder, name, manifest["shards"].get(name, {}).get("sha256"))
            if shard_content(there) == shard_content(row):  # as this version writes both
                return id
    return None


def _object_key(interaction: Interaction) -> str:
    return short_hash([json.dumps(interaction.object.to_dict()).encode()])


def _without_place(notes: Mapping[str, Any]) -> dict[str, Any]:
    """Notes without where the recording lay: it may have been moved."""
    return {name: value for name, value in notes.items() if name not in ("recording", "recording_path")}


def add_recorded(folder: Path, interaction: Interaction, notes: Mapping[str, Any]) -> int:
    """Adds an interaction to a data set of recordings, which is begun if there is none; returns its id.

    Args:
        folder: The data set's folder.
        interaction: What was recorded; it gets the next free id.
        notes: What is kept beside it, JSON-able.

    Raises:
        DatasetError: The folder holds something else, or a simulated data set.
    """
    if not (folder / storage.MANIFEST).is_file() and not _is_beginning(folder):
        raise DatasetError(f"{folder} is no data set and not empty: choose a new folder")
    for name in (storage.SHARD_FOLDER, NOTES_FOLDER):
        make_folder(folder / name, DatasetError)
    with sole_writer(folder, DatasetError):
        for place in (folder, folder / storage.SHARD_FOLDER, folder / NOTES_FOLDER):
            remove_partial(place)
        if (folder / storage.MANIFEST).is_file():
            manifest = storage.read_manifest(folder)
        else:
            manifest = storage.new_manifest(CONFIGURATION, 0, 1, interaction.provenance.versions)
        if manifest["configuration"] != CONFIGURATION:
            raise DatasetError(
                f"{folder} holds simulated interactions: keep recordings in a folder of their own"
            )
        id = manifest["num_trials"]
        objects = manifest.setdefault(OBJECTS, {})
        object_id = objects.setdefault(_object_key(interaction), len(objects))
        table = storage.to_table([storage.encode(replace(interaction, id=id), object_id)])
        path = folder / NOTES_FOLDER / f"{id:05d}.json"
        write_json(path, dict(notes))
        name = storage.shard_name(id)
        manifest["shards"][name] = write_shard(folder, name, table)
        manifest["num_trials"] = id + 1
        storage.write_manifest(folder, manifest)
    return id


def _is_beginning(folder: Path) -> bool:
    """Whether a folder is new, or holds what an import leaves that was stopped before it wrote the manifest."""
    shards, notes = folder / storage.SHARD_FOLDER, folder / NOTES_FOLDER
    first = Path(storage.shard_name(0)).name
    return (
        first_stranger(folder, (storage.SHARD_FOLDER, NOTES_FOLDER)) is None
        and first_stranger(notes, (f"{0:05d}.json",)) is None
        # Its notes are written before its shard: without them, the shard is of a simulation that lost its manifest.
        and first_stranger(shards, (first,) if (notes / f"{0:05d}.json").is_file() else ()) is None
    )


def numbered(objects: Mapping[str, int]) -> dict[str, int]:
    """The manifest's entry `OBJECTS` from numbers of objects by their descriptions."""
    return {short_hash([description.encode()]): number for description, number in objects.items()}
