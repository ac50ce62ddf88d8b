"""What a camera sees of printed boards and markers."""

import cv2
import numpy as np

from foretrace.geometry import invert_transform
from foretrace.interactions.marker_patterns import draw_marker
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.board import Board

CAMERA = PinholeCamera(640, 480, 600.0, 604.0, 322.0, 236.0, (0.08, -0.15, 0.001, -0.001, 0.05))
BOARD = Board((6, 5), 0.03, 0.022, "4x4_50")


def looking_at(tilt: float, turn: float, distance: float, spin: float = 0.3) -> np.ndarray:
    """T_camera_board: a board about the optical axis, slanted."""
    rotation, _ = cv2.Rodrigues(np.array([np.pi + tilt, turn, spin]))
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = [0.01, -0.02, distance]
    return T


def image_of(
    texture: np.ndarray, size: tuple[float, float], T: np.ndarray, camera: PinholeCamera
) -> np.ndarray:
    """What a camera sees of a flat print whose frame has its origin in the lower left corner: exact per pixel."""
    columns, rows = np.meshgrid(np.arange(2 * camera.width), np.arange(2 * camera.height))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1) / 2 - 0.25
    points = camera.on_plane(pixels, invert_transform(T))
    scale = np.array([texture.shape[1] / size[0], -texture.shape[0] / size[1]])
    where = (points * scale + [0.0, texture.shape[0]] - 0.5).astype(np.float32)
    where = where.reshape(*columns.shape, 2)
    seen = cv2.remap(texture, where[..., 0], where[..., 1], cv2.INTER_AREA, borderValue=200)
    image = cv2.resize(seen, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 0.6), cv2.COLOR_GRAY2BGR)


def board_images(num: int, board: Board = BOARD) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    texture = np.pad(board.draw(6000.0), 60, constant_values=255)
    size = (board.size[0] + 0.02, board.size[1] + 0.02)
    images = {}
    for k in range(num):
        tilt, turn = rng.uniform(-0.6, 0.6, 2)
        T = looking_at(float(tilt), float(turn), rng.uniform(0.22, 0.3))
        T[:3, 3] -= T[:3, :3] @ [size[0] / 2, size[1] / 2, 0.0]
        images[f"image {k}"] = image_of(texture, size, T, CAMERA)
    return images


def marker_scene(
    name: str, id: int, side: float, T: np.ndarray, camera: PinholeCamera = CAMERA
) -> np.ndarray:
    """A marker with its margin; T is T_camera_marker."""
    texture = np.pad(draw_marker(name, id, 20), 20, constant_values=255)
    modules = len(texture) // 20 - 2
    size = side * (modules + 2) / modules
    corner = np.eye(4)
    corner[:2, 3] = -size / 2
    return image_of(texture, (size, size), T @ corner, camera)
