"""Lever-ups in MuJoCo.

The action is open loop, so every set point is known before the first step: one call of ``mujoco.rollout`` steps
the whole interaction in C. Contacts are read afterwards, at the recorded samples only.
"""

# pyright: reportAttributeAccessIssue=false
# MuJoCo is a compiled module without type stubs.

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from foretrace.actions import LeverUp, ToolPath
from foretrace.errors import SimulationError
from foretrace.geometry import matrix_to_pose
from foretrace.interactions.record import Physics
from foretrace.objects import ObjectModel
from foretrace.simulation import arm
from foretrace.simulation.engine import SPEED_LIMIT, STANDING_DEPTH, Motion, tip_transforms
from foretrace.simulation.scene import EMBODIMENTS, body_origin, build_scene
from foretrace.simulation.tool import CARRIAGE_FREQUENCY, CARRIAGE_JOINTS, Tool

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


@dataclass(frozen=True)
class ControlPath:
    """Set points of the tool's servos along a path."""

    start: Float[np.ndarray, " joints"]
    """Joint positions at the start, in the servos' order."""
    setpoints: Float[np.ndarray, "step joints"]
    """Set point of each servo at every simulation step."""
    tips: Float[np.ndarray, "sample 4 4"]
    """Planned blade tip in the action frame at every recorded sample."""


class MujocoEngine:
    """Plays lever-ups in MuJoCo.

    Args:
        embodiment: ``arm``: the UR10 carries the screwdriver; ``tool``: a stiff carriage moves it alone.
        timestep: Time step [s]; divides the sample and control periods.
        sample_period: Time between recorded samples [s].

    Raises:
        SimulationError: If a value does not fit.
    """

    name = library = "mujoco"

    def __init__(self, embodiment: str = "arm", timestep: float = 0.002, sample_period: float = 0.05) -> None:
        if embodiment not in EMBODIMENTS:
            raise SimulationError(
                f"embodiment {embodiment!r} is unknown: choose one of {', '.join(EMBODIMENTS)}"
            )
        for period in (sample_period, arm.CONTROL_PERIOD):
            if not 0 < timestep <= period or abs(period / timestep - round(period / timestep)) > 1e-9:
                raise SimulationError(
                    f"timestep = {timestep} s does not divide {period} s: take 0.002 s or a half of it"
                )
        self.embodiment, self.timestep, self.sample_period = embodiment, timestep, sample_period
        self._scene: tuple[ObjectModel, Physics, Tool, mujoco.MjModel, mujoco.MjData] | None = None

    def play(self, obj: ObjectModel, action: LeverUp, path: ToolPath, tool: Tool, physics: Physics) -> Motion:
        """Plays one lever-up from the moment before the blade moves until the end of the path.

        Raises:
            ActionError: If the arm cannot follow the path.
        """
        control = plan_control(path, tool, self.embodiment, self.timestep, self.sample_period)
        model, data = self._compiled(obj, physics, tool)
        mujoco.mj_resetData(model, data)
        T_object_body = np.eye(4)
        T_object_body[:3, 3] = body_origin(obj)
        data.qpos[:7] = matrix_to_pose(action.T_action_object @ T_object_body)
        data.qpos[7:] = control.start
        state = np.empty(mujoco.mj_stateSize(model, STATE))
        mujoco.mj_getState(model, data, state, STATE)
        states, _ = rollout.rollout(model, data, initial_state=state[None], control=control.setpoints[None])
        stride = round(self.sample_period / self.timestep)
        samples = np.vstack([state[None], np.asarray(states)[0, stride - 1 :: stride]])
        return self._observe(model, data, samples, control)

    def _compiled(
        self, obj: ObjectModel, physics: Physics, tool: Tool
    ) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """The compiled scene; kept, as an object is usually levered at many points in a row."""
        kept = self._scene
        if kept is None or kept[0] is not obj or kept[1:3] != (physics, tool):
            model = build_scene(obj, physics, tool, self.embodiment, self.timestep).compile()
            self._scene = kept = (obj, physics, tool, model, mujoco.MjData(model))
        return kept[3], kept[4]

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
        object_body, blade_body = model.body("object").id, model.body("blade").id
        table, tip, frame = model.geom("table").id, model.site("tip").id, model.site("object").id
        object_pose = qpos[:, :7].copy()
        tool_pose, on_blade, contacts = np.zeros((num, 7)), np.zeros(num, dtype=bool), []
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
            on_blade[i] = bool((on_object & (bodies == blade_body).any(axis=1)).any())
            standing = on_object & (geoms == table).any(axis=1) & (contact.dist < STANDING_DEPTH)
            rotation = data.xmat[object_body].reshape(3, 3)
            contacts.append((contact.pos[standing] - data.site_xpos[frame]) @ rotation)
        error = np.linalg.norm(tool_pose[:, :3] - control.tips[:, :3, 3], axis=1).max()
        return Motion(
            times=np.arange(num) * self.sample_period,
            object_pose=object_pose,
            tool_pose=tool_pose,
            joints=qpos[:, 7:].copy() if self.embodiment == "arm" else np.empty((num, 0)),
            on_blade=on_blade,
            table_contacts=tuple(contacts),
            path_error=0.0 if diverged else float(error),
            diverged=diverged,
        )


@lru_cache(maxsize=8)
def plan_control(
    path: ToolPath, tool: Tool, embodiment: str, timestep: float, sample_period: float
) -> ControlPath:
    """Set points that lead the blade along a path; the same for every object, so planned once.

    The servos lag behind what they are told, by an amount known in advance; set points include the velocity and
    the torque that the motion needs, so that without an object the blade is on its path.

    Raises:
        ActionError: If the arm cannot follow the path.
    """
    num_samples = round(path.duration / sample_period)
    num_steps = num_samples * round(sample_period / timestep)
    tips = tip_transforms(path, np.arange(num_samples + 1) * sample_period)
    model = build_scene(None, Physics(), tool, embodiment, timestep).compile()
    if embodiment == "tool":
        times = np.arange(-1, num_steps + 1) * timestep
        positions = path.at(times)
        velocity = np.diff(positions, axis=0) / timestep
        acceleration = np.diff(velocity, axis=0) / timestep
        # The integrator is implicit in the velocity: a step starts at one position and ends at the next speed.
        lead = 2 / CARRIAGE_FREQUENCY * velocity[1:] + acceleration / CARRIAGE_FREQUENCY**2
        order = [model.joint(name).id for name in CARRIAGE_JOINTS]
        return ControlPath(positions[1, order], (positions[1:-1] + lead)[:, order], tips)
    period = arm.CONTROL_PERIOD
    steps_per_tick = round(period / timestep)
    num_ticks = -(-num_steps // steps_per_tick)
    # A set point is held for one control period: aim at the middle of it.
    times = (np.arange(-1, num_ticks + 1) + 0.5) * period
    joint_path = arm.solve_joint_path(model, tip_transforms(path, times), period)
    data, servo = mujoco.MjData(model), model.actuator_biasprm
    setpoints = np.empty_like(joint_path.positions)
    for i in range(len(times)):
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
    start = arm.solve_inverse_kinematics(model, tips[0], joint_path.positions[0])
    return ControlPath(start, np.repeat(setpoints[1:], steps_per_tick, axis=0)[:num_steps], tips)
