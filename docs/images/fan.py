"""Draws docs/images/fan.png, and animations of a lever-up and of a slip: what was predicted, and the truth on top.

    python docs/images/fan.py RUN DATA

Shown are lever-ups of the test part, not learned from. Which ones is fixed beforehand: those at given
places among the errors of all with the same outcome, up to the worst.
"""

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from foretrace.geometry import invert_transform, matrix_to_pose, pose_to_matrix
from foretrace.imagined.shown import percentage
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Interaction
from foretrace.pictures.animation import interaction_animation
from foretrace.pictures.bands import PredictionBand
from foretrace.pictures.scene import silhouette, tool_line
from foretrace.pictures.style import CM, GREY, INK, STYLE, TOOL_COLOR
from foretrace.predictor import ImaginedEffect, load_predictor, part_of
from foretrace.trajectories import mean_distance

PLACES = {
    "levered": (0.1, 0.5, 0.9, 1.0),
    "slipped": (0.25, 0.5, 0.9, 1.0),
    "rolled": (0.5, 1.0),
    "tumbled": (0.5, 1.0),
}
"""Which share of the lever-ups with an outcome is predicted better than those shown."""
NAMES = {0.1: "10th percentile", 0.25: "25th percentile", 0.5: "median", 0.9: "90th percentile", 1.0: "worst"}
PREDICTED, TRUTH = "#d55e00", INK
INSTANTS = 5
LEVEL = 0.9
LEAST_PROBABLE = 0.05


def main() -> None:
    """Draw them."""
    run, folder = (Path(argument) for argument in sys.argv[1:3])
    predictor = load_predictor(run)
    dataset = Dataset.open(folder)
    test = part_of(run, dataset)
    imagined = predictor.imagine_batch(test)
    errors = np.asarray(mean_distance(imagined.com, test.com))
    chosen = []
    for outcome, places in PLACES.items():
        rows = np.flatnonzero(test.outcome == outcome)
        order = rows[np.argsort(errors[rows])]
        chosen += [(order[round(place * (len(order) - 1))], place) for place in places]
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(15, 10.5), layout="constrained")
        for ax, (row, place) in zip(fig.subplots(3, 4).ravel(), chosen, strict=True):
            interaction = dataset.with_id(int(test.ids[row]))
            draw(ax, interaction, imagined[row])
            title = f"{interaction.effect.outcome}, {NAMES[place]}: {100 * errors[row]:.2f} cm"
            ax.set_title(f"{title}\n", fontsize=10.5, loc="left", fontweight="bold")
            said = ax.text(
                0, 1.03, told(imagined[row]), transform=ax.transAxes, fontsize=9.5, color=PREDICTED
            )
            said.set_in_layout(False)
        handles = [
            Line2D([], [], color=TRUTH, lw=2.2, label="what happened"),
            Line2D([], [], color=PREDICTED, lw=2, label="most probable future"),
            Patch(color=PREDICTED, alpha=0.2, label="holds nine paths in ten"),
            Line2D([], [], color=PREDICTED, lw=1, ls=(0, (2, 1.5)), label="less probable futures"),
        ]
        fig.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=11)
        fig.savefig(Path(__file__).with_name("fan.png"), dpi=100)
    for outcome in ("levered", "slipped"):
        row = next(row for row, place in chosen if test.outcome[row] == outcome and place == 0.5)
        interaction = dataset.with_id(int(test.ids[row]))
        interaction_animation(
            interaction, Path(__file__).with_name(f"{outcome}.gif"), {"predicted": imagined.com[row]}
        )


def told(effect: ImaginedEffect) -> str:
    """The two most probable outcomes."""
    found = sorted(((float(p[0]), name) for name, p in effect.futures.outcomes().items()), reverse=True)
    return "predicted: " + ", ".join(f"{name} {percentage(p)}" for p, name in found[:2] if p >= 0.01)


def draw(ax: Axes, interaction: Interaction, effect: ImaginedEffect) -> None:
    """One lever-up from the side."""
    observed, futures = interaction.effect, effect.futures
    assert futures is not None
    assert effect.pose_trajectory is not None
    rest = pose_to_matrix(observed.pose_trajectory[0])
    at_rest = np.eye(4)
    at_rest[:3, 3] = observed.com_trajectory[0]
    carried = pose_to_matrix(effect.pose_trajectory) @ invert_transform(at_rest) @ rest
    moved = np.linalg.norm(observed.com_trajectory - observed.com_trajectory[0], axis=1) > 1e-3
    first = int(np.argmax(moved)) if moved.any() else 0
    instants = np.unique(np.linspace(first, len(observed.times) - 1, INSTANTS).round().astype(int))
    ax.axhspan(-100, 0, color="#f1f2f4", zorder=-1)
    ax.axhline(0, color=GREY, linewidth=1, zorder=0)
    for k, strength in zip(instants, np.linspace(0.25, 1.0, len(instants)), strict=True):
        for ring in silhouette(interaction.object, observed.pose_trajectory[k]):
            ax.fill(*ring.T * CM, facecolor="#8fa3b8", alpha=0.14, linewidth=0)
            ax.plot(*ring.T * CM, color=TRUTH, alpha=0.7 * strength, linewidth=0.9)
        for ring in silhouette(interaction.object, matrix_to_pose(carried[k])):
            ax.plot(*ring.T * CM, color=PREDICTED, alpha=strength, linewidth=1.1)
    best = int(futures.probability[0].argmax())
    radius = futures.radius(LEVEL)[0, best]
    others = [
        (futures.outcome[k], futures.com[0, k])
        for k in np.flatnonzero(futures.probability[0] >= LEAST_PROBABLE)
        if k != best
    ]
    PredictionBand(
        effect.com_trajectory, radius if np.isfinite(radius).all() else None, LEVEL, others
    ).draw_in_plane(ax, (0, 2), PREDICTED)
    ax.plot(*effect.com_trajectory[:, [0, 2]].T * CM, color=PREDICTED, linewidth=2.0, zorder=5)
    ax.plot(*observed.com_trajectory[:, [0, 2]].T * CM, color=TRUTH, linewidth=1.6, zorder=6)
    ax.plot(
        *tool_line(observed.tool_trajectory[-1])[:, [0, 2]].T * CM, color=TOOL_COLOR, linewidth=2, zorder=2
    )
    shown = [ring for k in instants for ring in silhouette(interaction.object, observed.pose_trajectory[k])]
    shown += [ring for k in instants for ring in silhouette(interaction.object, matrix_to_pose(carried[k]))]
    low, high = CM * np.concatenate(shown).min(axis=0), CM * np.concatenate(shown).max(axis=0)
    top = max(high[1], 0.62 * (high[0] - low[0] + 3) / 1.25)
    ax.set(aspect="equal", xlim=(min(low[0], -2) - 1.5, high[0] + 1.5), ylim=(min(low[1], 0) - 1, top * 1.25))
    ax.grid(False)
    ax.set(xlabel="along the action [cm]", ylabel="up [cm]")


if __name__ == "__main__":
    main()
