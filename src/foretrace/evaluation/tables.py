"""Tables in Markdown, and numbers in their cells."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np


def markdown_table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table: the first column to the left, numbers to the right."""
    rule = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *lines))


def number(value: float | None, digits: int = 3, missing: str = "") -> str:
    """A number of a summary, where None and NaN are missing."""
    return missing if value is None or np.isnan(value) else f"{value:.{digits}f}"


def mean_with_interval(
    numbers: Mapping[str, Any] | None, digits: int = 3, sign: str = "", missing: str = ""
) -> str:
    """Mean and interval of a summary: ``0.31 [0.29, 0.33]``."""
    if numbers is None or numbers["mean"] is None:
        return missing
    text = f"{numbers['mean']:{sign}.{digits}f}"
    if numbers["low"] is None:
        return text
    return f"{text} [{numbers['low']:{sign}.{digits}f}, {numbers['high']:{sign}.{digits}f}]"


def capitalised(text: str) -> str:
    """A text with a capital letter at its beginning, and otherwise as it is."""
    return text[:1].upper() + text[1:]
