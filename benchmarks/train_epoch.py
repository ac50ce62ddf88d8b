"""One training epoch of im-cnn, as it is shipped against the plain way, in one run on one machine.

Plain: 32 windows of 15 states per step, the image's features computed anew for each window, repeated at every
state and concatenated with it; float32 in PyTorch's default layout. Shipped: 32 trajectories per step with all
their windows, features once per trajectory and projected once into the gates; convolutions in the number format and
layout that suit the hardware. Both see the same windows in one epoch.

    python benchmarks/train_epoch.py --threads 1
"""

import argparse
import math
from collections.abc import Callable
from time import perf_counter

import torch
from torch import Tensor, nn

from foretrace.features import ImageCnn
from foretrace.features.base import fast_precision
from foretrace.predictor import LstmConfig, LstmPredictor

NUM_TRAJECTORIES, NUM_SAMPLES, BATCH = 1400, 60, 32


class PlainPredictor(nn.Module):
    """The same network, written the obvious way."""

    def __init__(self, width: int, hidden: int):
        super().__init__()
        layers: list[nn.Module] = []
        for before, after in ((1, 32), (32, 64), (64, 128), (128, 256)):
            layers += [nn.Conv2d(before, after, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2)]
        dense = [nn.Flatten(), nn.Linear(8 * 8 * 256, width), nn.ReLU(), nn.Dropout(0.2)]
        self.features = nn.Sequential(*layers, *dense)
        self.lstm = nn.LSTM(3 + width, hidden, batch_first=True)
        self.output = nn.Linear(hidden, 3)

    def forward(self, images: Tensor, states: Tensor) -> Tensor:
        """Next states, (windows, window, 3), of windows with one image each."""
        repeated = self.features(images)[:, None].expand(-1, states.shape[1], -1)
        return self.output(self.lstm(torch.cat([states, repeated], dim=2))[0])


def plain_step(config: LstmConfig) -> Callable[[], None]:
    network = PlainPredictor(width=128, hidden=config.hidden)
    optimizer = torch.optim.Adam(network.parameters())
    images = (torch.rand(BATCH, 1, 128, 128) > 0.8).float()
    windows = torch.randn(BATCH, config.window + 1, 3)

    def step() -> None:
        optimizer.zero_grad()
        loss = (network(images, windows[:, :-1]) - windows[:, 1:]).square().mean()
        loss.backward()
        optimizer.step()

    return step


def shipped_step(config: LstmConfig) -> Callable[[], None]:
    predictor = LstmPredictor(ImageCnn(), NUM_SAMPLES, config).train()
    predictor.features.precision = fast_precision(torch.device("cpu"))
    optimizer = torch.optim.Adam(predictor.parameters(), fused=True)
    images = (torch.rand(BATCH, 1, 128, 128) > 0.8).to(torch.uint8)
    states, lengths = torch.randn(BATCH, NUM_SAMPLES, 3), torch.full((BATCH,), NUM_SAMPLES)

    def step() -> None:
        loss = predictor.training_loss(predictor.features(images), states, lengths)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def seconds_per_step(steps: dict[str, Callable[[], None]], repeats: int) -> dict[str, float]:
    """The fastest of several turns of each, taken alternately so that both meet the same load."""
    fastest = dict.fromkeys(steps, math.inf)
    for _ in range(repeats + 1):
        for name, step in steps.items():
            started = perf_counter()
            step()
            fastest[name] = min(fastest[name], perf_counter() - started)
    return fastest


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch")
    parser.add_argument("--repeats", type=int, default=8, help="steps timed of each")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    config = LstmConfig()
    seconds = seconds_per_step(
        {"plain": plain_step(config), "shipped": shipped_step(config)}, arguments.repeats
    )
    windows = NUM_TRAJECTORIES * math.ceil((NUM_SAMPLES - 1) / config.window)
    steps = {"plain": math.ceil(windows / BATCH), "shipped": math.ceil(NUM_TRAJECTORIES / BATCH)}
    precision = fast_precision(torch.device("cpu"))
    print(
        f"im-cnn, {NUM_TRAJECTORIES} trajectories x {NUM_SAMPLES} samples, {windows} windows of {config.window}"
    )
    print(f"{arguments.threads} thread(s), convolutions of the shipped step in {precision}")
    for name, each in seconds.items():
        epoch = each * steps[name]
        samples = NUM_TRAJECTORIES * NUM_SAMPLES / epoch
        print(
            f"{name:8s} {each:6.3f} s/step x {steps[name]:3d} = {epoch:6.1f} s/epoch, {samples:7.0f} samples/s"
        )
    ratio = seconds["plain"] * steps["plain"] / (seconds["shipped"] * steps["shipped"])
    print(f"shipped is {ratio:.1f} times as fast as plain")


if __name__ == "__main__":
    main()
