"""The example that comes with foretrace, as files in a folder, and the commands that predict it."""

from pathlib import Path

from foretrace.cli.contact import ContactOptions
from foretrace.cli.objects import ObjectOptions
from foretrace.errors import PredictionError
from foretrace.files import make_folder, write_bytes
from foretrace.perception.example import (
    BACKGROUND,
    CONTACT,
    CONTACT_PX,
    FILES,
    HEIGHT,
    MASK,
    PHOTO,
    SCALE,
    example_file,
)


def write_example(folder: Path) -> tuple[ObjectOptions, ContactOptions]:
    """Copy the example's files into a folder.

    Returns:
        The options that predict it.
    """
    make_folder(folder, PredictionError)
    for name in FILES:
        write_bytes(folder / name, example_file(name))
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
