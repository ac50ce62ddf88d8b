"""Scenes that an imaginer is asked about: objects from above, in the frames of the actions to be imagined."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from foretrace.errors import PredictionError
from foretrace.imagined.domain import measure, measure_from
from foretrace.interactions.candidates import Candidates
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL


@dataclass(frozen=True)
class Scenes:
    """What is to be imagined, checked; one row for each action."""

    source: InteractionBatch | Candidates
    """Interactions of which everything before the action may be read; or candidates."""
    com: Float[np.ndarray, "batch 3"]
    """Centres of mass at rest in the action frame [m]."""
    context: Float[np.ndarray, "batch context"]
    """Values of the imaginer's context [SI]."""
    observed: Float[np.ndarray, "batch samples 6"] | None = None
    """Motions' first samples at the imaginer's sample times, where they are under way: centre of mass in the action
    frame [m] and rotation vector since rest [rad]."""

    def __len__(self) -> int:
        return len(self.com)

    @cached_property
    def batch(self) -> InteractionBatch:
        """The objects in the frames of the actions."""
        return self.source.batch() if isinstance(self.source, Candidates) else self.source

    def measure(self) -> dict[str, Float[np.ndarray, " batch"]]:
        """Measures by which objects are compared, see `foretrace.imagined.domain.MEASURES`."""
        if isinstance(self.source, Candidates):
            return measure_from(self.source.view, self.source.contacts, self.source.directions, self.com)
        return measure(self.source, self.com)


def estimate_com(batch: InteractionBatch) -> Float[np.ndarray, "batch 3"]:
    """Centres of mass at rest in the action frame [m], estimated from the views.

    Above the centre of each mask's area, at half the object's greatest height: right for a prism of uniform
    density but for its bevel.

    Raises:
        PredictionError: A mask is empty.
    """
    across, along = batch.mask.sum(axis=2), batch.mask.sum(axis=1)
    areas = across.sum(axis=1)
    if not areas.all():
        raise PredictionError(
            f"the mask of interaction {batch.ids[np.argmin(areas)]} is empty: see that the camera sees the object"
        )
    rows, columns = (counts @ np.arange(counts.shape[1]) / areas for counts in (across, along))
    points = (CONTACT_PIXEL - np.stack([rows, columns], axis=-1)) * METRES_PER_PIXEL
    return np.concatenate([points, batch.height.max(axis=(1, 2))[:, None] / 2], axis=-1)
