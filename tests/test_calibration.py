"""Calibrations state how certain they are; weak sets are refused; boards other than stated are found or named."""

import importlib
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from PIL import Image

from foretrace.cli import main
from foretrace.errors import PerceptionError
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.board import Board, marker_squares, recognise
from foretrace.perception.calibration import calibrate
from foretrace.perception.markers import image_fault

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def table() -> Iterator[ModuleType]:
    """The benchmark that makes the table in the documentation."""
    sys.path.insert(0, str(BENCHMARKS))
    yield importlib.import_module("calibration")
    sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def good(table) -> dict[str, np.ndarray]:
    return table.photographs(table.Kind(9), 3)[0]


def test_a_good_set_states_its_uncertainty(table, good: dict[str, np.ndarray]) -> None:
    found = calibrate(good, table.BOARD)
    for name in ("fx", "fy", "cx", "cy"):
        error = abs(getattr(found.camera, name) - getattr(table.CAMERA, name))
        assert error < 3 * found.deviations[name], name
        assert 0.0 < found.deviations[name] < 0.01 * table.CAMERA.fx
    assert found.board == table.BOARD
    assert found.notes == ()


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (
            {"num": 6, "tilt": (8.0, 11.5), "fill": (0.28, 0.32)},
            r"standard deviation .* tilt the board by 25 to 45 degrees .* fill the image .* take 10 to 20 images",
        ),
        ({"num": 12, "repeats": 6}, "2 of 12 images differ, 5 are needed: show the board from other sides"),
        ({"num": 6, "tilt": (0.0, 2.0)}, "no image shows the board slanted by more than"),
    ],
)
def test_weak_sets_are_refused(table, kind: dict, message: str) -> None:
    images, board = table.photographs(table.Kind(**kind), 0)
    with pytest.raises(PerceptionError, match=message):
        calibrate(images, board)


def test_pictures_taken_twice_do_not_make_it_more_certain(table, good: dict[str, np.ndarray]) -> None:
    once = calibrate(good, table.BOARD)
    noise = np.random.default_rng(0)
    again = {
        f"{name} again": np.clip(image + noise.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)
        for name, image in good.items()
    }
    twice = calibrate(good | again, table.BOARD)
    assert twice.left_out.keys() == again.keys()
    assert "shows the board where 00 does" in twice.left_out["00 again"]
    assert twice.deviations == pytest.approx(once.deviations, rel=1e-3)


def test_a_lens_that_is_uncertain_only_where_no_board_was_is_reported(table, good) -> None:
    """The middle of a larger image tells nothing of its border."""
    margin = ((250, 250), (250, 250), (0, 0))
    larger = {name: np.pad(image, margin[: image.ndim], constant_values=128) for name, image in good.items()}
    found = calibrate(larger, table.BOARD)
    assert found.camera.fx == pytest.approx(table.CAMERA.fx, rel=0.01)
    assert found.deviations["border"] > 0.02 * found.camera.fx > found.deviations["fx"]
    assert any("uncertain at the image's border: standard deviation" in note for note in found.notes)
    assert calibrate(good, table.BOARD).notes == ()


def test_a_bent_board_is_taken_as_it_is(table) -> None:
    images, board = table.photographs(table.Kind(10, bend=0.003), 1)
    found = calibrate(images, board)
    assert found.camera.fx == pytest.approx(table.CAMERA.fx, rel=0.01)
    assert any(note.startswith("the board is bent by ") for note in found.notes)


def test_the_command_prints_and_stores_deviations_whatever_the_orientation_tags(
    good: dict[str, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Phones that look down tag their images at random; the camera belongs to the sensor's pixels."""
    cameras = []
    for name, tags in (("plain", (1,)), ("mixed", (1, 3, 6, 8))):
        folder = tmp_path / name
        folder.mkdir()
        for k, image in enumerate(good.values()):
            exif = Image.Exif()
            exif[0x0112] = tags[k % len(tags)]
            Image.fromarray(image).save(folder / f"{k}.jpg", quality=95, exif=exif)
        out = tmp_path / f"{name}.json"
        assert main(["calibrate", str(folder), "--out", str(out)]) == 0
        printed = capsys.readouterr().out
        assert printed.count("±") == 4
        stored = json.loads(out.read_text())["standard_deviations_pixels"]
        assert set(stored) == {"fx", "fy", "cx", "cy", "border"}
        assert f"± {stored['fx']:.1f} and" in printed
        cameras.append(PinholeCamera.load(out))
    np.testing.assert_allclose(cameras[1].matrix, cameras[0].matrix, rtol=1e-6)


def look(board: Board) -> np.ndarray:
    """A board seen aslant."""
    drawn = board.draw(60 / board.square_length)
    return aslant(np.pad(drawn, 40, constant_values=0 if board.inverted else 255))


def aslant(drawn: np.ndarray) -> np.ndarray:
    rows, columns = drawn.shape
    corners = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], dtype=np.float32)
    seen = np.array([[60, 50], [590, 30], [560, 440], [40, 400]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(corners, seen)
    return cv2.GaussianBlur(cv2.warpPerspective(drawn, H, (640, 480), borderValue=170), (0, 0), 0.6)


BOARD = Board((6, 4), 0.03, 0.022, "5x5_100")


@pytest.mark.parametrize(
    ("stated", "shown"),
    [
        (BOARD, {"legacy": True}),
        (BOARD, {"inverted": True}),
        (BOARD, {"first_id": 31}),
        (BOARD, {"first_id": 5, "legacy": True, "inverted": True}),
        (replace(BOARD, legacy=True), {"legacy": False}),
        (replace(BOARD, first_id=7), {"first_id": 0}),
        (replace(BOARD, squares=(7, 5)), {"first_id": 40, "inverted": True}),
    ],
)
def test_boards_that_differ_in_little_are_recognised(stated: Board, shown: dict) -> None:
    there = replace(stated, **shown)
    found, _ = recognise([look(there)], stated)
    assert found is not None
    assert found == there
    assert len(found.find(look(there))[0]) == (there.squares[0] - 1) * (there.squares[1] - 1)


@pytest.mark.parametrize(
    ("stated", "shown", "message"),
    [
        (BOARD, {"squares": (4, 6)}, "on a board of 4 x 6 squares, not 6 x 4: give --squares 4 6"),
        (replace(BOARD, squares=(5, 7)), {"squares": (7, 5)}, "7 x 5 squares, not 5 x 7: give --squares 7 5"),
        (replace(BOARD, squares=(9, 6)), {"squares": (8, 6)}, "8 x 6 squares, not 9 x 6: give --squares 8 6"),
        (replace(BOARD, squares=(5, 5)), {"squares": (8, 6), "legacy": True}, "--squares 8 6 --legacy"),
        (BOARD, {"dictionary": "6x6_250"}, "its markers are of 6x6_50, not 5x5_100"),
        (BOARD, {"dictionary": "apriltag_36h11"}, "its markers are of apriltag_36h11, not 5x5_100"),
    ],
)
def test_boards_that_differ_in_more_are_named(stated: Board, shown: dict, message: str) -> None:
    image = look(replace(stated, **shown))
    with pytest.raises(PerceptionError, match="0 of 5 images show the board") as refused:
        calibrate(dict.fromkeys("abcde", image), stated)
    assert message in str(refused.value)


def test_images_that_show_no_board_are_named() -> None:
    image = look(BOARD)
    assert "it is mirrored" in BOARD.what_is_missing(image[:, ::-1])
    squares = np.kron(np.indices((5, 7)).sum(axis=0) % 2 * 255, np.ones((60, 60))).astype(np.uint8)
    plain = np.pad(squares, 50, constant_values=255)
    assert "a plain chessboard of 7 x 5 squares, without markers" in BOARD.what_is_missing(aslant(plain))
    small = cv2.resize(image, None, fx=0.2, fy=0.2, interpolation=cv2.INTER_AREA)
    assert "too small for markers to be read: go nearer" in BOARD.what_is_missing(small)
    assert "check squares and dictionary" in BOARD.what_is_missing(
        np.pad(image[:, :150], 20, constant_values=170)
    )
    assert "blurred" in BOARD.what_is_missing(cv2.GaussianBlur(image, (0, 0), 12))


def test_nested_dictionaries_are_one_family() -> None:
    image = look(BOARD)
    assert image_fault(image, "5x5_50") == image_fault(image, "5x5_1000") == ""
    late = look(replace(BOARD, first_id=60))
    assert "its markers are of 5x5_100, not 5x5_50" in image_fault(late, "5x5_50")


def test_images_turned_by_a_program_are_named(good: dict[str, np.ndarray]) -> None:
    turned = good | {"turned": np.rot90(next(iter(good.values())))}
    with pytest.raises(PerceptionError, match=r"turned has 480 x 640 pixels.*as the camera stored them"):
        calibrate(turned, Board())


@pytest.mark.parametrize("in_corner", [False, True])
@pytest.mark.parametrize("squares", [(7, 5), (6, 4), (5, 8), (4, 7)])
def test_markers_lie_on_the_squares_where_opencv_has_them(squares: tuple[int, int], in_corner: bool) -> None:
    if in_corner and squares[1] % 2:
        pytest.skip("the older pattern differs for even numbers of rows only")
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard(squares, 1.0, 0.5, markers)
    board.setLegacyPattern(in_corner)
    middles = np.array(
        [np.asarray(corners).reshape(4, 3).mean(axis=0)[:2] for corners in board.getObjPoints()]
    )
    found = marker_squares(np.arange(len(middles)), squares[0], in_corner)
    np.testing.assert_allclose(found + 0.5, middles)
