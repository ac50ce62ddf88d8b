"""Outlines that the user gives as files."""

from pathlib import Path
from typing import TYPE_CHECKING

from foretrace.errors import ShapeError

if TYPE_CHECKING:
    import numpy as np


def read_polygon(file: Path) -> "np.ndarray":
    """Corners (n, 2) [m] from a text file with one "x y" or "x,y" per line; ``#`` starts a comment.

    Raises:
        ShapeError: If the file is missing or is not such a table.
    """
    import numpy as np

    try:
        text = file.read_text(encoding="utf-8")
        corners = np.loadtxt(text.replace(",", " ").splitlines(), ndmin=2)
    except (OSError, ValueError) as error:
        raise ShapeError(
            f'cannot read corners from {file} ({error}): write one "x y" per line [m]'
        ) from error
    if corners.ndim != 2 or corners.shape[1] != 2:
        raise ShapeError(f'{file} has {corners.shape[-1]} numbers per line: write one "x y" per line [m]')
    return corners


def read_mask(file: Path) -> "np.ndarray":
    """A picture (rows, columns) in grey.

    Raises:
        ShapeError: If the file cannot be read as a picture.
    """
    import cv2

    picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise ShapeError(f"cannot read a picture from {file}: give a PNG or JPEG, white object on black")
    return picture
