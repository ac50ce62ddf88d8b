"""Whether the arm can carry out a lever-up: the checks of its path, as a planner asks for them."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from foretrace.actions import LeverUp, Screwdriver
from foretrace.errors import ActionError, RobotError, fault, is_number, shown
from foretrace.robot.checks import ArmLimits, check_path, refuse_unsafe
from foretrace.robot.kinematics import ArmKinematics
from foretrace.robot.path import SLOWEST, plan_lever_up


@dataclass(frozen=True, eq=False)
class ArmReach:
    """Says of lever-ups why the arm must not carry them out; it is called with one at a time.

    A path is checked at its own speed, where it has the fewest set points: at a share of that, speeds are as much
    smaller, and accelerations by its square.

    Raises:
        RobotError: The speed is out of range.
    """

    T_table_base: Float[np.ndarray, "4 4"]
    """The arm's base in the table frame."""
    T_table_object: Float[np.ndarray, "4 4"]
    """The object in the table frame."""
    speed: float = 0.1
    """Share of the tool path's own speed."""
    limits: ArmLimits = field(default_factory=ArmLimits)
    """What must be kept."""
    kinematics: ArmKinematics = field(default_factory=lambda: ArmKinematics(Screwdriver()))
    """The arm with its screwdriver."""

    def __post_init__(self) -> None:
        if not is_number(self.speed) or not SLOWEST <= self.speed <= 1:
            raise fault(RobotError, is_number(self.speed))(
                f"speed {shown(self.speed)}: choose {SLOWEST:g} to 1, the tool path's own speed"
            )

    def __call__(self, action: LeverUp) -> str | None:
        """Why not, in a line; None: it may.

        Args:
            action: A lever-up in the object's frame.
        """
        turn, shift = self.T_table_object[:2, :2], self.T_table_object[:2, 3]
        placed = replace(action, contact=turn @ action.contact + shift, direction=turn @ action.direction)
        limits = replace(
            self.limits,
            joint_speed=tuple(limit / self.speed for limit in self.limits.joint_speed),
            joint_acceleration=self.limits.joint_acceleration / self.speed**2,
            tip_speed=self.limits.tip_speed / self.speed,
        )
        try:
            for leg in plan_lever_up(self.kinematics, placed, self.T_table_base, 1.0):
                postures = self.kinematics.along(leg.joints)
                refuse_unsafe(check_path(leg, postures, self.T_table_base, limits))
        except (ActionError, RobotError) as reason:
            return str(reason).split(": nothing was moved")[0]
        return None
