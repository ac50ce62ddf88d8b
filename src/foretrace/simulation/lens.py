"""A simulated camera with its faults: distortion, defocus, noise, changing light, depth that errs."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.errors import SimulationError, check_ranges
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.simulation.camera import compile_with_camera, make_renderer, render

WEBCAM = PinholeCamera(1280, 720, 921.0, 922.5, 648.0, 351.0, distortion=(0.09, -0.21, 0.0008, -0.0006, 0.11))
"""About what the colour camera of a depth camera has: 70 x 43 degrees, a lens of its time."""


@dataclass(frozen=True)
class Faults:
    """What keeps an image from being perfect."""

    blur: float = 0.7
    """Standard deviation of the defocus [pixel]."""
    noise: float = 2.0
    """Standard deviation of the noise of each colour [of 255]."""
    flicker: float = 0.15
    """Largest change of the light over a recording, as a part of it; it also falls off over the image by that."""
    depth_noise: float = 1.0
    """Scale of the depth noise that Nguyen et al. (2012) measured on a Kinect."""
    depth_holes: float = 0.01
    """Share of the pixels without depth."""

    def __post_init__(self) -> None:
        limits = {
            "blur": (0, 20),
            "noise": (0, 255),
            "flicker": (0, 1),
            "depth_noise": (0, 100),
            "depth_holes": (0, 1),
        }
        check_ranges(SimulationError, "film", self, limits, "choose a value in this range")


class LensCamera:
    """Renders a scene as a camera with a lens would see it.

    The scene is rendered through a pinhole wide enough, and then bent as the lens bends it.

    Args:
        spec: The scene; a camera is added to it.
        camera: The camera.
        T_world_camera: Its pose (x right, y down, z forward).
        lamp: Points that the scene's first light shines from [m]: it casts the shadows of all, blended. Without any
            nothing casts a shadow.

    Raises:
        SimulationError: The machine cannot render.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        camera: PinholeCamera,
        T_world_camera: Float[np.ndarray, "4 4"],
        lamp: Float[np.ndarray, "point 3"] | None = None,
    ):
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(float))
        reach = camera.fy * np.abs(rays[:, :2]).max(axis=0)
        width, height = (2 * int(np.ceil(half)) + 4 for half in reach)
        ideal = camera.fy * rays[:, :2] + [(width - 1) / 2, (height - 1) / 2]
        self._maps = [values.reshape(camera.height, camera.width).astype(np.float32) for values in ideal.T]
        self.camera, self._lamp = camera, lamp
        """Intrinsics."""
        self.model = compile_with_camera(spec, T_world_camera, height, width, camera.fy)
        """The compiled scene."""
        self.data = mujoco.MjData(self.model)
        """State of the scene."""
        self._renderer = make_renderer(self.model, height, width)

    def __enter__(self) -> "LensCamera":
        return self

    def __exit__(self, *exception: object) -> None:
        self._renderer.close()

    def colours(self) -> Float[np.ndarray, "rows columns 3"]:
        """The scene as it is: blue, green, red, bent by the lens and without noise."""
        lit = [self._render()] if self._lamp is None else [self._lit_from(point) for point in self._lamp]
        return self._bend(np.mean(lit, axis=0)[..., ::-1], cv2.INTER_LINEAR)

    def _lit_from(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "rows columns 3"]:
        self.model.light_pos[0] = point
        return self._render(shadows=True)

    def depths(self) -> Float[np.ndarray, "rows columns"]:
        """Distance along the optical axis [m], without noise."""
        return self._bend(self._render(depth=True), cv2.INTER_NEAREST).astype(float)

    def _render(self, **what: bool) -> np.ndarray:
        mujoco.mj_forward(self.model, self.data)
        return render(self._renderer, self.data, **what).astype(np.float32)

    def _bend(self, image: np.ndarray, interpolation: int) -> Any:
        return cv2.remap(image, self._maps[0], self._maps[1], interpolation)


def spoil(
    image: Float[np.ndarray, "rows columns 3"], faults: Faults, light: float, rng: np.random.Generator
) -> UInt8[np.ndarray, "rows columns 3"]:
    """An image as a sensor delivers it.

    Args:
        image: The perfect image.
        faults: How imperfect it becomes.
        light: Where in its range the light is, from -1 to 1.
        rng: Draws the noise.
    """
    slope = np.linspace(1.0, 1.0 - faults.flicker, image.shape[1])[None, :, None]
    lit = image * slope * (1 + faults.flicker * light)
    if faults.blur > 0:
        lit = cv2.GaussianBlur(lit, (0, 0), faults.blur)
    noise = faults.noise * _noise(image.shape, rng)
    return np.clip(np.rint(lit + noise), 0, 255).astype(np.uint8)


def spoil_depth(
    depth: Float[np.ndarray, "rows columns"], faults: Faults, rng: np.random.Generator
) -> Float[np.ndarray, "rows columns"]:
    """A depth image as a sensor delivers it [m]; 0 where it saw nothing."""
    sigma = faults.depth_noise * (0.0012 + 0.0019 * (depth - 0.4) ** 2)
    noisy = depth + sigma * _noise(depth.shape, rng)
    return np.where(rng.random(depth.shape, dtype=np.float32) < faults.depth_holes, 0.0, noisy)


@cache
def _noise_bank() -> Float[np.ndarray, " n"]:
    return np.random.default_rng(0).standard_normal(1 << 23, dtype=np.float32)


def _noise(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Normal noise, cut at a random place from a bank: drawing it anew would take longer than rendering."""
    size = int(np.prod(shape))
    bank = _noise_bank()
    if size >= len(bank):
        return rng.standard_normal(shape, dtype=np.float32)
    start = int(rng.integers(len(bank) - size))
    return bank[start : start + size].reshape(shape)


def add_image(
    body: mujoco.MjsBody,
    spec: mujoco.MjSpec,
    name: str,
    image: UInt8[np.ndarray, "rows columns"],
    size: tuple[float, float],
    pose: Float[np.ndarray, "7"],
) -> None:
    """Adds a thin slab with an image on its upper face, which nothing touches.

    Args:
        body: What it lies on.
        spec: The scene.
        name: A name that is still free.
        image: The image in grey.
        size: Width and height [m].
        pose: Its middle in the body's frame: x to the right in the image, y up, z out of it.
    """
    rows, columns = image.shape
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=columns, height=rows, nchannel=3
    )
    texture.data = np.repeat(image[..., None], 3, axis=2).tobytes()
    material = spec.add_material(name=name)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    x, y, z = size[0] / 2, size[1] / 2, SLAB / 2
    top = [[-x, y, z], [x, y, z], [x, -y, z], [-x, -y, z]]
    vertices = np.array(top + [[a, b, -z] for a, b, _ in top])
    faces = [[0, 3, 2], [0, 2, 1], [4, 5, 6], [4, 6, 7]]
    faces += [[k, k + 4, (k + 1) % 4 + 4] for k in range(4)] + [
        [k, (k + 1) % 4 + 4, (k + 1) % 4] for k in range(4)
    ]
    # Fifth texture point: a corner of the white margin, for the sides.
    places = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.005, 0.005]])
    face_places = [[0, 3, 2], [0, 2, 1]] + [[4, 4, 4]] * 10
    spec.add_mesh(
        name=name,
        uservert=vertices.ravel(),
        userface=np.ravel(faces).astype(np.int32),
        usertexcoord=places.ravel(),
        userfacetexcoord=np.ravel(face_places).astype(np.int32),
    )
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=name,
        pos=pose[:3],
        quat=pose[3:],
        contype=0,
        conaffinity=0,
        mass=0,
    )


SLAB = 0.0002
"""Thickness of a printed marker [m]."""
