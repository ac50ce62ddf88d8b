"""Images of an interaction over time, rendered again from its recorded poses by a camera beside the table."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.errors import ExportError, SimulationError
from foretrace.geometry import matrix_to_pose, planar_transform, pose_to_matrix, rigid_transform
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.record import Interaction
from foretrace.simulation.camera import compile_with_camera, make_renderer, render
from foretrace.simulation.scene import body_origin, build_scene
from foretrace.simulation.tool import add_tool

CAMERA = PinholeCamera(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
"""The camera's intrinsics."""
CAMERA_POSITION = np.array([0.06, -0.36, 0.42])
"""Where it stands in the action frame [m]: to the right of the action, looking down on it."""
CAMERA_AIM = np.array([0.04, 0.0, 0.04])
"""The point in the action frame that it looks at [m]."""


@dataclass(frozen=True)
class RenderedImages:
    """What a colour and depth camera sees, image by image."""

    rgb: UInt8[np.ndarray, "time rows columns 3"]
    """Colour."""
    depth: Float[np.ndarray, "time rows columns"]
    """Distance along the optical axis [m], as float32."""
    camera: PinholeCamera
    """Intrinsics."""
    T_action_camera: Float[np.ndarray, "4 4"]
    """Pose of the camera in the action frame (camera frame: x right, y down, z forward)."""


def camera_pose() -> Float[np.ndarray, "4 4"]:
    """T_action_camera of the camera beside the table."""
    forward = CAMERA_AIM - CAMERA_POSITION
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    return rigid_transform(np.column_stack([right, np.cross(forward, right), forward]), CAMERA_POSITION)


def render_images(
    interaction: Interaction,
    object_poses: Float[np.ndarray, "time 7"],
    tool_poses: Float[np.ndarray, "time 7"],
) -> RenderedImages:
    """Renders a simulated interaction: object, tool and table, without the arm.

    Args:
        interaction: Whose object, on whose table.
        object_poses: Object frame in the action frame: position [m], quaternion (w, x, y, z).
        tool_poses: Blade tip in the action frame, likewise.

    Raises:
        ExportError: The machine cannot render.
    """
    obj, pose = interaction.object, camera_pose()
    spec = build_scene(obj, interaction.physics, interaction.action.tool, None, timestep=0.002)
    body = spec.worldbody.add_body(name="tool")
    body.add_freejoint()
    add_tool(body, interaction.action.tool, 0.0, pos=np.zeros(3), quat=np.array([1.0, 0.0, 0.0, 0.0]))
    model = compile_with_camera(spec, pose, CAMERA.height, CAMERA.width, CAMERA.fy)
    data = mujoco.MjData(model)
    bodies = matrix_to_pose(pose_to_matrix(object_poses) @ planar_transform(body_origin(obj), 0.0))
    shape = (len(bodies), CAMERA.height, CAMERA.width)
    rgb, depth = np.zeros((*shape, 3), dtype=np.uint8), np.zeros(shape, dtype=np.float32)
    try:
        renderer = make_renderer(model, CAMERA.height, CAMERA.width)
    except SimulationError as error:
        raise ExportError(f"{error}; or export without images: --no-camera") from error
    with renderer:
        for k in range(len(bodies)):
            data.qpos[:] = np.concatenate([bodies[k], tool_poses[k]])
            mujoco.mj_forward(model, data)
            rgb[k] = render(renderer, data)
            depth[k] = render(renderer, data, depth=True)
    return RenderedImages(rgb, depth, CAMERA, pose)


def images_of_samples(interaction: Interaction) -> RenderedImages | None:
    """Images of a simulated interaction at its samples; None for a recorded one.

    Raises:
        ExportError: The machine cannot render.
    """
    if interaction.provenance.source != "simulated":
        return None
    effect = interaction.effect
    return render_images(interaction, effect.pose_trajectory, effect.tool_trajectory)
