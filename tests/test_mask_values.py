"""What a mask means: transparency, depth of its values, labels, inversion; and what a hole or a border gives away."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageFilter

from foretrace.cli.objects import ObjectOptions
from foretrace.errors import ForetraceError, ShapeError
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Prism, read_silhouette
from foretrace.objects.shape_files import read_silhouette_image

CORNERS = np.array([[45, 36], [126, 27], [141, 99], [60, 120]])


def quadrilateral(shift: int = 4) -> np.ndarray:
    """Which part of each pixel a quadrilateral covers, of 255."""
    large = np.zeros((150 << shift, 180 << shift), dtype=np.uint8)
    cv2.fillPoly(large, [CORNERS << shift], [255])
    return cv2.resize(large, (180, 150), interpolation=cv2.INTER_AREA)


SOFT = quadrilateral()
HARD = SOFT > 127
WHOLE = HARD.astype(np.uint8)
VOID = cv2.dilate(WHOLE, np.ones((7, 7), np.uint8)) - WHOLE
COLOURS = np.array([[0, 0, 0], [128, 0, 0], [224, 224, 192]], dtype=np.uint8)


def grey(values: np.ndarray, mode: str = "PNG", **options: object) -> tuple[Image.Image, str, dict]:
    return Image.fromarray(values), mode, options


def cut_out(object_colour: int, around: int, alpha: np.ndarray = SOFT, mode: str = "PNG") -> tuple:
    values = np.where(HARD, object_colour, around).astype(np.uint8)
    return Image.fromarray(np.dstack([values, values, values, alpha])), mode, {}


def two_tone() -> np.ndarray:
    values = np.zeros((150, 180, 4), dtype=np.uint8)
    values[HARD] = (60, 50, 45, 255)
    values[:, :90][HARD[:, :90]] = (230, 210, 180, 255)
    return values


def indexed(indices: np.ndarray, colours: np.ndarray, **options: object) -> tuple:
    image = Image.fromarray(indices.astype(np.uint8))
    image.putpalette(colours.ravel().tolist())
    return image, "PNG", options


READ_AS_MEANT = {
    "white object, transparent white": cut_out(255, 255),
    "black object, transparent black": cut_out(0, 0),
    "WebP": cut_out(90, 0, mode="WEBP"),
    "TIFF": cut_out(90, 200, mode="TIFF"),
    "two tones": (Image.fromarray(two_tone()), "PNG", {}),
    "grey with alpha": (Image.merge("LA", [Image.fromarray(WHOLE * 0), Image.fromarray(SOFT)]), "PNG", {}),
    "opaque": cut_out(255, 0, np.full_like(SOFT, 255)),
    "half opaque everywhere": cut_out(255, 0, np.full_like(SOFT, 128)),
    "transparent index of a palette": indexed(WHOLE, np.array([[9, 8, 7], [1, 2, 3]]), transparency=0),
    "palette of a VOC class": indexed(WHOLE, COLOURS),
    "palette of one colour": indexed(WHOLE, np.zeros((2, 3), dtype=np.uint8)),
    "16 bits, 1": grey(WHOLE.astype(np.uint16)),
    "16 bits, 200": grey(WHOLE.astype(np.uint16) * 200),
    "16 bits, 300": grey(WHOLE.astype(np.uint16) * 300),
    "16 bits, 65535": grey(WHOLE.astype(np.uint16) * 65535, "TIFF"),
    "float, 1": grey((SOFT / 255).astype(np.float32), "TIFF"),
    "float, 255": grey(SOFT.astype(np.float32), "TIFF"),
    "1 bit": (Image.fromarray(HARD), "PNG", {}),
    "soft edge": grey(SOFT),
    "JPEG": grey(WHOLE * 255, "JPEG", quality=40),
    "JPEG, quality 100": grey(WHOLE * 255, "JPEG", quality=100),
    "soft JPEG": grey(SOFT, "JPEG", quality=75),
    "blurred": (Image.fromarray(SOFT).filter(ImageFilter.GaussianBlur(2)), "PNG", {}),
    "CMYK": (Image.fromarray(WHOLE * 255).convert("CMYK"), "JPEG", {}),
    "yellow JPEG": (Image.fromarray(WHOLE[..., None] * np.array([220, 200, 20], np.uint8)), "JPEG", {}),
    "dark grey on light grey is no object": grey(np.where(HARD, 200, 120).astype(np.uint8)),
}


@pytest.mark.parametrize("kind", READ_AS_MEANT)
def test_masks_are_read_as_they_are_meant(kind: str, tmp_path: Path) -> None:
    image, format, options = READ_AS_MEANT[kind]
    image.save(tmp_path / "mask", format, **options)
    found = read_silhouette(read_silhouette_image(tmp_path / "mask"))
    assert (found ^ HARD).mean() < 0.001
    assert found.sum() == pytest.approx(HARD.sum(), rel=0.003)


SEPARATE = np.zeros((150, 180), dtype=np.uint8)
SEPARATE[30:90, 20:80], SEPARATE[30:90, 100:150] = 1, 3
INSTANCES = np.kron(np.arange(25).reshape(5, 5), np.ones((24, 24))).astype(np.uint8)
LABELS = {
    "void border": (grey(WHOLE + VOID * 255), 1, HARD, "0, 1, 255: choose"),
    "void border of class 15": (grey(WHOLE * 15 + VOID * 255), 15, HARD, "0, 15, 255"),
    "trimap": (grey(WHOLE * 255 + VOID * 128), 255, HARD, "0, 128, 255"),
    "two classes": (grey(SEPARATE), 3, SEPARATE == 3, "0, 1, 3"),
    "16 bits": (grey(SEPARATE.astype(np.uint16) * 300), 900, SEPARATE == 3, "0, 300, 900"),
    "float": (grey(SEPARATE.astype(np.float32) / 2, "TIFF"), 1.5, SEPARATE == 3, "0, 0.5, 1.5"),
    "many instances": (grey(INSTANCES), 12, INSTANCES == 12, "0, 1, 2, 3, 4, 5, 6, 7 and 17 more"),
    "colours": (
        (Image.fromarray(COLOURS[WHOLE + 2 * VOID]), "PNG", {}),
        (128, 0, 0),
        HARD,
        r"\(0,0,0\), \(128,0,0\), \(224,224,192\)",
    ),
    "colours of one brightness": (
        (Image.fromarray(np.array([[0, 0, 0], [100, 0, 0], [0, 0, 0], [0, 51, 0]], np.uint8)[SEPARATE]), "PNG", {}),
        (100, 0, 0),
        SEPARATE == 1,
        r"\(0,0,0\), \(0,51,0\), \(100,0,0\)",
    ),
    "palette": (indexed(WHOLE + 2 * VOID, COLOURS), 1, HARD, "0, 1, 2"),
}  # fmt: skip


@pytest.mark.parametrize("kind", LABELS)
def test_label_images_are_refused_until_a_label_is_chosen(kind: str, tmp_path: Path) -> None:
    (image, format, options), label, expected, values = LABELS[kind]
    image.save(tmp_path / "mask", format, **options)
    with pytest.raises(ShapeError, match=f"holds the values {values}"):
        read_silhouette_image(tmp_path / "mask")
    np.testing.assert_array_equal(read_silhouette_image(tmp_path / "mask", label), expected)


def test_labels_in_arrays() -> None:
    mask = WHOLE + VOID * 255
    with pytest.raises(ShapeError, match="0, 1, 255"):
        Prism.from_mask(mask, 0.001)
    np.testing.assert_array_equal(read_silhouette(mask, label=1), HARD)


@pytest.mark.parametrize(
    ("image", "label", "message"),
    [
        (grey(WHOLE + VOID * 255), 7, "label 7 is not in the mask, which holds 0, 1, 255"),
        (grey(WHOLE), (1, 2, 3), "is not in the mask"),
        (grey(WHOLE), (1, 2), "give a number"),
        (grey(SEPARATE * 80, "JPEG", quality=60), 240, "save labels as PNG"),
        (grey(SEPARATE * 80, "JPEG", quality=60), None, "0, 79, 240 and is blurred"),
        ((Image.fromarray(COLOURS[WHOLE]), "PNG", {}), 1, "give red, green and blue"),
        (grey(np.where(HARD, np.nan, 0).astype(np.float32), "TIFF"), None, "NaN or infinity"),
        (grey(np.where(HARD, np.inf, 0).astype(np.float32), "TIFF"), None, "NaN or infinity"),
    ],
)
def test_labels_that_do_not_fit_are_refused(
    image: tuple, label: object, message: str, tmp_path: Path
) -> None:
    image[0].save(tmp_path / "mask", image[1], **image[2])
    with pytest.raises(ShapeError, match=message):
        read_silhouette_image(tmp_path / "mask", label)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"label": "one"}, "--label is one: give a number, or red, green and blue as 128,0,0"),
        ({"label": "1,2"}, "give a number, or red, green and blue"),
        (
            {"image": None, "polygon": Path("outline.txt"), "invert": True},
            "--label and --invert go with --image",
        ),
        ({"label": "1", "invert": True}, "--label and --invert given"),
        ({"scale": None}, "--image needs --scale"),
    ],
)
def test_options_that_do_not_fit_are_refused(options: dict, message: str, tmp_path: Path) -> None:
    Image.fromarray(WHOLE).save(tmp_path / "mask.png")
    with pytest.raises(ForetraceError, match=message):
        ObjectOptions(**{"image": tmp_path / "mask.png", "scale": 0.001, **options}).load()


@pytest.mark.parametrize(
    ("scale", "size", "likelier"), [(0.004, "50.9", "0.0004"), (0.00012, "1.53", "0.0012")]
)
def test_an_unusual_size_is_pointed_out(scale: float, size: str, likelier: str, tmp_path: Path) -> None:
    Image.fromarray(np.pad(np.ones((90, 90), np.uint8), 9)).save(tmp_path / "mask.png")
    message = rf"{size} cm long, check --scale \(metres_per_pixel\): {likelier} m per pixel in place of"
    with pytest.warns(UserWarning, match=message):
        ObjectOptions(image=tmp_path / "mask.png", scale=scale).load()


PAGE = 255 - 255 * WHOLE
Y, X = np.mgrid[:150, :180]
DISC = np.hypot(X - 90, Y - 75) < 60


def framed(top: int = 0, bottom: int = 0, left: int = 0, right: int = 0) -> np.ndarray:
    """Black on white, with dark strips along the page's borders."""
    return np.pad(PAGE, ((top, bottom), (left, right)))


@pytest.mark.parametrize(
    "strips", [{}, {"top": 9}, {"left": 5, "top": 9}, {"top": 9, "bottom": 9, "left": 5}]
)
def test_black_on_white_is_named_and_inverted(strips: dict[str, int]) -> None:
    with pytest.raises(ShapeError, match=r"white touches the .* black on white, invert it \(--invert"):
        read_silhouette(framed(**strips))
    assert read_silhouette(framed(**strips), invert=True).sum() == HARD.sum()


def test_a_page_in_a_dark_frame_is_pointed_out() -> None:
    page = framed(9, 9, 9, 9)
    with pytest.warns(UserWarning, match=r"a rectangle with holes of 2\d % .* \(--invert"):
        read_silhouette(page)
    assert read_silhouette(page, invert=True).sum() == HARD.sum()


def test_a_tight_crop_of_black_on_white_is_named() -> None:
    rows, columns = (np.flatnonzero(DISC.any(axis=axis)) for axis in (1, 0))
    tight = ~DISC[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    with pytest.raises(ShapeError, match=r"4 separate objects: .* black on white, invert it"):
        read_silhouette(tight)
    assert read_silhouette(tight, invert=True).sum() == DISC.sum()


def test_rings_need_no_remark(recwarn: pytest.WarningsRecorder) -> None:
    ring = DISC & ~(np.hypot(X - 90, Y - 75) < 40)
    np.testing.assert_array_equal(read_silhouette(ring), DISC)
    assert not recwarn.list


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.uint16, np.int64, np.float16, np.float64])
def test_arrays_of_any_order_and_type_are_the_same_mask(dtype: type) -> None:
    mask = HARD.astype(dtype)
    for same in (np.asfortranarray(mask), mask[::-1].copy()[::-1], np.repeat(mask, 2, axis=1)[:, ::2]):
        np.testing.assert_array_equal(read_silhouette(same), HARD)
    np.testing.assert_array_equal(read_silhouette(np.rot90(mask)), np.rot90(HARD))
    np.testing.assert_array_equal(read_silhouette(mask.T), HARD.T)


def test_prisms_and_views_of_turned_masks_are_those_of_their_copies() -> None:
    mask = np.pad(np.tri(12, dtype=bool), 2)
    for turned in (mask.T, np.rot90(mask), mask[:, ::-1]):
        copied = np.ascontiguousarray(turned)
        np.testing.assert_array_equal(
            Prism.from_mask(turned, 0.004).corners, Prism.from_mask(copied, 0.004).corners
        )
        views = [TopDownView.from_mask(one, 0.004, (0.0, 0.0), (1.0, 0.0)) for one in (turned, copied)]
        np.testing.assert_array_equal(views[0].mask, views[1].mask)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"height": np.nan}, "height nan"),
        ({"height": -0.02}, "height -0.02"),
        ({"tolerance": np.nan}, "tolerance is nan"),
        ({"tolerance": -1.0}, "tolerance is -1.0"),
        ({"blunted": np.inf}, "blunted is inf"),
    ],
)
def test_heights_and_lengths_are_checked(settings: dict, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        Prism.from_mask(HARD, 0.001, **settings)


def test_a_scale_that_makes_no_believable_object_is_named_with_a_likelier_one() -> None:
    square = np.pad(np.ones((12, 12), dtype=bool), 2)
    with pytest.raises(ShapeError, match=r"0\.01 m per pixel in place of 0\.1 would make it 17 cm"):
        Prism.from_mask(square, 0.1)


def test_masks_of_any_size_are_bounded(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="20000 x 20000 pixels: scale it down"):
        Prism.from_mask(np.broadcast_to(np.uint8(1), (20_000, 20_000)), 1e-5)
    Image.new("1", (7_000, 6_000)).save(tmp_path / "mask.png")
    with pytest.raises(ShapeError, match="7000 x 6000 pixels: scale it down to 40 million"):
        read_silhouette_image(tmp_path / "mask.png")
