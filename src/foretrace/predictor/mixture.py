"""The distribution over motions that the networks of the direct trajectory predictor parametrise."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from foretrace.predictor.phase_time import Warp

COORDINATES = 6
"""Numbers of a motion per sample: displacement of the centre of mass, rotation vector, along an edge's axes [m]."""
TURN_LENGTH = 0.05
"""Displacement that weighs as much as a turn by 1 rad [m]: about the distance from edge to centre of mass."""


@dataclass(frozen=True)
class Mixture:
    """Gaussian distributions of weights in a PCA basis of trajectories, one for each pivot edge and outcome."""

    com: Float[Tensor, "batch 3"]
    """Centres of mass at rest in the action frame [m]."""
    axes: Float[Tensor, "batch edges 3 3"]
    """Rows: the edges' axes in the action frame."""
    ends: Float[Tensor, "batch edges 2 2"]
    """Ends of the edges [m]."""
    log_probability: Float[Tensor, "batch edges outcomes"]
    """Logarithms of the futures' probabilities."""
    mean: Float[Tensor, "batch edges outcomes components"]
    """Expected weights."""
    error: Float[Tensor, "batch edges outcomes"]
    """Predicted scale of the error."""
    covariance: Float[Tensor, "outcomes components components"]
    """Covariance of the weights at an error scale of 1."""
    components: Float[Tensor, "components time 6"]
    """PCA basis of trajectories along an edge's axes [m]; turns times ``TURN_LENGTH``."""
    mean_motion: Float[Tensor, "time 6"]
    """Mean trajectory, which they are added to."""
    warp: Warp | None = None
    """Where the trajectories' samples lie in those of the basis, the same for all or for each; None: they are those."""

    def most_probable(self) -> Float[Tensor, "batch time 6"]:
        """Positions [m] and rotation vectors [rad] of the most probable future of each."""
        rows = torch.arange(len(self.com), device=self.com.device)
        best = self.log_probability.flatten(1).argmax(dim=1)
        weights, axes = (
            self.mean.flatten(1, 2)[rows, best],
            self.axes[rows, best // self.log_probability.shape[2]],
        )
        return self._states(weights[:, None, None], axes[:, None])[:, 0]

    def states(self) -> Float[Tensor, "batch futures time 6"]:
        """Positions [m] and rotation vectors [rad] of all futures."""
        return self._states(self.mean, self.axes)

    def sample(self, num: int, generator: torch.Generator | None = None) -> Float[Tensor, "batch num time 6"]:
        """Positions [m] and rotation vectors [rad] drawn at random."""
        rows = torch.arange(len(self.com), device=self.com.device)[:, None]
        chosen = torch.multinomial(
            self.log_probability.flatten(1).exp(), num, replacement=True, generator=generator
        )
        z = torch.randn(*chosen.shape, self.mean.shape[-1], generator=generator, device=self.mean.device)
        root, error = torch.linalg.cholesky(self.covariance), self.error.flatten(1)[rows, chosen]
        off = error[..., None] * (root[chosen % len(root)] @ z[..., None])[..., 0]
        weights = self.mean.flatten(1, 2)[rows, chosen] + off
        return self._states(weights[:, :, None], self.axes[rows, chosen // self.log_probability.shape[2]])

    def spread(self) -> Float[Tensor, "batch futures time"]:
        """Root mean square of the distance from each future's positions [m]."""
        displaced = self.components[..., :3].permute(1, 2, 0).flatten(0, 1)  # (time 3, components)
        variance = ((displaced @ self.covariance) * displaced).sum(dim=-1)
        at_error_1 = variance.unflatten(-1, (-1, 3)).sum(dim=-1).sqrt()[None]  # (1, outcomes, time)
        if self.warp is not None:
            rows = self.warp.before.shape[0]
            at_error_1 = self.warp.read(at_error_1[..., None].expand(rows, -1, -1, 1))[..., 0]
        return (self.error[..., None] * at_error_1[:, None]).flatten(1, 2)

    def _states(
        self,
        weights: Float[Tensor, "batch edges futures components"],
        axes: Float[Tensor, "batch edges 3 3"],
    ) -> Float[Tensor, "batch edges*futures time 6"]:
        shape = (*weights.shape[:3], 2, 3)  # displacements and turns
        components, mean, warp = self.components, self.mean_motion, self.warp
        if warp is not None and warp.before.shape[0] == 1:  # the same for all: the basis is read once
            components, mean, warp = warp.read(components[None])[0], warp.read(mean[None])[0], None
        motion = torch.addmm(mean.mT.flatten(), weights.flatten(0, 2), components.mT.flatten(1))
        back = torch.stack([axes, axes / TURN_LENGTH], dim=2).mT[:, :, None].expand(*shape, 3)
        rest = F.pad(self.com, (0, 3)).unflatten(1, (2, 3))[:, None, None].expand(shape)
        # One product with time last: memory is gone through once, in long rows.
        states = torch.baddbmm(
            rest.flatten(0, 3)[..., None], back.flatten(0, 3), motion.unflatten(1, (2, 3, -1)).flatten(0, 1)
        )
        states = states.unflatten(0, shape[:4]).flatten(1, 2).flatten(2, 3).mT
        return states if warp is None else warp.read(states)


def along_edges(
    axes: Float[Tensor, "batch *edges 3 3"], motion: Float[Tensor, "batch time 6"]
) -> Float[Tensor, "batch *edges time 6"]:
    """Displacements and turns in the action frame along edges' axes.

    A turn seen along left-handed axes, those of a mirror image, goes the other way round.
    """
    extra = (1,) * (axes.dim() - 3)
    moved, turned = (
        part.view(len(part), *extra, *part.shape[1:]) @ axes.mT for part in motion.split(3, dim=-1)
    )
    return torch.cat([moved, torch.linalg.det(axes)[..., None, None] * turned], dim=-1)
