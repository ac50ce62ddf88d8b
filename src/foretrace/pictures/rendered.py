"""Animations of lever-ups in three dimensions: the arm, the object, and what had been imagined, rendered by MuJoCo."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.colors import to_rgb

from foretrace.errors import DatasetError
from foretrace.geometry import matrix_to_pose, planar_transform, pose_to_matrix
from foretrace.imagined import ImaginedEffect
from foretrace.imagined.shown import radius_of
from foretrace.interactions.record import Interaction
from foretrace.pictures.animation_files import write_animation
from foretrace.pictures.style import PREDICTION_COLORS, TRUTH_COLOR
from foretrace.simulation.arm_parts import joints_along
from foretrace.simulation.camera import make_renderer
from foretrace.simulation.scene import body_origin, build_scene

WIDTH, HEIGHT = 800, 600
"""Size of a picture [pixels]."""
LOOK_AT, DISTANCE, AZIMUTH, ELEVATION = (-0.01, 0.0, 0.07), 0.52, 118.0, -20.0
"""The camera: a point in the action frame [m], the distance from it [m], and directions [degrees]."""
PATH, TUBE = 0.0016, 0.09
"""Radius of a drawn path [m]; opacity of each of the balls that show the region about it."""
SHADOW = 1024
"""Pixels of the shadows' map: a quarter of MuJoCo's, and several times faster without a graphics card."""
WIDEST = 0.05
"""A wider region would hide the object, and is not drawn [m]."""


def rendered_animation(interaction: Interaction, path: Path, imagined: ImaginedEffect | None = None) -> Path:
    """Write an interaction with the whole arm as a GIF or MP4, in real time.

    Where the record has no joint angles, they follow from the tool's poses.

    Args:
        interaction: What happened; its path is green.
        path: The file to write; its ending decides between ``.gif`` and ``.mp4``.
        imagined: What had been imagined: the path of the most probable future is orange, and its region translucent.

    Raises:
        DatasetError: It has no motion.
        ActionError: The arm cannot follow the tool's poses.
        SimulationError: The machine cannot render.
        PredictionError: The ending is unknown, or MP4 cannot be written here.
    """
    times = interaction.effect.times
    if len(times) < 2:
        raise DatasetError("the interaction has no motion: choose another one")
    return write_animation(path, rendered_frames(interaction, imagined), float(np.median(np.diff(times))))


def rendered_frames(
    interaction: Interaction, imagined: ImaginedEffect | None = None
) -> Iterator[UInt8[np.ndarray, "rows columns 3"]]:
    """The pictures of `rendered_animation`, one for each sample."""
    obj, effect = interaction.object, interaction.effect
    spec = build_scene(obj, interaction.physics, interaction.action.tool, "arm", timestep=0.002)
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_FLAT}
    spec.add_texture(name="sky", rgb1=[0.93, 0.95, 0.97], width=16, height=16, **sky)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = WIDTH, HEIGHT
    spec.visual.quality.shadowsize = SHADOW
    model = spec.compile()
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    camera.lookat[:] = LOOK_AT
    camera.distance, camera.azimuth, camera.elevation = DISTANCE, AZIMUTH, ELEVATION
    poses = matrix_to_pose(pose_to_matrix(effect.pose_trajectory) @ planar_transform(body_origin(obj), 0.0))
    joints = effect.joint_trajectory
    if joints.shape[1] == 0:
        tip = pose_to_matrix(effect.tool_trajectory)
        joints = joints_along(interaction.action.tool, tip, float(np.median(np.diff(effect.times))))
    with make_renderer(model, HEIGHT, WIDTH) as renderer:
        for k in range(len(effect.times)):
            data.qpos[:7], data.qpos[7:] = poses[k], joints[k]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            _add_path(renderer.scene, effect.com_trajectory[: k + 1], TRUTH_COLOR)
            if imagined is not None:
                _add_imagined(renderer.scene, imagined)
            yield renderer.render().copy()


def _add_imagined(scene: mujoco.MjvScene, imagined: ImaginedEffect) -> None:
    color = PREDICTION_COLORS[0]
    _add_path(scene, imagined.com_trajectory, color)
    radius = radius_of(imagined)
    if radius is not None and radius.max() <= WIDEST:
        last = np.full(3, np.inf)
        for place, wide in zip(imagined.com_trajectory, radius, strict=True):
            if np.linalg.norm(place - last) > wide / 2:
                _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, wide, color, TUBE, place, place)
                last = place


def _add_path(scene: mujoco.MjvScene, path: Float[np.ndarray, "time 3"], color: str) -> None:
    for start, end in pairwise(path):
        _add(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, PATH, color, 1.0, start, end)


def _add(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    radius: float,
    color: str,
    opacity: float,
    start: Float[np.ndarray, "3"],
    end: Float[np.ndarray, "3"],
) -> None:
    """One more body in a picture, as long as there is room for it."""
    if scene.ngeom >= scene.maxgeom:
        return
    geom, rgba = scene.geoms[scene.ngeom], np.array([*to_rgb(color), opacity], dtype=np.float32)
    size = np.full(3, radius)
    mujoco.mjv_initGeom(geom, kind, size, np.asarray(start, float), np.eye(3).ravel(), rgba)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        mujoco.mjv_connector(geom, kind, radius, np.asarray(start, float), np.asarray(end, float))
    scene.ngeom += 1
