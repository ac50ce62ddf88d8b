"""The door for images: every format and depth as stored, the sensor's pixels, and one line for what cannot be read."""

import contextlib
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from foretrace.errors import PerceptionError
from foretrace.images import MOST_PIXELS, decode_image, read_colour, read_image

RNG = np.random.default_rng(0)
PHOTO = cv2.GaussianBlur(RNG.integers(0, 255, (48, 64, 3), dtype=np.uint8), (0, 0), 2)
DEEP = {
    "grey16.png": RNG.integers(0, 65536, (8, 9), dtype=np.uint16),
    "grey16.tif": RNG.integers(0, 65536, (8, 9), dtype=np.uint16),
    "colour16.png": RNG.integers(0, 65536, (8, 9, 3), dtype=np.uint16),
    "colour16.tif": RNG.integers(0, 65536, (8, 9, 3), dtype=np.uint16),
    "float32.tif": RNG.random((8, 9), dtype=np.float32),
    "float64.tif": RNG.random((8, 9)),
    "whole32.tif": RNG.integers(0, 99999, (8, 9), dtype=np.int32),
}


@pytest.mark.parametrize("format", ["png", "jpg", "webp", "bmp", "tif", "ppm"])
def test_colours_are_those_that_opencv_reads(format: str, tmp_path: Path) -> None:
    path = tmp_path / f"photo Ä.{format}"
    path.write_bytes(cv2.imencode(f".{format}", PHOTO)[1].tobytes())
    expected = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(read_colour(path, PerceptionError), expected)
    np.testing.assert_array_equal(
        decode_image(path.read_bytes(), "film", PerceptionError).values, expected[..., ::-1]
    )


@pytest.mark.parametrize("format", ["png", "jpg", "webp", "tif"])
@pytest.mark.parametrize("tag", range(1, 9))
def test_pixels_are_the_sensors_whatever_the_orientation_tag(format: str, tag: int, tmp_path: Path) -> None:
    path, exif = tmp_path / f"photo.{format}", Image.Exif()
    exif[0x0112] = tag
    options = {"compression": "tiff_lzw"} if format == "tif" and tag % 2 else {}
    Image.fromarray(PHOTO[..., ::-1]).save(path, exif=exif, **options)
    stored = read_colour(path, PerceptionError)
    assert np.abs(stored.astype(int) - PHOTO).mean() < 5
    shown = read_image(path, PerceptionError, upright=True).bgr(path, PerceptionError)
    upright = Image.fromarray(stored)
    upright.getexif()[0x0112] = tag
    np.testing.assert_array_equal(shown, np.asarray(ImageOps.exif_transpose(upright)))


@pytest.mark.parametrize("name", DEEP)
def test_values_are_as_stored(name: str, tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / name), DEEP[name])
    values = read_image(tmp_path / name, PerceptionError).values
    assert values.dtype == DEEP[name].dtype
    np.testing.assert_array_equal(values if values.ndim == 2 else values[..., ::-1], DEEP[name])


def test_alpha_and_palette_are_kept(tmp_path: Path) -> None:
    grey = Image.fromarray(PHOTO[..., 0])
    alpha = Image.fromarray(PHOTO[..., 1])
    Image.merge("LA", [grey, alpha]).save(tmp_path / "la.png")
    found = read_image(tmp_path / "la.png", PerceptionError)
    np.testing.assert_array_equal(found.values, PHOTO[..., 0])
    np.testing.assert_array_equal(found.alpha, PHOTO[..., 1])
    indices = np.zeros((8, 9), dtype=np.uint8)
    indices[2:5] = 3
    image = Image.fromarray(indices, mode="P")
    image.putpalette([0, 0, 0, 9, 9, 9, 8, 8, 8, 128, 64, 0])
    image.save(tmp_path / "palette.png", transparency=0)
    found = read_image(tmp_path / "palette.png", PerceptionError)
    np.testing.assert_array_equal(found.palette, indices)
    np.testing.assert_array_equal(found.alpha, np.where(indices == 0, 0, 255))
    np.testing.assert_array_equal(found.values[3, 3], [128, 64, 0])


def bomb(columns: int, rows: int) -> bytes:
    """A PNG file of few bytes that claims many pixels."""
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", columns, rows, 1, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(b"\0")),
    ]
    chunks = [struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in parts]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def encoded(format: str, image: np.ndarray = PHOTO) -> bytes:
    return cv2.imencode(f".{format}", image)[1].tobytes()


def animated(format: str, path: Path) -> bytes:
    image = Image.fromarray(PHOTO)
    image.save(path, format, save_all=True, append_images=[image.rotate(20)])
    return path.read_bytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "it is empty"),
        (b"no image", "its format is none"),
        (b"\0\0\0\x18ftypheic\0\0\0\0", "it is HEIC"),
        (bomb(40_000, 30_000), "40000 x 30000 pixels: scale it down"),
        (bomb(60, 40), "truncated"),
        (encoded("jpg")[:-40], "truncated"),
        (encoded("png")[:-200], "truncated"),
        (encoded("tif")[:90], "cut off"),
        (encoded("png", DEEP["colour16.png"])[:-60], "truncated"),
        (encoded("tif", DEEP["float64.tif"])[:-300], "cut off"),
    ],
)
def test_what_is_no_image_is_refused_in_a_line(
    content: bytes, message: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(content)
    with pytest.raises(PerceptionError, match=message) as refused:
        read_image(path, PerceptionError)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)
    with pytest.raises(PerceptionError, match=message):
        decode_image(content, "film", PerceptionError)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("format", ["GIF", "WEBP", "PNG", "TIFF"])
def test_several_images_in_a_file_are_refused(format: str, tmp_path: Path) -> None:
    animated(format, tmp_path / "image")
    with pytest.raises(PerceptionError, match="holds 2 images"):
        read_image(tmp_path / "image", PerceptionError)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    for path, message in (
        (tmp_path, "is a folder"),
        (tmp_path / "none", "does not exist"),
        ("a\0b", "exist"),
    ):
        with pytest.raises(PerceptionError, match=message):
            read_image(path, PerceptionError)
    assert MOST_PIXELS < 2**30  # what OpenCV decodes, too


def test_damaged_files_are_refused_and_print_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Bytes changed at random: an image or a line, whatever the decoder makes of them."""
    rng = np.random.default_rng(0)
    files = [encoded(format) for format in ("png", "jpg", "webp", "bmp", "tif", "gif", "ppm")]
    files += [encoded("png", DEEP["colour16.png"]), encoded("tif", DEEP["float64.tif"])]
    for whole in files:
        for k in range(40):
            damaged = bytearray(whole)
            for place in rng.integers(len(whole) if k % 2 else 64, size=3):
                damaged[place] = rng.integers(256)
            with contextlib.suppress(PerceptionError):
                decode_image(bytes(damaged), "film", PerceptionError)
    assert capfd.readouterr() == ("", "")
