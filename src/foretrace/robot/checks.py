"""What must hold of a joint path before an arm may move along it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float

from foretrace.errors import RobotError
from foretrace.geometry import transform_points
from foretrace.robot.kinematics import Posture
from foretrace.robot.path import ArmPath
from foretrace.simulation import arm

NO_TOLERANCE = 1e-9


@dataclass(frozen=True)
class ArmLimits:
    """Limits of a path, tighter than the arm's own."""

    joint_margin: float = 0.1
    """Distance of every joint from the end of its range [rad]."""
    joint_speed: tuple[float, ...] = tuple(float(v) / 2 for v in arm.SPEED_LIMIT)
    """Largest joint speeds [rad/s]: half of what the arm can."""
    joint_acceleration: float = 3.0
    """Largest joint acceleration [rad/s^2]."""
    tip_speed: float = 0.25
    """Largest speed of the blade tip [m/s]: the reduced speed of ISO 10218-1."""
    clearance: float = 0.01
    """Least distance of links, holder, handle and shaft from the table [m]."""
    blade_clearance: float = 0.0
    """Least distance of the blade from the table [m]."""
    nearest: float = 0.35
    """Least distance of the flange from the base's axis [m]."""
    farthest: float = 1.1
    """Largest distance of the flange from the base's middle [m]."""
    elbow: float = 0.2
    """Least sine of the elbow's angle, 0 where the arm is straight."""
    wrist: float = 0.2
    """Least sine of wrist 2's angle, 0 where the axes of the other wrist joints are parallel."""
    shoulder: float = 0.15
    """Least distance of the wrist ahead of the plane of the first two axes [m]."""
    singular_value: float = 0.05
    """Least singular value of the tip's Jacobian, lengths in metres."""
    reposition: float = 1.6
    """Farthest that a joint may turn from where the arm stands to the start [rad]."""


@dataclass(frozen=True)
class Check:
    """The worst moment of one leg in one respect."""

    leg: str
    name: str
    unit: str
    value: float
    limit: float
    at_least: bool
    """Whether the limit is a lower one."""
    sample: int
    """Number of the set point in its leg."""
    time: float
    """Time of that set point since the leg's start [s]."""
    joint: str | None
    """Which joint, where it is about one."""

    @property
    def passed(self) -> bool:
        """Whether the limit is kept."""
        excess = self.limit - self.value if self.at_least else self.value - self.limit
        return excess <= NO_TOLERANCE


def check_path(
    path: ArmPath, postures: Sequence[Posture], T_table_base: Float[np.ndarray, "4 4"], limits: ArmLimits
) -> list[Check]:
    """The worst moments of one leg.

    Args:
        path: The leg.
        postures: The arm at each of its set points.
        T_table_base: The arm's base in the table frame.
        limits: What must be kept.

    Raises:
        RobotError: If the leg has no set points, or one that is not finite.
    """
    if len(path.joints) == 0 or not np.isfinite(path.joints).all():
        bad = np.argwhere(~np.isfinite(path.joints))
        where = (
            f"joint {arm.JOINT_NAMES[bad[0, 1]]} is not finite at sample {bad[0, 0]}"
            if len(bad)
            else "is empty"
        )
        raise RobotError(f"{path.name}: {where}: plan the path anew")
    steps = np.diff(path.joints, axis=0) / arm.CONTROL_PERIOD
    # The arm rests before and after.
    changes = np.diff(np.pad(steps, ((1, 1), (0, 0))), axis=0) / arm.CONTROL_PERIOD
    tips = np.array([posture.T_base_tip[:3, 3] for posture in postures])
    tip_steps = np.linalg.norm(np.diff(tips, axis=0), axis=1) / arm.CONTROL_PERIOD
    links = [float((transform_points(T_table_base, p.links)[:, 2] - p.link_radii).min()) for p in postures]
    blade = [float(transform_points(T_table_base, p.blade)[:, 2].min()) for p in postures]
    flanges, wrists = np.array([p.flange for p in postures]), np.array([p.wrist for p in postures])
    ahead = wrists[:, 0] * np.cos(path.joints[:, 0]) + wrists[:, 1] * np.sin(path.joints[:, 0])
    smallest = [float(np.linalg.svd(p.jacobian, compute_uv=False)[-1]) for p in postures]
    most, least = partial(_worst, path), partial(_worst, path, at_least=True)
    return [
        most("joint angle", "rad", np.abs(path.joints), arm.JOINT_LIMIT - limits.joint_margin),
        most("joint speed", "rad/s", np.abs(steps), np.array(limits.joint_speed)),
        most("joint acceleration", "rad/s2", np.abs(changes), limits.joint_acceleration),
        most("blade tip speed", "m/s", tip_steps, limits.tip_speed),
        least("arm above table", "m", np.array(links), limits.clearance),
        least("blade above table", "m", np.array(blade), limits.blade_clearance),
        least("flange from base axis", "m", np.hypot(*flanges[:, :2].T), limits.nearest),
        most("flange from base", "m", np.linalg.norm(flanges, axis=1), limits.farthest),
        least("elbow singularity", "sine", np.abs(np.sin(path.joints[:, 2])), limits.elbow),
        least("wrist singularity", "sine", np.abs(np.sin(path.joints[:, 4])), limits.wrist),
        least("shoulder singularity", "m", np.abs(ahead), limits.shoulder),
        least("least singular value", "", np.array(smallest), limits.singular_value),
    ]


def check_start(path: ArmPath, limits: ArmLimits) -> Check:
    """How far the arm has to turn on its way to the start."""
    return _worst(path, "way to the start", "rad", np.abs(path.joints - path.joints[-1]), limits.reposition)


def refuse_unsafe(checks: list[Check]) -> None:
    """Refuse a path that does not keep its limits.

    Raises:
        RobotError: naming the first check that failed, with joint, set point, value and limit.
    """
    for check in checks:
        if not check.passed:
            joint = f" of {check.joint}" if check.joint else ""
            raise RobotError(
                f"{check.leg}: {check.name}{joint} is {check.value:.4g} {check.unit} at sample {check.sample} "
                f"({check.time:.2f} s), the limit is {'at least' if check.at_least else 'at most'} {check.limit:.4g}: "
                "nothing was moved; slow the path down, or move object, base or starting posture"
            )


def _worst(
    path: ArmPath,
    name: str,
    unit: str,
    values: np.ndarray,
    limit: float | np.ndarray,
    *,
    at_least: bool = False,
) -> Check:
    """Worst moment of values (time,) or (time, joint), which must keep a largest or a least value."""
    limits = np.broadcast_to(limit, values.shape)
    if values.size == 0:  # a leg of one set point has no speed
        return Check(path.name, name, unit, 0.0, float(np.min(limit)), at_least, 0, 0.0, None)
    excess = limits - values if at_least else values - limits
    where = np.unravel_index(int(excess.argmax()), values.shape)
    value, bound = float(values[where]), float(limits[where])
    sample, time = int(where[0]), float(path.times[where[0]])
    joint = arm.JOINT_NAMES[where[1]] if len(where) > 1 else None
    return Check(path.name, name, unit, value, bound, at_least, sample, time, joint)
