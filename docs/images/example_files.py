"""The files of `foretrace predict --example`: a mask, and a rendered photograph with its camera and markers.

python docs/images/example_files.py writes them into src/foretrace/assets/example and prints the contact in both.
"""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from foretrace.actions import LeverUp
from foretrace.errors import PredictionError
from foretrace.geometry import invert_transform
from foretrace.images import read_image
from foretrace.objects import Prism
from foretrace.objects.shape_files import read_silhouette_image
from foretrace.perception.example import BACKGROUND, CONTACT, FILES, HEIGHT, MASK, PHOTO, SCALE
from foretrace.simulation.lens import WEBCAM
from foretrace.simulation.recording import RecordingConfig, record_lever_up

FOLDER = Path(__file__).parents[2] / "src/foretrace/assets/example"
SIZE = (320, 400)
"""Rows and columns of the mask."""
CORNERS, RADIUS = np.array([[60.0, 75.0], [290.0, 45.0], [345.0, 150.0], [230.0, 265.0], [85.0, 240.0]]), 22.0
"""Middles of the arcs at the board's corners, and their radius [pixels]."""
SEED = 1


def draw_board() -> np.ndarray:
    """A cheese board: a pentagon with round corners, white on black."""
    mask = np.zeros(SIZE, dtype=np.uint8)
    shift = 4
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    discs = CORNERS[:, None] + RADIUS * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    hull = cv2.convexHull(np.round(discs.reshape(-1, 2) * 2**shift).astype(np.int32))
    cv2.fillConvexPoly(mask, hull, (255.0,), cv2.LINE_8, shift)
    return mask


def main() -> None:
    """Write the files."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(FOLDER / MASK), draw_board())
    board = Prism.from_mask(read_silhouette_image(FOLDER / MASK), SCALE, HEIGHT)
    action = LeverUp.nearest(board, CONTACT)
    camera = WEBCAM.scaled(960 / WEBCAM.width)
    config = RecordingConfig(
        camera,
        frames_per_second=1.0,
        tail_time=-2.95,
        depth_every=0,
        table="wooden",
        object_colour="blue",
        distance=0.58,
        shadows=True,
    )
    with TemporaryDirectory() as scratch:
        folder = Path(scratch, "film")
        truth = record_lever_up(board, action, folder, config, seed=SEED)
        (frame,) = sorted(folder.glob("colour-*"))
        for source, target in ((frame, PHOTO), (folder / "background.png", BACKGROUND)):
            picture = read_image(source, PredictionError).bgr(source, PredictionError)
            cv2.imwrite(str(FOLDER / target), picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
        shutil.copy(folder / "markers.json", FOLDER / "markers.json")
    camera.save(FOLDER / "camera.json")
    rim = truth.T_table_object[0] @ np.array([*action.contact, HEIGHT, 1.0])
    pixel = camera.project(rim[None, :3], invert_transform(truth.T_table_camera))[0]
    print(f"contact {action.contact.round(4).tolist()} m is pixel {pixel.round().astype(int).tolist()}")
    for name in FILES:
        print(f"{FOLDER / name}: {(FOLDER / name).stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
