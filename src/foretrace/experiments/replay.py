"""How far a simulated motion strays from a recorded one that started in the same way."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from foretrace.geometry import quaternion_to_matrix, rotation_angle
from foretrace.interactions.motions import Recording
from foretrace.simulation.free_motion import simulate_free_motion

FACE_TOLERANCE = np.deg2rad(20.0)
"""The same side is down if its direction differs by less than this [rad]."""
ESTIMATE_TIME = 0.1
"""Velocities that are not recorded are estimated from the frames of this time [s], from at least three."""
TIMESTEP = 0.001
"""Time step of the simulation [s]."""


@dataclass(frozen=True, eq=False)
class Replay:
    """A recording and what the simulation made of its first frame."""

    recording: Recording
    """What was recorded."""
    poses: Float[np.ndarray, "time 7"]
    """Simulated object frame at the recorded times: position [m], quaternion (w, x, y, z)."""
    position_error: Float[np.ndarray, " time"]
    """Distance of the simulated from the recorded centre of mass [m]."""
    rotation_error: Float[np.ndarray, " time"]
    """Angle between simulated and recorded orientation [rad]."""
    down_error: float
    """Angle between the directions that point down at the end, in the object frame [rad]."""

    @property
    def right_face(self) -> bool:
        """Whether the simulated object ends on the recorded side."""
        return bool(self.down_error < FACE_TOLERANCE)

    def rows(self) -> list[dict[str, Any]]:
        """The errors over time, one row per frame."""
        return [
            {
                "recording": self.recording.name,
                "time": float(time),
                "position_error_m": float(position),
                "rotation_error_deg": float(np.rad2deg(rotation)),
            }
            for time, position, rotation in zip(
                self.recording.times, self.position_error, self.rotation_error, strict=True
            )
        ]

    def summary(self) -> dict[str, Any]:
        """The errors in a few figures."""
        degrees = np.rad2deg(self.rotation_error)
        return {
            "recording": self.recording.name,
            "duration_s": float(self.recording.times[-1]),
            "frames": len(self.recording.times),
            "start_velocity": "estimated" if self.recording.velocity is None else "recorded",
            "mean_position_error_m": float(self.position_error.mean()),
            "largest_position_error_m": float(self.position_error.max()),
            "final_position_error_m": float(self.position_error[-1]),
            "mean_rotation_error_deg": float(degrees.mean()),
            "final_rotation_error_deg": float(degrees[-1]),
            "down_error_deg": float(np.rad2deg(self.down_error)),
            "right_face": self.right_face,
        }


def replay(recording: Recording, engine: str = "mujoco", timestep: float = TIMESTEP) -> Replay:
    """Simulates a recorded motion from its first frame and compares.

    A first frame that noise has put into the table is lifted out of it.

    Args:
        recording: What was recorded.
        engine: Physics engine.
        timestep: Time step [s].

    Raises:
        SimulationError: If the engine is unknown or not installed, or the numbers blow up.
    """
    start = recording.poses[0].copy()
    start[2] += max(0.0, -recording.body.lowest(start))
    velocity = estimate_velocity(recording) if recording.velocity is None else recording.velocity
    motion = simulate_free_motion(
        recording.body,
        start,
        float(recording.times[-1]),
        velocity=velocity,
        contact_parameters=recording.contact_parameters,
        engine=engine,
        timestep=timestep,
    ).at(recording.times)
    seen, simulated = quaternion_to_matrix(recording.poses[:, 3:]), quaternion_to_matrix(motion.poses[:, 3:])
    com = recording.body.mass.com
    apart = motion.poses[:, :3] + simulated @ com - recording.poses[:, :3] - seen @ com
    return Replay(
        recording=recording,
        poses=motion.poses,
        position_error=np.linalg.norm(apart, axis=1),
        rotation_error=rotation_angle(seen, simulated),
        down_error=_down_error(seen[-1], simulated[-1], recording.is_round),
    )


def estimate_velocity(recording: Recording) -> Float[np.ndarray, " 6"]:
    """Velocity of the centre of mass [m/s] and angular velocity [rad/s] in the first frame.

    Parabolas are fitted to the centre of mass and to the rotation since the first frame, over the frames of the first
    ``ESTIMATE_TIME``; straight lines where there are fewer than four.
    """
    num = max(int((recording.times <= ESTIMATE_TIME).sum()), min(3, len(recording.times)))
    times, poses = recording.times[:num], recording.poses[:num]
    rotations = quaternion_to_matrix(poses[:, 3:])
    com = poses[:, :3] + rotations @ recording.body.mass.com
    turned = Rotation.from_matrix(rotations @ rotations[0].T).as_rotvec()
    powers = np.vander(times, 3 if num >= 4 else 2, increasing=True)
    solution = np.linalg.lstsq(powers, np.hstack([com, turned]), rcond=None)[0]
    return solution[1]


def _down_error(seen: Float[np.ndarray, "3 3"], simulated: Float[np.ndarray, "3 3"], is_round: bool) -> float:
    """Angle between two downward directions in the object frame [rad]; a cylinder's axis alone counts."""
    first, second = -seen[2], -simulated[2]
    if is_round:
        first, second = ([np.hypot(x, y), 0.0, z] for x, y, z in (first, second))
    return float(np.arccos(np.clip(np.dot(first, second), -1, 1)))
