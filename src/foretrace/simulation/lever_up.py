"""Simulate an action, and record its effect (paper, section 4)."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from foretrace.actions import FAILED, Action, Motion, ToolPath
from foretrace.errors import (
    ActionError,
    SimulationError,
    check_ranges,
    check_type,
    is_number,
    is_whole,
    shown,
)
from foretrace.files import versions_of
from foretrace.geometry import (
    continuous_quaternions,
    invert_transform,
    matrix_to_pose,
    pose_to_matrix,
    quaternion_to_matrix,
    transform_points,
)
from foretrace.interactions.record import (
    NO_OFFSET,
    PHYSICS_RANGES,
    Effect,
    ExecutionOffset,
    Interaction,
    Physics,
    Provenance,
)
from foretrace.interactions.topdown import METRES_PER_PIXEL, TopDownView
from foretrace.objects import ObjectModel
from foretrace.simulation.engine import Engine, Play, make_engine

CAMERAS = ("exact", "grid", "rgbd")
"""``exact``: pixels aligned with the action. ``grid``: pixels that lie and are turned at random, as those of a camera
are, brought into the action's frame. ``rgbd``: a rendered depth image."""
GRID_STREAM = 4
"""Tells the random numbers of pixel grids from others of the same seed."""
LARGEST_SEED = 2**63 - 1
SHORTEST, LONGEST = 1e-5, 1.0
"""Limits of time steps and sample periods [s]."""
LEVER_ARM = "it is a lever arm in metres, a tenth of a millimetre on a hard table"
FALL_DEPTH = 0.5
"""The record of a falling object ends this far below the table top, above the floor [m]."""


@dataclass(frozen=True)
class SimulationConfig:
    """How actions are simulated."""

    engine: str = "mujoco"
    """Physics engine."""
    embodiment: str = "arm"
    """``arm``: the whole robot; ``tool``: the tool alone on the same path."""
    camera: str = "exact"
    """``exact``: the view from geometry; ``grid``: the same on turned pixels; ``rgbd``: from a rendered depth image."""
    timestep: float = 0.002
    """Time step [s]."""
    sample_period: float = 0.05
    """Time between recorded samples [s]."""
    watch_time: float = 0.0
    """Time for which the object is observed after the end of the tool's path, while the tool stands still [s]."""
    physics: Physics = field(default_factory=Physics)
    """Friction and density."""

    def __post_init__(self) -> None:
        check_type("physics", self.physics, Physics, SimulationError)
        numbers = {name: getattr(self, name) for name in ("timestep", "sample_period", "watch_time")}
        for name, value in (numbers | asdict(self.physics)).items():
            if not is_number(value) and not (name == "table_edge" and value is None):
                raise SimulationError(f"{name} is {shown(value)}: give a number")
        if not SHORTEST <= self.timestep <= self.sample_period <= LONGEST:
            raise SimulationError(
                f"timestep = {self.timestep} s and sample_period = {self.sample_period} s: give at least {SHORTEST} s, "
                f"at most {LONGEST} s, and the time step not longer than the sample period"
            )
        for name in ("engine", "embodiment"):
            check_type(name, getattr(self, name), str, SimulationError)
        check_ranges(SimulationError, "simulation", self, {"watch_time": (0.0, 60.0)}, "give seconds")
        check_ranges(SimulationError, "physics", self.physics, PHYSICS_RANGES, "check its unit")
        check_ranges(SimulationError, "physics", self.physics, {"rolling_friction": (0.0, 0.1)}, LEVER_ARM)
        if self.physics.table_edge is not None and not 0 < self.physics.table_edge <= 10:
            raise SimulationError(f"table_edge = {self.physics.table_edge} m: give a distance up to 10 m")
        engine = make_engine(self.engine, self.embodiment, self.timestep, self.sample_period)
        engine.check_physics(self.physics)
        if self.camera not in CAMERAS:
            raise SimulationError(
                f"camera {shown(self.camera)} is unknown: choose one of {', '.join(CAMERAS)}"
            )


@dataclass(frozen=True, eq=False)
class Trial:
    """One action to simulate: the arguments of `simulate_lever_up`."""

    obj: ObjectModel
    action: Action
    config: SimulationConfig = SimulationConfig()
    seed: int = 0
    id: int = 0
    execution_error: ExecutionOffset = NO_OFFSET

    def __post_init__(self) -> None:
        if not isinstance(self.action, Action):
            raise ActionError(
                f"action of type {type(self.action).__name__}: give a LeverUp or another Action"
            )
        check_type("obj", self.obj, ObjectModel, SimulationError)
        check_type("config", self.config, SimulationConfig, SimulationError)
        check_type("execution_error", self.execution_error, ExecutionOffset, SimulationError)
        if not is_whole(self.seed, 0, LARGEST_SEED):
            raise SimulationError(f"seed is {shown(self.seed)}: give a whole number from 0 to {LARGEST_SEED}")

    @cached_property
    def executed(self) -> Action:
        """The action as it is executed."""
        error = self.execution_error
        return self.action if error == NO_OFFSET else self.action.moved(**asdict(error))

    def view(self) -> TopDownView:
        """What the camera sees before."""
        self.action.check_contact(self.obj)
        if self.config.camera == "exact":
            return TopDownView.of(self.obj, self.action)
        if self.config.camera == "grid":
            return view_on_grid(self.obj, self.action, self.seed)
        # Loads OpenGL, which the exact camera does without.
        from foretrace.simulation.camera import take_rgbd

        return take_rgbd(self.obj, self.action, seed=self.seed).view()

    def play(self) -> Play:
        """What an engine plays."""
        executed = self.executed
        motion, duration = executed.tool_motion, executed.duration + self.config.watch_time
        return Play(self.obj, executed.T_action_object, executed.tool, motion, duration, self.config.physics)

    def at_rest(self) -> Interaction:
        """The interaction before anything moves, as far as it is known without playing it: its effect is one sample."""
        T, config = self.action.T_action_object, self.config
        com = transform_points(T, self.obj.mass_properties(config.physics.density).com[None])
        pose, nowhere = matrix_to_pose(T)[None], np.full((1, 7), np.nan)
        unseen = np.full((2, 2), np.nan)
        effect = Effect(np.zeros(1), pose, com, nowhere, np.empty((1, 0)), unseen, (), "")
        made = {name: getattr(config, name) for name in SETTINGS}
        known = (self.obj, self.action, self.view(), effect, config.physics)
        return Interaction(*known, Provenance(seed=self.seed, **made), self.execution_error, self.id)

    def record(self, view: TopDownView, motion: Motion, engine: Engine) -> Interaction:
        """The record of the motion, in the frame of the action as commanded."""
        executed = self.executed
        effect = effect_of(motion, self.obj, executed, self.config.physics)
        if executed is not self.action:
            effect = _transformed(
                effect, self.action.T_action_object @ invert_transform(executed.T_action_object)
            )
        made = {name: getattr(self.config, name) for name in SETTINGS}
        versions = versions_of("foretrace", "numpy", engine.library)
        provenance = Provenance(seed=self.seed, versions=versions, **made)
        known = (self.obj, self.action, view, effect, self.config.physics, provenance)
        return Interaction(*known, self.execution_error, self.id)


def simulate_lever_up(
    obj: ObjectModel,
    action: Action,
    config: SimulationConfig = SimulationConfig(),
    *,
    seed: int = 0,
    id: int = 0,
    execution_error: ExecutionOffset = NO_OFFSET,
) -> Interaction:
    """Simulates an action, a lever-up or any other one, and records it.

    Args:
        obj: The object.
        action: The action as commanded.
        config: How it is simulated.
        seed: Seed of the interaction's random draws (camera noise); the physics draws nothing.
        id: Number of the interaction within its data set.
        execution_error: Offset of the executed action from the commanded one. View and effect stay in the commanded
            action's frame; joint angles are those of the executed action.

    Returns:
        The interaction; its outcome is ``failed`` and its trajectories are empty if the simulation diverged.

    Raises:
        SimulationError: If the machine cannot render the view, or the tool's motion cannot be simulated.
        ActionError: If the contact is not on the outline, or the arm cannot follow the path.
        ViewError: If the object does not fit in the view.
    """
    return simulate_trials([Trial(obj, action, config, seed, id, execution_error)])[0]


def simulate_trials(trials: Sequence[Trial]) -> list[Interaction]:
    """Simulates actions at once, in their order, as `simulate_lever_up` does one.

    Args:
        trials: The actions; engine, embodiment and times are those of the first one's configuration.
    """
    if not trials:
        return []
    config = trials[0].config
    engine = make_engine(config.engine, config.embodiment, config.timestep, config.sample_period)
    views = [trial.view() for trial in trials]
    motions = engine.play_many([trial.play() for trial in trials])
    return [
        trial.record(view, motion, engine) for trial, view, motion in zip(trials, views, motions, strict=True)
    ]


def view_on_grid(obj: ObjectModel, action: Action, seed: int) -> TopDownView:
    """The view of an object whose mask was seen on a grid of pixels of its own, turned and shifted at random.

    Args:
        obj: The object.
        action: The action, in whose frame the view is.
        seed: Seed of the grid's place.

    Raises:
        ViewError: The object does not fit into the window.
    """
    rng = np.random.default_rng([seed, GRID_STREAM])
    turn = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(turn), np.sin(turn)])
    low, high = obj.corners.min(axis=0), obj.corners.max(axis=0)
    middle = (low + high) / 2 + METRES_PER_PIXEL * rng.uniform(-0.5, 0.5, 2)
    # Its window reaches from 0.1 m behind the contact point to 0.3 m ahead: the object is put into the middle.
    grid = replace(action, contact=middle - 0.1 * direction, direction=direction)
    T_grid_action = grid.T_action_object @ invert_transform(action.T_action_object)
    here = replace(action, contact=T_grid_action[:2, 3], direction=T_grid_action[:2, 0])
    return TopDownView.of(obj, grid).seen_from(here)


SETTINGS = ("engine", "embodiment", "camera", "timestep", "sample_period", "watch_time")
"""Settings of a `SimulationConfig` that a `Provenance` keeps by the same names."""


def simulate(
    obj: ObjectModel,
    action: Action,
    *,
    engine: str = "mujoco",
    embodiment: str = "arm",
    camera: str = "exact",
    seed: int = 0,
    physics: Physics | None = None,
    timestep: float = SimulationConfig.timestep,
    sample_period: float = SimulationConfig.sample_period,
    watch_time: float = 0.0,
    path: ToolPath | None = None,
) -> Interaction:
    """Simulates one action.

    Args:
        obj: The object.
        action: A `LeverUp` or another action.
        engine: Physics engine.
        embodiment: ``arm``: the whole robot; ``tool``: the tool alone on the same path.
        camera: ``exact``: the view from geometry; ``grid``: on turned pixels; ``rgbd``: from a rendered depth image.
        seed: Seed of the interaction's random draws (camera noise); the physics draws nothing.
        physics: Friction and density, if not the nominal ones.
        timestep: Time step [s].
        sample_period: Time between recorded samples [s].
        watch_time: Time for which the object is observed after the end of the tool's path [s].
        path: Path of the tool in place of the action's own.

    Raises:
        SimulationError: If engine, embodiment or camera is unknown, or a setting is out of range.
        ActionError: If the contact is not on the outline, or the arm cannot follow the path.
        ViewError: If the object does not fit in the view.
    """
    config = SimulationConfig(
        engine, embodiment, camera, timestep, sample_period, watch_time, physics or Physics()
    )
    action = action if path is None else replace(action, path=path)
    return simulate_lever_up(obj, action, config, seed=seed)


def replay(interaction: Interaction) -> Interaction:
    """Simulates a recorded interaction again, with everything that it records.

    On the same kind of machine with the same versions of the libraries, the result equals the record byte for byte.

    Raises:
        SimulationError: The interaction is a recording of a real one, or its engine is not installed.
    """
    check_type(
        "interaction",
        interaction,
        Interaction,
        SimulationError,
        "an Interaction, such as dataset.with_id(12)",
    )
    made = interaction.provenance
    if made.source != "simulated":
        raise SimulationError(
            f"interaction {interaction.id} is {made.source}, not simulated: only simulated interactions can be replayed"
        )
    config = SimulationConfig(physics=interaction.physics, **{name: getattr(made, name) for name in SETTINGS})
    return simulate_lever_up(
        interaction.object,
        interaction.action,
        config,
        seed=made.seed,
        id=interaction.id,
        execution_error=interaction.execution_error,
    )


def effect_of(
    motion: Motion, obj: ObjectModel, action: Action, physics: Physics, to_rest: bool = False
) -> Effect:
    """The record of an effect: what was seen, and what the action's judge concludes.

    Args:
        motion: The motion in the frame of the executed action.
        obj: The object.
        action: The executed action.
        physics: Friction and density.
        to_rest: The motion goes on after the path's end, and is judged until there.
    """
    if motion.diverged:
        empty, unknown = np.empty((0, 7)), np.full((2, 2), np.nan)
        joints = np.empty((0, motion.joints.shape[1]))
        return Effect(np.empty(0), empty, np.empty((0, 3)), empty, joints, unknown, (), FAILED)
    motion, fall = _until_the_floor(motion, obj, physics)
    rotation = quaternion_to_matrix(motion.object_pose[:, 3:])
    com = motion.object_pose[:, :3] + rotation @ obj.mass_properties(physics.density).com
    if not to_rest:
        return Effect.judged(motion, obj, action, com, fall)
    count = int(np.searchsorted(motion.times, action.duration + 1e-9, side="right"))
    judged = Effect.judged(_cut(motion, count), obj, action, com[:count], fall)
    whole = {"times": motion.times, "pose_trajectory": motion.object_pose, "com_trajectory": com}
    return replace(judged, **whole, tool_trajectory=motion.tool_pose, joint_trajectory=motion.joints)


def _transformed(effect: Effect, T_commanded_executed: Float[np.ndarray, "4 4"]) -> Effect:
    """An effect in the commanded action's frame, from the executed action's."""
    at_rest = np.column_stack([effect.support_points, np.zeros(2)])
    moved: dict[str, Any] = {
        "com_trajectory": transform_points(T_commanded_executed, effect.com_trajectory),
        "support_points": transform_points(T_commanded_executed, at_rest)[:, :2],
    }
    for name in ("pose_trajectory", "tool_trajectory"):
        pose = matrix_to_pose(T_commanded_executed @ pose_to_matrix(getattr(effect, name)))
        moved[name] = np.concatenate([pose[:, :3], continuous_quaternions(pose[:, 3:])], axis=1)
    return replace(effect, **moved)


def _until_the_floor(motion: Motion, obj: ObjectModel, physics: Physics) -> tuple[Motion, int | None]:
    """The motion up to where a falling object nears the floor, and the first sample at which it falls."""
    com = obj.mass_properties(physics.density).com
    height = motion.object_pose[:, 2] + (quaternion_to_matrix(motion.object_pose[:, 3:]) @ com)[:, 2]
    if physics.table_edge is None or (height > 0).all():
        return motion, None
    end = int((height < -FALL_DEPTH).argmax()) or len(height)
    return _cut(motion, end), int((height <= 0).argmax())


def _cut(motion: Motion, count: int) -> Motion:
    """The first samples of a motion."""
    names = ("times", "object_pose", "tool_pose", "joints", "on_tool", "table_contacts")
    cut = {name: values[:count] for name in names if (values := getattr(motion, name)) is not None}
    return replace(motion, **cut)
