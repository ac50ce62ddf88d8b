"""Objects and outlines from files: corners as text, meshes, descriptions, images of silhouettes."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.errors import ShapeError
from foretrace.files import read_json
from foretrace.images import read_image
from foretrace.objects import MeshObject, ObjectModel, Prism, object_from_dict
from foretrace.objects.prism import DEFAULT_HEIGHT


def read_shape(path: Path, height: float | None = None) -> ObjectModel:
    """An object from a description (``.json``, from ``to_dict``), a mesh (``.stl``, ``.obj``) or an outline (text).

    Args:
        path: The file.
        height: Height of an outline's prism [m]; 0.02 by default.

    Raises:
        ShapeError: The file is missing, damaged, or describes no usable object.
    """
    if path.suffix.lower() in (".stl", ".obj"):
        return MeshObject.load(path)
    if path.suffix.lower() == ".json":
        return object_from_dict(read_json(path, ShapeError, "give an object's to_dict() as JSON"))
    return Prism(read_polygon(path), DEFAULT_HEIGHT if height is None else height)


def read_polygon(file: Path) -> Float[np.ndarray, "n 2"]:
    """Corners [m] from a text file with one "x y" or "x,y" per line; ``#`` starts a comment.

    Raises:
        ShapeError: The file is missing or is no such table.
    """
    try:
        text = file.read_text(encoding="utf-8")
        lines = [line.split("#")[0].replace(",", " ").strip() for line in text.splitlines()]
        corners = np.loadtxt([line for line in lines if line] or ["nan"], ndmin=2)
    except (OSError, ValueError) as error:
        raise ShapeError(
            f'cannot read corners from {file} ({error}): write one "x y" per line [m]'
        ) from error
    if not any(lines):
        raise ShapeError(f'{file} holds no corners: write one "x y" per line [m]')
    if corners.ndim != 2 or corners.shape[1] != 2:
        raise ShapeError(f'{file} has {corners.shape[-1]} numbers per line: write one "x y" per line [m]')
    return corners


def read_silhouette_image(file: Path) -> UInt8[np.ndarray, "rows columns"]:
    """A silhouette's image in grey.

    Raises:
        ShapeError: The file cannot be read as an image.
    """
    return cv2.cvtColor(read_image(file, ShapeError, upright=True).bgr(file, ShapeError), cv2.COLOR_BGR2GRAY)
