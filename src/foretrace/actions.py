"""The lever-up action: where the blade goes under the object, and which way it pushes."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float

from foretrace.errors import ActionError
from foretrace.geometry import inward_normals
from foretrace.objects import ObjectModel

CORNER_MARGIN = 0.001
"""A contact point snapped to the outline keeps this distance from the corners [m]."""


@dataclass(frozen=True, eq=False)
class LeverUp:
    """A lever-up, placed on its object (paper, section 4).

    Raises:
        ActionError: if a value is not finite or the direction has no length.
    """

    contact: Float[np.ndarray, "2"]
    """Where the blade meets the outline, in the object frame [m]."""
    direction: Float[np.ndarray, "2"]
    """Unit vector along which the blade is pushed, in the object frame; usually the inward edge normal."""

    def __post_init__(self) -> None:
        contact, direction = np.array(self.contact, dtype=float), np.array(self.direction, dtype=float)
        for name, vector in (("contact", contact), ("direction", direction)):
            if vector.shape != (2,) or not np.isfinite(vector).all():
                raise ActionError(
                    f"{name} {vector.tolist()}: expected two finite numbers in the object frame"
                )
        length = np.linalg.norm(direction)
        if length < 1e-9:
            raise ActionError(f"direction {direction.tolist()} has no length: give a vector into the object")
        direction /= length
        for name, vector in (("contact", contact), ("direction", direction)):
            vector.setflags(write=False)
            object.__setattr__(self, name, vector)

    @classmethod
    def at_edge(cls, obj: ObjectModel, edge: int, fraction: float = 0.5) -> Self:
        """The lever-up at a fraction of an edge, pushing along its inward normal.

        Args:
            obj: the object.
            edge: number of the edge; edge k runs from corner k to corner k + 1.
            fraction: how far along the edge, strictly between 0 and 1.

        Raises:
            ActionError: if there is no such edge or the fraction leaves it.
        """
        num_edges = len(obj.corners)
        if not 0 <= edge < num_edges:
            raise ActionError(f"edge {edge} of an object with {num_edges} edges: choose 0 to {num_edges - 1}")
        if not 0 < fraction < 1:
            raise ActionError(f"fraction {fraction} of an edge: choose one between 0 and 1, both excluded")
        start, stop = obj.corners[edge], obj.corners[(edge + 1) % num_edges]
        return cls(start + fraction * (stop - start), inward_normals(obj.corners)[edge])

    @classmethod
    def nearest(cls, obj: ObjectModel, point: Float[np.ndarray, "2"] | tuple[float, float]) -> Self:
        """The lever-up at the point of the outline nearest to a given one, pushing along that edge's normal.

        Near a corner the contact keeps a millimetre from it (or half of a shorter edge), on the edge that
        faces the point more directly.

        Raises:
            ActionError: if the point is not finite.
        """
        point = np.array(point, dtype=float)
        if point.shape != (2,) or not np.isfinite(point).all():
            raise ActionError(
                f"contact point {point.tolist()}: expected two finite numbers in the object frame"
            )
        starts, stops = obj.corners, np.roll(obj.corners, -1, axis=0)
        lengths = np.linalg.norm(stops - starts, axis=1)
        along = ((point - starts) * (stops - starts)).sum(axis=1) / lengths**2
        margin = np.minimum(CORNER_MARGIN / lengths, 0.5)
        fractions = np.clip(along, margin, 1 - margin)
        contacts = starts + fractions[:, None] * (stops - starts)
        edge = int(np.argmin(np.linalg.norm(contacts - point, axis=1)))
        return cls(contacts[edge], inward_normals(obj.corners)[edge])

    @property
    def T_action_object(self) -> Float[np.ndarray, "4 4"]:
        """Transform from the object frame at rest to the action frame.

        The contact point becomes the origin, the direction the x axis; z is kept.
        """
        transform = np.eye(4)
        transform[:2, :2] = [self.direction, [-self.direction[1], self.direction[0]]]
        transform[:2, 3] = -transform[:2, :2] @ self.contact
        return transform


def sample_contacts(obj: ObjectModel, rng: np.random.Generator, per_edge: int = 2) -> list[LeverUp]:
    """Lever-ups at uniformly sampled points of every edge (paper, section 4: two on each edge)."""
    return [
        LeverUp.at_edge(obj, edge, 1.0 - rng.uniform(0.0, 1.0 - 1e-9))
        for edge in range(len(obj.corners))
        for _ in range(per_edge)
    ]
