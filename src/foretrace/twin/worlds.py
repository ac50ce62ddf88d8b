"""Worlds in which a twin plays an action: what is told is the same in all of them, the rest is drawn."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri
from scipy.stats import qmc

from foretrace.actions import FAILED, LeverUp
from foretrace.errors import ForetraceError, PredictionError, ShapeError, SimulationError
from foretrace.geometry import (
    continuous_rotation_vectors,
    invert_transform,
    quaternion_to_matrix,
    transform_points,
)
from foretrace.interactions.record import NO_OFFSET, ExecutionOffset, Physics
from foretrace.objects import ObjectModel, Prism, Weighted
from foretrace.simulation.engine import make_engine
from foretrace.simulation.lever_up import effect_of
from foretrace.simulation.randomisation import CONSTANTS, FACTORS, Randomisation, reshaped
from foretrace.workers import run_jobs

WAVES = 3
"""Waves round an outline that noise of it consists of: the same all round, a shift, an ellipse, a triangle."""
OFFSETS = ("execution_ahead", "execution_left", "execution_turn")
NAMES = (*CONSTANTS, *FACTORS, *OFFSETS, *(f"wave {k}" for k in range(2 * WAVES + 1)))
"""What is drawn, column by column."""
MIRRORED = ("execution_left", "execution_turn", *(f"wave {k}" for k in range(2, 2 * WAVES + 1, 2)))
"""What changes sides in a mirror: the offsets, and the sines of the waves."""
CHUNK = 8
"""Worlds that a worker process plays in a row."""
MANY = 128
"""Fewer worlds are played in this process: others would take longer to start."""


@dataclass(frozen=True)
class Player:
    """How worlds are played."""

    engine: str
    """Physics engine."""
    embodiment: str
    """``arm``: the whole robot; ``tool``: the tool alone."""
    timestep: float
    """Time step [s]."""
    sample_period: float
    """Time between samples [s]."""
    duration: float
    """Time of a motion [s]."""
    set_down: bool = False
    """Whether the tool goes back the way it came: outcomes are those of the way there."""


@dataclass(frozen=True, eq=False)
class World:
    """One object and one action, as they may be."""

    model: ObjectModel
    """The object."""
    T_action_object: Float[np.ndarray, "4 4"]
    """Its pose at rest in the frame of the action as commanded."""
    action: LeverUp
    """The action; path and tool count, not its place."""
    physics: Physics
    """Friction and density."""
    offset: ExecutionOffset = NO_OFFSET
    """Offset of the executed action from the commanded one."""


@dataclass(frozen=True, eq=False)
class Played:
    """Motion of one world, in the frame of the action as commanded."""

    com: Float[np.ndarray, "time 3"]
    """Centre of mass [m]."""
    turned: Float[np.ndarray, "time 3"]
    """Rotation vector since rest [rad]."""
    outcome: str
    """Outcome, as the action's judge has it."""
    support_points: Float[np.ndarray, "2 2"]
    """Ends of the edge that the object turned about, at rest [m]; NaN: none."""


@lru_cache(maxsize=8)
def draw_shares(count: int, seed: int) -> Float[np.ndarray, "worlds names"]:
    """Quasi-random shares between 0 and 1 (Sobol, scrambled), one row for each world, in pairs of mirror images.

    Args:
        count: Number of worlds, even.
        seed: Decides how they are scrambled.
    """
    sobol = qmc.Sobol(len(NAMES), scramble=True, rng=np.random.default_rng(seed))
    half = sobol.random_base2(max(0, int(np.ceil(np.log2(count / 2)))))[: count // 2]
    other = np.where(np.isin(NAMES, MIRRORED), 1.0 - half, half)
    shares = np.stack([half, other], axis=1).reshape(count, len(NAMES))
    shares.setflags(write=False)
    return shares


def vary(
    world: World,
    told: Sequence[str],
    ranges: Randomisation,
    outline_noise: float,
    shares: Float[np.ndarray, " names"],
) -> World:
    """One world around another one.

    Args:
        world: As told; where something is not told, as it is nominally.
        told: Names that stay as they are.
        ranges: What the rest is drawn from.
        outline_noise: Root mean square distance of the outline from the one that was seen [m].
        shares: Where the values lie within their ranges.
    """
    share = dict(zip(NAMES, shares.tolist(), strict=True))
    drawn = {
        name: limits[0] + share[name] * (limits[1] - limits[0])
        for name in (*CONSTANTS, *FACTORS)
        if name not in told and (limits := getattr(ranges, name)) is not None
    }
    offset = NO_OFFSET
    if "contact_error" not in told:
        offset = ExecutionOffset(*(float(getattr(ranges, name) * (2 * share[name] - 1)) for name in OFFSETS))
    constants = {name: drawn[name] for name in CONSTANTS if name in drawn}
    model = _noisy(world.model, outline_noise * ndtri(np.clip(shares[-2 * WAVES - 1 :], 1e-3, 1 - 1e-3)))
    try:
        model = reshaped(model, *(drawn.get(name, 1.0) for name in FACTORS))
    except ShapeError:  # too thin for such a bevel: it keeps its own
        model = world.model
    physics = replace(world.physics, **constants)
    return replace(world, model=model, physics=physics, offset=offset)


def _noisy(model: ObjectModel, sizes: Float[np.ndarray, " waves"]) -> ObjectModel:
    """A prism whose corners are moved away from its frame's origin or towards it by waves of their direction [m]."""
    if isinstance(model, Weighted):
        return Weighted(_noisy(model.object, sizes), model.com_offset)
    if type(model) is not Prism or not sizes.any():
        return model
    radius = np.linalg.norm(model.corners, axis=1)
    angle = np.arctan2(model.corners[:, 1], model.corners[:, 0])
    waves = [np.ones_like(angle)]
    for k in range(1, WAVES + 1):
        waves += [np.sqrt(2) * np.cos(k * angle), np.sqrt(2) * np.sin(k * angle)]
    out = (sizes / np.sqrt(len(waves))) @ np.array(waves)
    try:
        return Prism(model.corners * (1 + out / np.maximum(radius, 1e-3))[:, None], model.height, model.bevel)
    except ShapeError:
        return model


def play_worlds(player: Player, worlds: Sequence[World], workers: int) -> list[Played | None]:
    """Motions of worlds, in their order; None where the simulation diverged.

    Args:
        player: How they are played.
        worlds: The worlds.
        workers: Processes to share many worlds among.

    Raises:
        PredictionError: A world cannot be played.
    """
    if workers == 1 or len(worlds) < MANY:
        return [play(player, world) for world in worlds]
    chunks = [tuple(worlds[k : k + CHUNK]) for k in range(0, len(worlds), CHUNK)]
    parts = run_jobs(partial(_play_chunk, player), chunks, workers, error=PredictionError, ordered=True)
    return [played for part in parts for played in part]


def _play_chunk(player: Player, worlds: tuple[World, ...]) -> list[Played | None]:
    return [play(player, world) for world in worlds]


def play(player: Player, world: World) -> Played | None:
    """Motion of one world; None where the simulation diverged.

    Raises:
        PredictionError: It cannot be played.
    """
    try:
        engine = make_engine(player.engine, player.embodiment, player.timestep, player.sample_period)
        placed = _placed(world)
        executed = placed if world.offset == NO_OFFSET else placed.moved(**vars(world.offset))
        pose = world.T_action_object if executed is placed else executed.T_action_object
        way = executed.motion_to_rest if player.set_down else executed.tool_motion
        motion = engine.play(world.model, pose, executed.tool, way, player.duration, world.physics)
        effect = effect_of(motion, world.model, executed, world.physics, player.set_down)
    except (SimulationError, ShapeError) as error:
        raise PredictionError(f"the twin cannot play the action: {error}") from error
    if effect.outcome == FAILED:
        return None
    rotation = quaternion_to_matrix(effect.pose_trajectory[:, 3:])
    turned = continuous_rotation_vectors(rotation @ rotation[0].T)
    com, support = effect.com_trajectory, effect.support_points
    if executed is not placed:
        back = world.T_action_object @ invert_transform(pose)
        com, turned = transform_points(back, com), turned @ back[:3, :3].T
        support = transform_points(back, np.column_stack([support, np.zeros(2)]))[:, :2]
    return Played(com, turned, str(effect.outcome), support)


def _placed(world: World) -> LeverUp:
    """The action as commanded, in the object's frame."""
    T_object_action = invert_transform(world.T_action_object)
    return replace(world.action, contact=T_object_action[:2, 3], direction=T_object_action[:2, 0])


def check_player(player: Player) -> None:
    """Refuse an engine that does not exist or cannot be set up so.

    Raises:
        PredictionError: Naming what is wrong.
    """
    try:
        make_engine(player.engine, player.embodiment, player.timestep, player.sample_period)
    except ForetraceError as error:
        raise PredictionError(f"the twin has no such engine: {error}") from error
