"""From the rows of stored interactions to arrays."""

from collections.abc import Iterable, Mapping
from itertools import pairwise

import numpy as np
import pyarrow as pa
from jaxtyping import Float

from foretrace.actions import action_transform
from foretrace.errors import DatasetError
from foretrace.interactions import storage
from foretrace.interactions.batch import InteractionBatch, outcome_array, padded
from foretrace.objects import ObjectModel, Weighted


def common_times(tables: Iterable[pa.Table]) -> Float[np.ndarray, " time"]:
    """Sample times [s] of the longest interaction in some tables, with which all others agree.

    Raises:
        DatasetError: Two of them were sampled at different times.
    """
    found: dict[bytes, tuple[int, np.ndarray]] = {}  # an interaction of each kind of times
    for table in tables:
        for id, row in zip(table["id"].to_pylist(), _lists(table, "times", 1), strict=True):
            found.setdefault(row.tobytes(), (id, row[:, 0].copy()))
    longest = max((row for _, row in found.values()), key=len, default=np.zeros(0))
    for id, row in found.values():
        if not np.allclose(row, longest[: len(row)], rtol=0, atol=1e-9):
            raise DatasetError(f"interaction {id} was sampled at other times than the rest; batch it apart")
    return longest


def batch_of(
    table: pa.Table,
    objects: Mapping[str, ObjectModel],
    times: np.ndarray,
    parameters: Mapping[str, np.ndarray],
) -> InteractionBatch:
    """Stored interactions as arrays.

    Args:
        table: Their rows.
        objects: The objects by their descriptions.
        times: Their `common_times` [s].
        parameters: Parameters of their actions, as `parameter_values` finds them.
    """
    length = np.diff(table["times"].combine_chunks().offsets.to_numpy()).astype(np.int64)
    corners = _corners_in_action(table, objects)
    slip_index = table["slip_index"].to_numpy()
    constants = {name: table[name].to_numpy().astype(float) for name in storage.PHYSICS_COLUMNS}
    execution = _execution(table)
    constants["contact_error"] = np.hypot(execution[:, 0], execution[:, 1])
    constants["com_offset"] = _com_offsets(table, objects)
    return InteractionBatch(
        ids=table["id"].to_numpy(),
        mask=storage.unpack_masks(table["mask"].to_pylist()),
        height=storage.unpack_heights(table["height"].to_pylist()),
        corners=padded(corners, 2),
        num_corners=np.array([len(c) for c in corners], dtype=np.int64),
        object_ids=table["object_id"].to_numpy(),
        times=times,
        com=padded(_lists(table, "com_trajectory", 3), 3, len(times)),
        pose=padded(_lists(table, "pose_trajectory", 7), 7, len(times)),
        length=length,
        slip_index=np.where(np.isnan(slip_index.astype(float)), length, slip_index).astype(np.int64),
        support_points=np.array(_lists(table, "support_points", 2)).reshape(-1, 2, 2),
        outcome=outcome_array(table["outcome"].to_pylist()),
        execution=execution,
        bevel=np.array([_bevel(objects[each]) for each in table["object"].to_pylist()]).reshape(-1, 2),
        parameters=constants | dict(parameters),
    )


def _execution(table: pa.Table) -> Float[np.ndarray, "batch 3"]:
    """Executed actions relative to the commanded ones; NaN for recordings, where that was not measured."""
    columns = [table[storage.EXECUTION + name].to_numpy().astype(float) for name in ("ahead", "left", "turn")]
    simulated = np.array([source == "simulated" for source in table["source"].to_pylist()], dtype=bool)
    return np.where(simulated[:, None], np.column_stack(columns), np.nan)


def _bevel(obj: ObjectModel) -> tuple[float, float]:
    """Width and height of an object's bevel [m]."""
    own = getattr(obj.object if isinstance(obj, Weighted) else obj, "bevel", None)
    return (np.nan, np.nan) if own is None else (own.width, own.height)


def _com_offsets(table: pa.Table, objects: Mapping[str, ObjectModel]) -> Float[np.ndarray, " batch"]:
    """Distances of the centres of mass from those of uniform objects [m]."""
    known = [objects[description] for description in table["object"].to_pylist()]
    offsets = [obj.com_offset if isinstance(obj, Weighted) else np.zeros(2) for obj in known]
    return np.linalg.norm(np.array(offsets).reshape(-1, 2), axis=1)


def _corners_in_action(table: pa.Table, objects: Mapping[str, ObjectModel]) -> list[np.ndarray]:
    """Each object's corners in its action's frame at rest [m]."""
    corners = []
    columns = (table[name].to_pylist() for name in ("object", "contact", "direction"))
    for description, contact, direction in zip(*columns, strict=True):
        unit = np.array(direction)
        # Dividing by a length of almost 1 again keeps features as they have always been, to the last bit.
        T_action_object = action_transform(np.array(contact), unit / np.linalg.norm(unit))
        corners.append(objects[description].corners @ T_action_object[:2, :2].T + T_action_object[:2, 3])
    return corners


def _lists(table: pa.Table, name: str, width: int) -> list[np.ndarray]:
    """A list column as one (k, width) array per row, without a copy."""
    column = table[name].combine_chunks()
    flat, offsets = column.values.to_numpy(zero_copy_only=False), column.offsets.to_numpy()
    return [flat[a:b].reshape(-1, width) for a, b in pairwise(offsets)]
