"""What a predictor says beside one motion: what else may happen, how sure it is, and what is unusual."""

from typing import TYPE_CHECKING

import numpy as np

from foretrace.cli.console import say
from foretrace.imagined.shown import LEVEL, in_order, percentage, radius_of

if TYPE_CHECKING:
    from foretrace.imagined import ImaginedEffect


def say_futures(imagined: "ImaginedEffect") -> None:
    """Print outcomes, support edge if there is one, and radius; what is unusual goes to the terminal as warnings."""
    for warning in imagined.warnings:
        say(f"warning: {warning}")
    futures = imagined.futures
    if futures.is_point:
        return
    probable = sorted(futures.outcomes().items(), key=lambda item: -item[1][0])
    print("outcome: " + ", ".join(f"{name} {percentage(probability[0])}" for name, probability in probable))
    ends = 100 * futures.support_points[0, in_order(futures)[0]]
    if np.isfinite(ends).all():
        (x0, y0), (x1, y1) = ends
        print(
            f"turns about the edge from x {x0:.1f}, y {y0:.1f} to x {x1:.1f}, y {y1:.1f} cm in the action frame"
        )
    radius = radius_of(imagined)
    told = "not known: the validation part was too small" if radius is None else f"{100 * radius[-1]:.2f} cm"
    print(f"radius of the {LEVEL:.0%} region at the end: {told}")
