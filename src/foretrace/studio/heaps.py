"""Memory of programs that serve many threads."""

import ctypes
import sys

MOST_HEAPS = 2
"""Heaps that threads share."""
TRIMMED_FROM = 1 << 17
"""Free memory at the end of a heap that is given back to the system [bytes]."""
M_TRIM_THRESHOLD, M_ARENA_MAX = -1, -8
"""Parameters of glibc's ``mallopt``."""


def share_heaps() -> bool:
    """Let all threads share a few heaps, before the first thread begins; returns whether that is possible here.

    The C library of Linux gives threads heaps of their own, eight for each core, each of which grows to the most that
    any thread ever needed and keeps it. Elsewhere nothing is done.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # another C library
        return False
    return bool(mallopt(M_ARENA_MAX, MOST_HEAPS)) and bool(mallopt(M_TRIM_THRESHOLD, TRIMMED_FROM))
