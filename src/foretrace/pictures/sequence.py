"""Moving picture of a sequence of actions, from above: where the object lies, was expected, and shall lie."""

from collections.abc import Iterator
from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from foretrace.pictures.animation_files import write_animation
from foretrace.pictures.style import (
    CM,
    GREY,
    OBJECT_COLOR,
    OBJECT_EDGE,
    PREDICTION_COLORS,
    STYLE,
    TOOL_COLOR,
    TRUTH_COLOR,
)
from foretrace.planning import Execution
from foretrace.simulation.world import Played

PERIOD = 0.1
"""Time between pictures [s]."""
SPEED_UP = 2.0
"""How much faster than in reality they follow each other."""
MARGIN = 0.03
"""Space about everything that is seen [m]."""


def sequence_animation(
    done: Execution,
    played: list[Played],
    outline: Float[np.ndarray, "n 2"],
    T_goal: Float[np.ndarray, "4 4"],
    path: str | Path,
    title: str = "",
) -> Path:
    """Write a sequence as a GIF or MP4, twice as fast as it happened.

    Args:
        done: What became of it.
        played: The motions of its actions, as a `SimulatedWorld` keeps them.
        outline: Outline of the object in its frame [m].
        T_goal: Where the object shall lie, in its frame at the start.
        path: The file to write; its ending decides between ``.gif`` and ``.mp4``.
        title: First words of the title.

    Raises:
        PredictionError: The ending is unknown, or MP4 cannot be written here.
    """
    return write_animation(Path(path), _frames(done, played, outline, T_goal, title), PERIOD)


def _frames(
    done: Execution,
    played: list[Played],
    outline: Float[np.ndarray, "n 2"],
    T_goal: Float[np.ndarray, "4 4"],
    title: str,
) -> Iterator[np.ndarray]:
    closed = np.concatenate([outline, outline[:1]])
    places = [_from_above(T, closed) for T in (*done.frames, T_goal)]
    low, high = (f(np.concatenate(places), axis=0) for f in (np.min, np.max))
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(6.4, 5.2), dpi=100)
        canvas, ax = FigureCanvasAgg(fig), fig.add_axes((0.1, 0.1, 0.87, 0.78))
        for step, (motion, sequence) in enumerate(zip(played, done.sequences, strict=False)):
            for k in range(0, len(motion.times), max(1, round(SPEED_UP * PERIOD / motion.period))):
                ax.clear()
                ax.plot(*CM * _from_above(T_goal, closed).T, color=TRUTH_COLOR, linewidth=2, label="goal")
                for number, T in enumerate(sequence.frames[1:]):
                    expected = "expected" if number == 0 else None
                    look = {"color": PREDICTION_COLORS[0], "linestyle": "--", "linewidth": 1.1}
                    ax.plot(*CM * _from_above(T, closed).T, label=expected, **look)
                for T in done.frames[: step + 1]:
                    ax.plot(*CM * _from_above(T, closed).T, color=GREY, linewidth=0.7)
                here = _from_above(motion.object_frame[k], closed)
                ax.fill(*CM * here.T, facecolor=OBJECT_COLOR, edgecolor=OBJECT_EDGE, label="object")
                ax.plot(*CM * motion.tool[k], "o", color=TOOL_COLOR, markersize=8, label="tool")
                ax.set(
                    xlim=CM * np.array([low[0] - MARGIN, high[0] + MARGIN]),
                    ylim=CM * np.array([low[1] - MARGIN, high[1] + MARGIN]),
                    xlabel="x [cm]",
                    ylabel="y [cm]",
                    aspect="equal",
                )
                ax.set_title(f"{title}: {done.actions[step].label} {step + 1} of {len(done.actions)}")
                ax.legend(loc="upper left", fontsize=8)
                canvas.draw()
                yield np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def _from_above(T: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    return points @ T[:2, :2].T + T[:2, 3]
