"""A predictor that was trained before learns from further interactions."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from factories import fake_batch, fake_data_set
from foretrace.cli import main
from foretrace.errors import TrainingError
from foretrace.interactions.batch import InteractionBatch
from foretrace.predictor import (
    EffectPredictor,
    LstmConfig,
    OneShotConfig,
    TrainConfig,
    load_predictor,
    train_predictor,
)
from foretrace.predictor.config import FINE_TUNING
from foretrace.predictor.run_folder import RunFolder
from foretrace.predictor.training import _loop_settings
from foretrace.trajectories import mean_distance

FIRST = TrainConfig(epochs=8, min_steps=1, split=None, device="cpu")
MORE = replace(FIRST, epochs=25, learning_rate=1e-2)
CONFIGS = {
    "lstm": LstmConfig(features="none", hidden=16, window=6),
    "one-shot": OneShotConfig(hidden=16, ensemble=2, components=4),
}


@pytest.fixture(scope="module")
def batch() -> InteractionBatch:
    return fake_batch(np.random.default_rng(7), 40, num_samples=20)


@pytest.fixture(scope="module")
def further() -> InteractionBatch:
    """Interactions of another world: everything rises twice as far."""
    other = fake_batch(np.random.default_rng(8), 30, num_samples=20)
    com = other.com.copy()
    com[..., 2] = com[:, :1, 2] + 2 * (com[..., 2] - com[:, :1, 2])
    return replace(other, com=com)


@pytest.fixture(scope="module", params=list(CONFIGS))
def initial(request: pytest.FixtureRequest, batch: InteractionBatch, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp(request.param)
    return train_predictor(batch, CONFIGS[request.param], out / "initial", FIRST, progress=False)


def read(run: Path) -> EffectPredictor:
    predictor = load_predictor(run)
    assert isinstance(predictor, EffectPredictor)
    return predictor


def error(predictor: EffectPredictor, batch: InteractionBatch) -> float:
    imagined = predictor.imagine_batch(batch).com[:, : batch.com.shape[1]]
    return float(np.mean(mean_distance(imagined, batch.com)))


def test_it_starts_from_its_weights_and_keeps_its_normalisation(initial, further, tmp_path):
    before = read(initial)
    after = read(train_predictor(further, read(initial), tmp_path / "tuned", MORE, progress=False))
    assert error(after, further) < 0.9 * error(before, further)
    own, new = before.state_dict(), after.state_dict()
    for name in ("state_mean", "state_scale", "times", "motions", "covariance", "value_scale"):
        assert name not in own or torch.equal(own[name], new[name])
    assert any(not torch.equal(own[name], new[name]) for name, _ in before.named_parameters())
    for name, (low, high) in before.ranges.items():
        assert after.ranges[name][0] <= low
        assert after.ranges[name][1] >= high


def test_a_rate_of_nearly_nothing_leaves_it_as_it_was(initial, further, tmp_path):
    slow = replace(MORE, epochs=1, learning_rate=1e-12)
    after = read(train_predictor(further, read(initial), tmp_path / "tuned", slow, progress=False))
    before = read(initial)
    assert np.allclose(before.imagine_batch(further).com, after.imagine_batch(further).com, atol=1e-7)


def test_a_training_that_was_cut_short_goes_on_to_the_same_end(initial, further, tmp_path, monkeypatch):
    whole = train_predictor(further, read(initial), tmp_path / "whole", MORE, progress=False)
    save = RunFolder.save

    def save_and_die(self, progress, *others):
        save(self, progress, *others)
        if progress.epoch == 3:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(RunFolder, "save", save_and_die)
        with pytest.raises(KeyboardInterrupt):
            train_predictor(further, read(initial), tmp_path / "cut", MORE, progress=False)
    resumed = train_predictor(further, read(initial), tmp_path / "cut", MORE, progress=False)
    one, other = read(whole).state_dict(), read(resumed).state_dict()
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_a_training_goes_on_from_the_same_weights_only(initial, further, tmp_path):
    train_predictor(further, read(initial), tmp_path / "tuned", MORE, progress=False)
    tuned = read(tmp_path / "tuned")
    with pytest.raises(TrainingError, match=r"holds a training with training\.initial"):
        train_predictor(further, tuned, tmp_path / "tuned", MORE, progress=False)


def test_interactions_may_be_observed_for_a_shorter_time(initial, further, tmp_path):
    short = replace(
        further,
        times=further.times[:12],
        com=further.com[:, :12],
        pose=further.pose[:, :12],
        length=np.minimum(further.length, 12),
        slip_index=np.minimum(further.slip_index, 12),
    )
    after = read(train_predictor(short, read(initial), tmp_path / "tuned", MORE, progress=False))
    assert after.num_samples == 20
    assert error(after, short) < 0.9 * error(read(initial), short)


@pytest.mark.parametrize(
    "change", [lambda times: 2 * times, lambda times: np.append(times, times[-1] + 0.05)]
)
def test_other_sample_times_are_refused(initial, further, tmp_path, change):
    times = change(further.times)
    fill = np.full((len(further), len(times) - len(further.times), 1), np.nan)
    longer = {
        name: np.concatenate([values, np.repeat(fill, values.shape[-1], axis=-1)], axis=1)
        for name, values in (("com", further.com), ("pose", further.pose))
    }
    with pytest.raises(TrainingError, match=r"sampled every 0\.\S+ s up to \S+ s, .* take data with its"):
        train_predictor(replace(further, times=times, **longer), read(initial), tmp_path / "tuned", MORE)


def test_its_recommended_settings_are_those_of_fine_tuning(initial):
    assert _loop_settings(read(initial), None) is FINE_TUNING
    assert _loop_settings(CONFIGS["lstm"].make(20), None) is CONFIGS["lstm"].training


@pytest.mark.parametrize("samples", [20, 14])
def test_the_command(initial, tmp_path, capsys, samples):
    fake_data_set(tmp_path / "data", num_samples=samples)
    words = [
        "train",
        "--initial",
        str(initial),
        "--data",
        str(tmp_path / "data"),
        "--out",
        str(tmp_path / "run"),
    ]
    assert main([*words, "--epochs", "2", "--card"]) == 0
    noted = json.loads((tmp_path / "run" / "config.json").read_text())
    assert noted["config"] == json.loads((initial / "config.json").read_text())["config"]
    assert noted["training"]["epochs"] == 2
    assert noted["training"]["learning_rate"] == FINE_TUNING.learning_rate
    card = (tmp_path / "run" / "MODEL_CARD.md").read_text()
    assert (
        f"foretrace train --data {tmp_path / 'data'} --out {tmp_path / 'run'} --initial INITIAL --epochs 2"
        in card
    )
    assert f"have the checksum `{noted['training']['initial']}`" in card


@pytest.mark.parametrize("option", [["--hidden", "8"], ["--predictor", "lstm"], ["--features", "none"]])
def test_settings_of_the_predictor_are_refused_beside_it(initial, tmp_path, capsys, option):
    words = ["train", "--initial", str(initial), "--data", "nowhere", "--out", str(tmp_path / "run"), *option]
    assert main(words) == 2
    assert f"{option[0]} and --initial do not go together" in capsys.readouterr().err


def test_a_training_does_not_begin_where_it_starts_from(initial, tmp_path, capsys):
    run = tmp_path / "seed-0"
    shutil.copytree(initial, run)
    fake_data_set(tmp_path / "data", num_samples=20)
    words = ["train", "--initial", str(run), "--data", str(tmp_path / "data"), "--fresh", "--out"]
    for rest in ([str(run)], [str(tmp_path), "--seeds", "0"]):
        assert main([*words, *rest]) == 2
        assert f"--initial {run} is where the training is to go" in capsys.readouterr().err
    assert (run / "model.safetensors").read_bytes() == (initial / "model.safetensors").read_bytes()


def test_data_without_its_outcomes_are_refused(batch, tmp_path, capsys):
    initial = train_predictor(batch, CONFIGS["lstm"], tmp_path / "initial", FIRST, progress=False)
    data = fake_data_set(tmp_path / "data", num_samples=20)
    words = ["train", "--initial", str(initial), "--data", str(data), "--out", str(tmp_path / "run")]
    assert main([*words, "--outcomes", "tumbled"]) == 2
    assert (
        f"{data} has the outcomes levered, slipped, the predictor to start from learns tumbled: give data of its action"
        in " ".join(capsys.readouterr().err.split())
    )
