"""The camera: from points in space to pixels and back, on disk as JSON.

The camera frame has x to the right, y down and z forward. Pixels are (column, row) with centres at whole numbers.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Shaped

from foretrace.errors import PerceptionError
from foretrace.files import read_json, write_json
from foretrace.geometry import transform_points

FORMAT = "foretrace-camera"
VERSION = 1
DISTORTION_SIZES = (0, 4, 5, 8)
"""How many distortion coefficients OpenCV's models have."""


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of a camera: a pinhole behind a lens.

    Raises:
        PerceptionError: A value makes no camera.
    """

    width: int = 640
    """Columns of the image."""
    height: int = 480
    """Rows of the image."""
    fx: float = 579.4
    """Focal length along the columns [pixel]."""
    fy: float = 579.4
    """Focal length along the rows [pixel]."""
    cx: float = 319.5
    """Column of the optical axis [pixel]."""
    cy: float = 239.5
    """Row of the optical axis [pixel]."""
    distortion: tuple[float, ...] = ()
    """OpenCV's coefficients k1, k2, p1, p2, k3, k4, k5, k6, or the first 4 or 5; empty: no distortion."""

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy"):
            if not 0 < getattr(self, name) < np.inf:
                raise PerceptionError(f"camera: {name} = {getattr(self, name)}, it must be positive")
        for name, size in (("cx", self.width), ("cy", self.height)):
            if not 0 <= getattr(self, name) < size:
                raise PerceptionError(
                    f"camera: {name} = {getattr(self, name)} lies outside an image of {size} pixels: "
                    "check the order of the values"
                )
        if len(self.distortion) not in DISTORTION_SIZES or not np.isfinite(self.distortion).all():
            raise PerceptionError(
                f"camera: distortion {list(self.distortion)}: give 0, 4, 5 or 8 finite coefficients"
            )

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> Float[np.ndarray, " k"]:
        """The distortion as OpenCV wants it."""
        return np.array(self.distortion or np.zeros(4), dtype=float)

    def scaled(self, factor: float) -> "PinholeCamera":
        """The camera of images that are enlarged by a factor."""
        size = (round(factor * self.width), round(factor * self.height))
        centre = (factor * (self.cx + 0.5) - 0.5, factor * (self.cy + 0.5) - 0.5)
        return PinholeCamera(*size, factor * self.fx, factor * self.fy, *centre, self.distortion)

    def project(
        self, points: Float[np.ndarray, "k 3"], T_camera_frame: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "k 2"]:
        """Pixels of points given in another frame [m]; NaN for points that are not before the camera."""
        in_camera = transform_points(T_camera_frame, points)
        before = in_camera[:, 2] > 0
        pixels = np.full((len(points), 2), np.nan)
        if before.any():
            found, _ = cv2.projectPoints(
                in_camera[before], np.zeros(3), np.zeros(3), self.matrix, self.coefficients
            )
            pixels[before] = found.reshape(-1, 2)
        return pixels

    def rays(self, pixels: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 3"]:
        """Directions of sight in the camera frame, of length 1 along z."""
        if not self.distortion or len(pixels) == 0:
            plane = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        else:
            stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
            raw = pixels.reshape(-1, 1, 2).astype(float)
            plane = cv2.undistortPoints(raw, self.matrix, self.coefficients, criteria=stop).reshape(-1, 2)
        return np.column_stack([plane, np.ones(len(plane))])

    def on_plane(
        self, pixels: Float[np.ndarray, "k 2"], T_frame_camera: Float[np.ndarray, "4 4"], height: float = 0.0
    ) -> Float[np.ndarray, "k 2"]:
        """Where lines of sight meet the plane z = height of a frame [m]; NaN where they do not, before the camera."""
        directions = self.rays(pixels) @ T_frame_camera[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (height - T_frame_camera[2, 3]) / directions[:, 2]
            points = T_frame_camera[:2, 3] + reach[:, None] * directions[:, :2]
        return np.where((np.isfinite(reach) & (reach > 0))[:, None], points, np.nan)

    def deproject(
        self, depth: Float[np.ndarray, "rows columns"], T_frame_camera: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "points 3"]:
        """Points seen in a depth image.

        Args:
            depth: Distance along the optical axis [m]; pixels at 0, NaN or infinity saw nothing and are left out.
            T_frame_camera: Pose of the camera in the frame that the points are wanted in.
        """
        rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
        z = depth[rows, columns].astype(float)
        pixels = np.stack([columns, rows], axis=-1).astype(float)
        return transform_points(T_frame_camera, self.rays(pixels) * z[:, None])

    def check_image(self, image: Shaped[np.ndarray, "rows columns *channels"], name: str) -> None:
        """Refuse an image that this camera cannot have taken.

        Raises:
            PerceptionError: Its size is not the camera's.
        """
        rows, columns = image.shape[:2]
        if (columns, rows) != (self.width, self.height):
            raise PerceptionError(
                f"{name} has {columns} x {rows} pixels, the camera was calibrated for {self.width} x {self.height}: "
                "calibrate with images of this size, or take the right camera file"
            )

    def to_dict(self) -> dict[str, Any]:
        """The camera as plain JSON values."""
        return {"format": FORMAT, "version": VERSION, **asdict(self), "distortion": list(self.distortion)}

    @classmethod
    def from_dict(cls, values: Any, name: str = "camera") -> "PinholeCamera":
        """The camera that ``to_dict`` described; other keys are ignored.

        Raises:
            PerceptionError: A value is missing or makes no camera.
        """
        if not isinstance(values, dict) or values.get("format") != FORMAT:
            raise PerceptionError(f'{name} is no camera: it lacks "format": "{FORMAT}"')
        if values.get("version") != VERSION:
            raise PerceptionError(
                f"{name} has format version {values.get('version')}, this foretrace reads {VERSION}"
            )
        try:
            distortion = tuple(float(value) for value in values.get("distortion", ()))
            fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
            return cls(int(values["width"]), int(values["height"]), fx, fy, cx, cy, distortion)
        except KeyError as error:
            raise PerceptionError(f"{name} lacks {error}: write it by `foretrace calibrate`") from error
        except (TypeError, ValueError) as error:
            raise PerceptionError(f"{name} has a value that is no number ({error})") from error

    def save(self, path: str | Path, **more: Any) -> None:
        """Write the camera as JSON, with further values beside it."""
        write_json(Path(path), {**self.to_dict(), **more})

    @classmethod
    def load(cls, path: str | Path) -> "PinholeCamera":
        """The camera in a JSON file.

        Raises:
            PerceptionError: The file is missing, damaged, or describes no camera.
        """
        return cls.from_dict(
            read_json(Path(path), PerceptionError, "make one with `foretrace calibrate`"), str(path)
        )
