"""The command line: ``foretrace simulate | train | predict | ...``.

A command is a function; `COMMANDS` has one line about each, and where it is. It is imported when it is asked for, so
that ``foretrace --help`` answers at once; how its options come from its signature is in `foretrace.cli.parsing`.
"""

import errno
import os
import signal
import sys
import threading
import warnings
from collections.abc import Sequence
from difflib import get_close_matches

import foretrace
from foretrace.cli.console import say
from foretrace.cli.parsing import Command, Entry, Group, Ready, parse
from foretrace.errors import CommandError, ForetraceError, shown
from foretrace.extras import MissingExtraError, missing_extra

LEARN, SEE, HAND_ON = "simulate, learn, predict", "cameras and recordings", "other programs and robots"
"""Headings of the list of commands."""


def _command(home: str, summary: str, section: str = "", varies: bool = False, extras: str = "") -> Command:
    return Command(summary, f"foretrace.cli.{home}", section, varies, extras.split())


def _experiments() -> dict[str, Command]:
    from foretrace.cli.evaluation import experiment_commands

    return experiment_commands()


EXPORTS: dict[str, Entry] = {
    "rosbag": _command("export:export_rosbag", "Interactions as bags of ROS 1 or ROS 2."),
    "rerun": _command("export:export_rerun", "Interactions as Rerun recordings."),
    "lerobot": _command("export:export_lerobot", "Interactions as one LeRobotDataset."),
    "onnx": _command("export:export_onnx", "The network of a predictor as ONNX."),
}
COMMANDS: dict[str, Entry] = {
    "demo": _command(
        "demo:demo", "Simulate, train, predict and compare in a few minutes.", LEARN, extras="eval sim train"
    ),
    "simulate": _command("simulation:simulate", "Simulate lever-ups of many objects into a data set.", LEARN),
    "data": _command("data:data", "Describe, check, repair or upgrade a data set.", LEARN),
    "data-merge": _command("data:merge", "Make one data set of several.", LEARN),
    "data-split": _command("data:split", "Make several data sets of one.", LEARN),
    "data-sample": _command("data:sample", "Make a data set of some interactions.", LEARN),
    "train": _command("training:train_command", "Train a predictor on a data set.", LEARN, varies=True),
    "recalibrate": _command("training:recalibrate", "Calibrate a predictor's regions on other data.", LEARN),
    "evaluate": Group(
        "Evaluate a predictor, or run an experiment.", _experiments, LEARN, ("eval", "sim", "train")
    ),
    "predict": _command("prediction:predict", "Predict the motion of an object before it is touched.", LEARN),
    "plan": _command("planning:plan", "Choose where and how an object is levered for a goal.", LEARN),
    "monitor": _command("monitor:monitor", "Watch a recorded action as a monitor would have.", LEARN),
    "studio": _command(
        "studio:studio", "Try lever-ups in the browser: draw, drag, plan.", LEARN, extras="sim studio"
    ),
    "show": _command("data:show", "Draw a data set, or one interaction.", LEARN),
    "calibrate": _command("calibrate:calibrate", "Calibrate a camera, or print its board or markers.", SEE),
    "import": _command("recordings:import_recording", "Turn the recording of a lever-up into data.", SEE),
    "import-pushes": _command("pushes:import_pushes", "Turn a table of recorded pushes into data.", SEE),
    "film": _command("film:film", "Render a recording of a simulated lever-up.", SEE),
    "capture": _command("capture:capture", "Record with a RealSense camera (experimental).", SEE),
    "overlay": _command("overlay:overlay", "Draw prediction and observation over a recording.", SEE),
    "export": Group("Write data for ROS, Rerun, LeRobot; predictors for ONNX.", EXPORTS, HAND_ON),
    "serve": _command("studio:serve", "Serve predictions, plans and monitors over HTTP.", HAND_ON),
    "robot": _command("robot:robot", "Check and execute a lever-up on a UR10 (experimental).", HAND_ON),
}
"""Every command by its name, in the order of the help."""


KILLED = 128
"""Added to a signal's number, the exit status after it, as in a shell: 130 after Ctrl-C."""
REPEAT = 0.05
"""Time after which a signal is repeated whose interrupt was lost [s]."""
FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC), errno.EFBIG)
"""The system's errors for a disk without space, a used-up quota, and a file longer than it may be."""
OUTPUT_CLOSED = 141
"""Exit status where whoever read the output has closed it, as `head` does: what a shell says of SIGPIPE."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status.

    0: done. 1: `data` has something left to mend, a trial of `evaluate` failed, or `predict --images` left out
    images. 2: an error, printed as one line. 128 and the number of a signal that asked to end: 130
    after Ctrl-C, 143 after `kill`, 129 after a closed terminal. 141: the output was closed.
    """
    if threading.current_thread() is threading.main_thread():
        # `kill`, batch systems and a closed terminal are obeyed as Ctrl-C is: workers end, and what is done is kept.
        for name in ("SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) != signal.SIG_IGN:  # as nohup sets it
                signal.signal(number, _interrupt)
        sys.unraisablehook = _hear_again
    try:
        try:
            return _run(sys.argv[1:] if arguments is None else arguments)
        finally:
            if arguments is None:
                _end_at_once()
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


def _end_at_once() -> None:
    """Let a signal end the process without a word: the command is done, and Python waits for the end of its workers."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)


def read(arguments: Sequence[str]) -> Ready:
    """The command that arguments ask for, ready to run.

    Raises:
        ForetraceError: There is no such command, or its options cannot be read or do not go together.
        SystemExit: Help was asked for and has been printed.
    """
    about = "Predict how an object will move before the robot touches it."
    if (name := "-".join(arguments[:2])) in COMMANDS:  # `data merge` is data-merge
        arguments = [name, *arguments[2:]]
    elif arguments[:1] == ["data"] and len(arguments) > 1 and not os.path.exists(arguments[1]):
        parts = [name.removeprefix("data-") for name in COMMANDS if name.startswith("data-")]
        if close := get_close_matches(arguments[1], parts, n=1, cutoff=0.75):
            raise CommandError(
                f"unknown command {shown(f'data {arguments[1]}')}: did you mean data {close[0]}?"
            )
    return parse(COMMANDS, arguments, "foretrace", about)


def _run(arguments: Sequence[str]) -> int:
    """One command; its errors are told in one line."""
    if list(arguments) == ["--version"]:
        print(f"foretrace {foretrace.__version__}")
        return 0
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}")
        try:
            status = read(arguments)()
        except BrokenPipeError:
            raise
        except OSError as error:
            # A folder in place of a file, no permission, a full disk: the system's word for it is enough.
            where = "" if error.filename is None else f"cannot use {error.filename}: "
            remedy = (
                "free some, and repeat the command" if error.errno in FULL else "check path and permissions"
            )
            return _refuse(f"{where}{error.strerror or error}: {remedy}")
        except MissingExtraError as error:
            return _refuse(str(missing_extra(error, _extras_of(arguments))))
        except ForetraceError as error:
            return _refuse(str(error))
        except KeyboardInterrupt as interrupt:
            return _status_of(interrupt)
        except ImportError as error:
            if (missing := missing_extra(error, _extras_of(arguments))) is not None:
                return _refuse(str(missing))
            cause: BaseException | None = error
            while cause is not None:
                if isinstance(cause, KeyboardInterrupt):  # while a compiled module was loaded
                    return _status_of(cause)
                cause = cause.__cause__ or cause.__context__
            raise
    return status or 0


def _extras_of(arguments: Sequence[str]) -> Sequence[str]:
    """Extras that the command needs."""
    entry = COMMANDS.get(arguments[0])
    return entry.extras if isinstance(entry, Command | Group) else ()


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt(number)


def _hear_again(lost: "sys.UnraisableHookArgs") -> None:
    """Repeat a signal whose interrupt was lost, as in a destructor, where Python would go on after a word about it."""
    if not issubclass(lost.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    given = lost.exc_value.args if lost.exc_value is not None else ()
    number = given[0] if given else signal.SIGINT
    threading.Timer(REPEAT, os.kill, (os.getpid(), number)).start()


def _status_of(interrupt: KeyboardInterrupt) -> int:
    """Exit status after a signal, whose number is the first argument unless it was Ctrl-C."""
    return KILLED + (interrupt.args[0] if interrupt.args else signal.SIGINT)


def _refuse(reason: str) -> int:
    say(f"error: {' '.join(reason.split())}")
    return 2
