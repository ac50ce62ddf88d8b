"""From the motions of many worlds to futures: grouped by outcome and by the edge that the object turned about."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.cluster.hierarchy import fcluster, linkage

from foretrace.actions import LeverUp
from foretrace.geometry import quaternion_to_matrix, rotation_vector_to_quaternion
from foretrace.twin.worlds import Played

EDGES = 2
"""Futures of each outcome: motions about different edges."""
SAME_EDGE = 0.008
"""Edges whose middles are nearer than this are the same [m]."""
SLOTS = tuple(outcome for outcome in LeverUp.outcomes for _ in range(EDGES))
"""Outcome of each future."""


@dataclass(frozen=True, eq=False)
class Gathered:
    """Futures of one action."""

    probability: Float[np.ndarray, " futures"]
    """Share of the worlds."""
    states: Float[np.ndarray, "futures time 6"]
    """Mean motions: centres of mass [m] and rotation vectors since rest [rad]."""
    spread: Float[np.ndarray, "futures time"]
    """Root mean square distance of the worlds' centres of mass from it [m]."""
    support_points: Float[np.ndarray, "futures 2 2"]
    """Ends of the edge that the object turned about [m]; NaN: none."""


def gather(played: Sequence[Played], com: Float[np.ndarray, "3"]) -> Gathered:
    """Futures of one action from the motions of its worlds.

    Args:
        played: The motions, at least one.
        com: Centre of mass at rest in the action frame [m]: the point of the object whose path is wanted.
    """
    states = np.stack([_path_of(each, com) for each in played])
    count = len(SLOTS)
    time = states.shape[1]
    probability, spread = np.zeros(count), np.zeros((count, time))
    means, support = np.zeros((count, time, 6)), np.full((count, 2, 2), np.nan)
    outcomes = np.array([each.outcome for each in played])
    for first, outcome in enumerate(LeverUp.outcomes):
        members = np.flatnonzero(outcomes == outcome)
        edges = _edges([played[k].support_points for k in members.tolist()])
        for number in range(edges.max(initial=-1) + 1):
            slot, mine = EDGES * first + number, members[edges == number]
            probability[slot] = len(mine) / len(played)
            means[slot] = states[mine].mean(axis=0)
            means[slot, 0, :3] = com
            apart = states[mine, :, :3] - means[slot, :, :3]
            spread[slot] = np.sqrt((apart**2).sum(axis=-1).mean(axis=0))
            points = np.array([played[k].support_points for k in mine.tolist()])
            if (seen := np.isfinite(points).all(axis=(1, 2))).any():
                support[slot] = points[seen].mean(axis=0)
    empty, best = probability == 0, int(probability.argmax())
    means[empty], spread[empty] = means[best], spread[best]
    return Gathered(probability, means, spread, support)


def _path_of(played: Played, com: Float[np.ndarray, "3"]) -> Float[np.ndarray, "time 6"]:
    """Path of a point of the object, and rotation: exactly the centre of mass' own where that is the point."""
    rotation = quaternion_to_matrix(rotation_vector_to_quaternion(played.turned))
    path = played.com + rotation @ (com - played.com[0])
    path[0] = com
    return np.concatenate([path, played.turned], axis=1)


def _edges(points: Sequence[Float[np.ndarray, "2 2"]]) -> Int[np.ndarray, " worlds"]:
    """Number of the edge about which the object turned in each world, the most frequent first.

    Worlds without an observed edge go with the most frequent one.
    """
    middles = np.array([each.mean(axis=0) for each in points]).reshape(-1, 2)
    seen = np.isfinite(middles).all(axis=1)
    numbers = np.zeros(len(points), dtype=np.int64)
    if seen.sum() < 2:
        return numbers
    tree = linkage(middles[seen], "average")
    found = fcluster(tree, SAME_EDGE, "distance")
    if found.max() > EDGES:
        found = fcluster(tree, EDGES, "maxclust")
    names, counts = np.unique(found, return_counts=True)
    # Equally frequent ones in the order in which they first occur.
    order = sorted(range(len(names)), key=lambda k: (-counts[k], int(np.argmax(found == names[k]))))
    rank = {names[k]: place for place, k in enumerate(order)}
    numbers[seen] = [rank[name] for name in found]
    return numbers
