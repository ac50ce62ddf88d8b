"""Draws docs/images/one-shot.png: how the direct trajectory predictor processes a view."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import shapely
import torch
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Polygon, Rectangle

from foretrace.actions import LeverUp
from foretrace.features.pivot_edges import NUM_VALUES, RIM, find_pivot_edges
from foretrace.features.support_points import HALF_WIDTH, SETBACK
from foretrace.interactions.hull import fit_hull
from foretrace.interactions.topdown import METRES_PER_PIXEL, TopDownView
from foretrace.objects import Prism
from foretrace.pictures.style import INK, OBJECT_COLOR, OBJECT_EDGE, STYLE, TOOL_COLOR

CORNERS = np.array(
    [[0.055, -0.045], [0.075, 0.012], [0.03, 0.055], [-0.03, 0.045], [-0.06, -0.01], [-0.035, -0.05]]
)
FIRST, SECOND = "#0072b2", "#d55e00"


def main() -> None:
    """Draw it."""
    prism = Prism(CORNERS, 0.02)
    action = LeverUp.at_edge(prism, 4, 0.6)
    view = TopDownView.of(prism, action)
    hull = fit_hull(view.mask)
    T = action.T_action_object
    com = T[:3, :3] @ prism.mass_properties(1.0).com + T[:3, 3]
    rows = np.repeat(hull[:1], 24, axis=0)
    rows[: len(hull)] = hull
    edges = find_pivot_edges(torch.from_numpy(rows[None]), torch.from_numpy(com[None]))
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(12, 4.3), layout="constrained")
        left, middle, right = fig.subplots(1, 3, width_ratios=[1, 1, 1.15])
        _pixels(left, view, hull)
        _pivot_edges(middle, hull, com, edges)
        _futures(right)
        fig.savefig(Path(__file__).with_name("one-shot.png"), dpi=110)


def _frame(ax, title: str) -> None:
    ax.set(aspect="equal", xlim=(-0.085, 0.085), ylim=(-0.05, 0.165), xticks=[], yticks=[])
    ax.set_title(title, loc="left")
    for side in ax.spines.values():
        side.set_visible(False)
    ax.grid(False)


def _blade(ax) -> None:
    ax.add_patch(Rectangle((-HALF_WIDTH, -0.045), 2 * HALF_WIDTH, 0.045, color=TOOL_COLOR, zorder=4))
    ax.text(0.012, -0.037, "blade", color=TOOL_COLOR, fontsize=10)


def _pixels(ax, view: TopDownView, hull: np.ndarray) -> None:
    points = view.to_metres(np.argwhere(view.mask).astype(float))
    side = METRES_PER_PIXEL
    for x, y in points:
        ax.add_patch(
            Rectangle((-y - side / 2, x - side / 2), side, side, facecolor="#b8c4d2", ec="white", lw=0.5)
        )
    ax.add_patch(Polygon(hull[:, ::-1] * [-1, 1], fill=False, edgecolor=OBJECT_EDGE, lw=2))
    ax.plot(-hull[:, 1], hull[:, 0], "o", color=OBJECT_EDGE, ms=4)
    _blade(ax)
    _frame(ax, "1  From mask to hull")


def _pivot_edges(ax, hull: np.ndarray, com: np.ndarray, edges) -> None:
    ax.add_patch(Polygon(hull[:, ::-1] * [-1, 1], facecolor=OBJECT_COLOR, alpha=0.3, edgecolor=OBJECT_EDGE))
    bottom = shapely.get_coordinates(shapely.Polygon(hull).buffer(-RIM, join_style="mitre"))
    ax.plot(-bottom[:, 1], bottom[:, 0], color=OBJECT_EDGE, lw=1, ls=(0, (1, 1.5)))
    ax.text(-0.046, 0.018, "bottom face", color=OBJECT_EDGE, fontsize=9, ha="right")
    lift = np.array([-SETBACK, HALF_WIDTH * np.sign(com[1])])
    ray = com[:2] - lift
    end = com[:2] + 0.75 * ray
    ax.plot([-lift[1], -end[1]], [lift[0], end[0]], color=INK, lw=1, ls=(0, (4, 2)))
    ax.plot(-com[1], com[0], "o", color=INK, ms=6)
    ax.text(-com[1] + 0.006, com[0] - 0.002, "centre\nof mass", fontsize=10, va="center")
    for k, (color, name) in enumerate(((FIRST, "first pivot edge"), (SECOND, "second pivot edge"))):
        a, b = edges.ends[0, k].numpy()
        ax.plot([-a[1], -b[1]], [a[0], b[0]], color=color, lw=4, solid_capstyle="round")
        out = edges.axes[0, 0, k, 0, :2].numpy()
        at = (a + b) / 2
        ax.add_patch(
            FancyArrowPatch((-at[1], at[0]), (-at[1] - 0.03 * out[1], at[0] + 0.03 * out[0]), color=color,
                            arrowstyle="-|>", mutation_scale=12)
        )  # fmt: skip
        spot = at + 0.034 * out
        ax.text(-spot[1], spot[0], name, color=color, fontsize=10, ha="center", va="bottom")
    _blade(ax)
    _frame(ax, f"2  Two pivot edges, {NUM_VALUES} numbers each")


def _futures(ax) -> None:
    boxes = (
        (FIRST, 2.05, ("probability", "weights of 32 PCA components", "predicted error scale")),
        (SECOND, 0.55, ("probability", "weights of 32 PCA components", "predicted error scale")),
    )
    for color, y, words in boxes:
        ax.add_patch(Rectangle((0, y), 1.55, 0.8, facecolor="white", edgecolor=color, lw=1.8))
        ax.text(0.775, y + 0.4, "5 networks,\nalso in the mirror", ha="center", va="center", fontsize=10)
        for k, word in enumerate(words):
            ax.text(2.02, y + 0.72 - 0.32 * k, word, va="center", fontsize=10)
        ax.add_patch(
            FancyArrowPatch((1.6, y + 0.4), (1.95, y + 0.4), color=color, arrowstyle="-|>", mutation_scale=13)
        )
    ax.text(0, 0.1, "one row for each pivot edge and outcome: a future", fontsize=10, color=INK)
    ax.set(
        xlim=(-0.1, 4.6), ylim=(-0.1, 3.1), title="3  Futures that exclude each other", xticks=[], yticks=[]
    )
    for side in ax.spines.values():
        side.set_visible(False)
    ax.grid(False)


if __name__ == "__main__":
    main()
