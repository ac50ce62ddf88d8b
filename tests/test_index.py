"""The columns of a large data set that are kept in a file beside it."""

import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from foretrace.errors import DatasetError
from foretrace.interactions import dataset as datasets
from foretrace.interactions import index, parameters, storage
from foretrace.interactions.dataset import Dataset
from foretrace.simulation import collect as collecting
from foretrace.simulation.collect import CollectConfig, collect
from test_collect import fake_trial


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A data set of four shards, which does not fit into memory."""
    monkeypatch.setattr(collecting, "SHARD_SIZE", 4)
    collect(CollectConfig(objects=2), tmp_path / "data", 1, Console(quiet=True), fake_trial)
    monkeypatch.setattr(datasets, "CACHE_BYTES", 0)
    return tmp_path / "data"


@pytest.fixture
def read(monkeypatch) -> list[str]:
    """Names of shards that are read."""
    names, own = [], storage.read_shard

    def read_shard(folder, name, *arguments, **options):
        names.append(name)
        return own(folder, name, *arguments, **options)

    monkeypatch.setattr(storage, "read_shard", read_shard)
    return names


def test_a_second_opening_reads_one_shard_and_finds_the_same(folder, read):
    first = Dataset.open(folder, failed=True)
    assert len(set(read)) == 4
    read.clear()
    second = Dataset.open(folder, failed=True)
    assert read == [storage.shard_name(0)]
    assert second.index.equals(first.index)
    np.testing.assert_array_equal(second._places, first._places)
    assert second[13].id == 13
    assert second.where(num_corners=4).ids.tolist() == first.where(num_corners=4).ids.tolist()


def test_only_new_shards_are_read(folder, read):
    whole = Dataset.open(folder, failed=True)
    manifest = storage.read_manifest(folder)
    last = manifest["shards"].pop(storage.shard_name(3))
    storage.write_manifest(folder, manifest)
    with pytest.warns(UserWarning, match="1 of 4 shards are missing"):
        assert len(Dataset.open(folder, failed=True)) == 12
    manifest["shards"][storage.shard_name(3)] = last
    storage.write_manifest(folder, manifest)
    read.clear()
    assert Dataset.open(folder, failed=True).index.equals(whole.index)
    assert read == [storage.shard_name(0), storage.shard_name(3)]


@pytest.mark.parametrize("content", [b"", b"ARROW1 of something else", None])
def test_a_file_that_does_not_fit_is_made_again(folder, content):
    whole = Dataset.open(folder, failed=True)
    file = folder / index.INDEX
    before = file.read_bytes()
    file.unlink()  # it is mapped
    file.write_bytes(before[:-100] if content is None else content)
    assert Dataset.open(folder, failed=True).index.equals(whole.index)
    assert file.read_bytes() == before


def test_a_folder_without_room_is_read_each_time(folder, monkeypatch):
    whole = Dataset.open(folder, failed=True)
    (folder / index.INDEX).unlink()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(index, "_write", full)
    assert Dataset.open(folder, failed=True).index.equals(whole.index)
    assert not (folder / index.INDEX).exists()


def test_missing_and_changed_shards_are_noticed(folder):
    Dataset.open(folder)
    shard = folder / storage.shard_name(2)
    content = shard.read_bytes()
    shard.write_bytes(content[:-1] + b"?")
    opened = Dataset.open(folder, failed=True)
    with pytest.raises(DatasetError, match=r"shard-00002\.parquet is corrupt"):
        opened[8]
    shard.unlink()
    with pytest.raises(DatasetError, match=r"shard-00002\.parquet is missing"):
        Dataset.open(folder)


def test_rows_without_a_checksum_are_read_again(folder, read):
    manifest = json.loads((folder / storage.MANIFEST).read_text())
    manifest["shards"][storage.shard_name(1)].pop("sha256")
    (folder / storage.MANIFEST).write_text(json.dumps(manifest))
    Dataset.open(folder)
    read.clear()
    manifest["shards"][storage.shard_name(1)]["rows"] = 4
    Dataset.open(folder)
    assert set(read) == {storage.shard_name(0)}


def test_parameters_are_kept_and_not_decoded_again(folder, monkeypatch):
    small = storage.read_shard(folder, storage.shard_name(1))[0]
    first = Dataset.open(folder, failed=True)

    def refuse(*texts):
        raise AssertionError(f"{texts} decoded again")

    monkeypatch.setattr(parameters, "action_of", refuse)
    second = Dataset.open(folder, failed=True)
    assert second.parameters.keys() == {"insertion", "arc_radius", "sweep", "speed"}
    for name, values in second.parameters.items():
        np.testing.assert_array_equal(values, first.parameters[name])
    assert len(second[4:8].where(insertion=0.022)) == len(small)
    assert second[5].id == 5
    monkeypatch.undo()
    assert parameters.parameter_values(small)["sweep"].tolist() == second[4:8].parameters["sweep"].tolist()
