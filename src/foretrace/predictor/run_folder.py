"""The folder of one training: configuration, environment, progress, the best model so far."""

import csv
import io
import json
import platform
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import numpy as np
import torch
from msgspec import Meta
from safetensors import SafetensorError, safe_open
from torch import Tensor

from foretrace.errors import DatasetError, ForetraceError, TrainingError, is_whole, shown
from foretrace.files import (
    as_json,
    first_difference,
    first_stranger,
    make_folder,
    read_json,
    remove_partial,
    short_hash,
    sole_writer,
    versions_of,
    write_json,
    write_text,
)
from foretrace.imagined.context import column_of
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.splits import Split
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.checkpoint import (
    CALIBRATION,
    CONFIG,
    MODEL,
    RANGES,
    describe,
    load_tensors,
    read_config,
    read_tensors,
    write_tensors,
)
from foretrace.schema import Count, conform, parse_json

ENVIRONMENT = "environment.json"
METRICS = "metrics.csv"
SPLIT = "split.json"
ROUNDED = 1e-5
"""Precision of medians in fingerprints that do not depend on the processor [SI]."""
FINGERPRINTS = "fingerprints"
"""Entry of the split with a fingerprint of each part."""
RESUME = "resume.safetensors"
TENSORBOARD = "tensorboard"
INITIAL = "initial"
"""Entry about a training in ``config.json``: a checksum of the tensors that it started from, if it did."""


class RunSettings(TypedDict, total=False):
    """Schema of the environment, as far as a training reads it back."""

    threads: Annotated[int, Meta(ge=1, le=1024)]


class SplitEntries(TypedDict):
    """Schema of the split."""

    train: list[Count]
    validation: list[Count]
    test: list[Count]
    fingerprints: NotRequired[dict[str, str]]


Source = InteractionBatch | Dataset
"""Interactions in memory or on disk."""
Row = dict[str, int | float]
"""The metrics of one epoch, by name."""


@dataclass(frozen=True)
class Progress:
    """Progress of a training."""

    history: list[Row] = field(default_factory=list)
    """One row of metrics per finished epoch."""
    best_epoch: Count = 0
    """The epoch whose model is kept, counted from 1; 0 before there is one."""

    @property
    def epoch(self) -> int:
        """Epochs finished."""
        return len(self.history)

    @property
    def best_loss(self) -> float:
        """The smallest validation loss so far."""
        return self.history[self.best_epoch - 1]["validation_loss"] if self.best_epoch else float("inf")

    def with_epoch(self, row: Row, keep_last: bool = False) -> "Progress":
        """The progress after another epoch, which is kept if its validation loss is the smallest, or if all are."""
        better = keep_last or row["validation_loss"] < self.best_loss
        return replace(
            self, history=[*self.history, row], best_epoch=self.epoch + 1 if better else self.best_epoch
        )


class RunFolder:
    """Reads and writes the folder of one training.

    ``resume.safetensors`` is there from before the first epoch until the last: a folder with a model and
    without it is a finished training.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)

    @property
    def finished(self) -> bool:
        """Whether the training has run to its end."""
        return (self.path / MODEL).is_file() and not (self.path / RESUME).is_file()

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Hold the folder, which is made if it is not there.

        Raises:
            TrainingError: It holds something else, or another process trains there.
        """
        if not (self.path / CONFIG).is_file() and first_stranger(self.path):
            raise TrainingError(f"{self.path} is not empty and holds no training: choose another folder")
        make_folder(self.path, TrainingError)
        with sole_writer(self.path, TrainingError):
            remove_partial(self.path)
            yield

    def start(self, predictor: EffectPredictor, training: Mapping[str, Any], resume: bool) -> None:
        """Begin a training, or go on with it.

        Args:
            predictor: The predictor to be trained.
            training: All that decides the outcome of the training, JSON-able.
            resume: Whether to go on with a training that the folder holds; otherwise that is discarded.

        Raises:
            TrainingError: The folder holds a training of another configuration.
        """
        described = describe(predictor) | {"training": training}
        config = as_json({name: value for name, value in described.items() if name != RANGES})
        if resume and (self.path / CONFIG).is_file():
            self._check(config)
            return
        for name in (MODEL, METRICS, RESUME):  # a model without the last one would be a finished training
            (self.path / name).unlink(missing_ok=True)
        for events in self.path.glob(f"{TENSORBOARD}/events.*"):
            events.unlink()
        write_json(self.path / CONFIG, config)

    def _check(self, config: Mapping[str, Any]) -> None:
        there = {
            name: value for name, value in read_config(self.path).items() if name not in (RANGES, CALIBRATION)
        }
        if difference := first_difference(there, config):
            name, found, wanted = difference
            raise TrainingError(
                f"{self.path} holds a training with {name} = {shown(found)}, not {shown(wanted)}: choose another "
                "folder, the same configuration, or start afresh"
            )

    @property
    def first(self) -> int | None:
        """Number below which the training in the folder looks at interactions; None: at all, or there is none."""
        try:
            found = read_config(self.path).get("training", {}).get("first")
        except ForetraceError:
            return None
        return found if is_whole(found, 1, 10**12) else None

    @property
    def threads(self) -> int | None:
        """Threads that the training in the folder runs with; None: not known."""
        try:
            return read_json(self.path / ENVIRONMENT, RunSettings, TrainingError, "").get("threads")
        except TrainingError:
            return None

    def write_environment(self, facts: Mapping[str, Any]) -> None:
        """Note what the training runs on."""
        versions = {
            "python": platform.python_version(),
            **versions_of("foretrace", "numpy", "safetensors", "torch"),
        }
        write_json(self.path / ENVIRONMENT, {**facts, "commit": git_commit(), "versions": versions})

    def write_split(self, source: Source, split: Split) -> None:
        """Note the ids of the interactions in each part, and what they were."""
        parts, ids = asdict(split).items(), source.ids
        content = {part: ids[rows].tolist() for part, rows in parts}
        prints = {part: fingerprint(source[np.sort(rows)]) for part, rows in parts}
        write_json(self.path / SPLIT, {**content, FINGERPRINTS: prints})

    def save(self, progress: Progress, predictor: EffectPredictor, optimizer: torch.optim.Optimizer) -> None:
        """Note the end of an epoch; the model itself too if the epoch is the best so far."""
        if progress.epoch and progress.best_epoch == progress.epoch:
            write_tensors(self.path / MODEL, predictor.state_dict())
        if progress.history:
            table = io.StringIO()
            writer = csv.DictWriter(table, progress.history[0].keys(), lineterminator="\n")
            writer.writeheader()
            writer.writerows(progress.history)
            write_text(self.path / METRICS, table.getvalue())
        tensors = {f"model.{name}": tensor for name, tensor in predictor.state_dict().items()}
        for index, values in optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{name}": value for name, value in values.items()}
        write_tensors(self.path / RESUME, tensors, {"progress": json.dumps(asdict(progress))})

    def restore(self, predictor: EffectPredictor, optimizer: torch.optim.Optimizer) -> Progress | None:
        """Go back to the end of the last epoch noted; None where none was, or its best model is gone.

        Raises:
            TrainingError: The file is damaged.
            CheckpointError: Its tensors do not fit.
        """
        file, remedy = self.path / RESUME, "train anew without resuming"
        if not file.is_file():
            return None
        try:
            with safe_open(file, framework="pt") as opened:
                tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
                content = parse_json((opened.metadata() or {})["progress"])
        except (SafetensorError, OSError, KeyError, ValueError) as error:
            raise TrainingError(f"{file} cannot be read ({shown(error)}): {remedy}") from error
        progress = conform(content, Progress, str(file), TrainingError, remedy, "progress")
        if progress.best_epoch > progress.epoch:
            raise TrainingError(f"{file}: best_epoch {progress.best_epoch} of {progress.epoch}: {remedy}")
        if progress.best_epoch and not (self.path / MODEL).is_file():
            return None
        load_tensors(predictor, _below("model.", tensors), file)
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        state: dict[int, dict[str, Tensor]] = {}
        for name, tensor in _below("optimizer.", tensors).items():
            index, _, key = name.partition(".")
            if not index.isdecimal() or int(index) >= len(parameters):
                raise TrainingError(f"{file} has an unexpected tensor optimizer.{name:.80}: {remedy}")
            parameter = parameters[int(index)]
            if tensor.shape == parameter.shape:
                # The fused optimiser pairs numbers by their place in memory: give them the parameter's layout.
                tensor = torch.empty_like(parameter).detach().copy_(tensor)
            state.setdefault(int(index), {})[key] = tensor
        optimizer.load_state_dict(optimizer.state_dict() | {"state": state})
        return progress

    @property
    def model(self) -> dict[str, Tensor]:
        """The best model."""
        return read_tensors(self.path / MODEL)

    def finish(self, predictor: EffectPredictor) -> None:
        """Keep the finished predictor in place of the best model."""
        write_tensors(self.path / MODEL, predictor.state_dict())

    def close(self, predictor: EffectPredictor) -> None:
        """Note between which values the training part lies, and declare the training finished."""
        write_json(self.path / CONFIG, read_config(self.path) | {RANGES: dict(predictor.ranges)})
        (self.path / RESUME).unlink(missing_ok=True)


def first_of(source: Source, first: int | None) -> Source:
    """The interactions whose numbers are below a given one; None: all."""
    if first is None or (source.ids < first).all():
        return source
    return source[np.flatnonzero(source.ids < first)]


def fingerprint(source: Source, context: Sequence[str] = ()) -> str:
    """A short hash of everything in interactions that a training can read, and of the context it is conditioned on."""
    return short_hash(_contents(source, context))


def processor_independent_fingerprint(batch: InteractionBatch) -> str:
    """A short hash that the same simulated interactions have whichever processor simulated them.

    Processors differ in the last bit of a sum, and contacts make that grow: in 3 of 1000 lever-ups to more than
    0.01 mm. Masks, lengths and outcomes are the same, and so are medians of all else, rounded to `ROUNDED`.
    """
    top = batch.height.max(axis=(1, 2), initial=0.0)
    values = [top, batch.com, batch.pose, batch.support_points, *batch.parameters.values()]
    medians = [np.median(np.nan_to_num(each), axis=0) for each in values]
    rounded = [np.round(each / ROUNDED) + 0.0 for each in medians]  # no -0
    exact = [batch.ids, batch.mask, batch.length, batch.slip_index, batch.times, *rounded]
    names = "\n".join([*batch.outcome.tolist(), *batch.parameters]).encode()
    return short_hash([names, *(np.ascontiguousarray(each).tobytes() for each in exact)])


def _contents(source: Source, context: Sequence[str]) -> Iterator[bytes]:
    """The same bytes of a batch and of a data set, which is gone through for each of the large arrays."""
    small: dict[str, list[np.ndarray]] = {}
    yield np.ascontiguousarray(source.ids).tobytes()
    for batch in source.batches():
        yield np.ascontiguousarray(batch.mask).tobytes()
        for name in ("length", "slip_index", "support_points", "outcome"):
            small.setdefault(name, []).append(getattr(batch, name))
        for name in context:
            small.setdefault(f"context {name}", []).append(column_of(batch, name))
    for batch in source.batches():
        yield np.ascontiguousarray(batch.height).tobytes()
    yield np.ascontiguousarray(source.times).tobytes()
    for name in ("com", "pose"):
        for batch in source.batches():
            yield np.ascontiguousarray(getattr(batch, name)).tobytes()
    for name, parts in small.items():
        values = np.concatenate(parts)
        yield (
            "\n".join(values.tolist()).encode()
            if name == "outcome"
            else np.ascontiguousarray(values).tobytes()
        )


def parts_of(run: str | Path, data: Dataset) -> dict[str, list[int]]:
    """Ids of the interactions in each part of a training's split; empty if it was trained on other data.

    Args:
        run: Folder of the training.
        data: All of the data set.
    """
    try:
        return {name: _rows_of(run, data, name).ids.tolist() for name in _read_split(run)[0]}
    except (DatasetError, TrainingError):
        return {}


def part_of(run: str | Path, data: Source, part: str = "test") -> InteractionBatch:
    """The interactions that were one part of a training's split.

    Args:
        run: Folder of the training.
        data: The data set that it was trained on.
        part: ``train``, ``validation`` or ``test``.

    Raises:
        TrainingError: The folder has no such part, or the data lacks interactions that were in it.
    """
    found = _rows_of(run, data, part)
    return found if isinstance(found, InteractionBatch) else found.batch()


def _rows_of(run: str | Path, data: Source, part: str) -> Source:
    """The interactions that were one part of a training's split, and are still the same."""
    parts, prints = _read_split(run)
    if part not in parts or part not in prints:
        raise TrainingError(f"{Path(run) / SPLIT} has no part {shown(part)}; it has: {', '.join(parts)}")
    data = first_of(data, RunFolder(run).first)
    rows = np.flatnonzero(np.isin(data.ids, parts[part]))
    _ = data.times  # those of the whole from here on, even if the part's longest trajectory is shorter
    if len(rows) != len(parts[part]):
        raise TrainingError(
            f"the data has {len(rows)} of the {len(parts[part])} interactions in the {part} part of {run}: "
            "give the data set that it was trained on"
        )
    found: Source = data[rows]
    if fingerprint(found) != prints[part]:
        raise TrainingError(
            f"the interactions in the {part} part of {run} were others than those in the data: "
            "give the data set that it was trained on"
        )
    return found


def _read_split(run: str | Path) -> tuple[dict[str, list[int]], dict[str, str]]:
    """Ids of the interactions in each part, and the fingerprints of the parts."""
    content = read_json(Path(run) / SPLIT, SplitEntries, TrainingError, "give the folder of a training")
    parts = {"train": content["train"], "validation": content["validation"], "test": content["test"]}
    return parts, content.get("fingerprints", {})


def _below(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def git_commit() -> str | None:
    """Commit of the checkout that this code lies in, if it lies in one."""
    try:
        found = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=False,
        )
    except OSError:
        return None
    return found.stdout.strip() if found.returncode == 0 else None
