"""A sample of the campaign of crash points and damaged inputs; `benchmarks/campaign.py` runs the whole of it."""

import subprocess
import sys
from pathlib import Path

import pytest

from campaign import FAULT, OK, answers

UNSOUND = {
    "a fault of another class": lambda: {}["x"],
    "NaN": lambda: {"mass": float("nan")},
    "an absurd number": lambda: [1.0, 1e200],
    "a TypeError that names no argument": lambda: float([]),
}


@pytest.mark.parametrize("name", UNSOUND)
def test_faults_are_seen_as_faults(name):
    assert answers.judged(UNSOUND[name], ("mass",)).ending == FAULT


def test_sound_answers_are_seen_as_sound():
    assert answers.judged(lambda: {"mass": 1.0, "outcome": "levered"}).ending == OK


DOOMED = {
    "crash": ("import os; os.kill(os.getpid(), 11)", "died of signal 11"),
    "hang": ("import time; time.sleep(60)", "not done after 0 s"),
    "memory": ("kept = b'x' * (3 * 10**8); import time; time.sleep(60)", "MB of memory"),
    "left": ("import subprocess; subprocess.Popen(['sleep', '60'])", "a process is left"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DOOMED)
def test_trials_that_end_badly_are_faults(name, tmp_path):
    code, told = DOOMED[name]
    program = (
        "from pathlib import Path; from campaign import OK, Outcome, server\nserver.MEMORY_LIMIT = 200.0\n"
        f"def trial(request, folder, materials):\n    exec({code!r})\n    return Outcome(OK)\n"
        f"print(server.isolated(trial, [{{}}], Path(), {0.3 if name == 'hang' else 20.0}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=Path(__file__).parent
    )
    assert told in done.stdout
