"""A LeRobotDataset against the documented layout of version 3.0, read with pyarrow and with Rerun's LeRobot reader."""

import io
import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

import factories
from export_samples import NUM_SAMPLES, fake_data, fake_run, write_data
from foretrace import cli
from foretrace.errors import ExportError
from foretrace.export import lerobot
from foretrace.export.episode_statistics import all_statistics, image_statistics, vector_statistics
from foretrace.export.episodes import Episodes, choose
from foretrace.export.lerobot import export_lerobot
from foretrace.geometry import pose_to_matrix
from foretrace.interactions.dataset import Dataset
from foretrace.predictor import LstmConfig, TrainConfig, train_predictor

STATISTICS = {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}


@pytest.fixture(scope="module")
def episodes(tmp_path_factory) -> Episodes:
    data = fake_data(tmp_path_factory.mktemp("data"))
    return choose(data, [3, 1, 0], fake_run(tmp_path_factory.mktemp("run")))


@pytest.fixture(scope="module")
def folder(episodes, tmp_path_factory):
    out = tmp_path_factory.mktemp("lerobot") / "out"
    export_lerobot(episodes, out)
    return out


@pytest.fixture(scope="module")
def info(folder) -> dict:
    return json.loads((folder / "meta" / "info.json").read_text())


@pytest.fixture(scope="module")
def table(folder, info) -> pa.Table:
    return pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))


def recorded(id: int, times: np.ndarray):
    interaction = factories.fake_interaction(np.random.default_rng(id), id, num_samples=len(times))
    return replace(
        interaction,
        effect=replace(interaction.effect, times=times),
        provenance=replace(interaction.provenance, source="recorded", engine=""),
    )


def test_info_describes_the_files(folder, info, table):
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_episodes"], info["total_frames"]) == (20, 3, 3 * NUM_SAMPLES)
    assert (info["total_tasks"], info["splits"], info["video_path"]) == (1, {"train": "0:3"}, None)
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()} == {
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "data/chunk-000/file-000.parquet",
    }
    kinds = {"float32": pa.float32(), "int64": pa.int64()}
    image = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    assert set(table.schema.names) == set(info["features"])
    for name, feature in info["features"].items():
        if feature["dtype"] == "image":
            expected = image
        elif feature["shape"] == [1]:
            expected = kinds[feature["dtype"]]
        else:
            assert len(feature["names"]) == feature["shape"][0]
            expected = pa.list_(kinds[feature["dtype"]], feature["shape"][0])
        assert table.schema.field(name).type == expected, name
    for name, kind in (
        ("timestamp", "float32"), ("frame_index", "int64"), ("episode_index", "int64"), ("index", "int64"),
        ("task_index", "int64"),
    ):  # fmt: skip
        assert info["features"][name] == {"dtype": kind, "shape": [1], "names": None}
    assert info["features"]["observation.images.view"] == {
        "dtype": "image",
        "shape": [128, 128, 1],
        "names": ["height", "width", "channels"],
        "info": {"is_depth_map": True, "depth_unit": "m"},
    }


def test_rows_are_counted_and_timed(table):
    n = NUM_SAMPLES
    assert table["index"].to_pylist() == list(range(3 * n))
    assert table["frame_index"].to_pylist() == 3 * list(range(n))
    assert table["episode_index"].to_pylist() == [0] * n + [1] * n + [2] * n
    assert set(table["task_index"].to_pylist()) == {0}
    np.testing.assert_allclose(table["timestamp"], np.tile(np.arange(n) / 20, 3), rtol=1e-6)


def test_episodes_hold_what_happened_and_what_was_imagined(folder, episodes, table):
    file = pq.ParquetFile(folder / "data" / "chunk-000" / "file-000.parquet")
    assert file.num_row_groups == 3
    for k, episode in enumerate(episodes):
        effect, view = episode.interaction.effect, episode.interaction.view
        rows = file.read_row_group(k)
        assert set(rows["episode_index"].to_pylist()) == {k}
        state, action = (np.array(rows[name].to_pylist()) for name in ("observation.state", "action"))
        around = np.array(rows["observation.environment_state"].to_pylist())
        np.testing.assert_allclose(state, effect.tool_trajectory, atol=1e-6)
        np.testing.assert_allclose(action[:-1], state[1:])
        np.testing.assert_allclose(action[-1], state[-1])
        np.testing.assert_allclose(
            pose_to_matrix(around[:, :7]), pose_to_matrix(effect.pose_trajectory), atol=1e-6
        )
        np.testing.assert_allclose(around[:, 7:], effect.com_trajectory, atol=1e-6)
        np.testing.assert_allclose(
            np.array(rows["imagined.com"].to_pylist()), episode.imagined.com_trajectory, atol=1e-6
        )
        np.testing.assert_allclose(
            np.array(rows["observation.joints"].to_pylist()), effect.joint_trajectory, atol=1e-6
        )
        for row in (0, -1):
            image = Image.open(io.BytesIO(rows["observation.images.view"][row].as_py()["bytes"]))
            assert (image.format, image.mode) == ("TIFF", "F")
            np.testing.assert_array_equal(np.array(image), view.height)


def test_episode_rows_say_where_and_how(folder, info, episodes):
    rows = pq.read_table(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    n = NUM_SAMPLES
    expected = {
        "episode_index": [0, 1, 2], "length": [n] * 3, "dataset_from_index": [0, n, 2 * n],
        "dataset_to_index": [n, 2 * n, 3 * n], "data/chunk_index": [0] * 3, "data/file_index": [0] * 3,
        "meta/episodes/chunk_index": [0] * 3, "meta/episodes/file_index": [0] * 3,
        "foretrace/interaction": [3, 1, 0], "foretrace/outcome": ["levered"] * 3,
    }  # fmt: skip
    for name, values in expected.items():
        assert rows[name].to_pylist() == values, name
    tasks = pd.read_parquet(folder / "meta" / "tasks.parquet")
    assert tasks.index.name == "task"
    assert tasks["task_index"].to_list() == [0]
    assert rows["tasks"].to_pylist() == [tasks.index.to_list()] * 3
    found = {name for name in rows.schema.names if name.startswith("stats/")}
    assert found == {f"stats/{feature}/{name}" for feature in info["features"] for name in STATISTICS}
    z = episodes[1].interaction.effect.com_trajectory[:, 2]
    assert rows["stats/observation.environment_state/max"][1].as_py()[9] == pytest.approx(z.max())
    assert rows["stats/observation.environment_state/std"][1].as_py()[9] == pytest.approx(z.std())
    assert np.shape(rows["stats/observation.images.view/mean"][0].as_py()) == (1, 1, 1)


def test_statistics_of_the_whole_are_those_of_all_frames(folder, info, table):
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    assert set(stats) == set(info["features"])
    for name in ("observation.state", "action", "imagined.com", "observation.environment_state"):
        values = np.array(table[name].to_pylist())
        for statistic in ("min", "max", "mean", "std"):
            expected = getattr(values, statistic)(axis=0)
            np.testing.assert_allclose(
                stats[name][statistic], expected, atol=1e-6, err_msg=f"{name} {statistic}"
            )
        assert stats[name]["count"] == [3 * NUM_SAMPLES]
    assert np.shape(stats["observation.images.view"]["std"]) == (1, 1, 1)


def test_statistics_of_images_and_quantiles():
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 256, (5, 32, 16, 3), dtype=np.uint8)
    colours[..., 2] = 255
    found = image_statistics(colours)
    assert found["mean"].shape == (3, 1, 1)
    assert found["count"].tolist() == [5]
    assert found["mean"][2, 0, 0] == 1
    assert found["max"].max() <= 1
    ramps = [vector_statistics(np.arange(101) + start) for start in (0, 1000)]
    whole = all_statistics(ramps)
    assert [float(whole[name][0]) for name in ("q01", "q50", "q90", "q99")] == [1, 50, 1090, 1099]


def test_rerun_reads_it(folder):
    pytest.importorskip("rerun", reason="no rerun-sdk: its LeRobot reader is missing")
    from rerun.experimental import LeRobotReader

    reader = LeRobotReader(folder)
    assert reader.version == "v3"
    assert reader.episodes() == [0, 1, 2]
    rows: dict[str, int] = {}
    for chunk in reader.stream(1).to_chunks():
        rows[chunk.entity_path] = max(rows.get(chunk.entity_path, 0), chunk.num_rows)
    for name in ("observation.state", "action", "observation.images.view"):
        assert rows[f"/{name}"] == NUM_SAMPLES, rows


def test_episodes_are_split_as_the_training_was(tmp_path):
    data, run, other = fake_data(tmp_path / "data", 9), tmp_path / "run", fake_data(tmp_path / "other", 8)
    training = TrainConfig(epochs=1, min_steps=1, split=(3, 2, 1), threads=1)
    train_predictor(Dataset.open(data), LstmConfig(features="none"), run, training)
    parts = json.loads((run / "split.json").read_text())

    def exported(source, name, *options) -> tuple[dict, list[int]]:
        out = tmp_path / name
        command = ["export", "lerobot", "--data", str(source), "--out", str(out), *options]
        assert cli.main(command) == 0
        rows = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet")
        return json.loads((out / "meta/info.json").read_text())["splits"], rows[
            "foretrace/interaction"
        ].to_pylist()

    splits, ids = exported(data, "split", "--run", str(run))
    assert splits == {"train": "0:3", "validation": "3:5", "test": "5:6", "rest": "6:9"}
    assert [sorted(ids[a:b]) for a, b in ((0, 3), (3, 5), (5, 6))] == [
        sorted(parts[name]) for name in ("train", "validation", "test")
    ]
    assert sorted(ids) == list(range(9))
    few = [parts["test"][0], parts["train"][0]]
    splits, ids = exported(data, "few", "--run", str(run), "--ids", *map(str, few))
    assert (splits, ids) == ({"train": "0:1", "test": "1:2"}, few[::-1])
    # What was trained on other data says nothing about these.
    assert exported(other, "other-out", "--run", str(run)) == ({"train": "0:8"}, list(range(8)))
    assert exported(data, "plain") == ({"train": "0:9"}, list(range(9)))


def test_recordings_of_other_sampling_are_refused_or_resampled(tmp_path):
    mixed = [
        recorded(0, np.arange(20) / 20),
        recorded(1, np.sort(np.random.default_rng(0).uniform(0, 1, 25))),
    ]
    episodes = Episodes(Dataset.open(write_data(tmp_path / "data", mixed)))
    with pytest.raises(ExportError, match=r"interaction 1 is not sampled evenly .* give --fps"):
        export_lerobot(episodes, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["data"], "nothing is left behind"
    export_lerobot(episodes, tmp_path / "out", fps=10)
    table = pq.read_table(tmp_path / "out" / "data")
    assert table["episode_index"].to_pylist() == [0] * 10 + [1] * 10
    effect = episodes[1].interaction.effect
    z = np.array(table["observation.environment_state"].to_pylist())[10:, 9]
    times = effect.times[0] + np.arange(10) / 10
    np.testing.assert_allclose(z, np.interp(times, effect.times, effect.com_trajectory[:, 2]), atol=1e-6)
    with pytest.raises(ExportError, match="interaction 0 is recorded and cannot be rendered"):
        export_lerobot(episodes, tmp_path / "other", fps=10, camera=True)
    with pytest.raises(ExportError, match="0 frames per second"):
        export_lerobot(episodes, tmp_path / "other", fps=0)
    with pytest.raises(ExportError, match="1000000000 frames per second: give a number from 1 to 1000"):
        export_lerobot(episodes, tmp_path / "other", fps=1_000_000_000)


def test_large_data_sets_are_split_into_files(episodes, tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot, "FILE_SIZE", 1000)
    export_lerobot(episodes, tmp_path / "out")
    rows = pq.read_table(tmp_path / "out" / "meta" / "episodes")
    assert rows["data/file_index"].to_pylist() == [0, 1, 2]
    for k in range(3):
        file = pq.read_table(tmp_path / "out" / "data" / "chunk-000" / f"file-{k:03d}.parquet")
        assert set(file["episode_index"].to_pylist()) == {k}


def test_rendered_images_are_features(tmp_path):
    data = fake_data(tmp_path / "data", 1)
    command = [
        "export",
        "lerobot",
        "--data",
        str(data),
        "--out",
        str(tmp_path / "out"),
        "--fps",
        "5",
        "--camera",
    ]
    if cli.main(command) != 0:
        pytest.skip("this machine cannot render")
    features = json.loads((tmp_path / "out" / "meta" / "info.json").read_text())["features"]
    assert features["observation.images.camera"]["shape"] == [240, 320, 3]
    assert features["observation.images.camera_depth"]["info"]["is_depth_map"]
    assert not features["observation.images.camera"]["info"]["is_depth_map"]
    row = pq.read_table(tmp_path / "out" / "data").slice(2, 1).to_pylist()[0]
    colour, depth = (
        np.array(Image.open(io.BytesIO(row[f"observation.images.{name}"]["bytes"])))
        for name in ("camera", "camera_depth")
    )
    assert (colour.shape, colour.dtype) == ((240, 320, 3), np.uint8)
    assert (depth.shape, depth.dtype) == ((240, 320), np.float32)
    assert 0.3 < depth.min() < depth.max() < 1.5
