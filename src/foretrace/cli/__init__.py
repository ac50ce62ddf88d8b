"""The command line: ``foretrace simulate | train | predict | ...``.

A command is a function of plain arguments in `COMMANDS`, or a `Group` of such; tyro makes the options from its
signature and the help from its docstring. Whatever is slow to import is imported inside, so that
``foretrace --help`` answers at once.
"""

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Union

import tyro

import foretrace
from foretrace.cli.calibrate import calibrate
from foretrace.cli.capture import capture
from foretrace.cli.card import card
from foretrace.cli.console import say
from foretrace.cli.data import describe, doctor, show, simulate
from foretrace.cli.demo import demo
from foretrace.cli.evaluation import experiment_commands
from foretrace.cli.export import export_lerobot, export_onnx, export_rerun, export_rosbag
from foretrace.cli.film import film
from foretrace.cli.learning import predict, train
from foretrace.cli.overlay import overlay
from foretrace.cli.recordings import import_recording
from foretrace.cli.robot import robot
from foretrace.errors import ForetraceError

Command = Callable[..., int | None]


@dataclass(frozen=True)
class Group:
    """Several commands under one name."""

    summary: str
    """What they have in common, in a line."""
    commands: Mapping[str, Command]
    """Each by its name within the group."""


EVALUATE = "Run an experiment, or go on with it: rows, summary, report and figures."
COMMANDS: dict[str, Command | Group] = {
    "demo": demo,
    "simulate": simulate,
    "train": train,
    "evaluate": Group(EVALUATE, experiment_commands()),
    "card": card,
    "predict": predict,
    "export": Group(
        "Interactions, and what a predictor imagines about them, for ROS, Rerun and LeRobot; predictors for ONNX.",
        {"rosbag": export_rosbag, "rerun": export_rerun, "lerobot": export_lerobot, "onnx": export_onnx},
    ),
    "show": show,
    "describe": describe,
    "doctor": doctor,
    "calibrate": calibrate,
    "capture": capture,
    "film": film,
    "import": import_recording,
    "overlay": overlay,
    "robot": robot,
}
"""Every command by its name."""


INTERRUPTED = 130
"""Exit status after Ctrl-C, and after a request of the system to end."""
OUTPUT_CLOSED = 141
"""Exit status where whoever read the output has closed it, as `head` does: what a shell says of SIGPIPE."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status.

    0: done. 1: `doctor` has something left to mend, or trials of `evaluate` failed. 2: an error, printed as
    one line. 130: interrupted. 141: the output was closed.
    """
    if threading.current_thread() is threading.main_thread():
        # `kill` and batch systems are obeyed as Ctrl-C is: workers end, too, and what is done is kept.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        try:
            return _run(sys.argv[1:] if arguments is None else arguments)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # Python's own flush at exit would complain.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.dup2(nowhere, sys.stderr.fileno())
        return OUTPUT_CLOSED
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):  # rich has silenced itself, with exit status 1
            return OUTPUT_CLOSED
        raise


def _run(arguments: Sequence[str]) -> int:
    """One command; its errors are told in one line."""
    if list(arguments) == ["--version"]:
        print(f"foretrace {foretrace.__version__}")
        return 0
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}")
        try:
            named = arguments[1:2] if list(arguments[:1]) == ["evaluate"] else ()
            status = tyro.cli(
                _choice(COMMANDS | {"evaluate": Group(EVALUATE, experiment_commands(named))}),
                prog="foretrace",
                description="Predict how an object will move before the robot touches it.",
                args=arguments,
            )
        except BrokenPipeError:
            raise
        except OSError as error:
            # A folder in place of a file, no permission, a full disk: the system's word for it is enough.
            where = "" if error.filename is None else f"cannot use {error.filename}: "
            return _refuse(f"{where}{error.strerror or error}: check path, permissions and free space")
        except ForetraceError as error:
            return _refuse(str(error))
        except KeyboardInterrupt:
            return INTERRUPTED
        except ImportError as error:
            cause: BaseException | None = error
            while cause is not None:
                if isinstance(cause, KeyboardInterrupt):  # while a compiled module was loaded
                    return INTERRUPTED
                cause = cause.__cause__ or cause.__context__
            raise
    return status or 0


def _refuse(reason: str) -> int:
    say(f"error: {' '.join(reason.split())}")
    return 2


def _choice(commands: Mapping[str, Command | Group]) -> Any:
    """One of several commands, as a type that tyro understands."""
    known = []
    for name, command in commands.items():
        if isinstance(command, Group):
            nested = tyro.conf.subcommand(
                name, constructor=_choice(command.commands), description=command.summary
            )
            known.append(Annotated[Any, nested])
        else:
            known.append(Annotated[Any, tyro.conf.subcommand(name, constructor=command)])
    return Union[tuple(known)]  # noqa: UP007
