"""The flat-blade screwdriver: its dimensions, its body, and the carriage that moves it alone."""

# pyright: reportAttributeAccessIssue=false
# MuJoCo is a compiled module without type stubs.

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from foretrace.errors import SimulationError

TABLE_BIT, OBJECT_BIT, TOOL_BIT = 1, 2, 4
"""Collision groups: the object meets table and tool; tool and arm meet only the object."""
TOOL_COLLISION = {"contype": TOOL_BIT, "conaffinity": OBJECT_BIT}
TOUCH_MARGIN = 0.001
"""Blade and object closer than this touch [m], and push: the blade acts as if it were so much thicker."""
CARRIAGE_JOINTS = ("tool_x", "tool_z", "tool_pitch")
CARRIAGE_INERTIA = (100.0, 100.0, 1.0)
"""Inertia of the carriage [kg, kg, kg m^2]: so heavy that no object disturbs its path."""
CARRIAGE_FREQUENCY = 2 * np.pi * 30.0
"""Natural frequency of the carriage's servos, critically damped [rad/s]."""


@dataclass(frozen=True)
class Tool:
    """A flat-blade screwdriver."""

    blade_width: float = 0.0055
    """Width of the blade [m]."""
    blade_thickness: float = 0.001
    """Thickness of the blade [m]."""
    blade_length: float = 0.045
    """Length of the flat blade, from tip to shaft [m]."""
    shaft_radius: float = 0.004
    """Radius of the shaft [m]."""
    length: float = 0.17
    """From the tip to the handle's end in the holder [m]."""

    def __post_init__(self) -> None:
        for name in ("blade_width", "blade_thickness", "blade_length", "shaft_radius", "length"):
            if not 1e-4 <= getattr(self, name) <= 0.5:
                raise SimulationError(f"tool: {name} = {getattr(self, name)} m is outside 0.0001 to 0.5 m")
        if self.blade_length >= self.length:
            raise SimulationError(
                f"tool: blade_length = {self.blade_length} m does not fit in length = {self.length} m"
            )


def add_blade(
    parent: mujoco.MjsBody,
    tool: Tool,
    friction: float,
    pos: Float[np.ndarray, " 3"],
    quat: Float[np.ndarray, " 4"],
) -> None:
    """Adds blade, shaft and handle to a body, with a site ``tip`` at the middle of the blade's lower front edge.

    Args:
        parent: The body that carries the screwdriver.
        tool: Its dimensions.
        friction: Friction coefficient of its surface.
        pos: Tip frame in the parent's frame: position [m].
        quat: Tip frame in the parent's frame: quaternion (w, x, y, z); x along the blade, z out of its upper face.
    """
    body = parent.add_body(name="blade", pos=pos, quat=quat, gravcomp=1)
    body.add_site(name="tip")
    # MuJoCo would take the larger friction of two geoms; the priority makes the blade's own count.
    surface = {"friction": [friction, 0.005, 0.0001], "priority": 1, **TOOL_COLLISION}
    surface |= {"margin": TOUCH_MARGIN, "gap": TOUCH_MARGIN}
    steel, shaft_length = [0.75, 0.76, 0.78, 1], tool.length - tool.blade_length
    body.add_geom(
        name="blade",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[-tool.blade_length / 2, 0, tool.blade_thickness / 2],
        size=[tool.blade_length / 2, tool.blade_width / 2, tool.blade_thickness / 2],
        rgba=steel,
        mass=0.01,
        **surface,
    )
    start, middle = -tool.blade_length - tool.shaft_radius, -tool.blade_length - 0.5 * shaft_length
    body.add_geom(
        name="shaft",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[start, 0, tool.shaft_radius, middle, 0, tool.shaft_radius],
        size=[tool.shaft_radius, 0, 0],
        rgba=steel,
        mass=0.03,
        **surface,
    )
    body.add_geom(
        name="handle",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[middle, 0, tool.shaft_radius, -tool.length, 0, tool.shaft_radius],
        size=[0.012, 0, 0],
        rgba=[0.84, 0.37, 0.0, 1],
        mass=0.08,
        **surface,
    )


def add_carriage(spec: mujoco.MjSpec, tool: Tool, friction: float) -> None:
    """Adds the screwdriver on a stiff carriage that moves it in the action frame's x-z plane."""
    body = spec.worldbody.add_body(name="tool", gravcomp=1)
    axes = ([1, 0, 0], [0, 0, 1], [0, 1, 0])
    for name, axis, inertia in zip(CARRIAGE_JOINTS, axes, CARRIAGE_INERTIA, strict=True):
        kind = mujoco.mjtJoint.mjJNT_HINGE if name == "tool_pitch" else mujoco.mjtJoint.mjJNT_SLIDE
        body.add_joint(name=name, type=kind, axis=axis, armature=inertia)
        kp, kd = inertia * CARRIAGE_FREQUENCY**2, 2 * inertia * CARRIAGE_FREQUENCY
        add_servo(spec, name, kp, kd)
    add_blade(body, tool, friction, pos=np.zeros(3), quat=np.array([1.0, 0, 0, 0]))


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
