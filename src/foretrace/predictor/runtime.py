"""Where and how PyTorch computes: its device, its threads, its random numbers."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from foretrace.errors import TrainingError


def find_device(name: str) -> torch.device:
    """The device of a name.

    Raises:
        TrainingError: ``cuda`` was asked for and there is none.
    """
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise TrainingError("device 'cuda' was asked for and PyTorch finds none here: use 'auto' or 'cpu'")
    return torch.device("cuda" if available and name != "cpu" else "cpu")


@contextmanager
def seeded(seed: int, epoch: int, device: torch.device) -> Iterator[None]:
    """PyTorch's random numbers from a seed for a while, and afterwards the caller's as they were.

    Every epoch has its own seed, so that a resumed training needs no state of a generator.
    """
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(int(np.random.SeedSequence([seed, epoch]).generate_state(1)[0]))
        yield


@contextmanager
def thread_count(threads: int | None) -> Iterator[None]:
    """PyTorch with so many threads for a while; None leaves its choice."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
