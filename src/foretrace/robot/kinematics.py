"""Where every part of the arm and its screwdriver is at given joint angles, in the arm's base frame."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from foretrace.actions import Screwdriver
from foretrace.geometry import rigid_transform, transform_points
from foretrace.interactions.record import Physics
from foretrace.simulation import arm
from foretrace.simulation.scene import build_scene

FIXED_BODIES = ("world", "base", "link_shoulder_pan")
"""Bodies whose height above the base does not change."""


@dataclass(frozen=True)
class Posture:
    """The arm at one set of joint angles, in the base frame."""

    T_base_tip: Float[np.ndarray, "4 4"]
    """Blade tip: x along the blade, y to the left, z out of its upper face."""
    flange: Float[np.ndarray, "3"]
    """Middle of the tool flange [m]."""
    wrist: Float[np.ndarray, "3"]
    """Where the axes of the last two joints meet [m]."""
    jacobian: Float[np.ndarray, "6 6"]
    """Velocity [m/s] and angular velocity [rad/s] of the tip per joint speed."""
    links: Float[np.ndarray, "points 3"]
    """Ends of the capsules of links, holder, handle and shaft that can come near the table [m]."""
    link_radii: Float[np.ndarray, " points"]
    """Radii of those capsules [m]."""
    blade: Float[np.ndarray, "8 3"]
    """Corners of the blade [m]."""


class ArmKinematics:
    """Kinematics of the simulated arm, which are the real one's; the same model that planned the joint path.

    Args:
        tool: Dimensions of the screwdriver.
    """

    def __init__(self, tool: Screwdriver) -> None:
        self._model = build_scene(None, Physics(), tool, "arm", 0.002).compile()
        self._data = mujoco.MjData(self._model)
        self.T_flange_tip = arm.T_flange_tip(tool)
        """Blade tip in the flange's frame."""
        model, capsule = self._model, mujoco.mjtGeom.mjGEOM_CAPSULE
        fixed = [model.body(name).id for name in FIXED_BODIES]
        moving = [g for g in range(model.ngeom) if model.geom_bodyid[g] not in fixed]
        self._capsules = [g for g in moving if model.geom_type[g] == capsule]
        signs = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(8, 3)
        self._blade_corners = signs * model.geom("blade").size
        self._tip = model.site("tip").id
        # The scene's origin is the contact point; its axes are the base's.
        self._base = np.array(arm.BASE_POSITION)

    def solve(
        self, T_base_tip: Float[np.ndarray, "4 4"], start: Float[np.ndarray, "6"]
    ) -> Float[np.ndarray, "6"]:
        """Joint angles [rad] that bring the blade tip to a pose, in the branch of a nearby posture.

        Raises:
            ActionError: If the pose is out of reach.
        """
        T = T_base_tip.copy()
        T[:3, 3] += self._base
        return arm.solve_inverse_kinematics(self._model, T, start)

    def at(self, joints: Float[np.ndarray, "6"]) -> Posture:
        """The arm at given joint angles [rad]."""
        model, data = self._model, self._data
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        jacobian, tip = np.zeros((6, model.nv)), data.site("tip")
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], self._tip)
        axes = data.geom_xmat[self._capsules].reshape(-1, 3, 3)[:, :, 2]
        half = axes * model.geom_size[self._capsules, 1, None]
        middles = data.geom_xpos[self._capsules] - self._base
        blade = data.geom("blade")
        T_base_blade = rigid_transform(blade.xmat.reshape(3, 3), blade.xpos - self._base)
        return Posture(
            T_base_tip=rigid_transform(tip.xmat.reshape(3, 3), tip.xpos - self._base),
            flange=data.site("flange").xpos - self._base,
            wrist=data.body("link_wrist_3").xpos - self._base,
            jacobian=jacobian,
            links=np.concatenate([middles - half, middles + half]),
            link_radii=np.tile(model.geom_size[self._capsules, 0], 2),
            blade=transform_points(T_base_blade, self._blade_corners),
        )

    def along(self, joints: Float[np.ndarray, "time 6"]) -> list[Posture]:
        """The arm at every set point of a path."""
        return [self.at(q) for q in joints]
