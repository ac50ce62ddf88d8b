"""Motions through ur_rtde over real sockets, on the tests' own controller: nothing here has met a real arm."""

import csv
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from foretrace.actions import Screwdriver
from foretrace.errors import RobotError
from foretrace.interactions.recording_folder import RecordingNotes
from foretrace.robot.checks import ArmLimits
from foretrace.robot.execution import SETTLE, MotionLog, WatchConfig, execute
from foretrace.robot.kinematics import ArmKinematics
from foretrace.robot.path import ArmPath
from foretrace.robot.video import VideoRecorder
from foretrace.simulation.arm import CONTROL_PERIOD
from ur_controller import RunningController

pytest.importorskip("rtde_control", reason="needs ur_rtde: pip install 'foretrace[ur]'")
if sys.platform != "linux":
    pytest.skip("only Linux has more than one loopback address", allow_module_level=True)

START = np.array([2.9, -1.5, 2.3, -3.0, -1.5, 1.3])
NUM = 100
LEG = ArmPath("lever-up", START + np.linspace(0, 0.2, NUM)[:, None] * np.array([1, 0, 0, -1, 0, 0]))
PATIENT, WATCH = WatchConfig(timeout=1.5), WatchConfig(timeout=0.5)
"""Longer than the default: the tests' machine may be busy."""
BACK = ArmPath("set-down", LEG.joints[::-1])
BRIEF = 30
STEP = ArmPath("lever-up", LEG.joints[:BRIEF])
STEP_BACK = ArmPath("set-down", STEP.joints[::-1])
"""Long enough for everything that goes well."""
HALF = 30


@pytest.fixture(scope="module")
def kinematics() -> ArmKinematics:
    return ArmKinematics(Screwdriver())


@pytest.fixture
def recording(tmp_path) -> Path:
    return tmp_path / "recording.csv"


def go(
    host: str,
    kinematics: ArmKinematics,
    recording: Path,
    confirm=lambda checks: True,
    film=None,
    watch=PATIENT,
    legs=(LEG,),
) -> None:
    execute(host, legs, kinematics, np.eye(4), recording, ArmLimits(), watch, confirm, film)


def read(recording: Path) -> list[dict[str, str]]:
    with recording.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_lever_up_is_executed(kinematics, recording):
    seen = []
    away = START + np.array([0, 0, 0.004, 0, 0, 0])
    with RunningController(away) as controller:
        go(
            controller.host,
            kinematics,
            recording,
            lambda checks: bool(seen.append(checks)) or True,
            legs=(STEP,),
        )
    facts, rows = controller.facts, read(recording)
    assert {check.leg for check in seen[0]} == {"approach"}
    assert facts.uploads == 1
    assert facts.stops == ["servo", "program"]
    np.testing.assert_allclose(facts.joints, STEP.joints[-1], atol=1e-4)
    # Every set point arrives, in order.
    hold = round(SETTLE / CONTROL_PERIOD)
    np.testing.assert_allclose(facts.set_points[-BRIEF - hold : -hold], STEP.joints, atol=1e-12)
    np.testing.assert_allclose(facts.set_points[0], away, atol=1e-12)
    assert len(rows) == len(facts.set_points)
    assert {row["leg"] for row in rows} == {"approach", "lever-up", "hold"}
    assert np.all(np.diff([float(row["time_s"]) for row in rows]) >= 0)
    last = [float(rows[-1][name]) for name in rows[-1] if name.endswith(("pan_rad", "wrist_1_rad"))]
    np.testing.assert_allclose(last, STEP.joints[-1, [0, 3]], atol=1e-3)
    assert {(row["robot_mode"], row["safety_mode"]) for row in rows} == {("7", "1")}


def test_the_way_back_follows_and_is_recorded(kinematics, recording):
    with RunningController(START) as controller:
        go(controller.host, kinematics, recording, legs=(STEP, STEP_BACK))
    hold = round(SETTLE / CONTROL_PERIOD)
    np.testing.assert_allclose(
        controller.facts.set_points[-BRIEF - hold : -hold], STEP_BACK.joints, atol=1e-12
    )
    np.testing.assert_allclose(controller.facts.joints, START, atol=1e-4)
    legs = [row["leg"] for row in read(recording)]
    assert list(dict.fromkeys(legs)) == ["approach", "lever-up", "set-down", "hold"]
    assert legs.count("set-down") == BRIEF


class PacedCamera:
    """A video file that gives its images at the pace of a camera, over and over."""

    def __init__(self, file: Path) -> None:
        self._image = cv2.VideoCapture(str(file)).read()[1]

    def read(self) -> tuple[bool, np.ndarray]:
        time.sleep(1 / 30)
        return True, self._image

    def release(self) -> None:
        pass


@pytest.fixture
def video(tmp_path) -> Path:
    file = tmp_path / "camera.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    writer.write(np.full((48, 64, 3), 90, np.uint8))
    writer.write(np.full((48, 64, 3), 200, np.uint8))
    writer.release()
    return file


def test_a_motion_is_filmed_on_the_clock_of_its_recording(kinematics, recording, video, monkeypatch):
    folder = recording.parent / "film"
    film = VideoRecorder(str(video), folder)
    monkeypatch.setattr(film, "_capture", PacedCamera(video))
    with RunningController(START) as controller:
        go(controller.host, kinematics, recording, film=film, legs=(STEP, STEP_BACK))
    with (folder / "timestamps.csv").open(newline="") as file:
        frames = list(csv.DictReader(file))
    times, rows = [float(frame["time_s"]) for frame in frames], read(recording)
    assert np.all(np.diff(times) > 0)
    assert times[0] < float(rows[0]["host_s"])
    assert times[-1] > float(rows[-1]["host_s"])
    assert all((folder / frame["colour"]).is_file() for frame in frames)
    last, first = (
        [float(row["host_s"]) for row in rows if row["leg"] == leg] for leg in ("approach", "lever-up")
    )
    start = RecordingNotes.load(folder).action_start
    assert start is not None
    assert last[-1] - 1e-4 < start < first[0] + 1e-4


def test_a_camera_that_ends_early_is_told(video, tmp_path):
    with (
        pytest.warns(UserWarning, match="no more images"),
        VideoRecorder(str(video), tmp_path / "film") as film,
    ):
        film._thread.join(60)
    assert len((tmp_path / "film" / "timestamps.csv").read_text().splitlines()) == 2


def test_a_camera_that_is_not_there_is_named(tmp_path):
    with pytest.raises(RobotError, match=r"camera \S+none\.avi gives no image"):
        VideoRecorder(str(tmp_path / "none.avi"), tmp_path / "film")


@pytest.mark.parametrize(
    ("event", "said", "stops"),
    [
        ("protective", "protective stop, lever-up", []),
        ("emergency", "emergency stop, lever-up", []),
        ("reduced", r"safety mode 2 \(reduced\)", ["servo", "program"]),
        ("stuck", r"joint \w+ is 0\.05\d rad from its path", ["servo", "program"]),
        ("freeze", r"no data from the controller for \d\.\d+ s.*stopped by the dashboard", ["dashboard"]),
        ("drop", "connection lost.*no stop could be sent.*watchdog", ["watchdog"]),
    ],
)
def test_what_goes_wrong_half_way_stops_the_arm(kinematics, recording, event, said, stops):
    # Where no data come, the last known joints fall behind their path as well: here silence is to be noticed first.
    watch = replace(WATCH, deviation=0.15) if event == "freeze" else WATCH
    with RunningController(START, HALF, event) as controller, pytest.raises(RobotError, match=said):
        go(controller.host, kinematics, recording, watch=watch, legs=(LEG, BACK))
    assert controller.facts.stops == stops
    assert controller.facts.uploads == 1
    assert HALF <= len(controller.facts.set_points) < HALF + 75
    rows = read(recording)
    assert len(rows) >= HALF
    assert rows[-1]["leg"] == "lever-up"  # no way back after a stop


def test_ctrl_c_stops_the_arm_and_keeps_the_recording(kinematics, recording):
    with RunningController(START, HALF, "interrupt") as controller, pytest.raises(KeyboardInterrupt):
        go(controller.host, kinematics, recording)
    assert controller.facts.stops == ["servo", "program"]
    assert HALF <= len(controller.facts.set_points) < NUM
    assert len(read(recording)) >= HALF


def test_an_arm_that_is_not_ready_is_left_alone(kinematics, recording):
    said = "scales speeds to 50 %"
    with RunningController(START, speed_slider=0.5) as controller, pytest.raises(RobotError, match=said):
        go(controller.host, kinematics, recording)
    assert (controller.facts.uploads, controller.facts.set_points) == (0, [])
    assert not recording.exists()


def test_without_confirmation_nothing_moves(kinematics, recording):
    with RunningController(START) as controller, pytest.raises(RobotError, match="not confirmed"):
        go(controller.host, kinematics, recording, lambda checks: False)
    assert (controller.facts.uploads, controller.facts.set_points) == (0, [])


def test_an_unsafe_way_to_the_start_is_refused(kinematics, recording):
    away = START + np.array([0, 0, 0, 0, 1.7, 0])
    said = "approach: way to the start of wrist_2"
    with RunningController(away) as controller, pytest.raises(RobotError, match=said):
        go(controller.host, kinematics, recording)
    assert controller.facts.uploads == 0


def test_a_controller_that_is_not_there_is_named(kinematics, recording):
    with pytest.raises(RobotError, match=r"no UR controller answers at 127\.0\.0\.1, port 30004"):
        go("127.0.0.1", kinematics, recording)


def test_an_older_recording_is_not_overwritten(recording):
    recording.write_text("mine")
    with pytest.raises(RobotError, match="is there already"):
        MotionLog(recording)
    assert recording.read_text() == "mine"
