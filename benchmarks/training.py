"""Trainings per hour, as shipped against the plain way, in one run on one machine.

Plain, as one would write it in Keras after the paper: 100 epochs; 32 windows of 15 states per step, the image's
features computed anew for each window, repeated at every state and concatenated with it; float32 in PyTorch's default
layout. Shipped: the epochs that the default settings ask for; 32 trajectories per step with all their windows, features
once per trajectory and projected once into the gates, images convolved where the object is; number formats and layout
that suit the hardware. Both see the same windows in one epoch. Every core trains a predictor of its own.

    python benchmarks/training.py --workers 2
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

import torch
from joblib import Parallel, delayed
from torch import Tensor, nn

from foretrace.features import make_features
from foretrace.features.base import fast_precision
from foretrace.objects import Prism
from foretrace.predictor import LstmConfig, LstmPredictor, TrainConfig
from foretrace.predictor.states import Effects

NUM_TRAJECTORIES, NUM_SAMPLES, BATCH, PLAIN_EPOCHS = 1400, 60, 32, 100
LABELS = ("im-cnn", "sc-800", "none")


class PlainPredictor(nn.Module):
    """The same network, written the obvious way."""

    def __init__(self, label: str, hidden: int, num_features: int):
        super().__init__()
        self.features: nn.Module = nn.Identity()
        if label == "im-cnn":
            layers: list[nn.Module] = []
            for before, after in ((1, 32), (32, 64), (64, 128), (128, 256)):
                layers += [nn.Conv2d(before, after, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2)]
            dense = [nn.Flatten(), nn.Linear(8 * 8 * 256, num_features), nn.ReLU(), nn.Dropout(0.2)]
            self.features = nn.Sequential(*layers, *dense)
        self.lstm = nn.LSTM(3 + num_features, hidden, batch_first=True)
        self.output = nn.Linear(hidden, 3)

    def forward(self, inputs: Tensor, states: Tensor) -> Tensor:
        """Next states, (windows, window, 3), of windows with one input each."""
        repeated = self.features(inputs)[:, None].expand(-1, states.shape[1], -1)
        return self.output(self.lstm(torch.cat([states, repeated], dim=2))[0])


def views() -> Tensor:
    """Masks (BATCH, 1, 128, 128) of an object as large as the paper's."""
    from foretrace.actions import LeverUp
    from foretrace.interactions.topdown import TopDownView

    prism = Prism([[-0.1, 0.0], [0.03, -0.095], [0.1, 0.0], [-0.03, 0.095]], 0.02)
    mask = TopDownView.of(prism, LeverUp.at_edge(prism, 0, 0.5)).mask
    return torch.tensor(mask).to(torch.uint8).expand(BATCH, 1, -1, -1).contiguous()


def plain_step(label: str, config: LstmConfig) -> Callable[[], None]:
    num_features = make_features(label).num_features
    network = PlainPredictor(label, config.hidden, num_features)
    optimizer = torch.optim.Adam(network.parameters())
    inputs = views().float() if label == "im-cnn" else torch.randn(BATCH, num_features)
    windows = torch.randn(BATCH, config.window + 1, 3)

    def step() -> None:
        optimizer.zero_grad()
        loss = (network(inputs, windows[:, :-1]) - windows[:, 1:]).square().mean()
        loss.backward()
        optimizer.step()

    return step


def shipped_step(label: str, config: LstmConfig) -> Callable[[], None]:
    predictor = LstmPredictor(replace(config, features=label), NUM_SAMPLES).train()
    predictor.set_precision(fast_precision(torch.device("cpu")))
    optimizer = torch.optim.AdamW([p for p in predictor.parameters() if p.requires_grad], fused=True)
    inputs = views() if label == "im-cnn" else torch.randn(BATCH, predictor.features.num_features)
    states, lengths = torch.randn(BATCH, NUM_SAMPLES, 3), torch.full((BATCH,), NUM_SAMPLES)
    com = torch.full((BATCH, 3), torch.nan)
    effects = Effects(states, lengths, torch.zeros(BATCH, dtype=torch.long), com)

    def step() -> None:
        features = predictor.features(inputs) if predictor.features.trainable else inputs
        loss = predictor.training_loss(features, effects)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def seconds_per_step(label: str, repeats: int) -> tuple[float, float]:
    """Median of several steps of each, taken alternately so that both meet the same load: plain, shipped."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    steps = plain_step(label, LstmConfig()), shipped_step(label, LstmConfig())
    seconds: tuple[list[float], list[float]] = [], []
    for _ in range(repeats + 1):
        for step, taken in zip(steps, seconds, strict=True):
            started = perf_counter()
            step()
            taken.append(perf_counter() - started)
    plain, shipped = (sorted(taken[1:])[repeats // 2] for taken in seconds)
    return plain, shipped


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--workers", type=int, default=1, help="processes side by side, of one thread each")
    parser.add_argument("--repeats", type=int, default=15, help="steps timed of each")
    arguments = parser.parse_args()
    windows = NUM_TRAJECTORIES * math.ceil((NUM_SAMPLES - 1) / LstmConfig().window)
    counts = math.ceil(windows / BATCH), math.ceil(NUM_TRAJECTORIES / BATCH)
    epochs = PLAIN_EPOCHS, TrainConfig().num_epochs(NUM_TRAJECTORIES)
    precision = fast_precision(torch.device("cpu"))
    print(
        f"{NUM_TRAJECTORIES} trajectories of {NUM_SAMPLES} samples, {arguments.workers} process(es), {precision}"
    )
    print(
        f"{'':8s} {'':8s} {'s/step':>7s} {'s/epoch':>8s} {'samples/s':>9s} {'epochs':>6s} {'trainings/h':>11s}"
    )
    for label in LABELS:
        jobs = (delayed(seconds_per_step)(label, arguments.repeats) for _ in range(arguments.workers))
        measured = Parallel(n_jobs=arguments.workers)(jobs)
        rates = []
        for kind, name in enumerate(("plain", "shipped")):
            step = sum(pair[kind] for pair in measured) / arguments.workers
            epoch = step * counts[kind]
            samples = arguments.workers * NUM_TRAJECTORIES * NUM_SAMPLES / epoch
            rates.append(arguments.workers * 3600 / (epoch * epochs[kind]))
            row = f"{step:7.3f} {epoch:8.1f} {samples:9.0f} {epochs[kind]:6d} {rates[-1]:11.2f}"
            print(f"{label:8s} {name:8s} {row}")
        per_epoch = rates[1] / rates[0] * epochs[1] / epochs[0]
        print(
            f"{label:8s} shipped is {per_epoch:.1f} times as fast an epoch, {rates[1] / rates[0]:.0f} a training"
        )


if __name__ == "__main__":
    main()
