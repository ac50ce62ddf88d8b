import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foretrace.trajectories import final_distance, mean_distance, rotation_error, warped_distance


def test_a_shifted_trajectory_is_off_by_the_shift():
    a = np.random.default_rng(0).normal(size=(4, 10, 3))
    b = a + np.array([0.03, 0.0, 0.04])
    np.testing.assert_allclose(mean_distance(a, b), 0.05)
    np.testing.assert_allclose(final_distance(a, b), 0.05)


def test_mean_and_final_distance_by_hand():
    a = np.zeros((3, 3))
    b = np.array([[0.0, 0, 0], [3, 4, 0], [0, 0, 1]])
    assert mean_distance(a, b) == pytest.approx(2.0)
    assert final_distance(a, b) == pytest.approx(1.0)


def test_samples_past_the_end_of_either_do_not_count():
    a = np.zeros((2, 4, 3))
    b = np.ones((2, 4, 3)) * np.array([1.0, 2.0, 3.0, 4.0])[:, None] / np.sqrt(3)
    a[0, 3] = np.nan
    b[0, 2:] = np.nan
    np.testing.assert_allclose(mean_distance(a, b), [1.5, 2.5])
    np.testing.assert_allclose(final_distance(a, b), [2.0, 4.0])


def test_nothing_shared_is_nan_without_a_warning():
    a = np.full((5, 3), np.nan)
    with np.errstate(all="raise"):
        assert np.isnan(mean_distance(a, np.zeros((5, 3))))
        assert np.isnan(final_distance(a, np.zeros((5, 3))))


def about_z(angle: float) -> np.ndarray:
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


@given(st.floats(-3, 3), st.floats(-np.pi, np.pi))
def test_rotation_error_is_the_angle_between(start: float, angle: float):
    error = rotation_error(about_z(start), about_z(start + angle))
    assert error == pytest.approx(abs(angle), abs=1e-7)
    assert rotation_error(about_z(start), -about_z(start + angle)) == pytest.approx(error, abs=1e-12)


def test_small_rotations_keep_their_digits():
    assert rotation_error(about_z(0.3), about_z(0.3 + 1e-6)) == pytest.approx(1e-6, rel=1e-6)


def test_rotation_error_of_many():
    a = np.stack([about_z(0.0), about_z(1.0)])
    np.testing.assert_allclose(rotation_error(a, a[::-1]), [1.0, 1.0])


def brute_force_cost(a, b):
    """The least sum of distances, by the recursion that defines it."""
    costs = np.full((len(a) + 1, len(b) + 1), np.inf)
    costs[0, 0] = 0
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            costs[i + 1, j + 1] = np.linalg.norm(x - y) + min(costs[i, j], costs[i, j + 1], costs[i + 1, j])
    return costs[-1, -1]


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 10**6))
def test_warping_finds_the_least_sum_and_its_path(m, n, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(m, 3)), rng.normal(size=(n, 3))
    distance, path = warped_distance(a, b)
    assert path[0].tolist() == [0, 0]
    assert path[-1].tolist() == [m - 1, n - 1]
    assert {tuple(step) for step in np.diff(path, axis=0)} <= {(0, 1), (1, 0), (1, 1)}
    along = np.linalg.norm(a[path[:, 0]] - b[path[:, 1]], axis=1)
    assert distance == pytest.approx(along.mean())
    assert along.sum() == pytest.approx(brute_force_cost(a, b))


def test_warping_takes_out_the_sampling_rate_but_not_the_distance():
    slow, fast = np.linspace(0, 1, 31), np.linspace(0, 1, 91) ** 2
    line = np.array([0.03, 0.04, 0.0])
    assert warped_distance(slow[:, None] * line, slow[:, None] * line).distance == 0
    assert warped_distance(slow[:, None] * line, fast[:, None] * line).distance < 0.001
    apart = slow[:, None] * line + np.array([0.0, 0.0, 0.01])
    assert warped_distance(apart, fast[:, None] * line).distance == pytest.approx(0.01, rel=0.02)


@pytest.mark.parametrize("bad", [np.zeros((0, 3)), np.array([[0.0, np.nan, 0.0]])])
def test_warping_refuses_what_is_missing(bad):
    with pytest.raises(ValueError, match="second trajectory has"):
        warped_distance(np.zeros((3, 3)), bad)
