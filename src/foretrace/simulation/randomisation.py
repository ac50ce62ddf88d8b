"""Actions that differ from their nominal ones: domain randomisation (paper, section 6).

The draws of an action depend on the data set's seed and its own number alone, and those of one quantity do not depend
on which others vary.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from foretrace.actions import CONTACT_TOLERANCE, PushPath, ToolPath
from foretrace.errors import SimulationError, check_ranges, is_number, shown, wrong_type
from foretrace.interactions.record import ExecutionOffset, Physics
from foretrace.objects import Bevel, Box, ObjectModel, Prism, Weighted
from foretrace.objects.model import inner_radius

AnyPath = TypeVar("AnyPath")
Range = tuple[float, float]
"""Least and greatest value of what is drawn uniformly."""
LARGEST = {
    "execution_ahead": CONTACT_TOLERANCE,
    "execution_left": CONTACT_TOLERANCE,
    "execution_turn": 0.5,
}
"""Largest execution errors [m, rad]: beyond them it is another action."""


@dataclass(frozen=True)
class Randomisation:
    """What is drawn anew for every action; by default nothing.

    Thickness and bevel are those of prisms and boxes. Cylinders and meshes have neither and stay as they are.

    Raises:
        SimulationError: A range is empty or holds impossible values.
    """

    friction: Range | None = None
    """Friction coefficients between object and table; None leaves the configured one."""
    tool_friction: Range | None = None
    """Friction coefficients between object and blade."""
    density: Range | None = None
    """Densities of the object [kg/m^3]."""
    thickness_factor: Range | None = None
    """Times the object's height."""
    bevel_width_factor: Range | None = None
    """Times the width of its bevel: how far the bottom face lies inside the outline."""
    bevel_height_factor: Range | None = None
    """Times the height of its bevel: how much room the blade has under the rim."""
    execution_ahead: float = 0.0
    """Largest distance of the blade ahead of the commanded contact, or behind [m]."""
    execution_left: float = 0.0
    """Largest distance to either side of it [m]."""
    execution_turn: float = 0.0
    """Largest angle to either side of the commanded direction [rad]."""
    insertion: Range | None = None
    """Distances that the blade is pushed under the object [m]; None leaves the configured path."""
    arc_radius: Range | None = None
    """Radii of the arc on which it lifts [m]."""
    sweep: Range | None = None
    """Angles of that arc [rad]."""
    speed: Range | None = None
    """Multiples of the configured speed. The blade rests at the end until the slowest one would be there, too."""
    com_offset: float | None = None
    """Largest offset of the centre of mass of prisms and boxes, as a share of the radius of the widest circle inside
    the outline. Half of the objects stay uniform, as all do with None."""
    execution_share: float | None = None
    """Share of the actions that have an execution error; None: all."""
    distance: Range | None = None
    """Distances of pushes [m]. The rod rests at the end until the longest push would be done, too."""

    def __post_init__(self) -> None:
        for name in RANGES:
            if (limits := getattr(self, name)) is None:
                continue
            pair = isinstance(limits, tuple | list) and len(limits) == 2 and all(map(is_number, limits))
            if not pair:
                raise wrong_type(SimulationError)(
                    f"randomisation: {name} is {shown(limits)}: give a least and a greatest number"
                )
            low, high = limits
            if not 0 < low <= high < np.inf:
                raise SimulationError(
                    f"randomisation: {name} = {low} to {high} is no range of possible values: "
                    "give a least one above 0 and a greatest one"
                )
        limits = {name: (0.0, limit) for name, limit in LARGEST.items()}
        if self.com_offset is not None:
            limits["com_offset"] = (0.0, 0.5)
        if self.execution_share is not None:
            limits["execution_share"] = (0.0, 1.0)
        check_ranges(SimulationError, "randomisation", self, limits)

    def vary(
        self, obj: ObjectModel, physics: Physics, path: AnyPath, rng: np.random.Generator
    ) -> tuple[ObjectModel, Physics, AnyPath, ExecutionOffset]:
        """One action's object, constants, path and execution error.

        Args:
            obj: The object as configured.
            physics: Friction and density as configured.
            path: The tool's path as configured.
            rng: Random numbers: always one for each setting, in their order.

        Raises:
            ShapeError: A thinner object or a wider bevel leaves no bottom face.
            ActionError: No path goes so deep, so far or so fast.
            SimulationError: What is to be drawn is of another action's path.
        """
        # Numbers of its own, which do not move those of other settings.
        (own,) = rng.spawn(1)
        names = [field.name for field in fields(self) if field.name != "distance"]
        shares = dict(zip(names, rng.random(len(names)), strict=True))
        shares["distance"] = own.spawn(1)[0].random()  # a later setting, which moves no other's numbers
        drawn = {
            name: float(limits[0] + shares[name] * (limits[1] - limits[0]))
            for name in RANGES
            if (limits := getattr(self, name)) is not None
        }
        ahead, left, turn = (float(getattr(self, name) * (2 * shares[name] - 1)) for name in LARGEST)
        if self.execution_share is not None and shares["execution_share"] >= self.execution_share:
            ahead = left = turn = 0.0
        constants = {name: drawn[name] for name in CONSTANTS if name in drawn}
        factors = [drawn.get(name, 1.0) for name in FACTORS]
        path = self._drawn_path(path, {name: drawn[name] for name in (*PATH, "speed") if name in drawn})
        varied = reshaped(obj, *factors)
        if self.com_offset is not None:
            varied = off_centre(varied, self.com_offset * max(0.0, 2 * shares["com_offset"] - 1), own)
        return (
            varied,
            replace(physics, **constants),
            path,
            ExecutionOffset(ahead, left, turn),
        )

    def _drawn_path(self, path: Any, drawn: dict[str, float]) -> Any:
        """A path of any action with what was drawn of it; one of another package stays as it is."""
        if odd := [name for name in drawn if name not in OWN_PATH.get(type(path), ())]:
            raise SimulationError(f"{odd[0]} cannot be drawn of a {type(path).__name__}: leave it out")
        if isinstance(path, PushPath):
            if self.distance is None:
                return path
            rest = (self.distance[1] - drawn["distance"]) / path.speed
            return replace(path, distance=drawn["distance"], hold_time=path.hold_time + rest)
        path = replace(path, **{name: value for name, value in drawn.items() if name != "speed"})
        return path if self.speed is None else _sped_up(path, drawn["speed"], slowest=self.speed[0])


def _sped_up(path: ToolPath, speed: float, slowest: float) -> ToolPath:
    """A path at a multiple of its speed, with a rest that makes it end when the slowest one does."""
    rest = path.faster(slowest).duration - path.faster(speed).duration
    return replace(path.faster(speed), hold_time=path.hold_time + rest)


CONSTANTS = ("friction", "tool_friction", "density")
"""What is drawn of `Physics`."""
FACTORS = ("thickness_factor", "bevel_width_factor", "bevel_height_factor")
"""What is drawn of the object's shape."""
PATH = ("insertion", "arc_radius", "sweep", "distance")
"""What is drawn of a path, as it stands there."""
OWN_PATH = {ToolPath: ("insertion", "arc_radius", "sweep", "speed"), PushPath: ("distance",)}
"""What can be drawn of each kind of path."""
RANGES = (*CONSTANTS, *FACTORS, *PATH, "speed")
NOTHING = Randomisation()
"""Every lever-up as commanded, of the nominal object."""
RANDOMISED = Randomisation(
    friction=(0.5, 1.1),
    tool_friction=(0.2, 0.45),
    density=(300.0, 1200.0),
    thickness_factor=(0.75, 1.25),
    bevel_width_factor=(0.8, 1.2),
    bevel_height_factor=(0.8, 1.2),
    execution_ahead=0.003,
    execution_left=0.003,
    execution_turn=float(np.deg2rad(3.0)),
)
"""What ``foretrace simulate --randomise`` draws from: around the nominal constants, as wide as a robot's owner might be
wrong about a slab of wood or plastic, a steel blade and a calibrated camera."""


LARGEST_COM_OFFSET = 1 / 3
"""What ``foretrace simulate --off-centre`` draws up to, as a share of the inner radius."""


def reshaped(obj: ObjectModel, thickness: float, bevel_width: float, bevel_height: float) -> ObjectModel:
    """A prism or box of another height and bevel, by factors; any other object as it is.

    Raises:
        ShapeError: Too thin for its bevel, or no bottom face is left.
    """
    if isinstance(obj, Weighted):
        return Weighted(reshaped(obj.object, thickness, bevel_width, bevel_height), obj.com_offset)
    if not isinstance(obj, Prism) or (thickness, bevel_width, bevel_height) == (1.0, 1.0, 1.0):
        return obj
    height = thickness * obj.height
    bevel = Bevel(bevel_width * obj.bevel.width, bevel_height * obj.bevel.height)
    if isinstance(obj, Box):
        return Box(obj.width, obj.depth, height, bevel)
    return Prism(obj.corners, height, bevel)


def off_centre(obj: ObjectModel, share: float, rng: np.random.Generator) -> ObjectModel:
    """A prism or box whose centre of mass lies off, in any direction; any other object as it is.

    Args:
        obj: The object.
        share: Distance as a share of the radius of the widest circle inside the outline.
        rng: Draws the direction.
    """
    if not isinstance(obj, Prism) or share == 0:
        return obj
    angle = rng.uniform(0, 2 * np.pi)
    return Weighted(obj, share * inner_radius(obj.corners) * np.array([np.cos(angle), np.sin(angle)]))
