"""Quasi-static pushes of a flat object, many at once.

Friction alone determines how it slides, as it does at a few centimetres a second (M. T. Mason, Mechanics and Planning
of Manipulator Pushing Operations, 1986).

The object touches the table at feet that each carry a share of its weight. While it slides, the friction at each foot
is opposite to that foot's velocity; of all motions that the rod allows, the one that dissipates least takes place
(S. Goyal, A. Ruina, J. Papadopoulos, Planar sliding with dry friction, 1991). The mass of the object, the speed of the
rod and the friction coefficient of the table have no influence.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from foretrace.geometry import rotate_plane

SMOOTHING = 1e-3
"""Feet slower than this share of the rod's speed are smoothed over."""
FIRST = 4
"""Factor on the iterations of a push in its first step in contact, and after a change of how it slides."""

Plane = Float[np.ndarray, "pushes 2"]


@dataclass(frozen=True)
class Footprint:
    """A flat object as it lies on the table."""

    outline: Float[np.ndarray, "n 2"]
    """Corners, counter-clockwise, in the object frame [m]; the rod meets a dent at one point at a time."""
    feet: Float[np.ndarray, "*pushes feet 2"]
    """Where it touches the table, with equal shares of its weight, in the object frame [m]; in each push elsewhere, or
    the same in all."""


class Slide(NamedTuple):
    """Motions of pushed objects, after each step; the first is rest."""

    position: Float[np.ndarray, "pushes steps_and_one 2"]
    """Displacement of the object frame's origin, in the object frame at rest [m]."""
    angle: Float[np.ndarray, "pushes steps_and_one"]
    """Turn to the left [rad]."""
    gap: Float[np.ndarray, " pushes"]
    """Distance of the rod's surface from the object at the end [m]; below 0 where it has entered."""


class _Contact(NamedTuple):
    """Where the rod touches the objects, in their own frames."""

    point: Plane
    normal: Plane
    """Unit vector from the rod into the object."""
    depth: Float[np.ndarray, " pushes"]
    """How far the rod has entered [m]; negative: a gap."""


class _Memory(NamedTuple):
    """Last solutions, from which the next step starts."""

    turning: Float[np.ndarray, " pushes"]
    """Turn per distance of the rod's, while the rod sticks [rad/m]."""
    sliding: Plane
    """Slip and turn while the rod slides along the object."""
    side: Int[np.ndarray, " pushes"]
    """Side to which the rod slides: -1, 1, or 0 if it sticks."""
    new: Bool[np.ndarray, " pushes"]
    """Whether the rod has not touched the object yet."""


def slide(
    footprint: Footprint,
    start: Plane,
    motion: Plane,
    radius: float | Float[np.ndarray, " pushes"],
    friction: float | Float[np.ndarray, " pushes"],
    steps: int = 60,
    iterations: int = 6,
) -> tuple[Plane, Float[np.ndarray, " pushes"]]:
    """Final poses of an object that a vertical rod pushes along straight lines; arguments as of `slide_along`.

    Returns:
        Displacement of the object frame's origin [m] and turn to the left [rad] of each push, in the object frame at
        rest.
    """
    found = slide_along(footprint, start, motion, radius, friction, steps, iterations)
    return found.position[:, -1], found.angle[:, -1]


def slide_along(
    footprint: Footprint,
    start: Plane,
    motion: Plane,
    radius: float | Float[np.ndarray, " pushes"],
    friction: float | Float[np.ndarray, " pushes"],
    steps: int = 60,
    iterations: int = 6,
) -> Slide:
    """Motions of an object that a vertical rod pushes along straight lines.

    Args:
        footprint: The object.
        start: Centre of the rod before each push, in the object frame at rest [m].
        motion: Displacement of the rod in each push, in the same frame [m].
        radius: Radius of the rod [m].
        friction: Friction coefficient between rod and object.
        steps: Steps into which each push is cut.
        iterations: Iterations of the solver in a step.
    """
    count = len(start)
    friction = np.broadcast_to(friction, count)
    feet = np.broadcast_to(footprint.feet, (count, *footprint.feet.shape[-2:]))
    positions, angles = np.zeros((count, steps + 1, 2)), np.zeros((count, steps + 1))
    position, angle = np.zeros((count, 2)), np.zeros(count)
    memory = _Memory(
        np.zeros(count), np.zeros((count, 2)), np.zeros(count, dtype=int), np.ones(count, dtype=bool)
    )
    for step in range(1, steps + 1):
        rod = rotate_plane(start + motion * (step / steps) - position, -angle)
        contact = _touch(footprint.outline, rod, radius)
        rows = np.flatnonzero(contact.depth > 0)
        if len(rows):
            touching = _Contact(*(values[rows] for values in contact))
            advance = rotate_plane(motion[rows] / steps, -angle[rows])
            shift, turn = _follow(feet[rows], touching, advance, friction[rows], iterations, rows, memory)
            position[rows] += rotate_plane(shift, angle[rows] + turn / 2)
            angle[rows] += turn
        positions[:, step], angles[:, step] = position, angle
    end = _touch(footprint.outline, rotate_plane(start + motion - position, -angle), radius)
    return Slide(positions, angles, -end.depth)


def _touch(
    outline: Float[np.ndarray, "n 2"], rod: Plane, radius: float | Float[np.ndarray, " pushes"]
) -> _Contact:
    """The point of an outline that is nearest to each rod."""
    along = np.roll(outline, -1, axis=0) - outline
    lengths = np.linalg.norm(along, axis=1)
    from_corner = rod[:, None] - outline  # (pushes, edges, 2)
    share = np.clip((from_corner * along).sum(axis=-1) / lengths**2, 0.0, 1.0)
    towards = outline + share[..., None] * along - rod[:, None]
    rows, edge = np.arange(len(rod)), (towards**2).sum(axis=-1).argmin(axis=1)
    towards = towards[rows, edge]
    distance = np.linalg.norm(towards, axis=1)
    inside = shapely.contains_xy(shapely.Polygon(outline), *rod.T)
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1) / lengths[:, None]
    straight = np.where(inside, -1.0, 1.0)[:, None] * towards / np.maximum(distance, 1e-12)[:, None]
    normal = np.where((distance < 1e-7)[:, None], inward[edge], straight)
    return _Contact(rod + towards, normal, radius - np.where(inside, -distance, distance))


def _follow(
    feet: Float[np.ndarray, "touching feet 2"],
    contact: _Contact,
    advance: Plane,
    friction: Float[np.ndarray, " touching"],
    iterations: int,
    rows: Int[np.ndarray, " touching"],
    memory: _Memory,
) -> tuple[Plane, Float[np.ndarray, " touching"]]:
    """Motion of objects in one step: the rod leaves them along the normal, and may slide along them.

    Args:
        feet: Where the object touches the table.
        contact: Where the rod has entered it.
        advance: Motion of the rod in this step, in the object frame [m].
        friction: Friction coefficient between rod and object.
        iterations: Iterations of the solver.
        rows: Numbers of the pushes.
        memory: Last solutions of all pushes; changed.

    Returns:
        Displacement of the origin in the object frame [m] and turn [rad].
    """
    normal = contact.normal
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    along = (advance * tangent).sum(axis=1)
    size = np.maximum(np.hypot(contact.depth, along), 1e-12)
    velocity = (normal * contact.depth[:, None] + tangent * along[:, None]) / size[:, None]
    arms = feet - contact.point[:, None]
    levers = np.stack(
        [-arms[..., 1], arms[..., 0]], axis=-1
    )  # velocity of each foot by a turn about the contact
    more = FIRST if memory.new[rows].any() else 1
    turning = _stick(velocity, levers, memory.turning[rows], more * iterations)
    memory.turning[rows], memory.new[rows] = turning, False
    force = _friction(velocity[:, None] + turning[:, None, None] * levers)
    pressing, dragging = (force * normal).sum(axis=1), (force * tangent).sum(axis=1)
    side = np.where(np.abs(dragging) > friction * pressing, np.sign(dragging), 0.0).astype(int)
    slips = np.flatnonzero(side)
    if len(slips):
        n, sides = normal[slips], side[slips]
        edge = n + (friction[slips] * sides)[:, None] * tangent[slips]  # of the friction cone
        changed = memory.side[rows[slips]] != sides
        first = memory.sliding[rows[slips]]
        first[changed] = np.column_stack([np.zeros(changed.sum()), turning[slips][changed]])
        more = FIRST if changed.any() else 1
        found, at_contact = _slip(edge, levers[slips], first, more * iterations)
        memory.sliding[rows[slips]] = found
        scale = (velocity[slips] * n).sum(axis=1) / np.maximum((at_contact * n).sum(axis=1), 1e-6)
        velocity[slips], turning[slips] = at_contact * scale[:, None], found[:, 1] * scale
    memory.side[rows] = side
    point = contact.point
    origin = velocity + turning[:, None] * np.stack([point[:, 1], -point[:, 0]], axis=1)
    return origin * size[:, None], turning * size


def _friction(velocities: Float[np.ndarray, "pushes feet 2"]) -> Plane:
    """Force that moves all feet, as a share of the greatest that friction has."""
    speeds = np.sqrt((velocities**2).sum(axis=-1, keepdims=True) + SMOOTHING**2)
    return (velocities / speeds).mean(axis=1)


def _stick(
    velocity: Plane,
    levers: Float[np.ndarray, "pushes feet 2"],
    turning: Float[np.ndarray, " pushes"],
    iterations: int,
) -> Float[np.ndarray, " pushes"]:
    """Turn with the least dissipation at a given velocity of the contact point, by iteratively reweighted squares."""
    squares, mixed = (levers**2).sum(axis=-1), (levers * velocity[:, None]).sum(axis=-1)
    own = (velocity**2).sum(axis=1)[:, None] + SMOOTHING**2
    for _ in range(iterations):
        rate = turning[:, None]
        weights = 1 / np.sqrt(own + 2 * rate * mixed + rate**2 * squares)
        turning = -(weights * mixed).sum(axis=1) / (weights * squares).sum(axis=1)
    return turning


def _slip(
    edge: Plane, levers: Float[np.ndarray, "pushes feet 2"], found: Plane, iterations: int
) -> tuple[Plane, Plane]:
    """Motion under a force of a given direction, with the power 1 for a force of that length.

    Args:
        edge: Direction of the force at the contact.
        levers: Velocity of each foot by a turn about the contact.
        found: Velocity of the contact across the force, and turn: a first guess.
        iterations: Iterations of the solver.

    Returns:
        Velocity across the force and turn, and velocity of the contact.
    """
    squared = (edge**2).sum(axis=1, keepdims=True)
    forward, across = edge / squared, np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.sqrt(squared)
    squares = (levers**2).sum(axis=-1)
    sideways, ahead = ((levers * v[:, None]).sum(axis=-1) for v in (across, forward))
    for _ in range(iterations):
        speeds = forward[:, None] + found[:, :1, None] * across[:, None] + found[:, 1:, None] * levers
        weights = 1 / np.sqrt((speeds**2).sum(axis=-1) + SMOOTHING**2)
        a, b, c = weights.sum(axis=1), (weights * sideways).sum(axis=1), (weights * squares).sum(axis=1)
        right = -(weights * ahead).sum(axis=1)
        found = np.stack([-b * right, a * right], axis=1) / (a * c - b**2)[:, None]
    return found, forward + found[:, :1] * across
