"""Objects of a visitor in a photograph: files that are uploaded, and what `foretrace predict --photo` finds in them."""

import io
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from foretrace.actions import LeverUp
from foretrace.errors import StudioError, shown
from foretrace.images import check_pixels
from foretrace.imagined import ImaginedEffect
from foretrace.imagined.shown import radius_of
from foretrace.perception.example import BACKGROUND, CAMERA, CONTACT_PX, HEIGHT, MARKERS, PHOTO, example_file
from foretrace.perception.photo import PhotoConfig, PhotoView, open_photo
from foretrace.studio.shapes import check_bytes, written

KINDS: Mapping[str, str] = {
    "photo": PHOTO,
    "background": BACKGROUND,
    "camera": CAMERA,
    "markers": MARKERS,
}
"""Files that go with a photograph, and their names in the example that comes with foretrace."""
DEFAULTS = ("camera", "markers")
"""Files of which the example's are taken if none are given."""
METHODS = ("background", "threshold", "colour", "grabcut")
"""Ways to tell the object from the table without a depth image."""
MOST_PIXELS = 16_000_000
"""A photograph of more pixels takes minutes."""
SHOWN_WIDTH = 480
"""Columns of the photograph in the panel."""

Upload = tuple[str, bytes]
"""Name and content of a file."""


@dataclass(frozen=True)
class PhotoRequest:
    """What a visitor has said of a photograph."""

    files: Mapping[str, Upload]
    """The files; camera and markers are the example's unless given."""
    height: float
    """Height of the object [m]."""
    method: str = "background"
    """How the object is told from the table."""
    contact: str = ""
    """Column and row of the contact; empty: the largest object, at the middle of its longest edge."""
    box: str = ""
    """Left column, upper row, width and height of a box round the object, for grabcut."""

    def observe(self) -> PhotoView:
        """Object and lever-up in the photograph.

        Raises:
            StudioError: Something is missing, is no number, or is too large.
            PerceptionError: The photograph does not show an object on a table.
        """
        files = {kind: (KINDS[kind], example_file(KINDS[kind])) for kind in DEFAULTS} | dict(self.files)
        if "photo" not in files:
            raise StudioError("there is no photograph yet: choose one, or take the example")
        contact = _numbers("the contact", self.contact, ("column", "row"))
        box = _numbers("the box", self.box, ("left", "top", "width", "height"))
        if self.method == "background" and "background" not in files:
            raise StudioError(
                "background needs a photograph of the table without the object: choose one, or another method"
            )
        if self.method == "grabcut" and box is None:
            raise StudioError("grabcut needs a box round the object: write left, top, width and height")
        if self.method == "colour" and contact is None:
            raise StudioError("colour needs the contact: write its column and row in the photograph")
        for kind in ("photo", "background"):
            if kind in files:
                _check_picture(*files[kind])
        config = PhotoConfig(
            mask=self.method,  # pyright: ignore[reportArgumentType]
            box=None if box is None or self.method != "grabcut" else tuple(map(round, box)),  # pyright: ignore
            height=self.height,
        )
        with ExitStack() as opened:
            paths: dict[str, Path] = {
                kind: opened.enter_context(written(*file)) for kind, file in files.items()
            }
            return open_photo(paths.pop("photo"), contact, **paths, config=config)  # pyright: ignore


def example_request(height: float = HEIGHT) -> PhotoRequest:
    """The example that comes with foretrace."""
    files: dict[str, Upload] = {kind: (name, example_file(name)) for kind, name in KINDS.items()}
    return PhotoRequest(files, height, contact=" ".join(map(str, CONTACT_PX)))


def picture_of(
    seen: PhotoView, action: LeverUp, imagined: ImaginedEffect | None
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The photograph with the outline and what is imagined of a lever-up drawn into it: red, green, blue.

    Args:
        seen: What the photograph shows.
        action: The lever-up, in the object's frame.
        imagined: What is imagined of it.
    """
    now = replace(seen, action=action)
    drawn = now.overlay() if imagined is None else now.overlay(imagined.com_trajectory, radius_of(imagined))
    small = Image.fromarray(drawn[:, :, ::-1])
    small.thumbnail((SHOWN_WIDTH, SHOWN_WIDTH))
    return np.asarray(small)


class PhotoPanel:
    """The part of a visitor's panel in which a photograph is given.

    Args:
        gui: The visitor's panel, in viser.
    """

    def __init__(self, gui: Any) -> None:
        self._files: dict[str, Upload] = {}
        with gui.add_folder("Photograph", expand_by_default=False):
            gui.add_markdown(
                "Of an object on a table with markers, by a calibrated camera; height as above. "
                "Camera and markers are the example's unless given."
            )
            self.example = gui.add_button("example photograph")
            blank = np.zeros((1, 1, 3), np.uint8)
            self._picture = gui.add_image(blank, label="photograph", visible=False)
            images, texts = "image/jpeg,image/png", ".json,.yaml,.yml"
            self.uploads: dict[str, Any] = {
                "photo": gui.add_upload_button("choose a photograph", hint="JPEG or PNG.", mime_type=images),
                "background": gui.add_upload_button(
                    "choose one of the empty table", hint="JPEG or PNG, by the same camera.", mime_type=images
                ),
                "camera": gui.add_upload_button(
                    "choose a camera", hint="As `foretrace calibrate` writes it, or of ROS, OpenCV, Kalibr.",
                    mime_type=texts,
                ),
                "markers": gui.add_upload_button(
                    "choose a marker layout", hint="As `foretrace markers` writes it.", mime_type=texts
                ),
            }  # fmt: skip
            self._method = gui.add_dropdown("object told by", METHODS, initial_value=METHODS[0])
            self._contact = gui.add_text(
                "contact [px]", "", hint="Column and row on its upper rim; or nothing: drag it afterwards."
            )
            self._box = gui.add_text("box [px]", "", hint="Left, top, width, height; for grabcut.")
            self.find = gui.add_button("find the object", color="green")
            self._given = gui.add_markdown("")

    def take(self, kind: str) -> None:
        """Keep a file that was uploaded.

        Raises:
            StudioError: It is too large.
        """
        file = self.uploads[kind].value
        check_bytes(file.name, file.content)
        self._files[kind] = (file.name, file.content)
        self._say()

    def take_example(self) -> PhotoRequest:
        """Show the example's files, and ask for what they show."""
        request = example_request()
        self._files, self._contact.value = dict(request.files), request.contact
        self._method.value = request.method
        self._say()
        return request

    def request(self, height: float) -> PhotoRequest:
        """What is asked for."""
        return PhotoRequest(self._files, height, self._method.value, self._contact.value, self._box.value)

    def show(self, picture: UInt8[np.ndarray, "rows columns 3"] | None) -> None:
        """Show the photograph; None: none."""
        self._picture.visible = picture is not None
        if picture is not None:
            self._picture.image = picture

    def _say(self) -> None:
        self._given.content = ", ".join(f"{kind}: {name}" for kind, (name, _) in self._files.items())


def _check_picture(name: str, content: bytes) -> None:
    """Refuse a picture that is too large, before it is decoded; what is no picture is refused later."""
    check_bytes(name, content)
    try:
        with Image.open(io.BytesIO(content)) as opened:
            columns, rows = opened.size
    except (OSError, ValueError, Image.DecompressionBombError):
        return
    check_pixels(name, rows, columns, StudioError, MOST_PIXELS)


def _numbers(what: str, text: str, names: tuple[str, ...]) -> tuple[float, ...] | None:
    """Numbers that are written with blanks or commas between; None: nothing is written.

    Raises:
        StudioError: They are no such numbers.
    """
    parts = text.replace(",", " ").split()
    if not parts:
        return None
    try:
        values = tuple(float(part) for part in parts)
    except ValueError:
        values = ()
    if len(values) != len(names) or not np.isfinite(values).all():
        raise StudioError(f"{what} is {shown(text)}: write {', '.join(names)} in pixels")
    return values
