"""Beginnings of motions: as recorded, at any rate, in any object frame."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from factories import fake_batch, fake_interaction
from foretrace.errors import PredictionError
from foretrace.imagined import ObservedMotion
from foretrace.interactions.record import Effect
from foretrace.interactions.splits import Split
from foretrace.interactions.topdown import TopDownView
from foretrace.predictor import OneShotConfig, TrainConfig, fit_predictor
from foretrace.predictor.states import encode_states

SAMPLES = 24
TIMES = 0.05 * np.arange(SAMPLES)


@pytest.fixture(scope="module")
def predictor():
    torch.set_num_threads(1)
    batch = fake_batch(np.random.default_rng(3), 12, num_samples=SAMPLES)
    rows = np.flatnonzero(batch.outcome == "levered")
    config = OneShotConfig(hidden=16, ensemble=2, components=8)
    training = TrainConfig(epochs=2, min_steps=1, batch_size=4, split=None)
    return fit_predictor(batch, config, Split(rows, rows, rows), training)[0]


@pytest.fixture(scope="module")
def interaction():
    return fake_interaction(np.random.default_rng(8), 3, num_samples=SAMPLES)


def densely(effect: Effect, rate: int = 50) -> ObservedMotion:
    """The same motion as a camera of another rate records it, exactly."""
    fine = fake_interaction(np.random.default_rng(8), 3, num_samples=116).effect  # 5 times as many steps
    times = np.arange(116) * (TIMES[-1] / 115)
    kept = np.arange(0, 60, max(1, round(100 / rate)))
    return ObservedMotion(times[kept], fine.pose_trajectory[kept])


def test_states_are_those_that_predictors_learn_from():
    batch = fake_batch(np.random.default_rng(3), 3, num_samples=SAMPLES)
    for row in range(3):
        motion = ObservedMotion(batch.times[:12], batch.pose[row, :12])
        found = motion.states(batch.times, batch.com[row, 0])
        np.testing.assert_allclose(found, encode_states(batch, "turn")[row, :12], atol=1e-9)


@pytest.mark.parametrize("rate", [100, 50, 20])
def test_any_sampling_rate_tells_the_same(predictor, interaction, rate):
    effect, com = interaction.effect, interaction.effect.com_trajectory[0]
    motion = densely(effect, rate)
    found = motion.states(TIMES, com)
    assert len(found) == int(np.sum(motion.times[-1] >= TIMES))
    recorded = ObservedMotion.of(effect, motion.times[-1]).states(TIMES, com)
    np.testing.assert_allclose(found, recorded, atol=2e-3)
    one, other = (
        predictor.imagine(interaction.view, interaction.action, observed=each, com=com).com_trajectory
        for each in (motion, ObservedMotion.of(effect, motion.times[-1]))
    )
    np.testing.assert_allclose(one, other, atol=5e-3)


def test_the_object_frame_does_not_matter(predictor, interaction):
    """The same poses of a frame that lies elsewhere in the object, and is turned."""
    effect = interaction.effect
    poses = effect.pose_trajectory[:10]
    offset, turned = np.array([0.03, -0.02, 0.01]), Rotation.from_rotvec([0.0, 0.0, 2.0])
    rotation = Rotation.from_quat(poses[:, 3:], scalar_first=True)
    moved = np.concatenate(
        [poses[:, :3] + rotation.apply(offset), (rotation * turned).as_quat(scalar_first=True)], axis=1
    )
    com = effect.com_trajectory[0]
    plain, other = (ObservedMotion(TIMES[:10], each).states(TIMES, com) for each in (poses, moved))
    np.testing.assert_allclose(other, plain, atol=1e-9)
    np.testing.assert_allclose(plain[:, :3], effect.com_trajectory[:10], atol=1e-9)


def test_a_record_and_its_poses_are_the_same_observation(predictor, interaction):
    effect = interaction.effect
    names = ("times", "pose_trajectory", "com_trajectory", "tool_trajectory", "joint_trajectory")
    short = replace(effect, **{name: getattr(effect, name)[:10] for name in names})
    poses = ObservedMotion(short.times.tolist(), short.pose_trajectory.tolist())
    one, other = (
        predictor.imagine(interaction.view, observed=each, com=effect.com_trajectory[0])
        for each in (short, poses)
    )
    np.testing.assert_allclose(one.com_trajectory, other.com_trajectory, atol=1e-9)
    np.testing.assert_allclose(one.com_trajectory[:10], effect.com_trajectory[:10], atol=1e-9)
    without = predictor.imagine(interaction.view, observed=short)
    np.testing.assert_allclose(without.com_trajectory[0], effect.com_trajectory[0], atol=1e-9)


def test_a_batch_of_another_rate_is_resampled(predictor):
    slow = fake_batch(np.random.default_rng(3), 4, num_samples=SAMPLES)
    fast = replace(slow, times=slow.times / 2)
    imagined = predictor.imagine_batch(fast, observed=9)  # up to 0.2 s: five samples of the predictor
    np.testing.assert_allclose(imagined.com[:, :5], fast.com[:, 0:9:2], atol=1e-9)


REST = np.array([0.05, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def poses(number: int, **changes: float) -> np.ndarray:
    rows = np.repeat(REST[None], number, axis=0)
    for place, value in changes.items():
        row, column = map(int, place[1:].split("_"))
        rows[row, column] = value
    return rows


@pytest.mark.parametrize(
    ("times", "rows", "message"),
    [
        ([], np.zeros((0, 7)), "0 times and 0 poses"),
        (TIMES[:3], poses(4), "3 times and 4 poses: give one pose"),
        (TIMES[:3], np.zeros((3, 6)), r"must be numbers in the shape \('n', 7\), not in the shape \(3, 6\)"),
        (TIMES[:3], poses(3, _1_0=np.nan), "poses of an observed motion holds a value that is not finite"),
        ([0.0, np.inf, 0.1], poses(3), "times of an observed motion holds a value that is not finite"),
        ([0.0, 0.1, 0.1], poses(3), r"times must rise: 0.1 s follows 0.1 s"),
        (TIMES[:3], poses(3, _2_3=0.5), "of pose 2 has length 0.5, not 1"),
        (TIMES[:3], poses(3, _1_0=0.15), "moves by 10.0 cm and turns by 0 degrees in the first 0.06 s"),
        (TIMES[4:8], poses(4), r"begins at 0.2 s, the predictor's samples at 0 s"),
        (
            TIMES,
            poses(SAMPLES),
            r"lasts until 1.15 s, the predictor's until 1.15 s: give its beginning alone",
        ),
    ],
)
def test_motions_that_cannot_be_used_are_refused(predictor, interaction, times, rows, message):
    with pytest.raises(PredictionError, match=message):
        predictor.imagine(interaction.view, observed=ObservedMotion(times, rows))


def test_a_batch_with_too_few_samples_is_refused(predictor):
    batch = fake_batch(np.random.default_rng(3), 4, num_samples=SAMPLES)
    short = replace(batch, length=np.full(4, 4))
    with pytest.raises(PredictionError, match="has 4 samples, fewer than the 5 to be observed"):
        predictor.imagine_batch(short, observed=5)
    with pytest.raises(PredictionError, match=r"lasts until 1.15 s, the predictor's until 1.15 s"):
        predictor.imagine_batch(batch, observed=SAMPLES)


def test_the_whole_record_is_refused(predictor, interaction):
    with pytest.raises(PredictionError, match="give its beginning alone"):
        predictor.imagine(
            TopDownView(interaction.view.mask, interaction.view.height), observed=interaction.effect
        )
