"""What the comparison of masks with height maps comes to: a summary, tables and two pictures (paper, section 5.5)."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from foretrace.evaluation.statistics import mean_interval
from foretrace.experiments.charts import BLUE, GREEN, GRID, VERMILLION, finish, grid
from foretrace.experiments.non_flat_errors import CHANNELS, KINDS, SETTINGS
from foretrace.pictures.scene import DPI, INK, STYLE

PAPER = {"mask": 7.23, "height": 2.77}
"""Full-trajectory errors over the paper's whole set [cm] (section 5.5)."""
GOAL = 0.2
"""The height map's error is wanted to be at most this part of the mask's; the paper's is 0.38 of it."""
COLORS = {"mask": VERMILLION, "height": BLUE}
WORDS = {"mask": "mask", "height": "height map"}
PATHS: dict[str, tuple[str, Any, float]] = {
    "observed": (GREEN, "-", 2.6),
    "mask": (VERMILLION, "--", 1.8),
    "height": (BLUE, "-.", 1.8),
}
GROUPS = ("all", "alike", *KINDS)
"""What errors are averaged over: everything, what looks like something else, and each kind."""


def summarise(errors: pd.DataFrame, floors: pd.DataFrame) -> dict[str, Any]:
    """Everything that tables and pictures tell, JSON-able.

    Args:
        errors: As from `foretrace.experiments.non_flat_errors.measure`, with ``seed``, ``setting`` and ``channel``.
        floors: As from `foretrace.experiments.non_flat_errors.spread_of_fates`; may be empty.

    Returns:
        ``settings``: by setting, for each group the errors of both channels [cm] and the ratio of height map to mask,
        means and 95 % bootstrap intervals over the seeds; and by outcome. ``floors``: by kind. ``paper``: its numbers.
    """
    settings: dict[str, Any] = {}
    for setting in (name for name in SETTINGS if name in set(errors["setting"])):
        mine = errors.loc[errors["setting"].eq(setting)]
        groups = {name: _compare(_members(mine, name)) for name in GROUPS}
        outcomes = {str(name): _compare(part) for name, part in mine.groupby("outcome")}
        settings[setting] = {
            "seeds": sorted(int(seed) for seed in set(mine["seed"])),
            "groups": {name: found for name, found in groups.items() if found},
            "outcomes": outcomes,
        }
    by_kind = {
        name: {
            "probes": len(part),
            "floor_cm": round(float(np.mean(part["floor_cm"].to_numpy(float))), 4),
            "median_floor_cm": round(float(np.median(part["floor_cm"].to_numpy(float))), 4),
            "same_outcome": round(float(np.mean(part["same"].to_numpy(float))), 4),
        }
        for name, part in ((name, _members(floors, name)) for name in ("alike", *KINDS) if len(floors))
        if len(part)
    }
    return {"paper": PAPER, "goal": GOAL, "settings": settings, "floors": by_kind}


def _members(rows: pd.DataFrame, group: str) -> pd.DataFrame:
    if group == "all":
        return rows
    return rows.loc[rows["kind"].ne("prism") if group == "alike" else rows["kind"].eq(group)]


def _compare(rows: pd.DataFrame) -> dict[str, Any]:
    """Both channels on the same interactions; empty if there are none."""
    if rows.empty:
        return {}
    full = {channel: _by_seed(rows, channel, "full_cm") for channel in CHANNELS}
    found: dict[str, Any] = {
        channel: {
            "full_cm": _interval(full[channel]),
            "final_cm": _interval(_by_seed(rows, channel, "final_cm")),
            "median_cm": round(float(np.median(rows.loc[rows["channel"].eq(channel), "full_cm"])), 4),
        }
        for channel in CHANNELS
    }
    found["interactions"] = round(len(rows) / len(CHANNELS) / len(full["mask"]))
    found["still_cm"] = round(float(_by_seed(rows, "mask", "still_cm").mean()), 4)
    found["ratio"] = _interval(full["height"] / full["mask"])
    return found


def _by_seed(rows: pd.DataFrame, channel: str, column: str) -> np.ndarray:
    """The mean of a column for each seed."""
    mine = rows.loc[rows["channel"].eq(channel)]
    seeds = sorted(set(mine["seed"]))
    return np.array([mine.loc[mine["seed"].eq(seed), column].to_numpy(float).mean() for seed in seeds])


def _interval(values: np.ndarray) -> dict[str, float | None]:
    numbers = dict(zip(("mean", "low", "high"), mean_interval(values), strict=True))
    return {name: None if np.isnan(value) else round(float(value), 4) for name, value in numbers.items()}


def markdown(summary: Mapping[str, Any]) -> str:
    """The paper's two numbers with ours beside them, and where the errors come from."""
    parts = ["# Masks against height maps of objects that are not flat"]
    for setting, found in summary["settings"].items():
        seeds = ", ".join(map(str, found["seeds"]))
        parts.append(f"## Split {setting}, seeds {seeds}")
        ratio = found["groups"]["all"]["ratio"]
        met = "met" if ratio["mean"] <= summary["goal"] else "not met"
        lines = [["", "Interactions", "Nothing moves", "Mask", "Height map", "Height map / mask"]]
        paper = summary["paper"]
        share = f"{paper['height'] / paper['mask']:.2f}"
        lines.append(["Paper, all", "", "", f"{paper['mask']:.2f}", f"{paper['height']:.2f}", share])
        lines += [_row(name, group) for name, group in found["groups"].items()]
        lines += [_row(f"`{name}`", group) for name, group in found["outcomes"].items()]
        parts.append("Full-trajectory error of the centre of mass [cm], means over the test part:")
        parts.append(_table(lines))
        parts.append(f"Goal: a ratio of at most {summary['goal']:g} over all: {met}.")
    if summary["floors"]:
        lines = [["", "Probes", "Floor, mean [cm]", "Floor, median [cm]", "Same outcome"]]
        lines += [
            [
                name,
                str(each["probes"]),
                f"{each['floor_cm']:.3f}",
                f"{each['median_floor_cm']:.3f}",
                f"{100 * each['same_outcome']:.0f} %",
            ]
            for name, each in summary["floors"].items()
        ]
        parts += ["## Spread of fates", _table(lines)]
    return "\n\n".join(parts) + "\n"


def _row(name: str, group: Mapping[str, Any]) -> list[str]:
    words = {"all": "Ours, all", "alike": "Look-alikes"}.get(name, name[:1].upper() + name[1:])
    cells = [_range(group[channel]["full_cm"]) for channel in CHANNELS]
    still = f"{group['still_cm']:.2f}"
    return [words, str(group["interactions"]), still, *cells, _range(group["ratio"])]


def _range(numbers: Mapping[str, float | None]) -> str:
    text = f"{numbers['mean']:.2f}"
    return text if numbers["low"] is None else f"{text} [{numbers['low']:.2f}, {numbers['high']:.2f}]"


def _table(lines: Sequence[Sequence[str]]) -> str:
    rule = ["---", *["---:"] * (len(lines[0]) - 1)]
    return "\n".join("| " + " | ".join(line) + " |" for line in (lines[0], rule, *lines[1:]))


def errors_figure(summary: Mapping[str, Any]) -> Figure:
    """Errors of both channels by kind of object, one panel for each split."""
    settings = summary["settings"]
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(max(7.4, 5.6 * len(settings)), 4.2), dpi=DPI, layout="constrained")
        panels = fig.subplots(1, len(settings), squeeze=False, sharey=True)[0]
        for ax, (setting, found) in zip(panels, settings.items(), strict=True):
            _draw_groups(ax, found["groups"])
            words = {"by-outline": "No outline in two parts", "random": "Split at random"}[setting]
            count = len(found["seeds"])
            ax.set_title(f"{words}; {count} seed{'s' if count > 1 else ''}")
        panels[0].set_ylabel("full-trajectory error [cm]")
        handles: list[Patch | Line2D] = [
            Patch(facecolor=color, alpha=0.55, edgecolor=color, label=f"sees the {WORDS[name]}")
            for name, color in COLORS.items()
        ]
        handles.append(
            Line2D([], [], color=INK, marker="D", linestyle="none", label="paper, its own objects")
        )
        fig.legend(handles=handles, loc="outside lower center", ncols=3)
        note = (
            "The same predictor and lever-ups; means over the seeds, with 95 % bootstrap intervals if several"
        )
        finish(fig, "What the height map adds to the mask", note)
    return fig


def _draw_groups(ax: Axes, groups: Mapping[str, Any]) -> None:
    labels = {"all": "all", "alike": "look-alikes", "flat prism": "flat\nprism", "prism": "other\nprisms"}
    for k, (name, group) in enumerate(groups.items()):
        for channel, shift in zip(CHANNELS, (-0.2, 0.2), strict=True):
            numbers = group[channel]["full_cm"]
            mean, color = numbers["mean"], COLORS[channel]
            ax.bar(k + shift, mean, width=0.37, color=color, alpha=0.55, edgecolor=color)
            if numbers["low"] is not None:
                ends = [[mean - numbers["low"]], [numbers["high"] - mean]]
                ax.errorbar(k + shift, mean, yerr=ends, color=INK, capsize=3, linewidth=1.2)
            top = mean if numbers["high"] is None else numbers["high"]
            ax.text(k + shift, top + 0.06, f"{mean:.2f}", ha="center", va="bottom", fontsize=8, color=INK)
            if name == "all":
                ax.plot(k + shift, PAPER[channel], "D", color=INK, markersize=5.5, markeredgecolor="white")
    ax.set_xticks(range(len(groups)), [labels.get(name, name) for name in groups])
    ax.tick_params(axis="x", length=0)
    grid(ax)
    ax.margins(y=0.1)
    ax.set_ylim(0, None)


def paths_figure(paths: pd.DataFrame) -> Figure:
    """Observed and imagined paths of objects that look alike, from the side (paper, figure 16, right).

    Args:
        paths: As from `foretrace.experiments.non_flat_errors.example_paths`, of at least one object.
    """
    kinds = list(dict.fromkeys(paths["kind"]))
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(4.2 * len(kinds), 4.0), dpi=DPI, layout="constrained")
        for ax, kind in zip(fig.subplots(1, len(kinds), squeeze=False, sharey=True)[0], kinds, strict=True):
            mine = paths.loc[paths["kind"].eq(kind)]
            for name, (color, style, width) in PATHS.items():
                path = mine.loc[mine["path"].eq(name)]
                x, z = path["x_cm"].to_numpy(float), path["z_cm"].to_numpy(float)
                ax.plot(x, z, color=color, linestyle=style, linewidth=width)
                ax.plot(x[-1:], z[-1:], "o", color=color, markersize=5)
                if name == "observed":
                    ax.plot(x[:1], z[:1], "s", color=INK, markersize=5, zorder=5)
            ax.set_title(f"{kind[:1].upper()}{kind[1:]}: {mine['outcome'].iloc[0]}")
            ax.set_xlabel("x, along the action [cm]")
            ax.grid(color=GRID, linewidth=0.6)
            ax.set_axisbelow(True)
        fig.axes[0].set_ylabel("z, up [cm]")
        handles = [
            Line2D([], [], color=color, linestyle=style, linewidth=width, label=words)
            for words, (color, style, width) in zip(
                ("observed", "imagined from the mask", "imagined from the height map"),
                PATHS.values(),
                strict=True,
            )
        ]
        handles.append(Line2D([], [], color=INK, marker="s", linestyle="none", label="at rest"))
        fig.legend(handles=handles, loc="outside lower center", ncols=4)
        note = "A lever-up of the test part at one contact; each panel has its own scale along x"
        finish(fig, "One mask, three fates: paths of the centre of mass from the side", note)
    return fig
