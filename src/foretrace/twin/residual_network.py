"""The network of a residual: from a twin's motion to the difference from the real one."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foretrace.errors import TrainingError, check_ranges, is_whole, shown
from foretrace.features.pivot_edges import NUM_VALUES
from foretrace.imagined import LEVELS
from foretrace.predictor.ensemble import Ensemble
from foretrace.predictor.mixture import COORDINATES, along_edges
from foretrace.predictor.trajectory_basis import find_basis

SAME = 0.01
"""An input that varies by less counts as constant, and is only shifted."""
FARTHEST = 3.0
"""Inputs further from the training part's mean than this are taken to be there [standard deviations]."""
TURN_WEIGHT = 0.5
"""Weight of the turn in the loss, beside 1 for the displacement."""
SCALE_WEIGHT = 0.02
"""Weight of the predicted error scale's own loss."""
LARGEST_ERROR = 3.0
"""Logarithm of the largest predicted error scale, in units of the residual's."""
TOLD = 2
"""Further inputs: whether the twin turns about the second candidate edge, and whether its object stays on the blade."""


@dataclass(frozen=True, kw_only=True)
class ResidualConfig:
    """Settings of a residual and of its training.

    Raises:
        TrainingError: A value is out of its range.
    """

    hidden: int = 128
    """Units of each hidden layer."""
    layers: int = 3
    """Hidden layers."""
    ensemble: int = 5
    """Networks that learn side by side and are averaged."""
    components: int = 24
    """Components of the PCA basis of residuals, at most."""
    seen: int = 12
    """Components of the PCA basis of the twin's motions that the networks are given."""
    epochs: int = 120
    """Passes over the training part."""
    min_steps: int = 300
    """Optimiser steps, at least."""
    batch_size: int = 32
    """Actions per optimiser step."""
    learning_rate: float = 4e-3
    """Adam's largest learning rate; it rises for a tenth of the steps and falls to 0 along a cosine."""
    weight_decay: float = 0.1
    """Decay of the weights, times the learning rate and step."""
    seed: int = 0
    """Seed of the first weights and of the order."""

    def __post_init__(self) -> None:
        limits = {
            "hidden": 4096, "layers": 32, "ensemble": 100, "components": 1024, "seen": 1024,
            "epochs": 1_000_000, "min_steps": 1_000_000, "batch_size": 1_000_000,
        }  # fmt: skip
        for name, most in limits.items():
            if not is_whole(value := getattr(self, name), 1, most):
                raise TrainingError(f"{name} is {shown(value)}: give a whole number from 1 to {most}")
        if not is_whole(self.seed, 0, 2**63 - 1):
            raise TrainingError(f"seed is {shown(self.seed)}: give a whole number from 0 on")
        check_ranges(
            TrainingError, "residual", self, {"learning_rate": (1e-9, 1.0), "weight_decay": (0.0, 100.0)}
        )


@dataclass(frozen=True, eq=False)
class Priors:
    """Motions of twins, and what the residual is told about each, one row for each future."""

    motion: Float[Tensor, "batch time 6"]
    """Displacement of the centre of mass in the action frame [m], and rotation vector times ``TURN_LENGTH``."""
    values: Float[Tensor, "batch views inputs"]
    """The action relative to the edge that the twin turns about; and its mirror image."""
    axes: Float[Tensor, "batch views 3 3"]
    """Rows: the edge's axes in the action frame."""

    def __len__(self) -> int:
        return len(self.motion)

    def __getitem__(self, rows: Tensor) -> "Priors":
        return Priors(self.motion[rows], self.values[rows], self.axes[rows])


class ResidualNetwork(nn.Module):
    """From a twin's motion to the difference from the real one, in the frame of the edge that the twin turns about.

    Args:
        config: Settings.
        num_samples: Samples of a motion.
    """

    input_mean: Tensor
    input_scale: Tensor
    prior_mean: Tensor
    prior_basis: Tensor
    mean: Tensor
    basis: Tensor
    parity: Tensor
    profile: Tensor
    quantiles: Tensor

    def __init__(self, config: ResidualConfig, num_samples: int):
        super().__init__()
        inputs = NUM_VALUES + TOLD + config.seen
        widths = (inputs, *(config.hidden,) * config.layers, config.components + 1)
        self.networks = Ensemble(config.ensemble, widths)
        self.register_buffer("input_mean", torch.zeros(inputs))
        self.register_buffer("input_scale", torch.ones(inputs))
        self.register_buffer("prior_mean", torch.zeros(num_samples, COORDINATES))
        self.register_buffer("prior_basis", torch.zeros(config.seen, num_samples, COORDINATES))
        self.register_buffer("mean", torch.zeros(num_samples, COORDINATES))
        self.register_buffer("basis", torch.zeros(config.components, num_samples, COORDINATES))
        self.register_buffer("parity", torch.ones(config.components))
        self.register_buffer(
            "profile", torch.zeros(num_samples)
        )  # error by sample at an error scale of 1 [m]
        self.register_buffer("quantiles", torch.full((len(LEVELS),), torch.nan))

    def prepare(self, priors: Priors, residual: Float[Tensor, "batch time 6"]) -> None:
        """Find the bases of the twin's motions and of residuals, and the scale of the inputs.

        Args:
            priors: The training part.
            residual: Real motions minus those of the twin, in the action frame [m].
        """
        axes = priors.axes[:, 0]
        for motion, mean, basis, parity in (
            (priors.motion, self.prior_mean, self.prior_basis, None),
            (residual, self.mean, self.basis, self.parity),
        ):
            centre, components, signs = find_basis(along_edges(axes, motion), len(basis))
            mean.copy_(centre)
            basis[: len(components)] = components
            if parity is not None:
                parity[: len(signs)] = signs
        inputs = self._inputs(priors).flatten(0, 1)
        scale = inputs.std(dim=0, correction=0)
        self.input_mean.copy_(inputs.mean(dim=0))
        self.input_scale.copy_(torch.where(scale < SAME, 1.0, scale))

    def outputs(
        self, priors: Priors
    ) -> tuple[Float[Tensor, "ensemble batch views components"], Float[Tensor, "ensemble batch views"]]:
        """Weights of residuals in their basis, and logarithms of the error's scale."""
        inputs = self._inputs(priors)
        inputs = ((inputs - self.input_mean) / self.input_scale).clamp(-FARTHEST, FARTHEST)
        rows = inputs.flatten(0, 1).expand(self.networks.size, -1, -1)
        found = self.networks(rows).unflatten(1, inputs.shape[:2])
        return found[..., :-1], found[..., -1]

    def loss(self, priors: Priors, residual: Tensor, valid: Float[Tensor, "batch time"]) -> Float[Tensor, ""]:
        """Mean distance of motions, in units of the residuals', and that of its predicted scale."""
        weights, scale = self.outputs(priors)
        truth = along_edges(priors.axes, residual)  # (batch, views, time, 6)
        moved = (weights @ self.basis.flatten(1)).unflatten(-1, self.mean.shape) + self.mean
        apart = (moved - truth).unflatten(-1, (2, 3)).square().sum(dim=-1).add(1e-12).sqrt()
        apart = apart @ apart.new_tensor([1.0, TURN_WEIGHT])
        error = (apart * valid[:, None]).sum(dim=-1) / valid.sum(dim=-1).clamp(min=1)[:, None] / self._unit
        told = (scale + error.detach().clamp(min=1e-6) * torch.exp(-scale)).mean()
        return error.mean() + SCALE_WEIGHT * told

    def forward(self, priors: Priors) -> tuple[Float[Tensor, "batch time 6"], Float[Tensor, " batch"]]:
        """Residuals in the action frame [m], and the scale of their error in units of ``profile``."""
        weights, scale = self.outputs(priors)
        signs = torch.stack([torch.ones_like(self.parity), self.parity])
        mean = (weights * signs).mean(dim=(0, 2))
        moved = (mean @ self.basis.flatten(1)).unflatten(-1, self.mean.shape) + self.mean
        back = along_edges(priors.axes[:, 0].mT, moved)
        back[:, 0] = 0.0  # the start is known
        return back, scale.mean(dim=(0, 2)).clamp(-LARGEST_ERROR, LARGEST_ERROR).exp()

    @property
    def _unit(self) -> Tensor:
        """Size of residuals [m]."""
        return (
            self.basis[..., :3].square().sum(dim=(0, 2)) + self.mean[:, :3].square().sum(dim=1)
        ).mean().sqrt() + 1e-5

    def _inputs(self, priors: Priors) -> Float[Tensor, "batch views inputs"]:
        """What the networks are given, not yet standardised."""
        seen = along_edges(priors.axes, priors.motion) - self.prior_mean
        sizes = self.prior_basis.flatten(1).square().sum(dim=1).clamp(min=1e-12)
        weights = seen.flatten(2) @ self.prior_basis.flatten(1).mT / sizes
        return torch.cat([priors.values, weights], dim=-1)
