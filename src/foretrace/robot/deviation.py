"""How far the controller's own kinematics is from the nominal one that paths are planned with.

A UR's controller knows the arm's individual calibration: its flange is some millimetres away from where the published
Denavit-Hartenberg parameters have it, by an amount that changes slowly with the posture. The blade has less room.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from foretrace.errors import RobotError
from foretrace.robot.kinematics import ArmKinematics

OTHER_ARM = 0.01
"""A flange farther away than this is no calibration, but another arm [m]: of a UR10e's it is 24 mm or more."""
OTHER_ARM_ANGLE = 0.02
"""The same of its direction [rad]."""


@dataclass(frozen=True)
class Deviation:
    """The controller's pose less the planned one, for the same joint angles."""

    flange: Float[np.ndarray, "3"]
    """Of the flange, in the base frame [m]."""
    angle: float
    """Of the flange's orientation [rad]."""
    tip: Float[np.ndarray, "3"]
    """Of the blade's tip, in the table frame [m]."""


def measure_deviation(
    kinematics: ArmKinematics,
    T_table_base: Float[np.ndarray, "4 4"],
    joints: Float[np.ndarray, "6"],
    T_base_flange: Float[np.ndarray, "4 4"],
) -> Deviation:
    """Deviation at one posture.

    Args:
        kinematics: The nominal arm with its screwdriver.
        T_table_base: The arm's base in the table frame.
        joints: Joint angles [rad].
        T_base_flange: The controller's flange at these joint angles.
    """
    nominal = kinematics.at(joints)
    T_base_tip = T_base_flange @ kinematics.T_flange_tip
    turn = Rotation.from_matrix(nominal.T_base_tip[:3, :3].T @ T_base_tip[:3, :3])
    return Deviation(
        flange=T_base_flange[:3, 3] - nominal.flange,
        angle=float(turn.magnitude()),
        tip=T_table_base[:3, :3] @ (T_base_tip[:3, 3] - nominal.T_base_tip[:3, 3]),
    )


def refuse_other_arm(deviation: Deviation, host: str) -> None:
    """Refuse an arm with other dimensions than a UR10's.

    Raises:
        RobotError: saying how far its flange is from a UR10's.
    """
    distance = float(np.linalg.norm(deviation.flange))
    if not (distance <= OTHER_ARM and deviation.angle <= OTHER_ARM_ANGLE):  # nor what is no number
        raise RobotError(
            f"{host} has its flange {1e3 * distance:.1f} mm and {np.degrees(deviation.angle):.1f} degrees from where a "
            f"UR10 has it, more than a calibration's {1e3 * OTHER_ARM:g} mm and {np.degrees(OTHER_ARM_ANGLE):.1f} "
            "degrees: check that the arm is a UR10 (CB3)"
        )


def refuse_uncorrected(deviation: Deviation, correction: Float[np.ndarray, "3"], tolerance: float) -> None:
    """Refuse to lower a blade that would go elsewhere than planned, by the arm's own calibration.

    Args:
        deviation: Measured above the start of the path.
        correction: The part of the tip's deviation that was planned with, in the table frame [m].
        tolerance: Largest error of the tip's height [m].

    Raises:
        RobotError: naming the correction to give.
    """
    height = float(deviation.tip[2] - correction[2])
    if not abs(height) <= tolerance:
        x, y, z = deviation.tip
        raise RobotError(
            f"the controller has the blade's tip {1e3 * abs(height):.2f} mm {'below' if height < 0 else 'above'} the "
            f"planned height, more than {1e3 * tolerance:g} mm, by this arm's own calibration: give --correction "
            f"{x:.5f} {y:.5f} {z:.5f}"
        )
