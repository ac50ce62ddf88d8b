"""ChArUco boards: a chessboard with a marker in every white square; what they are, and what an image shows of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from foretrace.errors import (
    PerceptionError,
    check_choices,
    check_ranges,
    check_type,
    is_whole,
    shown,
    wrong_type,
)
from foretrace.geometry import invert_transform
from foretrace.interactions.marker_patterns import dictionary
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.markers import Detections, detect_markers, grey, image_fault, to_transform

FEWEST_CORNERS = 8
"""Least number of inner corners of the board in an image that counts."""
PAPER = 0.015
"""White margin round a printed board [m]; with it, the default board fits A4."""
INCH = 0.0254
MOST_COLUMNS = 24
"""Boards with up to this many columns are recognised."""
CLEAR_FIT = 0.1
"""Largest misfit of markers on the squares of the right board; on a wrong one they are off by half [square]."""
FEWEST_MARKERS = 6
"""Least number of markers by which a board is recognised."""
LEGIBLE_SQUARE = 18.0
"""Least side of a square whose marker would be seen if there were one [pixel]."""
CHESSBOARD_PIXELS = 800
"""Width to which an image is reduced to look for a plain chessboard."""

MOST = 10000
"""Greatest number of squares along a side, and of a first marker."""


@dataclass(frozen=True)
class Board:
    """A ChArUco board, as printed; its frame has its origin in a corner, z out of it.

    Raises:
        PerceptionError: The lengths or the number of squares make no board.
    """

    squares: tuple[int, int] = (7, 5)
    """Squares along x and y."""
    square_length: float = 0.035
    """Side of a square [m]."""
    marker_length: float = 0.026
    """Side of a marker [m]."""
    dictionary: str = "5x5_100"
    """Dictionary of its markers."""
    first_id: int = 0
    """Number of its first marker; the others follow."""
    legacy: bool = False
    """The pattern of OpenCV before 4.6 and of some generators for an even number of rows: a marker in the corner."""
    inverted: bool = False
    """Black and white are exchanged."""

    def __post_init__(self) -> None:
        whole = isinstance(self.squares, tuple | list) and all(is_whole(n, 0, MOST) for n in self.squares)
        if not whole or len(self.squares) != 2:
            raise wrong_type(PerceptionError)(f"squares is {shown(self.squares)}: give columns and rows")
        check_type("dictionary", self.dictionary, str, PerceptionError, "the name of a dictionary of markers")
        limits = {"square_length": (0.0, 1.0), "marker_length": (0.0, 1.0), "first_id": (0, MOST)}
        check_ranges(PerceptionError, "board", self, limits, "give lengths in metres")
        check_choices(PerceptionError, self)
        columns, rows = self.squares
        if min(columns, rows) < 3:
            raise PerceptionError(f"board of {columns} x {rows} squares: at least 3 x 3 are needed")
        if not 0 < self.marker_length < self.square_length < 1:
            raise PerceptionError(
                f"board with markers of {self.marker_length} m in squares of {self.square_length} m: "
                "the marker must be smaller than its square, both in metres"
            )
        size = dictionary(self.dictionary).bytesList.shape[0]
        if self.first_id < 0 or self.first_id + columns * rows // 2 > size:
            raise PerceptionError(
                f"board of {columns} x {rows} squares needs {columns * rows // 2} markers from {self.first_id} on, "
                f"{self.dictionary} has {size}"
            )

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.squares[0] * self.square_length, self.squares[1] * self.square_length

    def draw(self, pixels_per_metre: float = 300 / INCH) -> UInt8[np.ndarray, "rows columns"]:
        """The board as an image, without a margin; at 300 dots per inch by default."""
        width, height = (round(length * pixels_per_metre) for length in self.size)
        drawn = self._board.generateImage((width, height), marginSize=0)
        return 255 - drawn if self.inverted else drawn

    def save(self, path: str | Path) -> None:
        """Write the board for printing at its true size, as PNG (300 dots per inch) or PDF.

        Raises:
            PerceptionError: The name ends in neither.
        """
        from PIL import Image

        path = Path(path)
        if path.suffix.lower() not in (".png", ".pdf"):
            raise PerceptionError(f"cannot write a board to {path}: choose a name that ends in .png or .pdf")
        margin = round(PAPER * 300 / INCH)
        image = np.pad(self.draw(), margin, constant_values=255)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(path, dpi=(300, 300), resolution=300)

    def find(
        self, image: UInt8[np.ndarray, "rows columns *channels"]
    ) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 2"]]:
        """Inner corners of the board [m] and where they were seen [pixel]; no rows where it was not."""
        values = grey(image)
        corners, ids, _, _ = self._detector.detectBoard(255 - values if self.inverted else values)
        if ids is None or len(ids) == 0:
            return np.zeros((0, 3)), np.zeros((0, 2))
        known = np.asarray(self._board.getChessboardCorners(), dtype=float).reshape(-1, 3)
        # OpenCV's board has y downwards and z into it; ours has y upwards and z out of it.
        known = known * [1.0, -1.0, 0.0] + [0.0, self.size[1], 0.0]
        return known[np.ravel(ids).astype(int)], np.asarray(corners, dtype=float).reshape(-1, 2)

    def pose(
        self, image: UInt8[np.ndarray, "rows columns *channels"], camera: PinholeCamera, name: str = "image"
    ) -> Float[np.ndarray, "4 4"]:
        """T_board_camera: the camera's pose over a board that lies on the table, whose frame is the table frame.

        Raises:
            PerceptionError: The image is of another camera or does not show the board.
        """
        camera.check_image(image, name)
        points, pixels = self.find(image)
        if len(points) < FEWEST_CORNERS or not spans_plane(points):
            raise PerceptionError(f"{name} {self.what_is_missing(image)}")
        pixels, coefficients = camera.for_opencv(pixels)
        found, rvec, tvec = cv2.solvePnP(points, pixels, camera.matrix, coefficients, flags=cv2.SOLVEPNP_IPPE)
        if not found:
            raise PerceptionError(f"{name}: no pose explains the board's corners: show more of it")
        rvec, tvec = cv2.solvePnPRefineLM(points, pixels, camera.matrix, coefficients, rvec, tvec)
        return invert_transform(to_transform(rvec, tvec))

    def measure_marker(self, image: UInt8[np.ndarray, "rows columns *channels"]) -> float | None:
        """Side of the markers in an image, from the stated side of the squares [m]; None where it is not seen."""
        points, pixels = self.find(image)
        values = grey(image)
        seen = detect_markers(255 - values if self.inverted else values, self.dictionary)
        if not spans_plane(points) or not len(seen.ids):
            return None
        to_board, _ = cv2.findHomography(pixels, points[:, :2])
        corners = cv2.perspectiveTransform(seen.corners.reshape(1, -1, 2), to_board).reshape(-1, 4, 2)
        return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))

    def what_is_missing(self, image: UInt8[np.ndarray, "rows columns *channels"]) -> str:
        """Why an image does not show enough of the board, in words."""
        found = f"shows {len(self.find(image)[0])} corners of the board"
        plain, legible = _chessboard(image)
        fault = recognise([image], self)[1] or image_fault(image) or plain * (not legible)
        if fault := fault or image_fault(image, self.dictionary) or plain:
            return f"{found}: {fault}"
        return f"{found}, {FEWEST_CORNERS} over two rows are needed: show more of it, and check squares and dictionary"

    @cached_property
    def _board(self) -> cv2.aruco.CharucoBoard:
        markers = dictionary(self.dictionary)
        columns, rows = self.squares
        ids = self.first_id + np.arange(columns * rows // 2)
        board = cv2.aruco.CharucoBoard(self.squares, self.square_length, self.marker_length, markers, ids)
        board.setLegacyPattern(self.legacy)
        return board

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        return cv2.aruco.CharucoDetector(self._board)


def spans_plane(points: Float[np.ndarray, "k 3"]) -> bool:
    """Whether points do not lie on one line."""
    return bool(
        len(points) >= 4 and np.linalg.matrix_rank(points[:, :2] - points[:, :2].mean(axis=0), 1e-6) == 2
    )


def recognise(
    images: Sequence[UInt8[np.ndarray, "rows columns *channels"]], board: Board
) -> tuple[Board | None, str]:
    """What images of markers show where a board is not found in them.

    Args:
        images: The images.
        board: The board that they should show.

    Returns:
        The board, if it differs in first number, pattern or colours only; otherwise None and, in words, why they do not
        show this board: empty if that is unknown.
    """
    for mirrored, inverted in product((False, True), (board.inverted, not board.inverted)):
        views = []
        for image in images:
            values = 255 - grey(image) if inverted else grey(image)
            seen = detect_markers(
                np.ascontiguousarray(values[:, ::-1]) if mirrored else values, board.dictionary
            )
            if len(seen.ids) >= FEWEST_MARKERS:
                views.append(seen)
        if not views:
            continue
        if mirrored:
            return None, "it is mirrored: switch mirroring off in the camera's program"
        return _compare(views, replace(board, inverted=inverted))
    return None, ""


def _compare(views: Sequence[Detections], board: Board) -> tuple[Board | None, str]:
    """The board on whose squares markers lie, and what differs."""
    columns, rows = board.squares
    low, high = (int(pick([pick(seen.ids) for seen in views])) for pick in (min, max))
    for tried in dict.fromkeys([columns, rows, *range(3, MOST_COLUMNS + 1)]):
        for first, in_corner in _beginnings(board, low):
            if max(_misfit(seen, tried, first, in_corner) for seen in views) > CLEAR_FIT:
                continue
            count = int(marker_squares(np.array([high - first]), tried, in_corner)[0, 1]) + 1
            if tried == rows and count <= columns:
                count = columns
            if tried == columns and count <= rows and (not in_corner or rows % 2 == 0):
                return replace(board, first_id=first, legacy=in_corner), ""
            return None, (
                f"its markers lie as on a board of {tried} x {max(count, 3)} squares, not {columns} x {rows}: "
                f"give --squares {tried} {max(count, 3)}" + " --legacy" * in_corner
            )
    return None, ""


def _beginnings(board: Board, low: int) -> Iterator[tuple[int, bool]]:
    """First numbers and patterns, the likely ones first."""
    in_corner = board.legacy and board.squares[1] % 2 == 0
    for first in dict.fromkeys([min(board.first_id, low), 0, low, *range(low)]):
        yield first, in_corner
        yield first, not in_corner


def marker_squares(places: Int[np.ndarray, " k"], columns: int, in_corner: bool) -> Int[np.ndarray, "k 2"]:
    """Column and row of markers, counted from the upper left, by their place in the order of a board's markers."""
    pairs, rest = np.divmod(places, columns)
    first = (columns + in_corner) // 2  # markers in the first of two rows
    second = rest >= first
    column = 2 * (rest - first * second) + (second == in_corner)
    return np.stack([column, 2 * pairs + second], axis=1)


def _misfit(seen: Detections, columns: int, first: int, in_corner: bool) -> float:
    """How far markers lie from the squares of a board, at most, after the best projection [square]."""
    squares = marker_squares(seen.ids - first, columns, in_corner).astype(float)
    middles = seen.corners.mean(axis=1)
    to_board, _ = cv2.findHomography(middles, squares)
    if to_board is None or np.linalg.matrix_rank(squares - squares.mean(axis=0)) < 2:
        return np.inf
    fitted = cv2.perspectiveTransform(middles[None], to_board)[0]
    return float(np.linalg.norm(fitted - squares, axis=1).max())


def _chessboard(image: UInt8[np.ndarray, "rows columns *channels"]) -> tuple[str, bool]:
    """What an image of a chessboard shows, in words (empty if it is none), and whether markers would be legible."""
    values = grey(image)
    scale = min(1.0, CHESSBOARD_PIXELS / values.shape[1])
    small = cv2.resize(values, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    found, corners, inner = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
    if not found:
        return "", True
    rows, columns = np.sort(inner.shape) + 1
    steps = np.linalg.norm(np.diff(corners.reshape(*inner.shape, 2), axis=1), axis=2)
    if (side := float(np.median(steps)) / scale) < LEGIBLE_SQUARE:
        return f"its squares are {side:.0f} pixels wide, too small for markers to be read: go nearer", False
    return (
        f"it shows a plain chessboard of {columns} x {rows} squares, without markers: print the board that "
        "`foretrace calibrate --print-board board.pdf` writes"
    ), True
