"""Interactions as a LeRobotDataset v3.0: Parquet files and their description, which LeRobot's loader reads."""

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from foretrace.errors import ExportError
from foretrace.export.delivery import delivered, watched
from foretrace.export.episode_statistics import (
    Statistics,
    all_statistics,
    image_statistics,
    vector_statistics,
)
from foretrace.export.episodes import Episode
from foretrace.export.images import CAMERA, render_images
from foretrace.export.resampling import frame_times, frames_per_second, resample_poses
from foretrace.files import write_json
from foretrace.interactions.topdown import VIEW_SIZE
from foretrace.trajectories import interpolate

CODEBASE_VERSION = "v3.0"
FILES_PER_CHUNK = 1000
MOST_FRAMES = 1000
"""Frames per second that an effect may be resampled to."""
FILE_SIZE = 100 * 2**20
"""A data file that would grow beyond this is followed by another [byte]."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
TASK = "Push the blade under the object at the contact point and lever it up."
POSE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")
VIEW, COLOUR, DEPTH = (
    "observation.images.view",
    "observation.images.camera",
    "observation.images.camera_depth",
)
IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
INDICES = {
    name: {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index")
}
"""The columns that every such data set has."""

Features = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Layout:
    """What every episode of the data set holds."""

    fps: int
    """Frames per second."""
    features: Features
    """Features as ``meta/info.json`` describes them."""


def export_lerobot(
    episodes: Sequence[Episode],
    out: Path,
    fps: int | None = None,
    camera: bool = False,
    splits: Mapping[str, range] | None = None,
) -> None:
    """Write interactions as one data set, an episode each.

    Args:
        episodes: What to write.
        out: Folder to make.
        fps: Frames per second, to which recordings are resampled; by default that of the interactions, which
            must then be sampled alike.
        camera: Whether to render the images of a camera beside the table; for simulated interactions only.
        splits: Which episodes are in which part; by default all are in ``train``.

    Raises:
        ExportError: The folder exists, the interactions are not sampled alike, or images cannot be had.
    """
    with delivered(out) as folder:
        layout = _layout(episodes, fps, camera)
        rows = _write_data(episodes, layout, folder)
        _write_episodes(rows, folder)
        _write_description(rows, layout, splits or {"train": range(len(rows))}, folder)


def _layout(episodes: Sequence[Episode], fps: int | None, camera: bool) -> Layout:
    """The features that all of them have."""
    effects = []
    for episode in _without_imagining(episodes):
        interaction = episode.interaction
        if camera and interaction.provenance.source != "simulated":
            raise ExportError(
                f"interaction {interaction.id} is recorded and cannot be rendered: leave --camera out"
            )
        effects.append((interaction.id, interaction.effect))
    fps = frames_per_second(effects) if fps is None else fps
    if not 1 <= fps <= MOST_FRAMES:
        raise ExportError(f"{fps} frames per second: give a number from 1 to {MOST_FRAMES}")
    joints = {effect.joint_trajectory.shape[1] for _, effect in effects}
    features: Features = {
        "observation.state": _vector([f"tool_{name}" for name in POSE_NAMES]),
        "observation.environment_state": _vector(
            [*(f"object_{name}" for name in POSE_NAMES), "com_x", "com_y", "com_z"]
        ),
        "action": _vector([f"tool_{name}" for name in POSE_NAMES]),
        VIEW: _image(VIEW_SIZE, VIEW_SIZE, depth=True),
    }
    if len(joints) == 1 and (num_joints := joints.pop()) > 0:
        features["observation.joints"] = _vector([f"joint_{k}" for k in range(num_joints)])
    if episodes[0].imagined is not None:
        features["imagined.com"] = _vector(["com_x", "com_y", "com_z"])
    if camera:
        features[COLOUR] = _image(CAMERA.height, CAMERA.width, depth=False)
        features[DEPTH] = _image(CAMERA.height, CAMERA.width, depth=True)
    return Layout(fps, features | INDICES)


def _without_imagining(episodes: Sequence[Episode]) -> Iterable[Episode]:
    """Episodes for a look at what was recorded; a predictor need not be asked for that."""
    dataset = getattr(episodes, "dataset", None)
    return episodes if dataset is None else map(Episode, dataset)


def _vector(names: list[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": [len(names)], "names": names}


def _image(height: int, width: int, depth: bool) -> dict[str, Any]:
    info = {"is_depth_map": True, "depth_unit": "m"} if depth else {"is_depth_map": False}
    shape = [height, width, 1 if depth else 3]
    return {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"], "info": info}


def _schema(features: Features) -> pa.Schema:
    """Columns of the data files."""
    kinds = {"float32": pa.float32(), "int64": pa.int64()}
    columns = []
    for name, feature in features.items():
        if feature["dtype"] == "image":
            kind: pa.DataType = IMAGE
        else:
            kind, size = kinds[feature["dtype"]], feature["shape"][0]
            kind = kind if size == 1 else pa.list_(kind, size)
        columns.append(pa.field(name, kind))
    return pa.schema(columns)


def _write_data(episodes: Sequence[Episode], layout: Layout, folder: Path) -> list[dict[str, Any]]:
    """Writes the frames, one row group for each episode; returns a row for each episode."""
    schema, rows = _schema(layout.features), []
    chunk, file, start, largest = 0, 0, 0, 0
    sink, writer = _open(folder, chunk, file, schema)
    try:
        for number, episode in enumerate(watched(episodes, "episodes")):
            if number > 0 and sink.tell() + largest > FILE_SIZE:
                writer.close()
                sink.close()
                chunk, file = (chunk, file + 1) if file + 1 < FILES_PER_CHUNK else (chunk + 1, 0)
                sink, writer = _open(folder, chunk, file, schema)
            before = sink.tell()
            columns = _columns(episode, layout, number, start)
            length = len(columns["index"])
            writer.write_table(_table(columns, schema))
            largest = max(largest, sink.tell() - before)
            interaction = episode.interaction
            rows.append(
                {
                    "episode_index": number,
                    "tasks": [TASK],
                    "length": length,
                    "data/chunk_index": chunk,
                    "data/file_index": file,
                    "dataset_from_index": start,
                    "dataset_to_index": start + length,
                    "meta/episodes/chunk_index": 0,
                    "meta/episodes/file_index": 0,
                    "foretrace/interaction": interaction.id,
                    "foretrace/outcome": str(interaction.effect.outcome),
                    "foretrace/source": interaction.provenance.source,
                    "foretrace/object": json.dumps(interaction.object.to_dict()),
                    "stats": _episode_statistics(columns, layout.features),
                }
            )
            start += length
    finally:
        writer.close()
        sink.close()
    return rows


def _open(
    folder: Path, chunk: int, file: int, schema: pa.Schema
) -> tuple[io.BufferedWriter, pq.ParquetWriter]:
    path = folder / DATA_PATH.format(chunk_index=chunk, file_index=file)
    path.parent.mkdir(parents=True, exist_ok=True)
    sink = path.open("wb")  # its position tells the file's size
    return sink, pq.ParquetWriter(sink, schema, compression="snappy", use_dictionary=True)


def _columns(episode: Episode, layout: Layout, number: int, start: int) -> dict[str, np.ndarray]:
    """Every feature of one episode, frame by frame; images as (frames, rows, columns, channels)."""
    interaction = episode.interaction
    effect = interaction.effect
    times = frame_times(effect.times, layout.fps)
    here, n = effect.times - effect.times[0], len(times)
    tool = resample_poses(here, effect.tool_trajectory, times)
    thing = resample_poses(here, effect.pose_trajectory, times)
    columns = {
        "observation.state": tool,
        "observation.environment_state": np.column_stack(
            [thing, interpolate(here, effect.com_trajectory, times)]
        ),
        "action": np.concatenate([tool[1:], tool[-1:]]),  # where the blade goes next
        VIEW: np.broadcast_to(interaction.view.height[None, :, :, None], (n, VIEW_SIZE, VIEW_SIZE, 1)),
        "timestamp": np.arange(n) / layout.fps,
        "frame_index": np.arange(n),
        "episode_index": np.full(n, number),
        "index": start + np.arange(n),
        "task_index": np.zeros(n, dtype=np.int64),
    }
    if "observation.joints" in layout.features:
        columns["observation.joints"] = interpolate(here, effect.joint_trajectory, times)
    if episode.imagined is not None:
        there = episode.imagined.times - effect.times[0]
        columns["imagined.com"] = interpolate(there, episode.imagined.com_trajectory, times)
    if COLOUR in layout.features:
        seen = render_images(interaction, thing, tool)
        columns |= {COLOUR: seen.rgb, DEPTH: seen.depth[..., None]}
    return columns


def _table(columns: dict[str, np.ndarray], schema: pa.Schema) -> pa.Table:
    arrays = []
    for field in schema:
        values = columns[field.name]
        if field.type == IMAGE:
            arrays.append(_encoded(values))
        elif pa.types.is_fixed_size_list(field.type):
            flat = pa.array(np.ravel(values).astype(np.float32))
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, field.type.list_size))
        else:
            arrays.append(pa.array(values).cast(field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def _encoded(images: np.ndarray) -> pa.Array:
    """Images in files of their own: PNG for colour, TIFF of 32-bit floats for depth."""
    rows, last, content = [], None, b""
    for k, image in enumerate(images):
        if last is None or not np.array_equal(image, last):
            depth, buffer, last = image.shape[-1] == 1, io.BytesIO(), image
            if depth:
                Image.fromarray(image[..., 0]).save(buffer, "TIFF", compression="tiff_adobe_deflate")
            else:
                Image.fromarray(image).save(buffer, "PNG")
            content = buffer.getvalue()
        name = f"frame-{k:06d}.{'tiff' if image.shape[-1] == 1 else 'png'}"
        rows.append({"bytes": content, "path": name})
    return pa.array(rows, type=IMAGE)


def _episode_statistics(columns: dict[str, np.ndarray], features: Features) -> dict[str, Statistics]:
    return {
        name: image_statistics(columns[name])
        if feature["dtype"] == "image"
        else vector_statistics(columns[name])
        for name, feature in features.items()
    }


def _write_episodes(rows: Sequence[dict[str, Any]], folder: Path) -> None:
    """Where each episode is, and its statistics."""
    flat = []
    for row in rows:
        plain = {name: value for name, value in row.items() if name != "stats"}
        for feature, found in row["stats"].items():
            plain |= {f"stats/{feature}/{name}": value.tolist() for name, value in found.items()}
        flat.append(plain)
    path = folder / EPISODES_PATH
    path.parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(flat), path, compression="snappy")


def _write_description(
    rows: Sequence[dict[str, Any]], layout: Layout, splits: Mapping[str, range], folder: Path
) -> None:
    """The data set as a whole: what it holds, its one task, its statistics."""
    info = {
        "codebase_version": CODEBASE_VERSION,
        "robot_type": "ur10",
        "total_episodes": len(rows),
        "total_frames": rows[-1]["dataset_to_index"],
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": FILE_SIZE // 2**20,
        "video_files_size_in_mb": 200,
        "fps": layout.fps,
        "splits": {name: f"{part.start}:{part.stop}" for name, part in splits.items()},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": layout.features,
    }
    whole = {
        feature: {
            name: value.tolist()
            for name, value in all_statistics([row["stats"][feature] for row in rows]).items()
        }
        for feature in layout.features
    }
    for name, content in (("info", info), ("stats", whole)):
        write_json(folder / "meta" / f"{name}.json", content, indent=4)
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([TASK], name="task"))
    tasks.to_parquet(folder / "meta" / "tasks.parquet")
