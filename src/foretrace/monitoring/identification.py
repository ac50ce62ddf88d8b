"""What an execution tells of its constants: frictions, place of the centre of mass, error of the contact."""

from collections.abc import Mapping
from itertools import pairwise
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import maximum_filter1d
from scipy.special import logsumexp

from foretrace.actions import Action
from foretrace.errors import MonitoringError, check_type, fault, is_whole, shown
from foretrace.geometry import quaternion_to_matrix
from foretrace.imagined import IMAGINERS, Imaginer, ObservedMotion, estimate_com
from foretrace.imagined.belief import COM, Belief
from foretrace.imagined.context import parameters_of
from foretrace.imagined.futures import ImaginedBatch
from foretrace.imagined.observed import observed_motion, rotations_since_rest
from foretrace.imagined.worlds import play_worlds
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.record import Effect
from foretrace.interactions.topdown import TopDownView
from foretrace.monitoring.motions import TURN_LENGTH

COM_RANGE = 0.025
"""Range of the centre of mass about where it is seen, along each axis of the object frame, by default [m]."""
PARTICLES = 1024
"""Worlds in which the action is imagined in each round."""
TEMPERS = (0.1, 0.4, 1.0)
"""Shares of the likelihood after each round: each round's worlds are drawn where those before it fit."""
JITTER = 0.25
"""Distance that particles are moved by between rounds, in standard deviations."""
BEST = 48
"""Worlds of the last round that a second, exact imaginer plays again."""
LEAST = 12
"""Worlds that count then, at least: the likelihood is tempered until they do, as so few cannot tell more."""
WIDTH = 1.5e-3
"""Width of the likelihood: error of the learned imaginer [m]. That of the exact one is half as wide."""
SPEED_TIME = 0.02
"""An object in motion may be ahead or behind by this time [s]."""
RATE = 4.0
"""Independent observations in a second: residuals that follow each other closely are alike."""
MOVING = 1e-3
"""Samples from the first one on that moves the object by this count [m]."""
LONGEST_STEP = 0.1
"""Longest time that one sample stands for [s]."""
TAIL = 3.0
"""Degrees of freedom of the likelihood (Student): a few samples that are far off do not decide."""


def first_prior(known: Mapping[str, tuple[float, float]] = MappingProxyType({})) -> Belief:
    """What is believed of an object before its first action: usual ranges, its centre of mass within `COM_RANGE`.

    Args:
        known: Narrower ranges by name [SI].
    """
    return Belief(dict.fromkeys(COM, (-COM_RANGE, COM_RANGE)) | dict(known))


def identify(
    view: TopDownView,
    action: Action,
    effect: Effect | ObservedMotion,
    prior: Belief | None = None,
    *,
    imaginer: Imaginer | None = None,
    exact: Imaginer | None = None,
    seed: int = 0,
) -> Belief:
    """Learn constants of the physics from one observed action.

    The action is imagined in a thousand worlds that are drawn from the prior, then in worlds like those that fit; each
    counts by the likelihood of the observed motion (tempered sequential Monte Carlo). Beliefs multiply: that of one
    lever-up is the prior of the next on the same object, of which frictions, density and centre of mass stay, and the
    contact's error is drawn anew.

    Args:
        view: The object from above, in the action frame.
        action: The action, in the object frame: the same one for all actions on one object.
        effect: What was observed: the record's own effect, or poses over times; the beginning of a motion will do.
        prior: What is believed before; by default the ranges of randomised data sets, and a centre of mass within
            25 mm along each axis of the one that is seen.
        imaginer: Imagines the worlds; by default the predictor that comes with foretrace.
        exact: Plays the best worlds again, for instance a `TwinImaginer`; None: none does.
        seed: Decides the draws.

    Returns:
        What is believed after it. ``learned`` names what was learned; all else keeps its prior.

    Raises:
        MonitoringError: An argument is of another type, the seed is none, or the imaginer imagines no rotations.
        PredictionError: The view or the motion cannot be used.
    """
    check_type("view", view, TopDownView, MonitoringError)
    check_type("action", action, Action, MonitoringError)
    check_type("prior", prior, (Belief, type(None)), MonitoringError, "a Belief, such as an earlier result")
    for name, each in (("imaginer", imaginer), ("exact", exact)):
        check_type(name, each, (Imaginer, type(None)), MonitoringError)
    check_seed(seed)
    motion = observed_motion(effect)
    imaginer = imaginer or IMAGINERS.find("learned")(None)
    imaginer.imagine(view, action)  # with its checks of the view
    belief = prior or first_prior()
    com = estimate_com(InteractionBatch.from_views([view]))[0]
    parameters = {name: float(each[0]) for name, each in parameters_of([action]).items()}
    rng = np.random.default_rng(seed)
    drawn = belief.sample_ahead(PARTICLES, rng)
    values = np.column_stack([drawn[name] for name in belief.names])
    limits = np.array([belief.ranges[name] for name in belief.names])
    worlds: dict[str, np.ndarray] = {}
    likelihood, weights = np.zeros(PARTICLES), np.full(PARTICLES, 1 / PARTICLES)
    for before, now in pairwise((0.0, *TEMPERS)):
        if before:
            values = _spread_out(values, weights, limits, rng)
        worlds = dict(zip(belief.names, values.T, strict=True))
        played = play_worlds(imaginer, view, action, com, worlds, parameters)
        likelihood = log_likelihood(played, motion, WIDTH)
        weights = _normalised((now - before) * likelihood)
    if exact is not None:
        few = _resampled(weights, BEST, rng)
        values, worlds = values[few], {name: each[few] for name, each in worlds.items()}
        again = play_worlds(exact, view, action, com, worlds, parameters)
        weights = _tempered(log_likelihood(again, motion, WIDTH / 2) - likelihood[few])
    return belief.updated(values, weights)


def check_seed(seed: object) -> None:
    """Refuse what is no seed.

    Raises:
        MonitoringError: It is no whole number from 0 on.
    """
    if not is_whole(seed, 0, 2**63 - 1):
        raise fault(MonitoringError, isinstance(seed, int))(
            f"seed is {shown(seed)}: give a whole number from 0 to {2**63 - 1}"
        )


def log_likelihood(
    played: ImaginedBatch, motion: ObservedMotion, width: float
) -> Float[np.ndarray, " worlds"]:
    """Logarithm of the likelihood of an observed motion in worlds, up to a constant.

    Args:
        played: The worlds' futures, in the frame of the action as commanded.
        motion: The observed motion; its poses alone count.
        width: Error of the imaginer [m].
    """
    inside = motion.times <= played.times[-1]
    poses = motion.poses[inside]
    rotations = rotations_since_rest(poses)
    return log_likelihoods(played, motion.times[inside], poses[None], rotations[None], width)[0]


def log_likelihoods(
    played: ImaginedBatch,
    times: Float[np.ndarray, " time"],
    poses: Float[np.ndarray, "motions time 7"],
    rotations: Float[np.ndarray, "motions time 3"],
    width: float,
) -> Float[np.ndarray, "motions worlds"]:
    """As `log_likelihood`, of several motions with the same times that end no later than the played ones.

    Args:
        played: As of `log_likelihood`.
        times: Time of each sample [s].
        poses: Poses of any frame of the object in the frame of the action as commanded.
        rotations: Their rotation vectors since rest [rad].
        width: Error of the imaginer [m].

    Raises:
        MonitoringError: Rotations were not imagined.
    """
    futures = played.futures
    world, slot = np.nonzero(futures.counted)
    states = futures.states[world, slot]
    if not np.isfinite(states).all():
        raise MonitoringError("the imaginer imagines positions alone: give one that imagines rotations, too")
    points = states[:, 0, :3]
    place = np.interp(times, played.times, np.arange(len(played.times)))
    k = np.minimum(place.astype(int), len(played.times) - 2)
    share = (place - k)[:, None]
    expected = (1 - share) * states[:, k] + share * states[:, k + 1]  # (rows, time, 6)
    rest, turned = poses[:, :1], TURN_LENGTH * rotations
    turns = quaternion_to_matrix(poses[..., 3:]) @ np.swapaxes(quaternion_to_matrix(rest[..., 3:]), -1, -2)
    # Where each world's centre of mass is carried, (motions, rows, time, 3).
    arms = points - rest[..., :3]
    carried = np.swapaxes(arms[:, None] @ np.swapaxes(turns, -1, -2), 1, 2)
    off = poses[:, None, :, :3] + carried - (rest[:, :, None, :3] + arms[:, :, None])
    moved = np.linalg.norm(np.concatenate([off[:, 0], turned], axis=-1), axis=-1) > MOVING
    off -= expected[..., :3] - points[:, None]
    square = np.einsum("nrti,nrti->nrt", off, off)
    off = turned[:, None] - TURN_LENGTH * expected[..., 3:]
    square += np.einsum("nrti,nrti->nrt", off, off)
    # The observed motion's own speed decides, or slow worlds would be favoured for their narrow bands.
    seen = np.concatenate([poses[..., :3] - rest[..., :3], turned], axis=-1)
    speed = np.zeros(seen.shape[:2])
    if len(times) > 1:
        speed = np.linalg.norm(np.gradient(seen, times, axis=1), axis=-1)
    square /= (width + SPEED_TIME * maximum_filter1d(speed, 3, axis=1))[:, None] ** 2
    duration = np.minimum(np.diff(times, prepend=times[0]), LONGEST_STEP)
    counts = RATE * duration * np.maximum.accumulate(moved, axis=1)  # (motions, time)
    total = counts.sum(axis=1)
    # Where no world fits within the width, it is as wide as the best one is off.
    least = np.einsum("nrt,nt->nr", square, counts).min(axis=1) / np.where(total > 0, total, 1.0)
    square /= np.maximum(1.0, least)[:, None, None]
    log = -0.5 * (TAIL + 1) * np.einsum("nrt,nt->nr", np.log1p(square / TAIL), counts)
    found = np.full((len(poses), *futures.probability.shape), -np.inf)
    found[:, world, slot] = log + np.log(futures.probability[world, slot])
    return np.asarray(logsumexp(found, axis=2))


def _spread_out(
    values: Float[np.ndarray, "worlds names"],
    weights: Float[np.ndarray, " worlds"],
    limits: Float[np.ndarray, "names 2"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "worlds names"]:
    """Particles drawn by weight, each moved a little; mean and covariance stay (Liu and West, 2001)."""
    mean = weights @ values
    off = values - mean
    covariance = (off * weights[:, None]).T @ off
    scale = np.sqrt(np.diag(covariance)) + 1e-12
    unit = covariance / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    noise = rng.normal(size=values.shape) @ np.linalg.cholesky(unit).T * scale
    shrunk = np.sqrt(1 - JITTER**2)
    chosen = values[_resampled(weights, len(values), rng)]
    moved = mean + shrunk * (chosen - mean) + JITTER * noise
    low, high = limits.T
    moved = np.where(moved < low, 2 * low - moved, moved)  # reflected at the ends of the ranges
    return np.clip(np.where(moved > high, 2 * high - moved, moved), low, high)


def _resampled(
    weights: Float[np.ndarray, " worlds"], count: int, rng: np.random.Generator
) -> Int[np.ndarray, " count"]:
    """Rows drawn evenly along the cumulative weights."""
    places = (np.arange(count) + rng.random()) / count
    return np.minimum(np.searchsorted(np.cumsum(weights), places), len(weights) - 1)


def _tempered(log: Float[np.ndarray, " worlds"]) -> Float[np.ndarray, " worlds"]:
    """Normalised weights, of the largest power up to 1 by which an effective number of `LEAST` worlds counts."""
    for power in 0.8 ** np.arange(60):
        weights = _normalised(power * log)
        if 1 / np.sum(weights**2) >= min(LEAST, len(log)):
            return weights
    return np.full(len(log), 1 / len(log))


def _normalised(log: Float[np.ndarray, " worlds"]) -> Float[np.ndarray, " worlds"]:
    return np.exp(log - logsumexp(log))
