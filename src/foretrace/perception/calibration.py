"""Calibrate a camera from images of a ChArUco board: a chessboard with a marker in every white square."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.errors import PerceptionError
from foretrace.geometry import invert_transform
from foretrace.interactions.marker_patterns import dictionary
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recording_folder import read_image
from foretrace.perception.markers import Detections, MarkerBody, grey, image_fault, to_transform

FEWEST_IMAGES = 5
"""Least number of images that show the board."""
FEWEST_CORNERS = 8
"""Least number of inner corners of the board in an image that counts."""
LARGEST_ERROR = 1.0
"""Largest reprojection error of a calibration [pixel]."""
LOOSEST_FOCUS = 0.02
"""Largest relative standard deviation of a refined focal length."""
FARTHEST_FOCUS = 0.2
"""Largest relative change of a refined focal length."""
LEAST_TILT = np.deg2rad(10.0)
"""Least slant of the board in one of the images; without it the focal length stays unknown [rad]."""
PAPER = 0.015
"""White margin round a printed board [m]; with it, the default board fits A4."""
INCH = 0.0254
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
"""Endings of image files."""


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

    def __post_init__(self) -> None:
        columns, rows = self.squares
        if min(columns, rows) < 3:
            raise PerceptionError(f"board of {columns} x {rows} squares: at least 3 x 3 are needed")
        if not 0 < self.marker_length < self.square_length < 1:
            raise PerceptionError(
                f"board with markers of {self.marker_length} m in squares of {self.square_length} m: "
                "the marker must be smaller than its square, both in metres"
            )
        size = dictionary(self.dictionary).bytesList.shape[0]
        if columns * rows // 2 > size:
            raise PerceptionError(
                f"board of {columns} x {rows} squares needs {columns * rows // 2} markers, {self.dictionary} has {size}"
            )

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.squares[0] * self.square_length, self.squares[1] * self.square_length

    def draw(self, pixels_per_metre: float = 300 / INCH) -> UInt8[np.ndarray, "rows columns"]:
        """The board as an image, without a margin; at 300 dots per inch by default."""
        width, height = (round(length * pixels_per_metre) for length in self.size)
        return self._board.generateImage((width, height), marginSize=0)

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
        corners, ids, _, _ = self._detector.detectBoard(grey(image))
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
        if len(points) < FEWEST_CORNERS or not _spans_plane(points):
            raise PerceptionError(f"{name} {self.what_is_missing(image)}")
        pixels, coefficients = camera.for_opencv(pixels)
        found, rvec, tvec = cv2.solvePnP(points, pixels, camera.matrix, coefficients, flags=cv2.SOLVEPNP_IPPE)
        if not found:
            raise PerceptionError(f"{name}: no pose explains the board's corners: show more of it")
        rvec, tvec = cv2.solvePnPRefineLM(points, pixels, camera.matrix, coefficients, rvec, tvec)
        return invert_transform(to_transform(rvec, tvec))

    def what_is_missing(self, image: UInt8[np.ndarray, "rows columns *channels"]) -> str:
        """Why an image does not show enough of the board, in words."""
        found = f"shows {len(self.find(image)[0])} corners of the board"
        if fault := image_fault(image, self.dictionary):
            return f"{found}: {fault}"
        return f"{found}, {FEWEST_CORNERS} over two rows are needed: show more of it, and check squares and dictionary"

    @cached_property
    def _board(self) -> cv2.aruco.CharucoBoard:
        markers = dictionary(self.dictionary)
        return cv2.aruco.CharucoBoard(self.squares, self.square_length, self.marker_length, markers)

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        return cv2.aruco.CharucoDetector(self._board)


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera, and how well it explains the images."""

    camera: PinholeCamera
    """The camera."""
    error: float
    """Root mean square of the reprojection error over all corners [pixel]."""
    errors: dict[str, float]
    """The same for each image that was used."""
    left_out: dict[str, str]
    """Images that were not used, and why."""


def calibrate(images: Mapping[str, UInt8[np.ndarray, "rows columns *channels"]], board: Board) -> Calibration:
    """Focal lengths, centre and distortion (k1, k2, p1, p2, k3) from images of a board (Zhang, 2000).

    Args:
        images: Images by name, all of one size: the board from several sides, slanted, also in the corners.
        board: What they show.

    Raises:
        PerceptionError: Too few images show the board, their sizes differ, none shows it slanted, or no camera
            explains them.
    """
    points, pixels, left_out = _find_corners(images, board)
    if len(points) < FEWEST_IMAGES:
        odd = next(iter(left_out), "")
        reason = f"; {odd} {board.what_is_missing(images[odd])}" if odd else ""
        raise PerceptionError(
            f"{len(points)} of {len(images)} images show the board, {FEWEST_IMAGES} are needed{reason}"
        )
    rows, columns = next(iter(images.values())).shape[:2]
    size = columns, rows
    error, matrix, distortion, rvecs, tvecs, *_ = cv2.calibrateCameraExtended(
        list(points.values()), list(pixels.values()), size, np.eye(3), np.zeros(5)
    )
    tilts = [
        np.arccos(np.clip(abs(to_transform(r, t)[2, 2]), 0, 1)) for r, t in zip(rvecs, tvecs, strict=True)
    ]
    if max(tilts) < LEAST_TILT:
        raise PerceptionError(
            f"no image shows the board slanted by more than {np.rad2deg(max(tilts)):.0f} degrees: "
            "that leaves the focal length open; tilt the board or the camera by 20 to 45 degrees"
        )
    if not error <= LARGEST_ERROR:
        raise PerceptionError(
            f"no camera explains the images: reprojection error {error:.2f} pixels, at most {LARGEST_ERROR} is "
            "accepted; check squares and flatness of the board, and that zoom and focus are fixed"
        )
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    camera = PinholeCamera(*size, fx, fy, cx, cy, tuple(np.ravel(distortion)[:5].tolist()))
    errors = {}
    for name, rvec, tvec in zip(points, rvecs, tvecs, strict=True):
        miss = camera.project(points[name], to_transform(rvec, tvec)) - pixels[name]
        errors[name] = float(np.sqrt((np.linalg.norm(miss, axis=1) ** 2).mean()))
    return Calibration(camera, float(error), errors, left_out)


def _find_corners(
    images: Mapping[str, UInt8[np.ndarray, "rows columns *channels"]], board: Board
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, str]]:
    """Corners of the board and their pixels in the images that show it; why the other images do not.

    Raises:
        PerceptionError: The images differ in size.
    """
    sizes = {name: f"{image.shape[1]} x {image.shape[0]}" for name, image in images.items()}
    if len(set(sizes.values())) > 1:
        first, second = list(dict.fromkeys(sizes.values()))[:2]
        odd = next(name for name, size in sizes.items() if size == second)
        raise PerceptionError(
            f"images of different sizes: {odd} has {second} pixels, others {first}: calibrate with images of "
            "one camera at one resolution"
        )
    points, pixels, left_out = {}, {}, {}
    for name, image in images.items():
        known, seen = board.find(image)
        if len(known) < FEWEST_CORNERS or not _spans_plane(known):
            fault = image_fault(image)
            left_out[name] = f"shows {len(known)} corners of the board{fault and ': '}{fault}"
            continue
        points[name], pixels[name] = known.astype(np.float32), seen.astype(np.float32)
    return points, pixels, left_out


def read_images(paths: Sequence[str | Path]) -> dict[str, UInt8[np.ndarray, "rows columns 3"]]:
    """Images by name, blue-green-red; folders stand for the images in them.

    Raises:
        PerceptionError: One is missing or cannot be read, or there is none.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        inside = (
            sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
            if path.is_dir()
            else [path]
        )
        files += inside
    if not files:
        raise PerceptionError(f"no image in {', '.join(map(str, paths))}: give {', '.join(SUFFIXES)} files")
    return {str(file): read_image(file) for file in files}


def _spans_plane(points: Float[np.ndarray, "k 3"]) -> bool:
    """Whether points do not lie on one line."""
    return bool(
        len(points) >= 4 and np.linalg.matrix_rank(points[:, :2] - points[:, :2].mean(axis=0), 1e-6) == 2
    )


def refine_camera(
    detections: Sequence[Detections], body: MarkerBody, camera: PinholeCamera
) -> tuple[PinholeCamera, float]:
    """The camera whose focal lengths and first radial distortion fit images of known markers best.

    For images with a camera file that is not quite theirs. Images of a board give a better calibration.

    Args:
        detections: The markers in each image; the body must be seen from several sides.
        body: The markers.
        camera: The camera as far as it is known.

    Returns:
        The camera, and the root mean square of the reprojection error that remains [pixel].

    Raises:
        PerceptionError: There are too few images, or they are too much alike.
    """
    matches = [match for seen in detections if len((match := body.matches(seen))[0])]
    if len(matches) < FEWEST_IMAGES:
        raise PerceptionError(f"markers {body.ids} are in {len(matches)} images, {FEWEST_IMAGES} are needed")
    if len(camera.distortion) > 5 or camera.fisheye:
        lens = "a fisheye lens" if camera.fisheye else f"{len(camera.distortion)} distortion coefficients"
        raise PerceptionError(f"a camera with {lens} cannot be refined: calibrate it with a board")
    points, pixels = ([part.astype(np.float32) for part in parts] for parts in zip(*matches, strict=True))
    held = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_TANGENT_DIST
    held |= cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    lens = np.array([*camera.distortion, *np.zeros(5 - len(camera.distortion))])
    error, matrix, lens, _, _, deviations, _, _ = cv2.calibrateCameraExtended(
        points, pixels, (camera.width, camera.height), camera.matrix, lens, flags=held
    )
    loose = np.ravel(deviations)[:2].max() > LOOSEST_FOCUS * camera.fx
    if not np.isfinite(error) or loose or abs(matrix[0, 0] / camera.fx - 1) > FARTHEST_FOCUS:
        raise PerceptionError(
            f"{len(matches)} images of markers {body.ids} leave the focal length open: slant them more, both ways"
        )
    fx, fy = (float(matrix[k, k]) for k in (0, 1))
    found = tuple(float(value) for value in np.ravel(lens)[:5])
    return PinholeCamera(camera.width, camera.height, fx, fy, camera.cx, camera.cy, found), float(error)
