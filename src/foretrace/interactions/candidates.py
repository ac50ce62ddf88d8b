"""Several actions on the object of one view."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from foretrace.actions import Action
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.topdown import TopDownView


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
