"""Objects and outlines from files: corners as text, meshes, descriptions, images of silhouettes."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from foretrace.errors import ShapeError
from foretrace.files import read_json
from foretrace.images import read_image
from foretrace.objects import MeshObject, ObjectModel, Prism, object_from_dict
from foretrace.objects.object_pixels import Label, object_pixels
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


<<<<<<< HEAD
def read_silhouette_image(file: Path) -> UInt8[np.ndarray, "rows columns"]:
    """A silhouette's image in grey.
=======
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


def read_silhouette_image(
    file: Path, label: Label | None = None, invert: bool = False
) -> Bool[np.ndarray, "rows columns"]:
    """The pixels that an image marks as object, turned as viewers show it: by `object_pixels`.

    Args:
        file: The image.
        label: The object's value in an image of several labels.
        invert: The object is black on white.
>>>>>>> 746e772 (Masks: transparency, depth of values, labels and inversion are read as they are meant or named)

    Raises:
        ShapeError: The file cannot be read as an image, or leaves open which is the object.
    """
    try:
        return object_pixels(read_image(file, ShapeError, upright=True), label, invert)
    except ShapeError as error:
        raise ShapeError(str(error) if str(file) in str(error) else f"{file}: {error}") from None
