"""Calls into the package are checked while tests run: types, shapes, and axes of the same name."""

from dataclasses import dataclass

import jaxtyping
import numpy as np
import pytest
from jaxtyping import Float

from foretrace.geometry import rotate_plane
from type_checks import jaxtyped

Points = Float[np.ndarray, "n 3"]


@jaxtyped(typechecker=None)
def shift(points: Points, by: Points, times: int = 1, wrong: bool = False) -> Points:
    moved = points + times * by
    return moved[:-1] if wrong else moved


@jaxtyped(typechecker=None)
@dataclass
class Cloud:
    points: Points
    weight: Float[np.ndarray, " n"]
    name: "str | Nowhere" = ""


def test_arguments_and_results_are_checked():
    ones = np.ones((4, 3))
    assert shift(ones, ones).shape == (4, 3)
    for wrong in ((ones, ones[:1]), (ones[:, :2], ones[:, :2]), (ones, ones, 1.5), (ones, ones.astype(int))):
        with pytest.raises(jaxtyping.TypeCheckError):
            shift(*wrong)
    with pytest.raises(jaxtyping.TypeCheckError):
        shift(ones, ones, wrong=True)
    shift(ones[:2], ones[:2])  # axes are those of one call


def test_fields_are_checked():
    assert Cloud(np.ones((2, 3)), np.ones(2), name="both").name == "both"
    with pytest.raises(jaxtyping.TypeCheckError):
        Cloud(np.ones((2, 3)), np.ones(3))


def test_the_package_is_checked():
    with pytest.raises(jaxtyping.TypeCheckError):
        rotate_plane("points", 0.1)


def test_checks_can_be_switched_off(untyped):
    assert shift(np.ones((4, 3)), np.ones((1, 3))).shape == (4, 3)
