"""Shadows on the background: what an object takes of the light, separated from the object.

A shadow darkens what is there and leaves its colour (Horprasert, Harwood and Davis, 1999; Cucchiara et al., 2003) and
its pattern (Jacques, Jung and Musse, 2005). What is darker, of the background's colour, and without its pattern or in a
place that has none, may be either.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from foretrace.errors import PerceptionError

LEAST_LIGHT = 0.3
"""A shadow leaves at least this part of the light."""
COLOUR_CHANGE = 0.08
"""A shadow's colour may differ by this part of the brightest channel: its light is bluer or redder than the lamp's."""
NOISE = 3.0
"""Difference that may be noise [of 255]."""
PATTERN = 1.5
"""Standard deviation of a pattern that is clear enough to be looked for [of 255]."""
PATTERN_WINDOWS = (15, 31, 61)
"""Sides of the windows in which a pattern is compared [pixel]."""
PATTERN_LEFT = 0.5
"""A shadow keeps at least this part of the contrast that its darkness lets expect."""
BORDER = 4
"""Distance from an object in which its colour spreads into the background, by blur and compression [pixel]."""
SMALLEST_SHADOW = 50
"""Smaller patches of shadow are taken for noise [pixel]."""
SMALLEST_PATCH = 400
"""Smaller patches are neither objects nor what hides one [pixel]."""
LEAST_LACKING = 0.4
"""A patch of which more lacks the background's pattern is doubtful."""
MOST_LACKING = 0.9
"""Where more of what can be judged lacks it, the patch is an object."""
MOST_ALIKE = 0.5
"""Of what has more of the background's colour than this, a part may be taken for shadow: its sides are darker."""
ENCLOSING_GAP = 15
"""A shadow encloses what it surrounds but for gaps as wide as this [pixel]: that is rather a pattern on an object."""
DOUBTFUL = (
    "shadow and object cannot be told apart: what differs from the background has its colour, and may be a shadow or "
    "an object of that colour; find the object by depth, lay a sheet of another colour on the table, or light it from "
    "all round and say --no-shadows"
)


@dataclass(frozen=True)
class Shadow:
    """What an image shows of shadows."""

    pixels: Bool[np.ndarray, "rows columns"]
    """Where shadow is seen, and nothing but the background in it."""
    light: Float[np.ndarray, "rows columns 3"]
    """Which part of the background's light reaches each pixel; below objects as beside them."""


def find_shadow(
    now: Float[np.ndarray, "rows columns 3"],
    before: Float[np.ndarray, "rows columns 3"],
    changed: Bool[np.ndarray, "rows columns"],
) -> Shadow | None:
    """Shadows on the background, if there are any.

    Args:
        now: The image.
        before: The background under the light of the image as a whole.
        changed: Where they differ.

    Raises:
        PerceptionError: What changed may be shadow or object.
    """
    part = (now * before).sum(axis=2) / np.maximum((before**2).sum(axis=2), 1.0)
    off = np.abs(now - part[..., None] * before).max(axis=2)
    alike = (off < NOISE + COLOUR_CHANGE * now.max(axis=2)) & (part > LEAST_LIGHT)
    darker = changed & alike & (part < 1.0)
    if not opened(darker, 3).any():
        return None
    darker &= ~_objects(now.mean(axis=2), before.mean(axis=2), darker)
    shadow = opened(darker, 3)
    if patches(shadow)[1].max(initial=0) < SMALLEST_SHADOW:
        return None
    things = filled(opened(changed & ~darker, 5))
    shadow &= ~things
    _check(things, alike, shadow)
    hidden = grown(things, BORDER) & ~(shadow & ~grown(things, BORDER // 2))
    seen = (~hidden).astype(np.float32)
    weight = np.maximum(cv2.GaussianBlur(seen, (0, 0), 1.5), 1e-6)[..., None]
    light = cv2.GaussianBlur(seen[..., None] * (now + 1.0) / (before + 1.0), (0, 0), 1.5) / weight
    _, labels = cv2.distanceTransformWithLabels(
        hidden.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest: Any = labels
    values = np.zeros((int(nearest.max()) + 1, 3), dtype=light.dtype)
    values[nearest[~hidden]] = light[~hidden]
    return Shadow(darker, values[nearest])


def _objects(
    now: Float[np.ndarray, "rows columns"],
    before: Float[np.ndarray, "rows columns"],
    darker: Bool[np.ndarray, "rows columns"],
) -> Bool[np.ndarray, "rows columns"]:
    """Patches of darker background that are none: nearly everywhere they lack its pattern.

    Each pixel is judged by the smallest window that shows a pattern: an object is flatter there, whereas the edge of a
    shadow is not. Yet edges may look flat by chance, so whole patches decide.

    Raises:
        PerceptionError: A patch lacks the pattern in a part only: it may be an object with its shadow.
    """
    weight = darker.astype(np.float32)
    other, kept, undecided = np.zeros_like(darker), np.zeros_like(darker), darker.copy()
    for size in PATTERN_WINDOWS:
        count = cv2.boxFilter(weight, -1, (size, size), normalize=False)
        now_mean, before_mean, now_squares, squares, products = (
            cv2.boxFilter(weight * values, -1, (size, size), normalize=False) / np.maximum(count, 1.0)
            for values in (now, before, now**2, before**2, now * before)
        )
        spread, shared = squares - before_mean**2, products - now_mean * before_mean
        clear = undecided & (spread > PATTERN**2) & (count > 0.2 * size**2)
        expected = spread * (now_mean / np.maximum(before_mean, 1.0)) ** 2
        flat = now_squares - now_mean**2 < 1.5 * expected + NOISE**2
        keeps = shared * before_mean > PATTERN_LEFT * spread * now_mean
        other |= clear & flat & ~keeps
        kept |= clear & keeps
        undecided &= ~clear
    labels, areas = patches(darker)
    lacking, keeping = (np.bincount(labels[mask], minlength=len(areas) + 1)[1:] for mask in (other, kept))
    objects = (lacking > MOST_LACKING * (lacking + keeping)) & (lacking > 0.5 * areas)
    doubtful = ~objects & (lacking > LEAST_LACKING * areas) & (lacking > keeping)
    if doubtful[areas >= SMALLEST_PATCH].any():
        raise PerceptionError(DOUBTFUL)
    return np.concatenate([[False], objects])[labels]


def _check(
    things: Bool[np.ndarray, "rows columns"],
    alike: Bool[np.ndarray, "rows columns"],
    shadow: Bool[np.ndarray, "rows columns"],
) -> None:
    """Refuses shadows that may be objects, or parts of one.

    Raises:
        PerceptionError: There is nothing else, or something within a shadow, or something of the background's colour.
    """
    labels, areas = patches(things)
    large = 1 + np.flatnonzero(areas >= SMALLEST_PATCH)
    doubtful = len(large) == 0 and patches(shadow)[1].max(initial=0) >= SMALLEST_PATCH
    size = (ENCLOSING_GAP, ENCLOSING_GAP)
    enclosed = filled(cv2.morphologyEx(shadow.astype(np.uint8), cv2.MORPH_CLOSE, np.ones(size, np.uint8)) > 0)
    for k in large:
        thing = labels == k
        ring = grown(thing, 2 * BORDER) & ~thing
        doubtful |= enclosed[thing].mean() > 0.5
        doubtful |= shadow[ring].any() and alike[thing].mean() > MOST_ALIKE
    if doubtful:
        raise PerceptionError(DOUBTFUL)


def grown(mask: Bool[np.ndarray, "rows columns"], by: int) -> Bool[np.ndarray, "rows columns"]:
    """A mask and what lies around it, that many pixels wide."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * by + 1,) * 2, np.uint8)) > 0


def opened(mask: Bool[np.ndarray, "rows columns"], size: int) -> Bool[np.ndarray, "rows columns"]:
    """A mask without what is narrower than some pixels."""
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((size, size), np.uint8)) > 0


def filled(mask: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """A mask without holes."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), contours, -1, 1, cv2.FILLED) > 0


def patches(mask: Bool[np.ndarray, "rows columns"]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the patches of a mask, from 1, and their areas [pixel]."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return labels, stats[1:, cv2.CC_STAT_AREA]
