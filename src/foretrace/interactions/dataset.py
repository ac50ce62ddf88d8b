"""Interactions in memory: `Dataset` reads them from disk, `InteractionBatch` is what learners read."""

import json
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from jaxtyping import Bool, Float, Int

from foretrace.actions import ACTIONS, FAILED, action_transform
from foretrace.errors import DatasetError
from foretrace.interactions import storage
from foretrace.interactions.record import Interaction
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel, object_from_dict


@dataclass(frozen=True)
class InteractionBatch:
    """Many interactions as arrays, in the action frame; what every feature and predictor reads."""

    ids: Int[np.ndarray, " batch"]
    """Number of each interaction within its data set."""
    mask: Bool[np.ndarray, "batch 128 128"]
    """Top-down masks."""
    height: Float[np.ndarray, "batch 128 128"]
    """Top-down height maps [m], 0 outside the object."""
    corners: Float[np.ndarray, "batch corners 2"]
    """Corners of each object in the action frame at rest [m], counter-clockwise, NaN-padded."""
    num_corners: Int[np.ndarray, " batch"]
    """How many of them each object has."""
    object_ids: Int[np.ndarray, " batch"]
    """Which object was levered: equal numbers are the same object."""
    times: Float[np.ndarray, " time"]
    """Sample times [s], common to all."""
    com: Float[np.ndarray, "batch time 3"]
    """Centre-of-mass trajectories [m]; NaN past the end of a shorter one."""
    pose: Float[np.ndarray, "batch time 7"]
    """Pose trajectories of the object frame: position [m], quaternion (w, x, y, z)."""
    length: Int[np.ndarray, " batch"]
    """Number of valid samples of each trajectory."""
    slip_index: Int[np.ndarray, " batch"]
    """First sample off the tool after having been lifted; ``length`` where that never happened."""
    support_points: Float[np.ndarray, "batch 2 2"]
    """Observed support points in the action frame [m]; NaN where not observed."""
    outcome: np.ndarray
    """(batch,) array of outcome names (str)."""
    parameters: dict[str, np.ndarray]
    """(batch,) arrays by name [SI]: physical constants as in `Physics`, and parameters of the actions; NaN where an
    interaction has no such one."""

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, rows: Any) -> "InteractionBatch":
        """The given rows (slice, index array or boolean array) as a batch; ``times`` stays common to all."""
        kept = {
            f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name not in ("times", "parameters")
        }
        parameters = {name: values[rows] for name, values in self.parameters.items()}
        return replace(self, **kept, parameters=parameters)

    @classmethod
    def from_interactions(cls, interactions: Sequence[Interaction]) -> "InteractionBatch":
        """Interactions as arrays; objects that are equal get equal ``object_ids``, counted from 0.

        Raises:
            DatasetError: Two of them were sampled at different times.
        """
        descriptions = [json.dumps(interaction.object.to_dict()) for interaction in interactions]
        numbers = {description: k for k, description in enumerate(dict.fromkeys(descriptions))}
        rows = [
            storage.encode(interaction, numbers[description])
            for interaction, description in zip(interactions, descriptions, strict=True)
        ]
        known = dict(zip(descriptions, (interaction.object for interaction in interactions), strict=True))
        return _batch(storage.to_table(rows), known)

    @classmethod
    def from_views(
        cls,
        views: Sequence[TopDownView],
        times: Float[np.ndarray, " time"] | None = None,
        corners: Sequence[Float[np.ndarray, "_ 2"]] | None = None,
    ) -> "InteractionBatch":
        """Actions whose effect is still to be imagined: everything that was not observed is NaN, or empty.

        Args:
            views: What the camera sees of each object, in the action frame.
            times: Times at which the effect will be imagined [s]; by default none.
            corners: Corners of each object in the action frame [m], if known.
        """
        n, times = len(views), np.zeros(0) if times is None else times
        corners = [np.zeros((0, 2))] * n if corners is None else corners
        return cls(
            ids=np.arange(n),
            mask=np.array([view.mask for view in views], dtype=bool).reshape(n, *_VIEW_SHAPE),
            height=np.array([view.height for view in views], dtype=np.float32).reshape(n, *_VIEW_SHAPE),
            corners=_padded(corners, 2),
            num_corners=np.array([len(c) for c in corners], dtype=np.int64),
            object_ids=np.arange(n),
            times=times,
            com=np.full((n, len(times), 3), np.nan),
            pose=np.full((n, len(times), 7), np.nan),
            length=np.zeros(n, dtype=np.int64),
            slip_index=np.zeros(n, dtype=np.int64),
            support_points=np.full((n, 2, 2), np.nan),
            outcome=_outcome_array([""] * n),
            parameters={},
        )


class Dataset:
    """Interactions in the order of their ids; open one with `Dataset.open`.

    ``dataset[3]`` is the fourth interaction; ``dataset[10:20]`` and ``dataset[indices]`` are data sets again.
    """

    def __init__(self, table: pa.Table, manifest: Mapping[str, Any], path: Path):
        self.table = table
        """The rows as a pyarrow table; `storage.COLUMNS` explains its columns."""
        self.manifest = manifest
        """What the folder says about itself: configuration, versions, units, shards."""
        self.path = path
        """The folder that it was read from."""
        self._objects: dict[str, ObjectModel] = {}

    @classmethod
    def open(cls, path: str | Path, failed: bool = False) -> "Dataset":
        """Read a data set, whole, into memory; checksums are verified on the way.

        Args:
            path: The folder written by ``foretrace simulate``.
            failed: Keep the failed simulations too; they have no effect to learn from.

        Raises:
            DatasetError: Nothing there, another format version, or a missing or corrupt shard.
        """
        path = Path(path)
        manifest = storage.read_manifest(path)
        shards = sorted(manifest["shards"].items())
        tables = [storage.read_shard(path, name, entry.get("sha256"))[0] for name, entry in shards]
        if missing := storage.missing_shards(manifest):
            warnings.warn(
                f"{path} is not finished: {len(missing)} of {len(missing) + len(shards)} shards are missing; "
                "the same `foretrace simulate` command goes on where it stopped",
                stacklevel=2,
            )
        dataset = cls(pa.concat_tables([storage.SCHEMA.empty_table(), *tables]), manifest, path)
        return dataset if failed else dataset.where(outcome=lambda outcome: outcome != FAILED)

    def __len__(self) -> int:
        return self.table.num_rows

    def __getitem__(self, rows: Any) -> Any:
        if isinstance(rows, int | np.integer):
            if not -len(self) <= rows < len(self):
                raise IndexError(f"interaction {rows} of {len(self)}")
            row = self.table.slice(rows % len(self), 1).to_pylist()[0]
            return storage.decode(row, self._object(row["object"]))
        return self._view(np.arange(len(self))[rows])

    def __iter__(self) -> Iterator[Interaction]:
        return (self[k] for k in range(len(self)))

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
                kept &= np.asarray(wanted(column), dtype=bool)
                continue
            several = isinstance(wanted, list | tuple | set | frozenset | range | np.ndarray)
            values = list(wanted) if several else [wanted]
            if name == "outcome" and (
                odd := [value for value in values if value not in self._outcome_names()]
            ):
                raise DatasetError(f"no outcome {odd[0]!r}: choose from {', '.join(self._outcome_names())}")
            kept &= np.isin(column, values)
        return self if kept.all() else self._view(np.flatnonzero(kept))

    def with_id(self, id: int) -> Interaction:
        """The interaction of that number.

        Raises:
            DatasetError: It is not among these.
        """
        found = np.flatnonzero(self.table["id"].to_numpy() == id)
        if len(found) == 0:
            raise DatasetError(f"{self.path} has no interaction {id} among the {len(self)} selected")
        return self[found[0]]

    def batch(self) -> InteractionBatch:
        """All of them as arrays.

        Raises:
            DatasetError: Two of them were sampled at different times.
        """
        for description in self.table["object"].unique().to_pylist():
            self._object(description)
        return _batch(self.table, self._objects)

    def to_pandas(self) -> pd.DataFrame:
        """The rows as a data frame, trajectories flattened, images packed."""
        return self.table.to_pandas()

    def outcomes(self) -> dict[str, int]:
        """Number of interactions with each outcome that occurs, in the order in which actions name them."""
        return count_outcomes(self.table["outcome"].to_pylist())

    def _outcome_names(self) -> list[str]:
        """Outcomes that its actions can have, and any other that it holds."""
        known = [
            name
            for label in self.table["action"].unique().to_pylist()
            for name in ACTIONS.find(label).outcomes
        ]
        return list(dict.fromkeys([*known, FAILED, *self.table["outcome"].unique().to_pylist()]))

    def _column(self, name: str) -> np.ndarray:
        """A column of single values, or a parameter of the actions."""
        scalars = [f.name for f in storage.SCHEMA if not pa.types.is_nested(f.type)]
        if name in scalars:
            return self.table[name].to_numpy()
        if name not in self._parameters:
            names = ", ".join([*scalars, *self._parameters])
            raise DatasetError(f"no column {name!r} to filter by; there are {names}")
        return self._parameters[name]

    @cached_property
    def _parameters(self) -> dict[str, np.ndarray]:
        return storage.parameter_values(self.table)

    def _view(self, rows: np.ndarray) -> "Dataset":
        view = Dataset(self.table.take(pa.array(rows, type=pa.int64())), self.manifest, self.path)
        view._objects = self._objects
        return view

    def _object(self, description: str) -> ObjectModel:
        if description not in self._objects:
            self._objects[description] = object_from_dict(json.loads(description))
        return self._objects[description]


def count_outcomes(outcomes: Sequence[str]) -> dict[str, int]:
    """Number of times that each outcome occurs, in the order in which actions name them."""
    counts = Counter(map(str, outcomes))
    known = [str(name) for action in ACTIONS.values() for name in action.outcomes]
    return {name: counts[name] for name in dict.fromkeys([*known, FAILED, *counts]) if counts[name]}


_VIEW_SHAPE = (storage.VIEW_SIZE, storage.VIEW_SIZE)


def _outcome_array(outcomes: Sequence[str]) -> np.ndarray:
    """Names as an array whose width, and so its bytes, does not depend on which of a lever-up's outcomes occur."""
    return np.array(outcomes, dtype=f"<U{max(8, *map(len, outcomes), 0)}")


def _padded(arrays: Sequence[np.ndarray], width: int, longest: int | None = None) -> np.ndarray:
    """(n, longest, width) from arrays of (k, width), NaN past the end of each."""
    longest = max((len(a) for a in arrays), default=0) if longest is None else longest
    padded = np.full((len(arrays), longest, width), np.nan)
    for k, array in enumerate(arrays):
        padded[k, : len(array)] = array
    return padded


def _lists(table: pa.Table, name: str, width: int) -> list[np.ndarray]:
    """A list column as one (k, width) array per row, without a copy."""
    column = table[name].combine_chunks()
    flat, offsets = column.values.to_numpy(zero_copy_only=False), column.offsets.to_numpy()
    return [flat[a:b].reshape(-1, width) for a, b in pairwise(offsets)]


def _common_times(table: pa.Table) -> tuple[np.ndarray, np.ndarray]:
    """The longest row's sample times, and how many samples each row has."""
    times = [row[:, 0] for row in _lists(table, "times", 1)]
    length = np.array([len(row) for row in times], dtype=np.int64)
    longest = max(times, key=len, default=np.zeros(0)).copy()
    for id, row in zip(table["id"].to_pylist(), times, strict=True):
        if not np.allclose(row, longest[: len(row)], rtol=0, atol=1e-9):
            raise DatasetError(f"interaction {id} was sampled at other times than the rest; batch it apart")
    return longest, length


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


def _batch(table: pa.Table, objects: Mapping[str, ObjectModel]) -> InteractionBatch:
    times, length = _common_times(table)
    corners = _corners_in_action(table, objects)
    slip_index = table["slip_index"].to_numpy()
    constants = {name: table[name].to_numpy().astype(float) for name in storage.PHYSICS_COLUMNS}
    return InteractionBatch(
        ids=table["id"].to_numpy(),
        mask=storage.unpack_masks(table["mask"].to_pylist()),
        height=storage.unpack_heights(table["height"].to_pylist()),
        corners=_padded(corners, 2),
        num_corners=np.array([len(c) for c in corners], dtype=np.int64),
        object_ids=table["object_id"].to_numpy(),
        times=times,
        com=_padded(_lists(table, "com_trajectory", 3), 3, len(times)),
        pose=_padded(_lists(table, "pose_trajectory", 7), 7, len(times)),
        length=length,
        slip_index=np.where(np.isnan(slip_index.astype(float)), length, slip_index).astype(np.int64),
        support_points=np.array(_lists(table, "support_points", 2)).reshape(-1, 2, 2),
        outcome=_outcome_array(table["outcome"].to_pylist()),
        parameters=constants | storage.parameter_values(table),
    )
