"""Data sets at URLs: in an S3 server of this machine, in memory, in folders."""

import logging
import pickle
from contextlib import contextmanager
from pathlib import Path

import boto3
import fsspec
import numpy as np
import pytest
import requests
from moto.server import ThreadedMotoServer
from rich.console import Console

from foretrace import cli, urls
from foretrace.errors import DatasetError, ForetraceError, SimulationError
from foretrace.files import as_path
from foretrace.interactions import derive, shards, storage
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.doctor import examine
from foretrace.simulation import collect as collecting
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.urls import Url, as_place, is_url, names_in
from test_cluster import FakeRay, begin  # noqa: F401
from test_collect import fake_trial
from test_index import read  # noqa: F401

CONFIG = CollectConfig(objects=2)
"""14 trials."""
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def server():
    """Address of an S3 server with a bucket."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer("127.0.0.1", 0)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ACCESS_KEY_ID", "somebody")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        patch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        urls._store.cache_clear()
        boto3.client("s3", region_name="us-east-1").create_bucket(Bucket="bucket")
        yield f"{host}:{port}"
        urls._store.cache_clear()
    server.stop()


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A data set of four shards in a folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collecting, "SHARD_SIZE", 4)
        out = tmp_path_factory.mktemp("folder") / "set"
        collect(CONFIG, out, 1, QUIET, fake_trial)
    return out


@pytest.fixture(scope="module")
def stored(server, folder):
    """The same, in a store: its URL."""
    url = as_place("s3://bucket/stored/set", DatasetError)
    for file in (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"):
        (url / file.relative_to(folder).as_posix()).write_bytes(file.read_bytes())
    return url


@contextmanager
def no_access(server: str):
    """The server looks at credentials."""
    requests.post(f"http://{server}/moto-api/reset-auth", data="0")
    try:
        yield
    finally:
        requests.post(f"http://{server}/moto-api/reset-auth", data="inf")


def contents(place: Path | Url) -> dict[str, bytes]:
    """Every file of a data set."""
    names = [storage.MANIFEST, *(f"shards/{name}" for name in names_in(place / "shards"))]
    assert set(names_in(place)) - {".lock"} == {storage.MANIFEST, "shards"}
    return {name: (place / name).read_bytes() for name in names}


def test_a_simulation_into_a_store_goes_on_and_has_the_bytes_of_one_into_a_folder(
    server, folder, monkeypatch
):
    monkeypatch.setattr(collecting, "SHARD_SIZE", 4)
    out = as_place("s3://bucket/simulated", DatasetError)

    def interrupted(config, id):
        if id == 9:
            raise KeyboardInterrupt
        return fake_trial(config, id)

    with pytest.raises(KeyboardInterrupt):
        collect(CONFIG, "s3://bucket/simulated", 1, QUIET, interrupted)
    assert names_in(out / "shards") == ["shard-00000.parquet", "shard-00001.parquet"]
    done = []

    def noted(config, id):
        done.append(id)
        return fake_trial(config, id)

    counts = collect(CONFIG, out, 1, QUIET, noted)
    assert counts == {"levered": 14}
    assert done == [*range(8, 14)]
    assert contents(out) == contents(folder)


def test_nodes_of_a_cluster_write_into_the_store(server, folder, monkeypatch, begin):  # noqa: F811
    monkeypatch.setattr(collecting, "SHARD_SIZE", 4)
    out = as_place("s3://bucket/from/cluster", DatasetError)
    with begin(FakeRay({("shards/shard-00001.parquet", range(4, 8)): 2})):
        collect(CONFIG, out, 2, QUIET, fake_trial)
    assert contents(out) == contents(folder)


@pytest.mark.parametrize("large", [False, True])
def test_a_set_in_a_store_reads_as_one_in_a_folder(stored, folder, large, monkeypatch, read):  # noqa: F811
    here = Dataset.open(folder)
    monkeypatch.setattr(shards, "CACHE_BYTES", 0 if large else 2**30)
    there = Dataset.open(Path("s3://bucket/stored/set"))  # which has lost a slash
    assert there.path == stored
    assert there.index.equals(here.index)
    assert there.table.equals(here.table)
    np.testing.assert_array_equal(there[7].effect.pose_trajectory, here[7].effect.pose_trajectory)
    read.clear()
    assert len(Dataset.open(str(stored))) == 14
    assert len(set(read)) == (1 if large else 4)  # the index is kept on this machine
    assert set(names_in(stored)) == {storage.MANIFEST, "shards"}
    assert examine(stored).findings == ()


def test_sets_in_stores_are_merged_and_sampled_into_folders(stored, folder, tmp_path):
    derive.sample(stored, tmp_path / "one", 5)
    derive.sample(folder, tmp_path / "two", 5)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    rows, skipped = derive.merge([stored, folder], tmp_path / "merged", skip_duplicates=True)
    assert (rows, skipped) == (14, 14)


def test_commands_read_urls(stored, tmp_path, capsys):
    assert cli.main(["data", str(stored)]) == 0
    assert "s3://bucket/stored/set: 14 interactions, no problems left" in capsys.readouterr().out
    assert cli.main(["show", str(stored), "--id", "3", "--out", str(tmp_path / "3.png")]) == 0
    assert (tmp_path / "3.png").stat().st_size > 10_000
    words = ["train", "--data", str(stored), "--out", str(tmp_path / "run"), "--epochs", "1", "--hidden", "4"]
    assert cli.main([*words, "--split", "10", "2", "2", "--card"]) == 0
    card = (tmp_path / "run" / "MODEL_CARD.md").read_text()
    assert "--data s3://bucket/stored/set" in card


def test_a_damaged_object_is_named_with_a_remedy_that_works(stored, folder):
    url = as_place("s3://bucket/damaged", DatasetError)
    for name, content in contents(folder).items():
        (url / name).write_bytes(content[:-1] if name.endswith("2.parquet") else content)
    with pytest.raises(
        DatasetError, match=r"shard s3://bucket/damaged/shards/shard-00002.parquet is corrupt"
    ) as told:
        Dataset.open(url)
    assert "--repair" not in str(told.value)
    (url / storage.MANIFEST).write_bytes(b"{")
    with pytest.raises(DatasetError, match=r"s3://bucket/damaged/manifest.json cannot be read as JSON"):
        Dataset.open(url)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["data", "s3://bucket/nothing"], "no data set at s3://bucket/nothing: no such folder or bucket"),
        (["data", "s3://nowhere/set"], "no data set at s3://nowhere/set: no such folder or bucket"),
        (["data", "s3://bucket/stored"], "s3://bucket/stored is not a data set: it has no manifest.json"),
        (["data", "s3://bucket/stored/set", "--repair"], "s3://bucket/stored/set cannot be repaired"),
        (
            ["data", "s3://bucket/stored/set", "--upgrade"],
            "only data sets are read from and simulated to URLs",
        ),
        (["data", "s4://bucket/set"], "s4:// is no URL of an object store: choose from s3, gs"),
        (["data", "s3://me:secret@bucket/set"], "a URL s3://... with a password"),
        (["show", "s3://bucket/stored/set"], "name a file with --out"),
        (
            ["simulate", "--out", "s3://nowhere/set"],
            "s3://nowhere/set/manifest.json cannot be used: there is no such bucket: make it first",
        ),
        (["simulate", "--out", "s3://bucket/stored"], "holds set and is no data set"),
        (["train", "--data", "data", "--out", "s3://bucket/run"], "s3://bucket/run is a URL: name a folder"),
        (["data", "sample", "s3://bucket/stored/set", "--number", "1", "--out", "s3://bucket/x"], "is a URL"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(stored, words, message, capsys):
    assert cli.main(words) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
    assert "secret" not in told


def test_missing_credentials_are_told_in_one_line(server, stored, capsys):
    with no_access(server):
        assert cli.main(["data", str(stored)]) == 2
        told = capsys.readouterr().err
        with pytest.raises(
            SimulationError, match=r"^node .*: s3://bucket/stored/set/manifest.json cannot be used"
        ):
            collecting._simulate_shard(fake_trial, CONFIG, stored, ("shards/shard-00000.parquet", range(4)))
    assert " cannot be used: access is denied: give credentials that have it" in told
    assert told.count("\n") == 1


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (
            "When getting information for key 'set' in bucket 'bucket': AWS Error NETWORK_CONNECTION during HeadObject "
            "operation: curlCode: 7, Could not connect to server",
            "the server does not answer: check the network, and for S3 AWS_ENDPOINT_URL",
        ),
        ("google::cloud::Status(UNAVAILABLE: Retry policy exhausted)", "the server does not answer"),
        ("[Errno 111] Connection refused", "the server does not answer"),
        ("google::cloud::Status(UNAVAILABLE: Could not create a OAuth2 access token", "access is denied"),
        ("Something\nelse " + 300 * "x", "Something else xxx"),
    ],
)
def test_errors_of_libraries_in_words(said, told):
    assert urls._in_words(OSError(said)).startswith(told)
    assert len(urls._in_words(OSError(said))) <= 200


def test_sets_in_memory_and_file_urls(folder, monkeypatch):
    monkeypatch.setattr(collecting, "SHARD_SIZE", 4)
    collect(CONFIG, "memory://some/set", 1, QUIET, fake_trial)
    try:
        assert contents(as_place("memory://some/set", DatasetError)) == contents(folder)
        assert len(Dataset.open("memory://some/set")) == 14
    finally:
        fsspec.filesystem("memory").rm("/some", recursive=True)
    assert Dataset.open(f"file://{folder}").path == folder


def test_urls_and_paths_are_told_apart(tmp_path):
    url = as_place("gs://bucket//a/b/?endpoint_override=localhost:9&scheme=http", DatasetError)
    assert str(url / "c") == "gs://bucket/a/b/c?endpoint_override=localhost:9&scheme=http"
    assert pickle.loads(pickle.dumps(url)) == url
    assert url.resolve().name == "b"
    for path in ("C:/data", "data", "a/s3://b", "/s3:/b", Path("x:/data"), tmp_path):
        assert not is_url(path)
        assert as_place(path, DatasetError) == Path(path)
    with pytest.raises(ForetraceError, match="s3://b/run is a URL"):
        as_path("s3://b/run", ForetraceError)
    with pytest.raises(TypeError, match="3 is no path"):
        as_place(3, DatasetError)
