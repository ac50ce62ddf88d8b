"""The command that runs experiments; its options are the fields of each experiment."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from foretrace.cli.console import print_report, say
from foretrace.cli.parsing import Command, adapt
from foretrace.experiments import EXPERIMENTS, SUMMARIES

if TYPE_CHECKING:
    from foretrace.evaluation.experiment import Experiment


def experiment_commands() -> dict[str, Command]:
    """A command for each experiment; its module is imported when the command is asked for."""
    return {
        label: Command(
            SUMMARIES[label] if label in SUMMARIES else EXPERIMENTS.find(label).summary,
            partial(_command, label),
        )
        for label in EXPERIMENTS
    }


def _command(label: str) -> Callable[..., int]:
    kind = EXPERIMENTS.find(label)

    @adapt(run_folder="run")
    def evaluate(
        experiment: Any,
        out: Path | None = None,
        workers: int | None = None,
        threads: int = 1,
        cluster: str | None = None,
        dry_run: bool = False,
        redraw: bool = False,
    ) -> int:
        return _evaluate(experiment, out, workers, threads, cluster, dry_run, redraw)

    evaluate.__annotations__["experiment"] = Annotated[kind, tyro.conf.arg(name="")]
    keeps = "" if kind.needs_folder else "; by default nothing is kept"
    usual = "one for each core" if kind.workers is None else str(kind.workers)
    evaluate.__doc__ = f"""{kind.__doc__}

    The same command continues an interrupted one, and with other options it adds to the results where it can. The exit
    status is 1 if trials failed.

    Args:
        experiment: What to run.
        out: Folder to write to: rows.csv, summary.json, report.md and figures{keeps}.
        workers: Processes; by default {usual}.
        threads: Threads of numerical libraries in each process.
        cluster: Address of a Ray cluster that carries out the trials, all of whose nodes share --out and the data:
            HOST:PORT, ray://HOST:PORT, or local:N.
        dry_run: Print the number of missing trials, and run nothing.
        redraw: Run nothing: summarise, report and draw the rows in --out again.
    """
    return evaluate


def _evaluate(
    experiment: "Experiment",
    out: Path | None,
    workers: int | None,
    threads: int,
    cluster: str | None,
    dry_run: bool,
    redraw: bool,
) -> int:
    from foretrace.evaluation.run import count_missing, run_experiment
    from foretrace.workers import on_cluster

    if dry_run:
        for name, count in count_missing(experiment, out).items():
            print(f"{name:20s} {count:5d} trials missing")
        return 0
    try:
        with on_cluster(cluster):
            results = run_experiment(experiment, out, workers, threads, redraw=redraw)
    except KeyboardInterrupt:
        if out is not None:
            say(f"interrupted; finished trials stay in {out}, the same command goes on from there")
        raise
    if results.report:
        print_report(results.report)
    for trial, message in results.failures:
        say(f"failed: {trial}: {' '.join(message.split())}")
    for file in results.files:
        print(file)
    return 1 if results.failures else 0
