"""What a twin of planar pushes gets wrong, learned from recorded pushes; and how far the prediction may be off.

Networks predict the correction in the frame of the push: x along the rod's motion, y to its left. A push and its mirror
image are both learned from. Each network leaves a fold of the pushes out; on it, the error is measured that conformal
regions are made of.
"""

from dataclasses import dataclass

import numpy as np
import shapely
import torch
from jaxtyping import Float, Int
from torch import nn

from foretrace.errors import PredictionError
from foretrace.geometry import rotate_plane, wrap_angle
from foretrace.interactions.pushes import RecordedPushes
from foretrace.twin.sliding import SlidingTwin
from foretrace.twin.sliding_constants import Change

UNITS = np.array([0.003, 0.003, np.deg2rad(4.0)])
"""Usual size of a correction: displacement [m] and turn [rad]."""
CHANGES = (
    *(Change(friction=1.5), Change(friction=1 / 1.5), Change(spread=1.3), Change(spread=1 / 1.3)),
    *(Change(left=0.001), Change(left=-0.001), Change(turn=0.05), Change(turn=-0.05)),
)
"""Circumstances under which the twin plays each push again, in pairs."""
FOLDS = 6
"""Networks, each of which does not see one fold of the pushes."""
FEWEST = 30
"""Fewer pushes are not enough to learn from."""
BATCH, RATE, DECAY = 64, 2e-3, 1e-2
OVER_TWIN, ALONE = (90, 64, 0.2), (300, 128, 0.05)
"""Epochs, width and dropout, of corrections and of whole displacements; chosen on recorded pushes that were neither
learned from nor tested on."""
LIMIT = 4.0
"""Inputs are cut off at this value, in standard units."""
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of the correction that are tried on pushes that were left out."""


@dataclass(frozen=True, eq=False)
class PushRegions:
    """Conformal regions around predicted displacements and turns (V. Vovk et al., 2005): scores of left-out pushes."""

    scores: Float[np.ndarray, "pushes 2"]
    """Errors of displacement [m] and turn [rad], each divided by its scale."""

    def radius(self, level: float, scale: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Radius around the displacement [m] and half width around the turn [rad] that hold with a probability."""
        rank = int(np.ceil(level * (len(self.scores) + 1)))
        if rank > len(self.scores):
            return np.full_like(scale, np.inf)
        return np.sort(self.scores, axis=0)[rank - 1] * scale

    def level(
        self, errors: Float[np.ndarray, "n 2"], scale: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n 2"]:
        """Level below which regions do not hold an error, and above which they do."""
        below = (self.scores[None] < (errors / scale)[:, None]).sum(axis=1)
        return below / (len(self.scores) + 1)


def push_errors(
    found: Float[np.ndarray, "pushes 3"], truth: Float[np.ndarray, "pushes 3"]
) -> Float[np.ndarray, "pushes 2"]:
    """Distance [m] and angle [rad] between predicted and recorded poses after the pushes."""
    distance = np.linalg.norm(found[:, :2] - truth[:, :2], axis=1)
    return np.column_stack([distance, np.abs(wrap_angle(found[:, 2] - truth[:, 2]))])


class PushResidual:
    """Predicts pushes by a twin and learned corrections, or without a twin by learning alone.

    Args:
        twin: The twin; None learns the whole displacement.
        new_shapes: Whether the pushes to predict are of shapes that were never pushed. Then nothing that is a shape's
            own is learned, the twin uses what all shapes share, and each fold holds one shape.
        seed: Decides folds and first weights.
    """

    def __init__(self, twin: SlidingTwin | None, new_shapes: bool = False, seed: int = 0) -> None:
        self.twin = SlidingTwin(twin.shared) if twin is not None and new_shapes else twin
        self.new_shapes, self.seed = new_shapes, seed
        self.share = 1.0
        """Share of the learned correction that is used: what did best on pushes that were left out."""

    def fit(self, pushes: RecordedPushes) -> "PushResidual":
        """Learn from recorded pushes.

        Raises:
            PredictionError: There are too few of them.
        """
        if len(pushes) < FEWEST:
            raise PredictionError(f"{len(pushes)} pushes are too few to learn from: give {FEWEST} or more")
        self._names = [shape.name for shape in pushes.shapes]
        inputs, base, sensitivity = self._look(pushes)
        mirrored = _mirrored(inputs)
        self._mean = np.vstack([inputs.values, mirrored]).mean(axis=0)
        self._std = np.vstack([inputs.values, mirrored]).std(axis=0) + 0.05
        truth = _in_push_frame(pushes, pushes.displacement())
        wanted = truth - base
        folds = self._folds(pushes)
        left_out = np.zeros_like(wanted)
        self._networks = []
        for fold in np.unique(folds):
            torch.manual_seed(1000 * self.seed + int(fold))
            seen = folds != fold
            x = np.vstack([inputs.values[seen], mirrored[seen]])
            y = np.vstack([wanted[seen], wanted[seen] * [1, -1, -1]])
            network = _train(
                self._scaled(x),
                torch.tensor(y, dtype=torch.float32),
                *(ALONE if self.twin is None else OVER_TWIN),
            )
            self._networks.append(network)
            left_out[~seen] = _apply(network, self._scaled(inputs.values[~seen]))
        costs = [_cost(base + share * left_out - truth) for share in SHARES]
        self.share = SHARES[int(np.argmin(costs))] if self.twin is not None else 1.0
        found = _in_object_frame(pushes, base + self.share * left_out)
        errors = push_errors(found, pushes.displacement())
        self._trend = [_trend(sensitivity, errors[:, k]) for k in range(2)]
        self.regions = PushRegions(errors / self._scale(sensitivity))
        return self

    def predict(
        self, pushes: RecordedPushes
    ) -> tuple[Float[np.ndarray, "pushes 3"], Float[np.ndarray, "pushes 2"]]:
        """Displacement [m] and turn [rad] of each object in its own frame at rest, and the scale of their errors."""
        inputs, base, sensitivity = self._look(pushes)
        x = self._scaled(inputs.values)
        correction = np.mean([_apply(network, x) for network in self._networks], axis=0)
        return _in_object_frame(pushes, base + self.share * correction), self._scale(sensitivity)

    def _folds(self, pushes: RecordedPushes) -> Int[np.ndarray, " pushes"]:
        if self.new_shapes and len(np.unique(pushes.shape)) > 1:
            return pushes.shape
        return np.random.default_rng(self.seed).permutation(len(pushes)) % FOLDS

    def _look(self, pushes: RecordedPushes) -> tuple["_Inputs", np.ndarray, np.ndarray]:
        """Inputs of the networks, prediction without a correction, and how much it depends on circumstances."""
        even, odd, slant = _geometry(pushes)
        if self.twin is None:
            base, sensitivity = np.zeros((len(pushes), 3)), 0.2 + np.abs(slant)
        else:
            played = [self.twin.predict(pushes, change) for change in (Change(), *CHANGES)]
            base, *others = (_in_push_frame(pushes, each) for each in played)
            apart = np.stack([(a - b) / 2 for a, b in zip(others[::2], others[1::2], strict=True)], axis=1)
            sensitivity = 0.1 + np.abs(apart[:, 2:]).sum(axis=(1, 2))
            # The rod's friction and the spread keep their sign in a mirror, its offset and turn do not.
            even = np.column_stack(
                [even, base[:, 0] / 4, apart[:, :2, 0], apart[:, 2, 1:], apart[:, 3, 1:], np.log(sensitivity)]
            )
            odd = np.column_stack([odd, base[:, 1:] / 3, *(apart[:, k, 1:] for k in (0, 1)), apart[:, 2:, 0]])
        own = np.zeros((len(pushes), 0)) if self.new_shapes else _own_features(pushes, self._names)
        return _Inputs(np.column_stack([even, odd, own]), even.shape[1], odd.shape[1]), base, sensitivity

    def _scaled(self, values: np.ndarray) -> torch.Tensor:
        scaled = (values - self._mean) / self._std
        return torch.tensor(np.clip(scaled, -LIMIT, LIMIT), dtype=torch.float32)

    def _scale(self, sensitivity: np.ndarray) -> np.ndarray:
        return np.column_stack([np.exp(np.polyval(trend, np.log(sensitivity))) for trend in self._trend])


@dataclass(frozen=True, eq=False)
class _Inputs:
    values: np.ndarray
    even: int
    """Leading columns that are the same in a mirror."""
    odd: int
    """Columns after them that change their sign; the rest is a shape's own, which its mirror image is not."""


def _mirrored(inputs: _Inputs) -> np.ndarray:
    values = inputs.values.copy()
    values[:, inputs.even : inputs.even + inputs.odd] *= -1
    values[:, inputs.even + inputs.odd :] = 0.0
    return values


def _axes(pushes: RecordedPushes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions along and to the left of each push, and the centre of its shape, in the object frame."""
    ahead = pushes.motion / np.linalg.norm(pushes.motion, axis=1)[:, None]
    centre = np.array([shape.centroid for shape in pushes.shapes])[pushes.shape]
    return ahead, np.stack([-ahead[:, 1], ahead[:, 0]], axis=1), centre


def _in_push_frame(pushes: RecordedPushes, displacement: np.ndarray) -> np.ndarray:
    """Displacement of the object's centre along the push and to its left, and turn, in `UNITS`."""
    ahead, left, centre = _axes(pushes)
    moved = displacement[:, :2] + rotate_plane(centre, displacement[:, 2]) - centre
    return (
        np.column_stack([(moved * ahead).sum(axis=1), (moved * left).sum(axis=1), displacement[:, 2]]) / UNITS
    )


def _in_object_frame(pushes: RecordedPushes, values: np.ndarray) -> np.ndarray:
    ahead, left, centre = _axes(pushes)
    along, across, turn = (values * UNITS).T
    moved = along[:, None] * ahead + across[:, None] * left
    return np.column_stack([moved + centre - rotate_plane(centre, turn), turn])


def _geometry(pushes: RecordedPushes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the rod meets the object: features that a mirror keeps, those that it changes, slant of the push."""
    ahead, left, centre = _axes(pushes)
    rings = [shapely.LinearRing(shape.model.corners) for shape in pushes.shapes]
    near = np.array(
        [
            shapely.get_coordinates(shapely.shortest_line(rings[k], shapely.Point(start)))[0]
            for k, start in zip(pushes.shape, pushes.start, strict=True)
        ]
    )
    inward = near - pushes.start
    inward /= np.maximum(np.linalg.norm(inward, axis=1), 1e-9)[:, None]
    slant = ahead[:, 0] * inward[:, 1] - ahead[:, 1] * inward[:, 0]
    away = centre - pushes.start
    length = np.linalg.norm(pushes.motion, axis=1)
    even = np.column_stack([(away * ahead).sum(axis=1) / 0.03, (length - 0.05) / 0.01])
    return even, np.column_stack([2 * slant, (away * left).sum(axis=1) / 0.03]), slant


def _own_features(pushes: RecordedPushes, names: list[str]) -> np.ndarray:
    """Start and direction of each push in the frame of its own shape, and its direction on the table."""
    ahead, _, centre = _axes(pushes)
    known = np.array([names.index(shape.name) if shape.name in names else -1 for shape in pushes.shapes])
    which = (known[pushes.shape][:, None] == np.arange(len(names))).astype(float)
    place = np.column_stack([(pushes.start - centre) / 0.03, ahead, np.ones(len(pushes))])
    on_table = rotate_plane(ahead, pushes.before[:, 2])
    return np.column_stack([(which[:, :, None] * place[:, None]).reshape(len(pushes), -1), on_table])


def _train(x: torch.Tensor, y: torch.Tensor, epochs: int, width: int, dropout: float) -> nn.Module:
    """A network that predicts corrections; its loss is the mean distance, to which single large errors add little."""
    network = nn.Sequential(
        *(nn.Linear(x.shape[1], width), nn.SiLU(), nn.Dropout(dropout)),
        *(nn.Linear(width, width), nn.SiLU(), nn.Dropout(dropout)),
        nn.Linear(width, 3),
    )
    last = network[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    steps = epochs * -(-len(x) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    for _ in range(epochs):
        for rows in torch.randperm(len(x)).split(BATCH):
            off = network(x[rows]) - y[rows]
            shift = torch.sqrt((off[:, :2] ** 2).sum(dim=1) + 0.01)
            loss = (shift + torch.sqrt(off[:, 2] ** 2 + 0.01)).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return network.eval()


def _apply(network: nn.Module, x: torch.Tensor) -> np.ndarray:
    with torch.no_grad():
        return network(x).numpy().astype(float)


def _cost(off: np.ndarray) -> float:
    return float((np.linalg.norm(off[:, :2], axis=1) + np.abs(off[:, 2])).mean())


def _trend(sensitivity: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Line through the logarithms of errors over those of sensitivities."""
    return np.polyfit(np.log(sensitivity), np.log(np.maximum(errors, 1e-6)), 1)
