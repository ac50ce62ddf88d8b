"""Candidates: actions at contacts all around an outline, in directions near the inward normal."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float

from foretrace.actions import Action
from foretrace.actions.base import CORNER_MARGIN
from foretrace.errors import PlanningError, check_type
from foretrace.imagined.domain import check_object, find_usable_contacts
from foretrace.interactions.outline import fit_outline
from foretrace.interactions.topdown import LOOK_AHEAD as LOOK_AHEAD
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel

CHORD = 0.0035
"""The normal of a curved outline is that of a chord which reaches this far to both sides [m]."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The object that is to be acted upon."""

    view: TopDownView
    """The object from above."""
    T_view_object: Float[np.ndarray, "4 4"]
    """The object's frame in that of the view."""
    outline: Float[np.ndarray, "corners 2"]
    """Its outline in its own frame [m], counter-clockwise."""
    height: float
    """Its height [m]."""
    com: Float[np.ndarray, "3"] | None = None
    """Its centre of mass at rest in its own frame [m], where that is known."""
    object: ObjectModel | None = None
    """The object itself, where it is known."""
    T_start_now: Float[np.ndarray, "4 4"] | None = None
    """Its frame in that of the goal, where other actions have moved it since."""
    com_start: Float[np.ndarray, "3"] | None = None
    """Its centre of mass before these, in the frame of the goal [m]."""

    @classmethod
    def of(cls, seen: ObjectModel | TopDownView) -> "Scene":
        """The scene of an object, or of a view, whose frame then takes the place of the object's.

        Raises:
            PlanningError: It is neither.
            ViewError: The object does not fit into a view.
            PredictionError: The view does not show one object.
        """
        check_type("what is planned for", seen, (ObjectModel, TopDownView), PlanningError)
        if isinstance(seen, TopDownView):
            check_object(seen.mask, seen.height)
            outline = fit_outline(seen.mask)
            if len(outline) < 3:
                raise PlanningError("the object in the view is too small to have an outline: move nearer")
            return cls(seen, np.eye(4), outline, float(seen.height.max()))
        view, T_view_object = TopDownView.around(seen)
        check_object(view.mask, view.height)  # a needle is seen in no pixel
        com = seen.mass_properties(1.0).com
        return cls(view, T_view_object, seen.corners, seen.height, com, seen)

    def in_view(self, actions: Sequence[Action]) -> list[Action]:
        """Actions in the object's frame, in that of the view."""
        turn, shift = self.T_view_object[:2, :2], self.T_view_object[:2, 3]
        return [
            replace(action, contact=turn @ action.contact + shift, direction=turn @ action.direction)
            for action in actions
        ]

    def loaded(self, com: Float[np.ndarray, "3"]) -> "Scene":
        """The same with a centre of mass that is known [m]."""
        return replace(self, com=com)

    @property
    def com_in_view(self) -> Float[np.ndarray, "3"] | None:
        """The centre of mass at rest in the view's frame [m]; None: the view tells it."""
        if self.com is None:
            return None
        return self.T_view_object[:3, :3] @ self.com + self.T_view_object[:3, 3]


@dataclass(frozen=True, eq=False)
class Rim:
    """An outline by its length."""

    outline: Float[np.ndarray, "corners 2"]
    """Corners [m], counter-clockwise."""

    @cached_property
    def _starts(self) -> Float[np.ndarray, "corners_and_one"]:
        lengths = np.linalg.norm(np.roll(self.outline, -1, axis=0) - self.outline, axis=1)
        return np.concatenate([[0.0], np.cumsum(lengths)])

    @property
    def length(self) -> float:
        """Length of the outline [m]."""
        return float(self._starts[-1])

    def edge_at(self, along: Float[np.ndarray, " n"]) -> np.ndarray:
        """Number of the edge at distances along the outline: (n,) integers."""
        edges = np.searchsorted(self._starts, along % self.length, side="right") - 1
        return np.minimum(edges, len(self.outline) - 1)

    def points(self, along: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """Points at distances along the outline from its first corner [m]; any number of times round."""
        closed = np.concatenate([self.outline, self.outline[:1]])
        return np.stack([np.interp(along % self.length, self._starts, axis) for axis in closed.T], axis=1)

    def off_corners(self, along: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The same distances, kept a millimetre from both ends of their edge, or in its middle."""
        along = along % self.length
        edges = self.edge_at(along)
        low, high = self._starts[edges], self._starts[edges + 1]
        margin = np.minimum(CORNER_MARGIN, (high - low) / 2)
        return np.clip(along, low + margin, high - margin)

    def normals(self, along: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """Inward unit normals: of the edge, or, where it is shorter, of a chord of twice `CHORD`."""
        edges = self.edge_at(along)
        low, high = self._starts[edges], self._starts[edges + 1]
        short = high - low < 2 * CHORD
        first = self.points(np.where(short, along - CHORD, low))
        last = self.points(np.where(short, along + CHORD, high - 1e-9))
        chord = last - first
        inward = np.stack([-chord[:, 1], chord[:, 0]], axis=1)
        return inward / np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-12)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Actions of one kind on one object, by where on the outline they act and their turn from the normal."""

    along: Float[np.ndarray, " n"]
    """Distance of the contact along the outline from its first corner [m]."""
    turn: Float[np.ndarray, " n"]
    """Angle of the direction to the left of the inward normal [rad]."""
    actions: tuple[Action, ...]
    """The actions, in the object's frame."""

    def __len__(self) -> int:
        return len(self.actions)

    def __getitem__(self, rows: np.ndarray | list[int]) -> "Candidates":
        rows = np.arange(len(self))[rows]
        return Candidates(self.along[rows], self.turn[rows], tuple(self.actions[k] for k in rows))

    def joined(self, other: "Candidates") -> "Candidates":
        """These, and others."""
        return Candidates(
            np.concatenate([self.along, other.along]),
            np.concatenate([self.turn, other.turn]),
            (*self.actions, *other.actions),
        )

    @property
    def contacts(self) -> Float[np.ndarray, "n 2"]:
        """Contact points [m]."""
        return np.array([action.contact for action in self.actions]).reshape(-1, 2)


def place(
    kind: type[Action],
    rim: Rim,
    along: Float[np.ndarray, " n"],
    turn: Float[np.ndarray, " n"],
    paths: Sequence[Any],
) -> Candidates:
    """Actions of a kind at distances along an outline, turned from its normal [rad]."""
    along = rim.off_corners(along)
    contacts, normals = rim.points(along), rim.normals(along)
    c, s = np.cos(turn), np.sin(turn)
    directions = np.stack(
        [c * normals[:, 0] - s * normals[:, 1], s * normals[:, 0] + c * normals[:, 1]], axis=1
    )
    actions = tuple(
        kind(contact, direction, path)  # pyright: ignore[reportCallIssue]
        for contact, direction, path in zip(contacts, directions, paths, strict=True)
    )
    return Candidates(along, turn, actions)


def find_free(scene: Scene, candidates: Candidates) -> tuple[Bool[np.ndarray, " n"], dict[str, int]]:
    """Which candidates a tool gets to straight from outside and an imaginer can look at, and why others fall out."""
    if not len(candidates):
        return np.zeros(0, dtype=bool), {}
    contacts = candidates.contacts
    directions = np.array([action.direction for action in candidates.actions]).reshape(-1, 2)
    outline = shapely.Polygon(scene.outline)
    shapely.prepare(outline)
    side, near, far = candidates.actions[0].approach
    left = side * np.stack([-directions[:, 1], directions[:, 0]], axis=1)
    lost = -near * directions, -far * directions
    corners = np.stack(
        [
            contacts + lost[0] + left,
            contacts + lost[0] - left,
            contacts + lost[1] - left,
            contacts + lost[1] + left,
        ],
        axis=1,
    )
    # At a turned tool one of its corners is nearer to the outline than its middle: this much is no obstacle.
    slack = np.abs(np.sin(candidates.turn)) * side
    corners[:, :2] -= slack[:, None, None] * directions[:, None]
    free = ~shapely.intersects(outline, shapely.polygons(corners))
    turn, shift = scene.T_view_object[:2, :2], scene.T_view_object[:2, 3]
    seen = find_usable_contacts(scene.view.mask, contacts @ turn.T + shift, directions @ turn.T)
    reasons = {
        "no tool gets there": int((~free).sum()),
        "the object reaches beyond the view": int((free & ~seen).sum()),
    }
    return free & seen, {reason: count for reason, count in reasons.items() if count}
