"""The residual: what a twin gets wrong, learned from few actions."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from foretrace.actions import LeverUp
from foretrace.errors import CheckpointError, TrainingError
from foretrace.geometry import matrix_to_quaternion, quaternion_to_matrix, rotation_vector_to_quaternion
from foretrace.interactions.dataset import InteractionBatch
from foretrace.objects import sample_prism
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.twin import TwinConfig, TwinImaginer
from foretrace.twin.residual import ResidualImaginer, train_residual
from foretrace.twin.residual_network import ResidualConfig

TWIN = TwinImaginer(config=TwinConfig(workers=1, worlds=4))
SMALL = ResidualConfig(hidden=16, layers=2, ensemble=2, components=8, epochs=40, min_steps=200)


@pytest.fixture(scope="module")
def batch() -> InteractionBatch:
    """Lever-ups in a world where everything ends a centimetre further ahead and higher than in the twin's."""
    rng = np.random.default_rng(4)
    made = []
    for corners in (3, 4, 5, 6):
        obj = sample_prism(rng, corners)
        made += [
            simulate_lever_up(obj, LeverUp.at_edge(obj, edge, 0.45), SimulationConfig(embodiment="tool"))
            for edge in range(3)
        ]
    batch = InteractionBatch.from_interactions(made)
    shift = np.linspace(0.0, 0.01, len(batch.times))[:, None] * [1.0, 0.0, 1.0]
    return replace(batch, com=batch.com + shift)


@pytest.fixture(scope="module")
def residual(batch: InteractionBatch) -> ResidualImaginer:
    return train_residual(batch[:9], batch[9:], TWIN, SMALL)


def errors(imagined: np.ndarray, batch: InteractionBatch) -> np.ndarray:
    valid = np.arange(imagined.shape[1]) < batch.length[:, None]
    return np.where(valid, np.linalg.norm(imagined - batch.com, axis=-1), 0.0).sum(axis=1) / valid.sum(axis=1)


def test_a_difference_that_all_have_is_learned_from_nine(batch, residual):
    own, corrected = (errors(each.imagine_batch(batch[9:]).com, batch[9:]) for each in (TWIN, residual))
    assert own.mean() > 0.006
    assert corrected.mean() < 0.4 * own.mean()


def test_starts_probabilities_and_outcomes_stay_the_twins(batch, residual):
    own, corrected = TWIN.imagine_batch(batch), residual.imagine_batch(batch)
    assert (corrected.com[:, 0] == batch.com[:, 0]).all()
    assert (corrected.futures.probability == own.futures.probability).all()
    assert corrected.futures.outcome == own.futures.outcome
    assert np.isfinite(corrected.futures.states).all()
    assert (corrected.futures.spread >= 0).all()
    assert (np.diff(corrected.futures.quantiles[np.isfinite(corrected.futures.quantiles)]) >= 0).all()


def test_turns_are_corrected_as_positions_are(batch):
    turn = quaternion_to_matrix(rotation_vector_to_quaternion(np.array([0.0, 0.1, 0.0])))
    later = np.arange(len(batch.times)) > 30
    rotation = quaternion_to_matrix(batch.pose[..., 3:])
    rotation = np.where(later[:, None, None], turn @ rotation, rotation)
    pose = np.concatenate([batch.pose[..., :3], matrix_to_quaternion(rotation)], axis=-1)
    turned = replace(batch, pose=pose)
    found = train_residual(turned[:9], turned[9:], TWIN, SMALL).imagine_batch(turned[9:])
    own = TWIN.imagine_batch(turned[9:])
    extra = found.futures.states[:, 0, 50, 3:] - own.futures.states[:, 0, 50, 3:]
    levered = own.futures.probability[:, 0] == 1
    assert np.median(np.abs(extra[levered] - [0.0, 0.1, 0.0])) < 0.03


def test_mirror_images_have_mirrored_corrections(batch, residual):
    own = TWIN.imagine_batch(batch[9:])
    states = own.futures.states * [1, -1, 1, -1, 1, -1]
    support = own.futures.support_points[:, :, ::-1] * [1, -1]
    image = replace(
        batch[9:],
        mask=batch.mask[9:, :, ::-1].copy(),
        height=batch.height[9:, :, ::-1].copy(),
        com=batch.com[9:] * [1, -1, 1],
    )
    other = replace(own, futures=replace(own.futures, states=states, support_points=support))
    one = residual.correct(batch[9:], batch.com[9:, 0], own).com
    two = residual.correct(image, image.com[:, 0], other).com
    assert np.abs(one - two * [1, -1, 1]).max() < 1e-4


def test_saved_and_loaded_is_the_same(batch, residual, tmp_path):
    residual.save(tmp_path / "kept")
    again = ResidualImaginer.load(tmp_path / "kept", TWIN)
    assert (again.imagine_batch(batch[:3]).com == residual.imagine_batch(batch[:3]).com).all()
    assert again.interactions == 9
    assert again.config == SMALL
    with pytest.raises(CheckpointError, match="sample_period and watch_time"):
        ResidualImaginer.load(tmp_path / "kept", TwinImaginer(config=TwinConfig(watch_time=1.0)))
    file = tmp_path / "kept" / "residual.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"config": {"hidden": -1}}))
    with pytest.raises(CheckpointError, match="no usable settings"):
        ResidualImaginer.load(tmp_path / "kept", TWIN)


def test_the_same_seed_gives_the_same_weights_and_leaves_others_numbers_alone(batch):
    quick = replace(SMALL, min_steps=3, epochs=1)
    imagined = TWIN.imagine_batch(batch[:4]), TWIN.imagine_batch(batch[4:8])
    torch.manual_seed(5)
    first = train_residual(batch[:4], batch[4:8], TWIN, quick, imagined=imagined)
    after = torch.rand(1)
    torch.manual_seed(5)
    assert torch.rand(1) == after
    again = train_residual(batch[:4], batch[4:8], TWIN, quick, imagined=imagined)
    tensors = again.network.state_dict()
    assert all(torch.equal(tensor, tensors[name]) for name, tensor in first.network.state_dict().items())


@pytest.mark.parametrize("steps", [1, 9, 10, 20])
def test_any_number_of_steps_can_be_taken(steps, batch):
    imagined = TWIN.imagine_batch(batch[:2]), TWIN.imagine_batch(batch[2:4])
    quick = replace(SMALL, min_steps=steps, epochs=1)
    found = train_residual(batch[:2], batch[2:4], TWIN, quick, imagined=imagined)
    assert all(torch.isfinite(tensor).all() for tensor in found.network.parameters())


@pytest.mark.parametrize(
    "settings", [{"hidden": 0}, {"seed": -1}, {"learning_rate": 0.0}, {"weight_decay": -1.0}]
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(TrainingError, match=next(iter(settings))):
        ResidualConfig(**settings)


def test_data_that_do_not_fit_are_refused(batch):
    with pytest.raises(TrainingError, match="batch is empty"):
        train_residual(batch[:0], batch, TWIN, SMALL)
    with pytest.raises(TrainingError, match="the twin 60"):
        train_residual(batch, replace(batch, times=batch.times * 2), TWIN, SMALL)
