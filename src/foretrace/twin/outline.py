"""From a view to the object in it: outline to a fraction of a pixel, height, and what kind of solid it is."""

from dataclasses import dataclass

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from foretrace.errors import PredictionError, ShapeError
from foretrace.geometry import invert_transform, planar_transform
from foretrace.interactions.outline import fit_outline, near_rim, signed_distance
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE, largest_object
from foretrace.objects import Cylinder, ObjectModel, Prism
from foretrace.objects.model import fitting_bevel

SAME_HEIGHT = 0.02
"""Heights that differ by less than this share of the greatest are those of a flat top."""
ROUND_TOP = 0.03
"""Root mean square distance of a cylinder's heights from a round top, as a share of the greatest height."""
RECTANGULAR = 0.96
"""An outline fills at least this share of the smallest rectangle round a lying cylinder."""
OVERLAP = 0.85
"""A known object covers at least this share of what it and the mask cover together."""
TURNS = 72
"""Angles at which a known object is compared with the view before its place is fitted."""
STARTS = 3
"""The best of them from which it is fitted."""
ATTEMPTS = 40
"""Most evaluations of such a fit."""
SOFT = 0.1
"""Distance over which a pixel passes from the right to the wrong side [pixels]."""
CONTACT_WEIGHT = 1.0
"""Weight of the contact point, which an action has on the outline: it decides where the pixels leave the place open."""


@dataclass(frozen=True, eq=False)
class SeenObject:
    """An object and where it lies."""

    model: ObjectModel
    """The object, in its own frame."""
    T_action_object: Float[np.ndarray, "4 4"]
    """Its pose at rest in the action frame."""
    notes: tuple[str, ...] = ()
    """What the model leaves out of what was seen."""

    @classmethod
    def of_corners(
        cls, corners: Float[np.ndarray, "n 2"], height: float, notes: tuple[str, ...] = ()
    ) -> "SeenObject":
        """The prism of an outline in the action frame [m], its frame's origin at the outline's centroid.

        Raises:
            ShapeError: The corners bound no usable object.
        """
        middle = shapely.get_coordinates(shapely.centroid(shapely.Polygon(corners)))[0]
        local = corners - middle
        return cls(
            Prism(local, height, fitting_bevel(local, height)), planar_transform([*middle, 0.0], 0.0), notes
        )


def see_object(
    mask: Bool[np.ndarray, "128 128"], height: Float[np.ndarray, "128 128"], thickness: float | None = None
) -> SeenObject:
    """The object that a view shows: a lying cylinder where the height map is that of one, else a prism.

    Args:
        mask: The view's mask, not empty.
        height: Its height map [m].
        thickness: The object's height [m], where it is told and not to be taken from the height map.

    Raises:
        PredictionError: What is seen is no usable object.
    """
    mask = largest_object(mask)
    heights = height[mask].astype(float)
    highest = float(heights.max())
    corners = fit_outline(mask)
    flat = bool(np.ptp(np.quantile(heights, [0.05, 0.95])) < SAME_HEIGHT * highest)
    if not flat and thickness is None and (found := _find_cylinder(mask, height, corners)):
        return found
    # Noise of a flat top averages out; of any other shape the prism has the greatest height.
    tall = (float(np.median(heights)) if flat else highest) if thickness is None else thickness
    notes = () if flat else (f"heights from {heights.min():.3g} to {highest:.3g} m are taken for a flat top",)
    try:
        return SeenObject.of_corners(corners, tall, notes)
    except (ShapeError, ValueError) as error:
        raise PredictionError(f"the twin cannot build what the view shows: {error}") from error


def _find_cylinder(
    mask: Bool[np.ndarray, "128 128"],
    height: Float[np.ndarray, "128 128"],
    corners: Float[np.ndarray, "n 2"],
) -> SeenObject | None:
    """The lying cylinder whose heights a view shows, or None."""
    (x, y), (width, depth), turn = cv2.minAreaRect(corners.astype(np.float32)[:, None])
    if shapely.Polygon(corners).area < RECTANGULAR * width * depth:
        return None
    points = (CONTACT_PIXEL - np.argwhere(mask)) * METRES_PER_PIXEL
    heights = height[mask].astype(float)
    best: tuple[float, np.ndarray, float] | None = None
    for angle, length in ((np.deg2rad(turn), width), (np.deg2rad(turn) + np.pi / 2, depth)):
        start = np.array([-np.sin(angle) * x + np.cos(angle) * y, angle, heights.max() / 2])
        found = least_squares(_off_round_top, start, args=(points, heights), x_scale=[1e-3, 1e-2, 1e-3])
        off = float(np.sqrt(np.mean(found.fun**2)))
        if best is None or off < best[0]:
            best = off, found.x, length
    assert best is not None
    off, (across, angle, radius), length = best
    if off > ROUND_TOP * heights.max():
        return None
    along = np.array([np.cos(angle), np.sin(angle)])
    middle = (along @ [x, y]) * along + across * np.array([-along[1], along[0]])
    try:
        return SeenObject(
            Cylinder(float(radius), float(length)), planar_transform([*middle, 0.0], float(angle))
        )
    except ShapeError:
        return None


def _off_round_top(
    axis: Float[np.ndarray, "3"], points: Float[np.ndarray, "k 2"], heights: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Distance of heights from those of a cylinder [m], by its axis' offset [m], angle [rad], and its radius [m]."""
    across, angle, radius = axis
    off = points @ [-np.sin(angle), np.cos(angle)] - across
    return radius + np.sqrt(np.maximum(radius**2 - off**2, 0.0)) - heights


def locate_object(model: ObjectModel, mask: Bool[np.ndarray, "128 128"]) -> SeenObject:
    """Where a known object lies in a view: the place and turn in which its outline agrees best with the pixels.

    Raises:
        PredictionError: It nowhere looks like what the view shows.
    """
    mask = largest_object(mask)
    points, inside = near_rim(mask)
    sides, seen = np.where(inside, 1.0, -1.0), shapely.Polygon(fit_outline(mask))
    own, target = (
        shapely.get_coordinates(shapely.centroid(each))[0] for each in (shapely.Polygon(model.corners), seen)
    )

    def place(pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 2"]:
        turn = planar_transform([0.0, 0.0], float(pose[2]))[:2, :2]
        return (model.corners - own) @ turn.T + target + METRES_PER_PIXEL * pose[:2]

    def wrong(pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, " k"]:
        """How far pixels lie on the wrong side, softly, and the contact off the outline [pixels]."""
        corners = place(pose)
        depth = sides * signed_distance(corners, points) / METRES_PER_PIXEL
        off = CONTACT_WEIGHT * signed_distance(corners, np.zeros((1, 2))) / METRES_PER_PIXEL
        return np.append(np.sqrt(SOFT * np.logaddexp(0.0, -depth / SOFT)), off)

    angles = 2 * np.pi * np.arange(TURNS) / TURNS
    shares = [_overlap(place(np.array([0.0, 0.0, angle])), seen) for angle in angles]
    nearest = np.argsort(shares)[::-1][:STARTS]
    starts = [np.array([0.0, 0.0, angles[k]]) for k in nearest]
    fits = (least_squares(wrong, start, x_scale=[0.1, 0.1, 0.01], max_nfev=ATTEMPTS) for start in starts)
    found = min(fits, key=_cost)
    if (share := _overlap(place(found.x), seen)) < OVERLAP:
        raise PredictionError(
            f"the known object fits {100 * share:.0f} % of what the view shows: give the object that is seen, or none"
        )
    pose = planar_transform([*(target + METRES_PER_PIXEL * found.x[:2]), 0.0], float(found.x[2]))
    return SeenObject(model, pose @ invert_transform(planar_transform([*own, 0.0], 0.0)))


def _cost(found: "least_squares.OptimizeResult") -> float:  # pyright: ignore
    return float(found.cost)


def _overlap(corners: Float[np.ndarray, "n 2"], seen: shapely.Polygon) -> float:
    """Area that an outline and what is seen share, as a part of what they cover together."""
    outline = shapely.Polygon(corners)
    return float(outline.intersection(seen).area / outline.union(seen).area)


def match_corners(model: ObjectModel, corners: Float[np.ndarray, "n 2"]) -> SeenObject | None:
    """Where an object lies whose corners are recorded in the action frame [m]; None if they are another object's."""
    own = model.corners
    if own.shape != corners.shape:
        return None
    a, b = own - own.mean(axis=0), corners - corners.mean(axis=0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    turn = planar_transform([0.0, 0.0], float(angle))[:2, :2]
    if np.abs(a @ turn.T - b).max() > METRES_PER_PIXEL / VIEW_SIZE:
        return None
    return SeenObject(
        model, planar_transform([*(corners.mean(axis=0) - turn @ own.mean(axis=0)), 0.0], float(angle))
    )
