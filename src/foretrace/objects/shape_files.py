"""Objects and outlines from files: corners as text, meshes, descriptions, images of silhouettes."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from foretrace.errors import ShapeError
from foretrace.files import read_json
from foretrace.images import read_image
from foretrace.objects import MeshObject, ObjectModel, Prism, object_from_dict
from foretrace.objects.polygon_files import read_polygon
from foretrace.objects.prism import DEFAULT_HEIGHT


def read_shape(path: Path, height: float | None = None) -> ObjectModel:
    """An object from a description (``.json``, from ``to_dict``), a mesh (``.stl``, ``.obj``) or an outline (others).

    Args:
        path: The file.
        height: Height of an outline's prism [m]; 0.02 by default.

    Raises:
        ShapeError: The file is missing, damaged, or describes no usable object.
    """
    if path.suffix.lower() in (".stl", ".obj"):
        return MeshObject.load(path)
    if path.suffix.lower() == ".json":
        content = read_json(path, dict[str, Any], ShapeError, "give an object's to_dict() as JSON")
        if "type" not in content:  # GeoJSON names its type, an object its kind
            return object_from_dict(content)
    return Prism(read_polygon(path), DEFAULT_HEIGHT if height is None else height)


def read_silhouette_image(file: Path) -> UInt8[np.ndarray, "rows columns"]:
    """A silhouette's image in grey.

    Raises:
        ShapeError: The file cannot be read as an image.
    """
    return cv2.cvtColor(read_image(file, ShapeError, upright=True).bgr(file, ShapeError), cv2.COLOR_BGR2GRAY)
