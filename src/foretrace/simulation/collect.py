"""Many lever-ups into one data set: in parallel, reproducibly, and so that no crash destroys what is done.

Every object is levered at two points of each edge (paper, section 4), or of what counts as one; a recipe says which
objects. Trial ``id`` of a configuration is always the same object, action and seed, whoever simulates it and in
whatever order.
"""

import json
import os
import platform
import signal
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from importlib.metadata import version
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, cast

import joblib
import numpy as np
import pyarrow as pa
from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from foretrace.actions import LeverUp
from foretrace.errors import DatasetError, ForetraceError, SimulationError
from foretrace.interactions import storage
from foretrace.interactions.record import Interaction, Outcome, Physics
from foretrace.objects import ObjectModel
from foretrace.simulation import lever_up, recipes
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.randomisation import NOTHING, Randomisation
from foretrace.simulation.recipes import RECIPES

MOST = 1_000_000
"""Objects, and contacts at each edge, that a data set may have."""
SHARD_SIZE = 100
"""Interactions in one file."""
CHUNK_SIZE = 10
"""Interactions that a worker hands over at once."""
RANDOMISATION_STREAM = 2
"""Tells the random numbers of what varies from those of objects, contact points and cameras."""
PLAIN_REPORT_PERIOD = 10.0
"""Seconds between two lines of progress where there is no terminal."""


@dataclass(frozen=True)
class CollectConfig:
    """Everything that decides what is in a data set."""

    objects: int = 160
    """Number of objects; the paper has 160, spread evenly over 3 to 10 corners."""
    contacts_per_edge: int = 2
    """Lever-ups at each edge of each object; round outlines have as many as four edges."""
    seed: int = 0
    """Seed of the objects, the contact points and the simulations."""
    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    """How each lever-up is simulated."""
    recipe: str = "paper"
    """Which objects: one of RECIPES."""
    randomisation: Randomisation = NOTHING
    """What is drawn anew for every lever-up."""

    def __post_init__(self) -> None:
        for name in ("objects", "contacts_per_edge"):
            if not 1 <= getattr(self, name) <= MOST:
                raise SimulationError(f"{name} is {getattr(self, name)}: give a number from 1 to {MOST}")
        if self.seed < 0:
            raise SimulationError(f"seed is {self.seed}, it must not be negative")
        if self.recipe not in RECIPES:
            raise SimulationError(f"recipe {self.recipe!r} is unknown: choose one of {', '.join(RECIPES)}")


SETTINGS_SINCE: dict[str, Any] = {
    "recipe": "paper",
    "simulation.watch_time": 0.0,
    "simulation.physics.rolling_friction": Physics.rolling_friction,
    "simulation.physics.table_edge": None,
    **{f"randomisation.{name}": value for name, value in asdict(NOTHING).items()},
}
"""Settings that older data sets do not name, and what they were in effect."""


def num_trials(config: CollectConfig) -> int:
    """How many lever-ups the configuration asks for; 2080 for the paper's 160 objects."""
    return _first_contacts(config.recipe, config.objects, config.contacts_per_edge)[-1]


def trial(config: CollectConfig, id: int) -> tuple[ObjectModel, LeverUp, int]:
    """Object, action and simulation seed of one trial, before anything is varied.

    Raises:
        SimulationError: The configuration has no such trial.
    """
    if not 0 <= id < num_trials(config):
        raise SimulationError(f"there is no trial {id}: this configuration has 0 to {num_trials(config) - 1}")
    object_index, contact_index = _locate(config, id)
    obj, actions = _object_and_actions(config.recipe, config.seed, object_index, config.contacts_per_edge)
    seed = np.random.SeedSequence([config.seed, object_index, contact_index]).generate_state(1)[0]
    return obj, actions[contact_index], int(seed)


def simulate_trial(config: CollectConfig, id: int) -> Interaction:
    """Simulate one trial, alone; the same interaction as in the data set of that configuration."""
    obj, action, seed = trial(config, id)
    if config.randomisation == NOTHING:
        return lever_up.simulate_lever_up(obj, action, config.simulation, seed=seed, id=id)
    rng = np.random.default_rng(
        np.random.SeedSequence([config.seed, *_locate(config, id), RANDOMISATION_STREAM])
    )
    physics, path = config.simulation.physics, config.simulation.path
    obj, physics, path, misplacement = config.randomisation.vary(obj, physics, path, rng)
    simulation = replace(config.simulation, physics=physics, path=path)
    return lever_up.simulate_lever_up(obj, action, simulation, seed=seed, id=id, misplacement=misplacement)


def _locate(config: CollectConfig, id: int) -> tuple[int, int]:
    """Which object a trial levers, and at which of its contact points."""
    firsts = _first_contacts(config.recipe, config.objects, config.contacts_per_edge)
    object_index = bisect_right(firsts, id) - 1
    return object_index, id - firsts[object_index]


_first_contacts = lru_cache(maxsize=4)(recipes.first_contacts)
_object_and_actions = lru_cache(maxsize=64)(recipes.object_and_actions)


def collect(
    config: CollectConfig,
    out: str | Path,
    workers: int | None = None,
    console: Console | None = None,
    simulate: Callable[[CollectConfig, int], Interaction] = simulate_trial,
) -> dict[str, int]:
    """Simulate all trials of a configuration into a folder; goes on where an earlier call stopped.

    Args:
        config: What to simulate.
        out: The data set's folder.
        workers: Processes, by default one for each core. Their number does not change the data.
        console: Where progress is reported; standard error by default.
        simulate: Makes one interaction from a configuration and an id.

    Returns:
        How often each outcome occurs in the whole data set.

    Raises:
        DatasetError: The folder holds something else, or a data set of another configuration.
        SimulationError: A trial could not be simulated at all.
    """
    out, console = Path(out), console or Console(stderr=True)
    workers = joblib.cpu_count() if workers is None else workers
    if workers < 1:
        raise SimulationError(f"workers is {workers}, it must be at least 1")
    _prepare_folder(out)
    with storage.sole_writer(out):
        manifest = _open_manifest(config, out, console)
        counts, todo = _take_stock(out, manifest, console)
        with _Report(console, manifest["num_trials"], counts) as report:
            for name, table in _simulate_shards(config, todo, workers, simulate, report):
                manifest["shards"][name] = storage.write_shard(out, name, table)
                storage.write_manifest(out, manifest)
    return {str(outcome): counts[outcome] for outcome in Outcome if counts[outcome]}


def _prepare_folder(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file; choose a folder for the data set")
    if out.is_dir() and not (out / storage.MANIFEST).exists():
        own = (storage.LOCK, storage.SHARD_FOLDER, storage.MANIFEST)
        strangers = sorted(entry.name for entry in out.iterdir() if not entry.name.startswith(own))
        if strangers:
            raise DatasetError(f"{out} holds {strangers[0]} and is no data set; choose a new folder")
    (out / storage.SHARD_FOLDER).mkdir(parents=True, exist_ok=True)


def _open_manifest(config: CollectConfig, out: Path, console: Console) -> dict[str, Any]:
    """The manifest in the folder, checked against the configuration; a new one in an empty folder."""
    wanted = json.loads(json.dumps(asdict(config)))
    if not (out / storage.MANIFEST).exists():
        manifest = storage.new_manifest(wanted, num_trials(config), SHARD_SIZE, _current_versions(config))
        storage.write_manifest(out, manifest)
        return manifest
    manifest = storage.read_manifest(out)
    found = {**SETTINGS_SINCE, **_flat(manifest["configuration"]), "shard_size": manifest["shard_size"]}
    asked = {**_flat(wanted), "shard_size": SHARD_SIZE}
    for name in sorted(found.keys() | asked.keys()):
        if found.get(name) != asked.get(name):
            raise DatasetError(
                f"{out} was begun with {name} = {found.get(name)}, asked for is {name} = {asked.get(name)}; "
                "use the same configuration to go on, or another folder"
            )
    now, then = _current_versions(config), manifest["versions"]
    if changed := [f"{k} {now[k]} (was {then.get(k, 'not noted')})" for k in now if now[k] != then.get(k)]:
        _say(console, f"warning: numbers may change within {out}, versions have: {', '.join(changed)}")
    return manifest


def _flat(nested: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one level, names joined by dots."""
    flat = {}
    for name, value in nested.items():
        inner = _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
        flat.update(inner)
    return flat


def _current_versions(config: CollectConfig) -> dict[str, str]:
    simulation = config.simulation
    engine = lever_up.make_engine(
        simulation.engine, simulation.embodiment, simulation.timestep, simulation.sample_period
    )
    libraries = {name: version(name) for name in ("foretrace", engine.library, "numpy", "pyarrow")}
    return {"python": platform.python_version(), "machine": platform.machine(), **libraries}


def _take_stock(
    out: Path, manifest: dict[str, Any], console: Console
) -> tuple[Counter[str], dict[str, range]]:
    """Outcomes of the shards that are done, and the ids of those that are not.

    A shard without a checksum (the crash came before the manifest's update) is kept if it is whole.
    """
    for stray in [*out.glob("*.tmp"), *(out / storage.SHARD_FOLDER).glob("*.tmp")]:
        stray.unlink()
    counts: Counter[str] = Counter()
    todo: dict[str, range] = {}
    total, size = manifest["num_trials"], manifest["shard_size"]
    for index, start in enumerate(range(0, total, size)):
        name, ids = storage.shard_name(index), range(start, min(start + size, total))
        entry = manifest["shards"].pop(name, None)
        if entry is None and not (out / name).exists():
            todo[name] = ids
            continue
        try:
            table, content = storage.read_shard(out, name, entry and entry["sha256"])
            if table["id"].to_pylist() != list(ids):
                raise DatasetError(f"shard {out / name} does not hold interactions {ids[0]} to {ids[-1]}")
        except DatasetError as error:
            _say(console, f"{str(error).split(';')[0]}; making it again")
            todo[name] = ids
            continue
        manifest["shards"][name] = storage.shard_entry(content, table)
        counts.update(table["outcome"].to_pylist())
    storage.write_manifest(out, manifest)
    return counts, todo


def _simulate_shards(
    config: CollectConfig,
    todo: dict[str, range],
    workers: int,
    simulate: Callable[[CollectConfig, int], Interaction],
    report: "_Report",
) -> Iterator[tuple[str, pa.Table]]:
    """The shards to do, each as soon as all of its chunks are there."""
    chunks = [
        (name, ids[k : k + CHUNK_SIZE]) for name, ids in todo.items() for k in range(0, len(ids), CHUNK_SIZE)
    ]
    parts: dict[str, list[pa.Table]] = {name: [] for name in todo}
    with parallel_config("loky", n_jobs=max(1, min(workers, len(chunks))), inner_max_num_threads=1):
        jobs = [delayed(_simulate_chunk)(simulate, config, name, ids, os.getpid()) for name, ids in chunks]
        with ctrl_c_later():
            results = Parallel(return_as="generator_unordered")(jobs)
        tables = cast(Iterator[tuple[str, pa.Table]], results)
        try:
            for name, table in tables:
                report.add(table["outcome"].to_pylist())
                parts[name].append(table)
                if sum(part.num_rows for part in parts[name]) == len(todo[name]):
                    yield name, pa.concat_tables(sorted(parts.pop(name), key=_first_id))
        except TerminatedWorkerError as error:
            raise SimulationError(
                "a worker process was killed, perhaps for want of memory; what is done is kept: "
                f"repeat the command with fewer workers than {workers}"
            ) from error


@contextmanager
def ctrl_c_later() -> Iterator[None]:
    """Ctrl-C waits while workers are started, which inherit this and so never hear it, not even as they start."""
    if os.name != "posix":
        yield
        return
    resource_tracker.ensure_running()  # which would let Ctrl-C through again, were it started later
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _first_id(table: pa.Table) -> int:
    return table["id"][0].as_py()


def _simulate_chunk(
    simulate: Callable[[CollectConfig, int], Interaction],
    config: CollectConfig,
    name: str,
    ids: range,
    parent: int,
) -> tuple[str, pa.Table]:
    """Some trials of a shard, in a worker or (with one worker) in the parent itself."""
    in_worker = os.getpid() != parent
    if in_worker:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    rows = []
    for id in ids:
        if in_worker and os.getppid() != parent:
            os._exit(1)  # the parent was killed: nobody waits for this any more
        try:
            interaction = simulate(config, id)
        except ForetraceError as error:
            raise SimulationError(f"trial {id} cannot be simulated: {error}") from error
        rows.append(storage.encode(interaction, object_id=_locate(config, id)[0]))
    return name, storage.to_table(rows)


class _Report:
    """Progress on the console: a bar on a terminal, a line every ten seconds elsewhere."""

    def __init__(self, console: Console, total: int, counts: Counter[str]):
        self.counts = counts
        self._console, self._total = console, total
        self._done_before, self._begun = counts.total(), time.monotonic()
        self._last_line = self._begun
        self._progress = Progress(
            TextColumn("simulating"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.description}"),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("", total=total, completed=counts.total())

    def __enter__(self) -> "_Report":
        self._progress.start()
        if self._done_before:
            _say(self._console, f"{self._done_before} of {self._total} interactions are there already")
        return self

    def __exit__(self, *exception: object) -> None:
        self._progress.stop()

    def add(self, outcomes: list[str]) -> None:
        """Count finished interactions."""
        self.counts.update(outcomes)
        now, done = time.monotonic(), self.counts.total()
        rate = (done - self._done_before) / max(now - self._begun, 1e-9)
        table = ", ".join(f"{count} {outcome}" for outcome, count in self.counts.most_common())
        self._progress.update(self._task, completed=done, description=f"{rate:.1f}/s  {table}")
        if not self._console.is_terminal and now - self._last_line >= PLAIN_REPORT_PERIOD:
            self._last_line = now
            progress = f"{done} of {self._total} interactions, {rate:.1f}/s"
            _say(self._console, f"{progress}, {(self._total - done) / rate:.0f} s left: {table}")


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)
