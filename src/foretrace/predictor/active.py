"""Batch active learning: which actions to execute next, so that a predictor learns much from few of them.

Actions are chosen that differ from those learned from, and from each other, in what their motions depend on. How far
two actions are apart is measured by the predictor: by how much the motion that it expects would change, to first order
and on average over what it has learned from. Among the candidates nearest to one action learned from, the one farthest
away is chosen, of that action for which the squared distances of all of them add up to most (LCMD: Holzmueller et al.,
2023, "A framework and benchmark for deep batch active learning for regression"). A mirror image is no other action.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from foretrace.errors import PredictionError, check_type, is_whole, shown
from foretrace.interactions.batch import InteractionBatch
from foretrace.predictor.one_shot import OneShotPredictor

STEP = 0.1
"""By which inputs of unit scale are changed to see how motions depend on them."""
LEAST = 0.01
"""Share of the mean squared sensitivity that every direction of the inputs counts at least."""
TOGETHER = 500
"""Actions that are compared with all candidates at once."""


def choose_actions(
    predictor: OneShotPredictor, learned: InteractionBatch, candidates: InteractionBatch, count: int
) -> Int[np.ndarray, " count"]:
    """Rows of the candidates to carry out next, the most telling first.

    Args:
        predictor: Has learned from what there is so far.
        learned: The interactions that it has learned from.
        candidates: Actions that are still to be carried out. Views, starts (the first sample of ``com``) and context
            are looked at, effects are not.
        count: Number of actions to choose.

    Raises:
        PredictionError: The predictor is of another kind, nothing was learned from, or there are fewer candidates.
    """
    check_type("predictor", predictor, OneShotPredictor, PredictionError)
    for name, batch in (("learned", learned), ("candidates", candidates)):
        check_type(name, batch, InteractionBatch, PredictionError)
        if not len(batch):
            raise PredictionError(f"{name} holds no actions: give at least one")
    if not is_whole(count, 1, len(candidates)):
        raise PredictionError(f"count is {shown(count)}: give a whole number from 1 to {len(candidates)}")
    known, others = predictor.network_inputs(learned), predictor.network_inputs(candidates)
    if not predictor.is_symmetric:
        known, others = known[:, :1], others[:, :1]
    scale = _sensitivity(predictor, known[:, 0])
    return _farthest(known @ scale, others @ scale, count)


def _sensitivity(
    predictor: OneShotPredictor, inputs: Float[Tensor, "batch values"]
) -> Float[Tensor, "values axes"]:
    """Matrix that turns inputs so that their distances are those of the expected motions."""

    def expected(inputs: Tensor) -> Tensor:
        return predictor.expected_weights(inputs).mean(dim=0)

    before, steps = expected(inputs), STEP * torch.eye(inputs.shape[1], device=inputs.device)
    changes = [(expected(inputs + step) - before) / STEP for step in steps]
    slope = torch.stack(changes, dim=1).double()  # (batch, values, components)
    size, axes = torch.linalg.eigh((slope @ slope.mT).mean(dim=0))
    size = size.clamp(min=0)
    return (axes * (size + LEAST * size.mean()).sqrt()).to(inputs.dtype)


def _farthest(
    known: Float[Tensor, "known views axes"], others: Float[Tensor, "others views axes"], count: int
) -> Int[np.ndarray, " count"]:
    """Candidates chosen one after the other, each with the largest distance in the widest cluster."""
    own = others[:, 0].contiguous()
    nearest = torch.full((len(own),), torch.inf, dtype=own.dtype, device=own.device)
    cluster = torch.zeros(len(own), dtype=torch.int64, device=own.device)
    for first in range(0, len(known), TOGETHER):
        apart = torch.cdist(own, known[first : first + TOGETHER].flatten(0, 1)).square()
        found, where = apart.unflatten(1, (-1, known.shape[1])).amin(dim=2).min(dim=1)
        cluster = torch.where(found < nearest, first + where, cluster)
        nearest = nearest.minimum(found)
    chosen = []
    for number in range(len(known), len(known) + count):
        total = torch.zeros(number, dtype=nearest.dtype, device=own.device).index_add_(0, cluster, nearest)
        inside = torch.where(cluster == total.argmax(), nearest, -1.0)
        inside[chosen] = -2.0
        row = int(inside.argmax())
        chosen.append(row)
        apart = torch.cdist(own, others[row]).square().amin(dim=1)
        cluster = torch.where(apart < nearest, number, cluster)
        nearest = nearest.minimum(apart)
        cluster[row], nearest[row] = number, 0.0
    return np.array(chosen)
