"""Values of another type, size or shape at the doors of the Python interface: one table for each kind of error."""

# pyright: reportArgumentType=false

import json
import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import foretrace as ft
from factories import fake_batch, fake_interaction
from foretrace.actions import Rod
from foretrace.errors import (
    ActionError,
    DatasetError,
    PerceptionError,
    PredictionError,
    ShapeError,
    SimulationError,
    TrainingError,
    ViewError,
)
from foretrace.interactions.dataset import RowError
from foretrace.interactions.splits import (
    Split,
    scaled_sizes,
    split_by_corner_count,
    split_by_object,
    split_by_seed,
)
from foretrace.perception.board import Board
from foretrace.perception.importing import ImportConfig
from foretrace.perception.photo import PhotoConfig
from foretrace.predictor import EffectPredictor, PredictorConfig, fit_predictor
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.simulation.recording import RecordingConfig

pytestmark = pytest.mark.usefixtures("untyped")
BOX = ft.Box(0.15, 0.14, 0.02)
ACTION = ft.LeverUp.at_edge(BOX, 0)
VIEW = ft.TopDownView.of(BOX, ACTION)
MASK = np.pad(np.ones((60, 60)), 20)
PATH = ft.ToolPath()
LSTM = ft.LstmConfig(features="none", hidden=4)
LOOP = ft.TrainConfig(epochs=1, min_steps=1, split=None, threads=1)


def simulate(obj=BOX, action=ACTION, **settings):
    return ft.simulate(obj, action, **({"embodiment": "tool"} | settings))


def physics(**values):
    return lambda: simulate(physics=ft.Physics(**values))


REFUSED = {
    ActionError: {
        "direction [1e+200, 1e+200] is too long": lambda: ft.LeverUp((0, 0), (1e200, 1e200)),
        "contact [1e+300, 0.0] lies 1e+300 m away": lambda: ft.LeverUp((1e300, 0), (1, 0)),
        "contact Box(": lambda: ft.LeverUp(BOX, (1, 0)),
        "edge 1.5 of an object with 4 edges": lambda: ft.LeverUp.at_edge(BOX, 1.5),
        "edge True of": lambda: ft.LeverUp.at_edge(BOX, True),
        "fraction 'half' of an edge": lambda: ft.LeverUp.at_edge(BOX, 0, "half"),
        "obj of type TopDownView: give ObjectModel": lambda: ft.LeverUp.at_edge(VIEW, 0),
        "obj of type NoneType": lambda: ft.LeverUp.nearest(None, (0, 0)),
        "ahead is 'a': give a number": lambda: ACTION.moved("a", 0, 0),
        "action of type str": lambda: ft.LeverUp.from_dict("lever-up"),
        "tool = Rod(length=0.17, radius=0.006): give a Screwdriver": lambda: ft.LeverUp.from_dict(
            ACTION.to_dict() | {"tool": Rod().to_dict()}
        ),
        "tool of type list": lambda: ft.LeverUp.from_dict(ACTION.to_dict() | {"tool": [1]}),
        "sweep = True is outside": lambda: ft.ToolPath(sweep=True),
        "sweep = nan is outside": lambda: ft.ToolPath(sweep=np.nan),
        "insertion = 'x' is outside": lambda: ft.ToolPath(insertion="x"),
        "speed = 'fast' times": lambda: PATH.faster("fast"),
        "speed = nan times": lambda: PATH.faster(np.nan),
        "action of type str: give a LeverUp": lambda: simulate(action="lever-up"),
        "lies 625.0 mm from the object's outline": lambda: simulate(action=ft.LeverUp((0.7, 0), (-1, 0))),
    },
    ViewError: {
        "scale of 'x' m per pixel": lambda: ft.TopDownView(VIEW.mask, VIEW.height, "x"),
        "scale of 1e-09 m": lambda: ft.TopDownView(VIEW.mask, VIEW.height, 1e-9),
        "scale of True m": lambda: ft.TopDownView(VIEW.mask, VIEW.height, True),
        "height is 'x': give an array": lambda: ft.TopDownView(VIEW.mask, "x"),
        "values that are NaN": lambda: ft.TopDownView(np.where(VIEW.mask, 1, np.nan), VIEW.height),
        "obj of type LeverUp": lambda: ft.TopDownView.of(ACTION, BOX),
        "action of type str": lambda: ft.TopDownView.of(BOX, "lever-up"),
        "mask of type str": lambda: ft.TopDownView.from_mask("mask.png", 1e-3, (0, 0.03), (0, -1)),
        "scale of None m": lambda: ft.TopDownView.from_mask(MASK, None, (0, 0.03), (0, -1)),
        "height is nan": lambda: ft.TopDownView.from_mask(MASK, 1e-3, (0, 0.03), (0, -1), np.nan),
        "points of shape (4, 2)": lambda: ft.TopDownView.from_points(np.zeros((4, 2))),
        "points of shape ()": lambda: ft.TopDownView.from_points("cloud"),
    },
    ShapeError: {
        "height is '2 cm'": lambda: ft.Prism(BOX.corners, "2 cm"),
        "bevel of type float: give Bevel": lambda: ft.Prism(BOX.corners, 0.02, 0.003),
        "bevel of 'x' x 0": lambda: ft.Bevel("x", 0),
        "seed is -1": lambda: ft.paper_objects(-1),
        "rng of type int: give Generator": lambda: ft.sample_prism(0, 5),
        "polygon with '5' corners": lambda: ft.sample_prism(np.random.default_rng(0), "5"),
    },
    SimulationError: {
        "obj of type str": lambda: simulate(obj="box"),
        "physics of type dict: give Physics": lambda: simulate(physics={"friction": 0.5}),
        "friction is 'x': give a number": physics(friction="x"),
        "density is [1]: give a number": physics(density=[1]),
        "friction = nan is outside": physics(friction=np.nan),
        "timestep is None": lambda: simulate(timestep=None),
        "timestep = 1e-09 s and": lambda: simulate(timestep=1e-9),
        "timestep = 0.003 s does not divide 0.05 s": lambda: simulate(timestep=0.003),
        "engine of type list": lambda: simulate(engine=[]),
        "seed is -1: give a whole number": lambda: simulate(seed=-1),
        "config of type dict": lambda: ft.simulate_lever_up(BOX, ACTION, {}),
        "execution_error of type tuple": lambda: ft.simulate_lever_up(BOX, ACTION, execution_error=(0, 0, 0)),
        "interaction of type str": lambda: ft.replay("interaction"),
        "table_side = nan is outside": lambda: RecordingConfig(table_side=np.nan),
        "largest_side = -1 is outside": lambda: RecordingConfig(largest_side=-1),
        "table is nan: choose from plain": lambda: RecordingConfig(table=np.nan),
        "objects is 1.5: give a whole number": lambda: CollectConfig(objects=1.5),
        "path of type NoneType": lambda: CollectConfig(path=None),
        "config of type NoneType": lambda: collect(None, "out"),
        "workers is 'x'": lambda: collect(CollectConfig(objects=8), "out", "x"),
    },
    TrainingError: {
        "outcomes is 3": lambda: ft.TrainConfig(outcomes=3),
        "unknown outcome 'leverd'": lambda: ft.TrainConfig(outcomes=("leverd",)),
        "'levered' is named twice": lambda: ft.TrainConfig(outcomes=("levered", "levered")),
        "split is {1, 2, 3}": lambda: ft.TrainConfig(split={1, 2, 3}),
        "split is (1, 2)": lambda: ft.TrainConfig(split=(1, 2)),
        "device is 'gpu'": lambda: ft.TrainConfig(device="gpu"),
        "precision is 'fp16'": lambda: ft.TrainConfig(precision="fp16"),
        "learning_rate is inf": lambda: ft.TrainConfig(learning_rate=np.inf),
        "learning_rate is 1e+308": lambda: ft.TrainConfig(learning_rate=1e308),
        "batch of type str: give InteractionBatch": lambda: fit_predictor("few", LSTM, None),
        "split of type NoneType: give Split": lambda: fit_predictor(
            fake_batch(np.random.default_rng(0), 4), LSTM, None
        ),
        "state is 'poses'": lambda: ft.LstmConfig(state="poses"),
        "residual is 'no'": lambda: ft.LstmConfig(residual="no"),
        "mirrored is None": lambda: ft.OneShotConfig(mirrored=None),
        "context is 3": lambda: ft.LstmConfig(context=3),
        "feature_options of type list": lambda: ft.LstmConfig(feature_options=[1]),
        "num_samples is 'x'": lambda: LSTM.make("x"),
        "n of type InteractionBatch: give the number": lambda: split_by_seed(ft.InteractionBatch.from_views([VIEW]), 0),
        "n is 30.5": lambda: split_by_seed(30.5, 0, None),
        "seed is -1: give a whole number": lambda: split_by_seed(30, -1, None),
        "sizes is 3: give the sizes of three parts": lambda: split_by_seed(30, 0, 3),
        "sizes is (3, 4)": lambda: split_by_seed(30, 0, (3, 4)),
        "a part's size is 3.5": lambda: split_by_seed(30, 0, (3.5, 4, 1)),
        "shares of a split are (0.5, 0.5)": lambda: scaled_sizes(10, (0.5, 0.5)),
        "object_ids of type int": lambda: split_by_object(3, 0),
        "num_corners of type str": lambda: split_by_corner_count("3", (3,)),
        "PredictorConfig makes no predictor": lambda: PredictorConfig().make(9),
    },
    DatasetError: {
        "None is no path": lambda: ft.Dataset.open(None),
        "interactions of type Interaction": lambda: ft.InteractionBatch.from_interactions(
            fake_interaction(np.random.default_rng(0), 0)
        ),
        "interaction 0 of type str": lambda: ft.InteractionBatch.from_interactions(["x"]),
        "views of type TopDownView": lambda: ft.InteractionBatch.from_views(VIEW),
        "failed of type list: give True or False": lambda: ft.Dataset.open("data", failed=[]),
    },
    PerceptionError: {
        "hull is nan: give True or False": lambda: PhotoConfig(hull=np.nan),
        "shadows is 1: give True or False": lambda: ImportConfig(shadows=1),
        "inverted is '': give True or False": lambda: Board(inverted=""),
        "height is 1e+200: give metres": lambda: PhotoConfig(height=1e200),
        "height is '2 cm': give metres": lambda: ImportConfig(height="2 cm"),
        "sample_period = -1 is outside": lambda: ImportConfig(sample_period=-1),
        "start = array([], dtype=float64) is outside": lambda: ImportConfig(start=np.array([])),
        "start = 1e+308 is outside": lambda: ImportConfig(start=1e308),
    },
    PredictionError: {
        "shared of type NoneType: give names of constants": lambda: ft.Belief().of_another_object(None),
        "shared of type str: give names of constants": lambda: ft.Belief().of_another_object("friction"),
        "context is 'nominal': give values by name": lambda: ft.load_predictor().imagine(VIEW, context="nominal"),
        "start is array([0., 0.]): choose from": lambda: ft.load_predictor().imagine_batch(
            ft.InteractionBatch.from_views([VIEW]), np.zeros(2)
        ),
    },
}  # fmt: skip
ROWS = [(error, message) for error, table in REFUSED.items() for message in table]


def check(error, message, call):
    with pytest.raises(error) as caught:
        call()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("error", "message"), ROWS, ids=[message for _, message in ROWS])
def test_bad_values_are_refused_in_one_line(error, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check(error, message, REFUSED[error][message])
    assert not list(tmp_path.iterdir())


def split(**rows):
    parts = {"train": np.arange(4), "validation": np.arange(4), "test": np.arange(0)}
    return Split(**(parts | rows))


TRAININGS = {
    "predictor of type TrainConfig": {"predictor": LOOP},
    "predictor of type str": {"predictor": "lstm"},
    "training of type dict": {"training": {"epochs": 1}},
    "data of type str: give InteractionBatch or Dataset": {"data": "data"},
    "None is no path": {"out": None},
    "cannot be made (": {"out": "file/run"},
    "split of type tuple": {"split": (1, 2, 3)},
    "train part of the split is empty": {"split": lambda: split(train=np.arange(0))},
    "train part of the split has row 99: the data have 8 rows": {
        "split": lambda: split(train=np.array([99]))
    },
    "test part of the split has row -1": {"split": lambda: split(test=np.array([-1]))},
    "validation part of the split is array([0.5])": {"split": lambda: split(validation=np.array([0.5]))},
}


@pytest.mark.parametrize("message", TRAININGS)
def test_bad_trainings_are_refused_in_one_line(message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    batch = fake_batch(np.random.default_rng(0), 8)
    given = {"data": batch, "predictor": LSTM, "out": "run", "training": LOOP, "progress": False}
    given |= {name: value() if callable(value) else value for name, value in TRAININGS[message].items()}
    check(TrainingError, message, lambda: ft.train_predictor(**given))


def test_a_predictor_needs_a_config_of_its_own(registered):
    with pytest.raises(TypeError, match="needs a label and a config_class of its own"):

        class Borrowed(EffectPredictor):
            label = "borrowed"
            config_class = PredictorConfig

    assert not hasattr(PredictorConfig, "predictor_class")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "data"
    collect(CollectConfig(1, 1, simulation=ft.SimulationConfig(embodiment="tool")), folder, workers=1)
    return ft.Dataset.open(folder)


SELECTIONS = {
    "1.5 chooses no rows": lambda data: data[1.5],
    "'x' chooses no rows": lambda data: data["x"],
    "None chooses no rows": lambda data: data[None],
    "True chooses no rows": lambda data: data[True],
    "there is no row 99": lambda data: data[99],
    "[99] chooses no rows": lambda data: data[[99]],
    "array([ True, False]) chooses no rows": lambda data: data[np.array([True, False])],
    "no outcome 'leverd': choose from levered": lambda data: data.where(outcome="leverd"),
    "no column 'outcom' to filter by: choose from outcome": lambda data: data.where(outcom="levered"),
    "id of type list: give a whole number": lambda data: data.with_id([0]),
    "the function for num_corners ends with KeyError": lambda data: data.where(num_corners=lambda n: {}[0]),
    "num_corners is compared with 'x': give a number": lambda data: data.where(num_corners="x"),
    "num_corners is compared with None": lambda data: data.where(num_corners=None),
    "the function for num_corners returns": lambda data: data.where(num_corners=lambda n: [True, False]),
    "size of a batch is 0": lambda data: list(data.batches(0)),
}


@pytest.mark.parametrize("message", SELECTIONS)
def test_bad_selections_are_refused_in_one_line(message, dataset):
    check(DatasetError, message, lambda: SELECTIONS[message](dataset))


def test_rows_that_are_not_there_end_a_loop_as_ever(dataset):
    assert issubclass(RowError, IndexError)
    with pytest.raises(RowError, match="chooses no rows of 3"):
        dataset.batch()["x"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"shards": {"shards/shard-00000.parquet": None}},
            "entry shards.shards/shard-00000.parquet is null, an object",
        ),
        (
            {"shards": {"shards/shard-00000.parquet": {"sha256": 3}}},
            "00000.parquet.sha256 is 3, a text or null",
        ),
        ({"shard_size": 0}, "entry shard_size is 0, a whole number from 1 is expected"),
        ({"num_trials": -1}, "entry num_trials is -1, a whole number from 0 is expected"),
    ],
)
def test_a_damaged_manifest_is_refused_in_one_line(changes, message, dataset, tmp_path):
    folder = shutil.copytree(dataset.path, tmp_path / "data")
    manifest = json.loads((folder / "manifest.json").read_text()) | changes
    (folder / "manifest.json").write_text(json.dumps(manifest))
    check(DatasetError, message, lambda: ft.Dataset.open(folder))


def test_an_effect_of_an_object_elsewhere_is_refused():
    effect = fake_interaction(np.random.default_rng(0), 0).effect
    moved = replace(effect, com_trajectory=effect.com_trajectory + np.array([0.3, 0.0, 0.0]))
    with pytest.raises(ft.ForetraceError, match="cm outside the object in the view"):
        ft.load_predictor().imagine(VIEW, observed=moved)


def test_one_row_of_a_batch_is_a_batch():
    batch = fake_batch(np.random.default_rng(0), 4)
    assert [len(row) for row in batch] == [1, 1, 1, 1]
    np.testing.assert_array_equal(batch[-1].com, batch.com[3:])
    check(DatasetError, "[4] chooses no rows of 4", lambda: batch[4])
    check(DatasetError, "slice('a', None, None) chooses no rows", lambda: batch["a":])


WRONG: tuple[Any, ...] = (None, 3.5, "x", [1], object(), np.zeros(3), int, {"a": 1}, b"x", (k for k in "ab"))
DOORS = {
    "outline": lambda value: ft.Prism(value),
    "mesh": lambda value: ft.MeshObject.load(value),
    "contact": lambda value: ft.LeverUp(value, (1, 0)),
    "point": lambda value: ft.LeverUp.nearest(BOX, value),
    "described action": lambda value: ft.LeverUp.from_dict(value),
    "mask": lambda value: ft.TopDownView(value, VIEW.height),
    "scale": lambda value: ft.TopDownView(
        VIEW.mask, VIEW.height, None if isinstance(value, float) else value
    ),
    "data set": lambda value: ft.Dataset.open(value),
    "views": lambda value: ft.InteractionBatch.from_views(value),
    "corners": lambda value: ft.InteractionBatch.from_views(
        [VIEW], corners=value if value is not None else 1
    ),
    "motion": lambda value: ft.ObservedMotion(value, value),
    "epochs": lambda value: ft.TrainConfig(epochs=value),
    "device": lambda value: ft.TrainConfig(device=value),
    "simulated": lambda value: simulate(obj=value),
}


@pytest.mark.parametrize("door", DOORS)
def test_no_wrong_type_passes_a_door(door, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    types = set()
    for value in WRONG:
        with pytest.raises(ft.ForetraceError) as caught:
            DOORS[door](value)
        assert "\n" not in str(caught.value)
        types.add(isinstance(caught.value, TypeError))
    assert True in types
