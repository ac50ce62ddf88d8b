"""Camera files of other tools, and the fisheye lens: in files, from pixels to rays and back, in poses of markers."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from foretrace.errors import PerceptionError
from foretrace.geometry import invert_transform
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.markers import Detections, MarkerBody, square, to_transform
from foretrace.perception.tracking import still_pose

FISHEYE = PinholeCamera(1280, 720, 500.0, 500.0, 640.0, 360.0, (0.08, -0.01, 0.004, -0.002), fisheye=True)
OST = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [512.25, 0, 321.5, 0, 511.5, 243, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.25, 5e-2, 0.001, 0, 1e-05]}
projection_matrix: {rows: 3, cols: 4, data: [500, 0, 300, 0, 0, 500, 200, 0, 0, 0, 1, 0]}
"""
KALIBR = """\
cam0:
  camera_model: pinhole
  distortion_coeffs: [0.08, -0.01, 0.004, -0.002]
  distortion_model: equidistant
  intrinsics: [500.0, 500.0, 640.0, 360.0]
  resolution: [1280, 720]
  rostopic: /cam0/image_raw
"""


def read(folder: Path, text: str) -> PinholeCamera:
    path = folder / "camera.yaml"
    path.write_text(text, encoding="utf-8")
    return PinholeCamera.load(path)


def test_a_file_of_ros(tmp_path: Path) -> None:
    camera = PinholeCamera(640, 480, 512.25, 511.5, 321.5, 243.0, (-0.25, 0.05, 0.001, 0.0, 1e-05))
    assert read(tmp_path, OST) == camera
    assert read(tmp_path, "\ufeff" + OST.replace("\n", "\r\n")) == camera
    fisheye = OST.replace("plumb_bob", "equidistant").replace(", 1e-05]", "]")
    assert read(tmp_path, fisheye).fisheye


def test_a_file_of_kalibr(tmp_path: Path) -> None:
    assert read(tmp_path, KALIBR) == FISHEYE
    radtan = KALIBR.replace("equidistant", "radtan")
    assert read(tmp_path, radtan).distortion == FISHEYE.distortion
    assert not read(tmp_path, radtan).fisheye


@pytest.mark.parametrize("header", ["%YAML:1.0\n---\n", "%YAML 1.2\n---\n"])
@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_a_file_of_opencv(tmp_path: Path, header: str, count: int) -> None:
    lens = 0.01 * np.arange(1, count + 1)
    storage = cv2.FileStorage(str(tmp_path / "made.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 640), ("image_height", 480)):
        storage.write(name, value)
    storage.write("camera_matrix", np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]))
    storage.write("distortion_coefficients", lens[None])
    storage.release()
    body = (tmp_path / "made.yml").read_text().split("---\n")[1]
    camera = read(tmp_path, header + body)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 501, 320, 240)
    np.testing.assert_allclose(camera.distortion, lens)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "holds no camera"),
        ("- 1\n- 2", "holds no camera"),
        ("a: [1, 2", "cannot be read as YAML .* in line 1"),
        (
            "!!python/object/apply:os.system [echo]",
            "cannot be read as YAML .could not determine a constructor",
        ),
        ("a: " + "[" * 5000, "cannot be read as YAML"),
        ("a: 1", "lacks image_width"),
        (OST.replace("camera_matrix", "matrix"), "lacks camera_matrix"),
        (OST.replace("512.25, 0", "512.25, x"), "a value that is no number"),
        (OST.replace("image_width: 640", "image_width: .inf"), "a value that is no number"),
        (OST.replace("512.25, 0", "512.25, 7"), "a skew of 7 pixels"),
        (OST.replace("512.25, 0", "512.25"), "camera matrix of 8 numbers"),
        (
            OST.replace("plumb_bob", "double_sphere"),
            "camera.yaml: distortion model 'double_sphere' is none of",
        ),
        (OST.replace("plumb_bob", "equidistant"), "equidistant with coefficients .* it has 4"),
        (KALIBR.replace("pinhole", "omni"), "camera model 'omni'"),
        (KALIBR + KALIBR.replace("cam0", "cam1"), "has the cameras cam0, cam1: keep the one"),
        (KALIBR.replace("640.0, ", ""), "a value that is no number"),
        (" " * (1 << 20) + OST, "too large for a camera"),
    ],
)
def test_files_that_hold_no_camera(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(PerceptionError, match=reason) as told:
        read(tmp_path, text)
    assert "\n" not in str(told.value)
    with pytest.raises(PerceptionError, match=r"none.yaml does not exist"):
        PinholeCamera.load(tmp_path / "none.yaml")


def test_a_fisheye_lens_in_a_file_and_back(tmp_path: Path) -> None:
    FISHEYE.save(tmp_path / "camera.json")
    assert PinholeCamera.load(tmp_path / "camera.json") == FISHEYE
    assert FISHEYE.to_dict()["version"] == 2  # readers of version 1 know no fisheye lens
    assert "fisheye" not in PinholeCamera().to_dict()
    assert FISHEYE.scaled(2.0).fisheye


def test_a_fisheye_lens_is_opencv_s() -> None:
    points = np.array([[0.3, 0.1, 0.5], [-0.7, 0.2, 0.4], [0.0, 0.0, 1.0]])
    pixels, slopes = FISHEYE.project_with_slopes(points)
    known, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), FISHEYE.matrix, np.array(FISHEYE.distortion)
    )
    np.testing.assert_allclose(pixels, known[:, 0], atol=1e-9)
    np.testing.assert_allclose(FISHEYE.rays(pixels), points / points[:, 2:], atol=1e-6)
    for axis in range(3):
        moved = FISHEYE.project_with_slopes(points + 1e-6 * np.eye(3)[axis])[0]
        np.testing.assert_allclose(slopes[:, :, axis], (moved - pixels) / 1e-6, atol=0.01)


@pytest.mark.parametrize(
    "camera",
    [
        FISHEYE,
        PinholeCamera(640, 480, 500.0, 510.0, 330.0, 230.0, (-0.3, 0.1, 0.001, -0.002, 0.05)),
        PinholeCamera(
            640,
            480,
            500.0,
            510.0,
            330.0,
            230.0,
            (-0.3, 0.1, 0.001, 0.0, 0.05, 0.02, 0.01, 0.0, 0.001, 0.0, 0.0, 0.002),
        ),
    ],
    ids=["fisheye", "5", "12"],
)
def test_a_plane_is_laid_out_as_it_is_projected(camera: PinholeCamera) -> None:
    rays = np.array([[0.001, 0.0, -0.2], [0.0, 0.001, -0.15], [0.0, 0.0, 0.6]])
    columns, rows = camera.undistortion(rays, (400, 300))
    here = np.array([[3.0, 5.0, 1.0], [390.0, 20.0, 1.0], [200.0, 290.0, 1.0]])
    found = [[columns[int(y), int(x)], rows[int(y), int(x)]] for x, y, _ in here]
    np.testing.assert_allclose(found, camera.project(here @ rays.T, np.eye(4)), atol=1e-3)


@pytest.mark.parametrize("x", [0.0, 0.3, 0.6])
def test_a_marker_far_off_the_axis_of_a_fisheye_lens(x: float) -> None:
    turn = np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1.0]]) @ cv2.Rodrigues(np.array([0.3, 0.2, 0.0]))[0]
    T = to_transform(cv2.Rodrigues(turn)[0], np.array([x, 0.05, 0.6]))
    seen = Detections(np.array([0]), FISHEYE.project(square(0.05), T).reshape(1, 4, 2))
    body = MarkerBody.single(0, 0.05)
    np.testing.assert_allclose(body.poses(seen, FISHEYE)[0].T_camera_body, T, atol=1e-6)
    np.testing.assert_allclose(invert_transform(still_pose([seen], body, FISHEYE)) @ T, np.eye(4), atol=1e-6)
