"""Draws docs/images/uncertainty.svg: a sketch of futures, regions and observed samples; nothing in it was measured."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from foretrace.interactions.record import Outcome
from foretrace.pictures.style import GREY, INK, OUTCOME_COLORS, STYLE

LEVERED, SLIPPED = OUTCOME_COLORS[Outcome.LEVERED], OUTCOME_COLORS[Outcome.SLIPPED]
SEEN = 12
"""Samples that are observed in the second panel."""


def main() -> None:
    """Draw it."""
    time = np.linspace(0, 1, 40)
    angle = np.radians(15 + 38 * time)
    lifted = 7 * np.column_stack([-np.cos(angle), np.sin(angle)])
    back = np.clip((time - 0.5) / 0.5, 0, 1)[:, None] ** 1.5
    fallen = lifted * (1 - back) + np.array([-4.9, 1.5]) * back + np.array([0.0, 0.15])
    with mpl.rc_context(STYLE | {"svg.hashsalt": "uncertainty"}):
        fig = Figure(figsize=(9.6, 3.9), layout="constrained")
        before, after = fig.subplots(1, 2, sharey=True)
        _future(before, lifted, 0.2 + 0.4 * time, LEVERED, "levered: 0.8")
        _future(before, fallen, 0.2 + 0.55 * time, SLIPPED, "slipped: 0.2", "--")
        before.set_title("Before the action: two futures")
        path = lifted * (1 + 0.03 * time[:, None])
        ahead = np.clip(np.arange(40) - SEEN, 0, None) / 28
        _future(after, path[SEEN - 1 :], 0.03 + 0.3 * ahead[SEEN - 1 :], LEVERED, "levered: 0.97")
        after.plot(*path[:SEEN].T, "o", color=INK, markersize=4)
        after.annotate(
            "observed samples", path[4], (-5.2, 1.2), color=INK, fontsize=9,
            arrowprops={"arrowstyle": "-", "color": GREY},
        )  # fmt: skip
        after.set_title(f"Under way, after {SEEN} samples: one is left")
        before.annotate(
            "prediction region: the whole motion stays\nin one of the tubes with the level's probability",
            lifted[33] + [-0.35, 0.35], (-7.9, 6.45), color=INK, fontsize=9, va="center",
            arrowprops={"arrowstyle": "-", "color": GREY},
        )  # fmt: skip
        for ax in (before, after):
            ax.plot(*lifted[0], "s", color=INK, markersize=6, zorder=5)
            ax.plot(0, 0, "^", color=INK, markersize=8, clip_on=False)
            ax.text(-0.15, 0.3, "pivot edge", ha="right", fontsize=9)
            ax.axhline(0, color=GREY, linewidth=1)
            ax.set(xlim=(-8.1, 0.4), ylim=(-0.1, 7.1), aspect="equal", xlabel="along the action [cm]")
        before.text(*(lifted[0] + [-0.9, -0.75]), "centre of mass at rest", fontsize=9, va="center")
        before.set_ylabel("up [cm]")
        fig.savefig(Path(__file__).with_name("uncertainty.svg"), metadata={"Date": None})


def _future(ax: Axes, path: np.ndarray, radius: np.ndarray, color: str, text: str, line: str = "-") -> None:
    """A motion (time, 2), its tube of these radii (time,), and its probability at its end."""
    steps = shapely.linestrings(np.stack([path[:-1], path[1:]], axis=1))
    tube = shapely.unary_union(shapely.buffer(steps, radius[1:])).simplify(0.01)
    ax.fill(*np.transpose(tube.exterior.coords), color=color, alpha=0.22, linewidth=0)
    ax.plot(*path.T, color=color, linewidth=2.2, linestyle=line)
    ax.annotate(
        text, path[-1], (18, -2), textcoords="offset points", color=INK, fontsize=10, fontweight="bold"
    )


if __name__ == "__main__":
    main()
