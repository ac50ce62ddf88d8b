"""Memory of programs that serve many threads."""

import platform
import subprocess
import sys

import pytest

from foretrace.studio.heaps import MOST_HEAPS

MANY_THREADS = """
import ctypes, sys, threading
from foretrace.studio.heaps import share_heaps
if sys.argv[1] == "shared":
    assert share_heaps()
library, together = ctypes.CDLL(None), threading.Barrier(8)
library.malloc.restype, library.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
def work():
    together.wait()
    library.malloc(1000)
    together.wait()
threads = [threading.Thread(target=work) for _ in range(8)]
[each.start() for each in threads]
[each.join() for each in threads]
library.malloc_stats()
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="no glibc")
def test_threads_share_a_few_heaps():
    counts = []
    for how in ("shared", "alone"):
        words = [sys.executable, "-c", MANY_THREADS, how]
        said = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True).stderr
        counts.append(said.count("Arena "))
    assert counts[0] <= MOST_HEAPS < counts[1]
