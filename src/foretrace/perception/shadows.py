"""Shadows on the background: what an object takes of the light, told from the object itself.

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
"""So much of any difference may be noise [of 255]."""
PATTERN = 1.5
"""Standard deviation of a pattern that is clear enough to be looked for [of 255]."""
PATTERN_WINDOWS = (15, 31, 61)
"""Sides of the windows in which a pattern is compared [pixel]."""
PATTERN_LEFT = 0.5
"""A shadow keeps at least this part of the contrast that its darkness lets expect."""
BORDER = 4
"""So near to an object its colour spreads into the background's, by blur and compression [pixel]."""
SMALLEST_SHADOW = 50
"""Smaller patches of shadow are taken for noise [pixel]."""
SMALLEST_PATCH = 400
"""Smaller patches are neither objects nor what hides one [pixel]."""
MOST_ENCLOSED = 0.75
"""An object casts its shadow to one side: where more than this share of its outline meets shadow, that is no shadow."""


@dataclass(frozen=True)
class Shadow:
    """What a picture shows of shadows."""

    pixels: Bool[np.ndarray, "rows columns"]
    """Where shadow is seen, and nothing but the background in it."""
    light: Float[np.ndarray, "rows columns 3"]
    """Which part of the background's light reaches each pixel; below objects as beside them."""


MOST_ALIKE = 0.3
"""An object of which more has the background's colour may go on where shadow is seen."""


def find_shadow(
    now: Float[np.ndarray, "rows columns 3"],
    before: Float[np.ndarray, "rows columns 3"],
    changed: Bool[np.ndarray, "rows columns"],
) -> Shadow | None:
    """Shadows on the background, if there are any.

    Args:
        now: The picture.
        before: The background under the light of the picture as a whole.
        changed: Where they differ.

    Raises:
        PerceptionError: What changed may be shadow or object.
    """
    alike = _alike(now, before, changed)
    if _largest_patch(cv2.erode(alike.astype(np.uint8), np.ones((3, 3), np.uint8))) == 0:
        return None
    shaded = alike & ~_other_pattern(now.mean(axis=2), before.mean(axis=2), alike)
    shadow = cv2.morphologyEx(shaded.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if _largest_patch(shadow) < SMALLEST_SHADOW:
        return None
    things = cv2.morphologyEx((changed & ~shaded).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    contours, _ = cv2.findContours(things, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros_like(things), contours, -1, 1, cv2.FILLED)
    shadow[filled > 0] = 0
    _check(filled, alike, shadow)
    hidden = _grown(filled, BORDER) & ~((shadow > 0) & ~_grown(filled, BORDER // 2))
    seen = (~hidden).astype(np.float32)
    weight = np.maximum(cv2.GaussianBlur(seen, (0, 0), 1.5), 1e-6)[..., None]
    light = cv2.GaussianBlur(seen[..., None] * (now + 1.0) / (before + 1.0), (0, 0), 1.5) / weight
    _, labels = cv2.distanceTransformWithLabels(
        hidden.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest: Any = labels
    values = np.zeros((int(nearest.max()) + 1, 3), dtype=light.dtype)
    values[nearest[~hidden]] = light[~hidden]
    return Shadow(shaded, values[nearest])


def _grown(mask: Any, by: int) -> Bool[np.ndarray, "rows columns"]:
    return cv2.dilate(mask, np.ones((2 * by + 1,) * 2, np.uint8)) > 0


def _alike(
    now: Float[np.ndarray, "rows columns 3"],
    before: Float[np.ndarray, "rows columns 3"],
    changed: Bool[np.ndarray, "rows columns"],
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels of the background's colour, but darker."""
    part = (now * before).sum(axis=2) / np.maximum((before**2).sum(axis=2), 1.0)
    off = np.abs(now - part[..., None] * before).max(axis=2)
    alike = off < NOISE + COLOUR_CHANGE * now.max(axis=2)
    return changed & alike & (part > LEAST_LIGHT) & (part < 1.0)


def _other_pattern(
    now: Float[np.ndarray, "rows columns"],
    before: Float[np.ndarray, "rows columns"],
    shaded: Bool[np.ndarray, "rows columns"],
) -> Bool[np.ndarray, "rows columns"]:
    """Where the background has a pattern that the picture does not keep, in the smallest window that shows one."""
    weight, other, undecided = shaded.astype(np.float32), np.zeros(shaded.shape, bool), shaded.copy()
    for size in PATTERN_WINDOWS:
        count = cv2.boxFilter(weight, -1, (size, size), normalize=False)
        now_mean, before_mean, squares, products = (
            cv2.boxFilter(weight * values, -1, (size, size), normalize=False) / np.maximum(count, 1.0)
            for values in (now, before, before**2, now * before)
        )
        spread, shared = squares - before_mean**2, products - now_mean * before_mean
        clear = undecided & (spread > PATTERN**2) & (count > 0.2 * size**2)
        other |= clear & (shared * before_mean < PATTERN_LEFT * spread * now_mean)
        undecided &= ~clear
    return other


def _largest_patch(mask: Any) -> int:
    stats = cv2.connectedComponentsWithStats(mask)[2]
    return int(stats[1:, cv2.CC_STAT_AREA].max(initial=0))


def _check(things: Any, alike: Bool[np.ndarray, "rows columns"], shadow: Any) -> None:
    """Refuses shadows that may be objects."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(things)
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= SMALLEST_PATCH]
    doubtful = not large and _largest_patch(shadow) >= SMALLEST_PATCH
    for k in large:
        thing = (labels == k).astype(np.uint8)
        ring = _grown(thing, BORDER + 2) & ~_grown(thing, BORDER)
        doubtful |= shadow[ring].mean() > MOST_ENCLOSED
        doubtful |= shadow[ring].any() and alike[thing > 0].mean() > MOST_ALIKE
    if doubtful:
        raise PerceptionError(
            "shadow and object cannot be told apart: what differs from the background has its colour, only darker, "
            "and so may be a shadow or an object of that colour; find the object by depth or with --mask grabcut, "
            "light it from all round and use --mask threshold, or lay a sheet of another colour on the table"
        )
