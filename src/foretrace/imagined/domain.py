"""Views that an imaginer accepts, and warnings about objects that are unlike those it has learned from."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from foretrace.errors import PredictionError
from foretrace.interactions.batch import Candidates, InteractionBatch
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE, TopDownView
from foretrace.objects import BEVEL

LARGEST_GAP = 0.02
"""Largest distance of a contact point from the object's rim, outside or inside [m]."""
TALLEST = 2.0
"""A greater height is a mistake, such as one in other units [m]."""
LEVEL_TOP = 0.1
"""A top is level if its lowest point is no lower than this share of the height below its highest."""
RELEVANT_SHARE = 0.05
"""A spot in the mask with more than this share of the largest one's pixels is an object of its own."""
QUANTILES = (0.01, 0.99)
"""Quantiles of the training part between which an object is usual."""
MARGIN = 0.25
"""An object is unusual if it is further outside than this share of the range."""
LEAST_MARGIN = 0.1
"""The same as a share of the range's upper end, for measures that hardly differ in the training part."""
SEEN = {
    "area": (1e4, "cm^2"),
    "length": (100.0, "cm"),
    "width": (100.0, "cm"),
    "height": (100.0, "cm"),
    "distance": (100.0, "cm"),
    "corners": (1.0, ""),
}
"""Measures by which objects are compared: factor from SI units to the unit of messages, and that unit. Length and width
are along and across the action, the distance is that from contact to centre of mass in the plane."""
TOLD = dict.fromkeys(("friction", "tool_friction", "speed"), (1.0, "")) | {
    "density": (1.0, "kg/m^3"),
    "bevel_width": (1e3, "mm"),
    "bevel_height": (1e3, "mm"),
    "insertion": (100.0, "cm"),
    "arc_radius": (100.0, "cm"),
    "sweep": (180.0 / np.pi, "degrees"),
}
"""The same for what imaginers are told."""
MEASURES = SEEN | TOLD

Ranges = Mapping[str, tuple[float, float]]
"""Lower and upper end of measures in a training part, by name [SI]."""

_BEHIND = METRES_PER_PIXEL * (round(CONTACT_PIXEL[0] + LARGEST_GAP / METRES_PER_PIXEL) - CONTACT_PIXEL[0])
"""Distance behind the contact point at which an object levered at its rim has ended [m]: the middle of a row."""
OWN = np.zeros((1, 2)), np.array([[1.0, 0.0]])
"""Contact point and direction of a view's own action."""


def check_view(view: TopDownView) -> None:
    """Refuse a view that does not show one object, levered at its rim.

    Raises:
        PredictionError: See `check_object` and `check_contacts`.
    """
    check_object(view.mask, view.height)
    check_contacts(view.mask, *OWN)


def check_arrays(mask: Any, height: Any) -> None:
    """Refuse masks and heights of many views that are of another shape or type.

    Raises:
        PredictionError: They are not (batch, 128, 128), the masks boolean; or there is no view.
    """
    if mask.ndim != 3 or mask.shape != height.shape or mask.shape[1:] != (VIEW_SIZE, VIEW_SIZE):
        raise PredictionError(
            f"mask and height of the batch have the shapes {mask.shape} and {height.shape}: give (batch, {VIEW_SIZE}, "
            f"{VIEW_SIZE}), and of one interaction batch[k : k + 1]"
        )
    if mask.dtype != bool:
        raise PredictionError(f"mask of the batch has the type {mask.dtype}: give booleans")
    if not len(mask):
        raise PredictionError("the batch is empty: give at least one interaction")


def check_com(view: TopDownView, com: Float[np.ndarray, "3"]) -> None:
    """Refuse a centre of mass that does not lie in the object of a view.

    Raises:
        PredictionError: It lies more than ``LARGEST_GAP`` beside, above or below it.
    """
    corners = view.to_metres(np.argwhere(view.mask).astype(float))
    low = np.array([*corners.min(axis=0), 0.0])
    high = np.array([*corners.max(axis=0), float(view.height.max())])
    if (off := float(np.maximum(low - com, com - high).max())) > LARGEST_GAP:
        raise PredictionError(
            f"the centre of mass at rest {np.round(com, 4).tolist()} m lies {100 * off:.3g} cm outside the object in "
            "the view: give that of this object, in the frame of the view"
        )


def check_object(mask: Bool[np.ndarray, "128 128"], height: Float[np.ndarray, "128 128"]) -> None:
    """Refuse a view that does not show one object.

    Raises:
        PredictionError: No object, several or a part of one are seen, or a height is impossible.
    """
    if not mask.any():
        raise PredictionError("the view's mask is empty: see that the camera sees the object")
    if mask[[0, -1]].any() or mask[:, [0, -1]].any():
        raise PredictionError(
            "the object touches the border of the view, a part of it may not be seen: choose another contact point"
        )
    lowest, highest = float(height.min()), float(height.max())
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        raise PredictionError("a height in the view is not finite: put 0 where no height was measured")
    if highest > TALLEST:
        raise PredictionError(
            f"a height in the view is {highest:g} m, more than {TALLEST:g} m: give metres, or check the camera's pose"
        )
    if highest == 0:
        raise PredictionError("every height in the view is 0: give the object's height, in metres")
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


def check_contacts(
    mask: Bool[np.ndarray, "128 128"],
    contacts: Float[np.ndarray, "n 2"],
    directions: Float[np.ndarray, "n 2"],
    names: Sequence[str] = ("",),
) -> None:
    """Refuse actions that do not start at the rim of the object in a view and lead into it.

    Args:
        mask: The view's mask, not empty.
        contacts: Contact points in the view's frame [m].
        directions: Unit vectors of the actions in that frame.
        names: Beginning of the message about each of them.

    Raises:
        PredictionError: The object lies behind the contact point, away from it, around it, or beyond the window of
            the action's view.
    """
    faults = _find_faults(mask, contacts, directions)
    for name, distance, into in zip(names, faults.ahead, faults.into, strict=True):
        if distance <= 0 and not into:
            raise PredictionError(
                f"{name}the object lies behind the contact point, its middle by {-100 * distance:.1f} cm: turn "
                "the action's direction round"
            )
    for name, gap in zip(names, faults.apart, strict=True):
        if gap > LARGEST_GAP + METRES_PER_PIXEL / 2:
            raise PredictionError(
                f"{name}the contact point is {100 * gap:.1f} cm from the object, more than "
                f"{100 * LARGEST_GAP:.0f} cm: choose one at its rim"
            )
    if faults.inside.any():
        raise PredictionError(
            f"{names[int(faults.inside.argmax())]}the contact point lies in the object, which is still there "
            f"{100 * LARGEST_GAP:.0f} cm behind it: choose one at its rim"
        )
    if faults.cut.any():
        raise PredictionError(
            f"{names[int(faults.cut.argmax())]}the object reaches beyond the view from that contact point: choose "
            "another one"
        )


def find_usable_contacts(
    mask: Bool[np.ndarray, "128 128"],
    contacts: Float[np.ndarray, "n 2"],
    directions: Float[np.ndarray, "n 2"],
) -> Bool[np.ndarray, " n"]:
    """Which actions `check_contacts` does not refuse, but for those with the object's middle behind them, in dents."""
    faults = _find_faults(mask, contacts, directions)
    near = faults.apart <= LARGEST_GAP + METRES_PER_PIXEL / 2
    return (faults.ahead > 0) & near & ~faults.inside & ~faults.cut


class _Faults(NamedTuple):
    """What `check_contacts` asks of each action."""

    ahead: Float[np.ndarray, " n"]
    """Distance of the object's middle ahead of the contact point [m]; in a dent it may be behind."""
    into: Bool[np.ndarray, " n"]
    """Whether the object is just ahead of the contact point."""
    apart: Float[np.ndarray, " n"]
    """Distance of the contact point from the object [m]."""
    inside: Bool[np.ndarray, " n"]
    """Whether the object is still there well behind the contact point."""
    cut: Bool[np.ndarray, " n"]
    """Whether the object reaches beyond the window of the action's view."""


def _find_faults(
    mask: Bool[np.ndarray, "128 128"],
    contacts: Float[np.ndarray, "n 2"],
    directions: Float[np.ndarray, "n 2"],
) -> _Faults:
    rim = _rim(mask)
    rows, columns = mask.sum(axis=1), mask.sum(axis=0)
    middle = np.array([rows @ np.arange(len(rows)), columns @ np.arange(len(columns))]) / rows.sum()
    ahead = ((CONTACT_PIXEL - middle) * METRES_PER_PIXEL - contacts) * directions
    x, y = _along(rim, contacts, directions)
    apart = np.sqrt((x * x + y * y).min(axis=1))
    apart[_look_up(mask, contacts)] = 0.0
    left = np.stack([-directions[:, 1], directions[:, 0]], axis=1) * METRES_PER_PIXEL / 2
    behind = contacts - _BEHIND * directions
    inside = _look_up(mask, behind + left) & _look_up(mask, behind - left)
    cut = np.zeros(len(contacts), dtype=bool)
    for start, reach in zip(CONTACT_PIXEL, (x, y), strict=True):
        cut |= start - reach.max(axis=1) / METRES_PER_PIXEL < 0.5
        cut |= start - reach.min(axis=1) / METRES_PER_PIXEL > VIEW_SIZE - 1.5
    into = _look_up(mask, contacts + 2 * METRES_PER_PIXEL * directions)
    return _Faults(ahead.sum(axis=1), into, apart, inside, cut)


def _rim(mask: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "k 2"]:
    """Middles of the outermost pixels of a mask [m]."""
    kept = mask.view(np.uint8)
    inner = np.asarray(cv2.erode(kept, np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT, borderValue=0))
    return (CONTACT_PIXEL - np.argwhere(kept > inner)) * METRES_PER_PIXEL


def _look_up(
    mask: Bool[np.ndarray, "rows columns"], points: Float[np.ndarray, "n 2"]
) -> Bool[np.ndarray, " n"]:
    """Whether points [m] lie in the mask."""
    pixels = np.rint(CONTACT_PIXEL - points / METRES_PER_PIXEL).astype(int)
    there = np.all((pixels >= 0) & (pixels < mask.shape), axis=1)
    rows, columns = np.where(there[:, None], pixels, 0).T
    return there & mask[rows, columns]


def _along(
    points: Float[np.ndarray, "k 2"], contacts: Float[np.ndarray, "n 2"], directions: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
    """Coordinates of points in the frames of actions [m]."""
    left = np.stack([-directions[:, 1], directions[:, 0]], axis=1)
    return tuple(axes @ points.T - (axes * contacts).sum(axis=1)[:, None] for axes in (directions, left))


def measure(
    batch: InteractionBatch, com: Float[np.ndarray, "batch 3"]
) -> dict[str, Float[np.ndarray, " batch"]]:
    """Measures by which objects are compared [SI], by the names of ``SEEN``.

    Args:
        batch: The objects as seen from above.
        com: Their centres of mass at rest in the action frame [m].
    """
    return {
        "area": np.count_nonzero(batch.mask, axis=(1, 2)) * METRES_PER_PIXEL**2,
        "length": _extent(np.asarray(batch.mask.any(axis=2))),
        "width": _extent(np.asarray(batch.mask.any(axis=1))),
        "height": batch.height.max(axis=(1, 2)).astype(float),
        "distance": np.hypot(com[:, 0], com[:, 1]),
    }


def measure_candidates(
    candidates: Candidates, com: Float[np.ndarray, "n 3"]
) -> dict[str, Float[np.ndarray, " n"]]:
    """The same of one object as seen from the frames of several actions.

    Args:
        candidates: The object and the actions.
        com: Its centre of mass at rest in the frame of each action [m].
    """
    view, number = candidates.view, len(candidates.actions)
    x, y = _along(_rim(view.mask), candidates.contacts, candidates.directions)
    return {
        "area": np.full(number, np.count_nonzero(view.mask) * METRES_PER_PIXEL**2),
        "length": np.ptp(x, axis=1) + METRES_PER_PIXEL,
        "width": np.ptp(y, axis=1) + METRES_PER_PIXEL,
        "height": np.full(number, float(view.height.max())),
        "distance": np.hypot(com[:, 0], com[:, 1]),
    }


def measure_context(
    names: Sequence[str], values: Float[np.ndarray, "batch context"]
) -> dict[str, Float[np.ndarray, " batch"]]:
    """Measures of what is told [SI], by the names of ``TOLD``; NaN where it is not.

    Args:
        names: Names of the context.
        values: Its values.
    """
    return {name: values[:, k] for k, name in enumerate(names) if name in TOLD}


def bevel_scales(source: InteractionBatch | Candidates) -> Float[np.ndarray, " batch"]:
    """Share of the nominal bevel that each object bears: 1, or less for a slender or thin one."""
    if isinstance(source, Candidates):
        return np.full(len(source.actions), _bevel_scale(source.view.mask, source.view.height))
    return np.array([_bevel_scale(*view) for view in zip(source.mask, source.height, strict=True)])


def _bevel_scale(mask: Bool[np.ndarray, "128 128"], height: Float[np.ndarray, "128 128"]) -> float:
    pixels = np.pad(mask.view(np.uint8), 1)
    inner = float(cv2.distanceTransform(pixels, cv2.DIST_L2, 5).max()) * METRES_PER_PIXEL
    return min(1.0, 0.5 * inner / BEVEL.width, 0.5 * float(height.max()) / BEVEL.height)


def estimate_com(batch: InteractionBatch) -> Float[np.ndarray, "batch 3"]:
    """Centres of mass at rest in the action frame [m], estimated from the views.

    Above the centre of each mask's area, at half the object's greatest height; if its top is level, a little higher,
    as the bevel of a prism takes mass away at the bottom. Right for a prism of uniform density.

    Raises:
        PredictionError: A mask is empty.
    """
    across, along = batch.mask.sum(axis=2), batch.mask.sum(axis=1)
    areas = across.sum(axis=1)
    if not areas.all():
        raise PredictionError(
            f"the mask of interaction {batch.ids[np.argmin(areas)]} is empty: see that the camera sees the object"
        )
    rows, columns = (counts @ np.arange(counts.shape[1]) / areas for counts in (across, along))
    points = (CONTACT_PIXEL - np.stack([rows, columns], axis=-1)) * METRES_PER_PIXEL
    level = np.array([_centre_height(*view) for view in zip(batch.mask, batch.height, strict=True)])
    return np.concatenate([points, level[:, None]], axis=-1)


def level_tops(source: InteractionBatch | Candidates) -> Bool[np.ndarray, " batch"]:
    """Whether the top of each object is level, as a prism's is and that of a lying cylinder is not."""
    if isinstance(source, Candidates):
        return np.full(len(source.actions), _is_level(source.view.mask, source.view.height))
    return np.array([_is_level(*view) for view in zip(source.mask, source.height, strict=True)], dtype=bool)


def _is_level(mask: Bool[np.ndarray, "128 128"], height: Float[np.ndarray, "128 128"]) -> bool:
    top = float(height.max())
    return top - float(height[mask].min()) <= LEVEL_TOP * top


def _centre_height(mask: Bool[np.ndarray, "128 128"], height: Float[np.ndarray, "128 128"]) -> float:
    """Height of the centre of mass [m]: that of a prism with a bevel where the top is level, else half the greatest."""
    pixels, top = mask.view(np.uint8), float(height.max())
    if not _is_level(mask, height):
        return top / 2
    outlines, _ = cv2.findContours(pixels, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    rim = sum(cv2.arcLength(outline, True) for outline in outlines) * METRES_PER_PIXEL
    scale = _bevel_scale(mask, height)
    low = scale * BEVEL.height
    whole, cut = np.count_nonzero(mask) * METRES_PER_PIXEL**2 * top, rim * scale * BEVEL.width * low / 2
    return (whole * top / 2 - cut * low / 3) / (whole - cut)


def _extent(filled: np.ndarray) -> Float[np.ndarray, " batch"]:
    """Distance from the first to the last pixel [m]."""
    return (filled.shape[1] - filled.argmax(axis=1) - filled[:, ::-1].argmax(axis=1)) * METRES_PER_PIXEL


def ranges_of(measures: Mapping[str, Float[np.ndarray, " batch"]]) -> dict[str, tuple[float, float]]:
    """Range of each measure in a training part; of what was never told there is none."""
    found = {name: values[np.isfinite(values)] for name, values in measures.items()}
    return {
        name: (float(np.quantile(values, QUANTILES[0])), float(np.quantile(values, QUANTILES[1])))
        for name, values in found.items()
        if len(values)
    }


def wider(first: Ranges, second: Ranges) -> dict[str, tuple[float, float]]:
    """Ranges that hold those of both."""
    found = dict(first)
    for name, (low, high) in second.items():
        own = first.get(name, (low, high))
        found[name] = min(low, own[0]), max(high, own[1])
    return found


def known_ranges(found: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, float]]:
    """Those ranges in a configuration file that this foretrace has measures for."""
    return {name: (float(low), float(high)) for name, (low, high) in found.items() if name in MEASURES}


def find_unusual(
    measures: Mapping[str, Float[np.ndarray, " batch"]], ranges: Ranges
) -> tuple[tuple[str, ...], ...]:
    """Warnings about each object that is unlike those of a training part; none without ranges."""
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
