"""One scene: table, object, screwdriver on the arm or alone; built in code as one MuJoCo specification.

The scene lies in the action frame, so the tool path is the same for every object and it is the object that is
placed: its contact point at the origin, the action's direction along x (paper, section 3.1).
"""

# pyright: reportAttributeAccessIssue=false
# MuJoCo is a compiled module without type stubs.

import mujoco
import numpy as np

from foretrace.interactions.record import Physics
from foretrace.objects import ObjectModel
from foretrace.simulation.arm import add_arm
from foretrace.simulation.tool import OBJECT_BIT, TABLE_BIT, TOOL_BIT, Tool, add_carriage

EMBODIMENTS = ("arm", "tool")
CONTACT_TIME = 0.015
"""Time constant of the contacts' spring and damper [s]; critically damped."""
FRICTION_STIFFNESS = 10.0
"""How much stiffer contacts are along the surface than across it: keeps resting objects from creeping."""


def build_scene(
    obj: ObjectModel | None, physics: Physics, tool: Tool, embodiment: str | None, timestep: float
) -> mujoco.MjSpec:
    """A table with the tool and, if given, an object.

    Args:
        obj: The object; None leaves the table empty.
        physics: Friction and density.
        tool: Dimensions of the screwdriver.
        embodiment: ``arm``, ``tool``, or None for a table without a tool.
        timestep: Time step of the simulation [s].
    """
    spec = mujoco.MjSpec()
    spec.modelname = "foretrace"
    spec.compiler.degree = False
    option = spec.option
    option.timestep = timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = FRICTION_STIFFNESS
    # A diverged simulation must stay visible instead of being reset in silence.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.default.geom.solref = [CONTACT_TIME, 1.0]
    spec.visual.headlight.ambient = [0.3, 0.3, 0.3]
    spec.visual.headlight.diffuse = [0.3, 0.3, 0.3]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    world = spec.worldbody
    world.add_light(pos=[-0.3, -0.4, 1.6], dir=[0.2, 0.3, -1], diffuse=[0.4, 0.4, 0.4], specular=[0.1] * 3)
    world.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[1.2, 1.0, 0.01],
        friction=[physics.friction, 0.005, 0.0001],
        contype=TABLE_BIT,
        conaffinity=OBJECT_BIT,
        rgba=[0.86, 0.84, 0.8, 1],
    )
    if obj is not None:
        _add_object(spec, obj, physics)
    if embodiment == "arm":
        add_arm(spec, tool, physics.tool_friction)
    elif embodiment == "tool":
        add_carriage(spec, tool, physics.tool_friction)
    return spec


def _add_object(spec: mujoco.MjSpec, obj: ObjectModel, physics: Physics) -> None:
    body = spec.worldbody.add_body(name="object")
    body.add_freejoint()
    properties = obj.mass_properties(physics.density)
    body.mass, body.ipos, body.explicitinertial = properties.mass, properties.com, True
    inertia = properties.inertia
    body.fullinertia = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    for i, vertices in enumerate(obj.convex_pieces()):
        spec.add_mesh(name=f"piece_{i}", uservert=np.asarray(vertices, dtype=np.float32).ravel())
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"piece_{i}",
            friction=[physics.friction, 0.005, 0.0001],
            contype=OBJECT_BIT,
            conaffinity=TABLE_BIT | TOOL_BIT,
            rgba=[0.0, 0.45, 0.7, 1],
        )
