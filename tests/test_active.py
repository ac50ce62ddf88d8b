import numpy as np
import pytest
import torch

from foretrace.cli import main
from foretrace.cli.active import _learner
from foretrace.errors import PredictionError
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.splits import Split
from foretrace.predictor import OneShotConfig, TrainConfig, fit_predictor
from foretrace.predictor.active import _farthest, choose_actions
from foretrace.predictor.one_shot import OneShotPredictor
from foretrace.simulation.collect import CollectConfig, planned_trial, simulate_trial, trial
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.randomisation import RANDOMISED

BLADE = SimulationConfig(embodiment="tool")


@pytest.fixture(scope="module")
def batch() -> InteractionBatch:
    config = CollectConfig(objects=4, simulation=BLADE)
    return InteractionBatch.from_interactions([simulate_trial(config, id) for id in range(30)])


@pytest.fixture(scope="module")
def predictor(batch: InteractionBatch) -> OneShotPredictor:
    rows = np.arange(len(batch))
    config = OneShotConfig(hidden=16, layers=2, ensemble=2, components=6, outcomes=("levered", "slipped"))
    split = Split(rows[:20], rows[20:], rows[:0])
    made, _ = fit_predictor(batch, config, split, TrainConfig(epochs=20, min_steps=40))
    assert isinstance(made, OneShotPredictor)
    return made


def test_the_farthest_action_of_the_widest_cluster_is_next():
    known = torch.tensor([[[0.0, 0.0]], [[10.0, 0.0]]])
    others = torch.tensor([[[0.0, 2.0]], [[0.0, 1.0]], [[10.0, 2.1]], [[10.0, 0.1]], [[0.0, 1.9]]])
    # About the first: 4 + 1 + 3.61, about the second: 4.41 + 0.01. The one farthest of all is only third.
    assert _farthest(known, others, 3).tolist() == [0, 2, 1]


def test_mirror_images_are_no_other_actions():
    known = torch.tensor([[[1.0, 0.0], [-1.0, 0.0]]])
    others = torch.tensor([[[-1.0, 0.0], [1.0, 0.0]], [[0.5, 0.0], [-0.5, 0.0]]])
    assert _farthest(known, others, 1).tolist() == [1]


def test_actions_that_were_learned_from_are_chosen_last(predictor, batch):
    learned, candidates = batch[:10], batch[:20]
    chosen = choose_actions(predictor, learned, candidates, 20)
    assert sorted(chosen) == list(range(20))
    assert set(chosen[:10]) == set(range(10, 20))


def test_what_is_chosen_does_not_depend_on_effects_or_the_order_of_what_was_learned(predictor, batch):
    config = CollectConfig(objects=4, simulation=BLADE)
    at_rest = InteractionBatch.from_interactions(
        [planned_trial(config, id).at_rest() for id in range(10, 30)]
    )
    expected = choose_actions(predictor, batch[:10], batch[10:], 6)
    np.testing.assert_array_equal(choose_actions(predictor, batch[:10], at_rest, 6), expected)
    assert set(choose_actions(predictor, batch[np.arange(10)[::-1]], batch[10:], 6)) == set(expected)


def test_a_trial_at_rest_is_the_first_sample_of_what_is_simulated():
    config = CollectConfig(objects=4, simulation=BLADE, randomisation=RANDOMISED)
    for id in (0, 7):
        rest, played = planned_trial(config, id).at_rest(), simulate_trial(config, id)
        np.testing.assert_allclose(rest.effect.com_trajectory, played.effect.com_trajectory[:1], atol=1e-6)
        np.testing.assert_allclose(rest.effect.pose_trajectory, played.effect.pose_trajectory[:1], atol=1e-6)
        np.testing.assert_array_equal(rest.view.mask, played.view.mask)
        one, other = (InteractionBatch.from_interactions([each]) for each in (rest, played))
        np.testing.assert_array_equal(one.execution, other.execution)
        np.testing.assert_array_equal(one.bevel, other.bevel)
        np.testing.assert_equal(one.parameters, other.parameters)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"learned": 0}, "learned holds no actions"),
        ({"candidates": 0}, "candidates holds no actions"),
        ({"count": 21}, "count is 21: give a whole number from 1 to 20"),
        ({"count": 0}, "count is 0"),
    ],
)
def test_mistakes_are_named(predictor, batch, change, message):
    given = {"learned": 10, "candidates": 20, "count": 2} | change
    with pytest.raises(PredictionError, match=message):
        choose_actions(
            predictor, batch[: given["learned"]], batch[10 : 10 + given["candidates"]], given["count"]
        )


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("foretrace.cli.active.TRAINING", TrainConfig(epochs=1, min_steps=1))
    monkeypatch.setattr("foretrace.cli.active.CANDIDATES", 30)


def test_a_command_simulates_what_it_chooses_and_goes_on(quick, tmp_path, capsys):
    words = [
        "simulate",
        "--out",
        str(tmp_path / "data"),
        "--objects",
        "17",
        "--embodiment",
        "tool",
        "--seed",
        "3",
    ]
    assert main([*words, "--active", "120", "--workers", "1"]) == 0
    first = Dataset.open(tmp_path / "data")
    trials = first.manifest["configuration"]["trials"]
    assert len(first) == len(set(trials)) == 120
    config = CollectConfig(objects=17, simulation=BLADE, seed=3)
    again = simulate_trial(config, trials[110])
    np.testing.assert_array_equal(first[110].effect.pose_trajectory, again.effect.pose_trajectory)
    assert main([*words, "--active", "120", "--workers", "1"]) == 0
    assert Dataset.open(tmp_path / "data").manifest["configuration"]["trials"] == trials
    capsys.readouterr()
    for number, message in (
        (110, "has 120 chosen lever-ups"),
        (100, "--active is 100"),
        (9999, "--active is 9999"),
    ):
        assert main([*words, "--active", str(number)]) == 2
        assert message in capsys.readouterr().err
    assert main(words) == 2
    assert "was begun with trials" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "context"),
    [
        ("", ()),
        ("--vary-action", ("insertion", "arc_radius", "sweep", "speed")),
        (
            "--randomise",
            ("friction", "tool_friction", "density", "bevel_width", "bevel_height", "contact_error"),
        ),
        ("--recipe pushes --vary-action", ("distance",)),
    ],
)
def test_what_varies_is_told_to_the_predictor_that_chooses(words, context, monkeypatch, tmp_path):
    found = []

    def told(config, *_):
        found.append(_learner(config, trial(config, 0)[1].outcomes).context)
        return {"levered": 1}

    monkeypatch.setattr("foretrace.cli.active.collect_actively", told)
    common = ["--embodiment", "tool", "--objects", "20", "--active", "120"]
    assert main(["simulate", "--out", str(tmp_path / "data"), *common, *words.split()]) == 0
    assert found == [context]
