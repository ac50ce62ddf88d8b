"""Temperatures: probabilities as sure as they are right."""

import pytest
import torch

from foretrace.predictor.temperature import Odds, fit_temperatures, tempered


def drawn(sure: float, number: int = 20_000) -> Odds:
    """Observations drawn from probabilities, and predictions that are ``sure`` times as sure."""
    generator = torch.Generator().manual_seed(0)
    truth = torch.randn(number, 2, 3, generator=generator).flatten(1).log_softmax(dim=1)
    picked = torch.multinomial(truth.exp(), 1, generator=generator)[:, 0]
    truth = truth.view(number, 2, 3)
    return Odds(tempered(truth, torch.tensor([1 / sure, 1 / sure])), picked % 3, picked // 3)


@pytest.mark.parametrize("sure", [0.5, 1.0, 2.0])
def test_the_temperature_of_exaggerated_probabilities_is_found(sure):
    found = fit_temperatures([drawn(sure)])
    assert found.tolist() == pytest.approx([sure, sure], rel=0.05)


def test_tempered_probabilities_sum_to_one_and_keep_their_order():
    odds = drawn(1.0, 50)
    joint = tempered(odds.joint, torch.tensor([2.0, 3.0]))
    torch.testing.assert_close(joint.exp().sum(dim=(1, 2)), torch.ones(50))
    torch.testing.assert_close(tempered(odds.joint, torch.ones(2)), odds.joint)
    assert (joint.logsumexp(dim=1).argmax(dim=1) == odds.joint.logsumexp(dim=1).argmax(dim=1)).all()


def test_few_observations_leave_them_alone():
    assert fit_temperatures([drawn(2.0, 20)]).tolist() == [1.0, 1.0]
