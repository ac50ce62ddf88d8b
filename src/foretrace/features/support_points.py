"""The two corners that an object turns about, as features: by rule, predicted, observed (paper, section 3.4)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from foretrace.errors import PredictionError, TrainingError
from foretrace.features.base import FeatureExtractor, FitPart
from foretrace.features.cnn import initialise_rectified
from foretrace.features.fitting import FitConfig, fit_network
from foretrace.geometry import convex_hull, cross, polygon_centroid, support_edge
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.hull import UNIT, approximate_corners, mask_contour

WIDTH = 128
"""Units of each layer of the network (paper, section 3.4)."""
NO_DISTANCE = 1e-6
"""Points nearer than this are the same point [m]."""
SETBACK = 0.02
"""The line of action of the blade's force meets the table so far before the contact point [m].

The blade leans forward as it rises, and so does its force. Measured on the paper's lever-ups: from 2 to 3 cm, the
closed form is right equally often.
"""
HALF_WIDTH = 0.00275
"""Half the width of the blade [m]: a tilting object rests on one corner of it."""


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


def support_points_by_rule(
    batch: InteractionBatch, setback: float = SETBACK, half_width: float = HALF_WIDTH
) -> Float[np.ndarray, "batch 2 2"]:
    """The ends of the edge across which the ray from lift point through centre of mass leaves the hull [m].

    Statics, with no learning: see `foretrace.geometry.support_edge`. The lift point is where the line of action of
    the blade's force meets the table. The object rests on that corner of the blade which is nearer to the support
    edge: on the centre of mass's side. The points are corners of the outline; an object with a bevelled rim turns
    about the corners of its bottom face, which lie somewhat further in.

    Args:
        batch: Interactions in the action frame.
        setback: How far before the contact point the line of action meets the table [m].
        half_width: Half the width of the blade [m]. With both 0 the object is lifted at the contact point.

    Returns:
        Points in the action frame, the right one first as seen from the contact point.

    Raises:
        PredictionError: No corners are known and a mask is empty, or the contact point is the centre of mass.
    """
    found = np.zeros((len(batch), 2, 2))
    for row in range(len(batch)):
        corners, com = hull_and_com(batch, row)
        if np.linalg.norm(com) < NO_DISTANCE:
            raise PredictionError(
                f"interaction {batch.ids[row]}: no edge lies beyond the centre of mass at {com.tolist()} m as "
                "seen from the contact point: lift the object at its rim"
            )
        lift = np.array([-setback, half_width * np.sign(com[1])])
        found[row] = corners[list(support_edge(corners, lift, com))]
    return order_points(found)


def order_points(points: Float[np.ndarray, "batch 2 2"]) -> Float[np.ndarray, "batch 2 2"]:
    """Pairs of points [m] with the right one first, as seen from the contact point; NaN stays as it is."""
    swapped = cross(points[:, 0], points[:, 1]) < 0
    return np.where(swapped[:, None, None], points[:, ::-1], points)


def points_of(features: Float[Tensor, "batch 4"]) -> Float[np.ndarray, "batch 2 2"]:
    """The support points that features stand for, in the action frame [m]."""
    return UNIT * features.detach().double().cpu().numpy().reshape(-1, 2, 2)


def is_correct(
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

    See `is_correct`. Interactions without observed support points are left out.

    Returns:
        Between 0 and 1; NaN where nothing was observed at all.
    """
    seen = np.isfinite(observed).all(axis=(1, 2))
    return float(is_correct(predicted, corners, observed)[seen].mean()) if seen.any() else float("nan")


# --- features ---------------------------------------------------------------------------------------------


class SupportPointsByRule(FeatureExtractor):
    """``sp-rule``: support points in closed form; not in the paper.

    Four numbers: x and y of the right and of the left point in the action frame, in units of 10 cm.

    Args:
        setback: How far before the contact point the line of action of the blade's force meets the table [m].
        half_width: Half the width of the blade [m]. With both 0 the object is lifted at the contact point.
    """

    label = "sp-rule"

    def __init__(self, setback: float = SETBACK, half_width: float = HALF_WIDTH):
        super().__init__(setback=setback, half_width=half_width)
        self.setback, self.half_width = setback, half_width

    @property
    def num_features(self) -> int:
        """Two points."""
        return 4

    def inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch 4"]:
        """The points, by rule."""
        return _scaled(support_points_by_rule(batch, self.setback, self.half_width))

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
            points[unseen] = support_points_by_rule(batch[unseen], self.setback, self.half_width)
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
    predictor is trained; then it is frozen. The corners are those of the outline's convex hull.

    The paper leaves open in which frame the network sees the corners and how its points become corners. Here it
    sees them along the ray from lift point through centre of mass, mirrored so that the centre lies to the left:
    mirror images have mirrored support points, exactly. What it predicts is the edge of the hull that is nearest.

    Args:
        epochs: Passes over the training part, at most.
        batch_size: Objects per optimiser step.
        learning_rate: Adam's learning rate.
        patience: Epochs without a smaller validation loss after which its training stops.
        aligned: See corners along the ray; else in the action frame.
        snapped: Predict corners of the hull; else the network's own points, which are those of the bottom face.
    """

    label = "sp-pred"
    learns = True

    def __init__(
        self,
        epochs: int = 100,
        batch_size: int = 64,
        learning_rate: float = 1e-3,
        patience: int = 50,
        aligned: bool = True,
        snapped: bool = True,
    ):
        super().__init__(
            epochs=epochs,
            batch_size=batch_size,
            learning_rate=learning_rate,
            patience=patience,
            aligned=aligned,
            snapped=snapped,
        )
        self.config = FitConfig(epochs, batch_size, learning_rate, patience)
        self.aligned, self.snapped = aligned, snapped
        self.network = SupportPointNetwork().requires_grad_(False)

    @property
    def num_features(self) -> int:
        """Two points."""
        return 4

    def inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch points 3"]:
        """Points in units of 10 cm: the centre of mass, the hull's corners, the first corner again.

        In the third column, corners have a 1 and everything else a 0. The first corner fills the longer rows.
        """
        shapes = [hull_and_com(batch, row) for row in range(len(batch))]
        rows = torch.zeros(len(batch), 2 + max((len(hull) for hull, _ in shapes), default=0), 3)
        for row, (hull, com) in zip(rows, shapes, strict=True):
            row[:, :2] = torch.from_numpy(hull[0] / UNIT)
            row[0, :2] = torch.from_numpy(com / UNIT)
            row[1 : 1 + len(hull), :2] = torch.from_numpy(hull / UNIT)
            row[1 : 1 + len(hull), 2] = 1
        return rows

    def fit(self, train: FitPart, validation: FitPart, *, seed: int, report: Callable[[str], None]) -> None:
        """Learn from the observed support points; interactions without any are left out.

        Where none of the validation part was observed, the training part is for choosing the epoch.

        Raises:
            TrainingError: No support point of the training part was observed.
        """
        corners, points = self._observed(train)
        if len(corners) == 0:
            raise TrainingError(
                f"sp-pred: none of the {len(train.batch)} interactions to learn from has observed support "
                "points: add levered ones, or use sp-rule, which learns nothing"
            )
        held_out = self._observed(validation)
        chosen_by = held_out if len(held_out[0]) else (corners, points)
        fit_network(
            self.network,
            lambda rows: F.mse_loss(self.network(corners[rows]), points[rows]),
            lambda: F.mse_loss(self.network(chosen_by[0]), chosen_by[1]).item(),
            len(corners),
            self.config,
            name=self.label,
            seed=seed,
            report=report,
        )

    def forward(self, inputs: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch 4"]:
        """The predicted points, numbers and order as in ``sp-rule``."""
        frame = self._frame(inputs)
        points = frame.leave(self.network(frame.enter(inputs)).unflatten(1, (2, 2)))
        return (nearest_edges(inputs, points) if self.snapped else points).flatten(1)

    def _frame(self, inputs: Float[Tensor, "batch points 3"]) -> "RayFrame":
        com = inputs[:, 0, :2]
        return RayFrame.through(com) if self.aligned else RayFrame.of_action(com)

    def _observed(self, part: FitPart) -> tuple[Float[Tensor, "k points 3"], Float[Tensor, "k 4"]]:
        """What the network sees and is to say, for the interactions whose support points were observed."""
        seen = torch.from_numpy(np.isfinite(part.batch.support_points).all(axis=(1, 2)))
        targets = _scaled(order_points(part.batch.support_points))[seen].unflatten(1, (2, 2))
        inputs = part.inputs[seen.to(part.inputs.device)]
        frame = self._frame(inputs)
        return frame.enter(inputs), frame.enter(targets.to(inputs.device)).flatten(1)


@dataclass(frozen=True)
class RayFrame:
    """Where the network sees each object: as seen from the lift point, the centre of mass straight ahead."""

    origin: Float[Tensor, "batch 1 2"]
    """The lift point in the action frame, in units of 10 cm."""
    axes: Float[Tensor, "batch 2 2"]
    """Rows: unit vectors forwards, and to the centre of mass's side of the action axis."""
    mirrored: Bool[Tensor, "batch 1 1"]
    """Whether that side is the right one."""

    @classmethod
    def through(cls, com: Float[Tensor, "batch 2"]) -> "RayFrame":
        """Along the ray from the lift point of `support_points_by_rule` through the centre of mass."""
        side = torch.where(com[:, 1:] < 0, -1.0, 1.0)
        lift = torch.cat([torch.full_like(side, -SETBACK / UNIT), side * (HALF_WIDTH / UNIT)], dim=1)
        ahead = F.normalize(com - lift, dim=1)
        aside = side * torch.stack([-ahead[:, 1], ahead[:, 0]], dim=1)
        return cls(lift[:, None], torch.stack([ahead, aside], dim=1), side[:, None] < 0)

    @classmethod
    def of_action(cls, com: Float[Tensor, "batch 2"]) -> "RayFrame":
        """The action frame itself."""
        axes = torch.eye(2, device=com.device).expand(len(com), 2, 2)
        return cls(torch.zeros_like(com)[:, None], axes, torch.zeros_like(com[:, :1, None], dtype=torch.bool))

    def enter(self, points: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch points columns"]:
        """Points of the action frame in this one; pairs of points stay right first, further columns as they are."""
        inside = torch.cat([(points[..., :2] - self.origin) @ self.axes.mT, points[..., 2:]], dim=-1)
        return torch.where(self.mirrored, inside.flip(1), inside)

    def leave(self, points: Float[Tensor, "batch 2 2"]) -> Float[Tensor, "batch 2 2"]:
        """Pairs of points of this frame in the action frame."""
        return torch.where(self.mirrored, points.flip(1), points) @ self.axes + self.origin


def nearest_edges(
    inputs: Float[Tensor, "batch points 3"], pairs: Float[Tensor, "batch 2 2"]
) -> Float[Tensor, "batch 2 2"]:
    """The edge of each hull whose ends are nearest to a pair of points, by the sum of squared distances.

    Args:
        inputs: What `PredictedSupportPoints.inputs` made: hulls are counter-clockwise, so that of an edge seen
            from inside the right end comes first.
        pairs: Right and left point, in the same units.
    """
    edges = torch.stack([inputs[:, 1:-1, :2], inputs[:, 2:, :2]], dim=2)  # (batch, edges, 2, 2)
    distances = (edges - pairs[:, None]).square().sum(dim=(2, 3))
    best = distances.masked_fill(inputs[:, 1:-1, 2] == 0, torch.inf).argmin(dim=1)
    return edges[torch.arange(len(edges), device=edges.device), best]


def _scaled(points: Float[np.ndarray, "batch 2 2"]) -> Float[Tensor, "batch 4"]:
    return torch.from_numpy(points / UNIT).float().flatten(1)
