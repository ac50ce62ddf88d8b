"""What all exports share: the choice, the delivery, resampling, images."""

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import factories
from export_samples import fake_data, fake_run, write_data
from foretrace import cli
from foretrace.errors import DatasetError, ExportError, PredictionError
from foretrace.export.delivery import delivered
from foretrace.export.episodes import Episode, choose
from foretrace.export.images import CAMERA, camera_pose, render_images
from foretrace.export.resampling import frame_times, frames_per_second, resample_poses
from foretrace.geometry import invert_transform, pose_to_matrix, transform_points
from foretrace.imagined import Futures, ImaginedEffect
from foretrace.interactions.record import Outcome


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return fake_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return fake_run(tmp_path_factory.mktemp("run"), state="position")


def test_interactions_come_in_the_order_of_their_choice(data):
    assert [episode.interaction.id for episode in choose(data, [2, 0, 2])] == [2, 0]
    assert [episode.interaction.id for episode in choose(data)] == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        ([1, 7, 9], r"no interaction 7, 9 with a motion: there are 4 \(0 to 3\)"),
        (list(range(10, 30)), "10, 11, 12, 13, 14, 15, 16, 17 and more"),
        ([], "nothing to export"),
    ],
)
def test_a_choice_that_cannot_be_met_is_refused(data, ids, message):
    with pytest.raises(ExportError, match=message):
        choose(data, ids)


def test_a_failed_simulation_cannot_be_chosen(tmp_path):
    failed = factories.fake_interaction(np.random.default_rng(0), 0, outcome=Outcome.FAILED)
    folder = write_data(tmp_path / "data", [failed])
    with pytest.raises(ExportError, match=r"no interaction 0 with a motion: there are 0 \(none\)"):
        choose(folder, [0])
    with pytest.raises(ExportError, match="nothing to export"):
        choose(folder)
    with pytest.raises(DatasetError, match="no such folder"):
        choose(tmp_path / "nowhere")


def test_what_is_imagined_starts_where_the_object_was(data, run):
    episode = choose(data, [1], run)[0]
    effect = episode.interaction.effect
    np.testing.assert_allclose(episode.imagined.com_trajectory[0], effect.com_trajectory[0])
    assert episode.imagined_pose is None, "this one imagines positions alone"


def test_a_predictor_that_must_watch_first_is_refused(data, tmp_path):
    oracle = fake_run(tmp_path, "sp-truth")
    with pytest.raises(PredictionError, match="cannot imagine: its features 'sp-truth' are observed"):
        choose(data, [1], oracle)


def test_an_imagined_pose_is_that_of_the_object_frame():
    interaction = factories.fake_interaction(np.random.default_rng(3), 3)
    effect = interaction.effect
    since_rest = pose_to_matrix(effect.pose_trajectory) @ invert_transform(
        pose_to_matrix(effect.pose_trajectory[0])
    )
    turned = Rotation.from_matrix(since_rest[:, :3, :3]).as_quat(scalar_first=True)
    perfect = np.concatenate([effect.com_trajectory, turned], axis=1)
    turns = Rotation.from_matrix(since_rest[:, :3, :3]).as_rotvec()
    futures = Futures.point(effect.com_trajectory[None], turns[None], "levered")
    episode = Episode(interaction, ImaginedEffect(effect.times, effect.com_trajectory, perfect, futures))
    np.testing.assert_allclose(
        pose_to_matrix(episode.imagined_pose), pose_to_matrix(effect.pose_trajectory), atol=1e-12
    )


def test_an_export_is_whole_or_not_there(tmp_path):
    out = tmp_path / "deep" / "out"

    def write(stop: bool) -> None:
        with delivered(out) as folder:
            (folder / "file").write_text("half")
            assert not out.exists()
            if stop:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(stop=True)
    assert list(out.parent.iterdir()) == []
    write(stop=False)
    assert [path.name for path in out.iterdir()] == ["file"]
    with pytest.raises(ExportError, match="exists already and is not overwritten"), delivered(out):
        pass
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    with pytest.raises(ExportError, match="cannot be made"), delivered(out / "file" / "below"):
        pass


@pytest.mark.parametrize(
    ("command", "module", "extra"), [("rosbag", "rosbags", "ros"), ("rerun", "rerun", "rerun")]
)
def test_a_missing_library_is_named_with_its_install_command(
    command, module, extra, data, tmp_path, capsys, monkeypatch
):
    found = importlib.import_module

    def missing(name, *rest):
        if name == module:
            raise ImportError(name)
        return found(name, *rest)

    monkeypatch.setattr(importlib, "import_module", missing)
    options = ["--data", str(data), "--ids", "0", "--out", str(tmp_path / "out")]
    assert cli.main(["export", command, *options]) == 2
    assert (
        f"{module} is not installed; install it with `pip install 'foretrace[{extra}]'`"
        in capsys.readouterr().err
    )


def test_a_run_needs_the_data(tmp_path, capsys):
    assert cli.main(["export", "lerobot", "--run", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "--data" in capsys.readouterr().err


def effects(*times):
    base = factories.fake_interaction(np.random.default_rng(0), 0).effect
    return [(id, replace(base, times=np.asarray(each))) for id, each in enumerate(times)]


def test_the_rate_is_that_of_the_samples():
    grid = np.arange(60)
    assert frames_per_second(effects(grid / 20, grid / 20 + 3)) == 20
    with pytest.raises(
        ExportError, match="interaction 1 has 30 frames per second, interaction 0 has 20: give --fps"
    ):
        frames_per_second(effects(grid / 20, grid / 30))
    with pytest.raises(ExportError, match=r"interaction 0 is not sampled evenly .* \(about 12\.5\)"):
        frames_per_second(effects(grid * 0.08))
    with pytest.raises(ExportError, match="interaction 0 is not sampled evenly"):
        frames_per_second(effects(np.cumsum(1 + 0.5 * (grid % 2)) / 20))


def test_frames_end_with_the_last_sample():
    np.testing.assert_allclose(frame_times(np.arange(60) / 20, 20), np.arange(60) / 20)
    assert frame_times(5 + np.arange(60) / 20, 10)[-1] == pytest.approx(2.9)


def test_a_steady_motion_is_resampled_exactly():
    def motion(times):
        rotations = Rotation.from_rotvec(np.outer(times, [0.3, -0.2, 0.5])).as_quat(scalar_first=True)
        return np.concatenate([np.outer(times, [0.1, 0.2, -0.1]), rotations], axis=1)

    times, at = np.sort(np.random.default_rng(0).uniform(0, 3, 40)), np.linspace(0.5, 2.5, 31)
    poses = motion(times)
    poses[20:, 3:] *= -1  # the same rotations
    found = resample_poses(times, poses, at)
    np.testing.assert_allclose(pose_to_matrix(found), pose_to_matrix(motion(at)), atol=1e-12)


def test_images_show_object_and_tool_where_they_are():
    interaction = factories.fake_interaction(np.random.default_rng(2), 2)
    effect = interaction.effect
    try:
        seen = render_images(interaction, effect.pose_trajectory[::59], effect.tool_trajectory[::59])
    except ExportError as error:
        pytest.skip(f"cannot render here: {error}")
    np.testing.assert_allclose(np.linalg.det(camera_pose()), 1)
    for k, com in enumerate(effect.com_trajectory[::59]):
        x, y, z = transform_points(invert_transform(seen.T_action_camera), com[None])[0]
        column, row = round(CAMERA.fx * x / z + CAMERA.cx), round(CAMERA.fy * y / z + CAMERA.cy)
        assert 0 < z - seen.depth[k, row, column] < 0.03, "the surface lies just before the centre of mass"
        red, _, blue = seen.rgb[k, row, column].astype(int)
        assert blue > red + 20, "the object is blue, the table is not"
    assert np.abs(seen.rgb[0].astype(int) - seen.rgb[1]).max() > 50
