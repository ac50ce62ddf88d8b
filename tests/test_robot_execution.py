"""Motions through ur_rtde over real sockets, on the tests' own controller: nothing here has met a real arm."""

import contextlib
import csv
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from foretrace.actions import Screwdriver
from foretrace.errors import RobotError
from foretrace.interactions.recording_folder import RecordingNotes
from foretrace.robot import controller as controller_module
from foretrace.robot.checks import ArmLimits
from foretrace.robot.deviation import OTHER_ARM
from foretrace.robot.execution import SETTLE, MotionLog, WatchConfig, execute
from foretrace.robot.kinematics import ArmKinematics
from foretrace.robot.path import ArmPath, plan_approach
from foretrace.robot.video import VideoRecorder
from foretrace.simulation.arm import CONTROL_PERIOD
from ur_controller import UR10, UR10E, RunningController, tool_pose

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
    **more,
) -> None:
    execute(host, legs, kinematics, np.eye(4), recording, ArmLimits(), watch, confirm, film, **more)


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


@pytest.mark.parametrize("source", ["none.avi", "", "9" * 30, "/dev/null"])
def test_a_camera_that_is_not_there_is_named(tmp_path, source):
    with pytest.raises(RobotError, match=f"camera '{source}' gives no image"):
        VideoRecorder(source, tmp_path / "film")


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


@pytest.mark.parametrize("names", ["SIGINT", "SIGINT SIGINT SIGINT", "SIGHUP", "SIGQUIT SIGINT", "SIGTERM"])
def test_signals_stop_the_arm_and_keep_the_recording(kinematics, recording, names):
    with RunningController(START, HALF, names) as controller, pytest.raises(KeyboardInterrupt) as stop:
        go(controller.host, kinematics, recording)
    number, where = stop.value.args
    assert number == signal.Signals[names.split()[0]]
    assert where.startswith("lever-up, sample ")
    assert where.endswith("; stopped")
    assert controller.facts.stops == ["servo", "program"]
    assert HALF <= len(controller.facts.set_points) < NUM
    assert len(read(recording)) >= HALF


CLOSED_TERMINAL = """
import sys
sys.path.insert(0, {tests!r})
from test_robot import *
base, out = Path({folder!r}) / "base.json", Path({folder!r}) / "out"
pose = matrix_to_pose(T_TABLE_BASE).tolist()
base.write_text(json.dumps({{"format": "foretrace-base-pose", "version": 1, "T_table_base": pose}}))
start = plan_lever_up(ArmKinematics(Screwdriver()), ACTION, T_TABLE_BASE, 1.0)[0].joints[0]
with RunningController(start, 40, "SIGHUP SIGHUP") as controller:
    options = ["--execute", "--yes", "--speed", "1", "--host", controller.host, "--timeout", "1.5"]
    status = cli.main(command(base, out, *options))
assert controller.facts.stops == ["servo", "program"], controller.facts.stops
sys.exit(status)
"""


def test_a_closed_terminal_stops_the_arm(tmp_path):
    program = CLOSED_TERMINAL.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + signal.SIGHUP, done.stderr
    assert "interrupted; descent, sample" in done.stderr
    assert "stopped, " in done.stderr


@pytest.mark.parametrize(
    ("model", "version", "said"),
    [
        ("UR10", "URSoftware 5.11.1.108318 (Apr 27 2021)", r"moves a UR10e \(PolyScope 5\.11\.1\.108318\)"),
        ("UR5", "URSoftware 3.15.8.106339 (Mar 06 2022)", r"moves a UR5 \(PolyScope 3\.15"),
        ("UR3", "3.14.3", r"moves a UR3 "),
        ("UR16", "URSoftware 5.9.1.1031110", "moves a UR16e "),
        ("UR20", "URSoftware 5.15.0.1", "moves a UR20 "),
        ("", "URSoftware 5.4.2.76197", "moves another arm"),
        ("", "3.0.15547 (Jun 26 2014)", r"does not say its model.*could not understand.*give --is-ur10"),
        ("UR10", "who knows", "does not say its version, but 'who knows'"),
    ],
)
def test_another_arm_is_refused_by_name(kinematics, recording, model, version, said):
    other = RunningController(START, model=model, version=version)
    with other as controller, pytest.raises(RobotError, match=said):
        go(controller.host, kinematics, recording)
    assert (controller.facts.uploads, controller.facts.set_points) == (0, [])


def test_an_arm_that_a_user_vouches_for_is_moved(kinematics, recording):
    with RunningController(START, model="", version="3.0.15547 (Jun 26 2014)") as controller:
        go(controller.host, kinematics, recording, legs=(STEP,), is_ur10=True)
    np.testing.assert_allclose(controller.facts.joints, STEP.joints[-1], atol=1e-4)


TCP = [0.01, -0.02, 0.15, 0.3, -1.0, 2.0]
CALIBRATED = {
    "a": [2e-4, -0.6131, -0.5718, 5e-5, -4e-5, 0.0],
    "d": [0.1283, 1e-3, -8e-4, 0.1636, 0.1159, 0.0922],
}
"""A UR10 as it might leave the factory."""


def test_a_flange_that_is_elsewhere_is_refused_before_anything_moves(kinematics, recording):
    arm = RunningController(START, dh=UR10E, tcp=TCP)
    with (
        arm as controller,
        pytest.raises(RobotError, match=r"flange \d\d\.\d mm and 0\.0 degrees from where a UR10"),
    ):
        go(controller.host, kinematics, recording)
    assert controller.facts.set_points == []
    assert controller.facts.stops == ["servo", "program"]


def test_a_calibrated_arm_needs_its_correction(kinematics, recording, tmp_path):
    arm = RunningController(START, dh=CALIBRATED, tcp=TCP)
    with (
        arm as controller,
        pytest.raises(RobotError, match="the planned height, more than") as error,
    ):
        go(controller.host, kinematics, recording, legs=(STEP,))
    approach = plan_approach(START, START)
    assert len(controller.facts.set_points) == len(approach.joints)  # and nothing of the leg after it
    correction = [float(word) for word in str(error.value).split("--correction ")[1].split()]
    moved = np.eye(4)
    moved[:3, 3] = correction
    with RunningController(START, dh=CALIBRATED, tcp=TCP) as controller:
        again = tmp_path / "again.csv"
        limits = ArmLimits()
        execute(
            controller.host,
            (STEP,),
            kinematics,
            moved,
            again,
            limits,
            PATIENT,
            lambda checks: True,
            correction=correction,
        )
    np.testing.assert_allclose(controller.facts.joints, STEP.joints[-1], atol=1e-4)


def test_no_ur10_with_other_dimensions_passes(kinematics):
    """A UR10e's flange is farther from a UR10's than any calibration is, wherever the arm may be."""
    rng = np.random.default_rng(0)
    for joints in rng.uniform(-np.pi, np.pi, (500, 6)):
        own = tool_pose(list(joints), UR10, [0.0] * 6)
        np.testing.assert_allclose(own[:3], kinematics.at(joints).flange, atol=1e-9)
        other = tool_pose(list(joints), UR10E, [0.0] * 6)
        assert np.linalg.norm(np.subtract(other[:3], own[:3])) > 0.024 > 2 * OTHER_ARM


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


GREETING = b"\0\4V\1"
"""RTDE's yes to version 2."""


def hang_up(connection: socket.socket, *said: bytes) -> None:
    connection.recv(100)
    for words in said:
        connection.sendall(words)
    connection.close()


def flood(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while True:
            connection.sendall(b"\0\3x" * 1000)


@pytest.mark.parametrize(
    ("serve", "said"),
    [
        (lambda connection: None, "timed out"),
        (hang_up, "hung up|reset by peer"),
        (
            lambda connection: hang_up(connection, b"HTTP/1.1 400 Bad Request\r\n\r\n"),
            "hung up|reset by peer",
        ),
        (lambda connection: hang_up(connection, GREETING), "hung up|reset by peer"),
        (lambda connection: connection.sendall(GREETING), "timed out"),
        (lambda connection: connection.sendall(b"\0\4V\0"), "does not speak RTDE version 2"),
        (flood, "does not speak RTDE version 2"),
        (lambda connection: connection.sendall(GREETING + b"\0\x0dO\1NOT_FOUND"), "does not tell timestamp"),
    ],
)
def test_what_is_no_controller_is_named_and_never_waited_for(monkeypatch, serve, said):
    monkeypatch.setattr(controller_module, "PATIENCE", 0.3)
    host, kept = f"127.201.{os.getpid() // 250 % 250 + 1}.{os.getpid() % 250 + 1}", []

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                kept.append(listener.accept()[0])
                serve(kept[-1])

    with socket.create_server((host, 30004)) as listener:
        threading.Thread(target=accept, daemon=True).start()
        message = rf"no UR controller answers at {host}, port 30004 \(.*({said})"
        with pytest.raises(RobotError, match=message):
            controller_module.UrController(host, 0.2)
        listener.shutdown(socket.SHUT_RDWR)  # which ends the wait for the next one
    for connection in kept:
        connection.close()


def test_an_older_recording_is_not_overwritten(recording):
    recording.write_text("mine")
    with pytest.raises(RobotError, match="is there already"):
        MotionLog(recording)
    assert recording.read_text() == "mine"
