"""Who is training, validation and test data: by seed (paper, section 5), by object, by corner count."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from foretrace.errors import TrainingError, is_number, is_whole

PAPER_SIZES = (1400, 100, 300)
"""Training, validation and test interactions in the paper (section 5)."""
PAPER_FRACTIONS = (14 / 18, 1 / 18, 3 / 18)
"""The same as shares of the whole, for data sets of another size."""


@dataclass(frozen=True)
class Split:
    """Row numbers of three disjoint parts of a data set, each in rising order."""

    train: Int[np.ndarray, " train"]
    """Rows to learn from."""
    validation: Int[np.ndarray, " validation"]
    """Rows that choose the best epoch."""
    test: Int[np.ndarray, " test"]
    """Rows that are looked at once, at the end."""


def split_by_seed(n: int, seed: int, sizes: tuple[int, int, int] | None = PAPER_SIZES) -> Split:
    """Parts drawn at random, as in the paper.

    Args:
        n: Interactions in the data set.
        seed: Decides who is drawn.
        sizes: Interactions in each part; None for the paper's proportions whatever ``n`` is.

    Raises:
        TrainingError: The parts are larger than the data, one of them would be empty, or a number is none.
    """
    _check_whole("n", n, "the number of interactions, as len(dataset)")
    _check_whole("seed", seed, "a whole number from 0 on")
    sizes = scaled_sizes(n) if sizes is None else sizes
    if not isinstance(sizes, Sequence) or len(sizes) != 3:
        raise TrainingError(f"sizes is {sizes!r:.60}: give the sizes of three parts, or None")
    for size in sizes:
        _check_whole("a part's size", size, "a whole number")
    if sum(sizes) > n:
        raise TrainingError(
            f"a split of {sizes[0]} + {sizes[1]} + {sizes[2]} needs {sum(sizes)} interactions, the data has "
            f"{n}: simulate more objects, or use the paper's proportions of what there is (None, or no --split)"
        )
    _require_filled(*sizes)
    train, validation, test, _ = np.split(np.random.default_rng(seed).permutation(n), np.cumsum(sizes))
    return _ordered(train, validation, test)


def scaled_sizes(n: int, fractions: tuple[float, float, float] = PAPER_FRACTIONS) -> tuple[int, int, int]:
    """Sizes of three parts of ``n`` by shares that sum to 1; validation and test get at least one row each.

    Raises:
        TrainingError: Fewer than three interactions, or shares that do not sum to 1.
    """
    _check_whole("n", n, "the number of rows")
    if not isinstance(fractions, Sequence) or len(fractions) != 3 or not all(map(is_number, fractions)):
        raise TrainingError(f"the shares of a split are {fractions!r:.60}: give three numbers that sum to 1")
    if min(fractions) <= 0 or not np.isclose(sum(fractions), 1):
        raise TrainingError(f"the shares of a split must be positive and sum to 1, not {fractions}")
    if n < 3:
        raise TrainingError(f"{n} interactions cannot be split in three: simulate more objects")
    validation = max(1, round(fractions[1] * n))
    test = max(1, min(round(fractions[2] * n), n - validation - 1))
    return n - validation - test, validation, test


def split_by_object(
    object_ids: Int[np.ndarray, " n"],
    seed: int,
    fractions: tuple[float, float, float] = PAPER_FRACTIONS,
) -> Split:
    """Parts that share no object: what is tested was never seen, not even from another edge.

    Args:
        object_ids: Which object each interaction levered.
        seed: Decides which objects are drawn.
        fractions: Share of the objects in each part.

    Raises:
        TrainingError: Fewer than three objects, shares that do not sum to 1, or no numbers of objects.
    """
    _check_rows("object_ids", object_ids)
    _check_whole("seed", seed, "a whole number from 0 on")
    objects = np.random.default_rng(seed).permutation(np.unique(object_ids))
    if len(objects) < 3:
        raise TrainingError(f"{len(objects)} objects cannot be split in three: simulate more objects")
    parts = np.split(objects, np.cumsum(scaled_sizes(len(objects), fractions)))[:3]
    return _ordered(*(np.flatnonzero(np.isin(object_ids, part)) for part in parts))


def split_by_corner_count(
    num_corners: Int[np.ndarray, " n"],
    held_out: Collection[int],
    seed: int = 0,
    validation_share: float = 1 / 15,
) -> Split:
    """Test on some corner counts, learn from the others (paper, section 5.3).

    Args:
        num_corners: Corners of each interaction's object.
        held_out: Corner counts to test on, for example ``(3, 4)``.
        seed: Decides which of the others validate.
        validation_share: Share of the others that validates; the paper's 100 of 1500 by default.

    Raises:
        TrainingError: A corner count does not occur, or nothing is left to learn from.
    """
    _check_rows("num_corners", num_corners)
    _check_whole("seed", seed, "a whole number from 0 on")
    present = np.unique(num_corners).tolist()
    if absent := sorted(set(held_out) - set(present)):
        raise TrainingError(f"no object has {absent} corners to hold out; the data has {present}")
    is_test = np.isin(num_corners, list(held_out))
    others = np.random.default_rng(seed).permutation(np.flatnonzero(~is_test))
    count = max(1, round(validation_share * len(others)))
    _require_filled(len(others) - count, count, int(is_test.sum()))
    return _ordered(others[count:], others[:count], np.flatnonzero(is_test))


def _check_whole(name: str, value: object, wanted: str) -> None:
    if not is_whole(value, 0, 2**63 - 1):
        given = f"{value}" if is_number(value) else f"of type {type(value).__name__}"
        raise TrainingError(f"{name} {'is ' if is_number(value) else ''}{given}: give {wanted}")


def _check_rows(name: str, values: object) -> None:
    array = (
        values if isinstance(values, np.ndarray) else np.asarray(values if isinstance(values, list) else 0)
    )
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise TrainingError(
            f"{name} of type {type(values).__name__}: give an array of whole numbers, as batch.{name}"
        )


def _require_filled(*sizes: int) -> None:
    if min(sizes) < 1:
        names = ("training", "validation", "test")
        parts = ", ".join(f"{size} {name}" for size, name in zip(sizes, names, strict=True))
        raise TrainingError(
            f"every part of a split needs an interaction, this one has {parts}: simulate more objects"
        )


def _ordered(train: np.ndarray, validation: np.ndarray, test: np.ndarray) -> Split:
    return Split(np.sort(train), np.sort(validation), np.sort(test))
