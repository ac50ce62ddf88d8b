import json
import os
import threading
import time
import warnings
import weakref
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import factories
from foretrace.actions import LeverUp
from foretrace.errors import DatasetError
from foretrace.files import PARTIAL, sole_writer
from foretrace.geometry import polygon_area, quaternion_to_matrix
from foretrace.interactions import shards, storage
from foretrace.interactions.dataset import Dataset, InteractionBatch
from foretrace.interactions.doctor import examine
from foretrace.interactions.record import Interaction, Outcome
from foretrace.objects import Prism
from foretrace.simulation.lever_up import simulate


def write_dataset(folder: Path, interactions: list[Interaction], shard_size: int = 8) -> Path:
    """A finished data set, two interactions an object."""
    (folder / storage.SHARD_FOLDER).mkdir(parents=True)
    manifest = storage.new_manifest({"seed": 0}, len(interactions), shard_size, {"foretrace": "0.1.0"})
    rows = [storage.encode(interaction, object_id=interaction.id // 2) for interaction in interactions]
    for start in range(0, len(rows), shard_size):
        name = storage.shard_name(start // shard_size)
        table = storage.to_table(rows[start : start + shard_size])
        manifest["shards"][name] = shards.write_shard(folder, name, table)
    storage.write_manifest(folder, manifest)
    return folder


def assert_equal(a: Interaction, b: Interaction) -> None:
    """Everything is equal to the last bit."""
    assert a.object.to_dict() == b.object.to_dict()
    assert (a.id, a.physics, a.provenance) == (b.id, b.physics, b.provenance)
    for part in ("action", "view", "effect"):
        for f in fields(getattr(a, part)):
            left, right = getattr(getattr(a, part), f.name), getattr(getattr(b, part), f.name)
            if isinstance(left, np.ndarray):
                assert left.dtype == right.dtype, f.name
                np.testing.assert_array_equal(left, right, err_msg=f.name)
            else:
                assert left == right, f.name


@pytest.fixture(scope="module")
def interactions() -> list[Interaction]:
    made = factories.fake_interactions(np.random.default_rng(0), 20)
    failed = made[13]
    made[13] = replace(failed, effect=replace(failed.effect, outcome=Outcome.FAILED))
    return made


@pytest.fixture
def folder(tmp_path, interactions) -> Path:
    return write_dataset(tmp_path / "data", interactions)


@settings(deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1),
    id=st.integers(0, 2**40),
    num_samples=st.integers(5, 80),
    num_joints=st.integers(0, 7),
    outcome=st.sampled_from([outcome for outcome in Outcome if outcome != Outcome.FAILED]),
)
def test_storing_an_interaction_keeps_every_bit(seed, id, num_samples, num_joints, outcome):
    rng = np.random.default_rng(seed)
    made = factories.fake_interaction(
        rng, id, outcome=outcome, num_samples=num_samples, num_joints=num_joints
    )
    made = replace(made, effect=replace(made.effect, support_points=np.full((2, 2), np.nan)))
    table = storage.to_table([storage.encode(made, object_id=3)])
    assert_equal(storage.decode(table.to_pylist()[0]), made)


def test_heights_come_back_in_steps_of_a_tenth_of_a_millimetre():
    made = factories.fake_interaction(np.random.default_rng(0), 0)
    height = np.where(made.view.mask, np.linspace(0, 0.3, 128, dtype=np.float32), np.float32(0))
    made = replace(made, view=replace(made.view, height=height))
    stored = storage.decode(storage.to_table([storage.encode(made, 0)]).to_pylist()[0])
    assert np.abs(stored.view.height - height).max() <= 0.5001e-4


def test_dataset_reads_what_was_written_and_hides_failures(folder, interactions):
    dataset = Dataset.open(folder)
    assert len(dataset) == 19
    assert len(Dataset.open(folder, failed=True)) == 20
    wanted = [interaction for interaction in interactions if interaction.effect.outcome != Outcome.FAILED]
    for read, made in zip(dataset, wanted, strict=True):
        assert_equal(read, made)
    assert_equal(dataset[-1], interactions[-1])
    assert_equal(dataset.with_id(14), interactions[14])
    assert dataset.outcomes() == {"levered": 17, "slipped": 2}
    assert repr(dataset) == f"Dataset({str(folder)!r}: 19 interactions: 17 levered, 2 slipped)"
    assert repr(dataset[3]).startswith("Interaction(3: lever-up of a prism, levered, ")
    assert max(len(repr(part)) for part in (dataset[3], dataset[3].view, dataset[3].effect)) < 100
    assert repr(dataset[:0]) == f"Dataset({str(folder)!r}: 0 interactions)"


def test_failed_interaction_has_no_trajectory(folder):
    failed = Dataset.open(folder, failed=True).with_id(13)
    assert failed.effect.outcome == Outcome.FAILED
    assert failed.effect.com_trajectory.shape == (0, 3)
    assert failed.effect.joint_trajectory.shape == (0, 6)


def test_dataset_slices_and_filters(folder):
    dataset = Dataset.open(folder)
    assert [i.id for i in dataset[3:6]] == [3, 4, 5]
    assert [i.id for i in dataset[np.array([7, 2])]] == [7, 2]
    assert [i.id for i in dataset[dataset.table["id"].to_numpy() > 17]] == [18, 19]
    assert [i.id for i in dataset.where(outcome="slipped")] == [4, 14]
    assert [i.id for i in dataset.where(num_corners=(3, 4), object_id=range(5))] == [0, 1, 8, 9]
    assert [i.id for i in dataset.where(id=lambda ids: ids % 9 == 0)] == [0, 9, 18]
    assert len(dataset.where(outcome="missed")) == 0
    assert len(dataset.where(outcome="missed").batch()) == 0
    with pytest.raises(DatasetError, match=r"no column 'corner'.* num_corners"):
        dataset.where(corner=3)
    with pytest.raises(DatasetError, match=r"no outcome 'sliped': choose from levered, slipped, .*failed"):
        dataset.where(outcome=("levered", "sliped"))
    with pytest.raises(DatasetError, match="no interaction 13"):
        dataset.with_id(13)
    for rows, message in {
        19: "no row 19 among 19",
        "a": "'a' chooses no rows of 19",
    }.items():
        with pytest.raises(DatasetError, match=message) as caught:
            dataset[rows]
        assert isinstance(caught.value, IndexError)


def test_batch_equals_the_interactions_one_by_one(folder):
    dataset = Dataset.open(folder)
    batch = dataset.batch()
    assert len(batch) == len(dataset)
    for k, interaction in enumerate(dataset):
        effect, n = interaction.effect, len(interaction.effect.times)
        assert batch.length[k] == n
        assert batch.slip_index[k] == (n if effect.slip_index is None else effect.slip_index)
        np.testing.assert_array_equal(batch.times[:n], effect.times)
        np.testing.assert_array_equal(batch.com[k, :n], effect.com_trajectory)
        np.testing.assert_array_equal(batch.pose[k, :n], effect.pose_trajectory)
        assert np.isnan(batch.com[k, n:]).all()
        np.testing.assert_array_equal(batch.mask[k], interaction.view.mask)
        np.testing.assert_array_equal(batch.height[k], interaction.view.height)
        np.testing.assert_array_equal(batch.support_points[k], effect.support_points)
        assert batch.outcome[k] == effect.outcome
        assert batch.parameters["tool_friction"][k] == interaction.physics.tool_friction
        corners = batch.corners[k, : batch.num_corners[k]]
        assert np.isnan(batch.corners[k, batch.num_corners[k] :]).all()
        pose = effect.pose_trajectory[0]  # the object still lies flat: a turn about z and a shift
        angle = 2 * np.arctan2(pose[6], pose[3])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        np.testing.assert_allclose(corners, interaction.object.corners @ turn.T + pose[:2], atol=1e-12)
    assert batch.object_ids.tolist() == [interaction.id // 2 for interaction in dataset]


def test_batch_of_interactions_and_of_rows(interactions):
    kept = [interaction for interaction in interactions if interaction.effect.outcome != Outcome.FAILED]
    batch = InteractionBatch.from_interactions([*kept, kept[0]])
    assert batch.object_ids[-1] == batch.object_ids[0] == 0
    assert len(set(batch.object_ids)) == len(kept)
    some = batch[np.array([5, 2])]
    assert some.ids.tolist() == [batch.ids[5], batch.ids[2]]
    np.testing.assert_array_equal(some.com[1], batch.com[2])
    np.testing.assert_array_equal(some.times, batch.times)
    assert len(batch[batch.outcome == "slipped"]) == 2


def test_a_mirrored_batch_is_that_of_the_mirrored_object():
    """As if the mirrored object had been levered."""
    prism = Prism([(0.083, 0.011), (0.017, 0.079), (-0.071, 0.049), (-0.079, -0.043), (0.031, -0.077)], 0.02)
    other = Prism(prism.corners[::-1] * [1, -1], 0.02)
    batch, image = (
        InteractionBatch.from_interactions([simulate(each, LeverUp(contact, direction), embodiment="tool")])
        for each, contact, direction in (
            (prism, (-0.075, 0.003), (1.0, -0.087)),
            (other, (-0.075, -0.003), (1.0, 0.087)),
        )
    )
    found = batch.mirrored()
    np.testing.assert_array_equal(found.mask, image.mask)
    for name in ("height", "support_points", "com"):
        np.testing.assert_allclose(getattr(found, name), getattr(image, name), atol=1e-4, err_msg=name)
    assert {*np.round(found.corners[0], 6).flat} == {*np.round(image.corners[0], 6).flat}
    assert polygon_area(found.corners[0]) > 0
    turned, expected = (quaternion_to_matrix(each.pose[0, -1, 3:]) for each in (found, image))
    np.testing.assert_allclose(turned, expected, atol=0.01)
    for each in fields(batch):
        if each.name != "parameters":
            again, at_first = getattr(found.mirrored(), each.name), getattr(batch, each.name)
            np.testing.assert_array_equal(again, at_first, err_msg=each.name)


def test_batch_refuses_different_sample_times(interactions):
    other = replace(interactions[1].effect, times=interactions[1].effect.times * 2)
    with pytest.raises(DatasetError, match="interaction 1 was sampled at other times"):
        InteractionBatch.from_interactions([interactions[0], replace(interactions[1], effect=other)])


def test_batch_of_views_knows_no_effect(interactions):
    views = [interaction.view for interaction in interactions[:3]]
    batch = InteractionBatch.from_views(views, times=np.arange(4) * 0.05)
    assert batch.com.shape == (3, 4, 3)
    assert np.isnan(batch.com).all()
    assert batch.num_corners.tolist() == [0, 0, 0]
    np.testing.assert_array_equal(batch.mask[2], views[2].mask)
    with_corners = InteractionBatch.from_views(views[:2], corners=[np.zeros((3, 2)), np.ones((5, 2))])
    assert with_corners.corners.shape == (2, 5, 2)
    assert with_corners.num_corners.tolist() == [3, 5]


def test_pandas_and_arrow_access(folder):
    dataset = Dataset.open(folder)
    frame = dataset.to_pandas()
    assert list(frame["id"]) == dataset.table["id"].to_pylist()
    assert frame["com_trajectory"][0].reshape(-1, 3).shape == (60, 3)
    assert dataset.table.schema.equals(storage.SCHEMA)
    assert set(dataset.manifest["columns"]) == set(storage.SCHEMA.names)
    assert dataset.manifest["columns"]["com_trajectory"]["unit"] == "m"


def test_opening_nothing_names_the_folder_and_the_remedy(tmp_path):
    with pytest.raises(DatasetError, match=r"no data set at .*nowhere.*foretrace simulate"):
        Dataset.open(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=r"has no manifest\.json"):
        Dataset.open(tmp_path)


def test_a_manifest_does_not_tell_which_shard_was_finished_first(folder):
    before = (folder / "manifest.json").read_bytes()
    manifest = storage.read_manifest(folder)
    assert len(manifest["shards"]) > 1
    storage.write_manifest(folder, manifest | {"shards": dict(reversed(manifest["shards"].items()))})
    assert (folder / "manifest.json").read_bytes() == before


def test_opening_another_version_or_a_damaged_manifest(folder):
    path = folder / storage.MANIFEST
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps({**manifest, "format_version": 99}))
    with pytest.raises(DatasetError, match="format version 99, this foretrace reads version 2"):
        Dataset.open(folder)
    path.write_text(json.dumps({**manifest, "format": "other"}))
    with pytest.raises(DatasetError, match="does not describe a foretrace-interactions"):
        Dataset.open(folder)
    path.write_text(json.dumps({**manifest, "shards": []}))
    with pytest.raises(DatasetError, match=r"entry shards is \[\], an object is expected"):
        Dataset.open(folder)
    path.write_text(json.dumps({**manifest, "format_version": 1}))
    with pytest.raises(DatasetError, match=r"upgrade it in place with `foretrace data .* --upgrade`"):
        Dataset.open(folder)
    path.write_text(path.read_text()[:50])
    with pytest.raises(DatasetError, match="cannot be read as JSON"):
        Dataset.open(folder)


def flip_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (Path.unlink, r"shard .*shard-00001\.parquet cannot be read.*; repeat the same `foretrace simulate`"),
        (flip_a_bit, r"shard .*shard-00001\.parquet is corrupt.*foretrace data"),
        (lambda path: os.truncate(path, 100), r"shard .*shard-00001\.parquet is corrupt"),
    ],
)
def test_a_missing_or_corrupt_shard_is_named(folder, damage, message):
    damage(folder / storage.shard_name(1))
    with pytest.raises(DatasetError, match=message):
        Dataset.open(folder)


def test_no_other_thread_holds_on_to_a_shard_that_was_read(folder, monkeypatch):
    # Such a thread aborts the process if that ends just then.
    reader, let_go = pa.BufferReader, []

    def watched(content):
        array = np.frombuffer(content, dtype=np.uint8)
        weakref.finalize(array, lambda: let_go.append(threading.current_thread()))
        return reader(array)

    monkeypatch.setattr(storage.pa, "BufferReader", watched)
    for count in range(1, 21):
        storage.read_shard(folder, storage.shard_name(0))
        assert let_go == [threading.main_thread()] * count


def test_a_shard_of_another_schema_is_refused(folder):
    table, _ = storage.read_shard(folder, storage.shard_name(0))
    name = storage.shard_name(0)
    entry = shards.write_shard(folder, name, table.drop_columns(["height"]))
    with pytest.raises(DatasetError, match=r"another schema \(differs in height\)"):
        storage.read_shard(folder, name, entry["sha256"])


def test_an_unfinished_data_set_opens_with_a_warning(folder):
    manifest = storage.read_manifest(folder)
    del manifest["shards"][storage.shard_name(2)]
    storage.write_manifest(folder, manifest)
    with pytest.warns(UserWarning, match="1 of 3 shards are missing"):
        assert len(Dataset.open(folder)) == 15


def test_doctor_finds_nothing_in_a_sound_data_set(folder):
    diagnosis = examine(folder)
    assert diagnosis.findings == ()
    assert diagnosis.num_interactions == 20
    assert diagnosis.outcomes == {"levered": 17, "slipped": 2, "failed": 1}


def test_doctor_repairs_what_can_be_repaired(folder):
    flip_a_bit(folder / storage.shard_name(1))
    (folder / storage.SHARD_FOLDER / f".shard-00002.parquet.123{PARTIAL}").write_bytes(b"half")
    manifest = storage.read_manifest(folder)
    checksum = manifest["shards"].pop(storage.shard_name(0))
    storage.write_manifest(folder, manifest)

    found = examine(folder)
    assert [f.repaired for f in found.findings] == [False] * len(found.findings)
    assert storage.read_manifest(folder) == manifest, "without --repair nothing changes"

    repaired = examine(folder, repair=True)
    assert {f.file.replace("/.", "/").split(".")[0] for f in repaired.findings if f.repaired} == {
        "shards/shard-00000",
        "shards/shard-00001",
        "shards/shard-00002",
    }
    left = [f for f in repaired.findings if not f.repaired]
    assert [f.file for f in left] == [storage.shard_name(1)]
    assert "simulate" in left[0].problem
    assert not list(folder.rglob(f"*{PARTIAL}"))
    assert storage.read_manifest(folder)["shards"][storage.shard_name(0)] == checksum
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert len(Dataset.open(folder)) == 12
    assert [f.file for f in examine(folder).findings] == [storage.shard_name(1)]


def rewrite(folder: Path, index: int, column: str, change) -> None:
    """Put a changed column into a shard, with a good checksum."""
    name = storage.shard_name(index)
    table, _ = storage.read_shard(folder, name)
    k = storage.SCHEMA.get_field_index(column)
    values = pa.array(change(table[column].to_pylist()), type=storage.SCHEMA.field(column).type)
    manifest = storage.read_manifest(folder)
    manifest["shards"][name] = shards.write_shard(folder, name, table.set_column(k, column, values))
    storage.write_manifest(folder, manifest)


def spoil_quaternion(rows):
    rows[0][3] += 0.1
    return rows


def spoil_number(rows):
    rows[2][-1] = float("nan")
    return rows


@pytest.mark.parametrize(
    ("column", "change", "problem"),
    [
        ("pose_trajectory", spoil_quaternion, "interaction 8: a quaternion of pose_trajectory has a norm"),
        ("com_trajectory", spoil_number, "interaction 10: com_trajectory holds NaN"),
        ("com_trajectory", lambda rows: [rows[0][:-1], *rows[1:]], "interaction 8: com_trajectory has 179"),
        ("times", lambda rows: [rows[0][::-1], *rows[1:]], "interaction 8: its times do not rise"),
        ("outcome", lambda rows: ["gone", *rows[1:]], "unknown outcome 'gone'"),
        ("density", lambda rows: [None, *rows[1:]], "interaction 8: density is missing"),
        ("id", lambda rows: [3, *rows[1:]], "duplicate ids [3]"),
        ("id", lambda rows: [100, *rows[1:]], "its ids do not run from 8 on without gaps"),
    ],
)
def test_doctor_finds_unsound_rows(folder, column, change, problem):
    rewrite(folder, 1, column, change)
    problems = [f.problem for f in examine(folder).findings if f.file == storage.shard_name(1)]
    assert any(problem in found for found in problems), problems


def test_only_one_process_writes(folder):
    with sole_writer(folder, DatasetError), pytest.raises(DatasetError, match="another foretrace writes to"):
        examine(folder, repair=True)


def test_two_thousand_rows_open_within_a_second(tmp_path, interactions):
    many = [replace(interactions[k % 10], id=k) for k in range(2000)]
    write_dataset(tmp_path / "many", many, shard_size=100)
    begun = time.process_time()  # what else the machine does is not counted
    dataset = Dataset.open(tmp_path / "many")
    seconds = time.process_time() - begun
    assert len(dataset) == 2000
    assert seconds < 1.0
