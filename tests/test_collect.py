import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import factories
from foretrace.actions import Motion, ToolPath
from foretrace.errors import DatasetError, SimulationError
from foretrace.files import PARTIAL
from foretrace.geometry import is_convex
from foretrace.interactions import storage
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.doctor import examine
from foretrace.interactions.record import Interaction, Outcome
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Box, Cylinder, Prism
from foretrace.simulation import collect as collecting
from foretrace.simulation.collect import (
    CollectConfig,
    collect,
    num_trials,
    planned_trial,
    simulate_trial,
    trial,
)
from foretrace.simulation.engine import Play
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.mujoco_engine import MujocoEngine
from foretrace.simulation.recipes import RECIPES

SMALL = CollectConfig(objects=16)
"""208 trials: three shards."""


def fake_trial(config: CollectConfig, id: int) -> Interaction:
    """A stand-in for the physics: quick, and different for every trial; every 40th simulation diverges."""
    obj, action, seed = trial(config, id)
    made = factories.fake_lever_up(obj, action, id=id, seed=seed)
    outcome = Outcome.FAILED if id % 40 == 39 else Outcome.LEVERED
    return replace(made, effect=replace(made.effect, outcome=outcome))


def slow_trial(config: CollectConfig, id: int) -> Interaction:
    """The last one does not end before the test does, however busy the machine is."""
    time.sleep(600.0 if id == 207 else 0.02)
    return fake_trial(config, id)


def reluctant_trial(config: CollectConfig, id: int) -> Interaction:
    if id == 150:
        raise SimulationError("no engine by that name")
    return fake_trial(config, id)


def interrupted_trial(config: CollectConfig, id: int) -> Interaction:
    if id == 150:
        raise KeyboardInterrupt
    return fake_trial(config, id)


def interrupted_after_a_shard(config: CollectConfig, id: int) -> Interaction:
    if id == 110:
        raise KeyboardInterrupt
    return fake_trial(config, id)


def torch_free_trial(config: CollectConfig, id: int) -> Interaction:
    assert "torch" not in sys.modules
    assert os.environ["OMP_NUM_THREADS"] == "1"
    return fake_trial(config, id)


def quiet() -> Console:
    return Console(quiet=True)


def shards_of(folder: Path) -> dict[str, str]:
    """Checksum of every shard on disk."""
    files = sorted((folder / storage.SHARD_FOLDER).iterdir())
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("reference") / "data"
    collect(SMALL, folder, workers=1, console=quiet(), simulate=fake_trial)
    return folder


def test_the_papers_trials_are_2080():
    config = CollectConfig()
    assert num_trials(config) == 2080
    counts = [RECIPES["paper"].num_edges(k) for k in range(config.objects)]
    assert [counts.count(n) for n in range(3, 11)] == [20] * 8
    located = [collecting._locate(config, id) for id in range(2080)]
    assert located == [(k, contact) for k in range(160) for contact in range(2 * counts[k])]


@pytest.mark.parametrize("objects", [1, 3, 8, 13])
def test_any_number_of_objects_is_spread_over_the_corner_counts(objects):
    config = CollectConfig(objects=objects)
    counts = [RECIPES["paper"].num_edges(k) for k in range(objects)]
    assert num_trials(config) == 2 * sum(counts)
    assert max(map(counts.count, counts)) - min(map(counts.count, counts)) <= 1
    obj, _, _ = trial(config, num_trials(config) - 1)
    assert len(obj.corners) == counts[-1]
    with pytest.raises(SimulationError, match=f"no trial {num_trials(config)}"):
        trial(config, num_trials(config))


def test_every_edge_is_levered_twice_and_trials_are_reproducible():
    config = CollectConfig(objects=8, seed=5)
    normals = []
    for id in range(6):  # the triangle
        obj, action, _ = trial(config, id)
        normals.append(action.direction)
    np.testing.assert_allclose(normals[0::2], normals[1::2])
    assert len(np.unique(np.round(normals, 9), axis=0)) == 3
    seeds = {trial(config, id)[2] for id in range(num_trials(config))}
    assert len(seeds) == num_trials(config)
    collecting._object_and_actions.cache_clear()
    again, action_again, _ = trial(config, 5)
    assert again.to_dict() == obj.to_dict()
    np.testing.assert_array_equal(action_again.contact, action.contact)
    other, _, _ = trial(replace(config, seed=6), 5)
    assert other.to_dict() != obj.to_dict()


def test_more_objects_begin_with_the_same_trials():
    small, large = CollectConfig(objects=8), CollectConfig(objects=160)
    for id in (0, 50, 103):
        assert trial(small, id)[0].to_dict() == trial(large, id)[0].to_dict()
        assert trial(small, id)[2] == trial(large, id)[2]


def test_chosen_trials_are_those_of_the_whole_configuration(tmp_path):
    numbers = tuple(int(k) for k in np.random.default_rng(0).permutation(208)[:130])
    some = replace(SMALL, trials=numbers)
    assert num_trials(some) == 130
    collect(some, tmp_path / "data", workers=1, console=quiet(), simulate=fake_trial)
    assert not examine(tmp_path / "data").findings
    made = Dataset.open(tmp_path / "data")
    batch = made.batch()
    assert batch.ids.tolist() == [k for k in range(130) if k % 40 != 39]  # the others diverged
    for k, id in enumerate(batch.ids):
        obj, action, seed = trial(SMALL, numbers[id])
        assert made[k].provenance.seed == seed
        assert made[k].object.to_dict() == obj.to_dict()
        np.testing.assert_array_equal(made[k].action.contact, action.contact)
        assert batch.object_ids[k] == collecting._locate(SMALL, numbers[id])[0]


def test_chosen_trials_may_become_more_in_whole_shards(tmp_path):
    numbers = tuple(range(207, 57, -1))
    collect(replace(SMALL, trials=numbers[:100]), tmp_path / "grown", 1, quiet(), fake_trial)
    with pytest.raises(DatasetError, match=r"was begun with trials = \[207, 206"):
        collect(replace(SMALL, trials=numbers[1:]), tmp_path / "grown", 1, quiet(), fake_trial)
    with pytest.raises(DatasetError, match="was begun with trials"):
        collect(SMALL, tmp_path / "grown", 1, quiet(), fake_trial)
    collect(replace(SMALL, trials=numbers), tmp_path / "grown", 1, quiet(), fake_trial)
    collect(replace(SMALL, trials=numbers), tmp_path / "at-once", 1, quiet(), fake_trial)
    assert shards_of(tmp_path / "grown") == shards_of(tmp_path / "at-once")
    with pytest.raises(DatasetError, match="was begun with trials"):  # the last shard is not full
        collect(replace(SMALL, trials=(*numbers, 0)), tmp_path / "grown", 1, quiet(), fake_trial)


@pytest.mark.parametrize(
    ("trials", "message"),
    [((208,), "no trial 208"), ((-1,), "no trial -1"), ((3, 4, 3), "trial 3 is named twice")],
)
def test_wrong_trials_are_refused(trials, message):
    with pytest.raises(SimulationError, match=message):
        replace(SMALL, trials=trials)


def test_a_planned_trial_has_everything():
    planned = planned_trial(SMALL, 17)
    assert (planned.config, planned.seed, planned.id) == (SMALL.simulation, trial(SMALL, 17)[2], 17)


def test_solids_come_in_threes_with_one_mask_and_the_same_actions():
    config = CollectConfig(objects=6, recipe="solids")
    assert num_trials(config) == 6 * 8
    for id in (0, 5, 24):
        cylinder, box, flat = (trial(config, id + 8 * k) for k in range(3))
        assert [type(obj) for obj, _, _ in (cylinder, box, flat)] == [Cylinder, Box, Prism]
        for _, action, _ in (box, flat):
            np.testing.assert_array_equal(action.contact, cylinder[1].contact)
        masks = [TopDownView.of(obj, action).mask for obj, action, _ in (cylinder, box, flat)]
        np.testing.assert_array_equal(masks[0], masks[1])
        np.testing.assert_array_equal(masks[0], masks[2])
        assert len({seed for _, _, seed in (cylinder, box, flat)}) == 3
    assert trial(config, 0)[0].to_dict() != trial(config, 24)[0].to_dict()


def test_the_mixed_recipe_takes_turns():
    config = CollectConfig(objects=40, recipe="mixed")
    kinds = []
    located = [collecting._locate(config, id) for id in range(num_trials(config))]
    for k in range(40):
        obj, _, _ = trial(config, located.index((k, 0)))
        kinds.append(type(obj))
        assert located.count((k, 0)) == 1
        assert (
            sum(index == k for index, _ in located)
            == 2 * len(obj.corners)
            == 2 * RECIPES["mixed"].num_edges(k)
        )
    assert kinds == [Prism, Prism, Cylinder, Box, Prism] * 8
    prisms = [RECIPES["mixed"].num_edges(k) for k in range(40) if k % 5 < 2]
    assert sorted(prisms) == sorted([*range(3, 11)] * 2)
    fewer = replace(config, objects=11)
    for id in (0, 13, 50, num_trials(fewer) - 1):
        assert trial(fewer, id)[0].to_dict() == trial(config, id)[0].to_dict()
        assert trial(fewer, id)[2] == trial(config, id)[2]


def test_the_everyday_recipe_has_every_family():
    config = CollectConfig(objects=40, recipe="everyday")
    located = [collecting._locate(config, id) for id in range(num_trials(config))]
    objects = [trial(config, located.index((k, 0)))[0] for k in range(40)]
    for k, obj in enumerate(objects):
        kind, edges = (
            (Cylinder if k % 10 == 3 else Box if k % 10 == 4 else Prism),
            RECIPES["everyday"].num_edges(k),
        )
        assert type(obj) is kind
        assert (edges == len(obj.corners)) == (k % 10 < 6)
        assert sum(index == k for index, _ in located) == 2 * edges
    sized = [obj for k, obj in enumerate(objects) if k % 10 < 3]
    assert [len(obj.corners) for obj in sized] == [*range(3, 11), *range(3, 7)]
    radii = [np.linalg.norm(obj.corners[0]) for obj in sized]
    assert min(radii) < 0.06 < 0.09 < max(radii)
    assert len({obj.height for obj in sized}) == len(sized)
    convex = {k: is_convex(obj.corners) for k, obj in enumerate(objects)}
    assert all(convex[k] for k in range(40) if k % 10 < 8)
    assert sum(convex[k] for k in range(40) if k % 10 == 9) == 0
    fewer = replace(config, objects=11)
    for id in (0, 25, num_trials(fewer) - 1):
        assert trial(fewer, id)[0].to_dict() == trial(config, id)[0].to_dict()


@pytest.mark.parametrize("recipe", ["mixed", "everyday"])
def test_a_mixed_data_set_is_sound_reproducible_and_resumable(tmp_path, recipe):
    config = CollectConfig(objects=15, recipe=recipe)
    collect(config, tmp_path / "one", workers=1, console=quiet(), simulate=fake_trial)
    folder = tmp_path / "two"
    with pytest.raises(KeyboardInterrupt):
        collect(config, folder, workers=1, console=quiet(), simulate=interrupted_after_a_shard)
    with pytest.raises(DatasetError, match=f"begun with recipe = {recipe}, asked for is recipe = paper"):
        collect(replace(config, recipe="paper"), folder, workers=1, console=quiet(), simulate=fake_trial)
    collect(config, folder, workers=1, console=quiet(), simulate=fake_trial)
    assert shards_of(folder) == shards_of(tmp_path / "one")
    assert examine(folder).findings == ()
    dataset = Dataset.open(folder)
    again, _, _ = trial(config, 30)
    assert dataset.with_id(30).object.to_dict() == again.to_dict()
    assert len(dataset.batch()) == len(dataset)


def test_other_settings_of_the_simulation_are_refused(tmp_path):
    collect(SMALL, tmp_path, workers=1, console=quiet(), simulate=fake_trial)
    watched = replace(SMALL, simulation=SimulationConfig(watch_time=1.5))
    with pytest.raises(DatasetError, match=r"begun with simulation\.watch_time = 0\.0, asked for is"):
        collect(watched, tmp_path, workers=1, console=quiet(), simulate=fake_trial)
    steeper = replace(SMALL, path=ToolPath(pitch=0.4))
    with pytest.raises(
        DatasetError, match=r"begun with path\.pitch = 0\.28, asked for is path\.pitch = 0\.4"
    ):
        collect(steeper, tmp_path, workers=1, console=quiet(), simulate=fake_trial)


def test_falls_and_edges_survive_storing(tmp_path):
    made = fake_trial(SMALL, 3)
    physics = replace(made.physics, table_edge=0.4, rolling_friction=3e-4)
    made = replace(made, effect=replace(made.effect, fall_index=31), physics=physics)
    stored = storage.decode(storage.to_table([storage.encode(made, 0)]).to_pylist()[0])
    assert stored.effect.fall_index == 31
    assert stored.physics == physics


@pytest.mark.parametrize("recipe", ["Solids", "", "prisms"])
def test_unknown_recipes_are_refused(recipe):
    with pytest.raises(SimulationError, match=f"unknown recipe '{recipe}'; available: paper, solids, mixed"):
        CollectConfig(recipe=recipe)


@pytest.mark.parametrize("wrong", [{"objects": 0}, {"contacts_per_edge": 0}, {"seed": -1}])
def test_impossible_configurations_are_refused(wrong):
    with pytest.raises(SimulationError, match=str(next(iter(wrong.values())))):
        CollectConfig(**wrong)


def test_a_collected_data_set_is_whole(reference):
    assert examine(reference).findings == ()
    dataset = Dataset.open(reference, failed=True)
    assert dataset.table["id"].to_pylist() == list(range(208))
    assert dataset.outcomes() == {"levered": 203, "failed": 5}
    assert dataset.table["object_id"].to_pylist()[:7] == [0] * 6 + [1]
    assert json.loads(json.dumps(dataset.manifest["configuration"]))["objects"] == 16
    alone = fake_trial(SMALL, 123)
    np.testing.assert_array_equal(dataset[123].effect.pose_trajectory, alone.effect.pose_trajectory)
    assert dataset[123].provenance.seed == alone.provenance.seed


def test_shards_are_the_same_bytes_with_two_workers(reference, tmp_path):
    counts = collect(SMALL, tmp_path / "two", workers=2, console=quiet(), simulate=torch_free_trial)
    assert counts == {"levered": 203, "failed": 5}
    assert shards_of(tmp_path / "two") == shards_of(reference)
    assert len(shards_of(reference)) == 3


def test_collecting_again_does_nothing(reference):
    before = shards_of(reference)
    times = [file.stat().st_mtime_ns for file in (reference / storage.SHARD_FOLDER).iterdir()]
    counts = collect(SMALL, reference, workers=1, console=quiet(), simulate=reluctant_trial)
    assert counts == {"levered": 203, "failed": 5}
    assert shards_of(reference) == before
    assert times == [file.stat().st_mtime_ns for file in (reference / storage.SHARD_FOLDER).iterdir()]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"seed": 1}, "begun with seed = 0, asked for is seed = 1"),
        ({"objects": 8}, "begun with objects = 16, asked for is objects = 8"),
    ],
)
def test_another_configuration_in_the_same_folder_is_refused(reference, changed, message):
    before = shards_of(reference)
    with pytest.raises(DatasetError, match=message):
        collect(replace(SMALL, **changed), reference, workers=1, console=quiet(), simulate=fake_trial)
    assert shards_of(reference) == before


def test_nested_settings_are_compared_too(reference, tmp_path):
    manifest = storage.read_manifest(reference)
    manifest["configuration"]["simulation"]["engine"] = "newton"
    (tmp_path / storage.SHARD_FOLDER).mkdir()
    storage.write_manifest(tmp_path, manifest)
    with pytest.raises(DatasetError, match=r"simulation\.engine = newton, asked for is simulation"):
        collect(SMALL, tmp_path, workers=1, console=quiet(), simulate=fake_trial)


def test_foreign_folders_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(DatasetError, match=r"holds thesis\.tex and is no data set"):
        collect(SMALL, tmp_path, workers=1, console=quiet(), simulate=fake_trial)
    with pytest.raises(DatasetError, match=r"thesis\.tex is a file"):
        collect(SMALL, tmp_path / "thesis.tex", workers=1, console=quiet(), simulate=fake_trial)
    with pytest.raises(SimulationError, match="workers is 0"):
        collect(SMALL, tmp_path / "new", workers=0, console=quiet(), simulate=fake_trial)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_trial_that_cannot_be_simulated_stops_the_run_and_is_named(reference, tmp_path, workers):
    with pytest.raises(SimulationError, match="trial 150 cannot be simulated: no engine by that name"):
        collect(SMALL, tmp_path, workers=workers, console=quiet(), simulate=reluctant_trial)
    kept = shards_of(tmp_path)  # beside the failing shard, the others may have been finished
    assert "shard-00001.parquet" not in kept
    assert kept.items() <= shards_of(reference).items()


def test_an_interrupted_run_keeps_what_is_done_and_goes_on(reference, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        collect(SMALL, tmp_path, workers=1, console=quiet(), simulate=interrupted_trial)
    assert list(shards_of(tmp_path)) == ["shard-00000.parquet"]
    collect(SMALL, tmp_path, workers=1, console=quiet(), simulate=fake_trial)
    assert shards_of(tmp_path) == shards_of(reference)


def test_damage_is_made_good(reference, tmp_path):
    collect(SMALL, tmp_path, workers=1, console=quiet(), simulate=fake_trial)
    first, second, third = (tmp_path / storage.shard_name(k) for k in range(3))
    first.unlink()
    second.write_bytes(second.read_bytes()[:-1])
    manifest = storage.read_manifest(tmp_path)
    del manifest["shards"][storage.shard_name(2)]  # killed between the shard and the manifest
    storage.write_manifest(tmp_path, manifest)
    (tmp_path / storage.SHARD_FOLDER / f".shard-00001.parquet.1{PARTIAL}").write_bytes(b"half")
    begun = time.time_ns()
    collect(SMALL, tmp_path, workers=1, console=quiet(), simulate=fake_trial)
    assert shards_of(tmp_path) == shards_of(reference)
    assert examine(tmp_path).findings == ()
    assert third.stat().st_mtime_ns < begun, "a whole shard is not made again"


def test_kill_9_loses_only_the_shards_in_work(reference, tmp_path):
    folder = tmp_path / "data"
    code = (
        "from foretrace.simulation.collect import collect; import test_collect;"
        f"collect(test_collect.SMALL, {str(folder)!r}, workers=2, simulate=test_collect.slow_trial)"
    )
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    process = subprocess.Popen(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": paths}, start_new_session=True
    )
    try:
        deadline = time.monotonic() + 60
        while not (folder / storage.shard_name(0)).exists():
            assert process.poll() is None, "finished or failed before it could be killed"
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        done = {name: sha for name, sha in shards_of(folder).items() if not name.endswith(PARTIAL)}
        assert 1 <= len(done) < 3
        collect(SMALL, folder, workers=1, console=quiet(), simulate=fake_trial)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # its workers, should they still be there
    assert done.items() <= shards_of(folder).items()
    assert shards_of(folder) == shards_of(reference)
    assert examine(folder).findings == ()


def deaf_trial(config: CollectConfig, id: int) -> Interaction:
    if signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, []):
        raise SimulationError("Ctrl-C would have been heard")
    return fake_trial(config, id)


def test_workers_never_hear_ctrl_c_and_the_parent_does(tmp_path):
    code = (
        "import signal, test_collect; from foretrace.simulation.collect import collect\n"
        f"collect(test_collect.SMALL, {str(tmp_path)!r}, workers=2, simulate=test_collect.deaf_trial)\n"
        "assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])"
    )
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_progress_is_reported_in_plain_lines_without_a_terminal(tmp_path, monkeypatch):
    monkeypatch.setattr(collecting, "ProgressReport", partial(collecting.ProgressReport, period=1e-9))
    console = Console(file=(tmp_path / "log").open("w+"), force_terminal=False, width=40)
    collect(CollectConfig(objects=8), tmp_path / "data", workers=1, console=console, simulate=fake_trial)
    console.file.seek(0)
    lines = console.file.read().splitlines()
    assert len(lines) == 11
    assert lines[0].startswith("10 of 104 interactions, ")
    assert "s left: 10 levered" in lines[0]
    assert "102 levered, 2 failed" in lines[-1]


def test_a_real_interaction_is_reproducible_alone_from_its_id(tmp_path):
    config = CollectConfig(objects=1, simulation=SimulationConfig(embodiment="tool"))
    collect(config, tmp_path, workers=1, console=quiet())
    stored = Dataset.open(tmp_path)[4]
    alone = simulate_trial(config, 4)
    for name in ("pose_trajectory", "com_trajectory", "tool_trajectory", "support_points"):
        np.testing.assert_array_equal(getattr(stored.effect, name), getattr(alone.effect, name))
    assert stored.effect.outcome == alone.effect.outcome
    assert stored.provenance == alone.provenance


def test_an_engine_that_plays_many_at_once_makes_the_same_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = CollectConfig(objects=1, contacts_per_edge=2, simulation=SimulationConfig(embodiment="tool"))
    collect(config, tmp_path / "one", workers=1, console=quiet())
    calls = []
    one_by_one = MujocoEngine.play_many

    def counted(self: MujocoEngine, plays: Sequence[Play]) -> list[Motion]:
        calls.append(len(plays))
        return one_by_one(self, plays)

    monkeypatch.setattr(MujocoEngine, "at_once", 250)
    monkeypatch.setattr(MujocoEngine, "play_many", counted)
    collect(config, tmp_path / "many", workers=1, console=quiet())
    assert calls == [6]
    one, many = (storage.read_manifest(tmp_path / name)["shards"] for name in ("one", "many"))
    assert one == many
