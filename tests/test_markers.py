"""Markers as they are published, printed and read."""

import importlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from foretrace.cli import main
from foretrace.errors import PerceptionError
from foretrace.geometry import rotation_angle
from foretrace.interactions import marker_patterns
from foretrace.interactions.marker_patterns import PUBLISHED, draw_marker
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.markers import Detections, MarkerBody, MarkerLayout, align_patterns, detect_markers
from foretrace.perception.tracking import still_pose
from printed_scene import CAMERA, image_of, looking_at

TAG_0 = """
........
.##.#.#.
..###.#.
..##....
.#.#....
..#.##..
....#...
........
"""
"""Tag 0 of 36h11 as the AprilTag project publishes it (tag36_11_00000.png): black is a point, white a hash."""
CODES = {
    "apriltag_16h5": (0x27C8, 0x31B6, 0x3859),
    "apriltag_25h9": (0x156F1F4, 0x1F28CD5, 0x16CE32C),
    "apriltag_36h10": (0x1A42F9469, 0x21A48C08D, 0x26DFDBC5D),
    "apriltag_36h11": (0xD7E00984B, 0xDDA664CA7, 0xDC4A1C821),
}
"""Tags 0, 1 and 2 in the tables of the AprilTag library."""
QUADRANTS = {
    4: ((0, 0), (0, 1), (0, 2), (1, 1)),
    5: ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2)),
    6: ((0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (1, 1), (1, 2), (1, 3), (2, 2)),
}
"""Row and column of a code's first bits there; the other quarters follow, each turned by 90 degrees clockwise."""


def decode(code: int, side: int) -> np.ndarray:
    """A tag's modules from its code: 1 is white."""
    spots, quadrant = [], list(QUADRANTS[side])
    for _ in range(4):
        spots += quadrant
        quadrant = [(column, side - 1 - row) for row, column in quadrant]
    spots += [(side // 2, side // 2)] * (side % 2)
    modules = np.zeros((side, side), dtype=int)
    for k, spot in enumerate(spots):
        modules[spot] = code >> (side * side - 1 - k) & 1
    return modules


def test_tag_0_stands_as_published() -> None:
    drawn = ["".join(".#"[int(value > 0)] for value in row) for row in draw_marker("apriltag_36h11", 0)]
    assert drawn == TAG_0.split()


@pytest.mark.parametrize("name", PUBLISHED)
@pytest.mark.parametrize("turns", [0, 2])
def test_tags_stand_as_published_whichever_way_opencv_has_them(
    name: str, turns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV 4 has them upside down, later ones may not: both are brought to what is printed."""
    stored = cv2.aruco.getPredefinedDictionary(marker_patterns.DICTIONARIES[name])
    turned = np.roll(stored.bytesList.reshape(len(stored.bytesList), 4, -1), turns, axis=1)
    other = cv2.aruco.Dictionary(
        np.ascontiguousarray(turned.reshape(stored.bytesList.shape)), stored.markerSize, 3
    )
    monkeypatch.setattr(marker_patterns.cv2.aruco, "getPredefinedDictionary", lambda _: other)
    marker_patterns.dictionary.cache_clear()
    try:
        for id, code in enumerate(CODES[name]):
            drawn = draw_marker(name, id)[1:-1, 1:-1] > 0
            np.testing.assert_array_equal(drawn, decode(code, len(drawn)) > 0)
    finally:
        marker_patterns.dictionary.cache_clear()


def test_aruco_markers_stand_as_opencv_draws_them() -> None:
    stored = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    np.testing.assert_array_equal(
        draw_marker("5x5_100", 3, 4), cv2.aruco.generateImageMarker(stored, 3, 28, borderBits=1)
    )
    with pytest.raises(PerceptionError, match="marker 100 is not in 5x5_100: choose 0 to 99"):
        draw_marker("5x5_100", 100)


def table_of(patterns: dict[int, np.ndarray], spots: Sequence[tuple[float, float]], side: float) -> tuple:
    """A table of 0.4 m with markers on it, and T_camera_table of its middle and of its corner."""
    metre = 4000
    texture = np.full((1600, 1600), 170, np.uint8)
    for pattern, (x, y) in zip(patterns.values(), spots, strict=True):
        size = round(side * metre)
        marker = cv2.resize(pattern, (size, size), interpolation=cv2.INTER_NEAREST)
        marker = np.pad(marker, size // len(pattern), constant_values=255)
        row, column = round(800 - y * metre - len(marker) / 2), round(800 + x * metre - len(marker) / 2)
        texture[row : row + len(marker), column : column + len(marker)] = marker
    T = looking_at(0.5, 0.2, 0.45)
    corner = np.eye(4)
    corner[:2, 3] = -0.2
    return image_of(texture, (0.4, 0.4), T @ corner, CAMERA), T


def layout_of(
    path: Path, ids: Sequence[int], spots: Sequence[tuple[float, float]], **more: float
) -> MarkerLayout:
    table = [
        {"id": id, "side": 0.06, "position": list(spot), **more} for id, spot in zip(ids, spots, strict=True)
    ]
    content = {"format": "foretrace-markers", "version": 1, "dictionary": "apriltag_36h11"}
    path.write_text(json.dumps(content | {"table": table, "object": [{"id": 50, "side": 0.04}]}))
    return MarkerLayout.load(path)


SPOTS = ((-0.1, -0.1), (0.1, -0.1), (0.1, 0.1))


@pytest.mark.parametrize("num", [1, 3])
def test_the_table_frame_is_that_of_the_published_tag(num: int, tmp_path: Path) -> None:
    spots = SPOTS[-num:]
    patterns = {
        id: np.pad(255 * decode(CODES["apriltag_36h11"][id], 6).astype(np.uint8), 1) for id in range(num)
    }
    image, T = table_of(patterns, spots, 0.06)
    seen = align_patterns(image, detect_markers(image, "apriltag_36h11"), "apriltag_36h11")
    layout = layout_of(tmp_path / "markers.json", range(num), spots)
    found = still_pose([seen], layout.table, CAMERA)
    assert np.linalg.norm(found[:3, 3] - T[:3, 3]) < 0.004
    assert rotation_angle(found[:3, :3], T[:3, :3]) < np.deg2rad(1.0)


def test_tags_that_opencv_printed_are_named_and_have_a_layout(tmp_path: Path) -> None:
    patterns = {id: np.rot90(draw_marker("apriltag_36h11", id), 2) for id in range(3)}
    image, T = table_of(patterns, SPOTS, 0.06)
    seen = align_patterns(image, detect_markers(image, "apriltag_36h11"), "apriltag_36h11")
    with pytest.raises(PerceptionError, match=r'turned by 180 degrees.*add "angle_deg": 180 to each'):
        still_pose([seen], layout_of(tmp_path / "markers.json", range(3), SPOTS).table, CAMERA)
    turned = layout_of(tmp_path / "markers.json", range(3), SPOTS, angle_deg=180)
    assert rotation_angle(still_pose([seen], turned.table, CAMERA)[:3, :3], T[:3, :3]) < np.deg2rad(1.0)


def small(size: float, tilt: float, seed: int, id: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """An image of a marker of 5 cm whose side measures so many pixels where it is not slanted, and T_camera_marker."""
    rng = np.random.default_rng(seed)
    axis = rng.uniform(0, 2 * np.pi)
    turn, _ = cv2.Rodrigues(np.deg2rad(tilt) * np.array([np.cos(axis), np.sin(axis), 0.0]))
    T = np.eye(4)
    T[:3, :3] = turn @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = PLAIN.fx * 0.05 / size * PLAIN.rays(rng.uniform(120, 360, (1, 2)))[0]
    marker = np.pad(draw_marker("apriltag_36h11", id), 1, constant_values=255)
    return prints().photograph(marker, (0.0625, 0.0625), T, PLAIN, rng), T


PLAIN = PinholeCamera(480, 480, 600.0, 600.0, 240.0, 240.0)


def prints() -> ModuleType:
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    try:
        return importlib.import_module("prints")
    finally:
        del sys.path[0]


@pytest.mark.parametrize("tilt", [15.0, 35.0, 55.0])
def test_small_tags_tell_distance_and_direction(tilt: float) -> None:
    """Goals: 0.2 % of the distance and 0.3 degrees from tags of 30 pixels."""
    distance, turn = [], []
    for seed in range(6):
        image, T = small(30, tilt, seed)
        seen = align_patterns(image, detect_markers(image, "apriltag_36h11"), "apriltag_36h11")
        found = still_pose([seen], MarkerBody.single(3, 0.05), PLAIN)
        distance.append(np.linalg.norm(found[:3, 3]) / np.linalg.norm(T[:3, 3]) - 1)
        turn.append(np.rad2deg(rotation_angle(found[:3, :3], T[:3, :3])))
    assert abs(np.mean(distance)) < 0.0015
    assert np.median(np.abs(distance)) < 0.002
    assert np.median(turn) < 0.3
    assert np.max(turn) < 5.0


def corners_seen(tilt: float, noise: float, seed: int, distance: float = 1.0) -> Detections:
    rng, T = np.random.default_rng(seed), looking_at(np.deg2rad(tilt), 0.0, distance, 0.0)
    body = MarkerBody.single(3, 0.05)
    return Detections(np.array([3]), (PLAIN.project(body.corners(3), T) + rng.normal(0, noise, (4, 2)))[None])


def test_a_tag_that_two_poses_explain_alike_is_refused() -> None:
    body = MarkerBody.single(3, 0.05)
    for seed in range(5):
        with pytest.raises(
            PerceptionError, match=r"seen alike from two directions \d+ degrees apart: go nearer"
        ):
            still_pose([corners_seen(20.0, 0.5, seed)], body, PLAIN)
    still_pose([corners_seen(40.0, 0.01, 0)], body, PLAIN)


def test_a_tag_that_is_seen_too_flat_is_refused_as_that() -> None:
    body = MarkerBody.single(3, 0.05)
    with pytest.raises(
        PerceptionError, match=r"seen at 1[0-4] degrees above their plane, 15 are needed: .* higher up"
    ):
        still_pose([corners_seen(80.0, 0.01, 0, 0.3)], body, PLAIN)


def test_printed_markers_have_their_size_and_stand_upright(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tags.png"
    assert main(["calibrate", "--print-markers", str(out), "--ids", "0", "7", "--side", "0.04"]) == 0
    assert "2 markers of apriltag_36h11 on 1 page; print at 100 %" in capsys.readouterr().out
    image = np.asarray(cv2.imread(str(out), cv2.IMREAD_GRAYSCALE))
    dot = 0.0254 / 300
    assert image.shape[1] * dot == pytest.approx(0.21, abs=2 * dot)
    found = detect_markers(image, "apriltag_36h11")
    assert sorted(found.ids.tolist()) == [0, 7]
    for corners in found.corners:
        np.testing.assert_allclose(corners[1] - corners[0], [0.04 / dot, 0.0], atol=1.5)
        np.testing.assert_allclose(corners[3] - corners[0], [0.0, 0.04 / dot], atol=1.5)


def test_markers_of_a_layout_are_printed_each_with_its_side(tmp_path: Path) -> None:
    layout_of(tmp_path / "markers.json", range(3), SPOTS)
    out = tmp_path / "tags.pdf"
    assert main(["calibrate", "--print-markers", str(out), "--markers", str(tmp_path / "markers.json")]) == 0
    page = out.read_bytes()
    assert page.startswith(b"%PDF")
    width, height = 72 * 210 / 25.4, 72 * 297 / 25.4
    box = page[page.index(b"/MediaBox") :].split(b"]")[0].split(b"[")[1].split()
    assert [float(value) for value in box] == pytest.approx([0, 0, width, height], abs=0.01)
    svg = tmp_path / "tags.svg"
    assert main(["calibrate", "--print-markers", str(svg), "--markers", str(tmp_path / "markers.json")]) == 0
    assert 'width="595.275591pt"' in svg.read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["tags.jpg"], "ends in .pdf, .svg, .png"),
        (["tags.pdf", "--ids", "587"], "marker 587 is not in apriltag_36h11: choose 0 to 586"),
        (["tags.pdf", "--side", "50"], "marker 0 has a side of 50.0 m: give 0.005 to 0.6 m"),
        (["tags.pdf", "--ids"], "no markers to print"),
        (["tags.pdf", "--family", "apriltag"], "'apriltag' is unknown: choose one of"),
        (["tags.png", "--side", "0.14"], "5 markers fill 5 pages: write them to a .pdf"),
    ],
)
def test_markers_that_cannot_be_printed(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", "--print-markers", str(tmp_path / options[0]), *options[1:]]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
