"""The goal of learning about the object rather than moving it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from foretrace.errors import PlanningError, fault, is_number, shown
from foretrace.planning.goals.base import Goal
from foretrace.planning.motions import Motions


@dataclass(frozen=True)
class Learn(Goal):
    """Learn as much as possible about frictions, density and centre of mass, from the motion that is then observed.

    It needs a `Belief` as context: what is known already is not learned again.
    """

    label = "learn"
    asks_gain = True
    at_least: float = 0.5
    """Information from which on the goal counts as reached [nat]."""

    def __post_init__(self) -> None:
        if not is_number(self.at_least) or not 0 <= self.at_least < np.inf:
            raise fault(PlanningError, is_number(self.at_least))(
                f"at_least is {shown(self.at_least)}: give an information in nats, from 0 on"
            )

    def _gain(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        if motions.gain is None:
            raise PlanningError(
                "these motions come without information gains, which the goal Learn is about: give it to ft.plan, with "
                "a Belief as context"
            )
        return np.broadcast_to(motions.gain[:, None], motions.probability.shape)

    def cost(self, motions: Motions) -> Float[np.ndarray, "batch futures"]:
        """Minus the expected information [nat]: the same in all futures of an action."""
        return -self._gain(motions)

    def in_words(self, cost: float) -> str:
        """The information."""
        return f"tells {-cost:.2g} nat; reached from {self.at_least:.2g} nat on"

    def reached(self, motions: Motions) -> Bool[np.ndarray, "batch futures"]:
        """Where enough is expected to be learned."""
        return self._gain(motions) >= self.at_least
