"""Recorded pushes as interactions of a data set, each known at its two ends alone."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from foretrace.actions import Motion
from foretrace.errors import ActionError, DatasetError, ViewError
from foretrace.files import first_stranger, make_folder, sole_writer, versions_of
from foretrace.geometry import matrix_to_pose, planar_transform, quaternion_to_matrix
from foretrace.interactions import storage
from foretrace.interactions.pushes import RecordedPushes
from foretrace.interactions.record import Effect, Interaction, Physics, Provenance
from foretrace.interactions.shards import write_shard
from foretrace.interactions.topdown import TopDownView

CONFIGURATION = {"source": "recorded", "table": "pushes"}
SHARD_SIZE = 100
"""Interactions of a shard."""
PERIOD = 0.05
"""The common time of all ends is a multiple of this [s]."""
TABLE_FRICTION, ROD_FRICTION = 0.2, 0.2
"""Nominal friction coefficients: they are not measured."""


def end_time(pushes: RecordedPushes) -> float:
    """Time after which every push has ended and its object rests [s]; all of them are recorded until then."""
    length = np.linalg.norm(pushes.motion, axis=1)
    return float(np.ceil((length / pushes.speed).max() / PERIOD + 10) * PERIOD)


def push_interaction(pushes: RecordedPushes, row: int, end: float, id: int) -> Interaction | None:
    """The interaction of one recorded push; None where it can have none.

    It has none where the rod passes the object, the object leaves the view, or the path is out of its range.

    Args:
        pushes: The pushes.
        row: Number of the push.
        end: Time of its second sample, as `end_time` gives it [s].
        id: Number of the interaction in its data set.
    """
    action = pushes.action(row)
    if action is None:
        return None
    try:
        view = TopDownView.of(pushes.shapes[pushes.shape[row]].model, action)
    except ViewError:
        return None
    path = action.path
    try:
        action = replace(action, path=replace(path, hold_time=path.hold_time + end - path.duration))
    except ActionError:
        return None
    shape = pushes.shapes[pushes.shape[row]]
    x, y, turn = pushes[[row]].displacement()[0]
    rest = action.T_action_object
    object_pose = matrix_to_pose(np.stack([rest, rest @ planar_transform(np.array([x, y]), turn)]))
    times = np.array([0.0, end])
    tool_pose = np.zeros((2, 7))
    tool_pose[:, 0], tool_pose[:, 2] = action.tool_motion(times)[:, 0], path.clearance
    tool_pose[:, [3, 5]] = np.sqrt(0.5)  # the rod points down
    physics = Physics(density=shape.density, friction=TABLE_FRICTION, tool_friction=ROD_FRICTION)
    com = object_pose[:, :3] + quaternion_to_matrix(object_pose[:, 3:]) @ shape.model.mass_properties(1.0).com
    motion = Motion(times, object_pose, tool_pose, np.empty((2, 0)))
    made = Provenance(
        source="recorded",
        engine="",
        embodiment="tool",
        timestep=0.0,
        sample_period=end,
        versions=versions_of("foretrace"),
    )
    effect = Effect.judged(motion, shape.model, action, com)
    return Interaction(shape.model, action, view, effect, physics, made, id=id)


def write_pushes(
    pushes: RecordedPushes, folder: Path, progress: Callable[[int], Any] = lambda count: None
) -> tuple[int, int]:
    """Writes recorded pushes as a new data set.

    Args:
        pushes: The pushes.
        folder: A new folder.
        progress: Called with the number of pushes of each part that is written.

    Returns:
        Number of interactions, and of pushes that have none and are left out.

    Raises:
        DatasetError: The folder is not empty.
    """
    # An import that was stopped leaves shards without a manifest, and begins anew.
    stranger = storage.MANIFEST if (folder / storage.MANIFEST).exists() else None
    if stranger := stranger or first_stranger(folder, (storage.SHARD_FOLDER,)):
        raise DatasetError(f"{folder} holds {stranger}: choose a new folder")
    make_folder(folder / storage.SHARD_FOLDER, DatasetError)
    end, id, missed = end_time(pushes), 0, 0
    shards, rows = {}, []
    with sole_writer(folder, DatasetError):
        for row in range(len(pushes)):
            interaction = push_interaction(pushes, row, end, id)
            missed += interaction is None
            if interaction is not None:
                rows.append(storage.encode(interaction, int(pushes.shape[row])))
                id += 1
            if len(rows) == SHARD_SIZE or (rows and row == len(pushes) - 1):
                name = storage.shard_name(len(shards))
                shards[name] = write_shard(folder, name, storage.to_table(rows))
                progress(len(rows))
                rows = []
        if id == 0:
            raise DatasetError(
                "none of the pushes can be kept: the rod passes each object, or leaves the view"
            )
        manifest = storage.new_manifest(CONFIGURATION, id, SHARD_SIZE, versions_of("foretrace", "numpy"))
        storage.write_manifest(folder, manifest | {"shards": shards})
    return id, missed
