"""A Ray cluster of two nodes on this machine: random kills of workers, nodes, head and command; speed.

    python benchmarks/cluster.py                    # 60 kills, an hour; goes on where it was interrupted
    python benchmarks/cluster.py --part speed       # cost of Ray beside local processes, and scaling

Each kill is a line of FOLDER/kills.jsonl. A command that was killed, or refused to go on without its head, is repeated
on a cluster of another size. The data set must have the same bytes as one of a single process, and no other files. The
exit status is 1 if one has not.
"""

import hashlib
import json
import os
import random
import resource
import secrets
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console

from foretrace.errors import SimulationError
from foretrace.files import write_json, write_text
from foretrace.simulation.collect import CollectConfig, collect, num_trials
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.workers import on_cluster, run_jobs

ROOT = Path(__file__).parents[1]
MARK = "FORETRACE_NODE"
"""Variable of the environment that finds the processes of a node."""
OBJECTS = 32
"""416 lever-ups in five shards."""
COMMAND = f"simulate --objects {OBJECTS} --embodiment tool --out"
TARGETS = ("worker", "worker", "node", "node", "head", "command", "command", "ctrl-c")
LIMIT = 300.0
"""Time that a command may take [s]."""
NODE = "--num-cpus=1 --object-store-memory=80000000 --disable-usage-stats"
Row = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """What is run."""

    part: Literal["kills", "speed"] = "kills"
    """Kills, or times."""
    kills: int = 60
    """Number of kills."""
    minutes: float = float("inf")
    """Time after which no kill is begun [min]."""
    rounds: int = 3
    """Repetitions of each time that is measured."""
    objects: int = 90
    """Objects of the simulations that are timed, some 12 lever-ups of each."""
    seed: int = 0
    """Seed of moments and victims."""
    folder: Path = ROOT / "build" / "cluster"
    """Where data sets and the lines of kills are kept."""
    out: Path = ROOT / "docs" / "results" / "cluster"
    """Folder for the results."""


class Loopback:
    """Up to two nodes on this machine, with one processor each; killed as a machine is, all processes at once."""

    def __init__(self, folder: Path):
        with socket.create_server(("", 0)) as free:
            self.port = free.getsockname()[1]
        self.folder, self.name = folder, secrets.token_hex(4)
        self.environment = os.environ | {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(16)}
        self.environment |= {"RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1"}
        self.address = f"127.0.0.1:{self.port}"

    def ensure(self, nodes: int) -> None:
        """Let a number of nodes live."""
        if not list(self.processes("head")):
            self.kill("node")
            begin = f"--head --port={self.port} --include-dashboard=false --temp-dir=/tmp/ray-{self.name}"
            self._start("head", f"{begin} --ray-client-server-port={self.port + 1}")
        if nodes == 1:
            self.kill("node")
        elif not list(self.processes("node")):
            self._start("node", f"--address={self.address}")

    def _start(self, node: str, options: str) -> None:
        words = [*self.within(node), "ray", "start", *NODE.split(), *options.split()]
        mark = {MARK: f"{self.name}-{node}"}
        for _ in range(3):
            done = subprocess.run(
                words, env=self.environment | mark, capture_output=True, text=True, timeout=120
            )
            if done.returncode == 0:
                return
            self.kill(node)
            time.sleep(2)
        raise SystemExit(f"{' '.join(words)}: {done.stdout[-500:]}{done.stderr[-500:]}")

    def within(self, node: str) -> list[str]:
        """What begins the commands of a node."""
        return []

    def processes(self, node: str, beginning: str = "") -> Iterator[int]:
        """Numbers of a node's processes whose command begins so."""
        mark = f"{MARK}={self.name}-{node}".encode()
        for entry in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                line = (entry / "cmdline").read_bytes()
                if line.startswith(beginning.encode()) and mark in (entry / "environ").read_bytes():
                    yield int(entry.name)

    def kill(self, node: str) -> None:
        """End all processes of a node."""
        for number in list(self.processes(node)):
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)


def contents(folder: Path) -> dict[str, str]:
    """Checksum of every file."""
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def command(cluster: Loopback, out: Path, where: str | None) -> subprocess.Popen[str]:
    """Start the command, on the cluster or in local processes."""
    words = [sys.executable, "-m", "foretrace", *COMMAND.split(), str(out)]
    words += ["--workers", "2"] if where is None else ["--cluster", where]
    with open(out.with_suffix(".log"), "a") as log:
        return subprocess.Popen(
            words, env=cluster.environment, stdout=log, stderr=log, text=True, start_new_session=True
        )


def strike(cluster: Loopback, target: str, process: subprocess.Popen[str], rng: random.Random) -> bool:
    """Kill something; whether there was something to kill."""
    if target == "worker":
        found = [*cluster.processes("head", "ray::_work"), *cluster.processes("node", "ray::_work")]
        if found:
            with suppress(ProcessLookupError):
                os.kill(rng.choice(found), signal.SIGKILL)
        return bool(found)
    if target in ("node", "head"):
        cluster.kill(target)
        return True
    if process.poll() is not None:
        return False
    process.send_signal(signal.SIGINT if target == "ctrl-c" else signal.SIGKILL)
    return True


def one_kill(cluster: Loopback, number: int, seed: int, seconds: float, wanted: Row, folder: Path) -> Row:
    """One kill, and what came of it."""
    rng = random.Random(f"{seed} {number}")
    target, moment = TARGETS[number % len(TARGETS)], rng.uniform(0.0, 1.1 * seconds)
    out = folder / f"data-{number}"
    shutil.rmtree(out, ignore_errors=True)
    out.with_suffix(".log").unlink(missing_ok=True)
    cluster.ensure(2)
    process, begun = command(cluster, out, cluster.address), time.monotonic()
    with suppress(subprocess.TimeoutExpired):
        process.wait(moment)
    struck = strike(cluster, target, process, rng)
    row: Row = {
        "kill": number,
        "target": target,
        "moment": round(moment, 2),
        "struck": struck,
        "statuses": [],
    }
    while True:
        try:
            row["statuses"].append(process.wait(LIMIT))
        except subprocess.TimeoutExpired:
            process.kill()
            return row | {"fault": f"not ended {LIMIT:.0f} s after the kill"}
        if row["statuses"][-1] == 0:
            break
        if len(row["statuses"]) == 4:
            return row | {"fault": "does not go on: " + out.with_suffix(".log").read_text()[-300:]}
        size = rng.choice([0, 1, 2])
        row["again_on"] = size
        if size:
            cluster.ensure(size)
        process = command(cluster, out, cluster.address if size else None)
    row |= {"seconds": round(time.monotonic() - begun, 1)}
    said, found = out.with_suffix(".log").read_text(), contents(out)
    row["repeated"] = " repeated" in said
    if "Traceback" in said:
        row["fault"] = said[-300:]
    if odd := [name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name)]:
        row["fault"] = f"other bytes: {', '.join(sorted(odd))}"
    else:
        shutil.rmtree(out)
        out.with_suffix(".log").unlink()
    return row


def kills(options: Options) -> int:
    """All kills that are missing; exit status."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by the background jobs of a shell
    folder = options.folder
    folder.mkdir(parents=True, exist_ok=True)
    log, end = folder / "kills.jsonl", time.monotonic() + 60 * options.minutes
    rows = [json.loads(line) for line in log.read_text().splitlines()] if log.is_file() else []
    done = {row["kill"] for row in rows}
    cluster = Loopback(folder)
    try:
        reference = folder / "reference"
        config = CollectConfig(OBJECTS, simulation=SimulationConfig(embodiment="tool"))
        collect(config, reference, workers=1, console=Console(quiet=True))
        wanted = contents(reference)
        cluster.ensure(2)
        timed, begun = folder / "timed", time.monotonic()
        shutil.rmtree(timed, ignore_errors=True)
        assert command(cluster, timed, cluster.address).wait(LIMIT) == 0
        seconds = time.monotonic() - begun
        assert contents(timed) == wanted
        for number in sorted(set(range(options.kills)) - done):
            if time.monotonic() > end:
                break
            row = one_kill(cluster, number, options.seed, seconds, wanted, folder)
            print(row, flush=True)
            rows.append(row)
            with open(log, "a") as file:
                file.write(json.dumps(row) + "\n")
    finally:
        for node in ("node", "head"):
            cluster.kill(node)
        shutil.rmtree(f"/tmp/ray-{cluster.name}", ignore_errors=True)
    rows.sort(key=lambda row: row["kill"])
    faults = [row for row in rows if "fault" in row]
    write_json(
        options.out / "kills.json", {"seed": options.seed, "seconds": round(seconds, 1), "kills": rows}
    )
    write_text(options.out / "kills.md", table(rows))
    return int(bool(faults))


def table(rows: list[Row]) -> str:
    """The kills, by what was killed."""
    lines = ["| Killed | Trials | Before the end | Went on by itself | Repeated by hand | Faults |"]
    lines.append("| --- | --: | --: | --: | --: | --: |")
    for target in (*dict.fromkeys(TARGETS), "all"):
        some = [row for row in rows if target in ("all", row["target"])]
        struck = [row for row in some if row["struck"]]
        alone = sum(len(row["statuses"]) == 1 for row in struck)
        faults = sum("fault" in row for row in some)
        lines.append(
            f"| {target} | {len(some)} | {len(struck)} | {alone} | {len(struck) - alone} | {faults} |"
        )
    return "\n".join(lines) + "\n"


def nothing(job: int) -> tuple[str, dict[str, Any], Counter[str]]:
    """What a shard answers, without the shard."""
    return (
        f"shards/shard-{job:05d}.parquet",
        {"sha256": 64 * "0", "rows": 100},
        Counter(levered=90, slipped=10),
    )


def speed(options: Options) -> int:
    """Times of the same work with and without Ray, in turns; exit status."""
    config = CollectConfig(options.objects, simulation=SimulationConfig(embodiment="tool"))
    times: dict[str, list[float]] = {}

    def measure(name: str, workers: int) -> None:
        out = options.folder / "speed"
        shutil.rmtree(out, ignore_errors=True)
        begun = time.monotonic()
        collect(config, out, workers=workers, console=Console(quiet=True))
        times.setdefault(name, []).append(round(time.monotonic() - begun, 2))
        print(name, times[name][-1], flush=True)

    options.folder.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    with on_cluster("local:2"):
        times["start of Ray"] = [round(time.monotonic() - begun, 2)]
        list(run_jobs(nothing, range(100), 2, error=SimulationError))
        begun = time.monotonic()
        jobs = 10_000
        list(run_jobs(nothing, range(jobs), 2, error=SimulationError))
        empty = jobs / (time.monotonic() - begun)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    for _ in range(options.rounds):
        for workers in (1, 2):
            measure(f"local, {workers}", workers)
            with on_cluster(f"local:{workers}"):
                list(run_jobs(nothing, range(2 * workers), workers, error=SimulationError))
                measure(f"Ray, {workers}", workers)
    median = {name: statistics.median(values) for name, values in times.items()}
    results = {
        "lever_ups": num_trials(config),
        "seconds": times,
        "ratio_ray_to_local": {k: round(median[f"Ray, {k}"] / median[f"local, {k}"], 3) for k in (1, 2)},
        "scaling_1_to_2": {
            name: round(median[f"{name}, 1"] / median[f"{name}, 2"], 3) for name in ("local", "Ray")
        },
        "empty_jobs_per_second": round(empty),
        "memory_of_the_command_mb": round(memory),
        "load_of_the_machine": os.getloadavg()[0],
    }
    write_json(options.out / "speed.json", results, indent=2)
    print(json.dumps(results, indent=2))
    return 0


if __name__ == "__main__":
    chosen = tyro.cli(Options, description=__doc__)
    chosen.out.mkdir(parents=True, exist_ok=True)
    sys.exit(kills(chosen) if chosen.part == "kills" else speed(chosen))
