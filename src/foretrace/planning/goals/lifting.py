"""Goals about how an object is raised, tilted and turned over."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from foretrace.errors import PlanningError, fault, is_whole, shown
from foretrace.geometry import inward_normals
from foretrace.planning.goals.base import (
    ANGLE,
    LENGTH,
    LEVERED,
    ROLLED,
    TUMBLED,
    Constraint,
    Goal,
    check_angle,
    check_length,
    check_probability,
    in_cm,
    in_degrees,
    no_slip,
    unit,
)
from foretrace.planning.motions import Motions


@dataclass(frozen=True)
class Lift(Goal):
    """Raise the centre of mass as far as possible, and keep the object on the blade."""

    label = "lift"
    outcomes = (LEVERED,)
    max_slip: float | None = 0.05
    """Largest accepted probability that the object slips off the blade, 0 to 1; None: any."""
    at_least: float = 0.01
    """Rise from which on the goal counts as reached [m]."""

    def __post_init__(self) -> None:
        check_probability("max_slip", self.max_slip, optional=True)
        check_length("at_least", self.at_least)

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """Minus the rise; 0 where the object does not stay on the blade."""
        return np.where(motions.is_outcome(LEVERED), -motions.shift[..., 2], 0.0) / LENGTH

    def in_words(self, cost: float) -> str:
        """The rise."""
        return f"rises {in_cm(-cost * LENGTH)}; reached from {in_cm(self.at_least)} on"

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """On the blade, and high enough."""
        return motions.is_outcome(LEVERED) & (motions.shift[..., 2] >= self.at_least)

    def constraints(self) -> tuple[Constraint, ...]:
        """No slip."""
        return no_slip(self.max_slip)


@dataclass(frozen=True)
class Tilt(Goal):
    """Tilt the object to an angle, and keep it on the blade."""

    label = "tilt"
    outcomes = (LEVERED,)
    angle: float
    """The angle to the horizontal [rad]."""
    tolerance: float = 0.09
    """Deviation up to which the goal counts as reached [rad]."""
    max_slip: float | None = 0.05
    """Largest accepted probability that the object slips off the blade, 0 to 1; None: any."""

    def __post_init__(self) -> None:
        check_angle("angle", self.angle, 0.0, np.pi)
        check_angle("tolerance", self.tolerance, 0.0, np.pi)
        check_probability("max_slip", self.max_slip, optional=True)

    def _off(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        tilt = np.where(motions.is_outcome(LEVERED), motions.at_end(motions.tilt), 0.0)
        return np.abs(tilt - self.angle)

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """Deviation from the angle; an object that does not stay on the blade lies flat."""
        return self._off(motions) / ANGLE

    def in_words(self, cost: float) -> str:
        """The deviation."""
        return f"{in_degrees(cost * ANGLE)} off the angle; reached within {in_degrees(self.tolerance)}"

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Within the tolerance."""
        return self._off(motions) <= self.tolerance

    def constraints(self) -> tuple[Constraint, ...]:
        """No slip."""
        return no_slip(self.max_slip)


@dataclass(frozen=True)
class Tumble(Goal):
    """Turn the object onto another side, whichever."""

    label = "tumble"
    outcomes = (TUMBLED,)

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """0 where it tumbles; else from 1 down to a half, as it comes near."""
        near = np.clip(motions.most(motions.tilt) / np.pi, 0.0, 0.5)
        return np.where(motions.is_outcome(TUMBLED), 0.0, 1.0 - near)

    def in_words(self, cost: float) -> str:
        """Between both ends of the scale."""
        return "between 0, where it tumbles, and 1, where it stays flat"

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """It tumbles."""
        return np.array(motions.is_outcome(TUMBLED))


@dataclass(frozen=True)
class TurnOver(Goal):
    """Turn the object over one edge, or towards a direction.

    Raises:
        PlanningError: Neither or both are given.
    """

    label = "turn-over"
    outcomes = (TUMBLED,)
    edge: int | None = None
    """Number of the outline's edge to turn over; edge k runs from corner k to corner k + 1."""
    direction: Any = None
    """Towards which it turns, (x, y) in the object's frame, in place of an edge."""
    cone: float = 0.6
    """Deviation from that direction up to which the goal counts as reached [rad]."""

    def __post_init__(self) -> None:
        if (self.edge is None) == (self.direction is None):
            raise PlanningError("give TurnOver either an edge or a direction")
        if self.edge is not None and not is_whole(self.edge, 0, 2**31):
            raise fault(PlanningError, isinstance(self.edge, int))(
                f"edge is {shown(self.edge)}: give the number of an edge, from 0 on"
            )
        if self.direction is not None:
            object.__setattr__(self, "direction", unit("direction", self.direction))
        check_angle("cone", self.cone, 0.0, np.pi)

    def check(self, outline: Float[np.ndarray, "corners 2"]) -> None:
        """The outline has that edge."""
        if self.edge is not None and self.edge >= len(outline):
            raise PlanningError(
                f"edge {self.edge} of an object with {len(outline)} edges: choose 0 to {len(outline) - 1}"
            )

    def _towards(self, motions: Motions) -> Float[np.ndarray, "2"]:
        if self.direction is not None:
            return np.array(self.direction)
        self.check(motions.outline)
        return -inward_normals(motions.outline)[self.edge or 0]

    def _lean(self, motions: Motions) -> Float[np.ndarray, "batch futures time 2"]:
        return motions.up[..., :2]

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """Part of a quarter turn towards the direction that is missing, at the best moment."""
        angle = np.arctan2(self._lean(motions) @ self._towards(motions), motions.up[..., 2])
        return 1.0 - np.clip(motions.most(angle) / ANGLE, 0.0, 1.0)

    def in_words(self, cost: float) -> str:
        """What is missing."""
        return f"{in_degrees(cost * ANGLE)} short of a quarter turn; reached where it tumbles that way"

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """It tumbles, and towards the direction."""
        lean = self._lean(motions)
        rows, columns = np.indices(motions.probability.shape)
        last = np.where(motions.counts[:, None], np.linalg.norm(lean, axis=-1), -1.0).argmax(axis=2)
        way = lean[rows, columns, last]
        length = np.maximum(np.linalg.norm(way, axis=-1), 1e-12)
        right = way @ self._towards(motions) / length >= np.cos(self.cone)
        return motions.is_outcome(TUMBLED) & right


@dataclass(frozen=True)
class KeepUpright(Goal):
    """The object does not end on another side, nor tilted by more than an angle."""

    label = "keep-upright"
    outcomes = (TUMBLED,)
    most_tilt: float = float(np.deg2rad(80.0))
    """Largest tilt, at any time [rad]."""
    chance: float = 0.05
    """Largest probability that it happens all the same."""

    def __post_init__(self) -> None:
        check_angle("most_tilt", self.most_tilt, 0.0, np.pi)
        check_probability("chance", self.chance)

    def _falls(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        return motions.is_outcome(TUMBLED, ROLLED) | (motions.most(motions.tilt) > self.most_tilt)

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """None: it is a constraint."""
        return np.zeros(motions.probability.shape)

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Always: it is a constraint."""
        return np.ones(motions.probability.shape, dtype=bool)

    def constraints(self) -> tuple[Constraint, ...]:
        """It must not happen."""
        return (Constraint("falling over", self.chance, self._falls),)
