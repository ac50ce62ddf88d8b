"""Pictures of the comparisons with stand-in or recordings: the paper's figure 15, and figure 14's last panel."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from foretrace.experiments.charts import BLUE, GREEN, GRID, VERMILLION, finish, grid
from foretrace.experiments.transfer import Example
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE
from foretrace.pictures.scene import (
    ARROW_LENGTH,
    CM,
    DPI,
    GREY,
    INK,
    OBJECT_EDGE,
    STYLE,
    TOOL_COLOR,
)

HULL_COLOR, MASK_COLOR = "#f3c98b", "#a9bdd3"
BARS = {"predicted": ("distance_predicted_cm", VERMILLION), "simulated": ("distance_simulated_cm", BLUE)}
PATHS: dict[str, tuple[str, Any, float]] = {
    "observed": (GREEN, "-", 2.4),
    "predicted": (VERMILLION, "--", 1.8),
    "simulated": (BLUE, "-.", 1.8),
}
PAPER_MARK: dict[str, Any] = {
    "color": INK, "marker": "D", "markersize": 7, "linestyle": "none", "markeredgecolor": "white", "zorder": 5
}  # fmt: skip
"""A number of the paper's."""
PANEL = 10.0
"""Width of what is shown around paths [cm]."""
PER_ROW = 7
"""Masks side by side."""
PATHS_PER_ROW = 4
"""Panels with paths side by side."""


def objects_figure(
    examples: Sequence[Example], rows: pd.DataFrame, paper: Mapping[str, float] | None = None
) -> Figure:
    """Masks of objects as the predictor sees them, and the errors on each (paper, figure 15).

    Args:
        examples: Every contact of the objects.
        rows: Their lever-ups.
        paper: The paper's errors by object [cm].
    """
    names = list(dict.fromkeys(example.name for example in examples))
    columns = min(len(names), PER_ROW)
    lines = -(-len(names) // columns)
    with mpl.rc_context(STYLE):
        width = max(8.6, 1.75 * columns)
        heights = [width / columns * lines * 0.95, 3.6]
        fig = Figure(figsize=(width, 0.7 + sum(heights)), dpi=DPI, layout="constrained")
        layout = fig.add_gridspec(2, 1, height_ratios=heights)
        above, below = fig.add_subfigure(layout[0]), fig.add_subfigure(layout[1])
        cells = above.subplots(lines, columns, squeeze=False).ravel()
        for ax, name in zip(cells, names, strict=False):
            draw_view(ax, [example for example in examples if example.name == name])
        for ax in cells[len(names) :]:
            ax.axis("off")
        draw_errors(below.subplots(), rows, names, paper or {})
        handles = [
            Patch(color=MASK_COLOR, label="mask that the camera saw"),
            Patch(color=HULL_COLOR, label="added by its convex hull"),
            Line2D([], [], color=OBJECT_EDGE, linewidth=1, label="true outline"),
            Line2D([], [], color=TOOL_COLOR, linewidth=2.4, marker="^", label="contact shown"),
            Line2D([], [], color=INK, marker="o", linestyle="none", markersize=4, label="other contacts"),
        ]
        above.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=8.5)
        shown: list[Patch | Line2D] = [
            Patch(facecolor=color, alpha=0.45, edgecolor=color, label=f"stand-in against {name}")
            for name, (_, color) in BARS.items()
        ]
        if paper:
            shown.append(Line2D([], [], label="paper: real against predicted", **PAPER_MARK))
        note = "bars: mean and standard deviation; dots: single lever-ups"
        below.legend(
            handles=shown, loc="outside lower center", ncols=3, fontsize=8.5, title=note, title_fontsize=8.5
        )
        title = "Objects as the predictor sees them, and the distance of its path from the stand-in's"
        finish(
            fig,
            title,
            "A simulated stand-in for the real robot: Bullet, other friction, errors of contact and camera",
        )
    return fig


def draw_view(ax: Axes, examples: Sequence[Example]) -> None:
    """One object's mask and hull in the action frame of its first contact, action upwards; scales in cm."""
    first = examples[0]
    shown = first.observed.view.mask.astype(int) + first.view.mask
    edge = np.array([-0.5, VIEW_SIZE - 0.5])
    top, bottom = (CONTACT_PIXEL[0] - edge) * METRES_PER_PIXEL * CM
    left, right = (CONTACT_PIXEL[1] - edge) * METRES_PER_PIXEL * CM
    colors = ListedColormap(["white", HULL_COLOR, MASK_COLOR])
    ax.imshow(shown, cmap=colors, vmin=0, vmax=2, extent=(left, right, bottom, top), interpolation="nearest")
    T = first.simulated.action.T_action_object
    outline = first.simulated.object.corners @ T[:2, :2].T + T[:2, 3]
    closed = np.concatenate([outline, outline[:1]]) * CM
    ax.plot(closed[:, 1], closed[:, 0], color=OBJECT_EDGE, linewidth=1)
    contacts = np.array([example.simulated.action.contact for example in examples[1:]])
    if len(contacts):
        others = (contacts @ T[:2, :2].T + T[:2, 3]) * CM
        ax.plot(others[:, 1], others[:, 0], "o", color=INK, markersize=4)
    arrow = {"arrowstyle": "-|>", "color": TOOL_COLOR, "linewidth": 2.4, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", (0, 0), (0, -ARROW_LENGTH * CM), arrowprops=arrow)
    low, high = np.minimum(outline.min(axis=0) * CM, [-5, 0]), outline.max(axis=0) * CM
    middle, half = (low + high) / 2, max((high - low).max() / 2, 9) + 1.5
    ax.set(
        xlim=(middle[1] + half, middle[1] - half), ylim=(middle[0] - half, middle[0] + half), aspect="equal"
    )
    ax.set_title(first.name, loc="center")
    ax.set(xticks=[], yticks=[])
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.plot(
        [middle[1] - half + 5.8, middle[1] - half + 0.8], [middle[0] - half + 0.6] * 2, color=INK, linewidth=2
    )
    ax.text(middle[1] - half + 3.3, middle[0] - half + 1.1, "5 cm", ha="center", fontsize=8, color=INK)


def draw_errors(ax: Axes, rows: pd.DataFrame, names: Sequence[str], paper: Mapping[str, float]) -> None:
    """Mean and standard deviation for each object, every lever-up as a dot, the paper's value as a mark."""
    rng = np.random.default_rng(0)
    labels = []
    for k, name in enumerate(names):
        mine = rows.loc[rows["object"].eq(name)]
        labels.append(name)
        for (kind, (column, color)), shift in zip(BARS.items(), (-0.2, 0.2), strict=True):
            values = mine[column].dropna().to_numpy(float)
            if len(values) == 0:
                continue
            ax.bar(k + shift, values.mean(), width=0.36, color=color, alpha=0.3, edgecolor=color)
            places = k + shift + rng.uniform(-0.12, 0.12, len(values))
            ax.plot(places, values, "o", color=color, markersize=2.6, alpha=0.7, markeredgewidth=0)
            if len(values) > 1:
                sd = values.std(ddof=1)
                ax.errorbar(k + shift, values.mean(), yerr=sd, color=color, capsize=3, linewidth=1.4)
            if name in paper and kind == "predicted":
                ax.plot(k + shift, paper[name], **PAPER_MARK)
                labels[-1] += f"\n{values.mean():.2f} (paper {paper[name]:.2f})"
    grid(ax, ylabel="distance after\ntime warping [cm]", xlim=(-0.6, len(names) - 0.4), ylim=(0, None))
    many = len(names) > PER_ROW
    ax.set_xticks(
        range(len(names)),
        labels,
        rotation=35 if many else 0,
        ha="right" if many else "center",
        rotation_mode="anchor",
    )
    ax.tick_params(axis="x", length=0)
    if not many:
        for label in ax.get_xticklabels():
            label.set_verticalalignment("top")


def paths_figure(
    examples: Sequence[Example],
    observed: str = "stand-in",
    note: str = "The stand-in is Bullet with other constants and errors, not a robot; the table is grey",
) -> Figure:
    """Paths of the centre of mass from the side: observed, predicted, simulated (paper, figure 14, last panel).

    Args:
        examples: What is shown, four in a row.
        observed: What the observed path is called.
        note: What stands under the title.
    """
    columns = min(len(examples), PATHS_PER_ROW)
    lines = -(-len(examples) // columns)
    with mpl.rc_context(STYLE):
        width, height = max(6.8, 3.4 * columns), 1.2 + 3.7 * lines
        fig = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
        cells = fig.subplots(lines, columns, squeeze=False).ravel()
        for ax, example in zip(cells, examples, strict=False):
            draw_example(ax, example)
        for ax in cells[len(examples) :]:
            ax.axis("off")
        handles = [
            Line2D([], [], color=color, linestyle=style, linewidth=width, label=name)
            for name, (color, style, width) in zip(
                (observed, "predicted", "simulated"), PATHS.values(), strict=True
            )
        ]
        fig.legend(handles=handles, loc="outside lower center", ncols=3)
        finish(fig, "Paths of the centre of mass from the side", note)
    return fig


def side_figure(
    observed: Float[np.ndarray, "time 3"], predicted: Float[np.ndarray, "later 3"], title: str
) -> Figure:
    """Observed and predicted path of one recording from the side (paper, figure 14, last panel).

    Args:
        observed: Centre of mass in the action frame [m].
        predicted: The same as it was imagined.
        title: What the recording is called.
    """
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(6.4, 6.4), dpi=DPI, layout="constrained")
        ax = fig.subplots()
        draw_paths(ax, {"observed": observed, "predicted": predicted}, title)
        ax.legend(loc="upper left")
        finish(fig, "Paths of the centre of mass from the side", "The table is grey")
    return fig


def draw_example(ax: Axes, example: Example) -> None:
    """One contact's paths from the side, up to the first slip."""
    effect, observed = example.simulated.effect, example.observed
    end = effect.slip_index
    if observed.slip_time is not None:
        slip = int(np.searchsorted(effect.times, observed.slip_time))
        end = slip if end is None else min(end, slip)
    slipped = "" if observed.slip_time is None else f", slips at {observed.slip_time:.1f} s"
    paths = {
        "observed": observed.com,
        "predicted": example.imagined,
        "simulated": effect.com_trajectory[:end],
    }
    draw_paths(ax, paths, f"{example.name}, contact {example.contact}{slipped}")


def draw_paths(ax: Axes, paths: Mapping[str, Float[np.ndarray, "_ 3"]], title: str) -> None:
    """Paths [m] by what they are, in the x-z plane of the action frame; scales in cm."""
    for name, path in paths.items():
        color, style, width = PATHS[name]
        x, z = path[:, 0] * CM, path[:, 2] * CM
        ax.plot(x, z, color=color, linestyle=style, linewidth=width, zorder=5, label=name)
        ax.plot(x[-1:], z[-1:], "o", color=color, markersize=4.5, zorder=6)
    ax.set_title(title)
    seen = np.concatenate(list(paths.values()))[:, [0, 2]] * CM
    (left, _), (right, top) = seen.min(axis=0), seen.max(axis=0)
    middle = (left + right) / 2
    ax.set(xlim=(middle - PANEL / 2, middle + PANEL / 2), ylim=(-1, max(top + 1, PANEL - 1)))
    ax.set(aspect="equal", xlabel="x, along the action [cm]", ylabel="z, up [cm]")
    ax.axhspan(-1, 0, color="#f1f2f4", zorder=-1)
    ax.axhline(0, color=GREY, linewidth=1.2, zorder=0)
    ax.grid(color=GRID, linewidth=0.6)
    ax.set_axisbelow(True)
