"""How good it is where an object lies, for goals about an object at rest."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from foretrace.geometry import invert_transform, matrix_to_pose, transform_points
from foretrace.imagined import Futures, estimate_com
from foretrace.imagined.observed import rotations_since_rest
from foretrace.interactions.batch import InteractionBatch
from foretrace.planning.candidates import Scene
from foretrace.planning.goals import Goal
from foretrace.planning.motions import Motions
from foretrace.planning.scores import score

SURE = 0.5
"""A goal counts as reached from this probability on."""


class Rest(NamedTuple):
    """What a goal makes of where an object lies."""

    cost: float
    """The goal's cost."""
    reached: bool
    """Whether it is reached."""
    broken: tuple[str, ...]
    """What must not happen, and has."""


def com_of(scene: Scene) -> Float[np.ndarray, "3"]:
    """Centre of mass before the first action, in the goal's frame [m]."""
    if scene.com_start is not None:
        return scene.com_start
    if scene.com is not None:
        return scene.com
    middle = estimate_com(InteractionBatch.from_views([scene.view]))[0]
    return transform_points(invert_transform(scene.T_view_object), middle[None])[0]


def judge_rest(
    goal: Goal,
    scene: Scene,
    com: Float[np.ndarray, "3"],
    T_start_now: Float[np.ndarray, "4 4"],
    outcome: str = "at rest",
) -> Rest:
    """What a goal makes of where an object lies now.

    Args:
        goal: The goal, in the object's frame at the start.
        scene: The object as it was first seen; its outline and height count.
        com: Its centre of mass at the start [m].
        T_start_now: The object's frame now in that at the start.
        outcome: Outcome of the last action.
    """
    poses = np.array([np.eye(4), T_start_now])
    way = transform_points(T_start_now, com[None])[0]
    futures = Futures.point(
        np.array([[com, way]]), rotations_since_rest(matrix_to_pose(poses))[None], outcome
    )
    motions = Motions(
        (), np.array([0.0, 1.0]), futures.com, futures.states[..., 3:], futures, np.array([1]), scene.outline,
        scene.height,
    )  # fmt: skip
    found = score(goal, motions, "expected", 1.0)
    broken = tuple(each.name for each in goal.constraints() if each.happens(motions)[0, 0])
    return Rest(float(found.cost[0]), bool(found.reached[0] >= SURE), broken)
