"""Move the arm along checked legs, watch it while it moves, and write down what it did."""

import csv
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from foretrace.errors import RobotError, check_ranges
from foretrace.robot.checks import ArmLimits, Check, check_path, check_start, refuse_unsafe
from foretrace.robot.controller import ArmState, UrController
from foretrace.robot.deviation import Deviation, measure_deviation, refuse_other_arm, refuse_uncorrected
from foretrace.robot.kinematics import ArmKinematics
from foretrace.robot.path import LEVER_UP, ArmPath, plan_approach
from foretrace.robot.pose_watch import PoseWatch
from foretrace.robot.video import VideoRecorder
from foretrace.simulation.arm import CONTROL_PERIOD, JOINT_LIMIT, JOINT_NAMES

LAG = 0.3
"""Time over which set points are compared with the arm, which follows them with a delay [s]."""
SETTLE = 0.3
"""How long the last set point is held [s]."""
STILL = 0.005
"""Largest turn of a joint between check and motion [rad]."""
FULL_SPEED = 0.99
"""Least speed scaling of the controller; below, the arm would fall behind its set points."""


@dataclass(frozen=True)
class WatchConfig:
    """When a motion is given up.

    Raises:
        RobotError: If a value is out of range.
    """

    timeout: float = 0.2
    """Longest silence of the controller, and of us towards it [s]."""
    deviation: float = 0.05
    """Largest angle between a joint and its set points of the last moments [rad]."""
    height_error: float = 0.0004
    """Largest error of the blade tip's height before it goes down, by the arm's own calibration [m]."""

    def __post_init__(self) -> None:
        limits = {"timeout": (0.05, 2.0), "deviation": (0.001, 0.5), "height_error": (0.0001, 0.005)}
        check_ranges(RobotError, "watch", self, limits)


class MotionLog:
    """A CSV file of the motion, written as it happens.

    Raises:
        RobotError: If the file is there already.
    """

    COLUMNS = (
        "time_s",
        "host_s",
        "leg",
        *(f"{name}_rad" for name in JOINT_NAMES),
        *(f"{name}_commanded_rad" for name in JOINT_NAMES),
        *(f"tcp_{name}" for name in ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")),
        "robot_mode",
        "safety_mode",
    )

    def __init__(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            # Line by line: what is written stays, however the motion ends.
            self._file = file.open("x", encoding="utf-8", newline="", buffering=1)
        except FileExistsError as error:
            raise RobotError(f"{file} is there already: choose another folder") from error
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(self.COLUMNS)

    def __enter__(self) -> "MotionLog":
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()

    def add(self, leg: str, state: ArmState, commanded: Float[np.ndarray, "6"]) -> None:
        """One sample."""
        numbers = [f"{value:.6f}" for value in (*state.joints, *commanded, *state.tool_pose)]
        times = [f"{state.timestamp:.4f}", f"{time.monotonic():.4f}"]
        self._writer.writerow([*times, leg, *numbers, state.robot_mode, state.safety_mode])


def execute(
    host: str,
    legs: Sequence[ArmPath],
    kinematics: ArmKinematics,
    T_table_base: Float[np.ndarray, "4 4"],
    out: Path,
    limits: ArmLimits,
    watch: WatchConfig,
    confirm: Callable[[list[Check]], bool],
    video: VideoRecorder | None = None,
    correction: Sequence[float] = (0.0, 0.0, 0.0),
    is_ur10: bool = False,
    pose_watch: PoseWatch | None = None,
) -> None:
    """Bring the arm to the start of the first leg, and move it along all of them.

    Whatever ends the motion early, Ctrl-C and a closed terminal too, the arm is stopped and the recording keeps what
    was done. No second signal interrupts the stop.

    Args:
        host: Name or address of the controller.
        legs: Checked legs, each starting where the one before ends.
        kinematics: The arm with its screwdriver.
        T_table_base: The arm's base in the table frame that the legs were planned with.
        out: CSV file to record to; must not be there.
        limits: Limits of the way to the start.
        watch: When to give up.
        confirm: Whether the arm may move, from the checks of its way to the start.
        video: Recorder that films the motion.
        correction: The part of ``T_table_base``'s position that corrects for the arm's own calibration [m].
        is_ur10: Whether the arm is known to be a UR10 (CB3), where its controller is too old to say.
        pose_watch: Watches the object during the lever-up; its alarm ends the motion.

    Raises:
        RobotError: If the arm is not ready or no UR10, its way to the start is not safe, or the motion was stopped.
        KeyboardInterrupt: After a signal; its arguments are the signal's number and where and how the arm stopped.
    """
    controller = UrController(host, watch.timeout, is_ur10)
    try:
        state = controller.state()
        refuse_unready(state, host)
        approach = plan_approach(state.joints, legs[0].joints[0])
        start = check_start(approach, limits)
        refuse_unsafe([start])
        checks = [start, *check_path(approach, kinematics.along(approach.joints), T_table_base, limits)]
        refuse_unsafe(checks)
        if not confirm(checks):
            raise RobotError("not confirmed: nothing was moved")
        refuse_unready(controller.state(), host)
        if np.abs(controller.state().joints - state.joints).max() > STILL:
            raise RobotError("the arm was moved since its way to the start was checked: start again")

        def check_kinematics(state: ArmState) -> Deviation:
            found = measure_deviation(kinematics, T_table_base, state.joints, controller.flange(state))
            refuse_other_arm(found, host)
            return found

        def check_tip(state: ArmState) -> None:
            refuse_uncorrected(check_kinematics(state), np.array(correction), watch.height_error)

        checked = [_CheckedLeg(approach, check_kinematics), _CheckedLeg(legs[0], check_tip)]
        with (
            _noted_signals() as signals,
            pose_watch or nullcontext(),
            MotionLog(out) as log,
            video or nullcontext(),
        ):
            all_legs = [*checked, *map(_CheckedLeg, legs[1:])]
            stopped = _move(controller, all_legs, log, watch, video, signals, pose_watch)
        if signals:
            raise KeyboardInterrupt(signals[0], stopped)
    finally:
        controller.close()


@contextmanager
def _noted_signals() -> Iterator[list[int]]:
    """Numbers of the signals that ask to end, as they come: none of them interrupts anything in this block."""
    noted: list[int] = []
    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT"):
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) != signal.SIG_IGN:
                before[number] = signal.signal(number, lambda number, _: noted.append(number))
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def refuse_unready(state: ArmState, host: str) -> None:
    """Refuse an arm that cannot follow set points now.

    Raises:
        RobotError: saying why, and what to do at the pendant.
    """
    if state.fault:
        raise RobotError(f"{host} is in {state.fault}: release it at the pendant first")
    if state.playing:
        raise RobotError(f"{host} runs a program: stop it at the pendant first")
    if not (np.abs(state.joints) <= JOINT_LIMIT + STILL).all():
        raise RobotError(
            f"{host} says that its joints are at {np.round(state.joints, 3).tolist()} rad, where no arm can be: "
            "start it anew"
        )
    if not state.speed_scaling >= FULL_SPEED:
        raise RobotError(
            f"the controller scales speeds to {100 * state.speed_scaling:.0f} %: set the slider to 100 %, "
            "and go slower with the speed given here"
        )


@dataclass(frozen=True)
class _CheckedLeg:
    """A leg, and what must hold of the arm before it."""

    path: ArmPath
    check: Callable[[ArmState], object] = lambda state: None


def _move(
    controller: UrController,
    legs: Sequence[_CheckedLeg],
    log: MotionLog,
    watch: WatchConfig,
    video: VideoRecorder | None,
    signals: Sequence[int],
    pose_watch: PoseWatch | None,
) -> str:
    """Give one set point each control period; none is ever left out, so a delay here only makes the arm wait.

    Returns:
        Where and how the arm was stopped, in words.

    Raises:
        RobotError: If the motion was given up for another reason than a signal.
    """
    recent: deque[np.ndarray] = deque(maxlen=round(LAG / CONTROL_PERIOD))
    recent.append(legs[0].path.joints[0])
    hold = ArmPath("hold", np.repeat(legs[-1].path.joints[-1:], round(SETTLE / CONTROL_PERIOD), axis=0))
    ahead = deque([*legs, _CheckedLeg(hold)])
    reason = alarm = place = ""
    try:
        controller.take_control()
        while ahead and not reason:  # no leg follows a stop: the way back might be as unsafe as the way on
            leg = ahead.popleft()
            path = leg.path
            watched = pose_watch if path.name == LEVER_UP else None
            if video is not None and path.name == LEVER_UP:
                video.action_start = time.monotonic()
            for sample, set_point in enumerate(path.joints):
                place = f"{path.name}, sample {sample} of {len(path.joints)}"
                state = controller.state()
                reason = "interrupted" if signals else _reason_to_stop(controller, state, recent, watch)
                if not reason and watched is not None and (alarm := watched.alarm()):
                    if (answer := watched.answer(path, sample)) is not None:
                        watched.tell(f"{alarm}: {answer.name}")
                        ahead = deque([_CheckedLeg(answer)])
                        break
                    reason = alarm
                if not reason and sample == 0:
                    leg.check(state)
                log.add(path.name, state, recent[-1])
                if watched is not None:
                    watched.clock.tick()
                if not reason and not controller.send(set_point):
                    reason = "connection lost"
                if reason:
                    break
                recent.append(set_point)
    finally:
        outcome = controller.stop()
    if pose_watch is not None:  # the last verdict may come when the next leg has begun
        alarm = alarm or pose_watch.verdict_line()
    reasons = dict.fromkeys(each for each in (alarm, reason) if each)
    if reasons and not signals:
        raise RobotError(f"motion given up: {'; '.join(reasons)}, {place}; {outcome}; the recording is kept")
    return f"{place}; {outcome}"


def _reason_to_stop(
    controller: UrController, state: ArmState, recent: Sequence[np.ndarray], watch: WatchConfig
) -> str:
    """Why the motion cannot go on, in words; empty if it can."""
    silence = controller.silence(state)
    if silence > watch.timeout:
        return "connection lost" if np.isinf(silence) else f"no data from the controller for {silence:.2f} s"
    if state.fault:
        return state.fault
    if not state.playing:
        return "the control program ended"
    off = np.abs(np.array(recent) - state.joints)
    nearest = off[off.max(axis=1).argmin()]
    joint = int(nearest.argmax())
    if not nearest[joint] <= watch.deviation:  # nor what is no number
        return f"joint {JOINT_NAMES[joint]} is {nearest[joint]:.3f} rad from its path (allowed: {watch.deviation})"
    return ""
