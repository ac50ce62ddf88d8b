"""The picture of an execution that a monitor watched: score against threshold, outcomes, height."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from foretrace.imagined import ImaginedEffect
from foretrace.monitoring import Verdict
from foretrace.pictures.style import (
    CM,
    GREY,
    INK,
    OUTCOME_COLORS,
    PREDICTION_COLORS,
    TRUTH_COLOR,
    headline,
    new_figure,
    styled,
)

SHOWN = 60
"""Motions of worlds that are drawn."""


@styled
def monitor_figure(
    imagined: ImaginedEffect,
    verdicts: Sequence[Verdict],
    com: Float[np.ndarray, "time 3"],
    title: str,
) -> Figure:
    """Score, outcomes and height of one execution over time.

    Args:
        imagined: What was imagined.
        verdicts: The verdict at each sample, at least one.
        com: Observed centre of mass at each sample, in the action frame [m]; NaN where it was not tracked.
        title: Title.
    """
    times = np.array([each.time for each in verdicts])
    fig = new_figure(7.2, 7.0)
    score, outcomes, height = fig.subplots(3, 1, sharex=True, height_ratios=(3, 2, 3))
    values = np.array([each.score for each in verdicts])
    score.plot(times, values, color=PREDICTION_COLORS[0], label="score")
    score.axhline(verdicts[0].threshold, color=INK, linestyle="--", linewidth=1.0, label="threshold")
    score.set_yscale("log")
    score.set_ylim(0.05, max(20.0, 1.5 * values.max()))
    score.set_ylabel("widths of the band")
    names = [name for name in verdicts[0].outcomes if max(each.outcomes[name] for each in verdicts) > 0.01]
    for name in names:
        color = OUTCOME_COLORS.get(name, GREY)
        outcomes.plot(times, [each.outcomes[name] for each in verdicts], color=color, label=name)
    outcomes.set_ylim(-0.03, 1.03)
    outcomes.set_ylabel("probability")
    _draw_height(height, imagined, times, com)
    alarm = next((each for each in verdicts if each.alarm), None)
    if alarm is not None:
        for axes in (score, outcomes, height):
            axes.axvline(alarm.time, color=PREDICTION_COLORS[0], linewidth=1.0)
        last = verdicts[-1].cause
        words = f"alarm at {alarm.time:.2f} s: {alarm.cause}"
        words += "" if last == alarm.cause else f", in the end: {last}"
        score.text(alarm.time, score.get_ylim()[1], f" {words}", va="top", color=PREDICTION_COLORS[0])
    for axes in (score, outcomes, height):
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    headline(fig, title)
    return fig


def _draw_height(
    axes: Axes, imagined: ImaginedEffect, times: Float[np.ndarray, " time"], com: Float[np.ndarray, "time 3"]
) -> None:
    """Height of the centre of mass, as imagined and as seen."""
    worlds = imagined.worlds
    if worlds is not None:
        believed = [k for k, cause in enumerate(worlds.causes) if not cause]
        for k in believed[:: max(1, len(believed) // SHOWN)]:
            rise = worlds.futures.states[0, k, :, 2]
            axes.plot(imagined.times, CM * rise, color=GREY, linewidth=0.5, alpha=0.4)
        axes.plot([], [], color=GREY, linewidth=0.5, label="worlds")
    axes.plot(
        imagined.times,
        CM * imagined.com_trajectory[:, 2],
        color=PREDICTION_COLORS[1],
        linestyle="--",
        label="imagined",
    )
    axes.plot(times, CM * com[:, 2], color=TRUTH_COLOR, linewidth=1.8, label="observed")
    axes.set_xlim(times[0], max(float(times[-1]), float(times[0]) + 0.1))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("height [cm]")
