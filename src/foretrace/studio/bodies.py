"""What requests to the service may hold, all bounded, and how the library's own things are made of it."""

from dataclasses import MISSING, fields
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter

from foretrace.actions import LeverUp, ToolPath
from foretrace.errors import PlanningError
from foretrace.imagined.context import CONSTANTS
from foretrace.objects import Bevel, Box, Cylinder, ObjectModel, Prism
from foretrace.objects.prism import DEFAULT_HEIGHT
from foretrace.planning import PlanConfig, goals
from foretrace.studio.shapes import MOST_CORNERS, prism_of

Number = Annotated[FiniteFloat, Field(ge=-1e6, le=1e6)]
"""Anything in SI units: larger numbers are mistakes, and overflow when they are squared."""
Point = Annotated[list[Number], Field(min_length=2, max_length=2)]
Pose = Annotated[list[float], Field(min_length=7, max_length=7)]
Matrix = Annotated[
    list[Annotated[list[Number], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)
]
ConstantName = Literal["friction", "tool_friction", "density", "contact_error", "bevel_width", "bevel_height"]
GoalName = Literal["lift", "tilt", "tumble", "turn-over", "move", "move-to", "turn", "slide-off"]
MOST_KEPT = 32
"""Objects that are kept for further requests about them, at most."""
MOST_SAMPLES = 1000
"""Samples in one request, at most."""
assert set(CONSTANTS) == set(ConstantName.__args__)


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class PrismBody(_Body):
    """An outline, extruded."""

    kind: Literal["prism"]
    """An outline, extruded."""
    corners: Annotated[list[Point], Field(min_length=3, max_length=MOST_CORNERS)]
    """Corners x, y of the outline in the object's frame [m]."""
    height: Number = DEFAULT_HEIGHT
    """Height [m]."""
    bevel: Point | None = None
    """Width and height of the chamfer at its lower rim [m]; by default one that fits."""

    def make(self) -> ObjectModel:
        """The object."""
        corners = np.array(self.corners)
        if self.bevel is None:
            return prism_of(corners, self.height)
        return Prism(corners, self.height, Bevel(*self.bevel))


class BoxBody(_Body):
    """A box."""

    kind: Literal["box"]
    """A box."""
    length: Number
    """Along x [m]."""
    width: Number
    """Along y [m]."""
    height: Number
    """Height [m]."""

    def make(self) -> ObjectModel:
        """The object."""
        return Box(self.length, self.width, self.height)


class CylinderBody(_Body):
    """A cylinder that lies on its side."""

    kind: Literal["cylinder"]
    """A cylinder that lies on its side."""
    radius: Number
    """Radius [m]."""
    length: Number
    """Length [m]."""

    def make(self) -> ObjectModel:
        """The object."""
        return Cylinder(self.radius, self.length)


ObjectBody = Annotated[PrismBody | BoxBody | CylinderBody, Field(discriminator="kind")]


@lru_cache(maxsize=MOST_KEPT)
def _object(text: str) -> ObjectModel:
    body: PrismBody | BoxBody | CylinderBody = TypeAdapter(ObjectBody).validate_json(text)
    return body.make()


class ActionBody(_Body):
    """A lever-up on the object."""

    contact: Point
    """Point x, y of the outline where the blade meets it, in the object's frame [m]."""
    direction: Point | None = None
    """Direction x, y of the action there, in the object's frame; by default the inward normal at
    the nearest point of the outline."""
    insertion: Number = ToolPath.insertion
    """Distance that the blade is pushed under the object [m]."""
    arc_radius: Number = ToolPath.arc_radius
    """Radius of the arc on which it lifts [m]."""
    sweep: Number = ToolPath.sweep
    """Angle of that arc [rad]."""
    speed: Number = 1.0
    """Speed, as a multiple of the nominal one."""

    def make(self, obj: ObjectModel) -> LeverUp:
        """The lever-up."""
        path = ToolPath.of(self.speed, insertion=self.insertion, arc_radius=self.arc_radius, sweep=self.sweep)
        if self.direction is None:
            return LeverUp.nearest(obj, self.contact, path=path)
        action = LeverUp(self.contact, self.direction, path)
        action.check_contact(obj)
        return action


ContextBody = dict[ConstantName, Number] | Literal["unknown"] | None


class Known(_Body):
    """An object, and what is known of its physics."""

    object: ObjectBody
    """The object."""
    context: ContextBody = None
    """Constants that are known, by name: friction, tool_friction, density [kg/m^3], contact_error, bevel_width,
    bevel_height [m]; null: the nominal ones; ``unknown``: none."""

    def make_object(self) -> ObjectModel:
        """The object; for a description that was sent lately the same again, with all that is known of its shape."""
        return _object(self.object.model_dump_json())


class PredictBody(Known):
    """What is to be predicted."""

    action: ActionBody
    """The lever-up."""
    level: Annotated[FiniteFloat, Field(ge=0.01, le=0.99)] = 0.9
    """Probability of the region whose radii are given."""
    most_futures: Annotated[int, Field(ge=1, le=16)] = 3
    """So many of the most probable futures are given, at most."""


class GoalBody(_Body):
    """What is to happen, in the object's frame; each goal has entries of its own, those of its class in `ft.goals`."""

    name: GoalName
    """Which goal."""
    max_slip: Number | None = None
    """lift, tilt, move: largest accepted probability of a slip."""
    at_least: Number | None = None
    """lift, move: rise or distance from which on the goal counts as reached [m]."""
    angle: Number | None = None
    """tilt: angle to the horizontal; turn: turn to the left about the vertical [rad]."""
    edge: int | None = None
    """turn-over: the outline's edge to turn over; edge k runs from corner k to corner k + 1."""
    direction: Point | None = None
    """turn-over, move: direction x, y."""
    position: Point | None = None
    """move-to: where the centre of mass shall end, x, y [m]."""
    turn: Number | None = None
    """move-to: turn about the vertical at the end [rad]."""
    tolerance: Number | None = None
    """tilt, turn [rad], move-to [m]: deviation up to which the goal counts as reached."""
    point: Point | None = None
    """slide-off: a point x, y of the table's edge [m]."""
    outward: Point | None = None
    """slide-off: direction x, y off the table."""

    def make(self) -> goals.Goal:
        """The goal.

        Raises:
            PlanningError: An entry is missing, or belongs to another goal.
        """
        kind: Any = goals.GOALS.find(self.name)
        given = {
            name: value for name, value in self.model_dump(exclude={"name"}).items() if value is not None
        }
        known = {each.name: each for each in fields(kind)}
        for name in given:
            if name not in known:
                raise PlanningError(f"the goal {self.name} has no {name}: leave it out")
        for name, each in known.items():
            if each.default is MISSING and each.default_factory is MISSING and name not in given:
                raise PlanningError(f"the goal {self.name} needs its {name}")
        return kind(**given)


class PlanBody(Known):
    """What is to be planned."""

    goal: GoalBody
    """What is to happen."""
    spacing: Annotated[FiniteFloat, Field(ge=0.002, le=0.1)] = 0.005
    """Distance of contacts along the outline [m]."""
    refine: Annotated[int, Field(ge=0, le=4)] = 2
    """Rounds of refinement."""
    check: Annotated[int, Field(ge=0, le=8)] = 8
    """Number of the best candidates that the twin checks."""
    seed: Annotated[int, Field(ge=0, le=2**31)] = 0
    """Decides what is drawn."""
    T_table_object: Matrix | None = None
    """The object's frame in the table frame, where the plan is for a robot: rows of a homogeneous matrix [m]."""

    def config(self) -> PlanConfig:
        """How candidates are searched."""
        return PlanConfig(spacing=self.spacing, refine=self.refine, check=self.check, seed=self.seed)


class MonitorBody(Known):
    """What is to be watched."""

    action: ActionBody
    """The lever-up."""
    worlds: Annotated[int, Field(ge=0, le=256)] = 128
    """Worlds of a belief over friction, density and execution error, of which the context has what is known; 0: what
    is predicted in the context alone."""
    false_alarms: Number = 0.05
    """Share of whole normal executions that alarm, at most."""
    rest: Annotated[list[Number], Field(min_length=7, max_length=7)] | None = None
    """Pose of the object's frame at rest, where it is known, as in samples."""
    T_table_action: Matrix | None = None
    """The action frame in the table frame, where poses are tracked in the table frame: rows of a homogeneous matrix
    [m]."""
    clock_error: Number = 0.0
    """Largest error of the tracker's clock [s]."""


class Sample(_Body):
    """One tracked sample."""

    t: float
    """Time since the moment before the blade moves [s]."""
    pose: Pose | None
    """Position x, y, z [m] and quaternion w, x, y, z of the object's frame, in the action frame, or in the table frame
    where T_table_action was given; null: the tracker lost it."""


class SamplesBody(_Body):
    """Tracked samples, in the order of their times."""

    samples: Annotated[list[Sample], Field(min_length=1, max_length=MOST_SAMPLES)]
    """The samples."""
