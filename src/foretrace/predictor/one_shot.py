"""A predictor that says the whole motion at once: how the object turns about its support edge."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from foretrace.errors import TrainingError
from foretrace.features import FeatureExtractor, Outline
from foretrace.features.outline import UNIT
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.hinges import NUM_VALUES, find_hinges, mirror_corners

COORDINATES = 6
"""A motion's numbers per sample: displacement of the centre of mass, rotation vector, along a hinge's axes."""
TURN_LENGTH = 0.05
"""A turn by 1 rad weighs as much as a displacement by this [m]: about the distance from hinge to centre of mass."""
TURN_WEIGHT = 0.5
"""Weight of the turn in the loss, beside 1 for the displacement."""
SAMPLES_PER_STEP = 15
"""Samples of the trajectories, drawn at random, that one training step looks at: it makes the step cheaper."""


@dataclass(frozen=True)
class OneShotConfig:
    """Settings of the predictor of whole motions."""

    hidden: int = 192
    """Units of each hidden layer."""
    layers: int = 3
    """Hidden layers."""
    members: int = 5
    """Networks that learn side by side and are averaged."""
    motions: int = 32
    """Principal motions of the training part that the networks put a trajectory together from."""
    known: tuple[str, ...] = ()
    """Physical constants that it is told beside the view."""

    def __post_init__(self) -> None:
        for name in ("hidden", "layers", "members", "motions"):
            if getattr(self, name) < 1:
                raise TrainingError(f"{name} must be at least 1, not {getattr(self, name)}")


class Members(nn.Module):
    """Networks of one shape side by side: rectified layers that work on all of them in one product.

    Args:
        members: How many.
        sizes: Numbers in and out, and the hidden units in between.
    """

    def __init__(self, members: int, sizes: tuple[int, ...]):
        super().__init__()
        pairs = list(pairwise(sizes))
        # Variances are kept from layer to layer (Glorot and Bengio, 2010); every motion starts as the mean one.
        bounds = [(3 / enter) ** 0.5 for enter, _ in pairs[:-1]] + [0.0]
        self.members = members
        # A row for each unit of each member: what optimisers take for a layer's weights.
        self.weights = nn.ParameterList(
            torch.empty(members * leave, enter).uniform_(-1, 1) * bound
            for (enter, leave), bound in zip(pairs, bounds, strict=True)
        )
        self.biases = nn.ParameterList(torch.zeros(members * leave) for _, leave in pairs)

    def forward(self, x: Float[Tensor, "members batch enter"]) -> Float[Tensor, "members batch leave"]:
        """Every member's answer to its own rows."""
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            weight, bias = weight.unflatten(0, (self.members, -1)), bias.view(self.members, 1, -1)
            x = torch.baddbmm(bias, x, weight.mT)
            x = x if layer == last else F.silu(x)
        return x


@dataclass(frozen=True)
class _View:
    """Lever-ups as seen from their hinges, or as their mirror images are seen from theirs."""

    values: Float[Tensor, "batch values"]
    """What is seen, of unit scale."""
    axes: Float[Tensor, "batch 3 3"]
    """Rows: the hinge's axes in the action frame; of a mirror image's hinge, mirrored back."""


class OneShotPredictor(EffectPredictor):
    """Says a whole motion at once, in the frame of the edge that the object turns about.

    From the outline's corners and the centre of mass, `find_hinges` finds the support edge in closed form, and
    what the lever-up looks like from there. Networks turn these numbers into weights of principal motions: how far
    the object is displaced and turned, sample by sample, along the hinge's axes. Every lever-up is also seen in the
    mirror, and both answers are averaged: mirror images have mirrored motions, exactly.

    Args:
        features: Must be ``outline``.
        num_samples: Samples in a trajectory.
        settings: Settings.

    Raises:
        TrainingError: Other features.
    """

    label = "one-shot"
    value_mean: Tensor
    value_scale: Tensor
    mean_motion: Tensor
    motions: Tensor

    def __init__(
        self, features: FeatureExtractor, num_samples: int, settings: OneShotConfig = OneShotConfig()
    ):
        if not isinstance(features, Outline):
            raise TrainingError(
                f"the {self.label} predictor reads an object's outline, not {features.label}: train it with "
                "features 'outline'"
            )
        super().__init__(features, "pose", num_samples, settings.known)
        self.settings = settings
        hidden = (settings.hidden,) * settings.layers
        enter = NUM_VALUES + len(self.known)
        self.networks = Members(settings.members, (enter, *hidden, settings.motions))
        self.register_buffer("value_mean", torch.zeros(NUM_VALUES))
        self.register_buffer("value_scale", torch.ones(NUM_VALUES))
        self.register_buffer("mean_motion", torch.zeros(num_samples, COORDINATES))
        self.register_buffer("motions", torch.zeros(settings.motions, num_samples, COORDINATES))

    @property
    def config(self) -> OneShotConfig:
        """Its settings."""
        return self.settings

    @property
    def feature_weights(self) -> list[nn.Parameter]:
        """None: corners are not multiplied with weights, only what is made of them."""
        return []

    def prepare(
        self,
        features: Float[Tensor, "batch inputs"],
        states: Float[Tensor, "batch time 9"],
        lengths: Int[Tensor, " batch"],
    ) -> None:
        """Find the principal motions of the training part, and the scale of what is seen from the hinges.

        A shorter trajectory counts as if it stayed where it ends.
        """
        com = self._metres(states[:, :1, :3])
        views = self._see(features, com[:, 0])
        values = torch.cat([view.values for view in views])
        self.value_mean.copy_(values.mean(dim=0))
        self.value_scale.copy_(values.std(dim=0, correction=0).clamp(min=1e-3))
        held = torch.arange(states.shape[1], device=states.device).expand(len(states), -1)
        held = held.minimum(lengths[:, None] - 1)[..., None].expand_as(states)
        states = states.gather(1, held)
        motions = torch.cat([self._motion(states, com, view) for view in views])
        self.mean_motion.copy_(motions.mean(dim=0))
        _, sizes, directions = torch.linalg.svd((motions - self.mean_motion).flatten(1), full_matrices=False)
        found = min(len(sizes), len(self.motions))
        scaled = directions[:found] * (sizes[:found, None] / len(motions) ** 0.5)
        self.motions[:found].copy_(scaled.unflatten(1, self.mean_motion.shape))

    def training_loss(
        self,
        features: Float[Tensor, "batch inputs"],
        states: Float[Tensor, "batch time 9"],
        lengths: Int[Tensor, " batch"],
    ) -> Float[Tensor, ""]:
        """Mean distance of displacements, and of turns by ``TURN_WEIGHT``, in units of the normalised position.

        Distances, not their squares: one lever-up that goes another way does not outweigh all others.
        """
        com = self._metres(states[:, :1, :3])
        views = self._see(features, com[:, 0])
        time = torch.randperm(states.shape[1], device=states.device)[:SAMPLES_PER_STEP]
        valid = (time < lengths[:, None]).float().repeat(len(views), 1)
        truth = torch.cat([self._motion(states[:, time], com, view) for view in views])
        off = self._say(features, views, time) - truth  # (members, views batch, time, 6)
        apart = off.unflatten(-1, (2, 3)).square().sum(dim=-1).add(1e-12).sqrt()
        error = apart[..., 0] + TURN_WEIGHT * apart[..., 1]
        return (error * valid).sum() / (len(error) * valid.sum()) / self.state_scale[0]

    def validation_loss(self, off: Float[np.ndarray, "samples 9"]) -> float:
        """The mean distance of positions, as in training; its square would be that of the few worst."""
        return float(np.mean(np.linalg.norm(off[:, :3], axis=1)))

    def roll_out(
        self, features: Float[Tensor, "batch inputs"], first: Float[Tensor, "batch 9"]
    ) -> Float[Tensor, "batch time 9"]:
        """Whole motions from the view and the centre of mass at rest: the mean over members and mirror images."""
        com = self._metres(first[:, None, :3])
        views = self._see(features, com[:, 0])
        said = self._say(features, views, torch.arange(self.num_samples, device=first.device))
        said = said.unflatten(1, (len(views), len(first)))  # (members, views, batch, time, 6)
        axes = torch.stack([view.axes for view in views])[:, :, None]  # (views, batch, 1, 3, 3)
        displaced = (said[..., None, :3] @ axes)[..., 0, :].mean(dim=(0, 1))
        rotation = (axes.mT @ rotation_matrix(said[..., 3:] / TURN_LENGTH) @ axes).mean(dim=(0, 1))
        columns = rotation[..., :2].transpose(-1, -2).flatten(-2)
        return (torch.cat([com + displaced, columns], dim=-1) - self.state_mean) / self.state_scale

    def _metres(self, positions: Float[Tensor, "batch time 3"]) -> Float[Tensor, "batch time 3"]:
        return positions * self.state_scale[:3] + self.state_mean[:3]

    def _see(self, features: Float[Tensor, "batch inputs"], com: Float[Tensor, "batch 3"]) -> list[_View]:
        """The lever-ups, and their mirror images about the action axis."""
        corners = features[:, : self.features.num_features].unflatten(1, (-1, 2)) * UNIT
        mirror = com.new_tensor([1.0, -1.0, 1.0])
        seen, mirrored = find_hinges(corners, com), find_hinges(mirror_corners(corners), com * mirror)
        return [_View(seen.values, seen.axes), _View(mirrored.values, mirrored.axes * mirror)]

    def _motion(
        self, states: Float[Tensor, "batch time 9"], com: Float[Tensor, "batch 1 3"], view: _View
    ) -> Float[Tensor, "batch time 6"]:
        """States as displacements and turns along the axes of a view [m]."""
        columns = (states[..., 3:] * self.state_scale[3:] + self.state_mean[3:]).unflatten(-1, (2, 3))
        rotation = torch.stack([*columns.unbind(-2), torch.linalg.cross(*columns.unbind(-2))], dim=-1)
        axes = view.axes[:, None]
        displaced = (axes @ (self._metres(states[..., :3]) - com)[..., None])[..., 0]
        return torch.cat([displaced, TURN_LENGTH * rotation_vector(axes @ rotation @ axes.mT)], dim=-1)

    def _say(
        self, features: Float[Tensor, "batch inputs"], views: list[_View], time: Int[Tensor, " time"]
    ) -> Float[Tensor, "members seen time 6"]:
        """Every member's answer to every view, one view after the other, at the given samples [m]."""
        values = (torch.cat([view.values for view in views]) - self.value_mean) / self.value_scale
        known = features[:, self.features.num_features :].repeat(len(views), 1)
        rows = torch.cat([values, known], dim=1).expand(self.settings.members, -1, -1)
        motions = self.motions[:, time]
        said = self.networks(rows) @ motions.flatten(1)
        return said.unflatten(-1, motions.shape[1:]) + self.mean_motion[time]


def rotation_vector(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis times angle [rad] of rotation matrices; near half a turn the axis loses its digits."""
    twice = torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        dim=-1,
    )
    sine = twice.norm(dim=-1, keepdim=True)
    cosine = rotation.diagonal(dim1=-2, dim2=-1).sum(dim=-1, keepdim=True) - 1
    return twice * torch.where(sine > 1e-6, torch.atan2(sine, cosine) / sine.clamp(min=1e-6), 0.5)


def rotation_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of axes times angles [rad] (Rodrigues)."""
    angle = vector.norm(dim=-1)[..., None, None]
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    sine, versine = torch.sinc(angle / torch.pi), torch.sinc(angle / (2 * torch.pi)) ** 2 / 2
    return torch.eye(3, device=vector.device) + sine * skew + versine * skew @ skew
