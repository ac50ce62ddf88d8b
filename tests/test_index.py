"""The columns of a large data set that are kept in a file beside it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from foretrace.errors import DatasetError
from foretrace.interactions import index, parameters, recorded, shards, storage
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.doctor import examine
from foretrace.simulation import collect as collecting
from foretrace.simulation.collect import CollectConfig, collect
from test_collect import fake_trial


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A data set of four shards, which does not fit into memory."""
    monkeypatch.setattr(collecting, "SHARD_SIZE", 4)
    collect(CollectConfig(objects=2), tmp_path / "data", 1, Console(quiet=True), fake_trial)
    monkeypatch.setattr(shards, "CACHE_BYTES", 0)
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


@pytest.fixture
def old(folder, tmp_path) -> Path:
    """The same as it was written when shards had no index in their footers."""
    return aged(Path(shutil.copytree(folder, tmp_path / "old")))


def aged(folder: Path) -> Path:
    """A data set whose shards lose the index in their footers."""
    manifest = storage.read_manifest(folder)
    for name in manifest["shards"]:
        table, _ = storage.read_shard(folder, name)
        pq.write_table(table, folder / name, compression="zstd", use_dictionary=False)
        manifest["shards"][name] = storage.shard_entry((folder / name).read_bytes(), table)
    storage.write_manifest(folder, manifest)
    return folder


def test_the_first_opening_reads_footers(folder, read):
    first = Dataset.open(folder, failed=True)
    assert set(read) == {storage.shard_name(0)}, "read to see how large it is"
    assert first.index.equals(index.index_of(first.table))
    read.clear()
    second = Dataset.open(folder, failed=True)
    assert read == [storage.shard_name(0)]
    assert second.index.equals(first.index)
    np.testing.assert_array_equal(second._places, first._places)
    assert second[13].id == 13
    assert second.where(num_corners=4).ids.tolist() == first.where(num_corners=4).ids.tolist()


@pytest.mark.parametrize("room", [0, 2**30])
def test_an_older_data_set_opens_alike(folder, old, read, room, monkeypatch):
    monkeypatch.setattr(shards, "CACHE_BYTES", room)
    whole = Dataset.open(folder, failed=True)
    read.clear()
    first = Dataset.open(old, failed=True)
    assert len(set(read)) == 4
    assert first.index.equals(whole.index)
    assert first.table.equals(whole.table)
    for name, values in whole.batch().parameters.items():
        np.testing.assert_array_equal(first.batch().parameters[name], values)
    read.clear()
    assert Dataset.open(old, failed=True).index.equals(whole.index)
    assert len(set(read)) == (4 if room else 1)


def test_a_recording_is_found_in_an_older_data_set(folder, tmp_path):
    first, second = Dataset.open(folder)[0], Dataset.open(folder)[5]
    recorded.add_recorded(tmp_path / "recorded", first, {"start": 1.0})
    for recordings in (tmp_path / "recorded", aged(tmp_path / "recorded")):
        assert recorded.find_recorded(recordings, first, {"start": 1.0}) == 0
        assert recorded.find_recorded(recordings, second, {"start": 1.0}) is None


def test_checks_of_what_was_sound_when_it_was_written_are_not_repeated(folder, old, monkeypatch):
    checked = []
    monkeypatch.setattr(shards, "check_shard", lambda table, name, rows: checked.append(Path(name)))
    for each in (folder, old):
        list(Dataset.open(each, failed=True))
    assert set(checked) == {old / storage.shard_name(k) for k in range(4)}


def test_a_changed_shard_that_kept_its_footer_is_refused(folder):
    """As pyarrow writes it again: with the metadata that it read."""
    name = storage.shard_name(1)
    table = pq.ParquetFile(folder / name).read()
    column = table.column_names.index("friction")
    table = table.set_column(column, "friction", pa.array(np.full(len(table), 0.9)))
    pq.write_table(table, folder / name)
    manifest = storage.read_manifest(folder)
    manifest["shards"][name] = storage.shard_entry((folder / name).read_bytes(), table)
    storage.write_manifest(folder, manifest)
    opened = Dataset.open(folder)
    with pytest.raises(
        DatasetError, match=r"shard-00001\.parquet was changed, and has the index of other rows"
    ):
        opened[5]
    assert [finding.file for finding in examine(folder).findings] == [name]
    rewritten = shards.write_shard(folder, name, table)
    storage.write_manifest(folder, {**manifest, "shards": {**manifest["shards"], name: rewritten}})
    assert Dataset.open(folder)[5].physics.friction == 0.9


@pytest.mark.parametrize("place", [0.3, 0.6, 0.9])
def test_a_damaged_footer_is_not_believed(folder, place):
    """A flipped bit in it: the shard is read, and found corrupt."""
    path = folder / storage.shard_name(2)
    content = bytearray(path.read_bytes())
    start = content.index(shards.FOOTER)
    content[int(start + place * (len(content) - start))] ^= 1
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=r"shard-00002\.parquet is corrupt"):
        Dataset.open(folder)


def test_a_shard_with_a_fault_has_no_index(folder):
    name = storage.shard_name(1)
    table, _ = storage.read_shard(folder, name)
    column = table.column_names.index("friction")
    table = table.set_column(column, "friction", pa.array(np.full(len(table), np.nan)))
    manifest = storage.read_manifest(folder)
    manifest["shards"][name] = shards.write_shard(folder, name, table)
    storage.write_manifest(folder, manifest)
    assert shards.FOOTER not in pq.read_metadata(folder / name).metadata
    with pytest.raises(DatasetError, match=r"shard-00001\.parquet, row 0: friction is not a number"):
        Dataset.open(folder)


def test_only_new_shards_are_read(old, read):
    folder = old
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


def test_rows_without_a_checksum_are_read_again(old, read):
    folder = old
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
