"""What an imaginer returns: the expected effect, and all futures with their probabilities and regions."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from foretrace.errors import PredictionError
from foretrace.geometry import (
    matrix_to_pose,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from foretrace.imagined.context import CONSTANTS, nominal_constants
from foretrace.interactions.record import Outcome

if TYPE_CHECKING:
    from foretrace.imagined.worlds import Worlds

LEVELS = np.arange(1, 100) / 100
"""Levels of the prediction regions whose widths a predictor keeps."""
MIN_PROBABILITY = 0.05
"""A future less probable than this belongs to no region, unless it is the most probable one."""
FLOOR = 1e-4
"""Least uncertainty of a position [m]: halving the simulation's time step changes a fifth of it."""
STEADY = 2
"""Number of the last observed samples whose mean is compared with a future: single ones are noisy."""
DRIFT_SAMPLES = 10
"""Number of samples over which the distance from a future should stay the same."""
DRIFT = 2e-3
"""Change of that distance that makes a future half as probable [m]."""
FORGET_TIME = 0.3
"""Time constant in which a falling object loses its offset from the expected position [s]: it lands on the table."""


@dataclass(frozen=True)
class Futures:
    """Motions that may happen in interactions, which exclude each other."""

    probability: Float[np.ndarray, "batch futures"]
    """Probability of each; they sum up to 1."""
    outcome: tuple[str, ...]
    """Outcome of each."""
    states: Float[np.ndarray, "batch futures time 6"]
    """Positions of the centre of mass in the action frame [m] and rotation vectors since rest [rad]; the latter are
    NaN where only positions are predicted."""
    spread: Float[np.ndarray, "batch futures time"]
    """Expected distance of the centre of mass from it (root mean square) [m]; NaN: unknown."""
    support_points: Float[np.ndarray, "batch futures 2 2"]
    """Ends of the edge that the object turns about, in the action frame at rest [m]; NaN: unknown."""
    quantiles: Float[np.ndarray, "*batch levels"]
    """Distance from the nearest future, in spreads, within which whole motions of the validation part stayed, by
    `LEVELS`; NaN: unknown. One row for each interaction, or one for all."""

    @classmethod
    def point(
        cls,
        com: Float[np.ndarray, "batch time 3"],
        turned: Float[np.ndarray, "batch time 3"] | None,
        outcome: str,
    ) -> "Futures":
        """Futures of a point predictor: one for each interaction, of unknown spread.

        Args:
            com: Centres of mass in the action frame [m].
            turned: Rotation vectors since rest [rad]; None: not predicted.
            outcome: The outcome that the predictor was trained on.
        """
        n, time, _ = com.shape
        turned = np.full_like(com, np.nan) if turned is None else turned
        return cls(
            probability=np.ones((n, 1)),
            outcome=(outcome,),
            states=np.concatenate([com, turned], axis=-1)[:, None],
            spread=np.full((n, 1, time), np.nan),
            support_points=np.full((n, 1, 2, 2), np.nan),
            quantiles=np.full(len(LEVELS), np.nan),
        )

    @property
    def is_point(self) -> bool:
        """Whether there is one future alone, whose spread is unknown."""
        return len(self.outcome) == 1 and bool(np.isnan(self.spread).all())

    def __len__(self) -> int:
        return len(self.probability)

    def __getitem__(self, rows: slice | np.ndarray) -> "Futures":
        names = ["probability", "states", "spread", "support_points"]
        names += ["quantiles"] * (self.quantiles.ndim == 2)
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
        """Futures that are probable enough to belong to regions: (batch, futures) bool."""
        best = self.probability.max(axis=1, keepdims=True)
        return self.probability >= np.minimum(best, MIN_PROBABILITY)

    def radius(self, level: float) -> Float[np.ndarray, "batch futures time"]:
        """Radii of the prediction region about each future that counts [m]: whole motions stay in one of them.

        NaN for a future that does not count or whose spread is unknown; infinite where the validation part was too
        small.

        Args:
            level: Probability with which a motion stays in the region.

        Raises:
            PredictionError: The level is not between 0.01 and 0.99.
        """
        if not LEVELS[0] <= level <= LEVELS[-1]:
            raise PredictionError(f"level {level} of a region: choose one from {LEVELS[0]} to {LEVELS[-1]}")
        wide = self.width(level)[..., None, None]
        return np.where(self.counted[..., None], wide * (self.spread + FLOOR), np.nan)

    def width(self, level: float) -> Float[np.ndarray, "*batch"]:
        """Quantile of a level, in spreads: of each interaction, or of all."""
        low = int(np.clip(np.searchsorted(LEVELS, level, side="right") - 1, 0, len(LEVELS) - 2))
        share = (level - LEVELS[low]) / (LEVELS[low + 1] - LEVELS[low])
        below, above = self.quantiles[..., low], self.quantiles[..., low + 1]
        with np.errstate(invalid="ignore"):  # 0 x infinity: a level that is one of LEVELS is taken as it is
            between = (1 - share) * below + share * above
        return np.where(share < 1e-9, below, np.where(share > 1 - 1e-9, above, between))

    def given(self, observed: Float[np.ndarray, "batch samples 6"], sample_period: float) -> "Futures":
        """Futures after the first samples were observed.

        An object that is off its expected position, since the blade met it elsewhere, for instance, keeps that offset:
        everything that follows is moved and turned by it. After a slip the offset decays, as the object ends on the
        table. A future whose offset changes becomes less probable. Spreads grow from the last observed sample on, as
        those of a random walk, and faster the further that sample is off. Regions are only rough from then on.

        Args:
            observed: Positions in the action frame [m] and rotation vectors since rest [rad], from the start.
            sample_period: Seconds between samples.
        """
        k = observed.shape[1]
        off = observed[:, None] - self.states[:, :, :k]  # (batch, futures, k, 6)
        steady = off[:, :, -STEADY:].mean(axis=2, keepdims=True)
        drift = np.square(off - steady)[:, :, -DRIFT_SAMPLES:, :3].sum(axis=3).mean(axis=2)
        logits = np.log(np.maximum(self.probability, 1e-30)) - np.log1p(drift / DRIFT**2)
        weights = np.exp(logits - logits.max(axis=1, keepdims=True))
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
            probability=weights / weights.sum(axis=1, keepdims=True),
            states=states,
            spread=np.concatenate([np.zeros_like(self.spread[:, :, :k]), rest], axis=2),
        )

    def expected_error(self) -> Float[np.ndarray, " batch"]:
        """Expected distance of the most probable future from the motion, mean over time [m]; NaN: unknown.

        Each future counts by its probability: with its distance from the most probable one, and its own spread.
        """
        rows = np.arange(len(self))
        best = self.com[rows, self.probability.argmax(axis=1)]
        apart = np.linalg.norm(self.com - best[:, None], axis=-1)
        return (self.probability * np.hypot(apart, self.spread).mean(axis=2)).sum(axis=1)

    def outcomes(self) -> dict[str, Float[np.ndarray, " batch"]]:
        """Probability of each outcome."""
        names = dict.fromkeys(self.outcome)
        mine = np.array(self.outcome)
        return {name: self.probability[:, mine == name].sum(axis=1) for name in names}


def conformal_scores(
    futures: Futures, com: Float[np.ndarray, "batch time 3"], lengths: np.ndarray
) -> Float[np.ndarray, " batch"]:
    """Largest distance of motions, in spreads, from the future that they follow best: their nonconformity.

    The region of all motions with at most some score is a union of tubes about futures.

    Args:
        futures: Predicted futures.
        com: Observed centres of mass [m], perhaps for a shorter time.
        lengths: Samples of each that count.
    """
    count = com.shape[1]
    apart = np.linalg.norm(futures.com[:, :, :count] - com[:, None], axis=-1)
    apart = apart / (futures.spread[:, :, :count] + FLOOR)
    valid = np.arange(count) < lengths[:, None]
    furthest = np.where(valid[:, None], apart, 0.0).max(axis=2)
    return np.where(futures.counted, furthest, np.inf).min(axis=1)


def quantiles_of(scores: Float[np.ndarray, " n"]) -> Float[np.ndarray, " levels"]:
    """Quantiles of scores that a further score exceeds with probability 1 - `LEVELS` at most (split-conformal).

    Vovk et al., 2005, "Algorithmic learning in a random world": exact for exchangeable scores.
    """
    ordered = np.append(np.sort(scores), np.inf)
    return ordered[np.minimum(np.ceil(LEVELS * len(ordered)).astype(int) - 1, len(scores))]


def carried_poses(
    moved: Float[np.ndarray, "time 7"], T_action_object: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "time 7"]:
    """Poses of an object's frame in the action frame, from its centre of mass and its rotation since rest.

    Args:
        moved: As ``ImaginedEffect.pose_trajectory``.
        T_action_object: Object frame -> action frame at rest.
    """
    turns = quaternion_to_matrix(moved[:, 3:])
    poses = np.tile(T_action_object, (len(moved), 1, 1))
    poses[:, :3, :3] = turns @ T_action_object[:3, :3]
    poses[:, :3, 3] = moved[:, :3] + turns @ (T_action_object[:3, 3] - moved[0, :3])
    return matrix_to_pose(poses)


@dataclass(frozen=True)
class ImaginedEffect:
    """The effect that an imaginer expects of one action."""

    times: Float[np.ndarray, " time"]
    """Time of each sample [s], from the moment before the blade touches the object."""
    com_trajectory: Float[np.ndarray, "time 3"]
    """Centre of mass in the action frame [m]; the first row is the start that was given or estimated."""
    pose_trajectory: Float[np.ndarray, "time 7"] | None
    """Position of the centre of mass [m] and quaternion (w, x, y, z) of the rotation since rest, about the
    action frame's axes: the identity at first. None if only positions are predicted."""
    futures: Futures
    """All futures, one row; the trajectories above are those of the most probable one."""
    warnings: tuple[str, ...] = ()
    """Respects in which object or action are unlike those that the predictor has learned from."""
    context: Mapping[str, float] = field(default_factory=dict)
    """What the imaginer was told beside the view, by name [SI]; NaN: not told."""
    worlds: "Worlds | None" = None
    """Motions in all worlds of a `Belief` that was averaged over; None: there was none."""

    def to_dict(self, level: float = 0.9, most: int | None = None) -> dict[str, Any]:
        """Warnings, outcomes and futures as plain values; of a point predictor, the warnings alone.

        Futures are in the order of their probability, in the action frame [SI]; None where nothing is known.

        Args:
            level: Probability of the region whose radii are given.
            most: Futures that are listed, at most; None: all.
        """
        content: dict[str, Any] = {"warnings": list(self.warnings)}
        futures = self.futures
        if futures.is_point:
            return content
        radii = futures.radius(level)[0]
        order = np.argsort(-futures.probability[0], kind="stable")[:most]
        content["outcomes"] = {name: float(p[0]) for name, p in futures.outcomes().items()}
        content["level"] = level
        content["futures"] = [
            {
                "outcome": futures.outcome[k],
                "probability": float(futures.probability[0, k]),
                "com_trajectory": futures.com[0, k].tolist(),
                "pose_trajectory": futures.pose[0, k].tolist(),
                "radius": radii[k].tolist() if np.isfinite(radii[k]).all() else None,
                "support_points": futures.support_points[0, k].tolist(),
            }
            for k in order.tolist()
        ]
        return content

    def object_poses(self, T_action_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "time 7"] | None:
        """Poses of the object's frame in the action frame over time: position [m], quaternion (w, x, y, z).

        Args:
            T_action_object: Object frame -> action frame at rest.

        Returns:
            One pose for each of ``times``; None if only positions are predicted.
        """
        return None if self.pose_trajectory is None else carried_poses(self.pose_trajectory, T_action_object)

    def until(self, end: float) -> "ImaginedEffect":
        """The same up to a time [s], without the worlds of a belief; its probabilities are those of the whole."""
        kept = self.times <= end + 1e-9
        futures = replace(
            self.futures, states=self.futures.states[:, :, kept], spread=self.futures.spread[:, :, kept]
        )
        pose = None if self.pose_trajectory is None else self.pose_trajectory[kept]
        return replace(
            self,
            times=self.times[kept],
            com_trajectory=self.com_trajectory[kept],
            pose_trajectory=pose,
            futures=futures,
            worlds=None,
        )

    def __repr__(self) -> str:
        chances = ", ".join(
            f"{name} {float(chance[0]):.3g}" for name, chance in self.futures.outcomes().items()
        )
        warned = f", {len(self.warnings)} warnings" if self.warnings else ""
        physics = {name: value for name, value in self.context.items() if name in CONSTANTS}
        told = [f"{name} {value:.4g}" for name, value in physics.items() if not np.isnan(value)]
        hidden = [name for name, value in physics.items() if np.isnan(value)]
        words = [f"told {', '.join(told)}"] * bool(told) + [f"not told {', '.join(hidden)}"] * bool(hidden)
        if physics and all(value == nominal_constants()[name] for name, value in physics.items()):
            words = ["nominal physics"]
        return f"ImaginedEffect({', '.join([f'{len(self.times)} samples', chances, *words])}{warned})"


@dataclass(frozen=True)
class ImaginedBatch:
    """The effects that an imaginer expects of many actions."""

    times: Float[np.ndarray, " time"]
    """Time of each sample [s], common to all."""
    com: Float[np.ndarray, "batch time 3"]
    """Centres of mass in the action frame [m]."""
    pose: Float[np.ndarray, "batch time 7"] | None
    """As ``ImaginedEffect.pose_trajectory``, one for each action."""
    futures: Futures
    """As ``ImaginedEffect.futures``, one row for each action."""
    warnings: tuple[tuple[str, ...], ...] = ()
    """As ``ImaginedEffect.warnings``, one entry for each action."""
    context: Mapping[str, Float[np.ndarray, " batch"]] = field(default_factory=dict)
    """As ``ImaginedEffect.context``, one value for each action."""

    def __len__(self) -> int:
        return len(self.com)

    def __getitem__(self, index: int) -> ImaginedEffect:
        pose = None if self.pose is None else self.pose[index]
        futures = self.futures[np.array([index])]
        warnings = self.warnings[index] if self.warnings else ()
        context = {name: float(values[index]) for name, values in self.context.items()}
        return ImaginedEffect(self.times, self.com[index], pose, futures, warnings, context)
