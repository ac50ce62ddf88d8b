"""Workers end with their parent, however it ends and whatever they are doing."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from foretrace.errors import ForetraceError
from foretrace.workers import run_jobs

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs process groups")
SOON = 15.0
"""Time in which workers end after their parent, a tenth of it where the machine is idle [s]."""


def bulky(_job: int) -> bytes:
    """A result that no pipe takes at once."""
    return bytes(2_000_000)


def blocked() -> None:
    """Jobs whose results nothing reads as soon as this process is stopped."""
    for _ in run_jobs(bulky, range(10_000), 2, error=ForetraceError):
        print("one", flush=True)


def start(command: list[str]) -> subprocess.Popen[str]:
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": paths}
    return subprocess.Popen(
        [sys.executable, *command],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )


def left_after_a_kill(process: subprocess.Popen[str]) -> bool:
    """Kill a process group's leader alone; whether others are left soon after."""
    process.kill()
    process.wait()
    deadline = time.monotonic() + SOON
    try:
        while time.monotonic() < deadline:
            os.killpg(process.pid, 0)
            time.sleep(0.05)
    except ProcessLookupError:
        return False
    os.killpg(process.pid, signal.SIGKILL)
    return True


def test_workers_that_wait_for_room_in_a_pipe_end_with_their_parent():
    process = start(["-c", "import test_workers; test_workers.blocked()"])
    assert process.stdout is not None
    assert process.stdout.readline() == "one\n"
    process.send_signal(signal.SIGSTOP)
    time.sleep(0.5)  # they fill the pipe
    assert not left_after_a_kill(process)


@pytest.mark.slow
@pytest.mark.parametrize("moment", range(3))
def test_a_killed_simulation_leaves_no_process(tmp_path, moment):
    fast = ["--embodiment", "tool", "--insert-time", "0.1", "--lift-time", "0.2", "--hold-time", "0"]
    process = start(["-m", "foretrace", "simulate", "--out", str(tmp_path / "data"), *fast, "--workers", "2"])
    time.sleep(random.Random(moment).uniform(0.5, 5.0))
    assert process.poll() is None
    assert not left_after_a_kill(process)
