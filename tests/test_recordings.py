"""A recorded lever-up becomes an interaction; broken recordings are refused with a reason."""

import csv
import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import factories
from foretrace.actions import Motion
from foretrace.cli import main
from foretrace.errors import DatasetError, PerceptionError
from foretrace.geometry import rotation_angle
from foretrace.interactions import storage
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.doctor import examine
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.record import Outcome
from foretrace.interactions.recorded import add_recorded, find_recording, place_of
from foretrace.interactions.recording_folder import Frame, RecordingNotes, write_recording
from foretrace.interactions.topdown import TopDownView
from foretrace.perception.importing import Contact, ImportConfig, Imported, import_recording
from foretrace.perception.markers import MarkerLayout
from foretrace.perception.overlay import write_video
from foretrace.perception.recordings import open_recording
from foretrace.simulation.recording import RecordingTruth
from recorded_scene import ACTION, CAMERA, CONFIG, PRISM, contact_pixel

CONTACT = Contact(point=(float(ACTION.contact[0]), float(ACTION.contact[1])))


@pytest.fixture(scope="module")
def imported(recorded: tuple[Path, RecordingTruth]) -> Imported:
    folder, _ = recorded
    return import_recording(
        open_recording(folder), CAMERA, MarkerLayout.load(folder / "markers.json"), CONTACT, PRISM
    )


def some_of(folder: Path, new: Path, frames: int) -> Path:
    """A copy of a recording that ends after some frames."""
    shutil.copytree(folder, new)
    rows = list(csv.reader((new / "timestamps.csv").read_text().splitlines()))
    with open(new / "timestamps.csv", "w", newline="") as file:
        csv.writer(file).writerows(rows[: 1 + frames])
    return new


def look(folder: Path, camera: PinholeCamera = CAMERA) -> Imported:
    return import_recording(
        open_recording(folder), camera, MarkerLayout.load(folder / "markers.json"), CONTACT, PRISM
    )


def test_the_object_is_where_it_was(recorded: tuple[Path, RecordingTruth], imported: Imported) -> None:
    _, truth = recorded
    apart = np.linalg.norm(imported.T_table_object[:, :3, 3] - truth.T_table_object[:, :3, 3], axis=1)
    angle = rotation_angle(imported.T_table_object[:, :3, :3], truth.T_table_object[:, :3, :3])
    assert np.median(apart) < 0.001
    assert np.median(angle) < np.deg2rad(1.0)
    assert imported.track.seen.mean() > 0.9
    np.testing.assert_allclose(imported.T_table_camera[:3, 3], truth.T_table_camera[:3, 3], atol=0.002)


def test_the_interaction_is_that_of_the_simulation(
    recorded: tuple[Path, RecordingTruth], imported: Imported
) -> None:
    _, truth = recorded
    found, exact = imported.interaction, truth.interaction
    assert found.provenance.source == "recorded"
    assert found.effect.outcome == exact.effect.outcome == Outcome.LEVERED
    assert imported.start == pytest.approx(truth.action_start, abs=0.05)
    end = len(found.effect.times)
    assert end >= 58
    error = np.linalg.norm(found.effect.com_trajectory - exact.effect.com_trajectory[:end], axis=1)
    assert np.median(error) < 0.003
    overlap = (found.view.mask & exact.view.mask).sum() / (found.view.mask | exact.view.mask).sum()
    assert overlap > 0.98


def test_recordings_are_data_like_any_other(
    recorded: tuple[Path, RecordingTruth],
    imported: Imported,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder, _ = recorded
    out = tmp_path / "data"
    command = [
        "import",
        str(folder),
        "--out",
        str(out),
        "--object",
        str(folder / "object.json"),
        "--edge",
        "2",
    ]
    assert main(command) == 0
    assert "interaction 0: levered" in capsys.readouterr().out
    assert main(command) == 0  # as after an interruption of the last moment
    assert "has this recording already" in capsys.readouterr().err
    assert len(Dataset.open(out)) == 1
    first = json.loads((out / "recordings" / "00000.json").read_text())
    assert add_recorded(out, imported.interaction, first) == 1
    dataset = Dataset.open(out)
    assert len(dataset) == 2
    assert dataset.table["object_id"].to_pylist() == [0, 0]
    assert not examine(out).findings
    assert np.isfinite(dataset.batch().com).all()
    notes = json.loads((out / "recordings" / "00000.json").read_text())
    assert PinholeCamera.from_dict(notes["camera"]) == CAMERA
    assert len(notes["seen"]) == len(notes["frame_times"]) == len(notes["position_deviation_m"])
    with pytest.raises(DatasetError, match="is no data set"):
        add_recorded(folder, imported.interaction, {})
    (tmp_path / "simulated").mkdir()
    storage.write_manifest(tmp_path / "simulated", storage.new_manifest({"seed": 0}, 0, 100, {}))
    with pytest.raises(DatasetError, match="holds simulated interactions"):
        add_recorded(tmp_path / "simulated", imported.interaction, {})


def test_an_unknown_object_is_taken_from_its_outline(
    recorded: tuple[Path, RecordingTruth], tmp_path: Path
) -> None:
    folder, truth = some_of(recorded[0], tmp_path / "some", frames=24), recorded[1]
    found = import_recording(
        open_recording(folder),
        CAMERA,
        MarkerLayout.load(folder / "markers.json"),
        Contact(pixel=contact_pixel(truth)),
    )
    exact = TopDownView.of(PRISM, ACTION)
    view = found.interaction.view
    assert (view.mask & exact.mask).sum() / (view.mask | exact.mask).sum() > 0.97
    assert found.interaction.object.height == pytest.approx(PRISM.height, abs=0.002)


def test_broken_recordings_are_refused_with_a_reason(
    recorded: tuple[Path, RecordingTruth], tmp_path: Path
) -> None:
    folder, _ = recorded
    short = some_of(folder, tmp_path / "short", frames=8)
    with pytest.raises(PerceptionError, match="never moves by a millimetre"):
        look(short)
    with pytest.raises(PerceptionError, match="800 x 450 pixels, the camera was calibrated for 640 x 360"):
        look(short, PinholeCamera(640, 360, 460.0, 460.0, 320.0, 180.0))
    table = short / "timestamps.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([*lines[:4], lines[5], lines[4], *lines[6:]]))
    with pytest.raises(PerceptionError, match="do not increase: frame 4"):
        look(short)
    table.write_text("\n".join([lines[0], *(line.replace("colour-00002", "gone") for line in lines[1:])]))
    with pytest.raises(PerceptionError, match="cannot read an image"):
        look(short)
    table.write_text("time\n1")
    with pytest.raises(PerceptionError, match="its columns are time_s, colour, depth"):
        look(short)
    with pytest.raises(PerceptionError, match="no recording at"):
        open_recording(tmp_path / "nothing")
    with pytest.raises(PerceptionError, match="is no recording that can be read"):
        open_recording(folder / "markers.json")


@pytest.mark.parametrize(
    ("factor", "offset", "said"),
    [
        (
            1e3,
            0.0,
            r"has 0.01 frames per second by its time stamps, from 40657 to 41357 s: are they in seconds\?",
        ),
        (1e9, 1.7e18, r"has 1e-08 frames per second .* are they in seconds\?"),
        (1 / 3600, 0.0, r"has 3.6e\+04 frames per second .* are they in seconds\?"),
        (2.5, 0.0, r"has 4 frames per second .* Record at 10 frames per second or more"),
    ],
)
def test_time_stamps_in_another_unit_and_slow_films(
    recorded: tuple[Path, RecordingTruth], tmp_path: Path, factor: float, offset: float, said: str
) -> None:
    folder = some_of(recorded[0], tmp_path / "some", frames=8)
    table = folder / "timestamps.csv"
    head, *rows = csv.reader(table.read_text().splitlines())
    with open(table, "w", newline="") as file:
        csv.writer(file).writerows([head, *[[float(row[0]) * factor + offset, *row[1:]] for row in rows]])
    with pytest.raises(PerceptionError, match=said):
        look(folder)


def test_a_single_frame_is_no_recording(recorded: tuple[Path, RecordingTruth], tmp_path: Path) -> None:
    folder = some_of(recorded[0], tmp_path / "some", frames=1)
    with pytest.raises(
        PerceptionError, match="some has a single frame: give the recording of a whole lever-up"
    ):
        look(folder)


def test_one_frame_at_rest_is_not_enough(recorded: tuple[Path, RecordingTruth], tmp_path: Path) -> None:
    folder = some_of(recorded[0], tmp_path / "some", frames=8)
    for number in (1, 2):
        image = folder / f"colour-{number:05d}.jpg"
        cv2.imwrite(str(image), np.full((CAMERA.height, CAMERA.width, 3), 200, np.uint8))
    with pytest.raises(PerceptionError, match=r"seen at 40.657 s, the next time at 40.957 s: two are needed"):
        look(folder)


def test_a_recording_is_found_from_its_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From another folder, after both have moved, and after one has; old notes are seen from a folder above."""
    first, work = tmp_path / "first", tmp_path / "elsewhere"
    (first / "films" / "a").mkdir(parents=True)
    work.mkdir()
    monkeypatch.chdir(first)
    notes = place_of(Path("films/a"), Path("data/set"))
    assert notes["recording"] == "../../films/a"
    (first / "data" / "set").mkdir(parents=True)
    monkeypatch.chdir(work)
    for one in (notes, {"recording": "films/a"}, {"recording": str(first / "films" / "a")}):
        assert find_recording(first / "data" / "set", one).samefile(first / "films" / "a")
    (first / "data" / "set").rename(work / "set")
    assert find_recording(Path("set"), notes).samefile(first / "films" / "a")
    (work / "set").rename(first / "data" / "set")
    second = first.rename(tmp_path / "second")
    for one in (notes, {"recording": "films/a"}):
        assert find_recording(second / "data" / "set", one).samefile(second / "films" / "a")
    (second / "films" / "a").rmdir()
    with pytest.raises(DatasetError, match=r"no longer at .*: say where it is with --recording"):
        find_recording(second / "data" / "set", notes)


def test_why_no_marker_is_found(recorded: tuple[Path, RecordingTruth], tmp_path: Path) -> None:
    folder, _ = recorded
    few = some_of(folder, tmp_path / "few", frames=3)
    layout = json.loads((few / "markers.json").read_text())
    (few / "markers.json").write_text(json.dumps(layout | {"dictionary": "4x4_50"}))
    with pytest.raises(PerceptionError, match="its markers are of apriltag_36h11, not 4x4_50"):
        look(few)
    (few / "markers.json").write_text(json.dumps(layout | {"object": [{"id": 77, "side": 0.04}]}))
    with pytest.raises(PerceptionError, match=r"markers \[77\] are seen in 0 of 3 frames.*seen are \["):
        look(few)
    (few / "markers.json").write_text(json.dumps(layout))
    for name, spoil, reason in (
        ("dark", lambda image: image // 20, "it is dark"),
        ("blurred", lambda image: cv2.GaussianBlur(image, (0, 0), 12), "it is blurred"),
        ("empty", lambda image: np.full_like(image, 200), "it is blurred or empty"),
    ):
        copy = tmp_path / name
        shutil.copytree(few, copy)
        for path in list(copy.glob("colour-*.jpg"))[:]:
            cv2.imwrite(str(path), spoil(cv2.imread(str(path))))
        with pytest.raises(PerceptionError, match=reason):
            look(copy)


def test_wrong_sides_and_gaps_are_noticed(recorded: tuple[Path, RecordingTruth], tmp_path: Path) -> None:
    folder, _ = recorded
    copy = some_of(folder, tmp_path / "copy", frames=24)
    layout = json.loads((copy / "markers.json").read_text())
    layout["object"][0]["side"] *= 1.4
    (copy / "markers.json").write_text(json.dumps(layout))
    with pytest.raises(PerceptionError, match="check the sides of the markers"):
        look(copy)
    shutil.copy(folder / "markers.json", copy)
    for number in range(15, 22):
        cv2.imwrite(str(copy / f"colour-{number:05d}.jpg"), np.full((450, 800, 3), 200, np.uint8))
    with pytest.raises(PerceptionError, match=r"are not seen from .* longer than the 0.25 s"):
        look(copy)


def test_videos(recorded: tuple[Path, RecordingTruth], tmp_path: Path) -> None:
    folder, _ = recorded
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (800, 450))
    images = [frame.image for frame in open_recording(folder).frames()][:12]
    for image in images:
        writer.write(image)
    writer.release()
    frames = list(open_recording(path).frames())
    np.testing.assert_allclose([frame.time for frame in frames], 0.1 * np.arange(12), atol=1e-3)
    assert np.abs(frames[3].image.astype(int) - images[3]).mean() < 5
    content = path.read_bytes()
    (tmp_path / "half.avi").write_bytes(content[: len(content) // 2])
    with pytest.raises(PerceptionError, match=r"is cut off|cannot be opened"):
        list(open_recording(tmp_path / "half.avi").frames())
    (tmp_path / "none.mp4").write_bytes(b"no video")
    with pytest.raises(PerceptionError, match="cannot be opened"):
        list(open_recording(tmp_path / "none.mp4").frames())


def test_depth_helps_where_the_background_does_not_tell(
    recorded: tuple[Path, RecordingTruth], tmp_path: Path
) -> None:
    folder = some_of(recorded[0], tmp_path / "film", frames=24)
    cv2.imwrite(str(folder / "background.png"), np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))
    layout, contact = MarkerLayout.load(folder / "markers.json"), Contact(edge=(2, 0.5))
    with pytest.warns(UserWarning, match="found by depth, since by background: .* of the image differ"):
        found = import_recording(open_recording(folder), CAMERA, layout, contact, PRISM)
    off = found.T_table_object[0, :3, 3] - recorded[1].T_table_object[0, :3, 3]
    assert np.linalg.norm(off) < 0.003


def test_an_action_is_said_once() -> None:
    with pytest.raises(PerceptionError, match="exactly one"):
        Contact()
    with pytest.raises(PerceptionError, match="exactly one"):
        Contact(point=(0.0, 0.0), edge=(1, 0.5))


def test_outcomes_from_motion_alone_agree_with_those_that_saw_the_blade(
    recorded: tuple[Path, RecordingTruth],
) -> None:
    effect = recorded[1].interaction.effect

    def judged(poses: np.ndarray, com: np.ndarray) -> tuple[str, int | None]:
        unseen = np.empty((len(poses), 0))
        judgement = ACTION.judge(Motion(effect.times[: len(poses)], poses, poses, unseen), PRISM, com)
        return judgement.outcome, judgement.slip_index

    assert judged(effect.pose_trajectory, effect.com_trajectory) == (Outcome.LEVERED, None)
    dropped = effect.pose_trajectory.copy()
    dropped[40:] = dropped[0]
    com = effect.com_trajectory.copy()
    com[40:] = com[0]
    assert judged(dropped, com) == (Outcome.SLIPPED, 40)
    still = np.repeat(dropped[:1], 60, axis=0)
    assert judged(still, np.repeat(com[:1], 60, axis=0)) == (Outcome.MISSED, None)


def test_only_mujoco_films() -> None:
    simulation = dataclasses.replace(CONFIG.simulation)
    assert simulation.engine == "mujoco"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--width 3", "width = 3 is outside 64 to 7680"),
        ("--width 100000", "width = 100000 is outside"),
        ("--fps 0.001", "frames_per_second = 0.001 is outside 1 to 100"),
        ("--fps nan", "frames_per_second = nan is outside"),
        ("--distance 0", "distance = 0.0 is outside 0.1 to 10"),
        ("--distance inf", "distance = inf is outside"),
        ("--slant 2", "slant = 2.0 is outside 0 to 1.5"),
        ("--slant -0.1", "slant = -0.1 is outside"),
        ("--azimuth nan", "azimuth = nan is outside"),
        ("--depth-every -1", "depth_every = -1 is outside 0"),
        ("--board -1", "--board is -1: give a number from 0"),
        ("--seed -1", "--seed is -1: give a number from 0"),
    ],
)
def test_what_cannot_be_filmed_is_refused_before_anything_is_written(
    options: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = tmp_path / "data", tmp_path / "film"
    add_recorded(data, factories.fake_lever_up(PRISM, ACTION), {})
    assert main(["film", str(data), "0", "--out", str(out), *options.split()]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert message in printed
    assert not out.exists()


def test_a_film_does_not_take_the_place_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "film"
    out.write_text("kept")
    assert main(["film", str(tmp_path), "0", "--out", str(out)]) == 2
    assert f"{out} is a file: name a folder" in capsys.readouterr().err
    assert out.read_text() == "kept"


def test_a_image_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    frames = [Frame(0.0, np.zeros((4, 4, 3), np.uint8))]
    (tmp_path / "colour-00000.jpg").mkdir()  # a folder is where the image should be, as a full disk would be
    with pytest.raises(PerceptionError, match=r"cannot write .*colour-00000\.jpg"):
        write_recording(tmp_path, frames, RecordingNotes())
    (tmp_path / "film.mp4").mkdir()
    with pytest.raises(PerceptionError, match=r"cannot write .*film\.mp4: check the folder"):
        write_video(tmp_path / "film.mp4", [np.zeros((64, 64, 3), np.uint8)] * 100, 10.0)


def test_a_start_that_is_no_time_is_refused() -> None:
    with pytest.raises(PerceptionError, match=r"start = nan is outside .*: give a time stamp"):
        ImportConfig(start=float("nan"))
