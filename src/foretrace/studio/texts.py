"""What the page says in words and small charts, as HTML and Markdown."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from foretrace.imagined import Belief, ImaginedEffect
from foretrace.imagined.shown import percentage
from foretrace.pictures.style import GREY, OUTCOME_COLORS, PREDICTION_COLORS
from foretrace.planning import Plan
from foretrace.studio.session import LEVEL, LEVER_UPS, Simulated
from foretrace.studio.watching import Watched

LEAST_SHOWN = 5e-4
"""Outcomes less probable than this are not listed."""


def plan_text(found: Plan) -> str:
    """A plan in a few lines of Markdown."""
    lines = [f"**{found.goal}**: reached with a probability of {percentage(found.reached)}"]
    lines += [found.worth] if found.worth else []
    lines += [f"probability of {name}: {percentage(chance)}" for name, chance in found.chances.items()]
    lines += [f"*{found.note}*"] if found.note else []
    lines += [f"{k}. {other.lost}" for k, other in enumerate(found.alternatives, start=2)]
    return "\n\n".join(lines)


def simulated_text(simulated: Simulated, tried: Sequence[bool]) -> str:
    """What MuJoCo made of a lever-up, and how often the region held so far, in Markdown."""
    drawn = ", ".join(f"{name.replace('_', ' ')} {value:.3g}" for name, value in simulated.drawn.items())
    text = f"**{simulated.interaction.effect.outcome}** in MuJoCo (green)"
    if tried:
        text += f"; the {LEVEL:.0%} region held {sum(tried)} of {len(tried)}"
    return text + (f"\n\ndrawn: {drawn}" if drawn else "")


def result_html(imagined: ImaginedEffect | None, message: str = "") -> str:
    """Outcomes with their probabilities as bars, the region's radius at the end, and a message, in HTML."""
    rows = []
    if imagined is not None:
        chances = sorted(imagined.futures.outcomes().items(), key=lambda item: -item[1][0])
        for name, chance in chances[:3]:
            share, colour = float(chance[0]), OUTCOME_COLORS.get(name, GREY)
            if share < LEAST_SHOWN:
                continue
            rows.append(
                f'<div style="display:flex;align-items:center;gap:0.5em;line-height:1.35">'
                f'<span style="width:5.2em">{escape(name)}</span>'
                f'<span style="flex:1;background:rgba(128,128,128,.18);border-radius:3px;height:0.75em">'
                f'<span style="display:block;width:{100 * share:.1f}%;background:{colour};height:100%;'
                f'border-radius:3px"></span></span>'
                f'<span style="width:5em;text-align:right">{percentage(share)}</span></div>'
            )
        best = int(imagined.futures.probability[0].argmax())
        radius = float(imagined.futures.radius(LEVEL)[0, best, -1])
        told = f"{100 * radius:.1f} cm" if np.isfinite(radius) else "unknown"
        rows.append(f'<div style="opacity:.7">radius of the {LEVEL:.0%} region at the end: {told}</div>')
        rows += [_note(warning) for warning in imagined.warnings[:2]]
    if message:
        rows.append(_note(message))
    return f'<div style="padding:0.4em 1em 0.2em;font-size:0.82em">{"".join(rows)}</div>'


def learned_html(truth: Mapping[str, float], beliefs: Sequence[Belief]) -> str:
    """What is believed of each constant before and after lever-ups, and what it is, in HTML; which one is next."""
    before = Belief()
    heads = ["", "before", *(f"after {k}" for k in range(1, len(beliefs) + 1)), "truth"]
    rows = [
        [
            name.replace("_", " "),
            *(f"{b.mean[name]:.3g} ± {b.std[name]:.2g}" for b in (before, *beliefs)),
            f"{value:.3g}",
        ]
        for name, value in truth.items()
    ]
    cells = [
        "".join(f"<td style='padding:0 0.35em'>{escape(cell)}</td>" for cell in row) for row in (heads, *rows)
    ]
    lines = "".join(f"<tr>{each}</tr>" for each in cells)
    left = "" if len(beliefs) == LEVER_UPS else _note(f"lever-up {len(beliefs) + 1} of {LEVER_UPS} …")
    return f'<table style="font-size:0.75em;line-height:1.6;margin:0.4em">{lines}</table>{left}'


def _note(text: str) -> str:
    return f'<div style="color:{PREDICTION_COLORS[0]};line-height:1.25;margin-top:0.3em">{escape(text)}</div>'


def verdict_html(watched: Watched, k: int) -> str:
    """Score, threshold, alarm and cause up to a sample, in HTML; in the end, what went wrong."""
    verdicts = watched.verdicts[: k + 1]
    last, end = verdicts[-1], float(watched.times[-1])
    low, high = np.log(0.05), np.log(max(20.0, 1.2 * max(each.score for each in watched.verdicts)))

    def place(time: float, score: float) -> str:
        y = (np.log(max(score, 0.05)) - low) / (high - low)
        return f"{300 * time / end:.1f},{100 - 100 * float(y):.1f}"

    limit = float(place(0.0, last.threshold).split(",")[1])
    curve = " ".join(place(each.time, each.score) for each in verdicts)
    alarm = next((each for each in verdicts if each.alarm), None)
    red = PREDICTION_COLORS[0]
    mark = (
        ""
        if alarm is None
        else f'<path d="M{300 * alarm.time / end:.1f} 0v100" stroke="{red}" stroke-width="1"/>'
    )
    chart = (
        f'<svg viewBox="0 0 300 100" style="width:100%;height:110px;background:rgba(128,128,128,.12)">'
        f'<path d="M0 {limit:.1f}h300" stroke="currentColor" stroke-dasharray="5 4" stroke-width="1"/>{mark}'
        f'<polyline points="{curve}" fill="none" stroke="{red}" stroke-width="2"/></svg>'
    )
    rows = [
        f"<div>score {last.score:.2f}, alarm above {last.threshold:.2f} (dashed; logarithmic)</div>",
        "<div>"
        + ", ".join(f"{escape(n)} {percentage(p)}" for n, p in last.outcomes.items() if p > 0.01)
        + "</div>",
    ]
    if alarm is None:
        rows.append(f"<div><b>{escape(last.message)}</b></div>")
    else:
        causes = ", ".join(f"{escape(name)} {percentage(p)}" for name, p in last.causes.items() if p > 0.05)
        cause = escape(str(last.cause))
        rows.append(
            f'<div style="color:{red}"><b>alarm at {alarm.time:.2f} s: {cause}</b></div><div>{causes}</div>'
        )
    if k >= len(watched.times) - 1:
        rows.append(f"<div>In truth: <b>{escape(watched.truth)}</b></div>")
    return f'<div style="padding:0.4em 1em;font-size:0.82em;line-height:1.5">{chart}{"".join(rows)}</div>'
