"""Data sets of format version 1 become today's, whatever happens on the way."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

import factories
from foretrace.actions import ToolPath
from foretrace.actions.lever_up import VARIED_ACTION
from foretrace.errors import DatasetError
from foretrace.interactions import recorded, shards, storage
from foretrace.interactions import upgrade as upgrading
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.doctor import examine
from foretrace.interactions.record import Interaction
from foretrace.interactions.upgrade import upgrade
from foretrace.simulation.collect import CollectConfig, collect, simulate_trial
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.randomisation import RANDOMISED

GOLDEN = Path(__file__).parent / "golden" / "version-1"
"""Written by the last foretrace that wrote version 1: a random cylinder, levered four times."""
CONFIG = CollectConfig(
    objects=1,
    contacts_per_edge=1,
    simulation=SimulationConfig(embodiment="tool", watch_time=0.5),
    recipe="solids",
    randomisation=replace(RANDOMISED, **VARIED_ACTION),
    path=ToolPath(pitch=0.33, pitch_gain=0.6, insert_time=0.5, lift_time=1.5),
)
"""The configuration that it was written with."""


@pytest.fixture
def old(tmp_path: Path) -> Path:
    return Path(shutil.copytree(GOLDEN, tmp_path / "old"))


def old_shard(folder: Path) -> tuple[str, list[dict]]:
    name = storage.shard_name(0)
    return name, storage.read_shard(folder, name, schema=None)[0].to_pylist()


def assert_as_simulated_today(found: Interaction, id: int) -> None:
    made = simulate_trial(CONFIG, id)
    assert found.object.to_dict() == made.object.to_dict()
    assert found.action.direction.tobytes() == made.action.direction.tobytes()
    assert found.action.tool == made.action.tool
    # The speed is a quotient of stored numbers, and so exact but for its last bits.
    assert asdict(found.action.path) == pytest.approx(asdict(made.action.path), rel=1e-14)
    assert (found.physics, found.execution_error) == (made.physics, made.execution_error)
    assert replace(found.provenance, versions={}) == replace(made.provenance, versions={})
    assert found.effect.outcome == made.effect.outcome


def test_an_upgraded_data_set_has_the_whole_action_and_keeps_its_trajectories(old):
    _, before = old_shard(old)
    with pytest.raises(DatasetError, match=r"has format version 1, .*: upgrade it in place with `foretrace"):
        Dataset.open(old)
    assert upgrade(old) == 4
    dataset = Dataset.open(old, failed=True)
    for row, found in zip(before, dataset, strict=True):
        for name in ("times", "pose_trajectory", "com_trajectory", "tool_trajectory"):
            assert getattr(found.effect, name).ravel().tolist() == row[name]
        assert found.action.parameters() == pytest.approx(
            {name: row[name] for name in ("insertion", "arc_radius", "sweep", "speed")}, rel=1e-14
        )
        assert_as_simulated_today(found, row["id"])
    assert examine(old).findings == ()
    checksums = dict(dataset.manifest["shards"])
    assert upgrade(old) == 0, "today's version stays as it is"
    assert storage.read_manifest(old)["shards"] == checksums


def test_an_upgraded_data_set_goes_on(old):
    manifest = json.loads((old / storage.MANIFEST).read_text())
    (old / storage.shard_name(0)).unlink()
    upgrade(old)
    assert storage.missing_shards(storage.read_manifest(old)) == [storage.shard_name(0)]
    collect(CONFIG, old, workers=1)
    assert_as_simulated_today(Dataset.open(old)[0], 0)
    assert storage.read_manifest(old)["versions"] == manifest["versions"]


def test_early_data_sets_lack_columns_and_settings(old):
    name, _ = old_shard(old)
    table = storage.read_shard(old, name, schema=None)[0]
    gone = [f"misplaced_{way}" for way in ("ahead", "left", "turn")]
    gone += ["fall_index", "rolling_friction", "table_edge", "insertion", "arc_radius", "sweep", "speed"]
    manifest = json.loads((old / storage.MANIFEST).read_text())
    manifest["shards"][name] = shards.write_shard(old, name, table.drop_columns(gone))
    configuration = manifest["configuration"]
    del configuration["recipe"], configuration["randomisation"], configuration["simulation"]["watch_time"]
    del configuration["simulation"]["path"], configuration["simulation"]["physics"]["table_edge"]
    storage.write_manifest(old, manifest)
    upgrade(old)
    first = Dataset.open(old)[0]
    assert first.action.path == ToolPath()
    assert first.provenance.watch_time == 0
    plain = CollectConfig(1, 1, simulation=SimulationConfig(embodiment="tool"))
    expected = {name: value for name, value in asdict(plain).items() if name != "trials"}  # all of them
    assert storage.read_manifest(old)["configuration"] == json.loads(json.dumps(expected))


@pytest.mark.parametrize("calls", range(1, 4))
def test_a_crash_at_any_moment_loses_nothing(tmp_path, monkeypatch, calls):
    old, whole = (Path(shutil.copytree(GOLDEN, tmp_path / name)) for name in ("old", "whole"))
    name, _ = old_shard(old)
    for folder in (old, whole):  # a second shard
        manifest = json.loads((folder / storage.MANIFEST).read_text())
        manifest["shards"][storage.shard_name(1)] = manifest["shards"][name]
        shutil.copy(folder / name, folder / storage.shard_name(1))
        storage.write_manifest(folder, manifest)
    upgrade(whole)
    done = 0

    def crash(function):
        def crashing(*arguments):
            nonlocal done
            done += 1
            if done == calls:
                raise KeyboardInterrupt
            return function(*arguments)

        return crashing

    with monkeypatch.context() as patch:
        for module, function in ((upgrading, "write_shard"), (storage, "write_manifest")):
            patch.setattr(module, function, crash(getattr(module, function)))
        with pytest.raises(KeyboardInterrupt):
            upgrade(old)
    upgrade(old)
    assert storage.read_manifest(old) == storage.read_manifest(whole)
    for shard in (0, 1):
        assert (old / storage.shard_name(shard)).read_bytes() == (
            whole / storage.shard_name(shard)
        ).read_bytes()


def test_a_damaged_shard_is_named_before_anything_is_changed(old):
    path = old / storage.shard_name(0)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(DatasetError, match=r"shard-00000\.parquet is (corrupt|not readable)"):
        upgrade(old)
    assert path.read_bytes() == bytes(content)
    assert json.loads((old / storage.MANIFEST).read_text())["format_version"] == 1


def test_recordings_keep_the_numbers_of_their_objects(tmp_path):
    made = factories.fake_interaction(np.random.default_rng(0), 0)
    made = replace(made, provenance=replace(made.provenance, source="recorded", engine=""))
    other = replace(made, object=factories.fake_interaction(np.random.default_rng(1), 0).object)
    folder = tmp_path / "recorded"
    for interaction in (made, other):
        recorded.add_recorded(folder, interaction, {})
    manifest = storage.read_manifest(folder)
    del manifest[recorded.OBJECTS]
    for shard in manifest["shards"]:
        manifest["shards"][shard] = as_version_1(folder, shard)
    storage.write_manifest(folder, {**manifest, "format_version": 1})
    upgrade(folder)
    recorded.add_recorded(folder, other, {})
    dataset = Dataset.open(folder)
    assert dataset.table["object_id"].to_pylist() == [0, 1, 1]
    assert dataset[0].provenance.timestep == 0
    assert dataset[0].action.path == made.action.path


def as_version_1(folder: Path, shard: str) -> dict:
    """A shard with the columns that version 1 had; the path is the nominal one."""
    table = storage.read_shard(folder, shard)[0]
    new = ["action", "path", "tool", "camera", "timestep", "sample_period", "watch_time"]
    return shards.write_shard(
        folder, shard, table.drop_columns([*new, "execution_ahead", "execution_left", "execution_turn"])
    )
