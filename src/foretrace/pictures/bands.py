"""Prediction bands: the region about the most probable path, and the less probable ones."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import shapely
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from foretrace.pictures.style import CM

BAND = {"alpha": 0.18, "linewidth": 0}
UP = 2
"""Coordinate above the table."""
FAR = 1e3
THIN = {"linewidth": 1.0, "linestyle": (0, (2, 1.5))}


@dataclass(frozen=True)
class PredictionBand:
    """What may happen beside one imagined path; empty for a predictor of one path."""

    path: Float[np.ndarray, "time 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """The path of the centre of mass [m]."""
    radius: Float[np.ndarray, " time"] | None = None
    """Radius of the region about it [m], if it is known."""
    level: float = 0.9
    """Probability of the region."""
    others: Sequence[tuple[str, Float[np.ndarray, "time 3"]]] = ()
    """Less probable paths [m], each with what it is."""

    def draw_in_plane(self, ax: Axes, columns: Sequence[int], color: str) -> Float[np.ndarray, "n 2"]:
        """Draw into a picture of two coordinates in cm.

        Args:
            ax: The picture.
            columns: Which coordinates go to the right and up.
            color: The colour of the path.

        Returns:
            Points that enclose what was drawn, in the order of ``columns`` [m].
        """
        drawn = [np.zeros((0, 2)), *(path[:, columns] for _, path in self.others)]
        for path in drawn:
            ax.plot(*path.T * CM, color=color, zorder=3.5, **THIN)
        along = () if self.radius is None else zip(self.path[:, columns], self.radius, strict=True)
        discs = [shapely.Point(*point).buffer(radius) for point, radius in along]
        swept = shapely.union_all([shapely.union(a, b).convex_hull for a, b in pairwise(discs)])
        if columns[1] == UP and len(self.path):
            swept = shapely.intersection(swept, shapely.box(-FAR, self._ground, FAR, FAR))
        for part in shapely.get_parts(swept):
            ring = shapely.get_coordinates(part.exterior)
            ax.fill(*ring.T * CM, facecolor=color, zorder=3, **BAND)
            drawn.append(ring)
        return np.concatenate(drawn)

    def draw_over_time(self, ax: Axes, times: Float[np.ndarray, " time"], column: int, color: str) -> None:
        """Draw one coordinate, in cm, over time."""
        for _, path in self.others:
            ax.plot(times, path[:, column] * CM, color=color, **THIN)
        if self.radius is not None:
            low, high = (self.path[:, column] + sign * self.radius for sign in (-1, 1))
            if column == UP:
                low = np.maximum(low, self._ground)
            ax.fill_between(times, low * CM, high * CM, facecolor=color, **BAND)

    @property
    def _ground(self) -> float:
        """Height below which nothing is [m]: the table's, unless the path itself leads below it."""
        return float(min(0.0, self.path[:, UP].min()))

    def handles(self, color: str) -> list[Line2D | Patch]:
        """Legend entries."""
        handles: list[Line2D | Patch] = []
        if self.radius is not None:
            handles.append(Patch(facecolor=color, label=f"region of {self.level:.0%}", **BAND))
        if self.others:
            label = f"less probable: {', '.join(name for name, _ in self.others)}"
            handles.append(Line2D([], [], color=color, label=label, **THIN))
        return handles
