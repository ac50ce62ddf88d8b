"""The object is watched while the stand-in controller's arm levers it up; faults are injected into its poses."""

import csv
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import foretrace as ft
from foretrace import cli
from foretrace.actions import Screwdriver
from foretrace.errors import RobotError
from foretrace.geometry import rotation_vector_to_quaternion
from foretrace.imagined import LEVELS, Futures, ImaginedEffect
from foretrace.interactions.record import Effect
from foretrace.monitoring import MonitorCalibration
from foretrace.robot import pose_watch as module
from foretrace.robot.checks import ArmLimits
from foretrace.robot.execution import WatchConfig, execute
from foretrace.robot.kinematics import ArmKinematics
from foretrace.robot.path import ArmPath
from foretrace.robot.pose_watch import BRAKE, ActionClock, AlarmConfig, PoseSource, PoseWatch, replay
from foretrace.simulation.arm import CONTROL_PERIOD
from test_robot import base_file as base_file
from test_robot import command
from ur_controller import RunningController

needs_controller = pytest.mark.skipif(
    sys.platform != "linux", reason="only Linux has more than one loopback address"
)
START = np.array([2.9, -1.5, 2.3, -3.0, -1.5, 1.3])
NUM = 80
LEG = ArmPath("lever-up", START + np.linspace(0, 0.15, NUM)[:, None] * np.array([1, 0, 0, -1, 0, 0]))
BACK = ArmPath("set-down", LEG.joints[::-1])
TIMES = 0.02 * np.arange(33)
COM = np.array([0.08, 0.004, 0.01])
PATIENT = AlarmConfig(silence=1.5)
"""Longer than the default: the tests' machine may be busy."""
CALIBRATION = MonitorCalibration.of(np.linspace(0.1, 2.0, 200))


def lift() -> np.ndarray:
    """(time, 7) Poses of an object that rises by 5 cm from 0.1 s on."""
    phase = np.clip((TIMES - 0.1) / 0.4, 0, 1)
    poses = np.zeros((len(TIMES), 7))
    poses[:, :3] = COM + np.outer(phase, [0.01, 0.0, 0.05])
    poses[:, 3:] = rotation_vector_to_quaternion(np.outer(phase, [0.0, -0.5, 0.0]))
    return poses


LIFT = lift()


def monitor() -> ft.Monitor:
    phase = np.clip((TIMES - 0.1) / 0.4, 0, 1)
    states = np.concatenate([LIFT[:, :3], np.outer(phase, [0.0, -0.5, 0.0])], axis=1)[None, None]
    futures = Futures(
        np.ones((1, 1)),
        ("levered",),
        states,
        np.full(states.shape[:3], 0.001),
        np.full((1, 1, 2, 2), np.nan),
        np.linspace(1, 3, len(LEVELS)),
    )
    return ft.Monitor(ImaginedEffect(TIMES, LIFT[:, :3], LIFT, futures), calibration=CALIBRATION)


def tracked(pose_at: Callable[[float], np.ndarray | None]) -> PoseSource:
    """A tracker at 50 Hz of an object whose pose follows from the time of the action."""

    def samples(clock: ActionClock) -> Iterator[tuple[float, np.ndarray | None]]:
        noise = np.random.default_rng(0)
        while True:
            now = time.monotonic()
            pose = pose_at(clock.action_time(now) or 0.0)
            if pose is not None:
                pose = pose + np.append(noise.normal(scale=2e-4, size=3), np.zeros(4))
            yield now, pose
            time.sleep(0.02)

    return samples


def recorded(count: int = len(TIMES)) -> Effect:
    """The imagined motion as a recording, its first samples."""
    poses = LIFT[:count]
    nothing = np.zeros((count, 0)), np.full((2, 2), np.nan)
    return Effect(TIMES[:count], poses, poses[:, :3], poses, *nothing, (), "levered")


def go(watch: PoseWatch, recording: Path, event: str = "none", after: int = 0, legs=(LEG, BACK)):
    """Execute, and tell what the controller has seen and what was raised."""
    pytest.importorskip("rtde_control", reason="needs ur_rtde: pip install 'foretrace[ur]'")
    error = None
    with RunningController(START, after, event) as controller:
        try:
            execute(
                *(controller.host, legs, ArmKinematics(Screwdriver()), np.eye(4), recording),
                *(ArmLimits(), WatchConfig(timeout=1.5), lambda checks: True),
                pose_watch=watch,
            )
        except (RobotError, KeyboardInterrupt) as raised:
            error = raised
    return controller.facts, error


@needs_controller
def test_an_object_that_moves_as_imagined_lets_the_arm_go_on(tmp_path):
    watch = PoseWatch(monitor(), replay(recorded()), PATIENT)
    facts, error = go(watch, tmp_path / "recording.csv", legs=(LEG,))
    assert error is None
    np.testing.assert_allclose(facts.joints, LEG.joints[-1], atol=1e-4)
    assert watch.verdict is not None
    assert not watch.verdict.alarm
    assert watch.verdict.time > 0.55


@needs_controller
@pytest.mark.parametrize(("on_alarm", "event"), [("stop", "none"), ("hold", "SIGINT")])
def test_the_arm_stands_still_within_100_ms_of_an_alarm(tmp_path, on_alarm, event):
    """The object stays where it is; the best of three, since the tests' machine may be busy. Ctrl-C ends a hold."""
    late, told = [], []
    for attempt in range(3):
        watch = PoseWatch(
            monitor(), tracked(lambda t: LIFT[0]), replace(PATIENT, on_alarm=on_alarm), tell=told.append
        )
        facts, error = go(watch, tmp_path / f"{attempt}.csv", event, NUM + 20)
        if on_alarm == "stop":
            assert "motion given up: alarm at 0." in str(error)
        else:
            assert isinstance(error, KeyboardInterrupt)
            assert error.args[1].startswith("hold, sample")
            assert told[-1].startswith("alarm at 0.")
            assert told[-1].endswith(": hold")
        assert facts.stops == ["servo", "program"]
        assert facts.joints[0] < LEG.joints[-10, 0]
        assert watch.decided is not None
        assert facts.moved > 0
        late.append(facts.moved - watch.decided)
        if late[-1] < 0.1:
            break
    assert min(late) < 0.1


@needs_controller
def test_on_an_alarm_the_object_is_set_down(tmp_path):
    watch = PoseWatch(monitor(), tracked(lambda t: LIFT[0]), replace(PATIENT, on_alarm="set-down"))
    facts, error = go(watch, tmp_path / "recording.csv")
    assert "alarm at 0." in str(error)
    np.testing.assert_allclose(facts.joints, START, atol=1e-3)
    progress = np.array(facts.set_points)[:, 0]
    top = int(progress.argmax())
    assert progress[top] < LEG.joints[-10, 0]
    assert np.all(np.diff(progress[top:]) <= 1e-12)
    rows = (tmp_path / "recording.csv").read_text().splitlines()
    assert rows[-1].split(",")[2] == "set-down"


def throwing(t: float) -> np.ndarray:
    if t > 0.1:
        raise ValueError("camera\nunplugged")
    return LIFT[0]


def silent(clock: ActionClock) -> Iterator[tuple[float, np.ndarray]]:
    while not clock.action_time(time.monotonic()):
        yield time.monotonic(), LIFT[0]
        time.sleep(0.02)
    threading.Event().wait()


def backwards(clock: ActionClock) -> Iterator[tuple[float, np.ndarray]]:
    yield time.monotonic(), LIFT[0]
    time.sleep(0.1)
    now = time.monotonic()
    yield from ((now, LIFT[0]), (now - 0.01, LIFT[0]))


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (silent, r"the tracker has given no pose for 0\.\d+ s"),
        (tracked(lambda t: None if t > 0.05 else LIFT[0]), r"the tracker has given no pose for 0\.\d+ s"),
        (tracked(lambda t: LIFT[0] * (np.nan if t > 0.1 else 1)), "bad input, the pose at .* is not finite"),
        (tracked(lambda t: LIFT[0] + [0.5, 0, 0, 0, 0, 0, 0]), "the first pose lies 5[0-9.]+ cm from"),
        (tracked(lambda t: LIFT[0][: 3 if t > 0.1 else 7]), "ends the motion|could not be broadcast"),
        (tracked(throwing), r"the source of poses failed: ValueError: 'camera\\nunplugged'"),
        (replay(recorded(20)), "the source of poses has ended"),
        (backwards, r"the times of poses must rise: one comes 0\.010 s before the last"),
    ],
)
def test_a_tracker_that_fails_is_a_reason_to_stop(source, said):
    with PoseWatch(monitor(), source, AlarmConfig("set-down", silence=0.3)) as watch:
        alarm = ""
        for _ in range(NUM):  # the motion's loop
            if alarm := watch.alarm():
                break
            watch.clock.tick()
            time.sleep(CONTROL_PERIOD)
        assert watch.answer(LEG, 50) is None
    with pytest.raises(RobotError, match=said):
        raise RobotError(alarm or "the arm would have gone on")
    assert "\n" not in alarm


@pytest.mark.parametrize(
    ("samples", "said"),
    [
        ([], "the source of poses has ended: nothing was moved"),
        ([(0.0, LIFT[0])], r"is [0-9.]+ s old: give the time\.monotonic\(\)"),
        ([(1e12, LIFT[0])], r"is -[0-9.]+ s old"),
        ([(float("nan"), LIFT[0])], "is nan s old"),
        ([LIFT[0]], "the source of poses failed: ValueError"),
    ],
)
def test_without_a_pose_nothing_moves(samples, said):
    with pytest.raises(RobotError, match=said), PoseWatch(monitor(), lambda clock: samples):
        pytest.fail("the arm would have moved")


def test_a_tracker_that_never_begins_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(module, "PATIENCE", 0.2)
    lost = PoseWatch(monitor(), tracked(lambda t: None))
    with pytest.raises(RobotError, match=r"no pose came within 0\.2 s: nothing was moved; look"), lost:
        pytest.fail("the arm would have moved")


def test_an_alarm_brakes_along_the_path():
    watch = PoseWatch(monitor(), silent)
    for step, t in enumerate(TIMES):
        watch._judge(float(t), LIFT[0] + np.array([1e-4 * (step % 2), 0, 0, 0, 0, 0, 0]))
    assert watch.answer(LEG, 50) is None
    for config, end in (
        (AlarmConfig("hold", hold_for=1.0), 49 + (BRAKE - 1) / 2),
        (AlarmConfig("set-down"), 0),
    ):
        watch.config = config
        leg = watch.answer(LEG, 50)
        assert leg is not None
        place = (leg.joints[:, 0] - START[0]) / 0.15 * (NUM - 1)
        assert place[-1] == pytest.approx(end)
        steps = np.diff(np.concatenate([[48, 49], place[:50]]))
        assert np.abs(np.diff(steps)).max() < 1 / BRAKE + 1e-9
        assert place[-1] == place[-20]
        if leg.name == "hold":
            assert len(leg.joints) == BRAKE + round(1.0 / CONTROL_PERIOD)


def test_the_action_waits_with_the_arm(monkeypatch):
    clock, now = ActionClock(0.5), [10.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    assert clock.action_time(10.0) is None
    for now[0] in (10.0, 10.008, 10.108):
        clock.tick()
    step = 0.5 * CONTROL_PERIOD
    assert [clock.action_time(at) for at in (9.9, 10.0, 10.004, 10.058, 99.0)] == [
        None,
        *(pytest.approx(step * count) for count in (0, 0.5, 1.5, 2)),
    ]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: AlarmConfig(silence=60.0), r"alarm: silence = 60.0 is outside 0\.1 to 5"),
        (lambda: AlarmConfig(hold_for=np.nan), "alarm: hold_for = nan is outside"),
        (lambda: PoseWatch(monitor(), silent, speed=2.0), r"watch: speed = 2.0 is outside 0\.01 to 1"),
        (lambda: replay(recorded(0)), "the recording has 0 samples: choose one that did not fail"),
    ],
)
def test_wrong_arguments_are_told_in_one_line(make, said):
    with pytest.raises(RobotError, match=said):
        make()


@pytest.fixture
def plan_file(tmp_path) -> Path:
    prism = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
    place = np.eye(4)
    place[:2, 3] = 0.02, 0.01
    quick = ft.PlanConfig(refine=0, check=0)
    return ft.plan(prism, ft.goals.Lift(), config=quick, T_table_object=place).save(tmp_path / "plan.json")


def test_the_command_watches_a_replayed_recording(plan_file, base_file, tmp_path, capsys, monkeypatch):
    tool = ft.SimulationConfig(embodiment="tool")
    ft.collect(ft.CollectConfig(1, 1, simulation=tool), tmp_path / "data", workers=1)
    given, base = [], json.loads(base_file.read_text())
    base["T_table_base"] = [-0.75, 0, 0, 1, 0, 0, 0]
    base_file.write_text(json.dumps(base))
    monkeypatch.setattr("foretrace.cli.robot.move", lambda *_, pose_watch, **more: given.append(pose_watch))
    common = [
        "robot",
        str(plan_file),
        "--base",
        str(base_file),
        "--out",
        str(tmp_path / "out"),
        "--speed",
        "0.5",
    ]
    common += ["--speed", "1"]
    move = [*common, "--execute", "--host", "arm", "--yes"]
    data = str(tmp_path / "data")
    watched = ["--monitor", "--poses", data, "0", "--on-alarm", "hold", "--silence", "0.3"]
    assert cli.main([*move, *watched]) == 0
    assert isinstance(given[0], PoseWatch)
    assert given[0].config == AlarmConfig("hold", silence=0.3)
    assert given[0].speed == 1.0
    capsys.readouterr()
    for options, said in (
        (["--monitor", "--contact", "0", "0"], "--monitor needs --poses DATA ID"),
        (["--poses", data, "0"], "--poses needs --monitor"),
        (["--monitor", "--poses", data, "7"], "has no interaction 7"),
        (["--monitor", "--poses", "nowhere", "0"], "nowhere"),
        (["--monitor", "--poses", data, "0", "--false-alarms", "0.9"], "false_alarms is 0.9"),
        (["--monitor", "--poses", data, "0", "--on-alarm", "wait"], "--on-alarm"),
        (["--monitor", "--poses", data, "0", "--hold-for", "0"], "hold_for = 0.0 is outside"),
    ):
        assert cli.main([*common, *options]) == 2, options
        told = capsys.readouterr().err.strip().splitlines()
        assert len(told) == 1, told
        assert said in told[0]
    assert cli.main(command(base_file, tmp_path, "--monitor")) == 2
    assert "--monitor needs a plan.json" in capsys.readouterr().err


def test_a_plan_imagined_anew_tells_a_stuck_object_sooner(plan_file):
    """The file keeps futures; the motions of a belief's worlds are narrower."""
    plan, rng = ft.Plan.open(plan_file), np.random.default_rng(0)
    view = ft.TopDownView.of(plan.object, plan.action)
    start = ft.load_predictor().imagine(view, plan.action).pose_trajectory[0]
    alarms = []
    for watched in (plan, plan.imagined_by(ft.load_predictor(), ft.Belief())):
        monitor = ft.Monitor(watched)
        assert (watched.imagined.worlds is None) == (watched is plan)
        poses = (
            (t, np.array([*(start[:3] + rng.normal(0, 3e-4, 3)), *start[3:]])) for t in plan.imagined.times
        )
        alarms.append(next(t for t, pose in poses if monitor.update(t, pose).alarm))
    assert alarms[1] < alarms[0] - 0.3


@needs_controller
def test_a_plan_is_carried_out_by_the_command_over_a_controller(plan_file, base_file, tmp_path, capsys):
    """From plan.json to the arm's joints, through the command, sockets and the controller: nothing is replaced."""
    pytest.importorskip("rtde_control", reason="needs ur_rtde: pip install 'foretrace[ur]'")
    base = json.loads(base_file.read_text())
    base["T_table_base"] = [-0.75, 0, 0, 1, 0, 0, 0]
    base_file.write_text(json.dumps(base))
    common = ["robot", str(plan_file), "--base", str(base_file), "--speed", "1", "--no-retreat"]
    assert cli.main([*common, "--out", str(tmp_path / "dry")]) == 0
    with (tmp_path / "dry" / "path.csv").open(newline="") as file:
        planned = list(csv.DictReader(file))
    names = [name for name in planned[0] if name.endswith("_rad")][:6]
    joints = np.array([[float(row[name]) for name in names] for row in planned])
    start = joints[0] + np.array([0, 0, 0.004, 0, 0, 0])
    out = tmp_path / "executed"
    with RunningController(start) as controller:
        move = ["--execute", "--host", controller.host, "--yes", "--timeout", "1.5"]
        assert cli.main([*common, "--out", str(out), *move]) == 0
    assert capsys.readouterr().out.strip().endswith(str(out / "recording.csv"))
    np.testing.assert_allclose(controller.facts.joints, joints[-1], atol=1e-4)
    with (out / "recording.csv").open(newline="") as file:
        legs = {row["leg"] for row in csv.DictReader(file)}
    assert {"approach", "descent", "lever-up"} <= legs
