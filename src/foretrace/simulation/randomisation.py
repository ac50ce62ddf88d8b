"""Lever-ups that differ from what is told of them: domain randomisation (paper, section 6).

What is drawn for a lever-up depends on the data set's seed and on the lever-up alone, never on who simulates it, and
what is drawn for one quantity does not depend on which others vary.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from foretrace.actions import CONTACT_TOLERANCE
from foretrace.errors import SimulationError
from foretrace.interactions.record import Misplacement, Physics
from foretrace.objects import Bevel, Box, ObjectModel, Prism

Range = tuple[float, float]
"""Least and greatest value of what is drawn uniformly."""
LARGEST = {
    "misplaced_ahead": CONTACT_TOLERANCE,
    "misplaced_left": CONTACT_TOLERANCE,
    "misplaced_turn": 0.5,
}
"""How far a blade may err at most [m, rad]: beyond, it is another action."""


@dataclass(frozen=True)
class Randomisation:
    """What is drawn anew for every lever-up; by default nothing.

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
    misplaced_ahead: float = 0.0
    """The blade meets the object up to this far ahead of where it was told to, or behind [m]."""
    misplaced_left: float = 0.0
    """It meets it up to this far to either side of there [m]."""
    misplaced_turn: float = 0.0
    """It points up to this far to either side of where it was told to [rad]."""

    def __post_init__(self) -> None:
        for name in RANGES:
            if (limits := getattr(self, name)) is None:
                continue
            low, high = limits
            if not 0 < low <= high < np.inf:
                raise SimulationError(
                    f"randomisation: {name} = {low} to {high} is no range of possible values: "
                    "give a least one above 0 and a greatest one"
                )
        for name, limit in LARGEST.items():
            if not 0 <= getattr(self, name) <= limit:
                raise SimulationError(
                    f"randomisation: {name} = {getattr(self, name)} is outside 0 to {limit:g} (SI units)"
                )

    def vary(
        self, obj: ObjectModel, physics: Physics, rng: np.random.Generator
    ) -> tuple[ObjectModel, Physics, Misplacement]:
        """One lever-up's object, constants and misplacement.

        Args:
            obj: The object as configured.
            physics: Friction and density as configured.
            rng: What is drawn from: always one number for each setting, in their order.

        Raises:
            ShapeError: A thinner object or a wider bevel leaves no bottom face.
        """
        shares = dict(zip((field.name for field in fields(self)), rng.random(len(fields(self))), strict=True))
        drawn = {
            name: float(limits[0] + shares[name] * (limits[1] - limits[0]))
            for name in RANGES
            if (limits := getattr(self, name)) is not None
        }
        ahead, left, turn = (float(getattr(self, name) * (2 * shares[name] - 1)) for name in LARGEST)
        constants = {name: drawn[name] for name in CONSTANTS if name in drawn}
        factors = [drawn.get(name, 1.0) for name in FACTORS]
        return reshaped(obj, *factors), replace(physics, **constants), Misplacement(ahead, left, turn)


CONSTANTS = ("friction", "tool_friction", "density")
"""What is drawn of `Physics`."""
FACTORS = ("thickness_factor", "bevel_width_factor", "bevel_height_factor")
"""What is drawn of the object's shape."""
RANGES = CONSTANTS + FACTORS
NOTHING = Randomisation()
"""Every lever-up as told."""
RANDOMISED = Randomisation(
    friction=(0.5, 1.1),
    tool_friction=(0.2, 0.45),
    density=(300.0, 1200.0),
    thickness_factor=(0.75, 1.25),
    bevel_width_factor=(0.8, 1.2),
    bevel_height_factor=(0.8, 1.2),
    misplaced_ahead=0.003,
    misplaced_left=0.003,
    misplaced_turn=float(np.deg2rad(3.0)),
)
"""What ``foretrace simulate --randomise`` draws from: around the usual constants, as wide as a robot's owner might be
wrong about a slab of wood or plastic, a steel blade and a calibrated camera."""


def reshaped(obj: ObjectModel, thickness: float, bevel_width: float, bevel_height: float) -> ObjectModel:
    """A prism or box of another height and bevel, by factors; any other object as it is.

    Raises:
        ShapeError: Too thin for its bevel, or no bottom face is left.
    """
    if not isinstance(obj, Prism) or (thickness, bevel_width, bevel_height) == (1.0, 1.0, 1.0):
        return obj
    height = thickness * obj.height
    bevel = Bevel(bevel_width * obj.bevel.width, bevel_height * obj.bevel.height)
    if isinstance(obj, Box):
        return Box(obj.width, obj.depth, height, bevel)
    return Prism(obj.corners, height, bevel)
