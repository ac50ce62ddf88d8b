"""What an action is expected to tell of an object's constants, before it is carried out."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from foretrace.actions import Action
from foretrace.errors import MonitoringError, check_type
from foretrace.geometry import Numbers, finite_array, rotation_vector_to_quaternion
from foretrace.imagined import IMAGINERS, Imaginer, estimate_com
from foretrace.imagined.belief import EXECUTION, Belief
from foretrace.imagined.context import parameters_of
from foretrace.imagined.futures import ImaginedBatch
from foretrace.imagined.worlds import play_worlds
from foretrace.interactions.batch import Candidates, InteractionBatch
from foretrace.interactions.topdown import TopDownView
from foretrace.monitoring.identification import RATE, SPEED_TIME, WIDTH, check_seed, log_likelihoods
from foretrace.monitoring.motions import WEIGHTS

OBJECTS = 32
"""Draws of what stays from one action to the next: frictions, density, centre of mass."""
ERRORS = 4
"""Execution errors that each of them is imagined with: what they explain is not learned."""
EVERY = 0.1
"""Time between the samples of the motions that are compared [s]."""


def information_gain(
    view: TopDownView,
    actions: Iterable[Action],
    belief: Belief,
    *,
    imaginer: Imaginer | None = None,
    com: Numbers | None = None,
    seed: int = 0,
) -> Float[np.ndarray, " actions"]:
    """Information that each action's motion is expected to give about the constants that stay [nat].

    The mutual information between the motion as observed and frictions, density and centre of mass, by nested Monte
    Carlo: motions are drawn in worlds of the belief, and each is compared with the others by the likelihood of
    `identify`. The error of the contact, which is drawn anew at each execution, is averaged over. The estimate is at
    most the logarithm of `OBJECTS`, 3.5; halving the standard deviation of one constant takes 0.7.

    Args:
        view: The object from above, in any action frame.
        actions: The actions, in the view's frame.
        belief: What is believed of the constants, with the centre of mass in the view's frame.
        imaginer: Imagines the worlds; by default the predictor that comes with foretrace.
        com: The centre of mass at rest in the view's frame [m]; by default estimated from the view.
        seed: Decides the draws, which are the same for all actions.

    Raises:
        MonitoringError: An argument is of another type, the seed is none, or the imaginer imagines no rotations.
        PredictionError: The view does not show one object that such an action reaches.
    """
    check_type("view", view, TopDownView, MonitoringError)
    check_type("actions", actions, Iterable, MonitoringError, "a list of actions")
    check_type("belief", belief, Belief, MonitoringError, "a Belief, such as one of foretrace.identify")
    check_type("imaginer", imaginer, (Imaginer, type(None)), MonitoringError)
    check_seed(seed)
    imaginer = imaginer or IMAGINERS.find("learned")(None)
    actions = tuple(actions)
    imaginer.imagine_candidates(view, actions, com=com)  # with its checks
    middle = estimate_com(InteractionBatch.from_views([view]))[0]
    if com is not None:
        middle = finite_array("the centre of mass com (x, y, z) [m]", com, (3,), MonitoringError)
    values = _drawn(belief, seed)
    found = []
    for action, place in zip(actions, Candidates(view, actions).enter(middle), strict=True):
        parameters = {name: float(each[0]) for name, each in parameters_of([action]).items()}
        played = play_worlds(imaginer, view.seen_from(action), action, place, values, parameters)
        found.append(_gain(_thinned(played, action.duration), np.random.default_rng(seed)))
    return np.array(found)


def _drawn(belief: Belief, seed: int) -> Mapping[str, Float[np.ndarray, " worlds"]]:
    """Constants of the worlds: each object with the same execution errors, which follow each other."""
    from scipy.stats import qmc  # a fifth of a second to import

    objects = belief.sample(OBJECTS, np.random.default_rng(seed))
    shares = qmc.Sobol(len(EXECUTION), rng=np.random.default_rng(seed)).random(ERRORS)
    low, high = np.array([belief.ranges[name] for name in EXECUTION]).T
    errors = dict(zip(EXECUTION, (low + shares * (high - low)).T, strict=True))
    return {
        name: np.tile(errors[name], OBJECTS) if name in errors else np.repeat(each, ERRORS)
        for name, each in objects.items()
    }


def _thinned(played: ImaginedBatch, duration: float) -> ImaginedBatch:
    """The same with fewer samples, until the action ends."""
    step = max(1, round(EVERY / float(np.median(np.diff(played.times)))))
    count = max(2 * step, int(np.searchsorted(played.times, duration, side="right")))
    kept = slice(0, count, step)
    own = played.futures
    futures = replace(own, states=own.states[:, :, kept], spread=own.spread[:, :, kept])
    pose = None if played.pose is None else played.pose[:, kept]
    return replace(played, times=played.times[kept], com=played.com[:, kept], pose=pose, futures=futures)


def _gain(played: ImaginedBatch, rng: np.random.Generator) -> float:
    """Expected logarithm of how much better a motion is explained by its own object than by all of them."""
    world = ERRORS * np.arange(OBJECTS) + rng.permuted(np.arange(OBJECTS) % ERRORS)
    log = _compared(played, world, rng).reshape(OBJECTS, OBJECTS, ERRORS)
    own = np.diagonal(log, axis1=0, axis2=1).T  # (motions, errors)
    gains = np.logaddexp.reduce(own, axis=1) - np.logaddexp.reduce(log, axis=(1, 2)) + np.log(OBJECTS)
    return max(0.0, float(gains.mean()))


def _compared(
    played: ImaginedBatch, world: Int[np.ndarray, " motions"], rng: np.random.Generator
) -> Float[np.ndarray, "motions worlds"]:
    """Log likelihoods in all worlds of motions of some, with errors as wide as the likelihood expects them."""
    futures, times = played.futures, played.times
    probability = np.where(futures.counted, futures.probability, 0.0)[world]
    share = rng.random((len(world), 1)) * probability.sum(axis=1, keepdims=True)
    slot = (np.cumsum(probability, axis=1) <= share).sum(axis=1)
    states = futures.states[world, slot] * WEIGHTS  # (motions, time, 6)
    width = WIDTH + SPEED_TIME * np.linalg.norm(np.gradient(states, times, axis=1), axis=-1)
    knots = np.arange(0.0, times[-1] + 1 / RATE, 1 / RATE)
    errors = rng.normal(size=(len(knots), len(world), 6)) / np.sqrt(6)
    errors[0] = 0.0  # at rest
    place = times * RATE
    k = np.minimum(place.astype(int), len(knots) - 2)
    part = (place - k)[:, None, None]
    noise = np.swapaxes((1 - part) * errors[k] + part * errors[k + 1], 0, 1)
    states = (states + width[..., None] * noise) / WEIGHTS
    poses = np.concatenate([states[..., :3], rotation_vector_to_quaternion(states[..., 3:])], axis=-1)
    return log_likelihoods(played, times, poses, states[..., 3:], WIDTH)
