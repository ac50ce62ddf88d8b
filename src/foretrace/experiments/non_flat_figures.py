"""Pictures of masks against height maps: errors by kind of object, and paths of objects that look alike."""

from collections.abc import Mapping
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from foretrace.evaluation.charts import BLUE, GREEN, VERMILLION, finish, grid, mesh
from foretrace.evaluation.tables import capitalised
from foretrace.pictures.style import INK, new_figure, styled

COLORS = {"mask": VERMILLION, "height": BLUE}
WORDS = {"mask": "mask", "height": "height map"}
PATHS: dict[str, tuple[str, Any, float]] = {
    "observed": (GREEN, "-", 2.6),
    "mask": (VERMILLION, "--", 1.8),
    "height": (BLUE, "-.", 1.8),
}


@styled
def errors_figure(settings: Mapping[str, Any], paper: Mapping[str, float]) -> Figure:
    """Errors of both channels by kind of object, one panel for each split."""
    fig = new_figure(max(7.4, 5.6 * len(settings)), 4.2)
    panels = fig.subplots(1, len(settings), squeeze=False, sharey=True)[0]
    for ax, (setting, found) in zip(panels, settings.items(), strict=True):
        _draw_groups(ax, found["groups"], paper)
        words = {"by-outline": "No outline in two parts", "random": "Split at random"}[setting]
        count = len(found["seeds"])
        ax.set_title(f"{words}; {count} seed{'s' if count > 1 else ''}")
    panels[0].set_ylabel("full-trajectory error [cm]")
    handles: list[Patch | Line2D] = [
        Patch(facecolor=color, alpha=0.55, edgecolor=color, label=f"has the {WORDS[name]}")
        for name, color in COLORS.items()
    ]
    handles.append(Line2D([], [], color=INK, marker="D", linestyle="none", label="paper, its own objects"))
    fig.legend(handles=handles, loc="outside lower center", ncols=3)
    note = "The same predictor and lever-ups; means over the seeds, with 95 % intervals if several"
    finish(fig, "What the height map adds to the mask", note)
    return fig


def _draw_groups(ax: Axes, groups: Mapping[str, Any], paper: Mapping[str, float]) -> None:
    labels = {"all": "all", "alike": "look-alikes", "flat prism": "flat\nprism", "prism": "other\nprisms"}
    for k, (name, group) in enumerate(groups.items()):
        for channel, shift in zip(COLORS, (-0.2, 0.2), strict=True):
            numbers = group[channel]["full_cm"]
            mean, color = numbers["mean"], COLORS[channel]
            ax.bar(k + shift, mean, width=0.37, color=color, alpha=0.55, edgecolor=color)
            if numbers["low"] is not None:
                ends = [[mean - numbers["low"]], [numbers["high"] - mean]]
                ax.errorbar(k + shift, mean, yerr=ends, color=INK, capsize=3, linewidth=1.2)
            top = mean if numbers["high"] is None else numbers["high"]
            ax.text(k + shift, top + 0.06, f"{mean:.2f}", ha="center", va="bottom", fontsize=8, color=INK)
            if name == "all":
                ax.plot(k + shift, paper[channel], "D", color=INK, markersize=5.5, markeredgecolor="white")
    ax.set_xticks(range(len(groups)), [labels.get(name, name) for name in groups])
    ax.tick_params(axis="x", length=0)
    grid(ax)
    ax.margins(y=0.1)
    ax.set_ylim(0, None)


@styled
def paths_figure(paths: pd.DataFrame) -> Figure:
    """Observed and imagined paths of objects that look alike, from the side (paper, figure 16, right)."""
    kinds = list(dict.fromkeys(paths["kind"]))
    fig = new_figure(4.2 * len(kinds), 4.0)
    axes = fig.subplots(1, len(kinds), squeeze=False, sharex=True, sharey=True)[0]
    for ax, kind in zip(axes, kinds, strict=True):
        mine = paths.loc[paths["kind"].eq(kind)]
        for name, (color, style, width) in PATHS.items():
            path = mine.loc[mine["path"].eq(name), ["x_cm", "z_cm"]].to_numpy(float)
            ax.plot(*path.T, color=color, linestyle=style, linewidth=width)
            ax.plot(*path[-1:].T, "o", color=color, markersize=5)
            if name == "observed":
                ax.plot(*path[:1].T, "s", color=INK, markersize=5, zorder=5)
        ax.set_title(f"{capitalised(kind)}: {mine['outcome'].iloc[0]}")
        ax.set_xlabel("x, along the action [cm]")
        mesh(ax)
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
    title = "One mask, three motions: paths of the centre of mass from the side"
    finish(fig, title, "A lever-up of the test part at one contact")
    return fig
