"""Many lever-ups into one data set: in parallel, reproducibly, and so that no crash destroys what is done.

Every object is levered at two points of each edge (paper, section 4), or of what counts as one; a recipe says which
objects. Trial ``id`` of a configuration is always the same object, action and seed, whoever simulates it and in
whatever order.
"""

import platform
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rich.console import Console

from foretrace.actions import Action, LeverUp, Screwdriver, ToolPath
from foretrace.errors import DatasetError, ForetraceError, SimulationError, check_type, is_whole, shown
from foretrace.files import (
    as_json,
    first_difference,
    first_stranger,
    make_folder,
    remove_partial,
    sole_writer,
    versions_of,
)
from foretrace.interactions import storage
from foretrace.interactions.dataset import count_outcomes
from foretrace.interactions.record import Interaction
from foretrace.interactions.shards import write_shard
from foretrace.objects import ObjectModel
from foretrace.simulation import lever_up, recipes
from foretrace.simulation.engine import ENGINES
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.randomisation import NOTHING, Randomisation
from foretrace.simulation.recipes import RECIPES
from foretrace.urls import Url, as_place, names_in
from foretrace.workers import ProgressReport, count_workers, run_jobs, uses_cluster

MOST = 1_000_000
"""Objects, and contacts at each edge, that a data set may have."""
SHARD_SIZE = 100
"""Interactions in one file."""
CHUNK_SIZE = 10
"""Interactions that a local worker hands over at once; those of a cluster write whole shards themselves."""
MANIFEST_PERIOD = 1.0
"""Seconds between two updates of the manifest: of shards that are written in between, a crash loses the checksum."""
MANIFEST_SHARE = 20.0
"""Its period, at least, in times that an update takes: a large manifest does not hold up those who wait for work."""
RANDOMISATION_STREAM = 2
"""Tells the random numbers of what varies from those of objects, contact points and cameras."""


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
    """Kind of objects. paper: prisms. solids: lying cylinders, boxes and flat prisms, always three with one outline.
    mixed: prisms and solids. everyday: the same with prisms of many sizes, and flat objects with round, organic and
    dented outlines. all: everyday and the paper's prisms. pushes: plates that a rod pushes (--embodiment tool). Other
    packages may add objects and actions of their own."""
    randomisation: Randomisation = NOTHING
    """What is drawn anew for every lever-up."""
    path: ToolPath = field(default_factory=ToolPath)
    """Path of the blade in lever-ups."""
    tool: Screwdriver = field(default_factory=Screwdriver)
    """The screwdriver."""
    trials: tuple[int, ...] = ()
    """Trials to simulate, by their numbers among all that the other settings ask for, in this order; by default all.
    A data set may be extended by more of them later, in whole shards."""

    def __post_init__(self) -> None:
        for name, least, most in (
            ("objects", 1, MOST),
            ("contacts_per_edge", 1, MOST),
            ("seed", 0, 2**63 - 1),
        ):
            value = getattr(self, name)
            if not is_whole(value, least, most):
                raise SimulationError(f"{name} is {shown(value)}: give a whole number from {least} to {most}")
        kinds = {"simulation": SimulationConfig, "path": ToolPath, "randomisation": Randomisation}
        for name, kind in (kinds | {"recipe": str, "tool": Screwdriver}).items():
            check_type(name, getattr(self, name), kind, SimulationError)
        RECIPES.find(self.recipe)
        check_type("trials", self.trials, Sequence, SimulationError, "a list of numbers")
        object.__setattr__(self, "trials", tuple(self.trials))
        most = _first_actions(self.recipe, self.objects, self.contacts_per_edge)[-1] - 1 if self.trials else 0
        for number in self.trials:
            if not is_whole(number, 0, most):
                raise SimulationError(
                    f"there is no trial {shown(number)}: this configuration has 0 to {most}"
                )
        if len(set(self.trials)) < len(self.trials):
            twice = next(number for number, count in Counter(self.trials).items() if count > 1)
            raise SimulationError(f"trial {twice} is named twice: name each once")


def num_trials(config: CollectConfig) -> int:
    """Number of lever-ups that the configuration asks for; 2080 for the paper's 160 objects."""
    return len(config.trials) or _first_actions(config.recipe, config.objects, config.contacts_per_edge)[-1]


def trial(config: CollectConfig, id: int) -> tuple[ObjectModel, Action, int]:
    """Object, action and simulation seed of one trial, before anything is varied.

    Raises:
        SimulationError: The configuration has no such trial.
    """
    if not 0 <= id < num_trials(config):
        raise SimulationError(f"there is no trial {id}: this configuration has 0 to {num_trials(config) - 1}")
    object_index, contact_index = _locate(config, id)
    obj, actions = _object_and_actions(config.recipe, config.seed, object_index, config.contacts_per_edge)
    seed = np.random.SeedSequence([config.seed, object_index, contact_index]).generate_state(1)[0]
    action = actions[contact_index]
    if isinstance(action, LeverUp):
        action = replace(action, path=config.path, tool=config.tool)
    elif config.path != ToolPath():
        given = next(name for name, value in vars(config.path).items() if value != getattr(ToolPath(), name))
        raise SimulationError(
            f"{given} = {getattr(config.path, given)!r} is of a lever-up's path, and recipe {config.recipe!r} has a "
            f"{action.label}: leave it out"
        )
    return obj, action, int(seed)


def planned_trial(config: CollectConfig, id: int) -> lever_up.Trial:
    """One trial with everything that varies, ready to be simulated."""
    obj, action, seed = trial(config, id)
    if config.randomisation == NOTHING:
        return lever_up.Trial(obj, action, config.simulation, seed, id)
    rng = np.random.default_rng(
        np.random.SeedSequence([config.seed, *_locate(config, id), RANDOMISATION_STREAM])
    )
    obj, physics, path, error = config.randomisation.vary(obj, config.simulation.physics, action.path, rng)
    simulation = replace(config.simulation, physics=physics)
    return lever_up.Trial(obj, replace(action, path=path), simulation, seed, id, error)


def simulate_trial(config: CollectConfig, id: int) -> Interaction:
    """Simulate one trial, alone; the same interaction as in the data set of that configuration."""
    return lever_up.simulate_trials([planned_trial(config, id)])[0]


def _locate(config: CollectConfig, id: int) -> tuple[int, int]:
    """Which object a trial levers, and at which of its contact points."""
    id = config.trials[id] if config.trials else id
    firsts = _first_actions(config.recipe, config.objects, config.contacts_per_edge)
    object_index = bisect_right(firsts, id) - 1
    return object_index, id - firsts[object_index]


_first_actions = lru_cache(maxsize=4)(recipes.first_actions)
_object_and_actions = lru_cache(maxsize=64)(recipes.object_and_actions)


def collect(
    config: CollectConfig,
    out: str | Path | Url,
    workers: int | None = None,
    console: Console | None = None,
    simulate: Callable[[CollectConfig, int], Interaction] = simulate_trial,
) -> dict[str, int]:
    """Simulate all trials of a configuration into a folder; goes on where an earlier call stopped.

    Args:
        config: What to simulate.
        out: The data set's folder, or its URL.
        workers: Processes, by default one for each core. Their number does not change the data.
        console: Where progress is reported; standard error by default.
        simulate: Makes one interaction from a configuration and an id.

    Returns:
        How often each outcome occurs in the whole data set.

    Raises:
        DatasetError: The folder holds something else, or a data set of another configuration.
        SimulationError: A trial could not be simulated at all.
    """
    check_type("config", config, CollectConfig, SimulationError)
    out, console = as_place(out, DatasetError), console or Console(stderr=True)
    workers = count_workers(workers, SimulationError)
    _prepare_folder(out)
    # A store has no locks: two commands there do the same work twice, with the same bytes.
    with nullcontext() if isinstance(out, Url) else sole_writer(out, DatasetError):
        manifest = _open_manifest(config, out, console)
        counts, todo = _take_stock(out, manifest, console)
        with ProgressReport("interactions", manifest["num_trials"], counts.total(), console) as report:
            make = _simulate_on_cluster if uses_cluster() else _simulate_shards
            due = time.monotonic() + MANIFEST_PERIOD
            try:
                for name, entry in make(config, out, todo, workers, simulate, counts, report):
                    manifest["shards"][name] = entry
                    if (begun := time.monotonic()) > due:
                        storage.write_manifest(out, manifest)
                        took = time.monotonic() - begun
                        due = begun + max(MANIFEST_PERIOD, MANIFEST_SHARE * took)
            finally:
                storage.write_manifest(out, manifest)
    return count_outcomes(counts)


def _prepare_folder(out: Path | Url) -> None:
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file; choose a folder for the data set")
    if not (out / storage.MANIFEST).exists() and (stranger := first_stranger(out, (storage.SHARD_FOLDER,))):
        raise DatasetError(f"{out} holds {stranger} and is no data set; choose a new folder")
    if isinstance(out, Path):
        make_folder(out / storage.SHARD_FOLDER, DatasetError)


def _open_manifest(config: CollectConfig, out: Path | Url, console: Console) -> dict[str, Any]:
    """The manifest in the folder, checked against the configuration; a new one in an empty folder."""
    wanted = as_json(asdict(config))
    if not config.trials:
        del wanted["trials"]  # as of data sets that are older than this setting
    if not (out / storage.MANIFEST).exists():
        manifest = storage.new_manifest(wanted, num_trials(config), SHARD_SIZE, _current_versions(config))
        storage.write_manifest(out, manifest)
        return manifest
    manifest = storage.read_manifest(out)
    _extend(manifest, wanted)
    if made := manifest["configuration"].get("made"):
        command = storage.COMMANDS.get(str(made.get("how")), "")
        raise DatasetError(
            f"{out} holds a data set that `foretrace data {command}` made: choose another folder"
        )
    found = {**manifest["configuration"], "shard_size": manifest["shard_size"]}
    if different := first_difference(found, {**wanted, "shard_size": SHARD_SIZE}):
        name, was, asked = (shown(each) if isinstance(each, list) else each for each in different)
        raise DatasetError(
            f"{out} was begun with {name} = {was}, asked for is {name} = {asked}; "
            "use the same configuration to go on, or another folder"
        )
    now, then = _current_versions(config), manifest["versions"]
    if changed := [f"{k} {now[k]} (was {then.get(k, 'not noted')})" for k in now if now[k] != then.get(k)]:
        _say(console, f"warning: numbers may change within {out}, versions have: {', '.join(changed)}")
    return manifest


def _extend(manifest: dict[str, Any], wanted: Mapping[str, Any]) -> None:
    """Let a data set of some trials go on with more of them, after whole shards."""
    named, asked = manifest["configuration"].get("trials", ()), wanted.get("trials", ())
    if named and len(named) % SHARD_SIZE == 0 and asked[: len(named)] == named:
        manifest["configuration"]["trials"], manifest["num_trials"] = asked, len(asked)


def _current_versions(config: CollectConfig) -> dict[str, str]:
    library = ENGINES.find(config.simulation.engine).library
    libraries = versions_of("foretrace", library, "numpy", "pyarrow")
    return {"python": platform.python_version(), "machine": platform.machine(), **libraries}


def _take_stock(
    out: Path | Url, manifest: dict[str, Any], console: Console
) -> tuple[Counter[str], dict[str, range]]:
    """Outcomes of the shards that are done, and the ids of those that are not.

    A shard without a checksum (the crash came before the manifest's update) is kept if it is whole.
    """
    if isinstance(out, Path):
        for folder in (out, out / storage.SHARD_FOLDER):
            remove_partial(folder, everywhere=uses_cluster())
    there = set(names_in(out / storage.SHARD_FOLDER))
    counts: Counter[str] = Counter()
    todo: dict[str, range] = {}
    total, size = manifest["num_trials"], manifest["shard_size"]
    for index, start in enumerate(range(0, total, size)):
        name, ids = storage.shard_name(index), range(start, min(start + size, total))
        entry = manifest["shards"].pop(name, None)
        if entry is None and name.rpartition("/")[2] not in there:
            todo[name] = ids
            continue
        try:
            known = (entry or {}).get("sha256")
            columns = ["id", "outcome"] if known else None  # a checksum vouches for the others
            table, content = storage.read_shard(out, name, known, columns=columns)
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
    out: Path | Url,
    todo: dict[str, range],
    workers: int,
    simulate: Callable[[CollectConfig, int], Interaction],
    counts: Counter[str],
    report: ProgressReport,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Names and entries of the shards to do, each written as soon as all of its chunks are there."""
    at_once = _at_once(config, simulate)
    size = min(max(at_once, CHUNK_SIZE), SHARD_SIZE)
    chunks = [(name, ids[k : k + size]) for name, ids in todo.items() for k in range(0, len(ids), size)]
    per_job = max(1, at_once // size)
    jobs = [chunks[k : k + per_job] for k in range(0, len(chunks), per_job)]
    parts: dict[str, list[pa.Table]] = {name: [] for name in todo}
    function = partial(_simulate_chunks, simulate, config)
    for made in run_jobs(function, jobs, workers, error=SimulationError):
        for name, table in made:
            _count(Counter(table["outcome"].to_pylist()), counts, report)
            parts[name].append(table)
            if sum(part.num_rows for part in parts[name]) == len(todo[name]):
                whole = pa.concat_tables(sorted(parts.pop(name), key=_first_id))
                yield name, write_shard(out, name, whole)


def _simulate_on_cluster(
    config: CollectConfig,
    out: Path | Url,
    todo: dict[str, range],
    workers: int,
    simulate: Callable[[CollectConfig, int], Interaction],
    counts: Counter[str],
    report: ProgressReport,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Names and entries of the shards to do, each written by the node that simulates it."""
    function = partial(_simulate_shard, simulate, config, out)
    for name, entry, found in run_jobs(function, list(todo.items()), workers, error=SimulationError):
        _count(found, counts, report)
        yield name, entry
    if isinstance(out, Path):
        remove_partial(out / storage.SHARD_FOLDER, everywhere=True)  # of processes that were killed


def _count(found: Counter[str], counts: Counter[str], report: ProgressReport) -> None:
    counts.update(found)
    report.add(found.total(), ", ".join(f"{count} {outcome}" for outcome, count in counts.most_common()))


def _first_id(table: pa.Table) -> int:
    return table["id"][0].as_py()


def _at_once(config: CollectConfig, simulate: Callable[[CollectConfig, int], Interaction]) -> int:
    """How many trials to hand to the engine in one call."""
    return ENGINES.find(config.simulation.engine).at_once if simulate is simulate_trial else 1


def _simulate_chunks(
    simulate: Callable[[CollectConfig, int], Interaction],
    config: CollectConfig,
    chunks: Sequence[tuple[str, range]],
) -> list[tuple[str, pa.Table]]:
    """Some trials of each of some shards."""
    if _at_once(config, simulate) > 1:
        ids = [id for _, some in chunks for id in some]
        try:
            made = iter(lever_up.simulate_trials([planned_trial(config, id) for id in ids]))
        except ForetraceError as error:
            raise SimulationError(f"trials {ids[0]} to {ids[-1]} cannot be simulated: {error}") from error
    else:
        made = (_simulate_one(simulate, config, id) for _, some in chunks for id in some)
    return [
        (
            name,
            storage.to_table([storage.encode(next(made), object_id=_locate(config, id)[0]) for id in some]),
        )
        for name, some in chunks
    ]


def _simulate_one(
    simulate: Callable[[CollectConfig, int], Interaction], config: CollectConfig, id: int
) -> Interaction:
    try:
        return simulate(config, id)
    except ForetraceError as error:
        raise SimulationError(f"trial {id} cannot be simulated: {error}") from error


def _simulate_shard(
    simulate: Callable[[CollectConfig, int], Interaction],
    config: CollectConfig,
    out: Path | Url,
    shard: tuple[str, range],
) -> tuple[str, dict[str, Any], Counter[str]]:
    """All trials of a shard, into its file; its name and entry, and how often each outcome occurs."""
    try:
        seen = (out / storage.MANIFEST).is_file()
    except DatasetError as error:
        raise SimulationError(f"node {platform.node()}: {error}") from error
    if not seen:
        raise SimulationError(
            f"node {platform.node()} does not see {out / storage.MANIFEST}: give a folder that all share, or a URL"
        )
    ((name, table),) = _simulate_chunks(simulate, config, [shard])
    return name, write_shard(out, name, table), Counter(table["outcome"].to_pylist())


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)
