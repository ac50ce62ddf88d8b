"""The training of a predictor: one loop for all of them (paper, section 4)."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from foretrace.errors import TrainingError
from foretrace.features.base import FitPart, fast_precision
from foretrace.features.fitting import learning_rate
from foretrace.files import short_hash
from foretrace.imagined.context import recorded_context
from foretrace.imagined.domain import measure, ranges_of
from foretrace.interactions.dataset import Dataset, InteractionBatch
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import Split, split_by_seed
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.checkpoint import load_tensors, read_tensors, write_tensors
from foretrace.predictor.config import PredictorConfig, TrainConfig
from foretrace.predictor.display import tensorboard, terminal
from foretrace.predictor.optimizer import make_optimizer
from foretrace.predictor.run_folder import TENSORBOARD, Progress, Row, RunFolder, fingerprint
from foretrace.predictor.runtime import find_device, seeded, suitable_threads, thread_count
from foretrace.predictor.states import Effects, state_statistics, valid_lengths, valid_samples
from foretrace.trajectories import final_distance, mean_distance

RUNTIME = ("device", "threads", "precision")
"""Settings that say where a training runs, not what it ends with."""


@dataclass(frozen=True)
class _Part:
    """One part of the data, ready to learn from."""

    batch: InteractionBatch
    inputs: Tensor
    """Inputs of the features."""
    context: np.ndarray
    """(batch, context) values that the predictor is conditioned on [SI]."""
    states: np.ndarray
    """(batch, time, state) in the action frame [m], zeros past the length."""
    valid: np.ndarray
    """(batch, time) bool: the samples within it."""


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
        made.learned_from = _outcomes_of(batch[split.train])
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
    batch = data if isinstance(data, InteractionBatch) else data.batch()
    folder = RunFolder(out)
    threads = training.threads or (folder.threads if resume else None)
    with _made(predictor, training, batch, threads) as made:
        training = replace(training, outcomes=training.outcomes or made.outcomes or (str(Outcome.LEVERED),))
        split = _choose_split(batch, training) if split is None else split
        made.learned_from = _outcomes_of(batch[split.train])
        described = {name: value for name, value in asdict(training).items() if name not in RUNTIME}
        described |= {"data": fingerprint(batch, made.context), "rows": _hash_split(split)}
        folder.start(made, described, resume)
        if folder.finished:
            return folder.path
        folder.write_split(batch, split)
        folder.write_environment(
            {"seed": training.seed, "data": described["data"], "device": str(made.device)}
            | {"precision": made.features.precision, "threads": torch.get_num_threads()}
        )
        train, validation = (_prepare(batch[rows], made) for rows in (split.train, split.validation))
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
        self.epochs = config.num_epochs(len(train.batch))
        mean, scale = state_statistics(train.states, train.valid, predictor.state)
        predictor.set_normalisation(mean, scale, train.batch.times)
        predictor.set_context(train.context)
        self.effects = self._effects_of(train)
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
        batch, extractor = self.train.batch, self.predictor.features
        measures = measure(batch, batch.com[:, 0]) | extractor.measure(self.train.inputs)
        self.predictor.ranges = ranges_of(measures)
        return done

    def _fit_features(self, report: Callable[[str], None]) -> None:
        features, device, seed = self.predictor.features, self.predictor.device, self.config.seed
        train, validation = (FitPart(p.inputs.to(device), p.batch) for p in (self.train, self.validation))
        if self.fitted is None or not features.learns:
            features.fit(train, validation, seed=seed, report=report)
            return
        options = json.dumps([features.label, features.options, features.precision, seed])
        read = [(p.inputs.cpu().contiguous().numpy(), p.batch.support_points) for p in (train, validation)]
        digest = short_hash(options.encode(), *(array.tobytes() for pair in read for array in pair))
        file = self.fitted / f"{features.label}-{digest}.safetensors"
        if file.is_file():
            load_tensors(features, read_tensors(file), file)
        else:
            features.fit(train, validation, seed=seed, report=report)
            self.fitted.mkdir(parents=True, exist_ok=True)
            write_tensors(file, features.state_dict())

    def _effects_of(self, part: _Part) -> Effects:
        predictor = self.predictor
        states = (
            predictor.normalise(part.states) * torch.from_numpy(part.valid).to(predictor.device)[..., None]
        )
        lengths, outcomes = (
            torch.from_numpy(numbers).to(predictor.device)
            for numbers in (predictor.lengths(part.batch), predictor.number_outcomes(part.batch))
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
        return self.predictor.add_context(self.predictor.compute_features(part.inputs), part.context)

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
        imagined = predictor.imagine_states(features, part.states[:, 0])
        off = (imagined - part.states)[part.valid] / predictor.state_scale.cpu().numpy()
        truth = np.where(part.valid[..., None], part.batch.com, np.nan)
        return {
            "validation_loss": float(np.mean(off**2)),
            "validation_full_cm": 100 * float(np.mean(mean_distance(imagined[..., :3], truth))),
            "validation_final_cm": 100 * float(np.mean(final_distance(imagined[..., :3], truth))),
        }


def _loop_settings(predictor: PredictorConfig | EffectPredictor, training: TrainConfig | None) -> TrainConfig:
    for name, value, kinds in (
        ("predictor", predictor, (PredictorConfig, EffectPredictor)),
        ("training", training, (TrainConfig, type(None))),
    ):
        if not isinstance(value, kinds):
            wanted = " or ".join(kind.__name__ for kind in kinds if kind is not type(None))
            raise TrainingError(f"{name} is a {type(value).__name__}: give a {wanted}")
    config = predictor.config if isinstance(predictor, EffectPredictor) else predictor
    return config.training if training is None else training


def _outcomes_of(batch: InteractionBatch) -> tuple[str, ...]:
    """Outcomes that occur, in the order of `Outcome`."""
    there = set(batch.outcome.tolist())
    return tuple(str(outcome) for outcome in Outcome if outcome in there)


def _choose_split(batch: InteractionBatch, training: TrainConfig) -> Split:
    outcomes = training.outcomes or ()
    usable = np.flatnonzero(np.isin(batch.outcome, outcomes) & (valid_lengths(batch) >= 2))
    if len(usable) == 0:
        present = ", ".join(np.unique(batch.outcome).tolist()) or "none"
        raise TrainingError(
            f"no interaction has an outcome among {', '.join(outcomes)}; the data has: {present}"
        )
    drawn = split_by_seed(len(usable), training.seed, training.split)
    return Split(usable[drawn.train], usable[drawn.validation], usable[drawn.test])


def _hash_split(split: Split) -> str:
    return short_hash(json.dumps([rows.tolist() for rows in asdict(split).values()]).encode())


def _prepare(batch: InteractionBatch, predictor: EffectPredictor, inputs: Tensor | None = None) -> _Part:
    inputs = predictor.features.inputs(batch) if inputs is None else inputs
    context = recorded_context(batch, predictor.context)
    valid = valid_samples(batch, predictor.lengths(batch))
    return _Part(batch, inputs, context, predictor.encode(batch), valid)


@contextmanager
def _made(
    predictor: PredictorConfig | EffectPredictor,
    training: TrainConfig,
    batch: InteractionBatch,
    threads: int | None,
) -> Iterator[EffectPredictor]:
    """The untrained predictor on its device; PyTorch's threads set, its random numbers seeded for the training."""
    device, num_samples = find_device(training.device), batch.com.shape[1]
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
