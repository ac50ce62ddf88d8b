"""Data sets made of others: merged, split, sampled."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from rich.console import Console

from foretrace import cli
from foretrace.errors import DatasetError
from foretrace.files import PARTIAL
from foretrace.interactions import derive, shards, storage
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.doctor import examine
from foretrace.simulation import collect as collecting
from foretrace.simulation.collect import CollectConfig, collect
from test_collect import fake_trial


@pytest.fixture(scope="module")
def sources(tmp_path_factory) -> Path:
    """Data sets of 6, 14 and 14 lever-ups; the first is the beginning of the second."""
    folder = tmp_path_factory.mktemp("sources")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collecting, "SHARD_SIZE", 4)
        for name, objects, seed in (("few", 1, 0), ("more", 2, 0), ("other", 2, 1)):
            config = CollectConfig(objects=objects, contacts_per_edge=2, seed=seed)
            collect(config, folder / name, 1, Console(quiet=True), fake_trial)
    return folder


def objects_of(dataset: Dataset) -> dict[str, int]:
    return dict(zip(dataset.table["object"].to_pylist(), dataset.index["object_id"].to_pylist(), strict=True))


def same(one: Dataset, two: Dataset) -> bool:
    """Whether they hold the same interactions, whatever their numbers."""
    return one.table.drop(["id", "object_id"]).equals(two.table.drop(["id", "object_id"]))


def test_merged_data_sets_are_sound(sources, tmp_path):
    parts = [Dataset.open(sources / name, failed=True) for name in ("more", "other")]
    rows = len(parts[0]) + len(parts[1])
    assert derive.merge([sources / "more", sources / "other"], tmp_path / "all") == (rows, 0)
    merged = Dataset.open(tmp_path / "all", failed=True)
    assert examine(tmp_path / "all").findings == ()
    assert merged.ids.tolist() == list(range(rows))
    assert same(merged[: len(parts[0])], parts[0])
    assert same(merged[len(parts[0]) :], parts[1])
    assert len(set(objects_of(merged).values())) == 4
    configuration = merged.manifest["configuration"]
    assert (configuration["recipe"], configuration["objects"]) == ("paper", 2)
    assert "seed" not in configuration
    assert [source["configuration"]["seed"] for source in configuration["sources"]] == [0, 1]


def test_what_is_there_twice_is_refused_or_left_out(sources, tmp_path):
    both = [sources / "few", sources / "more"]
    with pytest.raises(
        DatasetError, match=r"interaction 0 of .*more is interaction 0 of .*few: the same object"
    ):
        derive.merge(both, tmp_path / "all")
    assert not list(tmp_path.iterdir())
    more = Dataset.open(sources / "more", failed=True)
    few = len(Dataset.open(sources / "few", failed=True))
    assert derive.merge(both, tmp_path / "all", skip_duplicates=True) == (len(more), few)
    merged = Dataset.open(tmp_path / "all", failed=True)
    assert same(merged, more)
    assert objects_of(merged) == objects_of(more)
    assert derive.merge([tmp_path / "all", *both], tmp_path / "again", skip_duplicates=True)[0] == len(more)


def test_parts_of_a_split_share_no_object(sources, tmp_path):
    derive.merge([sources / "more", sources / "other"], tmp_path / "all")
    counts = derive.split(tmp_path / "all", tmp_path / "parts", (0.5, 0.25, 0.25))
    parts = {name: Dataset.open(tmp_path / "parts" / name, failed=True) for name in counts}
    assert list(counts) == ["train", "validation", "test"]
    assert counts == {name: len(part) for name, part in parts.items()}
    objects = [set(objects_of(part)) for part in parts.values()]
    assert [len(each) for each in objects] == [2, 1, 1]
    assert set.union(*objects) == set(objects_of(Dataset.open(tmp_path / "all", failed=True)))
    assert all(examine(part.path).findings == () for part in parts.values())
    back = derive.merge([part.path for part in parts.values()], tmp_path / "back")
    assert back == (sum(counts.values()), 0)
    assert len(set(objects_of(Dataset.open(tmp_path / "back", failed=True)).values())) == 4


def test_interactions_are_split_and_sampled_at_random(sources, tmp_path):
    whole = Dataset.open(sources / "more", failed=True)
    counts = derive.split(sources / "more", tmp_path / "a", (0.5, 0.5), ("x", "y"), by="interaction", seed=3)
    assert counts == {"x": len(whole) // 2, "y": len(whole) - len(whole) // 2}
    assert derive.sample(sources / "more", tmp_path / "five", 5, seed=1) == 5
    chosen = np.sort(np.random.default_rng(1).choice(len(whole), 5, replace=False))
    assert same(Dataset.open(tmp_path / "five", failed=True), whole[chosen])
    assert derive.sample(sources / "more", tmp_path / "again", 5, seed=1) == 5
    for file in (tmp_path / "five").rglob("*.*"):
        assert file.read_bytes() == (tmp_path / "again" / file.relative_to(tmp_path / "five")).read_bytes()


def test_an_interrupt_leaves_nothing(sources, tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(storage, "write_manifest", interrupt)
    with pytest.raises(KeyboardInterrupt):
        derive.sample(sources / "more", tmp_path / "some", 5)
    assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    (tmp_path / f".some.abcdef-1-0{PARTIAL}").mkdir()  # of another machine, which may live
    derive.sample(sources / "more", tmp_path / "some", 5)
    assert len(Dataset.open(tmp_path / "some", failed=True)) == 5


def test_shards_of_another_version_are_refused(sources, tmp_path):
    import pyarrow.parquet as pq

    odd = tmp_path / "odd"
    derive.sample(sources / "more", odd, 5)
    shard = odd / storage.shard_name(1)
    pq.write_table(pq.read_table(shard).drop(["tool"]), shard)
    manifest = json.loads((odd / storage.MANIFEST).read_text())
    manifest["shards"][storage.shard_name(1)].pop("sha256")
    (odd / storage.MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match=r"shard-00001\.parquet has another schema \(differs in tool\)"):
        derive.merge([odd, sources / "other"], tmp_path / "all")
    assert not (tmp_path / "all").exists()


def test_ids_that_repeat_are_refused(sources, tmp_path):
    derive.sample(sources / "more", tmp_path / "odd", 5)
    name = storage.shard_name(0)
    table, _ = storage.read_shard(tmp_path / "odd", name)
    table = table.set_column(0, "id", pa.array([0] * table.num_rows, pa.int64()))
    manifest = storage.read_manifest(tmp_path / "odd")
    manifest["shards"][name] = shards.write_shard(tmp_path / "odd", name, table)
    storage.write_manifest(tmp_path / "odd", manifest)
    for make in (
        lambda out: derive.merge([tmp_path / "odd", sources / "other"], out),
        lambda out: derive.sample(tmp_path / "odd", out, 2),
        lambda out: derive.split(tmp_path / "odd", out, (0.5, 0.5)),
    ):
        with pytest.raises(DatasetError, match="does not have each id from 0 to 3 once"):
            make(tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_what_was_made_is_made_again(sources, tmp_path):
    few, other = tmp_path / "few", sources / "other"
    derive.sample(sources / "few", few, 6)
    (few / storage.shard_name(1)).unlink()
    with pytest.raises(DatasetError, match=r"cannot be read .*; sample again into a new folder, or restore"):
        derive.merge([few, other], tmp_path / "new")
    (found,) = examine(few).findings
    assert found.problem.endswith("sample again into a new folder, or restore a copy")
    repaired = examine(few, repair=True).findings
    assert "removed from the manifest: sample again" in repaired[0].problem
    with pytest.raises(DatasetError, match="few lacks 1 of 2 shards: sample again"):
        derive.merge([few, other], tmp_path / "new")
    (few / storage.shard_name(0)).write_bytes(b"")
    examine(few, repair=True)
    with pytest.raises(DatasetError, match="few is empty: sample again"):
        derive.sample(few, tmp_path / "new", 2)
    with pytest.raises(DatasetError, match="holds a data set that `foretrace data sample` made"):
        collect(CollectConfig(objects=1), few, 1, Console(quiet=True), fake_trial)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("merge {s}/more --out {t}/new", "1 data set to merge: give two or more"),
        ("merge {s}/more {s}/none --out {t}/new", "no data set at {s}/none"),
        ("merge {s}/more {s}/other --out {s}/few", "{s}/few exists: choose a new folder"),
        ("split {s}/more --out {t}/new --shares 0.5 0.6", "shares [0.5, 0.6]: give two or more positive"),
        (
            "split {s}/more --out {t}/new --shares 0.5 0.5 --names a a",
            "names ['a', 'a']: give 2 different names of folders",
        ),
        (
            "split {s}/more --out {t}/new --shares 0.5 0.5 --names a ../b",
            "give 2 different names of folders, without a path",
        ),
        ("merge --out {t}/new", "no data sets to merge: give two or more"),
        (
            "split {s}/few --out {t}/new",
            "few has 1 object for 3 parts: divide them with --by interaction, or give fewer shares",
        ),
        ("mrege {s}/more {s}/other --out {t}/new", "unknown command 'data mrege': did you mean data merge?"),
        ("split {s}/more --out {t}/new --shares 0.1 0.9", "part train of 2 objects would be empty"),
        (
            "sample {s}/more --out {t}/new --number 1000",
            "1000 interactions of {s}/more: give a number from 1",
        ),
        ("sample {s}/more --out {t}/new --number 2 --seed -1", "seed is -1: give a whole number"),
    ],
)
def test_mistakes_are_told_in_one_line(words, message, sources, tmp_path, capsys):
    places = {"s": sources, "t": tmp_path}
    assert cli.main(["data", *words.format(**places).split()]) == 2
    told = capsys.readouterr().err
    assert message.format(**places) in told
    assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_commands_say_what_they_have_made(sources, tmp_path, capsys):
    assert cli.main(["data", "merge", f"{sources}/more", f"{sources}/other", "--out", f"{tmp_path}/all"]) == 0
    assert cli.main(["data-sample", f"{tmp_path}/all", "--out", f"{tmp_path}/some", "--number", "9"]) == 0
    assert cli.main(["data", f"{tmp_path}/some"]) == 0
    assert f"data set: {tmp_path}/some, 9 interactions" in capsys.readouterr().out
