"""The UR10 in a visitor's page: it leads the screwdriver along the path that is chosen."""

from functools import lru_cache
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from foretrace.actions import LeverUp, ToolPath, tool_transforms
from foretrace.errors import ActionError
from foretrace.geometry import invert_transform, matrix_to_pose
from foretrace.simulation.arm_parts import arm_parts, arm_poses, joints_along

PERIOD = 0.05
"""Time between two of the arm's postures [s]."""
ROUND = 20
"""Sides of a part."""


@lru_cache(maxsize=32)
def postures(path: ToolPath) -> Float[np.ndarray, "parts time 7"]:
    """Where each of the arm's parts is along a path, every `PERIOD`, in the action frame.

    The arm's base has a fixed place in the action frame, so the contact makes no difference.

    Raises:
        ActionError: The arm cannot follow the path.
    """
    action = LeverUp((0.0, 0.0), (1.0, 0.0), path)
    times = PERIOD * np.arange(round(path.duration / PERIOD) + 1)
    joints = joints_along(action.tool, tool_transforms(action.tool_motion(times)), PERIOD)
    return arm_poses(action.tool, joints)


class ShownArm:
    """The arm in one visitor's page, hidden at first.

    Args:
        scene: The visitor's scene, in viser.
    """

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._root = scene.add_frame("/arm", show_axes=False, visible=False)
        self._parts: list[Any] = []
        self._postures = np.zeros((0, 0, 7))

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self._root.visible

    def place(self, action: LeverUp) -> None:
        """Bring its base to where it stands for a lever-up."""
        pose = matrix_to_pose(invert_transform(action.T_action_object))
        self._root.position, self._root.wxyz = pose[:3], pose[3:]

    def follow(self, path: ToolPath) -> None:
        """Show it, leading the screwdriver along a path.

        Raises:
            ActionError: It cannot follow the path, and is hidden.
        """
        try:
            self._postures = postures(path)
        except ActionError:
            self.hide()
            raise
        if not self._parts:
            self._add_parts()
        self._root.visible = True

    def hide(self) -> None:
        """Hide it."""
        self._root.visible = False

    def show_time(self, time: float) -> None:
        """The arm as it is at a time [s]."""
        if not self._root.visible:
            return
        shown = self._postures  # which another thread may replace
        k = min(round(time / PERIOD), shown.shape[1] - 1)
        for handle, pose in zip(self._parts, shown[:, k], strict=True):
            handle.position, handle.wxyz = pose[:3], pose[3:]

    def _add_parts(self) -> None:
        for k, part in enumerate(arm_parts(LeverUp((0.0, 0.0), (1.0, 0.0)).tool)):
            if part.shape == "capsule":
                mesh = trimesh.creation.capsule(part.length, part.radius, count=[ROUND, ROUND])
            else:
                mesh = trimesh.creation.cylinder(part.radius, part.length, sections=ROUND)
            colour = tuple(round(255 * each) for each in part.colour)
            self._parts.append(
                self._scene.add_mesh_simple(
                    f"/arm/part{k}", np.asarray(mesh.vertices), np.asarray(mesh.faces), color=colour
                )
            )
