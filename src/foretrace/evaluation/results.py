"""The results of many trainings on disk: one long table that only ever grows, by one trial at a time.

A results folder holds ``results.csv``, one row per number, and ``results.json``, which says what all of them have in
common: the data, the recipe, the version of foretrace; and on which machines they were computed.
"""

import json
import os
import platform
from collections.abc import Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

import pandas as pd
import torch

import foretrace
from foretrace.errors import DatasetError, ResultsError
from foretrace.files import flatten, sole_writer
from foretrace.files import write_bytes as write_atomically
from foretrace.predictor.run_folder import git_commit

FORMAT = "foretrace-results"
FORMAT_VERSION = 1
TABLE = "results.csv"
DESCRIPTION = "results.json"
COLUMNS = ("experiment", "features", "seed", "setting", "metric", "value")
LAST_METRIC = "seconds"
"""The last row of every trial: a trial without it was cut short by a crash."""


class Trial(NamedTuple):
    """One training and its test: the smallest piece of an experiment."""

    experiment: str
    """Which question it helps to answer."""
    features: str
    """What the predictor knows of the object."""
    seed: int
    """Seed of the split and of the training."""
    setting: str
    """What is varied in the experiment."""

    def __str__(self) -> str:
        return f"{self.experiment} {self.setting}, {self.features}, seed {self.seed}"


Metrics = dict[str, float]
"""What a trial found, by name."""


class ResultsTable:
    """A results folder that is being written; a context manager.

    Trials that a crash cut short are dropped when the folder is opened, and are then missing from `done`.

    Args:
        folder: The results folder; made if it is not there.
        identity: What decides the results beside a trial itself, JSON-able: the data's fingerprint, the recipe.
        machine: What they are computed on, for the record.

    Raises:
        ResultsError: The folder holds results of another identity, version of the format or of foretrace, its table is
            damaged, or another process writes to it.
    """

    def __init__(
        self, folder: str | Path, identity: Mapping[str, Any], machine: Mapping[str, Any] | None = None
    ):
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            try:
                stack.enter_context(sole_writer(self.folder, DatasetError))
            except DatasetError as error:
                raise ResultsError(str(error)) from None
            trials = finished_trials(self.folder, identity)
            self._description = _read_description(self.folder) or _describe(identity)
            self._description["machines"].append({**(machine or {}), "started": _now(), "hours": 0.0})
            self._begun = monotonic()
            self._write_description()
            _repair(self.folder / TABLE)
            self._file = stack.enter_context(open(self.folder / TABLE, "ab", buffering=0))
            self._done = trials
            self._stack = stack.pop_all()

    def __enter__(self) -> "ResultsTable":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the folder."""
        self._write_description()
        self._stack.close()

    def done(self) -> set[Trial]:
        """The trials that are finished."""
        return set(self._done)

    def append(self, trial: Trial, metrics: Mapping[str, float]) -> None:
        """Add a finished trial; it is on the disk when this returns.

        Args:
            trial: The trial.
            metrics: What it found, ``seconds`` among it.
        """
        content = _format({trial: metrics}).encode()
        if self._file.write(content) != len(content):
            raise ResultsError(f"{self.folder / TABLE} cannot grow: make room on the disk, and go on")
        os.fsync(self._file.fileno())
        self._done.add(trial)
        self._write_description()

    def _write_description(self) -> None:
        self._description["machines"][-1]["hours"] = round((monotonic() - self._begun) / 3600, 4)
        content = json.dumps(self._description, indent=1) + "\n"
        write_atomically(self.folder / DESCRIPTION, content.encode())


def read_results(folder: str | Path) -> pd.DataFrame:
    """The rows of all finished trials in a results folder, in the order in which they were finished.

    The folder may be written to at the same time.

    Args:
        folder: Where ``foretrace evaluate paper --out`` wrote to.

    Returns:
        Columns ``experiment``, ``features``, ``seed``, ``setting``, ``metric``, ``value``.

    Raises:
        ResultsError: There are no results, or they are damaged or of another version.
    """
    folder = Path(folder)
    if _read_description(folder) is None:
        raise ResultsError(
            f"{folder / DESCRIPTION} is missing: give a folder that `foretrace evaluate paper --out` has made"
        )
    rows = [
        (*trial, name, value) for trial, metrics in _read(folder).items() for name, value in metrics.items()
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype({"seed": int, "value": float})


def finished_trials(folder: str | Path, identity: Mapping[str, Any]) -> set[Trial]:
    """The trials that a results folder holds; none if it is empty or not there.

    Raises:
        ResultsError: They belong to another identity or version, or are damaged.
    """
    folder = Path(folder)
    description = _read_description(folder)
    if description is None:
        if (folder / TABLE).exists():
            raise ResultsError(
                f"{folder} has a {TABLE} and no {DESCRIPTION} that says what it is of: restore it, remove the folder, "
                "or choose another"
            )
        return set()
    found, wanted = (flatten(content["identity"]) for content in (description, _describe(identity)))
    for name in sorted(found.keys() | wanted.keys()):
        if found.get(name) != wanted.get(name):
            raise ResultsError(
                f"{folder} holds results with {name} = {found.get(name)!r}, asked for is {wanted.get(name)!r}: choose "
                "another folder, the same data and recipe, or remove the folder"
            )
    return set(_read(folder))


def describe_machine(device: str, workers: int, threads: int) -> dict[str, Any]:
    """What is computed on, for the record."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        models = [
            line.split(":")[1].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        cpu = models[0] if models else cpu
    if device == "cuda":
        device = torch.cuda.get_device_name()
    return {
        "cpu": cpu,
        "device": device,
        "workers": workers,
        "threads": threads,
        "torch": torch.__version__,
        "commit": git_commit(),
    }


def _describe(identity: Mapping[str, Any]) -> dict[str, Any]:
    whole = {"foretrace": foretrace.__version__, **identity}
    content = {"format": FORMAT, "version": FORMAT_VERSION, "identity": whole, "machines": []}
    return json.loads(json.dumps(content))


def _read_description(folder: Path) -> dict[str, Any] | None:
    """The contents of ``results.json``; None where there is none."""
    file = folder / DESCRIPTION
    if not file.is_file():
        return None
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ResultsError(f"{file} is not JSON ({error}): restore it, or remove the folder") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ResultsError(f"{file} does not describe {FORMAT}: choose another folder")
    if content.get("version") != FORMAT_VERSION:
        raise ResultsError(
            f"{file} has format version {content.get('version')!r}, this foretrace knows {FORMAT_VERSION}: use the "
            "foretrace that wrote it, or another folder"
        )
    return content


def _read(folder: Path) -> dict[Trial, Metrics]:
    """The finished trials of a table; what a crash left of the last one is passed over."""
    file = folder / TABLE
    if not file.is_file():
        return {}
    header, *lines = file.read_bytes().decode(errors="replace").split("\n")
    if header != ",".join(COLUMNS):
        missing = [name for name in COLUMNS if name not in header.split(",")]
        raise ResultsError(
            f"{file} begins with {header[:80]!r}"
            f"{', lacks ' + ', '.join(missing) if missing else ''}: its columns must be {', '.join(COLUMNS)}"
        )
    trials: dict[Trial, Metrics] = {}
    bad: int | None = None
    for number, line in enumerate(lines[:-1], 2):  # what follows the last line break is empty, or torn
        try:
            experiment, features, seed, setting, metric, text = line.split(",")
            trial, value = Trial(experiment, features, int(seed), setting), float(text)
        except ValueError:
            bad = number if bad is None else bad
            continue
        if bad is not None:
            raise ResultsError(
                f"{file}, line {bad} is no row of results: restore the file, or remove that line"
            )
        metrics = trials.setdefault(trial, {})
        if metric in metrics:
            raise ResultsError(
                f"{file}, line {number} tells {metric} of {trial} once more: remove one of them"
            )
        metrics[metric] = value
    return {trial: metrics for trial, metrics in trials.items() if LAST_METRIC in metrics}


def _repair(file: Path) -> None:
    """Make an empty table, or remove what a crash left of a trial."""
    whole = (",".join(COLUMNS) + "\n" + _format(_read(file.parent))).encode()
    if not file.is_file() or file.read_bytes() != whole:
        write_atomically(file, whole)


def _format(trials: Mapping[Trial, Mapping[str, float]]) -> str:
    lines = []
    for trial, metrics in trials.items():
        names = [*(name for name in metrics if name != LAST_METRIC), LAST_METRIC]
        start = ",".join(map(str, trial))
        lines += [f"{start},{name},{float(metrics[name])!r}\n" for name in names]
    return "".join(lines)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
