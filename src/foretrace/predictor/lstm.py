"""The paper's predictor: a Long Short-Term Memory network over states and object features (section 3.1)."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from foretrace.features import FeatureExtractor, Precision
from foretrace.features.mirror import MirroredFeatures
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.config import PredictorConfig, check_choice, check_count, check_flag
from foretrace.predictor.states import STATE_GROUPS, STATES_IN_MIRROR, Effects, StateKind, state_size

CHANGE_SCALE = 0.1
"""Normalised states change by about this much in one sample: the dense layer's numbers stay of unit scale."""


@dataclass(frozen=True, kw_only=True)
class LstmConfig(PredictorConfig):
    """Settings of the paper's predictor."""

    added = (*PredictorConfig.added, "mirrored")

    features: str = "im-cnn"
    """Features of the object that the predictor is given, by their label."""
    state: StateKind = "position"
    """What is predicted: position of the centre of mass, or the whole pose."""
    steps_ahead: int = 1
    """States predicted per iteration (n in the paper)."""
    hidden: int = 256
    """LSTM units."""
    window: int = 15
    """States per training sequence. The LSTM's memory is carried from window to window, its gradient is not."""
    residual: bool = True
    """Whether changes of the state are predicted; otherwise states themselves, as in the paper."""
    mirrored: bool = False
    """Whether every lever-up is also learned from in the mirror, and predictions are means over both images."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("state", self.state, STATE_GROUPS)
        check_count("steps_ahead", self.steps_ahead, 1000)
        check_count("hidden", self.hidden, 4096)
        check_count("window", self.window, 1_000_000)
        check_flag("residual", self.residual)
        check_flag("mirrored", self.mirrored)

    def make_features(self) -> FeatureExtractor:
        """The feature extractor; for both images where lever-ups are also seen in the mirror."""
        features = super().make_features()
        return MirroredFeatures(features) if self.mirrored else features


class ProjectedLstm(nn.Module):
    """An LSTM layer whose input is a changing state beside features that stay the same.

    Mathematically an LSTM over the concatenation of both; since the features are constant in time, their
    share in the gates is computed once per trajectory instead of once per step and window.

    Args:
        num_states: Numbers in one state.
        num_features: Numbers in a feature vector.
        hidden: Units.
    """

    def __init__(self, num_states: int, num_features: int, hidden: int):
        super().__init__()
        self.hidden = hidden
        self.precision: Precision = "float32"
        """Number format of the products with the recurrent weights in training mode."""
        # Gates in the order input, forget, cell, output.
        weight_input = torch.empty(4 * hidden, num_states + num_features)
        nn.init.xavier_uniform_(weight_input)
        self.weight_state = nn.Parameter(weight_input[:, :num_states].clone())
        self.weight_features = nn.Parameter(weight_input[:, num_states:].clone())
        self.weight_hidden = nn.Parameter(nn.init.orthogonal_(torch.empty(4 * hidden, hidden)))
        bias = torch.zeros(4 * hidden)
        bias[hidden : 2 * hidden] = 1.0  # remember at first
        self.bias = nn.Parameter(bias)

    def project(self, features: Float[Tensor, "batch features"]) -> Float[Tensor, "batch gates"]:
        """The features' share in the gates, biases included."""
        return torch.addmm(self.bias, features, self.weight_features.t())

    def step(
        self,
        state: Float[Tensor, "batch state"],
        projected: Float[Tensor, "batch gates"],
        memory: tuple[Tensor, Tensor] | None,
    ) -> tuple[Tensor, Tensor]:
        """The next output and cell, each (batch, hidden), from the last ones (None at the start)."""
        gates = torch.addmm(projected, state, self.weight_state.t())
        if memory is not None:
            gates = torch.addmm(gates, memory[0], self.weight_hidden.t())
        enter, forget, new, leave = gates.chunk(4, dim=1)
        cell = enter.sigmoid() * new.tanh()
        if memory is not None:
            cell = cell + forget.sigmoid() * memory[1]
        return leave.sigmoid() * cell.tanh(), cell

    def forward(
        self,
        states: Float[Tensor, "batch time state"],
        projected: Float[Tensor, "batch gates"],
        memory: tuple[Tensor, Tensor] | None = None,
    ) -> tuple[Float[Tensor, "batch time hidden"], tuple[Tensor, Tensor]]:
        """Outputs at every step of a sequence, and the memory after it; fast to train.

        No gradient flows into ``memory``, nor from what is later made of the returned one.
        """
        if memory is None:
            nothing = states.new_zeros(len(states), self.hidden)
            memory = nothing, nothing
        output, cell = (part.detach() for part in memory)
        reduced = self.training and self.precision == "bfloat16"
        outputs, cell = _LstmSequence.apply(
            states, projected, self.weight_state, self.weight_hidden, output, cell, reduced
        )
        return outputs, (outputs[:, -1].detach(), cell)


class _LstmSequence(torch.autograd.Function):
    """A sequence of steps as one node of the graph.

    Three times as fast on a CPU as letting autograd record each step: what does not depend on the step before is
    computed for all steps at once, activations are overwritten in place, and the products with the recurrent
    weights are in bfloat16 where the hardware multiplies that faster.
    """

    @staticmethod
    def forward(
        ctx: Any,
        states: Tensor,
        projected: Tensor,
        weight_state: Tensor,
        weight_hidden: Tensor,
        first_output: Tensor,
        first_cell: Tensor,
        reduced: bool,
    ) -> tuple[Tensor, Tensor]:
        batch, time, _ = states.shape
        hidden = weight_hidden.shape[1]
        product = torch.bfloat16 if reduced else weight_hidden.dtype
        weight = weight_hidden.to(product)
        x = states.transpose(0, 1)  # (time, batch, state)
        cells = x.new_empty(time + 1, batch, hidden)
        outputs = torch.empty_like(cells, dtype=product)
        outputs[0], cells[0] = first_output, first_cell
        squashed = torch.empty_like(cells[1:])
        gates = (x @ weight_state.t()).add_(projected)
        for t in range(time):
            gates[t].add_(outputs[t] @ weight.t())
            enter, forget, new, leave = gates[t].chunk(4, dim=1)
            gates[t, :, : 2 * hidden].sigmoid_()
            new.tanh_()
            leave.sigmoid_()
            torch.mul(enter, new, out=cells[t + 1]).addcmul_(forget, cells[t])
            torch.tanh(cells[t + 1], out=squashed[t])
            outputs[t + 1] = leave * squashed[t]
        ctx.save_for_backward(x, weight_state, weight, outputs, cells, gates, squashed)
        last_cell = cells[-1].clone()
        ctx.mark_non_differentiable(last_cell)
        return outputs[1:].transpose(0, 1).to(x.dtype), last_cell

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, weight_state, weight, outputs, cells, gates, squashed = ctx.saved_tensors
        time, batch, width = gates.shape
        grad = grads[0].transpose(0, 1)
        enter, forget, new, leave = gates.chunk(4, dim=2)
        # How the cell answers to its three gates, and the output to its gate and to the cell: (time, batch, hidden).
        by_enter, by_forget = new * enter * (1 - enter), cells[:-1] * forget * (1 - forget)
        by_gate = torch.cat([by_enter, by_forget, enter * (1 - new.square())], dim=2).unflatten(2, (3, -1))
        by_leave, by_cell = squashed * leave * (1 - leave), leave * (1 - squashed.square())
        grad_gates = torch.empty_like(gates, dtype=weight.dtype)
        grad_output, grad_cell = torch.zeros_like(cells[0]), torch.zeros_like(cells[0])
        for t in reversed(range(time)):
            grad_output = grad_output + grad[t]
            grad_cell = torch.addcmul(grad_cell, grad_output, by_cell[t])
            to_gates = grad_gates[t].unflatten(1, (4, -1))
            to_gates[:, :3] = by_gate[t] * grad_cell[:, None]
            to_gates[:, 3] = grad_output * by_leave[t]
            grad_cell = grad_cell * forget[t]
            if t > 0:
                grad_output = (grad_gates[t] @ weight).to(x.dtype)
        flat = grad_gates.view(time * batch, width)
        grad_hidden = (flat.t() @ outputs[:time].reshape(time * batch, -1)).to(x.dtype)
        grad_state = (flat.t() @ x.reshape(time * batch, -1).to(weight.dtype)).to(x.dtype)
        grad_x = None
        if ctx.needs_input_grad[0]:
            grad_x = (grad_gates.to(x.dtype) @ weight_state).transpose(0, 1)
        grad_projected = grad_gates.sum(0, dtype=x.dtype)
        return grad_x, grad_projected, grad_state, grad_hidden, None, None, None


class LstmPredictor(EffectPredictor):
    """Section 3.1: state and features into 256 LSTM units, a dense layer from there to the next n states.

    One departure from the paper, which ``residual=False`` takes back: the dense layer predicts changes. Trained
    on recorded states, a network that has to repeat the state itself learns to, first of all, and its small
    errors drive a roll-out off long before it has learned to make use of the features.

    Args:
        config: Settings.
        num_samples: Samples in an imagined trajectory.
    """

    label = "lstm"
    config_class = LstmConfig
    config: LstmConfig

    def __init__(self, config: LstmConfig, num_samples: int):
        super().__init__(config, num_samples, config.state)
        size = state_size(config.state)
        seen = self.features.num_features // 2 if config.mirrored else 0  # what comes twice
        self.lstm = ProjectedLstm(size, self.num_inputs - seen, config.hidden)
        self.output = nn.Linear(config.hidden, config.steps_ahead * size)
        nn.init.xavier_uniform_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    @property
    def display_name(self) -> str:
        """Name in figures and tables."""
        return f"{self.features.label} + LSTM"

    @property
    def is_symmetric(self) -> bool:
        """Whether mirror images have mirrored motions, exactly."""
        return self.config.mirrored

    @property
    def feature_weights(self) -> list[nn.Parameter]:
        """Those of the gates."""
        return [self.lstm.weight_features]

    def set_precision(self, precision: Precision) -> None:
        """Fix the number format of the large products in training."""
        super().set_precision(precision)
        self.lstm.precision = precision

    def training_loss(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> Float[Tensor, ""]:
        """Mean squared error of every step's n predicted states, window by window, given recorded states.

        The memory that a window leaves is where the next one starts, as in a roll-out: an LSTM that started
        anew in the middle of a trajectory could not tell how long an object at rest has been at rest.
        """
        states, lengths = effects.states, effects.lengths
        if self.config.mirrored:
            features = self._both_images(features)
            states, lengths = torch.cat([states, self._mirror(states)]), lengths.repeat(2)
        time = states.shape[1]
        ahead = self.config.steps_ahead
        projected = self.lstm.project(features)
        memory, outputs = None, []
        for window in states[:, :-1].split(self.config.window, dim=1):
            output, memory = self.lstm(window, projected, memory)
            outputs.append(output)
        predicted = self._next_states(torch.cat(outputs, dim=1), states[:, :-1])
        targets = F.pad(states[:, 1:], (0, 0, 0, ahead - 1)).unfold(1, ahead, 1).transpose(2, 3)
        steps = torch.arange(1, time, device=states.device)[:, None]
        steps = steps + torch.arange(ahead, device=states.device)  # (time - 1, ahead)
        valid = steps < lengths[:, None, None]
        return ((predicted - targets).square().mean(-1) * valid).sum() / valid.sum()

    def roll_out(
        self, features: Float[Tensor, "batch inputs"], first: Float[Tensor, "batch state"]
    ) -> Float[Tensor, "batch time state"]:
        """Feed predictions back, n states per iteration, until the trajectory is whole."""
        if not self.config.mirrored:
            return self._roll_out(features, first)
        both = self._roll_out(self._both_images(features), torch.cat([first, self._mirror(first)]))
        own, other = both.chunk(2)
        return (own + self._mirror(other)) / 2

    def _roll_out(
        self, features: Float[Tensor, "batch inputs"], first: Float[Tensor, "batch state"]
    ) -> Float[Tensor, "batch time state"]:
        projected = self.lstm.project(features)
        states, new = [first], [first]
        memory = None
        while len(states) < self.num_samples:
            for state in new:
                memory = self.lstm.step(state, projected, memory)
            assert memory is not None
            new = self._next_states(memory[0], states[-1]).unbind(1)
            states += new
        return torch.stack(states[: self.num_samples], dim=1)

    def _both_images(self, inputs: Float[Tensor, "batch inputs"]) -> Float[Tensor, "images own"]:
        """Features and context of all lever-ups, and then of their mirror images."""
        seen = self.features.num_features // 2
        own, other, context = inputs.tensor_split([seen, 2 * seen], dim=1)
        return torch.cat([torch.cat([each, context], dim=1) for each in (own, other)])

    def _mirror(self, states: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch state"]:
        """Normalised states in the mirror."""
        sign = states.new_tensor(STATES_IN_MIRROR[self.state])
        return sign * states + (sign - 1) * self.state_mean / self.state_scale

    def _next_states(
        self, outputs: Float[Tensor, "*batch hidden"], current: Float[Tensor, "*batch state"]
    ) -> Float[Tensor, "*batch ahead state"]:
        """The n states after the current ones, from the LSTM's outputs there."""
        predicted = self.output(outputs).unflatten(-1, (self.config.steps_ahead, -1))
        return current[..., None, :] + CHANGE_SCALE * predicted if self.config.residual else predicted
