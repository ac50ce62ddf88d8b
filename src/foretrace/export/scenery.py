"""What exports draw beside the object: colours, and the screwdriver in parts."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from foretrace.actions import Screwdriver

Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""

OBSERVED: Colour = (0.0, 0.62, 0.45)
IMAGINED: Colour = (0.87, 0.18, 0.0)
OBJECT: Colour = (0.55, 0.68, 0.82)
STEEL: Colour = (0.75, 0.76, 0.78)
HANDLE: Colour = (0.84, 0.37, 0.0)
HANDLE_RADIUS = 0.012
"""Radius of the handle [m]."""


class ToolPart(NamedTuple):
    """A part of the screwdriver, in the blade tip's frame."""

    shape: Literal["box", "cylinder"]
    """A cylinder lies along the blade, the frame's x axis."""
    centre: Float[np.ndarray, "3"]
    """Its middle [m]."""
    size: Float[np.ndarray, "3"]
    """Whole lengths along x, y and z [m]."""
    colour: Colour


SCREWDRIVER = Screwdriver()


def tool_parts(tool: Screwdriver = SCREWDRIVER) -> tuple[ToolPart, ToolPart, ToolPart]:
    """Blade, shaft and handle of a screwdriver."""
    shaft_end = -tool.blade_length - 0.5 * (tool.length - tool.blade_length)
    blade = np.array([tool.blade_length, tool.blade_width, tool.blade_thickness])
    return (
        ToolPart("box", blade * [-0.5, 0.0, 0.5], blade, STEEL),
        _rod(-tool.blade_length, shaft_end, tool.shaft_radius, tool.shaft_radius, STEEL),
        _rod(shaft_end, -tool.length, tool.shaft_radius, HANDLE_RADIUS, HANDLE),
    )


def _rod(start: float, end: float, height: float, radius: float, colour: Colour) -> ToolPart:
    centre = np.array([(start + end) / 2, 0.0, height])
    return ToolPart("cylinder", centre, np.array([abs(end - start), 2 * radius, 2 * radius]), colour)
