"""Actions in MuJoCo.

An action is open loop, so every set point is known before the first step: one call of ``mujoco.rollout`` steps
the whole interaction in C. Contacts are read afterwards, at the recorded samples only.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from foretrace.actions import Motion, Tool, tool_transforms
from foretrace.errors import SimulationError, shown
from foretrace.geometry import matrix_to_pose, planar_transform
from foretrace.interactions.record import Physics
from foretrace.objects import ObjectModel
from foretrace.simulation import arm
from foretrace.simulation.engine import (
    SPEED_LIMIT,
    STANDING_DEPTH,
    Engine,
    ToolMotion,
    check_divides,
    sample_tool,
    used_coordinates,
)
from foretrace.simulation.mujoco_free_motion import play_freely
from foretrace.simulation.scene import EMBODIMENTS, body_origin, build_scene
from foretrace.simulation.tool import CARRIAGE_FREQUENCY, TOOL_BODY

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


@dataclass(frozen=True)
class ControlPath:
    """Set points of the tool's servos along a path."""

    start: Float[np.ndarray, " joints"]
    """Joint positions at the start, in the servos' order."""
    setpoints: Float[np.ndarray, "step joints"]
    """Set point of each servo at every simulation step."""
    coordinates: tuple[int, ...]
    """Numbers of the coordinates in which a carriage moves the tool; empty for the arm."""
    tips: Float[np.ndarray, "sample 3"]
    """Planned position of the tool's tip in the action frame at every recorded sample [m]."""


class MujocoEngine(Engine):
    """MuJoCo.

    Args:
        embodiment: ``arm``: the UR10 carries the tool; ``tool``: a stiff carriage moves it alone.
        timestep: Time step [s]; divides the sample and control periods.
        sample_period: Time between recorded samples [s].

    Raises:
        SimulationError: If a value does not fit.
    """

    name = library = "mujoco"
    play_freely = staticmethod(play_freely)

    def __init__(self, embodiment: str = "arm", timestep: float = 0.002, sample_period: float = 0.05) -> None:
        if embodiment not in EMBODIMENTS:
            raise SimulationError(
                f"embodiment {shown(embodiment)} is unknown: choose one of {', '.join(EMBODIMENTS)}"
            )
        check_divides(timestep, sample_period, arm.CONTROL_PERIOD)
        self.embodiment, self.timestep, self.sample_period = embodiment, timestep, sample_period
        self._kept: tuple[Any, ObjectModel, mujoco.MjModel] | None = None

    def play(
        self,
        obj: ObjectModel,
        T_action_object: Float[np.ndarray, "4 4"],
        tool: Tool,
        tool_motion: ToolMotion,
        duration: float,
        physics: Physics,
    ) -> Motion:
        """Plays an action in one call of ``mujoco.rollout``."""
        stride = round(self.sample_period / self.timestep)
        control = self._control(tool, tool_motion, duration)
        model = self._compiled(obj, physics, tool, control.coordinates)
        data = mujoco.MjData(model)  # of its own: other threads may play with the same model
        data.qpos[:7] = matrix_to_pose(T_action_object @ planar_transform(body_origin(obj), 0.0))
        data.qpos[7:] = control.start
        state = np.empty(mujoco.mj_stateSize(model, STATE))
        mujoco.mj_getState(model, data, state, STATE)
        states, _ = rollout.rollout(model, data, initial_state=state[None], control=control.setpoints[None])
        seen = np.vstack([state[None], np.asarray(states)[0, stride - 1 :: stride]])
        return self._observe(model, data, seen, control)

    def _control(self, tool: Tool, tool_motion: ToolMotion, duration: float) -> ControlPath:
        """Set points of an action."""
        num_samples = round(duration / self.sample_period)
        samples = sample_tool(tool_motion, np.arange(num_samples + 1) * self.sample_period)
        plan = plan_arm if self.embodiment == "arm" else plan_carriage
        steps = num_samples * round(self.sample_period / self.timestep)
        return plan(tool_motion, samples, tool, steps, self.timestep)

    def _compiled(
        self, obj: ObjectModel, physics: Physics, tool: Tool, coordinates: tuple[int, ...]
    ) -> mujoco.MjModel:
        """The compiled scene; kept, as an object is usually acted on at many points in a row."""
        key, kept = (physics, tool, coordinates), self._kept
        if kept is None or kept[0] != key or kept[1] is not obj:
            model = build_scene(obj, physics, tool, self.embodiment, self.timestep, coordinates).compile()
            self._kept = kept = (key, obj, model)
        return kept[2]

    def _observe(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        samples: Float[np.ndarray, "sample state"],
        control: ControlPath,
    ) -> Motion:
        num = len(samples)
        qpos = samples[:, 1 : 1 + model.nq]
        object_qvel = samples[:, 1 + model.nq : 7 + model.nq]
        # A comparison with NaN is false, so this finds both.
        diverged = not bool(np.all(np.abs(object_qvel) < SPEED_LIMIT))
        object_body, tool_body = model.body("object").id, model.body(TOOL_BODY).id
        table, tip, frame = model.geom("table").id, model.site("tip").id, model.site("object").id
        object_pose = qpos[:, :7].copy()
        tool_pose, on_tool, contacts = np.zeros((num, 7)), np.zeros(num, dtype=bool), []
        for i in range(num if not diverged else 0):
            mujoco.mj_setState(model, data, samples[i], STATE)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            object_pose[i, :3] = data.site_xpos[frame]
            tool_pose[i, :3] = data.site_xpos[tip]
            mujoco.mju_mat2Quat(tool_pose[i, 3:], data.site_xmat[tip])
            geoms, contact = data.contact.geom, data.contact
            bodies = model.geom_bodyid[geoms]
            on_object = (bodies == object_body).any(axis=1)
            on_tool[i] = bool((on_object & (bodies == tool_body).any(axis=1)).any())
            standing = on_object & (geoms == table).any(axis=1) & (contact.dist < STANDING_DEPTH)
            rotation = data.xmat[object_body].reshape(3, 3)
            contacts.append((contact.pos[standing] - data.site_xpos[frame]) @ rotation)
        error = np.linalg.norm(tool_pose[:, :3] - control.tips, axis=1).max()
        return Motion(
            times=np.arange(num) * self.sample_period,
            object_pose=object_pose,
            tool_pose=tool_pose,
            joints=qpos[:, 7:].copy() if self.embodiment == "arm" else np.empty((num, 0)),
            on_tool=on_tool,
            table_contacts=tuple(contacts),
            path_error=0.0 if diverged else float(error),
            diverged=diverged,
        )


def plan_carriage(
    tool_motion: ToolMotion,
    samples: Float[np.ndarray, "sample 6"],
    tool: Tool,
    num_steps: int,
    timestep: float,
) -> ControlPath:
    """Set points that lead a tool along its path on the carriage.

    The servos lag behind their set points by an amount known in advance: set points include the velocity that the
    motion needs, so that without an object the tool is on its path.
    """
    positions = sample_tool(tool_motion, np.arange(-1, num_steps + 1) * timestep)
    velocity = np.diff(positions, axis=0) / timestep
    acceleration = np.diff(velocity, axis=0) / timestep
    # The integrator is implicit in the velocity: a step starts at one position and ends at the next speed.
    lead = 2 / CARRIAGE_FREQUENCY * velocity[1:] + acceleration / CARRIAGE_FREQUENCY**2
    # Without any joint there would be nothing to control.
    used = used_coordinates(positions) or (0,)
    return ControlPath(positions[1, used], (positions[1:-1] + lead)[:, used], used, samples[:, :3])


def plan_arm(
    tool_motion: ToolMotion,
    samples: Float[np.ndarray, "sample 6"],
    tool: Tool,
    num_steps: int,
    timestep: float,
) -> ControlPath:
    """Set points that lead a tool along its path on the arm; the same for every object, so planned once.

    Raises:
        ActionError: If the arm cannot follow the path.
    """
    period = arm.CONTROL_PERIOD
    steps_per_tick = round(period / timestep)
    num_ticks = -(-num_steps // steps_per_tick)
    # A set point is held for one control period: aim at the middle of it.
    ticks = sample_tool(tool_motion, (np.arange(-1, num_ticks + 1) + 0.5) * period)
    start, setpoints = _solve_arm(ticks.tobytes(), samples[:1].tobytes(), tool, timestep)
    return ControlPath(
        start, np.repeat(setpoints[1:], steps_per_tick, axis=0)[:num_steps], (), samples[:, :3]
    )


@lru_cache(maxsize=8)
def _solve_arm(
    ticks: bytes, first: bytes, tool: Tool, timestep: float
) -> tuple[Float[np.ndarray, " 6"], Float[np.ndarray, "tick 6"]]:
    """Joint positions at the start, and the servos' set points for every control period.

    The servos lag behind their set points, which therefore include the velocity and the torque that the motion needs.

    Args:
        ticks: (tick, 6) coordinates of the tool in every control period, as bytes, which can be kept as a key.
        first: (1, 6) coordinates at the start, likewise.
        tool: The tool.
        timestep: Time step [s].
    """
    poses, begin = (tool_transforms(np.frombuffer(part).reshape(-1, 6)) for part in (ticks, first))
    model = build_scene(None, Physics(), tool, "arm", timestep).compile()
    joint_path = arm.solve_joint_path(model, poses, arm.CONTROL_PERIOD)
    data, servo = mujoco.MjData(model), model.actuator_biasprm
    setpoints = np.empty_like(joint_path.positions)
    for i in range(len(poses)):
        data.qpos[:], data.qvel[:], data.qacc[:] = (
            joint_path.positions[i],
            joint_path.velocities[i],
            joint_path.accelerations[i],
        )
        mujoco.mj_inverse(model, data)
        # The integrator is implicit in the velocity: forces see the step's first position and its last speed.
        position = joint_path.positions[i] - timestep / 2 * joint_path.velocities[i]
        velocity = joint_path.velocities[i] + timestep / 2 * joint_path.accelerations[i]
        setpoints[i] = position - (data.qfrc_inverse - servo[:, 2] * velocity) / servo[:, 1]
    return arm.solve_inverse_kinematics(model, begin[0], joint_path.positions[0]), setpoints
