"""How predictors look in charts: colours, marks, intervals, boxes, labels.

A predictor's colour tells its family, its marker and line style which one it is, so that charts can be read in grey
and by colour-blind readers too. Points are means over the seeds, bars their 95 % bootstrap intervals.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from foretrace.evaluation.statistics import mean_interval
from foretrace.experiments.claims import SUPERVISED, TASK_SPECIFIC, UNSUPERVISED
from foretrace.pictures.scene import GREY, INK


class Look(NamedTuple):
    """How a predictor is drawn everywhere."""

    color: str
    marker: str
    line: Any


BLUE, ORANGE, VERMILLION, GREEN, PURPLE = "#0072b2", "#e69f00", "#d55e00", "#009e73", "#cc79a7"
SKY = "#3d9ad1"
DOTTED, DASHED, SOLID = (0, (1, 1.4)), (0, (4, 1.6)), "-"
LOOKS = {
    "none": Look(INK, "x", SOLID),
    "sc-200": Look(BLUE, "v", DOTTED),
    "sc-800": Look(BLUE, "s", DASHED),
    "sc-3200": Look(BLUE, "^", SOLID),
    "ae-256": Look(ORANGE, "<", DASHED),
    "ae-512": Look(ORANGE, ">", SOLID),
    "sc-cnn": Look(VERMILLION, "P", DASHED),
    "im-cnn": Look(VERMILLION, "o", SOLID),
    "sp-pred": Look(GREEN, "D", DASHED),
    "sp-truth": Look(GREEN, "*", SOLID),
    "sp-rule": Look(PURPLE, "h", DOTTED),
    "one-shot": Look(SKY, "p", SOLID),
    "chance": Look(GREY, "_", DOTTED),
}
"""Every predictor in the order of the paper's figures, then what the paper does not have."""
FAMILIES = {
    "no feature": ("none",),
    "unsupervised": UNSUPERVISED,
    "supervised": SUPERVISED,
    "task-specific": (*TASK_SPECIFIC, "sp-rule"),
    "whole motions": ("one-shot",),
}
GRID = "#e6e8ec"
QUIET = "#5b6472"
REFERENCE: dict[str, Any] = {"color": INK, "linewidth": 0.9, "linestyle": (0, (4, 2))}
"""A number of the paper's."""


def rows_of(table: pd.DataFrame, experiment: str, metric: str, settings: Iterable[str] = ()) -> pd.DataFrame:
    """Rows of one experiment and metric, of known predictors; only some settings, if any are named."""
    wanted = table["experiment"].eq(experiment) & table["metric"].eq(metric) & table["features"].isin(LOOKS)
    if settings := list(settings):
        wanted &= table["setting"].isin(settings)
    return table.loc[wanted & table["value"].notna()]


def present(rows: pd.DataFrame) -> list[str]:
    """Predictors that have rows, in the paper's order."""
    return [name for name in LOOKS if name in set(rows["features"])]


def seeds_in_words(rows: pd.DataFrame) -> str:
    """How many seeds are behind what is drawn; a range where that differs."""
    counts = rows.groupby(["features", "setting"])["seed"].nunique().to_numpy()
    low, high = counts.min(), counts.max()
    return f"{low} to {high} seeds" if low < high else f"{low} seed{'s' if low > 1 else ''}"


def intervals(rows: pd.DataFrame, name: str, settings: Sequence[str], scale: float = 1.0) -> np.ndarray:
    """Mean, low and high of one predictor (settings, 3), NaN where it has no rows."""
    result = np.full((len(settings), 3), np.nan)
    mine = rows.loc[rows["features"].eq(name)]
    for k, setting in enumerate(settings):
        result[k] = mean_interval(mine.loc[mine["setting"].eq(setting), "value"].to_numpy(float))
    return scale * result


def marks(look: Look) -> dict[str, Any]:
    """A predictor's marker, of about the same weight for all."""
    bare = look.marker in "x_"
    return {
        "color": look.color,
        "marker": look.marker,
        "markersize": {"*": 10, "P": 7, "x": 6, "_": 7}.get(look.marker, 5.5),
        "markeredgecolor": look.color if bare else "white",
        "markeredgewidth": 1.6 if bare else 0.5,
    }


def draw_line(ax: Axes, x: Sequence[float], numbers: np.ndarray, look: Look, *, line: bool = True) -> None:
    """Means with their intervals, joined where they are a curve."""
    known = np.isfinite(numbers[:, 0])
    at, (mean, low, high) = np.asarray(x, float)[known], numbers[known].T
    ax.errorbar(
        at, mean, yerr=np.nan_to_num([mean - low, high - mean]), linestyle=look.line if line else "none",
        linewidth=1.7, elinewidth=1.1, capsize=2, zorder=3, **marks(look),
    )  # fmt: skip


def label_ends(ax: Axes, ends: Mapping[str, float]) -> None:
    """Names at the right of the axis beside the ends of their lines, pushed apart where they would collide."""
    low, high = ax.get_ylim()
    gap = 0.062 * (high - low)
    names = sorted(ends, key=ends.__getitem__)
    heights = np.array([ends[name] for name in names])
    for _ in range(100):
        for k in np.flatnonzero(np.diff(heights) < gap):
            middle = heights[k : k + 2].mean()
            heights[k : k + 2] = middle - 0.501 * gap, middle + 0.501 * gap
    beside = ax.get_yaxis_transform()
    for name, y in zip(names, heights, strict=True):
        if name in LOOKS:
            ax.plot(1.035, y, transform=beside, clip_on=False, linestyle="none", **marks(LOOKS[name]))
        else:
            ax.plot([1.015, 1.055], [y, y], transform=beside, clip_on=False, **REFERENCE)
        ax.text(1.07, y, name, transform=beside, color=INK, va="center", fontsize=8.5)


def finish(fig: Figure, title: str, note: str) -> None:
    """Title of the whole picture, and below it in lighter type what its marks mean."""
    fig.suptitle(f"{title}\n", x=0.01, ha="left", fontsize=12, fontweight="bold", linespacing=1.5)
    fig.text(0.01, 0.98 - 0.26 / fig.get_figheight(), note, ha="left", va="top", fontsize=9, color=QUIET)


def grid(ax: Axes, **settings: Any) -> None:
    """Light horizontal lines, an axis from zero, labels."""
    ax.grid(axis="y", color=GRID, linewidth=0.8)
    ax.set_axisbelow(True)
    ax.set(**settings)


def legend(fig: Figure, names: Iterable[str], extra: Sequence[Line2D] = (), *, lines: bool = True) -> None:
    """All predictors that are drawn, below the axes."""
    handles = [
        Line2D([], [], linestyle=LOOKS[name].line if lines else "none", label=name, **marks(LOOKS[name]))
        for name in names
    ]
    fig.legend(handles=[*handles, *extra], loc="outside lower center", ncols=12, columnspacing=1.2)


def reference(ax: Axes, at: float) -> None:
    """A thin line at a number of the paper's."""
    ax.axhline(at, zorder=1, **REFERENCE)


def draw_boxes(ax: Axes, rows: pd.DataFrame, names: Sequence[str], marks: pd.DataFrame | None = None) -> None:
    """A box over the seeds for each predictor, every seed as a dot, families kept together.

    Args:
        ax: Where to draw.
        rows: Errors [cm] of one setting.
        names: Predictors, in order.
        marks: Errors of another setting, drawn as their mean.
    """
    rng = np.random.default_rng(0)
    place, ticks = 0.0, []
    for family, members in FAMILIES.items():
        shown = [name for name in names if name in members]
        if not shown:
            continue
        first = place
        for name in shown:
            values = rows.loc[rows["features"].eq(name), "value"].to_numpy(float)
            draw_box(ax, place, values, LOOKS[name].color, rng)
            if marks is not None and len(other := marks.loc[marks["features"].eq(name), "value"]):
                ax.plot([place - 0.42, place + 0.42], [other.mean()] * 2, color=INK, linewidth=1.8, zorder=4)
            ticks.append((place, name))
            place += 1
        middle = (first + place - 1) / 2
        ax.text(middle, 1.01, family, transform=ax.get_xaxis_transform(), ha="center",
                fontsize=8.5, color=QUIET)  # fmt: skip
        place += 0.6
    grid(ax, ylim=(0, None), xlim=(-0.8, place - 0.8))
    ax.set_xticks(
        [at for at, _ in ticks], [name for _, name in ticks], rotation=35, ha="right", rotation_mode="anchor"
    )
    ax.tick_params(axis="x", length=0)


def draw_box(ax: Axes, at: float, values: np.ndarray, color: str, rng: np.random.Generator) -> None:
    """Quartiles, median, whiskers to the extremes, and every value beside its neighbours."""
    if len(values) >= 4:
        ax.boxplot(
            values, positions=[at], widths=0.62, whis=(0, 100), manage_ticks=False, patch_artist=True,
            boxprops={"facecolor": to_rgba(color, 0.22), "edgecolor": color},
            medianprops={"color": color, "linewidth": 2}, whiskerprops={"color": color}, capprops={"color": color},
        )  # fmt: skip
    elif len(values):
        ax.plot([at - 0.31, at + 0.31], [np.median(values)] * 2, color=color, linewidth=2)
    spread = rng.uniform(-0.16, 0.16, len(values))
    ax.plot(
        at + spread, values, "o", color=color, markersize=3.4, markeredgecolor="white", markeredgewidth=0.4
    )
