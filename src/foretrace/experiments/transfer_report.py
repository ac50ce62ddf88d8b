"""What the comparisons with stand-in or recordings come to: a summary, and tables as the paper prints them."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from foretrace.evaluation.tables import capitalised, markdown_table, number
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
PAPER_EDGES = {"simulated": PAPER_SIMULATED, "predicted": PAPER_PREDICTED}
PAIR = ("predicted", "simulated")
"""What bars ask about."""
DISTANCES = {
    "simulated": "distance_simulated_cm",
    "predicted": "distance_predicted_cm",
    "predicted_from_view": "distance_predicted_from_view_cm",
    "simulated_predicted": "distance_simulated_predicted_cm",
}
STATISTICS = {"mean": "mean", "sd": "standard deviation", "max": "largest"}
KINDS = {"simulated": "simulation", "predicted": "predicted"}
"""What is compared with the observed paths, and its name in tables."""
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
EDGED = ("printed", RECORDED)
"""Groups whose contacts are edges."""
BARS = (
    ("printed", "every printed edge", PAPER_BAR),
    ("printed", "every printed edge", GOAL),
    (RECORDED, "every recorded edge", PAPER_BAR),
    (RECORDED, "every recorded edge", GOAL),
    ("everyday", "every everyday object", GOAL),
)
"""Groups, what a bar calls their entries, and the distance [cm] that these should lie below."""
OBJECT_TITLES = {
    "everyday": "Figure 15b: everyday objects",
    "silhouettes": "Given silhouettes",
    "prisms": "Given prisms",
}
"""Headings of the groups that are told object by object."""


def summarise(rows: pd.DataFrame) -> dict[str, Any]:
    """Everything that the tables tell, JSON-able.

    Returns:
        ``edges``: one entry for each edge of a printed or recorded shape; ``objects``: one for each other object;
        ``bars``: which means and which single lever-ups lie below the bars; ``outcomes``: how many there are of each;
        ``repeats``: most lever-ups at one contact; ``note``: what is compared.
    """
    edged = rows["group"].isin(EDGED)
    edges = [
        {
            "object": name,
            "group": group,
            "edge": int(edge),
            "paper": _paper(name, int(edge)),
            **_statistics(part),
        }
        for (name, edge, group), part in rows.loc[edged].groupby(["object", "contact", "group"])
    ]
    objects = [
        {"object": name, "group": group, "contacts": part["contact"].nunique(),
         "paper": {"predicted": PAPER_OBJECTS.get(name) if group == "everyday" else None}, **_statistics(part)}
        for (group, name), part in rows.loc[~edged].groupby(["group", "object"], sort=False)
    ]  # fmt: skip
    bars = []
    for group, what, bar in BARS:
        mine = rows.loc[rows["group"].eq(group)]
        if len(mine):
            entries = [entry for entry in edges + objects if entry["group"] == group]
            bars.append(
                {"what": what, "below_cm": bar} | {kind: _below(kind, entries, mine, bar) for kind in PAIR}
            )
    note = RECORDED_NOTE if RECORDED in set(rows["group"]) else NOTE
    about = {"note": note, "repeats": int(rows["repetition"].to_numpy().max()) + 1}
    return {**about, "edges": edges, "objects": objects, "bars": bars, "outcomes": _counts(rows)}


def _paper(name: str, edge: int) -> dict[str, float | None]:
    """The paper's numbers of an edge."""
    numbers = {kind: table.get(name, ()) for kind, table in PAPER_EDGES.items()}
    return {kind: values[edge - 1] if edge <= len(values) else None for kind, values in numbers.items()}


def _statistics(part: pd.DataFrame) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, column in DISTANCES.items():
        values = part[column].astype(float)
        numbers = {"mean": values.mean(), "sd": values.std(), "max": values.max()}
        found[name] = {key: None if pd.isna(x) else round(float(x), 4) for key, x in numbers.items()}
    return {**found, "outcomes": _counts(part)}


def _counts(part: pd.DataFrame) -> dict[str, int]:
    return {str(name): int(count) for name, count in part["outcome"].value_counts().items()}


def _below(kind: str, entries: Sequence[Mapping[str, Any]], rows: pd.DataFrame, bar: float) -> dict[str, Any]:
    """Whether all means and how many single lever-ups lie below a bar; a mean that is missing does not."""
    means = [entry[kind]["mean"] for entry in entries]
    below = sum(mean is not None and mean < bar for mean in means)
    share = round(float(np.mean(rows[DISTANCES[kind]].to_numpy(float) < bar)), 4)
    return {
        "holds": below == len(means), "means_below": below, "means": len(means), "share_of_lever_ups": share
    }  # fmt: skip


def bar_lines(summary: Mapping[str, Any], observed: str = "stand-in") -> list[str]:
    """One sentence for each bar; what was observed has a name."""
    return [
        f"{bar['what']} under {bar['below_cm']:g} cm on average, {observed} against {kind}: "
        f"{'yes' if bar[kind]['holds'] else 'no'} ({bar[kind]['means_below']} of {bar[kind]['means']}; "
        f"{100 * bar[kind]['share_of_lever_ups']:.0f} % of the single lever-ups)"
        for bar in summary["bars"]
        for kind in PAIR
    ]


def report(summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
    """The paper's tables 1 and 2 and figure 15b with ours beside them; of recordings, every interaction, too."""
    recorded, times = RECORDED in set(rows["group"]), f"{summary['repeats']} lever-ups at each"
    if recorded:
        parts, observed = ["# Predictions against recorded lever-ups"], RECORDED
        titles = {entry["object"]: entry["object"] for entry in summary["edges"]}
    else:
        parts, observed = ["# Predictions against a stand-in for the real robot"], "stand-in"
        titles = {name: f"Table {k}: {name}, {times} edge" for k, name in enumerate(PAPER_PREDICTED, 1)}
    parts.append(summary["note"])
    for name, title in titles.items():
        entries = [entry for entry in summary["edges"] if entry["object"] == name]
        if entries:
            heads = [f"Edge {entry['edge']}" for entry in entries]
            parts += [f"## {title}", _table(heads, entries, KINDS, observed)]
    for group, title in OBJECT_TITLES.items():
        entries = [entry for entry in summary["objects"] if entry["group"] == group]
        if entries:
            heads = [entry["object"] for entry in entries]
            wide = group == "everyday"
            table = _table(heads, entries, PAIR, observed) if wide else _long_table(entries)
            parts += [f"## {title}, {times} of {entries[0]['contacts']} contacts", table]
    if recorded:
        parts += ["## Interactions", _interactions(rows)]
    bars = "\n".join(f"- {line}" for line in bar_lines(summary, observed))
    return "\n\n".join([*parts, "## Bars", bars]) + "\n"


def _table(
    heads: Sequence[str], entries: Sequence[Mapping[str, Any]], kinds: Iterable[str], observed: str
) -> str:
    """Columns as in the paper; rows from the paper and from what was observed here."""
    counts, ours = [sum(entry["outcomes"].values()) for entry in entries], capitalised(observed)
    lines = [["Lever-ups", *map(str, counts)]]

    def add(words: str, kind: str, key: str = "mean") -> None:
        lines.append([words, *(number(entry[kind][key]) for entry in entries)])

    for kind in kinds:
        paper = [entry["paper"].get(kind) for entry in entries]
        if any(value is not None for value in paper):
            lines.append([f"Paper: real vs {KINDS[kind]}", *map(number, paper)])
        for key, words in STATISTICS.items():
            if key == "mean" or max(counts) > 1:
                add(f"{ours} vs {KINDS[kind]}, {words}", kind, key)
    add(f"{ours} vs predicted from the view alone, mean", "predicted_from_view")
    add("Simulation vs predicted, told everything", "simulated_predicted")
    lines.append(["Not levered", *(_others(entry["outcomes"]) for entry in entries)])
    return markdown_table(["", *heads], lines)


def _long_table(entries: Sequence[Mapping[str, Any]]) -> str:
    """A row for each object."""
    head = [f"vs {KINDS[kind]}, {word}" for kind in PAIR for word in STATISTICS.values()]
    lines = []
    for entry in entries:
        numbers = [number(entry[kind][key]) for kind in PAIR for key in STATISTICS]
        lines.append([entry["object"], *numbers, _others(entry["outcomes"])])
    return markdown_table(["", *head, "Not levered"], lines)


def _interactions(rows: pd.DataFrame) -> str:
    """A row for each recorded lever-up."""
    columns = ["interaction", "object", "contact", "outcome", "simulated_outcome"]
    distances = [DISTANCES[kind] for kind in KINDS]
    head = ["Interaction", "Object", "Edge", "Outcome", "Simulated", "vs simulation", "vs predicted"]
    lines = zip(rows[columns].astype(str).to_numpy(), rows[distances].to_numpy(float), strict=True)
    return markdown_table(head, ([*texts, *map(number, numbers)] for texts, numbers in lines))


def _others(outcomes: Mapping[str, int]) -> str:
    """How many lever-ups ended otherwise than on the blade."""
    return ", ".join(f"{count} {name}" for name, count in outcomes.items() if name != Outcome.LEVERED) or "0"
