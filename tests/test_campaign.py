"""A sample of the campaign of crash points and damaged inputs; `benchmarks/campaign.py` runs the whole of it."""

import json
import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from campaign import FAULT, OK, answers, calls, inputs, writes
from campaign.draws import drawn
from campaign.materials import prepare
from campaign.server import Server

PARTS = [(kind, number) for kind in ("input", "call") for number in range(4)]
EXAMPLES = 150
"""Of each part."""
FEW, COSTLY = 2, 1
"""Crash points tried of a command, and of one that takes longer."""


@pytest.fixture(scope="session")
def materials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("campaign") / "materials")


@pytest.fixture(scope="module")
def server(materials: Path) -> Iterator[Server]:
    with Server(materials) as process:
        yield process


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, job in writes.JOBS.items() if not job.slow])
def test_a_command_goes_on_after_it_stopped_at_a_write(name, server, materials):
    (first,) = server.run({"kind": "write", "job": name, "at": 0, "how": writes.STOP})
    assert first.ending != FAULT, first.detail
    count = writes.reference_of(name, materials)["writes"]
    rng = random.Random(name)
    points = sorted(rng.sample(range(count), min(count, COSTLY if writes.JOBS[name].costly else FEW)))
    requests = [{"kind": "write", "job": name, "at": at, "how": rng.choice(writes.WAYS)} for at in points]
    outcomes = zip(requests, server.run(*requests), strict=True)
    faults = [f"{request}: {outcome.detail}" for request, outcome in outcomes if outcome.ending == FAULT]
    assert not faults, "\n".join(faults)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "number"), PARTS)
def test_whatever_is_given_is_answered_or_refused(kind, number, server, materials):
    requests = drawn(inputs.requests() if kind == "input" else calls.requests(materials), number, EXAMPLES)
    outcomes = zip(requests, server.run(*requests), strict=True)
    faults = [f"{outcome.detail}: {json.dumps(one)}" for one, outcome in outcomes if outcome.ending == FAULT]
    assert not faults, "\n".join(faults)


UNSOUND = {
    "a fault of another class": lambda: {}["x"],
    "NaN": lambda: {"mass": float("nan")},
    "an absurd number": lambda: [1.0, 1e200],
    "a TypeError that names no argument": lambda: len(5),  # pyright: ignore[reportArgumentType]
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
