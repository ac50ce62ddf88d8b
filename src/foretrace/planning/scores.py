"""What candidates are worth: cost by a criterion, probabilities of what must not happen, and their order."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from foretrace.errors import PlanningError
from foretrace.planning.goals import Goal, describe
from foretrace.planning.motions import Motions

Criterion = Literal["expected", "cvar", "likeliest"]
"""``expected``: the mean over futures. ``cvar``: the mean over the worst ones (conditional value at risk).
``likeliest``: the most probable future alone, as if it were certain."""
SLACK = 1e-9
"""Probabilities that exceed a limit by less keep it."""


@dataclass(frozen=True, eq=False)
class Scores:
    """What candidates are worth, one row each."""

    cost: Float[np.ndarray, " n"]
    """Cost by the criterion."""
    reached: Float[np.ndarray, " n"]
    """Probability that the goal is reached, and nothing happens that must not."""
    chances: Float[np.ndarray, "n constraints"]
    """Probability of each thing that must not happen."""
    limits: Float[np.ndarray, " constraints"]
    """Largest probability that is accepted of each."""
    names: tuple[str, ...]
    """What they are."""

    def __len__(self) -> int:
        return len(self.cost)

    def __getitem__(self, rows: Int[np.ndarray, " k"] | list[int] | slice) -> "Scores":
        return Scores(self.cost[rows], self.reached[rows], self.chances[rows], self.limits, self.names)

    @property
    def excess(self) -> Float[np.ndarray, " n"]:
        """How far probabilities exceed what is accepted, summed up; 0: all constraints are kept."""
        over = np.maximum(self.chances - self.limits, 0.0)
        return np.where(over > SLACK, over, 0.0).sum(axis=1)

    @property
    def risk(self) -> Float[np.ndarray, " n"]:
        """Largest probability of anything that must not happen; 0 without constraints."""
        return self.chances.max(axis=1, initial=0.0)

    def order(self) -> Int[np.ndarray, " n"]:
        """Rows from the best on: those that keep all constraints by their cost, then the others by their excess."""
        return np.lexsort((self.cost, self.excess))

    def joined(self, other: "Scores") -> "Scores":
        """These rows, and those of another."""
        return Scores(
            np.concatenate([self.cost, other.cost]),
            np.concatenate([self.reached, other.reached]),
            np.concatenate([self.chances, other.chances]),
            self.limits,
            self.names,
        )

    def blended(self, other: "Scores", share: float) -> "Scores":
        """The same rows, with a share of another's values."""

        def mix(own: np.ndarray, its: np.ndarray) -> np.ndarray:
            return (1 - share) * own + share * its

        return Scores(
            mix(self.cost, other.cost),
            mix(self.reached, other.reached),
            mix(self.chances, other.chances),
            self.limits,
            self.names,
        )


def score(goal: Goal, motions: Motions, criterion: Criterion, tail: float) -> Scores:
    """What candidates are worth for a goal.

    Args:
        goal: The goal.
        motions: What is imagined of each candidate.
        criterion: How futures are weighed.
        tail: Share of the worst futures, for ``cvar``.
    """
    probability = motions.probability
    if criterion == "likeliest":
        probability = np.zeros_like(probability)
        probability[np.arange(len(motions)), motions.probability.argmax(axis=1)] = 1.0
    costs = np.asarray(goal.cost(motions), dtype=float)
    fits = costs.shape in (probability.shape, (len(motions), 1))
    if not fits or not np.isfinite(costs).all():
        wrong = "numbers that are not finite" if fits else f"the shape {costs.shape}"
        raise PlanningError(
            f"the costs of the goal {describe(goal)} have {wrong}: return finite ones of the shape {probability.shape}"
        )
    constraints = goal.constraints()
    happens = [np.asarray(each.happens(motions), dtype=bool) for each in constraints]
    bad: Bool[np.ndarray, "n futures"] = np.any(happens, axis=0) if happens else np.zeros(costs.shape, bool)
    chances = [(probability * each).sum(axis=1) for each in happens]
    return Scores(
        tail_mean(costs, probability, tail) if criterion == "cvar" else (probability * costs).sum(axis=1),
        (probability * (goal.reached(motions) & ~bad)).sum(axis=1),
        np.stack(chances, axis=1) if chances else np.zeros((len(motions), 0)),
        np.array([each.most for each in constraints]),
        tuple(each.name for each in constraints),
    )


def tail_mean(
    costs: Float[np.ndarray, "n futures"], probability: Float[np.ndarray, "n futures"], tail: float
) -> Float[np.ndarray, " n"]:
    """Mean of the costs over the worst futures that have a probability of ``tail`` together.

    The conditional value at risk (Rockafellar and Uryasev, 2000).
    """
    order = np.argsort(-costs, axis=1)
    costs, probability = (np.take_along_axis(each, order, axis=1) for each in (costs, probability))
    before = np.cumsum(probability, axis=1) - probability
    weights = np.clip(tail - before, 0.0, probability)
    return (weights * costs).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-12)


def check_outcomes(goal: Goal, known: tuple[str, ...], name: str) -> None:
    """Refuse an imaginer that does not tell the outcomes apart which a goal is about.

    Raises:
        PlanningError: Naming the outcome.
    """
    if missing := [outcome for outcome in goal.needed_outcomes() if outcome not in known]:
        raise PlanningError(
            f"the goal {describe(goal)} is about the outcome {missing[0]}, the {name} imaginer tells "
            f"{', '.join(dict.fromkeys(known))}: use one that tells it, or another goal"
        )
