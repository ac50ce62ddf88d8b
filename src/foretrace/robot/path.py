"""The arm's joint path for one lever-up on a real table, in legs that each start and end at rest."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypedDict

import numpy as np
from jaxtyping import Float
from msgspec import Meta
from scipy.interpolate import CubicSpline

from foretrace.actions import LeverUp, tool_transforms
from foretrace.errors import RobotError, is_number, shown
from foretrace.files import read_versioned
from foretrace.geometry import invert_transform, pose_to_matrix
from foretrace.robot.kinematics import ArmKinematics
from foretrace.simulation import arm
from foretrace.trajectories import UNIT_TOLERANCE

KNOT_PERIOD = 0.04
"""Inverse kinematics is solved at these intervals of the unscaled path; a cubic spline joins the solutions [s]."""
ABOVE = (-0.05, 0.10)
"""Where the descent starts and the retreat ends: behind and above the start, along the action's x and z [m]."""
DESCENT_TIME = 2.0
"""Time of the descent, unscaled [s]."""
APPROACH_SPEED, APPROACH_ACCELERATION = 0.2, 0.5
"""Largest joint speed [rad/s] and acceleration [rad/s^2] on the way to the descent, whatever the scaling."""
SLOWEST, LONGEST = 0.01, 600.0
"""Least share of the tool path's own speed, and longest time of descent and lever-up [s]."""
FARTHEST_BASE = 10.0
"""An arm's base farther than this from the table's origin is a mistake, such as one in other units [m]."""
LEVER_UP = "lever-up"
"""Name of the leg that is the tool path."""
FILE_FORMAT, FILE_VERSION = "foretrace-base-pose", 1


class BasePose(TypedDict):
    """Schema of the file with the pose of the arm's base."""

    # Within bounds before anything is squared.
    T_table_base: Annotated[
        list[Annotated[float, Meta(ge=-FARTHEST_BASE, le=FARTHEST_BASE)]], Meta(min_length=7, max_length=7)
    ]
    """Position [m] and unit quaternion (w, x, y, z)."""


@dataclass(frozen=True)
class ArmPath:
    """One leg of the way: a set point of the joints for every control period, at rest at both ends."""

    name: str
    """What it is for."""
    joints: Float[np.ndarray, "time 6"]
    """Joint angles [rad], `arm.CONTROL_PERIOD` apart."""

    @property
    def times(self) -> Float[np.ndarray, " time"]:
        """Time of each set point since the leg's start [s]."""
        return np.arange(len(self.joints)) * arm.CONTROL_PERIOD


def read_base_pose(file: Path) -> Float[np.ndarray, "4 4"]:
    """The calibrated pose of the arm's base in the table frame, from a JSON file.

    Raises:
        RobotError: If the file cannot be read, or is not such a pose.
    """
    place = f"x y z [m], at most {FARTHEST_BASE:g} m away, and a unit quaternion w x y z"
    remedy = f"give a JSON file with T_table_base: {place}"
    content = read_versioned(file, BasePose, FILE_FORMAT, FILE_VERSION, RobotError, remedy, key="version")
    pose = np.array(content["T_table_base"], dtype=float)
    if abs(np.linalg.norm(pose[3:]) - 1) > UNIT_TOLERANCE:
        raise RobotError(f"{file}: entry T_table_base is {shown(pose.tolist())}: {remedy}")
    return pose_to_matrix(pose)


def plan_lever_up(
    kinematics: ArmKinematics,
    action: LeverUp,
    T_table_base: Float[np.ndarray, "4 4"],
    speed: float,
) -> list[ArmPath]:
    """Descent to the start of a lever-up, and the lever-up.

    Args:
        kinematics: The arm with its screwdriver.
        action: The lever-up, with contact and direction in the table frame: that of an object whose corners are given
            in the table frame.
        T_table_base: The arm's base in the table frame.
        speed: Share of the tool path's own speed, over 0, at most 1.

    Raises:
        RobotError: If the speed is out of range.
        ActionError: If the arm cannot reach a pose.
    """
    if not is_number(speed) or not SLOWEST <= speed <= 1:
        raise RobotError(f"speed {speed}: choose {SLOWEST:g} to 1, the tool path's own speed")
    if (duration := (action.duration + DESCENT_TIME) / speed) > LONGEST:
        raise RobotError(
            f"the way to the end of the path takes {duration:.0f} s, more than {LONGEST:g} s: choose a higher speed or "
            "shorter times"
        )
    T_base_action = invert_transform(T_table_base) @ invert_transform(action.T_action_object)
    lever = tool_transforms(action.tool_motion(_knots(action.duration)))
    descent = np.repeat(lever[:1], len(_knots(DESCENT_TIME)), axis=0)
    remaining = 1 - _minimum_jerk(len(descent))
    descent[:, [0, 2], 3] += remaining[:, None] * np.array(ABOVE)
    x, y = T_base_action[:2, 3]
    # The simulated arm starts behind the contact point, facing it; the real one may look elsewhere.
    q = np.array(arm.HOME) + np.array([np.arctan2(y, x), 0, 0, 0, 0, 0])
    solved = []
    for T_action_tip in np.concatenate([descent, lever]):
        q = kinematics.solve(T_base_action @ T_action_tip, q)
        solved.append(q)
    split = len(descent)
    return [
        ArmPath("descent", _resample(np.array(solved[:split]), DESCENT_TIME / speed)),
        ArmPath(LEVER_UP, _resample(np.array(solved[split:]), action.duration / speed)),
    ]


def plan_retreat(legs: Sequence[ArmPath]) -> list[ArmPath]:
    """The way back of `plan_lever_up`'s legs: the object is set down and the blade pulled out, then the arm goes up.

    Args:
        legs: Descent and lever-up.
    """
    descent, lever = legs
    return [ArmPath("set-down", lever.joints[::-1]), ArmPath("retreat", descent.joints[::-1])]


def plan_approach(start: Float[np.ndarray, "6"], goal: Float[np.ndarray, "6"]) -> ArmPath:
    """A slow motion of all joints at once from where the arm stands.

    Args:
        start: Joint angles where it stands [rad].
        goal: Joint angles where it shall go [rad].
    """
    turn = float(np.abs(goal - start).max())
    # A minimum-jerk motion's largest speed is 15/8 of its mean, its largest acceleration 10/sqrt(3) turn / duration^2.
    duration = max(15 / 8 * turn / APPROACH_SPEED, np.sqrt(10 / np.sqrt(3) * turn / APPROACH_ACCELERATION))
    progress = _minimum_jerk(max(round(duration / arm.CONTROL_PERIOD), 1) + 1)
    return ArmPath("approach", start + progress[:, None] * (goal - start))


def _knots(duration: float) -> Float[np.ndarray, " time"]:
    return np.linspace(0, duration, max(round(duration / KNOT_PERIOD), 3) + 1)


def _minimum_jerk(num: int) -> Float[np.ndarray, " {num}"]:
    """Progress from 0 to 1, at rest at both ends."""
    s = np.linspace(0, 1, num)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _resample(knots: Float[np.ndarray, "knots 6"], duration: float) -> Float[np.ndarray, "time 6"]:
    """A set point for every control period of a duration [s], through knots that are spread evenly over it."""
    spline = CubicSpline(np.linspace(0, duration, len(knots)), knots, bc_type="clamped")
    num = int(np.ceil(duration / arm.CONTROL_PERIOD)) + 1
    return spline(np.minimum(np.arange(num) * arm.CONTROL_PERIOD, duration))
