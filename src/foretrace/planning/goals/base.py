"""The contract of a goal: what is to happen to an object, as a cost of its futures, and what must not happen."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float

from foretrace.actions import Outcome
from foretrace.errors import PlanningError, fault, is_number, shown, wrong_type
from foretrace.geometry import Numbers, finite_array
from foretrace.planning.motions import Motions
from foretrace.registry import Registry

LENGTH = 0.1
"""Distance that costs 1 [m]."""
ANGLE = np.pi / 2
"""Angle that costs 1 [rad]."""
LARGEST = 10.0
"""A longer distance is a mistake, such as one in other units [m]."""
GOALS: Registry[type["Goal"]] = Registry("goal", "foretrace.goals", PlanningError)
"""Every goal by its label."""
LEVERED, SLIPPED, TUMBLED, ROLLED = (
    str(name) for name in (Outcome.LEVERED, Outcome.SLIPPED, Outcome.TUMBLED, Outcome.ROLLED)
)


@dataclass(frozen=True)
class Constraint:
    """Something that must not happen, but for a small probability."""

    name: str
    """What it is, for messages."""
    most: float
    """Largest probability that is accepted."""
    happens: Callable[[Motions], np.ndarray]
    """Whether it happens in futures: (batch, futures) bool."""
    outcomes: tuple[str, ...] = ()
    """Outcomes that an imaginer has to tell apart for it."""


class Goal(ABC):
    """What is to happen. A subclass with a label is a frozen dataclass, and registers itself.

    Goals can be added, and multiplied by a weight: ``ft.goals.Lift() + 2 * ft.goals.Move((1, 0))``.
    """

    label: ClassVar[str] = ""
    """Name on the command line and in files."""
    outcomes: ClassVar[tuple[str, ...]] = ()
    """Outcomes that an imaginer has to tell apart for the cost."""
    asks_gain: ClassVar[bool] = False
    """Whether it looks at `Motions.gain`, which a belief as context gives."""

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if cls.__dict__.get("label"):
            GOALS.add(cls.label, cls)

    @abstractmethod
    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """Cost of each future."""

    @abstractmethod
    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Whether the goal counts as reached in each future, its constraints apart."""

    def constraints(self) -> tuple[Constraint, ...]:
        """What must not happen."""
        return ()

    def in_words(self, cost: float) -> str:
        """What a mean cost says in plain words, and from where on the goal counts as reached; empty: no such words."""
        return ""

    def check(self, outline: Float[np.ndarray, "corners 2"]) -> None:  # noqa: B027
        """Refuse a goal that this object cannot have; by default none is refused.

        Args:
            outline: The object's outline in its frame [m].

        Raises:
            PlanningError: Naming what is wrong.
        """

    def needed_outcomes(self) -> tuple[str, ...]:
        """Outcomes that an imaginer has to tell apart."""
        own = [*self.outcomes, *(name for each in self.constraints() for name in each.outcomes)]
        return tuple(dict.fromkeys(own))

    def needs_gain(self) -> bool:
        """Whether it can only be had with a belief, see `asks_gain`."""
        return self.asks_gain

    def tells_reached(self) -> bool:
        """Whether `reached` tells anything: a function of motions has costs alone."""
        return True

    def __add__(self, other: Any) -> "Total":
        return Total(_terms(self) + _terms(as_goal(other)))

    def __radd__(self, other: Any) -> "Total":
        return as_goal(other) + self

    def __mul__(self, weight: int | float) -> "Total":
        if not is_number(weight) or not 0 <= weight < np.inf:
            raise fault(PlanningError, is_number(weight))(
                f"weight of a goal is {shown(weight)}: give a number from 0 on"
            )
        return Total(tuple((weight * own, goal) for own, goal in _terms(self)))

    __rmul__ = __mul__


@dataclass(frozen=True)
class Total(Goal):
    """Several goals at once: costs add up by their weights, all have to be reached, all constraints hold."""

    terms: tuple[tuple[float, Goal], ...]
    """Weights and goals."""

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """Weighted sum."""
        return np.sum([weight * goal.cost(motions) for weight, goal in self.terms], axis=0)

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Whether all are."""
        return np.all([goal.reached(motions) for _, goal in self.terms], axis=0)

    def constraints(self) -> tuple[Constraint, ...]:
        """Those of all."""
        return tuple(each for _, goal in self.terms for each in goal.constraints())

    def check(self, outline: Float[np.ndarray, "corners 2"]) -> None:
        """Each of them."""
        for _, goal in self.terms:
            goal.check(outline)

    def needed_outcomes(self) -> tuple[str, ...]:
        """Those of all."""
        return tuple(dict.fromkeys(name for _, goal in self.terms for name in goal.needed_outcomes()))

    def needs_gain(self) -> bool:
        """Whether any does."""
        return any(goal.needs_gain() for _, goal in self.terms)

    def tells_reached(self) -> bool:
        """Whether any does."""
        return any(goal.tells_reached() for _, goal in self.terms)

    def __str__(self) -> str:
        return " + ".join(
            f"{'' if weight == 1 else f'{weight:g} '}{describe(goal)}" for weight, goal in self.terms
        )


@dataclass(frozen=True)
class Own(Goal):
    """A goal of one's own: any function of motions.

    Raises:
        PlanningError: When it is used, if the function returns anything else than finite numbers, one for each future.
    """

    function: Callable[[Motions], Any]
    """Returns costs (batch, futures), or (batch,)."""

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """What the function returns."""
        shape = motions.probability.shape
        found = self.function(motions)
        try:
            costs = np.array(found, dtype=float)
        except (TypeError, ValueError):
            raise wrong_type(PlanningError)(f"the goal {self} costs {shown(found)}: return numbers") from None
        costs = costs[:, None] if costs.shape == shape[:1] else costs
        if costs.shape not in (shape, (shape[0], 1)) or not np.isfinite(costs).all():
            raise PlanningError(
                f"the goal {self} returned {shown(costs)} for {shape[0]} actions with {shape[1]} futures: return one "
                "finite number for each future"
            )
        return np.broadcast_to(costs, shape).copy()

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Always: only its cost is known."""
        return np.ones(motions.probability.shape, dtype=bool)

    def tells_reached(self) -> bool:
        """No."""
        return False

    def __str__(self) -> str:
        return getattr(self.function, "__name__", type(self.function).__name__)


def as_goal(goal: Any) -> Goal:
    """A goal, from one or from a function of motions.

    Raises:
        PlanningError: It is neither.
    """
    if isinstance(goal, Goal):
        return goal
    if callable(goal) and not isinstance(goal, type):
        return Own(goal)
    raise wrong_type(PlanningError)(
        f"goal {shown(goal)}: give a goal such as ft.goals.Lift(), or a function of motions"
    )


def describe(goal: Goal) -> str:
    """A goal in words: its class, and what differs from its defaults."""
    if isinstance(goal, Total | Own):
        return str(goal)
    shorts = [
        f"{each.name}={_short(getattr(goal, each.name))}"
        for each in fields(goal)  # pyright: ignore[reportArgumentType]
        if getattr(goal, each.name) is not each.default
    ]
    return f"{type(goal).__name__}({', '.join(shorts)})"


def _short(value: Any) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(_short(each) for each in value)})"
    return f"{value:.4g}" if isinstance(value, float) else shown(value)


def _terms(goal: Goal) -> tuple[tuple[float, Goal], ...]:
    return goal.terms if isinstance(goal, Total) else ((1.0, goal),)


def in_cm(length: float) -> str:
    """A length [m] in words."""
    return f"{100 * length:.2g} cm"


def in_degrees(angle: float) -> str:
    """An angle [rad] in words."""
    return f"{np.degrees(angle):.2g} degrees"


def no_slip(most: float | None) -> tuple[Constraint, ...]:
    """No slip, but for a probability; nothing without one."""
    if most is None:
        return ()
    return (Constraint("slip", most, lambda motions: motions.is_outcome(SLIPPED), (SLIPPED,)),)


def check_probability(name: str, value: Any, optional: bool = False) -> None:
    """Refuse what is no probability; None is one where it is optional.

    Raises:
        PlanningError: Naming it.
    """
    if not (is_number(value) and 0 <= value <= 1) and not (optional and value is None):
        raise fault(PlanningError, is_number(value))(f"{name} is {shown(value)}: give a probability, 0 to 1")


def check_length(name: str, value: Any) -> None:
    """Refuse what is no length in metres.

    Raises:
        PlanningError: Naming it.
    """
    if not is_number(value) or not 0 <= value <= LARGEST:
        raise fault(PlanningError, is_number(value))(
            f"{name} is {shown(value)}: give metres, from 0 to {LARGEST:g}"
        )


def check_angle(name: str, value: Any, least: float, most: float) -> None:
    """Refuse what is no angle within limits [rad].

    Raises:
        PlanningError: Naming it.
    """
    if not is_number(value) or not least <= value <= most:
        raise fault(PlanningError, is_number(value))(
            f"{name} is {shown(value)}: give radians, from {least:.3g} to {most:.3g}"
        )


def point(name: str, value: Numbers) -> tuple[float, float]:
    """A place in the plane [m].

    Raises:
        PlanningError: Naming what is none.
    """
    place = finite_array(f"{name} (x, y) [m]", value, (2,), PlanningError)
    if np.abs(place).max() > LARGEST:
        raise PlanningError(f"{name} is {shown(place.tolist())}: give metres, up to {LARGEST:g}")
    return float(place[0]), float(place[1])


def unit(name: str, value: Numbers) -> tuple[float, float]:
    """A direction in the plane, as a unit vector.

    Raises:
        PlanningError: Naming what is none.
    """
    vector = finite_array(f"{name} (x, y)", value, (2,), PlanningError)
    if (largest := np.abs(vector).max()) == 0:
        raise PlanningError(f"{name} is {shown(vector.tolist())}, which has no length: give a direction")
    vector = vector / largest
    vector = vector / np.linalg.norm(vector)
    return float(vector[0]), float(vector[1])
