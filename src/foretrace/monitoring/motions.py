"""Motions that an execution is compared with: every one that was imagined, with the width of its band."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import maximum_filter1d

from foretrace.errors import MonitoringError
from foretrace.geometry import quaternion_to_matrix, rotation_vector_to_quaternion
from foretrace.imagined import Futures, ImaginedEffect

TURN_LENGTH = 0.06
"""A rotation counts as the distance by which it moves a point so far away [m]."""
WEIGHTS = np.array([1.0, 1.0, 1.0, TURN_LENGTH, TURN_LENGTH, TURN_LENGTH])
WIDTH = 1e-3
"""Width of the band about a motion at rest [m]: noise of the tracker and of the imaginer."""
SPEED_TIME = 0.05
"""A moving object may be ahead or behind by this time: the band is wider by that times its speed [s]."""
NEAR = 0.15
"""The greatest speed within this time counts [s]."""
FALL_TIME = 0.05
"""From a fall on, the band is wider by this time's travel at its greatest speed downwards [s]: where an object comes to
rest after it cannot be told exactly."""
WRONG_SHARE = 1e-3
"""Prior probability of all worlds with one cause, beside those as believed."""


@dataclass(frozen=True, eq=False)
class Motions:
    """Motions that may be observed, one row each; of points of the object, relative to their places at rest."""

    times: Float[np.ndarray, " time"]
    """Sample times [s]."""
    points: Float[np.ndarray, "motions 3"]
    """The points: centres of mass at rest in the action frame [m]."""
    states: Float[np.ndarray, "motions time 6"]
    """Displacements [m], and rotation vectors since rest [rad] times `TURN_LENGTH`."""
    width: Float[np.ndarray, "motions time"]
    """Widths of the bands [m]."""
    spread: Float[np.ndarray, "motions time"]
    """Spreads as imagined [m]; 0 where unknown."""
    log_prior: Float[np.ndarray, " motions"]
    """Logarithm of the probabilities before the motion."""
    outcome: Int[np.ndarray, " motions"]
    """Outcomes, as numbers of ``outcomes``."""
    outcomes: tuple[str, ...]
    """Names of the outcomes."""
    causes: np.ndarray
    """(motions,) What is wrong in the world of each (str); empty: nothing."""

    @property
    def believed(self) -> np.ndarray:
        """(motions,) Whether nothing is wrong in its world (bool)."""
        return self.causes == ""

    def at(self, time: float) -> tuple[Float[np.ndarray, "motions 6"], Float[np.ndarray, " motions"]]:
        """States and widths at a time [s]; beyond the last sample, those of the last."""
        place = np.interp(time, self.times, np.arange(len(self.times)))
        k = min(int(place), len(self.times) - 2)
        share = place - k
        states = (1 - share) * self.states[:, k] + share * self.states[:, k + 1]
        return states, (1 - share) * self.width[:, k] + share * self.width[:, k + 1]

    def repeated(self, times: int) -> "Motions":
        """Each motion several times."""
        names = ("points", "states", "width", "spread", "log_prior", "outcome", "causes")
        return replace(self, **{name: np.repeat(getattr(self, name), times, axis=0) for name in names})

    def at_each(
        self, times: Float[np.ndarray, " motions"]
    ) -> tuple[Float[np.ndarray, "motions 6"], Float[np.ndarray, " motions"]]:
        """As `at`, at a time of its own for each motion."""
        place = np.interp(times, self.times, np.arange(len(self.times)))
        k = np.minimum(place.astype(int), len(self.times) - 2)
        share, rows = place - k, np.arange(len(k))
        states = (1 - share)[:, None] * self.states[rows, k] + share[:, None] * self.states[rows, k + 1]
        return states, (1 - share) * self.width[rows, k] + share * self.width[rows, k + 1]


def motions_of(imagined: ImaginedEffect) -> Motions:
    """All motions of an imagined effect: those of its worlds, where it has any, or its futures.

    Raises:
        MonitoringError: Rotations were not imagined.
    """
    worlds = imagined.worlds
    futures = imagined.futures if worlds is None else worlds.futures
    kept = np.flatnonzero(futures.counted[0]) if worlds is None else np.arange(len(futures.outcome))
    states = futures.states[0, kept]
    if not np.isfinite(states).all():
        raise MonitoringError(
            "the imagined effect has positions alone: monitor one whose rotations are imagined, too"
        )
    causes = np.full(len(kept), "", dtype=object) if worlds is None else np.array(worlds.causes, dtype=object)
    relative = np.concatenate([states[..., :3] - states[:, :1, :3], TURN_LENGTH * states[..., 3:]], axis=-1)
    prior = np.maximum(futures.probability[0, kept], 1e-12)
    prior = np.where(causes == "", prior, WRONG_SHARE * prior)
    names = tuple(dict.fromkeys(futures.outcome))
    return Motions(
        times=np.asarray(imagined.times, dtype=float),
        points=states[:, 0, :3],
        states=relative,
        width=band_width(relative, imagined.times),
        spread=np.nan_to_num(futures.spread[0, kept]),
        log_prior=np.log(prior),
        outcome=np.array([names.index(futures.outcome[k]) for k in kept]),
        outcomes=names,
        causes=causes,
    )


def band_width(
    states: Float[np.ndarray, "motions time 6"], times: Float[np.ndarray, " time"]
) -> Float[np.ndarray, "motions time"]:
    """Widths of the bands about motions [m]: wider where they are fast, and after falls."""
    period = float(np.median(np.diff(times)))
    reach = max(1, round(NEAR / period))
    steps = np.diff(states, axis=1, prepend=states[:, :1]) / period
    speed = maximum_filter1d(np.linalg.norm(steps, axis=2), 2 * reach + 1, axis=1, mode="nearest")
    falling = np.maximum(-steps[..., 2], 0.0)
    ahead = np.pad(falling, ((0, 0), (0, reach)))[:, reach:]
    fall = np.maximum.accumulate(np.maximum(ahead, falling), axis=1)
    return WIDTH + SPEED_TIME * speed + FALL_TIME * fall


def place_of(
    pose: Float[np.ndarray, "7"], rest: Float[np.ndarray, "7"], points: Float[np.ndarray, "motions 3"]
) -> Float[np.ndarray, "motions 3"]:
    """Displacement of points of the object since rest [m].

    Args:
        pose: Pose of the object frame in the action frame.
        rest: The same at rest.
        points: Their places at rest in the action frame [m].
    """
    turn = quaternion_to_matrix(pose[3:]) @ quaternion_to_matrix(rest[3:]).T
    return pose[:3] - rest[:3] + (points - rest[:3]) @ (turn - np.eye(3)).T


def gather_motions(
    motions: Motions,
    weights: Float[np.ndarray, " motions"],
    states: Float[np.ndarray, "motions time 6"],
    spread: Float[np.ndarray, "motions time"],
    com: Float[np.ndarray, "3"],
    quantiles: Float[np.ndarray, " levels"],
) -> Futures:
    """Futures by outcome: weighted means of motions, with their spreads.

    Args:
        motions: The motions.
        weights: Their probabilities.
        states: What becomes of them, as `Motions.states`.
        spread: Spread of each [m].
        com: Centre of mass at rest [m].
        quantiles: As `Futures.quantiles`.
    """
    present = [k for k in range(len(motions.outcomes)) if weights[motions.outcome == k].sum() > 0]
    means, spreads, shares = [], [], []
    for k in present:
        mine = motions.outcome == k
        share = weights[mine] / weights[mine].sum()
        mean = np.einsum("m,mts->ts", share, states[mine])
        apart = ((states[mine, :, :3] - mean[:, :3]) ** 2).sum(axis=-1)
        means.append(mean)
        spreads.append(np.sqrt(share @ (apart + spread[mine] ** 2)))
        shares.append(float(weights[mine].sum()))
    found = np.array(means)
    found = np.concatenate([found[..., :3] + com, found[..., 3:] / TURN_LENGTH], axis=-1)
    return Futures(
        probability=np.array([shares]) / sum(shares),
        outcome=tuple(motions.outcomes[k] for k in present),
        states=found[None],
        spread=np.array(spreads)[None],
        support_points=np.full((1, len(present), 2, 2), np.nan),
        quantiles=quantiles,
    )


def effect_of(futures: Futures, times: Float[np.ndarray, " time"]) -> ImaginedEffect:
    """The effect whose futures these are."""
    best = futures.states[0, int(futures.probability[0].argmax())]
    pose = np.concatenate([best[:, :3], rotation_vector_to_quaternion(best[:, 3:])], axis=1)
    return ImaginedEffect(times, best[:, :3], pose, futures)
