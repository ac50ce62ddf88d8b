"""A camera fitted to views of a board: which lens, how far the board is bent, and how certain it all is."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from foretrace.perception.board import Board
from foretrace.perception.markers import to_transform

MOST_FITS = 15
"""Fits without some of the images from which the uncertainty is estimated, at most."""
BEND_STEP = 1e-3
"""Step for the derivative with respect to the bend of a board [its width]."""
SIMPLER = {
    9: 0,
    8: cv2.CALIB_FIX_K3,
    6: cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
    5: cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2,
    4: cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K1,
}
"""Lens models by how many numbers they have: all of OpenCV's, and those with coefficients at zero."""


@dataclass(frozen=True)
class CameraFit:
    """A camera fitted to views of a board."""

    error: float
    matrix: Float[np.ndarray, "3 3"]
    lens: Float[np.ndarray, " 5"]
    poses: list[Float[np.ndarray, "4 4"]]
    deviations: Float[np.ndarray, " k"]
    residuals: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class BoardViews:
    """Corners of a board and where images show them."""

    points: list[Float[np.ndarray, "_ 3"]]
    pixels: list[Float[np.ndarray, "_ 2"]]
    size: tuple[int, int]

    def fit(self, flags: int, like: CameraFit | None = None) -> CameraFit:
        """The camera that explains the views best (Zhang, 2000)."""
        matrix, lens = (np.eye(3), np.zeros(5)) if like is None else (like.matrix.copy(), like.lens.copy())
        if like is not None:
            flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        points, pixels = ([part.astype(np.float32) for part in parts] for parts in (self.points, self.pixels))
        error, matrix, lens, rvecs, tvecs, deviations, *_ = cv2.calibrateCameraExtended(
            points, pixels, self.size, matrix, lens, flags=flags
        )
        matrix, lens = np.asarray(matrix), np.ravel(lens)[:5]
        residuals = [
            (cv2.projectPoints(known, rvec, tvec, matrix, lens)[0].reshape(-1, 2) - seen).ravel()
            for known, seen, rvec, tvec in zip(self.points, self.pixels, rvecs, tvecs, strict=True)
        ]
        poses = [to_transform(rvec, tvec) for rvec, tvec in zip(rvecs, tvecs, strict=True)]
        return CameraFit(float(error), matrix, lens, poses, np.ravel(deviations), np.concatenate(residuals))

    def without(self, left: Sequence[int]) -> "BoardViews":
        """The views without some."""
        kept = [k for k in range(len(self.points)) if k not in left]
        return BoardViews([self.points[k] for k in kept], [self.pixels[k] for k in kept], self.size)

    def bent(self, bend: Float[np.ndarray, "2"], size: tuple[float, float]) -> "BoardViews":
        """The views of a board of that size whose middle stands out against its sides, along x and along y [m]."""
        across = [(points[:, :2] / size - 0.5) ** 2 for points in self.points]
        lifted = [-4 * part @ bend for part in across]
        points = [np.column_stack([p[:, :2], z]) for p, z in zip(self.points, lifted, strict=True)]
        return BoardViews(points, self.pixels, self.size)


def choose_lens(views: BoardViews) -> tuple[int, CameraFit]:
    """The simplest lens model that explains the views, by the Bayesian information criterion (Schwarz, 1978)."""
    count = 2 * sum(map(len, views.points))
    fits = {number: views.fit(flags) for number, flags in SIMPLER.items()}
    best = min(fits, key=lambda number: count * 2 * np.log(fits[number].error) + number * np.log(count))
    return SIMPLER[best], fits[best]


def straighten(
    views: BoardViews, flags: int, flat: CameraFit, board: Board
) -> tuple[BoardViews, CameraFit, Float[np.ndarray, "2"]]:
    """The views as ones of a bent board, where that explains them better, and its bend along x and y [m].

    Gauss-Newton steps over the bend alone: the camera follows it (variable projection; Golub and Pereyra, 1973).
    """
    step, bend, fit = BEND_STEP * board.size[0], np.zeros(2), flat
    for _ in range(2):
        tried = [views.bent(bend + step * axis, board.size).fit(flags, fit) for axis in np.eye(2)]
        jacobian = np.stack([(other.residuals - fit.residuals) / step for other in tried], axis=1)
        bend = bend - np.linalg.lstsq(jacobian, fit.residuals, rcond=None)[0]
        fit = views.bent(bend, board.size).fit(flags, fit)
    count = len(flat.residuals)
    if count * 2 * np.log(flat.error / fit.error) < 2 * np.log(count):
        return views, flat, np.zeros(2)
    return views.bent(bend, board.size), fit, bend


def deviations_of(views: BoardViews, flags: int, fit: CameraFit) -> dict[str, float]:
    """Standard deviations of fx, fy, cx and cy, and of lines of sight at the image's border [pixel]."""
    groups = np.array_split(np.arange(len(views.points)), min(len(views.points), MOST_FITS))
    border = _border(views.size)
    sight = cv2.undistortPoints(border[:, None], fit.matrix, fit.lens)
    rays = np.concatenate([sight, np.ones((len(border), 1, 1))], axis=2)
    values = []
    for group in groups:
        other = views.without(group.tolist()).fit(flags, fit)
        seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), other.matrix, other.lens)
        values.append(np.concatenate([other.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], np.ravel(seen)]))
    spread = np.sqrt((len(groups) - 1) * np.var(values, axis=0))
    intrinsic = np.maximum(spread[:4], fit.deviations[:4]).tolist()
    at_border = np.linalg.norm(spread[4:].reshape(-1, 2), axis=1).max()
    return dict(zip(("fx", "fy", "cx", "cy"), intrinsic, strict=True)) | {"border": float(at_border)}


def _border(size: tuple[int, int]) -> Float[np.ndarray, "8 2"]:
    """Corners of the image and middles of its sides [pixel]."""
    grid = np.stack(np.meshgrid([0.0, 0.5, 1.0], [0.0, 0.5, 1.0]), axis=-1).reshape(-1, 2)
    return np.delete(grid, 4, axis=0) * (np.array(size) - 1)
