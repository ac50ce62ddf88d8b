"""How exactly one small marker tells its pose: detected corners against aligned ones, over rendered images."""

import argparse
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from foretrace.errors import PerceptionError
from foretrace.geometry import rigid_transform, rotation_angle
from foretrace.interactions.marker_patterns import draw_marker
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.markers import Detections, MarkerBody, align_patterns, detect_markers
from foretrace.perception.tracking import still_pose
from prints import photograph

CAMERA = PinholeCamera(640, 480, 600.0, 600.0, 320.0, 240.0)
DICTIONARY = "apriltag_36h11"
SIDE = 0.05
SIZES = (25, 30, 35, 48, 65, 80)
TILTS = (0.0, 60.0)
CONDITIONS: dict[str, dict[str, Any]] = {
    "sharp": {"blur": 0.5, "noise": 1.5},
    "usual": {"blur": 0.8, "noise": 2.0},
    "blurred, noisy": {"blur": 1.2, "noise": 4.0},
    "light raised to 1 / 2.2": {"blur": 0.8, "noise": 2.0, "gamma": 2.2},
}
WRONG = 15.0
"""Rotation error beyond which the other of the two poses was taken [degree]."""


def measure(size: float, rng: np.random.Generator, **condition: Any) -> dict:
    """Errors of the pose from one image of a marker whose side measures so many pixels where it is not slanted."""
    id = int(rng.integers(0, 100))
    marker = np.pad(draw_marker(DICTIONARY, id), 1, constant_values=255)
    axis, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(*TILTS))
    turn, _ = cv2.Rodrigues(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
    spin, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    pixel = np.array([320.0, 240.0]) + rng.uniform(-120, 120, 2)
    place = CAMERA.fx * SIDE / size * CAMERA.rays(pixel[None])[0]
    T = rigid_transform(turn @ np.diag([1.0, -1.0, -1.0]) @ spin, place)
    paper = SIDE * len(marker) / (len(marker) - 2)
    image = photograph(marker, (paper, paper), T, CAMERA, rng, **condition)
    seen = detect_markers(image, DICTIONARY)
    body, row = MarkerBody.single(id, SIDE), {}
    for name, found in (("detected", seen), ("aligned", align_patterns(image, seen, DICTIONARY))):
        row[name] = _errors(found, body, T)
    return row


def _errors(found: Detections, body: MarkerBody, T: np.ndarray) -> dict | str:
    try:
        pose = still_pose([found], body, CAMERA)
    except PerceptionError as error:
        return "unseen" if "not seen" in str(error) else "flagged"
    return {
        "distance_percent": float(100 * (np.linalg.norm(pose[:3, 3]) / np.linalg.norm(T[:3, 3]) - 1)),
        "rotation_deg": float(np.rad2deg(rotation_angle(pose[:3, :3], T[:3, :3]))),
    }


def summarise(rows: list[dict | str]) -> dict:
    """One cell of the table."""
    kept = [row for row in rows if isinstance(row, dict)]
    line: dict = {"images": len(rows), "unseen": rows.count("unseen"), "flagged": rows.count("flagged")}
    if kept:
        distance, turn = (
            np.array([row[key] for row in kept]) for key in ("distance_percent", "rotation_deg")
        )
        right = turn < WRONG
        line |= {
            "wrong_pose": int((~right).sum()),
            "distance_percent_mean": float(distance.mean()),
            "distance_percent_median": float(np.median(np.abs(distance))),
            "rotation_deg_median": float(np.median(turn)),
        }
    return line


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--images", type=int, default=100, help="of each size and condition")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    table: dict = {}
    for name, condition in CONDITIONS.items():
        for size in SIZES:
            rng = np.random.default_rng(size)
            rows = [measure(size, rng, **condition) for _ in range(options.images)]
            cell = {how: summarise([row[how] for row in rows]) for how in ("detected", "aligned")}
            table.setdefault(name, {})[str(size)] = cell
            print(name, size, json.dumps(cell), flush=True)
    if options.out is not None:
        content = {"opencv": cv2.__version__, "foretrace": version("foretrace"), "conditions": table}
        options.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
