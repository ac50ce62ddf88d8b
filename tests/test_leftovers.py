"""What killed processes leave: it is removed or gone on with, and never in the way."""

import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factories import fake_batch, fake_data_set
from foretrace import files
from foretrace.errors import DatasetError, ForetraceError, TrainingError
from foretrace.files import OLD, atomic_folder, atomic_path, first_stranger, partial_files, sole_writer
from foretrace.interactions import recorded, storage
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.doctor import examine
from foretrace.predictor import LstmConfig, TrainConfig, train_predictor
from foretrace.simulation.collect import CollectConfig, collect

SMALL = TrainConfig(epochs=1, min_steps=1, split=None, device="cpu")
CONFIG = LstmConfig(features="none", hidden=8, window=6)
HERE = files._here()


def dead_process() -> int:
    """Number of a process that is over."""
    done = subprocess.Popen(["true"])
    done.wait()
    return done.pid


@pytest.fixture(scope="module")
def batch():
    return fake_batch(np.random.default_rng(7), 12, num_samples=12)


@pytest.fixture(autouse=True)
def _first_write():
    """Every test is a process that has not written anywhere."""
    files._sweep_once.cache_clear()


@pytest.mark.parametrize(
    ("name", "old", "left"),
    [
        (f".a.json.{HERE}-{{dead}}-0.partial", False, True),
        (f".a.json.{HERE}-{{dead}}-0.partial", True, True),
        (f".a.json.{HERE}-{{alive}}-3.partial", False, False),
        (f".a.json.{HERE}-{{alive}}-3.partial", True, True),
        (f".a.json.{HERE}-{{own}}-99999.partial", False, True),
        (".a.json.abcdef-{dead}-0.partial", False, False),
        (".a.json.abcdef-{dead}-0.partial", True, True),
        (".a.json.{alive}.partial", False, True),
    ],
)
def test_only_drafts_of_the_living_stay(tmp_path, name, old, left):
    name = name.format(dead=dead_process(), alive=os.getppid(), own=os.getpid())
    draft = tmp_path / name
    draft.write_text("half")
    if old:
        os.utime(draft, (past := time.time() - 2 * OLD, past))
    assert partial_files(tmp_path) == [draft] * left
    with atomic_path(tmp_path / "b.json") as partial:
        partial.write_text("whole")
    assert draft.exists() == (not left or files.DRAFT.fullmatch(name) is None)
    assert (tmp_path / "b.json").read_text() == "whole"


def test_folders_of_the_dead_are_removed_and_other_files_are_not(tmp_path):
    draft = tmp_path / f".film.{HERE}-{dead_process()}-0.partial"
    draft.mkdir()
    (draft / "image.jpg").write_text("half")
    (tmp_path / "my.partial").write_text("mine")
    with atomic_folder(tmp_path / "film") as folder:
        (folder / "image.jpg").write_text("whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film", "my.partial"]


def test_threads_write_one_file_at_once(tmp_path):
    path, failures = tmp_path / f"{'long' * 60}.json", []

    def write(text: str) -> None:
        try:
            for _ in range(20):
                files.write_text(path, text * 1000)
        except OSError as error:
            failures.append(error)

    threads = [threading.Thread(target=write, args=(letter,)) for letter in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert len(set(path.read_text())) == 1
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_folder_that_filled_meanwhile_is_not_replaced(tmp_path):
    def write() -> None:
        with atomic_folder(tmp_path / "film") as folder:
            (folder / "new").write_text("")
            (tmp_path / "film").mkdir()
            (tmp_path / "film" / "other").write_text("")

    with pytest.raises(OSError, match="not empty"):
        write()
    assert [path.name for path in tmp_path.rglob("*")] == ["film", "other"]


def test_strangers_are_told_from_beginnings(tmp_path):
    assert first_stranger(tmp_path / "none") is None
    for name in (".lock", f".config.json.{HERE}-1-0.partial", "shards"):
        (tmp_path / name).write_text("")
    assert first_stranger(tmp_path) == "shards"
    assert first_stranger(tmp_path, ("shards",)) is None
    (tmp_path / "my.partial").write_text("")
    assert first_stranger(tmp_path, ("shards",)) == "my.partial"


def begun(folder: Path, name: str) -> Path:
    """A folder as a process leaves it that was killed in its first write."""
    folder.mkdir()
    (folder / ".lock").write_text("")
    (folder / f".{name}.{HERE}-{dead_process()}-0.partial").write_text("{")
    return folder


def test_a_training_goes_on_that_was_killed_in_its_first_write(tmp_path, batch):
    run = begun(tmp_path / "run", "config.json")
    train_predictor(batch, CONFIG, run, SMALL, progress=False)
    assert partial_files(run) == []
    assert (run / "model.safetensors").is_file()


def test_a_model_that_is_gone_is_trained_anew(tmp_path, batch, monkeypatch):
    longer = replace(SMALL, epochs=2)
    with monkeypatch.context() as patch:
        patch.setattr("foretrace.predictor.run_folder.RunFolder.finish", lambda *_: sys.exit(1))
        with pytest.raises(SystemExit):
            train_predictor(batch, CONFIG, tmp_path, longer, progress=False)
    (tmp_path / "model.safetensors").unlink()
    train_predictor(batch, CONFIG, tmp_path, longer, progress=False)
    assert (tmp_path / "model.safetensors").is_file()


def test_a_second_training_in_a_folder_is_refused(tmp_path, batch):
    def train() -> None:
        train_predictor(batch, CONFIG, tmp_path, SMALL, progress=False)

    with (
        sole_writer(tmp_path),
        pytest.raises(TrainingError, match=r"another foretrace writes to \S+; wait until"),
    ):
        train()
    train()
    with sole_writer(tmp_path):
        train()  # it is finished: nothing is written


def test_a_simulation_goes_on_that_was_killed_in_its_first_write(tmp_path):
    folder = begun(tmp_path / "data", "manifest.json")
    (folder / storage.SHARD_FOLDER).mkdir()
    config = CollectConfig(objects=1, contacts_per_edge=1)
    with pytest.raises(ForetraceError, match="stop here"):
        collect(config, folder, workers=1, simulate=stopped)
    assert partial_files(folder) == []


def stopped(config: CollectConfig, id: int):
    raise ForetraceError("stop here")


@pytest.mark.parametrize("killed", ["in the notes", "in the shard", "in the manifest"])
def test_an_import_goes_on_that_was_killed_before_its_first_manifest(tmp_path, killed):
    interaction = Dataset.open(fake_data_set(tmp_path / "fake", objects=1))[0]
    pose = np.eye(4).tolist()
    notes = {"recording": "film", "camera": {}, "T_action_camera": pose, "start": 0.0, "frame_times": []}
    folder, whole = begun(tmp_path / "data", "manifest.json"), tmp_path / "whole"
    assert recorded.add_recorded(whole, interaction, notes) == 0
    for name in (recorded.NOTES_FOLDER, storage.SHARD_FOLDER):
        (folder / name).mkdir()
    files_of = {"in the notes": 0, "in the shard": 1, "in the manifest": 2}[killed]
    for name in (f"{recorded.NOTES_FOLDER}/00000.json", storage.shard_name(0))[:files_of]:
        (folder / name).write_bytes((whole / name).read_bytes())
    half = folder / recorded.NOTES_FOLDER / f".00000.json.{HERE}-{dead_process()}-0.partial"
    half.write_text("{")
    assert recorded.add_recorded(folder, interaction, notes) == 0
    assert examine(folder).findings == ()
    assert not list(folder.rglob("*.partial"))


def test_an_import_does_not_write_over_shards_without_a_manifest(tmp_path):
    folder = fake_data_set(tmp_path / "data", objects=1)
    interaction = Dataset.open(folder)[0]
    (folder / storage.MANIFEST).unlink()
    with pytest.raises(DatasetError, match="no data set and not empty"):
        recorded.add_recorded(folder, interaction, {})


def test_the_doctor_leaves_drafts_of_the_living(tmp_path):
    folder = fake_data_set(tmp_path / "data", objects=1)
    alive = folder / storage.SHARD_FOLDER / f".shard-00000.parquet.{HERE}-{os.getppid()}-0.partial"
    dead = folder / f".manifest.json.{HERE}-{dead_process()}-0.partial"
    for draft in (alive, dead):
        draft.write_text("half")
    assert [finding.file for finding in examine(folder).findings] == [dead.name]
    examine(folder, repair=True)
    assert (alive.exists(), dead.exists()) == (True, False)


SMALL_DISK = """
import resource
from foretrace.cli import main
whole = resource.getrlimit(resource.RLIMIT_FSIZE)
for size in {sizes}:
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, whole[1]))
    print(main([*{command!r}, "--out", {out!r} + str(size)]))
    resource.setrlimit(resource.RLIMIT_FSIZE, whole)
    print(main([*{command!r}, "--out", {out!r} + str(size)]))
"""


def test_a_training_on_a_full_disk_ends_in_one_line_and_goes_on_later(tmp_path):
    """A file may not become longer than so many bytes, which the system tells like a full disk."""
    data, sizes = fake_data_set(tmp_path / "data", objects=8), (0, 500, 2_000, 8_000)
    config = ["--features", "none", "--epochs", "2", "--min-steps", "1", "--hidden", "16"]
    command = ["train", "--data", str(data), *config, "--split", "20", "5", "5"]
    code = SMALL_DISK.format(sizes=sizes, command=command, out=str(tmp_path / "run"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if "error: " in line]
    assert len(errors) == len(sizes), done.stderr
    for line in errors:
        assert line.startswith("foretrace: error: cannot use ")
        assert line.endswith("File too large: free some, and repeat the command")
    assert [line for line in done.stdout.splitlines() if line.isdecimal()] == ["2", "0"] * len(sizes)
