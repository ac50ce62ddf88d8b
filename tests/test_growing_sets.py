"""Trainings on data sets that are still being written, several of them at once, and plans for every object."""

import csv
import json
import shutil
from pathlib import Path

import pytest
from rich.console import Console

import foretrace as ft
from foretrace import cli
from foretrace.cli import plan_many
from foretrace.interactions import storage
from foretrace.interactions.dataset import Dataset
from foretrace.simulation import collect as collecting
from foretrace.simulation.collect import CollectConfig, collect
from test_cluster import FakeRay, begin  # noqa: F401
from test_collect import fake_trial

CONFIG = CollectConfig(objects=4)
OPTIONS = ["--epochs", "2", "--hidden", "4", "--split", "10", "3", "3"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A data set of four shards."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collecting, "SHARD_SIZE", 10)
        collect(CONFIG, out := tmp_path_factory.mktemp("whole") / "set", 1, Console(quiet=True), fake_trial)
    assert len(storage.read_manifest(out)["shards"]) == 4
    return out


@pytest.fixture
def growing(whole, tmp_path) -> Path:
    """The same, whose third shard is still to come."""
    shutil.copytree(whole, folder := tmp_path / "set")
    manifest = storage.read_manifest(folder)
    del manifest["shards"][storage.shard_name(2)]
    storage.write_manifest(folder, manifest)
    (folder / storage.shard_name(2)).unlink()
    return folder


def train(data: Path, out: Path, *options: str) -> int:
    return cli.main(["train", "--data", str(data), "--out", str(out), *OPTIONS, *options])


def files(run: Path) -> dict[str, bytes]:
    """What a training made, without times and places."""
    kept = {name: (run / name).read_bytes() for name in ("config.json", "model.safetensors", "split.json")}
    rows = (run / "metrics.csv").read_text().splitlines()
    return kept | {"metrics.csv": "\n".join(row.rpartition(",")[0] for row in rows).encode()}


def test_a_training_looks_at_the_complete_shards_and_goes_on_with_the_same(whole, growing, tmp_path, capsys):
    assert train(growing, tmp_path / "run") == 0
    told = capsys.readouterr().err
    assert (
        f"{growing} has its first 20 of {Dataset.open(whole).manifest['num_trials']} interactions so far"
        in told
    )
    assert "not finished" not in told
    assert json.loads((tmp_path / "run" / "config.json").read_text())["training"]["first"] == 20
    before = files(tmp_path / "run")
    shutil.rmtree(growing)
    shutil.copytree(whole, growing)
    assert train(growing, tmp_path / "run", "--card") == 0  # the simulation has ended in the meantime
    assert files(tmp_path / "run") == before
    card = (tmp_path / "run" / "MODEL_CARD.md").read_text()
    assert "`set`, the first 20 interactions, simulated with" in card
    assert "--first 20" in card
    assert "so far" not in capsys.readouterr().err
    assert train(whole, tmp_path / "again", "--first", "20") == 0
    assert files(tmp_path / "again") == before


def test_a_fresh_training_looks_at_all_that_there_is(whole, growing, tmp_path):
    assert train(growing, tmp_path / "run") == 0
    assert train(whole, tmp_path / "run", "--fresh") == 0
    assert json.loads((tmp_path / "run" / "config.json").read_text())["training"]["first"] is None


def test_a_set_without_a_beginning_is_refused(growing, tmp_path, capsys):
    manifest = storage.read_manifest(growing)
    del manifest["shards"][storage.shard_name(0)]
    storage.write_manifest(growing, manifest)
    assert train(growing, tmp_path / "run") == 2
    assert "has no complete shard at its beginning yet: wait" in capsys.readouterr().err


def test_trainings_with_several_seeds_are_those_with_each(growing, tmp_path, begin, capsys):  # noqa: F811
    with begin(FakeRay()):
        assert train(growing, tmp_path / "runs", "--seeds", "1", "2") == 0
    told = capsys.readouterr()
    assert told.err.count("so far") == 1
    assert "2 of 2 trainings" in told.err
    assert [*map(str, (tmp_path / "runs" / name for name in ("seed-1", "seed-2")))] == [
        line.removeprefix("predictor: ") for line in told.out.splitlines() if line.startswith("predictor: ")
    ]
    assert train(growing, tmp_path / "2", "--seed", "2") == 0
    assert files(tmp_path / "2") == files(tmp_path / "runs" / "seed-2")
    assert files(tmp_path / "2") != files(tmp_path / "runs" / "seed-1")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seed", "1", "--seeds", "1", "2"], "--seed and --seeds do not go together"),
        (["--seeds", "1", "1"], "names a seed twice"),
        (["--seeds", "-1"], "seed is -1"),
        (["--workers", "2"], "--workers without --seeds"),
        (["--seeds", "1", "--workers", "0"], "workers is 0"),
        (["--first", "0"], "first is 0"),
        (["--first", "5"], "split"),
    ],
)
def test_options_that_do_not_fit_are_refused(whole, tmp_path, options, message, capsys):
    assert train(whole, tmp_path / "run", *options) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1


def plan(data: Path, out: Path, *options: str) -> int:
    quick = ["--refine", "0", "--check", "0", "--spacing", "0.05"]
    return cli.main(["plan", "--data", str(data), "--every", "--out", str(out), *quick, *options])


def test_plans_for_every_object_are_those_of_each_and_go_on(whole, tmp_path, begin, monkeypatch, capsys):  # noqa: F811
    assert plan(whole, tmp_path / "plans", "--workers", "1") == 0
    assert "4 plans, " in capsys.readouterr().out
    with (tmp_path / "plans" / "plans.csv").open() as file:
        rows = list(csv.DictReader(file))
    dataset = Dataset.open(whole)
    assert [int(row["object_id"]) for row in rows] == [0, 1, 2, 3]
    firsts = [dataset.where(object_id=k).ids[0] for k in range(4)]
    assert [int(row["interaction"]) for row in rows] == firsts
    quick = ft.PlanConfig(refine=0, check=0, spacing=0.05)
    alone = ft.plan(dataset.with_id(int(firsts[2])).object, ft.goals.Lift(), config=quick)
    assert [float(rows[2][name]) for name in ("contact_x_m", "contact_y_m")] == alone.action.contact.tolist()
    assert float(rows[2]["reached"]) == alone.reached

    own, planned = plan_many._plan, []

    def interrupted(task, number, *others):
        planned.append(number)
        if planned == [0, 1, 2]:
            raise KeyboardInterrupt
        return own(task, number, *others)

    monkeypatch.setattr(plan_many, "_plan", interrupted)
    assert plan(whole, tmp_path / "again", "--workers", "1") == 130
    with begin(FakeRay()):
        assert plan(whole, tmp_path / "again") == 0
    assert sorted(planned) == [0, 1, 2, 2, 3]
    assert (tmp_path / "again" / "plans.csv").read_bytes() == (tmp_path / "plans" / "plans.csv").read_bytes()
    assert plan(whole, tmp_path / "again", "--goal", "tilt", "--angle", "0.1") == 2
    assert "again holds plans with goal = Lift(" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--id", "1"], "many objects: leave out --id, or --every"),
        (["--pose", "0", "0", "0", "--steps", "2"], "many objects: leave out --pose and --steps, or --every"),
        (["--workers", "0"], "workers is 0"),
    ],
)
def test_options_of_one_object_do_not_go_with_every(whole, tmp_path, options, message, capsys):
    assert plan(whole, tmp_path / "plans", *options) == 2
    assert message in capsys.readouterr().err
