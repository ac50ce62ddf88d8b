"""The example that comes with foretrace: an object's mask, and a photograph of it on a table."""

from importlib.resources import files
from pathlib import Path

from foretrace.cli.contact import ContactOptions
from foretrace.cli.objects import ObjectOptions
from foretrace.errors import PredictionError
from foretrace.files import make_folder, write_bytes

EXAMPLE = "example"
"""Folder of the example's files."""
MASK, PHOTO, BACKGROUND = "mask.png", "photo.jpg", "background.jpg"
FILES = (MASK, PHOTO, BACKGROUND, "camera.json", "markers.json")
SCALE = 0.0005
"""Metres per pixel of the mask."""
HEIGHT = 0.018
"""Height of the object [m]."""
CONTACT = (-0.0687, -0.0289)
"""Where it is levered, in the mask's frame [m]."""
CONTACT_PX = (565, 209)
"""The same point in the photograph."""


def write_example(folder: Path) -> tuple[ObjectOptions, ContactOptions]:
    """Copy the example's files into a folder.

    Returns:
        The options that predict it.
    """
    make_folder(folder, PredictionError)
    for name in FILES:
        write_bytes(folder / name, files("foretrace").joinpath("assets", EXAMPLE, name).read_bytes())
    return ObjectOptions(image=folder / MASK, scale=SCALE, height=HEIGHT), ContactOptions(contact=CONTACT)


def say_example(folder: Path) -> None:
    """Print the commands that predict the same from its files."""
    contact, pixel = (" ".join(map(str, point)) for point in (CONTACT, CONTACT_PX))
    print(
        f"\nthe same by hand:\n  foretrace predict --image {folder / MASK} --scale {SCALE} --height {HEIGHT} \\"
    )
    print(f"    --contact {contact}\nfrom a photograph:")
    print(f"  foretrace predict --photo {folder / PHOTO} --contact-px {pixel} --height {HEIGHT} \\")
    print(f"    --mask background --background {folder / BACKGROUND}")
