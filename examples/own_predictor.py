"""A predictor of one's own: a network that predicts whole trajectories from features and centre of mass.

Defining the class registers it: training, checkpoints, evaluation and commands know it by its label from then on.

python examples/own_predictor.py data runs/dense
"""

import sys
from dataclasses import dataclass

import torch
from torch import nn

import foretrace as ft
from foretrace.predictor import TrainConfig


@dataclass(frozen=True, kw_only=True)
class DenseConfig(ft.PredictorConfig):
    """Settings of the dense predictor."""

    training = TrainConfig(epochs=30, min_steps=50, learning_rate=3e-3, split=None)  # recommended settings

    features: str = "sp-rule"
    """Features of the object, by their label."""
    hidden: int = 64
    """Units of the hidden layer."""


class DensePredictor(ft.EffectPredictor):
    """One hidden layer, from features, context and the first state to all displacements."""

    label = "dense"
    config_class = DenseConfig

    def __init__(self, config: DenseConfig, num_samples: int):
        super().__init__(config, num_samples)
        hidden = nn.Linear(self.num_inputs + 3, config.hidden)  # features, context, centre of mass at rest
        self.network = nn.Sequential(hidden, nn.ReLU(), nn.Linear(config.hidden, num_samples * 3))

    def roll_out(self, features, first):
        """Normalised states over time, from the first one."""
        moved = self.network(torch.cat([features, first], dim=1)).unflatten(1, (-1, 3))
        return first[:, None] + moved - moved[:, :1]

    def training_loss(self, features, effects):
        """Mean squared error of the samples that count."""
        error = (self.roll_out(features, effects.states[:, 0]) - effects.states).square().mean(dim=2)
        valid = torch.arange(error.shape[1], device=error.device) < effects.lengths[:, None]
        return error[valid].mean()


if __name__ == "__main__":
    data, out = ft.Dataset.open(sys.argv[1]), sys.argv[2]
    predictor = ft.load_predictor(ft.train_predictor(data, DenseConfig(hidden=32), out, progress=False))
    box = ft.Box(0.15, 0.13, 0.02)
    imagined = predictor.imagine(ft.TopDownView.of(box, ft.LeverUp.at_edge(box, edge=0)))
    print(f"the centre of mass ends at {imagined.com_trajectory[-1].round(3).tolist()} m")
