"""How the parameters of a predictor share learning rate and weight decay."""

from typing import Any

import torch
from torch import nn

from foretrace.errors import TrainingError
from foretrace.predictor.base import EffectPredictor

FULL_RATE_INPUTS = 256
"""Units with more inputs than this learn at a lower rate."""
FEATURE_DECAY = 1 / 800
"""Weight decay per feature."""


def make_optimizer(predictor: EffectPredictor) -> torch.optim.Optimizer:
    """AdamW over what is trainable; a group's learning rate is to be its ``share`` of that of the step."""
    # The loss of a state's small change is small: the usual epsilon of 1e-8 would outweigh its gradient.
    groups = parameter_groups(predictor)
    if not groups:
        raise TrainingError(
            f"predictor {predictor.label!r} has no parameters to train: create them in __init__"
        )
    return torch.optim.AdamW(groups, eps=1e-12, fused=True)


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
