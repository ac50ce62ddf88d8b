"""Parts of the data, ready to learn from."""

import os
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from foretrace.errors import TrainingError, shown
from foretrace.imagined.context import column_of, recorded_context
from foretrace.imagined.domain import estimate_com, measure
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.splits import Split, split_by_seed
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.config import TrainConfig
from foretrace.predictor.run_folder import Source
from foretrace.predictor.states import Effects, valid_lengths

LARGE = 20_000
"""States of a part of more interactions are kept in single precision, and features take the place of their inputs."""

FEW_BYTES = 64
"""Of a large part, values of a row that take more may be kept in a file."""

PIECE = 2048
"""Rows that are normalised together."""


@dataclass
class Part:
    """One part of the data, ready to learn from."""

    source: Source
    """Its interactions."""
    inputs: Tensor
    """Inputs of the features; in a large part the features may take their place."""
    context: np.ndarray
    """(batch, context) values that the predictor is conditioned on [SI]."""
    states: np.ndarray
    """(batch, time, state) in the action frame [m], zeros past the length; float32 in a large part."""
    lengths: np.ndarray
    """(batch,) samples of each trajectory that count."""
    outcomes: np.ndarray
    """(batch,) numbers of the outcomes that the predictor distinguishes."""
    estimated_com: np.ndarray
    """(batch, 3) centres of mass at rest as estimated from the views [m]; NaN of weighted objects."""
    execution: np.ndarray
    """(batch, 3) executed actions relative to the commanded ones [m, m, rad]; zeros where that is not known."""
    measures: dict[str, np.ndarray]
    """(batch,) measures by which objects are compared."""
    features: Tensor | None = field(default=None, init=False)
    """Features and context, once they are computed, of an extractor that is not trained with the predictor."""

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def large(self) -> bool:
        """Whether there is room for one copy of it only."""
        return self.states.dtype == np.float32

    @property
    def valid(self) -> np.ndarray:
        """(batch, time) bool: the samples that count."""
        return np.arange(self.states.shape[1]) < self.lengths[:, None]


def prepare(
    source: Source, predictor: EffectPredictor, inputs: Tensor | None = None, folder: Path | None = None
) -> Part:
    """A part of the data for a predictor; of a `Dataset` piece by piece, since it need not fit into memory.

    Args:
        source: Its interactions.
        predictor: The predictor.
        inputs: Inputs of its features, where they are known already.
        folder: Where a large part of a `Dataset` is kept in files that go with it; in memory if not given.

    Raises:
        TrainingError: An observed motion is not finite.
    """
    if isinstance(source, Dataset):
        return _prepare_in_pieces(source, predictor, folder)
    inputs = predictor.features.inputs(source) if inputs is None else inputs
    states = predictor.encode(source)
    wrong = np.flatnonzero(~np.isfinite(states).all(axis=(1, 2)))
    if len(wrong):
        raise TrainingError(
            f"interaction {source.ids[wrong[0]]} has a motion that is not finite, as have {len(wrong)} of "
            f"{len(source)}: leave them out"
        )
    return Part(
        source=source,
        inputs=inputs,
        context=recorded_context(source, predictor.context, predictor.marginal),
        states=states,
        lengths=predictor.lengths(source),
        outcomes=predictor.number_outcomes(source),
        estimated_com=_estimated_com(source),
        execution=np.nan_to_num(source.execution),
        measures=measure(source, source.com[:, 0]) | predictor.features.measure(inputs),
    )


def features_of(part: Part, predictor: EffectPredictor) -> Tensor:
    """Features and context of a part; computed once if the extractor is not trained with the predictor."""
    if part.features is not None:
        return part.features
    fixed = not predictor.features.trainable
    features = predictor.compute_features(part.inputs, in_place=part.large and fixed)
    features = predictor.add_context(features, part.context)
    if fixed:
        part.features = features
    return features


def effects_of(part: Part, predictor: EffectPredictor, in_place: bool = False) -> Effects:
    """Normalised effects of a part; in place of states in metres where there is no room for both."""
    valid = torch.from_numpy(part.valid)
    if in_place:
        states = torch.from_numpy(part.states)
        for piece, counts in zip(states.split(PIECE), valid.split(PIECE), strict=True):
            piece.copy_(predictor.normalise(piece.numpy()).cpu() * counts[..., None])
        states = states.to(predictor.device)
    else:
        states = predictor.normalise(part.states) * valid.to(predictor.device)[..., None]
    lengths, outcomes = (torch.from_numpy(n).to(predictor.device) for n in (part.lengths, part.outcomes))
    estimated, execution = (
        torch.as_tensor(n, dtype=torch.float32, device=predictor.device)
        for n in (part.estimated_com, part.execution)
    )
    return Effects(states, lengths, outcomes, estimated, execution)


def _estimated_com(source: InteractionBatch) -> np.ndarray:
    """Estimated centres of mass, NaN where the estimate cannot be right: of weighted objects."""
    uniform = np.nan_to_num(column_of(source, "com_offset")) == 0
    return np.where(uniform[:, None], estimate_com(source), np.nan)


def _prepare_in_pieces(source: Dataset, predictor: EffectPredictor, folder: Path | None) -> Part:
    large = len(source) > LARGE
    columns: dict[str, np.ndarray] = {}
    measures: dict[str, np.ndarray] = {}
    order, done = np.argsort(source.ids, kind="stable"), 0  # as they lie on disk: each shard is read once
    for batch in source[order].batches():
        piece = prepare(batch, predictor)
        own = {
            "inputs": piece.inputs.numpy(),
            "context": piece.context,
            "states": piece.states.astype(np.float32 if large else np.float64),
            "lengths": piece.lengths,
            "outcomes": piece.outcomes,
            "estimated_com": piece.estimated_com,
            "execution": piece.execution,
        }
        for whole, found in ((columns, own), (measures, piece.measures)):
            for name, values in found.items():
                if name not in whole:
                    kept = folder if large and values[0].nbytes > FEW_BYTES else None
                    whole[name] = _room((len(source), *values.shape[1:]), values.dtype, kept)
                whole[name][order[done : done + len(batch)]] = values
        done += len(batch)
    inputs = torch.from_numpy(columns.pop("inputs"))
    return Part(source, inputs, measures=measures, **columns)


def _room(shape: tuple[int, ...], dtype: np.dtype, folder: Path | None) -> np.ndarray:
    """An array without values: in memory, or mapped from a file that has no name and goes with it."""
    if folder is None:
        return np.empty(shape, dtype)
    with tempfile.TemporaryFile(dir=folder) as file:
        if hasattr(os, "posix_fallocate"):  # on a full disk an error now, no dead process later
            os.posix_fallocate(file.fileno(), 0, int(np.prod(shape)) * dtype.itemsize)
        return np.memmap(file, dtype, "w+", shape=shape)


def choose_split(source: Source, training: TrainConfig) -> Split:
    """Parts drawn by the seed among the interactions that a training may learn from.

    Raises:
        TrainingError: No interaction has one of its outcomes, or the parts are larger than the data.
    """
    outcome, outcomes = outcome_of(source), training.outcomes or ()
    usable = np.flatnonzero(np.isin(outcome, outcomes) & (usable_lengths(source) >= 2))
    if len(usable) == 0:
        present = ", ".join(np.unique(outcome).tolist()) or "none"
        raise TrainingError(
            f"no interaction has an outcome among {', '.join(outcomes)}; the data has: {present}"
        )
    drawn = split_by_seed(len(usable), training.seed, training.split)
    return Split(usable[drawn.train], usable[drawn.validation], usable[drawn.test])


def outcome_of(source: Source) -> np.ndarray:
    """(n,) array of the outcome of each interaction."""
    if isinstance(source, InteractionBatch):
        return source.outcome
    return np.array(source.index["outcome"].to_pylist())


def usable_lengths(source: Source) -> Int[np.ndarray, " n"]:
    """Samples of each interaction up to where the object slipped."""
    if isinstance(source, InteractionBatch):
        return valid_lengths(source)
    slips = source.index["slip_index"].fill_null(np.iinfo(np.int64).max).to_numpy()
    return np.minimum(source.lengths, slips)


def check_split(split: Split, lengths: np.ndarray) -> None:
    """Refuse rows that the data do not have, and parts from which nothing can be learned."""
    for name, rows in asdict(split).items():
        if not isinstance(rows, np.ndarray) or rows.dtype.kind not in "iu" or rows.ndim != 1:
            raise TrainingError(f"{name} part of the split is {shown(rows)}: give an array of row numbers")
        if len(rows) and not (rows.min() >= 0 and rows.max() < len(lengths)):
            worst = rows.min() if rows.min() < 0 else rows.max()
            raise TrainingError(
                f"{name} part of the split has row {worst}: the data have {len(lengths)} rows"
            )
        if name == "test":
            continue
        if not len(rows):
            raise TrainingError(f"{name} part of the split is empty: give at least one interaction")
        if (lengths[rows] < 2).any():
            row = rows[lengths[rows] < 2][0]
            raise TrainingError(
                f"{name} part of the split has row {row} of fewer than two samples before a slip: leave it out"
            )
