"""Lines that several commands print."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any


def say(line: Any) -> None:
    """One line to the person at the terminal, beside the command's own output."""
    print(f"foretrace: {line}", file=sys.stderr)


@contextmanager
def when_interrupted(line: str) -> Iterator[None]:
    """Tell what is left after Ctrl-C in a block."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"interrupted; {line}")
        raise


def print_outcomes(counts: Mapping[str, int]) -> None:
    """How often each outcome occurs, and the total."""
    total = sum(counts.values())
    for outcome, count in counts.items():
        print(f"{outcome:>10} {count:7d} {100 * count / total:6.1f} %")
    print(f"{'total':>10} {total:7d}")


def print_report(text: str) -> None:
    """A report in Markdown: laid out on a terminal, as it is elsewhere."""
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console()
    if console.is_terminal:
        console.print(Markdown(text))
    else:
        print(text)
