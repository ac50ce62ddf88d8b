"""The command that has a real arm execute a lever-up."""

import csv
import io
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from foretrace.actions import LeverUp, Screwdriver, ToolPath
from foretrace.cli.console import say
from foretrace.errors import RobotError
from foretrace.files import write_json, write_text
from foretrace.geometry import matrix_to_pose
from foretrace.imagined import Belief
from foretrace.interactions.dataset import Dataset
from foretrace.monitoring import Monitor
from foretrace.planning import Plan
from foretrace.robot.checks import ArmLimits, Check, check_path, refuse_unsafe
from foretrace.robot.dashboard import check_host
from foretrace.robot.deviation import OTHER_ARM
from foretrace.robot.execution import WatchConfig
from foretrace.robot.execution import execute as move
from foretrace.robot.kinematics import ArmKinematics
from foretrace.robot.path import ArmPath, plan_lever_up, plan_retreat, read_base_pose
from foretrace.robot.pose_watch import AlarmConfig, PoseWatch, replay
from foretrace.robot.video import VideoRecorder
from foretrace.simulation.arm import CONTROL_PERIOD, JOINT_NAMES


def robot(
    base: Path,
    path: Annotated[OmitArgPrefixes[ToolPath], arg(name="path")],
    watch: Annotated[OmitArgPrefixes[WatchConfig], arg(name="watch")],
    alarm: Annotated[OmitArgPrefixes[AlarmConfig], arg(name="alarm")],
    plan: Positional[Path | None] = None,
    contact: tuple[float, float] | None = None,
    direction: tuple[float, float] | None = None,
    out: Path = Path("execution"),
    speed: float = 0.1,
    retreat: bool = True,
    execute: bool = False,
    host: str | None = None,
    yes: bool = False,
    camera: str | None = None,
    correction: tuple[float, float, float] = (0.0, 0.0, 0.0),
    is_ur10: bool = False,
    monitor: bool = False,
    poses: tuple[Path, int] | None = None,
    false_alarms: float = 0.05,
) -> None:
    """Plan and check a lever-up for a real UR10 (CB3); with --execute, move the arm (experimental).

    NEVER TRIED ON A REAL ARM: it has moved a simulated controller only. Keep the emergency stop in hand.

    Without --execute this is a dry run: no connection is opened. Links are checked against the table, not against
    each other, the object or anything else.

    Args:
        base: JSON file with the calibrated pose of the arm's base in the table frame.
        plan: plan.json of `foretrace plan`, in place of contact, direction and path.
        contact: Where the blade meets the object, X Y in the table frame [m].
        direction: Along which the blade is pushed, X Y in the table frame; its length does not matter.
        out: Folder for path.csv, checks.json, recording.csv and film.
        speed: Share of the tool path's own speed, at most 1.
        path: Path of the blade.
        watch: When the motion is given up.
        retreat: Whether the arm then sets the object down the way it lifted it, pulls the blade out, and goes up by
            10 cm. Otherwise the arm stays at the path's end, with the object on the blade.
        execute: Move the arm.
        host: Name or address of the controller; needed with --execute.
        yes: Do not ask before the arm moves.
        camera: Film the motion into the folder's film: number of a camera, or what else OpenCV opens.
        correction: Deviation of the blade's tip by the arm's own calibration, X Y Z in the table frame [m], as the
            command gives it before the blade goes down.
        is_ur10: The arm is a UR10 (CB3); for a controller before PolyScope 3.12, which cannot say so.
        monitor: Compare the object's poses with what the plan imagined while the arm levers it up, and act on an alarm.
        poses: Folder of a data set and number of an interaction, whose poses are replayed as if they were tracked now:
            a rehearsal. A tracker of one's own is connected in Python.
        false_alarms: Share of whole normal executions that may alarm.
        alarm: What an alarm does.
    """
    if execute and host is None:
        raise RobotError("--execute needs --host, the controller's address")
    recording = out / "recording.csv"
    if execute and recording.exists():
        raise RobotError(f"{recording} is there already: choose another folder")
    if host is not None:
        check_host(host)
    if not all(abs(value) <= OTHER_ARM for value in correction):
        raise RobotError(
            f"--correction {' '.join(map(str, correction))}: give metres, at most {OTHER_ARM:g}, as this command does"
        )
    limits, kinematics = ArmLimits(), ArmKinematics(Screwdriver())
    T_table_base = read_base_pose(base)
    T_table_base[:3, 3] += correction
    pose_watch = _pose_watch(plan, poses, alarm, false_alarms, speed) if monitor else None
    if poses is not None and not monitor:
        raise RobotError("--poses needs --monitor, which watches them")
    action = _action(plan, contact, direction, path)
    legs = plan_lever_up(kinematics, action, T_table_base, speed)
    legs += plan_retreat(legs) if retreat else []
    postures = [kinematics.along(leg.joints) for leg in legs]
    checks = [
        check
        for leg, along in zip(legs, postures, strict=True)
        for check in check_path(leg, along, T_table_base, limits)
    ]
    _print_checks(checks)
    out.mkdir(parents=True, exist_ok=True)
    tips = [[T_table_base @ posture.T_base_tip for posture in along] for along in postures]
    _write(out, legs, tips, checks)
    refuse_unsafe(checks)
    if not execute or host is None:
        print("dry run: nothing was moved and no connection opened; --execute moves the arm")
        return

    def confirm(approach: list[Check]) -> bool:
        _print_checks(approach)
        return yes or _agreed(host, sum(len(leg.joints) for leg in legs))

    say("this has never moved a real arm: keep the emergency stop in hand; Ctrl-C stops the arm, too")
    try:
        video = None if camera is None else VideoRecorder(camera, out / "film")
        move(
            *(host, legs, kinematics, T_table_base, recording, limits, watch, confirm, video),
            correction=correction,
            is_ur10=is_ur10,
            pose_watch=pose_watch,
        )
    except KeyboardInterrupt as interrupt:
        stop = (
            f"{interrupt.args[1]}, {recording} has what was done" if interrupt.args[1:] else "nothing moved"
        )
        say(f"interrupted; {stop}")
        raise
    if pose_watch is not None and (verdict := pose_watch.verdict) is not None:
        print(f"no alarm: score {verdict.score:.2f} of {verdict.threshold:.2f}; {verdict.message}")
    print(recording)


def _pose_watch(
    plan: Path | None, poses: tuple[Path, int] | None, alarm: AlarmConfig, false_alarms: float, speed: float
) -> PoseWatch:
    """The monitor of a plan, with replayed poses.

    Raises:
        RobotError: There is no plan, or no poses.
        PlanningError: The plan cannot be read.
        DatasetError: There is no such interaction.
        PredictionError: The plan's action is not the predictor's.
        MonitoringError: The share is out of range.
    """
    if plan is None:
        raise RobotError("--monitor needs a plan.json of `foretrace plan`, which says what was imagined")
    if poses is None:
        raise RobotError("--monitor needs --poses DATA ID, a recording of the action to rehearse with")
    folder, id = poses
    source = replay(Dataset.open(folder).with_id(id).effect)
    from foretrace.predictor import load_imaginer  # not needed to move

    watched = Plan.open(plan).imagined_by(load_imaginer(), Belief())
    return PoseWatch(Monitor(watched, false_alarms), source, alarm, speed, say)


def _action(
    plan: Path | None,
    contact: tuple[float, float] | None,
    direction: tuple[float, float] | None,
    path: ToolPath,
) -> LeverUp:
    """The lever-up in the table frame.

    Raises:
        RobotError: It is given twice, or not at all.
        PlanningError: The plan cannot be read, or does not know where the object lies.
    """
    if plan is not None:
        if contact is not None or direction is not None or path != ToolPath():
            raise RobotError(f"{plan} says where and how: leave out --contact, --direction and the path")
        found = Plan.open(plan).table_action
        if not isinstance(found, LeverUp):
            raise RobotError(
                f"{plan} plans a {found.label}: the arm moves a blade, give a plan of a lever-up"
            )
        return found
    if contact is None or direction is None:
        raise RobotError("give a plan.json of `foretrace plan`, or --contact X Y and --direction X Y")
    return LeverUp(contact, direction, path)


def _agreed(host: str, num_set_points: int) -> bool:
    """Whether the user agrees at the terminal."""
    seconds = num_set_points * CONTROL_PERIOD
    try:
        answer = input(f"Move the arm at {host} for {seconds:.0f} s and its way to the start? Type yes: ")
    except EOFError:
        raise RobotError("no terminal to confirm in: run it in a terminal, or give --yes") from None
    return answer.strip() == "yes"


def _print_checks(checks: list[Check]) -> None:
    """One line for each leg that passes all its checks, and a table of what is refused of the others."""
    for leg, members in groupby(checks, key=lambda check: check.leg):
        members = list(members)
        refused = [check for check in members if not check.passed]
        print(f"{leg}: {len(members) - len(refused)} of {len(members)} checks passed")
        if not refused:
            continue
        table = Table(box=None, padding=(0, 1))
        for heading in ("check", "joint", "at [s]", "worst", "limit", ""):
            table.add_column(heading, justify="right" if heading in ("at [s]", "worst") else "left")
        for check in refused:
            table.add_row(
                check.name,
                check.joint or "",
                f"{check.time:.2f}",
                f"{check.value:.4f}",
                f"{'>=' if check.at_least else '<='} {check.limit:.4g} {check.unit}",
                "[bold]REFUSED[/bold]",
            )
        Console().print(table)


def _write(out: Path, legs: list[ArmPath], tips: list[list[np.ndarray]], checks: list[Check]) -> None:
    """The planned path, with the blade tip in the table frame, and its checks."""
    rows, start = [], 0.0
    for leg, along in zip(legs, tips, strict=True):
        for time, joints, tip in zip(leg.times, leg.joints, along, strict=True):
            numbers = (f"{value:.6f}" for value in (start + time, *joints, *matrix_to_pose(tip)))
            first, *others = numbers
            rows.append([first, leg.name, *others])
        start += leg.times[-1]
    tip_columns = [f"tip_{name}" for name in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")]
    columns = ["time_s", "leg", *(f"{name}_rad" for name in JOINT_NAMES), *tip_columns]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    write_text(out / "path.csv", text.getvalue())
    report = [{**asdict(check), "passed": check.passed} for check in checks]
    write_json(out / "checks.json", report)
    print(out / "path.csv")
    print(out / "checks.json")
