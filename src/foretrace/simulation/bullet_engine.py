"""Actions and free motion in Bullet, the paper's physics engine, through pybullet."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from foretrace.actions import Motion, Tool, tool_transforms
from foretrace.errors import SimulationError, shown
from foretrace.geometry import matrix_to_pose, pose_to_matrix
from foretrace.interactions.motions import GRAVITY, ContactParameters
from foretrace.interactions.record import Physics
from foretrace.objects import ObjectModel
from foretrace.objects.body import Body
from foretrace.simulation.bullet_world import World, connect
from foretrace.simulation.engine import (
    SPEED_LIMIT,
    STANDING_DEPTH,
    Engine,
    FreePlay,
    ToolMotion,
    check_divides,
    sample_tool,
)


def play_freely(
    body: Body,
    pose: Float[np.ndarray, " 7"],
    velocity: Float[np.ndarray, " 6"],
    contact_parameters: ContactParameters,
    steps: int,
    timestep: float,
) -> FreePlay:
    """Poses and velocities of a free body, as `simulate_free_motion` describes them."""
    world = World(timestep, contact_parameters.gravity)
    world.add_table(contact_parameters.friction, contact_parameters.rolling_friction)
    thing = world.add_object(body, pose_to_matrix(pose), contact_parameters.restitution or 0.0)
    world.set_velocity(thing, velocity)
    poses, velocities = [], np.empty((steps + 1, 6))
    for i in range(steps + 1):
        if i:
            world.bullet.stepSimulation()
        poses.append(world.centred_pose(thing))
        velocities[i] = world.velocity(thing)
    return world.to_object_frame(thing, poses), velocities


Disturbance = Callable[[World, int, float], None]
"""Does something to a body of a world at a time [s]."""
TOUCH_MARGIN = 0.001
"""Tool and object closer than this touch [m]."""


class BulletEngine(Engine):
    """Bullet.

    The tool is a body of a thousand tonnes that is given the velocity of its path before every step.

    Args:
        embodiment: ``tool``; Bullet has no arm.
        timestep: Time step [s]; divides the sample period.
        sample_period: Time between recorded samples [s].

    Raises:
        SimulationError: If a value does not fit, or pybullet is not installed.
    """

    name, library = "bullet", "pybullet"
    play_freely = staticmethod(play_freely)

    def __init__(
        self, embodiment: str = "tool", timestep: float = 0.002, sample_period: float = 0.05
    ) -> None:
        if embodiment != "tool":
            raise SimulationError(
                f"engine 'bullet' has no embodiment {shown(embodiment)}: "
                "choose embodiment tool (--embodiment tool), or engine mujoco for the arm"
            )
        check_divides(timestep, sample_period)
        connect()
        self.timestep, self.sample_period = timestep, sample_period

    def play(
        self,
        obj: ObjectModel,
        T_action_object: Float[np.ndarray, "4 4"],
        tool: Tool,
        tool_motion: ToolMotion,
        duration: float,
        physics: Physics,
        disturb: Disturbance | None = None,
    ) -> Motion:
        """Plays an action, step by step, as `Engine.play`; a disturbance is called before each step."""
        stride = round(self.sample_period / self.timestep)
        times = np.arange(round(duration / self.sample_period) + 1) * self.sample_period
        tips = sample_tool(tool_motion, times)
        steps = sample_tool(tool_motion, np.arange((len(times) - 1) * stride + 1) * self.timestep)
        velocities = np.diff(steps, axis=0) / self.timestep
        # Gravity acts on the tool as well, before it moves.
        velocities[:, :3] -= np.array(GRAVITY) * self.timestep
        world = World(self.timestep, GRAVITY)
        rolling = physics.rolling_friction if obj.is_round else 0.0
        ground = world.add_table(physics.friction, rolling, physics.table_edge)
        thing = world.add_object(Body.of(obj, physics.density), T_action_object)
        held = world.add_tool(tool, physics.tool_friction, not_against=ground)
        start = matrix_to_pose(tool_transforms(tips[:1])[0])
        world.bullet.resetBasePositionAndOrientation(held, start[:3].tolist(), start[[4, 5, 6, 3]].tolist())
        object_pose, tool_pose = np.zeros((len(times), 7)), np.zeros((len(times), 7))
        on_tool, contacts, speed = np.zeros(len(times), dtype=bool), [], 0.0
        for i in range(len(times)):
            for step in range((i - 1) * stride, i * stride) if i else ():
                world.set_velocity(held, velocities[step])
                if disturb is not None:
                    disturb(world, thing, step * self.timestep)
                world.bullet.stepSimulation()
            object_pose[i], tool_pose[i] = world.pose(thing), world.pose(held)
            on_tool[i] = len(world.bullet.getClosestPoints(thing, held, TOUCH_MARGIN)) > 0
            contacts.append(_standing_points(world, thing, ground[0], object_pose[i]))
            # Written so that NaN is kept.
            speed = np.maximum(speed, np.abs(world.velocity(thing)).max())
        error = np.linalg.norm(tool_pose[:, :3] - tips[:, :3], axis=1).max()
        diverged = not bool(speed < SPEED_LIMIT)
        return Motion(
            times=times,
            object_pose=object_pose,
            tool_pose=tool_pose,
            joints=np.empty((len(times), 0)),
            on_tool=on_tool,
            table_contacts=tuple(contacts),
            path_error=0.0 if diverged else float(error),
            diverged=diverged,
        )


def _standing_points(
    world: World, body: int, table: int, pose: Float[np.ndarray, " 7"]
) -> Float[np.ndarray, "_ 3"]:
    """Where a body stands on the table, in its own frame [m]."""
    world.bullet.performCollisionDetection()
    points = [
        contact[5] for contact in world.bullet.getContactPoints(body, table) if contact[8] < STANDING_DEPTH
    ]
    return (np.array(points).reshape(-1, 3) - pose[:3]) @ pose_to_matrix(pose)[:3, :3]
