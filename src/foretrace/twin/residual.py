"""What a twin gets wrong, learned from few real actions: a network over the twin's own motion."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from foretrace.errors import (
    CheckpointError,
    TrainingError,
    check_ranges,
    check_type,
    is_whole,
    shown,
)
from foretrace.features import Outline
from foretrace.features.base import UNIT
from foretrace.files import as_path, make_folder, read_versioned, write_json
from foretrace.geometry import rotation_vector_to_quaternion
from foretrace.imagined import (
    LEVELS,
    Futures,
    ImaginedBatch,
    Imaginer,
    Scenes,
    conformal_scores,
    quantiles_of,
)
from foretrace.imagined.observed import rotations_since_rest
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.hull import MAX_CORNERS
from foretrace.predictor.checkpoint import load_tensors, read_tensors, write_tensors
from foretrace.predictor.ensemble import Ensemble
from foretrace.predictor.mixture import COORDINATES, TURN_LENGTH, along_edges
from foretrace.predictor.pivot_edges import NUM_VALUES, find_pivot_edges
from foretrace.predictor.runtime import seeded, thread_count
from foretrace.predictor.trajectory_basis import find_basis
from foretrace.twin.imaginer import TwinImaginer

FORMAT, VERSION = "foretrace-residual", 1
CONFIG, MODEL = "residual.json", "residual.safetensors"
REMEDY = "train the residual again, and save that"
SAME = 0.01
"""An input that varies by less counts as constant, and is only shifted."""
FARTHEST = 3.0
"""Inputs further from the training part's mean than this are taken to be there [standard deviations]."""
FEWEST_STEPS = 4
"""A rate that rises and falls needs at least so many steps."""
TURN_WEIGHT = 0.5
"""Weight of the turn in the loss, beside 1 for the displacement."""
SCALE_WEIGHT = 0.02
"""Weight of the predicted error scale's own loss."""
LARGEST_ERROR = 3.0
"""Logarithm of the largest predicted error scale, in units of the residual's."""
TOLD = 2
"""Further inputs: whether the twin turns about the second candidate edge, and whether its object stays on the blade."""


@dataclass(frozen=True, kw_only=True)
class ResidualConfig:
    """Settings of a residual and of its training.

    Raises:
        TrainingError: A value is out of its range.
    """

    hidden: int = 128
    """Units of each hidden layer."""
    layers: int = 3
    """Hidden layers."""
    ensemble: int = 5
    """Networks that learn side by side and are averaged."""
    components: int = 24
    """Components of the PCA basis of residuals, at most."""
    seen: int = 12
    """Components of the PCA basis of the twin's motions that the networks are given."""
    epochs: int = 120
    """Passes over the training part."""
    min_steps: int = 300
    """Optimiser steps, at least."""
    batch_size: int = 32
    """Actions per optimiser step."""
    learning_rate: float = 4e-3
    """Adam's largest learning rate; it rises for a tenth of the steps and falls to 0 along a cosine."""
    weight_decay: float = 0.1
    """Decay of the weights, times the learning rate and step."""
    seed: int = 0
    """Seed of the first weights and of the order."""

    def __post_init__(self) -> None:
        limits = {
            "hidden": 4096, "layers": 32, "ensemble": 100, "components": 1024, "seen": 1024,
            "epochs": 1_000_000, "min_steps": 1_000_000, "batch_size": 1_000_000,
        }  # fmt: skip
        for name, most in limits.items():
            if not is_whole(value := getattr(self, name), 1, most):
                raise TrainingError(f"{name} is {shown(value)}: give a whole number from 1 to {most}")
        if not is_whole(self.seed, 0, 2**63 - 1):
            raise TrainingError(f"seed is {shown(self.seed)}: give a whole number from 0 on")
        check_ranges(
            TrainingError, "residual", self, {"learning_rate": (1e-9, 1.0), "weight_decay": (0.0, 100.0)}
        )


class ResidualEntries(TypedDict):
    """Schema of the file of settings."""

    config: dict[str, Any]
    times: list[float]
    interactions: int


@dataclass(frozen=True, eq=False)
class Priors:
    """Motions of twins, and what the residual is told about each, one row for each future."""

    motion: Float[Tensor, "batch time 6"]
    """Displacement of the centre of mass in the action frame [m], and rotation vector times ``TURN_LENGTH``."""
    values: Float[Tensor, "batch views inputs"]
    """The action relative to the edge that the twin turns about; and its mirror image."""
    axes: Float[Tensor, "batch views 3 3"]
    """Rows: the edge's axes in the action frame."""

    def __len__(self) -> int:
        return len(self.motion)

    def __getitem__(self, rows: Tensor) -> "Priors":
        return Priors(self.motion[rows], self.values[rows], self.axes[rows])


class ResidualNetwork(nn.Module):
    """From a twin's motion to the difference from the real one, in the frame of the edge that the twin turns about.

    Args:
        config: Settings.
        num_samples: Samples of a motion.
    """

    input_mean: Tensor
    input_scale: Tensor
    prior_mean: Tensor
    prior_basis: Tensor
    mean: Tensor
    basis: Tensor
    parity: Tensor
    profile: Tensor
    quantiles: Tensor

    def __init__(self, config: ResidualConfig, num_samples: int):
        super().__init__()
        inputs = NUM_VALUES + TOLD + config.seen
        widths = (inputs, *(config.hidden,) * config.layers, config.components + 1)
        self.networks = Ensemble(config.ensemble, widths)
        self.register_buffer("input_mean", torch.zeros(inputs))
        self.register_buffer("input_scale", torch.ones(inputs))
        self.register_buffer("prior_mean", torch.zeros(num_samples, COORDINATES))
        self.register_buffer("prior_basis", torch.zeros(config.seen, num_samples, COORDINATES))
        self.register_buffer("mean", torch.zeros(num_samples, COORDINATES))
        self.register_buffer("basis", torch.zeros(config.components, num_samples, COORDINATES))
        self.register_buffer("parity", torch.ones(config.components))
        self.register_buffer(
            "profile", torch.zeros(num_samples)
        )  # error by sample at an error scale of 1 [m]
        self.register_buffer("quantiles", torch.full((len(LEVELS),), torch.nan))

    def prepare(self, priors: Priors, residual: Float[Tensor, "batch time 6"]) -> None:
        """Find the bases of the twin's motions and of residuals, and the scale of the inputs.

        Args:
            priors: The training part.
            residual: Real motions minus those of the twin, in the action frame [m].
        """
        axes = priors.axes[:, 0]
        for motion, mean, basis, parity in (
            (priors.motion, self.prior_mean, self.prior_basis, None),
            (residual, self.mean, self.basis, self.parity),
        ):
            centre, components, signs = find_basis(along_edges(axes, motion), len(basis))
            mean.copy_(centre)
            basis[: len(components)] = components
            if parity is not None:
                parity[: len(signs)] = signs
        inputs = self._inputs(priors).flatten(0, 1)
        scale = inputs.std(dim=0, correction=0)
        self.input_mean.copy_(inputs.mean(dim=0))
        self.input_scale.copy_(torch.where(scale < SAME, 1.0, scale))

    def outputs(
        self, priors: Priors
    ) -> tuple[Float[Tensor, "ensemble batch views components"], Float[Tensor, "ensemble batch views"]]:
        """Weights of residuals in their basis, and logarithms of the error's scale."""
        inputs = self._inputs(priors)
        inputs = ((inputs - self.input_mean) / self.input_scale).clamp(-FARTHEST, FARTHEST)
        rows = inputs.flatten(0, 1).expand(self.networks.size, -1, -1)
        found = self.networks(rows).unflatten(1, inputs.shape[:2])
        return found[..., :-1], found[..., -1]

    def loss(self, priors: Priors, residual: Tensor, valid: Float[Tensor, "batch time"]) -> Float[Tensor, ""]:
        """Mean distance of motions, in units of the residuals', and that of its predicted scale."""
        weights, scale = self.outputs(priors)
        truth = along_edges(priors.axes, residual)  # (batch, views, time, 6)
        moved = (weights @ self.basis.flatten(1)).unflatten(-1, self.mean.shape) + self.mean
        apart = (moved - truth).unflatten(-1, (2, 3)).square().sum(dim=-1).add(1e-12).sqrt()
        apart = apart @ apart.new_tensor([1.0, TURN_WEIGHT])
        error = (apart * valid[:, None]).sum(dim=-1) / valid.sum(dim=-1).clamp(min=1)[:, None] / self._unit
        told = (scale + error.detach().clamp(min=1e-6) * torch.exp(-scale)).mean()
        return error.mean() + SCALE_WEIGHT * told

    def forward(self, priors: Priors) -> tuple[Float[Tensor, "batch time 6"], Float[Tensor, " batch"]]:
        """Residuals in the action frame [m], and the scale of their error in units of ``profile``."""
        weights, scale = self.outputs(priors)
        signs = torch.stack([torch.ones_like(self.parity), self.parity])
        mean = (weights * signs).mean(dim=(0, 2))
        moved = (mean @ self.basis.flatten(1)).unflatten(-1, self.mean.shape) + self.mean
        back = along_edges(priors.axes[:, 0].mT, moved)
        back[:, 0] = 0.0  # the start is known
        return back, scale.mean(dim=(0, 2)).clamp(-LARGEST_ERROR, LARGEST_ERROR).exp()

    @property
    def _unit(self) -> Tensor:
        """Size of residuals [m]."""
        return (
            self.basis[..., :3].square().sum(dim=(0, 2)) + self.mean[:, :3].square().sum(dim=1)
        ).mean().sqrt() + 1e-5

    def _inputs(self, priors: Priors) -> Float[Tensor, "batch views inputs"]:
        """What the networks are given, not yet standardised."""
        seen = along_edges(priors.axes, priors.motion) - self.prior_mean
        sizes = self.prior_basis.flatten(1).square().sum(dim=1).clamp(min=1e-12)
        weights = seen.flatten(2) @ self.prior_basis.flatten(1).mT / sizes
        return torch.cat([priors.values, weights], dim=-1)


class ResidualImaginer(Imaginer):
    """A twin, corrected by what a network has learned from real actions.

    Every future of the twin keeps its probability and outcome; its motion is corrected.

    Args:
        twin: The twin.
        network: What it gets wrong.
        config: Settings of the network.
        interactions: Number of actions learned from.
    """

    marginal = True

    def __init__(
        self, twin: TwinImaginer, network: ResidualNetwork, config: ResidualConfig, interactions: int
    ) -> None:
        self.twin, self.network, self.config, self.interactions = twin, network.eval(), config, interactions
        self.context = twin.context

    @property
    def sample_times(self) -> Float[np.ndarray, " time"]:
        """Times of the imagined samples [s]."""
        return self.twin.sample_times

    @property
    def name(self) -> str:
        """Name in messages."""
        return "residual"

    def imagine_scenes(self, scenes: Scenes) -> ImaginedBatch:
        """The twin's answer, corrected."""
        return self.correct(scenes.batch, scenes.com, self.twin.imagine_scenes(scenes))

    def correct(
        self, batch: InteractionBatch, com: Float[np.ndarray, "batch 3"], imagined: ImaginedBatch
    ) -> ImaginedBatch:
        """What a twin has imagined, corrected.

        Args:
            batch: The actions.
            com: Centres of mass at rest in the action frame [m].
            imagined: The twin's answer.
        """
        futures = imagined.futures
        rows, slots = np.nonzero(futures.probability > 0)
        priors = _priors(batch[rows], com[rows], _at(futures, rows, slots))
        with torch.inference_mode():
            moved, scale = self.network(priors)
        states = futures.states.copy()
        states[rows, slots] += _as_states(moved)
        spread = np.zeros_like(futures.spread)
        learned = scale[:, None].double().numpy() * self.network.profile.double().numpy()
        spread[rows, slots] = np.hypot(np.nan_to_num(futures.spread[rows, slots]), learned)
        best = futures.probability.argmax(axis=1)
        every = np.arange(len(futures))
        empty = futures.probability == 0
        states[empty], spread[empty] = (
            np.broadcast_to(part[every, best][:, None], part.shape)[empty] for part in (states, spread)
        )
        quantiles = self.network.quantiles.double().numpy()
        futures = replace(futures, states=states, spread=spread, quantiles=quantiles)
        found = states[every, best]
        pose = np.concatenate([found[..., :3], rotation_vector_to_quaternion(found[..., 3:])], axis=-1)
        return replace(imagined, com=found[..., :3], pose=pose, futures=futures)

    def save(self, folder: str | Path) -> None:
        """Write settings and weights of the network into a folder.

        Raises:
            TrainingError: The folder cannot be written.
        """
        folder = as_path(folder, TrainingError)
        make_folder(folder, TrainingError)
        content = {"config": asdict(self.config), "times": self.sample_times.tolist()}
        start = {"format": FORMAT, "version": VERSION, "interactions": self.interactions}
        write_json(folder / CONFIG, start | content)
        write_tensors(folder / MODEL, self.network.state_dict())

    @classmethod
    def load(cls, folder: str | Path, twin: TwinImaginer | None = None) -> "ResidualImaginer":
        """Read it from a folder.

        Args:
            folder: Where it was saved.
            twin: The twin that it corrects; by default one with the usual settings.

        Raises:
            CheckpointError: The folder holds none, or one of another version or for another twin.
        """
        folder, twin = as_path(folder, CheckpointError), twin or TwinImaginer()
        content = read_versioned(
            folder / CONFIG, ResidualEntries, FORMAT, VERSION, CheckpointError, REMEDY, key="version"
        )
        times = np.array(content["times"])
        if times.shape != twin.sample_times.shape or not np.allclose(
            times, twin.sample_times, rtol=0, atol=1e-9
        ):
            raise CheckpointError(
                f"{folder} holds a residual of motions with {len(times)} samples, the twin's have "
                f"{len(twin.sample_times)}: give a twin with the same sample_period and watch_time"
            )
        try:
            config = ResidualConfig(**content["config"])
        except (TypeError, TrainingError) as error:
            raise CheckpointError(f"{folder / CONFIG} has no usable settings ({error}): {REMEDY}") from error
        network = ResidualNetwork(config, len(times))
        load_tensors(network, read_tensors(folder / MODEL), folder / MODEL)
        return cls(twin, network, config, content["interactions"])


def train_residual(
    batch: InteractionBatch,
    validation: InteractionBatch,
    twin: TwinImaginer | None = None,
    config: ResidualConfig = ResidualConfig(),
    *,
    imagined: tuple[ImaginedBatch, ImaginedBatch] | None = None,
) -> ResidualImaginer:
    """Learn what a twin gets wrong.

    Args:
        batch: Actions to learn from, a few are enough.
        validation: Further ones, which decide the widths of regions and nothing else.
        twin: The twin; by default one with the usual settings. It is told what was recorded of each action.
        config: Settings.
        imagined: What the twin imagines of both, where that is known already.

    Raises:
        TrainingError: There is nothing to learn from, or samples are taken at other times than the twin's.
        PredictionError: As `Imaginer.imagine_batch`.
    """
    twin = twin or TwinImaginer()
    for name, part in (("batch", batch), ("validation", validation)):
        check_type(name, part, InteractionBatch, TrainingError)
        if not len(part):
            raise TrainingError(f"{name} is empty: give at least one interaction")
        times, wanted = part.times, twin.sample_times
        if len(times) != len(wanted) or not np.allclose(times, wanted, rtol=0, atol=1e-9):
            raise TrainingError(
                f"{name} has {len(times)} samples up to {shown(float(times[-1]))} s, the twin {len(wanted)} up to "
                f"{float(wanted[-1]):g} s: give a twin with the same sample_period and watch_time"
            )
    if imagined is None:
        imagined = twin.imagine_batch(batch), twin.imagine_batch(validation)
    network = _fit(config, *_examples(batch, imagined[0]))
    made = ResidualImaginer(twin, network, config, len(batch))
    _calibrate(made, validation, imagined[1])
    return made


def _fit(config: ResidualConfig, priors: Priors, residual: Tensor, valid: Tensor) -> ResidualNetwork:
    """Train a network."""
    steps = max(FEWEST_STEPS, config.min_steps, config.epochs * -(-len(priors) // config.batch_size))
    with seeded(config.seed, 0, torch.device("cpu")), thread_count(1):
        network = ResidualNetwork(config, residual.shape[1])
        network.prepare(priors, residual)
        optimizer = torch.optim.AdamW(
            network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            config.learning_rate,
            total_steps=steps,
            pct_start=max(0.1, 2 / steps),
            cycle_momentum=False,
        )
        for rows in _draws(len(priors), config.batch_size, steps):
            loss = network.loss(priors[rows], residual[rows], valid[rows])
            if not torch.isfinite(loss):
                raise TrainingError("the residual's loss is no longer finite: take a smaller learning_rate")
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return network.eval()


def _draws(number: int, size: int, steps: int) -> Iterator[Tensor]:
    """Rows of each step: all of them in a random order, again and again."""
    done = 0
    while True:
        for rows in torch.randperm(number).split(size):
            if done == steps:
                return
            done += 1
            yield rows


def _calibrate(made: ResidualImaginer, batch: InteractionBatch, imagined: ImaginedBatch) -> None:
    """Measure the size of the error by sample, and the quantiles of scores."""
    network, futures, every = made.network, imagined.futures, np.arange(len(batch))
    best = futures.probability.argmax(axis=1)
    with torch.inference_mode():
        _, scale = network(_priors(batch, batch.com[:, 0], _at(futures, every, best)))
    valid = np.arange(batch.com.shape[1]) < batch.length[:, None]
    off = np.linalg.norm(made.correct(batch, batch.com[:, 0], imagined).com - batch.com, axis=-1)
    ratio = np.where(valid, off, 0.0) / scale.double().numpy()[:, None]
    profile = np.sqrt((ratio**2).sum(axis=0) / np.maximum(valid.sum(axis=0), 1))
    network.profile.copy_(torch.from_numpy(profile))
    scored = made.correct(batch, batch.com[:, 0], imagined).futures
    network.quantiles.copy_(torch.from_numpy(quantiles_of(conformal_scores(scored, batch.com, batch.length))))


def _examples(batch: InteractionBatch, imagined: ImaginedBatch) -> tuple[Priors, Tensor, Tensor]:
    """The twin's likeliest motions, the real ones' differences from them [m], and which samples count."""
    futures = imagined.futures
    rows = np.arange(len(batch))
    slots = futures.probability.argmax(axis=1)
    priors = _priors(batch, batch.com[:, 0], _at(futures, rows, slots))
    valid = np.arange(batch.com.shape[1]) < batch.length[:, None]
    quaternions = np.where(valid[..., None], batch.pose[..., 3:], batch.pose[:, :1, 3:])
    turned = rotations_since_rest(np.concatenate([batch.pose[..., :3], quaternions], axis=-1))
    truth = np.concatenate([batch.com - batch.com[:, :1], TURN_LENGTH * turned], axis=-1)
    residual = np.where(valid[..., None], truth, 0.0) - np.where(valid[..., None], priors.motion.numpy(), 0.0)
    # A shorter motion keeps its last difference, so that means and bases are not drawn to 0.
    last = np.minimum(np.arange(valid.shape[1]), batch.length[:, None] - 1)
    residual = np.take_along_axis(residual, last[..., None], axis=1)
    return priors, torch.from_numpy(residual).float(), torch.from_numpy(valid).float()


def _at(
    futures: Futures, rows: Int[np.ndarray, " n"], slots: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n time 6"], Float[np.ndarray, "n 2 2"], np.ndarray]:
    """Motions, support points and outcomes of some futures."""
    outcomes = np.array(futures.outcome)[slots]
    return futures.states[rows, slots], futures.support_points[rows, slots], outcomes


def _priors(
    batch: InteractionBatch,
    com: Float[np.ndarray, "batch 3"],
    told: tuple[Float[np.ndarray, "batch time 6"], Float[np.ndarray, "batch 2 2"], np.ndarray],
) -> Priors:
    """Motions of twins in the frames of the edges that they turn about."""
    states, support, outcomes = told
    corners = Outline().inputs(batch).unflatten(1, (MAX_CORNERS, 2)) * UNIT
    edges = find_pivot_edges(corners, torch.from_numpy(com).float(), 2)
    middles = torch.from_numpy(support.mean(axis=1)).float()
    apart = (edges.ends.mean(dim=2) - middles[:, None]).norm(dim=2)
    second = (apart[:, 1] < apart[:, 0]).long()  # not where no edge was observed
    rows = torch.arange(len(batch))
    flags = torch.stack([second.float(), torch.from_numpy(outcomes == "levered").float()], dim=1)
    values = torch.cat([edges.values[rows, :, second], flags[:, None].expand(-1, 2, -1)], dim=-1)
    motion = np.concatenate([states[..., :3] - states[:, :1, :3], TURN_LENGTH * states[..., 3:]], axis=-1)
    return Priors(torch.from_numpy(motion).float(), values, edges.axes[rows, :, second])


def _as_states(moved: Float[Tensor, "batch time 6"]) -> Float[np.ndarray, "batch time 6"]:
    """Differences of motions as differences of states: displacements [m] and rotation vectors [rad]."""
    return np.asarray((moved / moved.new_tensor([1.0] * 3 + [TURN_LENGTH] * 3)).double())
