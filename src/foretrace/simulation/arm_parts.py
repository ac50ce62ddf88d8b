"""The arm as pictures show it: its parts, and where each of them is while the arm leads a tool along a path."""

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float

from foretrace.actions import Tool
from foretrace.geometry import matrix_to_pose
from foretrace.interactions.record import Physics
from foretrace.simulation.arm import solve_joint_path
from foretrace.simulation.scene import build_scene
from foretrace.simulation.tool import TOOL_BODY

SHAPES: dict[int, Literal["capsule", "cylinder"]] = {
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
}


@dataclass(frozen=True)
class ArmPart:
    """A capsule or cylinder along the z axis of its frame, which lies in its middle."""

    shape: Literal["capsule", "cylinder"]
    """A capsule is a cylinder with half a ball at either end."""
    radius: float
    """Radius [m]."""
    length: float
    """Length of the cylinder [m]."""
    colour: tuple[float, float, float]
    """Red, green and blue, 0 to 1."""


def arm_model(tool: Tool) -> mujoco.MjModel:
    """The arm that holds a tool at an empty table, in the action frame."""
    return build_scene(None, Physics(), tool, "arm", timestep=0.002).compile()


def joints_along(
    tool: Tool, T_action_tip: Float[np.ndarray, "time 4 4"], dt: float
) -> Float[np.ndarray, "time 6"]:
    """Joint angles that lead a tool along a path [rad].

    Args:
        tool: The tool.
        T_action_tip: Poses of its tip, a fixed time apart.
        dt: That time [s].

    Raises:
        ActionError: The arm cannot follow.
    """
    return solve_joint_path(arm_model(tool), T_action_tip, dt).positions


def arm_parts(tool: Tool) -> tuple[ArmPart, ...]:
    """All parts from the base to the tool's holder, without the tool."""
    model = arm_model(tool)
    return tuple(
        ArmPart(
            SHAPES[int(model.geom_type[g])],
            float(model.geom_size[g, 0]),
            2 * float(model.geom_size[g, 1]),
            tuple(model.geom_rgba[g, :3].tolist()),
        )
        for g in _drawn(model)
    )


def arm_poses(tool: Tool, joints: Float[np.ndarray, "time 6"]) -> Float[np.ndarray, "parts time 7"]:
    """Where each part is, in the action frame: position [m] and quaternion (w, x, y, z).

    Args:
        tool: The tool.
        joints: Joint angles over time [rad].
    """
    model = arm_model(tool)
    data, drawn = mujoco.MjData(model), _drawn(model)
    T_action_part = np.tile(np.eye(4), (len(drawn), len(joints), 1, 1))
    for k, angles in enumerate(joints):
        data.qpos[:] = angles
        mujoco.mj_kinematics(model, data)
        T_action_part[:, k, :3, :3] = data.geom_xmat[drawn].reshape(-1, 3, 3)
        T_action_part[:, k, :3, 3] = data.geom_xpos[drawn]
    return matrix_to_pose(T_action_part)


def _drawn(model: mujoco.MjModel) -> list[int]:
    """Shapes of all bodies but the table's and the tool's."""
    others = {model.body("world").id, model.body(TOOL_BODY).id}
    return [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) not in others]
