"""Move the arm along checked legs, watch it while it moves, and write down what it did."""

import csv
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from foretrace.errors import RobotError, check_ranges
from foretrace.robot.checks import ArmLimits, Check, check_path, check_start, refuse_unsafe
from foretrace.robot.controller import ArmState, UrController
from foretrace.robot.kinematics import ArmKinematics
from foretrace.robot.path import LEVER_UP, ArmPath, plan_approach
from foretrace.robot.video import VideoRecorder
from foretrace.simulation.arm import CONTROL_PERIOD, JOINT_NAMES

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

    def __post_init__(self) -> None:
        check_ranges(RobotError, "watch", self, {"timeout": (0.05, 2.0), "deviation": (0.001, 0.5)})


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
) -> None:
    """Bring the arm to the start of the first leg, and move it along all of them.

    Whatever ends the motion early, Ctrl-C too, the arm is stopped and the recording keeps what was done.

    Args:
        host: Name or address of the controller.
        legs: Checked legs, each starting where the one before ends.
        kinematics: The arm with its screwdriver.
        T_table_base: The arm's base in the table frame.
        out: CSV file to record to; must not be there.
        limits: Limits of the way to the start.
        watch: When to give up.
        confirm: Whether the arm may move, from the checks of its way to the start.
        video: Recorder that films the motion.

    Raises:
        RobotError: If the arm is not ready, its way to the start is not safe, or the motion was stopped.
    """
    controller = UrController(host, watch.timeout)
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
        with MotionLog(out) as log, video or nullcontext():
            _move(controller, [approach, *legs], log, watch, video)
    finally:
        controller.close()


def refuse_unready(state: ArmState, host: str) -> None:
    """Refuse an arm that cannot follow set points now.

    Raises:
        RobotError: saying why, and what to do at the pendant.
    """
    if state.fault:
        raise RobotError(f"{host} is in {state.fault}: release it at the pendant first")
    if state.playing:
        raise RobotError(f"{host} runs a program: stop it at the pendant first")
    if state.speed_scaling < FULL_SPEED:
        raise RobotError(
            f"the controller scales speeds to {100 * state.speed_scaling:.0f} %: set the slider to 100 %, "
            "and go slower with the speed given here"
        )


def _move(
    controller: UrController,
    legs: Sequence[ArmPath],
    log: MotionLog,
    watch: WatchConfig,
    video: VideoRecorder | None,
) -> None:
    """Give one set point each control period; none is ever left out, so a delay here only makes the arm wait."""
    recent: deque[np.ndarray] = deque(maxlen=round(LAG / CONTROL_PERIOD))
    recent.append(legs[0].joints[0])
    hold = ArmPath("hold", np.repeat(legs[-1].joints[-1:], round(SETTLE / CONTROL_PERIOD), axis=0))
    stopped_at = None
    try:
        controller.take_control()
        for leg in [*legs, hold]:
            if video is not None and leg.name == LEVER_UP:
                video.action_start = time.monotonic()
            for sample, set_point in enumerate(leg.joints):
                state = controller.state()
                log.add(leg.name, state, recent[-1])
                reason = _reason_to_stop(controller, state, recent, watch)
                if not reason and not controller.send(set_point):
                    reason = "connection lost"
                if reason:
                    stopped_at = f"{reason}, {leg.name}, sample {sample} of {len(leg.joints)}"
                    break
                recent.append(set_point)
            if stopped_at:  # no leg follows a stop: the way back might be as unsafe as the way on
                break
    finally:
        outcome = controller.stop()
    if stopped_at:
        raise RobotError(f"motion given up: {stopped_at}; {outcome}; the recording is kept")


def _reason_to_stop(
    controller: UrController, state: ArmState, recent: Sequence[np.ndarray], watch: WatchConfig
) -> str | None:
    """Why the motion cannot go on, in words."""
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
    if nearest[joint] > watch.deviation:
        return f"joint {JOINT_NAMES[joint]} is {nearest[joint]:.3f} rad from its path (allowed: {watch.deviation})"
    return None
