"""Play the action, judge and record the effect (paper, section 4)."""

from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from importlib.metadata import version
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from foretrace.actions import LeverUp, Stroke, ToolPath
from foretrace.errors import SimulationError
from foretrace.geometry import (
    continuous_quaternions,
    invert_transform,
    matrix_to_pose,
    pose_to_matrix,
    quaternion_to_matrix,
    transform_points,
)
from foretrace.interactions.outcomes import lifted_samples, name_outcome
from foretrace.interactions.record import (
    AS_TOLD,
    Effect,
    Interaction,
    Misplacement,
    Outcome,
    Physics,
    Provenance,
)
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel
from foretrace.simulation.engine import ENGINES, Engine, Motion
from foretrace.simulation.tool import Tool

CAMERAS = ("exact", "rgbd")
PHYSICS_RANGES = {"friction": (0.0, 10.0), "tool_friction": (0.0, 10.0), "density": (1.0, 100_000.0)}
"""What is simulated: friction coefficients, densities of anything solid [kg/m^3]."""
OFF_SAMPLES = 2
"""So many samples in a row off the blade are a slip; one alone is a bounce."""
FALL_DEPTH = 0.5
"""The record of a falling object ends this far below the table top, above the floor [m]."""
CORNER_REACH = 0.004
"""A table contact belongs to a corner within this distance [m]."""
SUPPORT_SHARE = 0.5
"""A support corner carries the object in at least this share of the lifted samples."""


@lru_cache(maxsize=4)
def make_engine(name: str, embodiment: str, timestep: float, sample_period: float) -> Engine:
    """The engine of a name.

    Args:
        name: One of ENGINES.
        embodiment: ``arm`` or ``tool``.
        timestep: Time step [s].
        sample_period: Time between recorded samples [s].

    Raises:
        SimulationError: If there is no such engine.
    """
    if name == "mujoco":
        from foretrace.simulation.mujoco_engine import MujocoEngine

        return MujocoEngine(embodiment, timestep, sample_period)
    if name == "bullet":
        from foretrace.simulation.bullet_engine import BulletEngine

        return BulletEngine(embodiment, timestep, sample_period)
    raise SimulationError(f"engine {name!r} is unknown: choose one of {', '.join(ENGINES)}")


@dataclass(frozen=True)
class SimulationConfig:
    """How lever-ups are simulated."""

    engine: str = "mujoco"
    """Physics engine."""
    embodiment: str = "arm"
    """``arm``: the whole robot; ``tool``: the blade alone on the same path."""
    camera: str = "exact"
    """``exact``: the view from geometry; ``rgbd``: from a rendered depth image."""
    timestep: float = 0.002
    """Time step [s]."""
    sample_period: float = 0.05
    """Time between recorded samples [s]."""
    path: ToolPath = field(default_factory=ToolPath)
    """The blade's path."""
    watch_time: float = 0.0
    """How long the object is watched on after the path's end, while the blade stands still [s]."""
    tool: Tool = field(default_factory=Tool)
    """The screwdriver."""
    physics: Physics = field(default_factory=Physics)
    """Friction and density."""

    def __post_init__(self) -> None:
        if not 0 <= self.watch_time <= 60:
            raise SimulationError(f"watch_time = {self.watch_time} s is outside 0 to 60 s")
        if self.physics.table_edge is not None and not 0 < self.physics.table_edge <= 10:
            raise SimulationError(f"table_edge = {self.physics.table_edge} m: give a distance up to 10 m")
        if not 0 <= self.physics.rolling_friction <= 0.1:
            raise SimulationError(
                f"rolling_friction = {self.physics.rolling_friction} m is outside 0 to 0.1 m: "
                "it is a lever arm, a tenth of a millimetre on a hard table"
            )
        for name, (low, high) in PHYSICS_RANGES.items():
            if not low <= getattr(self.physics, name) <= high:
                raise SimulationError(
                    f"{name} = {getattr(self.physics, name)} is outside {low:g} to {high:g}: check its unit"
                )
        make_engine(self.engine, self.embodiment, self.timestep, self.sample_period)
        if self.camera not in CAMERAS:
            raise SimulationError(f"camera {self.camera!r} is unknown: choose one of {', '.join(CAMERAS)}")


def simulate_lever_up(
    obj: ObjectModel,
    action: LeverUp,
    config: SimulationConfig = SimulationConfig(),
    *,
    seed: int = 0,
    id: int = 0,
    misplacement: Misplacement = AS_TOLD,
) -> Interaction:
    """Simulates one lever-up and records it.

    Args:
        obj: The object.
        action: Where and which way it is levered up.
        config: How.
        seed: Seed of the interaction's random draws (camera noise); the physics draws nothing.
        id: Number of the interaction within its data set.
        misplacement: How far from what it is told the blade acts. View and effect stay in the told frame; joint
            angles are those that were played.

    Returns:
        The interaction; its outcome is ``failed`` and its trajectories are empty if the simulation diverged.

    Raises:
        SimulationError: If the machine cannot render the view.
        ActionError: If the contact is not on the outline, or the arm cannot follow the path.
        ViewError: If the object does not fit in the view.
    """
    action.check_contact(obj)
    engine = make_engine(config.engine, config.embodiment, config.timestep, config.sample_period)
    if config.camera == "exact":
        view = TopDownView.of(obj, action)
    else:
        # Loads OpenGL, which the exact camera does without.
        from foretrace.simulation.camera import take_rgbd

        view = take_rgbd(obj, action, seed=seed).view()
    path = replace(config.path, hold_time=config.path.hold_time + config.watch_time)
    done = action if misplacement == AS_TOLD else action.moved(**asdict(misplacement))
    motion = engine.play(obj, done, path, config.tool, config.physics)
    effect = judge(motion, obj, done, config.physics)
    if done is not action:
        effect = _transformed(effect, action.T_action_object @ invert_transform(done.T_action_object))
    return Interaction(
        object=obj,
        action=action,
        view=view,
        effect=effect,
        physics=config.physics,
        provenance=Provenance(
            source="simulated",
            engine=engine.name,
            embodiment=config.embodiment,
            seed=seed,
            versions=_versions(engine.library),
        ),
        misplacement=misplacement,
        stroke=Stroke.of(config.path),
        id=id,
    )


def simulate(
    obj: ObjectModel,
    action: LeverUp,
    *,
    engine: str = "mujoco",
    embodiment: str = "arm",
    camera: str = "exact",
    seed: int = 0,
    physics: Physics | None = None,
    path: ToolPath | None = None,
    watch_time: float = 0.0,
) -> Interaction:
    """Simulates one lever-up; ``simulate_lever_up`` with the settings that people change spelled out.

    Args:
        obj: The object.
        action: Where and which way it is levered up, in the object frame.
        engine: Physics engine.
        embodiment: ``arm``: the whole robot; ``tool``: the blade alone on the same path.
        camera: ``exact``: the view from geometry; ``rgbd``: from a rendered depth image.
        seed: Seed of the interaction's random draws (camera noise); the physics draws nothing.
        physics: Friction and density, if not the usual ones.
        path: The blade's path, if not the usual one.
        watch_time: How long the object is watched on after the path's end [s].

    Raises:
        SimulationError: If engine, embodiment or camera is unknown.
        ActionError: If the contact is not on the outline, or the arm cannot follow the path.
        ViewError: If the object does not fit in the view.
    """
    config = SimulationConfig(
        engine=engine,
        embodiment=embodiment,
        camera=camera,
        path=path or ToolPath(),
        physics=physics or Physics(),
        watch_time=watch_time,
    )
    return simulate_lever_up(obj, action, config, seed=seed)


def judge(motion: Motion, obj: ObjectModel, action: LeverUp, physics: Physics) -> Effect:
    """Turns what the engine saw into the record of an effect: outcome, slip and support points.

    Args:
        motion: The engine's motion.
        obj: The object.
        action: The lever-up.
        physics: Friction and density.
    """
    unknown = np.full((2, 2), np.nan)
    if motion.diverged:
        empty = np.empty((0, 7))
        joints = np.empty((0, motion.joints.shape[1]))
        return Effect(np.empty(0), empty, np.empty((0, 3)), empty, joints, unknown, (), Outcome.FAILED)
    motion, fall = _until_the_floor(motion, obj, physics)
    rotation = quaternion_to_matrix(motion.object_pose[:, 3:])
    com = motion.object_pose[:, :3] + rotation @ obj.mass_properties(physics.density).com
    lifted = lifted_samples(obj, rotation, com[:, 2])
    slip = _slip_index(lifted, motion.on_blade)
    outcome = name_outcome(rotation, com[:, 2], lifted, bool(motion.on_blade[-1]), slip)
    corners, points = (), unknown
    end = len(com) if slip is None else slip
    if lifted[:end].any() and outcome != Outcome.ROLLED:
        counts = _corner_counts(motion, obj, np.flatnonzero(lifted[:end]))
        shares = counts / max(int(lifted[:end].sum()), 1)
        corners = tuple(int(k) for k in np.flatnonzero(shares >= SUPPORT_SHARE))
        busiest = np.argsort(-counts, kind="stable")[:2]
        if (counts[busiest] > 0).all():
            at_rest = np.column_stack([obj.support_corners[np.sort(busiest)], np.zeros(2)])
            points = transform_points(action.T_action_object, at_rest)[:, :2]
    return Effect(
        times=motion.times,
        pose_trajectory=motion.object_pose,
        com_trajectory=com,
        tool_trajectory=motion.tool_pose,
        joint_trajectory=motion.joints,
        support_points=points,
        support_corners=corners,
        outcome=outcome,
        slip_index=None if outcome in (Outcome.ROLLED, Outcome.TUMBLED) else slip,
        fall_index=fall,
        path_error=motion.path_error,
    )


def _transformed(effect: Effect, T_told_done: Float[np.ndarray, "4 4"]) -> Effect:
    """An effect in the frame that was told, from the frame in which the blade really acted."""
    told: dict[str, Any] = {
        "com_trajectory": transform_points(T_told_done, effect.com_trajectory),
        "support_points": transform_points(
            T_told_done, np.column_stack([effect.support_points, np.zeros(2)])
        )[:, :2],
    }
    for name in ("pose_trajectory", "tool_trajectory"):
        pose = matrix_to_pose(T_told_done @ pose_to_matrix(getattr(effect, name)))
        told[name] = np.concatenate([pose[:, :3], continuous_quaternions(pose[:, 3:])], axis=1)
    return replace(effect, **told)


def _until_the_floor(motion: Motion, obj: ObjectModel, physics: Physics) -> tuple[Motion, int | None]:
    """The motion up to where a falling object nears the floor, and the first sample at which it falls."""
    com = obj.mass_properties(physics.density).com
    height = motion.object_pose[:, 2] + (quaternion_to_matrix(motion.object_pose[:, 3:]) @ com)[:, 2]
    if physics.table_edge is None or (height > 0).all():
        return motion, None
    end = int((height < -FALL_DEPTH).argmax()) or len(height)
    cut = {
        name: getattr(motion, name)[:end]
        for name in ("times", "object_pose", "tool_pose", "joints", "on_blade", "table_contacts")
    }
    return replace(motion, **cut), int((height <= 0).argmax())


def _slip_index(lifted: Bool[np.ndarray, " time"], on_blade: Bool[np.ndarray, " time"]) -> int | None:
    """First sample of the first lasting loss of contact after the object was first lifted."""
    if not lifted.any():
        return None
    off = ~on_blade
    off[: int(lifted.argmax())] = False
    lasting = off.copy()
    for k in range(1, OFF_SAMPLES):
        # At the record's end the missing samples count as off.
        lasting &= np.append(off[k:], np.ones(k, dtype=bool))
    return int(lasting.argmax()) if lasting.any() else None


def _corner_counts(
    motion: Motion, obj: ObjectModel, samples: Int[np.ndarray, " samples"]
) -> Int[np.ndarray, " corners"]:
    """In how many of the given samples each corner of the object stood on the table."""
    counts = np.zeros(len(obj.corners), dtype=int)
    # With growing tilt the object passes from the bevel's inner to its outer edge: a corner is the segment between.
    start, along = obj.support_corners, obj.corners - obj.support_corners
    length2 = np.maximum((along**2).sum(axis=1), 1e-18)
    for i in samples:
        points = motion.table_contacts[i][:, None, :2] - start  # (contacts, corners, 2)
        t = np.clip((points * along).sum(axis=-1) / length2, 0.0, 1.0)
        distance = np.linalg.norm(points - t[..., None] * along, axis=-1)
        counts += (distance < CORNER_REACH).any(axis=0)
    return counts


@lru_cache(maxsize=4)
def _versions(library: str) -> dict[str, str]:
    return {name: version(name) for name in ("foretrace", "numpy", library)}
