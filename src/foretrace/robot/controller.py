"""The controller of a UR arm (CB3), through ur_rtde (`foretrace[ur]`).

What ur_rtde does on its own decides how it is used here. When the connection breaks it connects again by itself, and
with its default flags uploads its program again: so the program is uploaded once, by hand, and never comes back after a
stop. It reports commands as sent on a connection that is gone: so the age of the arm's data decides, not its return
values. It cannot be interrupted while it connects, and its destructors may wait forever: so ports are tried first, and
its objects are never destroyed.
"""

# pyright: reportMissingImports=false, reportMissingModuleSource=false
# ur_rtde is an extra, compiled and without type stubs.

import contextlib
import ctypes
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from foretrace.errors import RobotError
from foretrace.geometry import invert_transform, rigid_transform
from foretrace.robot.dashboard import DASHBOARD_PORT, check_host, dashboard, refuse_other_model
from foretrace.simulation.arm import CONTROL_PERIOD

RTDE_PORT, SCRIPT_PORT = 30004, 30003
PATIENCE = 2.0
"""How long an answer may take where the arm does not wait for it [s]."""
STOP_PATIENCE = 0.5
"""How long an answer may take while the arm is being stopped [s]."""
STOP_DECELERATION = 2.0
"""Deceleration of the tool when the arm is stopped [m/s^2]."""
LOOKAHEAD, GAIN = 0.1, 300.0
"""Smoothing of the set points [s], and stiffness, of URScript's servoj: its defaults."""
MOST_MESSAGES = 1000
"""Largest number of other messages before the one that is waited for."""
VARIABLES = [
    "timestamp",
    "actual_q",
    "actual_TCP_pose",
    "robot_mode",
    "safety_mode",
    "runtime_state",
    "safety_status_bits",
    "speed_scaling",
    "target_speed_fraction",
]
RUNNING, NORMAL, PLAYING = 7, 1, 2
"""Robot mode, safety mode and program state in which the arm moves."""
SAFETY_MODES = dict(
    enumerate(
        [
            "normal",
            "reduced",
            "protective stop",
            "recovery",
            "safeguard stop",
            "system emergency stop",
            "robot emergency stop",
            "violation",
            "fault",
        ],
        start=1,
    )
)
ROBOT_MODES = dict(
    enumerate(
        [
            "no controller",
            "disconnected",
            "confirm safety",
            "booting",
            "power off",
            "power on",
            "idle",
            "backdrive",
            "running",
            "updating firmware",
        ],
        start=-1,
    )
)


@dataclass(frozen=True)
class ArmState:
    """State of the arm that the controller last sent."""

    timestamp: float
    """Time since the controller was started [s]."""
    joints: Float[np.ndarray, "6"]
    """Joint angles [rad]."""
    tool_pose: Float[np.ndarray, "6"]
    """Tool centre point as set in the controller, in the base frame: position [m], rotation vector [rad]."""
    robot_mode: int
    safety_mode: int
    protective_stop: bool
    emergency_stop: bool
    playing: bool
    """Whether a program runs."""
    speed_scaling: float
    """Share of the programmed speed that the controller allows."""

    @property
    def fault(self) -> str | None:
        """Why the arm must not move, in words."""
        if self.emergency_stop:
            return "emergency stop"
        if self.protective_stop:
            return "protective stop"
        if self.safety_mode != NORMAL:
            return f"safety mode {self.safety_mode} ({SAFETY_MODES.get(self.safety_mode, 'unknown')})"
        if self.robot_mode != RUNNING:
            return f"robot mode {self.robot_mode} ({ROBOT_MODES.get(self.robot_mode, 'unknown')})"
        return None


class UrController:
    """A connection that listens to the arm from the start, and moves it only after `take_control`.

    Args:
        host: Name or address of the controller.
        timeout: Longest silence [s], from the controller towards us and from us towards the controller.
        is_ur10: Whether the arm is known to be a UR10 (CB3), where its controller is too old to name its model.

    Raises:
        RobotError: If ur_rtde is not installed, the controller does not answer, or its arm is no UR10 (CB3).
    """

    def __init__(self, host: str, timeout: float, is_ur10: bool = False) -> None:
        check_host(host)
        try:
            from rtde_receive import RTDEReceiveInterface
        except ImportError as error:
            raise RobotError("ur_rtde is not installed: run pip install 'foretrace[ur]'") from error
        self.host, self.timeout = host, timeout
        _greet(host)
        refuse_other_model(host, is_ur10)
        self._receive = _connect(host, lambda: RTDEReceiveInterface(host, 1 / CONTROL_PERIOD, VARIABLES))
        self._control: Any = None
        self._T_flange_tool: np.ndarray | None = None
        self._heard, self._timestamp = time.monotonic(), -np.inf

    def state(self) -> ArmState:
        """State that the controller last sent."""
        receive = self._receive
        return ArmState(
            timestamp=receive.getTimestamp(),
            joints=np.array(receive.getActualQ()),
            tool_pose=np.array(receive.getActualTCPPose()),
            robot_mode=receive.getRobotMode(),
            safety_mode=receive.getSafetyMode(),
            protective_stop=receive.isProtectiveStopped(),
            emergency_stop=receive.isEmergencyStopped(),
            playing=receive.getRuntimeState() == PLAYING,
            speed_scaling=receive.getSpeedScaling() * receive.getTargetSpeedFraction(),
        )

    def silence(self, state: ArmState) -> float:
        """Time without anything new from the controller up to a state just read [s]; infinite if it hung up."""
        now = time.monotonic()
        if state.timestamp != self._timestamp:
            self._heard, self._timestamp = now, state.timestamp
        return now - self._heard if self._receive.isConnected() else np.inf

    def take_control(self) -> None:
        """Start the program that moves the arm, and the controller's own watchdog; nothing moves yet.

        Raises:
            RobotError: If the program does not start.
        """
        from rtde_control import RTDEControlInterface

        flags = RTDEControlInterface.FLAG_NO_WAIT  # and not FLAG_UPLOAD_SCRIPT
        self._control = _connect(
            self.host, lambda: RTDEControlInterface(self.host, 1 / CONTROL_PERIOD, flags)
        )
        self._control.reuploadScript()
        patience = time.monotonic() + PATIENCE
        # Each connection hears of it at its own time.
        while not (self.state().playing and self._control.isProgramRunning()):
            if time.monotonic() > patience:
                raise RobotError(
                    f"{self.host} did not start the control program within {PATIENCE:g} s: "
                    "look at the pendant's log, and whether a fieldbus holds the RTDE registers"
                )
            time.sleep(CONTROL_PERIOD)
        if not self._control.setWatchdog(1 / self.timeout):
            raise RobotError(
                f"{self.host} did not take the watchdog of {self.timeout:g} s: the arm was not moved"
            )
        offset = _within(PATIENCE, self._control.getTCPOffset)
        if offset is None or len(offset) != 6 or not np.isfinite(offset).all():
            raise RobotError(
                f"{self.host} does not tell the tool centre point that is set in it: the arm was not moved; look at "
                "the pendant's log"
            )
        self._T_flange_tool = _transform(np.array(offset))

    def flange(self, state: ArmState) -> Float[np.ndarray, "4 4"]:
        """Flange in the base frame by the controller's own, calibrated kinematics; control must have been taken."""
        assert self._T_flange_tool is not None
        return _transform(state.tool_pose) @ invert_transform(self._T_flange_tool)

    def send(self, joints: Float[np.ndarray, "6"]) -> bool:
        """Give the next set point [rad], and wait until the one after it is due; False if the connection broke."""
        start = self._control.initPeriod()
        try:
            self._control.servoJ(joints.tolist(), 0.0, 0.0, CONTROL_PERIOD, LOOKAHEAD, GAIN)
        except RuntimeError:  # it broke in the middle, and ur_rtde could not connect again
            return False
        self._control.waitPeriod(start)
        return True

    def stop(self) -> str:
        """Stop arm and program by every way that is left; returns which one answered, in words."""
        state = self.state()
        heard = self.silence(state) < self.timeout
        if self._control is None or (heard and not state.playing):
            return "the control program does not run"
        if heard and _within(STOP_PATIENCE, self._stop_program):
            return "stopped"
        if self._stop_by_dashboard():
            return "stopped by the dashboard"
        return f"no stop could be sent; the controller's own watchdog stops the arm after {self.timeout:g} s"

    def close(self) -> None:
        """Hang up. The arm is stopped before."""
        ends = [each.disconnect for each in (self._control, self._receive) if each is not None]
        threads = [threading.Thread(target=end, daemon=True) for end in ends]
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + PATIENCE / 2
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _stop_program(self) -> bool:
        stopped = self._control.servoStop(STOP_DECELERATION)
        self._control.stopScript()
        return stopped

    def _stop_by_dashboard(self) -> bool:
        """Ask the dashboard server, over a connection of its own."""
        with contextlib.suppress(OSError), dashboard(self.host, STOP_PATIENCE) as ask:
            return ask("stop").startswith("Stopped")
        return False


def _greet(host: str) -> None:
    """See that all ports answer as a controller's would: ur_rtde would wait for one without end.

    Raises:
        RobotError: naming the port that does not.
    """
    port = RTDE_PORT
    try:
        with socket.create_connection((host, port), PATIENCE) as rtde, rtde.makefile("rb") as stream:
            rtde.settimeout(PATIENCE)
            _hear_once(rtde, stream)
        port = DASHBOARD_PORT
        with dashboard(host, PATIENCE):
            pass
        port = SCRIPT_PORT
        socket.create_connection((host, port), PATIENCE).close()
    except OSError as error:
        raise RobotError(
            f"no UR controller answers at {host}, port {port} ({error}): check address, cable and that the arm is on"
        ) from error


def _hear_once(rtde: socket.socket, stream: BinaryIO) -> None:
    """Ask for the arm's data as ur_rtde will, and wait for the first of them.

    Raises:
        OSError: If they do not come.
    """

    def ask(kind: bytes, content: bytes) -> bytes:
        rtde.sendall(struct.pack(">Hc", 3 + len(content), kind) + content)
        return hear(kind)

    def hear(wanted: bytes) -> bytes:
        for _ in range(MOST_MESSAGES):  # texts for the log come between
            start = stream.read(3)
            size, kind = struct.unpack(">Hc", start) if len(start) == 3 else (0, b"")
            content = stream.read(max(size - 3, 0))
            if size < 3 or len(content) != size - 3:
                raise OSError("it hung up")
            if kind == wanted:
                return content
        raise OSError("it does not speak RTDE version 2")

    if ask(b"V", struct.pack(">H", 2)) != b"\1":
        raise OSError("it does not speak RTDE version 2")
    wanted = struct.pack(">d", 1 / CONTROL_PERIOD) + ",".join(VARIABLES).encode()
    types = ask(b"O", wanted)[1:].decode(errors="replace")
    if missing := [
        name for name, kind in zip(VARIABLES, types.split(","), strict=False) if kind == "NOT_FOUND"
    ]:
        raise OSError(f"it does not tell {missing[0]}")
    if ask(b"S", b"") != b"\1":
        raise OSError("it sends no data")
    hear(b"U")


def _connect(host: str, make: Callable[[], Any]) -> Any:
    """An object of ur_rtde, kept until the process ends: its destructor waits with Python's lock held.

    Raises:
        RobotError: If it cannot connect.
    """
    try:
        interface = make()
    except RuntimeError as error:
        raise RobotError(
            f"{host} does not take the connection ({error}): look at the pendant's log"
        ) from error
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(interface))
    return interface


def _within(seconds: float, action: Callable[[], Any]) -> Any:
    """What an action that may hang returns within a time [s]; None if it fails, or goes on in the background."""
    answers: list[Any] = []
    done = threading.Event()

    def act() -> None:
        with contextlib.suppress(RuntimeError):
            answers.append(action())
            done.set()

    threading.Thread(target=act, daemon=True).start()
    return answers[0] if done.wait(seconds) else None


def _transform(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """A pose as the controller writes it: position [m], rotation vector [rad]."""
    return rigid_transform(Rotation.from_rotvec(pose[3:]).as_matrix(), pose[:3])
