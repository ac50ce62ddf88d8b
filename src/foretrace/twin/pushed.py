"""Motions of pushed objects over time, by the quasi-static model, and the futures that they make."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from foretrace.actions import Push
from foretrace.actions.push import LOST_GAP, MISSED, PUSHED, TURNED_AWAY, find_missed
from foretrace.geometry import invert_transform, rotate_plane, rotation_vector_to_quaternion
from foretrace.imagined import LEVELS, Futures, ImaginedBatch, quantiles_of
from foretrace.imagined.futures import FLOOR
from foretrace.simulation.sliding import Footprint, Slide, slide_along

OUTCOMES = (PUSHED, TURNED_AWAY, MISSED)
"""Outcome of each future: the model keeps objects flat."""


@dataclass(frozen=True, eq=False)
class PushWorlds:
    """Worlds in which pushes are played, row by row; all of one object, in its own frame at rest."""

    outline: Float[np.ndarray, "n 2"]
    """Its outline [m]."""
    feet: Float[np.ndarray, "rows feet 2"]
    """Where it touches the table [m]."""
    friction: Float[np.ndarray, " rows"]
    """Friction coefficient between rod and object."""
    start: Float[np.ndarray, "rows 2"]
    """Centre of the rod before each push [m]."""
    motion: Float[np.ndarray, "rows 2"]
    """Displacement of the rod [m]."""
    radius: Float[np.ndarray, " rows"]
    """Radius of the rod [m]."""

    def play(self, steps: int) -> tuple[Slide, Int[np.ndarray, " rows"]]:
        """Motions, and the number of each one's outcome in `OUTCOMES`."""
        footprint = Footprint(self.outline, self.feet)
        found = slide_along(footprint, self.start, self.motion, self.radius, self.friction, steps)
        middle = self.outline.mean(axis=0)
        carried = found.position[:, -1] + rotate_plane(
            np.tile(middle, (len(found.angle), 1)), found.angle[:, -1]
        )
        shift = np.linalg.norm(carried - middle, axis=1)
        missed = find_missed(shift, found.angle[:, -1])
        return found, np.where(missed, 2, np.where(found.gap > LOST_GAP, 1, 0))


def states_over_time(
    found: Slide,
    pushes: list[Push],
    times: Float[np.ndarray, " time"],
    com: Float[np.ndarray, "rows 3"],
    T_action_object: Float[np.ndarray, "rows 4 4"],
) -> Float[np.ndarray, "rows time 6"]:
    """Centre of mass in the frame of each push [m] and rotation vector since rest [rad], at sample times.

    Args:
        found: Motions by the way of the rod, in the object frame at rest.
        pushes: The push of each row: when its rod is where.
        times: Sample times [s].
        com: Centre of mass at rest in the frame of each push [m].
        T_action_object: The object frame at rest in the frame of each push.
    """
    steps = found.angle.shape[1] - 1
    ways = {push.path: push.path.at(times) / push.path.length for push in pushes}
    place = steps * np.array([ways[push.path] for push in pushes])  # (rows, time)
    low = np.clip(place.astype(int), 0, steps - 1)
    share, rows = place - low, np.arange(len(pushes))[:, None]
    angle = (1 - share) * found.angle[rows, low] + share * found.angle[rows, low + 1]
    moved = (1 - share)[..., None] * found.position[rows, low] + share[..., None] * found.position[
        rows, low + 1
    ]
    turn = T_action_object[:, :2, :2]
    T_object_action = np.array([invert_transform(each) for each in T_action_object])
    own = np.einsum("nij,nj->ni", T_object_action[:, :3, :3], com) + T_object_action[:, :3, 3]
    c, s = np.cos(angle), np.sin(angle)
    x, y = own[:, :1], own[:, 1:2]
    moved = moved + np.stack([c * x - s * y - x, s * x + c * y - y], axis=-1)
    states = np.zeros((*place.shape, 6))
    states[..., :3] = com[:, None]
    states[..., :2] += np.einsum("nij,ntj->nti", turn, moved)
    states[..., 5] = angle
    return states


def gather_pushes(
    states: Float[np.ndarray, "pushes worlds time 6"],
    outcome: Int[np.ndarray, "pushes worlds"],
    times: Float[np.ndarray, " time"],
) -> ImaginedBatch:
    """Futures by outcome from the motions of each push in its worlds, with regions that hold as many of these worlds.

    Of a single world, spread and regions are unknown.
    """
    count, worlds, time = states.shape[:3]
    probability = np.stack([(outcome == k).mean(axis=1) for k in range(len(OUTCOMES))], axis=1)
    best = probability.argmax(axis=1)
    means = np.zeros((count, len(OUTCOMES), time, 6))
    spread = np.zeros((count, len(OUTCOMES), time))
    scores = np.zeros((count, worlds))
    for k in range(len(OUTCOMES)):
        mine = (
            outcome == np.where(probability[:, k] > 0, k, best)[:, None]
        )  # what never happens: as the likeliest
        share = mine / mine.sum(axis=1, keepdims=True)
        means[:, k] = np.einsum("nw,nwts->nts", share, states)
        apart = np.linalg.norm(states[..., :3] - means[:, k, None, :, :3], axis=-1)
        spread[:, k] = np.sqrt(np.einsum("nw,nwt->nt", share, apart**2))
        score = (apart / (spread[:, k, None] + FLOOR)).max(axis=2)
        scores = np.where(outcome == k, score, scores)
    if worlds == 1:
        spread[:], quantiles = np.nan, np.full(len(LEVELS), np.nan)
    else:
        quantiles = np.array([quantiles_of(each) for each in scores])
    futures = Futures(
        probability, OUTCOMES, means, spread, np.full((count, len(OUTCOMES), 2, 2), np.nan), quantiles
    )
    likeliest = means[np.arange(count), best]
    pose = np.concatenate([likeliest[..., :3], rotation_vector_to_quaternion(likeliest[..., 3:])], axis=-1)
    return ImaginedBatch(times, likeliest[..., :3], pose, futures)


def with_regions(futures: Futures, errors: Float[np.ndarray, " pushes"]) -> Futures:
    """Futures of single worlds with regions that grow to the errors of pushes that were carried out [m]."""
    usual = float(np.sqrt(np.mean(errors**2)))
    way = np.linalg.norm(futures.com - futures.com[:, :, :1], axis=-1)
    whole = np.maximum(way[..., -1:], FLOOR)
    return replace(
        futures, spread=usual * np.minimum(way / whole, 1.0), quantiles=quantiles_of(errors / (usual + FLOOR))
    )
