"""The command that films a simulated lever-up, without a camera or a robot."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from foretrace.actions import LeverUp
from foretrace.cli.console import say
from foretrace.cli.parsing import adapt
from foretrace.errors import PerceptionError, SimulationError
from foretrace.files import atomic_folder, make_folder, write_json
from foretrace.geometry import invert_transform
from foretrace.interactions import recording_folder
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.board import Board
from foretrace.simulation.lens import WEBCAM
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.recording import RecordingConfig, photograph_board, record_lever_up

USUAL = RecordingConfig(depth_every=10)
"""Recordings by default: depth makes large files."""


@adapt((RecordingConfig, ("camera", "faults", "simulation")), frames_per_second="fps")
def film(
    data: Positional[Path],
    id: Positional[int],
    out: Path,
    config: Annotated[OmitArgPrefixes[RecordingConfig], arg(name="")] = USUAL,
    width: int = WEBCAM.width,
    embodiment: Literal["tool", "arm"] | None = None,
    board: int = 0,
    seed: int = 0,
) -> None:
    """Film a lever-up of a data set, simulated anew, as a camera above a real table would: a folder for `import`.

    The recording has a lens, blur, noise and changing light, markers on table and object, and an image of the empty
    table. What it shows exactly is in truth.json, which `import` does not read.

    Args:
        data: Folder of the data set.
        id: Number of the interaction.
        out: Folder to make; it has its name when everything is in it.
        config: Camera, table and light.
        width: Columns of the images; they have 9/16 as many rows.
        embodiment: What moves the blade: nothing that is seen, or the whole arm; by default as in the data set.
        board: Number of images of a calibration board to take, too; they leave the camera's file to `calibrate`.
        seed: Seed of noise, clock, table, and of where marker and lamp are.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise PerceptionError(f"{out} is in use: choose another folder")
    for option, value, most in (("seed", seed, 2**32), ("board", board, 1000)):
        if not 0 <= value <= most:
            raise SimulationError(f"--{option} is {value}: give a number from 0 to {most}")
    dataset = Dataset.open(data)
    shown = dataset.with_id(id)
    if not isinstance(shown.action, LeverUp):
        raise SimulationError(f"interaction {id} is a {shown.action.label}: only lever-ups can be filmed")
    camera = WEBCAM.scaled(width / WEBCAM.width)
    recorded = dataset.manifest["configuration"].get("simulation", {})
    simulation = SimulationConfig(
        embodiment=embodiment or recorded.get("embodiment", "tool"), physics=shown.physics
    )
    config = replace(config, camera=camera, simulation=simulation)
    obj, action = shown.object, shown.action
    if not isinstance(action, LeverUp):
        raise SimulationError(f"interaction {id} is a {action.label}: only lever-ups can be filmed")
    make_folder(out.parent, PerceptionError)
    with atomic_folder(out) as draft:
        if board:
            _film_board(draft / "board", board, camera, seed)
        else:
            camera.save(draft / recording_folder.CAMERA)
        truth = record_lever_up(obj, action, draft, config, seed=seed)
        write_json(draft / recording_folder.OBJECT, obj.to_dict())
    rim = truth.T_table_object[0] @ np.array([*action.contact, obj.height, 1.0])
    column, row = camera.project(rim[None, :3], invert_transform(truth.T_table_camera))[0]
    x, y = action.contact
    away = np.linalg.norm(truth.interaction.effect.com_trajectory[-1] - shown.effect.com_trajectory[-1])
    say(
        f"{truth.interaction.effect.outcome}; the object ends {1000 * away:.1f} mm from where it does in {data}"
    )
    print(f"{len(truth.times)} frames: {out}")
    if board:
        images, intrinsics = out / "board", out / recording_folder.CAMERA
        print(f"{board} images of a board: {images}; foretrace calibrate {images} --out {intrinsics}")
    print(f"contact: --contact {x:.4f} {y:.4f}, in the first frame --contact-px {column:.0f} {row:.0f}")


def _film_board(folder: Path, num: int, camera: PinholeCamera, seed: int) -> None:
    """Images of the default calibration board."""
    folder.mkdir(parents=True)
    printed = Board()
    images = photograph_board(printed.draw(4000.0), printed.size, camera, num, seed=seed)
    for number, image in enumerate(images):
        recording_folder.write_image(folder / f"{number:02d}.png", image)
