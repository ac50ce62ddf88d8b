"""Options that say where a tool meets an object."""

from dataclasses import dataclass

from foretrace.actions import Action, LeverUp
from foretrace.errors import CommandError
from foretrace.objects import ObjectModel


@dataclass(frozen=True)
class ContactOptions:
    """The contact."""

    edge: int | None = None
    """Number of the outline's edge to lever at; edge k runs from corner k to corner k + 1."""
    fraction: float | None = None
    """Share of that edge before the contact, between 0 and 1; 0.5 by default."""
    contact: tuple[float, float] | None = None
    """Point to lever at instead, in the object's frame [m]; moved to the outline. An image's frame has its origin at
    the silhouette's centroid, x to the right and y up."""

    @property
    def share(self) -> tuple[int, float] | None:
        """Edge, and share of it before the contact; None without an edge.

        Raises:
            CommandError: A share of no edge is given.
        """
        if self.edge is None and self.fraction is not None:
            raise CommandError("--fraction goes with --edge: give one, or leave it out")
        return None if self.edge is None else (self.edge, 0.5 if self.fraction is None else self.fraction)

    def place(self, obj: ObjectModel, kind: type[Action] = LeverUp) -> Action:
        """The action on an object, by default a lever-up.

        Raises:
            CommandError: Options do not go together.
            ActionError: There is no such edge, or the point is too far from the outline.
        """
        if (self.edge is None) == (self.contact is None):
            raise CommandError("give either --edge (with --fraction) or --contact X Y")
        if self.share is not None:
            return kind.at_edge(obj, *self.share)
        assert self.contact is not None
        return kind.nearest(obj, self.contact)
