"""Constants of the quasi-static model of pushes, and how they are identified from recorded pushes.

They are the rod's friction, how an object's weight is spread over its lower face, and offsets between the frames of
object, rod and table. Every constant has a prior: few pushes suffice for those that all shapes share, each shape's own
need more.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foretrace.errors import PredictionError, check_type
from foretrace.geometry import rotate_plane
from foretrace.interactions.pushes import RecordedPushes
from foretrace.objects.footed import feet_of
from foretrace.simulation.sliding import Footprint, slide

NAMES = (
    "friction",
    *("spread_x", "spread_y", "pressure_x", "pressure_y"),
    *("outline_x", "outline_y", "rod_x", "rod_y"),
)
"""Logarithm of the rod's friction over the nominal one; logarithms of how wide the weight is spread, 0 for evenly over
the face; offset of its centre [cm]; offset of the outline in the object frame [mm]; of the rod in the table's [mm]."""
SPREADS = (1, 2)
"""Places of the spreads among the values."""
FRICTION = 0.2
"""Nominal friction coefficient between rod and object."""
SHARED = np.array([0.4, 0.25, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0])
"""Prior standard deviation of what all shapes share; 0: nothing."""
OWN = np.array([0.25, 0.35, 0.35, 0.25, 0.25, 0.5, 0.5, 0.3, 0.3])
"""Prior standard deviation of each shape's own values around those."""
STEP = np.array([0.05, 0.05, 0.05, 0.05, 0.05, 0.1, 0.1, 0.1, 0.1])
"""Steps of the finite differences."""
SCALE = np.array([0.0025, 0.0025, np.deg2rad(3.0)])
"""Usual error of a good model: displacement [m] and turn [rad]."""
ITERATIONS = 5
"""Steps of the fit."""
MOST_FITTED = 160
"""Pushes of one shape that its values are fitted to; more of them tell little more."""
STEPS = 40
"""Steps of each push."""
Group = tuple[str, str]
"""A surface and the name of a shape."""


@dataclass(frozen=True)
class Change:
    """A change of circumstances, to see how much a push depends on them."""

    friction: float = 1.0
    """Factor of the rod's friction."""
    spread: float = 1.0
    """Factor of how wide the weight is spread."""
    left: float = 0.0
    """Offset of the rod to the left of its motion [m]."""
    turn: float = 0.0
    """Turn of its motion to the left [rad]."""


AS_IT_IS = Change()
"""No change."""


def check_pushes(pushes: RecordedPushes) -> None:
    """Refuse what is no table of pushes.

    Raises:
        PredictionError: It is something else, such as interactions.
    """
    check_type(
        "pushes", pushes, RecordedPushes, PredictionError, "RecordedPushes, as of(interactions) makes them"
    )


def groups_of(pushes: RecordedPushes) -> dict[Group, np.ndarray]:
    """Rows of each shape on each surface."""
    keys = [(pushes.surface[k], pushes.shapes[pushes.shape[k]].name) for k in range(len(pushes))]
    return {key: np.array([k for k, each in enumerate(keys) if each == key]) for key in dict.fromkeys(keys)}


def play_pushes(
    pushes: RecordedPushes,
    values: Float[np.ndarray, "variants names"],
    change: Change = AS_IT_IS,
    steps: int | None = None,
) -> Float[np.ndarray, "variants pushes 3"]:
    """Displacements [m] and turns [rad] of pushes of one shape, by several sets of constants.

    Args:
        pushes: The pushes.
        values: Sets of constants, by `NAMES`.
        change: A change of circumstances.
        steps: Steps of each push; None: `STEPS`.
    """
    shape, variants, count = pushes.shapes[pushes.shape[0]], len(values), len(pushes)
    offset = 1e-3 * values[:, None, 5:7]
    feet = feet_of(shape.model.corners, "uniform")
    around = (feet - feet.mean(axis=0)) * np.exp(values[:, None, 1:3]) * change.spread
    feet = shape.centroid + 1e-2 * values[:, None, 3:5] + around  # in the frame of the outline
    turn = np.tile(-pushes.before[:, 2], variants)
    rod = rotate_plane(np.repeat(1e-3 * values[:, 7:9], count, axis=0), turn).reshape(variants, count, 2)
    motion = rotate_plane(pushes.motion, np.full(count, change.turn))
    left = np.stack([-motion[:, 1], motion[:, 0]], axis=1) / np.linalg.norm(motion, axis=1)[:, None]
    position, angle = slide(
        Footprint(shape.model.corners, np.repeat(feet, count, axis=0)),
        (pushes.start + rod + change.left * left - offset).reshape(-1, 2),
        np.tile(motion, (variants, 1)),
        pushes.radius,
        np.repeat(FRICTION * np.exp(values[:, 0]) * change.friction, count),
        steps or STEPS,
    )
    origin = np.repeat(offset[:, 0], count, axis=0)
    moved = position + origin - rotate_plane(origin, angle)
    return np.column_stack([moved, angle]).reshape(variants, count, 3)


def fit_constants(
    pushes: RecordedPushes, mean: Float[np.ndarray, " names"], std: Float[np.ndarray, " names"]
) -> tuple[Float[np.ndarray, " names"], Float[np.ndarray, "names names"]]:
    """Most probable values and their covariance, by Gauss and Newton's method.

    Priors are normal, errors have long tails. A standard deviation of 0 of the spread along y ties it to that along x.
    """
    free = np.flatnonzero(std > 0)
    tied = std[SPREADS[1]] == 0

    def whole(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        if tied:
            values[SPREADS[1]] = values[SPREADS[0]]
        return values

    def residuals(values: np.ndarray) -> np.ndarray:
        """One row for each set of constants."""
        found = np.zeros((len(values), len(pushes), 3))
        for rows in groups.values():
            found[:, rows] = play_pushes(pushes[rows], np.array([whole(each) for each in values]))
        return ((found - truth) / SCALE).reshape(len(values), -1)

    truth, groups = pushes.displacement(), groups_of(pushes)
    values, covariance, damping = mean.copy(), np.diag(std**2), 1e-2
    for _ in range(ITERATIONS):
        errors, *stepped = residuals(np.stack([values, *(values + np.diag(STEP)[free])]))
        slopes = ((np.array(stepped) - errors) / STEP[free, None]).T
        # Student's t with two degrees of freedom: a push that went another way counts little.
        weights = 3 / (2 + errors**2)
        best = _cost(errors, values, mean, std, free)
        precision = np.diag(1 / std[free] ** 2)
        square = slopes.T @ (weights[:, None] * slopes) + precision
        covariance[np.ix_(free, free)] = np.linalg.inv(square)
        right = slopes.T @ (weights * errors) + (values - mean)[free] / std[free] ** 2
        for _ in range(3):
            trial = values.copy()
            trial[free] -= np.linalg.solve(square + damping * np.diag(np.diag(square)), right)
            if _cost(residuals(trial[None])[0], trial, mean, std, free) < best:
                values, damping = trial, damping / 3
                break
            damping *= 10
        else:
            break
    return whole(values), covariance


def _cost(
    errors: np.ndarray, values: np.ndarray, mean: np.ndarray, std: np.ndarray, free: np.ndarray
) -> float:
    return float(3 * np.log1p(errors**2 / 2).sum() + (((values - mean)[free] / std[free]) ** 2).sum())
