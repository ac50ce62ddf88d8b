"""Numbers, tables and pictures of how well pushes are predicted."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from foretrace.evaluation.charts import finish, grid
from foretrace.evaluation.tables import markdown_table, number
from foretrace.geometry import rotate_plane
from foretrace.interactions.pushes import RecordedPushes
from foretrace.pictures.style import GREY, INK, PREDICTION_COLORS, TOOL_COLOR, TRUTH_COLOR, new_figure, styled

WORDS = {
    "stays": "object stays",
    "constant": "constant displacement",
    "nearest": "nearest recorded push",
    "poly4": "limit surface, poly4 (published)",
    "quadratic": "limit surface, ellipsoid (published)",
    "simulation": "quasi-static twin, nominal",
    "mujoco": "MuJoCo, nominal",
    "identified-20": "twin, constants from 20 pushes",
    "identified": "twin, constants from all pushes",
    "learned": "learned alone",
    "im-cnn": "im-cnn + LSTM",
    "one-shot": "one-shot",
    "residual": "residual over the twin",
}
"""Methods in words."""
LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Levels of the regions whose coverage is told."""
SHOWN = "residual"
"""Method whose predictions are drawn."""
RESAMPLED = 1000
"""Bootstrap samples of an interval of a mean."""
MANY = 30
"""Fewer pairs of repeated pushes tell nothing of the least error."""
WORST, TYPICAL = 4, 8
"""Pushes that are drawn."""
MANY_WORST = 20
"""Pushes that are listed."""


def summary_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Errors and coverage of each method."""
    return {method: _numbers(part) for method, part in _by_method(rows)}


def means_of(rows: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Mean errors of each method on some pushes with their intervals, and their number."""
    return {method: _errors(part) | {"pushes": len(part)} for method, part in _by_method(rows)}


def _by_method(rows: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """The rows of each method, in the order of `WORDS`; others come first."""
    places = {name: k for k, name in enumerate(WORDS)}
    parts = [(str(name), part) for name, part in rows.groupby("method", sort=False)]
    return sorted(parts, key=lambda each: places.get(each[0], -1))


def worst_of(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """The pushes that `SHOWN` errs most on, and what every method makes of them [mm]."""
    errors = rows.pivot_table(index=["line", "shape"], columns="method", values="position_mm", sort=False)
    if SHOWN not in errors:
        return []
    worst = errors.nlargest(MANY_WORST, SHOWN)
    return [
        {"line": int(line), "shape": str(shape), "position_mm": {str(k): float(v) for k, v in each.items()}}
        for (line, shape), each in worst.iterrows()  # pyright: ignore[reportGeneralTypeIssues]
    ]


def _numbers(part: pd.DataFrame) -> dict[str, Any]:
    found = {"pushes": len(part)} | _errors(part)
    for name in ("position_mm", "rotation_deg"):
        found[f"{name}_median"] = float(np.median(part[name].to_numpy(float)))
    found["coverage"] = _coverage(part)
    for column, name in (("shape", "by_shape"), ("speed_mm_s", "by_speed")):
        found[name] = {
            str(key): _errors(some) | {"pushes": len(some), "coverage": _coverage(some)}
            for key, some in part.groupby(column)
        }
    return found


def _errors(part: pd.DataFrame) -> dict[str, Any]:
    """Means of both errors with their intervals."""
    found: dict[str, Any] = {}
    for name in ("position_mm", "rotation_deg"):
        values = part[name].to_numpy(float)
        found |= {name: float(values.mean()), f"{name}_interval": _interval(values)}
    return found


def _interval(values: np.ndarray) -> list[float]:
    """95 % interval of a mean over pushes (percentile bootstrap)."""
    rng = np.random.default_rng(0)
    means = values[rng.integers(len(values), size=(RESAMPLED, len(values)))].mean(axis=1)
    return np.percentile(means, [2.5, 97.5]).tolist()


def _coverage(part: pd.DataFrame) -> dict[str, dict[str, float]] | None:
    """Share of the pushes that regions of each level hold; None of a method without regions."""
    reached = {name: _levels(part, name) for name in ("position", "rotation")}
    if np.isnan(reached["position"]).any():
        return None
    return {
        f"{level:.0%}": {name: float((values < level).mean()) for name, values in reached.items()}
        for level in LEVELS
    }


def _levels(rows: pd.DataFrame, name: str) -> np.ndarray:
    """Level of the region that just holds each push; NaN of methods without regions."""
    column = f"{name}_level"  # which is missing where no method has regions
    return rows[column].to_numpy(float) if column in rows else np.full(len(rows), np.nan)


def report_of(summary: Mapping[str, Any]) -> str:
    """The summary in Markdown."""
    methods = summary["methods"]
    lines = []
    for name, each in methods.items():
        covered = each["coverage"]
        shares = ["-"] if covered is None else [f"{100 * covered[k]['position']:.0f}" for k in covered]
        lines.append(
            [
                WORDS.get(name, name),
                _with_interval(each, "position_mm"),
                number(each["position_mm_median"], 2),
                _with_interval(each, "rotation_deg"),
                number(each["rotation_deg_median"], 2),
                " / ".join(shares),
            ]
        )
    head = [
        "Method",
        "Position [mm]",
        "median",
        "Rotation [°]",
        "median",
        "50 / 80 / 90 / 95 % regions hold [%]",
    ]
    held_out = summary["held_out"]
    where = f", all of shape {held_out}, which is not learned from" if held_out else ""
    text = [
        "# Recorded pushes\n",
        f"Learned from {summary['learned_from']} pushes, tested on {summary['tested_on']} others{where}; "
        f"seed {summary['seed']}. Means with 95 % intervals (bootstrap over pushes).\n",
        markdown_table(head, lines),
    ]
    if viewed := summary.get("viewed"):
        text.append(
            f"\nOf {next(iter(viewed.values()))['pushes']} pushes there is a view: the rod meets the outline and leads "
            "into the object, which the window holds. Predictors that observe views answer the others as the nominal "
            "twin does. On those with a view:\n"
        )
        lines = [
            [WORDS.get(name, name), _with_interval(each, "position_mm"), _with_interval(each, "rotation_deg")]
            for name, each in viewed.items()
        ]
        text.append(markdown_table(["Method", "Position [mm]", "Rotation [°]"], lines))
    repeated = summary["repetitions"]
    if repeated["pairs"] >= MANY:
        text.append(
            f"\n{repeated['pairs']} pairs of pushes repeat each other: their objects end {repeated['position_mm']:.2f} "
            f"mm and {repeated['rotation_deg']:.2f}° apart. Divided by the square root of 2, that is about the least "
            f"error that any prediction can have: {repeated['position_mm'] / np.sqrt(2):.2f} mm and "
            f"{repeated['rotation_deg'] / np.sqrt(2):.2f}°.\n"
        )
    shapes = list(dict.fromkeys(key for each in methods.values() for key in each["by_shape"]))
    parts = [
        [WORDS.get(name, name), *(_pair(each["by_shape"].get(shape)) for shape in shapes)]
        for name, each in methods.items()
    ]
    text += ["\n## By shape\n", "Position [mm] / rotation [°].\n", markdown_table(["Method", *shapes], parts)]
    if SHOWN in methods:
        groups = [(name, key) for name in ("by_shape", "by_speed") for key in methods[SHOWN][name]]
        rows = [
            [
                key if name == "by_shape" else f"{float(key):g} mm/s",
                str(each["pushes"]),
                _with_interval(each, "position_mm"),
                _with_interval(each, "rotation_deg"),
            ]
            for name, key in groups
            for each in [methods[SHOWN][name][key]]
        ]
        head = ["Shape or speed", "Pushes", "Position [mm]", "Rotation [°]"]
        text += [f"\nThe {WORDS[SHOWN]}, with 95 % intervals:\n", markdown_table(head, rows)]
    if worst := summary["worst"]:
        columns = list(worst[0]["position_mm"])
        listed = [
            [str(each["line"]), each["shape"], *(f"{each['position_mm'][name]:.1f}" for name in columns)]
            for each in worst
        ]
        mean = [f"{np.mean([each['position_mm'][name] for each in worst]):.1f}" for name in columns]
        words = (
            f"Position errors [mm] of every method where the {WORDS[SHOWN]} errs most; line of the file.\n"
        )
        table = markdown_table(["Line", "Shape", *columns], [*listed, ["mean", "", *mean]])
        text += [f"\n## The worst {len(worst)}\n", words, table]
    if summary["rows_left_out"]:
        text += ["\n## Rows that were left out\n", *(f"- {each}" for each in summary["rows_left_out"])]
    return "\n".join(text) + "\n"


def _with_interval(each: Mapping[str, Any], name: str) -> str:
    low, high = each[f"{name}_interval"]
    return f"{each[name]:.2f} [{low:.2f}, {high:.2f}]"


def _pair(each: Mapping[str, Any] | None) -> str:
    return "" if each is None else f"{each['position_mm']:.1f} / {each['rotation_deg']:.1f}"


@styled
def draw_errors(rows: pd.DataFrame) -> Figure:
    """Mean errors of all methods."""
    summary = summary_of(rows)
    names = [name for name in WORDS if name in summary] + [name for name in summary if name not in WORDS]
    fig = new_figure(9.6, 0.34 * len(names) + 1.5)
    axes = fig.subplots(1, 2, sharey=True)
    for ax, column, words in zip(
        axes, ("position_mm", "rotation_deg"), ("position error [mm]", "rotation error [°]"), strict=True
    ):
        for k, name in enumerate(names):
            value, (low, high) = summary[name][column], summary[name][f"{column}_interval"]
            color = PREDICTION_COLORS[0] if name == SHOWN else PREDICTION_COLORS[1]
            ax.plot([low, high], [k, k], color=color, linewidth=2)
            ax.plot(value, k, "o", color=color, markersize=5)
            ax.annotate(
                f"{value:.2f}", (high, k), (4, 0), textcoords="offset points", va="center", fontsize=8
            )
        grid(ax, xlabel=words, xlim=(0, None), ylim=(len(names) - 0.5, -0.5))
    axes[0].set_yticks(range(len(names)), [WORDS.get(name, name) for name in names])
    finish(
        fig,
        "Where pushes leave their objects",
        f"means over {len(rows) // len(names)} pushes, 95 % intervals",
    )
    return fig


@styled
def draw_coverage(rows: pd.DataFrame) -> Figure:
    """Share of pushes that regions hold, against their level."""
    fig = new_figure(7.6, 4.0)
    axes = fig.subplots(1, 2, sharey=True)
    levels = np.linspace(0, 1, 101)
    for ax, name in zip(axes, ("position", "rotation"), strict=True):
        for method, color, style in (("residual", 0, "-"), ("learned", 1, "--"), ("identified", 2, "-.")):
            reached = _levels(rows.loc[rows["method"] == method], name)
            if len(reached) and not np.isnan(reached).any():
                held = [(reached < level).mean() for level in levels]
                ax.plot(levels, held, style, color=PREDICTION_COLORS[color], label=WORDS[method])
        ax.plot([0, 1], [0, 1], ":", color=GREY)
        grid(ax, xlabel=f"level of the {name} region", xlim=(-0.02, 1.02), ylim=(0, 1.02))
    axes[0].set_ylabel("share of pushes inside")
    if axes[1].get_legend_handles_labels()[0]:
        fig.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    finish(fig, "Regions hold what they promise", "dotted: as promised")
    return fig


@styled
def draw_poses(rows: pd.DataFrame, test: RecordedPushes) -> Figure:
    """Predicted and recorded poses of pushes of every size of error, the worst included."""
    part = pd.DataFrame(rows[rows["method"] == SHOWN]).to_dict(orient="records")
    place = {int(line): row for row, line in enumerate(test.line)}
    fig = new_figure(9.6, 7.6)
    axes = fig.subplots(3, 4).ravel()
    ordered = sorted(part, key=lambda each: each["position_mm"])
    typical = np.linspace(0, max(0, len(ordered) - 1 - WORST), TYPICAL).astype(int)
    numbers = [*np.unique(typical).tolist(), *range(max(0, len(ordered) - WORST), len(ordered))]
    chosen = [ordered[k] for k in numbers if k < len(ordered)]
    for ax, each in zip(axes, chosen, strict=False):
        _draw_pose(ax, each, test, place[int(each["line"])])
    for ax in axes[len(chosen) :]:
        ax.set_axis_off()
    if chosen:
        fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    finish(fig, "Recorded and predicted poses after pushes", "errors from the least to the four worst")
    return fig


def _draw_pose(ax: Axes, each: Mapping[str, Any], test: RecordedPushes, row: int) -> None:
    corners, start, motion = test.shapes[test.shape[row]].model.corners, test.start[row], test.motion[row]
    centre = test.shapes[test.shape[row]].centroid
    truth = test.displacement()[row]
    found = np.array([each["x_mm"] / 1000, each["y_mm"] / 1000, np.deg2rad(each["turn_deg"])])
    ahead = np.arctan2(motion[1], motion[0])

    def outline(pose: Sequence[float] | np.ndarray) -> np.ndarray:
        return 100 * rotate_plane(rotate_plane(corners, pose[2]) + pose[:2] - centre, np.pi / 2 - ahead)

    ax.add_patch(Polygon(outline([0.0, 0.0, 0.0]), fill=False, edgecolor=GREY, linestyle=":", label="before"))
    ax.add_patch(Polygon(outline(truth), facecolor=TRUTH_COLOR, alpha=0.25))
    ax.add_patch(Polygon(outline(truth), fill=False, edgecolor=TRUTH_COLOR, linewidth=1.4, label="recorded"))
    ax.add_patch(
        Polygon(outline(found), fill=False, edgecolor=PREDICTION_COLORS[0], linestyle="--", label="predicted")
    )
    middle = (
        100 * rotate_plane(rotate_plane(centre[None], found[2]) + found[:2] - centre, np.pi / 2 - ahead)[0]
    )
    if np.isfinite(each["radius_90_mm"]):
        ax.add_patch(
            Circle(
                middle,
                each["radius_90_mm"] / 10,
                facecolor=PREDICTION_COLORS[0],
                alpha=0.25,
                label="90 % region",
            )
        )
    ways = 100 * rotate_plane(np.stack([start, start + motion]) - centre, np.pi / 2 - ahead)
    ax.plot(*ways.T, color=TOOL_COLOR, linewidth=2.5, solid_capstyle="round", label="rod")
    ax.add_patch(Circle(ways[1], 100 * test.radius, facecolor=TOOL_COLOR))
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.margins(0.05)
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_visible(False)
    ax.set_title(
        f"{each['shape']}: {each['position_mm']:.1f} mm, {each['rotation_deg']:.1f}°", fontsize=8.5, color=INK
    )
