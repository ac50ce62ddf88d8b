"""The training of a predictor: one loop for all of them (paper, section 4)."""

import hashlib
import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from foretrace.errors import TrainingError
from foretrace.features import FeatureExtractor, make_features
from foretrace.features.base import FitPart, Option, fast_precision
from foretrace.features.fitting import learning_rate
from foretrace.interactions.dataset import Dataset, InteractionBatch
from foretrace.interactions.splits import PAPER_SIZES, Split, split_by_seed
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.checkpoint import PREDICTORS, load_tensors, read_tensors, settings_of
from foretrace.predictor.context import check_names, observed_values
from foretrace.predictor.display import tensorboard, terminal
from foretrace.predictor.domain import ranges_of
from foretrace.predictor.files import write_tensors
from foretrace.predictor.lstm import LstmConfig, LstmPredictor
from foretrace.predictor.one_shot import OneShotConfig, OneShotPredictor
from foretrace.predictor.optimizer import make_optimizer
from foretrace.predictor.run_folder import TENSORBOARD, Progress, Row, RunFolder, fingerprint
from foretrace.predictor.runtime import find_device, seeded, thread_count
from foretrace.predictor.states import (
    Effects,
    StateKind,
    state_statistics,
    valid_lengths,
    valid_samples,
)
from foretrace.trajectories import final_distance, mean_distance


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training; the defaults are the paper's where the paper says (section 4)."""

    features: str = "im-cnn"
    """What the predictor knows about the object: a label of FEATURES."""
    feature_options: dict[str, Option] = field(default_factory=dict)
    """Settings of the feature extractor, by name."""
    state: StateKind = "position"
    """What is predicted: the centre of mass, or the whole pose."""
    steps_ahead: int = 1
    """States predicted per iteration (n in the paper)."""
    hidden: int = 256
    """LSTM units."""
    window: int = 15
    """States per training sequence; the LSTM's memory is carried on to the next one."""
    residual: bool = True
    """Whether the network predicts changes of the state, instead of states as in the paper."""
    known: tuple[str, ...] = ()
    """What the predictor is told beside the view, by the names of `Physics` and `Stroke`."""
    epochs: int = 15
    """Passes over the training part, unless ``min_steps`` asks for more."""
    min_steps: int = 300
    """Optimiser steps, at least: a small training part is passed over more often."""
    batch_size: int = 32
    """Trajectories per optimiser step."""
    learning_rate: float = 8e-3
    """Adam's largest learning rate: it is reached after a tenth of the steps and falls to 0 along a cosine."""
    outcomes: tuple[str, ...] = ("levered",)
    """Outcomes of the interactions to learn from and to judge by."""
    split: tuple[int, int, int] | None = PAPER_SIZES
    """Sizes of the training, validation and test parts; None for the paper's proportions."""
    seed: int = 0
    """Seed of the split, the first weights, the order and the dropout."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; ``auto`` takes a CUDA device if there is one."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Number format of the convolutions in training; ``auto`` takes what the device multiplies fastest."""
    threads: int | None = None
    """Threads of PyTorch on the CPU; None leaves its choice. More than the idle cores make it slower."""
    predictor: str = "lstm"
    """What kind of predictor: a label of PREDICTORS. ``one-shot`` needs the features ``outline``, always predicts
    poses, and of the settings of networks looks at ``hidden`` and ``predictor_options``."""
    predictor_options: dict[str, Option] = field(default_factory=dict)
    """Further settings of the one-shot predictor, by their names in `OneShotConfig`."""

    def __post_init__(self) -> None:
        limits = {"hidden": 4096, "steps_ahead": 1000, "threads": 1024}
        for name in ("steps_ahead", "hidden", "window", "epochs", "min_steps", "batch_size", "threads"):
            value, most = getattr(self, name), limits.get(name, 1_000_000)
            if value is not None and not 1 <= value <= most:
                raise TrainingError(f"{name} is {value}: give a number from 1 to {most}")
        if not self.learning_rate > 0:
            raise TrainingError(f"learning_rate must be positive, not {self.learning_rate}")
        check_names(self.known)
        if self.predictor not in PREDICTORS:
            raise TrainingError(f"unknown predictor {self.predictor!r}; available: {', '.join(PREDICTORS)}")

    def num_epochs(self, size: int) -> int:
        """Passes over a training part of so many interactions."""
        return max(self.epochs, math.ceil(self.min_steps / math.ceil(size / self.batch_size)))

    def make_predictor(self, num_samples: int) -> EffectPredictor:
        """The untrained predictor that these settings ask for."""
        features = make_features(self.features, **self.feature_options)
        if self.predictor == OneShotPredictor.label:
            allowed = {f.name for f in fields(OneShotConfig)} - {"hidden", "known", "outcomes"}
            if odd := sorted(self.predictor_options.keys() - allowed):
                raise TrainingError(
                    f"the one-shot predictor has no option {odd[0]!r}; it has: {', '.join(sorted(allowed))}"
                )
            chosen: dict[str, Any] = dict(self.predictor_options)
            shot = OneShotConfig(self.hidden, known=self.known, outcomes=self.outcomes, **chosen)
            return OneShotPredictor(features, num_samples, shot)
        if self.predictor_options:
            raise TrainingError(
                f"the {self.predictor} predictor has no further options: leave out predictor_options"
            )
        settings = LstmConfig(
            self.state, self.steps_ahead, self.hidden, self.window, self.residual, self.known
        )
        return LstmPredictor(features, num_samples, settings)


RECIPES = {
    "lstm": TrainConfig(),
    "one-shot": TrainConfig(
        predictor="one-shot", features="outline", hidden=128, epochs=150, learning_rate=4e-3
    ),
}
"""What a kind of predictor is trained with, unless somebody asks for something else; keys are those of PREDICTORS."""


@dataclass(frozen=True)
class _Part:
    """One part of the data, ready to learn from."""

    batch: InteractionBatch
    inputs: Tensor
    """Inputs of the features."""
    known: np.ndarray
    """(batch, known) constants that the predictor is told [SI]."""
    states: np.ndarray
    """(batch, time, state) in the action frame [m], zeros past the length."""
    valid: np.ndarray
    """(batch, time) bool: the samples within it."""


def fit_predictor(
    batch: InteractionBatch,
    config: TrainConfig,
    split: Split,
    *,
    inputs: Tensor | None = None,
    fitted: Path | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> tuple[EffectPredictor, Progress]:
    """Train a predictor in memory; `train_predictor` does the same and leaves a folder.

    Args:
        batch: The interactions.
        config: Settings; its ``split`` is not looked at, and its ``outcomes`` only by predictors that tell them apart.
        split: Rows of ``batch`` in each part, all with at least two valid samples.
        inputs: What the features' ``inputs`` make of the whole ``batch``, where that is known already.
        fitted: Folder that keeps what feature extractors have learned on their own, for further trainings on the
            same parts and seed.
        report: Takes a line on the progress.

    Returns:
        The predictor of the best validation epoch, and the metrics of all epochs.

    Raises:
        TrainingError: Unknown features or device, or a loss that is no longer finite.
    """
    with thread_count(config.threads), _made(config, batch) as predictor:
        keeper = _Memory()
        inputs = predictor.features.inputs(batch) if inputs is None else inputs
        train, validation = (
            _prepare(batch[rows], predictor, inputs[rows]) for rows in (split.train, split.validation)
        )
        progress = _Training(config, predictor, keeper, train, validation, fitted).run(report)
    return predictor.eval(), progress


def train_predictor(
    data: InteractionBatch | Dataset,
    config: TrainConfig,
    out: str | Path,
    resume: bool = True,
    split: Split | None = None,
    progress: bool = True,
) -> Path:
    """Train a predictor and keep the model of its best validation epoch.

    After every epoch all that is needed to go on is on disk: the same call continues a training that was
    killed and ends with the same model, to the bit on a CPU, as if that had never happened.

    Args:
        data: The interactions.
        config: Settings.
        out: Folder of the training: ``config.json``, ``model.safetensors``, ``metrics.csv``,
            ``environment.json``, ``split.json`` and TensorBoard events.
        resume: Go on with an unfinished training in ``out``; otherwise discard it.
        split: Rows of ``data`` in each part, all with at least two valid samples; drawn by the seed among the
            chosen outcomes if not given.
        progress: Show a progress bar.

    Returns:
        The folder.

    Raises:
        TrainingError: Unknown features or device, a split larger than the data, a folder in use, or a loss
            that is no longer finite.
    """
    batch = data if isinstance(data, InteractionBatch) else data.batch()
    split = _choose_split(batch, config) if split is None else split
    folder = RunFolder(out)
    with thread_count(config.threads), _made(config, batch) as predictor:
        surroundings = ("device", "threads", "precision")
        training = {name: value for name, value in settings_of(config).items() if name not in surroundings}
        training |= {"data": fingerprint(batch, config.known), "rows": _hash_split(split)}
        folder.start(predictor, training, resume)
        if folder.finished:
            return folder.path
        folder.write_split(batch, split)
        threads = torch.get_num_threads()
        folder.write_environment(
            {"seed": config.seed, "data": training["data"], "device": str(predictor.device)}
            | {"precision": predictor.features.precision, "threads": threads}
        )
        train, validation = (_prepare(batch[rows], predictor) for rows in (split.train, split.validation))
        with (
            terminal(config.num_epochs(len(split.train)), progress) as (report, show),
            tensorboard(folder.path / TENSORBOARD) as log,
        ):

            def tell(row: Row, done: Progress) -> None:
                log(row)
                show(row, done)

            _Training(config, predictor, folder, train, validation).run(report, tell)
    folder.close(predictor)
    return folder.path


class _Memory:
    """Keeps the best model as a `RunFolder` does, but not beyond the process."""

    model: dict[str, Tensor]

    def save(self, progress: Progress, predictor: EffectPredictor, optimizer: torch.optim.Optimizer) -> None:
        """Note the end of an epoch."""
        if progress.best_epoch == progress.epoch:
            self.model = {name: tensor.clone() for name, tensor in predictor.state_dict().items()}

    def restore(self, predictor: EffectPredictor, optimizer: torch.optim.Optimizer) -> None:
        """There is never anything to go on from."""

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
        predictor.set_known(train.known)
        self.effects = self._effects_of(train)
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
            self._prepare_predictor()
            self.keeper.save(done, self.predictor, self.optimizer)
        fixed = None if self.predictor.features.trainable else self._features_of(self.train)
        fixed_validation = None if fixed is None else self._features_of(self.validation)
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
        if type(self.predictor).finish is not EffectPredictor.finish:
            with torch.no_grad():
                self.predictor.finish(
                    *(self._features_of(self.train), self.effects),
                    *(self._features_of(self.validation), self._effects_of(self.validation)),
                )
            self.keeper.finish(self.predictor)
        batch, inputs = self.train.batch, self.train.inputs
        self.predictor.ranges = ranges_of(self.predictor.measure(batch, batch.com[:, 0], inputs))
        return done

    def _fit_features(self, report: Callable[[str], None]) -> None:
        features, device, seed = self.predictor.features, self.predictor.device, self.config.seed
        train, validation = (FitPart(p.inputs.to(device), p.batch) for p in (self.train, self.validation))
        if self.fitted is None or type(features).fit is FeatureExtractor.fit:
            features.fit(train, validation, seed=seed, report=report)
            return
        options = json.dumps([features.label, features.options, features.precision, seed])
        digest = hashlib.sha256(options.encode())
        for part in (train, validation):
            digest.update(
                part.inputs.cpu().contiguous().numpy().tobytes() + part.batch.support_points.tobytes()
            )
        file = self.fitted / f"{features.label}-{digest.hexdigest()[:16]}.safetensors"
        if file.is_file():
            load_tensors(features, read_tensors(file), file)
        else:
            features.fit(train, validation, seed=seed, report=report)
            self.fitted.mkdir(parents=True, exist_ok=True)
            write_tensors(file, features.state_dict())

    def _prepare_predictor(self) -> None:
        if type(self.predictor).prepare is not EffectPredictor.prepare:
            with torch.no_grad():
                self.predictor.prepare(self._features_of(self.train), self.effects)

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

    def _features_of(self, part: _Part) -> Tensor:
        return self.predictor.add_known(self.predictor.compute_features(part.inputs), part.known)

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
                    features = predictor.add_known(features, self.train.known[rows.numpy()])
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


def _choose_split(batch: InteractionBatch, config: TrainConfig) -> Split:
    usable = np.flatnonzero(np.isin(batch.outcome, config.outcomes) & (valid_lengths(batch) >= 2))
    if len(usable) == 0:
        present = ", ".join(np.unique(batch.outcome).tolist()) or "none"
        raise TrainingError(
            f"no interaction has an outcome among {', '.join(config.outcomes)}; the data has: {present}"
        )
    drawn = split_by_seed(len(usable), config.seed, config.split)
    return Split(usable[drawn.train], usable[drawn.validation], usable[drawn.test])


def _hash_split(split: Split) -> str:
    text = json.dumps([rows.tolist() for rows in asdict(split).values()])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _prepare(batch: InteractionBatch, predictor: EffectPredictor, inputs: Tensor | None = None) -> _Part:
    inputs = predictor.features.inputs(batch) if inputs is None else inputs
    known = observed_values(batch, predictor.known)
    valid = valid_samples(batch, predictor.lengths(batch))
    return _Part(batch, inputs, known, predictor.encode(batch), valid)


@contextmanager
def _made(config: TrainConfig, batch: InteractionBatch) -> Iterator[EffectPredictor]:
    """The untrained predictor on its device, and PyTorch's random numbers seeded for its training."""
    device = find_device(config.device)
    with seeded(config.seed, 0, device):
        predictor = config.make_predictor(batch.com.shape[1]).to(device)
        predictor.set_precision(fast_precision(device) if config.precision == "auto" else config.precision)
        yield predictor
