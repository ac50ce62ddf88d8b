"""Pictures of how far several futures are to be trusted: regions, observed beginnings, outcomes."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FormatStrFormatter
from scipy.stats import betabinom

from foretrace.evaluation.charts import BLUE, GRID, QUIET, REFERENCE, VERMILLION, finish, grid, mesh
from foretrace.experiments.uncertainty_metrics import ALL, BEGINNINGS
from foretrace.imagined import LEVELS
from foretrace.interactions.record import Outcome
from foretrace.pictures.style import INK, OUTCOME_COLORS, new_figure, styled

SPLIT_WORDS = {"shuffled": "Shuffled", "novel-shapes": "Novel shapes"}
BEGINNING_WORDS = {"record": "since the record's start", "moving": "since the object moves"}
SPLIT_COLORS = {"shuffled": BLUE, "novel-shapes": VERMILLION}
MARKERS = {ALL: "o", "levered": "s", "slipped": "^", "tumbled": "D", "rolled": "v", "missed": "P"}
FOUND = [10, 25, 50, 75, 90]
"""Ticks of levels [%]."""


@styled
def reliability_figure(rows: pd.DataFrame) -> Figure:
    """Share of motions within regions against their levels, a panel for each split."""
    splits = list(dict.fromkeys(rows["split"]))
    fig = new_figure(4.4 * len(splits) + 0.4, 5.0)
    for ax, split in zip(fig.subplots(1, len(splits), squeeze=False, sharey=True)[0], splits, strict=True):
        _draw_reliability(ax, rows.loc[rows["split"].eq(split)], SPLIT_COLORS.get(split, BLUE))
        ax.set_title(SPLIT_WORDS.get(split, split))
    fig.axes[0].set_ylabel("motions that stay within [%]")
    handles = [
        Line2D([], [], color=INK, linewidth=2.2, label="mean over the seeds"),
        Line2D([], [], color=INK, linewidth=0.7, alpha=0.6, label="one seed"),
        Line2D([], [], label="as promised", **REFERENCE),
        Patch(color=GRID, label="95 % of seeds of exact regions"),
    ]
    fig.legend(handles=handles, loc="outside lower center", ncols=4, columnspacing=1.2)
    finish(fig, "Do motions stay within the regions?", "above the diagonal: regions are wider than need be")
    return fig


def _draw_reliability(ax: Axes, rows: pd.DataFrame, color: str) -> None:
    ax.fill_between(100 * LEVELS, *_chance_band(rows), color=GRID, linewidth=0)
    ax.plot([0, 100], [0, 100], **REFERENCE)
    chosen = rows["metric"].eq("coverage") & rows["group"].eq(ALL)
    found = 100 * rows.loc[chosen].pivot(index="level", columns="seed", values="value").sort_index()
    at = 100 * found.index.to_numpy(float)
    ax.plot(at, found.to_numpy(), color=color, linewidth=0.7, alpha=0.6)
    ax.plot(at, found.to_numpy().mean(axis=1), color=color, linewidth=2.2)
    ax.set(xlim=(0, 100), ylim=(0, 100), xlabel="level of the region [%]", aspect="equal")
    ax.set_xticks(FOUND)
    ax.set_yticks(FOUND)
    mesh(ax)


def _chance_band(rows: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Shares [%] among which 95 % of seeds lie if validation and test could come in any order.

    Of n validation scores, the k-th one is the width: a share of Beta(k, n + 1 - k) of all motions stays within it
    (Vovk, 2012, "Conditional validity of inductive conformal predictors"), and of that, the test part is a draw.
    """
    sizes = [
        int(rows.loc[rows["metric"].eq(name)].groupby("seed")["value"].sum().min())
        for name in ("count_validation", "count_test")
    ]
    n, m = max(sizes[0], 1), max(sizes[1], 1)
    k = np.ceil(LEVELS * (n + 1))
    told = k <= n  # beyond, regions are everything
    low, high = (
        np.where(told, betabinom.ppf(q, m, np.minimum(k, n), np.maximum(n + 1 - k, 1)) / m, 1.0)
        for q in (0.025, 0.975)
    )
    return 100 * low, 100 * high


@styled
def observed_figure(rows: pd.DataFrame) -> Figure:
    """Errors of the rest of motions against how many samples were observed, a panel for each beginning and split."""
    splits = list(dict.fromkeys(rows["split"]))
    groups = [name for name in MARKERS if name in set(rows.loc[rows["metric"].eq("record_rest"), "group"])]
    fig = new_figure(9.0, 0.9 + 3.2 * len(splits))
    axes = fig.subplots(len(splits), len(BEGINNINGS), squeeze=False, sharex=True, sharey=True)
    for line, split in zip(axes, splits, strict=True):
        for ax, beginning in zip(line, BEGINNINGS, strict=True):
            mine = rows.loc[rows["split"].eq(split)]
            for group in groups:
                _draw_rest(ax, mine.loc[mine["group"].eq(group)], beginning, group)
            ax.set_yscale("log")
            grid(ax)
            ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
            ax.set_title(f"{SPLIT_WORDS.get(split, split)}, samples {BEGINNING_WORDS[beginning]}")
        line[0].set_ylabel("error of the rest [cm]")
    for ax in axes[-1]:
        ax.set_xlabel("observed samples")
    handles = [
        Line2D([], [], color=_color(name), marker=MARKERS[name], markersize=5, label=name) for name in groups
    ]
    handles += [
        Line2D(
            [],
            [],
            color=QUIET,
            linestyle=(0, (2, 1.6)),
            linewidth=1.1,
            label="the same rest, none observed",
        )
    ]
    fig.legend(handles=handles, loc="outside lower center", ncols=len(handles), columnspacing=1.4)
    note = "mean error of the most probable future; bands: from the best to the worst seed"
    finish(fig, "Gain by observing the beginning of a motion", note)
    return fig


def _draw_rest(ax: Axes, rows: pd.DataFrame, beginning: str, group: str) -> None:
    for metric, style, width in (("rest_unobserved", (0, (2, 1.6)), 1.1), ("rest", "-", 1.8)):
        chosen = rows.loc[rows["metric"].eq(f"{beginning}_{metric}")]
        if chosen.empty:
            continue
        found = chosen.pivot(index="level", columns="seed", values="value").sort_index()
        at, values = found.index.to_numpy(float), found.to_numpy()
        marker = MARKERS[group] if metric == "rest" else ""
        ax.plot(at, np.nanmean(values, axis=1), color=_color(group), linestyle=style, linewidth=width,
                marker=marker, markersize=5, markeredgecolor="white", markeredgewidth=0.5)  # fmt: skip
        if metric == "rest" and values.shape[1] > 1:
            low, high = np.nanmin(values, axis=1), np.nanmax(values, axis=1)
            ax.fill_between(at, low, high, color=_color(group), alpha=0.15, linewidth=0)


def _color(group: str) -> str:
    return INK if group == ALL else OUTCOME_COLORS[Outcome(group)]


@styled
def confusion_figure(rows: pd.DataFrame) -> Figure:
    """Which outcomes are taken for which, a panel for each split; counts of all seeds together."""
    splits = list(dict.fromkeys(rows["split"]))
    names = list(dict.fromkeys(rows.loc[rows["metric"].eq("count_test"), "group"]))
    side = 1.6 + 1.0 * len(names)
    fig = new_figure(max(5.6, side * len(splits)), side + 0.9)
    for ax, split in zip(fig.subplots(1, len(splits), squeeze=False)[0], splits, strict=True):
        mine = rows.loc[rows["split"].eq(split) & rows["metric"].eq("confusion")]
        sums = mine.groupby("group")["value"].sum()
        counts = np.array([[sums.get(f"{a}, predicted {b}", 0.0) for b in names] for a in names])
        shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        ax.imshow(shares, cmap="Blues", vmin=0, vmax=1)
        for (i, j), share in np.ndenumerate(shares):
            color = "white" if share > 0.55 else INK
            text = f"{counts[i, j]:.0f}\n{share:.0%}"
            ax.text(j, i, text, ha="center", va="center", color=color, fontsize=10)
        ax.set_xticks(range(len(names)), names)
        ax.set_yticks(range(len(names)), names, rotation=90, va="center")
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        ax.set(title=SPLIT_WORDS.get(split, split), xlabel="predicted to be most probable", ylabel="happened")
    finish(fig, "Which outcomes are taken for which", "lever-ups of the test parts; % of what happened")
    return fig
