"""A feature extractor's own training: one loop for those that learn before the predictor does."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from foretrace.errors import TrainingError

NUM_REPORTS = 10
"""Lines on the progress, at most."""
WARM_UP = 0.1
"""Share of the steps in which the learning rate rises."""


@dataclass(frozen=True)
class FitConfig:
    """Settings of such a training."""

    epochs: int
    """Passes over the training part, at most."""
    batch_size: int
    """Rows per optimiser step."""
    learning_rate: float
    """Adam's learning rate."""
    patience: int | None = None
    """Epochs without a smaller validation loss after which the training stops; None: it runs to its end."""
    annealed: bool = False
    """Whether the learning rate rises and falls as in `learning_rate`, instead of staying the same."""
    min_steps: int = 1
    """Optimiser steps, at least: few rows are passed over more often."""

    def __post_init__(self) -> None:
        for name in ("epochs", "batch_size", "patience", "min_steps"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise TrainingError(f"{name} must be at least 1, not {value}")
        if not self.learning_rate > 0:
            raise TrainingError(f"learning_rate must be positive, not {self.learning_rate}")


def fit_network(
    network: nn.Module,
    train_loss: Callable[[Int[Tensor, " rows"]], Float[Tensor, ""]],
    validation_loss: Callable[[], float],
    num_rows: int,
    config: FitConfig,
    *,
    name: str,
    seed: int,
    report: Callable[[str], None],
) -> None:
    """Train a network, keep its best validation epoch and freeze it.

    Args:
        network: What to train; it has no dropout.
        train_loss: Mean loss of the given rows of the training part.
        validation_loss: Loss of the validation part; called without gradients.
        num_rows: Rows of the training part.
        config: Settings.
        name: What is trained, for reports and errors.
        seed: Seed of the order of the rows.
        report: Takes a line on the progress.

    Raises:
        TrainingError: A loss is no longer finite.
    """
    network.requires_grad_(True)
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    rng = np.random.default_rng(seed)
    epochs = max(config.epochs, math.ceil(config.min_steps / math.ceil(num_rows / config.batch_size)))
    best, best_epoch, kept = float("inf"), 0, {}
    try:
        for epoch in range(1, epochs + 1):
            batches = torch.from_numpy(rng.permutation(num_rows)).split(config.batch_size)
            for number, rows in enumerate(batches):
                if config.annealed:
                    share = (epoch - 1 + number / len(batches)) / epochs
                    optimizer.param_groups[0]["lr"] = learning_rate(config.learning_rate, share)
                optimizer.zero_grad()
                train_loss(rows).backward()
                optimizer.step()
            with torch.no_grad():
                loss = validation_loss()
            if not np.isfinite(loss):
                raise TrainingError(
                    f"{name}: the validation loss is {loss} in epoch {epoch}: lower the learning rate of "
                    f"{config.learning_rate}"
                )
            if loss < best:
                best, best_epoch = loss, epoch
                kept = {key: tensor.clone() for key, tensor in network.state_dict().items()}
            elif config.patience is not None and epoch - best_epoch >= config.patience:
                break
            if epoch % -(-epochs // NUM_REPORTS) == 0:
                report(f"{name}: epoch {epoch} of {epochs}, best validation loss {best:.3g}")
    finally:
        network.requires_grad_(False)
    network.load_state_dict(kept)
    report(f"{name}: best validation loss {best:.3g} in epoch {best_epoch}")


def learning_rate(largest: float, share: float) -> float:
    """The rate for a step before which a share of the training is done: linear warm-up, then a cosine to 0.

    Loshchilov and Hutter, 2017, "SGDR"; with its end known in advance, a training needs a fraction of the epochs
    that one with a rate lowered on plateaus does.
    """
    if share < WARM_UP:
        return largest * share / WARM_UP
    return largest * (1 + math.cos(math.pi * (share - WARM_UP) / (1 - WARM_UP))) / 2
