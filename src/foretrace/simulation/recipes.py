"""Which objects a data set holds, and where they are levered.

An object is known by its number alone, so that any worker can make it, and more objects begin with the same ones.
"""

from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from foretrace.actions import LeverUp, sample_contacts, sample_reachable_contacts
from foretrace.objects import (
    CORNER_COUNTS,
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
"""They are levered at as many points as an object of so many edges."""
RECIPES = {
    "paper": ("prism",),
    "solids": ("alike",) * LOOK_ALIKES,
    "mixed": ("prism",) * 2 + ("alike",) * LOOK_ALIKES,
    "everyday": ("sized",) * 3 + ("alike",) * LOOK_ALIKES + tuple(ROUND),
}
"""Families that take turns. ``prism``: random prisms of 3 to 10 corners (section 4). ``alike``: a lying cylinder, a box
and a flat prism with one outline, levered at the same points (section 5.5). ``sized``: prisms of other sizes and
heights. The others are `ROUND`."""
SOLID_STREAM = 1
"""Tells the random numbers of the solids from those of prisms with the same number."""
EVERYDAY_STREAM = 3
"""Tells the random numbers of the sized prisms and round objects from those of the others."""


class _Place(NamedTuple):
    """Where an object stands in its recipe."""

    family: str
    turn: int
    """How many times all families have had their turn before."""
    member: int
    """How many of its own family come before it in its turn."""
    number: int
    """How many of its own family come before it in all."""


def _place(recipe: str, object_index: int) -> _Place:
    families = RECIPES[recipe]
    turn, k = divmod(object_index, len(families))
    member = families[:k].count(families[k])
    return _Place(families[k], turn, member, families.count(families[k]) * turn + member)


def num_edges(recipe: str, object_index: int) -> int:
    """Edges at which an object is levered, or as many as count for a round one.

    The prisms' counts take turns, so that any number of objects is spread evenly.
    """
    place = _place(recipe, object_index)
    if place.family in ("prism", "sized"):
        return CORNER_COUNTS[place.number % len(CORNER_COUNTS)]
    return ROUND_EDGES


def first_contacts(recipe: str, objects: int, contacts_per_edge: int) -> list[int]:
    """Number of the first lever-up of each object, and at the end how many there are in all."""
    counts = (contacts_per_edge * num_edges(recipe, k) for k in range(objects))
    return list(accumulate(counts, initial=0))


def object_and_actions(
    recipe: str, seed: int, object_index: int, contacts_per_edge: int
) -> tuple[ObjectModel, list[LeverUp]]:
    """An object and its lever-ups; objects with one outline are levered at the same points."""
    place, edges = _place(recipe, object_index), num_edges(recipe, object_index)
    if place.family == "alike":
        rng = np.random.default_rng(np.random.SeedSequence([seed, place.turn, SOLID_STREAM]))
        alike = sample_look_alikes(rng)
        return alike[place.member], sample_contacts(alike[0], rng, per_edge=contacts_per_edge)
    if place.family == "prism":
        rng = np.random.default_rng(np.random.SeedSequence([seed, object_index]))
        prism = sample_prism(rng, edges)
        return prism, sample_contacts(prism, rng, per_edge=contacts_per_edge)
    rng = np.random.default_rng(np.random.SeedSequence([seed, object_index, EVERYDAY_STREAM]))
    if place.family == "sized":
        prism = sample_sized_prism(rng, edges)
        return prism, sample_contacts(prism, rng, per_edge=contacts_per_edge)
    obj = ROUND[place.family](rng)
    return obj, sample_reachable_contacts(obj, rng, contacts_per_edge * edges)
