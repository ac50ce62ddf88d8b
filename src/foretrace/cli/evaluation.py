"""The command that runs experiments; its options are the fields of each experiment."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from foretrace.cli.console import say
from foretrace.experiments import EXPERIMENTS, SUMMARIES

if TYPE_CHECKING:
    from foretrace.evaluation.experiment import Experiment


def experiment_commands(named: Sequence[str] = ()) -> dict[str, Callable[..., int]]:
    """A command for each experiment.

    Args:
        named: The experiment whose options are needed. The others are not imported, so that the help is quick.
    """
    if not named:
        return {label: _stub(summary) for label, summary in SUMMARIES.items()}
    return {
        label: _command(EXPERIMENTS.find(label)) if label in named else _stub(SUMMARIES.get(label, ""))
        for label in EXPERIMENTS
    }


def _stub(summary: str) -> Callable[..., int]:
    def evaluate() -> int:
        raise AssertionError("an experiment without its options cannot be run")

    evaluate.__doc__ = summary
    return evaluate


def _command(kind: "type[Experiment]") -> Callable[..., int]:
    def evaluate(
        experiment: Any,
        out: Path | None = None,
        workers: int | None = None,
        threads: int = 1,
        dry_run: bool = False,
        redraw: bool = False,
    ) -> int:
        return _evaluate(experiment, out, workers, threads, dry_run, redraw)

    evaluate.__annotations__["experiment"] = Annotated[kind, tyro.conf.arg(name="")]
    keeps = "" if kind.needs_folder else "; by default nothing is kept"
    usual = "one for each core" if kind.workers is None else str(kind.workers)
    evaluate.__doc__ = f"""{kind.__doc__}

    The same command goes on where an interrupted one stopped, and with other options it adds to the results where it
    can. The exit status is 1 if trials failed.

    Args:
        experiment: What to run.
        out: Folder to write to: rows.csv, summary.json, report.md and figures{keeps}.
        workers: Processes; by default {usual}.
        threads: Threads of numerical libraries in each process.
        dry_run: Print the number of missing trials, and run nothing.
        redraw: Run nothing: summarise, report and draw the rows in --out again.
    """
    return evaluate


def _evaluate(
    experiment: "Experiment", out: Path | None, workers: int | None, threads: int, dry_run: bool, redraw: bool
) -> int:
    from rich.console import Console
    from rich.markdown import Markdown

    from foretrace.evaluation.run import count_missing, run_experiment

    if dry_run:
        for name, count in count_missing(experiment, out).items():
            print(f"{name:20s} {count:5d} trials missing")
        return 0
    try:
        results = run_experiment(experiment, out, workers, threads, redraw=redraw)
    except KeyboardInterrupt:
        if out is not None:
            say(f"interrupted; finished trials stay in {out}, the same command goes on from there")
        raise
    console = Console()
    if results.report:
        console.print(Markdown(results.report)) if console.is_terminal else print(results.report)
    for trial, message in results.failures:
        say(f"failed: {trial}: {' '.join(message.split())}")
    for file in results.files:
        print(file)
    return 1 if results.failures else 0
