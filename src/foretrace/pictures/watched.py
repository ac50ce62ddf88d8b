"""Picture and film of an execution that a monitor watched: score against threshold, outcomes, height."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from foretrace.imagined import ImaginedEffect
from foretrace.monitoring import Verdict
from foretrace.pictures.animation import frames
from foretrace.pictures.animation_files import write_animation
from foretrace.pictures.scene import Ghost, Scene
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
PERIOD = 0.05
"""Least time between the pictures of a film [s]."""
MOST = 300
"""Pictures of a film, at most."""


@styled
def monitor_figure(
    imagined: ImaginedEffect,
    verdicts: Sequence[Verdict],
    com: Float[np.ndarray, "time 3"],
    title: str,
    source: str = "observed",
) -> Figure:
    """Score, outcomes and height of one execution over time.

    Args:
        imagined: What was imagined.
        verdicts: The verdict at each sample, at least one.
        com: Centre of mass at each sample, in the action frame [m]; NaN where it was not tracked.
        title: Title.
        source: What the motion is called: ``observed`` or ``simulated``.
    """
    fig = new_figure(7.2, 7.0)
    axes = list(fig.subplots(3, 1, sharex=True, height_ratios=(3, 2, 3)))
    _draw_verdicts(axes, imagined, verdicts, com, source)
    alarm = _alarm(verdicts)
    if alarm is not None:
        last, top = verdicts[-1].cause, axes[0].get_ylim()[1]
        words = _words(alarm)
        words += "" if last == alarm.cause else f", in the end: {last}"
        axes[0].text(alarm.time, top, f" {words}", va="top", color=PREDICTION_COLORS[0])
    turn = turning_point(verdicts)
    if turn is not None:
        late = turn.time > np.mean([each.time for each in verdicts])
        words = f"{turn.time:.2f} s: {max(turn.outcomes, key=turn.outcomes.__getitem__)} takes over"
        axes[1].annotate(words, (turn.time, 0.5), (-14 if late else 14, 0), textcoords="offset points",
                         ha="right" if late else "left", va="center", fontsize=8)  # fmt: skip
    for each in axes:
        each.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    headline(fig, title)
    return fig


def monitor_film(
    scene: Scene, imagined: ImaginedEffect, verdicts: Sequence[Verdict], path: str | Path
) -> Path:
    """Write the execution as a GIF or MP4 in real time: the object, where it was expected, and score over time.

    Pictures follow each other evenly, at most 20 in a second and `MOST` in all, however often the object was tracked.

    Args:
        scene: The execution; its samples are those of the verdicts.
        imagined: What was imagined.
        verdicts: The verdict at each sample.
        path: The file to write; its ending decides between ``.gif`` and ``.mp4``.

    Raises:
        PredictionError: The ending is unknown, or MP4 cannot be written here.
    """
    com = scene.com
    assert com is not None
    scene = _evenly(scene)
    expected = imagined.object_poses(scene.placement)
    ghosts = (
        ()
        if expected is None
        else (Ghost(_at(scene.times, imagined.times, expected), PREDICTION_COLORS[0], 1.0),)
    )
    scene = replace(scene, predictions={"imagined": imagined.com_trajectory}, ghosts=ghosts)

    def diagrams(axes: list[Axes], _: Scene) -> None:
        _draw_verdicts(axes, imagined, verdicts, com, scene.source)
        for ax in axes[:2]:
            ax.tick_params(labelbottom=False)
        axes[0].set_title("score, outcomes, height", fontsize=9)
        axes[1].legend(loc="center left", fontsize=7)
        for ax in axes:
            ax.set_ylabel(ax.get_ylabel(), fontsize=7.5)

    alarm = _alarm(verdicts)
    news = None
    if alarm is not None:
        since = int(np.searchsorted(scene.times, alarm.time - 1e-6))
        news = min(since, len(scene.times) - 1), _words(alarm).capitalize()
    period = float(scene.times[1] - scene.times[0]) if len(scene.times) > 1 else PERIOD
    return write_animation(Path(path), frames(scene, height=500, diagrams=diagrams, news=news), period)


def _evenly(scene: Scene) -> Scene:
    """A scene at even times: at each, the last sample so far."""
    times = scene.times
    if len(times) < 2:
        return scene
    span = float(times[-1] - times[0])
    period = max(PERIOD, float(np.median(np.diff(times))), span / (MOST - 1))
    even = times[0] + period * np.arange(round(span / period) + 1)
    rows = np.searchsorted(times, even + 1e-6, side="right") - 1
    own = {name: getattr(scene, name)[rows] for name in ("com", "tool") if getattr(scene, name) is not None}
    return replace(scene, times=even, pose=scene.pose[rows], **own)


def _alarm(verdicts: Sequence[Verdict]) -> Verdict | None:
    return next((each for each in verdicts if each.alarm), None)


def turning_point(verdicts: Sequence[Verdict]) -> Verdict | None:
    """The first verdict by which another outcome than the one expected at first has taken over."""
    return next((each for each in verdicts if each.transition), None)


def _words(alarm: Verdict) -> str:
    return f"alarm at {alarm.time:.2f} s: {alarm.cause}"


def _at(
    times: Float[np.ndarray, " samples"],
    own: Float[np.ndarray, " time"],
    poses: Float[np.ndarray, "time 7"],
) -> Float[np.ndarray, "samples 7"]:
    """Poses at the nearest of their own times."""
    return poses[np.abs(times[:, None] - own).argmin(axis=1)]


def _draw_verdicts(
    axes: list[Axes],
    imagined: ImaginedEffect,
    verdicts: Sequence[Verdict],
    com: Float[np.ndarray, "time 3"],
    source: str,
) -> None:
    """Score, outcomes and height over time, one below the other, with the moments of alarm and change of outcome."""
    score, outcomes, height = axes
    times = np.array([each.time for each in verdicts])
    values = np.array([each.score for each in verdicts])
    score.plot(times, values, color=PREDICTION_COLORS[0], label="score")
    score.axhline(verdicts[0].threshold, color=INK, linestyle="--", linewidth=1.0, label="threshold")
    score.set_yscale("log")
    score.set_ylim(0.05, max(20.0, 1.5 * values.max()))
    score.set_ylabel("score [widths of the band]")
    names = [name for name in verdicts[0].outcomes if max(each.outcomes[name] for each in verdicts) > 0.01]
    for name in names:
        color = OUTCOME_COLORS.get(name, GREY)
        outcomes.plot(times, [each.outcomes[name] for each in verdicts], color=color, label=name)
    outcomes.set_ylim(-0.03, 1.03)
    outcomes.set_ylabel("probability")
    _draw_height(height, imagined, times, com, source)
    alarm = _alarm(verdicts)
    if alarm is not None:
        for ax in axes:
            ax.axvline(alarm.time, color=PREDICTION_COLORS[0], linewidth=1.0)
    turn = turning_point(verdicts)
    if turn is not None:
        for ax in axes:
            ax.axvline(turn.time, color=INK, linestyle=":", linewidth=1.0)


def _draw_height(
    axes: Axes,
    imagined: ImaginedEffect,
    times: Float[np.ndarray, " time"],
    com: Float[np.ndarray, "time 3"],
    source: str,
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
        color=PREDICTION_COLORS[0],
        linestyle="--",
        label="imagined",
    )
    axes.plot(times, CM * com[:, 2], color=TRUTH_COLOR, linewidth=1.8, label=source)
    axes.set_xlim(times[0], max(float(times[-1]), float(times[0]) + 0.1))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("height [cm]")
