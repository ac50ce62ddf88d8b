from dataclasses import replace

import numpy as np
import pytest
import torch

from factories import fake_batch
from foretrace.errors import TrainingError
from foretrace.experiments.support_points import CHOICES, support_point_metrics
from foretrace.interactions.splits import Split

QUICK = {"epochs": 8, "batch_size": 8, "snapped": False}
AT_CONTACT = {"setback": 0.0, "half_width": 0.0}
"""The synthetic objects are lifted at the contact point itself."""
SPLIT = Split(np.arange(0, 60), np.arange(60, 70), np.arange(70, 110))


@pytest.fixture(scope="module")
def batch():
    """Objects of 3 to 10 corners that turn about the edge that the closed form names."""
    torch.set_num_threads(1)
    return fake_batch(np.random.default_rng(3), 110, num_samples=12)


def with_points(batch, rows, points):
    changed = batch.support_points.copy()
    changed[rows] = points
    return replace(batch, support_points=changed)


def test_the_rule_is_right_where_objects_follow_it(batch):
    wrong = SPLIT.test[batch.num_corners[SPLIT.test] == 4]
    levered = np.array([corners[np.linalg.norm(corners, axis=1).argsort()[:2]] for corners in batch.corners])
    metrics = support_point_metrics(
        "sp-rule", with_points(batch, wrong, levered[wrong]), SPLIT, 0, **AT_CONTACT
    )
    assert set(metrics) == {"accuracy", "accuracy_from_mask", "accuracy_balanced"} | {
        f"accuracy_{n}" for n in range(3, 11)
    }
    assert metrics["accuracy"] == pytest.approx(35 / 40)
    assert metrics["accuracy_4"] == 0
    assert metrics["accuracy_7"] == 1
    assert metrics["accuracy_balanced"] == pytest.approx(7 / 8)
    assert 0.7 < metrics["accuracy_from_mask"] <= 35 / 40


def test_chance_draws_an_edge_but_the_levered_one(batch):
    metrics = support_point_metrics("chance", batch, SPLIT, seed=0)
    for n in range(3, 11):
        assert metrics[f"accuracy_{n}"] == pytest.approx(1 / (n - 1))
    assert metrics["accuracy_balanced"] == pytest.approx(0.2286, abs=1e-4)  # the paper's 23 %
    assert metrics["accuracy"] == pytest.approx(np.mean(1 / (batch.num_corners[SPLIT.test] - 1)))
    assert metrics["accuracy_from_mask"] == pytest.approx(metrics["accuracy"], abs=0.05)


def test_what_was_not_observed_is_left_out(batch):
    metrics = support_point_metrics(
        "sp-rule", with_points(batch, SPLIT.test[:30], np.nan), SPLIT, 0, **AT_CONTACT
    )
    assert metrics["accuracy"] == 1.0
    assert {name for name in metrics if name[-1].isdigit()} == {
        f"accuracy_{n}" for n in set(batch.num_corners[SPLIT.test[30:]].tolist())
    }


def test_predictions_are_learned_from_the_training_part_alone(batch):
    metrics = support_point_metrics("sp-pred", batch, SPLIT, 0, **QUICK)
    assert metrics["accuracy"] > support_point_metrics("chance", batch, SPLIT, seed=0)["accuracy"]
    elsewhere = with_points(batch, SPLIT.test[20:], np.nan)
    less = support_point_metrics("sp-pred", elsewhere, replace(SPLIT, test=SPLIT.test[:20]), 0, **QUICK)
    more = support_point_metrics("sp-pred", batch, replace(SPLIT, test=SPLIT.test[:20]), 0, **QUICK)
    assert less == more
    shifted = with_points(batch, SPLIT.train, batch.support_points[SPLIT.train] + 0.03)
    assert support_point_metrics("sp-pred", shifted, SPLIT, 0, **QUICK) != metrics


def test_the_same_seed_gives_the_same_numbers_and_leaves_torch_alone(batch):
    state = torch.random.get_rng_state()
    one = support_point_metrics("sp-pred", batch, SPLIT, 0, **QUICK)
    assert torch.equal(state, torch.random.get_rng_state())
    torch.manual_seed(99)
    assert support_point_metrics("sp-pred", batch, SPLIT, 0, **QUICK) == one
    assert support_point_metrics("sp-pred", batch, SPLIT, 1, **QUICK) != one


def test_unknown_features_are_refused_with_the_choices(batch):
    with pytest.raises(TrainingError, match=r"'sp-truth' .* choose sp-pred, sp-rule, chance"):
        support_point_metrics("sp-truth", batch, SPLIT, seed=0)


@pytest.mark.parametrize("features", CHOICES)
def test_nothing_observed_is_refused(batch, features):
    with pytest.raises(TrainingError, match="none of the 40 test interactions has observed support points"):
        support_point_metrics(features, with_points(batch, SPLIT.test, np.nan), SPLIT, seed=0)
