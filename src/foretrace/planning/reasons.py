"""Plans in words: why candidates were not chosen, what stands in the way of the one that was, what its cost says."""

from collections.abc import Mapping

import numpy as np

from foretrace.imagined.shown import percentage
from foretrace.planning.goals import Goal, describe
from foretrace.planning.scores import Criterion, Scores

TIE = 0.005
"""Costs that differ by less are the same: half a millimetre. Then the contact decides where errors cost least."""
WEIGHED: dict[Criterion, str] = {
    "expected": "expected",
    "cvar": "in the worst futures",
    "likeliest": "in the likeliest future",
}
"""What a cost is by each criterion."""
UNREACHED = "the robot does not reach it"


def why_lost(one: Scores, best: float, before: str) -> str:
    """Why a candidate was not chosen.

    Args:
        one: The candidate's score, one row.
        best: Cost of the choice.
        before: Why its cost did not count: it was not checked, or the robot does not reach it; empty if it did.
    """
    for name, chance, limit in zip(one.names, one.chances[0], one.limits, strict=True):
        if chance > limit:
            return f"{name} {percentage(chance)}, at most {limit:.0%} accepted"
    more = float(one.cost[0]) - best
    if more > 0:
        return f"costs {more:.2g} more"
    if before:
        return f"costs {-more:.2g} less, but {before}"
    return f"costs as much to within {TIE}, but more where the contact is missed by a few millimetres"


def reasons(scores: Scores, best: int, lost: Mapping[str, int]) -> dict[str, int]:
    """How many candidates were not chosen for which reason.

    Args:
        scores: Of all candidates.
        best: Row of the choice.
        lost: The same of those that were left out before.
    """
    others = np.arange(len(scores)) != best
    found = dict(lost)
    for column, name in enumerate(scores.names):
        over = scores.chances[:, column] > scores.limits[column]
        found[f"{name} is too probable"] = int((over & others).sum())
    kept, more = others & (scores.excess == 0), scores.cost > scores.cost[best]
    found["costs more"] = int((kept & more).sum())
    found["costs no more, but was not checked, or tolerates errors less"] = int((kept & ~more).sum())
    return {reason: count for reason, count in found.items() if count}


def note(goal: Goal, one: Scores, scores: Scores) -> str:
    """What stands in the way; empty where the goal is reached.

    Args:
        goal: The goal.
        one: The score of the choice, one row.
        scores: Of all candidates.
    """
    if one.excess[0] > 0:
        over = np.flatnonzero(one.chances[0] > one.limits)[0]
        return (
            f"no contact keeps {one.names[over]} to {one.limits[over]:.0%}: here it has a probability of "
            f"{percentage(one.chances[0, over])}, the least that was imagined is "
            f"{percentage(scores.chances[:, over].min())}"
        )
    if one.reached[0] < 0.5:
        return (
            f"nothing reaches the goal {describe(goal)}: this comes nearest, with a probability of "
            f"{percentage(one.reached[0])}"
        )
    return ""


def worth(goal: Goal, cost: float, criterion: Criterion) -> str:
    """What a cost says; empty where the goal has no words for it."""
    words = goal.in_words(cost)
    return f"{WEIGHED[criterion]}: {words}" if words else ""
