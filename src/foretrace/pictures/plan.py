"""Picture of a plan: the object with the cost along its rim, the chosen contact, and what is imagined of it."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from foretrace.geometry import tilt
from foretrace.imagined.shown import percentage
from foretrace.pictures.style import (
    CM,
    GREY,
    INK,
    OBJECT_COLOR,
    OBJECT_EDGE,
    OUTCOME_COLORS,
    PREDICTION_COLORS,
    headline,
    new_figure,
    styled,
)
from foretrace.planning import Plan

COSTS = "viridis_r"
"""Colours of costs: the lighter, the better."""
ARROW = 0.05
"""Length of the arrow that shows the action [m]."""
LEAST_PROBABLE = 0.02
"""Futures less probable than this are not drawn."""
FLAT = 0.02
"""A motion that never tilts by more than this stays flat [rad]."""
RISKY = 0.2
"""Contacts whose risk is greater are crossed out."""


@styled
def plan_figure(plan: Plan) -> Figure:
    """The object from above in its own frame, and the futures over time."""
    fig = new_figure(11.0, 4.9)
    grid = fig.add_gridspec(2, 2, width_ratios=[1.35, 1.0])
    draw_rim(fig.add_subplot(grid[:, 0]), plan)
    height, angle = fig.add_subplot(grid[0, 1]), fig.add_subplot(grid[1, 1])
    _draw_futures(height, angle, plan)
    risk = f", risk {percentage(plan.risk)}" if plan.chances else ""
    title = (
        f"{plan.goal}: reached with a probability of {percentage(plan.reached)}, cost {plan.cost:.2f}{risk}"
    )
    headline(fig, title if len(title) <= 110 else f"{title[:107]}...")
    return fig


def draw_rim(axes: Axes, plan: Plan) -> None:
    """The object from above: cost along the rim, contacts, and the imagined motion."""
    axes.fill(*CM * plan.outline.T, color=OBJECT_COLOR, zorder=0)
    axes.plot(*_closed(CM * plan.outline).T, color=OBJECT_EDGE, linewidth=0.8, zorder=1)
    rim = plan.rim
    dots = axes.scatter(*CM * rim.points.T, c=rim.cost, cmap=COSTS, s=34, zorder=3, linewidths=0)
    # The rim is coloured by the first stage: what the choice costs after refinement and check stands in the title.
    label = "cost as first imagined" + (
        ", before the check" if any(each.name == "checked" for each in plan.stages) else ""
    )
    axes.figure.colorbar(dots, ax=axes, label=label, shrink=0.75, pad=0.02)
    if (risky := rim.risk > RISKY).any():
        axes.scatter(
            *CM * rim.points[risky].T, marker="x", c=INK, s=12, linewidths=0.7, zorder=4,
            label=f"risk over {RISKY:.0%}",
        )  # fmt: skip
    color = PREDICTION_COLORS[0]
    path, end = _imagined_from_above(plan)
    axes.plot(*CM * path.T, color=color, linestyle="--", linewidth=1.6, label="centre of mass", zorder=5)
    axes.plot(*CM * path[-1], "o", color=color, markersize=4, zorder=5)
    if end is not None:
        axes.plot(*_closed(CM * end).T, color=color, linewidth=1.1, alpha=0.8, label="object at the end")
    contact, way = plan.action.contact, plan.action.direction
    start, tip = CM * (contact - ARROW * way), CM * contact
    axes.annotate(
        "",
        tuple(tip.tolist()),
        tuple(start.tolist()),
        arrowprops={"arrowstyle": "-|>", "color": color, "lw": 2.2},
        zorder=6,
    )
    for k, other in enumerate(plan.alternatives, start=2):
        place = CM * (other.action.contact - 0.012 * other.action.direction)
        axes.text(float(place[0]), float(place[1]), str(k), color=GREY, fontsize=9, ha="center", va="center")
    axes.update_datalim([start])
    axes.set_aspect("equal")
    axes.margins(0.06)
    axes.set_xlabel("x, object frame [cm]")
    axes.set_ylabel("y, object frame [cm]")
    axes.set_title("cost along the rim; 2, 3, ...: alternatives")
    axes.legend(loc="best", fontsize=8)


def _draw_futures(height: Axes, angle: Axes, plan: Plan) -> None:
    """Height of the centre of mass and tilt over time, or way and turn of what stays flat, as wide as probable."""
    futures, times = plan.futures, plan.imagined.times
    flat = not (np.abs(futures.states[0, :, :, 3:5]) > FLAT).any()
    shown = times <= plan.action.duration + 1e-9
    for k in np.argsort(-futures.probability[0]):
        probability = float(futures.probability[0, k])
        if probability < LEAST_PROBABLE:
            continue
        states, name = futures.states[0, k][shown], futures.outcome[k]
        look = {
            "color": OUTCOME_COLORS.get(name, INK),
            "linewidth": 0.8 + 1.8 * probability,
            "label": f"{name} {percentage(probability)}",
        }
        way = np.linalg.norm(states[:, :2] - states[0, :2], axis=1)
        height.plot(times[shown], CM * (way if flat else states[:, 2]), **look)
        if np.isfinite(states[:, 3:]).all():
            turned = states[:, 5] if flat else tilt(Rotation.from_rotvec(states[:, 3:]).as_matrix())
            angle.plot(times[shown], np.degrees(turned), **look)
    height.set_ylabel(f"{'way' if flat else 'height'} of the\ncentre of mass [cm]")
    height.legend(loc="upper left", fontsize=8)
    height.tick_params(labelbottom=False)
    angle.set_ylabel(f"{'turn' if flat else 'tilt'} [degrees]")
    angle.set_xlabel("time [s]")
    height.set_title("what is imagined of it")


def _imagined_from_above(plan: Plan) -> tuple[np.ndarray, np.ndarray | None]:
    """Path of the centre of mass and the upper face's outline at the path's end, in the object's frame [m]."""
    action, imagined = plan.action, plan.imagined
    states = plan.futures.states[0, int(plan.futures.probability[0].argmax())]
    states = states[imagined.times <= action.duration + 1e-9]
    axes = action.T_action_object[:2, :2]  # rows: the action frame's axes in the object's
    path = states[:, :2] @ axes + action.contact
    if not np.isfinite(states[-1, 3:]).all():
        return path, None
    top = np.column_stack([plan.outline, np.full(len(plan.outline), plan.height)])
    start = np.array([*path[0], states[0, 2]])
    turn = np.eye(3)
    turn[:2, :2] = axes.T
    rotation = turn @ Rotation.from_rotvec(states[-1, 3:]).as_matrix() @ turn.T
    return path, (top - start) @ rotation[:2].T + path[-1]


def _closed(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, points[:1]])
