"""Files whose content is not what foretrace writes: one line that names the entry, and nothing that goes on."""

import json
import pickle
import shutil
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from safetensors.numpy import load_file, save_file

import foretrace as ft
from factories import fake_data_set
from foretrace.errors import SHOWN, CheckpointError, DatasetError, ShapeError, check_type, shown, wrong_type
from foretrace.files import read_json
from foretrace.interactions import shards, storage
from foretrace.interactions.doctor import examine
from foretrace.interactions.soundness import find_faults
from foretrace.predictor.loading import default_checkpoint
from foretrace.schema import conform, parse_json

TEXTS = {
    '{"a": [1, {"b": NaN}]}': "entry a[1].b is nan, a finite number",
    '{"a": -Infinity}': "entry a is -inf",
    '{"a": 1e400}': "entry a is inf",
    f'{{"a": {"1" * 5000}}}': "entry a is inf",
    "[" * 100_000: "nested too deep",
    '{"a": ' * 100_000: "nested too deep",
    '{"a": 1, "a": 2}': "the entry 'a' twice",
    '{"a": "\\ud800"}': "half a character",
    '{"a": 1,\n"b" 2}': "line 2 column 5",
    "": "line 1 column 1",
    "\x00\x01": "line 1 column 1",
}


@pytest.mark.parametrize("text", TEXTS, ids=range(len(TEXTS)))
def test_what_json_does_not_have_is_refused_in_one_line(text: str, tmp_path):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(DatasetError) as caught:
        read_json(tmp_path / "a.json", dict, DatasetError, "mend it")
    assert TEXTS[text] in str(caught.value)
    assert str(caught.value).endswith("mend it")
    assert "\n" not in str(caught.value)


MANIFESTS: dict[str, Any] = {
    "entry num_trials is '3', a whole number is expected": {"num_trials": "3"},
    "entry num_trials is true": {"num_trials": True},
    "entry num_trials is 3.0": {"num_trials": 3.0},
    "more than 1000000 shards": {"num_trials": 10**12, "shard_size": 1},
    "entry shards is null, an object is expected": {"shards": None},
    "entry shards.../x is '../x', a text matching": {"shards": {"../x": {}}},
    "shard-00000.parquet.rows is -1": {"shards": {"shards/shard-00000.parquet": {"rows": -1}}},
    "entry configuration is []": {"configuration": []},
    "entry configuration.randomisation.friction is [1], a list of at least 2": {
        "configuration": {"randomisation": {"friction": [1]}}
    },
    "entry configuration.path.sweep is 'x'": {"configuration": {"path": {"sweep": "x"}}},
    "entry versions is missing": {"versions": ...},
    "has format version True, this foretrace reads": {"format_version": True},
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return fake_data_set(tmp_path_factory.mktemp("sound") / "data", objects=1)


@pytest.mark.parametrize("message", MANIFESTS)
def test_a_wrong_manifest_is_named_by_open_and_by_the_doctor(message: str, data, tmp_path):
    folder = shutil.copytree(data, tmp_path / "data")
    content = json.loads((folder / "manifest.json").read_text()) | MANIFESTS[message]
    kept = {name: value for name, value in content.items() if value is not ...}
    (folder / "manifest.json").write_text(json.dumps(kept))
    with pytest.raises(DatasetError) as caught:
        ft.Dataset.open(folder)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    found = examine(folder)
    assert message in found.findings[0].problem
    assert found.num_interactions > 0


def changed(name: str, change: Any) -> Any:
    """A row's value replaced."""
    return lambda row: row | {name: change(row[name])}


def spoiled(name: str, number: float) -> Any:
    return changed(name, lambda values: [number, *values[1:]])


FAULTS: dict[str, Any] = {
    "com_trajectory holds NaN or infinity": spoiled("com_trajectory", np.inf),
    "tool_trajectory holds NaN or infinity": spoiled("tool_trajectory", np.nan),
    "times holds a null": spoiled("times", None),
    "times holds NaN": spoiled("times", np.nan),
    "its times do not rise": spoiled("times", 9.0),
    "com_trajectory has": changed("com_trajectory", lambda values: values[1:]),
    "joint_trajectory has": changed("num_joints", lambda number: number + 1),
    "num_joints is negative": changed("num_joints", lambda _: -1),
    "a quaternion of pose_trajectory": changed("pose_trajectory", lambda values: [0.5 * v for v in values]),
    "contact has another number of values than 2": changed("contact", lambda _: [0.0]),
    "support_points has another number": changed("support_points", lambda _: []),
    "support_points holds NaN or infinity": changed("support_points", lambda _: [np.inf] * 4),
    "direction has not the length 1": changed("direction", lambda _: [1.0, 1.0]),
    "direction has another number": changed("direction", lambda _: []),
    "friction is not a number": changed("friction", lambda _: np.nan),
    "density is missing": changed("density", lambda _: None),
    "table_edge is not a number": changed("table_edge", lambda _: np.inf),
    "mask has another size": changed("mask", lambda _: b"x"),
    "height has another size": changed("height", lambda _: b""),
    "slip_index is no sample": changed("slip_index", lambda _: 10**9),
    "fall_index is no sample": changed("fall_index", lambda _: -1),
    "unknown action 'kick'": changed("action", lambda _: "kick"),
    "line 1 column 2": changed("path", lambda _: "{"),
    "is nan, a finite number": changed("tool", lambda text: text.replace("0.17", "NaN")),
    "versions: it is [], an object is expected": changed("versions", lambda _: "[]"),
    "the unknown outcome 'gone'": changed("outcome", lambda _: "gone"),
    "it has no samples": lambda row: row | {n: [] for n in (*storage.TRAJECTORIES, "joint_trajectory")},
}


def with_row(data, folder, change):
    """A copy of a data set in which one row is another; the checksum is right."""
    folder = shutil.copytree(data, folder)
    name = storage.shard_name(0)
    rows = storage.read_shard(folder, name)[0].to_pylist()
    rows[1] = change(rows[1])
    manifest = storage.read_manifest(folder)
    manifest["shards"][name] = shards.write_shard(folder, name, storage.to_table(rows))
    storage.write_manifest(folder, manifest)
    return folder


@pytest.mark.parametrize("message", FAULTS)
def test_a_wrong_row_is_named_by_open_and_by_the_doctor(message: str, data, tmp_path):
    folder = with_row(data, tmp_path / "data", FAULTS[message])
    with pytest.raises(DatasetError) as caught:
        ft.Dataset.open(folder)
    assert "shard-00000.parquet, row 1: " in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert any(message in finding.problem for finding in examine(folder).findings)


def test_rows_and_numbers_agree_with_the_manifest(data, tmp_path):
    folder = shutil.copytree(data, tmp_path / "data")
    manifest = storage.read_manifest(folder)
    manifest["shards"][storage.shard_name(0)]["rows"] += 1
    storage.write_manifest(folder, manifest)
    with pytest.raises(DatasetError, match="rows, the manifest says"):
        ft.Dataset.open(folder)
    assert "rows, the manifest says" in examine(folder).findings[0].problem
    twice = with_row(data, tmp_path / "twice", changed("id", lambda _: 0))
    with pytest.raises(DatasetError, match="has interaction 0 more than once"):
        ft.Dataset.open(twice)


def test_an_unusable_object_is_named(data, tmp_path):
    folder = with_row(data, tmp_path / "data", changed("object", lambda _: '{"kind": "prism"}'))
    with pytest.raises(DatasetError, match="describes an object that cannot be read"):
        ft.Dataset.open(folder).batch()
    assert any("its object cannot be read" in finding.problem for finding in examine(folder).findings)


def test_sound_rows_have_no_fault(data):
    table = storage.read_shard(data, storage.shard_name(0))[0]
    assert list(find_faults(table)) == []
    assert list(find_faults(table.slice(0, 0))) == []
    assert list(find_faults(pa.concat_tables([table, table]))) == []


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_weights_that_are_no_numbers_are_refused(value: float, tmp_path):
    shutil.copytree(default_checkpoint(), tmp_path, dirs_exist_ok=True)
    weights = load_file(tmp_path / "model.safetensors")
    name = next(name for name, values in weights.items() if values.dtype == np.float32 and values.ndim > 1)
    weights[name] = weights[name].copy()
    weights[name].flat[0] = value
    save_file(weights, tmp_path / "model.safetensors")
    with pytest.raises(CheckpointError, match=f"{name} holds NaN or infinity: copy it again or train anew"):
        ft.load_predictor(tmp_path)


@pytest.mark.parametrize(
    "value", ["x" * 1000, [0.5] * 1000, {k: k for k in range(99)}, 10**5000, b"x" * 999], ids=range(5)
)
def test_values_in_messages_are_short(value: Any):
    assert len(shown(value)) <= SHOWN
    with pytest.raises(ShapeError) as caught:
        conform({"a": [value]}, dict[str, list[bool]], "it", ShapeError, "")
    assert len(str(caught.value)) < SHOWN + 60


def test_arrays_in_messages_are_shape_and_type():
    assert shown(np.zeros((100, 3))) == "an array of shape (100, 3) and type float64"
    assert shown(np.array([0.5, 1])) == "array([0.5, 1. ])"
    assert shown(np.eye(2)) == "array([[1., 0.], [0., 1.]])"


def test_a_wrong_type_is_a_type_error_of_its_kind_in_other_processes_too():
    with pytest.raises(ShapeError, match="obj of type str: give int") as caught:
        check_type("obj", "x", int, ShapeError)
    assert isinstance(caught.value, TypeError)
    again = pickle.loads(pickle.dumps(caught.value))
    assert type(again) is wrong_type(ShapeError)
    assert str(again) == str(caught.value)


def test_numbers_are_kept_as_they_are():
    assert parse_json('{"a": [1, 2.5, -1e-300, true, null, "\\ud83d\\ude00"]}') == {
        "a": [1, 2.5, -1e-300, True, None, "\U0001f600"]
    }
