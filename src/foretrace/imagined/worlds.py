"""Many worlds: one action imagined under draws of a belief, and under what may be wrong with it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from foretrace.actions import Action
from foretrace.geometry import (
    invert_transform,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from foretrace.imagined.belief import COM, EXECUTION
from foretrace.imagined.context import CONSTANTS, EXACT
from foretrace.imagined.futures import Futures, ImaginedBatch
from foretrace.interactions.batch import Candidates
from foretrace.interactions.topdown import TopDownView

if TYPE_CHECKING:
    from foretrace.imagined.imaginer import Imaginer

IMPROBABLE = 0.02
"""Motions that are less probable than this in their world are left out."""
MISSED, PHYSICS, OBJECT = "missed contact", "other physics", "other object"
"""Causes that are imagined in worlds of their own."""
SHARE = 64
"""Worlds of the belief for each world of a variant of a cause."""
FAR_CONTACT, FAR_COM = 0.0075, 0.02
"""Contact error and offset of the centre of mass in these worlds [m]."""
EIGHT = [(np.cos(angle), np.sin(angle)) for angle in np.pi / 4 * np.arange(8)]
VARIANTS: dict[str, list[dict[str, float]]] = {
    MISSED: [
        {"contact_ahead": FAR_CONTACT * x, "contact_left": FAR_CONTACT * y} for x, y in EIGHT if x < 0.5
    ],
    PHYSICS: [
        {"friction": f, "tool_friction": g} for f, g in ((2.0, 2.0), (0.5, 0.5), (1.0, 0.4), (1.0, 2.0))
    ],
    OBJECT: [{"com_x": FAR_COM * x, "com_y": FAR_COM * y} for x, y in EIGHT],
}
"""What is different in them: frictions by factors, all else by what is added."""


@dataclass(frozen=True, eq=False)
class Worlds:
    """Motions of one action in many worlds, in the frame of the action as commanded."""

    futures: Futures
    """All motions as one row; probabilities of those without a cause sum to 1, and so do those of each cause."""
    causes: tuple[str, ...]
    """What is wrong in the world of each motion; empty: nothing, it is as believed."""
    values: Mapping[str, Float[np.ndarray, " worlds"]]
    """Constants of the worlds, by name [SI]."""
    world: np.ndarray
    """(motions,) World of each motion, as row of ``values`` (int)."""


def wrong_worlds(drawn: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Draws of a belief, followed by worlds in which something is wrong, and the cause of each."""
    count = len(drawn["friction"])
    number = max(1, count // SHARE)
    values = {name: [each] for name, each in drawn.items()}
    causes = [""] * count
    for cause, variants in VARIANTS.items():
        for k, variant in enumerate(variants):
            rows = (np.arange(number) + number * k) % count
            for name, each in drawn.items():
                change = variant.get(name, 1.0 if "friction" in name else 0.0)
                values[name].append(each[rows] * change if "friction" in name else each[rows] + change)
            causes += [cause] * number
    return {name: np.concatenate(parts) for name, parts in values.items()}, tuple(causes)


def play_worlds(
    imaginer: "Imaginer",
    view: TopDownView,
    action: Action,
    com: Float[np.ndarray, "3"],
    values: Mapping[str, Float[np.ndarray, " worlds"]],
    parameters: Mapping[str, float],
) -> ImaginedBatch:
    """Effects of one action in worlds, in the frame of the action as commanded.

    Args:
        imaginer: The imaginer; constants that it is not conditioned on do not count.
        view: The object from above, in the action frame.
        action: The action; its place in the object frame says how that is turned.
        com: Centre of mass at rest in the action frame [m].
        values: Constants of the worlds, as those of a `Belief` [SI].
        parameters: Parameters of the action's path.
    """
    from foretrace.imagined.imaginer import Scenes

    count = len(values["friction"])
    own = replace(action, contact=np.zeros(2), direction=np.array([1.0, 0.0]))
    offsets = np.column_stack([values[name] for name in EXECUTION])
    actions = tuple(own if not row.any() else own.moved(*row.tolist()) for row in offsets)
    places = np.tile(com, (count, 1))
    shift = np.column_stack([values[name] for name in COM])
    places[:, :2] += shift @ action.T_action_object[:2, :2].T
    T_moved_own = np.array([each.T_action_object for each in actions])
    told = {name: values[name] for name in CONSTANTS if name in values} | {EXACT: np.zeros(count)}
    context = np.full((count, len(imaginer.context)), np.nan)
    for column, name in enumerate(imaginer.context):
        context[:, column] = told.get(name, parameters.get(name, np.nan))
    candidates = Candidates(view, actions)
    there = np.einsum("nij,nj->ni", T_moved_own[:, :3, :3], places) + T_moved_own[:, :3, 3]
    context = imaginer.as_seen(context, candidates)
    imagined = imaginer.imagine_scenes(Scenes(candidates, there, context, "observed", actions=actions))
    return replace(imagined, futures=_moved_back(imagined.futures, T_moved_own))


def _moved_back(futures: Futures, T_moved_own: Float[np.ndarray, "worlds 4 4"]) -> Futures:
    """Futures of moved actions in the frame of the action as commanded."""
    back = np.array([invert_transform(each) for each in T_moved_own])
    turn, place = back[:, :3, :3], back[:, None, None, :3, 3]
    com = np.einsum("nij,nktj->nkti", turn, futures.states[..., :3]) + place
    turned = np.einsum("nij,nktj->nkti", turn, futures.states[..., 3:])
    points = np.einsum("nij,nkej->nkei", turn[:, :2, :2], futures.support_points) + place[..., :2]
    return replace(futures, states=np.concatenate([com, turned], axis=-1), support_points=points)


def gather_worlds(
    imagined: ImaginedBatch, values: Mapping[str, np.ndarray], causes: tuple[str, ...]
) -> Worlds:
    """All sufficiently probable motions of all worlds."""
    found = imagined.futures
    named = np.array(causes)
    share = np.zeros(len(named))
    for cause in set(causes):
        share[named == cause] = 1 / np.sum(named == cause)
    kept = found.counted & (found.probability >= IMPROBABLE)
    world, slot = np.nonzero(kept)
    probability = found.probability[kept] * share[world]
    for cause in set(causes):
        mine = named[world] == cause
        probability[mine] /= probability[mine].sum()
    futures = Futures(
        probability=probability[None],
        outcome=tuple(found.outcome[k] for k in slot),
        states=found.states[kept][None],
        spread=found.spread[kept][None],
        support_points=found.support_points[kept][None],
        quantiles=np.full(0, np.nan),
    )
    return Worlds(futures, tuple(named[world].tolist()), dict(values), world)


def average_worlds(futures: Futures, worlds: int, com: Float[np.ndarray, "actions 3"]) -> Futures:
    """Futures averaged over worlds, slot by slot: probabilities, motions of one point of the object, spreads.

    Args:
        futures: Rows: the worlds of each action, one action after the other.
        worlds: Number of worlds of each action.
        com: The point whose motion is wanted: centre of mass at rest in each action's frame [m].
    """
    count = len(futures) // worlds
    futures = _aligned(futures, worlds)
    weight = futures.probability.reshape(count, worlds, -1)
    share = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-30)
    states = _carried(futures.states, np.repeat(com, worlds, axis=0)).reshape(
        count, worlds, *futures.states.shape[1:]
    )
    mean = np.einsum("nwk,nwkts->nkts", share, states)
    apart = ((states[..., :3] - mean[:, None, ..., :3]) ** 2).sum(axis=-1)
    own = np.nan_to_num(futures.spread).reshape(count, worlds, *futures.spread.shape[1:]) ** 2
    spread = np.sqrt(np.einsum("nwk,nwkt->nkt", share, apart + own))
    points = np.nan_to_num(futures.support_points).reshape(count, worlds, *futures.support_points.shape[1:])
    seen = np.isfinite(futures.support_points).all(axis=(2, 3)).reshape(count, worlds, -1)
    with np.errstate(invalid="ignore"):
        points = np.einsum("nwk,nwkij->nkij", seen, points) / seen.sum(axis=1)[..., None, None]
    wide = futures.quantiles
    if wide.ndim == 2:
        wide = wide.reshape(count, worlds, -1).max(axis=1)
    return Futures(weight.mean(axis=1), futures.outcome, mean, spread, points, wide)


def _aligned(futures: Futures, worlds: int) -> Futures:
    """Futures whose slots stand for the same pivot edge in all worlds of an action, where an outcome has two."""
    middles = futures.support_points.mean(axis=2)  # (rows, futures, 2)
    order = np.tile(np.arange(len(futures.outcome)), (len(futures), 1))
    for outcome in set(futures.outcome):
        slots = [k for k, name in enumerate(futures.outcome) if name == outcome]
        if len(slots) != 2:
            continue
        own = middles[:, slots].reshape(-1, worlds, 2, 2)
        seen = np.isfinite(own).all(axis=(2, 3))
        edges, swap = own[:, :1], np.zeros(own.shape[:2], dtype=bool)
        for _ in range(2):  # each world's two edges go with the nearer ones of the mean edges
            straight, swapped = (
                np.linalg.norm(each - edges, axis=-1).sum(axis=-1) for each in (own, own[:, :, ::-1])
            )
            swap = seen & (swapped < straight)
            sorted_own = np.where(swap[..., None, None], own[:, :, ::-1], own)
            edges = np.nan_to_num(sorted_own).mean(axis=1, keepdims=True)
        rows = np.flatnonzero(swap.ravel())
        order[rows[:, None], np.array(slots)] = slots[::-1]
    if (order == np.arange(len(futures.outcome))).all():
        return futures
    rows = np.arange(len(futures))[:, None]
    names = ("probability", "states", "spread", "support_points")
    return replace(futures, **{name: getattr(futures, name)[rows, order] for name in names})


def _carried(
    states: Float[np.ndarray, "rows futures time 6"], point: Float[np.ndarray, "rows 3"]
) -> Float[np.ndarray, "rows futures time 6"]:
    """Motions of another point of the object than the one whose positions are given."""
    off = point[:, None, None] - states[:, :, :1, :3]
    if np.abs(off).max() < 1e-6:
        return states
    rotation = quaternion_to_matrix(rotation_vector_to_quaternion(states[..., 3:]))
    com = states[..., :3] + np.einsum(
        "nktij,nktj->nkti", rotation, np.broadcast_to(off, states[..., :3].shape)
    )
    return np.concatenate([com, states[..., 3:]], axis=-1)
