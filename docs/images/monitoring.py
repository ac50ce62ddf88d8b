"""Draws what a monitor says of six faults, a film of one of them, and what lever-ups tell.

The files are docs/images/causes.png, held.gif and belief.png.

    python docs/images/monitoring.py

Executions are the first ones of their kind, of a seed of their own, in which the fault moves the object by more than a
centimetre.
"""

from dataclasses import replace
from itertools import count
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import foretrace as ft
from foretrace.experiments.executions import Execution, make_execution
from foretrace.experiments.monitor_calibration import imagine
from foretrace.geometry import pose_to_matrix
from foretrace.pictures.scene import Scene
from foretrace.pictures.style import GREY, INK, PREDICTION_COLORS, STYLE
from foretrace.pictures.watched import monitor_film

SEED = 401
SHOWN = {
    "slip": "The blade is pulled out",
    "fixed": "Held at one corner",
    "pushed": "Pushed from the side",
    "friction": "Frictions doubled or halved",
    "other shape": "Another shape",
    "freeze": "The tracker freezes",
}
LEAST = 0.01
HERE = Path(__file__).parent
LOADED = (0.012, -0.008)


def main() -> None:
    """Draw all of them."""
    draw_film()
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(11, 5.6), layout="constrained")
        for ax, (fault, title) in zip(fig.subplots(2, 3).ravel(), SHOWN.items(), strict=True):
            found = (make_execution(SEED, number, fault) for number in count())
            draw_score(ax, next(each for each in found if each.deviation[-1] > LEAST), title)
        fig.supxlabel("time [s]", fontsize=10)
        fig.supylabel("score, widths of the band", fontsize=10)
        fig.savefig(HERE / "causes.png", dpi=110)
        fig = Figure(figsize=(9, 2.6), layout="constrained")
        draw_beliefs(list(fig.subplots(1, 4)))
        fig.savefig(HERE / "belief.png", dpi=110)


def draw_score(ax: Axes, execution: Execution, title: str) -> None:
    """Score against threshold, the deviation's beginning, the alarm and its cause."""
    monitor = ft.Monitor(imagine(execution, "worlds"))
    verdicts = [
        monitor.update(float(t), pose) for t, pose in zip(execution.times, execution.tracked, strict=True)
    ]
    ax.plot(execution.times, [each.score for each in verdicts], color=PREDICTION_COLORS[0])
    ax.axhline(monitor.threshold, color=INK, linestyle="--", linewidth=1)
    ax.axvline(execution.times[int((execution.deviation > 0.002).argmax())], color=GREY, linewidth=1)
    ax.set_yscale("log")
    ax.set_ylim(0.1, 200)
    ax.set_title(title)
    first = next((each for each in verdicts if each.alarm), None)
    if first is not None:
        ax.plot(first.time, max(first.score, 0.1), "o", color=PREDICTION_COLORS[0])
        later = [each.cause for each in verdicts if each.time <= first.time + 0.31][-1]
        ax.text(0.03, 0.9, f"{first.time:.2f} s: {later}", transform=ax.transAxes, color=PREDICTION_COLORS[0])


def draw_film() -> None:
    """The object that is held at a corner, while the monitor watches."""
    found = (make_execution(SEED, number, "fixed") for number in count())
    held = next(each for each in found if each.deviation[-1] > LEAST)
    imagined = imagine(held, "worlds")
    monitor = ft.Monitor(imagined)
    verdicts = [monitor.update(float(t), pose) for t, pose in zip(held.times, held.tracked, strict=True)]
    frames = pose_to_matrix(held.poses)
    com = frames[:, :3, :3] @ held.object.mass_properties(1.0).com + frames[:, :3, 3]
    scene = Scene.imagined(held.object, held.action, held.times, {}, held.poses)
    scene = replace(scene, com=com, title="An object that is held at one corner")
    monitor_film(scene, imagined, verdicts, HERE / "held.gif")


def draw_beliefs(axes: list[Axes]) -> None:
    """Particles of the centre of mass before any lever-up, and after one, two and three."""
    prism = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
    loaded = ft.Weighted(prism, LOADED)
    belief = ft.Belief({"com_x": (-0.025, 0.025), "com_y": (-0.025, 0.025)})
    actions = [ft.LeverUp.at_edge(prism, edge) for edge in (1, 3, 0)]
    for k, ax in enumerate(axes):
        if k:
            action = actions[k - 1]
            effect = ft.simulate(loaded, action, embodiment="tool").effect
            belief = ft.identify(ft.TopDownView.of(prism, action), action, effect, belief)
        drawn = belief.sample(600, np.random.default_rng(0))
        ax.plot(
            1000 * drawn["com_x"],
            1000 * drawn["com_y"],
            ".",
            color=PREDICTION_COLORS[1],
            markersize=3,
            alpha=0.4,
        )
        ax.plot(*(1000 * np.array(LOADED)), "+", color=INK, markersize=14, markeredgewidth=2)
        ax.set_title(["Before", "One lever-up", "Two", "Three"][k])
        ax.set_aspect("equal")
        ax.set_xlim(-26, 26)
        ax.set_ylim(-26, 26)
        ax.set_xlabel("x [mm]")
    axes[0].set_ylabel("centre of mass, y [mm]")


if __name__ == "__main__":
    main()
