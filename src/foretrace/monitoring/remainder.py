"""The remainder of a motion under way, imagined anew: motions by how well they fit, moved to where the object is."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foretrace.geometry import continuous_rotation_vectors, quaternion_to_matrix
from foretrace.imagined import Futures, ImaginedEffect
from foretrace.imagined.futures import FORGET_TIME, MIN_PROBABILITY
from foretrace.imagined.worlds import MISSED
from foretrace.interactions.record import Outcome
from foretrace.monitoring.causes import FROZEN, HELD, JUMPED, LOST, SLIPPED
from foretrace.monitoring.motions import TURN_LENGTH, Motions, effect_of, gather_motions

FALL = 0.25
"""Time in which an object that slipped comes to rest on the table [s]."""
STILL = 0.003
"""An object that has moved by less than this since rest has not been lifted [m]."""
STEADY = 3
"""Samples whose mean is the present offset from a motion."""
GROWTH = 0.02
"""Growth of the spread with the square root of time, where nothing better is known [m/s^0.5]."""
NEGLIGIBLE = 1e-6


@dataclass(frozen=True, eq=False)
class Remainder:
    """What is known when a verdict is given; futures are worked out when they are asked for."""

    motions: Motions
    """Motions that may be observed."""
    weights: Float[np.ndarray, " motions"]
    """Their probabilities."""
    time: float
    """Time of the verdict [s]."""
    trusted: int
    """The motion that fitted best before a deviation."""
    times: tuple[float, ...]
    """Times of the tracked samples [s]."""
    poses: tuple[Float[np.ndarray, "7"], ...]
    """The tracked samples, in the action frame."""
    rest_pose: Float[np.ndarray, "7"]
    """Pose at rest."""
    cause: str | None
    """Cause of an alarm."""
    imagined: ImaginedEffect
    """What was imagined before the motion."""
    quantiles: Float[np.ndarray, " levels"]
    """As `Futures.quantiles`, of rests."""

    def whole(self) -> Futures:
        """Futures over the whole motion, by outcome, with the probabilities that they have now."""
        motions = self.motions
        com = self.imagined.com_trajectory[0]
        return gather_motions(motions, self.weights, motions.states, motions.spread, com, self.quantiles)

    def rest(self) -> ImaginedEffect | None:
        """The effect from now on; None past the last sample."""
        after = self.motions.times > self.time + 1e-9
        if not after.any():
            return None
        times = self.motions.times[after]
        since = times - self.time
        com = self.imagined.com_trajectory[0]
        here = self._seen(com)
        moves = float(np.linalg.norm(here[-1])) > STILL
        if self.cause in (SLIPPED, HELD) or (self.cause == MISSED and not moves):
            return self._alone(times, since, here[-1], falls=self.cause == SLIPPED)
        weights = self.weights
        if self.cause in (FROZEN, LOST, JUMPED):  # what the tracker says is not where the object is
            weights = np.zeros_like(weights)
            weights[self.trusted] = 1.0
            offset = np.zeros((len(weights), 1, 6))
        else:
            offset = self._offsets()[:, None]
        kept = weights > NEGLIGIBLE
        falls = np.array([name == Outcome.SLIPPED for name in self.motions.outcomes])[self.motions.outcome]
        share = np.where(falls[:, None], np.exp(-since / FORGET_TIME), 1.0)[..., None]
        states = np.where(kept[:, None, None], self.motions.states[:, after] + share * offset, 0.0)
        last = int(np.searchsorted(self.motions.times, self.time, side="right")) - 1
        now = self.motions.spread[:, max(last, 0)]
        size = np.linalg.norm(offset[:, 0, :3], axis=1)
        grown = np.sqrt(np.maximum(self.motions.spread[:, after] ** 2 - now[:, None] ** 2, 0.0))
        spread = np.hypot(np.hypot(grown, GROWTH * np.sqrt(since) * 0.1), 0.5 * size[:, None])
        futures = gather_motions(
            self.motions, np.where(kept, weights, 0.0), states, spread, com, self.quantiles
        )
        return effect_of(_likely(futures), times)

    def _alone(
        self,
        times: Float[np.ndarray, " rest"],
        since: Float[np.ndarray, " rest"],
        here: Float[np.ndarray, "6"],
        falls: bool,
    ) -> ImaginedEffect:
        """The object falls back onto the table, or stays where it is."""
        end = here * np.array([1, 1, 0, 0, 0, 1]) if falls else here
        share = np.clip(since / FALL, 0, 1)[:, None] ** 2
        states = here + share * (end - here)
        com = self.imagined.com_trajectory[0]
        states = np.concatenate([states[:, :3] + com, states[:, 3:] / TURN_LENGTH], axis=1)
        outcome = str(Outcome.SLIPPED) if falls else self._still_outcome()
        futures = Futures(
            np.ones((1, 1)),
            (outcome,),
            states[None, None],
            (GROWTH * np.sqrt(since))[None, None],
            np.full((1, 1, 2, 2), np.nan),
            self.quantiles,
        )
        return effect_of(futures, times)

    def _still_outcome(self) -> str:
        names = [name for name in self.motions.outcomes if name == Outcome.MISSED]
        return names[0] if names else self.motions.outcomes[int(self.motions.outcome[self.trusted])]

    def _seen(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "time 6"]:
        """Displacements of a point and turns, as `Motions.states`."""
        poses = np.array(self.poses)
        turns = quaternion_to_matrix(poses[:, 3:]) @ quaternion_to_matrix(self.rest_pose[3:]).T
        moved = poses[:, :3] - self.rest_pose[:3] + (turns - np.eye(3)) @ (point - self.rest_pose[:3])
        return np.concatenate([moved, TURN_LENGTH * continuous_rotation_vectors(turns)], axis=1)

    def _offsets(self) -> Float[np.ndarray, "motions 6"]:
        """Present offset of the object from each motion: the mean of the last samples."""
        points, rest = self.motions.points, self.rest_pose
        recent = range(max(0, len(self.times) - STEADY), len(self.times))
        turned = self._seen(rest[:3])[:, 3:]
        found = np.zeros((len(points), 6))
        for k in recent:
            pose = self.poses[k]
            turn = quaternion_to_matrix(pose[3:]) @ quaternion_to_matrix(rest[3:]).T
            moved = pose[:3] - rest[:3] + (points - rest[:3]) @ (turn - np.eye(3)).T
            expected, _ = self.motions.at(self.times[k])
            found[:, :3] += moved - expected[:, :3]
            found[:, 3:] += turned[k] - expected[:, 3:]
        return found / len(recent)


def _likely(futures: Futures) -> Futures:
    """Futures without those that are too improbable to count."""
    kept = futures.counted[0] | (futures.probability[0] >= MIN_PROBABILITY)
    probability = futures.probability[:, kept]
    return Futures(
        probability / probability.sum(),
        tuple(name for name, each in zip(futures.outcome, kept, strict=True) if each),
        futures.states[:, kept],
        futures.spread[:, kept],
        futures.support_points[:, kept],
        futures.quantiles,
    )
