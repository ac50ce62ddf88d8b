"""Networks of one shape that learn side by side."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

MANY = 256
"""Number of rows from which on networks are faster one after the other."""


class Ensemble(nn.Module):
    """Networks of one shape side by side: layers that work on all of them in one product.

    Args:
        size: Number of networks.
        widths: Numbers in and out, and the hidden units in between.
    """

    def __init__(self, size: int, widths: tuple[int, ...]):
        super().__init__()
        pairs = list(pairwise(widths))
        # Variances are kept from layer to layer (Glorot and Bengio, 2010); every motion starts as the mean one.
        bounds = [(3 / enter) ** 0.5 for enter, _ in pairs[:-1]] + [0.0]
        self.size = size
        # A row for each unit of each network: the shape that optimisers take for a layer's weights.
        self.weights = nn.ParameterList(
            torch.empty(size * leave, enter).uniform_(-1, 1) * bound
            for (enter, leave), bound in zip(pairs, bounds, strict=True)
        )
        self.biases = nn.ParameterList(torch.zeros(size * leave) for _, leave in pairs)

    def forward(self, x: Float[Tensor, "size batch enter"]) -> Float[Tensor, "size batch leave"]:
        """Every network's output for its own rows."""
        if torch.is_inference_mode_enabled() and x.shape[1] >= MANY:
            return self._in_turn(x)
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            weight, bias = weight.unflatten(0, (self.size, -1)), bias.view(self.size, 1, -1)
            x = torch.baddbmm(bias, x, weight.mT)
            x = x if layer == last else F.silu(x)
        return x

    def _in_turn(self, x: Tensor) -> Tensor:
        """The same, network after network: the activations of one stay in the processor's cache."""
        layers = [
            tuple(zip(w.chunk(self.size), b.chunk(self.size), strict=True))
            for w, b in zip(self.weights, self.biases, strict=True)
        ]
        answers = []
        for number, answer in enumerate(x):
            for layer in layers[:-1]:
                answer = F.silu(F.linear(answer, *layer[number]), inplace=True)
            answers.append(F.linear(answer, *layers[-1][number]))
        return torch.stack(answers)
