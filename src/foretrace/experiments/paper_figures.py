"""The paper's figures 9 to 13, drawn from the long table of results: table to picture, nothing else.

A figure draws whatever rows there are, says how many seeds are behind it, and is None if there is nothing to draw.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from foretrace.evaluation.charts import (
    GRID,
    draw_boxes,
    draw_line,
    finish,
    grid,
    intervals,
    label_ends,
    legend,
    present,
    reference,
    rows_of,
    seeds_in_words,
    style_of,
)
from foretrace.experiments.paper_claims import (
    AUTOENCODERS,
    PAIRS,
    SHAPE_CONTEXTS,
    SIZES,
    SUPERVISED,
    TASK_SPECIFIC,
)
from foretrace.experiments.paper_comparisons import COMPARISONS
from foretrace.pictures.style import INK, new_figure, styled

PANELS = {
    "Shape context": SHAPE_CONTEXTS,
    "Autoencoder": AUTOENCODERS,
    "Supervised": SUPERVISED,
    "Support points": (*TASK_SPECIFIC, "sp-rule"),
    "Direct": ("one-shot",),
    "Simulated": ("twin", "twin, arm"),
}
"""Predictors that share a panel where there is one for each family."""
ERRORS = {"full": "error, full trajectory [cm]", "final": "error, final position [cm]"}
STEPS = ("2", "3", "4", "5")
PAPER_ACCURACY, PAPER_NOVEL_ACCURACY = 93.0, 89.0
"""What the paper's text gives for figures 9a and 9b [%]."""
BACKGROUND = "#cdd2da"


def last(numbers: np.ndarray) -> float:
    """The last mean there is."""
    return float(numbers[np.isfinite(numbers[:, 0])][-1, 0])


@styled
def figure_9a(table: pd.DataFrame) -> Figure | None:
    """Accuracy of predicted support points against the size of the training set."""
    rows = rows_of(table, "support-points", "accuracy")
    if rows.empty:
        return None
    settings = sorted(set(rows["setting"]), key=float)
    x = [float(setting) for setting in settings]
    fig = new_figure(7.2, 4.4)
    ax = fig.add_subplot()
    grid(ax, ylim=(0, 103), xlim=(0, 103), xlabel="training interactions used [%]", ylabel="accuracy [%]")
    ends = {}
    for name in present(rows):
        numbers = intervals(rows, name, settings, 100.0, COMPARISONS["support-points"].ratio)
        draw_line(ax, x, numbers, style_of(name))
        ends[name] = last(numbers)
    reference(ax, PAPER_ACCURACY)
    label_ends(ax, ends, {"paper: 93 %": PAPER_ACCURACY})
    finish(fig, "Support points predicted correctly", f"means and 95 % intervals over {seeds_in_words(rows)}")
    return fig


@styled
def figure_9b(table: pd.DataFrame) -> Figure | None:
    """Accuracy of predicted support points on corner counts that were not learned from."""
    rows = rows_of(table, "support-points-novel", "accuracy", PAIRS)
    if rows.empty:
        return None
    fig = new_figure(7.2, 4.4)
    ax = fig.add_subplot()
    grid(ax, ylim=(0, 103), ylabel="accuracy [%]", xlabel="corner counts held out of the training")
    names = present(rows)
    draw_groups(ax, rows, names, scale=100.0)
    reference(ax, PAPER_NOVEL_ACCURACY)
    label_ends(ax, {}, {"paper: 89 %": PAPER_NOVEL_ACCURACY})
    legend(fig, names, lines=False)
    finish(fig, "Support points predicted correctly, novel corner counts",
           f"means and 95 % intervals over {seeds_in_words(rows)}")  # fmt: skip
    return fig


def draw_groups(ax: Axes, rows: pd.DataFrame, names: Sequence[str], scale: float = 1.0) -> np.ndarray:
    """A group of points for each held-out pair, one for each predictor; returns their offsets in a group."""
    offsets = np.linspace(-0.36, 0.36, len(names)) if len(names) > 1 else np.zeros(1)
    if len(names) <= 3:
        offsets = offsets * 0.6
    for name, offset in zip(names, offsets, strict=True):
        numbers = intervals(rows, name, PAIRS, scale, COMPARISONS["novel-corners"].ratio)
        draw_line(ax, [float(k + offset) for k in range(len(PAIRS))], numbers, style_of(name), line=False)
    for k in range(len(PAIRS) - 1):
        ax.axvline(k + 0.5, color=GRID, linewidth=0.8)
    ax.set(xticks=range(len(PAIRS)), xticklabels=[pair.replace("&", " and ") for pair in PAIRS])
    ax.set(xlim=(-0.5, len(PAIRS) - 0.5))
    ax.tick_params(axis="x", length=0)
    return offsets


@styled
def figure_10(table: pd.DataFrame, metric: str) -> Figure | None:
    """Errors of all predictors on the paper's split: the boxes of figure 10."""
    rows = rows_of(table, "features", metric, ["shuffled"])
    if rows.empty:
        return None
    ahead = rows_of(table, "half-plane", metric, ["shuffled"])
    fig = new_figure(7.6, 4.5)
    ax = fig.add_subplot()
    draw_boxes(ax, rows, present(rows), ahead)
    ax.set_ylabel(ERRORS[metric])
    note = f"boxes, whiskers to the extremes, and every seed; {seeds_in_words(rows)}"
    if not ahead.empty:
        note += f"; black: mean, half plane ahead only, {seeds_in_words(ahead)}"
    finish(fig, f"Prediction {ERRORS[metric].removesuffix(' [cm]')}", note)
    return fig


@styled
def figure_10_by_object(table: pd.DataFrame) -> Figure | None:
    """The same errors where no object is in two parts, beside the paper's split."""
    by_object = {metric: rows_of(table, "features", metric, ["by-object"]) for metric in ERRORS}
    if all(rows.empty for rows in by_object.values()):
        return None
    fig = new_figure(13.2, 4.5)
    axes = fig.subplots(1, 2, sharey=True)
    for ax, (metric, rows) in zip(axes, by_object.items(), strict=True):
        draw_boxes(ax, rows, present(rows), rows_of(table, "features", metric, ["shuffled"]))
        ax.set_ylabel(ERRORS[metric])
    axes[0].set_ylim(0, 1.08 * max(rows["value"].max() for rows in by_object.values()))
    finish(fig, "Prediction error on objects that were not learned from",
           f"boxes, whiskers to the extremes, and every seed; {seeds_in_words(pd.concat(by_object.values()))}; "
           "black: mean with all interactions shuffled, as in the paper")  # fmt: skip
    return fig


def draw_panels(
    rows: pd.DataFrame, experiment: str, settings: Sequence[str], title: str, **axis: Any
) -> Figure:
    """Curves of all predictors, a panel for each family; the others are behind them in grey."""
    x = [float(setting) for setting in settings]
    ratio = COMPARISONS[experiment].ratio
    numbers = {name: intervals(rows, name, settings, ratio=ratio) for name in present(rows)}
    in_some = {"none", *chain(*PANELS.values())}
    families = PANELS | {"Others": tuple(name for name in numbers if name not in in_some)}
    panels = {title: [name for name in names if name in numbers] for title, names in families.items()}
    panels = {title: names for title, names in panels.items() if names} or {"No feature": []}
    fig = new_figure(max(13.2, 3.0 * len(panels)), 4.3)
    axes = fig.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    top = 1.06 * max(np.nanmax(part) for part in numbers.values())
    for ax, (family, names) in zip(axes, panels.items(), strict=True):
        shown = [name for name in ("none", *names) if name in numbers]
        for name, values in numbers.items():
            if name not in shown:
                known = np.isfinite(values[:, 0])
                ax.plot(np.asarray(x)[known], values[known, 0], color=BACKGROUND, linewidth=1, zorder=1)
        grid(ax, ylim=(0, top), title=family)
        for name in shown:
            draw_line(ax, x, numbers[name], style_of(name))
        label_ends(ax, {name: last(numbers[name]) for name in shown})
        ax.set(**axis)
    axes[0].set_ylabel(ERRORS["full"])
    note = f"means and 95 % intervals over {seeds_in_words(rows)}; grey: the other families"
    finish(fig, f"Error against the {title}", note)
    return fig


@styled
def figure_11(table: pd.DataFrame) -> Figure | None:
    """Error against the size of the training set."""
    rows = rows_of(table, "training-size", "full", SIZES)
    if rows.empty:
        return None
    fig = draw_panels(
        rows, "training-size", SIZES, "size of the training set", xlabel="data used for training [%]"
    )
    for ax in fig.axes:
        ax.set_xscale("log", base=2)
        ax.set_xticks([float(size) for size in SIZES], SIZES)
        ax.minorticks_off()
    return fig


@styled
def figure_12(table: pd.DataFrame) -> Figure | None:
    """Error against the number of states predicted at once."""
    several = rows_of(table, "steps-ahead", "full", STEPS)
    if several.empty:
        return None
    one = rows_of(table, "features", "full", ["shuffled"]).assign(setting="1")
    rows = pd.concat([one.merge(several[["features", "seed"]].drop_duplicates()), several])
    axis = {"xticks": range(1, 6), "xlim": (0.7, 5.3), "xlabel": "states predicted at once, n"}
    return draw_panels(rows, "steps-ahead", ("1", *STEPS), "number of states predicted at once", **axis)


@styled
def figure_13(table: pd.DataFrame) -> Figure | None:
    """Error on corner counts that were not learned from."""
    rows = rows_of(table, "novel-corners", "full", PAIRS)
    if rows.empty:
        return None
    shuffled = rows_of(table, "features", "full", ["shuffled"])
    names = present(rows)
    fig = new_figure(13.2, 4.9)
    ax = fig.add_subplot()
    for name, offset in zip(names, draw_groups(ax, rows, names), strict=True):
        mean = shuffled.loc[shuffled["features"].eq(name), "value"].mean()
        for k in range(len(PAIRS)):
            ax.plot(
                [k + offset - 0.022, k + offset + 0.022], [mean, mean], color=INK, linewidth=1.3, zorder=2
            )
    grid(ax, ylim=(0, None), ylabel=ERRORS["full"], xlabel="corner counts held out of the training")
    mark = Line2D([], [], color=INK, linewidth=1.3, label="all shuffled")
    legend(fig, names, [] if shuffled.empty else [mark], lines=False)
    note = f"means and 95 % intervals over {seeds_in_words(rows)}"
    if not shuffled.empty:
        note += "; short black lines: the same predictor with all interactions shuffled (figure 10a)"
    finish(fig, "Error on corner counts that were not learned from", note)
    return fig


FIGURES: dict[str, Callable[[pd.DataFrame], Figure | None]] = {
    "figure-9a": figure_9a,
    "figure-9b": figure_9b,
    "figure-10a": partial(figure_10, metric="full"),
    "figure-10b": partial(figure_10, metric="final"),
    "figure-10-by-object": figure_10_by_object,
    "figure-11": figure_11,
    "figure-12": figure_12,
    "figure-13": figure_13,
}
"""Every figure by the name of its files."""
