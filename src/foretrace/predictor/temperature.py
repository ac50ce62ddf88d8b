"""Temperatures that make predicted probabilities as sure as they are right (Guo et al., 2017)."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import minimize_scalar
from torch import Tensor

LIMITS = (0.2, 5.0)
"""Lowest and highest temperature."""
ENOUGH = 50
"""Fewer observations leave a temperature as it is."""


class Odds(NamedTuple):
    """Predicted log-probabilities, and what happened."""

    joint: Float[Tensor, "batch edges outcomes"]
    """Log-probabilities of pivot edge and outcome."""
    outcome: Int[Tensor, " batch"]
    """The outcome that was observed."""
    edge: Int[Tensor, " batch"]
    """The edge whose future the motion followed; -1 where the two hardly differ."""


def tempered(
    joint: Float[Tensor, "batch edges outcomes"], temperature: Float[Tensor, "2"]
) -> Float[Tensor, "batch edges outcomes"]:
    """Log-probabilities at temperatures of the outcome, and of the edge given the outcome."""
    outcome = joint.logsumexp(dim=1, keepdim=True)
    edge = ((joint - outcome) / temperature[1]).log_softmax(dim=1)
    return (outcome / temperature[0]).log_softmax(dim=2) + edge


def fit_temperatures(parts: Sequence[Odds], otherwise: Sequence[float] = (1.0, 1.0)) -> Float[Tensor, "2"]:
    """The temperatures of least negative log-likelihood.

    Args:
        parts: Predictions at temperature 1, and what happened.
        otherwise: What they are where there are fewer than `ENOUGH` observations.
    """
    joint, outcome, edge = (torch.cat(values) for values in zip(*parts, strict=True))
    rows = torch.arange(len(joint), device=joint.device)
    outcomes = joint.logsumexp(dim=1)
    edges = (joint - outcomes[:, None])[rows, :, outcome]
    known = edge >= 0
    fitted = (_best(outcomes, outcome), _best(edges[known], edge[known]))
    return torch.tensor([old if new is None else new for new, old in zip(fitted, otherwise, strict=True)])


def _best(log_probability: Float[Tensor, "batch kinds"], observed: Int[Tensor, " batch"]) -> float | None:
    if len(observed) < ENOUGH or log_probability.shape[1] < 2:
        return None

    def loss(logarithm: float) -> float:
        scaled = (log_probability / np.exp(logarithm)).log_softmax(dim=1)
        return -float(scaled.gather(1, observed[:, None]).mean())

    minimise: Callable[..., Any] = minimize_scalar
    return float(np.exp(minimise(loss, bounds=np.log(LIMITS), method="bounded").x))
