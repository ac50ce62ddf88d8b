"""The two corners that an object turns about, as features: by rule, predicted, observed (paper, section 3.4)."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from foretrace.errors import PredictionError, TrainingError
from foretrace.features.base import FeatureExtractor, FitPart
from foretrace.features.cnn import initialise_rectified
from foretrace.features.fitting import FitConfig, fit_network
from foretrace.features.outlines import approximate_corners, mask_contour
from foretrace.geometry import convex_hull, cross, polygon_centroid, support_edge
from foretrace.interactions.dataset import InteractionBatch

UNIT = 0.1
"""Coordinates are divided by this to be of unit scale [m]."""
WIDTH = 128
"""Units of each layer of the network (paper, section 3.4)."""


# --- geometry ---------------------------------------------------------------------------------------------


def hull_and_com(
    batch: InteractionBatch, row: int
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "2"]]:
    """Corners of one object's convex hull, and its area's centre, in the action frame at rest [m].

    From ``batch.corners`` where they are known, else from the mask: its outline's hull, approximated by a
    polygon. The area's centre is the centre of mass of an object of uniform height and density.

    Raises:
        PredictionError: No corners are known and the mask is empty.
    """
    corners = batch.corners[row]
    corners = corners[np.isfinite(corners).all(axis=1)]
    if len(corners) >= 3:
        return convex_hull(corners), polygon_centroid(corners)
    contour = mask_contour(batch, row)
    return approximate_corners(contour), polygon_centroid(contour)


def support_points_by_rule(batch: InteractionBatch) -> Float[np.ndarray, "batch 2 2"]:
    """The ends of the edge across which the ray from contact point through centre of mass leaves the hull [m].

    Statics, with no learning: see `foretrace.geometry.support_edge`. The points are corners of the outline; an
    object with a bevelled rim turns about the corners of its bottom face, which lie somewhat further in.

    Returns:
        Points in the action frame, the right one first as seen from the contact point.

    Raises:
        PredictionError: No corners are known and a mask is empty, or the contact point is the centre of mass.
    """
    found = np.zeros((len(batch), 2, 2))
    for row in range(len(batch)):
        corners, com = hull_and_com(batch, row)
        try:
            found[row] = corners[list(support_edge(corners, np.zeros(2), com))]
        except IndexError:
            raise PredictionError(
                f"interaction {batch.ids[row]}: no edge lies beyond the centre of mass at {com.tolist()} m as "
                "seen from the contact point: lift the object at its rim"
            ) from None
    return order_points(found)


def order_points(points: Float[np.ndarray, "batch 2 2"]) -> Float[np.ndarray, "batch 2 2"]:
    """Pairs of points [m] with the right one first, as seen from the contact point; NaN stays as it is."""
    swapped = cross(points[:, 0], points[:, 1]) < 0
    return np.where(swapped[:, None, None], points[:, ::-1], points)


def points_of(features: Float[Tensor, "batch 4"]) -> Float[np.ndarray, "batch 2 2"]:
    """The support points that features stand for, in the action frame [m]."""
    return UNIT * features.detach().double().cpu().numpy().reshape(-1, 2, 2)


def named_right(
    predicted: Float[np.ndarray, "batch 2 2"],
    corners: Float[np.ndarray, "batch corners 2"],
    observed: Float[np.ndarray, "batch 2 2"],
) -> Bool[np.ndarray, " batch"]:
    """Where both support corners are right; False where none were observed.

    Each point stands for the corner of the outline that is nearest to it; the order of the two does not matter.

    Args:
        predicted: Support points in the action frame [m].
        corners: Corners of the outlines [m], NaN-padded.
        observed: What was observed [m]; NaN where nothing was.
    """

    def nearest(points: np.ndarray) -> np.ndarray:
        distance = np.linalg.norm(points[:, :, None] - corners[:, None], axis=-1)  # (batch, 2, corners)
        return np.sort(np.where(np.isnan(distance), np.inf, distance).argmin(axis=-1), axis=-1)

    seen = np.isfinite(observed).all(axis=(1, 2))
    return seen & (nearest(predicted) == nearest(observed)).all(axis=-1)


def support_point_accuracy(
    predicted: Float[np.ndarray, "batch 2 2"],
    corners: Float[np.ndarray, "batch corners 2"],
    observed: Float[np.ndarray, "batch 2 2"],
) -> float:
    """Share of the interactions of which both support corners are right (paper, section 5.1).

    See `named_right`. Interactions without observed support points are left out.

    Returns:
        Between 0 and 1; NaN where nothing was observed at all.
    """
    seen = np.isfinite(observed).all(axis=(1, 2))
    return float(named_right(predicted, corners, observed)[seen].mean()) if seen.any() else float("nan")


# --- features ---------------------------------------------------------------------------------------------


class SupportPointsByRule(FeatureExtractor):
    """``sp-rule``: support points in closed form; not in the paper.

    Four numbers: x and y of the right and of the left point in the action frame, in units of 10 cm.
    """

    label = "sp-rule"

    @property
    def num_features(self) -> int:
        """Two points."""
        return 4

    def inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch 4"]:
        """The points, by rule."""
        return _scaled(support_points_by_rule(batch))

    def forward(self, inputs: Float[Tensor, "batch 4"]) -> Float[Tensor, "batch 4"]:
        """Hand the points on."""
        return inputs


class ObservedSupportPoints(SupportPointsByRule):
    """``sp-truth``: support points as observed during the action, an oracle (paper, section 3.4).

    Where they were not observed, those of the rule stand in, so that every interaction has features. Numbers
    and order are those of ``sp-rule``; the points are corners of the bottom face.
    """

    label = "sp-truth"
    oracle = True

    def inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch 4"]:
        """The points, observed if possible."""
        points = order_points(batch.support_points)
        unseen = np.flatnonzero(~np.isfinite(points).all(axis=(1, 2)))
        if len(unseen):
            points[unseen] = support_points_by_rule(batch[unseen])
        return _scaled(points)


class SupportPointNetwork(nn.Module):
    """From any number of corners to two points (paper, section 3.4).

    Every corner goes through the same encoder, three rectified layers of 128; the codes are summed, so that
    neither order nor number of the corners matters; two rectified layers of 128 decode the sum, and a linear
    one gives the points.
    """

    def __init__(self) -> None:
        super().__init__()
        self.encoder = initialise_rectified(
            nn.Sequential(
                *(nn.Linear(2, WIDTH), nn.ReLU()),
                *(nn.Linear(WIDTH, WIDTH), nn.ReLU()),
                *(nn.Linear(WIDTH, WIDTH), nn.ReLU()),
            )
        )
        self.decoder = initialise_rectified(
            nn.Sequential(nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU())
        )
        self.output = nn.Linear(WIDTH, 4)

    def forward(self, corners: Float[Tensor, "batch corners 3"]) -> Float[Tensor, "batch 4"]:
        """Two points for the corners of each object: x, y, and 1 for a corner or 0 for padding."""
        codes = self.encoder(corners[..., :2]) * corners[..., 2:]  # (batch, corners, 128)
        return self.output(self.decoder(codes.sum(dim=1)))


class PredictedSupportPoints(FeatureExtractor):
    """``sp-pred``: support points that a network predicts from the corners (paper, section 3.4).

    The network learns from the support points observed in the training part, by mean squared error, before the
    predictor is trained; then it is frozen. The corners are those of the outline's convex hull. It learns the
    corners of the bottom face, about which an object turns.

    Args:
        epochs: Passes over the training part, at most.
        batch_size: Objects per optimiser step.
        learning_rate: Adam's learning rate.
        patience: Epochs without a smaller validation loss after which its training stops.
    """

    label = "sp-pred"

    def __init__(
        self, epochs: int = 500, batch_size: int = 32, learning_rate: float = 1e-3, patience: int = 50
    ):
        super().__init__(epochs=epochs, batch_size=batch_size, learning_rate=learning_rate, patience=patience)
        self.config = FitConfig(epochs, batch_size, learning_rate, patience)
        self.network = SupportPointNetwork().requires_grad_(False)

    @property
    def num_features(self) -> int:
        """Two points."""
        return 4

    def inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch corners 3"]:
        """Corners in units of 10 cm, each with a 1; rows of zeros past the last."""
        hulls = [hull_and_com(batch, row)[0] for row in range(len(batch))]
        rows = torch.zeros(len(batch), max(map(len, hulls), default=0), 3)
        for row, hull in zip(rows, hulls, strict=True):
            row[: len(hull), :2] = torch.from_numpy(hull / UNIT)
            row[: len(hull), 2] = 1
        return rows

    def fit(self, train: FitPart, validation: FitPart, *, seed: int, report: Callable[[str], None]) -> None:
        """Learn from the observed support points; interactions without any are left out.

        Where none of the validation part was observed, the training part is for choosing the epoch.

        Raises:
            TrainingError: No support point of the training part was observed.
        """
        corners, points = _observed(train)
        if len(corners) == 0:
            raise TrainingError(
                f"sp-pred: none of the {len(train.batch)} interactions to learn from has observed support "
                "points: add levered ones, or use sp-rule, which learns nothing"
            )
        held_out = _observed(validation)
        judged = held_out if len(held_out[0]) else (corners, points)
        fit_network(
            self.network,
            lambda rows: F.mse_loss(self.network(corners[rows]), points[rows]),
            lambda: F.mse_loss(self.network(judged[0]), judged[1]).item(),
            len(corners),
            self.config,
            name=self.label,
            seed=seed,
            report=report,
        )

    def forward(self, inputs: Float[Tensor, "batch corners 3"]) -> Float[Tensor, "batch 4"]:
        """The predicted points, numbers and order as in ``sp-rule``."""
        return self.network(inputs)


def _scaled(points: Float[np.ndarray, "batch 2 2"]) -> Float[Tensor, "batch 4"]:
    return torch.from_numpy(points / UNIT).float().flatten(1)


def _observed(part: FitPart) -> tuple[Float[Tensor, "k corners 3"], Float[Tensor, "k 4"]]:
    """Inputs and targets of the interactions whose support points were observed."""
    seen = torch.from_numpy(np.isfinite(part.batch.support_points).all(axis=(1, 2)))
    targets = _scaled(order_points(part.batch.support_points))[seen]
    return part.inputs[seen.to(part.inputs.device)], targets.to(part.inputs.device)
