"""Runtime settings of PyTorch: device, threads, random numbers."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn

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
    """PyTorch with a number of threads for a while; None: with as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def suitable_threads(network: nn.Module) -> int:
    """Threads with which a network trains well on the CPU.

    One without convolutions: its products are too small to share. Else the cores that are idle, by the system's load
    in the last minute, and at most as many as PyTorch takes by itself, which is the number of physical cores.
    """
    if not any(isinstance(module, nn.Conv2d) for module in network.modules()):
        return 1
    most = torch.get_num_threads()
    if not hasattr(os, "getloadavg"):
        return most
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(most, round(cores - os.getloadavg()[0])))
