"""Damaged files for every reader, and what is done with what was read."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from campaign import Outcome
from campaign.answers import judged
from campaign.changes import apply, changes


@dataclass(frozen=True)
class Reader:
    """A file of the materials and what reads it."""

    file: str
    """The file that is damaged, below the materials."""
    kind: str
    """``json``, ``text`` or ``bytes``: which changes it gets beside those of bytes."""
    read: Callable[[Path], Any]
    """Reads and uses it: is given the copy of the file."""
    whole: str = ""
    """Folder of the materials that is copied; by default the file alone is."""
    share: int = 2
    """How often it is chosen, beside the others."""


def _data_set(path: Path) -> Any:
    """Whatever opens can be read whole, described and examined; and the doctor never dies."""
    import foretrace as ft
    from foretrace.interactions.description import describe_dataset
    from foretrace.interactions.doctor import examine

    folder = path.parent if path.name == "manifest.json" else path.parents[1]
    diagnosis = examine(folder)
    data = ft.Dataset.open(folder)
    batch = data.batch()
    return (
        data.outcomes,
        describe_dataset(data),
        batch.com,
        batch.pose,
        data[0].effect,
        diagnosis.num_interactions,
    )


def _predictor(path: Path) -> Any:
    import foretrace as ft

    box = ft.Box(0.15, 0.14, 0.02)
    action = ft.LeverUp.at_edge(box, 0)
    imagined = ft.load_predictor(path.parent).imagine(ft.TopDownView.of(box, action), action)
    return imagined.com_trajectory, imagined.pose_trajectory, imagined.futures.outcomes, repr(imagined)


def _split(path: Path) -> Any:
    import foretrace as ft
    from foretrace.predictor import part_of

    return part_of(path.parent, ft.Dataset.open(MATERIALS / "data")).com


def _camera(path: Path) -> Any:
    from foretrace.interactions.pinhole import PinholeCamera

    camera = PinholeCamera.load(path)
    return camera, camera.matrix, camera.rays(np.array([[camera.cx, camera.cy]]))


def _markers(path: Path) -> Any:
    from foretrace.perception.markers import MarkerLayout

    return MarkerLayout.load(path)


def _frames(path: Path, most: int = 4) -> Any:
    from foretrace.perception.recordings import open_recording

    recording = open_recording(path)
    frames = list(islice(recording.frames(), most))
    return recording.camera, recording.notes, [(frame.time, frame.depth) for frame in frames]


def _notes(path: Path) -> Any:
    from foretrace.interactions.recorded import read_notes

    return {
        name: value for name, value in read_notes(path.parents[1], 0).items() if name in ("camera", "start")
    }


def _base(path: Path) -> Any:
    from foretrace.robot.path import read_base_pose

    return read_base_pose(path)


def _plan(path: Path) -> Any:
    import foretrace as ft
    from foretrace.pictures.plan import plan_figure

    found = ft.Plan.open(path)
    plan_figure(found)
    return found.imagined.com_trajectory, found.futures.outcomes(), found.T_table_action, repr(found)


def _object(path: Path) -> Any:
    import foretrace as ft
    from foretrace.objects.shape_files import read_shape

    obj = read_shape(path)
    heaviness = obj.mass_properties(600.0)
    if not heaviness.mass > 0:
        raise AssertionError(f"a mass of {heaviness.mass} kg")
    view = ft.TopDownView.of(obj, ft.LeverUp.at_edge(obj, 0))
    return heaviness, obj.corners, view.height


def _silhouette(path: Path) -> Any:
    import foretrace as ft
    from foretrace.objects.shape_files import read_silhouette_image

    return ft.Prism.from_mask(read_silhouette_image(path), 0.001).mass_properties(600.0)


def _image(path: Path) -> Any:
    from foretrace.interactions.recording_folder import read_image

    return read_image(path).shape


def _depth(path: Path) -> Any:
    from foretrace.interactions.recording_folder import read_depth

    return read_depth(path)


def _board(path: Path) -> Any:
    from foretrace.perception.calibration import read_images

    return {name: image.shape for name, image in read_images([path]).items()}


def _results(path: Path) -> Any:
    from rich.console import Console

    from foretrace.evaluation.run import run_experiment
    from foretrace.experiments.predictor import Predictor

    experiment = Predictor(MATERIALS / "lstm", MATERIALS / "data")
    folder = path.parent if path.name == "summary.json" else path.parents[1]
    return run_experiment(experiment, folder, console=Console(quiet=True), redraw=True).summary


MATERIALS = Path()
READERS: dict[str, Reader] = {
    "manifest": Reader("data/manifest.json", "json", _data_set, "data", 5),
    "shard": Reader("data/shards/shard-00000.parquet", "bytes", _data_set, "data", 3),
    "split": Reader("lstm/split.json", "json", _split, "lstm", 2),
    "lstm config": Reader("lstm/config.json", "json", _predictor, "lstm", 4),
    "lstm weights": Reader("lstm/model.safetensors", "bytes", _predictor, "lstm", 3),
    "one-shot config": Reader("one-shot/config.json", "json", _predictor, "one-shot", 4),
    "one-shot weights": Reader("one-shot/model.safetensors", "bytes", _predictor, "one-shot", 3),
    "camera": Reader("recording/camera.json", "json", _camera, share=4),
    "markers": Reader("recording/markers.json", "json", _markers, share=4),
    "film notes": Reader("film/film.json", "json", lambda path: _frames(path.parent), "film", 2),
    "film times": Reader("film/timestamps.csv", "text", lambda path: _frames(path.parent), "film", 4),
    "film camera": Reader("film/camera.json", "json", lambda path: _frames(path.parent), "film", 1),
    "recording notes": Reader("imported/recordings/00000.json", "json", _notes, "imported", 2),
    "base pose": Reader("base.json", "json", _base, share=3),
    "plan": Reader("plan/plan.json", "json", _plan, share=4),
    "object": Reader("object.json", "json", _object, share=4),
    "stl": Reader("box.stl", "bytes", _object, share=4),
    "ascii stl": Reader("ascii.stl", "text", _object, share=3),
    "obj": Reader("box.obj", "text", _object, share=3),
    "outline": Reader("outline.txt", "text", _object, share=4),
    "outline with commas": Reader("outline.csv", "text", _object, share=4),
    "png mask": Reader("mask.png", "bytes", _silhouette),
    "jpg mask": Reader("mask.jpg", "bytes", _silhouette),
    "tif mask": Reader("mask.tif", "bytes", _silhouette),
    "photograph": Reader("film/colour-00000.jpg", "bytes", _image),
    "depth": Reader("film/depth-00000.png", "bytes", _depth),
    "board": Reader("board/00.png", "bytes", _board),
    "video": Reader("film.avi", "bytes", _frames, share=3),
    "bag of ROS 1": Reader("film.bag", "bytes", _frames, share=3),
    "mcap": Reader("film-mcap/film-mcap.mcap", "bytes", lambda path: _frames(path.parent), "film-mcap", 3),
    "db3": Reader("film-db3/film-db3.db3", "bytes", lambda path: _frames(path.parent), "film-db3", 3),
    "bag's metadata": Reader(
        "film-mcap/metadata.yaml", "text", lambda path: _frames(path.parent), "film-mcap", 2
    ),
    "results": Reader("evaluated/summary.json", "json", _results, "evaluated", 1),
    "trial": Reader("evaluated/trials/test.json", "json", _results, "evaluated", 1),
}
"""Every reader by its name."""


def requests() -> st.SearchStrategy[dict[str, Any]]:
    """Trials of all readers."""
    chosen = [name for name, reader in READERS.items() for _ in range(reader.share)]

    def damaged(name: str) -> st.SearchStrategy[dict[str, Any]]:
        made = changes(READERS[name].kind)
        return made.map(lambda listed: {"kind": "input", "reader": name, "changes": listed})

    return st.sampled_from(chosen).flatmap(damaged)


def load(materials: Path) -> None:
    """Read every material once, so that nothing is loaded in the trials.

    Raises:
        AssertionError: A sound file is refused.
    """
    global MATERIALS
    MATERIALS = materials
    for name, reader in READERS.items():
        outcome = judged(lambda reader=reader: reader.read(materials / reader.file))
        assert outcome.ending == "ok", f"{name}: {outcome}"


def run(request: Any, folder: Path, materials: Path) -> Outcome:
    """One damaged file."""
    reader = READERS[request["reader"]]
    if reader.whole:
        shutil.copytree(materials / reader.whole, folder / reader.whole)
    else:
        (folder / reader.file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(materials / reader.file, folder / reader.file)
    file = folder / reader.file
    apply(file, reader.kind, request["changes"])
    outcome = judged(lambda: reader.read(file))
    return replace(outcome, detail=outcome.detail.replace(str(folder), "."))
