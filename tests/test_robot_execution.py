"""Motions through ur_rtde over real sockets, on the tests' own controller: nothing here has met a real arm."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from foretrace.errors import RobotError
from foretrace.robot.checks import ArmLimits
from foretrace.robot.execution import SETTLE, WatchConfig, execute
from foretrace.robot.kinematics import ArmKinematics
from foretrace.robot.path import ArmPath
from foretrace.simulation.arm import CONTROL_PERIOD
from foretrace.simulation.tool import Tool
from ur_controller import RunningController

pytest.importorskip("rtde_control", reason="needs ur_rtde: pip install 'foretrace[ur]'")
if sys.platform != "linux":
    pytest.skip("only Linux has more than one loopback address", allow_module_level=True)

START = np.array([2.9, -1.5, 2.3, -3.0, -1.5, 1.3])
NUM = 80
LEG = ArmPath("lever-up", START + np.linspace(0, 0.15, NUM)[:, None] * np.array([1, 0, 0, -1, 0, 0]))
WATCH = WatchConfig(timeout=0.5)
"""Longer than the default: the tests' machine may be busy."""
HALF = 40


@pytest.fixture(scope="module")
def kinematics() -> ArmKinematics:
    return ArmKinematics(Tool())


@pytest.fixture
def recording(tmp_path) -> Path:
    return tmp_path / "recording.csv"


def go(host: str, kinematics: ArmKinematics, recording: Path, confirm=lambda checks: True) -> None:
    execute(host, [LEG], kinematics, np.eye(4), recording, ArmLimits(), WATCH, confirm)


def read(recording: Path) -> list[dict[str, str]]:
    with recording.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_lever_up_is_executed(kinematics, recording):
    seen = []
    away = START + np.array([0, 0, 0.004, 0, 0, 0])
    with RunningController(away) as controller:
        go(controller.host, kinematics, recording, lambda checks: bool(seen.append(checks)) or True)
    facts, rows = controller.facts, read(recording)
    assert {check.leg for check in seen[0]} == {"approach"}
    assert facts.uploads == 1
    assert facts.stops == ["servo", "program"]
    np.testing.assert_allclose(facts.joints, LEG.joints[-1], atol=1e-4)
    # Every set point arrives, in order.
    hold = round(SETTLE / CONTROL_PERIOD)
    np.testing.assert_allclose(facts.set_points[-NUM - hold : -hold], LEG.joints, atol=1e-12)
    np.testing.assert_allclose(facts.set_points[0], away, atol=1e-12)
    assert len(rows) == len(facts.set_points)
    assert {row["leg"] for row in rows} == {"approach", "lever-up", "hold"}
    assert np.all(np.diff([float(row["time_s"]) for row in rows]) >= 0)
    last = [float(rows[-1][name]) for name in rows[-1] if name.endswith(("pan_rad", "wrist_1_rad"))]
    np.testing.assert_allclose(last, LEG.joints[-1, [0, 3]], atol=1e-3)
    assert {(row["robot_mode"], row["safety_mode"]) for row in rows} == {("7", "1")}


@pytest.mark.parametrize(
    ("event", "said", "stops"),
    [
        ("protective", "protective stop, lever-up", []),
        ("emergency", "emergency stop, lever-up", []),
        ("reduced", r"safety mode 2 \(reduced\)", ["servo", "program"]),
        ("stuck", r"joint \w+ is 0\.05\d rad from its path", ["servo", "program"]),
        ("freeze", r"no data from the controller for 0\.\d+ s.*stopped by the dashboard", ["dashboard"]),
        ("drop", "connection lost.*no stop could be sent.*watchdog", ["watchdog"]),
    ],
)
def test_what_goes_wrong_half_way_stops_the_arm(kinematics, recording, event, said, stops):
    with RunningController(START, HALF, event) as controller, pytest.raises(RobotError, match=said):
        go(controller.host, kinematics, recording)
    assert controller.facts.stops == stops
    assert controller.facts.uploads == 1
    assert HALF <= len(controller.facts.set_points) < HALF + 75
    assert len(read(recording)) >= HALF


def test_ctrl_c_stops_the_arm_and_keeps_the_recording(kinematics, recording):
    with RunningController(START, HALF, "interrupt") as controller, pytest.raises(KeyboardInterrupt):
        go(controller.host, kinematics, recording)
    assert controller.facts.stops == ["servo", "program"]
    assert HALF <= len(controller.facts.set_points) < NUM
    assert len(read(recording)) >= HALF


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"safety_mode": 3}, "is in protective stop: release it"),
        ({"speed_slider": 0.5}, "scales speeds to 50 %"),
        ({"playing": True}, "runs a program"),
    ],
)
def test_an_arm_that_is_not_ready_is_left_alone(kinematics, recording, settings, said):
    with RunningController(START, **settings) as controller, pytest.raises(RobotError, match=said):
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


def test_an_older_recording_is_not_overwritten(kinematics, recording):
    recording.write_text("mine")
    with RunningController(START) as controller, pytest.raises(RobotError, match="is there already"):
        go(controller.host, kinematics, recording)
    assert recording.read_text() == "mine"
    assert controller.facts.uploads == 0
