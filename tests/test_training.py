import copy
import csv
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from factories import QUICK_OPTIONS, fake_batch, fake_data_set
from foretrace.errors import CheckpointError, TrainingError
from foretrace.evaluation.metrics import evaluate_predictor
from foretrace.features import FEATURES, Autoencoder256, NoFeatures
from foretrace.files import LOCK
from foretrace.interactions import dataset, shards
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.splits import Split
from foretrace.predictor import (
    LstmConfig,
    OneShotConfig,
    TrainConfig,
    load_predictor,
    part_of,
    parts,
    train_predictor,
)
from foretrace.predictor import training as training_module
from foretrace.predictor.run_folder import RunFolder
from foretrace.predictor.runtime import suitable_threads
from foretrace.predictor.training import fit_predictor, learning_rate, parameter_groups
from foretrace.trajectories import mean_distance

CONFIG = LstmConfig(features="none", hidden=16, window=6)
SMALL = TrainConfig(epochs=3, min_steps=1, split=None, device="cpu")


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def batch():
    return fake_batch(np.random.default_rng(7), 30, num_samples=20)


def train(data, out: Path, training: TrainConfig = SMALL, config=CONFIG, **more) -> Path:
    return train_predictor(data, config, out, training, progress=False, **more)


def rows(run: Path) -> list[dict[str, str]]:
    with (run / "metrics.csv").open() as file:
        return [
            {name: text for name, text in row.items() if name != "seconds"} for row in csv.DictReader(file)
        ]


def same_tensors(one: Path, other: Path) -> bool:
    a, b = load_file(one / "model.safetensors"), load_file(other / "model.safetensors")
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


class Interrupted(Exception):
    pass


def interrupt_after(monkeypatch, epochs: int, error: type[BaseException] = Interrupted) -> None:
    """Let the training die right after it has noted so many epochs."""
    save = RunFolder.save

    def save_and_die(self, progress, *others):
        save(self, progress, *others)
        if progress.epoch == epochs:
            raise error

    monkeypatch.setattr(RunFolder, "save", save_and_die)


@pytest.mark.parametrize("state", ["position", "pose"])
@pytest.mark.parametrize("features", list(FEATURES))
def test_a_run_leaves_what_is_needed(tmp_path, batch, features, state):
    options = QUICK_OPTIONS.get(features, {})
    config = replace(CONFIG, features=features, feature_options=options, state=state)
    run = train(batch, tmp_path / "run", replace(SMALL, epochs=2), config)
    names = {file.name for file in run.iterdir()}
    assert names == {
        *(
            LOCK,
            "config.json",
            "model.safetensors",
            "metrics.csv",
            "environment.json",
            "split.json",
            "tensorboard",
        )
    }
    assert [row["epoch"] for row in rows(run)] == ["1", "2"]
    environment = json.loads((run / "environment.json").read_text())
    assert environment["seed"] == 0
    assert environment["versions"]["torch"] == torch.__version__
    imagined = load_predictor(run).imagine_batch(batch)
    assert imagined.com.shape == batch.com.shape
    assert np.isfinite(imagined.com).all()
    np.testing.assert_array_equal(imagined.times, batch.times)


def test_tensorboard_reads_the_events(tmp_path, batch):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run = train(batch, tmp_path / "run")
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    logged = [event.value for event in events.Scalars("validation_full_cm")]
    np.testing.assert_allclose(logged, [float(row["validation_full_cm"]) for row in rows(run)], rtol=1e-6)


@pytest.mark.parametrize("features", ["none", "im-cnn"])
def test_the_same_seed_trains_the_same_model(tmp_path, batch, features):
    config, training = replace(CONFIG, features=features), replace(SMALL, epochs=2)
    one = train(batch, tmp_path / "one", training, config)
    torch.manual_seed(99)
    np.random.default_rng(1).random()
    other = train(batch, tmp_path / "other", training, config)
    assert same_tensors(one, other)
    assert rows(one) == rows(other)
    assert not same_tensors(one, train(batch, tmp_path / "seed", replace(training, seed=1), config))


def test_training_leaves_the_callers_random_numbers_and_threads_alone(tmp_path, batch):
    before = torch.random.get_rng_state()
    train(batch, tmp_path / "run", replace(SMALL, threads=2, epochs=1))
    assert torch.equal(before, torch.random.get_rng_state())
    assert torch.get_num_threads() == 1


@pytest.mark.parametrize("after", [0, 2])
@pytest.mark.parametrize("features", ["none", "im-cnn"])
def test_a_resumed_training_ends_as_if_never_interrupted(tmp_path, batch, monkeypatch, features, after):
    config = replace(CONFIG, features=features)
    whole = train(batch, tmp_path / "whole", config=config)
    with monkeypatch.context() as patch:
        interrupt_after(patch, after)
        with pytest.raises(Interrupted):
            train(batch, tmp_path / "run", config=config)
    assert (tmp_path / "run" / "resume.safetensors").is_file()
    resumed = train(batch, tmp_path / "run", config=config)
    assert same_tensors(whole, resumed)
    assert rows(whole) == rows(resumed)
    assert not (resumed / "resume.safetensors").exists()


def test_a_killed_process_can_go_on(tmp_path, batch):
    """The real thing: kill -9 in the middle, then the same call."""
    script = textwrap.dedent("""
        import sys
        import numpy as np, torch
        from factories import QUICK_OPTIONS, fake_batch
        from foretrace.predictor import LstmConfig, TrainConfig, train_predictor
        torch.set_num_threads(1)
        config = LstmConfig(features="none", hidden=16, window=6)
        training = TrainConfig(epochs=25, min_steps=1, split=None, device="cpu")
        batch = fake_batch(np.random.default_rng(7), 30, num_samples=20)
        train_predictor(batch, config, sys.argv[1], training, progress=False)
    """)
    tests = Path(__file__).parent
    environment = os.environ | {"PYTHONPATH": f"{tests}{os.pathsep}{tests.parent / 'src'}"}
    process = subprocess.Popen([sys.executable, "-c", script, str(tmp_path / "run")], env=environment)
    metrics = tmp_path / "run" / "metrics.csv"
    while not metrics.is_file() and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert 0 < len(rows(tmp_path / "run")) < 25
    training = replace(SMALL, epochs=25)
    resumed = train(batch, tmp_path / "run", training)
    assert same_tensors(train(batch, tmp_path / "whole", training), resumed)


def test_after_ctrl_c_the_best_so_far_can_be_used(tmp_path, batch, monkeypatch):
    with monkeypatch.context() as patch:
        interrupt_after(patch, 2, KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt):
            train(batch, tmp_path / "run")
    assert load_predictor(tmp_path / "run").imagine_batch(batch).com.shape == batch.com.shape


def test_a_finished_training_is_not_repeated(tmp_path, batch):
    run = train(batch, tmp_path / "run")
    before = (run / "model.safetensors").stat().st_mtime_ns
    assert train(batch, run) == run
    assert (run / "model.safetensors").stat().st_mtime_ns == before
    train(batch, run, resume=False)
    assert (run / "model.safetensors").stat().st_mtime_ns > before


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"config": replace(CONFIG, hidden=17)}, "config.hidden"),
        ({"training": replace(SMALL, learning_rate=2e-3)}, r"training.learning_rate = 0.008, not 0.002"),
    ],
)
def test_a_folder_of_another_configuration_is_refused(tmp_path, batch, change, name):
    run = train(batch, tmp_path / "run")
    with pytest.raises(TrainingError, match=name):
        train(batch, run, **change)
    train(batch, run, **change, resume=False)


def test_a_folder_of_other_data_is_refused(tmp_path, batch):
    run = train(batch, tmp_path / "run")
    with pytest.raises(TrainingError, match=r"training\.data"):
        train(batch[:20], run)


@pytest.mark.parametrize("resume", [True, False])
def test_a_folder_with_something_else_is_left_alone(tmp_path, batch, resume):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(TrainingError, match="not empty"):
        train(batch, tmp_path, resume=resume)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_damaged_resume_file_is_named(tmp_path, batch, monkeypatch):
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1)
        with pytest.raises(Interrupted):
            train(batch, tmp_path / "run")
    (tmp_path / "run" / "resume.safetensors").write_bytes(b"nonsense")
    with pytest.raises((TrainingError, CheckpointError), match=r"resume\.safetensors"):
        train(batch, tmp_path / "run")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"split": (1400, 100, 300)}, "needs 1800"),
        ({"outcomes": ("tumbled",)}, "tumbled; the data has: levered, slipped"),
    ],
)
def test_trainings_that_cannot_start_are_refused(tmp_path, batch, change, message):
    with pytest.raises(TrainingError, match=message):
        train(batch, tmp_path / "run", replace(SMALL, **change))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("settings", "name", "value", "remedy"),
    [
        (TrainConfig, "epochs", 0, "from 1 to 1000000"),
        (TrainConfig, "batch_size", True, "from 1"),
        (TrainConfig, "threads", 0, "from 1 to 1024"),
        (TrainConfig, "learning_rate", 0.0, "number above 0 and at most 1000"),
        (TrainConfig, "learning_rate", float("inf"), "number above 0 and at most 1000"),
        (TrainConfig, "learning_rate", float("nan"), "number above 0 and at most 1000"),
        (TrainConfig, "seed", -1, "from 0"),
        (TrainConfig, "device", "gpu", "choose from auto, cpu, cuda"),
        (TrainConfig, "precision", "fp16", "choose from auto, float32, bfloat16"),
        (TrainConfig, "outcomes", (), "name at least one"),
        (TrainConfig, "split", (1, 2), "sizes of three parts"),
        (LstmConfig, "window", 0, "from 1"),
        (LstmConfig, "hidden", 5000, "from 1 to 4096"),
        (LstmConfig, "steps_ahead", 0, "from 1 to 1000"),
        (LstmConfig, "state", "poses", "choose from position, pose, turn"),
        (LstmConfig, "context", "friction", "names in a tuple"),
    ],
)
def test_absurd_settings_are_refused(settings, name, value, remedy):
    # The types of fields are checked in the tests alone; users get these messages for wrong types, too.
    untyped = next(kind for kind in settings.__mro__ if "__post_init__" in kind.__dict__)
    config = copy.copy(settings())
    object.__setattr__(config, name, value)
    with pytest.raises(TrainingError, match=f"{name} is {re.escape(repr(value))}: .*{remedy}"):
        untyped.__post_init__(config)


def test_unknown_outcomes_and_features_are_refused():
    with pytest.raises(TrainingError, match="unknown outcome 'melted'; choose from levered"):
        TrainConfig(outcomes=("melted",))
    with pytest.raises(TrainingError, match="unknown features 'magic'; available: none, im-cnn"):
        LstmConfig(features="magic")
    with pytest.raises(TrainingError, match="none has no option 'width'; it has: none"):
        LstmConfig(features="none", feature_options={"width": 3}).make(5)


def test_an_instance_is_trained_in_place_of_its_config(tmp_path, batch):
    torch.manual_seed(0)
    predictor = CONFIG.make(20)
    start = {name: tensor.clone() for name, tensor in predictor.state_dict().items()}
    run = train(batch, tmp_path / "run", config=predictor)
    loaded = load_predictor(run).state_dict()
    assert not torch.equal(loaded["output.weight"], start["output.weight"])
    with pytest.raises(TrainingError, match="imagines 21 samples, the data have 20"):
        train(batch, tmp_path / "again", config=CONFIG.make(21))


def test_threads_are_those_that_are_idle_and_worth_it(monkeypatch):
    small, large = CONFIG.make(4), LstmConfig(features="im-cnn", hidden=4).make(4)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: range(8), raising=False)
    for load, expected in ((0.1, 4), (5.2, 3), (9.0, 1)):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load, 0.0, 0.0))
        assert suitable_threads(large) == expected
        assert suitable_threads(small) == 1


def test_a_missing_cuda_device_is_refused(tmp_path, batch, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(TrainingError, match="cuda"):
        train(batch, tmp_path / "run", replace(SMALL, device="cuda"))


def test_a_diverging_training_is_stopped(tmp_path, batch, monkeypatch):
    monkeypatch.setattr("foretrace.predictor.config.FASTEST", 1e31)  # slower ones no longer diverge
    with pytest.raises(
        TrainingError, match=r"loss is (nan|inf) in epoch \d+: lower the learning rate of 1e\+30"
    ):
        train(batch, tmp_path / "run", replace(SMALL, learning_rate=1e30))


def test_a_motion_that_is_not_finite_is_named(batch):
    com = batch.com.copy()
    com[3, 5] = np.nan
    rows = np.arange(len(batch))
    with pytest.raises(TrainingError, match="interaction 3 has a motion that is not finite, as have 1 of"):
        fit_predictor(replace(batch, com=com), CONFIG, Split(rows, rows, rows), SMALL)


def test_only_the_chosen_outcomes_are_split(tmp_path, batch):
    run = train(batch, tmp_path / "run", replace(SMALL, epochs=1))
    parts = [part_of(run, batch, name) for name in ("train", "validation", "test")]
    assert all((part.outcome == "levered").all() for part in parts)
    ids = np.concatenate([part.ids for part in parts])
    assert len(np.unique(ids)) == len(ids) == (batch.outcome == "levered").sum()
    with pytest.raises(TrainingError, match="'tset'"):
        part_of(run, batch, "tset")
    with pytest.raises(TrainingError, match="give the data set"):
        part_of(run, batch[:5], "train")
    other = replace(batch, com=batch.com + 1e-6)
    with pytest.raises(TrainingError, match="were others than those in the data"):
        part_of(run, other, "train")


def test_normalisation_and_fit_see_the_training_part_alone(tmp_path, batch, registered):
    seen = {}

    class Fitted(NoFeatures):
        label = "fitted"

        def fit(self, train, validation, *, seed, report):
            seen.update(
                train=train.batch.ids, validation=validation.batch.ids, rows=len(train.inputs), seed=seed
            )

    split = Split(np.arange(0, 10), np.arange(10, 15), np.arange(15, 20))
    config, training = replace(CONFIG, features="fitted"), replace(SMALL, epochs=1, seed=5)
    run = train(batch, tmp_path / "one", training, config, split=split)
    tensors = load_file(run / "model.safetensors")
    assert seen["train"].tolist() == list(range(10))
    assert seen["validation"].tolist() == list(range(10, 15))
    assert (seen["rows"], seen["seed"]) == (10, 5)

    other = fake_batch(np.random.default_rng(7), 30, num_samples=20)
    other.com[10:] += 0.5
    run = train(other, tmp_path / "two", training, config, split=split)
    moved = load_file(run / "model.safetensors")
    assert torch.equal(tensors["state_mean"], moved["state_mean"])
    assert torch.equal(tensors["state_scale"], moved["state_scale"])
    kept = np.concatenate([batch.com[k, : min(batch.length[k], batch.slip_index[k])] for k in range(10)])
    np.testing.assert_allclose(tensors["state_mean"], kept.mean(axis=0), rtol=1e-5)


def test_the_best_validation_epoch_is_kept(tmp_path, batch, monkeypatch):
    losses = iter([3.0, 1.0, 2.0])
    kept = []
    validate = training_module._Training._validate

    def scripted(self):
        kept.append({name: tensor.clone() for name, tensor in self.predictor.state_dict().items()})
        return validate(self) | {"validation_loss": next(losses)}

    monkeypatch.setattr(training_module._Training, "_validate", scripted)
    tensors = load_file(train(batch, tmp_path / "run") / "model.safetensors")
    assert torch.equal(tensors["output.weight"], kept[1]["output.weight"])
    assert not torch.equal(tensors["output.weight"], kept[2]["output.weight"])


def test_the_learning_rate_rises_and_falls():
    rates = [learning_rate(1.0, share) for share in np.linspace(0, 1, 101)]
    assert rates[0] == 0.0
    assert rates[10] == pytest.approx(1.0)
    assert rates[55] == pytest.approx(0.5)
    assert rates[100] == pytest.approx(0.0)
    assert np.argmax(rates) == 10
    assert (np.diff(rates[10:]) < 0).all()


def test_units_with_many_inputs_learn_at_a_lower_rate_and_many_features_decay():
    predictor = LstmConfig(features="sc-3200", hidden=512).make(20)
    groups = {id(p): group for group in parameter_groups(predictor) for p in group["params"]}
    assert len(groups) == len(list(predictor.parameters()))

    def setting(parameter):
        return groups[id(parameter)]["share"], groups[id(parameter)]["weight_decay"]

    assert setting(predictor.lstm.weight_hidden) == (0.5, 0.0)
    assert setting(predictor.lstm.weight_state) == (1.0, 0.0)
    assert setting(predictor.lstm.weight_features) == (1.0, 4.0)
    assert setting(predictor.lstm.bias) == (1.0, 0.0)


def test_a_small_training_part_is_passed_over_more_often():
    config = TrainConfig(epochs=15, min_steps=300, batch_size=32)
    assert config.num_epochs(1400) == 15
    assert config.num_epochs(36) == 150


def test_features_that_do_not_train_are_computed_once(tmp_path, batch, registered):
    calls = []

    class Counted(NoFeatures):
        label = "counted"

        def forward(self, inputs):
            calls.append(len(inputs))
            return inputs

    train(batch, tmp_path / "run", config=replace(CONFIG, features="counted"))
    assert len(calls) == 2  # the training part and the validation part


def halves(batch) -> Split:
    return Split(np.arange(20), np.arange(20, 25), np.arange(25, 30))


def test_training_in_memory_ends_with_the_model_of_the_folder(tmp_path, batch):
    run = train(batch, tmp_path / "run", split=halves(batch))
    inputs = NoFeatures().inputs(batch)
    predictor, progress = fit_predictor(batch, CONFIG, halves(batch), SMALL, inputs=inputs)
    kept = load_file(run / "model.safetensors")
    assert all(torch.equal(kept[name], tensor) for name, tensor in predictor.state_dict().items())
    assert not predictor.training
    assert [str(row["epoch"]) for row in progress.history] == [row["epoch"] for row in rows(run)]


def test_what_features_learned_is_learned_once(tmp_path, batch, monkeypatch):
    config = replace(CONFIG, features="ae-256", feature_options=QUICK_OPTIONS["ae-256"])
    training = replace(SMALL, epochs=1)
    calls = []
    fit = Autoencoder256.fit

    def counted(self, *parts, **more):
        calls.append(1)
        fit(self, *parts, **more)

    monkeypatch.setattr(Autoencoder256, "fit", counted)
    first, _ = fit_predictor(batch, config, halves(batch), training, fitted=tmp_path)
    again, _ = fit_predictor(batch, config, halves(batch), training, fitted=tmp_path)
    assert len(calls) == 1
    assert all(torch.equal(first.state_dict()[name], tensor) for name, tensor in again.state_dict().items())
    other = replace(halves(batch), train=np.arange(19))
    fit_predictor(batch, config, other, training, fitted=tmp_path)
    fit_predictor(batch, config, halves(batch), replace(training, seed=1), fitted=tmp_path)
    assert len(calls) == 3
    for file in tmp_path.glob("ae-256-*.safetensors"):
        file.write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match="cannot be read"):
        fit_predictor(batch, config, halves(batch), training, fitted=tmp_path)


def test_evaluation_rows(tmp_path, batch):
    run = train(batch, tmp_path / "run")
    predictor = load_predictor(run)
    table = evaluate_predictor(predictor, batch)
    found = {(row["group"], row["metric"], row["start"]): row for row in table}
    assert len(found) == len(table)
    assert {row["start"] for row in table} == {"observed", "estimated"}
    whole = found["all", "full", "observed"]
    assert whole["count"] == len(batch)
    truth = np.where(
        (np.arange(20) < np.minimum(batch.length, batch.slip_index)[:, None])[..., None], batch.com, np.nan
    )
    errors = 100 * mean_distance(predictor.imagine_batch(batch).com, truth)
    assert whole["mean_cm"] == pytest.approx(errors.mean())
    assert whole["median_cm"] == pytest.approx(np.median(errors))
    assert whole["p95_cm"] == pytest.approx(np.percentile(errors, 95))
    slipped = found["slipped", "full", "observed"]
    assert slipped["mean_cm"] == pytest.approx(errors[batch.outcome == "slipped"].mean())
    corners = [
        row["count"] for row in table if row["group"].endswith(" corners") and row["metric"] == "final"
    ]
    assert sum(corners) == 2 * len(batch)


@pytest.mark.parametrize("config", [CONFIG, OneShotConfig(hidden=8, ensemble=2, components=6)])
def test_data_sets_larger_than_memory_train_the_same(tmp_path, monkeypatch, config):
    """Prepared piece by piece: the same numbers to the bit; in single precision, nearly the same ones."""
    fake_data_set(tmp_path / "data")
    monkeypatch.setattr(shards, "CACHE_BYTES", 0)
    monkeypatch.setattr(dataset, "ROWS_AT_ONCE", 16)
    data = Dataset.open(tmp_path / "data")
    whole = train(data, tmp_path / "whole", config=config)
    monkeypatch.setattr(training_module, "IN_MEMORY", 0)
    pieces = train(data, tmp_path / "pieces", config=config)
    for name in ("config.json", "split.json", "model.safetensors"):
        assert (pieces / name).read_bytes() == (whole / name).read_bytes(), name
    assert part_of(pieces, data).ids.tolist() == part_of(whole, data.batch()).ids.tolist()
    monkeypatch.setattr(parts, "LARGE", 0)
    single = train(data, tmp_path / "single", config=config)
    assert {file.name for file in single.iterdir()} == {file.name for file in whole.iterdir()}
    monkeypatch.setattr(parts, "FEW_BYTES", 10**9)  # in memory, not in files of the folder
    memory = train(data, tmp_path / "memory", config=config)
    assert (memory / "model.safetensors").read_bytes() == (single / "model.safetensors").read_bytes()
    losses = [[float(row["train_loss"]) for row in rows(run)] for run in (whole, single)]
    np.testing.assert_allclose(*losses, rtol=1e-3)
    assert (single / "model.safetensors").read_bytes() != (whole / "model.safetensors").read_bytes()
