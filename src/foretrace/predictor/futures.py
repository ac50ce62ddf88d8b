"""What may happen: several futures, each with its probability and how far the motion may be from it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from foretrace.predictor.states import decode_poses

LEVELS = np.arange(1, 100) / 100
"""Probabilities of the regions whose widths a predictor keeps."""
MIN_PROBABILITY = 0.05
"""A future less probable than this belongs to no region, unless it is the most probable one."""
FLOOR = 1e-4
"""Nobody is surer of a position than this [m]: what half the time step changes in simulation is a fifth of it."""
NOISE = 5e-4
"""What an observed position may be off [m]; also what principal motions leave out."""
FREEDOM = 4.0
"""Degrees of freedom of the Student distribution of errors: the fewer, the heavier its tails."""
DOUBT = 2.0
"""A future loses probability where the beginning is farther from it than so many times what was expected."""
COORDINATES = 6
"""A motion's numbers per sample: displacement of the centre of mass, rotation vector, along a hinge's axes [m]."""
TURN_LENGTH = 0.05
"""A turn by 1 rad weighs as much as a displacement by this [m]: about the distance from hinge to centre of mass."""


@dataclass(frozen=True)
class Futures:
    """What may happen in interactions: whole motions that exclude each other."""

    probability: Float[np.ndarray, "batch futures"]
    """Of each; they sum up to 1."""
    outcome: tuple[str, ...]
    """What becomes of the object in each."""
    states: Float[np.ndarray, "batch futures time 6"]
    """Positions of the centre of mass in the action frame [m] and rotation vectors since rest [rad]."""
    spread: Float[np.ndarray, "batch futures time"]
    """Expected distance of the centre of mass from it (root mean square) [m]."""
    support_points: Float[np.ndarray, "batch futures 2 2"]
    """Ends of the edge that the object turns about, in the action frame at rest [m]."""
    quantiles: Float[np.ndarray, " levels"]
    """How many spreads away from the nearest future whole motions stayed in the validation part, by `LEVELS`."""

    def __len__(self) -> int:
        return len(self.probability)

    def __getitem__(self, rows: slice | np.ndarray) -> "Futures":
        names = ("probability", "states", "spread", "support_points")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @property
    def com(self) -> Float[np.ndarray, "batch futures time 3"]:
        """Centres of mass in the action frame [m]."""
        return self.states[..., :3]

    @cached_property
    def pose(self) -> Float[np.ndarray, "batch futures time 7"]:
        """As ``ImaginedEffect.pose_trajectory``; worked out when it is asked for."""
        return decode_poses(self.states)

    @property
    def counted(self) -> np.ndarray:
        """(batch, futures) bool: which futures are probable enough to belong to regions."""
        best = self.probability.max(axis=1, keepdims=True)
        return self.probability >= np.minimum(best, MIN_PROBABILITY)

    def radius(self, level: float) -> Float[np.ndarray, "batch futures time"]:
        """Radii of tubes [m] about those futures that count: whole motions stay in one of them with that probability.

        NaN for a future that does not count; infinite where the validation part was too small to tell.

        Raises:
            ValueError: The level is not between 0.01 and 0.99.
        """
        if not LEVELS[0] <= level <= LEVELS[-1]:
            raise ValueError(f"level {level} of a region: choose one from {LEVELS[0]} to {LEVELS[-1]}")
        wide = float(np.interp(level, LEVELS, self.quantiles))
        return np.where(self.counted[..., None], wide * (self.spread + FLOOR), np.nan)

    def outcomes(self) -> dict[str, Float[np.ndarray, " batch"]]:
        """Probability of each outcome."""
        names = dict.fromkeys(self.outcome)
        mine = np.array(self.outcome)
        return {name: self.probability[:, mine == name].sum(axis=1) for name in names}


def conformal_scores(
    futures: Futures, com: Float[np.ndarray, "batch time 3"], lengths: np.ndarray
) -> Float[np.ndarray, " batch"]:
    """How many spreads motions were away, where they were furthest, from the future that they followed best.

    A region of all motions with at most some score is a union of tubes about futures.

    Args:
        futures: What was expected.
        com: What happened [m].
        lengths: Samples of each that count.
    """
    apart = np.linalg.norm(futures.com - com[:, None], axis=-1) / (futures.spread + FLOOR)
    valid = np.arange(com.shape[1]) < lengths[:, None]
    furthest = np.where(valid[:, None], apart, 0.0).max(axis=2)
    return np.where(futures.counted, furthest, np.inf).min(axis=1)


def quantiles_of(scores: Float[np.ndarray, " n"]) -> Float[np.ndarray, " levels"]:
    """Scores that further ones exceed with probabilities of 1 less `LEVELS` at most (split-conformal prediction).

    Vovk et al., 2005, "Algorithmic learning in a random world": exact for scores that could come in any order.
    """
    known = np.append(np.sort(scores), np.inf)
    return known[np.minimum(np.ceil(LEVELS * len(known)).astype(int) - 1, len(scores))]


@dataclass(frozen=True)
class Mixture:
    """Gaussian distributions of the weights of principal motions, one for each hinge and outcome."""

    com: Float[Tensor, "batch 3"]
    """Centres of mass at rest in the action frame [m]."""
    axes: Float[Tensor, "batch hinges 3 3"]
    """Rows: the hinges' axes in the action frame."""
    ends: Float[Tensor, "batch hinges 2 2"]
    """Ends of the hinges [m]."""
    odds: Float[Tensor, "batch hinges outcomes"]
    """Logarithms of probabilities."""
    mean: Float[Tensor, "batch hinges outcomes motions"]
    """Expected weights."""
    error: Float[Tensor, "batch hinges outcomes"]
    """How large errors are expected to be."""
    root: Float[Tensor, "#batch #hinges outcomes motions motions"]
    """Square roots of the covariances of weights, for errors of 1; the same for all until something is observed."""
    motions: Float[Tensor, "motions time 6"]
    """Principal motions along a hinge's axes [m]; turns times ``TURN_LENGTH``."""
    mean_motion: Float[Tensor, "time 6"]
    """What they are added to."""
    observed: Float[Tensor, "batch samples 6"]
    """Positions [m] and rotation vectors [rad] that were observed."""

    def given(self, observed: Float[Tensor, "batch samples 6"]) -> "Mixture":
        """The mixture after the first samples were observed.

        Conditional multivariate Student distributions (Roth, 2013, "On the multivariate t distribution"), of which
        those lose probability that the beginning does not fit. Regions that
        were measured before anything was observed hold only roughly for what is given here.

        Args:
            observed: Positions in the action frame [m] and rotation vectors since rest [rad].
        """
        k = observed.shape[1]
        motion = torch.cat([observed[..., :3] - self.com[:, None], TURN_LENGTH * observed[..., 3:]], dim=-1)
        seen = along_hinges(self.axes, motion)  # (batch, hinges, samples, 6)
        # What is known exactly and what is hardly known lie orders of magnitude apart: too many for float32.
        basis, factor = self.motions[:, :k].flatten(1).double(), self._factor().double()
        off = (seen - self.mean_motion[:k]).double().flatten(2)[:, :, None] - self.mean.double() @ basis
        # Of unit weights z, of which the motion is a linear image.
        image = factor.mT @ basis / NOISE
        off = off[..., None] / NOISE
        precision = image @ image.mT + torch.eye(image.shape[-2], dtype=image.dtype, device=image.device)
        root = torch.linalg.cholesky(precision)
        pull = image @ off
        z = torch.cholesky_solve(pull, root)
        # Errors are Student distributed: an odd beginning makes what follows less sure, not another future certain.
        # Samples tell weights apart from noise in so many dimensions:
        size = len(basis) - torch.cholesky_inverse(root).diagonal(dim1=-2, dim2=-1).sum(dim=-1)
        distance = off.square().sum(dim=(-2, -1)) - (pull * z).sum(dim=(-2, -1))
        # Bayes' rule would name the future that is narrowest about the beginning. That is a lift, until an object
        # slips: slips differ from each other. So a beginning speaks only against futures that it is far from.
        beyond = (distance / DOUBT**2 - size).clamp(min=0) / (FREEDOM + size)
        evidence = -(FREEDOM + size) / 2 * torch.log1p(beyond)
        wider = ((FREEDOM + distance) / (FREEDOM + size)).sqrt()
        odds = (self.odds + evidence.to(self.odds)).flatten(1).log_softmax(dim=1).view_as(self.odds)
        mean = self.mean + (factor @ z)[..., 0].to(self.mean)
        unit = torch.eye(len(basis), dtype=root.dtype, device=root.device).expand_as(root)
        inverse = torch.linalg.solve_triangular(root, unit, upper=False) * wider[..., None, None]
        # (factor inverse^T) (factor inverse^T)^T is the covariance; any square root of it will do.
        root = (factor @ inverse.mT).to(self.root)
        return replace(self, odds=odds, mean=mean, error=torch.ones_like(odds), root=root, observed=observed)

    def most_probable(self) -> Float[Tensor, "batch time 6"]:
        """Positions [m] and rotation vectors [rad] of the most probable future of each."""
        rows = torch.arange(len(self.com), device=self.com.device)
        best = self.odds.flatten(1).argmax(dim=1)
        weights, axes = self.mean.flatten(1, 2)[rows, best], self.axes[rows, best // self.odds.shape[2]]
        return self._states(weights[:, None, None], axes[:, None])[:, 0]

    def states(self) -> Float[Tensor, "batch futures time 6"]:
        """Positions [m] and rotation vectors [rad] of all futures."""
        return self._states(self.mean, self.axes)

    def sample(self, num: int, generator: torch.Generator | None = None) -> Float[Tensor, "batch num time 6"]:
        """Positions [m] and rotation vectors [rad] drawn at random."""
        rows = torch.arange(len(self.com), device=self.com.device)[:, None]
        chosen = torch.multinomial(self.odds.flatten(1).exp(), num, replacement=True, generator=generator)
        z = torch.randn(*chosen.shape, self.mean.shape[-1], generator=generator, device=self.mean.device)
        factor = self._factor().flatten(1, 2)[rows, chosen]
        weights = self.mean.flatten(1, 2)[rows, chosen] + (factor @ z[..., None].to(factor))[..., 0]
        return self._states(weights[:, :, None], self.axes[rows, chosen // self.odds.shape[2]])

    def spread(self) -> Float[Tensor, "batch futures time"]:
        """Root mean square of the distance from each future's positions [m]."""
        displaced = self.motions[..., :3].permute(1, 2, 0).flatten(0, 1)  # (time 3, motions)
        images = (displaced @ self.root).unflatten(-2, (-1, 3)).flatten(-2)
        return (self.error[..., None] * images.norm(dim=-1)).flatten(1, 2)

    def _factor(self) -> Float[Tensor, "batch hinges outcomes motions motions"]:
        return self.error[..., None, None] * self.root

    def _states(
        self,
        weights: Float[Tensor, "batch hinges futures motions"],
        axes: Float[Tensor, "batch hinges 3 3"],
    ) -> Float[Tensor, "batch hinges*futures time 6"]:
        shape = (*weights.shape[:3], 2, 3)  # displacements and turns
        motion = torch.addmm(self.mean_motion.mT.flatten(), weights.flatten(0, 2), self.motions.mT.flatten(1))
        back = torch.stack([axes, axes / TURN_LENGTH], dim=2).mT[:, :, None].expand(*shape, 3)
        rest = F.pad(self.com, (0, 3)).unflatten(1, (2, 3))[:, None, None].expand(shape)
        # One product with time last: memory is gone through once, in long rows.
        states = torch.baddbmm(
            rest.flatten(0, 3)[..., None], back.flatten(0, 3), motion.unflatten(1, (2, 3, -1)).flatten(0, 1)
        )
        states = states.unflatten(0, shape[:4]).flatten(1, 2).flatten(2, 3).mT
        if not (k := self.observed.shape[1]):
            return states
        seen = self.observed[:, None].expand(-1, states.shape[1], -1, -1)
        return torch.cat([seen, states[:, :, k:]], dim=2)


def along_hinges(
    axes: Float[Tensor, "batch *hinges 3 3"], motion: Float[Tensor, "batch time 6"]
) -> Float[Tensor, "batch *hinges time 6"]:
    """Displacements and turns in the action frame along hinges' axes.

    A turn seen along left-handed axes, those of a mirror image, goes the other way round.
    """
    extra = (1,) * (axes.dim() - 3)
    moved, turned = (
        part.view(len(part), *extra, *part.shape[1:]) @ axes.mT for part in motion.split(3, dim=-1)
    )
    return torch.cat([moved, torch.linalg.det(axes)[..., None, None] * turned], dim=-1)


def no_observations(com: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 0 6"]:
    """What was observed when nothing was."""
    return com.new_zeros(com.shape[0], 0, COORDINATES)  # not len(com): an export takes that for a constant
