"""The camera_info of a bag: by the name of its model, of the images' own camera, or a reason why it is none."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from foretrace.errors import PerceptionError
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.camera_info import Images, Info, camera_of

K = [500.0, 0.0, 330.0, 0.0, 510.0, 230.0, 0.0, 0.0, 1.0]
P = [430.0, 0.0, 300.0, 0.0, 0.0, 440.0, 250.0, 0.0, 0.0, 0.0, 1.0, 0.0]
LENS = [-0.3, 0.1, 0.001, -0.002, 0.05, 0.2, 0.01, 0.002, 0.001, -0.001, 0.002, 0.0005, 0.01, -0.02]
IMAGES = Images("/cam/image_raw", "cam", (640, 480))


def info(topic: str = "/cam/camera_info", frame: str = "cam", **changed: Any) -> Info:
    x, y, width, height = changed.pop("roi", (0, 0, 0, 0))
    roi = SimpleNamespace(x_offset=x, y_offset=y, width=width, height=height)
    values: dict[str, Any] = {"width": 640, "height": 480, "distortion_model": "plumb_bob", "binning_x": 0}
    values |= {"binning_y": 0, "d": [], "k": K, "p": [0.0] * 12, "roi": roi} | changed
    return Info(topic, SimpleNamespace(header=SimpleNamespace(frame_id=frame), **values))


@pytest.mark.parametrize(
    ("model", "count"),
    [
        ("plumb_bob", 0),
        ("plumb_bob", 4),
        ("plumb_bob", 5),
        ("plumb_bob", 8),
        ("radtan", 4),
        ("rational_polynomial", 5),
        ("rational_polynomial", 8),
        ("rational_polynomial", 12),
        ("rational_polynomial", 14),
        ("equidistant", 4),
        ("Kannala Brandt4", 4),
        ("", 0),
        ("none", 0),
        ("Inverse Brown Conrady", 0),
    ],
)
def test_points_are_where_the_model_puts_them(model: str, count: int) -> None:
    camera = camera_of(IMAGES, [info(distortion_model=model, d=LENS[:count])])
    points = np.array([[0.1, -0.05, 0.6], [0.3, 0.2, 0.7], [-0.25, 0.1, 0.5]])
    project = cv2.fisheye.projectPoints if camera.fisheye else cv2.projectPoints
    matrix, lens = np.reshape(K, (3, 3)), np.array(LENS[:count] or np.zeros(4))
    pixels = project(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, lens)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(points, np.eye(4)), pixels, atol=1e-9)
    np.testing.assert_allclose(camera.rays(pixels)[:, :2], points[:, :2] / points[:, 2:], atol=1e-4)
    assert camera.fisheye == ("annala" in model or "equi" in model)


def test_a_fisheye_lens_bends_without_coefficients_too() -> None:
    camera = camera_of(IMAGES, [info(distortion_model="equidistant", d=[0.0] * 4)])
    np.testing.assert_allclose(
        camera.project(np.array([[1.0, 0, 1]]), np.eye(4))[0], [330 + 500 * np.pi / 4, 230]
    )


def test_zeros_at_the_end_change_nothing() -> None:
    for model in ("radtan", "equidistant"):
        short, long = (info(d=LENS[:4] + more, distortion_model=model) for more in ([], [0.0] * 4))
        assert camera_of(IMAGES, [long]) == camera_of(IMAGES, [short])


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"k": [0.0] * 9}, "not calibrated"),
        ({"width": 0, "height": 0}, "not calibrated .all zeros, 0 x 0"),
        ({"k": [np.nan, *K[1:]]}, "fx = nan"),
        ({"k": [-500.0, *K[1:]]}, "fx = -500.0, it must be positive"),
        ({"k": [*K[:4], 1e200, *K[5:]]}, r"fy = 1e\+200 pixels: at most 1e\+07 are believed"),
        ({"k": [1.0, 0, 0, 0, 1, 0, 0, 0, 1]}, "not calibrated .focal length of 1 pixels"),
        ({"k": [500.0, 3.0, *K[2:]]}, "skew is 3 pixels"),
        ({"d": LENS[:3]}, r"plumb_bob with coefficients \[-0.3, 0.1, 0.001\]: it has 4 or 5 or 8"),
        ({"d": LENS[:8], "distortion_model": "radtan"}, "it has 4 or 5 finite ones"),
        ({"d": [np.nan] * 5}, "14 finite ones"),
        ({"d": LENS[:5], "distortion_model": "equidistant"}, "equidistant .* it has 4 finite"),
        ({"d": LENS[:6], "distortion_model": "rational_polynomial"}, "it has 4 or 5 or 8 or 12 or 14"),
        ({"d": LENS[:4], "distortion_model": ""}, "no distortion model has coefficients"),
        ({"d": LENS[:4], "distortion_model": "none"}, "model 'none' has coefficients"),
        ({"d": LENS[:5], "distortion_model": "double_sphere"}, "'double_sphere' is none of plumb_bob"),
        ({"distortion_model": "fov"}, "'fov' is none of plumb_bob"),
        ({"width": 1280, "height": 960}, "of images of 1280 x 960 pixels, these have 640 x 480"),
        ({"binning_x": 2, "binning_y": 2}, "of images of 320 x 240 pixels"),
        ({"roi": (0, 0, 320, 240)}, "of images of 320 x 240 pixels"),
        ({"p": [0.0] * 11}, "P has 11 numbers"),
    ],
)
def test_what_cannot_be_used_is_told(changed: dict[str, Any], reason: str) -> None:
    with pytest.raises(PerceptionError, match=rf"/cam/camera_info: .*{reason}"):
        camera_of(IMAGES, [info(**changed)])


@pytest.mark.parametrize("topic", ["/cam/image_rect", "/cam/image_rect_color", "/cam/rectified/compressed"])
def test_rectified_images_are_of_the_matrix_p(topic: str) -> None:
    images = Images(topic, "cam", (640, 480))
    for model in ("plumb_bob", "equidistant", "double_sphere"):
        camera = camera_of(images, [info(d=LENS[:4], p=P, distortion_model=model)])
        assert camera == PinholeCamera(640, 480, 430.0, 440.0, 300.0, 250.0)
    assert camera_of(images, [info()]) == PinholeCamera(640, 480, 500.0, 510.0, 330.0, 230.0)
    with pytest.raises(PerceptionError, match="no matrix P for rectified images"):
        camera_of(images, [info(d=LENS[:4])])


def test_a_topic_whose_name_only_sounds_rectified_is_raw() -> None:
    assert (
        camera_of(Images("/direct/image_raw", "", (640, 480)), [info("/direct/camera_info", p=P)]).fx == 500
    )


def test_binned_pixels_and_a_part_of_the_sensor() -> None:
    """A point is seen in the pixel into which the sensor's pixel went."""
    part = info(width=1280, height=960, d=LENS[:5], roi=(100, 40, 1000, 800), binning_x=2, binning_y=4)
    camera = camera_of(Images("/cam/image_raw", "cam", (500, 200)), [part])
    whole = camera_of(
        Images("/cam/image_raw", "cam", (1280, 960)), [info(width=1280, height=960, d=LENS[:5])]
    )
    points = np.array([[0.1, -0.05, 0.6], [0.1, 0.2, 0.7]])
    sensor = whole.project(points, np.eye(4)) + 0.5
    expected = (sensor - [100, 40]) / [2, 4] - 0.5
    np.testing.assert_allclose(camera.project(points, np.eye(4)), expected, atol=1e-9)


OTHER = [390.0, 0.0, 318.0, 0.0, 390.0, 236.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("topic", "right", "others"),
    [
        (
            "/camera/color/image_raw",
            "/camera/color/camera_info",
            ["/camera/depth/camera_info", "/camera/camera_info"],
        ),
        ("/camera/color/image_raw/compressed", "/camera/color/camera_info", ["/camera/camera_info"]),
        ("/camera/image_raw/theora", "/camera/camera_info", ["/camera_info"]),
        ("/camera/compressed", "/camera/camera_info", ["/camera_info"]),
        ("/image_raw", "/camera_info", ["/cam/camera_info"]),
        ("/image_raw/compressed", "/camera_info", ["/image/camera_info"]),
        ("/cam1/image_raw", "/cam1/camera_info", ["/cam10/camera_info", "/cam/camera_info"]),
        ("/cam10/image_raw", "/cam10/camera_info", ["/cam1/camera_info"]),
        ("image_raw", "camera_info", ["/cam/camera_info"]),
    ],
)
@pytest.mark.parametrize("frame", ["", "cam"])
def test_the_camera_info_beside_the_images_counts(
    topic: str, right: str, others: list[str], frame: str
) -> None:
    infos = sorted([info(right, frame), *(info(other, frame, k=OTHER) for other in others)])
    assert camera_of(Images(topic, frame, (640, 480)), infos).fx == 500


def test_a_slash_before_a_frame_says_nothing() -> None:
    images = Images("/cam/image_raw", "/cam", (640, 480))
    for topic in ("/cam/camera_info", "/elsewhere/camera_info"):
        assert camera_of(images, [info(topic, "cam")]) == camera_of(IMAGES, [info(topic, "/cam")])


def test_elsewhere_the_frame_must_be_the_same() -> None:
    images = Images("/camera/color/image_raw", "color", (640, 480))
    depth = info("/camera/depth/camera_info", "depth", k=OTHER)
    aligned = info("/camera/aligned_depth_to_color/camera_info", "color")
    assert camera_of(images, [depth, aligned]).fx == 500
    with pytest.raises(
        PerceptionError,
        match=r"no camera_info belongs to /camera/color/image_raw .frame 'color'.: "
        r"/camera/depth/camera_info .frame 'depth'.",
    ):
        camera_of(images, [depth])
    with pytest.raises(PerceptionError, match="there is no camera_info"):
        camera_of(images, [])
    with pytest.raises(PerceptionError, match="no camera_info belongs"):
        camera_of(Images("/a/image", "", (640, 480)), [info("/b/camera_info", "")])
    with pytest.raises(PerceptionError, match="of frame 'depth', /camera/color/image_raw of 'color'"):
        camera_of(images, [info("/camera/color/camera_info", "depth")])
    with pytest.raises(PerceptionError, match="/a/camera_info, /b/camera_info differ"):
        camera_of(images, [info("/a/camera_info", "color"), info("/b/camera_info", "color", k=OTHER)])


def test_the_other_camera_of_a_stereo_pair_is_another_one() -> None:
    """Both may name the frame of the left one."""
    left, right = (
        Images("/left/image_raw", "pair", (640, 480)),
        Images("/right/image_raw", "pair", (640, 480)),
    )
    shifted = [*P[:3], -43.0, *P[4:]]
    for images, one in (
        (left, info("/right/camera_info", "pair")),
        (right, info("/left/camera_info", "pair")),
        (left, info("/second/camera_info", "pair", p=shifted)),
    ):
        with pytest.raises(PerceptionError, match="no camera_info belongs"):
            camera_of(images, [one])
    assert camera_of(right, [info("/right/camera_info", "pair", p=shifted)]).fx == 500
