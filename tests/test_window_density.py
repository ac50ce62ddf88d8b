"""The density of windows of successes, a baseline of monitors."""

import numpy as np
from scipy.spatial import KDTree

from foretrace.experiments.window_density import NEIGHBOURS, unlikeness, windows_of

REST = np.array([0.1, 0.0, 0.01, 1.0, 0, 0, 0])
UP = np.array([0, 0, 0.001, 0, 0, 0, 0])


def test_motions_like_those_of_successes_are_likelier_than_others_and_later_ones():
    rises = [[REST + k * speed * UP for k in range(40)] for speed in (0.9, 0.95, 1.0, 1.05, 1.1)]
    known = KDTree(np.concatenate([windows_of(each) for each in rises]))
    like = unlikeness([REST + k * 1.01 * UP for k in range(40)], known)
    still = unlikeness([REST] * 40, known)
    late = unlikeness([REST] * 10 + [REST + k * UP for k in range(30)], known)
    assert len(rises) == NEIGHBOURS
    assert like < 0.3 * late < 0.3 * still


def test_lost_poses_count_as_those_before():
    whole = [REST + k * UP for k in range(20)]
    gaps = [None if k in (7, 8) else pose for k, pose in enumerate(whole)]
    filled = [whole[6] if k in (7, 8) else pose for k, pose in enumerate(whole)]
    np.testing.assert_array_equal(windows_of(gaps), windows_of(filled))
    assert windows_of(whole[:5]).shape == (0, 25)
