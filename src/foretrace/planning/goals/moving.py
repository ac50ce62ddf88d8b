"""Goals about where an object goes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float

from foretrace.errors import PlanningError, fault, is_number, shown
from foretrace.geometry import finite_array, wrap_angle
from foretrace.planning.goals.base import (
    ANGLE,
    LENGTH,
    Constraint,
    Goal,
    check_angle,
    check_length,
    check_probability,
    in_cm,
    in_degrees,
    no_slip,
    point,
    unit,
)
from foretrace.planning.motions import Motions

FARTHEST = 0.3
"""A place further than this from the object is outside the view, and no goal of one action [m]."""
LEAST_PROBABLE = 0.01
"""Futures less probable than this enter no zone."""
STRIDE = 5
"""Samples from one comparison of an outline with a zone to the next."""


@dataclass(frozen=True)
class Move(Goal):
    """Move the centre of mass as far as possible along a direction, whatever becomes of the object otherwise."""

    label = "move"
    direction: Any
    """The direction, (x, y) in the object's frame; its length does not matter."""
    max_slip: float | None = None
    """Largest accepted probability that the object slips off the blade, 0 to 1; None: any."""
    at_least: float = 0.01
    """Distance from which on the goal counts as reached [m]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", unit("direction", self.direction))
        check_probability("max_slip", self.max_slip, optional=True)
        check_length("at_least", self.at_least)

    def _way(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        return motions.shift[..., :2] @ np.array(self.direction)

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """Minus the distance."""
        return -self._way(motions) / LENGTH

    def in_words(self, cost: float) -> str:
        """The distance."""
        return f"moves {in_cm(-cost * LENGTH)} that way; reached from {in_cm(self.at_least)} on"

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Far enough."""
        return self._way(motions) >= self.at_least

    def constraints(self) -> tuple[Constraint, ...]:
        """No slip, if asked for."""
        return no_slip(self.max_slip)


@dataclass(frozen=True)
class MoveTo(Goal):
    """Bring the centre of mass to a place, and optionally the object to a turn about the vertical."""

    label = "move-to"
    position: Any
    """Where the centre of mass shall end, (x, y) in the object's frame at rest [m]."""
    turn: float | None = None
    """Turn about the vertical that the object shall have at the end [rad]; None: any."""
    tolerance: float = 0.01
    """Distance up to which the goal counts as reached [m]."""
    turn_tolerance: float = 0.17
    """Deviation from the turn up to which it does [rad]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", point("position", self.position))
        check_length("tolerance", self.tolerance)
        if self.turn is not None:
            check_angle("turn", self.turn, -np.pi, np.pi)
        check_angle("turn_tolerance", self.turn_tolerance, 0.0, np.pi)

    def _off(self, motions: Motions) -> tuple[np.ndarray, np.ndarray]:
        apart = np.linalg.norm(motions.end_com[..., :2] - np.array(self.position), axis=-1)
        if self.turn is None:
            return apart, np.zeros_like(apart)
        off = motions.heading - self.turn
        return apart, np.abs(wrap_angle(off))

    def check(self, outline: Float[np.ndarray, "corners 2"]) -> None:
        """The place is near enough for one action."""
        far = float(np.linalg.norm(outline.mean(axis=0) - np.array(self.position)))
        if far > FARTHEST:
            raise PlanningError(
                f"position {list(self.position)} lies {far:.2g} m from the object, outside what one view shows: give "
                f"a place within {FARTHEST:g} m, in metres of the object's frame"
            )

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """Distance from the place, and deviation from the turn."""
        apart, off = self._off(motions)
        return apart / LENGTH + off / ANGLE

    def in_words(self, cost: float) -> str:
        """The distance; with a turn, distance and deviation are one sum."""
        if self.turn is not None:
            return ""
        return f"ends {in_cm(cost * LENGTH)} from the place; reached within {in_cm(self.tolerance)}"

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Within the tolerances."""
        apart, off = self._off(motions)
        return (apart <= self.tolerance) & (off <= self.turn_tolerance)


@dataclass(frozen=True)
class Turn(Goal):
    """Turn the object about the vertical, wherever it goes."""

    label = "turn"
    angle: float
    """The turn to the left [rad]."""
    tolerance: float = 0.17
    """Deviation up to which the goal counts as reached [rad]."""

    def __post_init__(self) -> None:
        check_angle("angle", self.angle, -np.pi, np.pi)
        check_angle("tolerance", self.tolerance, 0.0, np.pi)

    def _off(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        return np.abs(wrap_angle(motions.heading - self.angle))

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """Deviation from the turn."""
        return self._off(motions) / ANGLE

    def in_words(self, cost: float) -> str:
        """The deviation."""
        return f"{in_degrees(cost * ANGLE)} off the angle; reached within {in_degrees(self.tolerance)}"

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Within the tolerance."""
        return self._off(motions) <= self.tolerance


@dataclass(frozen=True)
class SlideOff(Goal):
    """Bring the centre of mass beyond a straight edge of the table."""

    label = "slide-off"
    point: Any
    """A point of the table's edge, (x, y) in the object's frame [m]."""
    outward: Any
    """Direction off the table, (x, y) in the object's frame."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "point", point("point", self.point))
        object.__setattr__(self, "outward", unit("outward", self.outward))

    def _missing(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        return (np.array(self.point) - motions.end_com[..., :2]) @ np.array(self.outward)

    def check(self, outline: Float[np.ndarray, "corners 2"]) -> None:
        """The object is not beyond the edge already."""
        if ((outline - np.array(self.point)) @ np.array(self.outward)).min() > 0:
            raise PlanningError(
                f"the object lies beyond the table's edge through {list(self.point)} already: check point and outward"
            )

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """Distance to the edge; 0 beyond it."""
        return np.maximum(self._missing(motions), 0.0) / LENGTH

    def in_words(self, cost: float) -> str:
        """The distance to the edge."""
        return f"{in_cm(cost * LENGTH)} short of the edge; reached beyond it"

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Beyond the edge."""
        return self._missing(motions) < 0


@dataclass(frozen=True, eq=False)
class Avoid(Goal):
    """Keep a zone free: neither the object, nor the tool on its straight way to the contact, enters it.

    The zone is entered where the outline from above, grown by the prediction region's radius, meets it.
    """

    label = "avoid"
    zone: Any
    """Corners of the zone, (n, 2) in the object's frame [m]."""
    chance: float = 0.05
    """Largest probability that it is entered all the same."""
    level: float | None = 0.9
    """Level of the prediction region; None: the imagined motions alone count. Unknown regions do not count."""

    def __post_init__(self) -> None:
        corners = finite_array("zone (corners, 2) [m]", self.zone, (None, 2), PlanningError)
        polygon = shapely.Polygon(corners) if len(corners) >= 3 else shapely.Polygon()
        if not polygon.is_valid or polygon.area == 0:
            raise PlanningError(
                f"the zone of {len(corners)} corners encloses no area: give at least three corners in order"
            )
        corners.setflags(write=False)
        object.__setattr__(self, "zone", corners)
        check_probability("chance", self.chance)
        if self.level is not None and not (is_number(self.level) and 0.01 <= self.level <= 0.99):
            raise fault(PlanningError, is_number(self.level))(
                f"level {shown(self.level)} of a region: choose one from 0.01 to 0.99"
            )

    def check(self, outline: Float[np.ndarray, "corners 2"]) -> None:
        """The object does not lie in it."""
        if shapely.Polygon(outline).intersects(shapely.Polygon(self.zone)):
            raise PlanningError(
                "the object lies in the zone that it shall avoid: give a zone that is free, in the object's frame"
            )

    def _enters(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        zone = shapely.Polygon(self.zone)
        shapely.prepare(zone)
        entered = np.zeros(motions.probability.shape, dtype=bool)
        rows, columns = np.nonzero(motions.probability >= LEAST_PROBABLE)
        samples = np.unique([*range(0, int(motions.end.max()), STRIDE), *motions.end])
        if len(rows):
            points = motions.footprints(rows, columns, samples)
            apart = np.asarray(shapely.distance(shapely.convex_hull(shapely.multipoints(points)), zone))
            radius = np.zeros_like(apart)
            if self.level is not None:
                found = motions.futures.radius(self.level)[rows, columns][:, samples]
                radius = np.where(np.isfinite(found), found, 0.0)
            inside = np.where(motions.counts[rows][:, samples], apart <= radius, False)
            entered[rows, columns] = inside.any(axis=1)
        if not motions.actions:  # an object at rest
            return entered
        side, near, far = motions.actions[0].approach
        ways = np.array(
            [
                [action.contact - far * action.direction, action.contact - near * action.direction]
                for action in motions.actions
            ]
        )
        blocked = np.asarray(shapely.distance(shapely.linestrings(ways), zone)) <= side
        return entered | blocked[:, None]

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """None: it is a constraint."""
        return np.zeros(motions.probability.shape)

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Always: it is a constraint."""
        return np.ones(motions.probability.shape, dtype=bool)

    def constraints(self) -> tuple[Constraint, ...]:
        """It must not be entered."""
        return (Constraint("entering the zone", self.chance, self._enters),)
