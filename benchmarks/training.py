"""Trainings per hour, as shipped against the plain way, in one run on one machine.

Plain, as one would write it in Keras after the paper: 100 epochs; 32 windows of 15 states per step, the image's
features computed anew for each window, repeated at every state and concatenated with it; float32 in PyTorch's default
layout. Shipped: the epochs that the default settings ask for; 32 trajectories per step with all their windows, features
once per trajectory and projected once into the gates, images convolved where the object is; number formats and layout
that suit the hardware. Both see the same windows in one epoch. Every core trains a predictor of its own.

The plain network is also trained by PyTorch Lightning with its default settings, if it is installed (`pip install
pytorch-lightning`), and the shipped convolutions are compiled by ``torch.compile`` with --compile. The direct predictor
has no plain form; its own speed is told.

    python benchmarks/training.py --workers 2 --compile --out docs/results/training.json
"""

import argparse
import logging
import math
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from joblib import Parallel, delayed
from torch import Tensor, nn
from torch.utils.data import DataLoader, TensorDataset

from foretrace.actions import LeverUp
from foretrace.features import make_features
from foretrace.features.base import fast_precision
from foretrace.files import write_json
from foretrace.imagined import estimate_com
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Prism, sample_prism
from foretrace.predictor import LstmConfig, LstmPredictor, OneShotConfig, OneShotPredictor, TrainConfig
from foretrace.predictor.states import Effects

NUM_TRAJECTORIES, NUM_SAMPLES, BATCH, PLAIN_EPOCHS = 1400, 60, 32, 100
LABELS = ("im-cnn", "sc-800", "none", "one-shot")
KINDS = ("plain", "Lightning", "shipped", "compiled")


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


def lightning_steps(label: str, config: LstmConfig, repeats: int) -> list[float]:
    """Seconds of the same steps as Lightning's trainer takes them, with its defaults but for the progress bar."""
    import pytorch_lightning as pl

    num_features = make_features(label).num_features
    inputs = views().float() if label == "im-cnn" else torch.randn(BATCH, num_features)
    windows = torch.randn(BATCH, config.window + 1, 3)
    data = TensorDataset(
        inputs.repeat(repeats + 1, *[1] * (inputs.dim() - 1)), windows.repeat(repeats + 1, 1, 1)
    )
    seconds: list[float] = []

    class Module(pl.LightningModule):
        def __init__(self):
            super().__init__()
            self.network = PlainPredictor(label, config.hidden, num_features)
            self.began = perf_counter()

        def training_step(self, batch, number):
            given, states = batch
            return (self.network(given, states[:, :-1]) - states[:, 1:]).square().mean()

        def configure_optimizers(self):
            return torch.optim.Adam(self.parameters())

        def on_train_batch_end(self, *_):
            seconds.append(perf_counter() - self.began)
            self.began = perf_counter()

    logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer = pl.Trainer(
            max_epochs=1,
            accelerator="cpu",
            default_root_dir=folder,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        trainer.fit(Module(), DataLoader(data, batch_size=BATCH, shuffle=True))
    return seconds


def shipped_step(label: str, config: LstmConfig, compiled: bool = False) -> Callable[[], None]:
    predictor = LstmPredictor(replace(config, features=label), NUM_SAMPLES).train()
    predictor.set_precision(fast_precision(torch.device("cpu")))
    optimizer = torch.optim.AdamW([p for p in predictor.parameters() if p.requires_grad], fused=True)
    inputs = views() if label == "im-cnn" else torch.randn(BATCH, predictor.features.num_features)
    states, lengths = torch.randn(BATCH, NUM_SAMPLES, 3), torch.full((BATCH,), NUM_SAMPLES)
    com = torch.full((BATCH, 3), torch.nan)
    effects = Effects(states, lengths, torch.zeros(BATCH, dtype=torch.long), com)
    extract: Any = torch.compile(predictor.features) if compiled else predictor.features

    def step() -> None:
        features = extract(inputs) if predictor.features.trainable else inputs
        loss = predictor.training_loss(features, effects)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def one_shot_step() -> Callable[[], None]:
    """A step of the direct predictor, as `foretrace train --predictor one-shot` takes it."""
    predictor = OneShotPredictor(OneShotConfig(), NUM_SAMPLES).train()
    optimizer = torch.optim.AdamW(predictor.parameters(), fused=True)
    rng = np.random.default_rng(0)
    prisms = [sample_prism(rng, 3 + k % 8) for k in range(BATCH)]
    batch = InteractionBatch.from_views([TopDownView.of(each, LeverUp.at_edge(each, 0)) for each in prisms])
    features = predictor.features(torch.as_tensor(predictor.features.inputs(batch)))
    states, lengths = torch.randn(BATCH, NUM_SAMPLES, 6), torch.full((BATCH,), NUM_SAMPLES)
    effects = Effects(
        states, lengths, torch.zeros(BATCH, dtype=torch.long), torch.as_tensor(estimate_com(batch)).float()
    )

    def step() -> None:
        loss = predictor.training_loss(features, effects)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def seconds_per_step(label: str, repeats: int, kinds: tuple[str, ...]) -> dict[str, float]:
    """Median of several steps of each kind, taken alternately so that all meet the same load."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    config = LstmConfig()
    if label == "one-shot":
        steps = {"shipped": one_shot_step()}
    else:
        steps = {"plain": plain_step(label, config), "shipped": shipped_step(label, config)}
        if "compiled" in kinds and label == "im-cnn":
            steps["compiled"] = shipped_step(label, config, compiled=True)
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(repeats + 1):
        for name, step in steps.items():
            started = perf_counter()
            step()
            seconds[name].append(perf_counter() - started)
    if "Lightning" in kinds and label != "one-shot":
        seconds["Lightning"] = lightning_steps(label, config, repeats)
    return {name: sorted(taken[1:])[repeats // 2] for name, taken in seconds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--workers", type=int, default=1, help="processes side by side, of one thread each")
    parser.add_argument("--repeats", type=int, default=15, help="steps timed of each")
    parser.add_argument("--compile", action="store_true", help="also time compiled convolutions")
    parser.add_argument("--out", type=Path, help="file for the results (JSON)")
    arguments = parser.parse_args()
    kinds = tuple(
        kind
        for kind in KINDS
        if kind in ("plain", "shipped")
        or (kind == "Lightning" and find_spec("pytorch_lightning"))
        or (kind == "compiled" and arguments.compile)
    )
    windows = NUM_TRAJECTORIES * math.ceil((NUM_SAMPLES - 1) / LstmConfig().window)
    batches = {
        kind: math.ceil((windows if kind in ("plain", "Lightning") else NUM_TRAJECTORIES) / BATCH)
        for kind in KINDS
    }
    precision = fast_precision(torch.device("cpu"))
    print(
        f"{NUM_TRAJECTORIES} trajectories of {NUM_SAMPLES} samples, {arguments.workers} process(es), {precision}"
    )
    print(
        f"{'':8s} {'':9s} {'s/step':>7s} {'s/epoch':>8s} {'samples/s':>9s} {'epochs':>6s} {'trainings/h':>11s}"
    )
    rows = []
    for label in LABELS:
        jobs = (delayed(seconds_per_step)(label, arguments.repeats, kinds) for _ in range(arguments.workers))
        measured = Parallel(n_jobs=arguments.workers)(jobs)
        own = OneShotConfig.training if label == "one-shot" else TrainConfig()
        for kind in (each for each in KINDS if each in measured[0]):
            step = sum(each[kind] for each in measured) / arguments.workers
            epoch = step * batches[kind]
            epochs = PLAIN_EPOCHS if kind in ("plain", "Lightning") else own.num_epochs(NUM_TRAJECTORIES)
            row = {
                "predictor": label,
                "kind": kind,
                "seconds_per_step": round(step, 4),
                "seconds_per_epoch": round(epoch, 2),
                "samples_per_second": round(arguments.workers * NUM_TRAJECTORIES * NUM_SAMPLES / epoch),
                "epochs": epochs,
                "trainings_per_hour": round(arguments.workers * 3600 / (epoch * epochs), 2),
            }
            rows.append(row)
            print("{:8s} {:9s} {:7.4f} {:8.1f} {:9d} {:6d} {:11.2f}".format(*row.values()))
    if arguments.out is not None:
        write_json(
            arguments.out, {"workers": arguments.workers, "precision": str(precision), "rows": rows}, 2
        )


if __name__ == "__main__":
    main()
