"""The compared predictors and tests of varied training data, and their picture."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from foretrace.evaluation.charts import BLUE, GREEN, ORANGE, finish, grid, seeds_in_words
from foretrace.evaluation.statistics import interval
from foretrace.pictures.style import GREY, INK, new_figure, styled

PLAIN, VARIED, KNOWING = "plain", "randomised", "knowing"
SETTINGS = (PLAIN, VARIED, KNOWING)
"""Training data: plain; varied; the same, conditioned on what varies."""
TESTS = {
    "plain test": "plain_full",
    "varied test": "randomised_full",
    "stand-in, printed": "stand_in_printed",
    "stand-in, everyday": "stand_in_everyday",
}
"""What predictors are evaluated on, and the metric [cm]."""
NOMINAL = {
    "plain_full": "plain_nominal_full",
    "randomised_full": "randomised_nominal_full",
    "stand_in_printed": "stand_in_printed_nominal",
    "stand_in_everyday": "stand_in_everyday_nominal",
}
"""The same with the nominal values as context."""
BARS = {
    "plain data": (PLAIN, False, GREY, ""),
    "varied data": (VARIED, False, ORANGE, ""),
    "varied, true values as context": (KNOWING, False, BLUE, ""),
    "varied, nominal values as context": (KNOWING, True, GREEN, "///"),
}
"""Predictors: what they learned from, whether their context is the nominal values, and how they are drawn."""
CONTRASTS = {
    "varied instead of plain": ("varied data", "plain data"),
    "true values as context": ("varied, true values as context", "varied data"),
    "nominal values instead of true ones": (
        "varied, nominal values as context",
        "varied, true values as context",
    ),
}
"""Differences of two predictors of the same seed: the first less the second."""


def values_of(table: pd.DataFrame, features: str, bar: str, metric: str) -> pd.Series:
    """One number per seed [cm]."""
    setting, nominal, _, _ = BARS[bar]
    wanted = NOMINAL[metric] if nominal else metric
    chosen = table["features"].eq(features) & table["setting"].eq(setting) & table["metric"].eq(wanted)
    return table.loc[chosen].set_index("seed")["value"].sort_index()


def tests_of(table: pd.DataFrame) -> dict[str, str]:
    """Those of TESTS that there are: the stand-in can be left out."""
    metrics = set(table["metric"])
    return {test: metric for test, metric in TESTS.items() if metric in metrics}


@styled
def randomisation_figure(table: pd.DataFrame) -> Figure:
    """Errors of all predictors, a panel for each kind of features."""
    labels = list(dict.fromkeys(table["features"]))
    fig = new_figure(9.6, 1.0 + 2.5 * len(labels))
    axes = fig.subplots(len(labels), 1, squeeze=False)[:, 0]
    for ax, features in zip(axes, labels, strict=True):
        _draw(ax, table, features)
    patches = [
        Patch(facecolor=color, hatch=hatch, edgecolor="white", label=name)
        for name, (_, _, color, hatch) in BARS.items()
    ]
    fig.legend(handles=patches, loc="outside lower center", ncols=2, columnspacing=1.4)
    note = f"bars: means over {seeds_in_words(table)} with 95 % intervals; dots: seeds"
    finish(fig, "Training on plain and on varied data, with and without context", note)
    return fig


def _draw(ax: Axes, table: pd.DataFrame, features: str) -> None:
    width = 0.8 / len(BARS)
    tests = tests_of(table)
    for place, metric in enumerate(tests.values()):
        for k, (bar, (_, _, color, hatch)) in enumerate(BARS.items()):
            values = values_of(table, features, bar, metric).to_numpy(float)
            if len(values) == 0:
                continue
            at = place + (k - (len(BARS) - 1) / 2) * width
            mean, low, high, _ = interval(values)
            ax.bar(at, mean, 0.92 * width, color=color, hatch=hatch, edgecolor="white", linewidth=0.5)
            ax.errorbar(
                at, mean, np.nan_to_num([[mean - low], [high - mean]]), color=INK, elinewidth=1.1, capsize=2
            )
            ax.plot(np.full(len(values), at), values, "o", color=INK, markersize=2.2, alpha=0.7)
    grid(ax, ylim=(0, None), ylabel="error [cm]")
    ax.set_xticks(range(len(tests)), list(tests))
    ax.set_title(features, loc="left")
    ax.tick_params(axis="x", length=0)
