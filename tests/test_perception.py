"""Cameras, calibration and markers: truth found again, and bad input refused with a reason."""

import itertools
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from foretrace.cli import main
from foretrace.errors import PerceptionError
from foretrace.geometry import invert_transform, pose_to_matrix, rotation_angle
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.board import Board
from foretrace.perception.calibration import calibrate, refine_camera
from foretrace.perception.markers import (
    Detections,
    MarkerBody,
    MarkerLayout,
    align_patterns,
    detect_markers,
    fitting_dictionaries,
    image_fault,
    square,
)
from foretrace.perception.overlay import PREDICTED, draw_overlay
from printed_scene import BOARD, CAMERA, board_images, image_of, looking_at, marker_scene

SHARED = Path(__file__).parents[2] / "shared" / "data" / "markers"


@pytest.fixture(scope="module")
def images() -> dict[str, np.ndarray]:
    return board_images(8)


def test_pixels_and_rays_agree_with_distortion() -> None:
    pixels = np.array([[3.0, 5.0], [320.5, 200.0], [630.0, 470.0]])
    np.testing.assert_allclose(CAMERA.project(CAMERA.rays(pixels) * 0.7, np.eye(4)), pixels, atol=1e-4)
    T = invert_transform(looking_at(0.5, 0.2, 0.7))
    points = CAMERA.on_plane(pixels, T, 0.02)
    lifted = np.column_stack([points, np.full(3, 0.02)])
    np.testing.assert_allclose(CAMERA.project(lifted, invert_transform(T)), pixels, atol=1e-4)
    assert np.isnan(CAMERA.project(np.array([[0.0, 0.0, -1.0]]), np.eye(4))).all()
    depth = np.zeros((480, 640))
    depth[5, 3] = 0.7
    np.testing.assert_allclose(CAMERA.deproject(depth, np.eye(4)), 0.7 * CAMERA.rays(pixels[:1]), atol=1e-9)


def test_camera_files(tmp_path: Path) -> None:
    CAMERA.save(tmp_path / "camera.json", error_pixels=0.2)
    assert PinholeCamera.load(tmp_path / "camera.json") == CAMERA
    good = CAMERA.to_dict()
    for change, message in (
        ({"fx": None}, "entry fx is null"),
        ({"fx": -3}, "entry fx is -3, a finite number above 0.0"),
        ({"cx": 900}, "cx = 900.0 lies outside"),
        ({"distortion": [1, 2]}, "0, 4, 5, 8, 12 or 14"),
        ({"version": 2}, "a fisheye lens has 4 finite"),
        ({"version": 9}, "format version 9"),
        ({"format": "x"}, "is no camera"),
    ):
        (tmp_path / "bad.json").write_text(json.dumps(good | change))
        with pytest.raises(PerceptionError, match=message):
            PinholeCamera.load(tmp_path / "bad.json")
    del good["cy"]
    (tmp_path / "bad.json").write_text(json.dumps(good))
    with pytest.raises(PerceptionError, match="entry cy is missing"):
        PinholeCamera.load(tmp_path / "bad.json")
    with pytest.raises(PerceptionError, match="foretrace calibrate"):
        PinholeCamera.load(tmp_path / "none.json")


def test_calibration_finds_the_camera(images: dict[str, np.ndarray]) -> None:
    found = calibrate(images, BOARD)
    assert found.error < 0.15
    assert set(found.errors) == set(images)
    # Two cameras are alike if they see along the same lines.
    pixels = np.stack(np.meshgrid([60.0, 320.0, 580.0], [60.0, 240.0, 420.0]), axis=-1).reshape(-1, 2)
    apart = np.linalg.norm(found.camera.project(CAMERA.rays(pixels), np.eye(4)) - pixels, axis=1)
    assert apart.max() < 2.5
    assert found.camera.fx == pytest.approx(CAMERA.fx, rel=0.005)


def test_camera_pose_over_the_board(images: dict[str, np.ndarray]) -> None:
    margin = 0.01
    T = looking_at(0.5, 0.1, 0.4)
    size = (BOARD.size[0] + 2 * margin, BOARD.size[1] + 2 * margin)
    image = image_of(np.pad(BOARD.draw(6000.0), 60, constant_values=255), size, T, CAMERA)
    shift = np.eye(4)
    shift[:2, 3] = margin
    truth = invert_transform(T @ shift)
    found = BOARD.pose(image, CAMERA)
    assert np.linalg.norm(found[:3, 3] - truth[:3, 3]) < 0.001
    assert rotation_angle(found[:3, :3], truth[:3, :3]) < np.deg2rad(0.2)
    with pytest.raises(PerceptionError, match="was calibrated for 640 x 480"):
        BOARD.pose(image[:400], CAMERA)


def test_calibration_refuses_what_it_cannot_use(images: dict[str, np.ndarray]) -> None:
    few = dict(list(images.items())[:3])
    with pytest.raises(PerceptionError, match="3 of 3 images show the board, 5 are needed"):
        calibrate(few, BOARD)
    with pytest.raises(PerceptionError, match="its markers are of 4x4_50, not 6x6_50"):
        calibrate(images, Board((6, 5), 0.03, 0.022, "6x6_50"))
    with pytest.raises(PerceptionError, match="odd has 320 x 240 pixels"):
        calibrate(images | {"odd": np.zeros((240, 320, 3), np.uint8)}, BOARD)
    dark = {f"dark {k}": (image * 0.05).astype(np.uint8) for k, image in enumerate(images.values())}
    with pytest.raises(PerceptionError, match="it is dark"):
        calibrate(dark, BOARD)
    rows, columns = np.indices((480, 640), dtype=np.float32)
    waves = 4 * np.sin(rows / 20)
    wavy = {name: cv2.remap(image, columns + waves, rows, 1) for name, image in images.items()}
    with pytest.raises(PerceptionError, match="no camera explains the images"):
        calibrate(wavy, BOARD)


def test_calibrate_command(
    tmp_path: Path, images: dict[str, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    for name, image in images.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    options = ["--squares", "6", "5", "--square-length", "0.03", "--marker-length", "0.022"]
    options += ["--dictionary", "4x4_50"]
    assert main(["calibrate", str(tmp_path), *options, "--out", str(tmp_path / "c.json")]) == 0
    assert "over 8 images" in capsys.readouterr().out
    assert PinholeCamera.load(tmp_path / "c.json").fx == pytest.approx(600, rel=0.01)
    assert main(["calibrate", "--print-board", str(tmp_path / "b.png"), *options]) == 0
    assert "180.0 x 150.0 mm" in capsys.readouterr().out
    printed = cv2.imread(str(tmp_path / "b.png"))
    assert len(BOARD.find(printed)[0]) == 20
    assert main(["calibrate", "--print-board", str(tmp_path / "b.pdf"), *options]) == 0
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF")
    assert main(["calibrate", str(tmp_path / "nothing.png")]) == 2
    assert "cannot read an image" in capsys.readouterr().err


def test_the_command_refines_a_camera_by_markers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for k, slant in enumerate(np.linspace(0.4, 0.9, 6)):
        T = looking_at(*(slant * np.array([np.cos(2.0 * k), np.sin(2.0 * k)])), 0.3)
        cv2.imwrite(str(folder / f"{k}.png"), marker_scene("apriltag_36h11", 7, 0.08, T))
    stated, layout, out = (tmp_path / f"{name}.json" for name in ("stated", "markers", "refined"))
    replace(CAMERA, fx=0.96 * CAMERA.fx, fy=0.96 * CAMERA.fy).save(stated)
    marker = {"id": 7, "side": 0.08}
    content = {"format": "foretrace-markers", "version": 1, "dictionary": "apriltag_36h11"}
    layout.write_text(json.dumps(content | {"table": [marker], "object": [{"id": 8, "side": 0.04}]}))
    command = ["calibrate", str(folder), "--refine", str(stated), "--out", str(out)]
    assert main(command) == 2
    assert "--markers LAYOUT go together" in capsys.readouterr().err
    assert main([*command, "--markers", str(layout)]) == 0
    assert "over 6 images" in capsys.readouterr().out
    refined = PinholeCamera.load(out)
    assert refined.fx == pytest.approx(CAMERA.fx, rel=0.01)
    assert refined.fy == pytest.approx(CAMERA.fy, rel=0.01)


@pytest.mark.parametrize("name", ["5x5_100", "apriltag_36h11"])
def test_a_marker_tells_its_pose(name: str) -> None:
    T = looking_at(0.6, 0.4, 0.35)
    image = marker_scene(name, 7, 0.06, T)
    found = align_patterns(image, detect_markers(image, name), name)
    assert found.ids.tolist() == [7]
    np.testing.assert_allclose(found.corners[0], CAMERA.project(square(0.06), T), atol=0.15)
    best, other = MarkerBody.single(7, 0.06).poses(found, CAMERA)
    assert np.linalg.norm(best.T_camera_body[:3, 3] - T[:3, 3]) < 0.001
    assert rotation_angle(best.T_camera_body[:3, :3], T[:3, :3]) < np.deg2rad(0.6)
    assert best.error < 0.1 < other.error
    assert fitting_dictionaries(image)[0].startswith(name.split("_")[0])


def test_several_markers_of_one_body_tell_more_than_one() -> None:
    T = looking_at(0.05, 0.02, 0.5)  # frontal: a single marker is ambiguous here
    place = pose_to_matrix(np.array([0.12, 0.0, 0.0, 1.0, 0, 0, 0]))
    body = MarkerBody({1: 0.04, 2: 0.04}, {1: np.eye(4), 2: place})
    rng = np.random.default_rng(0)
    corners = np.stack([CAMERA.project(body.corners(id), T) for id in (1, 2)])
    seen = Detections(np.array([1, 2]), corners + rng.normal(0, 0.1, corners.shape))
    pose = body.poses(seen, CAMERA)[0].T_camera_body
    assert rotation_angle(pose[:3, :3], T[:3, :3]) < np.deg2rad(3)
    assert body.poses(Detections(np.array([5]), corners[:1]), CAMERA) == []


def test_what_is_wrong_with_a_image() -> None:
    image = marker_scene("5x5_100", 7, 0.06, looking_at(0.3, 0.2, 0.3))
    assert image_fault(image) == ""
    assert "dark" in image_fault(image // 20)
    assert "blurred" in image_fault(cv2.GaussianBlur(image, (0, 0), 15))
    with pytest.raises(PerceptionError, match="'9x9' is unknown: choose one of 4x4_50"):
        detect_markers(image, "9x9")


def test_marker_layouts(tmp_path: Path) -> None:
    path = tmp_path / "markers.json"
    entry = {"id": 3, "side": 0.04, "position": [0.1, 0.2], "angle_deg": 90}
    good = {"format": "foretrace-markers", "version": 1, "dictionary": "4x4_50", "table": [entry]}
    good["object"] = [{"id": 4, "side": 0.03}]
    path.write_text(json.dumps(good))
    layout = MarkerLayout.load(path)
    np.testing.assert_allclose(layout.table.corners(3)[0], [0.08, 0.18, 0.0], atol=1e-12)
    for change, message in (
        ({"object": [{"id": 3, "side": 0.03}]}, "each must be there once"),
        ({"object": [{"id": 60, "side": 0.03}]}, "from 0 to 49"),
        ({"object": [{"id": 4, "side": 40}]}, "side is 40, a finite number up to 1.0"),
        ({"object": [{"id": 4}]}, "side"),
        ({"version": 3}, "has format version 3"),
    ):
        path.write_text(json.dumps(good | change))
        with pytest.raises(PerceptionError, match=message):
            MarkerLayout.load(path)


ANGLES = (-50, -30, 0, 20, 40, 60)


@pytest.fixture(scope="module")
def stand() -> dict[int, Detections]:
    """The marker in photographs of a rotary stand, by its angle [degree]."""
    if not SHARED.is_dir():
        pytest.skip(f"the photographs are not at {SHARED}")
    images = {angle: cv2.imread(str(SHARED / f"rotary_{angle}.png")) for angle in ANGLES}
    return {
        angle: align_patterns(image, detect_markers(image, "apriltag_36h11"), "apriltag_36h11")
        for angle, image in images.items()
    }


def rotations_on_the_stand(stand: dict[int, Detections], camera: PinholeCamera) -> dict[int, np.ndarray]:
    body = MarkerBody.single(int(stand[0].ids[0]), 0.065)
    return {angle: body.poses(seen, camera)[0].T_camera_body[:3, :3] for angle, seen in stand.items()}


def test_photographs_of_a_marker_on_a_rotary_stand(stand: dict[int, Detections]) -> None:
    """The camera is refined from how the marker looks in all of them; the angles are not told."""
    stated = PinholeCamera(1056, 792, 329.873, 332.946, 528.0, 396.0)
    body = MarkerBody.single(int(stand[0].ids[0]), 0.065)
    camera, error = refine_camera(list(stand.values()), body, stated)
    assert error < 0.15
    rotations = rotations_on_the_stand(stand, camera)
    for a, b in itertools.combinations(ANGLES, 2):
        turned = np.rad2deg(rotation_angle(rotations[a], rotations[b]))
        assert abs(turned - (b - a)) < 2.0, (a, b)


def looks(camera: PinholeCamera, slants: Sequence[float]) -> tuple[MarkerBody, list[Detections]]:
    """A marker seen from several sides, its corners to 0.05 pixels."""
    body, rng, found = MarkerBody.single(0, 0.08), np.random.default_rng(0), []
    for k, slant in enumerate(slants):
        T = np.eye(4)
        turn = np.array([np.cos(2.0 * k), np.sin(2.0 * k), 0.0]) * slant
        T[:3, :3] = cv2.Rodrigues(turn)[0] @ np.diag([1.0, -1.0, -1.0])
        T[:3, 3] = [0.05 * np.cos(k), 0.04 * np.sin(k), 0.3]
        corners = camera.project(body.corners(0), T) + rng.normal(0, 0.05, (4, 2))
        found.append(Detections(np.array([0]), corners[None]))
    return body, found


def test_a_camera_is_refined_from_markers() -> None:
    true = PinholeCamera(640, 480, 520.0, 515.0, 322.0, 238.0, (-0.12, 0.0, 0.0, 0.0, 0.0))
    stated = PinholeCamera(640, 480, 500.0, 505.0, 322.0, 238.0)
    body, seen = looks(true, np.linspace(0.3, 1.0, 12).tolist())
    camera, error = refine_camera(seen, body, stated)
    assert error < 0.15
    np.testing.assert_allclose([camera.fx, camera.fy], [true.fx, true.fy], rtol=0.01)
    assert camera.distortion[0] == pytest.approx(-0.12, abs=0.04)
    with pytest.raises(PerceptionError, match="are in 3 images, 5 are needed"):
        refine_camera(seen[:3], body, stated)
    body, flat = looks(true, [0.01] * 6)
    with pytest.raises(PerceptionError, match="leave the focal length open: slant them more"):
        refine_camera(flat, body, stated)


def test_an_uncertain_path_is_drawn_as_a_tube() -> None:
    camera, grey = PinholeCamera(320, 240, 200.0, 200.0, 159.5, 119.5), np.full((240, 320, 3), 128, np.uint8)
    path = np.column_stack([np.linspace(-0.1, 0.1, 9), np.zeros(9), np.full(9, 0.5)])
    radius = np.linspace(0.01, 0.05, 9)
    paths = {"predicted": (path, PREDICTED)}
    bare = draw_overlay(grey, camera, np.eye(4), paths=paths)
    drawn = draw_overlay(grey, camera, np.eye(4), paths=paths, radii={"predicted": radius})
    column = lambda image, x: np.flatnonzero((image[40:, round(159.5 + 400 * x)] != 128).any(axis=1))  # noqa: E731
    assert np.ptp(column(bare, 0.1)) < 6
    assert np.ptp(column(drawn, 0.1)) == pytest.approx(2 * 200 * 0.05 / 0.5, abs=3)
    assert np.ptp(column(drawn, -0.1)) == pytest.approx(2 * 200 * 0.01 / 0.5, abs=3)
    assert (
        draw_overlay(grey, camera, np.eye(4), paths=paths, radii={"predicted": np.full(9, np.nan)}) == bare
    ).all()


def test_names_of_paths_have_a_border_that_fits() -> None:
    camera, grey = PinholeCamera(640, 360, 400.0, 400.0, 319.5, 179.5), np.full((360, 640, 3), 128, np.uint8)
    path = np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.5]])
    text = draw_overlay(grey, camera, np.eye(4), paths={"predicted": (path, PREDICTED)})[:40].astype(int)
    white, red = (np.abs(text - colour).max(axis=2) < 60 for colour in (255, PREDICTED))
    assert white.any()
    assert red.any()
    for axis in (0, 1):
        first, last = (np.flatnonzero(part.any(axis=axis))[[0, -1]] for part in (white, red))
        assert np.abs(first - last).max() <= 3
