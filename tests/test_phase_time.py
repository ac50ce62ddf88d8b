from dataclasses import replace

import numpy as np
import pytest
import torch

from factories import fake_batch
from foretrace.actions import ToolPath
from foretrace.errors import TrainingError
from foretrace.interactions.splits import Split
from foretrace.predictor import OneShotConfig
from foretrace.predictor.phase_time import Warp, in_phase, phase_of, time_of
from foretrace.predictor.states import Effects
from foretrace.predictor.training import TrainConfig, fit_predictor
from foretrace.trajectories import mean_distance

TIMES = torch.linspace(0.0, 6.0, 97, dtype=torch.float64)
CONFIG = OneShotConfig(
    hidden=32, outcomes=("levered", "slipped"), context=("speed",), phase_time=True, ensemble=2
)


@pytest.mark.parametrize("speed", [0.5, 1.0, 1.7])
def test_a_path_of_any_speed_is_where_the_nominal_one_is_at_its_phase(speed):
    nominal, phases = ToolPath(), phase_of(TIMES, torch.tensor(speed, dtype=torch.float64))
    np.testing.assert_allclose(
        nominal.faster(speed).at(TIMES.numpy()), nominal.at(phases.numpy()), atol=1e-12
    )
    torch.testing.assert_close(time_of(phases, torch.tensor(speed, dtype=torch.float64)), TIMES)


def test_samples_are_read_between_others_and_the_last_one_stays():
    samples = torch.arange(5.0)[None, :, None] ** 2
    warp = Warp.to(torch.tensor([[0.0, 0.25, 1.5, 2.0, 9.0]]), torch.tensor(0.5), 5)
    torch.testing.assert_close(warp.read(samples)[0, :, 0], torch.tensor([0.0, 0.5, 9.0, 16.0, 16.0]))


def at_speeds(speeds: torch.Tensor) -> Effects:
    """One and the same motion along paths of several speeds, for two seconds after its end; observed until then."""
    times = 0.02 * torch.arange(400.0)
    phases = phase_of(times, speeds[:, None])
    states = torch.stack([phases.clamp(max=2.6).sin(), phases.clamp(max=2.0)], dim=-1)
    lengths = 1 + ((0.1 + 2.3 / speeds + 2.0) / 0.02).long()
    states = states * (torch.arange(400) < lengths[:, None])[..., None]
    return Effects(
        states, lengths, torch.zeros(len(speeds), dtype=torch.long),
        torch.zeros(len(speeds), 3), torch.zeros(len(speeds), 3),
    )  # fmt: skip


def test_slow_and_fast_motions_are_alike_in_phase():
    effects = at_speeds(torch.tensor([0.7, 1.0, 1.5]))
    slots = torch.linspace(0, 4.4, 300)
    found = in_phase(effects, torch.tensor([0.7, 1.0, 1.5]), slots, torch.tensor(0.02))
    for row in (0, 2):
        torch.testing.assert_close(found.states[row, :290], found.states[1, :290], atol=0.01, rtol=0)
    assert ((found.lengths - 299).abs() <= 1).all()
    assert found.states[0, -1, 1] == 2.0  # it stays


def test_a_predictor_tells_motions_at_the_times_of_each_path():
    torch.set_num_threads(1)
    batch = fake_batch(np.random.default_rng(3), 12, num_samples=60)
    held = np.minimum(np.arange(60), batch.length[:, None] - 1)
    com, pose = (np.take_along_axis(each, held[..., None], axis=1) for each in (batch.com, batch.pose))
    batch = replace(batch, times=0.07 * np.arange(60), com=com, pose=pose, length=np.full(12, 60))
    speeds = np.where(np.arange(12) % 2, 1.4, 0.8)
    phases = [
        np.interp(phase_of(torch.tensor(batch.times), torch.tensor(s)), batch.times, np.arange(60))
        for s in speeds
    ]
    moved = np.array(
        [[np.interp(p, np.arange(60), c) for c in com.T] for p, com in zip(phases, batch.com, strict=True)]
    )
    pose = np.array([each[np.round(p).astype(int)] for p, each in zip(phases, batch.pose, strict=True)])
    batch = replace(
        batch, com=moved.transpose(0, 2, 1), pose=pose, parameters=batch.parameters | {"speed": speeds}
    )
    rows, training = (
        np.arange(12),
        TrainConfig(epochs=60, min_steps=1, batch_size=4, learning_rate=1e-2, split=None),
    )
    predictor = fit_predictor(batch, CONFIG, Split(rows, rows, rows), training)[0]
    off = mean_distance(predictor.imagine_batch(batch).com, batch.com).mean()
    assert off < 0.2 * mean_distance(np.repeat(batch.com[:, :1], 60, axis=1), batch.com).mean()
    # All at one speed or each at its own: the same motions.
    one, all_of = predictor.imagine_batch(batch[1:2]), predictor.imagine_batch(batch)
    np.testing.assert_allclose(one.com[0], all_of.com[1], atol=1e-6)
    np.testing.assert_allclose(one.futures.spread[0], all_of.futures.spread[1], rtol=1e-5)


@pytest.mark.parametrize("wrong", [{"context": ("friction",)}, {"outcomes": ("pushed",)}])
def test_what_has_no_phases(wrong):
    with pytest.raises(TrainingError, match="phase_time"):
        replace(CONFIG, **wrong)
