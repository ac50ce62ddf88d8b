"""What an imaginer returns: the expected effect, and all futures with their probabilities and regions."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from foretrace.geometry import rotation_vector_to_quaternion
from foretrace.interactions.record import Outcome

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
        return np.concatenate(
            [self.states[..., :3], rotation_vector_to_quaternion(self.states[..., 3:])], axis=-1
        )

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
class ImaginedEffect:
    """The effect that a predictor expects of one action."""

    times: Float[np.ndarray, " time"]
    """Time of each sample [s], from the moment before the blade touches the object."""
    com_trajectory: Float[np.ndarray, "time 3"]
    """Centre of mass in the action frame [m]; the first row is the start that was given or estimated."""
    pose_trajectory: Float[np.ndarray, "time 7"] | None = None
    """Position of the centre of mass [m] and quaternion (w, x, y, z) of the rotation since rest, about the
    action frame's axes: the identity at first. None if the predictor knows positions only."""
    futures: Futures | None = None
    """All that may happen, one row; the trajectories above are those of the most probable. None if the predictor
    tells of one future only."""
    warnings: tuple[str, ...] = ()
    """In what the object is unlike those that the predictor has learned from, as far as it knows."""


@dataclass(frozen=True)
class ImaginedBatch:
    """The effects that a predictor expects of many actions."""

    times: Float[np.ndarray, " time"]
    """Time of each sample [s], common to all."""
    com: Float[np.ndarray, "batch time 3"]
    """Centres of mass in the action frame [m]."""
    pose: Float[np.ndarray, "batch time 7"] | None = None
    """As ``ImaginedEffect.pose_trajectory``, one per interaction."""
    futures: Futures | None = None
    """As ``ImaginedEffect.futures``, one row per interaction."""
    warnings: tuple[tuple[str, ...], ...] = ()
    """As ``ImaginedEffect.warnings``, one per interaction; or none at all, where nobody looked."""

    def __len__(self) -> int:
        return len(self.com)

    def __getitem__(self, index: int) -> ImaginedEffect:
        pose = None if self.pose is None else self.pose[index]
        futures = None if self.futures is None else self.futures[np.array([index])]
        warnings = self.warnings[index] if self.warnings else ()
        return ImaginedEffect(self.times, self.com[index], pose, futures, warnings)
