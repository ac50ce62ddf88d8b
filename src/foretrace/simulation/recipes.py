"""Which objects a data set holds, and where they are levered.

An object is known by its number alone, so that any worker can make it, and more objects begin with the same ones.
"""

from itertools import accumulate

import numpy as np

from foretrace.actions import LeverUp, sample_contacts
from foretrace.objects import CORNER_COUNTS, ObjectModel, sample_look_alikes, sample_prism

RECIPES = ("paper", "solids", "mixed")
"""``paper``: random prisms of 3 to 10 corners in turn (section 4). ``solids``: lying cylinders, boxes and flat prisms,
always three with one outline, levered at the same points (section 5.5). ``mixed``: two prisms, then three solids."""
LOOK_ALIKES = 3
"""Objects that share one outline."""
PRISMS_IN_TURN = 2
"""Prisms between two triples of solids in the mixed recipe."""
SOLID_STREAM = 1
"""Tells the random numbers of the solids from those of prisms with the same number."""


def _place(recipe: str, object_index: int) -> tuple[int, int | None]:
    """Number of a prism and None, or number of a triple of solids and the place within it."""
    if recipe == "paper":
        return object_index, None
    if recipe == "solids":
        return divmod(object_index, LOOK_ALIKES)
    turn, place = divmod(object_index, PRISMS_IN_TURN + LOOK_ALIKES)
    if place < PRISMS_IN_TURN:
        return PRISMS_IN_TURN * turn + place, None
    return turn, place - PRISMS_IN_TURN


def num_corners(recipe: str, object_index: int) -> int:
    """Corners of an object: the prisms' counts take turns, so that any number of objects is spread evenly."""
    number, place = _place(recipe, object_index)
    return CORNER_COUNTS[number % len(CORNER_COUNTS)] if place is None else 4


def first_contacts(recipe: str, objects: int, contacts_per_edge: int) -> list[int]:
    """Number of the first lever-up of each object, and at the end how many there are in all."""
    counts = (contacts_per_edge * num_corners(recipe, k) for k in range(objects))
    return list(accumulate(counts, initial=0))


def object_and_actions(
    recipe: str, seed: int, object_index: int, contacts_per_edge: int
) -> tuple[ObjectModel, list[LeverUp]]:
    """An object and its lever-ups; objects with one outline are levered at the same points."""
    number, place = _place(recipe, object_index)
    if place is None:
        rng = np.random.default_rng(np.random.SeedSequence([seed, object_index]))
        prism = sample_prism(rng, num_corners(recipe, object_index))
        return prism, sample_contacts(prism, rng, per_edge=contacts_per_edge)
    rng = np.random.default_rng(np.random.SeedSequence([seed, number, SOLID_STREAM]))
    alike = sample_look_alikes(rng)
    return alike[place], sample_contacts(alike[0], rng, per_edge=contacts_per_edge)
