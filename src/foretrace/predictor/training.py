"""The training of a predictor: one loop for all of them (paper, section 4)."""

import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from foretrace.errors import TrainingError, check_type, shown
from foretrace.features.base import FitPart, fast_precision
from foretrace.features.fitting import learning_rate
from foretrace.files import as_path, short_hash
from foretrace.imagined.domain import measure_context, ranges_of, wider
from foretrace.interactions.dataset import Dataset, InteractionBatch, count_outcomes
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import Split
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.checkpoint import load_tensors, read_tensors, write_tensors
from foretrace.predictor.config import FINE_TUNING, PredictorConfig, TrainConfig
from foretrace.predictor.display import tensorboard, terminal
from foretrace.predictor.parts import (
    Part,
    check_split,
    choose_split,
    effects_of,
    features_of,
    outcome_of,
    prepare,
    usable_lengths,
)
from foretrace.predictor.run_folder import (
    INITIAL,
    TENSORBOARD,
    Progress,
    Row,
    RunFolder,
    Source,
    fingerprint,
    first_of,
)
from foretrace.predictor.runtime import find_device, seeded, suitable_threads, thread_count
from foretrace.predictor.states import state_statistics
from foretrace.trajectories import final_distance, mean_distance, rhythm

RUNTIME = ("device", "threads", "precision")
"""Settings that say where a training runs, not what it ends with."""

FULL_RATE_INPUTS = 256
"""Units with more inputs than this learn at a lower rate."""
FEATURE_DECAY = 1 / 800
"""Weight decay per feature."""
PIECE = 2048
"""Rows that are imagined together."""
IN_MEMORY = 4_000
"""A data set of more interactions is prepared piece by piece: it need not fit into memory."""


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
        predictor: Its settings, or a predictor, which is trained in place; one that was trained before is fine-tuned,
            see `train_predictor`.
        split: Rows of ``batch`` in each part, all with at least two valid samples.
        training: Settings of the loop, of which ``split``, ``outcomes`` and ``first`` are not looked at; by default
            those that the predictor's settings recommend.
        inputs: The features' ``inputs`` of the whole ``batch``, where they are known already.
        fitted: Folder that keeps what feature extractors have learned on their own, for further trainings on the
            same parts and seed.
        report: Takes a line on the progress.

    Returns:
        The predictor of the best validation epoch, and the metrics of all epochs.

    Raises:
        TrainingError: The predictor does not fit the data, or the loss is no longer finite.
    """
    check_type("batch", batch, InteractionBatch, TrainingError)
    check_type("split", split, Split, TrainingError)
    training = _loop_settings(predictor, training)
    with _made(predictor, training, batch, training.threads) as made:
        made.learned_from = _learned(made, batch, split)
        inputs = made.features.inputs(batch) if inputs is None else inputs
        train, validation = (
            prepare(batch[rows], made, inputs[rows]) for rows in (split.train, split.validation)
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

    A predictor that was trained before is fine-tuned: it starts from its weights, and keeps how it normalises and what
    else it took from its first training part; new data only widen its ranges. Interactions may be observed for a
    shorter time than it imagines. Its regions and probabilities are fitted to the new validation part, as far as that
    is large enough.

    Args:
        data: The interactions.
        predictor: Its settings, or a predictor, which is trained in place.
        out: Folder of the training: ``config.json``, ``model.safetensors``, ``metrics.csv``,
            ``environment.json``, ``split.json`` and TensorBoard events.
        training: Settings of the loop; by default those that the predictor's settings recommend.
        resume: Go on with an unfinished training in ``out``; otherwise discard it.
        split: Rows of ``data``, or of its first ones if ``training`` says so, in each part, all with at least two valid
            samples; drawn by the seed among the chosen outcomes if not given.
        progress: Show a progress bar.

    Returns:
        The folder.

    Raises:
        TrainingError: The predictor does not fit the data, the split is larger than the data, the folder is in use, or
            the loss is no longer finite.
    """
    check_type("data", data, (InteractionBatch, Dataset), TrainingError)
    training = _loop_settings(predictor, training)
    check_type("split", split, (Split, type(None)), TrainingError)
    data = first_of(data, training.first)
    source = data.batch() if isinstance(data, Dataset) and len(data) <= IN_MEMORY else data
    folder = RunFolder(as_path(out, TrainingError))
    threads = training.threads or (folder.threads if resume else None)
    with _made(predictor, training, source, threads) as made:
        training = replace(training, outcomes=training.outcomes or made.outcomes or (str(Outcome.LEVERED),))
        split = choose_split(source, training) if split is None else split
        check_split(split, usable_lengths(source))
        made.learned_from = _learned(made, source, split)
        described = {name: value for name, value in asdict(training).items() if name not in RUNTIME}
        described |= {
            "data": fingerprint(source, made.context),
            "rows": short_hash([json.dumps([rows.tolist() for rows in asdict(split).values()]).encode()]),
        }
        if made.fine_tuned:
            described[INITIAL] = _digest(made)
        if resume and folder.finished:  # nothing is written
            folder.start(made, described, resume)
            return folder.path
        with folder.claimed():
            folder.start(made, described, resume)
            if not folder.finished:
                _train_into(folder, source, split, made, training, described["data"], progress)
    return folder.path


def _train_into(
    folder: RunFolder,
    source: Source,
    split: Split,
    predictor: EffectPredictor,
    training: TrainConfig,
    data: str,
    progress: bool,
) -> None:
    """Train a predictor in a folder that holds its configuration; ``data`` is the fingerprint of the interactions."""
    folder.write_split(source, split)
    folder.write_environment(
        {"seed": training.seed, "data": data, "device": str(predictor.device)}
        | {"precision": predictor.features.precision, "threads": torch.get_num_threads()}
    )
    train, validation = (
        prepare(source[rows], predictor, folder=folder.path) for rows in (split.train, split.validation)
    )
    with (
        terminal(training.num_epochs(len(split.train)), progress) as (report, show),
        tensorboard(folder.path / TENSORBOARD) as log,
    ):

        def show_and_log(row: Row, done: Progress) -> None:
            log(row)
            show(row, done)

        _Training(training, predictor, folder, train, validation).run(report, show_and_log)
    folder.close(predictor)


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
        train: Part,
        validation: Part,
        fitted: Path | None = None,
    ):
        self.config, self.predictor, self.keeper, self.fitted = config, predictor, keeper, fitted
        self.train, self.validation = train, validation
        self.epochs = config.num_epochs(len(train))
        if not predictor.fine_tuned:
            mean, scale = state_statistics(train.states, train.valid, predictor.state)
            predictor.set_normalisation(mean, scale, train.source.times)
            predictor.set_context(train.context)
        self.effects = effects_of(train, predictor, in_place=train.large)
        # The loss of a state's small change is small: the usual epsilon of 1e-8 would outweigh its gradient.
        groups = parameter_groups(predictor)
        if not groups:
            raise TrainingError(
                f"predictor {shown(predictor.label)} has no parameters to train: create them in __init__"
            )
        self.optimizer = torch.optim.AdamW(groups, eps=1e-12, fused=True)

    def run(
        self,
        report: Callable[[str], None],
        show: Callable[[Row, Progress], None] = lambda row, progress: None,
    ) -> Progress:
        """Train until the last epoch."""
        done = self.keeper.restore(self.predictor, self.optimizer)
        if done is None:
            done = Progress()
            if not self.predictor.fine_tuned:
                self._fit_features(report)
                with torch.no_grad():
                    self.predictor.prepare(self._features_of(self.train), self.effects)
            self.keeper.save(done, self.predictor, self.optimizer)
        while done.epoch < self.epochs:
            started = perf_counter()
            row = {"epoch": done.epoch + 1, "train_loss": self._epoch(done.epoch + 1)}
            row |= self._validate()
            row |= {
                "learning_rate": self.optimizer.param_groups[0]["lr"],
                "seconds": perf_counter() - started,
            }
            done = done.with_epoch(row, self.predictor.keeps_last_epoch)
            self.keeper.save(done, self.predictor, self.optimizer)
            show(row, done)
        self.predictor.load_state_dict(self.keeper.model)
        with torch.no_grad():
            features, other_features = self._features_of(self.train), self._features_of(self.validation)
            other_effects = effects_of(self.validation, self.predictor)
            self.predictor.finish(features, self.effects, other_features, other_effects)
        self.keeper.finish(self.predictor)
        told = measure_context(self.predictor.context, self.train.context)
        self.predictor.ranges = wider(self.predictor.ranges, ranges_of(self.train.measures | told))
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

    def _features_of(self, part: Part) -> Tensor:
        return features_of(part, self.predictor)

    def _epoch(self, epoch: int) -> float:
        """One pass over the training part; the mean loss."""
        predictor, optimizer, device = self.predictor, self.optimizer, self.predictor.device
        order = np.random.default_rng([self.config.seed, epoch]).permutation(len(self.effects))
        fixed = None if predictor.features.trainable else self._features_of(self.train)
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
                loss = predictor.training_loss(*predictor.augment(features, self.effects[rows]))
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

    def _validate(self) -> Row:
        """Errors of the whole roll-out from the first state alone."""
        part, predictor = self.validation, self.predictor
        features = self._features_of(part)
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


def parameter_groups(predictor: EffectPredictor) -> list[dict[str, Any]]:
    """What is trainable, grouped by its share of the learning rate and by its weight decay.

    One step of Adam changes every weight by about the learning rate, and so what a unit sees by that times its
    number of inputs. From ``FULL_RATE_INPUTS`` inputs on the rate is therefore lowered in proportion (Yang et
    al., 2021, "Tensor programs V"). The weights of the features keep the full rate and decay in proportion to
    the number of features instead (Loshchilov and Hutter, 2019): thousands of them tell every training object
    apart, four do not.
    """
    readers = {id(parameter) for parameter in predictor.feature_weights}
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    for parameter in predictor.parameters():
        if parameter.requires_grad:
            inputs = parameter[0].numel() if parameter.dim() > 1 else 0
            if id(parameter) in readers:
                key = 1.0, FEATURE_DECAY * inputs
            else:
                key = min(1.0, FULL_RATE_INPUTS / max(1, inputs)), 0.0
            groups.setdefault(key, []).append(parameter)
    return [{"params": p, "share": share, "weight_decay": decay} for (share, decay), p in groups.items()]


def _learned(predictor: EffectPredictor, source: Source, split: Split) -> tuple[str, ...]:
    """Outcomes that occur in the training part, in the order in which actions name them; and in those before."""
    before = predictor.learned_from if predictor.fine_tuned else ()
    return tuple(count_outcomes(Counter([*before, *outcome_of(source)[split.train].tolist()])))


def _digest(predictor: EffectPredictor) -> str:
    """A checksum of a predictor's tensors."""
    tensors = predictor.state_dict().values()
    return short_hash([tensor.cpu().contiguous().numpy().tobytes() for tensor in tensors])


def _loop_settings(predictor: PredictorConfig | EffectPredictor, training: TrainConfig | None) -> TrainConfig:
    check_type("predictor", predictor, (PredictorConfig, EffectPredictor), TrainingError)
    check_type("training", training, (TrainConfig, type(None)), TrainingError)
    if training is not None:
        return training
    if not isinstance(predictor, EffectPredictor):
        return predictor.training
    return FINE_TUNING if predictor.is_trained else predictor.config.training


@contextmanager
def _made(
    predictor: PredictorConfig | EffectPredictor,
    training: TrainConfig,
    source: Source,
    threads: int | None,
) -> Iterator[EffectPredictor]:
    """The predictor on its device; PyTorch's threads set, its random numbers seeded for the training."""
    device, num_samples = find_device(training.device), len(source.times)
    with seeded(training.seed, 0, device), thread_count(threads):
        made = predictor if isinstance(predictor, EffectPredictor) else predictor.make(num_samples)
        made.fine_tuned = made.is_trained
        if made.fine_tuned:
            _check_times(made, source)
        elif made.num_samples != num_samples:
            raise TrainingError(
                f"the predictor imagines {made.num_samples} samples, the data have {num_samples}: make it for these"
            )
        made = made.to(device)
        made.set_precision(fast_precision(device) if training.precision == "auto" else training.precision)
        with thread_count(threads or suitable_threads(made)):
            yield made


def _check_times(predictor: EffectPredictor, source: Source) -> None:
    """Refuse data that a predictor cannot learn more from, as they were sampled at other times or for longer."""
    times, own = np.round(source.times, 9), np.round(predictor.sample_times, 9)
    if not np.array_equal(times, own[: len(times)]):
        raise TrainingError(
            f"the data are sampled {rhythm(times)}, the predictor imagines motions {rhythm(own)}: take data with its "
            f"period, and for at most {own[-1]:g} s"
        )
