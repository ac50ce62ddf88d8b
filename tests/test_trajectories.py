import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foretrace.trajectories import final_distance, mean_distance, rotation_error


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
