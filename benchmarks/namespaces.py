"""A Ray cluster of two nodes, each in a network namespace of its own, joined by a virtual cable; one of them is killed.

    python benchmarks/namespaces.py                 # two minutes; needs Linux, ip and root

The nodes share the machine's files, as over NFS, and reach each other by their addresses alone. The exit status is 1 if
the data set has other bytes than that of one process.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import tyro
from rich.console import Console

from cluster import Loopback, contents
from foretrace.files import write_json
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.simulation.lever_up import SimulationConfig

ROOT = Path(__file__).parents[1]
OBJECTS = 16
"""208 lever-ups in three shards."""
ADDRESSES = {"head": "10.77.0.1", "node": "10.77.0.2"}
PORT = 6379
LIMIT = 400.0
"""Time that the command may take [s]."""


class Namespaces(Loopback):
    """Two nodes that see each other's address, and nothing else of the machine's network."""

    def __init__(self, folder: Path):
        super().__init__(folder)
        self.port, self.address = PORT, f"{ADDRESSES['head']}:{PORT}"
        self.names = {node: f"foretrace-{self.name}-{node}" for node in ADDRESSES}
        ends = {node: f"{node}{self.name[:6]}" for node in ADDRESSES}
        for name in self.names.values():
            ip("netns", "add", name)
        ip("link", "add", ends["head"], "type", "veth", "peer", "name", ends["node"])
        for node, name in self.names.items():
            ip("link", "set", ends[node], "netns", name)
            ip("-n", name, "addr", "add", f"{ADDRESSES[node]}/24", "dev", ends[node])
            for device in ("lo", ends[node]):
                ip("-n", name, "link", "set", device, "up")

    def within(self, node: str) -> list[str]:
        """What begins a command in the namespace of a node."""
        return ["ip", "netns", "exec", self.names[node]]

    def _start(self, node: str, options: str) -> None:
        super()._start(node, f"{options} --node-ip-address={ADDRESSES[node]}")

    def close(self) -> None:
        """End both nodes, and remove their namespaces."""
        for node, name in self.names.items():
            self.kill(node)
            ip("netns", "del", name)
        shutil.rmtree(f"/tmp/ray-{self.name}", ignore_errors=True)


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


def main(
    folder: Path = ROOT / "build" / "namespaces",
    out: Path = ROOT / "docs" / "results" / "cluster" / "namespaces.json",
) -> int:
    """Simulate on both nodes, kill the one without the command in the middle, compare; exit status."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    config = CollectConfig(OBJECTS, simulation=SimulationConfig(embodiment="tool"))
    collect(config, folder / "alone", workers=1, console=Console(quiet=True))
    nodes = Namespaces(folder)
    try:
        nodes.ensure(2)
        words = f"-m foretrace simulate --objects {OBJECTS} --embodiment tool --out {folder / 'data'}"
        command = [*nodes.within("head"), sys.executable, *words.split(), "--cluster", nodes.address]
        begun, worked = time.monotonic(), 0.0
        with subprocess.Popen(command, env=nodes.environment, stderr=subprocess.PIPE, text=True) as process:
            while process.poll() is None and time.monotonic() < begun + LIMIT:
                if not worked and list(nodes.processes("node", "ray::_work")):  # it has a shard
                    time.sleep(2.0)
                    worked = time.monotonic() - begun
                    nodes.kill("node")
                time.sleep(0.2)
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGTERM)
            said = process.stderr.read() if process.stderr else ""
    finally:
        nodes.close()
    results = {
        "status": process.returncode,
        "killed_after_s": round(worked, 1),
        "seconds": round(time.monotonic() - begun, 1),
        "repeated": " repeated" in said,
        "same_bytes": contents(folder / "data") == contents(folder / "alone"),
    }
    write_json(out, results)
    print(json.dumps(results))
    return int(not (results["same_bytes"] and results["repeated"]))


if __name__ == "__main__":
    sys.exit(tyro.cli(main, description=__doc__))
