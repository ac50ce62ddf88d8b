import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from factories import besides_doubt, fake_batch
from foretrace.actions import LeverUp
from foretrace.errors import CheckpointError, PredictionError
from foretrace.imagined.domain import check_view, find_unusual, measure, ranges_of
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Box, Prism, sample_prism
from foretrace.predictor import OneShotConfig, TrainConfig, load_predictor, train_predictor

CONFIG = OneShotConfig(hidden=8, outcomes=("levered", "slipped"))
QUICK = TrainConfig(epochs=1, min_steps=1, split=None, learning_rate=4e-3)


@pytest.fixture(autouse=True, scope="module")
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def view() -> TopDownView:
    box = Box(0.1, 0.08, 0.03)
    return TopDownView.of(box, LeverUp.at_edge(box, 0))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    batch = fake_batch(np.random.default_rng(0), 24, num_samples=24)
    return train_predictor(batch, CONFIG, tmp_path_factory.mktemp("domain") / "run", QUICK, progress=False)


@pytest.fixture(scope="module")
def usual() -> TopDownView:
    """An object as in the training."""
    box = Box(0.15, 0.14, 0.02)
    return TopDownView.of(box, LeverUp.at_edge(box, 0))


def shifted(view: TopDownView, rows: int, columns: int = 0) -> TopDownView:
    """The object further down and further right in the picture."""
    mask, height = (np.roll(picture, (rows, columns), (0, 1)) for picture in (view.mask, view.height))
    return TopDownView(mask, height)


def with_height(view: TopDownView, row: int, column: int, height: float) -> TopDownView:
    heights = view.height.copy()
    heights[row, column] = height
    return TopDownView(view.mask, heights)


def test_views_of_levered_objects_are_fine(view):
    check_view(view)
    rng = np.random.default_rng(0)
    for k in range(40):
        prism = sample_prism(rng, 3 + k % 8)
        check_view(TopDownView.of(prism, LeverUp.at_edge(prism, 0, rng.uniform(0.1, 0.9))))


NONSENSE = {
    "the view's mask is empty": lambda view: TopDownView(
        np.zeros((128, 128), dtype=bool), np.zeros((128, 128))
    ),
    "touches the border": lambda view: shifted(view, 0, 64 - 13),
    "is not finite": lambda view: with_height(view, 80, 64, np.nan),
    r"-0.0100 m, below the table": lambda view: with_height(view, 80, 64, -0.01),
    r"heights up to 0.0500 m outside the mask": lambda view: with_height(view, 10, 10, 0.05),
    "shows 2 objects": lambda view: replace(
        view, mask=view.mask | shifted(view, -45).mask, height=view.height + shifted(view, -45).height
    ),
    r"lies behind the contact point, its middle by 5.\d cm": lambda view: shifted(view, 29),
    r"contact point is 3.\d cm from the object": lambda view: shifted(view, -10),
    "lies in the object": lambda view: shifted(view, 9),
}


@pytest.mark.parametrize("message", NONSENSE)
def test_nonsense_is_refused(view, message):
    with pytest.raises(PredictionError, match=message):
        check_view(NONSENSE[message](view))


def test_a_contact_in_a_dent_may_have_the_middle_behind_it():
    corners = [(-6, -5), (6, -5), (6, 5), (4, 5), (4, -3), (-4, -3), (-4, 5), (-6, 5)]
    bracket = Prism(0.01 * np.array(corners, dtype=float), 0.01)
    action = LeverUp.nearest(bracket, (0.0, -0.03))
    check_view(TopDownView.of(bracket, action))
    middle = bracket.mass_properties(1.0).com[:2]
    assert (middle - action.contact) @ action.direction < -0.01


def test_small_spots_and_inexact_contacts_are_fine(view):
    mask, height = view.mask.copy(), view.height.copy()
    mask[20:23, 20:23] = True
    height[20:23, 20:23] = 0.005
    check_view(TopDownView(mask, height))
    for rows in (-5, 5):
        check_view(shifted(view, rows))


def test_measures_are_those_of_the_object(view):
    batch = InteractionBatch.from_views([view])
    measures = measure(batch, np.array([[0.03, 0.04, 0.015]]))
    box = {"area": 0.008, "length": 0.08, "width": 0.1, "height": 0.03, "distance": 0.05}
    for name, value in box.items():
        assert measures[name][0] == pytest.approx(value, rel=0.05)


def test_an_object_unlike_those_learned_from_is_pointed_out(run, usual):
    predictor = load_predictor(run)
    assert besides_doubt(predictor.imagine(usual).warnings) == ()
    large = Box(0.28, 0.26, 0.09)
    said = besides_doubt(predictor.imagine(TopDownView.of(large, LeverUp.at_edge(large, 0))).warnings)
    names = {line.split()[0] for line in said}
    assert names == {"area", "length", "width", "height", "distance"}
    assert any(line.startswith("height 9 cm is far outside") for line in said)


def test_each_row_of_a_batch_has_its_own_warnings(run, usual):
    predictor = load_predictor(run)
    box = Box(0.15, 0.14, 0.12)
    high = TopDownView.of(box, LeverUp.at_edge(box, 0))
    imagined = predictor.imagine_batch(InteractionBatch.from_views([usual, high]), "estimated")
    assert [one.warnings for one in (imagined[0], imagined[1])] == list(imagined.warnings)
    assert besides_doubt(imagined[0].warnings) == ()
    assert len(besides_doubt(imagined[1].warnings)) == 1
    assert imagined[1].warnings[0].startswith("height 12 cm is far outside what was learned from, ")


def test_ranges_are_the_training_parts_and_kept(run):
    batch = fake_batch(np.random.default_rng(0), 24, num_samples=24)
    split = json.loads((run / "split.json").read_text())
    part = batch[np.isin(batch.ids, split["train"])]
    ranges = load_predictor(run).ranges
    assert ranges["height"] == pytest.approx(np.quantile(part.height.max(axis=(1, 2)), (0.01, 0.99)))
    assert ranges["area"][0] > 0.001
    assert 3 <= ranges["corners"][0] < ranges["corners"][1] <= 11
    # The same training again is the same training; and whole already.
    before = (run / "config.json").read_text()
    train_predictor(batch, CONFIG, run, QUICK, progress=False)
    assert (run / "config.json").read_text() == before


def test_a_checkpoint_without_ranges_warns_of_nothing(run, view, tmp_path):
    config = json.loads((run / "config.json").read_text())
    del config["ranges"]
    (tmp_path / "config.json").write_text(json.dumps(config))
    (tmp_path / "model.safetensors").write_bytes((run / "model.safetensors").read_bytes())
    predictor = load_predictor(tmp_path)
    assert not predictor.ranges
    assert besides_doubt(predictor.imagine(view).warnings) == ()
    (tmp_path / "config.json").write_text(json.dumps(config | {"ranges": {"area": 3}}))
    with pytest.raises(CheckpointError, match=r"entry ranges\.area is 3, a list is expected"):
        load_predictor(tmp_path)


def test_unusual_is_what_is_far_outside():
    ranges = ranges_of({"area": np.linspace(0.01, 0.02, 101), "height": np.full(101, 0.02)})
    assert ranges["area"] == pytest.approx((0.0101, 0.0199))
    measures = {
        "area": np.array([0.008, 0.007, 0.0222, 0.0225]),
        "height": np.array([0.02, 0.0215, 0.03, 0.02]),
    }
    told = [[line.split()[0] for line in row] for row in find_unusual(measures, ranges)]
    assert told == [[], ["area"], ["height"], ["area"]]
