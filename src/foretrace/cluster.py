"""A Ray cluster that runs jobs: connects to it, hands jobs out, and repeats those whose process or machine has died.

What travels is small: jobs go out, names and numbers come back. Files are written by the jobs themselves, into a folder
that every node has at the same place.
"""

import os
import platform
import re
import signal
import socket
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from foretrace.errors import ForetraceError, counted, is_whole, shown
from foretrace.extras import named_extras
from foretrace.files import versions_of

MOST_LOCAL = 1024
LOCAL, CLIENT = "local:", "ray://"
ADDRESSES = "give HOST:PORT, ray://HOST:PORT, or local:N for N processes of this machine"
REACHED_WITHIN = 5.0
"""Time in which a cluster must answer [s]."""
LOOK_PERIOD = 2.0
"""Time between two looks at the nodes [s]."""
DEAD = 20.0
"""Time for which the head node may not answer before the work is given up [s]."""
DESERTED = 120.0
"""Time for which a cluster may be without any node before the work is given up [s]."""
MOST_DEATHS = 10
"""Processes that may die on one job."""
MOST_SKEW = 3600.0
"""Difference of two clocks that is accepted [s]; drafts of a day ago count as left behind, by any machine's clock."""
GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(3) + b"\x04" + bytes(5)
"""Beginning of a connection in HTTP/2, as gRPC has it, with empty settings (RFC 9113, section 3.4)."""
SETTINGS_TYPE = slice(3, 4), b"\x04"
"""Where an answer says what it is, and what a server of HTTP/2 says first."""
STORE_BYTES = 80 * 2**20
"""Shared memory of a cluster of this machine alone; Ray takes no less than 75 MB."""
VARIABLES = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_DEDUP_LOGS": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",
}
"""Variables of the environment that keep Ray from reporting to its makers and from talking, and give the processes that
it begins here the priority of local ones."""
LACKING = re.compile(r"No module named '([^']+)'")
"""What Python says on a node where something is not installed."""
TOKENS = ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


class Cluster:
    """A connection to a Ray cluster; a context manager.

    Args:
        address: ``HOST:PORT`` of a cluster that this machine belongs to, ``ray://HOST:PORT`` of one that it does not
            belong to, or ``local:N``, which begins N processes on this machine.

    Raises:
        ForetraceError: There is no such cluster, it does not answer, or Ray is not installed.
    """

    def __init__(self, address: str):
        self.address = address
        self.died = 0
        """Jobs that were handed out again, because their process or machine had died."""
        self._ray, self._head = _connect(address)
        self._looked, self._answered = 0.0, time.monotonic()
        self._inhabited = self._answered
        self.nodes = self.cpus = 0
        self._look()
        self._cpus_at_first = self.cpus

    def __enter__(self) -> "Cluster":
        return self

    def __exit__(self, *exception: Any) -> None:
        if self._answered == self._looked:  # it would wait for one that is gone
            self._ray.shutdown()

    def __str__(self) -> str:
        repeated = f", {self.died} repeated" if self.died else ""
        return f"{counted(self.nodes, 'node')}{repeated}"

    def run(
        self,
        function: Callable[[Any], Any],
        jobs: Sequence[Any],
        workers: int,
        *,
        error: type[ForetraceError],
        threads: int = 1,
        ordered: bool = False,
        ahead: int = 2,
    ) -> Generator[Any, None, None]:
        """Results of a function over many jobs; arguments and errors as of `foretrace.workers.run_jobs`.

        With as many workers as the cluster had processors, processors that are added later work, too.
        """
        ray = self._ray
        task = ray.remote(_work).options(num_cpus=threads, max_retries=0)
        sent = ray.put(function)
        here = Path.cwd()
        waiting, deaths = deque(range(len(jobs))), Counter[int]()
        running: dict[Any, int] = {}
        early: dict[int, Any] = {}
        next_one = 0
        try:
            while waiting or running:
                self._look()
                if self._looked - self._answered > DEAD:
                    raise ConnectionError
                if time.monotonic() - self._inhabited > DESERTED:
                    raise error(
                        f"{self.address} has had no node for {DESERTED:.0f} s; finished work is kept: add nodes "
                        "(ray start --address), and repeat the command"
                    )
                most = workers if workers < self._cpus_at_first else ahead * max(1, self.cpus // threads)
                while waiting and len(running) < most:
                    number = waiting.popleft()
                    running[task.remote(sent, jobs[number], here, _versions(), time.time())] = number
                for ref in self._finished(list(running)):
                    number = running.pop(ref)
                    try:
                        result = _opened(ray.get(ref), error)
                    except _deaths(ray) as reason:
                        deaths[number] += 1
                        self.died += 1
                        if deaths[number] == MOST_DEATHS:
                            raise error(
                                f"{MOST_DEATHS} processes have died on the same job, perhaps for lack of memory; "
                                "finished work is kept: repeat the command with fewer workers on each node"
                            ) from reason
                        waiting.appendleft(number)
                        continue
                    except ray.exceptions.RayTaskError as reason:
                        if lacking := LACKING.search(str(reason)):
                            raise error(
                                f"a node lacks the Python module {lacking[1]}: install foretrace, with the same "
                                "extras, on every node, and start Ray from that environment"
                            ) from None
                        raise
                    if not ordered:
                        yield result
                        continue
                    early[number] = result
                    while next_one in early:
                        yield early.pop(next_one)
                        next_one += 1
        except ConnectionError:
            self._answered = -DEAD
            remedy = "look whether its head node runs (`ray status`), and repeat the command"
            raise error(f"cluster {self.address} answers no more; finished work is kept: {remedy}") from None
        finally:
            if self._answered == self._looked:
                with suppress(Exception):  # it may be gone since
                    for ref in running:
                        ray.cancel(ref, force=True)

    def _finished(self, running: list[Any]) -> list[Any]:
        """Those that are done, as soon as one is; none after a while."""
        if self._ray.wait(running, num_returns=1, timeout=LOOK_PERIOD, fetch_local=False)[0]:
            return self._ray.wait(running, num_returns=len(running), timeout=0, fetch_local=False)[0]
        return []

    def _look(self) -> None:
        """Count nodes and processors, now and then."""
        if time.monotonic() - self._looked < LOOK_PERIOD and self._looked:
            return
        self._looked = time.monotonic()
        with suppress(OSError):  # a dead one would hold up Ray for a minute, and end this process
            socket.create_connection(self._head, REACHED_WITHIN).close()
            self._answered = self._looked
        if self._answered < self._looked:
            return
        alive = [node for node in self._ray.nodes() if node["Alive"]]
        self.nodes, self.cpus = len(alive), int(sum(node["Resources"].get("CPU", 0) for node in alive))
        if self.cpus:
            self._inhabited = self._looked


def _connect(address: str) -> tuple[Any, tuple[str, int]]:
    """Ray, connected, and where its head node answers.

    Raises:
        ForetraceError: As of `Cluster`.
    """
    own, where = address.startswith(LOCAL), address.removeprefix(CLIENT)
    host, colon, port = where.rpartition(":")
    whole = port.isdecimal() and is_whole(int(port), 1, MOST_LOCAL if own else 65535)
    if own and not whole:
        raise ForetraceError(f"cluster {shown(address)}: give {LOCAL}N with N from 1 to {MOST_LOCAL}")
    if not colon or not whole or "/" in host:
        raise ForetraceError(f"cluster {shown(address)}: {ADDRESSES}")
    os.environ.update({name: value for name, value in VARIABLES.items() if name not in os.environ})
    if not own:
        _reach(host.strip("[]"), int(port), address)
        os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "1")  # of 40 s each, where the head ends right now
        has_token = (
            any(os.environ.get(name) for name in TOKENS) or (Path.home() / ".ray/auth_token").is_file()
        )
        if has_token:  # which Ray reads, but does not send unless told to
            os.environ.setdefault("RAY_AUTH_MODE", "token")
    with named_extras():
        import ray
        from ray._private import worker
    # Ray would print pages about each process that dies to standard output; there is no setting for it.
    worker.print_worker_logs = lambda *_: None
    settings: dict[str, Any] = {"address": address, "log_to_driver": False, "logging_level": "critical"}
    if own:
        resources = {"num_cpus": int(port), "object_store_memory": STORE_BYTES, "include_dashboard": False}
        settings |= resources | {"address": "local"}
    with _own_signals(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            ray.init(**settings)
        except Exception as reason:  # Ray has many kinds, of which some are RuntimeErrors
            cause = next((line for line in str(reason).splitlines() if line.strip()), type(reason).__name__)
            remedy = (
                "give fewer processes, or leave --cluster out"
                if own
                else f"check that Ray {ray.__version__} runs there (`ray status`), and that this machine belongs to it "
                "or the address begins with ray://"
            )
            raise ForetraceError(f"cluster {address} cannot be used ({cause.strip()}): {remedy}") from reason
    if not own:
        return ray, (host.strip("[]"), int(port))
    host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
    return ray, (host, int(port))


def _reach(host: str, port: int, address: str) -> None:
    """Look for a server that may be Ray's: Ray itself would look for minutes."""
    try:
        with socket.create_connection((host, port), REACHED_WITHIN) as connection:
            connection.settimeout(REACHED_WITHIN)
            connection.sendall(GREETING)
            place, wanted = SETTINGS_TYPE
            problem = "" if connection.recv(9)[place] == wanted else "another server answers there"
    except OSError as reason:
        problem = reason.strerror or str(reason)
    if problem:
        remedy = f"start it with `ray start --head`, or {ADDRESSES}"
        raise ForetraceError(f"cluster {address} cannot be reached ({problem}): {remedy}")


@contextmanager
def _own_signals() -> Generator[None, None, None]:
    """Leave the answers to signals as they are, which Ray would change."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        with suppress(ValueError):  # not the main thread, where Ray changes none
            signal.signal(signal.SIGTERM, before)


@lru_cache(maxsize=1)
def _versions() -> dict[str, str]:
    """What must be the same on all nodes, so that each job has the same result on any of them."""
    from foretrace.interactions.storage import FORMAT_VERSION

    return {
        **versions_of("foretrace", "numpy", "pyarrow", "mujoco", "pybullet", "torch"),
        "data set format": str(FORMAT_VERSION),
        "processor": platform.machine(),
    }


def _work(
    function: Callable[[Any], Any], job: Any, folder: Path, versions: dict[str, str], sent: float
) -> tuple[str, Any, float]:
    """Carry out a job on whatever node; what it ends with: ``result``, ``error`` or ``refusal``, of what, and when."""
    node = platform.node()
    for name, wanted in versions.items():
        if (found := _versions().get(name)) != wanted:
            text = f"node {node} has {name} {found}, this machine {wanted}: install the same on every node"
            return "refusal", text, time.time()
    if time.time() < sent - MOST_SKEW:
        return "refusal", _skewed(f"node {node}", sent - time.time(), "behind"), time.time()
    try:
        os.chdir(folder)
    except OSError as reason:
        text = f"node {node} has no folder {folder} ({reason.strerror}): share it, at the same place on every node"
        return "refusal", text, time.time()
    try:
        return "result", function(job), time.time()
    except ForetraceError as reason:
        return "error", reason, time.time()
    except OSError as reason:
        where = f" at {reason.filename}" if reason.filename else ""
        text = f"node {node}: {reason.strerror or reason}{where}; finished work is kept: mend it, repeat the command"
        return "refusal", text, time.time()


def _skewed(who: str, seconds: float, way: str) -> str:
    return f"the clock of {who} is {seconds / 3600:.1f} h {way} this machine's: set both, as with NTP"


def _opened(answer: tuple[str, Any, float], error: type[ForetraceError]) -> Any:
    """The result of a job.

    Raises:
        ForetraceError: It has none.
    """
    kind, content, finished = answer
    if kind == "error":
        raise content
    if kind == "result" and finished > time.time() + MOST_SKEW:
        kind, content = "refusal", _skewed("a node", finished - time.time(), "ahead of")
    if kind == "refusal":
        raise error(content)
    return content


def _deaths(ray: Any) -> tuple[type[Exception], ...]:
    """Errors after which a job is handed out again: its process or machine is gone, and perhaps its result."""
    names = (
        "WorkerCrashedError",
        "NodeDiedError",
        "OutOfMemoryError",
        "ObjectLostError",
        "LocalRayletDiedError",
    )
    return tuple(getattr(ray.exceptions, name) for name in names)
