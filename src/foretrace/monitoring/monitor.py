"""A monitor: tells, sample by sample, whether an execution is still what was imagined, and what it is if not."""

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from foretrace.errors import MonitoringError, check_type, is_number, shown, wrong_type
from foretrace.geometry import (
    Numbers,
    continuous_rotation_vectors,
    finite_array,
    invert_transform,
    matrix_to_pose,
    pose_to_matrix,
    quaternion_to_matrix,
)
from foretrace.imagined import ImaginedEffect
from foretrace.imagined.context import first_action
from foretrace.monitoring.calibration import MonitorCalibration, check_calibration, shipped
from foretrace.monitoring.causes import BAD_INPUT, FROZEN, LOST, SURE, UNKNOWN, CauseModel, evidence
from foretrace.monitoring.motions import TURN_LENGTH, motions_of, place_of
from foretrace.monitoring.remainder import Remainder
from foretrace.monitoring.verdict import Verdict
from foretrace.trajectories import UNIT_TOLERANCE

WINDOW = 0.5
"""Residuals are averaged over the last samples within this time [s]."""
RATE = 6.0
"""Independent observations in a second: residuals that follow each other closely are alike."""
LARGEST = 7.0
"""Largest residual that counts for the weights, in widths of the band: a larger one counts as this one."""
LONGEST_GAP = 0.5
"""An object that the tracker loses for longer than this [s] raises an alarm."""
REPEATS = 3
"""Exactly equal samples after the first that mean a frozen tracker, if a motion is expected meanwhile."""
EXPECTED_MOTION = 0.002
"""Motion that is expected at least meanwhile [m]."""
QUIET = 3e-4
"""An object is at rest until a believed motion has moved it by more than this [m]."""
BEFORE = 0.25
"""Time before an alarm at which the best motion is still trusted [s]."""
FARTHEST = 10.0
"""A position farther from the origin of its frame is a mistake, such as one in other units [m]."""
FAR = 0.15
"""The object frame lies at most so far from the centre of mass [m], if its pose at rest is not told."""
SHIFTED = 400
"""Motions that are shifted by errors of the clock, at least."""
GOLDEN = 0.6180339887
REST_DISTANCE, REST_ANGLE = 0.01, 0.1
"""Largest distance and angle of the first pose from the one at rest that is told [m, rad]."""


class Monitor:
    """Watches one execution of an action against what was imagined of it.

    Every future, or every motion in the worlds of a `Belief`, has a band whose width follows its speed. The score is
    the largest root mean square deviation over half a second from the motion that stays nearest, in widths of its
    band, so it never falls. Its threshold is a quantile over normal executions: at most a share ``false_alarms`` of
    whole executions alarm although nothing is wrong (split-conformal; as functional bands, Diquigiovanni et al., 2022).

    Args:
        imagined: The imagined effect, best with a `Belief` as context; or a plan, which has one as ``imagined``.
        false_alarms: Share of whole normal executions that alarm, at most.
        calibration: Scores of normal executions, or a file of them; by default those of the predictor that comes with
            foretrace.
        T_table_action: The action frame in the table frame, where poses are tracked in the table frame.
        rest: Pose of the object frame at rest, in the frame of the tracked poses, where it is known: needed if tracking
            begins later than the motion, and the first pose is compared with it.
        clock_error: Largest error of the tracker's clock relative to the action's [s].

    Raises:
        MonitoringError: An argument cannot be used.
    """

    def __init__(
        self,
        imagined: ImaginedEffect | Any,
        false_alarms: float = 0.05,
        *,
        calibration: MonitorCalibration | str | Path | None = None,
        T_table_action: Numbers | None = None,
        rest: Numbers | None = None,
        clock_error: float = 0.0,
    ) -> None:
        effect = imagined if isinstance(imagined, ImaginedEffect) else getattr(imagined, "imagined", imagined)
        check_type("imagined", effect, ImaginedEffect, MonitoringError, "an ImaginedEffect or a plan")
        if not is_number(false_alarms) or not 0.01 <= false_alarms <= 0.5:
            raise MonitoringError(
                f"false_alarms is {shown(false_alarms)}: give a share of executions from 0.01 to 0.5"
            )
        if not is_number(clock_error) or not 0 <= clock_error <= 0.5:
            raise MonitoringError(f"clock_error is {shown(clock_error)}: give seconds from 0 to 0.5")
        self.imagined = effect
        """What was imagined."""
        self.calibration = check_calibration(calibration, _kind(effect))
        """Scores of normal executions."""
        self.threshold = self.calibration.threshold(float(false_alarms))
        """Score above which there is an alarm."""
        self._causes = CauseModel.of_entries(shipped()["causes"])
        self._motions = motions = motions_of(effect)
        self._shift = None
        if clock_error:
            self._motions = motions = motions.repeated(-(-SHIFTED // len(motions.points)))
            shares = (np.arange(len(motions.points)) * GOLDEN) % 1.0  # evenly, in no order
            self._shift = float(clock_error) * (2 * shares - 1)
        self._T_action_table = None
        if T_table_action is not None:
            transform = finite_array("T_table_action", T_table_action, (4, 4), MonitoringError)
            turn = transform[:3, :3]
            if np.abs(turn @ turn.T - np.eye(3)).max() > UNIT_TOLERANCE or np.linalg.det(turn) < 0:
                raise MonitoringError("T_table_action is no transform: give rotation and position, 4 x 4")
            self._T_action_table = invert_transform(transform)
        self._told_rest = None
        if rest is not None:
            told = finite_array("rest", rest, (7,), MonitoringError)
            if (wrong := _wrong_pose(told)) is not None:
                raise MonitoringError(f"rest: {wrong}")
            self._told_rest = self._enter(told)
        far = np.linalg.norm(motions.states[motions.believed], axis=2)
        moving = (np.quantile(far, 0.9, axis=0) > QUIET).argmax()
        self._quiet_until = float(motions.times[max(int(moving) - 1, 0)])
        count = len(motions.points)
        self._log_weight = motions.log_prior.copy()
        self._window: deque[tuple[float, Float[np.ndarray, " motions"]]] = deque()
        self._largest = np.zeros(count)
        self._squares = np.zeros(count)
        self._rests: list[np.ndarray] = []
        self._times: list[float] = []
        self._poses: list[np.ndarray] = []
        self._best: list[int] = []
        self._turned = np.zeros(3)
        self._repeats = 0
        self._last_time = -np.inf
        self._score = 0.0
        self._fixed_cause: str | None = None
        self._note = ""
        self._alarmed: int | None = None

    def update(self, t: float, pose: Numbers | None) -> Verdict:
        """Take in one tracked sample.

        What is no pose raises an alarm: the monitor fails safe. What cannot be an input at all is an error.

        Args:
            t: Time since the moment before the blade moves [s]; later than the last one.
            pose: Object frame in the action frame, as ``Effect.pose_trajectory``: position [m], quaternion (w, x, y,
                z); in the table frame if the monitor has ``T_table_action``. None: the tracker lost the object.

        Raises:
            MonitoringError: t is no number or pose no seven numbers; or the first pose lies elsewhere than the object
                that was seen, or comes after the motion began and the pose at rest is not told.
        """
        if not is_number(t):
            raise wrong_type(MonitoringError)(f"t is {shown(t)}: give a time in seconds")
        seen = None if pose is None else _seven(pose)
        if (wrong := self._fault(float(t), seen)) is not None:
            self._raise(BAD_INPUT, wrong)
            return self._verdict(float(t))
        self._last_time = float(t)
        if seen is None:
            since = t - (self._times[-1] if self._times else max(0.0, self._motions.times[0]))
            if since > LONGEST_GAP:
                self._raise(LOST, f"the tracker has lost the object for {since:.2f} s")
            return self._verdict(float(t))
        self._take(float(t), self._enter(seen))
        return self._verdict(float(t))

    def score_of(self, times: Numbers, poses: Any) -> float:
        """Score that a whole execution ends with, for a calibration; the monitor must be new.

        Args:
            times: Times [s].
            poses: Poses, each as `update` takes it.

        Raises:
            MonitoringError: As `update`; or a sample is none.
        """
        for t, pose in zip(times, poses, strict=True):
            self.update(float(t), pose)
        if self._fixed_cause is not None:
            raise MonitoringError(f"this is no normal execution: {self._note}")
        return self._score

    # --- one sample --------------------------------------------------------------------------------------

    def _fault(self, t: float, pose: Float[np.ndarray, "7"] | None) -> str | None:
        if not np.isfinite(t):
            return f"the time is {t}"
        if t <= self._last_time:
            return f"times must rise: {t:g} s follows {self._last_time:g} s"
        if pose is None:
            return None
        if not np.isfinite(pose).all():
            return f"the pose at {t:g} s is not finite"
        return _wrong_pose(pose)

    def _take(self, t: float, pose: Float[np.ndarray, "7"]) -> None:
        """Compare a pose in the action frame with all motions."""
        motions = self._motions
        if not self._times:
            self._begin(t, pose)
        if self._told_rest is None and t <= self._quiet_until + 1e-9:
            self._rests.append(pose)
        rest = self._rest
        turn = quaternion_to_matrix(pose[3:]) @ quaternion_to_matrix(rest[3:]).T
        self._turned = _next_turn(turn, self._turned)
        moved = place_of(pose, rest, motions.points)
        states, width = motions.at(t) if self._shift is None else motions.at_each(t - self._shift)
        off = np.concatenate([moved, np.tile(TURN_LENGTH * self._turned, (len(moved), 1))], axis=1) - states
        square = (off**2).sum(axis=1)
        own = square / width**2
        self._window.append((t, own))
        while t - self._window[0][0] > WINDOW - 1e-9:
            self._window.popleft()
        mean = sum(each for _, each in self._window) / len(self._window)
        self._largest = np.maximum(self._largest, mean)
        self._score = max(self._score, float(np.sqrt(self._largest[motions.believed].min())))
        since = min(t - self._times[-1], 0.1) if self._times else 0.0
        self._log_weight -= 0.5 * RATE * since * np.minimum(own, LARGEST**2)
        self._squares += square
        self._repeats = self._repeats + 1 if self._poses and np.array_equal(pose, self._poses[-1]) else 0
        self._times.append(t)
        self._poses.append(pose)
        self._best.append(int(np.where(motions.believed, self._log_weight, -np.inf).argmax()))
        if self._alarmed is None and self._score > self.threshold:
            self._alarmed = len(self._times) - 1
        if self._repeats >= REPEATS and self._expected_motion() > EXPECTED_MOTION:
            self._raise(FROZEN, f"the tracker has repeated the same pose {self._repeats + 1} times")

    def _begin(self, t: float, pose: Float[np.ndarray, "7"]) -> None:
        """Check that the first pose is that of the object that was seen, at rest.

        Raises:
            MonitoringError: It is not.
        """
        if self._told_rest is None:
            off = pose[:3] - self.imagined.com_trajectory[0]
            if (far := float(np.linalg.norm(off))) > FAR:
                others = ", or, for poses in the table frame, T_table_action (--table)"
                right = f"action frame{others}" if self._T_action_table is None else "table frame"
                raise MonitoringError(
                    f"the first pose lies {100 * far:.1f} cm from the centre of mass of the object that was seen: give "
                    f"poses in the {right}"
                )
            if t > self._quiet_until + 1e-9:
                raise MonitoringError(
                    f"the first pose comes at {t:g} s, and the object moves from {self._quiet_until:g} s on: begin "
                    "earlier, or give the pose at rest"
                )
        elif t <= self._quiet_until + 1e-9:
            far = float(np.linalg.norm(pose[:3] - self._told_rest[:3]))
            turn = quaternion_to_matrix(pose[3:]) @ quaternion_to_matrix(self._told_rest[3:]).T
            angle = float(np.linalg.norm(continuous_rotation_vectors(turn[None])[0]))
            if far > REST_DISTANCE or angle > REST_ANGLE:
                raise MonitoringError(
                    f"the first pose is {100 * far:.1f} cm and {np.degrees(angle):.0f} degrees away from the one at "
                    "rest: give both in the same frame, of the same object"
                )

    @property
    def _rest(self) -> Float[np.ndarray, "7"]:
        """The pose at rest: as told, or the mean of the first ones."""
        if self._told_rest is not None:
            return self._told_rest
        first = np.array(self._rests)
        mean = np.concatenate(
            [
                first[:, :3].mean(axis=0),
                (first[:, 3:] * np.sign(first[:, 3:] @ first[0, 3:])[:, None]).mean(axis=0),
            ]
        )
        mean[3:] /= np.linalg.norm(mean[3:])
        return mean

    def _expected_motion(self) -> float:
        """How far the motion that fitted best before the samples repeated has gone since [m]."""
        first = len(self._times) - 1 - self._repeats
        k = self._best[first]
        there, here = (self._motions.at(self._times[i])[0][k] for i in (first, -1))
        return float(np.linalg.norm(here - there))

    def _enter(self, pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "7"]:
        """A tracked pose in the action frame."""
        if self._T_action_table is None:
            return pose
        return matrix_to_pose(self._T_action_table @ pose_to_matrix(pose))

    def _raise(self, cause: str, note: str) -> None:
        if self._fixed_cause is None:
            self._fixed_cause, self._note = cause, note

    # --- what it says ------------------------------------------------------------------------------------

    def _verdict(self, t: float) -> Verdict:
        motions = self._motions
        alarm = self._fixed_cause is not None or self._alarmed is not None
        weights = np.exp(self._log_weight - self._log_weight.max())
        shown_weights = weights if alarm else np.where(motions.believed, weights, 0.0)
        total = shown_weights.sum()
        shares = np.bincount(motions.outcome, shown_weights / total, len(motions.outcomes))
        outcomes = dict(zip(motions.outcomes, shares.tolist(), strict=True))
        before = np.bincount(motions.outcome, np.exp(motions.log_prior) * motions.believed)
        transition = not alarm and int(shares.argmax()) != int(before.argmax())
        cause, causes, message = None, {}, "as imagined"
        if self._fixed_cause is not None:
            cause, causes, message = self._fixed_cause, {self._fixed_cause: 1.0}, self._note
        elif alarm:
            causes = self._causes.probabilities(self.evidence())
            if (
                not self._repeats and (others := 1.0 - causes.pop(FROZEN, 0.0)) > 0
            ):  # a pose that changes is not frozen
                causes = {name: chance / others for name, chance in causes.items()}
            likeliest = max(causes, key=lambda name: causes[name])
            cause = likeliest if causes[likeliest] >= SURE else UNKNOWN
            message = f"not as imagined: {cause}"
        elif transition:
            message = f"another future takes over: {motions.outcomes[int(shares.argmax())]}"
        remainder = None
        if self._times:
            remainder = Remainder(
                motions,
                shown_weights / total,
                t,
                self._best[self._trusted],
                tuple(self._times),
                tuple(self._poses),
                self._rest,
                cause,
                self.imagined,
                self.calibration.rest,
            )
        return Verdict(
            t, alarm, cause, self._score, self.threshold, transition, outcomes, causes, message, remainder
        )

    @property
    def _trusted(self) -> int:
        """Sample of which the best motion is trusted: the last one, or some time before an alarm."""
        if self._alarmed is None:
            return -1
        times = np.array(self._times)
        return max(0, int(np.searchsorted(times, times[self._alarmed] - BEFORE, side="right")) - 1)

    def evidence(self) -> Float[np.ndarray, " numbers"]:
        """What causes are told apart by, from the samples so far; at least one pose is needed."""
        motions, rest = self._motions, self._rest
        k = self._best[self._trusted]
        times, poses = np.array(self._times), np.array(self._poses)
        turns = quaternion_to_matrix(poses[:, 3:]) @ quaternion_to_matrix(rest[3:]).T
        moved = poses[:, :3] - rest[:3] + (turns - np.eye(3)) @ (motions.points[k] - rest[:3])
        seen = np.concatenate([moved, TURN_LENGTH * continuous_rotation_vectors(turns)], axis=1)
        expected = np.column_stack([np.interp(times, motions.times, each) for each in motions.states[k].T])
        residuals = {
            str(cause): float(np.sqrt(self._squares[motions.causes == cause].min() / len(times)))
            for cause in set(motions.causes)
        }
        return evidence(times, seen, expected, residuals, self._repeats)


def _seven(pose: Any) -> Float[np.ndarray, "7"]:
    """Seven numbers, finite or not.

    Raises:
        MonitoringError: It is something else.
    """
    try:
        found = np.array(pose, dtype=float)
    except (TypeError, ValueError, OverflowError):
        found = np.zeros(0)
    if found.shape != (7,):
        raise wrong_type(MonitoringError)(
            f"pose is {shown(pose)}: give position [m] and quaternion (w, x, y, z), seven numbers, or None"
        )
    return found


def _kind(effect: ImaginedEffect) -> str:
    """Which of the calibrations that come with foretrace belongs to an effect: by its action, and whether believed."""
    kind = "futures" if effect.worlds is None else "worlds"
    action = first_action(effect.futures.outcome)
    return kind if action is first_action() else f"{action.label} {kind}"


def _wrong_pose(pose: Float[np.ndarray, "7"]) -> str | None:
    if (far := float(np.linalg.norm(pose[:3]))) > FARTHEST:
        return f"the position lies {far:.4g} m from the origin of its frame: give metres, not millimetres"
    length = float(np.linalg.norm(pose[3:]))
    wrong = abs(length - 1) > UNIT_TOLERANCE
    return f"the quaternion (w, x, y, z) has length {length:.4g}, not 1: normalise it" if wrong else None


def _next_turn(turn: Float[np.ndarray, "3 3"], before: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Rotation vector of a rotation, of all those that are equal the one near that of the sample before."""
    vector = continuous_rotation_vectors(turn[None])[0]
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 1e-9 else before / max(float(np.linalg.norm(before)), 1e-12)
    return axis * (angle + 2 * np.pi * np.round((before @ axis - angle) / (2 * np.pi)))
