from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from factories import fake_batch
from foretrace.errors import PredictionError
from foretrace.features import NoFeatures
from foretrace.geometry import quaternion_to_matrix
from foretrace.imagined import estimate_com
from foretrace.interactions.topdown import TopDownView
from foretrace.predictor import LstmConfig, LstmPredictor
from foretrace.predictor.lstm import ProjectedLstm
from foretrace.predictor.states import (
    Effects,
    decode_poses,
    encode_states,
    rest_states,
    state_statistics,
    valid_samples,
)
from foretrace.trajectories import mean_distance, rotation_error


@pytest.fixture(scope="module")
def batch():
    torch.set_num_threads(1)
    return fake_batch(np.random.default_rng(3), 8, num_samples=24)


def make(batch, features: str = "im-cnn", **settings) -> LstmPredictor:
    torch.manual_seed(1)
    settings = {"hidden": 24} | settings
    predictor = LstmPredictor(LstmConfig(features=features, **settings), batch.com.shape[1])
    states = encode_states(batch, predictor.state)
    mean, scale = state_statistics(states, valid_samples(batch), predictor.state)
    predictor.set_normalisation(mean, scale, batch.times)
    return predictor.eval()


def reference_lstm(layer: ProjectedLstm) -> nn.LSTM:
    reference = nn.LSTM(
        layer.weight_state.shape[1] + layer.weight_features.shape[1], layer.hidden, batch_first=True
    )
    with torch.no_grad():
        reference.weight_ih_l0.copy_(torch.cat([layer.weight_state, layer.weight_features], dim=1))
        reference.weight_hh_l0.copy_(layer.weight_hidden)
        reference.bias_ih_l0.copy_(layer.bias)
        reference.bias_hh_l0.zero_()
    return reference


def test_the_layer_is_an_lstm_over_states_and_features_concatenated():
    torch.manual_seed(0)
    layer = ProjectedLstm(num_states=3, num_features=5, hidden=16)
    reference = reference_lstm(layer)
    states, features = torch.randn(4, 9, 3, requires_grad=True), torch.randn(4, 5, requires_grad=True)
    weights = torch.randn(4, 9, 16)
    ours, _ = layer(states, layer.project(features))
    theirs, _ = reference(torch.cat([states, features[:, None].expand(4, 9, 5)], dim=2))
    torch.testing.assert_close(ours, theirs)

    our_gradients = torch.autograd.grad((ours * weights).sum(), [states, features, *layer.parameters()])
    parameters = [reference.weight_ih_l0, reference.weight_hh_l0, reference.bias_ih_l0]
    their_gradients = torch.autograd.grad((theirs * weights).sum(), [states, features, *parameters])
    to_states, to_features, weight_state, weight_features, weight_hidden, bias = our_gradients
    ordered = [to_states, to_features, torch.cat([weight_state, weight_features], 1), weight_hidden, bias]
    for ours_, theirs_ in zip(ordered, their_gradients, strict=True):
        torch.testing.assert_close(ours_, theirs_, rtol=1e-4, atol=1e-5)


def test_gradients_agree_with_finite_differences():
    torch.manual_seed(0)
    layer = ProjectedLstm(2, 3, 4).double()
    states = torch.randn(2, 5, 2, dtype=torch.float64, requires_grad=True)
    features = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s, f: layer(s, layer.project(f))[0], (states, features))


def test_stepping_equals_the_whole_sequence():
    torch.manual_seed(0)
    layer = ProjectedLstm(3, 2, 8)
    states, projected = torch.randn(5, 7, 3), layer.project(torch.randn(5, 2))
    memory, outputs = None, []
    for t in range(7):
        memory = layer.step(states[:, t], projected, memory)
        outputs.append(memory[0])
    whole, (last_output, last_cell) = layer(states, projected)
    torch.testing.assert_close(torch.stack(outputs, 1), whole)
    torch.testing.assert_close((last_output, last_cell), memory)


def test_a_sequence_can_be_cut_where_its_memory_is_carried_on():
    torch.manual_seed(0)
    layer = ProjectedLstm(3, 2, 8)
    states, projected = torch.randn(5, 7, 3), layer.project(torch.randn(5, 2))
    first, memory = layer(states[:, :4], projected)
    second, _ = layer(states[:, 4:], projected, memory)
    torch.testing.assert_close(torch.cat([first, second], 1), layer(states, projected)[0])
    (gradient,) = torch.autograd.grad(second.sum(), layer.weight_hidden)
    stepped, carried = [], tuple(part.detach() for part in memory)
    for t in range(4, 7):
        carried = layer.step(states[:, t], projected.detach(), carried)
        stepped.append(carried[0])
    (expected,) = torch.autograd.grad(torch.stack(stepped).sum(), layer.weight_hidden)
    torch.testing.assert_close(gradient, expected)


@pytest.mark.parametrize("residual", [True, False])
@pytest.mark.parametrize("ahead", [1, 2, 3, 4, 5])
def test_imagine_equals_a_hand_unrolled_loop(batch, ahead, residual):
    predictor = make(batch, steps_ahead=ahead, residual=residual)
    reference = reference_lstm(predictor.lstm)
    mean, scale = predictor.state_mean, predictor.state_scale
    with torch.no_grad():
        features = predictor.features(predictor.features.inputs(batch[:1]))[0]
        states = [(torch.from_numpy(batch.com[0, 0]).float() - mean) / scale]
        while len(states) < 24:
            rows = torch.stack([torch.cat([state, features]) for state in states])
            outputs, _ = reference(rows[None])
            said = predictor.output(outputs[0, -1]).view(ahead, 3)
            states += states[-1] + 0.1 * said if residual else said
        expected = (torch.stack(states[:24]) * scale + mean).numpy()
    imagined = predictor.imagine(TopDownView(batch.mask[0], batch.height[0]), com=batch.com[0, 0])
    np.testing.assert_allclose(imagined.com_trajectory, expected, atol=1e-6)
    np.testing.assert_array_equal(imagined.times, batch.times)
    assert imagined.pose_trajectory is None


def test_imagining_leaves_training_mode_and_random_numbers_alone(batch):
    predictor = make(batch).train()
    before = torch.random.get_rng_state()
    predictor.imagine_batch(batch)
    assert predictor.training
    assert torch.equal(before, torch.random.get_rng_state())


def test_the_start_can_be_estimated_from_the_view(batch):
    estimated = estimate_com(batch)
    assert np.linalg.norm(estimated - batch.com[:, 0], axis=1).max() < 0.001
    predictor = make(batch)
    imagined = predictor.imagine(TopDownView(batch.mask[2], batch.height[2]))
    np.testing.assert_allclose(imagined.com_trajectory[0], estimated[2])
    from_views = predictor.imagine_batch(batch, start="estimated")
    np.testing.assert_allclose(from_views.com[2], imagined.com_trajectory, atol=1e-6)


def test_oracles_do_not_imagine_from_a_view(batch, registered):
    class Oracle(NoFeatures):
        label = "oracle"
        oracle = True

    predictor = LstmPredictor(LstmConfig(features="oracle", hidden=4), 24)
    with pytest.raises(PredictionError, match="'oracle'"):
        predictor.imagine(TopDownView(batch.mask[0], batch.height[0]))
    assert predictor.imagine_batch(batch).com.shape == (8, 24, 3)


def effects(states: torch.Tensor, lengths: torch.Tensor) -> Effects:
    com = torch.full((len(states), 3), torch.nan)
    return Effects(
        states, lengths, torch.zeros(len(states), dtype=torch.long), com, torch.zeros(len(states), 3)
    )


@pytest.mark.parametrize("window", [5, 23, 60])
@pytest.mark.parametrize("ahead", [1, 3])
@pytest.mark.parametrize("residual", [True, False])
def test_the_loss_is_the_mean_over_every_steps_predictions(batch, ahead, window, residual):
    predictor = make(batch, "none", steps_ahead=ahead, window=window, residual=residual)
    states = torch.from_numpy(encode_states(batch, "position")).float()
    lengths = torch.tensor([24, 24, 13, 2, 24, 7, 24, 24])
    with torch.no_grad():
        loss = predictor.training_loss(torch.zeros(8, 0), effects(states, lengths))
        reference, errors = reference_lstm(predictor.lstm), []
        for row, length in zip(states, lengths, strict=True):
            predicted = predictor.output(reference(row[None])[0][0]).view(24, ahead, 3)
            predicted = row[:, None] + 0.1 * predicted if residual else predicted
            for t in range(24):
                targets = row[t + 1 : min(t + 1 + ahead, int(length))]
                errors += (predicted[t, : len(targets)] - targets).square().mean(dim=1)
    torch.testing.assert_close(loss, torch.stack(errors).mean(), rtol=1e-4, atol=1e-7)


def test_the_gradient_stops_at_the_windows_edge(batch):
    def gradient(window: int) -> torch.Tensor:
        predictor = make(batch, "none", window=window)
        states = predictor.normalise(encode_states(batch[:4], "position"))
        predictor.training_loss(torch.zeros(4, 0), effects(states, torch.full((4,), 20))).backward()
        return predictor.lstm.weight_hidden.grad

    torch.testing.assert_close(gradient(23), gradient(60))
    assert not torch.allclose(gradient(6), gradient(60), rtol=1e-2)


def test_what_lies_past_the_end_is_not_learned(batch):
    predictor = make(batch, "none")
    states, lengths = torch.randn(8, 24, 3), torch.full((8,), 10)
    loss = predictor.training_loss(torch.zeros(8, 0), effects(states, lengths))
    states[:, 10:] = 0.0
    torch.testing.assert_close(predictor.training_loss(torch.zeros(8, 0), effects(states, lengths)), loss)


def test_pose_states_there_and_back(batch):
    states = encode_states(batch, "pose")
    valid = valid_samples(batch)
    assert np.all(states[~valid] == 0)
    poses = decode_poses(states[valid])
    np.testing.assert_allclose(poses[:, :3], batch.com[valid])
    np.testing.assert_allclose(states[:, 0], rest_states(batch.com[:, 0], "pose"), atol=1e-12)
    since_rest = quaternion_to_matrix(batch.pose[0, 20, 3:]) @ quaternion_to_matrix(batch.pose[0, 0, 3:]).T
    back = quaternion_to_matrix(decode_poses(states[0, 20])[3:])
    np.testing.assert_allclose(back, since_rest, atol=1e-9)


def test_turns_go_on_beyond_half_a_turn(batch):
    times = np.arange(24)
    rolled = Rotation.from_rotvec(np.outer(times * 0.5, [0.0, 0.6, 0.8])).as_quat(scalar_first=True)
    pose = batch.pose[:1].copy()
    pose[0, :, 3:] = rolled
    one = replace(batch[:1], pose=pose, length=np.array([24]), slip_index=np.array([24]))
    states = encode_states(one, "turn")
    np.testing.assert_allclose(states[0, :, 3:], np.outer(times * 0.5, [0.0, 0.6, 0.8]), atol=1e-9)
    np.testing.assert_allclose(states[:, 0], rest_states(one.com[:, 0], "turn"), atol=1e-12)
    np.testing.assert_allclose(rotation_error(decode_poses(states)[0, :, 3:], rolled), 0, atol=1e-7)


def test_samples_after_a_slip_are_cut(batch):
    slipped = int(np.flatnonzero(batch.outcome == "slipped")[0])
    assert valid_samples(batch)[slipped].sum() == batch.slip_index[slipped] < batch.length[slipped]


def test_statistics_share_a_scale_within_a_unit(batch):
    states, valid = encode_states(batch, "pose"), valid_samples(batch)
    mean, scale = state_statistics(states, valid, "pose")
    assert len(set(scale[:3])) == 1
    assert len(set(scale[3:])) == 1
    normalised = ((states - mean) / scale)[valid]
    np.testing.assert_allclose(normalised.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(np.mean(normalised[:, :3] ** 2), 1)
    np.testing.assert_allclose(np.mean(normalised[:, 3:] ** 2), 1)


@pytest.mark.parametrize("state", ["position", "pose"])
@pytest.mark.parametrize("ahead", [1, 2, 3, 4, 5])
def test_every_number_of_steps_and_every_state_can_be_learned(batch, state, ahead):
    four = batch[np.array([0, 1, 2, 3])]
    predictor = make(four, "none", state=state, steps_ahead=ahead, hidden=32)
    states = predictor.normalise(encode_states(four, state))
    optimizer = torch.optim.Adam(predictor.parameters(), lr=1e-2)
    errors = []
    for step in range(201):
        if step % 200 == 0:
            errors.append(mean_distance(predictor.imagine_batch(four).com, four.com).mean())
        optimizer.zero_grad()
        predictor.training_loss(torch.zeros(4, 0), effects(states, torch.full((4,), 24))).backward()
        optimizer.step()
    assert errors[1] < 0.25 * errors[0]
