import json
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from factories import fake_batch
from foretrace.errors import CheckpointError
from foretrace.features import FEATURES
from foretrace.predictor import LstmConfig, LstmPredictor, OneShotConfig, load_predictor, save_checkpoint
from foretrace.predictor.checkpoint import read_config


@pytest.fixture(scope="module")
def batch():
    torch.set_num_threads(1)
    return fake_batch(np.random.default_rng(5), 4, num_samples=10)


def make(features: str = "none", **settings) -> LstmPredictor:
    torch.manual_seed(2)
    predictor = LstmPredictor(LstmConfig(**({"features": features, "hidden": 8} | settings)), 10)
    predictor.set_normalisation(
        np.full(len(predictor.state_mean), 0.1), np.full(len(predictor.state_mean), 0.5), 0.05 * np.arange(10)
    )
    return predictor.eval()


@pytest.fixture
def saved(tmp_path):
    save_checkpoint(tmp_path, make())
    return tmp_path


def edit_config(path, **changes):
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(config | changes))


def edit_tensors(path, change):
    tensors = load_file(path / "model.safetensors")
    change(tensors)
    save_file(tensors, path / "model.safetensors")


@pytest.mark.parametrize("features", list(FEATURES))
@pytest.mark.parametrize("state", ["position", "pose"])
def test_saved_and_loaded_imagines_the_same(tmp_path, batch, features, state):
    predictor = make(features, state=state, steps_ahead=2, window=4)
    save_checkpoint(tmp_path / "new" / "folder", predictor)
    loaded = load_predictor(tmp_path / "new" / "folder")
    expected, found = predictor.imagine_batch(batch), loaded.imagine_batch(batch)
    np.testing.assert_array_equal(found.com, expected.com)
    np.testing.assert_array_equal(found.times, expected.times)
    if state == "pose":
        np.testing.assert_array_equal(found.pose, expected.pose)
    assert loaded.config == predictor.config
    assert loaded.features.options == predictor.features.options
    assert not loaded.training


def test_options_of_features_survive(tmp_path):
    options = {"channel": "height", "width": 7}
    predictor = LstmPredictor(LstmConfig(features="im-cnn", feature_options=options, hidden=8), 10)
    save_checkpoint(tmp_path, predictor)
    loaded = load_predictor(tmp_path)
    assert loaded.features.options == {"channel": "height", "width": 7, "dropout": 0.2}


def test_a_folder_holds_no_pickle(saved):
    assert sorted(file.name for file in saved.iterdir()) == ["config.json", "model.safetensors"]
    load_file(saved / "model.safetensors")


def test_loading_leaves_the_random_numbers_alone(saved):
    before = torch.random.get_rng_state()
    load_predictor(saved)
    assert torch.equal(before, torch.random.get_rng_state())


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_missing_files_are_named(saved, name):
    (saved / name).unlink()
    with pytest.raises(CheckpointError, match=f"{name} (is missing|does not exist)"):
        load_predictor(saved)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_damaged_files_are_named(saved, name):
    content = (saved / name).read_bytes()
    (saved / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(CheckpointError, match=name):
        load_predictor(saved)


@pytest.mark.parametrize("version", [0, 3, None, "1"])
def test_other_versions_are_refused(saved, version):
    edit_config(saved, version=version)
    with pytest.raises(CheckpointError, match=r"format version .* reads version 2"):
        load_predictor(saved)


def test_other_formats_are_refused(saved):
    edit_config(saved, format="something-else")
    with pytest.raises(CheckpointError, match="foretrace-predictor"):
        load_predictor(saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"predictor": "oracle"}, "unknown predictor 'oracle'; available: lstm"),
        ({"predictor": ["lstm"]}, r"entry predictor is \['lstm'\], a text"),
        (
            {"config": {"hidden": 8}},
            "missing or unknown settings context, feature_options, features, residual",
        ),
        ({"config": None}, "entry config is null, an object"),
        ({"num_samples": "ten"}, "entry num_samples is 'ten', a whole number"),
        ({"outcomes": ["melted"]}, "unknown outcome 'melted'"),
    ],
)
def test_odd_configurations_are_refused(saved, change, message):
    edit_config(saved, **change)
    with pytest.raises(CheckpointError, match=message):
        load_predictor(saved)


def test_missing_tensors_are_named(saved):
    edit_tensors(saved, lambda tensors: tensors.pop("lstm.bias"))
    with pytest.raises(CheckpointError, match=r"lacks the tensors lstm\.bias"):
        load_predictor(saved)


def test_extra_tensors_are_named(saved):
    edit_tensors(saved, lambda tensors: tensors.update(stowaway=torch.zeros(1)))
    with pytest.raises(CheckpointError, match="unexpected tensors stowaway"):
        load_predictor(saved)


@pytest.mark.parametrize("wrong", [torch.zeros(31), torch.zeros(32, dtype=torch.float64)])
def test_misshaped_tensors_are_named(saved, wrong):
    edit_tensors(saved, lambda tensors: tensors.update({"lstm.bias": wrong}))
    with pytest.raises(CheckpointError, match=r"lstm\.bias is .* asks for \(32,\) torch\.float32"):
        load_predictor(saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": "magic"}, "unknown features 'magic'"),
        ({"hidden": -1}, "hidden is -1: give a number from 1"),
    ],
)
def test_odd_settings_are_refused(saved, change, message):
    config = json.loads((saved / "config.json").read_text())["config"]
    edit_config(saved, config=config | change)
    with pytest.raises(CheckpointError, match=message):
        load_predictor(saved)


def test_files_of_version_1_are_read(tmp_path, batch):
    shipped = tmp_path / "new"
    made = OneShotConfig(feature_options={"heights": True}, hidden=8, ensemble=2, components=4).make(20)
    save_checkpoint(shipped, made.eval(), {"epochs": 3})
    shutil.copy(shipped / "model.safetensors", tmp_path)
    content = json.loads((shipped / "config.json").read_text())
    config = content.pop("config")
    features = {"label": config.pop("features"), "options": config.pop("feature_options")}
    names = {"ensemble": "members", "components": "motions", "pivot_edges": "hinges"}
    later = ("context", "hidden_share", "error_weighting", "phase_time")
    settings = {names.get(name, name): value for name, value in config.items() if name not in later}
    training = content["training"] | {"state": "position", "window": 15}
    del content["outcomes"]
    old = content | {"version": 1, "settings": settings, "features": features, "training": training}
    (tmp_path / "config.json").write_text(json.dumps(old))
    expected = read_config(shipped)
    assert [expected["config"].pop(name) for name in later[1:]] == [0.0, 0.0, False]
    assert read_config(tmp_path) == expected
    found, expected = (load_predictor(path).imagine_batch(batch, "estimated") for path in (tmp_path, shipped))
    np.testing.assert_array_equal(found.com, expected.com)
    for damaged in ({"settings": None}, {"features": {"label": "outline"}}):
        edit_config(tmp_path, **damaged)
        with pytest.raises(CheckpointError, match=r"entry (settings is null|features.options is missing)"):
            read_config(tmp_path)
