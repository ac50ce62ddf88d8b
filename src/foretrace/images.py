"""The one door through which images are read: pixels as they are stored, or one line that says why not.

Pillow decodes; OpenCV takes over where Pillow would keep only the upper 8 of 16 bits, and for TIFF files of floating
point numbers. Both leave the pixels as the sensor gave them unless a reader asks for the image as viewers show it: a
camera's calibration belongs to the sensor's pixels, whatever way up the camera was held.
"""

import io
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8
from PIL import Image, UnidentifiedImageError
from PIL.TiffImagePlugin import IMAGELENGTH, IMAGEWIDTH, STRIPBYTECOUNTS, STRIPOFFSETS, ImageFileDirectory_v2

from foretrace.errors import ForetraceError

MOST_PIXELS = 80_000_000
"""Larger images are refused before they are decoded: a file of 100 kB may claim any size."""
FORMATS = ("PNG", "JPEG", "BMP", "GIF", "PPM", "WEBP", "TIFF", "JPEG2000", "AVIF")
"""Formats that are read, by Pillow's names, those that it loads at once first; others start programs (EPS)."""
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""How TIFF files begin; so do none of the other formats."""
DAMAGED = "it is damaged or cut off"
REMEDY = "give a whole PNG, JPEG, WebP, TIFF or BMP file"
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
"""Endings of image files that are looked for in a folder."""
ORIENTATION = 0x0112
"""The tag that says how viewers turn and mirror the stored pixels (EXIF 2.3, section 4.6.4)."""
BACK = {6: 8, 8: 6}
"""Tags whose turn another tag's turn undoes; all others undo themselves."""

Stream = io.BytesIO | io.BufferedReader
"""A file that is open for reading, or its bytes."""

logging.getLogger("PIL").addHandler(
    logging.NullHandler()
)  # errors are raised; without a handler they are printed, too


@dataclass(frozen=True, eq=False)
class StoredImage:
    """An image's values as its file has them."""

    values: Shaped[np.ndarray, "rows columns *channels"]
    """One channel, or red, green and blue; whole numbers of 8, 16 or 32 bits, or floating point."""
    alpha: Shaped[np.ndarray, "rows columns"] | None = None
    """Opacity, 0 where transparent; None where the file has none."""
    palette: UInt8[np.ndarray, "rows columns"] | None = None
    """Indices into the file's palette, whose colours the values are; None where it has none."""

    def bgr(self, source: str | Path, error: type[ForetraceError]) -> UInt8[np.ndarray, "rows columns 3"]:
        """Blue, green and red, of 16 bits the upper 8; transparency is left out.

        Args:
            source: Where the image is from, for the message.
            error: The class to raise.

        Raises:
            ForetraceError: Of the given class: its values are no colours.
        """
        values = self.values
        if values.dtype == np.uint16:
            values = (values >> 8).astype(np.uint8)
        if values.dtype != np.uint8:
            raise error(f"{source} holds numbers of type {values.dtype}: give a photograph of 8 or 16 bits")
        return np.ascontiguousarray(
            np.repeat(values[..., None], 3, 2) if values.ndim == 2 else values[..., ::-1]
        )


def read_image(
    path: str | Path,
    error: type[ForetraceError],
    upright: bool = False,
    remedy: str = REMEDY,
    most: int = MOST_PIXELS,
) -> StoredImage:
    """The image in a file.

    Args:
        path: The file.
        error: The class to raise.
        upright: Turn it as its orientation tag says, as viewers do; otherwise its pixels are the sensor's.
        remedy: What to do about a file that cannot be read; ends the message.
        most: Images of more pixels are refused.

    Raises:
        ForetraceError: Of the given class: the file is missing, damaged, cut off, too large, of an unknown format or
            several images.
    """
    path = Path(path)
    try:
        if not path.is_file():
            found = "is a folder" if path.is_dir() else "is no file" if path.exists() else "does not exist"
            raise error(f"cannot read an image from {path}, which {found}: {remedy}")
        with open(path, "rb") as stream:
            return _decode(stream, path, error, upright, most)
    except (OSError, ValueError) as reason:
        why = getattr(reason, "strerror", None) or reason
        raise error(f"cannot read an image from {path} ({why}): {remedy}") from None


def decode_image(data: bytes, source: str | Path, error: type[ForetraceError]) -> StoredImage:
    """The image that the bytes of a file hold.

    Args:
        data: The bytes.
        source: Where they are from, for the message.
        error: The class to raise.

    Raises:
        ForetraceError: As `read_image`.
    """
    try:
        return _decode(io.BytesIO(data), source, error)
    except ValueError as reason:
        raise error(f"{source} cannot be decoded ({reason}): record or copy it again") from None


def read_colour(path: str | Path, error: type[ForetraceError]) -> UInt8[np.ndarray, "rows columns 3"]:
    """The photograph in a file: the sensor's pixels as blue, green and red.

    Raises:
        ForetraceError: As `read_image`, or its values are no colours.
    """
    return read_image(path, error).bgr(path, error)


def check_pixels(
    source: str | Path, rows: int, columns: int, error: type[ForetraceError], most: int = MOST_PIXELS
) -> None:
    """Refuse an image of more pixels than can be worked with, by an error of the given class."""
    if rows * columns > most:
        raise error(
            f"{source} has {columns} x {rows} pixels: scale it down to {most / 1e6:.0f} million at most"
        )


def _decode(
    stream: Stream,
    source: str | Path,
    error: type[ForetraceError],
    upright: bool = False,
    most: int = MOST_PIXELS,
) -> StoredImage:
    """The image in a file.

    Raises:
        ValueError: It cannot be decoded.
        ForetraceError: Of the given class: it is too large or several images.
    """
    start = stream.read(12)
    stream.seek(0)
    with _quiet(), _mute() if start[:4] in TIFF else nullcontext():
        try:
            with Image.open(stream, formats=FORMATS) as image:
                check_pixels(source, image.height, image.width, error, most)
                if (frames := _frames(image)) > 1:
                    raise error(f"{source} holds {frames} images: give a file of one")
                return _oriented(image, stream, upright)
        except ForetraceError:
            raise
        except UnidentifiedImageError:
            if start[:4] in TIFF:
                return _decode_tiff(stream, source, error, most)
            heic = start[4:11] in (b"ftyphei", b"ftyphev", b"ftypmif")
            why = (
                "it is HEIC"
                if heic
                else "its format is none of those that are read"
                if start
                else "it is empty"
            )
        except OSError as reason:
            why = str(reason)
        except Exception:  # decoders raise whatever a damaged file makes them stumble over
            why = DAMAGED
    raise ValueError(why)


@contextmanager
def _quiet() -> Iterator[None]:
    """Pillow and OpenCV print nothing, and Pillow leaves the check of the size to `check_pixels`."""
    log, most = cv2.utils.logging, Image.MAX_IMAGE_PIXELS
    level = log.getLogLevel()
    try:
        log.setLogLevel(log.LOG_LEVEL_SILENT)
        Image.MAX_IMAGE_PIXELS = None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        Image.MAX_IMAGE_PIXELS = most
        log.setLogLevel(level)


@contextmanager
def _mute() -> Iterator[None]:
    """Discard the process's standard error, to which libtiff and libpng write without being asked."""
    shown, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(shown, 2)
        os.close(shown)
        os.close(nothing)


def _frames(image: Image.Image) -> int:
    """Images in a file, without thumbnails and what cameras put beside a photograph (gain maps, depth)."""
    count = getattr(image, "n_frames", 1)
    if count == 1 or image.format == "MPO":
        return 1
    if image.format != "TIFF":
        return count
    size, whole = image.size, 0
    for frame in range(count):
        image.seek(frame)
        whole += image.size == size
    image.seek(0)
    return whole


def _oriented(image: Image.Image, stream: Stream, upright: bool) -> StoredImage:
    """Decode an image, its pixels as stored or as viewers show them."""
    tiles = getattr(image, "tile", None)
    layout = tiles[0].args if tiles else ""  # before it is loaded
    layout = layout if isinstance(layout, str) else str(layout and layout[0])
    tag = int(image.getexif().get(ORIENTATION) or 1)
    image.load()  # finds what is cut off, which OpenCV fills up
    if ";16" in layout and not image.mode.startswith("I"):
        stored, shown = _decode_cv(stream), False
    else:
        stored, shown = _stored(image), image.format == "TIFF"  # Pillow turns TIFF files, and no others
    if shown == upright:
        return stored
    tag = tag if upright else BACK.get(tag, tag)
    kept = {name: values for name, values in vars(stored).items() if values is not None}
    return replace(stored, **{name: _turned(values, tag) for name, values in kept.items()})


def _turned(values: np.ndarray, tag: int) -> np.ndarray:
    """Pixels as an orientation tag says that they are shown."""
    if tag in (5, 7):
        values = values.swapaxes(0, 1)
    if tag in (2, 4):
        values = np.flip(values, axis=1 if tag == 2 else 0)
    return np.ascontiguousarray(np.rot90(values, {3: 2, 6: -1, 7: 2, 8: 1}.get(tag, 0)))


def _stored(image: Image.Image) -> StoredImage:
    """An image's values, whatever Pillow's mode of it."""
    palette = np.array(image) if image.mode == "P" else None
    alpha = None
    if image.has_transparency_data:
        if image.mode.startswith("I;16"):
            alpha = (np.array(image) != image.info["transparency"]).astype(np.uint8) * 255
        else:
            alpha = np.array(image.convert("RGBA").getchannel("A"))
    if image.mode in ("1", "LA", "La"):
        image = image.convert("L")
    elif image.mode not in ("L", "I", "F") and not image.mode.startswith("I;16"):
        image = image.convert("RGB")
    return StoredImage(np.array(image), alpha, palette)


def _decode_cv(stream: Stream) -> StoredImage:
    """An image of more than 8 bits in each of several channels, by OpenCV.

    Raises:
        ValueError: It is damaged.
    """
    stream.seek(0)
    data = np.frombuffer(stream.read(), dtype=np.uint8)
    try:
        with _mute():
            values = cv2.imdecode(data, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        values = None
    if values is None:
        raise ValueError(DAMAGED)
    if values.ndim == 2:
        return StoredImage(values)
    return StoredImage(values[..., 2::-1], values[..., 3] if values.shape[2] == 4 else None)


def _decode_tiff(stream: Stream, source: str | Path, error: type[ForetraceError], most: int) -> StoredImage:
    """A TIFF file whose kind of values Pillow does not know, such as floating point numbers of 64 bits.

    Raises:
        ValueError: It is damaged.
        ForetraceError: Of the given class: it is too large.
    """
    try:
        stream.seek(0)
        directory = ImageFileDirectory_v2(stream.read(8))
        stream.seek(directory.next)
        directory.load(stream)
        columns, rows = int(directory[IMAGEWIDTH]), int(directory[IMAGELENGTH])
        strips = list(zip(directory.get(STRIPOFFSETS, ()), directory.get(STRIPBYTECOUNTS, ()), strict=True))
    except Exception:  # as above
        raise ValueError(DAMAGED) from None
    check_pixels(source, rows, columns, error, most)
    if any(offset + count > stream.seek(0, os.SEEK_END) for offset, count in strips):
        raise ValueError(DAMAGED)
    return _decode_cv(stream)
