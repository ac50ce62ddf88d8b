"""Small data sets and predictors on disk, for the tests of exports."""

from pathlib import Path

import numpy as np
import torch

import factories
from foretrace.interactions import shards, storage
from foretrace.interactions.record import Interaction
from foretrace.predictor import LstmConfig, LstmPredictor, save_checkpoint

NUM_SAMPLES = 20


def write_data(folder: Path, interactions: list[Interaction]) -> Path:
    """A finished data set of one shard."""
    (folder / storage.SHARD_FOLDER).mkdir(parents=True)
    manifest = storage.new_manifest({"seed": 0}, len(interactions), len(interactions), {"foretrace": "0.1.0"})
    table = storage.to_table([storage.encode(interaction, interaction.id) for interaction in interactions])
    manifest["shards"][storage.shard_name(0)] = shards.write_shard(folder, storage.shard_name(0), table)
    storage.write_manifest(folder, manifest)
    return folder


def fake_data(folder: Path, num: int = 4) -> Path:
    """A data set of synthetic lever-ups, numbered from 0."""
    rng = np.random.default_rng(7)
    return write_data(
        folder, [factories.fake_interaction(rng, id, num_samples=NUM_SAMPLES) for id in range(num)]
    )


def fake_run(folder: Path, features: str = "none", state: str = "pose") -> Path:
    """A checkpoint of a predictor that has learned nothing."""
    torch.manual_seed(2)
    predictor = LstmPredictor(LstmConfig(features=features, hidden=8, state=state), NUM_SAMPLES)
    size = len(predictor.state_mean)
    predictor.set_normalisation(np.full(size, 0.1), np.full(size, 0.5), 0.05 * np.arange(NUM_SAMPLES))
    save_checkpoint(folder, predictor.eval())
    return folder
