"""Tools in MuJoCo: their bodies, and the carriage that moves them alone."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from foretrace.actions import Tool
from foretrace.simulation.engine import COORDINATES

TABLE_BIT, OBJECT_BIT, TOOL_BIT = 1, 2, 4
"""Collision groups: the object meets table and tool; tool and arm meet only the object."""
TOOL_COLLISION = {"contype": TOOL_BIT, "conaffinity": OBJECT_BIT}
TOOL_BODY = "tool_parts"
"""Name of the body that holds a tool's parts."""
CARRIAGE_INERTIA = (100.0, 1.0)
"""Inertia of the carriage [kg, kg m^2] as it moves and turns: so heavy that no object disturbs its path."""
CARRIAGE_FREQUENCY = 2 * np.pi * 30.0
"""Natural frequency of the carriage's servos, critically damped [rad/s]."""


def add_tool(
    parent: mujoco.MjsBody,
    tool: Tool,
    friction: float,
    pos: Float[np.ndarray, " 3"],
    quat: Float[np.ndarray, " 4"],
) -> None:
    """Adds a tool's parts to a body, with a site ``tip`` at the origin of the tool's frame.

    Args:
        parent: The body that carries the tool.
        tool: The tool.
        friction: Friction coefficient of its surface.
        pos: Tool frame in the parent's frame: position [m].
        quat: Tool frame in the parent's frame: quaternion (w, x, y, z).
    """
    body = parent.add_body(name=TOOL_BODY, pos=pos, quat=quat, gravcomp=1)
    body.add_site(name="tip")
    # MuJoCo would take the larger friction of two geoms; the priority makes the tool's own count.
    surface = {"friction": [friction, 0.005, 0.0001], "priority": 1, **TOOL_COLLISION}
    surface |= {"margin": tool.touch_margin, "gap": tool.touch_margin}
    for part in tool.parts():
        if part.shape == "box":
            shape = {"type": mujoco.mjtGeom.mjGEOM_BOX, "pos": [*part.start], "size": [*part.end]}
        else:
            shape = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "fromto": [*part.start, *part.end]}
            shape["size"] = [part.radius, 0, 0]
        body.add_geom(name=part.name, rgba=[*part.colour, 1], mass=part.mass, **shape, **surface)


def add_carriage(spec: mujoco.MjSpec, tool: Tool, friction: float, coordinates: Sequence[int]) -> None:
    """Adds a tool on a stiff carriage.

    Args:
        spec: The scene, in the action frame.
        tool: The tool.
        friction: Friction coefficient of its surface.
        coordinates: Numbers of the coordinates in which the carriage moves it, in rising order; with at most one of
            the last three, that one's joint angle is the rotation vector's length.
    """
    body = spec.worldbody.add_body(name="tool", gravcomp=1)
    for k in coordinates:
        turns, axis = k >= 3, np.eye(3)[k % 3].tolist()
        kind = mujoco.mjtJoint.mjJNT_HINGE if turns else mujoco.mjtJoint.mjJNT_SLIDE
        name, inertia = f"tool_{COORDINATES[k]}", CARRIAGE_INERTIA[turns]
        body.add_joint(name=name, type=kind, axis=axis, armature=inertia)
        kp, kd = inertia * CARRIAGE_FREQUENCY**2, 2 * inertia * CARRIAGE_FREQUENCY
        add_servo(spec, name, kp, kd)
    add_tool(body, tool, friction, pos=np.zeros(3), quat=np.array([1.0, 0, 0, 0]))


def add_servo(
    spec: mujoco.MjSpec, joint: str, stiffness: float, damping: float, limit: float | None = None
) -> None:
    """Adds a position servo: force = stiffness * (set point - position) - damping * velocity, within a limit."""
    spec.add_actuator(
        name=joint,
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        gainprm=[stiffness] + [0] * 9,
        biasprm=[0, -stiffness, -damping] + [0] * 7,
        forcelimited=limit is not None,
        forcerange=[-(limit or 0), limit or 0],
    )
