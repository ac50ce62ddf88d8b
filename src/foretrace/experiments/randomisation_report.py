"""What the comparison of plain and randomised training data comes to: a summary, a table and a picture."""

from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from foretrace.evaluation.statistics import mean_interval
from foretrace.experiments.charts import BLUE, GREEN, ORANGE, finish, grid, seeds_in_words
from foretrace.experiments.randomisation import KNOWING, PLAIN, VARIED
from foretrace.pictures.scene import DPI, GREY, INK, STYLE

JUDGES = {
    "plain test": "plain_full",
    "randomised test": "randomised_full",
    "stand-in, printed": "stand_in_printed",
    "stand-in, everyday": "stand_in_everyday",
}
"""What predictors are judged by, and the metric [cm]."""
NOMINAL = {
    "plain_full": "plain_nominal_full",
    "randomised_full": "randomised_nominal_full",
    "stand_in_printed": "stand_in_printed_nominal",
    "stand_in_everyday": "stand_in_everyday_nominal",
}
"""The same where a predictor that knows what varies is told the usual values."""
BARS = {
    "plain data": (PLAIN, False, GREY, ""),
    "randomised data": (VARIED, False, ORANGE, ""),
    "randomised, true values known": (KNOWING, False, BLUE, ""),
    "randomised, told the usual values": (KNOWING, True, GREEN, "///"),
}
"""Predictors: what they learned from, whether they are told the usual values, and how they are drawn."""
CONTRASTS = {
    "randomised instead of plain": ("randomised data", "plain data"),
    "true values known": ("randomised, true values known", "randomised data"),
    "usual values instead of true ones": (
        "randomised, told the usual values",
        "randomised, true values known",
    ),
}
"""Differences of two predictors of the same seed: the first less the second."""


def values_of(table: pd.DataFrame, features: str, bar: str, metric: str) -> pd.Series:
    """One number per seed [cm]."""
    setting, nominal, _, _ = BARS[bar]
    wanted = NOMINAL[metric] if nominal else metric
    chosen = table["features"].eq(features) & table["setting"].eq(setting) & table["metric"].eq(wanted)
    return table.loc[chosen].set_index("seed")["value"].sort_index()


def judges_of(table: pd.DataFrame) -> dict[str, str]:
    """Those of JUDGES who judged: the stand-in can be left out."""
    metrics = set(table["metric"])
    return {judge: metric for judge, metric in JUDGES.items() if metric in metrics}


def summarise(table: pd.DataFrame) -> dict[str, Any]:
    """Means over the seeds and their 95 % bootstrap intervals, JSON-able.

    Args:
        table: As from `foretrace.evaluation.results.read_results`.

    Returns:
        By features and judge: ``errors`` [cm] of every predictor, and ``differences`` within the same seeds.
    """
    summary: dict[str, Any] = {}
    for features in dict.fromkeys(table["features"]):
        summary[features] = {}
        for judge, metric in judges_of(table).items():
            values = {bar: values_of(table, features, bar, metric) for bar in BARS}
            differences = {
                name: (values[first] - values[second]).dropna() for name, (first, second) in CONTRASTS.items()
            }
            summary[features][judge] = {
                "errors": {name: _interval(each) for name, each in values.items() if len(each)},
                "differences": {name: _interval(each) for name, each in differences.items() if len(each)},
            }
    return summary


def _interval(values: pd.Series) -> dict[str, Any]:
    mean, low, high = (None if np.isnan(x) else round(x, 4) for x in mean_interval(values.to_numpy(float)))
    return {"mean": mean, "low": low, "high": high, "seeds": len(values)}


def markdown(summary: dict[str, Any]) -> str:
    """Errors and differences as two tables."""
    lines = ["Errors in cm, means over the seeds (95 % bootstrap interval).", ""]
    for part, columns in (("errors", list(BARS)), ("differences", list(CONTRASTS))):
        if part == "differences":
            lines += ["", "Differences in cm within the same seeds; below zero is an improvement.", ""]
        lines += [f"| Features | Judged by | {' | '.join(columns)} |", "| --- " * (len(columns) + 2) + "|"]
        for features, judges in summary.items():
            for judge, found in judges.items():
                cells = " | ".join(_cell(found[part].get(name), part) for name in columns)
                lines.append(f"| `{features}` | {judge} | {cells} |")
    return "\n".join(lines) + "\n"


def _cell(found: dict[str, Any] | None, part: str) -> str:
    if found is None:
        return ""
    sign = "+" if part == "differences" else ""
    interval = "" if found["low"] is None else f" ({found['low']:{sign}.3f} to {found['high']:{sign}.3f})"
    return f"{found['mean']:{sign}.3f}{interval}"


@mpl.rc_context(STYLE)
def randomisation_figure(table: pd.DataFrame) -> Figure:
    """Errors of all predictors, a panel for each kind of features."""
    labels = list(dict.fromkeys(table["features"]))
    fig = Figure(figsize=(9.6, 1.0 + 2.5 * len(labels)), dpi=DPI, layout="constrained")
    axes = fig.subplots(len(labels), 1, squeeze=False)[:, 0]
    for ax, features in zip(axes, labels, strict=True):
        _draw(ax, table, features)
    patches = [
        Patch(facecolor=color, hatch=hatch, edgecolor="white", label=name)
        for name, (_, _, color, hatch) in BARS.items()
    ]
    fig.legend(handles=patches, loc="outside lower center", ncols=2, columnspacing=1.4)
    note = f"bars: means over {seeds_in_words(table)} with 95 % bootstrap intervals; dots: seeds"
    finish(fig, "What randomised training data do, and what it helps to know what varies", note)
    return fig


def _draw(ax: Axes, table: pd.DataFrame, features: str) -> None:
    width = 0.8 / len(BARS)
    judges = judges_of(table)
    for place, metric in enumerate(judges.values()):
        for k, (bar, (_, _, color, hatch)) in enumerate(BARS.items()):
            values = values_of(table, features, bar, metric).to_numpy(float)
            if len(values) == 0:
                continue
            at = place + (k - (len(BARS) - 1) / 2) * width
            mean, low, high = mean_interval(values)
            ax.bar(at, mean, 0.92 * width, color=color, hatch=hatch, edgecolor="white", linewidth=0.5)
            ax.errorbar(
                at, mean, np.nan_to_num([[mean - low], [high - mean]]), color=INK, elinewidth=1.1, capsize=2
            )
            ax.plot(np.full(len(values), at), values, "o", color=INK, markersize=2.2, alpha=0.7)
    grid(ax, ylim=(0, None), ylabel="error [cm]")
    ax.set_xticks(range(len(judges)), list(judges))
    ax.set_title(features, loc="left")
    ax.tick_params(axis="x", length=0)
