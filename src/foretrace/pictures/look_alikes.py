"""The paper's figure 16 as a picture: one outline from above, several heights, several outcomes."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MultipleLocator

from foretrace.errors import DatasetError
from foretrace.interactions.record import Interaction
from foretrace.interactions.topdown import TopDownView
from foretrace.pictures.scene import ARROW_LENGTH, draw_arrow, draw_instant, draw_table, silhouette
from foretrace.pictures.style import (
    CM,
    OUTCOME_COLORS,
    headline,
    new_figure,
    styled,
)

MARGIN = 0.02
"""Table shown around the objects [m]."""
BLADE_SHOWN = 0.75
"""The blade is left out once it is higher than this part of the picture."""
INSTANTS = 6
"""Moments of each motion that are drawn."""
MASK_COLORS = ListedColormap(["white", "#4a6078"])
HEIGHT_COLORS = "cividis"


@styled
def non_flat_figure(interactions: Mapping[str, Interaction]) -> Figure:
    """Lever-ups of objects that look alike from above: mask, height map and motion of each, in one row.

    Args:
        interactions: What happened, by the name of the object. Their masks should be equal: that is the point.

    Raises:
        DatasetError: There is nothing to draw, or a simulation failed.
    """
    if not interactions:
        raise DatasetError("no interaction to draw: give at least one")
    for name, interaction in interactions.items():
        if len(interaction.effect.times) == 0:
            raise DatasetError(f"{name}: interaction {interaction.id} failed, it has no motion to draw")
    shown = list(interactions.items())
    views = [interaction.view for _, interaction in shown]
    window, highest = _window(views), max(float(view.height.max()) for view in views)
    span = _side_span([interaction for _, interaction in shown])
    width = (span[1] - span[0]) / (span[3] - span[2])
    fig = new_figure(12.6, 0.9 + 2.35 * len(shown))
    axes = fig.subplots(len(shown), 3, squeeze=False, width_ratios=[1.0, 1.0, 1.15 * width])
    images = []
    for (mask, height, side), (name, interaction) in zip(axes, shown, strict=True):
        view = interaction.view
        _draw_map(mask, view, window, view.mask, 1.0, MASK_COLORS)
        images.append(_draw_map(height, view, window, view.height * CM, highest * CM, HEIGHT_COLORS))
        _draw_motion(side, interaction, span)
        mask.set_title(f"{name[:1].upper()}{name[1:]}: mask")
        mask.set_ylabel("x, along the action [cm]")
        height.set_title("Height map")
    for ax in axes[:-1].ravel():
        ax.set_xlabel("")
    fig.colorbar(images[0], ax=axes[:, 1], label="height [cm]", shrink=0.7, aspect=28)
    headline(fig, _headline(views))
    return fig


def _headline(views: list[TopDownView]) -> str:
    differing = sum(int((view.mask != views[0].mask).sum()) for view in views)
    if differing == 0:
        return "The same projection, different outcomes: the masks are equal in every pixel"
    return f"Different outcomes; the masks differ in {differing} pixels"


def _window(views: list[TopDownView]) -> tuple[float, float, float, float]:
    """Range of x and y that all masks and the action's arrow need [m]."""
    seen = np.concatenate([view.to_metres(np.argwhere(view.mask).astype(float)) for view in views])
    low, high = seen.min(axis=0) - MARGIN, seen.max(axis=0) + MARGIN
    return min(low[0], -ARROW_LENGTH - 0.01), high[0], low[1], high[1]


def _draw_map(
    ax: Axes,
    view: TopDownView,
    window: tuple[float, float, float, float],
    values: np.ndarray,
    highest: float,
    colors: str | ListedColormap,
) -> AxesImage:
    """A picture of the view in metres: the action points up, y to the left."""
    corners = view.to_metres(np.array([[-0.5, -0.5], [len(values) - 0.5, len(values) - 0.5]])) * CM
    (top, left), (bottom, right) = corners
    image = ax.imshow(
        np.where(view.mask, values, 0 if colors is MASK_COLORS else np.nan),
        extent=(left, right, bottom, top),
        cmap=colors,
        vmin=0,
        vmax=highest,
        interpolation="nearest",
    )
    draw_arrow(ax, 2.2, 0.3)
    x0, x1, y0, y1 = (CM * value for value in window)
    ax.set(xlim=(y1, y0), ylim=(x0, x1), xlabel="y, to the left [cm]")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MultipleLocator(5))
    return image


def _side_span(interactions: list[Interaction]) -> tuple[float, float, float, float]:
    """Range of x and z that all motions need from the side [m]."""
    rings = [
        ring
        for interaction in interactions
        for pose in interaction.effect.pose_trajectory[::4]
        for ring in silhouette(interaction.object, pose)
    ]
    points = np.concatenate(rings)
    (x0, z0), (x1, z1) = points.min(axis=0), points.max(axis=0)
    return min(x0, -0.06) - 0.01, x1 + 0.01, min(z0, 0.0) - 0.012, z1 + 0.012


def _draw_motion(ax: Axes, interaction: Interaction, span: tuple[float, float, float, float]) -> None:
    """Silhouettes from light to dark with their times, the blade, and the path of the centre of mass."""
    effect = interaction.effect
    color = OUTCOME_COLORS[effect.outcome]
    moved = np.flatnonzero(np.linalg.norm(effect.com_trajectory - effect.com_trajectory[0], axis=1) > 1e-3)
    first = int(moved[0]) if len(moved) else 0
    travelled = np.abs(np.diff(effect.com_trajectory[first:], axis=0)).sum(axis=1).cumsum()
    # Equally far apart along the path, not in time: a rolling object slows down.
    steps = np.linspace(0, travelled[-1], INSTANTS) if len(travelled) else np.zeros(1)
    chosen = np.unique(first + np.searchsorted(travelled, steps[:-1]))
    chosen = np.append(chosen, len(effect.times) - 1)
    draw_table(ax, -100 * span[2] * CM)
    for strength, k in zip(np.linspace(0.25, 1.0, len(chosen)), chosen, strict=True):
        tool = effect.tool_trajectory[k]
        shown = tool if tool[2] < BLADE_SHOWN * span[3] else None
        draw_instant(ax, interaction.object, effect.pose_trajectory[k], shown, strength, 2.0)
    path = effect.com_trajectory * CM
    ax.plot(path[:, 0], path[:, 2], color=color, linewidth=2.2, zorder=4)
    ax.plot(path[chosen, 0], path[chosen, 2], color=color, marker="o", markersize=3.5, linestyle="", zorder=5)
    distance = float(np.linalg.norm(path[-1] - path[0]))
    where = f"{distance:.1f} cm away after {effect.times[-1]:.1f} s"
    ax.set_title(f"From the side: {effect.outcome}, the centre of mass is {where}")
    x0, x1, z0, z1 = (CM * value for value in span)
    ax.set(
        xlim=(x0, x1), ylim=(z0, z1), aspect="equal", xlabel="x, along the action [cm]", ylabel="z, up [cm]"
    )
