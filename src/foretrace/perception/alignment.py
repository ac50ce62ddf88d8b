"""A marker's corners to a hundredth of a pixel: its pattern, as a camera would see it, fitted to the image."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.interactions.marker_patterns import draw_marker

CELL = 16
"""Values along a module of the pattern that is drawn."""
OVERSAMPLED_SIDE = 400
"""Samples along a marker's side, which are averaged pixel by pixel, 4 along a pixel at most."""
BLUR, LEAST_BLUR, LARGEST_BLUR, BLUR_STEP = 0.8, 0.2, 4.0, 0.3
"""Standard deviation of the blur at first, its bounds, and its largest change in a step [pixel]."""
BORDER = 8
"""Pixels round a marker that are drawn."""
RIM = 0.75
"""White round the marker that counts: further out, what lies round the marker shines in [module]."""
STEPS = 10
CONVERGED = 1e-3
"""Change of the corners at which the fit ends [pixel]."""
LEAST_LIKENESS = 0.5
"""Least part of the variance that the pattern explains; an image that is less like it is covered or smeared."""


def fit_pattern(
    image: UInt8[np.ndarray, "rows columns"], name: str, id: int, corners: Float[np.ndarray, "4 2"]
) -> Float[np.ndarray, "4 2"] | None:
    """The corners at which a marker's pattern explains the image best; None where it does not.

    Least squares over all pixels of the marker and some of its margin (Gauss-Newton; Lucas and Kanade, 1981; Baker and
    Matthews, 2004): eight numbers of the projection, the blur, and how grey values follow from light (a parabola).
    Since blur and contrast are fitted, edges are neither drawn outwards nor inwards.

    Args:
        image: The image.
        name: The marker's dictionary.
        id: Its number.
        corners: Its corners as detected [pixel], to about a pixel.
    """
    pattern = np.pad(draw_marker(name, id), 1, constant_values=255)
    modules = len(pattern) - 2
    square = modules * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - BORDER, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + BORDER + 1, image.shape[::-1])
    patch = image[low[1] : high[1], low[0] : high[0]].astype(float)
    samples = int(np.clip(OVERSAMPLED_SIDE / np.ptp(corners, axis=0).max(), 1, 4))
    fine = np.kron(pattern, np.ones((CELL, CELL))).astype(np.float32) / 255
    columns, rows = np.meshgrid(*(np.arange(side, dtype=float) for side in patch.shape[::-1]))
    H = cv2.getPerspectiveTransform(square.astype(np.float32), (corners - low).astype(np.float32)).astype(
        float
    )
    blur, found, before = BLUR, corners - low, corners - low
    missing, seen = np.ones(1), np.zeros(1)
    for _ in range(STEPS):
        to_square = np.linalg.inv(H)
        drawn = _draw(fine, to_square, patch.shape, samples, blur)
        u, v, w = np.tensordot(to_square, np.stack([columns, rows, np.ones_like(rows)]), axes=1)
        u, v = u / w, v / w
        inside = (np.minimum(u, v) > -RIM) & (np.maximum(u, v) < modules + RIM)
        u, v, x, y = u[inside], v[inside], columns[inside], rows[inside]
        light, by_x, by_y, by_blur = (part[inside] for part in drawn)
        tones = np.stack([light, np.ones_like(light), light**2], axis=1)
        seen = patch[inside]
        curve = np.linalg.lstsq(tones, seen, rcond=None)[0]
        missing = seen - tones @ curve
        gain, scale = curve[0] + 2 * curve[2] * light, H[2, 0] * u + H[2, 1] * v + H[2, 2]
        by_x, by_y = -gain * by_x / scale, -gain * by_y / scale
        by_w = -(x * by_x + y * by_y)
        terms = [by_x * u, by_x * v, by_x, by_y * u, by_y * v, by_y, by_w * u, by_w * v, gain * by_blur]
        jacobian = np.column_stack([*terms, tones])
        norms = np.linalg.norm(jacobian, axis=0) + 1e-12
        step = np.linalg.lstsq(jacobian / norms, missing, rcond=None)[0] / norms
        H = H + np.append(step[:8], 0.0).reshape(3, 3)
        blur = float(np.clip(blur + np.clip(step[8], -BLUR_STEP, BLUR_STEP), LEAST_BLUR, LARGEST_BLUR))
        found = cv2.perspectiveTransform(square[None], H)[0]
        if not np.isfinite(found).all() or np.abs(found + low - corners).max() > BORDER:
            return None
        if np.abs(found - before).max() < CONVERGED:
            break
        before = found
    if not (missing**2).mean() < (1 - LEAST_LIKENESS) * seen.var():
        return None
    return found + low


def _draw(
    fine: Float[np.ndarray, "side side"],
    to_square: Float[np.ndarray, "3 3"],
    shape: tuple[int, int],
    samples: int,
    blur: float,
) -> Float[np.ndarray, "4 rows columns"]:
    """The pattern as a camera sees it, and its derivatives by column, row and blur, white 1 and black 0."""
    size = (shape[1] * samples, shape[0] * samples)
    to_pattern = np.array([[CELL, 0.0, CELL - 0.5], [0.0, CELL, CELL - 0.5], [0.0, 0.0, 1.0]])
    shift = 0.5 / samples - 0.5
    from_sample = np.array([[1 / samples, 0.0, shift], [0.0, 1 / samples, shift], [0.0, 0.0, 1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    sharp = cv2.warpPerspective(
        fine, to_pattern @ to_square @ from_sample, size, flags=flags, borderValue=1.0
    )
    seen = cv2.GaussianBlur(sharp, (0, 0), blur * samples, borderType=cv2.BORDER_REPLICATE)
    half = 0.5 * samples
    parts = [
        seen,
        half * cv2.Sobel(seen, cv2.CV_32F, 1, 0, ksize=1),
        half * cv2.Sobel(seen, cv2.CV_32F, 0, 1, ksize=1),
        blur * samples**2 * cv2.Laplacian(seen, cv2.CV_32F, ksize=1),  # the heat equation
    ]
    return np.stack([cv2.resize(part, shape[::-1], interpolation=cv2.INTER_AREA) for part in parts]).astype(
        float
    )
