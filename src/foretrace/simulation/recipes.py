"""Which objects a data set holds, and how each of them is acted on.

An object is known by its number alone, so that any worker can make it, and more objects begin with the same ones.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from foretrace.actions import Action, LeverUp, Push, sample_contacts, sample_pushes, sample_reachable_contacts
from foretrace.errors import SimulationError
from foretrace.objects import (
    CORNER_COUNTS,
    FOOTINGS,
    NO_BEVEL,
    Footed,
    ObjectModel,
    Prism,
    sample_dented,
    sample_look_alikes,
    sample_organic,
    sample_oval,
    sample_prism,
    sample_rounded,
    sample_sized_prism,
)
from foretrace.registry import Registry

LOOK_ALIKES = 3
"""Objects that share one outline."""
ROUND: dict[str, Callable[[np.random.Generator], Prism]] = {
    "oval": sample_oval,
    "rounded": sample_rounded,
    "organic": sample_organic,
    "dented": sample_dented,
}
"""Families of flat objects without edges to count, and how one of each is drawn."""
ROUND_EDGES = 4
"""Number of edges that count for them."""
SOLID_STREAM = 1
"""Tells the random numbers of the solids from those of prisms with the same number."""
PUSH_STREAM = 7
"""Tells the random numbers of pushes from those of the objects."""
EVERYDAY_STREAM = 3
"""Tells the random numbers of the sized prisms and round objects from those of the others."""


class Recipe(ABC):
    """Objects and actions of a data set; both depend on the arguments alone, so that any worker can make them."""

    @abstractmethod
    def count(self, object_index: int, per_edge: int) -> int:
        """Number of actions on an object.

        Args:
            object_index: Number of the object.
            per_edge: Actions at each edge that are asked for; what counts as an edge is up to the recipe.
        """

    @abstractmethod
    def make(self, seed: int, object_index: int, per_edge: int) -> tuple[ObjectModel, Sequence[Action]]:
        """An object and its actions, as many as `count` has.

        Args:
            seed: Seed of the data set.
            object_index: Number of the object.
            per_edge: As `count` has it.
        """


RECIPES: Registry[Recipe] = Registry("recipe", "foretrace.recipes", SimulationError)
"""Every recipe by its name; other packages add theirs."""


class _Place(NamedTuple):
    """Where an object stands in its recipe."""

    family: str
    turn: int
    """How many times all families have had their turn before."""
    member: int
    """How many of its own family come before it in its turn."""
    number: int
    """How many of its own family come before it in all."""


@dataclass(frozen=True)
class Families(Recipe):
    """Lever-ups of objects whose families take turns."""

    families: tuple[str, ...]
    """``prism``: random prisms of 3 to 10 corners (section 4). ``alike``: a lying cylinder, a box and a flat prism with
    one outline, levered at the same points (section 5.5). ``sized``: prisms of other sizes and heights. The others are
    `ROUND`."""

    def count(self, object_index: int, per_edge: int) -> int:
        """Number of lever-ups of an object."""
        return per_edge * self.num_edges(object_index)

    def num_edges(self, object_index: int) -> int:
        """Edges at which an object is levered, or as many as count for a round one.

        The prisms' counts take turns, so that any number of objects is spread evenly.
        """
        place = self._place(object_index)
        if place.family in ("prism", "sized"):
            return CORNER_COUNTS[place.number % len(CORNER_COUNTS)]
        return ROUND_EDGES

    def make(self, seed: int, object_index: int, per_edge: int) -> tuple[ObjectModel, list[LeverUp]]:
        """An object and its lever-ups; objects with one outline are levered at the same points."""
        place, edges = self._place(object_index), self.num_edges(object_index)
        family = place.family
        numbers = {"prism": [object_index], "alike": [place.turn, SOLID_STREAM]}
        stream = numbers.get(family, [object_index, EVERYDAY_STREAM])
        rng = np.random.default_rng(np.random.SeedSequence([seed, *stream]))
        if family in ROUND:
            obj = ROUND[family](rng)
            return obj, sample_reachable_contacts(obj, rng, per_edge * edges)
        if family == "alike":
            alike = sample_look_alikes(rng)
            obj, levered = alike[place.member], alike[0]
        else:
            obj = levered = (sample_prism if family == "prism" else sample_sized_prism)(rng, edges)
        return obj, sample_contacts(levered, rng, per_edge=per_edge)

    def _place(self, object_index: int) -> _Place:
        turn, k = divmod(object_index, len(self.families))
        family = self.families[k]
        member = self.families[:k].count(family)
        return _Place(family, turn, member, self.families.count(family) * turn + member)


PUSHED_THICKNESS = 0.013
"""Thickness of pushed objects [m]."""


@dataclass(frozen=True)
class Pushed(Recipe):
    """Pushes of flat plates on feet, whose outlines are those of another recipe's objects."""

    shapes: Families
    """The other recipe; of its objects the outlines count."""

    def count(self, object_index: int, per_edge: int) -> int:
        """Number of pushes of an object."""
        return self.shapes.count(object_index, per_edge)

    def make(self, seed: int, object_index: int, per_edge: int) -> tuple[ObjectModel, list[Push]]:
        """An object and its pushes, all round its outline and within a cone about the inward normal."""
        model = self.shapes.make(seed, object_index, per_edge)[0]
        rng = np.random.default_rng(np.random.SeedSequence([seed, object_index, PUSH_STREAM]))
        plate = Prism(model.corners, PUSHED_THICKNESS, NO_BEVEL)
        plate = Footed(plate, FOOTINGS[int(rng.integers(len(FOOTINGS)))])
        return plate, sample_pushes(plate, rng, self.count(object_index, per_edge))


RECIPES.add("paper", Families(("prism",)))
RECIPES.add("solids", Families(("alike",) * LOOK_ALIKES))
RECIPES.add("mixed", Families(("prism",) * 2 + ("alike",) * LOOK_ALIKES))
RECIPES.add("everyday", Families(("sized",) * 3 + ("alike",) * LOOK_ALIKES + tuple(ROUND)))
RECIPES.add("all", Families(("prism",) * 3 + ("sized",) * 3 + ("alike",) * LOOK_ALIKES + tuple(ROUND)))
RECIPES.add("pushes", Pushed(Families(("prism",) * 3 + tuple(ROUND))))


def first_actions(recipe: str, objects: int, per_edge: int) -> list[int]:
    """Number of the first action on each object, and at the end how many there are in all."""
    counts = (RECIPES[recipe].count(k, per_edge) for k in range(objects))
    return list(accumulate(counts, initial=0))


def object_and_actions(
    recipe: str, seed: int, object_index: int, per_edge: int
) -> tuple[ObjectModel, Sequence[Action]]:
    """An object of a recipe and its actions."""
    return RECIPES[recipe].make(seed, object_index, per_edge)
