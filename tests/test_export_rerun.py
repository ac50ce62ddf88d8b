"""Rerun recordings as Rerun's own reader reads them."""

import numpy as np
import pyarrow as pa
import pytest

import factories
from export_samples import fake_data, fake_run
from foretrace import cli
from foretrace.export.episodes import choose

pytest.importorskip("rerun", reason="no rerun-sdk: Rerun recordings cannot be written")

from rerun.chunk import RrdReader

from foretrace.export.rerun import distances, export_rerun


@pytest.fixture(scope="module")
def episodes(tmp_path_factory):
    data = fake_data(tmp_path_factory.mktemp("data"))
    return choose(data, [1], fake_run(tmp_path_factory.mktemp("run")))


@pytest.fixture(scope="module")
def recording(episodes, tmp_path_factory):
    out = tmp_path_factory.mktemp("rerun") / "out"
    export_rerun(episodes, out, camera=False)
    (file,) = out.iterdir()
    assert file.name == "interaction-000001.rrd"
    return RrdReader(file)


def column(recording, entity: str, component: str) -> list:
    """A component's values of an entity, each with its time [ns], in the order of time."""
    found = []
    for chunk in recording.stream().to_chunks():
        if chunk.entity_path != entity:
            continue
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name.endswith(component)]
        moving = "time" in batch.schema.names
        times = batch["time"].cast(pa.int64()).to_pylist() if moving else [0] * batch.num_rows
        for name in names:
            found += list(zip(times, batch[name].to_pylist(), strict=True))
    return sorted((each for each in found if each[1] is not None), key=lambda each: each[0])


def test_object_moves_as_observed(recording, episodes):
    effect = episodes[0].interaction.effect
    translations = column(recording, "/action/object", "Transform3D:translation")
    assert len(translations) == len(effect.times)
    np.testing.assert_allclose(
        [each[1][0] for each in translations], effect.pose_trajectory[:, :3], atol=1e-6
    )
    np.testing.assert_allclose([time / 1e9 for time, _ in translations], effect.times, atol=1e-9)
    x, y, z, w = np.array(
        [each[1][0] for each in column(recording, "/action/object", "Transform3D:quaternion")]
    ).T
    np.testing.assert_allclose(np.stack([w, x, y, z], axis=1), effect.pose_trajectory[:, 3:], atol=1e-6)


def test_paths_are_green_and_red(recording, episodes):
    episode = episodes[0]
    for name, com in (
        ("observed", episode.interaction.effect.com_trajectory),
        ("imagined", episode.imagined.com_trajectory),
    ):
        strips = column(recording, f"/action/{name}/path", "LineStrips3D:strips")
        np.testing.assert_allclose(strips[-1][1][0], com, atol=1e-6)
        (colour,) = column(recording, f"/action/{name}/path", "LineStrips3D:colors")[-1][1]
        red, green = colour >> 24, colour >> 16 & 255
        assert (red > green) == (name == "imagined")


def test_the_mesh_is_the_object(recording, episodes):
    ((_, corners),) = column(recording, "/action/object/shape", "Mesh3D:vertex_positions")
    volume = np.linalg.det(np.array(corners).reshape(-1, 3, 3)).sum() / 6
    assert volume == pytest.approx(episodes[0].interaction.object.mass_properties(1.0).mass, rel=1e-4)


def test_curves_and_blueprint(recording, episodes):
    episode = episodes[0]
    effect = episode.interaction.effect
    z = column(recording, "/curves/com/z/observed", "Scalars:scalars")
    np.testing.assert_allclose([each[1][0] for each in z], 100 * effect.com_trajectory[:, 2])
    error = column(recording, "/curves/error/distance", "Scalars:scalars")
    apart = 100 * np.linalg.norm(effect.com_trajectory - episode.imagined.com_trajectory, axis=1)
    np.testing.assert_allclose([each[1][0] for each in error], apart)
    assert len(recording.blueprints()) == 1
    assert [each.application_id for each in recording.recordings()] == ["foretrace"]


def test_distance_is_taken_while_both_are_known():
    effect = factories.fake_interaction(np.random.default_rng(0), 0).effect
    shifted = effect.com_trajectory[5:15] + np.array([0.0, 0.0, 0.01])
    times, apart = distances(effect, effect.times[5:15], shifted)
    np.testing.assert_allclose(times, effect.times[5:15])
    np.testing.assert_allclose(apart, 0.01)


def test_command_line(tmp_path, capsys):
    data = fake_data(tmp_path / "data", 2)
    out = tmp_path / "out"
    command = ["export", "rerun", "--data", str(data), "--ids", "1", "--out", str(out), "--no-camera"]
    assert cli.main(command) == 0
    assert capsys.readouterr().out.strip() == str(out / "interaction-000001.rrd")
    assert cli.main(command) == 2
