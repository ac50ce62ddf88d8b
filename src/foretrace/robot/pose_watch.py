"""Watch the object while the arm levers it up: poses from a tracker go to a monitor, which may end the motion.

Poses come from a `PoseSource`, which runs in a thread of its own: neither a slow tracker nor the monitor delays the
arm. Whatever goes wrong there stops the arm.
"""

import threading
import time
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from foretrace.errors import ForetraceError, RobotError, check_choices, check_ranges, check_type, shown
from foretrace.geometry import Numbers, matrix_to_pose, pose_to_matrix
from foretrace.interactions.record import Effect
from foretrace.monitoring import Monitor, Verdict
from foretrace.monitoring.causes import BAD_INPUT, FROZEN, LOST
from foretrace.robot.path import SLOWEST, ArmPath
from foretrace.simulation.arm import CONTROL_PERIOD
from foretrace.trajectories import interpolate_poses

PATIENCE = 5.0
"""How long the first pose may take [s]."""
AHEAD = 0.05
"""How far a sample may lie in the future: more is another clock [s]."""
REPLAY_PERIOD = 0.04
"""Time between the poses of a replay [s]."""
BRAKE = 4
"""Control periods in which the arm comes to rest along its path."""
SETTLING = 25
"""Control periods for which the arm stays where it has set the object down."""
TRACKER_CAUSES = (BAD_INPUT, FROZEN, LOST)
"""Causes after which the arm stops, whatever else was asked for: the object is not seen."""


class ActionClock:
    """Time of the action, by the set points that were given: the arm may be slower than planned, and wait.

    Args:
        speed: Share of the tool path's own speed.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self._period = speed * CONTROL_PERIOD
        self._given: list[float] = []

    def tick(self) -> None:
        """The next set point of the lever-up is given now."""
        self._given.append(time.monotonic())

    def action_time(self, host_time: float) -> float | None:
        """Time since the lever-up's start at its own speed [s]; None before the start.

        Args:
            host_time: Time by this machine's monotonic clock [s]; past the last set point, that one counts.
        """
        last = bisect_right(self._given, host_time) - 1
        if last < 0:
            return None
        before, after = (self._given[last : last + 2] * 2)[:2]
        share = (host_time - before) / (after - before) if after > before else 0.0
        return self._period * (last + share)


PoseSample = tuple[float, Numbers | None]
"""When the object was seen, by ``time.monotonic()`` of this machine [s], and its pose as `Monitor.update` takes it;
None where the tracker lost it."""
PoseSource = Callable[[ActionClock], Iterable[PoseSample]]
"""Yields samples as they come, from before the arm moves until the lever-up is over; most need no clock."""


def replay(effect: Effect) -> PoseSource:
    """A source that gives the poses of a recorded motion as if it happened now: a rehearsal, which observes nothing.

    Args:
        effect: What was recorded of the same action.

    Raises:
        RobotError: It has fewer than two samples.
    """
    check_type("effect", effect, Effect, RobotError)
    if len(effect.times) < 2:
        raise RobotError(f"the recording has {len(effect.times)} samples: choose one that did not fail")
    times, poses = effect.times, pose_to_matrix(effect.pose_trajectory)
    end = times[-1] + (times[-1] - times[-2])  # the last sample stands until the next would have come

    def samples(clock: ActionClock) -> Iterator[PoseSample]:
        while True:
            now = time.monotonic()
            if (at := clock.action_time(now) or 0.0) > end:
                return
            yield now, matrix_to_pose(interpolate_poses(times, poses, np.array([at]))[0])
            time.sleep(REPLAY_PERIOD)

    return samples


@dataclass(frozen=True)
class AlarmConfig:
    """What an alarm of the monitor does.

    Raises:
        RobotError: If a value is out of range.
    """

    on_alarm: Literal["stop", "hold", "set-down"] = "stop"
    """Stop arm and program; hold where it is under control; or set the object down along the same path. Then stop."""
    hold_for: float = 60.0
    """How long the arm holds before its program ends; Ctrl-C ends it earlier [s]."""
    silence: float = 0.5
    """Longest time without a pose from the tracker [s]."""

    def __post_init__(self) -> None:
        check_choices(RobotError, self)
        limits = {"hold_for": (0.1, 3600.0), "silence": (0.1, 5.0)}
        check_ranges(RobotError, "alarm", self, limits)


class PoseWatch:
    """Gives tracked poses to a monitor between the beginning and the end of a ``with`` block.

    Args:
        monitor: A new monitor of the plan.
        source: Where poses come from.
        config: What an alarm does.
        speed: Share of the tool path's own speed, as of the planned legs.
        tell: Told of an alarm in a line at once, where the arm goes on holding or setting down.

    Raises:
        RobotError: An argument cannot be used.
    """

    def __init__(
        self,
        monitor: Monitor,
        source: PoseSource,
        config: AlarmConfig = AlarmConfig(),
        speed: float = 1.0,
        tell: Callable[[str], None] = lambda line: None,
    ) -> None:
        check_type("monitor", monitor, Monitor, RobotError, "ft.Monitor(plan)")
        check_type("config", config, AlarmConfig, RobotError)
        if not callable(source):
            raise RobotError(
                f"source is {shown(source)}: give a function of a clock that yields (time, pose)"
            )
        self.speed = speed
        check_ranges(RobotError, "watch", self, {"speed": (SLOWEST, 1.0)}, "give a share")
        self.config, self.tell = config, tell
        self.clock = ActionClock(speed)
        """Time of the action; the motion's loop moves it on."""
        self.verdict: Verdict | None = None
        """The monitor's last verdict, or that of the alarm."""
        self.decided: float | None = None
        """When the arm was to stop, by this machine's monotonic clock [s]."""
        self._monitor, self._source = monitor, source
        self._failure = ""
        self._heard = self._last = -np.inf
        self._first, self._finish = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "PoseWatch":
        self._thread.start()
        if not self._first.wait(PATIENCE):
            self._finish.set()
            raise RobotError(
                f"no pose came within {PATIENCE:g} s: nothing was moved; look whether the tracker runs"
            )
        if self._failure:
            raise RobotError(f"{self._failure}: nothing was moved")
        return self

    def __exit__(self, *exception: object) -> None:
        self._finish.set()  # a source that waits for its tracker ends with the process

    def alarm(self) -> str:
        """Why the lever-up must not go on, in a line; empty if it may."""
        silence = time.monotonic() - self._heard
        if silence > self.config.silence:
            self._fail(f"the tracker has given no pose for {silence:.2f} s")
        return self.verdict_line() or self._failure

    def verdict_line(self) -> str:
        """The monitor's alarm in a line; empty if there is none."""
        verdict = self.verdict
        if verdict is None or not verdict.alarm:
            return ""
        said = f", {verdict.message}" if verdict.cause in TRACKER_CAUSES else ""
        return (
            f"alarm at {verdict.time:.2f} s of the action: {verdict.cause}{said} (score {verdict.score:.2f}, "
            f"threshold {verdict.threshold:.2f})"
        )

    def answer(self, path: ArmPath, sample: int) -> ArmPath | None:
        """The leg that follows an alarm; None: stop.

        Args:
            path: The leg that the arm is on.
            sample: The set point that would be next.
        """
        verdict = self.verdict
        seen = verdict is not None and verdict.alarm and verdict.cause not in TRACKER_CAUSES
        if not seen or self.config.on_alarm == "stop":
            return None
        slower = 1 - np.arange(1, BRAKE + 1) / BRAKE
        if self.config.on_alarm == "hold":
            steps = [slower, np.zeros(round(self.config.hold_for / CONTROL_PERIOD))]
        else:
            steps = [slower, slower - 1, -np.ones(sample), np.zeros(SETTLING)]
        at = np.clip(max(sample - 1, 0) + np.cumsum(np.concatenate(steps)), 0, len(path.joints) - 1)
        return ArmPath(self.config.on_alarm, _between(path.joints, at))

    def _run(self) -> None:
        """Take in samples until the end; whatever the source or the monitor raises is a reason to stop."""
        try:
            for host_time, pose in self._source(self.clock):
                if self._finish.is_set():
                    return
                self._take(host_time, pose)
                if self._failure:
                    return
            self._fail("the source of poses has ended")
        except ForetraceError as error:
            self._fail(str(error))
        except Exception as error:
            self._fail(f"the source of poses failed: {type(error).__name__}: {shown(str(error))}")

    def _take(self, host_time: float, pose: Numbers | None) -> None:
        age = time.monotonic() - host_time
        if not -AHEAD <= age <= self.config.silence:  # nor what is no number
            self._fail(f"a pose is {age:.2f} s old: give the time.monotonic() at which it was seen")
        elif not host_time > self._last:
            self._fail(
                f"the times of poses must rise: one comes {self._last - host_time:.3f} s before the last"
            )
        else:
            before, at = self.clock.action_time(self._last), self.clock.action_time(host_time)
            self._last = host_time
            if self.decided is None and at is not None and (before is None or at > before):
                self._judge(at, pose)
            if pose is not None:
                self._heard = host_time
                self._first.set()

    def _judge(self, at: float, pose: Numbers | None) -> None:
        verdict = self._monitor.update(at, pose)
        if verdict.alarm:
            self.decided = time.monotonic()
        self.verdict = verdict

    def _fail(self, reason: str) -> None:
        if not self._failure and self.decided is None:
            self.decided = time.monotonic()
            self._failure = reason
        self._first.set()


def _between(
    joints: Float[np.ndarray, "time 6"], at: Float[np.ndarray, " steps"]
) -> Float[np.ndarray, "steps 6"]:
    """Set points at fractional places along a leg."""
    return np.column_stack([np.interp(at, np.arange(len(joints)), joint) for joint in joints.T])
