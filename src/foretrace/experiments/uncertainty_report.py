"""What the judgement of several futures comes to: a summary and tables. Pictures are in ``uncertainty_figures``."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from foretrace.evaluation.statistics import mean_interval
from foretrace.experiments.uncertainty_metrics import ALL, BEGINNINGS, OBSERVED, SHOWN_LEVELS, UNLIKE
from foretrace.experiments.uncertainty_scores import FORECASTS, SCORES
from foretrace.predictor.one_shot import FEW

PARTS = ("train", "validation", "test")
ERRORS = {
    "full": "Full [cm]",
    "final": "Final [cm]",
    "full_median": "Full, median [cm]",
    "until_slip_full": "Full, until slip [cm]",
    "until_slip_final": "Final, until slip [cm]",
    "nearest_full": "Nearest, full [cm]",
    "nearest_final": "Nearest, final [cm]",
    "futures": "Futures",
    "rotation": "Rotation, median [°]",
    "final_rotation": "Final rotation, median [°]",
}
WORDS = {
    "shuffled": "Shuffled",
    "novel-shapes": "Novel shapes",
    "record": "since the record's start",
    "moving": "since the object moves",
}
DIGITS = 4

Numbers = Mapping[str, float | None]


def summarise(rows: pd.DataFrame) -> dict[str, Any]:
    """Means over the seeds and their 95 % bootstrap intervals, JSON-able.

    Args:
        rows: As from `foretrace.experiments.uncertainty.measure`, with ``seed`` and ``split``.

    Returns:
        By split: ``seeds``; ``values``, by metric, group and, if there are any, level; ``few``: outcomes of which some
        part has fewer than `FEW` examples. Regions are told at `SHOWN_LEVELS` only.
    """
    summary: dict[str, Any] = {}
    shown = rows.loc[rows["metric"].ne("coverage") | rows["level"].isin(SHOWN_LEVELS)]
    for split in dict.fromkeys(shown["split"]):
        mine = shown.loc[shown["split"].eq(split)]
        values: dict[str, Any] = {}
        for (metric, group, level), part in mine.groupby(
            ["metric", "group", "level"], dropna=False, sort=False
        ):
            numbers = _interval(part.sort_values("seed")["value"].to_numpy(float))
            found = values.setdefault(metric, {})
            if np.isnan(level):
                found[group] = numbers
            else:
                found.setdefault(group, {})[f"{level:g}"] = numbers
        counts = mine.loc[mine["metric"].str.startswith("count_")]
        few = sorted(set(counts.loc[counts["value"].lt(FEW), "group"]))
        summary[split] = {"seeds": sorted(map(int, set(mine["seed"]))), "few": few, "values": values}
    return summary


def _interval(values: np.ndarray) -> dict[str, float | None]:
    names = ("mean", "low", "high")
    if not np.isfinite(values).all():  # a region that is everything has no width
        return dict.fromkeys(names)
    numbers = dict(zip(names, mean_interval(values), strict=True))
    return {name: round(float(v), DIGITS) if np.isfinite(v) else None for name, v in numbers.items()}


def markdown(summary: Mapping[str, Any]) -> str:
    """All tables, split by split."""
    parts = ["# Several futures, judged", "Means over the seeds, 95 % bootstrap intervals in brackets."]
    for split, found in summary.items():
        values = found["values"]
        seeds = ", ".join(map(str, found["seeds"]))
        parts += [f"## {WORDS.get(split, split)}, seeds {seeds}", *_examples(values, found["few"])]
        parts += ["### Outcomes", *_outcomes(values)]
        parts += ["### Errors of the most probable and of the nearest future", _errors(values)]
        parts += ["### Regions", *_regions(values)]
        parts += ["### Scores of samples; less is better", _scores(values)]
        parts += ["### The rest of the motion, after some samples were observed", *_observed(values)]
        if f"{UNLIKE}{BEGINNINGS[0]}_rest" in values:
            parts += ["### The same of lever-ups with other physics than those learned from"]
            parts += _observed(values, UNLIKE)
    return "\n\n".join(parts) + "\n"


def _examples(values: Mapping[str, Any], few: Sequence[str]) -> list[str]:
    outcomes = list(values["count_test"])
    lines = [["Outcome", *PARTS]]
    for name in outcomes:
        lines.append([f"`{name}`", *(f"{values[f'count_{part}'][name]['mean']:.4g}" for part in PARTS)])
    notes = []
    if few:
        named = ", ".join(f"`{name}`" for name in few)
        notes = [f"Too few examples (fewer than {FEW} in some part of some split) of: {named}."]
    return ["Interactions in each part:", _table(lines), *notes]


def _outcomes(values: Mapping[str, Any]) -> list[str]:
    macro, brier = _cell(values["macro_f1"][ALL], 3), _cell(values["brier"][ALL], 3)
    right, common = (_cell(values[name][ALL], 3) for name in ("accuracy", "accuracy_of_most_common"))
    text = (
        f"Macro-F1 {macro}; accuracy {right} ({common} for naming the most common one); Brier score {brier}."
    )
    names = list(values["count_test"])
    lines = [["Happened", *(f"said `{name}`" for name in names), "F1"]]
    for name in names:
        counts = (values["confusion"][f"{name}, said {other}"]["mean"] for other in names)
        f1 = _cell(values["f1"].get(name), 3)
        lines.append([f"`{name}`", *(f"{count:.4g}" for count in counts), f1])
    return [text, _table(lines)]


def _errors(values: Mapping[str, Any]) -> str:
    lines = [["", *ERRORS.values()]]
    for group in values["full"]:
        lines.append([_name(group), *(_cell(values[metric][group], 3) for metric in ERRORS)])
    return _table(lines)


def _regions(values: Mapping[str, Any]) -> list[str]:
    found = []
    for metric, words, digits in (
        ("coverage", "Share of motions that stay within a tube all the time:", 3),
        ("tube", "Median radius of the most probable future's tube [cm]:", 2),
    ):
        lines = [["", *(f"{level:.0%}" for level in SHOWN_LEVELS)]]
        for group, by_level in values[metric].items():
            cells = (_cell(by_level[f"{level:g}"], digits) for level in SHOWN_LEVELS)
            lines.append([_name(group), *cells])
        found += [words, _table(lines)]
    return found


def _scores(values: Mapping[str, Any]) -> str:
    lines = [["Samples of", "", *SCORES.values()]]
    for forecast, words in FORECASTS.items():
        for group in values[f"{forecast}_crps"]:
            cells = (_cell(values[f"{forecast}_{name}"][group], 3) for name in SCORES)
            lines.append([words, _name(group), *cells])
    return _table(lines)


def _observed(values: Mapping[str, Any], prefix: str = "") -> list[str]:
    found = []
    for name in BEGINNINGS:
        beginning = prefix + name
        levels = [f"{k}" for k in OBSERVED if f"{k}" in values[f"{beginning}_rest"].get(ALL, {})]
        lines = [["Observed samples", *levels]]
        for group in values[f"{beginning}_rest"]:
            for metric, words in (("rest", "error [cm]"), ("rest_ratio", "÷ unobserved")):
                by_level = values[f"{beginning}_{metric}"][group]
                cells = (_cell(by_level.get(level), 3) for level in levels)
                lines.append([f"{_name(group)}, {words}", *cells])
        scores = values[f"{beginning}_macro_f1"][ALL]
        lines.append(["Macro-F1 of outcomes", *(_cell(scores.get(level), 3) for level in levels)])
        found += [f"Samples counted {WORDS[name]}:", _table(lines)]
    return found


def _name(group: str) -> str:
    return "All" if group == ALL else f"`{group}`"


def _cell(numbers: Numbers | None, digits: int) -> str:
    if numbers is None or numbers["mean"] is None:
        return "-"
    text = f"{numbers['mean']:.{digits}f}"
    return (
        text
        if numbers["low"] is None
        else f"{text} [{numbers['low']:.{digits}f}, {numbers['high']:.{digits}f}]"
    )


def _table(lines: Sequence[Sequence[str]]) -> str:
    rule = ["---", *["---:"] * (len(lines[0]) - 1)]
    return "\n".join("| " + " | ".join(line) + " |" for line in (lines[0], rule, *lines[1:]))
