"""The training of a predictor: one loop for all of them (paper, section 4)."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from foretrace.errors import TrainingError, check_type
from foretrace.features.base import FitPart, fast_precision
from foretrace.features.fitting import learning_rate
from foretrace.files import as_path, short_hash
from foretrace.imagined.context import recorded_context
from foretrace.imagined.domain import measure, ranges_of
from foretrace.interactions.dataset import Dataset, InteractionBatch, count_outcomes
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import Split, split_by_seed
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.checkpoint import load_tensors, read_tensors, write_tensors
from foretrace.predictor.config import PredictorConfig, TrainConfig
from foretrace.predictor.display import tensorboard, terminal
from foretrace.predictor.optimizer import make_optimizer
from foretrace.predictor.run_folder import TENSORBOARD, Progress, Row, RunFolder, fingerprint
from foretrace.predictor.runtime import find_device, seeded, suitable_threads, thread_count
from foretrace.predictor.states import Effects, state_statistics, valid_lengths
from foretrace.trajectories import final_distance, mean_distance

RUNTIME = ("device", "threads", "precision")
"""Settings that say where a training runs, not what it ends with."""


Source = InteractionBatch | Dataset
PIECE = 2048
"""Rows that are normalised or imagined together."""
MEASURE = "measure "
LARGE = 20_000
"""A data set of more interactions is prepared piece by piece: it need not fit into memory."""


@dataclass
class _Part:
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
    measures: dict[str, np.ndarray]
    """(batch,) measures by which objects are compared."""

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def large(self) -> bool:
        """Whether it was prepared piece by piece."""
        return isinstance(self.source, Dataset)

    @property
    def valid(self) -> np.ndarray:
        """(batch, time) bool: the samples that count."""
        return np.arange(self.states.shape[1]) < self.lengths[:, None]


def fit_predictor(
    batch: InteractionBatch,
    predictor: PredictorConfig | EffectPredictor,
    split: Split,
    training: TrainConfig | None = None,
    *,
    inputs: Tensor | None = None,
    fitted: Path | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> tuple[EffectPredictor, Progress]:
    """Train a predictor in memory; `train_predictor` does the same and leaves a folder.

    Args:
        batch: The interactions.
        predictor: Its settings, or an untrained predictor, which is trained in place.
        split: Rows of ``batch`` in each part, all with at least two valid samples.
        training: Settings of the loop, of which ``split`` and ``outcomes`` are not looked at; by default those that the
            predictor's settings recommend.
        inputs: The features' ``inputs`` of the whole ``batch``, where they are known already.
        fitted: Folder that keeps what feature extractors have learned on their own, for further trainings on the
            same parts and seed.
        report: Takes a line on the progress.

    Returns:
        The predictor of the best validation epoch, and the metrics of all epochs.

    Raises:
        TrainingError: The predictor does not fit the data or was trained before, or the loss is no longer finite.
    """
    training = _loop_settings(predictor, training)
    with _made(predictor, training, batch, training.threads) as made:
        made.learned_from = _outcomes_of(batch.outcome[split.train])
        inputs = made.features.inputs(batch) if inputs is None else inputs
        train, validation = (
            _prepare(batch[rows], made, inputs[rows]) for rows in (split.train, split.validation)
        )
        progress = _Training(training, made, _Memory(), train, validation, fitted).run(report)
    return made.eval(), progress


def train_predictor(
    data: InteractionBatch | Dataset,
    predictor: PredictorConfig | EffectPredictor,
    out: str | Path,
    training: TrainConfig | None = None,
    *,
    resume: bool = True,
    split: Split | None = None,
    progress: bool = True,
) -> Path:
    """Train a predictor and keep the model of its best validation epoch.

    After every epoch all that is needed to go on is on disk: the same call continues a training that was
    killed and ends with the same model, to the bit on a CPU, as if that had never happened.

    Args:
        data: The interactions.
        predictor: Its settings, or an untrained predictor.
        out: Folder of the training: ``config.json``, ``model.safetensors``, ``metrics.csv``,
            ``environment.json``, ``split.json`` and TensorBoard events.
        training: Settings of the loop; by default those that the predictor's settings recommend.
        resume: Go on with an unfinished training in ``out``; otherwise discard it.
        split: Rows of ``data`` in each part, all with at least two valid samples; drawn by the seed among the
            chosen outcomes if not given.
        progress: Show a progress bar.

    Returns:
        The folder.

    Raises:
        TrainingError: The predictor does not fit the data or was trained before, the split is larger than the data, the
            folder is in use, or the loss is no longer finite.
    """
    training = _loop_settings(predictor, training)
    check_type("data", data, (InteractionBatch, Dataset), TrainingError)
    check_type("split", split, (Split, type(None)), TrainingError)
    source = data.batch() if isinstance(data, Dataset) and len(data) <= LARGE else data
    folder = RunFolder(as_path(out, TrainingError))
    threads = training.threads or (folder.threads if resume else None)
    with _made(predictor, training, source, threads) as made:
        training = replace(training, outcomes=training.outcomes or made.outcomes or (str(Outcome.LEVERED),))
        outcomes, lengths = _overview(source)
        split = _choose_split(outcomes, lengths, training) if split is None else split
        _check_split(split, lengths)
        made.learned_from = _outcomes_of(outcomes[split.train])
        described = {name: value for name, value in asdict(training).items() if name not in RUNTIME}
        described |= {"data": fingerprint(source, made.context), "rows": _hash_split(split)}
        folder.start(made, described, resume)
        if folder.finished:
            return folder.path
        folder.write_split(source, split)
        folder.write_environment(
            {"seed": training.seed, "data": described["data"], "device": str(made.device)}
            | {"precision": made.features.precision, "threads": torch.get_num_threads()}
        )
        train, validation = (_prepare(source[rows], made) for rows in (split.train, split.validation))
        with (
            terminal(training.num_epochs(len(split.train)), progress) as (report, show),
            tensorboard(folder.path / TENSORBOARD) as log,
        ):

            def show_and_log(row: Row, done: Progress) -> None:
                log(row)
                show(row, done)

            _Training(training, made, folder, train, validation).run(report, show_and_log)
    folder.close(made)
    return folder.path


class _Memory:
    """Keeps the best model as a `RunFolder` does, but not beyond the process."""

    model: dict[str, Tensor]

    def save(self, progress: Progress, predictor: EffectPredictor, optimizer: torch.optim.Optimizer) -> None:
        """Note the end of an epoch."""
        if progress.best_epoch == progress.epoch:
            self.model = {name: tensor.clone() for name, tensor in predictor.state_dict().items()}

    def restore(self, predictor: EffectPredictor, optimizer: torch.optim.Optimizer) -> None:
        """Nothing: there is nothing to go on from."""

    def finish(self, predictor: EffectPredictor) -> None:
        """Keep the finished predictor."""
        self.model = predictor.state_dict()


class _Training:
    """The loop over epochs."""

    def __init__(
        self,
        config: TrainConfig,
        predictor: EffectPredictor,
        keeper: RunFolder | _Memory,
        train: _Part,
        validation: _Part,
        fitted: Path | None = None,
    ):
        self.config, self.predictor, self.keeper, self.fitted = config, predictor, keeper, fitted
        self.train, self.validation = train, validation
        self.epochs = config.num_epochs(len(train))
        mean, scale = state_statistics(train.states, train.valid, predictor.state)
        predictor.set_normalisation(mean, scale, train.source.times)
        predictor.set_context(train.context)
        self.effects = self._effects_of(train, in_place=train.large)
        self._fixed: tuple[Tensor, Tensor] | None = None
        self.optimizer = make_optimizer(predictor)

    def run(
        self,
        report: Callable[[str], None],
        show: Callable[[Row, Progress], None] = lambda row, progress: None,
    ) -> Progress:
        """Train until the last epoch."""
        done = self.keeper.restore(self.predictor, self.optimizer)
        if done is None:
            done = Progress()
            self._fit_features(report)
            with torch.no_grad():
                self.predictor.prepare(self._features()[0], self.effects)
            self.keeper.save(done, self.predictor, self.optimizer)
        fixed, fixed_validation = (None, None) if self.predictor.features.trainable else self._features()
        while done.epoch < self.epochs:
            started = perf_counter()
            row = {"epoch": done.epoch + 1, "train_loss": self._epoch(done.epoch + 1, fixed)}
            row |= self._validate(fixed_validation)
            row |= {
                "learning_rate": self.optimizer.param_groups[0]["lr"],
                "seconds": perf_counter() - started,
            }
            done = done.with_epoch(row, self.predictor.keeps_last_epoch)
            self.keeper.save(done, self.predictor, self.optimizer)
            show(row, done)
        self.predictor.load_state_dict(self.keeper.model)
        with torch.no_grad():
            features, other_features = self._features()
            other_effects = self._effects_of(self.validation)
            self.predictor.finish(features, self.effects, other_features, other_effects)
        self.keeper.finish(self.predictor)
        self.predictor.ranges = ranges_of(self.train.measures)
        return done

    def _fit_features(self, report: Callable[[str], None]) -> None:
        features, device, seed = self.predictor.features, self.predictor.device, self.config.seed
        train, validation = (FitPart(p.inputs.to(device), p.source) for p in (self.train, self.validation))
        if self.fitted is None or not features.learns:
            features.fit(train, validation, seed=seed, report=report)
            return
        options = json.dumps([features.label, features.options, features.precision, seed])
        read = [(p.inputs.cpu().contiguous().numpy(), p.batch.support_points) for p in (train, validation)]
        digest = short_hash([options.encode(), *(array.tobytes() for pair in read for array in pair)])
        file = self.fitted / f"{features.label}-{digest}.safetensors"
        if file.is_file():
            load_tensors(features, read_tensors(file), file)
        else:
            features.fit(train, validation, seed=seed, report=report)
            self.fitted.mkdir(parents=True, exist_ok=True)
            write_tensors(file, features.state_dict())

    def _effects_of(self, part: _Part, in_place: bool = False) -> Effects:
        """Normalised states; in place of those in metres where there is no room for both."""
        predictor, valid = self.predictor, torch.from_numpy(part.valid)
        if in_place:
            states = torch.from_numpy(part.states)
            for piece, counts in zip(states.split(PIECE), valid.split(PIECE), strict=True):
                piece.copy_(predictor.normalise(piece.numpy()).cpu() * counts[..., None])
            states = states.to(predictor.device)
        else:
            states = predictor.normalise(part.states) * valid.to(predictor.device)[..., None]
        lengths, outcomes = (
            torch.from_numpy(numbers).to(predictor.device) for numbers in (part.lengths, part.outcomes)
        )
        return Effects(states, lengths, outcomes)

    def _features(self) -> tuple[Tensor, Tensor]:
        """Features and context of training and validation part; computed once if the extractor does not train."""
        if self._fixed is not None:
            return self._fixed
        features = (self._features_of(self.train), self._features_of(self.validation))
        if not self.predictor.features.trainable:
            self._fixed = features
        return features

    def _features_of(self, part: _Part) -> Tensor:
        features = self.predictor.compute_features(
            part.inputs, in_place=part.large and not self.predictor.features.trainable
        )
        return self.predictor.add_context(features, part.context)

    def _epoch(self, epoch: int, fixed: Tensor | None) -> float:
        """One pass over the training part; the mean loss. ``fixed`` are features that do not change."""
        predictor, optimizer, device = self.predictor, self.optimizer, self.predictor.device
        order = np.random.default_rng([self.config.seed, epoch]).permutation(len(self.effects))
        total = torch.zeros((), device=device)
        predictor.train()
        with seeded(self.config.seed, epoch, device):
            batches = torch.from_numpy(order).split(self.config.batch_size)
            for number, rows in enumerate(batches):
                share = (epoch - 1 + number / len(batches)) / self.epochs
                rate = learning_rate(self.config.learning_rate, share)
                for group in optimizer.param_groups:
                    group["lr"] = rate * group["share"]
                if fixed is None:
                    features = predictor.features(self.train.inputs[rows].to(device))
                    features = predictor.add_context(features, self.train.context[rows.numpy()])
                else:
                    features = fixed[rows]
                loss = predictor.training_loss(features, self.effects[rows])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                total += loss.detach() * len(rows)
        mean = float(total) / len(order)
        if not np.isfinite(mean):
            raise TrainingError(
                f"the loss is {mean} in epoch {epoch}: lower the learning rate of {self.config.learning_rate}"
            )
        return mean

    def _validate(self, fixed: Tensor | None) -> Row:
        """Errors of the whole roll-out from the first state alone."""
        part, predictor = self.validation, self.predictor
        features = self._features_of(part) if fixed is None else fixed
        pieces = zip(
            features.split(PIECE), np.split(part.states[:, 0], range(PIECE, len(part), PIECE)), strict=True
        )
        imagined = np.concatenate([predictor.imagine_states(*piece) for piece in pieces])
        off = (imagined - part.states)[part.valid] / predictor.state_scale.cpu().numpy()
        truth = np.where(part.valid[..., None], part.states[..., :3], np.nan)
        return {
            "validation_loss": float(np.mean(off**2)),
            "validation_full_cm": 100 * float(np.mean(mean_distance(imagined[..., :3], truth))),
            "validation_final_cm": 100 * float(np.mean(final_distance(imagined[..., :3], truth))),
        }


def _loop_settings(predictor: PredictorConfig | EffectPredictor, training: TrainConfig | None) -> TrainConfig:
    check_type("predictor", predictor, (PredictorConfig, EffectPredictor), TrainingError)
    check_type("training", training, (TrainConfig, type(None)), TrainingError)
    config = predictor.config if isinstance(predictor, EffectPredictor) else predictor
    return config.training if training is None else training


def _outcomes_of(outcomes: np.ndarray) -> tuple[str, ...]:
    """Outcomes that occur, in the order in which actions name them."""
    return tuple(count_outcomes(outcomes.tolist()))


def _overview(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Outcome of each interaction, and the number of its samples up to where the object slipped."""
    if isinstance(source, InteractionBatch):
        return source.outcome, valid_lengths(source)
    slips = source.index["slip_index"].fill_null(np.iinfo(np.int64).max).to_numpy()
    return np.array(source.index["outcome"].to_pylist()), np.minimum(source.lengths, slips)


def _choose_split(outcome: np.ndarray, lengths: np.ndarray, training: TrainConfig) -> Split:
    outcomes = training.outcomes or ()
    usable = np.flatnonzero(np.isin(outcome, outcomes) & (lengths >= 2))
    if len(usable) == 0:
        present = ", ".join(np.unique(outcome).tolist()) or "none"
        raise TrainingError(
            f"no interaction has an outcome among {', '.join(outcomes)}; the data has: {present}"
        )
    drawn = split_by_seed(len(usable), training.seed, training.split)
    return Split(usable[drawn.train], usable[drawn.validation], usable[drawn.test])


def _check_split(split: Split, lengths: np.ndarray) -> None:
    """Refuse rows that the data do not have, and parts from which nothing can be learned."""
    for name, rows in asdict(split).items():
        if not isinstance(rows, np.ndarray) or rows.dtype.kind not in "iu" or rows.ndim != 1:
            raise TrainingError(f"{name} part of the split is {rows!r}: give an array of row numbers")
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


def _hash_split(split: Split) -> str:
    return short_hash([json.dumps([rows.tolist() for rows in asdict(split).values()]).encode()])


def _prepare(source: Source, predictor: EffectPredictor, inputs: Tensor | None = None) -> _Part:
    if isinstance(source, Dataset):
        return _prepare_in_pieces(source, predictor)
    inputs = predictor.features.inputs(source) if inputs is None else inputs
    return _Part(
        source=source,
        inputs=inputs,
        context=recorded_context(source, predictor.context),
        states=predictor.encode(source),
        lengths=predictor.lengths(source),
        outcomes=predictor.number_outcomes(source),
        measures=measure(source, source.com[:, 0]) | predictor.features.measure(inputs),
    )


def _prepare_in_pieces(source: Dataset, predictor: EffectPredictor) -> _Part:
    """The same of a data set that need not fit into memory."""
    whole: dict[str, Any] = {}
    done = 0
    for batch in source.batches():
        piece = _prepare(batch, predictor)
        columns = {
            "inputs": piece.inputs.numpy(),
            "context": piece.context,
            "states": piece.states.astype(np.float32),
            "lengths": piece.lengths,
            "outcomes": piece.outcomes,
            **{MEASURE + name: values for name, values in piece.measures.items()},
        }
        for name, values in columns.items():
            column = whole.setdefault(name, np.empty((len(source), *values.shape[1:]), values.dtype))
            column[done : done + len(batch)] = values
        done += len(batch)
    measures = {
        name.removeprefix(MEASURE): values for name, values in whole.items() if name.startswith(MEASURE)
    }
    rest = {name: values for name, values in whole.items() if not name.startswith(MEASURE)}
    rest["inputs"] = torch.from_numpy(rest["inputs"])
    return _Part(source, measures=measures, **rest)


@contextmanager
def _made(
    predictor: PredictorConfig | EffectPredictor,
    training: TrainConfig,
    source: Source,
    threads: int | None,
) -> Iterator[EffectPredictor]:
    """The untrained predictor on its device; PyTorch's threads set, its random numbers seeded for the training."""
    device, num_samples = find_device(training.device), len(source.times)
    with seeded(training.seed, 0, device), thread_count(threads):
        made = predictor if isinstance(predictor, EffectPredictor) else predictor.make(num_samples)
        if made.num_samples != num_samples:
            raise TrainingError(
                f"the predictor imagines {made.num_samples} samples, the data have {num_samples}: make it for these"
            )
        if made.ranges or made.times.any():
            raise TrainingError("the predictor was trained before: give its config, or an untrained one")
        made = made.to(device)
        made.set_precision(fast_precision(device) if training.precision == "auto" else training.precision)
        with thread_count(threads or suitable_threads(made)):
            yield made
