"""The example that comes with foretrace: an object's mask, and a photograph of it on a table with markers."""

from importlib.resources import files

EXAMPLE = "example"
"""Folder of the example's files."""
MASK, PHOTO, BACKGROUND, CAMERA, MARKERS = (
    "mask.png",
    "photo.jpg",
    "background.jpg",
    "camera.json",
    "markers.json",
)
FILES = (MASK, PHOTO, BACKGROUND, CAMERA, MARKERS)
SCALE = 0.0005
"""Metres per pixel of the mask."""
HEIGHT = 0.018
"""Height of the object [m]."""
CONTACT = (-0.0687, -0.0289)
"""Where it is levered, in the mask's frame [m]."""
CONTACT_PX = (565, 209)
"""The same point in the photograph."""


def example_file(name: str) -> bytes:
    """What one of the files holds."""
    return files("foretrace").joinpath("assets", EXAMPLE, name).read_bytes()
