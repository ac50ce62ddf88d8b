"""What a page shows in three dimensions, as arrays: motions, tubes, the coloured rim.

All lies in the object's frame at rest.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps

from foretrace.actions import LeverUp, tool_transforms
from foretrace.geometry import invert_transform, pose_to_matrix, transform_points
from foretrace.imagined import ImaginedEffect
from foretrace.imagined.futures import carried_poses
from foretrace.imagined.shown import in_order
from foretrace.objects import ObjectModel
from foretrace.objects.surface import faces_of
from foretrace.pictures.plan import COSTS
from foretrace.planning import RimCost

MOST_FUTURES = 4
"""Futures that are shown, at most."""
LEAST_PROBABLE = 0.02
"""Futures less probable than this are not shown."""
LARGEST_RADIUS = 0.2
"""A tube is drawn no wider than this [m]: a wider region says nothing."""
SIDES = 14
"""Sides of a tube."""
SLOWEST = 1e-4
"""Samples of a path nearer than this to the last one are left out of its tube [m]."""
RIM_GAP, RIM_HEIGHT = 0.008, 0.0015
"""The coloured rim lies this far outside the outline, this far above the table [m]."""
MOST_FACES, MOST_UPRIGHTS = 500, 16
"""An object of more faces is drawn without edges; one of more corners, without upright ones."""

Mesh = tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]
"""Vertices [m], and the corners of triangles."""


@dataclass(frozen=True)
class Moving:
    """One motion of the object."""

    outcome: str
    """What becomes of it."""
    probability: float
    """How probable it is."""
    poses: Float[np.ndarray, "time 4 4"]
    """The object frame over time, relative to where it rests."""
    path: Float[np.ndarray, "time 3"]
    """The centre of mass over time [m]."""
    radius: Float[np.ndarray, " time"] | None = None
    """Radius of the region about the path [m]; None: unknown."""


def shown_times(imagined: ImaginedEffect, action: LeverUp) -> Float[np.ndarray, " time"]:
    """Times of the samples up to the end of the blade's path [s]."""
    return imagined.times[imagined.times <= action.duration + 1e-9]


def futures_of(imagined: ImaginedEffect, action: LeverUp, level: float) -> list[Moving]:
    """The futures that are shown, the most probable one first.

    Args:
        imagined: What was imagined.
        action: The lever-up.
        level: Probability with which a motion stays in the region.
    """
    imagined = imagined.until(action.duration)
    futures, T_action_object = imagined.futures, action.T_action_object
    T_object_action = invert_transform(T_action_object)
    radius = futures.radius(level)[0]
    order = in_order(futures)[:MOST_FUTURES]
    found = []
    for k in order:
        if k != order[0] and futures.probability[0, k] < LEAST_PROBABLE:
            continue
        known = np.isfinite(radius[k]).all()
        poses = carried_poses(futures.pose[0, k], T_action_object)
        found.append(
            Moving(
                futures.outcome[k],
                float(futures.probability[0, k]),
                T_object_action @ pose_to_matrix(poses),
                transform_points(T_object_action, futures.com[0, k]),
                np.minimum(radius[k], LARGEST_RADIUS) if known else None,
            )
        )
    return found


def observed_motion(
    poses: Float[np.ndarray, "time 7"], action: LeverUp, com: Float[np.ndarray, "3"]
) -> Moving:
    """A motion that was simulated or recorded.

    Args:
        poses: Poses of the object's frame in the action frame.
        action: The lever-up.
        com: Centre of mass at rest, in the object's frame [m].
    """
    T_rest_now = invert_transform(action.T_action_object) @ pose_to_matrix(poses)
    return Moving("", 1.0, T_rest_now, T_rest_now[:, :3, :3] @ com + T_rest_now[:, :3, 3])


def tool_poses_of(action: LeverUp, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 4 4"]:
    """Poses of the tool as commanded."""
    return invert_transform(action.T_action_object) @ tool_transforms(action.tool_motion(times))


def tube(path: Float[np.ndarray, "time 3"], radius: Float[np.ndarray, " time"]) -> Mesh:
    """The surface about a path, round at both ends.

    Args:
        path: Points [m]; those that hardly differ from the one before are left out.
        radius: Radius at each of them [m].
    """
    kept = [0]
    for k in range(1, len(path)):
        if np.linalg.norm(path[k] - path[kept[-1]]) > SLOWEST:
            kept.append(k)
    centres, wide = path[kept], radius[kept]
    if len(kept) == 1:  # nothing moves
        centres, wide = (
            np.concatenate([centres, centres + np.array([0, 0, SLOWEST])]),
            np.repeat(radius.max(), 2),
        )
    tangents = np.gradient(centres, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    sides = np.empty_like(tangents)
    side = np.cross(tangents[0], np.array([0.0, 0.0, 1.0] if abs(tangents[0, 2]) < 0.9 else [1.0, 0.0, 0.0]))
    for k, ahead in enumerate(tangents):
        side = side - (side @ ahead) * ahead  # carried along without twist
        side = sides[k] = side / max(float(np.sqrt(side @ side)), 1e-12)
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    around = (
        np.cos(angles)[:, None] * sides[:, None]
        + np.sin(angles)[:, None] * np.cross(tangents, sides)[:, None]
    )
    # Rings along the path, and smaller ones beyond its ends.
    share = np.array([0.15, 0.6, 0.9])
    beyond = np.sqrt(1 - share**2)
    count = len(centres)
    which = np.concatenate([[0] * 3, np.arange(count), [count - 1] * 3])
    back = np.concatenate([-beyond, np.zeros(count), beyond[::-1]])
    small = np.concatenate([share, np.ones(count), share[::-1]])
    offsets = back[:, None, None] * tangents[which][:, None] + small[:, None, None] * around[which]
    rings = centres[which][:, None] + wide[which][:, None, None] * offsets
    rings[..., 2] = np.maximum(rings[..., 2], min(0.0, centres[:, 2].min()))  # nothing is below the table
    here = np.arange(SIDES)
    after = np.roll(here, -1)
    quads = np.concatenate(
        [np.column_stack([here, after, after + SIDES]), np.column_stack([here, after + SIDES, here + SIDES])]
    )
    faces = np.concatenate([quads + SIDES * k for k in range(len(rings) - 1)])
    return rings.reshape(-1, 3), faces


def rim_segments(
    rim: RimCost, outline: Float[np.ndarray, "corners 2"]
) -> tuple[Float[np.ndarray, "n 2 3"], Int[np.ndarray, "n 2 3"]]:
    """The rim around an object in the colours of its cost.

    Args:
        rim: Cost of the contacts.
        outline: The object's outline [m], counter-clockwise.

    Returns:
        Ends of segments [m], and their colours, 0 to 255.
    """
    starts, ends = outline, np.roll(outline, -1, axis=0)
    lengths = np.linalg.norm(ends - starts, axis=1)
    before = np.concatenate([[0.0], np.cumsum(lengths)])
    way = (ends - starts) / lengths[:, None]
    shares = np.einsum("nek,ek->ne", rim.points[:, None] - starts, way)
    near = starts + np.clip(shares, 0, lengths)[..., None] * way
    edge = np.linalg.norm(near - rim.points[:, None], axis=-1).argmin(axis=1)
    rows = np.arange(len(edge))
    along = before[edge] + np.clip(shares[rows, edge], 0, lengths[edge])
    order = np.argsort(along)
    outward = np.column_stack([way[:, 1], -way[:, 0]])[edge[order]]
    points = np.column_stack([rim.points[order] + RIM_GAP * outward, np.full(len(order), RIM_HEIGHT)])
    low, high = float(rim.cost.min()), float(rim.cost.max())
    worse = (rim.cost[order] - low) / max(high - low, 1e-9)
    colours = (255 * colormaps[COSTS](worse)[:, :3]).round().astype(int)
    pairs = np.column_stack([np.arange(len(order)), np.roll(np.arange(len(order)), -1)])
    gap = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    pairs = pairs[gap < 4 * max(float(np.median(gap)), 1e-6)]  # where nothing is free, the rim is open
    return points[pairs], colours[pairs]


def edges_of(obj: ObjectModel) -> Float[np.ndarray, "n 2 3"]:
    """Edges of an object that are worth drawing: of flat faces, and no uprights of what is round [m]."""
    faces = faces_of(obj)
    if len(faces) > MOST_FACES:
        return np.zeros((0, 2, 3))
    sharp = len(obj.corners) <= MOST_UPRIGHTS
    found = [np.stack([face, np.roll(face, -1, axis=0)], axis=1) for face in (faces if sharp else faces[:2])]
    return np.concatenate(found)
