"""The UR10 with a tool, written from the arm's published kinematics; inverse kinematics along a path.

Denavit-Hartenberg parameters, masses, centres of mass, joint, speed and torque limits are those that Universal
Robots publishes for the UR10 (CB3). The links are drawn and collide as capsules.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from foretrace.actions import Tool
from foretrace.errors import ActionError
from foretrace.geometry import matrix_to_pose, rigid_transform
from foretrace.simulation.tool import TOOL_COLLISION, add_servo, add_tool

NUM_JOINTS = 6
JOINT_NAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
DH_A = (0.0, -0.612, -0.5723, 0.0, 0.0, 0.0)
"""Link lengths a_i [m]."""
DH_D = (0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922)
"""Link offsets d_i [m]."""
DH_ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
"""Link twists alpha_i [rad]."""
LINK_MASS = (7.1, 12.7, 4.27, 2.0, 2.0, 0.365)
"""Masses [kg]."""
LINK_COM = (
    (0.021, 0.0, 0.027),
    (0.38, 0.0, 0.158),
    (0.24, 0.0, 0.068),
    (0.0, 0.007, 0.018),
    (0.0, 0.007, 0.018),
    (0.0, 0.0, -0.026),
)
"""Centres of mass in the frame at each link's far end [m]."""
JOINT_LIMIT = 2 * np.pi
"""Every joint turns by this much either way [rad]."""
SPEED_LIMIT = np.deg2rad((120.0, 120.0, 180.0, 180.0, 180.0, 180.0))
"""Largest joint speeds [rad/s]."""
TORQUE_LIMIT = (330.0, 330.0, 150.0, 56.0, 56.0, 56.0)
"""Largest joint torques [N m]."""
CONTROL_PERIOD = 0.008
"""The controller takes a new set point every 8 ms (125 Hz) [s]."""

ROTOR_INERTIA = (2.0, 2.0, 1.0, 0.3, 0.3, 0.3)
"""Inertia of rotor and gear seen at the joint [kg m^2]; an estimate, Universal Robots publishes none."""
SERVO_STIFFNESS = (40000.0, 40000.0, 25000.0, 4000.0, 4000.0, 4000.0)
"""Proportional gain of the joint servos [N m/rad]."""
SERVO_DAMPING = (1000.0, 1000.0, 450.0, 70.0, 70.0, 70.0)
"""Derivative gain of the joint servos [N m s/rad], near critical damping."""

LINK_CAPSULES = (
    ((0.0, 0.0, 0.09), (0.0, 0.0, 0.16), 0.075),
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.18), 0.07),
    ((0.0, 0.0, 0.18), (-0.612, 0.0, 0.18), 0.058),
    ((0.0, 0.0, 0.18), (0.0, 0.0, 0.05), 0.055),
    ((0.0, 0.0, 0.05), (-0.5723, 0.0, 0.05), 0.048),
    ((0.0, 0.0, 0.06), (0.0, 0.0, 0.163941), 0.045),
    ((0.0, 0.0, 0.03), (0.0, 0.0, 0.1157), 0.045),
    ((0.0, 0.0, 0.03), (0.0, 0.0, 0.06), 0.04),
)
"""Ends [m] and radius [m] of the capsules, in the frames of the bodies in CAPSULE_BODIES."""
CAPSULE_BODIES = (0, 1, 1, 2, 2, 3, 4, 5)

HOLDER_ANGLE = np.deg2rad(45.0)
"""The holder turns the screwdriver up from the flange's axis by this angle, to keep the wrist off the table [rad]."""
HOLDER_LENGTH = 0.07
"""From the flange to the screwdriver's handle, along the flange's axis [m]."""
BASE_POSITION = (-0.85, 0.0, 0.0)
"""Arm base in the action frame [m]; its axes are the action frame's."""
MAX_IK_STEP = 0.2
"""Largest change of a joint in one iteration of inverse kinematics [rad]."""
HOME = (2.9, -1.2, 2.3, -3.0, -1.5, 1.3)
"""Posture from which inverse kinematics starts [rad]: elbow up, hand behind and above the contact point."""


def add_arm(spec: mujoco.MjSpec, tool: Tool, tool_friction: float) -> None:
    """Adds the arm, its servos and a tool to a scene.

    Bodies are gravity compensated, as a UR's controller does for its own links and the payload it was told of.

    Args:
        spec: The scene, in the action frame.
        tool: The tool.
        tool_friction: Friction coefficient of the tool.
    """
    parent = spec.worldbody.add_body(name="base", pos=BASE_POSITION)
    parent.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[0.09, 0.02, 0],
        pos=[0, 0, 0.02],
        rgba=[0.3, 0.32, 0.35, 1],
        contype=0,
        conaffinity=0,
    )
    pos, quat = np.zeros(3), np.array([1.0, 0, 0, 0])
    bodies = []
    for i, name in enumerate(JOINT_NAMES):
        body = parent.add_body(name=f"link_{name}", pos=pos, quat=quat, gravcomp=1)
        body.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0, 0, 1],
            limited=True,
            range=[-JOINT_LIMIT, JOINT_LIMIT],
            armature=ROTOR_INERTIA[i],
        )
        add_servo(spec, name, SERVO_STIFFNESS[i], SERVO_DAMPING[i], TORQUE_LIMIT[i])
        # Frame i is reached from this body by Tz(d) Tx(a) Rx(alpha).
        pos = np.array([DH_A[i], 0.0, DH_D[i]])
        quat = np.array([np.cos(DH_ALPHA[i] / 2), np.sin(DH_ALPHA[i] / 2), 0, 0])
        com = pos + _rotate(quat, np.array(LINK_COM[i]))
        body.mass, body.ipos, body.explicitinertial = LINK_MASS[i], com, True
        body.inertia = _rod_inertia(LINK_MASS[i], max(float(np.linalg.norm(pos)), 0.1))
        bodies.append(body)
        parent = body
    for (start, end, radius), index in zip(LINK_CAPSULES, CAPSULE_BODIES, strict=True):
        bodies[index].add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[*start, *end],
            size=[radius, 0, 0],
            rgba=[0.62, 0.68, 0.74, 1],
            mass=0,
            **TOOL_COLLISION,
        )
    bodies[-1].add_site(name="flange", pos=pos, quat=quat)
    holder = bodies[-1].add_body(name="tool", pos=pos, quat=quat, gravcomp=1)
    holder.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0, 0, 0, 0, 0, HOLDER_LENGTH],
        size=[0.025, 0, 0],
        rgba=[0.25, 0.25, 0.28, 1],
        mass=0.3,
        **TOOL_COLLISION,
    )
    pose = matrix_to_pose(T_flange_tip(tool))
    add_tool(holder, tool, tool_friction, pos=pose[:3], quat=pose[3:])


def T_flange_tip(tool: Tool) -> Float[np.ndarray, "4 4"]:
    """Tool frame in the flange frame: x along the tool, y to the left."""
    # At the flange y is the action's left; the tool's axis is the flange's axis turned up by HOLDER_ANGLE.
    c, s = np.cos(HOLDER_ANGLE), np.sin(HOLDER_ANGLE)
    axes = np.array([[-s, 0.0, -c], [0.0, 1.0, 0.0], [c, 0.0, -s]])
    return rigid_transform(axes, np.array([0, 0, HOLDER_LENGTH]) + tool.length * axes[:, 0])


@dataclass(frozen=True)
class JointPath:
    """The arm's joint angles along a tool path, one row per time."""

    positions: Float[np.ndarray, "time 6"]
    """Joint angles [rad]."""
    velocities: Float[np.ndarray, "time 6"]
    """Joint speeds [rad/s]."""
    accelerations: Float[np.ndarray, "time 6"]
    """Joint accelerations [rad/s^2]."""


def solve_inverse_kinematics(
    model: mujoco.MjModel,
    T_action_tip: Float[np.ndarray, "4 4"],
    start: Float[np.ndarray, " joints"],
    tolerance: float = 1e-9,
    max_iterations: int = 100,
) -> Float[np.ndarray, " 6"]:
    """Joint angles that bring the blade tip to a pose, by damped least squares from a nearby posture.

    Args:
        model: A scene with the arm.
        T_action_tip: Wanted pose of the blade tip in the action frame.
        start: Joint angles to start from [rad]; the solution stays in their branch.
        tolerance: Largest remaining error of position [m] and rotation [rad].
        max_iterations: Give up after this many steps.

    Raises:
        ActionError: If the pose is out of reach.
    """
    data = mujoco.MjData(model)
    site = model.site("tip").id
    address = [model.joint(name).qposadr[0] for name in JOINT_NAMES]
    columns = [model.joint(name).dofadr[0] for name in JOINT_NAMES]
    q = np.array(start, dtype=float)
    jac_pos, jac_rot = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    target_quat, quat, error = np.zeros(4), np.zeros(4), np.zeros(6)
    mujoco.mju_mat2Quat(target_quat, np.ascontiguousarray(T_action_tip[:3, :3]).ravel())
    for _ in range(max_iterations):
        data.qpos[address] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        error[:3] = T_action_tip[:3, 3] - data.site_xpos[site]
        mujoco.mju_mat2Quat(quat, data.site_xmat[site])
        mujoco.mju_subQuat(error[3:], target_quat, quat)
        error[3:] = data.site_xmat[site].reshape(3, 3) @ error[3:]
        if np.abs(error).max() < tolerance:
            return q
        mujoco.mj_jacSite(model, data, jac_pos, jac_rot, site)
        J = np.vstack([jac_pos, jac_rot])[:, columns]  # (6, 6)
        damping = 1e-3 * min(1.0, float(np.linalg.norm(error)))
        step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), error)
        # A bounded step stays in the branch of the start.
        q = q + step * min(1.0, MAX_IK_STEP / float(np.abs(step).max()))
    x, y, z = T_action_tip[:3, 3]
    raise ActionError(
        f"the arm cannot bring the blade to ({x:.3f}, {y:.3f}, {z:.3f}) m: "
        f"{1e3 * float(np.linalg.norm(error[:3])):.1f} mm remain; shorten the tool path or move it nearer to the arm"
    )


def solve_joint_path(
    model: mujoco.MjModel, T_action_tip: Float[np.ndarray, "time 4 4"], dt: float
) -> JointPath:
    """Joint path that leads the blade tip along a tool path.

    Args:
        model: A scene with the arm.
        T_action_tip: Poses of the blade tip, a fixed time apart.
        dt: That time [s].

    Raises:
        ActionError: If a pose is out of reach, or a joint would have to move faster than it can.
    """
    q = np.array(HOME)
    positions = np.empty((len(T_action_tip), NUM_JOINTS))
    for i, T in enumerate(T_action_tip):
        q = solve_inverse_kinematics(model, T, q)
        positions[i] = q
    velocities = np.asarray(np.gradient(positions, dt, axis=0, edge_order=2))
    accelerations = np.asarray(np.gradient(velocities, dt, axis=0, edge_order=2))
    excess = np.abs(velocities).max(axis=0) / SPEED_LIMIT
    worst = int(excess.argmax())
    if excess[worst] > 1:
        raise ActionError(
            f"joint {JOINT_NAMES[worst]} would move at {np.rad2deg(excess[worst] * SPEED_LIMIT[worst]):.0f} deg/s, "
            f"over its limit of {np.rad2deg(SPEED_LIMIT[worst]):.0f}: make the tool path slower"
        )
    return JointPath(positions, velocities, accelerations)


def _rod_inertia(mass: float, length: float) -> list[float]:
    """Principal inertia of a stout rod, a stand-in for the links' unpublished inertia [kg m^2]."""
    value = mass * (length**2 / 12 + 0.05**2)
    return [value, value, value]


def _rotate(quat: Float[np.ndarray, " 4"], vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, vector, quat)
    return result
