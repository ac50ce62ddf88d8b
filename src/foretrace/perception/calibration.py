"""Calibrate a camera from images of a ChArUco board: a chessboard with a marker in every white square."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.errors import PerceptionError
from foretrace.images import SUFFIXES
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recording_folder import read_image
from foretrace.perception.board import FEWEST_CORNERS, Board, recognise, spans_plane
from foretrace.perception.camera_fit import BoardViews, choose_lens, deviations_of, straighten
from foretrace.perception.markers import Detections, MarkerBody, image_fault

FEWEST_IMAGES = 5
"""Least number of images that show the board."""
ENOUGH_IMAGES = 10
"""With fewer, more are advised where a calibration is too uncertain."""
ALIKE = 0.005
"""Views whose corners are closer than this on average count as one [image width]."""
LARGEST_ERROR = 1.0
"""Largest reprojection error of a calibration [pixel]."""
LOOSEST = 0.02
"""Largest standard deviation of focal length and centre of a calibration, and of a line of sight at the image's border
that passes without a word [focal length]."""
FARTHEST_FOCUS = 0.2
"""Largest relative change of a refined focal length."""
LEAST_TILT, GOOD_TILT = np.deg2rad([10.0, 25.0])
"""Least slant of the board in one of the images, without which the focal length stays unknown, and a good one [rad]."""
LEAST_FILL = 0.35
"""Least part of the image's width or height that the board should fill in some images."""
LEAST_COVER = 0.6
"""Least part of the image's width and height over which the board should have been."""
LEAST_BEND = 0.0002
"""Least bend of a board that is reported [m]."""
LARGEST_RATIO = 0.05
"""Largest relative error of a marker's stated side in its square that is not reported."""


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera, and how well it explains the images."""

    camera: PinholeCamera
    """The camera."""
    error: float
    """Root mean square of the reprojection error over all corners [pixel]."""
    errors: dict[str, float]
    """The same for each image that was used."""
    deviations: dict[str, float]
    """Standard deviations of fx, fy, cx and cy, and of a line of sight at the image's border [pixel]."""
    left_out: dict[str, str]
    """Images that were not used, and why."""
    board: Board
    """The board that the images show: as stated, but for first number, pattern or colours."""
    notes: tuple[str, ...] = ()
    """What the board turned out to be."""


def calibrate(images: Mapping[str, UInt8[np.ndarray, "rows columns *channels"]], board: Board) -> Calibration:
    """Focal lengths, centre and distortion (k1, k2, p1, p2, k3) from images of a board (Zhang, 2000).

    Distortion coefficients that the images do not determine are zero (Schwarz, 1978), and a board that is bent is
    taken as it is. Standard deviations are the larger of those of the least squares, for which corners err
    independently, and those of fits without some of the images, for which images do (jackknife; Quenouille, 1956).

    Args:
        images: Images by name, all of one size: the board from several sides, slanted, also in the corners.
        board: What they show.

    Raises:
        PerceptionError: Too few images show the board, their sizes differ, none shows it slanted, no camera
            explains them, or they leave the camera too uncertain.
    """
    points, pixels, left_out = _find_corners(images, board)
    stated = board
    if len(points) < FEWEST_IMAGES:
        found, _ = recognise([images[name] for name in list(left_out)[:3]], board)
        if found is not None and found != board:
            board = found
            points, pixels, left_out = _find_corners(images, board)
    if len(points) < FEWEST_IMAGES:
        odd = next(iter(left_out), "")
        reason = f"; {odd} {stated.what_is_missing(images[odd])}" if odd else ""
        raise PerceptionError(
            f"{len(points)} of {len(images)} images show the board, {FEWEST_IMAGES} are needed{reason}"
        )
    rows, columns = next(iter(images.values())).shape[:2]
    left_out |= _drop_repeated(points, pixels, columns)
    if len(points) < FEWEST_IMAGES:
        raise PerceptionError(
            f"{len(points)} of {len(images)} images differ, {FEWEST_IMAGES} are needed: show the board from other sides"
        )
    views = BoardViews(list(points.values()), list(pixels.values()), (columns, rows))
    flags, fit = choose_lens(views)
    views, fit, bend = straighten(views, flags, fit, board)
    tilts = [np.arccos(np.clip(abs(T[2, 2]), 0, 1)) for T in fit.poses]
    if max(tilts) < LEAST_TILT:
        raise PerceptionError(
            f"no image shows the board slanted by more than {np.rad2deg(max(tilts)):.0f} degrees: "
            "that leaves the focal length open; tilt the board or the camera by 20 to 45 degrees"
        )
    if not fit.error <= LARGEST_ERROR:
        raise PerceptionError(
            f"no camera explains the images: reprojection error {fit.error:.2f} pixels, at most {LARGEST_ERROR} is "
            "accepted; check squares and flatness of the board, and that zoom and focus are fixed"
        )
    deviations = deviations_of(views, flags, fit)
    _check_deviations(deviations, fit.matrix[0, 0], views, tilts)
    (fx, _, cx), (_, fy, cy), _ = fit.matrix.tolist()
    camera = PinholeCamera(columns, rows, fx, fy, cx, cy, tuple(fit.lens.tolist()))
    ends = np.cumsum([2 * len(part) for part in views.points])
    squared = [2 * (part**2).mean() for part in np.split(fit.residuals, ends[:-1])]
    errors = dict(zip(points, np.sqrt(squared).tolist(), strict=True))
    notes = _differences(stated, board, bend, [images[name] for name in list(points)[:3]])
    if deviations["border"] > LOOSEST * camera.fx:
        notes += (
            f"the lens is uncertain at the image's border: standard deviation {deviations['border']:.0f} pixels; hold "
            "the board there, too, or keep the object away from it",
        )
    return Calibration(camera, fit.error, errors, deviations, left_out, board, notes)


def _check_deviations(
    deviations: Mapping[str, float], focus: float, views: BoardViews, tilts: Sequence[float]
) -> None:
    """Refuse a calibration that is too uncertain, with what would make it better."""
    names = {"fx": "the focal length", "cx": "the centre"}
    shares = {name: max(deviations[name], deviations[name.replace("x", "y")]) / focus for name in names}
    worst = max(shares, key=lambda name: shares[name])
    if shares[worst] <= LOOSEST:
        return
    size = np.array(views.size)
    fills = [np.ptp(seen, axis=0) / size for seen in views.pixels]
    cover = np.ptp(np.concatenate(views.pixels), axis=0) / size
    advice = [
        (
            max(tilts) < GOOD_TILT,
            f"tilt the board by 25 to 45 degrees (at most {np.rad2deg(max(tilts)):.0f} now)",
        ),
        (
            np.max(fills) < LEAST_FILL,
            f"fill the image with the board (at most {100 * np.max(fills):.0f} % now)",
        ),
        (min(cover) < LEAST_COVER, "hold it in all parts of the image"),
        (len(tilts) < ENOUGH_IMAGES, f"take 10 to 20 images ({len(tilts)} now)"),
    ]
    given = [words for lacks, words in advice if lacks] or [
        "tilt the board more, both ways, and fill the image with it"
    ]
    raise PerceptionError(
        f"{len(tilts)} images leave {names[worst]} uncertain: standard deviation {100 * shares[worst]:.1f} % of the "
        f"focal length, at most {100 * LOOSEST:.0f} % is accepted: {', '.join(given)}"
    )


def _drop_repeated(
    points: dict[str, np.ndarray], pixels: dict[str, np.ndarray], width: int
) -> dict[str, str]:
    """Take out views that repeat an earlier one, which would count twice; say of which."""
    repeated: dict[str, str] = {}
    kept: list[str] = []
    for name in list(points):
        for earlier in kept:
            here = {
                tuple(point): pixel for point, pixel in zip(points[name].tolist(), pixels[name], strict=True)
            }
            there = zip(points[earlier].tolist(), pixels[earlier], strict=True)
            apart = [
                np.linalg.norm(here[tuple(point)] - pixel) for point, pixel in there if tuple(point) in here
            ]
            if 2 * len(apart) >= len(points[earlier]) and np.mean(apart) < ALIKE * width:
                repeated[name] = f"shows the board where {earlier} does"
                break
        else:
            kept.append(name)
    for name in repeated:
        del points[name], pixels[name]
    return repeated


def _differences(
    stated: Board, found: Board, bend: Float[np.ndarray, "2"], images: Sequence[np.ndarray]
) -> tuple[str, ...]:
    """What a board turned out to be, in words."""
    lines = []
    if found.first_id != stated.first_id:
        lines.append(f"the board's markers begin at {found.first_id} (--first-id {found.first_id})")
    if found.legacy != stated.legacy:
        lines.append(
            "the board has the pattern of OpenCV before 4.6 (--legacy)"
            if found.legacy
            else "the board has the pattern of OpenCV since 4.6 (without --legacy)"
        )
    if found.inverted != stated.inverted:
        lines.append(f"black and white are exchanged on the board (--{'no-' * stated.inverted}inverted)")
    if np.abs(bend).max() > LEAST_BEND:
        lines.append(
            f"the board is bent by {1000 * np.abs(bend).max():.1f} mm, which is taken into account: make it flat"
        )
    sides = [side for image in images if (side := found.measure_marker(image)) is not None]
    if sides and abs(np.median(sides) / stated.marker_length - 1) > LARGEST_RATIO:
        lines.append(
            f"markers measure {1000 * np.median(sides):.1f} mm in squares of {1000 * stated.square_length:.1f} mm, not "
            f"{1000 * stated.marker_length:.1f} mm: measure both"
        )
    return tuple(lines)


def _find_corners(
    images: Mapping[str, UInt8[np.ndarray, "rows columns *channels"]], board: Board
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, str]]:
    """Corners of the board and their pixels in the images that show it; why the other images do not.

    Raises:
        PerceptionError: The images differ in size.
    """
    sizes = {name: (image.shape[1], image.shape[0]) for name, image in images.items()}
    if len(set(sizes.values())) > 1:
        first, second = list(dict.fromkeys(sizes.values()))[:2]
        odd = next(name for name, size in sizes.items() if size == second)
        remedy = "calibrate with images of one camera at one resolution"
        if first == second[::-1]:
            remedy = "some were turned after they were taken; give them as the camera stored them"
        raise PerceptionError(
            f"images of different sizes: {odd} has {second[0]} x {second[1]} pixels, others {first[0]} x {first[1]}: "
            f"{remedy}"
        )
    points, pixels, left_out = {}, {}, {}
    for name, image in images.items():
        known, seen = board.find(image)
        if len(known) < FEWEST_CORNERS or not spans_plane(known):
            fault = image_fault(image)
            left_out[name] = f"shows {len(known)} corners of the board{fault and ': '}{fault}"
            continue
        points[name], pixels[name] = known, seen
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
    loose = np.ravel(deviations)[:2].max() > LOOSEST * camera.fx
    if not np.isfinite(error) or loose or abs(matrix[0, 0] / camera.fx - 1) > FARTHEST_FOCUS:
        raise PerceptionError(
            f"{len(matches)} images of markers {body.ids} leave the focal length open: slant them more, both ways"
        )
    fx, fy = (float(matrix[k, k]) for k in (0, 1))
    found = tuple(float(value) for value in np.ravel(lens)[:5])
    return PinholeCamera(camera.width, camera.height, fx, fy, camera.cx, camera.cy, found), float(error)
