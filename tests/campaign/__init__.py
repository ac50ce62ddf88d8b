"""Crash points, damaged inputs and kills: `tests/test_campaign.py` samples them, `benchmarks/campaign.py` runs all.

Every trial is described by a few plain values, so that it can be repeated alone, and ends in one `Outcome`.
"""

import ctypes
import signal
import sys
from dataclasses import dataclass

from foretrace.workers import PR_SET_PDEATHSIG

OK, REFUSED, FAULT = "ok", "refused", "fault"


@dataclass(frozen=True)
class Outcome:
    """How a trial ended."""

    ending: str
    """`OK`, `REFUSED`: in one line, as intended; or `FAULT`."""
    detail: str = ""
    """The message, or what went wrong."""
    seconds: float = 0.0
    """How long it took [s]."""
    megabytes: float = 0.0
    """Peak of its memory [MB]; 0: not measured."""


def one_line(message: str) -> str | None:
    """What is wrong with the form of an error message; None: nothing."""
    if "\n" in message.strip():
        return "more than one line"
    if len(message) > 600:
        return f"{len(message)} characters"
    return None if message.strip() else "an empty message"


def end_with_parent() -> None:
    """Have the kernel end this process with its parent, such as a campaign that is interrupted."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
