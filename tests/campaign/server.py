"""Every trial in a process of its own, forked from one that has loaded everything already.

A trial that crashes, hangs or takes all memory ends alone; what it leaves running is found and ended.

    python -m campaign.server MATERIALS < requests > outcomes
"""

import contextlib
import gc
import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from campaign import FAULT, Outcome, end_with_parent
from campaign.answers import leak

TIME_LIMIT, MEMORY_LIMIT = 20.0, 2000.0
"""A trial that takes longer [s] or more [MB] is a fault."""
ADDRESSES = 12 * 1024**3
"""Address space of a trial [bytes]: far above the limit, so that it is the trial that ends and not the machine."""
ENDINGS = 3.0
"""Time in which processes that a trial has started must be gone after it [s]."""

Request = Mapping[str, Any]
Trial = Callable[[Request, Path, Path], Outcome]


class Server:
    """The process that forks, and the pipe to it. A context manager.

    Args:
        materials: Folder of `campaign.materials`.
    """

    def __init__(self, materials: Path):
        self._command = [sys.executable, "-m", "campaign.server", str(materials)]
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> "Server":
        return self

    def __exit__(self, *exception: object) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()

    def run(self, *requests: Request) -> list[Outcome]:
        """The outcomes of trials, which share a process as long as it lives."""
        if self._process is None:
            paths = [str(Path(__file__).parents[1]), *filter(None, sys.path)]
            environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(requests) + "\n")
        self._process.stdin.flush()
        return [Outcome(**each) for each in json.loads(self._process.stdout.readline())]


def isolated(
    trial: Trial, requests: Sequence[Request], materials: Path, limit: float = TIME_LIMIT
) -> list[Outcome]:
    """Outcomes of trials in a forked process; one that ends it is a fault, and the others go on in a new one."""
    outcomes: list[Outcome] = []
    while len(outcomes) < len(requests):
        outcomes += _forked(trial, requests[len(outcomes) :], materials, limit)
    return outcomes


def _forked(trial: Trial, requests: Sequence[Request], materials: Path, limit: float) -> list[Outcome]:
    """The outcomes of trials up to the first that ends the process."""
    folder = Path(tempfile.mkdtemp(prefix="trial-"))
    begun = time.monotonic()
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        os.close(reading)
        _in_child(trial, requests, folder, materials, writing)
    os.close(writing)
    outcomes: list[Outcome] = []
    ended, status, megabytes = 0, 0, 0.0
    with os.fdopen(reading) as answers:
        while not ended and time.monotonic() - begun < limit and megabytes < MEMORY_LIMIT:
            if select.select([answers], [], [], 0.02)[0] and (line := answers.readline()):
                outcome = Outcome(**json.loads(line))
                outcomes.append(replace(outcome, seconds=round(time.monotonic() - begun, 3)))
                begun = time.monotonic()
            megabytes = max(megabytes, _resident(child))
            ended, status, usage = os.wait4(child, os.WNOHANG)
    if not ended:
        _, status, usage = _ended(child)
    left = _left_behind(child) if ended else False
    megabytes = max(megabytes, usage.ru_maxrss / 1024)
    output = folder / "output"
    told = output.read_text(errors="replace")[-300:] if output.is_file() else ""
    shutil.rmtree(folder, ignore_errors=True)
    outcomes = [replace(each, megabytes=round(megabytes)) for each in outcomes]
    seconds = round(time.monotonic() - begun, 3)
    code = os.waitstatus_to_exitcode(status)
    if megabytes > MEMORY_LIMIT:
        fault = f"{megabytes:.0f} MB of memory"
    elif not ended:
        fault = f"not done after {limit:.0f} s"
    elif code:
        fault = f"died of signal {-code}: {told}" if code < 0 else f"ended with {code}: {told}"
    elif left:
        fault = f"a process is left after {outcomes.pop().detail!r}"
    else:
        return outcomes
    return [*outcomes, Outcome(FAULT, fault, seconds, round(megabytes))][: len(requests)]


def _in_child(trial: Trial, requests: Sequence[Request], folder: Path, materials: Path, answers: int) -> None:
    end_with_parent()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    for number, request in enumerate(requests):
        work = folder / str(number) / "work"
        try:
            output = os.open(folder / "output", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
            os.dup2(output, 1)
            os.dup2(output, 2)
            os.close(output)
            work.mkdir(parents=True)
            os.chdir(work)
            outcome = trial(request, work, materials)
            if outcome.ending != FAULT and (line := leak(folder / "output")):
                outcome = Outcome(FAULT, f"a library prints {line!r}")
        except BaseException:
            outcome = Outcome(FAULT, "the trial itself failed: " + traceback.format_exc()[-800:])
        os.write(answers, (json.dumps(asdict(outcome)) + "\n").encode())
        os.chdir(folder)
        shutil.rmtree(work.parent, ignore_errors=True)
    os._exit(0)


def _resident(process: int) -> float:
    """Memory that a process uses now [MB]."""
    with contextlib.suppress(OSError, IndexError, ValueError):
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * resource.getpagesize() / 1024**2
    return 0.0


def _ended(session: int) -> tuple[int, int, Any]:
    """End a trial that takes too long, and all that it has started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(session, signal.SIGKILL)
    return os.wait4(session, 0)


def _left_behind(session: int) -> bool:
    """Whether processes of a trial are still there some seconds after it; they are ended."""
    deadline = time.monotonic() + ENDINGS
    while True:
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return False
        if time.monotonic() > deadline:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(session, signal.SIGKILL)
            return True
        time.sleep(0.01)


def serve(materials: Path) -> None:
    """Answer requests, a line each, until there are no more."""
    from campaign import calls, inputs, writes

    kinds: dict[str, tuple[Trial, float]] = {
        "write": (writes.run, 10 * TIME_LIMIT),
        "input": (inputs.run, TIME_LIMIT),
        "call": (calls.run, TIME_LIMIT),
    }
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # nothing but outcomes goes to the pipe
    for module in (writes, inputs, calls):
        module.load(materials)
    gc.collect()
    gc.freeze()  # what is loaded stays shared
    for line in sys.stdin:
        requests = json.loads(line)
        trial, limit = kinds[requests[0]["kind"]]
        outcomes = isolated(trial, requests, materials, limit)
        answers.write(json.dumps([asdict(each) for each in outcomes]) + "\n")
        answers.flush()


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
