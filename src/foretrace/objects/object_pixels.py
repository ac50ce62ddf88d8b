"""Which pixels of a mask are the object: by transparency, by brightness, by a label, or the other way round."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Num, Shaped

from foretrace.errors import ShapeError, shown
from foretrace.images import StoredImage

MOST_PIXELS = 40_000_000
"""Larger masks are refused: an outline needs no more, and they would take seconds and gigabytes."""
ANALYSED = 2000
"""Largest number of rows and columns in which labels are looked for; larger images are sampled."""
THICK = 9
"""Side of the square that a label's value fills somewhere [pixel]; traces of JPEG and of blur are narrower."""
FEW_VALUES = 16
"""An image of more values has blurred edges, noise or JPEG's traces; neighbouring values are one label then."""
SAME_LABEL = (0.02, 0.1)
"""Values nearer to each other than this share of all are the same label, in images of few values and of many."""
BEYOND = 0.25
"""A value farther outside the labels than this share of their range belongs to no blurred edge between them."""
BLURRED = "is blurred or was compressed as JPEG: save labels as PNG, or paint the object white on black"
SPECK = 0.01
"""Objects below this share of the largest one's area are taken for noise."""
SHOWN = 8
"""Largest number of values that a message names."""
Label = int | float | Sequence[int] | Sequence[float]
"""Value of an object's pixels, index into the palette of an image that has one, or red, green and blue."""


def object_pixels(
    image: StoredImage, label: Label | None = None, invert: bool = False
) -> Bool[np.ndarray, "rows columns"]:
    """The pixels that an image marks as object.

    Those that are opaque where transparency varies over the image; otherwise those brighter than the middle between
    the darkest and the brightest value. An image of more than two values that are no blurred edge is a label image.

    Args:
        image: The image.
        label: The object's value in a label image: a number, an index into a palette, or a colour.
        invert: The object is black on white, or transparent; a frame round the page is left out.

    Raises:
        ShapeError: The image is empty or the same everywhere, or its labels leave open which is the object.
    """
    values, palette = image.values, image.palette
    if values.ndim == 3 and all((values[..., 0] == values[..., k]).all() for k in (1, 2)):
        values = values[..., 0]
    if values.ndim == 2 and palette is not None and values.size and values.min() == values.max():
        values = palette  # all of one colour: the palette names nothing, its indices do
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise ShapeError("mask holds NaN or infinity: write finite numbers, 0 beside the object")
    if label is not None:
        white = _labelled(values, palette, label)
    elif image.alpha is not None and _varies(image.alpha):
        white = _bright(image.alpha)
    else:
        if values.size == 0 or not values.any():
            raise ShapeError(
                f"mask of {values.shape[1]} x {values.shape[0]} pixels is empty: draw the object white on black"
            )
        labels, exact = _labels(values) if values.dtype != np.bool_ else (np.arange(2), True)
        if len(labels) > 2:
            labels = labels if palette is None else _labels(palette)[0]
            remedy = "choose the object's (--label, or read_silhouette(mask, label=...)), or paint it white on black"
            raise ShapeError(
                f"mask holds the values {_names(labels)}" + (f": {remedy}" if exact else f" and {BLURRED}")
            )
        white = _bright(_grey(values))
    return _without_frame(~white) if invert else white


def _grey(values: Shaped[np.ndarray, "rows columns *channels"]) -> Shaped[np.ndarray, "rows columns"]:
    """Brightness of colours (ITU-R BT.601)."""
    return values if values.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(values), cv2.COLOR_RGB2GRAY)


def _varies(alpha: np.ndarray) -> bool:
    """Whether an image is a cut-out: some of it is rather transparent, some of it opaque."""
    return bool(alpha.min() <= 0.5 * alpha.max() and alpha.any())


def _bright(
    grey: Num[np.ndarray, "rows columns"] | Bool[np.ndarray, "rows columns"],
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels above the middle of the range of values; all of them where there is no range."""
    low, high = grey.min(), grey.max()
    if low == high or grey.dtype == np.bool_:
        return grey > 0
    return grey > 0.5 * (float(low) + float(high))


def _labelled(
    values: Shaped[np.ndarray, "rows columns *channels"], palette: np.ndarray | None, label: Label
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels of a label."""
    wanted = np.atleast_1d(np.asarray(label))
    if wanted.dtype.kind not in "iuf" or wanted.shape not in ((1,), (3,)):
        raise ShapeError(f"label {shown(label)}: give a number, or red, green and blue")
    if wanted.size == 1 and palette is not None:
        values = palette
    if wanted.size == 3 and values.ndim == 2:
        wanted = wanted[[0]] if (wanted == wanted[0]).all() else np.array([np.nan])
    if wanted.size == 1 and values.ndim == 3:
        raise ShapeError(f"label {shown(label)} in a mask of colours: give red, green and blue")
    found = values == wanted[0] if values.ndim == 2 else (values == wanted).all(axis=2)
    labels, exact = _labels(values)
    if not exact:
        raise ShapeError(f"label {_name(wanted)} in a mask that {BLURRED}")
    if not found.any():
        raise ShapeError(f"label {_name(wanted)} is not in the mask, which holds {_names(labels)}")
    return found


def _sampled(values: np.ndarray) -> np.ndarray:
    """Every nth row and column of a large image."""
    step = 1 + max(values.shape[:2]) // ANALYSED
    return values[::step, ::step]


def _labels(values: Shaped[np.ndarray, "rows columns *channels"]) -> tuple[np.ndarray, bool]:
    """Labels of an image: values of areas, and of lines that are no blurred edge; and whether they are exact.

    Where they are not, blur or compression makes other values of them. Edges that are blurred in few steps are exact.
    """
    sample = _sampled(values)
    if sample.ndim == 3 and sample.dtype.kind == "f":
        sample = _grey(sample)
    levels, codes, counts = _levels(sample)
    if len(levels) > FEW_VALUES**2 and levels.ndim == 2:  # a photograph, or JPEG's traces of few colours
        levels, codes, counts = _levels(_grey(sample))
    if len(levels) <= 2:
        return levels, True
    brightness = _grey(levels[None].astype(np.float32))[0] if levels.ndim == 2 else levels.astype(float)
    codes = codes.astype(np.float32)  # what OpenCV compares; exact up to 16 million values
    inner = codes[_flat(codes, THICK)].astype(int)
    labels = np.flatnonzero(np.bincount(inner, minlength=len(levels))).tolist()
    exact = len(levels) <= max(FEW_VALUES, 2 * len(labels))
    near = SAME_LABEL[0 if exact else 1] * float(np.ptp(brightness))
    if not exact:
        labels = _merged(labels, brightness, counts, near)
    rest = counts.copy()
    rest[labels] = 0
    odd = int(rest.argmax())
    if labels and 2 * rest[odd] > rest.sum():  # a value of its own, not one of many along an edge
        known = brightness[labels]
        gap = BEYOND * np.ptp(known)
        thick = np.abs(known - brightness[odd]).min() > near and bool(
            (_flat(codes, 2) & (codes == odd)).any()
        )
        if thick or (len(labels) > 1 and not known.min() - gap <= brightness[odd] <= known.max() + gap):
            labels.append(odd)
    return levels[sorted(labels)], exact


def _levels(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct values or colours, darkest first or by red, the index of each pixel's, and how often each occurs."""
    if values.ndim == 2:
        levels, codes, counts = np.unique(values, return_inverse=True, return_counts=True)
    else:
        packed = (values.astype(np.int64) * [1 << 32, 1 << 16, 1]).sum(axis=2)
        packed, codes, counts = np.unique(packed, return_inverse=True, return_counts=True)
        levels = np.stack([packed >> 32, packed >> 16 & 0xFFFF, packed & 0xFFFF], axis=1)
    return levels, codes.reshape(values.shape[:2]), counts


def _flat(codes: np.ndarray, size: int) -> np.ndarray:
    """Pixels in the middle of a square of one value."""
    square = np.ones((size, size), np.uint8)
    return cv2.erode(codes, square) == cv2.dilate(codes, square)


def _merged(labels: list[int], brightness: np.ndarray, counts: np.ndarray, near: float) -> list[int]:
    """The most frequent of each run of labels that are alike."""
    labels = sorted(labels, key=lambda k: brightness[k])
    runs: list[list[int]] = []
    for k in labels:
        if runs and brightness[k] - brightness[runs[-1][-1]] <= near:
            runs[-1].append(k)
        else:
            runs.append([k])
    return [max(run, key=lambda k: counts[k]) for run in runs]


def _without_frame(white: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """White without what touches the image's border, a scan's dark frame, if more than specks are left."""
    count, found = cv2.connectedComponents(np.ascontiguousarray(white, dtype=np.uint8), connectivity=8)
    parts: Any = found
    inner = np.ones(count, dtype=bool)
    for border in (parts[0], parts[-1], parts[:, 0], parts[:, -1]):
        inner[border] = False
    inside = white & inner[parts]
    return inside if inside.sum() > SPECK * white.sum() else white


def _names(levels: np.ndarray) -> str:
    """Values or colours, the first few."""
    more = f" and {len(levels) - SHOWN} more" if len(levels) > SHOWN else ""
    return ", ".join(_name(level) for level in levels[:SHOWN]) + more


def _name(level: np.ndarray | np.generic) -> str:
    """A value, or a colour."""
    numbers = ",".join(f"{value:g}" for value in np.atleast_1d(level))
    return f"({numbers})" if np.size(level) > 1 else numbers
