"""Poses of trackers: tables, bags of ROS, and a plan that is watched with them."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import foretrace as ft
import recorded_scene
from export_samples import fake_data
from foretrace.cli import main
from foretrace.errors import PerceptionError
from foretrace.export.episodes import choose
from foretrace.geometry import (
    invert_transform,
    matrix_to_pose,
    planar_transform,
    pose_to_matrix,
    rotation_angle,
)
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recording_folder import read_image
from foretrace.perception.live import LiveTracker, live_frames
from foretrace.perception.markers import MarkerLayout
from foretrace.perception.pose_files import COLUMNS, read_poses

HEAD = ",".join(COLUMNS)
ROWS = ("0.5,0.1,0,0,1,0,0,0", "0.6,,,,,,,", "0.7,0.12,0,0.01,0.8,0.6,0,0")
PRISM = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])


@pytest.mark.parametrize(
    "text",
    [
        "\n".join([HEAD, *ROWS]),
        "\r\n".join(["t,X,y,z,qw,qx,qy,qz", *ROWS, ""]),
        "\n".join(row.replace(",", ";").replace(".", ",") for row in (HEAD, *ROWS)),
        "\n".join(f"{row},{k}" for k, row in enumerate([HEAD, *ROWS])),
        "\n".join([HEAD, ROWS[0], ROWS[0], "0.6,None,null,N/A,nan,,NA,0", ROWS[2]]),
        "\n".join([HEAD, ROWS[0], "0.6,0,0,0,0,0,0,0", ROWS[2]]),
    ],
    ids=["as it is", "other names", "decimal commas", "one more column", "words, a row twice", "zeros"],
)
def test_tables_are_read_and_empty_cells_are_lost_poses(tmp_path: Path, text: str):
    file = tmp_path / "poses.csv"
    file.write_text(text, encoding="utf-8", newline="")
    times, poses = read_poses(file)
    np.testing.assert_array_equal(times, [0.5, 0.6, 0.7])
    np.testing.assert_array_equal(poses[[0, 2]], [[0.1, 0, 0, 1, 0, 0, 0], [0.12, 0, 0.01, 0.8, 0.6, 0, 0]])
    assert np.isnan(poses[1]).all()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["time_s,x_m"], "has no column y_m, z_m, qw, qx, qy, qz"),
        ([HEAD], "has no pose"),
        ([""], "has no column"),
        ([HEAD, ROWS[2], ROWS[0]], "time 0.5 s follows 0.7 s"),
        (
            [HEAD, "1700000000.25,0,0,0,1,0,0,0", "1700000000.2,0,0,0,1,0,0,0"],
            "1700000000.2 s follows 1700000000.25 s",
        ),
        ([HEAD, ROWS[0], ROWS[0].replace("0.1", "0.2")], "two poses at 0.5 s: leave one out"),
        ([HEAD + ",x", ROWS[0] + ",0.1"], "has two columns x_m: leave one"),
        (
            [HEAD, ROWS[0].replace("0.1", "here")],
            "line 2: 'here' is no number: give one, or leave the cell empty",
        ),
        ([HEAD, ROWS[0].replace("0.1", "inf")], "line 2: inf is not finite"),
        ([HEAD, ROWS[0].replace("0.5", "")], "a line has no time"),
    ],
)
def test_tables_that_cannot_be_used_are_refused(tmp_path: Path, lines: list[str], message: str):
    file = tmp_path / "poses.csv"
    file.write_text("\n".join(lines))
    with pytest.raises(PerceptionError, match=message):
        read_poses(file)


def test_a_table_has_no_topic(tmp_path: Path):
    with pytest.raises(PerceptionError, match="is a table, which has no topic '/p'"):
        read_poses(tmp_path / "poses.csv", "/p")


@pytest.mark.parametrize("version", [1, 2])
def test_transforms_in_bags_are_the_poses_that_were_exported(tmp_path: Path, version: int):
    rosbag = pytest.importorskip("foretrace.export.rosbag", reason="no rosbags")
    data = fake_data(tmp_path / "data")
    rosbag.export_rosbags(choose(data, [1]), tmp_path / "bags", version, camera=False)
    (bag,) = (each for each in (tmp_path / "bags").iterdir() if each.name.startswith("interaction"))
    effect = Dataset.open(data).with_id(1).effect
    times, poses = read_poses(bag)
    np.testing.assert_allclose(times - rosbag.START, effect.times, atol=1e-6)
    np.testing.assert_allclose(pose_to_matrix(poses), pose_to_matrix(effect.pose_trajectory), atol=1e-9)
    with pytest.raises(PerceptionError, match="has no frame 'hand': name one of object, tool"):
        read_poses(bag, child="hand")
    with pytest.raises(PerceptionError, match="no pose topic /here"):
        read_poses(bag, "/here")


def test_stamped_poses_in_bags_are_read(tmp_path: Path):
    pytest.importorskip("rosbags", reason="no rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    make = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/tracked", make["PoseStamped"].__msgtype__, typestore=store)
        for k in range(3):
            header = make["Header"](stamp=make["Time"](sec=7, nanosec=100_000_000 * k), frame_id="table")
            pose = make["Pose"](
                position=make["Point"](x=0.1 * k, y=0.2, z=0.3),
                orientation=make["Quaternion"](x=0.6, y=0.0, z=0.0, w=0.8),
            )
            message = make["PoseStamped"](header=header, pose=pose)
            writer.write(topic, 9_000_000_000 + k, store.serialize_cdr(message, message.__msgtype__))
    times, poses = read_poses(tmp_path / "bag")
    np.testing.assert_allclose(times, [7.0, 7.1, 7.2])
    np.testing.assert_allclose(poses, [[0.1 * k, 0.2, 0.3, 0.8, 0.6, 0, 0] for k in range(3)])


def test_a_plan_is_watched_with_poses_in_either_frame(tmp_path: Path, capsys, monkeypatch):
    """The same motion in the action frame, late by the clock, and in the table frame gives the same score."""
    monkeypatch.chdir(tmp_path)
    T_table_object = planar_transform([0.3, 0.1, 0.0], 0.4)
    config = ft.PlanConfig(check=0, refine=0, spacing=0.05)
    plan = ft.plan(PRISM, ft.goals.Lift(), config=config, T_table_object=T_table_object)
    plan.save("plan.json")
    effect = ft.simulate(PRISM, plan.action, embodiment="tool").effect
    on_table = matrix_to_pose(plan.T_table_action @ pose_to_matrix(effect.pose_trajectory))
    for name, shift, poses in (("own", 100.0, effect.pose_trajectory), ("table", 0.0, on_table)):
        table = np.column_stack([effect.times + shift, poses])
        np.savetxt(f"{name}.csv", table, delimiter=",", header=HEAD, comments="")
    said = []
    for words in (["own.csv"], ["table.csv", "--table"]):
        command = ["monitor", "plan.json", "--poses", *words, "--worlds", "16", "--out", "watched.png"]
        assert main(command) == 0
        said.append(capsys.readouterr().out)
    assert said[0] == said[1]
    assert said[0].startswith("no alarm")
    replace(plan, action=ft.Push(plan.action.contact, plan.action.direction)).save("push.json")
    push = ["monitor", "push.json", "--poses", "own.csv", "--worlds", "16", "--out", "watched.png"]
    assert main(push) == 2
    assert "push.json plans a push, and the one-shot predictor imagines a lever-up" in capsys.readouterr().err
    table = np.column_stack([effect.times, effect.pose_trajectory])
    for name, by in (("ms", [1e3] + [1] * 7), ("off", [1] * 4 + [2] * 4)):
        np.savetxt(f"{name}.csv", table * by, delimiter=",", header=HEAD, comments="")
    for words, wrong in (
        (["--poses", "table.csv"], "give poses in the action frame, or, for poses in the table frame"),
        (["--poses", "own.csv", "--table"], "give poses in the table frame"),
        (["--poses", "own.csv", "--start", "300"], "--start 300 is after the last pose, at 10"),
        (["--poses", "own.csv", "--start=-inf"], "--start is -inf: give a time"),
        (["--poses", "ms.csv"], "ms.csv has 1 pose within the"),
        (["--poses", "off.csv"], "off.csv, first pose: the quaternion (w, x, y, z) has length 2, not 1"),
        (["--poses", "none.csv"], "none.csv"),
        ([], "is a plan: give --poses FILE"),
        (["3", "--poses", "own.csv"], "is a plan: give --poses FILE or --camera, and no number"),
    ):
        assert main(["monitor", "plan.json", *words, "--worlds", "16", "--out", "watched.png"]) == 2
        assert wrong in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_a_plan_is_watched_through_a_camera(recorded, tmp_path: Path, capsys, monkeypatch):
    """A folder of frames, or a video of them, stands for the camera; the motion of another contact alarms under way."""
    monkeypatch.chdir(tmp_path)
    folder, truth = recorded
    config = ft.PlanConfig(check=0, refine=0, spacing=0.05)
    plan = ft.plan(
        recorded_scene.PRISM, ft.goals.Lift(), config=config, T_table_object=truth.T_table_object[0]
    )
    replace(plan, action=recorded_scene.ACTION).save("plan.json")
    other = ft.LeverUp.at_edge(recorded_scene.PRISM, 4, 0.5)
    replace(plan, action=other).save("other.json")
    frames = [read_image(file) for file in sorted(folder.glob("colour-*"))]
    video = cv2.VideoWriter("film.avi", cv2.VideoWriter.fourcc(*"MJPG"), 10.0, frames[0].shape[1::-1])
    for frame in frames:
        video.write(frame)
    video.release()
    files = ["--markers", str(folder / "markers.json"), "--intrinsics", str(folder / "camera.json")]
    begin = f"{truth.action_start - truth.times[0]}"
    words = ["--worlds", "32", "--delay", begin, "--out", "watched.png"]
    for camera in (str(folder), "film.avi"):
        assert main(["monitor", "plan.json", "--camera", camera, *files, *words]) == 0
        told = capsys.readouterr()
        assert told.out.startswith("no alarm")
        assert "alarm at" not in told.err
        assert Path("watched.png").stat().st_size > 10_000
    assert main(["monitor", "other.json", "--camera", str(folder), *files, *words]) == 0
    told = capsys.readouterr()
    assert "alarm at" in told.err
    assert told.out.startswith("alarm at")
    for given, wrong in (
        (["--camera", str(folder)], "--camera needs --markers and --intrinsics"),
        (["--camera", "none.mp4", *files], "none.mp4"),
        (["--camera", str(folder), *files, "--delay=-1"], "--delay is -1"),
        (["--camera", str(folder), *files, "--delay", "100"], "is seen in 0 images"),
        (["--camera", str(folder), "--poses", "own.csv"], "give --poses FILE or --camera"),
    ):
        assert main(["monitor", "plan.json", *given, "--worlds", "16", "--out", "watched.png"]) == 2
        assert wrong in " ".join(capsys.readouterr().err.split())


def test_a_live_tracker_is_as_good_as_the_film_is_sharp(recorded):
    """From the first fifth of a second on, within 1.5 mm and half a degree, without what comes after."""
    folder, truth = recorded
    tracker = LiveTracker(
        PinholeCamera.load(folder / "camera.json"), MarkerLayout.load(folder / "markers.json")
    )
    found = [tracker.update(frame.time, frame.image) for frame in live_frames(str(folder))]
    seen = [k for k, pose in enumerate(found) if pose is not None]
    assert seen == list(range(seen[0], len(found)))
    assert truth.times[seen[0]] - truth.times[0] == pytest.approx(0.2, abs=0.11)
    for k in seen:
        moved = found[k] @ invert_transform(found[seen[0]])
        wanted = truth.T_table_object[k] @ invert_transform(truth.T_table_object[seen[0]])
        here = truth.T_table_object[seen[0]][:, 3]
        assert np.linalg.norm(moved @ here - wanted @ here) < 0.0015
        assert rotation_angle(moved[:3, :3], wanted[:3, :3]) < np.deg2rad(0.5)
