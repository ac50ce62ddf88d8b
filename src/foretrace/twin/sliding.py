"""A twin of planar pushes: the quasi-static model, with constants that are identified from recorded pushes.

The constants are the rod's friction, how an object's weight is spread over its lower face, and offsets between the
frames of object, rod and table. Every constant has a prior: few pushes suffice for those that all shapes share, each
shape's own need more.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from foretrace.errors import PredictionError
from foretrace.geometry import rotate_plane
from foretrace.interactions.pushes import PushedShape, RecordedPushes
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


@dataclass(eq=False)
class SlidingTwin:
    """Predicts where pushes leave their objects, by the quasi-static model."""

    shared: Float[np.ndarray, " names"] = field(default_factory=lambda: np.zeros(len(NAMES)))
    """Values of a shape that was never pushed. How its weight is spread is nominal: shapes differ in that among each
    other as much as from an even spread."""
    own: dict[Group, Float[np.ndarray, " names"]] = field(default_factory=dict)
    """Values of each shape on its surface."""

    def predict(self, pushes: RecordedPushes, change: Change = Change()) -> Float[np.ndarray, "pushes 3"]:
        """Displacement [m] and turn [rad] of each object, in its own frame at rest."""
        found = np.zeros((len(pushes), 3))
        for group, rows in groups_of(pushes).items():
            found[rows] = _play(pushes[rows], self.own.get(group, self.shared), change)
        return found

    @classmethod
    def identified(cls, pushes: RecordedPushes, seed: int = 0) -> "SlidingTwin":
        """The twin whose constants explain recorded pushes best.

        Args:
            pushes: Pushes to learn from.
            seed: Decides which pushes are used where there are more than `MOST_FITTED` of a shape.

        Raises:
            PredictionError: There are no pushes.
        """
        if len(pushes) == 0:
            raise PredictionError("no push to identify constants from: give at least one")
        rng = np.random.default_rng(seed)
        some = rng.permutation(len(pushes))[: 2 * MOST_FITTED]
        shared = _fit(pushes[np.sort(some)], np.zeros(len(NAMES)), SHARED)
        own = {}
        for group, rows in groups_of(pushes).items():
            kept = np.sort(rng.permutation(rows)[:MOST_FITTED])
            own[group] = _fit(pushes[kept], shared, OWN)
        return cls(np.where(np.isin(np.arange(len(NAMES)), SPREADS), 0.0, shared), own)


def groups_of(pushes: RecordedPushes) -> dict[Group, np.ndarray]:
    """Rows of each shape on each surface."""
    keys = [(pushes.surface[k], pushes.shapes[pushes.shape[k]].name) for k in range(len(pushes))]
    found: dict[Group, list[int]] = {}
    for row, key in enumerate(keys):
        found.setdefault(key, []).append(row)
    return {key: np.array(rows) for key, rows in found.items()}


def _play(pushes: RecordedPushes, values: Float[np.ndarray, " names"], change: Change) -> np.ndarray:
    """Displacements and turns of pushes of one shape."""
    shape = pushes.shapes[pushes.shape[0]]
    footprint = _footprint(shape, values, change.spread)
    rod = rotate_plane(np.broadcast_to(1e-3 * values[7:9], (len(pushes), 2)), -pushes.before[:, 2])
    motion = rotate_plane(pushes.motion, np.full(len(pushes), change.turn))
    left = np.stack([-motion[:, 1], motion[:, 0]], axis=1) / np.linalg.norm(motion, axis=1)[:, None]
    friction = FRICTION * np.exp(values[0]) * change.friction
    start = pushes.start + rod + change.left * left
    position, angle = slide(footprint, start, motion, pushes.radius, friction, STEPS)
    return np.column_stack([position, angle])


def _footprint(shape: PushedShape, values: Float[np.ndarray, " names"], spread: float) -> Footprint:
    """A shape with its weight spread as given."""
    offset = 1e-3 * values[5:7]
    feet = feet_of(shape.model.corners, "uniform")
    around = (feet - feet.mean(axis=0)) * np.exp(values[1:3]) * spread
    return Footprint(shape.model.corners + offset, shape.centroid + offset + 1e-2 * values[3:5] + around)


def _fit(
    pushes: RecordedPushes, mean: Float[np.ndarray, " names"], std: Float[np.ndarray, " names"]
) -> Float[np.ndarray, " names"]:
    """Most probable values under normal priors and errors with long tails, by Gauss and Newton's method.

    A standard deviation of 0 of the spread along y ties it to that along x.
    """
    free = np.flatnonzero(std > 0)
    tied = std[SPREADS[1]] == 0

    def whole(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        if tied:
            values[SPREADS[1]] = values[SPREADS[0]]
        return values

    def residuals(values: np.ndarray) -> np.ndarray:
        return ((SlidingTwin(whole(values)).predict(pushes) - truth) / SCALE).ravel()

    truth = pushes.displacement()
    values, damping = mean.copy(), 1e-2
    for _ in range(ITERATIONS):
        errors = residuals(values)
        steps = STEP * np.eye(len(NAMES))
        slopes = np.stack([(residuals(values + steps[k]) - errors) / STEP[k] for k in free], axis=1)
        # Student's t with two degrees of freedom: a push that went another way counts little.
        weights = 3 / (2 + errors**2)
        best = _cost(errors, values, mean, std, free)
        precision = np.diag(1 / std[free] ** 2)
        square = slopes.T @ (weights[:, None] * slopes) + precision
        right = slopes.T @ (weights * errors) + (values - mean)[free] / std[free] ** 2
        for _ in range(3):
            trial = values.copy()
            trial[free] -= np.linalg.solve(square + damping * np.diag(np.diag(square)), right)
            if _cost(residuals(trial), trial, mean, std, free) < best:
                values, damping = trial, damping / 3
                break
            damping *= 10
        else:
            break
    return whole(values)


def _cost(
    errors: np.ndarray, values: np.ndarray, mean: np.ndarray, std: np.ndarray, free: np.ndarray
) -> float:
    return float(3 * np.log1p(errors**2 / 2).sum() + (((values - mean)[free] / std[free]) ** 2).sum())
