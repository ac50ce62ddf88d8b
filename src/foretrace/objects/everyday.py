"""Flat objects of daily use, and the shapes that the paper prints (paper, section 5.4).

The paper prints a pentagon and a heptagon (tables 1 and 2) and takes a book, a PCB, an HDD and a table-tennis racket
(figure 15) without their dimensions; those here are common sizes. All are slabs with a bevelled lower rim.
"""

from collections.abc import Sequence

import numpy as np

from foretrace.objects.model import fitting_bevel
from foretrace.objects.prism import CIRCLE_RADIUS, Prism
from foretrace.objects.solid import rectangle


def on_circle(degrees: Sequence[int]) -> Prism:
    """A prism with corners at given angles [deg] on the circle that the paper's objects have theirs on."""
    angles = np.deg2rad(np.asarray(degrees, dtype=float))
    return Prism(CIRCLE_RADIUS * np.column_stack([np.cos(angles), np.sin(angles)]))


def slab(length: float, width: float, height: float) -> Prism:
    """A rectangular slab [m]."""
    corners = rectangle(length, width)
    return Prism(corners, height, fitting_bevel(corners, height))


def racket(
    head: tuple[float, float] = (0.157, 0.150),
    handle: tuple[float, float] = (0.1, 0.028),
    height: float = 0.012,
) -> Prism:
    """A table-tennis racket: an ellipse with a straight handle, equally thick all over.

    Args:
        head: Length and width of the blade [m].
        handle: Length and width of the handle [m].
        height: Thickness [m].
    """
    a, b = head[0] / 2, head[1] / 2
    opening = float(np.arcsin(handle[1] / 2 / b))  # the handle leaves the ellipse at this angle from its axis
    angles = np.linspace(-np.pi + opening, np.pi - opening, 25)
    outline = np.column_stack([a * np.cos(angles), b * np.sin(angles)])
    end = -a - handle[0]
    corners = np.concatenate([outline, [[end, handle[1] / 2], [end, -handle[1] / 2]]])
    return Prism(corners, height, fitting_bevel(corners, height))


PENTAGON = on_circle((0, 58, 142, 205, 290))
"""Stands for the paper's printed pentagon: irregular, of the size of its simulated objects."""
HEPTAGON = on_circle((0, 38, 95, 152, 196, 262, 308))
"""Stands for the paper's printed heptagon."""

EVERYDAY = {
    "HDD": (slab(0.147, 0.1016, 0.0261), 0.7),
    "PCB": (slab(0.17, 0.17, 0.008), 0.35),
    "book": (slab(0.21, 0.148, 0.015), 0.37),
    "racket": (racket(), 0.18),
}
"""Everyday objects by name, with their masses [kg].

- HDD: 147 x 101.6 x 26.1 mm, the 3.5-inch form factor (SFF-8301), 0.7 kg.
- PCB: 170 x 170 mm, a mini-ITX board, 0.35 kg. The bare board of 1.6 mm is no thicker than the blade and its
  clearance: with its solder joints and low components it counts as a slab of 8 mm.
- Book: A5 (ISO 216), 210 x 148 mm, 15 mm thick, as dense as paper.
- Racket: blade 157 x 150 mm, handle 100 x 28 mm, 0.18 kg. 12 mm thick: 6 mm of wood and two coverings of 3 mm,
  where the ITTF's laws allow 4 mm each. The handle, in truth thicker, is taken to be as thick as the blade.
"""
