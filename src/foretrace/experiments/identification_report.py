"""Summary, tables and figures of what lever-ups tell, at random places and at chosen ones."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, MaxNLocator
from scipy.stats import kstest

from foretrace.evaluation.charts import GREEN, GREY, ORANGE, SKY, finish, grid
from foretrace.evaluation.statistics import interval
from foretrace.evaluation.tables import markdown_table, mean_with_interval, number
from foretrace.pictures.style import new_figure, styled

NAMES = ("friction", "tool_friction", "density", "com_x", "com_y")
"""Constants that stay from one lever-up of an object to the next."""
RANDOM, CHOSEN = "random", "chosen"
NOTHING, TOLD = "error nothing", "error told"
LABELS = {RANDOM: "at random", CHOSEN: "chosen"}
COLORS = {RANDOM: SKY, CHOSEN: ORANGE}


def values_of(rows: pd.DataFrame) -> dict[str, dict[str, pd.Series]]:
    """Values by choice and metric, each by object."""
    found: dict[str, dict[str, dict[Any, float]]] = {}
    for row in rows.sort_values("object").to_dict("records"):
        mine = found.setdefault(str(row["choice"]), {})
        mine.setdefault(str(row["metric"]), {})[row["object"]] = float(row["value"])
    return {
        choice: {metric: pd.Series(each) for metric, each in own.items()} for choice, own in found.items()
    }


def summarise(rows: pd.DataFrame) -> dict[str, Any]:
    """Means with intervals by choice and metric; calibration of ranks; shares of the gain; differences of errors."""
    values = values_of(rows)
    summary: dict[str, Any] = {"objects": len(set(np.asarray(rows["object"]).tolist()))}
    summary["metrics"] = {
        choice: {
            name: interval(each, 0.0).as_dict(4) | {"median": float(each.median())}
            for name, each in own.items()
            if not name.startswith("rank")
        }
        for choice, own in values.items()
    }
    summary["ranks"] = {
        choice: {
            name.removeprefix("rank "): float(kstest(np.asarray(each), "uniform").pvalue)
            for name, each in own.items()
            if name.startswith("rank")
        }
        for choice, own in values.items()
    }
    told = values.get(RANDOM, {})
    if {NOTHING, TOLD} <= set(told):
        gain = told[NOTHING].mean() - told[TOLD].mean()
        summary["gain"] = {
            choice: {
                str(count): float((told[NOTHING].mean() - own[f"error after {count}"].mean()) / gain)
                for count in counts_of(own)
            }
            for choice, own in values.items()
        }
    if {RANDOM, CHOSEN} <= set(values):
        summary["chosen less random"] = {
            name: interval((values[CHOSEN][name] - values[RANDOM][name]).dropna(), 0.0).as_dict(4)
            for name in values[CHOSEN]
            if name.startswith(("error after", "com ")) and name in values[RANDOM]
        }
    return summary


def counts_of(own: Mapping[str, Any]) -> list[int]:
    """Numbers of lever-ups after which there are results."""
    return sorted(int(name.split()[-1]) for name in own if name.startswith("error after"))


def report(summary: Mapping[str, Any], tried: int) -> str:
    """Tables of errors and of calibration."""
    found = summary["metrics"]
    told = found.get(RANDOM, {})
    counts = counts_of(found.get(RANDOM) or found[CHOSEN])
    lines = [
        [words, mean_with_interval(told[name]), number(told[name]["median"]), ""]
        for name, words in ((NOTHING, "told nothing"), (TOLD, "told everything"))
        if name in told
    ]
    for choice, own in found.items():
        for count in counts:
            each = own[f"error after {count}"]
            share = summary.get("gain", {}).get(choice, {}).get(str(count))
            gain = "" if share is None else f"{100 * share:.0f} %"
            words = f"after {_plural(count)} {LABELS[choice]}"
            lines.append([words, mean_with_interval(each), number(each["median"]), gain])
    head = ["Error of other lever-ups [cm]", "Mean", "Median", "Share of the gain of being told everything"]
    parts = [
        "# Identification",
        f"{summary['objects']} objects, {tried} other lever-ups of each.",
        markdown_table(head, lines),
    ]
    if "chosen less random" in summary:
        parts.append(_differences(summary["chosen less random"], counts))
    lines = [
        [f"after {_plural(count)} {LABELS[choice]}", mean_with_interval(each, 2), number(each["median"], 2)]
        for choice, own in found.items()
        for count in counts
        for each in (own[f"com {count}"],)
    ]
    parts.append(markdown_table(["Error of the centre of mass [mm]", "Mean", "Median"], lines))
    for choice, own in found.items():
        head = [
            f"Lever-ups {LABELS[choice]}",
            *(f"Spread after {count}, of the prior's" for count in counts),
            *(f"Ranks after {count}: p" for count in counts),
        ]
        lines = [
            [
                name,
                *(number(own[f"std {name} {count}"]["mean"], 2) for count in counts),
                *(number(summary["ranks"][choice][f"{name} {count}"], 3) for count in counts),
            ]
            for name in NAMES
        ]
        parts.append(markdown_table(head, lines))
    seconds = {
        "One identification": next(own["seconds"]["median"] for own in found.values()),
        "One choice": found.get(CHOSEN, {}).get("seconds of choosing", {}).get("median"),
    }
    parts += [
        f"{name}: {value:.1f} s of processor time." for name, value in seconds.items() if value is not None
    ]
    return "\n\n".join(parts) + "\n"


def _plural(count: int) -> str:
    return f"{count} lever-up{'s' if count > 1 else ''}"


def _differences(differences: Mapping[str, Any], counts: list[int]) -> str:
    """Table of the differences on the same objects."""
    lines = [
        [
            str(count),
            mean_with_interval(differences[f"error after {count}"]),
            mean_with_interval(differences[f"com {count}"], 2),
        ]
        for count in counts
    ]
    head = ["Lever-ups; chosen less random, on the same objects", "Error [cm]", "Centre of mass [mm]"]
    return markdown_table(head, lines)


@styled
def figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Errors of other lever-ups, object by object; and by the number of lever-ups, at random and chosen."""
    values = values_of(rows)
    drawn = {}
    own = values.get(RANDOM, {})
    names = [NOTHING, *(f"error after {count}" for count in counts_of(own)), TOLD]
    if set(names) <= set(own):
        drawn["errors"] = _errors_figure({name: np.asarray(own[name]) for name in names})
    if {RANDOM, CHOSEN} <= set(values) and len(own["seconds"]) > 1:
        drawn["choosing"] = _choosing_figure(values)
    return drawn


def _errors_figure(values: Mapping[str, np.ndarray]) -> Figure:
    fig = new_figure(6.5, 4.2)
    ax = fig.subplots()
    for k, (name, each) in enumerate(values.items()):
        color = {NOTHING: GREY, TOLD: GREEN}.get(name, (SKY, SKY, ORANGE)[min(k - 1, 2)])
        ax.plot(np.full(len(each), k), each, "o", color=color, alpha=0.4, markersize=4)
        ax.plot([k - 0.25, k + 0.25], [each.mean()] * 2, color=color, linewidth=2.5)
    ax.set_xticks(range(len(values)), [name.removeprefix("error ") for name in values])
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    grid(ax, ylabel="error of other lever-ups [cm]")
    finish(
        fig,
        "What was learned, on other lever-ups of the same object",
        "lever-ups at random; lines: means; points: objects",
    )
    return fig


def _choosing_figure(values: Mapping[str, Mapping[str, pd.Series]]) -> Figure:
    fig = new_figure(8.0, 3.8)
    panels = {"error after": "error of other lever-ups [cm]", "com": "error of the centre of mass [mm]"}
    for ax, (metric, label) in zip(fig.subplots(1, 2), panels.items(), strict=True):
        for k, choice in enumerate((RANDOM, CHOSEN)):
            counts = np.array(counts_of(values[choice]))
            found = [interval(values[choice][f"{metric} {count}"], 0.0) for count in counts]
            mean = np.array([each.mean for each in found])
            apart = np.array([[each.mean - each.low, each.high - each.mean] for each in found]).T
            ax.errorbar(
                counts + 0.06 * (2 * k - 1), mean, apart, fmt="o-", color=COLORS[choice], label=LABELS[choice]
            )
        if metric == "error after":
            ax.axhline(values[RANDOM][TOLD].mean(), color=GREEN, linestyle="--", label="told everything")
            ax.legend(frameon=False)
        ax.set_ylim(bottom=0)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        grid(ax, ylabel=label, xlabel="lever-ups that were learned from")
    finish(
        fig, "Lever-ups chosen by what they are expected to tell", "means with 95 % intervals over objects"
    )
    return fig
