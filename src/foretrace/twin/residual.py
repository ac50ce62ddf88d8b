"""What a twin gets wrong, learned from few real actions: a network over the twin's own motion."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from foretrace.errors import (
    CheckpointError,
    TrainingError,
    check_type,
    shown,
)
from foretrace.features import Outline
from foretrace.features.pivot_edges import find_pivot_edges
from foretrace.files import as_path, make_folder, read_versioned, write_json
from foretrace.geometry import rotation_vector_to_quaternion
from foretrace.imagined import (
    Futures,
    ImaginedBatch,
    Imaginer,
    Scenes,
    conformal_scores,
    quantiles_of,
)
from foretrace.imagined.observed import rotations_since_rest
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.hull import MAX_CORNERS, UNIT
from foretrace.predictor.checkpoint import load_tensors, read_tensors, write_tensors
from foretrace.predictor.mixture import TURN_LENGTH
from foretrace.predictor.runtime import seeded, thread_count
from foretrace.twin.imaginer import TwinImaginer
from foretrace.twin.residual_network import Priors, ResidualConfig, ResidualNetwork

FORMAT, VERSION = "foretrace-residual", 1
CONFIG, MODEL = "residual.json", "residual.safetensors"
REMEDY = "train the residual again, and save that"
FEWEST_STEPS = 4
"""Fewest steps over which a learning rate can rise and fall."""


class ResidualEntries(TypedDict):
    """Schema of the file of settings."""

    config: dict[str, Any]
    times: list[float]
    interactions: int


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
    bevels_all = True

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
    config: ResidualConfig | None = None,
    *,
    imagined: tuple[ImaginedBatch, ImaginedBatch] | None = None,
) -> ResidualImaginer:
    """Learn what a twin gets wrong.

    Args:
        batch: Actions to learn from, a few are enough.
        validation: Further ones, which decide the widths of regions and nothing else.
        twin: The twin; by default one with the usual settings. It is told what was recorded of each action.
        config: Settings; by default the usual ones.
        imagined: What the twin imagines of both, where that is known already.

    Raises:
        TrainingError: There is nothing to learn from, or samples are taken at other times than the twin's.
        PredictionError: As `Imaginer.imagine_batch`.
    """
    twin, config = twin or TwinImaginer(), config or ResidualConfig()
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
