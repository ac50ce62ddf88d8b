"""The camera: from points in space to pixels and back, on disk as JSON.

The camera frame has x to the right, y down and z forward. Pixels are (column, row) with centres at whole numbers.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import cv2
import numpy as np
from jaxtyping import Float, Shaped
from msgspec import Meta

from foretrace.errors import PerceptionError, fault, is_number, shown
from foretrace.files import read_json, write_json
from foretrace.geometry import transform_points
from foretrace.interactions.camera_yaml import read_camera_yaml
from foretrace.schema import Finite, Positive, conform

FORMAT = "foretrace-camera"
VERSION = 1
FISHEYE_VERSION = 2
"""Version of a camera with `PinholeCamera.fisheye`, which older readers would take for one without."""
DISTORTION_SIZES = (0, 4, 5, 8, 12, 14)
"""How many distortion coefficients OpenCV's models have."""
FISHEYE_SIZE = 4
"""How many its fisheye model has."""
NO_RAY = -1e6
"""What its fisheye model gives where no ray leads to a pixel."""
YAML = (".yaml", ".yml")
LONGEST_FOCUS = 1e7
"""Greatest focal length, and width and height of an image [pixel]: a telescope's."""
MOST_PIXELS = 100_000
"""Most rows or columns of an image."""


class CameraEntries(TypedDict):
    """Schema of a camera's description."""

    width: Annotated[int, Meta(ge=1, le=MOST_PIXELS)]
    height: Annotated[int, Meta(ge=1, le=MOST_PIXELS)]
    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    distortion: NotRequired[list[Finite]]


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
    """OpenCV's coefficients k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty, or the first 4, 5, 8 or 12; empty:
    no distortion."""
    fisheye: bool = False
    """Whether the lens is OpenCV's fisheye model (Kannala and Brandt, 2006), with distortion k1, k2, k3, k4."""

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy"):
            value = getattr(self, name)
            if not is_number(value) or not 0 < value < np.inf:
                raise PerceptionError(f"camera: {name} = {shown(value)}, it must be positive")
            if value > LONGEST_FOCUS:
                raise PerceptionError(
                    f"camera: {name} = {shown(value)} pixels: at most {LONGEST_FOCUS:g} are believed"
                )
        for name, size in (("cx", self.width), ("cy", self.height)):
            if not is_number(getattr(self, name)) or not 0 <= getattr(self, name) < size:
                raise PerceptionError(
                    f"camera: {name} = {getattr(self, name)} lies outside an image of {size} pixels: "
                    "check the order of the values"
                )
        sizes = (FISHEYE_SIZE,) if self.fisheye else DISTORTION_SIZES
        lens = "a fisheye lens has 4" if self.fisheye else "give 0, 4, 5, 8, 12 or 14"
        try:
            values = np.asarray(self.distortion, dtype=float)
        except (TypeError, ValueError):
            values = np.full((), np.nan)
        if values.ndim != 1 or len(values) not in sizes or not np.isfinite(values).all():
            given = values.tolist() if values.ndim == 1 else shown(self.distortion)
            raise fault(PerceptionError, values.ndim == 1)(
                f"camera: distortion {given}: {lens} finite coefficients"
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
        focus = (factor * self.fx, factor * self.fy)
        return PinholeCamera(*size, *focus, *centre, self.distortion, self.fisheye)

    def project(
        self, points: Float[np.ndarray, "k 3"], T_camera_frame: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "k 2"]:
        """Pixels of points given in another frame [m]; NaN for points that are not before the camera."""
        in_camera = transform_points(T_camera_frame, points)
        before = in_camera[:, 2] > 0
        pixels = np.full((len(points), 2), np.nan)
        if before.any():
            pixels[before] = self.project_with_slopes(in_camera[before])[0]
        return pixels

    def project_with_slopes(
        self, points: Float[np.ndarray, "k 3"]
    ) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2 3"]]:
        """Pixels of points before the camera, in its frame [m], and how they change with the points [pixel/m]."""
        still = (np.zeros(3), np.zeros(3), self.matrix, self.coefficients)
        if self.fisheye:
            pixels, jacobian = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), *still)
            slopes = np.asarray(jacobian)[:, 11:14]
        else:
            pixels, jacobian = cv2.projectPoints(points, *still)
            slopes = np.asarray(jacobian)[:, 3:6]
        return pixels.reshape(-1, 2), slopes.reshape(-1, 2, 3)

    def rays(self, pixels: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 3"]:
        """Directions of sight in the camera frame, of length 1 along z."""
        if not self.distortion or len(pixels) == 0:
            plane = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        else:
            stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
            raw = pixels.reshape(-1, 1, 2).astype(float)
            straighten = cv2.fisheye.undistortPoints if self.fisheye else cv2.undistortPoints
            plane = straighten(raw, self.matrix, self.coefficients, criteria=stop).reshape(-1, 2)
            if self.fisheye:  # OpenCV's sign that no ray before the camera leads there
                plane[(plane == NO_RAY).all(axis=1)] = np.nan
        return np.column_stack([plane, np.ones(len(plane))])

    def for_opencv(
        self, pixels: Float[np.ndarray, "k 2"]
    ) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " c"]]:
        """Pixels and coefficients for functions of OpenCV that have no fisheye model.

        Of a fisheye lens: the pixels of the same rays in a camera without distortion.
        """
        if not self.fisheye:
            return pixels, self.coefficients
        return self.rays(pixels)[:, :2] * [self.fx, self.fy] + [self.cx, self.cy], np.zeros(4)

    def undistortion(
        self, T: Float[np.ndarray, "3 3"], size: tuple[int, int]
    ) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
        """Columns and rows to which each pixel of another image leads.

        Args:
            T: From (column, row, 1) of that image to a ray in the camera frame.
            size: Its columns and rows.
        """
        make = cv2.fisheye.initUndistortRectifyMap if self.fisheye else cv2.initUndistortRectifyMap
        columns, rows = make(self.matrix, self.coefficients, np.eye(3), np.linalg.inv(T), size, cv2.CV_32FC1)
        return columns, rows

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
        values = asdict(self) | {"distortion": list(self.distortion)}
        if not values.pop("fisheye"):
            return {"format": FORMAT, "version": VERSION, **values}
        return {"format": FORMAT, "version": FISHEYE_VERSION, **values, "fisheye": True}

    @classmethod
    def from_dict(cls, values: Any, name: str = "camera") -> "PinholeCamera":
        """The camera that ``to_dict`` described; other keys are ignored.

        Raises:
            PerceptionError: A value is missing or makes no camera.
        """
        if not isinstance(values, dict) or values.get("format") != FORMAT:
            raise PerceptionError(f'{name} is no camera: it lacks "format": "{FORMAT}"')
        fisheye = values.get("version") == FISHEYE_VERSION
        if values.get("version") != VERSION and not fisheye:
            raise PerceptionError(
                f"{name} has format version {shown(values.get('version'))}, this one reads {VERSION} and "
                f"{FISHEYE_VERSION}"
            )
        remedy = "write it by `foretrace calibrate`"
        found = conform(values, CameraEntries, name, PerceptionError, remedy)
        fx, fy, cx, cy = (float(found[key]) for key in ("fx", "fy", "cx", "cy"))
        distortion = tuple(map(float, found.get("distortion", ())))
        return cls(found["width"], found["height"], fx, fy, cx, cy, distortion, fisheye)

    def save(self, path: str | Path, **more: Any) -> None:
        """Write the camera as JSON, with further values beside it."""
        write_json(Path(path), {**self.to_dict(), **more})

    @classmethod
    def load(cls, path: str | Path) -> "PinholeCamera":
        """The camera in a file: JSON, or YAML of ROS, OpenCV or Kalibr.

        Raises:
            PerceptionError: The file is missing, damaged, or describes no camera.
        """
        path = Path(path)
        if path.suffix.lower() in YAML:
            return cls(**read_camera_yaml(path))
        return cls.from_dict(
            read_json(path, dict[str, Any], PerceptionError, "make one with `foretrace calibrate`"),
            str(path),
        )
