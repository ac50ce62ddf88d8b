"""Many interactions from above on one sheet."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from foretrace.errors import DatasetError
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Interaction
from foretrace.pictures.scene import draw_arrow, support_handle
from foretrace.pictures.style import (
    CM,
    GREY,
    INK,
    OBJECT_COLOR,
    OBJECT_EDGE,
    SUPPORT_COLOR,
    headline,
    new_figure,
    outcome_color,
    styled,
)


@styled
def contact_sheet(dataset: Dataset, columns: int = 8, rows: int = 5) -> Figure:
    """Many interactions from above at one scale: outline, action, support points and path by outcome.

    Args:
        dataset: What to show; if it is larger than the sheet, it is sampled evenly.
        columns: Pictures side by side.
        rows: Pictures one above another.

    Raises:
        DatasetError: There is nothing to show.
    """
    if len(dataset) == 0:
        raise DatasetError(f"{dataset.path} has no interaction to show: filter less, or simulate")
    shown = np.unique(np.linspace(0, len(dataset) - 1, min(len(dataset), columns * rows)).round().astype(int))
    columns = min(columns, len(shown))
    rows = -(-len(shown) // columns)
    counts = dataset.outcomes()
    fig = new_figure(1.55 * columns + 0.3, 1.7 * rows + 1.0)
    for cell, k in enumerate(shown):
        _draw_cell(fig.add_subplot(rows, columns, cell + 1), dataset[int(k)])
    title = f"{len(dataset)} interactions, {len(shown)} shown; the bar is 10 cm"
    headline(fig, title)
    handles = [
        Line2D([], [], color=outcome_color(name), linewidth=2.5, label=f"{name}: {count}")
        for name, count in counts.items()
    ]
    handles.append(support_handle())
    fig.legend(handles=handles, loc="outside lower center", ncols=8)
    return fig


def _draw_cell(ax: Axes, interaction: Interaction) -> None:
    """A stamp-sized view from above, the same scale for all."""
    effect = interaction.effect
    color = outcome_color(effect.outcome)
    placement = interaction.action.T_action_object
    outline = (interaction.object.corners @ placement[:2, :2].T + placement[:2, 3]) * CM
    ax.fill(outline[:, 1], outline[:, 0], facecolor=OBJECT_COLOR, edgecolor=OBJECT_EDGE, linewidth=0.9)
    draw_arrow(ax, 1.5)
    points = effect.support_points * CM
    ax.plot(points[:, 1], points[:, 0], color=SUPPORT_COLOR, linewidth=1.5, marker="o", markersize=3)
    path = effect.com_trajectory * CM
    ax.plot(path[:, 1], path[:, 0], color=color, linewidth=2.2)
    middle = (outline[:, 1].min() + outline[:, 1].max()) / 2
    ax.plot([middle + 10.5, middle + 0.5], [-6.5, -6.5], color=GREY, linewidth=1.5)
    ax.set(xlim=(middle + 11, middle - 11), ylim=(-7, 21), aspect="equal")
    ax.axis("off")
    ax.set_title(f"{interaction.id}  {effect.outcome}", fontsize=8, color=INK, fontweight="normal", pad=2)
