"""Summary, tables and picture of the experiment on plans."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from foretrace.evaluation.charts import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, finish, grid
from foretrace.evaluation.tables import markdown_table
from foretrace.pictures.style import GREY, INK, new_figure, styled

GOALS = ("lift", "tilt", "move", "move-to", "turn-over")
"""What is wanted: as high as possible without a slip; 0.5 rad; as far as possible in a direction; a place 3 cm away; as
far as possible over towards a direction."""
BROWN, DARK_PURPLE = "#8c6d31", "#7a3e6c"
SAFE = ("lift", "tilt")
"""Goals with a limit to slips."""
METHODS = {
    "random": GREY,
    "longest edge": GREY,
    "far": GREY,
    "closed form": ORANGE,
    "im-cnn": BROWN,
    "without uncertainty": SKY,
    "learned": BLUE,
    "learned, checked": GREEN,
    "twin": VERMILLION,
    "identified": PURPLE,
    "identified, checked": DARK_PURPLE,
    "oracle": INK,
}
"""Methods, with their colours."""
WORDS = {
    "random": "random contact (expectation)",
    "longest edge": "middle of the longest edge",
    "far": "farthest from the centre of mass",
    "closed form": "closed-form rule, by the goal",
    "im-cnn": "planner, im-cnn with an LSTM",
    "without uncertainty": "planner, learned, likeliest future alone",
    "learned": "planner, learned",
    "learned, checked": "planner, learned, best few checked by the twin",
    "twin": "twin of every candidate",
    "identified": "planner, learned, after one lever-up of the object",
    "identified, checked": "planner, after one lever-up, best few checked by the twin",
    "oracle": "oracle: truth of every candidate",
}
DRAWS = 2000
"""Bootstrap samples of the objects."""
LEAST_GAP = 1e-9
WORST = 20
"""Plans that are looked at because they lose most."""


def summary_of(rows: pd.DataFrame) -> dict[str, Any]:
    """By world and method, with 95 % bootstrap intervals over objects."""
    summary: dict[str, Any] = {}
    for world in sorted(set(rows["world"])):
        mine = rows.loc[rows["world"].eq(world)]
        methods = [name for name in METHODS if name in set(mine["method"])]
        table = {
            name: mine.pivot_table(
                index=["family", "number"], columns=["goal", "method"], values=name, aggfunc="mean"
            )
            for name in ("cost", "reached", "slipped", "seconds")
        }
        count = len(table["cost"])
        rng = np.random.default_rng(0)
        drawn = np.concatenate([np.arange(count)[None], rng.integers(count, size=(DRAWS, count))])
        found: dict[str, Any] = {}
        for method in methods:
            shares = {goal: _closed(table["cost"], goal, method, drawn) for goal in GOALS}
            slips = np.mean([_mean(table["slipped"], goal, method, drawn) for goal in SAFE], axis=0)
            success = np.mean([_mean(table["reached"], goal, method, drawn) for goal in GOALS], axis=0)
            best = np.mean([_mean(table["reached"], goal, "oracle", drawn) for goal in GOALS], axis=0)
            seconds = np.concatenate([np.asarray(table["seconds"][goal][method]) for goal in GOALS])
            found[method] = {
                "closed": _interval(np.mean(list(shares.values()), axis=0)),
                **{f"closed {goal}": _interval(share) for goal, share in shares.items()},
                "success": _interval(success),
                "success, relative": _interval(success / np.maximum(best, 1e-9)),
                "slips": _interval(slips),
                "seconds, median": float(np.round(np.median(seconds), 4)),
                "seconds, p95": float(np.round(np.percentile(seconds, 95), 4)),
            }
        families = np.asarray(table["cost"].index.get_level_values("family"))
        summary[world] = {
            "objects": count,
            "methods": found,
            "families": {
                str(family): {
                    method: round(_closed_in(table["cost"].loc[families == family], method), 4)
                    for method in methods
                }
                for family in dict.fromkeys(families.tolist())
            },
            "worst": _worst_of(mine),
        }
    return summary


def _worst_of(rows: pd.DataFrame, method: str = "learned, checked") -> dict[str, Any]:
    """The plans of a method that lose most to the oracle: their share of the loss, families, and slips."""
    keys = ["family", "number", "goal"]
    own, best = (rows.loc[rows["method"].eq(name)].set_index(keys) for name in (method, "oracle"))
    lost = (own["cost"] - best["cost"].reindex(own.index)).sort_values(ascending=False)
    worst = own.loc[lost.index[:WORST]]
    return {
        "plans": len(own),
        "worst": len(worst),
        "share of the loss": round(float(lost.iloc[:WORST].sum() / max(lost.sum(), LEAST_GAP)), 4),
        "families": {str(name): int(n) for name, n in worst.reset_index()["family"].value_counts().items()},
        "slipped": int((worst["slipped"] > 0.5).sum()),
    }


def _closed_in(costs: pd.DataFrame, method: str) -> float:
    """Share of the gap that is closed on some objects, in the mean over goals."""
    rows = np.arange(len(costs))[None]
    return float(np.mean([_closed(costs, goal, method, rows) for goal in GOALS]))


def _closed(costs: pd.DataFrame, goal: str, method: str, drawn: np.ndarray) -> np.ndarray:
    """Share of the gap between random and oracle that is closed, for each sample of objects."""
    chance, oracle, own = (np.asarray(costs[goal][name]) for name in ("random", "oracle", method))
    gap = (chance - oracle)[drawn].sum(axis=1)
    return (chance - own)[drawn].sum(axis=1) / np.maximum(gap, LEAST_GAP)


def _mean(values: pd.DataFrame, goal: str, method: str, drawn: np.ndarray) -> np.ndarray:
    return np.asarray(values[goal][method], dtype=float)[drawn].mean(axis=1)


def _interval(samples: np.ndarray) -> dict[str, float]:
    """The value of the objects as they are, and between which values 95 % of the samples lie."""
    low, high = np.percentile(samples[1:], [2.5, 97.5])
    return {
        name: round(float(value), 4) for name, value in (("mean", samples[0]), ("low", low), ("high", high))
    }


def report_of(summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
    """A table for each world, and one of goals."""
    parts = ["# Plans beside rules and an oracle"]
    for world, found in summary.items():
        lines, by_goal = [], []
        for method, numbers in found["methods"].items():
            timed = numbers["seconds, p95"] > 0
            lines.append(
                [
                    WORDS[method],
                    _percent(numbers["closed"]),
                    _percent(numbers["success"]),
                    _percent(numbers["success, relative"]),
                    _percent(numbers["slips"]),
                    f"{1000 * numbers['seconds, median']:.0f} / {1000 * numbers['seconds, p95']:.0f}"
                    if timed
                    else "",
                ]
            )
            by_goal.append([WORDS[method], *(_percent(numbers[f"closed {goal}"]) for goal in GOALS)])
        head = [
            "",
            "Gap closed",
            "Success",
            "Relative to oracle",
            "Slips (lift, tilt)",
            "Time [ms], median / p95",
        ]
        parts += [
            f"## World: {world}, {found['objects']} objects",
            markdown_table(head, lines),
            "Share of the gap closed, by goal:",
            markdown_table(["", *GOALS], by_goal),
            "Share of the gap closed, by family of objects:",
            markdown_table(
                ["", *found["families"]],
                [
                    [WORDS[method], *(f"{100 * each[method]:.1f} %" for each in found["families"].values())]
                    for method in found["methods"]
                ],
            ),
            _about_worst(found["worst"]),
        ]
    return "\n\n".join(parts) + "\n"


def _about_worst(found: Mapping[str, Any]) -> str:
    families = ", ".join(f"{count} of the family {name}" for name, count in found["families"].items())
    return (
        f"Of {found['plans']} plans that the twin checked, the {found['worst']} worst hold "
        f"{100 * found['share of the loss']:.0f} % of what is lost to the oracle ({families}); in {found['slipped']} "
        "of them the object slips."
    )


def _percent(numbers: Mapping[str, float]) -> str:
    mean, low, high = (100 * numbers[name] for name in ("mean", "low", "high"))
    return f"{mean:.1f} % [{low:.1f}, {high:.1f}]"


@styled
def draw(rows: pd.DataFrame) -> dict[str, Figure]:
    """Share of the gap that is closed, method by method and world by world."""
    summary = summary_of(rows)
    if not summary:
        return {}
    counts = [len(found["methods"]) for found in summary.values()]
    fig = new_figure(0.62 * sum(counts), 4.2)
    axes = np.ravel(fig.subplots(1, len(summary), sharey=True, squeeze=False, width_ratios=counts))
    for ax, (world, found) in zip(axes, summary.items(), strict=True):
        methods = [name for name in found["methods"] if name not in ("random", "oracle")]
        for k, method in enumerate(methods):
            numbers = found["methods"][method]["closed"]
            mean, low, high = (100 * numbers[name] for name in ("mean", "low", "high"))
            ax.bar(k, mean, color=METHODS[method], width=0.7)
            ax.plot([k, k], [low, high], color=INK, linewidth=1.2)
            number = ax.text(k, max(high, 0) + 2, f"{round(mean)}", ha="center", fontsize=8.5)
            number.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 0.8})
        ax.axhline(100, color=INK, linewidth=0.8, linestyle=":", zorder=1)
        ax.set_xticks(range(len(methods)), [name.replace(" ", "\n", 1) for name in methods], fontsize=7.5)
        grid(ax, title=f"{world}, {found['objects']} objects", ylim=(-30, 115))
    axes[0].set_ylabel("gap from random to oracle closed [%]")
    finish(fig, "Choosing a contact", "mean over five goals, 95 % bootstrap intervals over objects")
    return {"gap": fig}
