"""Styles of what is compared in charts: colours, marks, intervals, boxes, labels.

A colour stands for a family of features or predictors, marker and line style for one of them, so that charts can be
read in grey and by colour-blind readers too. What has no style of its own gets one of the palette. Points are means
over the seeds, bars their 95 % intervals (`foretrace.evaluation.statistics`).
"""

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from foretrace.evaluation.statistics import TEST_TO_TRAIN, interval
from foretrace.pictures.style import GREY, INK


class Style(NamedTuple):
    """How one of the compared is drawn everywhere."""

    color: str
    marker: str
    line: Any


BLUE, ORANGE, VERMILLION, GREEN, PURPLE = "#0072b2", "#e69f00", "#d55e00", "#009e73", "#cc79a7"
SKY = "#3d9ad1"
DOTTED, DASHED, SOLID = (0, (1, 1.4)), (0, (4, 1.6)), "-"
STYLES = {
    "none": Style(INK, "x", SOLID),
    "sc-200": Style(BLUE, "v", DOTTED),
    "sc-800": Style(BLUE, "s", DASHED),
    "sc-3200": Style(BLUE, "^", SOLID),
    "ae-256": Style(ORANGE, "<", DASHED),
    "ae-512": Style(ORANGE, ">", SOLID),
    "sc-cnn": Style(VERMILLION, "P", DASHED),
    "im-cnn": Style(VERMILLION, "o", SOLID),
    "sp-pred": Style(GREEN, "D", DASHED),
    "sp-truth": Style(GREEN, "*", SOLID),
    "sp-rule": Style(PURPLE, "h", DOTTED),
    "one-shot": Style(SKY, "p", SOLID),
    "twin": Style(GREY, "d", DASHED),
    "residual": Style(GREY, "X", DOTTED),
    "twin, arm": Style(GREY, "H", SOLID),
    "chance": Style(GREY, "_", DOTTED),
}
"""What has a style of its own: the paper's features in the order of its figures, then what the paper does not have."""
OTHER = "others"
FAMILIES = {
    "no feature": ("none",),
    "unsupervised": ("sc-200", "sc-800", "sc-3200", "ae-256", "ae-512"),
    "supervised": ("sc-cnn", "im-cnn"),
    "task-specific": ("sp-pred", "sp-truth", "sp-rule"),
    "direct": ("one-shot",),
    "simulated": ("twin", "residual", "twin, arm"),
    OTHER: (),
}
"""What is drawn side by side; `OTHER` takes whatever is in none of them."""
MARKERS = "dHX8<>^v"
MOST_COLUMNS = 12
"""Entries side by side in a legend."""
GRID = "#e6e8ec"
QUIET = "#5b6472"
REFERENCE: dict[str, Any] = {"color": INK, "linewidth": 0.9, "linestyle": (0, (4, 2))}
"""A number of the paper's."""


def style_of(name: str) -> Style:
    """The style of a name; one without a style of its own gets one of the palette, always the same."""
    if name in STYLES:
        return STYLES[name]
    number = zlib.crc32(name.encode())
    palette, lines = (PURPLE, GREEN, ORANGE, SKY, BLUE, VERMILLION), (DASHED, SOLID, DOTTED)
    return Style(
        palette[number % len(palette)], MARKERS[number // 7 % len(MARKERS)], lines[number // 11 % len(lines)]
    )


def family_of(name: str) -> str:
    """Name of the family that one of the compared belongs to."""
    return next((family for family, members in FAMILIES.items() if name in members), OTHER)


def rows_of(table: pd.DataFrame, experiment: str, metric: str, settings: Iterable[str] = ()) -> pd.DataFrame:
    """Rows of one comparison and metric; only some settings, if any are named."""
    wanted = table["experiment"].eq(experiment) & table["metric"].eq(metric)
    if settings := list(settings):
        wanted &= table["setting"].isin(settings)
    return table.loc[wanted & table["value"].notna()]


def present(rows: pd.DataFrame) -> list[str]:
    """What has rows: in the paper's order, then in that of the rows."""
    found = dict.fromkeys(rows["features"])
    return [*(name for name in STYLES if name in found), *(name for name in found if name not in STYLES)]


def seeds_in_words(rows: pd.DataFrame) -> str:
    """How many seeds are behind what is drawn; a range where that differs."""
    counts = rows.groupby(["features", "setting"])["seed"].nunique().to_numpy()
    low, high = counts.min(), counts.max()
    return f"{low} to {high} seeds" if low < high else f"{low} seed{'s' if low > 1 else ''}"


def intervals(
    rows: pd.DataFrame,
    name: str,
    settings: Sequence[str],
    scale: float = 1.0,
    ratio: Callable[[str], float] = lambda setting: TEST_TO_TRAIN,
) -> np.ndarray:
    """Mean, low and high of one of the compared (settings, 3), NaN where it has no rows."""
    result = np.full((len(settings), 3), np.nan)
    mine = rows.loc[rows["features"].eq(name)]
    for k, setting in enumerate(settings):
        values = mine.loc[mine["setting"].eq(setting), "value"].to_numpy(float)
        result[k] = interval(values, ratio(setting))[:3]
    return scale * result


def marks(style: Style) -> dict[str, Any]:
    """A marker, of about the same weight for all."""
    bare = style.marker in "x_"
    return {
        "color": style.color,
        "marker": style.marker,
        "markersize": {"*": 10, "P": 7, "x": 6, "_": 7}.get(style.marker, 5.5),
        "markeredgecolor": style.color if bare else "white",
        "markeredgewidth": 1.6 if bare else 0.5,
    }


def draw_line(ax: Axes, x: Sequence[float], numbers: np.ndarray, style: Style, *, line: bool = True) -> None:
    """Means with their intervals, joined where they are a curve."""
    known = np.isfinite(numbers[:, 0])
    at, (mean, low, high) = np.asarray(x, float)[known], numbers[known].T
    ax.errorbar(
        at, mean, yerr=np.nan_to_num([mean - low, high - mean]), linestyle=style.line if line else "none",
        linewidth=1.7, elinewidth=1.1, capsize=2, zorder=3, **marks(style),
    )  # fmt: skip


def label_ends(ax: Axes, ends: Mapping[str, float], references: Mapping[str, float] | None = None) -> None:
    """Names at the right of the axis beside the ends of their lines, pushed apart where they would collide."""
    references = references or {}
    ends = {**ends, **references}
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
        if name in references:
            ax.plot([1.015, 1.055], [y, y], transform=beside, clip_on=False, **REFERENCE)
        else:
            ax.plot(1.035, y, transform=beside, clip_on=False, linestyle="none", **marks(style_of(name)))
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


def mesh(ax: Axes) -> None:
    """Light lines in both directions."""
    ax.grid(color=GRID, linewidth=0.6)
    ax.set_axisbelow(True)


def legend(fig: Figure, names: Iterable[str], extra: Sequence[Line2D] = (), *, lines: bool = True) -> None:
    """All that is drawn, below the axes."""
    handles = [
        Line2D(
            [], [], linestyle=style_of(name).line if lines else "none", label=name, **marks(style_of(name))
        )
        for name in names
    ]
    shown = [*handles, *extra]
    fig.legend(handles=shown, loc="outside lower center", ncols=columns_of(len(shown)), columnspacing=1.2)


def columns_of(count: int) -> int:
    """Columns of a legend with a number of entries: its rows differ in length as little as possible."""
    lines = max(1, -(-count // MOST_COLUMNS))
    return max(1, -(-count // lines))


def reference(ax: Axes, at: float) -> None:
    """A thin line at a number of the paper's."""
    ax.axhline(at, zorder=1, **REFERENCE)


def draw_boxes(ax: Axes, rows: pd.DataFrame, names: Sequence[str], marks: pd.DataFrame | None = None) -> None:
    """A box over the seeds for each predictor, every seed as a dot; marks are drawn as their mean. Errors in cm."""
    rng = np.random.default_rng(0)
    place, ticks = 0.0, []
    for family in FAMILIES:
        shown = [name for name in names if family_of(name) == family]
        if not shown:
            continue
        first = place
        for name in shown:
            values = rows.loc[rows["features"].eq(name), "value"].to_numpy(float)
            draw_box(ax, place, values, style_of(name).color, rng)
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
