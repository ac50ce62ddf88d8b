"""Draws docs/images/goals.png: one object, five goals, five lever-ups, as imagined and as simulated with the whole arm.

python docs/images/goals.py
"""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import foretrace as ft
from foretrace.geometry import pose_to_matrix, tilt
from foretrace.pictures.style import CM, INK, OBJECT_COLOR, OBJECT_EDGE, PREDICTION_COLORS, new_figure, styled
from foretrace.planning import Plan

OBJECT = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
GOALS = {
    "as high as possible": ft.goals.Lift(),
    "tilted by 43 degrees": ft.goals.Tilt(0.75),
    "as far to the right as possible": ft.goals.Move((1.0, 0.0)),
    "2 cm up the page": ft.goals.MoveTo((0.0, 0.02)),
    "over towards the top": ft.goals.TurnOver(direction=(0.0, 1.0)),
}
ARROW = 0.04
"""Length of the arrow that shows the lever-up [m]."""
IMAGINED, SIMULATED = PREDICTION_COLORS[0], INK


def main() -> None:
    """Plan, simulate and draw."""
    figure = draw([(name, ft.plan(OBJECT, goal)) for name, goal in GOALS.items()])
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


@styled
def draw(plans: list[tuple[str, Plan]]) -> Figure:
    """A column for each goal."""
    figure = new_figure(14.0, 5.6)
    above, below = figure.subplots(2, len(plans), height_ratios=[1.7, 1.0], squeeze=False)
    for (name, plan), top, bottom in zip(plans, above, below, strict=True):
        draw_plan(name, plan, top, bottom)
    above[0].set_ylabel("y, object frame [cm]")
    below[0].set_ylabel("tilt [degrees]")
    handles, labels = above[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def draw_plan(name: str, plan: Plan, top: Axes, bottom: Axes) -> None:
    """One goal: object, contact and ends from above; tilt over time."""
    action = plan.action
    effect = ft.simulate(OBJECT, action).effect
    seen = effect.times <= action.duration + 1e-9
    real = pose_to_matrix(effect.pose_trajectory[seen])
    states = plan.futures.states[0, int(plan.futures.probability[0].argmax())]
    states = states[plan.imagined.times <= action.duration + 1e-9]
    turned = Rotation.from_rotvec(states[:, 3:]).as_matrix()
    com = OBJECT.mass_properties(1.0).com
    imagined = np.tile(np.eye(4), (len(states), 1, 1))
    imagined[:, :3, :3] = turned @ real[0, :3, :3]
    imagined[:, :3, 3] = states[:, :3] - imagined[:, :3, :3] @ com
    back = np.linalg.inv(action.T_action_object)
    top.fill(*CM * OBJECT.corners.T, color=OBJECT_COLOR, zorder=0)
    top.plot(*closed(CM * OBJECT.corners).T, color=OBJECT_EDGE, linewidth=0.8, zorder=1)
    for poses, color, line, label in (
        (real, SIMULATED, "-", "as simulated with the arm"),
        (imagined, IMAGINED, "--", "as imagined before"),
    ):
        frames = back @ poses
        end = np.column_stack([OBJECT.corners, np.full(len(OBJECT.corners), OBJECT.height)])
        end = end @ frames[-1, :3, :3].T + frames[-1, :3, 3]
        path = frames[:, :3, :3] @ com + frames[:, :3, 3]
        top.plot(*closed(CM * end[:, :2]).T, color=color, linestyle=line, linewidth=1.3, label=label)
        top.plot(*CM * path[:, :2].T, color=color, linestyle=line, linewidth=1.8)
        times = action.duration * np.linspace(0, 1, len(poses))
        bottom.plot(times, np.degrees(tilt(poses[:, :3, :3])), color=color, linestyle=line)
    start, tip = CM * (action.contact - ARROW * action.direction), CM * action.contact
    arrow = {"arrowstyle": "-|>", "color": "#009e73", "lw": 2.4}
    top.annotate("", tuple(tip.tolist()), tuple(start.tolist()), arrowprops=arrow, zorder=6)
    top.set_xlim(-15, 15)
    top.set_ylim(-15, 15)
    top.set_aspect("equal")
    top.set_title(name, fontsize=10)
    top.set_xlabel("x [cm]")
    bottom.set_ylim(0, 95)
    bottom.set_xlabel("time [s]")


def closed(points: np.ndarray) -> np.ndarray:
    """Corners, with the first again in the end."""
    return np.concatenate([points, points[:1]])


if __name__ == "__main__":
    main()
