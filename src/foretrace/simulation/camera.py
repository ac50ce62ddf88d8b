"""A simulated RGB-D camera above the table, about as good as a Kinect's."""

import ctypes
import os
import sys
import warnings
from dataclasses import dataclass, field

import mujoco
import numpy as np
from jaxtyping import Float, Shaped, UInt8
from mujoco.rendering.classic import gl_context

from foretrace.actions import Action, Screwdriver
from foretrace.errors import SimulationError
from foretrace.geometry import matrix_to_pose, matrix_to_quaternion, planar_transform, rigid_transform
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.record import Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel
from foretrace.simulation.scene import body_origin, build_scene

MINIMAL_HEIGHT = 0.008
"""Points lower than this are the table's, noise included [m]."""
CAMERA = "camera"
"""Name of the camera in a scene."""


@dataclass(frozen=True)
class RgbdFrame:
    """One image of an RGB-D camera."""

    rgb: UInt8[np.ndarray, "rows columns 3"]
    """Colour."""
    depth: Float[np.ndarray, "rows columns"]
    """Distance along the optical axis [m]."""
    camera: PinholeCamera
    """Intrinsics."""
    T_action_camera: Float[np.ndarray, "4 4"]
    """Pose of the camera in the action frame (camera frame: x right, y down, z forward)."""

    def view(self) -> TopDownView:
        """The image seen from above: what every real depth image goes through, too."""
        points = self.camera.deproject(self.depth, self.T_action_camera)
        return TopDownView.from_points(points, MINIMAL_HEIGHT)


@dataclass(frozen=True)
class RgbdConfig:
    """Where the camera hangs and how noisy its depth is."""

    camera: PinholeCamera = field(default_factory=PinholeCamera)
    """Intrinsics; 57 x 45 degrees by default."""
    position: tuple[float, float, float] = (0.1, 0.0, 0.75)
    """Position in the action frame [m]; it looks straight down."""
    noise: float = 1.0
    """Scale of the axial noise that Nguyen et al. (2012) measured on a Kinect; 0 switches it off."""


def take_rgbd(
    obj: ObjectModel, action: Action, config: RgbdConfig = RgbdConfig(), *, seed: int = 0
) -> RgbdFrame:
    """Renders the object on the table before the arm comes into the image.

    Args:
        obj: The object.
        action: The lever-up that places it.
        config: The camera.
        seed: Seed of the depth noise.

    Raises:
        SimulationError: If the machine can render neither with EGL nor with OSMesa.
    """
    camera = config.camera
    spec = build_scene(obj, Physics(), Screwdriver(), None, timestep=0.002)
    # The image's rows run along -x and its columns along -y of the action frame, as in the top-down view.
    axes = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    T_action_camera = rigid_transform(axes, config.position)
    model = compile_with_camera(spec, T_action_camera, camera.height, camera.width, camera.fy)
    data = mujoco.MjData(model)
    data.qpos[:7] = matrix_to_pose(action.T_action_object @ planar_transform(body_origin(obj), 0.0))
    mujoco.mj_forward(model, data)
    with make_renderer(model, camera.height, camera.width) as renderer:
        rgb = render(renderer, data)
        depth = render(renderer, data, depth=True).astype(float)
    sigma = config.noise * (0.0012 + 0.0019 * (depth - 0.4) ** 2)
    depth += np.random.default_rng(seed).normal(size=depth.shape) * sigma
    return RgbdFrame(rgb, depth, camera, T_action_camera)


def compile_with_camera(
    spec: mujoco.MjSpec, T_world_camera: Float[np.ndarray, "4 4"], height: int, width: int, fy: float
) -> mujoco.MjModel:
    """A compiled scene with a camera in it.

    Args:
        spec: The scene.
        T_world_camera: Pose of the camera (x right, y down, z forward).
        height: Rows of the image.
        width: Columns of the image.
        fy: Focal length along the rows [pixel].
    """
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    # MuJoCo's camera has y up and looks along -z.
    turned = matrix_to_quaternion(T_world_camera[:3, :3] @ np.diag([1.0, -1.0, -1.0]))
    spec.worldbody.add_camera(name=CAMERA, pos=T_world_camera[:3, 3], quat=turned)
    model = spec.compile()
    model.cam_fovy[model.camera(CAMERA).id] = np.rad2deg(2 * np.arctan(height / 2 / fy))
    return model


def make_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """A renderer that needs no display: EGL, or OSMesa where EGL is missing (it warns then).

    The environment variable ``MUJOCO_GL`` overrides the choice.

    Raises:
        SimulationError: If neither is installed.
    """
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
        if _loads("libEGL.so.1") and _loads("libOpenGL.so.0"):
            from mujoco.egl import GLContext
        elif _loads("libOSMesa.so.8") or _loads("libOSMesa.so.6"):
            warnings.warn("EGL is not installed: rendering in software with OSMesa, slower", stacklevel=2)
            from mujoco.osmesa import GLContext
        else:
            raise SimulationError(
                "cannot render: neither EGL nor OSMesa is installed; install libegl1, libopengl0 and "
                "libgl1-mesa-dri (or libosmesa6), or use the exact camera, which needs no rendering"
            )
        gl_context.GLContext = GLContext
    try:
        return mujoco.Renderer(model, height, width)
    except (ImportError, RuntimeError, mujoco.FatalError) as error:
        raise SimulationError(
            f"cannot open a renderer ({error}): set MUJOCO_GL to egl or osmesa, or use the exact camera"
        ) from error


def render(
    renderer: mujoco.Renderer, data: mujoco.MjData, *, depth: bool = False, shadows: bool = False
) -> Shaped[np.ndarray, "rows columns *channels"]:
    """One image of a scene by its `compile_with_camera`: red, green and blue, or distance along the optical axis [m].

    Args:
        renderer: The renderer.
        data: State of the scene.
        depth: Render depth instead of colour.
        shadows: Let the scene's lamps cast shadows.
    """
    renderer.update_scene(data, camera=CAMERA)
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
    if not depth:
        return renderer.render()
    renderer.enable_depth_rendering()
    try:
        return renderer.render()
    finally:
        renderer.disable_depth_rendering()


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
