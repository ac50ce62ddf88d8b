import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foretrace.errors import TrainingError
from foretrace.interactions.splits import (
    PAPER_SIZES,
    Split,
    scaled_sizes,
    split_by_corner_count,
    split_by_object,
    split_by_seed,
)


def check_disjoint(split: Split, n: int) -> None:
    together = np.concatenate([split.train, split.validation, split.test])
    assert len(np.unique(together)) == len(together)
    assert together.min() >= 0
    assert together.max() < n
    for part in (split.train, split.validation, split.test):
        assert len(part) > 0
        assert np.all(np.diff(part) > 0)


@settings(deadline=None)
@given(n=st.integers(3, 3000), seed=st.integers(0, 2**32 - 1))
def test_split_by_seed_in_proportion_is_disjoint_and_complete(n, seed):
    split = split_by_seed(n, seed, sizes=None)
    check_disjoint(split, n)
    assert len(split.train) + len(split.validation) + len(split.test) == n


@settings(deadline=None)
@given(sizes=st.tuples(*[st.integers(1, 50)] * 3), spare=st.integers(0, 50), seed=st.integers(0, 1000))
def test_split_by_seed_keeps_the_sizes_asked_for(sizes, spare, seed):
    split = split_by_seed(sum(sizes) + spare, seed, sizes)
    check_disjoint(split, sum(sizes) + spare)
    assert (len(split.train), len(split.validation), len(split.test)) == sizes


def test_split_by_seed_is_decided_by_the_seed():
    assert np.array_equal(split_by_seed(2000, 1).test, split_by_seed(2000, 1).test)
    assert not np.array_equal(split_by_seed(2000, 1).test, split_by_seed(2000, 2).test)


def test_split_larger_than_the_data_names_numbers_and_remedy():
    with pytest.raises(TrainingError, match=r"1400 \+ 100 \+ 300 needs 1800 .* has 1799: simulate more"):
        split_by_seed(1799, 0)
    with pytest.raises(TrainingError, match="0 validation"):
        split_by_seed(100, 0, (50, 0, 50))


def test_scaled_sizes_are_the_papers_proportions():
    assert scaled_sizes(1800) == PAPER_SIZES
    assert scaled_sizes(180) == (140, 10, 30)
    assert scaled_sizes(3) == (1, 1, 1)
    with pytest.raises(TrainingError, match="2 interactions"):
        scaled_sizes(2)
    with pytest.raises(TrainingError, match="sum to 1"):
        scaled_sizes(10, (0.5, 0.2, 0.2))


@settings(deadline=None)
@given(data=st.data(), num_objects=st.integers(3, 40), seed=st.integers(0, 1000))
def test_split_by_object_shares_no_object(data, num_objects, seed):
    repeats = data.draw(st.lists(st.integers(1, 5), min_size=num_objects, max_size=num_objects))
    object_ids = np.repeat(np.arange(num_objects) * 7, repeats)
    split = split_by_object(object_ids, seed)
    check_disjoint(split, len(object_ids))
    parts = [set(object_ids[part]) for part in (split.train, split.validation, split.test)]
    assert sum(map(len, parts)) == num_objects
    assert len(parts[0] | parts[1] | parts[2]) == num_objects


def test_split_by_object_needs_three_objects():
    with pytest.raises(TrainingError, match="2 objects"):
        split_by_object(np.array([0, 0, 1]), 0)


@settings(deadline=None)
@given(seed=st.integers(0, 1000), held_out=st.sets(st.integers(3, 10), min_size=1, max_size=7))
def test_split_by_corner_count_tests_exactly_the_held_out(seed, held_out):
    num_corners = np.tile(np.arange(3, 11), 20)
    split = split_by_corner_count(num_corners, held_out, seed)
    check_disjoint(split, len(num_corners))
    assert set(num_corners[split.test]) == held_out
    assert len(split.test) == 20 * len(held_out)
    assert not held_out & set(num_corners[np.concatenate([split.train, split.validation])])


def test_split_by_corner_count_refuses_what_is_not_there():
    with pytest.raises(TrainingError, match=r"no object has \[12\] corners"):
        split_by_corner_count(np.array([3, 4, 5]), (3, 12))
    with pytest.raises(TrainingError, match="0 training"):
        split_by_corner_count(np.array([3, 3, 4]), (3,))
