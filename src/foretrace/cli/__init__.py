"""The command line: ``foretrace simulate | train | predict | ...``.

A command is a function of plain arguments in `COMMANDS`; tyro makes the options from its signature and the help from
its docstring. Whatever is slow to import is imported inside, so that ``foretrace --help`` answers at once.
"""

import sys
import warnings
from collections.abc import Callable, Sequence

import tyro

import foretrace
from foretrace.cli.console import say
from foretrace.cli.data import describe, doctor, show, simulate
from foretrace.cli.demo import demo
from foretrace.cli.figures import figures
from foretrace.cli.learning import evaluate, predict, train
from foretrace.errors import ForetraceError

COMMANDS: dict[str, Callable[..., int | None]] = {
    "demo": demo,
    "simulate": simulate,
    "train": train,
    "evaluate": evaluate,
    "figures": figures,
    "predict": predict,
    "show": show,
    "describe": describe,
    "doctor": doctor,
}
"""Every command by its name."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status.

    0: done. 1: `doctor` has something left to mend. 2: an error, printed as one line. 130: interrupted.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if list(arguments) == ["--version"]:
        print(f"foretrace {foretrace.__version__}")
        return 0
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}")
        try:
            status = tyro.extras.subcommand_cli_from_dict(
                COMMANDS,
                prog="foretrace",
                description="Predict how an object will move before the robot touches it.",
                args=arguments,
            )
        except ForetraceError as error:
            say(f"error: {' '.join(str(error).split())}")
            return 2
        except KeyboardInterrupt:
            return 130
    return status or 0
