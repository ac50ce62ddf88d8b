"""The rendered view agrees with the exact one; machines that cannot render are told what to do."""

import cv2
import numpy as np
import pytest

from foretrace.actions import LeverUp, sample_contacts
from foretrace.errors import SimulationError
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import paper_objects
from foretrace.simulation import camera
from foretrace.simulation.camera import RgbdConfig, take_rgbd


@pytest.fixture(scope="module")
def renderer() -> None:
    obj = paper_objects(0, 1)[0]
    try:
        take_rgbd(obj, LeverUp.at_edge(obj, 0))
    except SimulationError as error:
        pytest.skip(str(error))


def outline_distance(a: TopDownView, b: TopDownView) -> float:
    """Largest distance of a contour point of one view from the other's contour, both ways [pixel]."""
    worst = 0.0
    for one, other in ((a, b), (b, a)):
        edge = cv2.morphologyEx(other.mask.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
        distance = cv2.distanceTransform(1 - edge, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        rim = one.mask & (cv2.erode(one.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
        worst = max(worst, float(distance[rim].max()))
    return worst


@pytest.mark.usefixtures("renderer")
@pytest.mark.parametrize("index", [0, 3, 7])
def test_rendered_and_exact_view_agree_within_a_pixel(index: int) -> None:
    obj = paper_objects(2, 1)[index]
    action = sample_contacts(obj, np.random.default_rng(index))[1]
    rendered, exact = take_rgbd(obj, action, seed=5).view(), TopDownView.of(obj, action)
    assert outline_distance(rendered, exact) <= 1.0
    # No swelling: as many pixels too many as too few, up to a tenth of the outline's length.
    excess = int(rendered.mask.sum()) - int(exact.mask.sum())
    assert abs(excess) < 0.02 * exact.mask.sum()
    both = rendered.mask & exact.mask
    assert np.abs(rendered.height - exact.height)[both].mean() < 0.001


@pytest.mark.usefixtures("renderer")
def test_noise_is_seeded() -> None:
    obj = paper_objects(2, 1)[4]
    action = LeverUp.at_edge(obj, 1)
    first, same, other = (take_rgbd(obj, action, seed=seed).depth for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, same)
    assert not np.array_equal(first, other)
    clean = take_rgbd(obj, action, RgbdConfig(noise=0.0)).depth
    assert clean.max() == pytest.approx(0.75, abs=1e-3)
    assert clean.min() == pytest.approx(0.75 - obj.height, abs=1e-3)


def test_deprojection_inverts_projection() -> None:
    pinhole = PinholeCamera(8, 6, 10.0, 12.0, 3.5, 2.5)
    depth = np.zeros((6, 8))
    depth[4, 7] = 2.0
    depth[1, 2] = np.nan
    T = np.eye(4)
    T[:3, 3] = [1.0, 2.0, 3.0]
    points = pinhole.deproject(depth, T)
    np.testing.assert_allclose(points, [[1 + 0.35 * 2, 2 + 0.125 * 2, 5.0]])


def test_without_egl_and_osmesa_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera, "_loads", lambda library: False)
    monkeypatch.setattr(camera.sys, "platform", "linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    obj = paper_objects(0, 1)[0]
    with pytest.raises(SimulationError, match="install libegl1"):
        take_rgbd(obj, LeverUp.at_edge(obj, 0))
