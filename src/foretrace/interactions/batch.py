"""Interactions in memory as arrays, and several actions on one object."""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from numbers import Integral
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from foretrace.actions import Action
from foretrace.errors import DatasetError, RowError, check_type, is_whole, shown, wrong_type
from foretrace.geometry import finite_array
from foretrace.interactions.record import Interaction
from foretrace.interactions.topdown import VIEW_SIZE, TopDownView

MIRROR = np.array([1.0, -1.0, 1.0])
"""Factors of a vector's coordinates in a mirror along the action axis."""


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
    execution: Float[np.ndarray, "batch 3"]
    """The executed action relative to the commanded one: ahead and to the left [m], turned to the left [rad]; NaN where
    that is not known."""
    bevel: Float[np.ndarray, "batch 2"]
    """Width and height of each object's bevel [m]; NaN where it has none or that is not known."""
    parameters: dict[str, np.ndarray]
    """(batch,) arrays by name [SI]: physical constants as in `Physics`, and parameters of the actions; NaN where an
    interaction has no such one."""

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, rows: Any) -> "InteractionBatch":
        """The given rows (slice, index array or boolean array) as a batch; ``times`` stays common to all.

        One row number gives a batch of one.

        Raises:
            RowError: There are no such rows.
        """
        if isinstance(rows, Integral) and not isinstance(rows, bool):
            rows = [int(rows)]
        chosen = chosen_rows(len(self), rows)
        rows = rows if isinstance(rows, slice) else chosen
        kept = {
            f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name not in ("times", "parameters")
        }
        parameters = {name: values[rows] for name, values in self.parameters.items()}
        return replace(self, **kept, parameters=parameters)

    def batches(self, size: int | None = None) -> Iterator["InteractionBatch"]:
        """The same in parts of a number of rows, in order; by default in one."""
        size = max(1, len(self)) if size is None else size
        if not is_whole(size, 1, 2**63 - 1):
            raise wrong_type(DatasetError)(
                f"size of a batch is {shown(size)}: give a number of rows from 1 on"
            )
        return (self[start : start + size] for start in range(0, len(self), size))

    def mirrored(self) -> "InteractionBatch":
        """The same interactions in a mirror along the action axis: left is right.

        The grid of the views is its own mirror image, so that no pixel is drawn anew. Object frames are mirrored, too.
        """
        order = np.arange(self.corners.shape[1])
        backwards = self.num_corners[:, None] - 1 - order  # corners stay counter-clockwise
        order = np.where(backwards >= 0, backwards, order)
        return replace(
            self,
            mask=np.ascontiguousarray(self.mask[:, :, ::-1]),
            height=np.ascontiguousarray(self.height[:, :, ::-1]),
            corners=np.take_along_axis(self.corners, order[..., None], axis=1) * MIRROR[:2],
            com=self.com * MIRROR,
            pose=self.pose * [*MIRROR, 1, -1, 1, -1],
            support_points=np.ascontiguousarray(self.support_points[:, ::-1] * MIRROR[:2]),
        )

    @classmethod
    def from_interactions(cls, interactions: Sequence[Interaction]) -> "InteractionBatch":
        """Interactions as arrays; objects that are equal get equal ``object_ids``, counted from 0.

        Raises:
            DatasetError: Two of them were sampled at different times.
        """
        from foretrace.interactions import storage
        from foretrace.interactions.parameters import parameter_values
        from foretrace.interactions.tables import batch_of, common_times

        check_type("interactions", interactions, Iterable, DatasetError)
        interactions = list(interactions)
        for k, interaction in enumerate(interactions):
            check_type(f"interaction {k}", interaction, Interaction, DatasetError)
        descriptions = [json.dumps(interaction.object.to_dict()) for interaction in interactions]
        numbers = {description: k for k, description in enumerate(dict.fromkeys(descriptions))}
        rows = [
            storage.encode(interaction, numbers[description])
            for interaction, description in zip(interactions, descriptions, strict=True)
        ]
        known = dict(zip(descriptions, (interaction.object for interaction in interactions), strict=True))
        table = storage.to_table(rows)
        return batch_of(table, known, common_times([table]), parameter_values(table))

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
        check_type("views", views, Sequence, DatasetError)
        for k, view in enumerate(views):
            check_type(f"view {k}", view, TopDownView, DatasetError)
        n, times = (
            len(views),
            np.zeros(0) if times is None else finite_array("times", times, (None,), DatasetError),
        )
        corners = [np.zeros((0, 2))] * n if corners is None else corners
        check_type("corners", corners, Sequence, DatasetError)
        corners = [finite_array("corners", each, (None, 2), DatasetError) for each in corners]
        return cls(
            ids=np.arange(n),
            mask=np.array([view.mask for view in views], dtype=bool).reshape(n, VIEW_SIZE, VIEW_SIZE),
            height=np.array([view.height for view in views], dtype=np.float32).reshape(
                n, VIEW_SIZE, VIEW_SIZE
            ),
            corners=padded(corners, 2),
            num_corners=np.array([len(c) for c in corners], dtype=np.int64),
            object_ids=np.arange(n),
            times=times,
            com=np.full((n, len(times), 3), np.nan),
            pose=np.full((n, len(times), 7), np.nan),
            length=np.zeros(n, dtype=np.int64),
            slip_index=np.zeros(n, dtype=np.int64),
            support_points=np.full((n, 2, 2), np.nan),
            outcome=outcome_array([""] * n),
            execution=np.full((n, 3), np.nan),
            bevel=np.full((n, 2), np.nan),
            parameters={},
        )


@dataclass(frozen=True)
class Candidates:
    """Several actions on the object of one view."""

    view: TopDownView
    """The object, in any action frame."""
    actions: tuple[Action, ...]
    """The actions, in that frame."""

    @cached_property
    def contacts(self) -> Float[np.ndarray, "n 2"]:
        """Contact points in the view's frame [m]."""
        return np.array([action.contact for action in self.actions])

    @cached_property
    def directions(self) -> Float[np.ndarray, "n 2"]:
        """Unit vectors of the actions in the view's frame."""
        return np.array([action.direction for action in self.actions])

    @property
    def axes(self) -> Float[np.ndarray, "n 2 2"]:
        """Rows: x and y axis of each action's frame, in the view's."""
        return np.stack([self.directions, self.directions[:, ::-1] * [-1, 1]], axis=1)

    def enter(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
        """A point of the view's frame [m] in each action's frame."""
        inside = np.einsum("nij,nj->ni", self.axes, point[:2] - self.contacts)
        return np.concatenate([inside, np.full((len(inside), 1), point[2])], axis=1)

    def batch(self) -> InteractionBatch:
        """The object as seen in each action's frame."""
        return InteractionBatch.from_views([self.view.seen_from(action) for action in self.actions])


def outcome_array(outcomes: Sequence[str]) -> np.ndarray:
    """Names as an array whose width, and so its bytes, does not depend on which of a lever-up's outcomes occur."""
    return np.array(outcomes, dtype=f"<U{max(8, *map(len, outcomes), 0)}")


def padded(arrays: Sequence[np.ndarray], width: int, longest: int | None = None) -> np.ndarray:
    """(n, longest, width) from arrays of (k, width), NaN past the end of each."""
    longest = max((len(a) for a in arrays), default=0) if longest is None else longest
    padded = np.full((len(arrays), longest, width), np.nan)
    for k, array in enumerate(arrays):
        padded[k, : len(array)] = array
    return padded


def chosen_rows(number: int, rows: Any) -> Int[np.ndarray, " chosen"]:
    """Numbers of the chosen rows.

    Raises:
        RowError: There are no such rows.
    """
    try:
        chosen = np.arange(number)[[] if isinstance(rows, list | tuple) and not rows else rows]
    except (IndexError, TypeError, ValueError) as reason:
        shown = " ".join(repr(rows).split())
        raise RowError(
            f"{shown:.60} chooses no rows of {number} ({reason}): give a row number, a slice, row numbers, or a "
            "boolean array of all rows"
        ) from None
    if chosen.ndim != 1:
        raise RowError(
            f"{' '.join(repr(rows).split()):.60} chooses no rows of {number}: give row numbers in one list"
        )
    return chosen
