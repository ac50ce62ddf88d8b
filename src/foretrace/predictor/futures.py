"""What may happen: several futures, each with its probability and how far the motion may be from it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from foretrace.interactions.record import Outcome
from foretrace.predictor.states import decode_poses

LEVELS = np.arange(1, 100) / 100
"""Probabilities of the regions whose widths a predictor keeps."""
MIN_PROBABILITY = 0.05
"""A future less probable than this belongs to no region, unless it is the most probable one."""
FLOOR = 1e-4
"""Nobody is surer of a position than this [m]: what half the time step changes in simulation is a fifth of it."""
STEADY = 2
"""An observed motion is compared with a future by the mean of its last so many samples: they are noisy."""
DRIFT_SAMPLES = 10
"""Over so many samples before, the distance from a future should not have changed."""
DRIFT = 2e-3
"""A change by this makes a future half as probable [m]."""
FORGET_TIME = 0.3
"""An object that falls forgets within this time that it was not where it was expected [s]; it lands on the table."""
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

    def given(self, observed: Float[np.ndarray, "batch samples 6"], sample_period: float) -> "Futures":
        """What may happen after the first samples were observed.

        An object that is not where it was expected, since the blade met it elsewhere, say, keeps that distance: all
        that follows is moved and turned by it. What follows a slip forgets it, as it ends on the table. A future from
        which the distance changes becomes less probable. Expected distances grow from the last observed sample on, as
        those of a random walk, and more so the further that sample is off. Regions hold only roughly from then on.

        Args:
            observed: Positions in the action frame [m] and rotation vectors since rest [rad], from the start.
            sample_period: Seconds between samples.
        """
        k = observed.shape[1]
        off = observed[:, None] - self.states[:, :, :k]  # (batch, futures, k, 6)
        steady = off[:, :, -STEADY:].mean(axis=2, keepdims=True)
        drift = np.square(off - steady)[:, :, -DRIFT_SAMPLES:, :3].sum(axis=3).mean(axis=2)
        odds = np.log(np.maximum(self.probability, 1e-30)) - np.log1p(drift / DRIFT**2)
        odds = np.exp(odds - odds.max(axis=1, keepdims=True))
        since = sample_period * np.arange(1, self.states.shape[2] - k + 1)
        falls = np.array([name == Outcome.SLIPPED for name in self.outcome])
        kept = np.where(falls[:, None], np.exp(-since / FORGET_TIME), 1.0)[..., None]
        seen = np.broadcast_to(observed[:, None], off.shape)
        states = np.concatenate([seen, self.states[:, :, k:] + kept * steady], axis=2)
        last = self.spread[:, :, k - 1 : k]
        beyond = np.linalg.norm(steady[..., :3], axis=3) / (last + FLOOR)
        rest = np.sqrt(np.maximum(self.spread[:, :, k:] ** 2 - last**2, 0.0)) * np.maximum(beyond, 1.0)
        return replace(
            self,
            probability=odds / odds.sum(axis=1, keepdims=True),
            states=states,
            spread=np.concatenate([np.zeros_like(self.spread[:, :, :k]), rest], axis=2),
        )

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
    covariance: Float[Tensor, "outcomes motions motions"]
    """Of weights, for errors of 1."""
    motions: Float[Tensor, "motions time 6"]
    """Principal motions along a hinge's axes [m]; turns times ``TURN_LENGTH``."""
    mean_motion: Float[Tensor, "time 6"]
    """What they are added to."""

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
        root, error = torch.linalg.cholesky(self.covariance), self.error.flatten(1)[rows, chosen]
        off = error[..., None] * (root[chosen % len(root)] @ z[..., None])[..., 0]
        weights = self.mean.flatten(1, 2)[rows, chosen] + off
        return self._states(weights[:, :, None], self.axes[rows, chosen // self.odds.shape[2]])

    def spread(self) -> Float[Tensor, "batch futures time"]:
        """Root mean square of the distance from each future's positions [m]."""
        displaced = self.motions[..., :3].permute(1, 2, 0).flatten(0, 1)  # (time 3, motions)
        variance = ((displaced @ self.covariance) * displaced).sum(dim=-1)
        at_error_1 = variance.unflatten(-1, (-1, 3)).sum(dim=-1).sqrt()  # (outcomes, time)
        return (self.error[..., None] * at_error_1).flatten(1, 2)

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
        return states.unflatten(0, shape[:4]).flatten(1, 2).flatten(2, 3).mT


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
