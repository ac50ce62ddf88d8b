"""The training of a predictor: one loop for all of them (paper, section 4)."""

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np
import torch
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar
from torch import Tensor

from foretrace.errors import TrainingError
from foretrace.features import make_features
from foretrace.features.base import FitPart, Option, fast_precision
from foretrace.interactions.dataset import Dataset, InteractionBatch
from foretrace.interactions.splits import PAPER_SIZES, Split, split_by_seed
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.lstm import LstmConfig, LstmPredictor
from foretrace.predictor.run_folder import TENSORBOARD, Progress, Row, RunFolder, fingerprint
from foretrace.predictor.states import (
    StateKind,
    encode_states,
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
    epochs: int = 100
    """Passes over the training part, at most."""
    batch_size: int = 32
    """Trajectories per optimiser step."""
    learning_rate: float = 1e-3
    """Adam's learning rate at the start."""
    plateau_factor: float = 0.8
    """The learning rate is multiplied by this when the validation loss has stopped falling; 1 to keep it."""
    plateau_patience: int = 5
    """Epochs without a smaller validation loss before that happens."""
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

    def __post_init__(self) -> None:
        for name in ("steps_ahead", "hidden", "window", "epochs", "batch_size"):
            if getattr(self, name) < 1:
                raise TrainingError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not self.learning_rate > 0:
            raise TrainingError(f"learning_rate must be positive, not {self.learning_rate}")

    def make_predictor(self, num_samples: int) -> EffectPredictor:
        """The untrained predictor that these settings ask for."""
        features = make_features(self.features, **self.feature_options)
        settings = LstmConfig(self.state, self.steps_ahead, self.hidden, self.window, self.residual)
        return LstmPredictor(features, num_samples, settings)


@dataclass(frozen=True)
class _Part:
    """One part of the data, ready to learn from."""

    batch: InteractionBatch
    inputs: Tensor
    """Inputs of the features."""
    states: np.ndarray
    """(batch, time, state) in the action frame [m], zeros past the valid length."""


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
    device = find_device(config.device)
    precision = fast_precision(device) if config.precision == "auto" else config.precision
    folder = RunFolder(out)
    with _seeded(config.seed, 0, device), _thread_count(config.threads):
        predictor = config.make_predictor(batch.com.shape[1])
        surroundings = ("device", "threads", "precision")
        training = {name: value for name, value in asdict(config).items() if name not in surroundings}
        training |= {"data": fingerprint(batch), "rows": _hash_split(split)}
        folder.start(predictor, training, resume)
        if folder.finished:
            return folder.path
        folder.write_split(batch, split)
        threads = torch.get_num_threads()
        folder.write_environment(
            {"seed": config.seed, "data": training["data"], "device": str(device), "precision": precision}
            | {"threads": threads}
        )
        predictor.to(device)
        predictor.features.precision = precision
        parts = [_prepare(batch[rows], predictor) for rows in (split.train, split.validation)]
        _Training(config, predictor, folder, *parts).run(progress)
    folder.finish()
    return folder.path


class _Training:
    """The loop over epochs."""

    def __init__(
        self,
        config: TrainConfig,
        predictor: EffectPredictor,
        folder: RunFolder,
        train: _Part,
        validation: _Part,
    ):
        self.config, self.predictor, self.folder = config, predictor, folder
        self.train, self.validation = train, validation
        valid = valid_samples(train.batch)
        mean, scale = state_statistics(train.states, valid, predictor.state)
        predictor.set_normalisation(mean, scale, train.batch.times)
        self.states = (
            predictor.normalise(train.states) * torch.from_numpy(valid).to(predictor.device)[..., None]
        )
        self.lengths = torch.from_numpy(valid_lengths(train.batch)).to(predictor.device)
        self.optimizer = torch.optim.Adam(
            [p for p in predictor.parameters() if p.requires_grad], lr=config.learning_rate, fused=True
        )

    def run(self, show_progress: bool) -> None:
        """Train until the last epoch."""
        with _display(self.config.epochs, show_progress) as (report, show):
            done = self.folder.restore(self.predictor, self.optimizer)
            if done is None:
                done = Progress()
                self._fit_features(report)
                self.folder.save(done, self.predictor, self.optimizer)
            fixed = None if self.predictor.features.trainable else self._features_of(self.train)
            fixed_validation = None if fixed is None else self._features_of(self.validation)
            with _tensorboard(self.folder.path / TENSORBOARD, done.epoch) as log:
                while done.epoch < self.config.epochs:
                    started = perf_counter()
                    rate = learning_rate(self.config, [row["validation_loss"] for row in done.history])
                    row = {"epoch": done.epoch + 1, "train_loss": self._epoch(done.epoch + 1, rate, fixed)}
                    row |= self._validate(fixed_validation)
                    row |= {"learning_rate": rate, "seconds": perf_counter() - started}
                    done = done.with_epoch(row)
                    self.folder.save(done, self.predictor, self.optimizer)
                    log(row)
                    show(row, done)

    def _fit_features(self, report: Callable[[str], None]) -> None:
        device = self.predictor.device
        train, validation = (FitPart(p.inputs.to(device), p.batch) for p in (self.train, self.validation))
        self.predictor.features.fit(train, validation, seed=self.config.seed, report=report)

    def _features_of(self, part: _Part) -> Tensor:
        return self.predictor.compute_features(part.inputs)

    def _epoch(self, epoch: int, rate: float, fixed: Tensor | None) -> float:
        """One pass over the training part; the mean loss. ``fixed`` are features that do not change."""
        predictor, optimizer, device = self.predictor, self.optimizer, self.predictor.device
        for group in optimizer.param_groups:
            group["lr"] = rate
        order = np.random.default_rng([self.config.seed, epoch]).permutation(len(self.states))
        total = torch.zeros((), device=device)
        predictor.train()
        with _seeded(self.config.seed, epoch, device):
            for rows in torch.from_numpy(order).split(self.config.batch_size):
                features = (
                    predictor.features(self.train.inputs[rows].to(device)) if fixed is None else fixed[rows]
                )
                loss = predictor.training_loss(features, self.states[rows], self.lengths[rows])
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
        valid = valid_samples(part.batch)
        off = (imagined - part.states)[valid] / predictor.state_scale.cpu().numpy()
        truth = np.where(valid[..., None], part.batch.com, np.nan)
        return {
            "validation_loss": float(np.mean(off**2)),
            "validation_full_cm": 100 * float(np.mean(mean_distance(imagined[..., :3], truth))),
            "validation_final_cm": 100 * float(np.mean(final_distance(imagined[..., :3], truth))),
        }


def learning_rate(config: TrainConfig, losses: list[float]) -> float:
    """The rate for the next epoch, given the validation losses so far: lowered on every plateau."""
    rate, best, waited = config.learning_rate, float("inf"), 0
    for loss in losses:
        best, waited = (loss, 0) if loss < best else (best, waited + 1)
        if waited > config.plateau_patience:
            rate, waited = rate * config.plateau_factor, 0
    return rate


def find_device(name: str) -> torch.device:
    """The device of a name.

    Raises:
        TrainingError: ``cuda`` was asked for and there is none.
    """
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise TrainingError("device 'cuda' was asked for and PyTorch finds none here: use 'auto' or 'cpu'")
    return torch.device("cuda" if available and name != "cpu" else "cpu")


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


def _prepare(batch: InteractionBatch, predictor: EffectPredictor) -> _Part:
    return _Part(batch, predictor.features.inputs(batch), encode_states(batch, predictor.state))


@contextmanager
def _seeded(seed: int, epoch: int, device: torch.device) -> Iterator[None]:
    """PyTorch's random numbers from a seed for a while, and afterwards the caller's as they were.

    Every epoch has its own seed, so that a resumed training needs no state of a generator.
    """
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(int(np.random.SeedSequence([seed, epoch]).generate_state(1)[0]))
        yield


@contextmanager
def _thread_count(threads: int | None) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _tensorboard(path: Path, epoch: int) -> Iterator[Callable[[Row], None]]:
    """A function that logs a row of metrics for TensorBoard."""
    from torch.utils.tensorboard import SummaryWriter  # takes a second to import

    with SummaryWriter(str(path), purge_step=epoch + 1) as writer:

        def log(row: Row) -> None:
            for name, value in row.items():
                writer.add_scalar(name, value, int(row["epoch"]))
            writer.flush()

        yield log


@contextmanager
def _display(epochs: int, visible: bool) -> Iterator[tuple[Callable[[str], None], Callable[..., None]]]:
    """A progress bar: a function for lines of text and one for the end of an epoch."""
    columns = (TextColumn("epoch {task.completed:.0f}/{task.total:.0f}"), BarColumn())
    numbers = TextColumn("{task.description}")
    with ProgressBar(*columns, numbers, TimeRemainingColumn(), disable=not visible) as bar:
        task = bar.add_task("", total=epochs)

        def show(row: dict[str, Any], done: Progress) -> None:
            best = (
                done.history[done.best_epoch - 1]["validation_full_cm"] if done.best_epoch else float("nan")
            )
            text = (
                f"loss {row['train_loss']:.5f}, validation {row['validation_full_cm']:.2f} cm "
                f"(best {best:.2f} cm, epoch {done.best_epoch})"
            )
            bar.update(task, completed=done.epoch, description=text)

        yield bar.console.print, show
