"""A rigid body on the table without a tool: it falls, slides, rolls, tips and comes to rest.

What both engines are checked with against mechanics in closed form, and what recorded motions are replayed with.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foretrace.errors import SimulationError
from foretrace.geometry import Numbers, continuous_quaternions
from foretrace.interactions.motions import ContactParameters
from foretrace.objects.body import Body
from foretrace.simulation.engine import ENGINES


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """Where a body was, in the table frame."""

    times: Float[np.ndarray, " time"]
    """Times since the start [s]."""
    poses: Float[np.ndarray, "time 7"]
    """Object frame: position [m], quaternion (w, x, y, z) without jumps of sign."""
    velocities: Float[np.ndarray, "time 6"]
    """Velocity of the centre of mass [m/s], and angular velocity [rad/s]."""

    def at(self, times: Float[np.ndarray, " sample"]) -> "FreeMotion":
        """The motion at other times, interpolated between two steps."""
        columns = np.concatenate([self.poses, self.velocities], axis=1)
        values = np.column_stack([np.interp(times, self.times, column) for column in columns.T])
        values[:, 3:7] /= np.linalg.norm(values[:, 3:7], axis=1, keepdims=True)
        return FreeMotion(np.asarray(times, dtype=float), values[:, :7], values[:, 7:])


DEFAULT_CONTACT = ContactParameters()


def simulate_free_motion(
    body: Body,
    start: Numbers,
    duration: float,
    *,
    velocity: Numbers = (0.0,) * 6,
    contact_parameters: ContactParameters = DEFAULT_CONTACT,
    engine: str = "mujoco",
    timestep: float = 0.002,
) -> FreeMotion:
    """Lets a body go and follows it.

    Args:
        body: The body.
        start: Pose of its object frame in the table frame: position [m], quaternion (w, x, y, z).
        duration: How long to follow it [s]; rounded up to whole time steps.
        velocity: Velocity of its centre of mass [m/s] and angular velocity [rad/s] at the start, table frame.
        contact_parameters: Friction, restitution and gravity.
        engine: One of ENGINES.
        timestep: Time step [s].

    Returns:
        The motion at every time step.

    Raises:
        SimulationError: If the engine is unknown or not installed, a value is out of range, or the numbers blow up.
    """
    pose, speed = np.array(start, dtype=float), np.array(velocity, dtype=float)
    if pose.shape != (7,) or speed.shape != (6,) or not np.isfinite([*pose, *speed]).all():
        raise SimulationError("a start is seven finite numbers (pose) and six (velocity)")
    if abs(np.linalg.norm(pose[3:]) - 1) > 1e-3:
        raise SimulationError(f"quaternion {pose[3:].tolist()} has not the length 1")
    if not (0 < timestep <= 0.02 and 0 <= duration <= 3600):
        raise SimulationError(
            f"timestep = {timestep} s, duration = {duration} s: choose at most 0.02 s and an hour"
        )
    steps = int(np.ceil(duration / timestep - 1e-9))
    poses, velocities = ENGINES.find(engine).play_freely(
        body, pose, speed, contact_parameters, steps, timestep
    )
    if not np.isfinite(poses).all():
        raise SimulationError("the numbers blew up: take a smaller time step")
    poses[:, 3:] = continuous_quaternions(poses[:, 3:])
    return FreeMotion(np.arange(steps + 1) * timestep, poses, velocities)
