"""How a sentence about results is tested on a table of them.

A `Claim` is one sentence with the `Check`s that test it. A check takes one number from every seed, such as the error
of one predictor less the error of another one in the same seed, and asks where the 95 % interval of its mean over the
seeds lies (`foretrace.evaluation.statistics.interval`):

- supported: wholly where the claim needs it,
- contradicted: wholly outside,
- open: on both sides,
- missing: fewer than `MIN_SEEDS` seeds have all the rows.

A claim holds if all its deciding checks are supported. It does not hold if one of them is contradicted. Else it is
undecided. Checks that do not decide are there for their numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from foretrace.evaluation.statistics import TEST_TO_TRAIN, interval
from foretrace.evaluation.tables import markdown_table

MIN_SEEDS = 3
"""With fewer seeds nothing is decided."""
KEY = ["experiment", "features", "setting", "metric"]

Unit = Literal["cm", "%", "times"]
Support = Literal["supported", "contradicted", "open", "missing"]


class Cell(NamedTuple):
    """One place of the table; it holds a value per seed."""

    experiment: str
    features: str
    setting: str
    metric: str


Ratio = Callable[[Cell], float]
"""Size of the test part divided by that of the training part, by the place of the table."""


def _usual_ratio(cell: Cell) -> float:
    return TEST_TO_TRAIN


@dataclass(frozen=True)
class Check:
    """One comparison, made in every seed."""

    label: str
    """What is computed, in words."""
    cells: tuple[Cell, ...]
    """What it is computed from."""
    contrast: Callable[[np.ndarray], np.ndarray]
    """Values (seeds, cells) to one number per seed."""
    above: float | None = None
    """The interval has to lie above this."""
    below: float | None = None
    """The interval has to lie below this."""
    unit: Unit = "cm"
    """Unit of the number; accuracies are shares, shown in per cent."""

    @property
    def decides(self) -> bool:
        """Whether the claim hangs on it; if not, it is there for its number."""
        return self.above is not None or self.below is not None

    def evaluate(self, values: dict[Cell, pd.Series], ratio: Ratio) -> dict[str, Any]:
        """Number, interval, seeds, and whether that supports the claim; of the cells' ratios the largest counts."""
        found = [values[cell].rename(str(k)) for k, cell in enumerate(self.cells) if cell in values]
        common = pd.concat(found, axis=1, join="inner") if len(found) == len(self.cells) else pd.DataFrame()
        row: dict[str, Any] = {"comparison": self.label, "needed": self.needed, "unit": self.unit}
        if len(common) < MIN_SEEDS:
            return {**row, "mean": None, "low": None, "high": None, "seeds": len(common), "result": "missing"}
        found = interval(self.contrast(common.to_numpy(float)), max(ratio(cell) for cell in self.cells))
        result = self._support(found.low, found.high)
        return {**row, **found.as_dict(6), "seeds": found.seeds, "result": result}

    @property
    def needed(self) -> str:
        """Where the interval has to lie, in words; empty if the check does not decide."""
        limits = [("above", self.above), ("below", self.below)]
        return " and ".join(f"{side} {in_unit(at, self.unit)}" for side, at in limits if at is not None)

    def _support(self, low: float, high: float) -> Support:
        if (self.above is not None and high <= self.above) or (self.below is not None and low >= self.below):
            return "contradicted"
        inside = (self.above is None or low > self.above) and (self.below is None or high < self.below)
        return "supported" if inside else "open"


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper and what has to be so for it to hold."""

    name: str
    section: str
    sentence: str
    """In the paper's words, shortened."""
    test: str
    """How it is tested."""
    checks: tuple[Check, ...]

    def evaluate(self, values: dict[Cell, pd.Series], ratio: Ratio = _usual_ratio) -> dict[str, Any]:
        """Whether it holds, and the numbers."""
        rows = [check.evaluate(values, ratio) for check in self.checks]
        results = [row["result"] for row, check in zip(rows, self.checks, strict=True) if check.decides]
        holds: bool | str = "undecided"
        if "contradicted" in results:
            holds = False
        elif set(results) == {"supported"}:
            holds = True
        return {
            "name": self.name,
            "section": self.section,
            "claim": self.sentence,
            "test": self.test,
            "holds": holds,
            "numbers": rows,
        }


def in_unit(value: float | None, unit: Unit) -> str:
    """A number as people read it."""
    if value is None:
        return ""
    return f"{100 * value:.1f} %" if unit == "%" else f"{value:.3f} cm" if unit == "cm" else f"{value:.2f}"


def by_cell(table: pd.DataFrame) -> dict[Cell, pd.Series]:
    """The values of every cell by their seed; of rows given twice, the last."""
    known = table.dropna(subset=["value"])
    cells: dict[Cell, dict[int, float]] = {}
    for *key, seed, value in known[[*KEY, "seed", "value"]].itertuples(index=False):
        cells.setdefault(Cell(*key), {})[seed] = value
    return {cell: pd.Series(values).sort_index() for cell, values in cells.items()}


def cell_table(table: pd.DataFrame, ratio: Ratio = _usual_ratio) -> pd.DataFrame:
    """One row per cell: mean over the seeds, its 95 % interval, standard deviation, number of seeds."""
    rows = [
        (*cell, *interval(values, ratio(cell)), values.std(ddof=1) if len(values) > 1 else np.nan)
        for cell, values in by_cell(table).items()
    ]
    return pd.DataFrame(rows, columns=[*KEY, "mean", "low", "high", "seeds", "std"])


def tally(row: dict[str, Any]) -> str:
    """An evaluated claim's numbers in a line: a single deciding check in full; of several, how many are supported."""
    deciding = [number for number in row["numbers"] if number["needed"]]
    if len(deciding) == 1:
        return f"{deciding[0]['comparison']}: {_in_words(deciding[0])}"
    kinds: dict[str, list[str]] = {}
    for number in deciding:
        kinds.setdefault(number["result"], []).append(number["comparison"])
    parts = [
        f"{len(names)} {kind}" + (f" ({', '.join(names)})" if kind in ("contradicted", "open") else "")
        for kind, names in kinds.items()
    ]
    return f"of {len(deciding)} comparisons " + ", ".join(parts)


def _in_words(number: dict[str, Any]) -> str:
    if number["mean"] is None:
        return "rows missing"
    mean, low, high = (in_unit(number[name], number["unit"]) for name in ("mean", "low", "high"))
    return f"{mean} [{low}, {high}], {number['seeds']} seeds"


def holds_in_words(row: dict[str, Any]) -> str:
    """``yes``, ``no`` or ``undecided``."""
    return row["holds"] if isinstance(row["holds"], str) else "yes" if row["holds"] else "no"


def claims_markdown(rows: list[dict[str, Any]]) -> list[str]:
    """A table of the claims, and one of all their comparisons."""
    verdicts = [[r["section"], r["claim"], holds_in_words(r), r["test"], tally(r)] for r in rows]
    comparisons = [
        [row["name"], number["comparison"], _in_words(number), number["needed"],
         number["result"] if number["needed"] else "does not decide"]
        for row in rows for number in row["numbers"]
    ]  # fmt: skip
    return [
        markdown_table(["Section", "Claim", "Holds here", "Tested by", "Result"], verdicts),
        markdown_table(["Claim", "Comparison", "Mean [95 % interval]", "Needed", "Result"], comparisons),
    ]
