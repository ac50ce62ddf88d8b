"""What a predictor can be asked about: views that make no sense are refused, unusual objects are pointed out."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int

from foretrace.errors import PredictionError
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE, TopDownView

LARGEST_GAP = 0.02
"""A contact point farther from the object is not at it, and one that deep in it is not at its rim [m]."""
RELEVANT_SHARE = 0.05
"""A spot in the mask with more than this share of the largest one's pixels is an object of its own."""
QUANTILES = (0.01, 0.99)
"""The training part lies between these, what is rare left out."""
MARGIN = 0.25
"""An object is unusual if it is further outside than this share of the range."""
LEAST_MARGIN = 0.1
"""The same as a share of the range's upper end, for what hardly differs in the training part."""
MEASURES = {
    "area": (1e4, "cm^2"),
    "length": (100.0, "cm"),
    "width": (100.0, "cm"),
    "height": (100.0, "cm"),
    "distance": (100.0, "cm"),
    "corners": (1.0, ""),
}
"""What objects are compared by, the units that people are told, and how many there are of them in SI units: length and
width are along and across the action, the distance is that from contact to centre of mass in the plane."""

Ranges = Mapping[str, tuple[float, float]]
"""Lower and upper end of measures in a training part, by name [SI]."""

_PIXELS = np.arange(VIEW_SIZE)
_FROM_CONTACT = np.hypot(*np.meshgrid(*(CONTACT_PIXEL[k] - _PIXELS for k in (0, 1)), indexing="ij"))
_NEAR_CONTACT = _FROM_CONTACT * METRES_PER_PIXEL <= LARGEST_GAP + METRES_PER_PIXEL / 2
_ROW_BEHIND = round(CONTACT_PIXEL[0] + LARGEST_GAP / METRES_PER_PIXEL)
_COLUMNS_BEHIND = slice(VIEW_SIZE // 2 - 1, VIEW_SIZE // 2 + 1)


def check_view(view: TopDownView) -> None:
    """Refuse a view that does not show one object, levered at its rim.

    Raises:
        PredictionError: Nothing, several objects or a part of one are seen; heights are none; or the contact point is
            not where the object begins.
    """
    mask, height = view.mask, view.height
    if not mask.any():
        raise PredictionError("the view's mask is empty: see that the camera sees the object")
    if mask[[0, -1]].any() or mask[:, [0, -1]].any():
        raise PredictionError(
            "the object touches the border of the view, a part of it may not be seen: choose another contact point"
        )
    lowest, highest = float(height.min()), float(height.max())
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        raise PredictionError("a height in the view is not finite: put 0 where no height was measured")
    if lowest < 0:
        raise PredictionError(
            f"a height in the view is {lowest:.4f} m, below the table: check the camera's pose"
        )
    if height[~mask].any():
        raise PredictionError(
            f"the view has heights up to {height[~mask].max():.4f} m outside the mask: give 0 beside the object, or "
            "a mask of all that has a height"
        )
    outlines, _ = cv2.findContours(mask.view(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    if len(outlines) > 1:  # of several objects, or of holes
        _, _, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
        sizes = stats[1:, cv2.CC_STAT_AREA]
        if (count := int((sizes > RELEVANT_SHARE * sizes.max()).sum())) > 1:
            raise PredictionError(f"the view's mask shows {count} objects: leave one of them")
    _check_contact(mask)


def _check_contact(mask: np.ndarray) -> None:
    ahead = CONTACT_PIXEL[0] - float(mask.sum(axis=1) @ _PIXELS) / mask.sum()
    if ahead <= 0:
        raise PredictionError(
            f"the object lies behind the contact point, its middle by {-100 * ahead * METRES_PER_PIXEL:.1f} cm: turn "
            "the action's direction round"
        )
    if not mask[_NEAR_CONTACT].any():
        gap = _FROM_CONTACT[mask].min() * METRES_PER_PIXEL
        raise PredictionError(
            f"the contact point is {100 * gap:.1f} cm from the object, more than {100 * LARGEST_GAP:.0f} cm: choose "
            "one at its rim"
        )
    if mask[_ROW_BEHIND, _COLUMNS_BEHIND].all():
        raise PredictionError(
            f"the contact point lies in the object, which is still there {100 * LARGEST_GAP:.0f} cm behind it: choose "
            "one at its rim"
        )


def measure(
    batch: InteractionBatch,
    com: Float[np.ndarray, "batch 3"],
    corners: Int[np.ndarray, " batch"] | None = None,
) -> dict[str, Float[np.ndarray, " batch"]]:
    """What objects are compared by [SI], by the names of ``MEASURES``.

    Args:
        batch: The objects as seen from above.
        com: Their centres of mass at rest in the action frame [m].
        corners: How many corners were seen of each, where somebody counted them.
    """
    measures = {
        "area": np.count_nonzero(batch.mask, axis=(1, 2)) * METRES_PER_PIXEL**2,
        "length": _extent(np.asarray(batch.mask.any(axis=2))),
        "width": _extent(np.asarray(batch.mask.any(axis=1))),
        "height": batch.height.max(axis=(1, 2)).astype(float),
        "distance": np.hypot(com[:, 0], com[:, 1]),
    }
    return measures if corners is None else measures | {"corners": corners.astype(float)}


def _extent(filled: np.ndarray) -> Float[np.ndarray, " batch"]:
    """From the first to the last pixel [m]."""
    return (filled.shape[1] - filled.argmax(axis=1) - filled[:, ::-1].argmax(axis=1)) * METRES_PER_PIXEL


def ranges_of(measures: Mapping[str, Float[np.ndarray, " batch"]]) -> dict[str, tuple[float, float]]:
    """Between which values a training part lies."""
    return {
        name: (float(np.quantile(values, QUANTILES[0])), float(np.quantile(values, QUANTILES[1])))
        for name, values in measures.items()
    }


def read_ranges(found: Any) -> dict[str, tuple[float, float]]:
    """Ranges as a configuration file has them; none where it tells of none.

    Raises:
        TypeError, ValueError, AttributeError: They are something else.
    """
    return {
        name: (float(low), float(high)) for name, (low, high) in (found or {}).items() if name in MEASURES
    }


def find_unusual(
    measures: Mapping[str, Float[np.ndarray, " batch"]], ranges: Ranges
) -> tuple[tuple[str, ...], ...]:
    """What is unusual about each object, in a line each; nothing where no ranges are known."""
    number = len(measures["area"])
    warnings: list[list[str]] = [[] for _ in range(number)]
    for name, (low, high) in ranges.items():
        if name not in measures:
            continue
        values, margin = measures[name], max(MARGIN * (high - low), LEAST_MARGIN * abs(high))
        for row in np.flatnonzero((values < low - margin) | (values > high + margin)):
            factor, unit = MEASURES[name]
            warnings[row].append(
                f"{name} {factor * values[row]:.3g}{unit and ' '}{unit} is far outside what was learned from, "
                f"{factor * low:.3g} to {factor * high:.3g}{unit and ' '}{unit}"
            )
    return tuple(map(tuple, warnings))
