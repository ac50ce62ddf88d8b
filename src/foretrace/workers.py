"""The one way to run many jobs: local processes or a Ray cluster, progress, Ctrl-C, workers that are killed."""

import ctypes
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from contextvars import ContextVar
from multiprocessing import resource_tracker
from typing import Any, TypeVar, cast

from joblib import Parallel, cpu_count, delayed, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from foretrace.cluster import Cluster
from foretrace.errors import ForetraceError, is_whole, shown

Job = TypeVar("Job")
Result = TypeVar("Result")

MOST_WORKERS = 1024
MOST_ON_CLUSTER = 100_000
PARENT_PERIOD = 1.0
"""Seconds between two looks of a worker at whether its parent lives."""
PR_SET_PDEATHSIG = 1
"""Linux's prctl: the signal that a process gets when its parent ends."""
PLAIN_REPORT_PERIOD = 10.0
"""Seconds between two lines of progress where there is no terminal."""

_cluster: ContextVar[Cluster | None] = ContextVar("cluster", default=None)


@contextmanager
def on_cluster(address: str | None) -> Iterator[None]:
    """Let a Ray cluster do the work of `run_jobs` within a block.

    Files that are read and written must be in folders that every node has at the same place.

    Args:
        address: ``HOST:PORT`` of a cluster that this machine belongs to, ``ray://HOST:PORT`` of another one,
            ``local:N`` for N processes of this machine; None for local processes without Ray, as outside of the block.

    Raises:
        ForetraceError: There is no such cluster, it does not answer, or Ray is not installed.
    """
    if address is None:
        yield
        return
    with Cluster(address) as cluster:
        token = _cluster.set(cluster)
        try:
            yield
        finally:
            _cluster.reset(token)


def uses_cluster() -> bool:
    """Whether `run_jobs` uses a cluster: results should then be small, and files be written by the jobs."""
    return _cluster.get() is not None


def count_workers(workers: int | None, error: type[ForetraceError]) -> int:
    """Number of processes: by default one for each core, of this machine or of all nodes of the cluster.

    Raises:
        ForetraceError: Of the given class: the number is out of range.
    """
    cluster = _cluster.get()
    if workers is None:
        return cpu_count() if cluster is None else max(1, cluster.cpus)
    most = MOST_WORKERS if cluster is None else MOST_ON_CLUSTER
    if not is_whole(workers, 1, most):
        raise error(f"workers is {shown(workers)}: give a number from 1 to {most}")
    return workers


def run_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    workers: int,
    *,
    error: type[ForetraceError],
    threads: int = 1,
    ordered: bool = False,
    ahead: str = "2*n_jobs",
) -> Generator[Result, None, None]:
    """Results of a function over many jobs, each as soon as it is there.

    The processes never hear Ctrl-C: this one stops them. When this one is killed they end, whatever they are doing.
    Where a local one is killed the work ends; within `on_cluster`, another one does its job again.

    Args:
        function: Runs one job in any process: a function or a picklable object, whose result depends on the job alone.
        jobs: The jobs, begun in this order.
        workers: Processes; with one, the work is done in this process, or by one of the cluster.
        error: Class to raise when a process is killed.
        threads: Threads of numerical libraries in each process.
        ordered: Whether results come in the order of the jobs; otherwise, in the order in which they are finished.
        ahead: How many jobs are handed out before they are needed, as joblib's ``pre_dispatch``.

    Raises:
        ForetraceError: Of the given class: a process was killed; or any that the function raises.
    """
    if (cluster := _cluster.get()) is not None:
        factor = 1 if ahead == "n_jobs" else 2
        options: Any = {"error": error, "threads": threads, "ordered": ordered, "ahead": factor}
        with closing(cluster.run(function, jobs, workers, **options)) as results:
            yield from results
        return
    begin = {"initializer": _begin_worker, "initargs": (os.getpid(),)}
    num = max(1, min(workers, len(jobs)))
    with (
        parallel_config("loky", n_jobs=num, inner_max_num_threads=threads, **begin),
        warnings.catch_warnings(),
    ):
        warnings.filterwarnings("ignore", message=".*still being processed by the workers")  # after Ctrl-C
        order = "generator" if ordered else "generator_unordered"
        # One at a time: joblib would hand over short jobs in batches, and hold results back until a batch is done.
        parallel = Parallel(return_as=order, batch_size=1, pre_dispatch=ahead)  # pyright: ignore[reportArgumentType]
        calls = (delayed(function)(job) for job in jobs)
        try:
            with _ctrl_c_later():
                results = cast(Generator[Result, None, None], parallel(calls))
            with closing(results):
                yield from results
        except TerminatedWorkerError as reason:
            raise error(
                "a worker process was killed, perhaps for lack of memory; finished work is kept: "
                f"repeat the command with fewer workers than {workers}"
            ) from reason


def _begin_worker(parent: int) -> None:
    """What a worker does before its first job: it will not hear Ctrl-C, and ends with its parent.

    A worker may wait without end once its parent is gone: for a job, or for room in a pipe that nothing else reads, and
    whose other end the workers themselves hold open.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    if os.name != "posix":
        return
    if sys.platform == "linux":  # even in the middle of compiled code
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """Wait for the end of the parent, and end this process."""
    while os.getppid() == parent:
        time.sleep(PARENT_PERIOD)
    os._exit(1)


@contextmanager
def _ctrl_c_later() -> Iterator[None]:
    """Ctrl-C waits while workers start: they inherit the mask, and so never hear it, not even as they start."""
    if os.name != "posix":
        yield
        return
    resource_tracker.ensure_running()  # which would let Ctrl-C through again, were it started later
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class ProgressReport:
    """Progress on the console: a bar on a terminal, a line now and then elsewhere. A context manager.

    Args:
        noun: What is counted, in the plural: ``interactions``.
        total: How many there are in all.
        done: How many were finished before.
        console: Where to report; standard error by default.
        period: Seconds between two lines where there is no terminal; 0 for a line each.
    """

    def __init__(
        self,
        noun: str,
        total: int,
        done: int = 0,
        console: Console | None = None,
        period: float = PLAIN_REPORT_PERIOD,
    ):
        self.console = console or Console(stderr=True)
        self._noun, self._total, self._before, self._done = noun, total, done, done
        self._period, self._begun = period, time.monotonic()
        self._last_line = self._begun
        self._bar = Progress(
            MofNCompleteColumn(),
            BarColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
            console=self.console,
            disable=not self.console.is_terminal,
            speed_estimate_period=24 * 3600,  # one job may take longer than the default of half a minute
        )
        self._task = self._bar.add_task("", total=total, completed=done)

    def __enter__(self) -> "ProgressReport":
        self._bar.start()
        if self._before:
            self.say(f"{self._before} of {self._total} {self._noun} are there already")
        return self

    def __exit__(self, *exception: Any) -> None:
        self._bar.stop()

    def add(self, count: int = 1, text: str = "") -> None:
        """Count finished jobs, with a word on the last one or on all of them."""
        self._done += count
        now = time.monotonic()
        rate = (self._done - self._before) / max(now - self._begun, 1e-9)
        speed = f"{rate:.1f}/s" if rate >= 0.1 else f"{60 * rate:.1f}/min"
        if (cluster := _cluster.get()) is not None:
            speed = f"{speed} on {cluster}"
        self._bar.update(self._task, completed=self._done, description=f"{speed}  {text}")
        if not self.console.is_terminal and now - self._last_line >= self._period:
            self._last_line = now
            left = f", {(self._total - self._done) / rate:.0f} s left" if self._period and rate else ""
            self.say(f"{self._done} of {self._total} {self._noun}, {speed}{left}: {text}".rstrip(": "))

    def say(self, line: str) -> None:
        """Print a line beside the bar."""
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)
