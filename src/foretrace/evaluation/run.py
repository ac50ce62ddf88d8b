"""The one way to carry out an experiment: run what is missing, keep it, summarise, report, draw."""

import os
import pickle
import platform
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console

import foretrace
from foretrace.errors import ForetraceError, ResultsError, shown
from foretrace.evaluation.experiment import Experiment, Row, Trial, checked_seeds
from foretrace.evaluation.storage import Rows, Store, kept_identity, table_of
from foretrace.files import as_json, versions_of
from foretrace.interactions.storage import MANIFEST
from foretrace.predictor.run_folder import git_commit
from foretrace.workers import ProgressReport, count_workers, run_jobs, uses_cluster

LIBRARIES = ("foretrace", "torch", "numpy", "mujoco", "pybullet")


class Failure(NamedTuple):
    """A trial that could not be carried out."""

    trial: Trial
    message: str


@dataclass(frozen=True)
class Results:
    """What an experiment came to."""

    rows: pd.DataFrame
    """All rows in the folder, of earlier runs, too."""
    summary: Mapping[str, Any]
    """As `Experiment.summarise` makes it."""
    claims: list[dict[str, Any]]
    """As `Experiment.judge` makes it."""
    report: str
    """Markdown."""
    failures: list[Failure]
    """Trials of this run that failed."""
    files: list[Path] = field(default_factory=list)
    """What was written."""


def run_experiment(
    experiment: Experiment,
    out: str | Path | None = None,
    workers: int | None = None,
    threads: int = 1,
    console: Console | None = None,
    redraw: bool = False,
) -> Results:
    """Carry out an experiment, or what is missing of it, and write table, summary, report and figures.

    It may be stopped at any time: the same call goes on. With other options that do not change what a trial gives,
    such as more seeds, it adds to the results. Of a finished folder it only reads the rows.

    Args:
        experiment: What to carry out.
        out: Folder of the results: ``rows.csv``, ``summary.json``, ``report.md``, pictures, and in ``trials`` a file
            for each trial. None: nothing is kept; for experiments that are quick.
        workers: Processes; by default what the experiment says, or all of a cluster.
        threads: Threads of numerical libraries in each process.
        console: Where progress is reported; standard error by default.
        redraw: Run nothing, and ask for no data: summarise, report and draw the rows that the folder holds.

    Raises:
        ResultsError: The folder holds other results, or a worker was killed.
        ForetraceError: The options or the data cannot be used.
    """
    with ExitStack() as stack:
        if out is None:
            if experiment.needs_folder:
                raise ResultsError(
                    f"{experiment.label} takes long and has to keep its results: give a folder (--out)"
                )
            kept = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        else:
            kept = Path(out)
        found = _run(experiment, kept, workers, threads, console, redraw)
    return found if out is not None else Results(**{**vars(found), "files": []})


def count_missing(experiment: Experiment, out: str | Path | None = None) -> dict[str, int]:
    """How many trials `run_experiment` would carry out, by the first setting of the trials."""
    trials = _trials_of(experiment)
    done = {} if out is None else _store(experiment, Path(out)).done()
    first = {trial: str(next(iter(trial.settings.values()))) for trial in trials}
    missing = Counter(name for trial, name in first.items() if trial not in done)
    return {name: missing[name] for name in dict.fromkeys(first.values())}


def _trials_of(experiment: Experiment) -> list[Trial]:
    """All that is asked for, each trial once."""
    if (seed := getattr(experiment, "seed", None)) is not None:
        checked_seeds([seed])
    return list(dict.fromkeys(experiment.trials()))


def _store(experiment: Experiment, out: Path, redraw: bool = False) -> Store:
    if out.exists() and not out.is_dir():
        raise ResultsError(f"{out} is a file: give a folder to write to")
    if (out / MANIFEST).exists():
        raise ResultsError(f"{out} is a data set: give another folder for the results")
    identity = None if redraw else experiment.identity()
    if identity is None:
        return Store(out, experiment, kept_identity(out, experiment.label))
    about = {"experiment": experiment.label or type(experiment).__name__, "foretrace": foretrace.__version__}
    return Store(out, experiment, as_json(about | identity))


def _run(
    experiment: Experiment,
    out: Path,
    workers: int | None,
    threads: int,
    console: Console | None,
    redraw: bool,
) -> Results:
    if threads < 1:
        raise ResultsError(f"threads is {threads}: give a number from 1")
    workers = experiment.workers if workers is None and not uses_cluster() else workers
    workers = count_workers(workers, ResultsError)
    trials = [] if redraw else _trials_of(experiment)
    store = _store(experiment, out, redraw)
    done = store.done()
    missing = [trial for trial in trials if trial not in done]
    machines = store.machines()
    failures: list[Failure] = []
    if missing:
        store.prepare(done)
        machine = {
            "cpu": _processor(),
            "workers": workers,
            "threads": threads,
            "versions": versions_of(*LIBRARIES),
        }
        machine |= _device(getattr(experiment, "device", "cpu"))
        machine |= {"commit": git_commit(), "started": datetime.now(UTC).isoformat(timespec="seconds")}
        begun = time.monotonic()
        failures = _carry_out(store, missing, len(trials), workers, threads, console)
        machines = [*machines, machine | {"hours": round((time.monotonic() - begun) / 3600, 4)}]
        done = store.done()
    done = _in_order(done, trials)
    rows = table_of(done)
    if rows.empty:
        return Results(rows, {}, [], "", failures)
    summary, claims = experiment.summarise(rows), experiment.judge(rows)
    report = experiment.report(summary, rows)
    failed = [{"trial": trial.settings, "message": message} for trial, message in failures]
    content = {"machines": machines, "failed": failed, "claims": claims, "summary": summary}
    files = store.write(done, {name: part for name, part in content.items() if part}, report)
    files += write_figures(experiment.figures(rows), out, experiment.formats)
    return Results(rows, summary, claims, report, failures, files)


def _carry_out(
    store: Store, missing: list[Trial], total: int, workers: int, threads: int, console: Console | None
) -> list[Failure]:
    """Run trials and keep each as soon as it is finished."""
    failures = []
    work = _Work(store, threads)
    with ProgressReport("trials", total, total - len(missing), console, period=0.0) as report:
        finished = run_jobs(work, missing, workers, error=ResultsError, threads=threads, ahead="n_jobs")
        for trial, message, text in finished:
            if message is not None:
                failures.append(Failure(trial, message))
            report.add(text=f"{trial}: {text}")
    return failures


@dataclass(frozen=True)
class _Work:
    """Carries out one trial and writes its file, in whatever process."""

    store: Store
    threads: int
    parent: int = field(default_factory=os.getpid)

    def __call__(self, trial: Trial) -> tuple[Trial, str | None, str]:
        """The trial; why it failed, if it did; and what to say about it."""
        experiment, started = _kept_here(self.store), time.perf_counter()
        try:
            with warnings.catch_warnings(), _threads(self.threads):
                if os.getpid() != self.parent:
                    warnings.simplefilter("ignore")  # the parent has warned about the data
                rows = list(experiment.run(trial, self.store.folder))
            _check_columns(trial, rows)
            seconds = time.perf_counter() - started
            self.store.save(trial, rows, seconds)
        except ForetraceError as error:
            return trial, str(error), "failed"
        first = rows[0] if rows else {}
        number = f"{first['metric']} {first['value']:.3f} " if "metric" in first and "value" in first else ""
        return trial, None, f"{number}in {seconds:.0f} s"


def _check_columns(trial: Trial, rows: Iterable[Row]) -> None:
    """A row may repeat a field of its trial, but not change it."""
    for row in rows:
        for name, value in trial.settings.items():
            if row.get(name, value) != value:
                raise ResultsError(
                    f"a row has {name} = {shown(row[name])}, its trial has {shown(value)}: call the column otherwise"
                )


_HERE: dict[bytes, Experiment] = {}


def _kept_here(store: Store) -> Experiment:
    """The same experiment for all trials in this process, so that it reads its data once."""
    key = pickle.dumps((store.experiment, store.identity))
    if key not in _HERE:
        _HERE.clear()
        _HERE[key] = store.experiment
    return _HERE[key]


def _threads(threads: int) -> Any:
    """PyTorch with a number of threads, where an experiment has loaded it."""
    if "torch" not in sys.modules:
        return nullcontext()
    from foretrace.predictor.runtime import thread_count

    return thread_count(threads)


def _device(name: str) -> dict[str, str]:
    """What PyTorch computes on, and in which format it trains convolutions, where an experiment has loaded it."""
    if "torch" not in sys.modules:
        return {}
    import torch

    from foretrace.features.base import fast_precision
    from foretrace.predictor.runtime import find_device

    device = find_device(name)
    found = torch.cuda.get_device_name() if device.type == "cuda" else device.type
    return {"device": found, "precision": fast_precision(device)}


def _in_order(done: Mapping[Trial, Rows], trials: list[Trial]) -> dict[Trial, Rows]:
    """Trials that are asked for in their order, then the others as they were."""
    return {trial: done[trial] for trial in dict.fromkeys([*trials, *done]) if trial in done}


def write_figures(
    figures: Mapping[str, Figure], out: Path, formats: tuple[str, ...] = ("png",)
) -> list[Path]:
    """Write figures; the same figure gives the same bytes. Returns the files."""
    about: dict[str, Any] = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}}
    files = [(figure, out / f"{name}.{ending}") for name, figure in figures.items() for ending in formats]
    with mpl.rc_context({"svg.hashsalt": "foretrace"}):
        for figure, file in files:
            figure.savefig(file, metadata=about.get(file.suffix[1:]))
    return [file for _, file in files]


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.split(":")[1].strip() for line in lines if "model name" in line]
    return models[0] if models else platform.processor() or platform.machine()
