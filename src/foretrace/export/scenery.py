"""Colours of what exports draw."""

from foretrace.actions.tool import Colour

OBSERVED: Colour = (0.0, 0.62, 0.45)
IMAGINED: Colour = (0.87, 0.18, 0.0)
OBJECT: Colour = (0.55, 0.68, 0.82)
