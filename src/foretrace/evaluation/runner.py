"""Many trials, in parallel, each written down as soon as it is finished."""

import os
import signal
import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from typing import NamedTuple, cast

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from foretrace.errors import ForetraceError, ResultsError
from foretrace.evaluation.results import Metrics, ResultsTable, Trial
from foretrace.workers import _ctrl_c_later as ctrl_c_later

Work = Callable[[Trial], Metrics]
"""Carries out one trial; it travels to the workers, and what it finds must depend on the trial alone."""


class Failure(NamedTuple):
    """A trial that could not be carried out."""

    trial: Trial
    """Which."""
    message: str
    """Why not."""


def run_trials(
    trials: Sequence[Trial],
    work: Work,
    table: ResultsTable,
    *,
    workers: int = 1,
    threads: int = 1,
    console: Console | None = None,
) -> list[Failure]:
    """Carry out the trials that are not in a table yet.

    Args:
        trials: All that are asked for, in the order in which they are begun.
        work: Carries out one of them; a `ForetraceError` in it ends that trial alone.
        table: Where each is written to as soon as it is finished.
        workers: Processes; with one, the work is done in this one.
        threads: Threads of each of them.
        console: Where progress is reported; standard error by default.

    Returns:
        The trials that failed.

    Raises:
        ResultsError: A worker was killed.
    """
    done = table.done()
    missing = [trial for trial in dict.fromkeys(trials) if trial not in done]
    failures = []
    with (
        _Report(console or Console(stderr=True), len(set(trials)), len(missing)) as report,
        parallel_config("loky", n_jobs=max(1, min(workers, len(missing))), inner_max_num_threads=threads),
        warnings.catch_warnings(),
    ):
        warnings.filterwarnings("ignore", message=".*still being processed by the workers")  # after Ctrl-C
        jobs = (delayed(_attempt)(work, trial, os.getpid()) for trial in missing)
        # One at a time: joblib would hand over short ones in batches, and hold them back until the batch is done.
        parallel = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="n_jobs")  # pyright: ignore[reportArgumentType]
        try:
            with ctrl_c_later():
                results = cast(Generator[tuple[Trial, Metrics | str]], parallel(jobs))
            with closing(results) as finished:
                for trial, found in finished:
                    if isinstance(found, str):
                        failures.append(Failure(trial, found))
                    else:
                        table.append(trial, found)
                    report.add(trial, found)
        except TerminatedWorkerError as error:
            raise ResultsError(
                "a worker process was killed, perhaps for want of memory; what is finished is kept: repeat the command "
                f"with fewer workers than {workers}"
            ) from error
    return failures


def _attempt(work: Work, trial: Trial, parent: int) -> tuple[Trial, Metrics | str]:
    """What one trial found or why it failed, in a worker or (with one worker) in the parent itself."""
    if os.getpid() != parent:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
        if os.getppid() != parent:
            os._exit(1)  # the parent was killed: nobody waits for this any more
    try:
        return trial, work(trial)
    except ForetraceError as error:
        return trial, str(error)


class _Report:
    """Progress on the console: a bar on a terminal, a line for each trial elsewhere."""

    def __init__(self, console: Console, total: int, missing: int):
        self._console, self._total, self._finished = console, total, total - missing
        self._bar = Progress(
            MofNCompleteColumn(),
            BarColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
            console=console,
            disable=not console.is_terminal,
            speed_estimate_period=24 * 3600,  # a single training may take longer than the usual half a minute
        )
        self._task = self._bar.add_task("", total=total, completed=self._finished)

    def __enter__(self) -> "_Report":
        self._bar.start()
        if self._finished:
            self._say(f"{self._finished} of {self._total} trainings are there already")
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def add(self, trial: Trial, found: Metrics | str) -> None:
        """Count a finished trial."""
        self._finished += 1
        if isinstance(found, str):
            text = f"{trial}: failed"
        else:
            name, value = next(iter(found.items()))
            text = f"{trial}: {name} {value:.3f} in {found['seconds']:.0f} s"
        self._bar.update(self._task, completed=self._finished, description=text)
        if not self._console.is_terminal:
            self._say(f"{self._finished}/{self._total}  {text}")

    def _say(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
