"""Small sound inputs of every kind, made once in a folder: what trials start from, or damage."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

TESTS = Path(__file__).parents[1]
DONE = "complete"
"""File that marks a folder of materials as complete."""


def prepare(folder: Path) -> Path:
    """Make the materials, in a process of its own, unless they are there.

    That process alone renders, trains and starts threads: processes that fork must not have done so.
    """
    if not (folder / DONE).is_file():
        folder.mkdir(parents=True, exist_ok=True)
        paths = f"import sys; sys.path.insert(0, {str(TESTS)!r})"
        code = f"{paths}; from campaign import materials; materials.make({str(folder)!r})"
        subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
    return folder


def make(folder: str | Path) -> None:
    """Make all materials in an empty folder."""
    import trimesh

    import foretrace as ft
    import recorded_scene
    from foretrace.cli import main
    from foretrace.interactions.recording_folder import write_image
    from foretrace.perception.calibration import Board
    from foretrace.simulation.collect import CollectConfig, collect
    from foretrace.simulation.recording import photograph_board

    folder = Path(folder)
    tool = ft.SimulationConfig(embodiment="tool")
    collect(CollectConfig(3, 1, simulation=tool), folder / "data", workers=1)
    data = ft.Dataset.open(folder / "data")
    loop = ft.TrainConfig(epochs=1, min_steps=1, split=None, threads=1)
    for name, config in (
        ("lstm", ft.LstmConfig(features="none", hidden=4)),
        ("one-shot", ft.OneShotConfig(hidden=8)),
    ):
        ft.train_predictor(data, config, folder / name, loop, progress=False)
    truth = recorded_scene.record(folder / "recording")
    board = Board()
    (folder / "board").mkdir()
    shots = photograph_board(board.draw(2000.0), board.size, recorded_scene.CAMERA, 12, seed=0)
    for number, image in enumerate(shots):
        write_image(folder / "board" / f"{number:02d}.png", image)

    box = trimesh.creation.box((0.12, 0.08, 0.02))
    box.apply_translation((0.0, 0.0, 0.01))
    for name in ("box.stl", "box.obj"):
        box.export(folder / name)
    (folder / "ascii.stl").write_text(str(box.export(file_type="stl_ascii")))
    corners = recorded_scene.PRISM.corners
    (folder / "outline.txt").write_text("".join(f"{x:.4f} {y:.4f}\n" for x, y in corners))
    (folder / "outline.csv").write_text("".join(f"{x:.4f},{y:.4f}\n" for x, y in corners))
    (folder / "object.json").write_text(json.dumps(recorded_scene.PRISM.to_dict()))
    mask = np.zeros((90, 120), dtype=np.uint8)
    cv2.fillPoly(mask, [np.array([[20, 20], [100, 15], [95, 70], [30, 75]], dtype=np.int32)], 255)
    for name in ("mask.png", "mask.jpg", "mask.tif"):
        cv2.imwrite(str(folder / name), mask)
    pose = {
        "format": "foretrace-base-pose",
        "version": 1,
        "T_table_base": [-0.7, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0],
    }
    (folder / "base.json").write_text(json.dumps(pose))
    _make_films(folder)
    made = {
        "imported": "import {m}/recording --contact-px {x} {y} --object {m}/object.json --out {m}/imported",
        "evaluated": "evaluate predictor {m}/lstm --data {m}/data --out {m}/evaluated",
        "plan": "plan {m}/lstm --polygon {m}/outline.txt --goal move --direction 1 0 --pose 0.1 0.2 0.3 --refine 0"
        " --check 0 --out {m}/plan",
        "film": "film {m}/data 0 --out {m}/film --width 320 --fps 4 --exposures 1 --depth-every 8",
    }
    x, y = (f"{value:.1f}" for value in recorded_scene.contact_pixel(truth))
    for command in made.values():
        status = main(command.format(m=folder, x=x, y=y).split())
        assert status == 0, command
    trial = next((folder / "evaluated" / "trials").iterdir())
    trial.rename(trial.with_name("test.json"))
    (folder / DONE).touch()


def _make_films(folder: Path) -> None:
    """The recording as a video and as bags."""
    from test_bags import Said, images, write_bag

    images_of = [cv2.imread(str(file)) for file in sorted((folder / "recording").glob("colour-*.jpg"))[:6]]
    writer = cv2.VideoWriter(str(folder / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (800, 450))
    for image in images_of:
        writer.write(image)
    writer.release()
    said = images(3)
    packed = [
        Said("/camera/color/compressed", one.time, cv2.imencode(".png", one.data)[1].tobytes(), "png")
        for one in said
    ]
    write_bag(folder / "film.bag", said, ros1=True)
    write_bag(folder / "film-mcap", said, ros1=False)
    write_bag(folder / "film-db3", packed, ros1=False, plugin="db3")
