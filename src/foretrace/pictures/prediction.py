"""What pictures show of a prediction: the most probable motion, the others, the region; or the truth beside it."""

from dataclasses import replace

import numpy as np

from foretrace.actions import Action
from foretrace.imagined import ImaginedEffect
from foretrace.imagined.futures import carried_poses
from foretrace.imagined.shown import LEVEL, in_order, percentage, radius_of
from foretrace.interactions.record import Interaction
from foretrace.objects import ObjectModel
from foretrace.pictures.bands import PredictionBand
from foretrace.pictures.scene import Ghost, Scene
from foretrace.pictures.style import PREDICTION_COLORS

LARGEST_RADIUS = 0.5
"""A wider region says nothing and is not drawn [m]."""
LEAST_PROBABLE = 0.01
"""Futures less probable than this are not drawn."""
LEAST_MOVING = 0.05
"""The object is not shown moving in futures less probable than this."""


def prediction_band(imagined: ImaginedEffect) -> PredictionBand:
    """What to draw beside the path."""
    futures, radius = imagined.futures, radius_of(imagined)
    if futures.is_point:
        return PredictionBand()
    others = [k for k in in_order(futures)[1:] if futures.probability[0, k] >= LEAST_PROBABLE]
    if radius is not None and radius.max() > LARGEST_RADIUS:
        radius = None
    return PredictionBand(
        imagined.com_trajectory,
        radius,
        LEVEL,
        [
            (f"{futures.outcome[k]} {percentage(futures.probability[0, k])}", futures.com[0, k])
            for k in others
        ],
    )


def other_motions(imagined: ImaginedEffect, T_action_object: np.ndarray) -> list[np.ndarray]:
    """Poses of the object's frame (time, 7) in the futures beside the most probable one, which are probable enough.

    Args:
        imagined: What is predicted.
        T_action_object: Object frame -> action frame at rest.
    """
    futures = imagined.futures
    if futures.is_point:
        return []
    others = [k for k in in_order(futures)[1:] if futures.probability[0, k] >= LEAST_MOVING]
    return [carried_poses(futures.pose[0, k], T_action_object) for k in others]


def scene_of(
    obj: ObjectModel,
    action: Action,
    imagined: ImaginedEffect,
    name: str,
    truth: Interaction | None = None,
) -> Scene:
    """What pictures show of a prediction: the most probable motion and the others; or, if it is known, the truth.

    Args:
        obj: The object.
        action: The action.
        imagined: What is predicted; samples after the action's end are left out.
        name: What the predictor is called.
        truth: The simulated action.
    """
    imagined = imagined.until(action.duration)
    placement, color = action.T_action_object, PREDICTION_COLORS[0]
    pose, paths = imagined.object_poses(placement), {name: imagined.com_trajectory}
    if truth is not None and len(truth.effect.times) > 0:
        scene = replace(
            Scene.observed(truth, paths),
            title=f"Predicted and simulated {action.label}: {truth.effect.outcome}",
        )
        ghosts = [] if pose is None else [Ghost(pose, color, 1.0)]
    else:
        scene = Scene.imagined(obj, action, imagined.times, paths, pose)
        if not imagined.futures.is_point:
            outcome, chance = max(imagined.futures.outcomes().items(), key=lambda item: item[1][0])
            scene = replace(scene, title=f"{scene.title}: {outcome} {percentage(float(chance[0]))}")
        ghosts = [Ghost(motion, color, 1.0) for motion in other_motions(imagined, placement)]
    return replace(scene, band=prediction_band(imagined), ghosts=ghosts)
