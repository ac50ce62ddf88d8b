"""Objects of a visitor: examples by name, corners as text, and files that are uploaded, all bounded."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory

import numpy as np

from foretrace.errors import ForetraceError, StudioError
from foretrace.objects import Box, ObjectModel, Prism
from foretrace.objects.everyday import EVERYDAY, HEPTAGON, PENTAGON
from foretrace.objects.mesh_files import is_mesh_file
from foretrace.objects.model import fitting_bevel
from foretrace.objects.prism import DEFAULT_HEIGHT, check_polygon
from foretrace.objects.shape_files import read_shape, read_silhouette_image
from foretrace.objects.surface import triangles_of

MOST_BYTES = 8 << 20
"""Largest file that is taken."""
MOST_TEXT = 20_000
"""Longest text with corners [characters]."""
MOST_CORNERS = 400
"""Corners of an outline, at most: planning takes time with each."""
MOST_TRIANGLES = 40_000
"""Triangles of a mesh, at most: each visitor's browser gets them."""
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".gif")
"""Endings of files that are taken for masks."""


def _disc(radius: float, height: float) -> Prism:
    angles = 2 * np.pi * np.arange(48) / 48
    corners = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return Prism(corners, height, fitting_bevel(corners, height))


def _bracket() -> Prism:
    corners = np.array(
        [(-0.07, -0.06), (0.08, -0.06), (0.08, -0.01), (-0.02, -0.01), (-0.02, 0.08), (-0.07, 0.08)]
    )
    return Prism(corners, 0.02, fitting_bevel(corners, 0.02))


EXAMPLES: Mapping[str, ObjectModel] = {
    "pentagon": PENTAGON,
    "heptagon": HEPTAGON,
    **{name.lower(): thing for name, (thing, _) in EVERYDAY.items()},
    "bracket": _bracket(),
    "disc": _disc(0.07, 0.015),
    "box": Box(0.16, 0.1, 0.05),
}
"""Objects to begin with, by name."""


def example(name: str) -> ObjectModel:
    """An object by its name.

    Raises:
        StudioError: There is no such example.
    """
    if name not in EXAMPLES:
        raise StudioError(f"there is no example {name!r}: choose from {', '.join(EXAMPLES)}")
    return EXAMPLES[name]


def prism_of(corners: np.ndarray, height: float = DEFAULT_HEIGHT) -> Prism:
    """The prism of an outline that was drawn, with a bevel that fits.

    Args:
        corners: (corners, 2) [m], in order.
        height: Its height [m].

    Raises:
        ShapeError: It is no outline of an object.
    """
    outline = check_polygon(corners)
    return Prism(outline, height, fitting_bevel(outline, height))


def from_text(text: str, height: float = DEFAULT_HEIGHT) -> ObjectModel:
    """The prism whose corners are written down, one ``x y`` in each line [m].

    Raises:
        StudioError: The text is too long, or has too many corners.
        ShapeError: It holds no outline of an object.
    """
    if len(text) > MOST_TEXT:
        raise StudioError(f"the corners are {len(text)} characters long: give at most {MOST_TEXT}")
    return from_file("corners.txt", text.encode(), height)


def from_file(
    name: str, content: bytes, height: float = DEFAULT_HEIGHT, scale: float | None = None
) -> ObjectModel:
    """The object in a file that was uploaded: a mask, a mesh, corners, or a description.

    Args:
        name: The file's name, whose ending says what it is.
        content: What is in it.
        height: Height of a mask's or an outline's prism [m].
        scale: Metres per pixel of a mask, or per unit of a mesh or an outline.

    Raises:
        StudioError: The file is too large, or a mask comes without a scale.
        ShapeError: It holds no object.
    """
    check_bytes(name, content)
    with written(name, content) as file:
        if file.suffix.lower() in IMAGES:
            if scale is None:
                raise StudioError(f"{file.name} is a mask: give its scale, the metres per pixel")
            found: ObjectModel = Prism.from_mask(read_silhouette_image(file), scale, height)
        elif is_mesh_file(file):
            found = read_shape(file, None, scale, rest=True)
        else:
            found = read_shape(file, height, scale)
    return checked(found)


def check_bytes(name: str, content: bytes) -> None:
    """Refuse a file that is too large.

    Raises:
        StudioError: It has more than `MOST_BYTES`.
    """
    if len(content) > MOST_BYTES:
        raise StudioError(too_large(name, len(content)))


def too_large(name: str, size: int) -> str:
    """What is said of a file that is too large."""
    return f"{PurePath(name).name} has {size / 2**20:.1f} MB: give at most {MOST_BYTES >> 20} MB"


def checked(obj: ObjectModel) -> ObjectModel:
    """An object that is small enough for a page.

    Raises:
        StudioError: It has too many corners or triangles.
    """
    if (count := len(obj.corners)) > MOST_CORNERS:
        raise StudioError(
            f"the outline has {count} corners: give at most {MOST_CORNERS}, or a simpler outline"
        )
    if (count := len(triangles_of(obj)[1])) > MOST_TRIANGLES:
        raise StudioError(f"the mesh has {count} triangles: give at most {MOST_TRIANGLES}, or a simpler mesh")
    return obj


@contextmanager
def written(name: str, content: bytes) -> Iterator[Path]:
    """A file of that content while it is needed; errors name it without its folder."""
    ending = "".join(letter for letter in PurePath(name).suffix if letter.isalnum() or letter == ".")[:10]
    stem = "".join(letter for letter in PurePath(name).stem if letter.isalnum() or letter in "-_ ")[:60]
    with TemporaryDirectory(prefix="foretrace-") as folder:
        file = Path(folder) / f"{stem or 'file'}{ending}"
        file.write_bytes(content)
        try:
            yield file
        except ForetraceError as error:
            raise type(error)(str(error).replace(f"{folder}/", "")) from None
