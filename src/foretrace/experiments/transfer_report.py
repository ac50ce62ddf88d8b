"""What the comparisons with stand-in or recordings come to: a summary, and tables as the paper prints them."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from foretrace.evaluation.tables import markdown_table, number
from foretrace.interactions.record import Outcome

RECORDED = "recorded"
"""Group of recorded lever-ups."""
PAPER_SIMULATED = {
    "pentagon": (0.485, 0.520, 0.379, 0.385, 0.474),
    "heptagon": (0.447, 0.910, 0.368, 0.333, 0.720, 0.864, 0.338),
}
"""Real against simulated, by edge [cm] (paper, tables 1 and 2)."""
PAPER_PREDICTED = {
    "pentagon": (0.981, 0.446, 0.480, 0.611, 0.401),
    "heptagon": (0.601, 0.633, 0.460, 0.316, 0.531, 0.499, 0.471),
}
"""Real against predicted, by edge [cm]."""
PAPER_OBJECTS = {"HDD": 0.123, "PCB": 0.344, "book": 0.415, "racket": 0.479}
"""Real against predicted, by object [cm] (paper, figure 15)."""
PAPER_BAR = 1.0
"""The paper's distances of printed shapes all lie below this [cm]."""
GOAL = 0.5
"""The paper's distances of everyday objects all lie below this; here it is asked of printed shapes, too [cm]."""
DISTANCES = {
    "simulated": "distance_simulated_cm",
    "predicted": "distance_predicted_cm",
    "predicted_from_view": "distance_predicted_from_view_cm",
    "simulated_predicted": "distance_simulated_predicted_cm",
}
STATISTICS = {"mean": "mean", "sd": "standard deviation", "max": "largest"}
NOTE = (
    "The stand-in is no robot: it is another physics engine with other friction, density and thickness, errors of "
    "contact, direction, camera and marker, and another sampling rate, all drawn anew for every lever-up. Distances in "
    "cm: mean over the paths after dynamic time warping, up to where the object slips off the blade. The paper gives "
    "one number for each edge or object, of a real robot."
)
RECORDED_NOTE = (
    "Every recorded lever-up against the simulation of the same object, contact and path, and against what the "
    "predictor imagines from the recorded view. Friction and density of a recording are not known: the simulator has "
    "nominal ones. Distances in cm: mean over the paths after dynamic time warping, up to where the object slips off "
    "the blade."
)
EDGED = {"printed": "every printed edge", RECORDED: "every recorded edge"}
"""Groups whose contacts are edges, and what a bar calls them."""


def summarise(rows: pd.DataFrame) -> dict[str, Any]:
    """Everything that the tables tell, JSON-able.

    Args:
        rows: Of `foretrace.experiments.transfer.Transfer`.

    Returns:
        ``edges``: one entry for each edge of a printed or recorded shape; ``objects``: one for each other object;
        ``bars``: which means and which single lever-ups lie below the bars; ``outcomes``: how many there are of each;
        ``repeats``: most lever-ups at one contact; ``note``: what is compared.
    """
    edges: list[dict[str, Any]] = []
    objects: list[dict[str, Any]] = []
    edged = rows.loc[rows["group"].isin(EDGED)].sort_values(["object", "contact"], kind="stable")
    for group, name, edge in dict.fromkeys(
        zip(edged["group"], edged["object"], edged["contact"], strict=True)
    ):
        part = edged.loc[edged["group"].eq(group) & edged["object"].eq(name) & edged["contact"].eq(edge)]
        paper = {
            "simulated": _listed(PAPER_SIMULATED, name, edge - 1),
            "predicted": _listed(PAPER_PREDICTED, name, edge - 1),
        }
        place = {"object": name, "group": group, "edge": int(edge)}
        edges.append({**place, "paper": paper, **_statistics(part)})
    others = rows.loc[~rows["group"].isin(EDGED)]
    for group, name in dict.fromkeys(zip(others["group"], others["object"], strict=True)):
        part = others.loc[others["group"].eq(group) & others["object"].eq(name)]
        paper = {"predicted": PAPER_OBJECTS.get(name) if group == "everyday" else None}
        contacts = len(set(part["contact"]))
        objects.append(
            {"object": name, "group": group, "contacts": contacts, "paper": paper, **_statistics(part)}
        )
    everyday = [entry for entry in objects if entry["group"] == "everyday"]
    bars = []
    for group, words in EDGED.items():
        mine = [entry for entry in edges if entry["group"] == group]
        if mine:
            part = edged.loc[edged["group"].eq(group)]
            bars += [_bar(words, mine, part, bar) for bar in (PAPER_BAR, GOAL)]
    if everyday:
        bars.append(_bar("every everyday object", everyday, rows.loc[rows["group"].eq("everyday")], GOAL))
    note = RECORDED_NOTE if RECORDED in set(rows["group"]) else NOTE
    repeats = int(rows["repetition"].to_numpy().max()) + 1
    about = {"note": note, "repeats": repeats}
    return {**about, "edges": edges, "objects": objects, "bars": bars, "outcomes": _counts(rows)}


def _listed(numbers: Mapping[str, Sequence[float]], name: str, at: int) -> float | None:
    values = numbers.get(name, ())
    return values[at] if at < len(values) else None


def _statistics(part: pd.DataFrame) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, column in DISTANCES.items():
        values = part[column].dropna().to_numpy(float)
        numbers = {
            "mean": values.mean() if len(values) else np.nan,
            "sd": values.std(ddof=1) if len(values) > 1 else np.nan,
            "max": values.max() if len(values) else np.nan,
        }
        found[name] = {key: None if np.isnan(x) else round(float(x), 4) for key, x in numbers.items()}
    return {**found, "outcomes": _counts(part)}


def _counts(part: pd.DataFrame) -> dict[str, int]:
    return {str(name): int(count) for name, count in part["outcome"].value_counts().items()}


def _bar(what: str, entries: Sequence[Mapping[str, Any]], rows: pd.DataFrame, bar: float) -> dict[str, Any]:
    """Whether all means and how many single lever-ups lie below a bar; a mean that is missing does not."""
    result: dict[str, Any] = {"what": what, "below_cm": bar}
    for name in ("predicted", "simulated"):
        means = [entry[name]["mean"] for entry in entries]
        result[name] = {
            "holds": all(mean is not None and mean < bar for mean in means),
            "means_below": sum(mean is not None and mean < bar for mean in means),
            "means": len(means),
            "share_of_lever_ups": round(float(np.mean(rows[DISTANCES[name]].to_numpy(float) < bar)), 4),
        }
    return result


def bar_lines(summary: Mapping[str, Any], observed: str = "stand-in") -> list[str]:
    """One sentence for each bar; what was observed has a name."""
    lines = []
    for bar in summary["bars"]:
        for name in ("predicted", "simulated"):
            found = bar[name]
            lines.append(
                f"{bar['what']} under {bar['below_cm']:g} cm on average, {observed} against {name}: "
                f"{'yes' if found['holds'] else 'no'} ({found['means_below']} of {found['means']}; "
                f"{100 * found['share_of_lever_ups']:.0f} % of the single lever-ups)"
            )
    return lines


def report(summary: Mapping[str, Any]) -> str:
    """The paper's tables 1 and 2 and figure 15b with ours beside them."""
    repeats = summary["repeats"]
    parts = ["# Predictions against a stand-in for the real robot", NOTE]
    for table, name in enumerate(PAPER_PREDICTED, 1):
        entries = [entry for entry in summary["edges"] if entry["object"] == name]
        if entries:
            heads = [f"Edge {entry['edge']}" for entry in entries]
            title = f"## Table {table}: {name}, {repeats} lever-ups at each edge"
            parts += [title, _table(heads, entries, ("simulated", "predicted"))]
    for group, title in (
        ("everyday", "Figure 15b: everyday objects"),
        ("silhouettes", "Given silhouettes"),
        ("prisms", "Given prisms"),
    ):
        entries = [entry for entry in summary["objects"] if entry["group"] == group]
        if not entries:
            continue
        title = f"## {title}, {repeats} lever-ups at each of {entries[0]['contacts']} contacts"
        parts.append(title)
        if group == "everyday":
            parts.append(_table([entry["object"] for entry in entries], entries, ("predicted", "simulated")))
        else:
            parts.append(_long_table(entries))
    bars = "\n".join(f"- {line}" for line in bar_lines(summary))
    return "\n\n".join([*parts, "## Bars", bars]) + "\n"


def recorded_report(summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
    """Tables 1 and 2 of recorded lever-ups: one for each object, and one with every interaction.

    Args:
        summary: As `summarise` makes it.
        rows: What it was made of.
    """
    parts = ["# Predictions against recorded lever-ups", RECORDED_NOTE]
    for name in dict.fromkeys(entry["object"] for entry in summary["edges"]):
        entries = [entry for entry in summary["edges"] if entry["object"] == name]
        heads = [f"Edge {entry['edge']}" for entry in entries]
        parts += [f"## {name}", _table(heads, entries, ("simulated", "predicted"), "Recorded")]
    columns = ["interaction", "object", "contact", "outcome", "simulated_outcome"]
    lines = [["Interaction", "Object", "Edge", "Outcome", "Simulated", "vs simulation", "vs predicted"]]
    for row in rows.to_dict("records"):
        distances = (row[DISTANCES[kind]] for kind in ("simulated", "predicted"))
        numbers = [number(value) for value in distances]
        lines.append([*(str(row[column]) for column in columns), *numbers])
    bars = "\n".join(f"- {line}" for line in bar_lines(summary, RECORDED))
    return (
        "\n\n".join([*parts, "## Interactions", markdown_table(lines[0], lines[1:]), "## Bars", bars]) + "\n"
    )


def _table(
    heads: Sequence[str],
    entries: Sequence[Mapping[str, Any]],
    kinds: Iterable[str],
    observed: str = "Stand-in",
) -> str:
    """Columns as in the paper; rows from the paper and from what was observed here."""
    lines = [["", *heads], ["Lever-ups", *(str(sum(entry["outcomes"].values())) for entry in entries)]]
    repeated = any(sum(entry["outcomes"].values()) > 1 for entry in entries)
    for kind in kinds:
        word = {"simulated": "simulation", "predicted": "predicted"}[kind]
        paper = [entry["paper"].get(kind) for entry in entries]
        if any(value is not None for value in paper):
            lines.append([f"Paper: real vs {word}", *map(number, paper)])
        lines += [
            [f"{observed} vs {word}, {words}", *(number(entry[kind][key]) for entry in entries)]
            for key, words in STATISTICS.items()
            if repeated or key == "mean"
        ]
    blind = [number(entry["predicted_from_view"]["mean"]) for entry in entries]
    lines.append([f"{observed} vs predicted from the view alone, mean", *blind])
    own = [number(entry["simulated_predicted"]["mean"]) for entry in entries]
    lines.append(["Simulation vs predicted, told everything", *own])
    lines.append(["Not levered", *(_others(entry["outcomes"]) for entry in entries)])
    return markdown_table(lines[0], lines[1:])


def _long_table(entries: Sequence[Mapping[str, Any]]) -> str:
    """A row for each object."""
    words = list(STATISTICS.values())
    lines = [
        ["", *(f"vs {kind}, {word}" for kind in ("predicted", "simulation") for word in words), "Not levered"]
    ]
    for entry in entries:
        numbers = [entry[kind][key] for kind in ("predicted", "simulated") for key in STATISTICS]
        lines.append([entry["object"], *map(number, numbers), _others(entry["outcomes"])])
    return markdown_table(lines[0], lines[1:])


def _others(outcomes: Mapping[str, int]) -> str:
    """How many lever-ups ended otherwise than on the blade."""
    return ", ".join(f"{count} {name}" for name, count in outcomes.items() if name != Outcome.LEVERED) or "0"
