"""Tools: rigid bodies made of simple parts, which engines build and exports draw."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float

from foretrace.errors import ActionError, check_ranges, check_type, shown
from foretrace.registry import Registry

Point = tuple[float, float, float]
"""Coordinates in the tool's frame [m]."""
Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""

STEEL: Colour = (0.75, 0.76, 0.78)
HANDLE: Colour = (0.84, 0.37, 0.0)
HANDLE_RADIUS = 0.012
"""Radius of a tool's handle [m]."""


@dataclass(frozen=True)
class ToolPart:
    """A box or a capsule, in the tool's frame."""

    name: str
    """Name of the part."""
    shape: Literal["box", "capsule"]
    """A box lies along the frame's axes."""
    start: Point
    """Middle of a box, or one end of a capsule's axis [m]."""
    end: Point
    """Half lengths of a box along x, y and z, or the other end of a capsule's axis [m]."""
    radius: float
    """Radius of a capsule [m]; 0 for a box."""
    mass: float
    """Mass [kg]."""
    colour: Colour
    """Colour in pictures."""

    @property
    def length(self) -> float:
        """Length of a capsule's axis [m]; 0 for a box."""
        return 0.0 if self.shape == "box" else float(np.linalg.norm(np.subtract(self.start, self.end)))

    @property
    def pose(self) -> Float[np.ndarray, "7"]:
        """Middle in the tool's frame [m], and quaternion (w, x, y, z) that turns the z axis along a capsule."""
        if self.shape == "box":
            return np.array([*self.start, 1.0, 0.0, 0.0, 0.0])
        start, end = np.array(self.start), np.array(self.end)
        x, y, z = (start - end) / np.linalg.norm(start - end)
        across = float(np.hypot(x, y))
        axis = np.array([-y / across, x / across] if across else [1.0, 0.0])
        turn = [np.sqrt((1 + z) / 2), *(np.sqrt((1 - z) / 2) * axis), 0.0]
        return np.array([*(start + end) / 2, *turn])


TOOLS: Registry[type["Tool"]] = Registry("tool", "foretrace.tools", ActionError)
"""Every tool by its label."""


@dataclass(frozen=True)
class Tool(ABC):
    """What an action touches the object with.

    The tool's frame has its origin at the tip and its x axis along the tool, from the holder to the tip. A subclass is
    a frozen dataclass whose fields are its dimensions in metres; it registers itself by its label.
    """

    label: ClassVar[str]
    """Name in records."""
    touch_margin: ClassVar[float] = 0.0
    """In MuJoCo the tool acts as if it were thicker by this [m]."""
    length: float
    """Distance from the tip to the end in the holder [m]."""

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if "label" in cls.__dict__:
            TOOLS.add(cls.label, cls)

    @abstractmethod
    def parts(self) -> tuple[ToolPart, ...]:
        """Parts of the tool; the first one is at its tip."""

    def to_dict(self) -> dict[str, Any]:
        """Label and dimensions, JSON-able."""
        return {"label": self.label, **asdict(self)}

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> "Tool":
        """The tool that `to_dict` described.

        Raises:
            ActionError: There is no such tool, or a dimension is missing or impossible.
        """
        check_type("tool", content, Mapping, ActionError)
        kind = TOOLS.find(content.get("label"))
        try:
            return kind(**{name: value for name, value in content.items() if name != "label"})
        except TypeError as reason:
            raise ActionError(
                f"tool {shown(kind.label)} cannot be read ({reason}): check its dimensions"
            ) from None


@dataclass(frozen=True)
class Screwdriver(Tool):
    """A flat-blade screwdriver; the tip is the middle of the blade's lower front edge, z points out of its upper face.

    Raises:
        ActionError: A dimension is out of range.
    """

    label = "screwdriver"
    touch_margin = 0.001  # a thin blade that comes under a rim is felt in time
    blade_width: float = 0.0055
    """Width of the blade [m]."""
    blade_thickness: float = 0.001
    """Thickness of the blade [m]."""
    blade_length: float = 0.045
    """Length of the flat blade, from tip to shaft [m]."""
    shaft_radius: float = 0.004
    """Radius of the shaft [m]."""
    length: float = 0.17
    """Distance from the tip to the handle's end in the holder [m]."""

    def __post_init__(self) -> None:
        check_ranges(
            ActionError, "tool", self, dict.fromkeys((field.name for field in fields(self)), (1e-4, 0.5))
        )
        if self.blade_length >= self.length:
            raise ActionError(
                f"tool: blade_length = {self.blade_length} m does not fit in length = {self.length} m"
            )

    def parts(self) -> tuple[ToolPart, ...]:
        """Blade, shaft and handle."""
        radius = self.shaft_radius
        half = (self.blade_length / 2, self.blade_width / 2, self.blade_thickness / 2)
        start = (-self.blade_length - radius, 0.0, radius)
        middle = (-self.blade_length - 0.5 * (self.length - self.blade_length), 0.0, radius)
        end = (-self.length, 0.0, radius)
        return (
            ToolPart("blade", "box", (-half[0], 0.0, half[2]), half, 0.0, 0.01, STEEL),
            ToolPart("shaft", "capsule", start, middle, radius, 0.03, STEEL),
            ToolPart("handle", "capsule", middle, end, HANDLE_RADIUS, 0.08, HANDLE),
        )


@dataclass(frozen=True)
class Rod(Tool):
    """A round rod with a hemispherical tip, for pushes and pokes.

    Raises:
        ActionError: A dimension is out of range.
    """

    label = "rod"
    radius: float = 0.006
    """Radius of the rod [m]."""
    length: float = 0.17
    """Distance from the tip to the end in the holder [m]."""

    def __post_init__(self) -> None:
        check_ranges(ActionError, "tool", self, {"radius": (1e-3, 0.05), "length": (0.02, 0.5)})
        if 2 * self.radius >= self.length:
            raise ActionError(f"tool: radius = {self.radius} m is too large for length = {self.length} m")

    def parts(self) -> tuple[ToolPart, ...]:
        """The rod alone."""
        tip, end = (-self.radius, 0.0, 0.0), (-self.length, 0.0, 0.0)
        return (ToolPart("rod", "capsule", tip, end, self.radius, 0.1, STEEL),)
