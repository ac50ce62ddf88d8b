"""Commands that are killed at random moments: nothing stays running, and the same command comes to the same end."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from campaign import FAULT, OK, Outcome
from campaign.writes import contents_of, gone_on

MARK = "FORETRACE_CAMPAIGN"
"""Variable of the environment that finds what a command has started."""
ENDINGS = 5.0
"""Time in which all that a command has started must have ended after it [s]."""
DEAF = 20.0
"""Time in which a command must hear Ctrl-C or a request to end [s]."""
LIMIT = 600.0
"""Time that a command may take [s]."""
TRAIN = "train --data {m}/data --out out --min-steps 1 --threads 1"
COMMANDS: dict[str, str] = {
    "simulate": "simulate --objects 8 --contacts-per-edge 2 --embodiment tool --workers 2 --out out",
    "train": TRAIN + " --features none --hidden 32 --epochs 60",
    "evaluate": "evaluate predictor {m}/lstm --data {m}/data --out out",
    "import": "import {m}/recording --contact-px 466.3 178.1 --object {m}/object.json --out out",
    "film": "film {m}/data 0 --out out --width 640 --fps 10 --exposures 1",
    "export rosbag": "export rosbag --data {m}/data --ids 0 1 2 3 4 5 --no-camera --out out",
    "export lerobot": "export lerobot --data {m}/data --out out",
    "export rerun": "export rerun --data {m}/data --ids 0 1 --no-camera --out out",
    "export onnx": "export onnx {m}/lstm --out out.onnx",
    "demo": "demo --out out --objects 8 --contacts-per-edge 1 --epochs 2 --min-steps 1 --workers 2",
}
"""Every command that takes long."""
SIGNALS = (*[signal.SIGKILL] * 3, signal.SIGINT, signal.SIGTERM)


def run(request: Any, folder: Path, materials: Path) -> Outcome:
    """One kill: ``{"command": name, "seed": number}`` choose the moment and the signal."""
    name = request["command"]
    reference = _reference(name, materials)
    rng = random.Random(f"{name} {request['seed']}")
    moment, sent = rng.uniform(0.0, 1.05 * reference["seconds"]), rng.choice(SIGNALS)
    begun = time.monotonic()
    process = _start(name, folder, materials)
    try:
        process.wait(moment)
    except subprocess.TimeoutExpired:
        if sent == signal.SIGINT:
            os.killpg(process.pid, sent)  # as a terminal does
        else:
            process.send_signal(sent)
    told = f"{sent.name} after {moment:.2f} s"
    try:
        process.wait(DEAF)
    except subprocess.TimeoutExpired:
        _end(process)
        return Outcome(FAULT, f"{told}: not heard within {DEAF:.0f} s")
    if left := _left_behind(process):
        return Outcome(FAULT, f"{told}: process left: {left}")
    said = (folder.parent / "said").read_text(errors="replace")
    if "Traceback" in said:
        return Outcome(FAULT, f"{told}: {said[-400:]}")
    outcome = gone_on(lambda: _whole(name, folder, materials), folder, reference["contents"])
    detail = f"{told}: {outcome.detail}" if outcome.ending != OK else told
    return replace(outcome, detail=detail, seconds=round(time.monotonic() - begun, 2))


def _reference(name: str, materials: Path) -> dict[str, Any]:
    """Duration and contents of an uninterrupted run."""
    file = materials / "references" / f"killed {name}.json"
    if not file.is_file():
        file.parent.mkdir(exist_ok=True)
        folder = materials / "references" / f"{name}-{uuid.uuid4().hex}"  # several threads may want the same
        runs = []
        for part in ("once", "again"):
            (folder / part / "work").mkdir(parents=True)
            begun = time.monotonic()
            status, told = _whole(name, folder / part / "work", materials)
            assert status == 0, f"{name}: {told}"
            runs.append((time.monotonic() - begun, contents_of(folder / part / "work")))
        (seconds, once), (_, again) = runs
        contents = {each: sum if again.get(each) == sum else "any" for each, sum in once.items()}
        subprocess.run(["rm", "-r", str(folder)], check=True)
        file.write_text(json.dumps({"seconds": seconds, "contents": contents}))
    return json.loads(file.read_text())


def _start(name: str, folder: Path, materials: Path) -> "subprocess.Popen[bytes]":
    environment = os.environ | {MARK: uuid.uuid4().hex, "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    with open(folder.parent / "said", "wb") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "foretrace", *COMMANDS[name].format(m=materials).split()],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
            start_new_session=True,
        )
    process.mark = environment[MARK]  # pyright: ignore[reportAttributeAccessIssue]
    return process


def _whole(name: str, folder: Path, materials: Path) -> tuple[int, str]:
    """Run a command to its end; exit status, and what it says on standard error."""
    process = _start(name, folder, materials)
    try:
        status = process.wait(LIMIT)
    except subprocess.TimeoutExpired:
        status = 124
    _end(process)
    errors = [
        line
        for line in (folder.parent / "said").read_text(errors="replace").splitlines()
        if "trials," not in line
    ]
    return status, "\n".join(errors if status != 2 else errors[-1:])


def _left_behind(process: Any) -> str:
    """Command line of a process that is still there some seconds after the one that started it; it is ended."""
    deadline = time.monotonic() + ENDINGS
    while left := list(_marked(process.mark)):
        if time.monotonic() > deadline:
            said = " ".join(text for _, text in left)[:200]
            _end(process)
            return said
        time.sleep(0.05)
    return ""


def _end(process: Any) -> None:
    for number, _ in [(process.pid, ""), *_marked(process.mark)]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    process.wait()


def _marked(mark: str) -> Iterator[tuple[int, str]]:
    """Number and command line of every process with the mark in its environment."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if mark.encode() in (folder / "environ").read_bytes():
                line = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                yield int(folder.name), line
