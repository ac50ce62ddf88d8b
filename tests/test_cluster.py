"""Jobs on a Ray cluster: addresses, nodes that do not fit, processes that die; the same bytes as without one."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from foretrace import cli, cluster
from foretrace.errors import DatasetError, ForetraceError, SimulationError
from foretrace.files import PARTIAL
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.workers import count_workers, on_cluster, run_jobs
from test_collect import fake_trial

SMALL = CollectConfig(objects=8)
"""104 trials: two shards."""
HERE = dict(cluster._versions())


class CrashedError(Exception):
    """A stand-in for what Ray raises where a process died."""


class RemoteError(Exception):
    """A stand-in for what Ray raises where a function cannot be run, with the traceback as its text."""


class FakeRay:
    """A cluster in this process: a job is done when it is asked for, and dies as often as is said before."""

    def __init__(self, deaths: dict[Any, int] | None = None, cpus: int = 3):
        self.deaths, self.cpus, self.most, self.cancelled = deaths or {}, cpus, 0, []
        names = ("WorkerCrashedError", "NodeDiedError", "OutOfMemoryError", "ObjectLostError")
        self.exceptions = SimpleNamespace(**dict.fromkeys((*names, "LocalRayletDiedError"), CrashedError))
        self.exceptions.RayTaskError = RemoteError

    def remote(self, function):
        return SimpleNamespace(
            options=lambda **_: SimpleNamespace(remote=lambda *given: partial(function, *given))
        )

    def put(self, value):
        return value

    def wait(self, running, num_returns, timeout, fetch_local):
        self.most = max(self.most, len(running))
        return running[-1:], running[:-1]  # the last one first

    def get(self, ref):
        if self.deaths.get(ref.args[1], 0):
            self.deaths[ref.args[1]] -= 1
            raise CrashedError
        return ref()

    def cancel(self, ref, force):
        self.cancelled.append(ref)

    def nodes(self):
        return [{"Alive": True, "Resources": {"CPU": self.cpus}}, {"Alive": False, "Resources": {"CPU": 9}}]

    def shutdown(self):
        pass


@pytest.fixture
def begin(monkeypatch):
    """Begin a block on a stand-in of a cluster."""
    with socket.create_server(("127.0.0.1", 0)) as head:

        def begin(fake: FakeRay):
            monkeypatch.setattr(cluster, "_connect", lambda _address: (fake, head.getsockname()))
            return on_cluster("10.0.0.1:6379")

        yield begin


def double(job: int) -> int:
    return 2 * job


def full(job: int) -> int:
    raise OSError(28, "No space left on device", "/scratch/shard")


def odd(job: int) -> int:
    raise DatasetError(f"job {job} is odd")


def lacking(job: int) -> int:
    raise RemoteError("ray::_work() (pid=1)\nModuleNotFoundError: No module named 'foretrace'")


def run(function, jobs, workers=3, **options) -> list[int]:
    return list(run_jobs(function, jobs, workers, error=SimulationError, **options))


def test_jobs_whose_process_dies_are_done_again(begin):
    fake = FakeRay({4: 2, 7: 1})
    with begin(fake):
        assert sorted(run(double, range(20))) == [2 * k for k in range(20)]
        assert run(double, range(20), ordered=True) == [2 * k for k in range(20)]
        assert fake.most == 6
        fake.most = 0
        run(double, range(20), workers=2)
        assert fake.most == 2
        assert count_workers(None, SimulationError) == 3
    assert count_workers(None, SimulationError) == os.cpu_count() or os.cpu_count() is None


def test_jobs_that_kill_every_process_end_the_work(begin):
    fake = FakeRay({4: 10})
    with begin(fake), pytest.raises(SimulationError, match="10 processes have died on the same job"):
        run(double, range(20))
    assert fake.cancelled
    assert not fake.deaths[4]


def test_a_head_that_is_gone_ends_the_work(begin, monkeypatch):
    monkeypatch.setattr(cluster, "LOOK_PERIOD", 0.0)
    monkeypatch.setattr(cluster, "DEAD", 0.1)
    fake = FakeRay()
    with socket.create_server(("127.0.0.1", 0)) as head:
        monkeypatch.setattr(cluster, "_connect", lambda _address: (fake, head.getsockname()))
        with on_cluster("10.0.0.1:6379"):
            results = run_jobs(double, range(10**6), 3, error=SimulationError)
            next(results)
            head.close()
            with pytest.raises(
                SimulationError, match=r"10\.0\.0\.1:6379 answers no more; finished work is kept"
            ):
                list(results)
    assert not fake.cancelled


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (odd, DatasetError, "job 0 is odd"),
        (lacking, SimulationError, "a node lacks the Python module foretrace: install"),
        (full, SimulationError, "No space left on device at /scratch/shard; finished work is kept"),
    ],
)
def test_errors_of_jobs_arrive(begin, function, error, message):
    with begin(FakeRay()), pytest.raises(error, match=message) as caught:
        run(function, [0])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"versions": {**HERE, "foretrace": "9.9"}}, "has foretrace .*, this machine 9.9: install the same"),
        ({"versions": {**HERE, "data set format": "3"}}, "has data set format 2, this machine 3"),
        ({"ahead": 9001.0}, "is 2.5 h behind this machine's"),
        ({"folder": Path("/nowhere/at/all")}, "has no folder /nowhere/at/all .*: share it"),
    ],
)
def test_nodes_that_do_not_fit_are_refused(changed, message):
    sent = time.time() + changed.pop("ahead", 0.0)
    given = {"function": double, "job": 1, "folder": Path.cwd(), "versions": HERE, "sent": sent}
    with pytest.raises(SimulationError, match=message):
        cluster._opened(cluster._work(**given | changed), SimulationError)


def test_a_clock_ahead_is_refused():
    with pytest.raises(SimulationError, match=r"a node is 2\.5 h ahead of"):
        cluster._opened(("result", 1, time.time() + 9001), SimulationError)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("somewhere", "cluster 'somewhere': give HOST:PORT, ray://HOST:PORT, or local:N"),
        ("local:0", "cluster 'local:0': give"),
        ("local:many", "cluster 'local:many': give"),
        ("local:999999", "cluster 'local:999999': give local:N with N from 1 to 1024"),
        ("http://127.0.0.1:22", "cluster 'http://127.0.0.1:22': give HOST:PORT"),
        ("host:99999", "cluster 'host:99999': give"),
        ("127.0.0.1:9", r"cannot be reached \(Connection refused\): start it with `ray start --head`"),
        ("ray://host.invalid:10001", "cluster ray://host.invalid:10001 cannot be reached"),
    ],
)
def test_clusters_that_are_not_there_are_refused(address, message, tmp_path, capsys):
    assert cli.main(["simulate", "--out", str(tmp_path / "data"), "--cluster", address]) == 2
    told = capsys.readouterr().err
    with pytest.raises(ForetraceError, match=message):
        cluster._connect(address)
    assert told.count("\n") == 1
    assert not (tmp_path / "data").exists()


def test_another_server_is_no_cluster():
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            connection, _ = server.accept()
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            connection.close()

        threading.Thread(target=answer, daemon=True).start()
        with pytest.raises(ForetraceError, match="another server answers there"):
            cluster._reach(*server.getsockname(), "it")


def test_a_data_set_is_the_same_bytes(begin, tmp_path):
    console = Console(quiet=True)
    collect(SMALL, tmp_path / "one", workers=1, console=console, simulate=fake_trial)
    with begin(FakeRay({("shards/shard-00001.parquet", range(100, 104)): 1})):
        collect(SMALL, tmp_path / "two", console=console, simulate=fake_trial)
        (tmp_path / "two/shards/shard-00001.parquet").unlink()
        draft = tmp_path / f"two/shards/.shard-00001.parquet.abcdef-1-0{PARTIAL}"
        draft.write_bytes(b"of a killed process on another machine")
        collect(SMALL, tmp_path / "two", console=console, simulate=fake_trial)
    assert contents(tmp_path / "two") == contents(tmp_path / "one")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def slow_trial(config: CollectConfig, id: int):
    time.sleep(0.05)
    return fake_trial(config, id)


@pytest.mark.slow
def test_ray_itself_survives_a_killed_worker(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    console = Console(quiet=True)
    collect(SMALL, tmp_path / "one", workers=1, console=console, simulate=fake_trial)
    killed = []

    def kill():
        while not killed:
            time.sleep(0.1)
            found = subprocess.run(
                ["pgrep", "-f", "^ray::_work", "-s", "0"], capture_output=True, text=True, check=False
            )
            for number in found.stdout.split()[:1]:
                os.kill(int(number), signal.SIGKILL)
                killed.append(number)

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    with on_cluster("local:2"):
        threading.Thread(target=kill, daemon=True).start()
        collect(SMALL, tmp_path / "two", console=console, simulate=slow_trial)
    assert killed
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
