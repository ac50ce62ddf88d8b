"""One scene: table, object, tool on the arm or alone; built in code as one MuJoCo specification.

The scene lies in the action frame, so the tool's path is the same for every object, and the object is placed: its
contact point at the origin, the action's direction along x (paper, section 3.1).
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from foretrace.actions import Tool
from foretrace.geometry import matrix_to_pose
from foretrace.interactions.record import Physics
from foretrace.objects import CollisionShape, HullShape, ObjectModel
from foretrace.simulation.arm import add_arm
from foretrace.simulation.tool import OBJECT_BIT, TABLE_BIT, TOOL_BIT, add_carriage

EMBODIMENTS = ("arm", "tool")
CONTACT_TIME = 0.015
"""Time constant of the contacts' spring and damper [s]; critically damped."""
FRICTION_STIFFNESS = 10.0
"""How much stiffer contacts are along the surface than across it: keeps resting objects from creeping."""
EXACT_TOUCH = 1e-9
"""Tolerance of the contact search where curved surfaces meet flat ones [m]."""
EXACT_ITERATIONS = 100
"""Its largest number of steps."""
TABLE_SIZE = (1.2, 1.0)
"""How far the table reaches behind the contact point and to either side [m]."""
TABLE_THICKNESS = 0.05
"""Thickness of a table with edges [m]."""
TABLE_HEIGHT = 0.75
"""Height of a table with edges above the floor [m]."""


def build_scene(
    obj: ObjectModel | None,
    physics: Physics,
    tool: Tool,
    embodiment: str | None,
    timestep: float,
    coordinates: Sequence[int] = (),
) -> mujoco.MjSpec:
    """A table with the tool and, if given, an object.

    Args:
        obj: The object; None leaves the table empty.
        physics: Friction and density.
        tool: The tool.
        embodiment: ``arm``, ``tool``, or None for a table without a tool.
        timestep: Time step of the simulation [s].
        coordinates: Numbers of the coordinates in which the tool alone moves, as in `add_carriage`.
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
    if physics.table_edge is not None or (obj is not None and obj.is_round):
        # A round object on a board is pushed by errors of a tenth of a millimetre in where they touch.
        option.ccd_tolerance, option.ccd_iterations = EXACT_TOUCH, EXACT_ITERATIONS
    spec.default.geom.solref = [CONTACT_TIME, 1.0]
    spec.visual.headlight.ambient = [0.3, 0.3, 0.3]
    spec.visual.headlight.diffuse = [0.3, 0.3, 0.3]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    world = spec.worldbody
    world.add_light(pos=[-0.3, -0.4, 1.6], dir=[0.2, 0.3, -1], diffuse=[0.4, 0.4, 0.4], specular=[0.1] * 3)
    _add_table(world, physics)
    if obj is not None:
        _add_object(spec, obj, physics)
    if embodiment == "arm":
        add_arm(spec, tool, physics.tool_friction)
    elif embodiment == "tool":
        add_carriage(spec, tool, physics.tool_friction, coordinates)
    return spec


def _add_table(world: mujoco.MjsBody, physics: Physics) -> None:
    """The table top; where its edge is within reach, a board with edges above a floor."""
    common = {
        "friction": [physics.friction, 0.005, physics.rolling_friction],
        "contype": TABLE_BIT,
        "conaffinity": OBJECT_BIT,
        "rgba": [0.86, 0.84, 0.8, 1],
    }
    far, plane = physics.table_edge, mujoco.mjtGeom.mjGEOM_PLANE
    if far is None:
        world.add_geom(name="table", type=plane, size=[TABLE_SIZE[0], TABLE_SIZE[1], 0.01], **common)
        return
    half = [(TABLE_SIZE[0] + far) / 2, TABLE_SIZE[1], TABLE_THICKNESS / 2]
    middle = [far - half[0], 0.0, -half[2]]
    world.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_BOX, pos=middle, size=half, **common)
    # Without a floor a falling object would soon look like a simulation that blew up.
    world.add_geom(name="floor", type=plane, pos=[0, 0, -TABLE_HEIGHT], size=[3, 3, 0.01], **common)


def _add_object(spec: mujoco.MjSpec, obj: ObjectModel, physics: Physics) -> None:
    body = spec.worldbody.add_body(name="object")
    body.add_freejoint()
    properties = obj.mass_properties(physics.density)
    origin = body_origin(obj)
    body.add_site(name="object", pos=-origin)
    body.mass, body.ipos, body.explicitinertial = properties.mass, properties.com - origin, True
    inertia = properties.inertia
    body.fullinertia = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    surface = {
        "friction": [physics.friction, 0.005, 0.0001],
        "contype": OBJECT_BIT,
        "conaffinity": TABLE_BIT | TOOL_BIT,
        "rgba": [0.0, 0.45, 0.7, 1],
    }
    if obj.is_round:
        surface |= {"friction": [physics.friction, 0.005, physics.rolling_friction], "condim": 6}
    add_shapes(spec, body, obj.collision_shapes(), origin, **surface)


def add_shapes(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    shapes: Sequence[CollisionShape],
    origin: Float[np.ndarray, "3"],
    **surface: Any,
) -> None:
    """Adds an object's collision shapes to a body.

    Args:
        spec: The scene.
        body: The body.
        shapes: The shapes, in the object frame.
        origin: Where the body has its origin, in the object frame [m].
        **surface: Fields of every geom.
    """
    for i, shape in enumerate(shapes):
        if isinstance(shape, HullShape):
            spec.add_mesh(name=f"piece_{i}", uservert=np.asarray(shape.vertices, dtype=np.float32).ravel())
            kind = mujoco.mjtGeom.mjGEOM_MESH
            body.add_geom(type=kind, meshname=f"piece_{i}", pos=-origin, **surface)
        else:
            pose = matrix_to_pose(shape.T_object_shape)
            size = [shape.radius, shape.length / 2, 0.0]
            kind = mujoco.mjtGeom.mjGEOM_CYLINDER
            body.add_geom(type=kind, pos=pose[:3] - origin, quat=pose[3:], size=size, **surface)


def body_origin(obj: ObjectModel) -> Float[np.ndarray, "3"]:
    """Where the object's MuJoCo body has its origin, in the object frame [m].

    MuJoCo's contacts are solved for the acceleration of that point; on a rolling object it must not itself go round,
    or the object shakes. So it is the centre of mass of a round object, and the object's own origin otherwise.
    """
    return obj.mass_properties(1.0).com if obj.is_round else np.zeros(3)
