"""How far calibrations are off, against what they state, over rendered sets of images; which sets are refused."""

import argparse
import json
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np

from foretrace.errors import PerceptionError
from foretrace.geometry import rigid_transform
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.board import Board
from foretrace.perception.calibration import calibrate
from prints import photograph

CAMERA = PinholeCamera(640, 480, 500.0, 501.0, 322.0, 236.0, (-0.12, 0.08, 0.001, -0.001, 0.0))
BOARD = Board((7, 5), 0.035, 0.026)
DOTS_PER_SQUARE = 36


@dataclass(frozen=True)
class Kind:
    """How the images of a set are taken."""

    num: int = 12
    """Images."""
    tilt: tuple[float, float] = (5.0, 40.0)
    """Least and largest slant of the board [degree]."""
    fill: tuple[float, float] = (0.35, 0.65)
    """Part of the image's width that the board fills."""
    spot: tuple[float, float] = (0.3, 0.7)
    """Where its middle is, across the image and down."""
    bend: float = 0.0
    """How far its middle stands out [m]."""
    blur: float = 0.7
    """Blur [pixel]."""
    noise: float = 1.5
    """Noise [grey value]."""
    repeats: int = 1
    """How often each view is taken."""


KINDS = {
    "good, 12 images": Kind(),
    "good, 9 images": Kind(9),
    "good, 20 images": Kind(20),
    "blurred": Kind(blur=1.6, noise=4.0),
    "board bent by 1 mm": Kind(bend=0.001),
    "board bent by 3 mm": Kind(bend=0.003),
    "five images": Kind(5),
    "tilted by 6 to 12 degrees": Kind(8, (6.0, 12.0)),
    "the same, small": Kind(6, (6.0, 12.0), (0.18, 0.25)),
    "small": Kind(8, fill=(0.15, 0.2)),
    "small, bent by 1 mm": Kind(8, fill=(0.15, 0.2), bend=0.001),
    "in one corner": Kind(10, fill=(0.25, 0.35), spot=(0.2, 0.3)),
    "five views, each four times": Kind(20, repeats=4),
    "two views, each six times": Kind(12, repeats=6),
}


def photographs(kind: Kind, seed: int) -> tuple[dict[str, np.ndarray], Board]:
    """Images of a set."""
    rng = np.random.default_rng(seed)
    margin = DOTS_PER_SQUARE // 2
    pattern = np.pad(BOARD.draw(DOTS_PER_SQUARE / BOARD.square_length), margin, constant_values=255)
    size = tuple(BOARD.square_length * side / DOTS_PER_SQUARE for side in pattern.shape[::-1])
    images: dict[str, np.ndarray] = {}
    while len(images) < kind.num:
        axis, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(*kind.tilt))
        turn, _ = cv2.Rodrigues(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
        spin, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-0.4, 0.4)]))
        distance = CAMERA.fx * BOARD.size[0] / (rng.uniform(*kind.fill) * CAMERA.width)
        pixel = rng.uniform(*kind.spot, 2) * [CAMERA.width, CAMERA.height]
        T = rigid_transform(turn @ np.diag([1.0, -1.0, -1.0]) @ spin, distance * CAMERA.rays(pixel[None])[0])
        for _ in range(kind.repeats):
            images[f"{len(images):02d}"] = photograph(
                pattern, size, T, CAMERA, rng, blur=kind.blur, noise=kind.noise, bend=kind.bend, samples=3
            )
    return images, BOARD


def measure(kind: Kind, seed: int) -> dict:
    """Error and stated deviation of the focal length and the centre, or why the set is refused."""
    images, board = photographs(kind, seed)
    try:
        found = calibrate(images, board)
    except PerceptionError as error:
        return {"refused": str(error)}
    camera, deviations = found.camera, found.deviations
    return {
        "focus_error_percent": 100 * (camera.fx / CAMERA.fx - 1),
        "focus_deviation_percent": 100 * deviations["fx"] / camera.fx,
        "centre_error_pixels": float(np.hypot(camera.cx - CAMERA.cx, camera.cy - CAMERA.cy)),
        "centre_deviation_pixels": float(np.hypot(deviations["cx"], deviations["cy"])),
        "reprojection_pixels": found.error,
    }


def summarise(rows: list[dict]) -> dict:
    """One line of the table."""
    kept = [row for row in rows if "refused" not in row]
    line: dict = {"sets": len(rows), "refused": len(rows) - len(kept)}
    if kept:
        error, stated = (
            np.array([abs(row[f"focus_{name}_percent"]) for row in kept]) for name in ("error", "deviation")
        )
        line |= {
            "focus_error_percent_median": float(np.median(error)),
            "focus_error_percent_max": float(error.max()),
            "focus_deviation_percent_median": float(np.median(stated)),
            "focus_within_2_deviations": int((error <= 2 * stated).sum()),
        }
    return line


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--sets", type=int, default=20)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    table = {}
    for name, kind in KINDS.items():
        rows = [measure(kind, seed) for seed in range(options.sets)]
        table[name] = summarise(rows)
        print(
            name,
            json.dumps(table[name]),
            next((row["refused"] for row in rows if "refused" in row), ""),
            flush=True,
        )
    if options.out is not None:
        content = {"opencv": cv2.__version__, "foretrace": version("foretrace"), "kinds": table}
        options.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
