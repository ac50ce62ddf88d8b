"""Pictures of the comparisons with stand-in or recordings: the paper's figure 15, and figure 14's last panel."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from msgspec import Meta

from foretrace.errors import ResultsError
from foretrace.evaluation.charts import BLUE, GREEN, VERMILLION, finish, grid, mesh
from foretrace.experiments.transfer_objects import Subject
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE
from foretrace.pictures.scene import draw_arrow, draw_path, draw_table
from foretrace.pictures.style import CM, INK, OBJECT_EDGE, TOOL_COLOR, new_figure, styled
from foretrace.schema import conform
from foretrace.simulation.stand_in import Perturbation, StandIn, hull_of

HULL_COLOR, MASK_COLOR = "#f3c98b", "#a9bdd3"
BARS = {"predicted": ("distance_predicted_cm", VERMILLION), "simulated": ("distance_simulated_cm", BLUE)}
PATHS: dict[str, tuple[str, Any, float]] = {
    "observed": (GREEN, "-", 2.4),
    "predicted": (VERMILLION, "--", 1.8),
    "simulated": (BLUE, "-.", 1.8),
}
PAPER_MARK: dict[str, Any] = {
    "color": INK, "marker": "D", "markersize": 7, "linestyle": "none", "markeredgecolor": "white", "zorder": 5
}  # fmt: skip
"""A number of the paper's."""
PANEL = 10.0
"""Width of what is shown around paths [cm]."""
PER_ROW = 7
"""Masks side by side."""
PATHS_PER_ROW = 4
"""Panels with paths side by side."""


@styled
def objects_figure(
    subjects: Sequence[Subject], rows: pd.DataFrame, stand_in: StandIn, paper: Mapping[str, float]
) -> Figure:
    """Masks of objects as the predictor observes them, and the errors on each (paper, figure 15)."""
    names = [subject.name for subject in subjects]
    columns = min(len(names), PER_ROW)
    lines = -(-len(names) // columns)
    width = max(8.6, 1.75 * columns)
    heights = [width / columns * lines * 0.95, 3.6]
    fig = new_figure(width, 0.7 + sum(heights))
    layout = fig.add_gridspec(2, 1, height_ratios=heights)
    above, below = fig.add_subfigure(layout[0]), fig.add_subfigure(layout[1])
    cells = above.subplots(lines, columns, squeeze=False).ravel()
    for ax, subject in zip(cells, subjects, strict=False):
        draw_view(ax, subject, rows.loc[rows["object"].eq(subject.name)], stand_in)
    for ax in cells[len(names) :]:
        ax.axis("off")
    draw_errors(below.subplots(), rows, names, paper)
    handles = [
        Patch(color=MASK_COLOR, label="mask of the camera"),
        Patch(color=HULL_COLOR, label="added by its convex hull"),
        Line2D([], [], color=OBJECT_EDGE, linewidth=1, label="true outline"),
        Line2D([], [], color=TOOL_COLOR, linewidth=2.4, marker="^", label="contact shown"),
        Line2D([], [], color=INK, marker="o", linestyle="none", markersize=4, label="other contacts"),
    ]
    above.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=8.5)
    shown: list[Patch | Line2D] = [
        Patch(facecolor=color, alpha=0.45, edgecolor=color, label=f"stand-in against {name}")
        for name, (_, color) in BARS.items()
    ]
    if paper:
        shown.append(Line2D([], [], label="paper: real against predicted", **PAPER_MARK))
    note = "bars: mean and standard deviation; dots: single lever-ups"
    below.legend(
        handles=shown, loc="outside lower center", ncols=3, fontsize=8.5, title=note, title_fontsize=8.5
    )
    title = "Objects as the predictor observes them, and the distance of its path from the stand-in's"
    finish(
        fig,
        title,
        "A simulated stand-in for the real robot: Bullet, other friction, errors of contact and camera",
    )
    return fig


def draw_view(ax: Axes, subject: Subject, rows: pd.DataFrame, stand_in: StandIn) -> None:
    """One object's mask and hull in the action frame of its first contact, action upwards; scales in cm."""
    row = rows.sort_values(["contact", "repetition"], kind="stable").iloc[0]
    values = {each.name: float(row[each.name]) for each in fields(Perturbation)}
    drawn = Perturbation(**values | {"noise_seed": int(values["noise_seed"])})  # pyright: ignore[reportArgumentType]
    action = subject.actions[int(row["contact"]) - 1]
    view = stand_in.see(subject.obj, action, drawn)
    shown = view.mask.astype(int) + (hull_of(view) if subject.hull else view).mask
    edge = np.array([-0.5, VIEW_SIZE - 0.5])
    top, bottom = (CONTACT_PIXEL[0] - edge) * METRES_PER_PIXEL * CM
    left, right = (CONTACT_PIXEL[1] - edge) * METRES_PER_PIXEL * CM
    colors = ListedColormap(["white", HULL_COLOR, MASK_COLOR])
    ax.imshow(shown, cmap=colors, vmin=0, vmax=2, extent=(left, right, bottom, top), interpolation="nearest")
    T = action.T_action_object
    outline = subject.obj.corners @ T[:2, :2].T + T[:2, 3]
    closed = np.concatenate([outline, outline[:1]]) * CM
    ax.plot(closed[:, 1], closed[:, 0], color=OBJECT_EDGE, linewidth=1)
    contacts = np.array([other.contact for other in subject.actions if other is not action])
    if len(contacts):
        others = (contacts @ T[:2, :2].T + T[:2, 3]) * CM
        ax.plot(others[:, 1], others[:, 0], "o", color=INK, markersize=4)
    draw_arrow(ax, 2.4)
    low, high = np.minimum(outline.min(axis=0) * CM, [-5, 0]), outline.max(axis=0) * CM
    middle, half = (low + high) / 2, max((high - low).max() / 2, 9) + 1.5
    ax.set(
        xlim=(middle[1] + half, middle[1] - half), ylim=(middle[0] - half, middle[0] + half), aspect="equal"
    )
    ax.set_title(subject.name, loc="center")
    ax.set(xticks=[], yticks=[])
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.plot(
        [middle[1] - half + 5.8, middle[1] - half + 0.8], [middle[0] - half + 0.6] * 2, color=INK, linewidth=2
    )
    ax.text(middle[1] - half + 3.3, middle[0] - half + 1.1, "5 cm", ha="center", fontsize=8, color=INK)


def draw_errors(ax: Axes, rows: pd.DataFrame, names: Sequence[str], paper: Mapping[str, float]) -> None:
    """Mean and standard deviation for each object, every lever-up as a dot, the paper's value as a mark."""
    rng = np.random.default_rng(0)
    labels = []
    for k, name in enumerate(names):
        mine = rows.loc[rows["object"].eq(name)]
        labels.append(name)
        for (kind, (column, color)), shift in zip(BARS.items(), (-0.2, 0.2), strict=True):
            values = mine[column].dropna().to_numpy(float)
            if len(values) == 0:
                continue
            ax.bar(k + shift, values.mean(), width=0.36, color=color, alpha=0.3, edgecolor=color)
            places = k + shift + rng.uniform(-0.12, 0.12, len(values))
            ax.plot(places, values, "o", color=color, markersize=2.6, alpha=0.7, markeredgewidth=0)
            if len(values) > 1:
                sd = values.std(ddof=1)
                ax.errorbar(k + shift, values.mean(), yerr=sd, color=color, capsize=3, linewidth=1.4)
            if name in paper and kind == "predicted":
                ax.plot(k + shift, paper[name], **PAPER_MARK)
                labels[-1] += f"\n{values.mean():.2f} (paper {paper[name]:.2f})"
    grid(ax, ylabel="distance after\ntime warping [cm]", xlim=(-0.6, len(names) - 0.4), ylim=(0, None))
    many = len(names) > PER_ROW
    ax.set_xticks(
        range(len(names)),
        labels,
        rotation=35 if many else 0,
        ha="right" if many else "center",
        rotation_mode="anchor",
    )
    ax.tick_params(axis="x", length=0)
    if not many:
        for label in ax.get_xticklabels():
            label.set_verticalalignment("top")


@styled
def paths_figure(
    rows: pd.DataFrame,
    observed: str = "stand-in",
    note: str = "The stand-in is Bullet with other constants and errors, not a robot; the table is grey",
) -> Figure:
    """Paths of the centre of mass from the side: observed, predicted, simulated (paper, figure 14, last panel)."""
    columns = min(len(rows), PATHS_PER_ROW)
    lines = -(-len(rows) // columns)
    width, height = max(6.8, 3.4 * columns), 1.2 + 3.7 * lines
    fig = new_figure(width, height)
    cells = fig.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
    shown = [{name: np.array(path) / CM for name, path in _paths(text).items()} for text in rows["paths_cm"]]
    window = window_of([path for paths in shown for path in paths.values()])
    for k, (ax, paths, row) in enumerate(zip(cells, shown, rows.to_dict("records"), strict=False)):
        slip = row.get("slip_time", np.nan)
        slipped = "" if np.isnan(slip) else f", slips at {slip:.1f} s"
        draw_paths(ax, paths, f"{row['object']}, contact {row['contact']}{slipped}", window)
        lowest = k + columns >= len(rows)
        ax.set_xlabel(ax.get_xlabel() if lowest else "")
        ax.set_ylabel("" if k % columns else ax.get_ylabel())
        ax.tick_params(labelbottom=lowest)
    for ax in cells[len(rows) :]:
        ax.axis("off")
    handles = _handles((observed, "predicted", "simulated"))
    fig.legend(handles=handles, loc="outside lower center", ncols=3)
    finish(fig, "Paths of the centre of mass from the side", note)
    return fig


def _handles(names: Sequence[str]) -> list[Line2D]:
    return [
        Line2D([], [], color=color, linestyle=style, linewidth=width, label=name)
        for name, (color, style, width) in zip(names, PATHS.values(), strict=False)
    ]


@styled
def side_figure(
    observed: Float[np.ndarray, "time 3"], predicted: Float[np.ndarray, "later 3"], title: str
) -> Figure:
    """Observed and predicted centre of mass [m] of one recording from the side (paper, figure 14, last panel)."""
    fig = new_figure(6.4, 6.4)
    ax = fig.subplots()
    paths = {"observed": observed, "predicted": predicted}
    draw_paths(ax, paths, title, window_of(list(paths.values())))
    ax.legend(handles=_handles(("observed", "predicted")), loc="upper left")
    finish(fig, "Paths of the centre of mass from the side", "The table is grey")
    return fig


def window_of(paths: Sequence[Float[np.ndarray, "_ 3"]]) -> tuple[float, float, float]:
    """Left and right end, and top, of what is shown around paths [m], in cm."""
    seen = np.concatenate(paths)[:, [0, 2]] * CM
    (left, _), (right, top) = seen.min(axis=0), seen.max(axis=0)
    half = max(PANEL, right - left + 2) / 2
    middle = (left + right) / 2
    return middle - half, middle + half, max(top + 1, PANEL - 1)


def draw_paths(
    ax: Axes,
    paths: Mapping[str, Float[np.ndarray, "_ 3"]],
    title: str,
    window: tuple[float, float, float],
) -> None:
    """Paths [m] by what they are, in the x-z plane of the action frame, within a window; scales in cm."""
    for name, path in paths.items():
        draw_path(ax, path[:, [0, 2]] * CM, *PATHS[name])
    ax.set_title(title)
    left, right, top = window
    ax.set(xlim=(left, right), ylim=(-1, top))
    ax.set(aspect="equal", xlabel="x, along the action [cm]", ylabel="z, up [cm]")
    draw_table(ax, 1.0)
    mesh(ax)


def _paths(text: Any) -> dict[str, Any]:
    """Paths [cm] from the text in a row.

    Raises:
        ResultsError: It is no such text.
    """
    remedy = "restore the table of rows"
    try:
        content = json.loads(str(text))
    except ValueError as reason:
        raise ResultsError(f"paths_cm is no JSON ({reason}): {remedy}") from None
    point = Annotated[list[float], Meta(min_length=3, max_length=3)]
    return conform(content, dict[str, list[point]], "paths_cm", ResultsError, remedy)
