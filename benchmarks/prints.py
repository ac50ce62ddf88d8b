"""Photographs of printed patterns: what a camera with a lens sees of them, blurred and with noise."""

from functools import lru_cache

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from foretrace.interactions.pinhole import PinholeCamera

SAMPLES = 6
"""Samples along a pixel, which are averaged."""
GRID = 4
"""Pixels from one line of sight that is computed to the next."""
BORDER = 8
"""Pixels round the print that are drawn with it."""


def _rays(pixels: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Lines of sight, interpolated between those of every fourth pixel."""
    where = ((pixels + GRID) / GRID).T[::-1]
    x, y = (map_coordinates(part, where, order=1) for part in _grid(camera))
    return np.stack([x, y, np.ones_like(x)], axis=-1)


@lru_cache(maxsize=8)
def _grid(camera: PinholeCamera) -> np.ndarray:
    columns, rows = (np.arange(-GRID, side + 2 * GRID, GRID) for side in (camera.width, camera.height))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    rays = camera.rays(pixels.reshape(-1, 2).astype(float))
    return rays[:, :2].T.reshape(2, *pixels.shape[:2])


def photograph(
    pattern: np.ndarray,
    size: tuple[float, float],
    T_camera_print: np.ndarray,
    camera: PinholeCamera,
    rng: np.random.Generator,
    *,
    blur: float = 0.7,
    noise: float = 1.5,
    bend: float = 0.0,
    black: float = 30.0,
    white: float = 220.0,
    around: float = 150.0,
    gamma: float = 1.0,
    samples: int = SAMPLES,
) -> np.ndarray:
    """A print in grey; its frame has its origin in the middle, x to the right, y up, z out of it.

    Args:
        pattern: What is printed, 0 black and 255 white, each value a rectangle.
        size: Width and height of the print [m].
        T_camera_print: Where it is.
        camera: What takes it.
        rng: For the noise.
        blur: Standard deviation of the lens's blur [pixel].
        noise: Standard deviation of the noise [grey value].
        bend: How far the middle stands out against the left and right sides [m].
        black: Grey value of black.
        white: Grey value of white.
        around: Grey value round the print.
        gamma: The response: light is averaged and blurred, then raised to 1 / gamma.
        samples: Samples along a pixel.
    """
    outline = np.array([[x, y, 0.0] for x in (-0.5, 0, 0.5) for y in (-0.5, 0, 0.5)]) * [*size, 0.0]
    seen = camera.project(outline, T_camera_print)
    low = np.maximum(np.floor(seen.min(axis=0)).astype(int) - BORDER, 0)
    high = np.minimum(np.ceil(seen.max(axis=0)).astype(int) + BORDER, [camera.width, camera.height])
    columns, rows = (np.arange(samples * (b - a)) / samples for a, b in zip(low, high, strict=True))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2) + low + 0.5 / samples - 0.5
    rotation, place = T_camera_print[:3, :3], T_camera_print[:3, 3]
    rays, start = _rays(pixels, camera) @ rotation, -rotation.T @ place
    x, y = (start - start[2] / rays[:, 2:] * rays)[:, :2].T
    for _ in range(2 if bend else 0):  # a bent print is met at another height than a flat one
        z = bend * (1 - 4 * (x / size[0]) ** 2)
        x, y = (start + ((z - start[2]) / rays[:, 2])[:, None] * rays)[:, :2].T
    row = np.floor((0.5 - y / size[1]) * pattern.shape[0]).astype(int)
    column = np.floor((0.5 + x / size[0]) * pattern.shape[1]).astype(int)
    inside = (row >= 0) & (row < pattern.shape[0]) & (column >= 0) & (column < pattern.shape[1])
    light = [255 * (value / 255) ** gamma for value in (around, black, white)]
    values = np.full(len(pixels), light[0])
    values[inside] = light[1] + pattern[row[inside], column[inside]] / 255 * (light[2] - light[1])
    shape = (len(rows) // samples, samples, len(columns) // samples, samples)
    image = np.full((camera.height, camera.width), light[0])
    image[low[1] : high[1], low[0] : high[0]] = values.reshape(shape).mean(axis=(1, 3))
    image = 255 * (cv2.GaussianBlur(image, (0, 0), blur) / 255) ** (1 / gamma)
    return np.clip(np.rint(image + rng.normal(0, noise, image.shape)), 0, 255).astype(np.uint8)
