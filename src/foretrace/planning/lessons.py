"""Lessons of earlier actions in a sequence: where they left the object, compared with where they were expected to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foretrace.actions import Action
from foretrace.geometry import invert_transform
from foretrace.planning.motions import FLAT, Motions

NEAR, ALIKE = 0.01, 0.2
"""Distance of two contacts [m] and angle between two directions [rad], in standard deviations of which a Gaussian
measures how alike two actions are."""


@dataclass(frozen=True, eq=False)
class Lesson:
    """One action that was carried out."""

    action: Action
    """The action, in the object's frame before it."""
    error: Float[np.ndarray, "3"]
    """Resting pose of the object in the frame in which it was expected: x, y [m] and turn [rad]."""

    @classmethod
    def of(
        cls, action: Action, expected: Float[np.ndarray, "4 4"], observed: Float[np.ndarray, "4 4"]
    ) -> "Lesson":
        """The lesson of an action; its error is zero where the object was expected or observed on another side.

        Args:
            action: The action, in the object's frame before it.
            expected: The object's frame after it in the one before, as imagined.
            observed: The same as observed.
        """
        if min(expected[2, 2], observed[2, 2]) < np.cos(FLAT):
            return cls(action, np.zeros(3))
        off = invert_transform(expected) @ observed
        return cls(action, np.array([*off[:2, 3], np.arctan2(off[1, 0], off[0, 0])]))


def taught(motions: Motions, lessons: Sequence[Lesson]) -> Motions:
    """Motions corrected by the errors of similar earlier actions, each weighted by how alike the two actions are.

    Of several lessons about an action, the mean counts. Actions on different paths are not alike.
    """
    if not lessons:
        return motions
    contacts, directions = (
        np.array([getattr(action, name) for action in motions.actions]) for name in ("contact", "direction")
    )
    weights = np.zeros((len(motions), len(lessons)))
    for k, lesson in enumerate(lessons):
        apart = np.linalg.norm(contacts - lesson.action.contact, axis=1) / NEAR
        turned = np.arccos(np.clip(directions @ lesson.action.direction, -1.0, 1.0)) / ALIKE
        same = np.array([action.path == lesson.action.path for action in motions.actions])
        weights[:, k] = same * np.exp(-(apart**2 + turned**2) / 2)
    errors = weights @ np.array([lesson.error for lesson in lessons])
    return motions.moved_on(errors / np.maximum(weights.sum(axis=1), 1.0)[:, None])
