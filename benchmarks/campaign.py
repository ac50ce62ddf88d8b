"""The campaign: every crash point of every command, damaged files, odd arguments, and kills at random moments.

    python benchmarks/campaign.py                      # all of it: several hours on two cores
    python benchmarks/campaign.py --minutes 10         # what there is time for, spread over all parts
    python benchmarks/campaign.py --repeat 'TRIAL'     # one trial of faults.jsonl again

Every trial is one line of FOLDER/trials.jsonl; the same command goes on where an interrupted one stopped, and a new
commit starts anew. The tables go to --out and into docs/reliability.md. The exit status is 1 if there are faults.
"""

import json
import os
import platform
import random
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from campaign import FAULT, OK, REFUSED, Outcome, calls, inputs, kills, writes
from campaign.draws import drawn
from campaign.materials import prepare
from campaign.server import Server
from foretrace.predictor.run_folder import git_commit

ROOT = Path(__file__).parents[1]
Part = Literal["writes", "inputs", "calls", "kills"]
SHARES: dict[str, float] = {"writes": 0.35, "inputs": 0.15, "calls": 0.15, "kills": 0.35}
"""Share of the time that each part gets."""
BLOCK = 200
"""Trials that hypothesis draws at once, with a seed of their own: so a longer campaign begins like a shorter one."""
TOGETHER = 20
"""Damaged files or odd arguments that share a process as long as it lives."""
MARKS = "<!-- campaign -->\n", "<!-- end of the campaign -->\n"
"""Where in docs/reliability.md the table stands."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """What is run."""

    parts: tuple[Part, ...] = ("writes", "inputs", "calls", "kills")
    """Parts that are run."""
    inputs: int = 10_000
    """Damaged files and odd arguments, half each."""
    kills: int = 60
    """Kills of each command that takes long."""
    minutes: float = float("inf")
    """Time after which no trial is begun, spread over the parts [min]."""
    workers: int = 2
    """Trials at the same time."""
    seed: int = 0
    """Seed of everything that is drawn."""
    folder: Path = ROOT / "build" / "campaign"
    """Where materials and the lines of trials are kept."""
    out: Path = ROOT / "docs" / "results" / "reliability"
    """Folder for summary.json, faults.jsonl and table.md."""
    repeat: str | None = None
    """A trial to run alone, as JSON."""


def main(options: Options) -> int:
    """Run what is missing, and print and write the tables."""
    options.folder.mkdir(parents=True, exist_ok=True)
    materials = prepare(options.folder.absolute() / f"materials-{(git_commit() or 'none')[:12]}")
    log = materials.with_name(materials.name.replace("materials", "trials") + ".jsonl")
    if options.repeat is not None:
        with Server(materials) as server:
            print(run([json.loads(options.repeat)], server, materials)[0])
        return 0
    console = Console()
    begun = time.monotonic()
    for part in options.parts:
        shares = [SHARES[each] for each in options.parts]
        share = sum(shares[: options.parts.index(part) + 1]) / sum(shares)
        try:
            carry_out(part, options, materials, log, begun + 60 * options.minutes * share, console)
        except KeyboardInterrupt:
            console.print("interrupted: the same command goes on from here")
            break
    rows = list(read(log))
    write(rows, options, console)
    return int(any(row["ending"] == FAULT for row in rows))


def carry_out(
    part: str, options: Options, materials: Path, log: Path, deadline: float, console: Console
) -> None:
    """Run the trials of a part that have no line yet, until the deadline."""
    done = {json.dumps(row["trial"], sort_keys=True) for row in read(log)}
    lock, servers = threading.Lock(), threading.local()
    opened: list[Server] = []
    stop = threading.Event()

    def some(batch: list[Row]) -> None:
        if stop.is_set() or time.monotonic() > deadline:
            return
        if not hasattr(servers, "own"):
            servers.own = Server(materials)
            opened.append(servers.own)
        outcomes = run(batch, servers.own, materials)
        with lock, open(log, "a") as file:
            for trial, outcome in zip(batch, outcomes, strict=True):
                file.write(json.dumps({"part": part, "trial": trial, **asdict(outcome)}) + "\n")
            progress.update(task, advance=len(batch))

    with Progress(console=console) as progress:
        missing = [
            trial
            for trial in trials(part, options, materials)
            if json.dumps(trial, sort_keys=True) not in done
        ]
        size = TOGETHER if part in ("inputs", "calls") else 1
        batches = [missing[start : start + size] for start in range(0, len(missing), size)]
        task = progress.add_task(part, total=len(missing))
        try:
            with ThreadPoolExecutor(options.workers) as pool:
                try:
                    list(pool.map(some, batches))
                except BaseException:
                    stop.set()
                    raise
        finally:
            for server in opened:
                server.__exit__()


def trials(part: str, options: Options, materials: Path) -> list[Row]:
    """All trials of a part, in an order in which any beginning is a fair sample; commands that take long are last."""
    if part == "writes":
        with Server(materials) as server:
            for name in writes.JOBS:
                server.run({"kind": "write", "job": name, "at": 0, "how": writes.STOP})
        found = [
            {"kind": "write", "job": name, "at": at, "how": how}
            for name in writes.JOBS
            for at in range(writes.reference_of(name, materials)["writes"])
            for how in writes.WAYS
        ]
    elif part == "kills":
        found = [
            {"kind": "kill", "command": name, "seed": options.seed + number}
            for name in kills.COMMANDS
            for number in range(options.kills)
        ]
    else:
        strategy = inputs.requests() if part == "inputs" else calls.requests(materials)
        starts = range(0, options.inputs // 2, BLOCK)
        counts = [(start // BLOCK, min(BLOCK, options.inputs // 2 - start)) for start in starts]
        return [
            trial for block, n in counts for trial in drawn(strategy, 1_000_000 * options.seed + block, n)
        ]
    random.Random(options.seed).shuffle(found)
    return sorted(found, key=lambda trial: part == "writes" and writes.JOBS[trial["job"]].slow)


def run(batch: list[Row], server: Server, materials: Path) -> list[Outcome]:
    """Some trials of one kind."""
    if batch[0]["kind"] != "kill":
        return server.run(*batch)
    outcomes = []
    for trial in batch:
        folder = Path(tempfile.mkdtemp(prefix="kill-"))
        (folder / "work").mkdir()
        try:
            outcomes.append(kills.run(trial, folder / "work", materials))
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    return outcomes


def read(log: Path) -> Iterator[Row]:
    """The lines of trials; one that was cut off is run again."""
    if log.is_file():
        for line in log.read_text().splitlines():
            try:
                yield json.loads(line)
            except ValueError:
                continue


def write(rows: list[Row], options: Options, console: Console) -> None:
    """Print the tables, and write them."""
    counted = [count(part, rows) for part in SHARES]
    columns = ("trials", "ok", "refused", "faults", "slowest [s]", "most memory [MB]")
    table = Table(title="Campaign", title_justify="left")
    for column in ("part", *columns):
        table.add_column(column, justify="left" if column == "part" else "right")
    for name, *values in counted:
        table.add_row(name, *map(str, values))
    console.print(table)
    goals = measured(rows)
    for name, value in goals.items():
        console.print(f"{name}: {value}")
    options.out.mkdir(parents=True, exist_ok=True)
    lines = ["| Part | Trials | Answered or finished | Refused | Faults | Slowest [s] | Most memory [MB] |"]
    lines += ["| --- | --: | --: | --: | --: | --: | --: |"]
    lines += [f"| {' | '.join(map(str, row))} |" for row in counted]
    lines += ["", "| Goal | Measured |", "| --- | --: |"]
    lines += [f"| {name} | {value} |" for name, value in goals.items()]
    text = "\n".join(lines) + "\n"
    (options.out / "table.md").write_text(text)
    faults = [row for row in rows if row["ending"] == FAULT]
    (options.out / "faults.jsonl").write_text("".join(json.dumps(row) + "\n" for row in faults))
    summary = {
        "commit": git_commit(),
        "seed": options.seed,
        "machine": {
            "python": platform.python_version(),
            "system": platform.platform(),
            "cores": os.cpu_count(),
        },
        "parts": {name: dict(zip(columns, values, strict=True)) for name, *values in counted},
        "goals": goals,
        "each": each_of(rows),
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    page = ROOT / "docs" / "reliability.md"
    if options.out == Options.out and page.is_file():
        before, _, rest = page.read_text().partition(MARKS[0])
        after = rest.partition(MARKS[1])[2]
        page.write_text(f"{before}{MARKS[0]}\n{text}\n{MARKS[1]}{after}")


def count(part: str, rows: Iterable[Row]) -> list[Any]:
    """Name, counts of endings, longest time and most memory of a part."""
    own = [row for row in rows if row["part"] == part]
    endings = [row["ending"] for row in own]
    slowest = max((row["seconds"] for row in own), default=0.0)
    most = max((row["megabytes"] for row in own), default=0.0)
    return [
        NAMES[part],
        len(own),
        *(endings.count(each) for each in (OK, REFUSED, FAULT)),
        round(slowest, 1),
        round(most),
    ]


NAMES = {"writes": "Crash points", "inputs": "Damaged files", "calls": "Odd arguments", "kills": "Kills"}


def measured(rows: list[Row]) -> dict[str, int]:
    """The goals, all of which are 0."""
    faults = [row["detail"] for row in rows if row["ending"] == FAULT]
    signs = {
        "Hangs over 20 s": ("not done after", "not heard within"),
        "Memory over 2 GB": ("MB of memory",),
        "Processes left": ("process is left", "process left"),
        "Rows lost, or another end than without interruption": ("afterwards", "the same command again"),
        "NaN, infinite or absurd answers": ("in the answer",),
        "Processes that died": ("died of signal",),
    }
    found = {name: sum(any(each in one for each in said) for one in faults) for name, said in signs.items()}
    return found | {"Tracebacks and other faults": len(faults) - sum(found.values())}


def each_of(rows: Iterable[Row]) -> dict[str, dict[str, int]]:
    """Counts of endings of every command, reader and call."""
    found: dict[str, dict[str, int]] = {}
    for row in rows:
        trial = row["trial"]
        name = next(trial[key] for key in ("job", "reader", "call", "command") if key in trial)
        counts = found.setdefault(f"{row['part']}: {name}", {OK: 0, REFUSED: 0, FAULT: 0})
        counts[row["ending"]] += 1
    return dict(sorted(found.items()))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
