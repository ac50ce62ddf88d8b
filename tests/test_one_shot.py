from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from factories import fake_batch
from foretrace.errors import TrainingError
from foretrace.features import make_features
from foretrace.features.outline import MAX_CORNERS, UNIT
from foretrace.features.support_points import support_points_by_rule
from foretrace.geometry import quaternion_to_matrix
from foretrace.interactions.splits import Split
from foretrace.predictor import OneShotConfig, OneShotPredictor, load_predictor, save_checkpoint
from foretrace.predictor.hinges import find_hinges, mirror_corners
from foretrace.predictor.one_shot import rotation_matrix, rotation_vector
from foretrace.predictor.training import TrainConfig, fit_predictor, train_predictor
from foretrace.trajectories import mean_distance, rotation_error

QUICK = TrainConfig(
    predictor="one-shot",
    features="outline",
    hidden=32,
    epochs=2,
    min_steps=1,
    batch_size=4,
    learning_rate=4e-3,
    split=None,
    outcomes=("levered",),
)


@pytest.fixture(scope="module")
def batch():
    torch.set_num_threads(1)
    return fake_batch(np.random.default_rng(3), 12, num_samples=24)


def exact_corners(batch) -> torch.Tensor:
    """Corners as the simulator knows them, the first one filling the rows [m]."""
    corners = np.repeat(batch.corners[:, :1], MAX_CORNERS, axis=1)
    known = np.isfinite(batch.corners)
    corners[:, : batch.corners.shape[1]][known] = batch.corners[known]
    return torch.from_numpy(corners)


def mirrored(batch):
    """The same lever-ups in a mirror along the action axis."""
    return replace(
        batch,
        mask=batch.mask[:, :, ::-1],
        height=batch.height[:, :, ::-1],
        corners=batch.corners[:, ::-1] * [1, -1],
        com=batch.com * [1, -1, 1],
    )


def everything(batch) -> Split:
    rows = np.arange(len(batch))
    return Split(rows, rows, rows)


def test_the_hinge_is_the_rules_support_edge(batch):
    hinges = find_hinges(exact_corners(batch), torch.from_numpy(batch.com[:, 0]))
    rule = support_points_by_rule(batch)
    np.testing.assert_allclose(np.sort(hinges.ends, axis=1), np.sort(rule, axis=1), atol=1e-12)
    product = hinges.axes @ hinges.axes.mT
    torch.testing.assert_close(product, torch.eye(3, dtype=torch.float64).expand_as(product))
    assert (torch.linalg.det(hinges.axes) > 0).all()
    # The first axis points out of the object.
    outwards = hinges.ends.mean(dim=1) - torch.from_numpy(batch.com[:, 0, :2])
    assert ((hinges.axes[:, 0, :2] * outwards).sum(dim=1) > 0).all()


def test_mirror_images_have_mirrored_hinges(batch):
    corners, com = exact_corners(batch), torch.from_numpy(batch.com[:, 0])
    mirror = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    hinges, images = find_hinges(corners, com), find_hinges(mirror_corners(corners), com * mirror)
    torch.testing.assert_close(images.ends.flip(1), hinges.ends * mirror[:2])
    torch.testing.assert_close(images.values[:, :2], hinges.values[:, :2])
    torch.testing.assert_close(mirror_corners(mirror_corners(corners)), corners)


def test_the_object_turns_about_the_second_axis(batch):
    hinges = find_hinges(exact_corners(batch), torch.from_numpy(batch.com[:, 0]))
    # The synthetic lever-ups turn about the edge ahead of the contact point, mostly the rule's.
    apart = np.sort(hinges.ends, axis=1) - np.sort(batch.support_points, axis=1)
    same = (np.abs(apart).max(axis=(1, 2)) < 1e-9) & (batch.outcome == "levered")
    assert same.mean() > 0.7
    rotation = torch.from_numpy(quaternion_to_matrix(batch.pose[same, 10:12, 3:]))
    turn = rotation_vector(rotation[:, 1] @ rotation[:, 0].mT)
    along = (hinges.axes[same] @ turn[..., None])[..., 0]
    assert (along[:, 1] > 0).all()
    torch.testing.assert_close(along[:, [0, 2]], torch.zeros(int(same.sum()), 2, dtype=torch.float64))


def test_rotation_vectors_are_those_of_scipy():
    vectors = np.random.default_rng(0).normal(size=(50, 3))
    vectors[0], vectors[1] = 0, 1e-9
    matrices = rotation_matrix(torch.from_numpy(vectors))
    np.testing.assert_allclose(matrices, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(
        rotation_vector(matrices), Rotation.from_matrix(matrices).as_rotvec(), atol=1e-7
    )


def test_mirror_images_have_mirrored_motions(batch):
    predictor, _ = fit_predictor(batch, QUICK, everything(batch))
    imagined, image = predictor.imagine_batch(batch), predictor.imagine_batch(mirrored(batch))
    np.testing.assert_allclose(image.com, imagined.com * [1, -1, 1], atol=1e-5)
    assert imagined.pose is not None
    assert image.pose is not None
    np.testing.assert_allclose(image.pose[..., 3:], imagined.pose[..., 3:] * [1, -1, 1, -1], atol=1e-4)


def test_it_learns_what_it_has_seen(batch):
    config = replace(QUICK, hidden=64, epochs=60, learning_rate=1e-2)
    predictor, _ = fit_predictor(batch, config, everything(batch))
    imagined = predictor.imagine_batch(batch)
    levered = batch.outcome == "levered"
    still = np.repeat(batch.com[:, :1], batch.com.shape[1], axis=1)
    errors = np.asarray(mean_distance(imagined.com, batch.com))[levered]
    assert errors.max() < 0.1 * np.mean(np.asarray(mean_distance(still, batch.com))[levered])
    assert imagined.pose is not None
    turned = quaternion_to_matrix(batch.pose[..., 3:])
    turned = Rotation.from_matrix((turned @ np.swapaxes(turned[:, :1], -1, -2))[levered, -11])
    off = rotation_error(imagined.pose[levered, -11, 3:], turned.as_quat(scalar_first=True))
    assert np.degrees(off).max() < 4


def test_a_trained_one_can_be_saved_and_loaded(batch, tmp_path):
    predictor, _ = fit_predictor(batch, QUICK, everything(batch))
    save_checkpoint(tmp_path, predictor)
    again = load_predictor(tmp_path)
    assert again.config == predictor.config
    np.testing.assert_array_equal(again.imagine_batch(batch).com, predictor.imagine_batch(batch).com)


def test_an_interrupted_training_ends_with_the_same_model(batch, tmp_path, monkeypatch):
    whole = train_predictor(batch, QUICK, tmp_path / "whole", split=everything(batch), progress=False)
    loss, calls = OneShotPredictor.training_loss, []

    def stopping(self, *args):
        calls.append(1)
        if len(calls) > 4:
            raise KeyboardInterrupt
        return loss(self, *args)

    monkeypatch.setattr(OneShotPredictor, "training_loss", stopping)
    with pytest.raises(KeyboardInterrupt):
        train_predictor(batch, QUICK, tmp_path / "cut", split=everything(batch), progress=False)
    monkeypatch.undo()
    cut = train_predictor(batch, QUICK, tmp_path / "cut", split=everything(batch), progress=False)
    assert (cut / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()


def test_what_is_known_changes_what_is_said(batch):
    told = replace(batch, friction=np.linspace(0.3, 0.9, len(batch)))
    predictor, _ = fit_predictor(told, replace(QUICK, known=("friction",), epochs=20), everything(told))
    other = predictor.imagine_batch(replace(told, friction=told.friction[::-1]))
    assert not np.allclose(other.com, predictor.imagine_batch(told).com, atol=1e-7)


def test_other_features_are_refused():
    with pytest.raises(TrainingError, match="not im-cnn: train it with features 'outline'"):
        OneShotPredictor(make_features("im-cnn"), 24)
    with pytest.raises(TrainingError, match="unknown predictor 'one-shoot'; available: lstm, one-shot"):
        TrainConfig(predictor="one-shoot")
    with pytest.raises(TrainingError, match="members must be at least 1, not 0"):
        OneShotConfig(members=0)


def test_corners_are_read_in_their_unit(batch):
    features = make_features("outline")
    corners = features.inputs(batch).unflatten(1, (MAX_CORNERS, 2)) * UNIT
    assert (corners[:, 0].norm(dim=1) < 0.3).all()
    assert corners.std() > 0.03
