"""Free motion in MuJoCo, on the table of the lever-ups."""

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from foretrace.actions import Screwdriver
from foretrace.geometry import quaternion_to_matrix
from foretrace.interactions.motions import ContactParameters
from foretrace.interactions.record import Physics
from foretrace.objects import HullShape
from foretrace.objects.body import Body
from foretrace.simulation.scene import add_shapes, build_scene
from foretrace.simulation.tool import OBJECT_BIT, TABLE_BIT

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
STRONGEST_DAMPING = 3.0
"""Damping ratio beyond which a contact that has given way hardly recovers."""
SHORTEST_CONTACT = 2.2
"""Least time constant of a contact [time steps]: at MuJoCo's limit of 2 an impact overshoots by 5 % of its speed."""


def play_freely(
    body: Body,
    pose: Float[np.ndarray, " 7"],
    velocity: Float[np.ndarray, " 6"],
    contact_parameters: ContactParameters,
    steps: int,
    timestep: float,
) -> tuple[Float[np.ndarray, "time 7"], Float[np.ndarray, "time 6"]]:
    """Poses and velocities of a free body, as `simulate_free_motion` describes them."""
    model = _compile(body, contact_parameters, timestep)
    data = mujoco.MjData(model)
    rotation, com = quaternion_to_matrix(pose[3:]), body.mass.com
    # The free joint is at the centre of mass, in the object's directions.
    data.qpos[:] = [*(pose[:3] + rotation @ com), *pose[3:]]
    data.qvel[:] = [*velocity[:3], *(rotation.T @ velocity[3:])]
    state = np.empty(mujoco.mj_stateSize(model, STATE))
    mujoco.mj_getState(model, data, state, STATE)
    states = state[None]
    if steps:
        later, _ = rollout.rollout(model, data, initial_state=state[None], nstep=steps)
        states = np.vstack([states, np.asarray(later)[0]])
    qpos, qvel = states[:, 1:8], states[:, 8:14]
    rotations = quaternion_to_matrix(qpos[:, 3:])
    positions = qpos[:, :3] - rotations @ com
    spins = np.einsum("tij,tj->ti", rotations, qvel[:, 3:])
    return np.hstack([positions, qpos[:, 3:]]), np.hstack([qvel[:, :3], spins])


def _compile(body: Body, contact_parameters: ContactParameters, timestep: float) -> mujoco.MjModel:
    friction = [contact_parameters.friction, 0.005, contact_parameters.rolling_friction]
    spec = build_scene(None, Physics(friction=contact_parameters.friction), Screwdriver(), None, timestep)
    spec.option.gravity = contact_parameters.gravity
    table = spec.geom("table")
    table.friction = friction
    surface = {"friction": friction, "contype": OBJECT_BIT, "conaffinity": TABLE_BIT}
    if contact_parameters.restitution is not None:
        table.solref = surface["solref"] = _bouncing(contact_parameters.restitution, timestep)
    part = spec.worldbody.add_body(name="object")
    part.add_freejoint()
    # Without a position MuJoCo drops the directions of the principal axes.
    part.mass, part.ipos, part.explicitinertial = body.mass.mass, np.zeros(3), True
    part.fullinertia = body.mass.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    # Rolling friction is for cylinders: boxes and hulls do not roll.
    rolls = contact_parameters.rolling_friction > 0 and not any(isinstance(s, HullShape) for s in body.shapes)
    add_shapes(spec, part, body.shapes, body.mass.com, condim=6 if rolls else 3, **surface)
    return spec.compile()


def _bouncing(restitution: float, timestep: float) -> list[float]:
    """Time constant [s] and damping ratio of contacts that return this share of an impact's speed.

    MuJoCo has no coefficient of restitution: its contacts are a spring and a damper that push but never pull. They
    are made as stiff as the time step bears. Contacts of ``STRONGEST_DAMPING`` return the
    least, 1 to 2 %.
    """
    # A spring and damper that let go when their force vanishes (Schwager and Poeschel, 2007), below and above
    # critical damping.
    below, above = np.linspace(1e-4, 0.9999, 10000), np.linspace(1.0001, STRONGEST_DAMPING, 2000)
    root, slow = np.sqrt(1 - below**2), np.sqrt(above**2 - 1)
    returned = np.exp(
        np.concatenate(
            [
                -below / root * np.arctan2(2 * below * root, 2 * below**2 - 1),
                above / slow * np.log((above - slow) / (above + slow)),
            ]
        )
    )
    damping = float(np.concatenate([below, above])[np.argmin(np.abs(returned - restitution))])
    return [timestep * max(2 / damping, SHORTEST_CONTACT), damping]
