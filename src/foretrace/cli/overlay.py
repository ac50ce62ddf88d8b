"""The command that draws prediction and observation over a recording that was imported."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from foretrace.errors import DatasetError, PerceptionError
from foretrace.experiments.transfer_figures import side_figure
from foretrace.geometry import pose_to_matrix, transform_points
from foretrace.imagined import ImaginedEffect
from foretrace.imagined.shown import radius_of
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.record import Interaction
from foretrace.interactions.recorded import Notes, find_recording, read_notes
from foretrace.interactions.recording_folder import Frame
from foretrace.perception.overlay import OBSERVED, PREDICTED, draw_overlay, write_video
from foretrace.perception.recordings import Recording, open_recording
from foretrace.predictor import load_imaginer
from foretrace.trajectories import interpolate_poses

SAME_TIME = 0.001
"""Largest difference between the time stamps of an imported frame and of the recording's own [s]."""


def overlay(
    data: Positional[Path],
    id: Positional[int],
    out: Path,
    run: Path | None = None,
    recording: Path | None = None,
    topic: str | None = None,
) -> None:
    """Draw what a predictor expects and what was observed over an imported recording, frame by frame, as an MP4.

    Beside it an image is written that shows both paths from the side, its name with "-side.png" in place of ".mp4".

    Red: predicted, before the touch. Green: observed so far. White: the object's outline. A translucent tube: how
    uncertain the prediction is, if the predictor predicts it. Needs foretrace[video].

    Args:
        data: Folder of the recorded data set.
        id: Number of the interaction.
        out: The .mp4 file to write.
        run: Folder of the training; by default the predictor that comes with foretrace.
        recording: The recording, if it is neither where it was when it was imported nor where the data set has moved to
            with it.
        topic: Image topic of a bag, if it has several; by default the one that was imported.
    """
    if out.suffix.lower() != ".mp4":
        raise PerceptionError(f"cannot write a video to {out}: choose a name that ends in .mp4")
    dataset = Dataset.open(data)
    rows = np.flatnonzero(dataset.index["id"].to_numpy() == id)
    notes = read_notes(data, id)
    if len(rows) == 0:
        raise DatasetError(f"{data} has no recording {id}: give a data set that `foretrace import` made")
    row = int(rows[0])
    imagined = load_imaginer(run).imagine_batch(dataset[row : row + 1].batch())[0]
    opened = open_recording(recording or find_recording(data, notes), topic or notes.get("topic"))
    times = np.array(notes["frame_times"])
    images = _drawn(_same(opened, times), notes, dataset[row], imagined)
    count = write_video(out, images, float(1 / np.median(np.diff(times))))
    print(f"{count} frames: {out}")
    effect, side = dataset[row].effect, out.with_name(f"{out.stem}-side.png")
    end = None if effect.slip_index is None else effect.times[effect.slip_index]
    until = slice(end if end is None else int(np.searchsorted(imagined.times, end)))
    paths = effect.com_trajectory[: effect.slip_index], imagined.com_trajectory[until]
    slips = "" if end is None else f", slips at {end:.1f} s"
    side_figure(*paths, f"Recording {id}: {effect.outcome}{slips}".replace("slipped, ", "")).savefig(side)
    print(side)


def _same(opened: Recording, times: np.ndarray) -> Iterator[Frame]:
    """The frames of a recording, as long as they are those that were imported."""
    for number, frame in enumerate(opened.frames()):
        if number >= len(times) or abs(frame.time - times[number]) > SAME_TIME:
            raise PerceptionError(
                f"frame {number} of {opened.path} at {frame.time:.3f} s is none of the recording that was imported: "
                "name the right one with --recording, or import this one"
            )
        yield frame


def _drawn(
    frames: Iterator[Frame], notes: Notes, interaction: Interaction, imagined: ImaginedEffect
) -> Iterator[np.ndarray]:
    """The recording's images with outline and paths in them."""
    camera = PinholeCamera.from_dict(notes["camera"], "the recording's camera")
    T_action_camera = np.array(notes["T_action_camera"])
    obj, effect = interaction.object, interaction.effect
    rim = np.column_stack([obj.corners, np.full(len(obj.corners), obj.height)])
    poses = pose_to_matrix(effect.pose_trajectory)
    radius = radius_of(imagined)
    for number, frame in enumerate(frames):
        camera.check_image(frame.image, f"frame {number} of the recording")
        time = frame.time - notes["start"]
        here = interpolate_poses(effect.times, poses, np.array([time]))[0]
        paths = {
            "predicted": (imagined.com_trajectory, PREDICTED),
            "observed": (effect.com_trajectory[effect.times <= max(time, 0.0)], OBSERVED),
        }
        radii = None if radius is None else {"predicted": np.asarray(radius, dtype=float)}
        yield draw_overlay(
            frame.image, camera, T_action_camera, transform_points(here, rim), paths, radii=radii
        )
