"""Cameras as other tools write them in YAML: ROS's camera_calibration (``ost.yaml``), OpenCV and Kalibr."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from foretrace.errors import PerceptionError, shown
from foretrace.files import read_text
from foretrace.interactions.lens_models import FISHEYE, OPENCV, lens_of

REMEDY = "give a camera file of `foretrace calibrate`, ROS (ost.yaml), OpenCV or Kalibr"
LARGEST = 1 << 20
"""Longest text that is parsed: cameras have a thousand characters."""
NAMES = {
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "matrix": ("camera_matrix", "cameramatrix", "k", "intrinsic_matrix", "mtx"),
    "distortion": ("distortion_coefficients", "dist_coeffs", "distcoeffs", "d", "dist"),
    "model": ("distortion_model",),
}
"""Keys in small letters; tools write them in several ways."""


class _Loader(yaml.SafeLoader):
    """Plain values only; OpenCV's matrices are mappings with a tag of their own."""


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def read_camera_yaml(path: Path) -> dict[str, Any]:
    """What makes a `PinholeCamera` of a YAML file, by the names of its fields.

    Raises:
        PerceptionError: The file is missing or damaged, or it holds no camera or several.
    """
    content = _parsed(path)
    several = {key: one for key, one in content.items() if isinstance(one, dict) and "intrinsics" in one}
    if len(several) > 1:
        raise PerceptionError(
            f"{path} has the cameras {', '.join(map(str, several))[:60]}: keep the one that is meant"
        )
    try:
        return _kalibr(next(iter(several.values()))) if several else _ros_or_opencv(content)
    except PerceptionError as error:
        raise PerceptionError(f"{path}: {error}: {REMEDY}") from error
    except KeyError as error:
        raise PerceptionError(f"{path} lacks {error.args[0]}: {REMEDY}") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise PerceptionError(
            f"{path} has a value that is no number ({str(error)[:60]}): {REMEDY}"
        ) from error


def _parsed(path: Path) -> dict[str, Any]:
    text = read_text(path, PerceptionError, REMEDY)
    if len(text) > LARGEST:
        raise PerceptionError(f"{path} is too large for a camera: {REMEDY}")
    try:
        # OpenCV's first line is none that YAML allows.
        content = yaml.load(text.removeprefix("%YAML:1.0"), _Loader)  # of plain values only
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        reason = str(getattr(error, "problem", None) or error)[:60]
        mark = getattr(error, "problem_mark", None)
        place = "" if mark is None else f" in line {mark.line + 1}"
        raise PerceptionError(f"{path} cannot be read as YAML ({reason}{place}): {REMEDY}") from error
    if not isinstance(content, dict):
        raise PerceptionError(f"{path} holds no camera: {REMEDY}")
    return content


def _ros_or_opencv(content: Mapping[str, Any]) -> dict[str, Any]:
    small = {str(key).lower(): value for key, value in content.items()}
    found = {name: next((small[key] for key in keys if key in small), None) for name, keys in NAMES.items()}
    for name in ("width", "height", "matrix", "distortion"):
        if found[name] is None:
            raise KeyError(NAMES[name][0])
    matrix, lens = _matrix(found["matrix"]), _matrix(found["distortion"])
    model = found["model"]
    if model is None:  # OpenCV: the number of coefficients tells the model, but for the fisheye one
        model = FISHEYE[0] if small.get("fisheye_model") else OPENCV[0]
    return _camera(found["width"], found["height"], matrix, str(model), lens)


def _kalibr(content: Mapping[str, Any]) -> dict[str, Any]:
    if (kind := content.get("camera_model")) != "pinhole":
        raise PerceptionError(f"camera model {shown(str(kind)[:40])}, of Kalibr's models pinhole can be read")
    fx, fy, cx, cy = (float(value) for value in content["intrinsics"])
    width, height = content["resolution"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    lens = np.asarray(content["distortion_coeffs"], dtype=float)
    return _camera(width, height, matrix, str(content["distortion_model"]), lens)


def _matrix(value: Any) -> np.ndarray:
    """A matrix as a mapping with ``data``, or as lists."""
    return np.asarray(value["data"] if isinstance(value, dict) else value, dtype=float)


def _camera(width: Any, height: Any, matrix: np.ndarray, model: str, lens: np.ndarray) -> dict[str, Any]:
    if matrix.size != 9:
        raise PerceptionError(f"a camera matrix of {matrix.size} numbers, it has 9")
    matrix = matrix.reshape(3, 3)
    if abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
        raise PerceptionError(f"a skew of {matrix[0, 1]:g} pixels, which cannot be used")
    distortion, fisheye = lens_of(model, lens.ravel().tolist())
    return {
        "width": int(width),
        "height": int(height),
        "fx": float(matrix[0, 0]),
        "fy": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]),
        "cy": float(matrix[1, 2]),
        "distortion": distortion,
        "fisheye": fisheye,
    }
