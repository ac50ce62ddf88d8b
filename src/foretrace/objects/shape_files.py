"""Objects and outlines from files: corners as text, meshes, descriptions, images of silhouettes."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from foretrace.errors import ShapeError
from foretrace.files import read_json
from foretrace.images import read_image
from foretrace.objects import MeshObject, ObjectModel, Prism, object_from_dict
from foretrace.objects.mesh_files import is_mesh_file
from foretrace.objects.object_pixels import MOST_PIXELS, Label, object_pixels
from foretrace.objects.polygon_files import read_polygon
from foretrace.objects.prism import DEFAULT_HEIGHT


def read_shape(
    path: Path, height: float | None = None, scale: float | None = None, rest: bool = False
) -> ObjectModel:
    """An object from a file.

    Args:
        path: A description (``.json``, from ``to_dict``), a mesh (STL, OBJ, PLY, OFF), or else an outline.
        height: Height of an outline's prism [m]; 0.02 by default.
        scale: Metres per unit of a mesh or an outline; 1 by default.
        rest: Whether to turn a mesh onto the side on which its centre of mass is lowest.

    Raises:
        ShapeError: The file is missing, damaged, or describes no usable object.
    """
    if is_mesh_file(path):
        return MeshObject.load(path, 1.0 if scale is None else scale, rest=rest)
    if rest:
        raise ShapeError(f"{path} is no mesh and lies as it should: leave out --rest")
    if path.suffix.lower() == ".json":
        content = read_json(path, dict[str, Any], ShapeError, "give an object's to_dict() as JSON")
        if "type" not in content:  # GeoJSON names its type, an object its kind
            if scale is not None:
                raise ShapeError(f"{path} describes an object in metres: leave out --scale")
            return object_from_dict(content)
    return Prism(read_polygon(path, scale), DEFAULT_HEIGHT if height is None else height)


def read_silhouette_image(
    file: Path, label: Label | None = None, invert: bool = False
) -> Bool[np.ndarray, "rows columns"]:
    """The pixels that an image marks as object, turned as viewers show it: by `object_pixels`.

    Args:
        file: The image.
        label: The object's value in an image of several labels.
        invert: The object is black on white.

    Raises:
        ShapeError: The file cannot be read as an image, or leaves open which is the object.
    """
    try:
        return object_pixels(read_image(file, ShapeError, upright=True, most=MOST_PIXELS), label, invert)
    except ShapeError as error:
        raise ShapeError(str(error) if str(file) in str(error) else f"{file}: {error}") from None
