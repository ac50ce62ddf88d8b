"""Trials that hypothesis draws."""

from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st


def drawn(strategy: st.SearchStrategy[Any], number: int, count: int) -> list[Any]:
    """The first trials of a strategy with a seed; always the same ones."""
    found = []

    @seed(number)
    @settings(
        max_examples=count,
        phases=[Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(strategy)
    def draw(trial: Any) -> None:
        found.append(trial)

    draw()
    return found
