"""The command that films a simulated lever-up, without a camera or a robot."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from foretrace.cli.console import say

if TYPE_CHECKING:
    from foretrace.interactions.pinhole import PinholeCamera


def film(
    data: Positional[Path],
    id: Positional[int],
    out: Path,
    width: int = 1280,
    fps: float = 30.0,
    slant: float = 0.6,
    azimuth: float = 1.0,
    distance: float = 0.7,
    depth_every: int = 10,
    embodiment: Literal["tool", "arm"] | None = None,
    board: int = 0,
    shadows: bool = False,
    table: Literal["plain", "wooden", "speckled"] = "plain",
    object_colour: Literal["blue", "grey", "brown"] = "blue",
    seed: int = 0,
) -> None:
    """Film a lever-up of a data set, simulated anew, as a camera above a real table would: a folder for `import`.

    The recording has a lens, blur, noise and changing light, markers on table and object, and an image of the empty
    table. What it shows exactly is in truth.json, which `import` does not read.

    Args:
        data: Folder of the data set.
        id: Number of the interaction.
        out: Folder to make.
        width: Columns of the images; they have 9/16 as many rows.
        fps: Frames per second.
        slant: Angle of the camera's line of sight from the vertical [rad].
        azimuth: Where the camera stands, from the action's direction towards its left [rad].
        distance: From the camera to the point on the table that it looks at [m].
        depth_every: Images from one with depth to the next; 0: no depth.
        embodiment: What moves the blade: nothing that is seen, or the whole arm; by default as in the data set.
        board: Number of images of a calibration board to take, too; they leave the camera's file to `calibrate`.
        shadows: Let a slanted lamp of some size cast soft shadows.
        table: How the table looks.
        object_colour: The object's colour; grey resembles the plain table, brown the wooden one.
        seed: Seed of noise, clock, table, and of where marker and lamp are.
    """
    import numpy as np

    from foretrace.errors import DatasetError, PerceptionError, SimulationError
    from foretrace.files import write_json
    from foretrace.geometry import invert_transform
    from foretrace.interactions import recording_folder
    from foretrace.interactions.dataset import Dataset
    from foretrace.simulation.lens import WEBCAM
    from foretrace.simulation.lever_up import SimulationConfig
    from foretrace.simulation.recording import RecordingConfig, record_lever_up

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise PerceptionError(f"{out} is in use: choose another folder")
    for option, value, most in (("seed", seed, 2**32), ("board", board, 1000)):
        if not 0 <= value <= most:
            raise SimulationError(f"--{option} is {value}: give a number from 0 to {most}")
    dataset = Dataset.open(data)
    rows = np.flatnonzero(dataset.table["id"].to_numpy() == id)
    if len(rows) == 0:
        raise DatasetError(
            f"{data} has no interaction {id} with a motion: `foretrace describe` lists what it has"
        )
    shown = dataset[int(rows[0])]
    camera = WEBCAM.scaled(width / WEBCAM.width)
    recorded = dataset.manifest["configuration"].get("simulation", {})
    simulation = SimulationConfig(
        embodiment=embodiment or recorded.get("embodiment", "tool"), physics=shown.physics
    )
    config = RecordingConfig(
        camera,
        distance,
        slant,
        azimuth,
        fps,
        depth_every=depth_every,
        shadows=shadows,
        table=table,
        object_colour=object_colour,
        simulation=simulation,
    )
    obj, action = shown.object, shown.action
    if board:
        _film_board(out / "board", board, camera, seed)
    truth = record_lever_up(obj, action, out, config, seed=seed)
    write_json(out / recording_folder.OBJECT, obj.to_dict())
    intrinsics = out / recording_folder.CAMERA
    if not board:
        camera.save(intrinsics)
    rim = truth.T_table_object[0] @ np.array([*action.contact, obj.height, 1.0])
    column, row = camera.project(rim[None, :3], invert_transform(truth.T_table_camera))[0]
    x, y = action.contact
    away = np.linalg.norm(truth.interaction.effect.com_trajectory[-1] - shown.effect.com_trajectory[-1])
    say(
        f"{truth.interaction.effect.outcome}; the object ends {1000 * away:.1f} mm from where it does in {data}"
    )
    print(f"{len(truth.times)} frames: {out}")
    if board:
        print(
            f"{board} images of a board: {out / 'board'}; foretrace calibrate {out / 'board'} --out {intrinsics}"
        )
    print(f"contact: --contact {x:.4f} {y:.4f}, in the first frame --contact-px {column:.0f} {row:.0f}")


def _film_board(folder: Path, num: int, camera: "PinholeCamera", seed: int) -> None:
    """Images of the default calibration board."""
    from foretrace.interactions import recording_folder
    from foretrace.perception.calibration import Board
    from foretrace.simulation.recording import photograph_board

    folder.mkdir(parents=True)
    printed = Board()
    images = photograph_board(printed.draw(4000.0), printed.size, camera, num, seed=seed)
    for number, image in enumerate(images):
        recording_folder.write_image(folder / f"{number:02d}.png", image)
