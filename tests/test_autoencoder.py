import numpy as np
import pytest
import torch

from factories import fake_batch
from foretrace.errors import TrainingError
from foretrace.features import Autoencoder256, Autoencoder512, FitPart


@pytest.fixture(scope="module")
def batch():
    torch.set_num_threads(1)
    return fake_batch(np.random.default_rng(5), 10, num_samples=12)


def fit(extractor, train, validation, seed: int = 0) -> list[str]:
    lines: list[str] = []
    parts = [FitPart(extractor.inputs(part), part) for part in (train, validation)]
    extractor.fit(*parts, seed=seed, report=lines.append)
    return lines


def made(seed: int = 0, **options) -> Autoencoder256:
    torch.manual_seed(seed)
    return Autoencoder256(**({"epochs": 2, "min_steps": 1, "width": 8} | options))


def same_tensors(one, other) -> bool:
    a, b = one.state_dict(), other.state_dict()
    return all(torch.equal(a[name], b[name]) for name in a)


def test_the_channels_are_the_papers():
    for kind, code in ((Autoencoder256, 4), (Autoencoder512, 8)):
        extractor = kind()
        assert extractor.num_features == 64 * code == int(extractor.label[3:])
        network = extractor.network
        assert [c.out_channels for c in network.encoder] == [128, 128, 64, code]
        assert [c.out_channels for c in network.decoder] == [code, 64, 128, 128]
        weights = [p for name, p in network.named_parameters() if name.endswith("weight")]
        assert all(weight.shape[2:] == (3, 3) for weight in weights)


def test_the_code_is_8_by_8_and_images_keep_their_size(batch):
    extractor = made()
    images = extractor.inputs(batch)
    assert images.dtype == torch.uint8
    assert extractor.network.encode(images.float()).shape == (len(batch), 4, 8, 8)
    restored = extractor.reconstruct(images)
    assert restored.shape == (len(batch), 1, 128, 128)
    assert 0 <= restored.min() <= restored.max() <= 1


def test_it_learns_to_restore_masks(batch):
    extractor = made(epochs=80, batch_size=5, learning_rate=1e-2)
    images = extractor.inputs(batch)
    before = extractor._mean_loss(images)
    lines = fit(extractor, batch, batch)
    after = extractor._mean_loss(images)
    assert after < 0.3 * before
    agreeing = (extractor.reconstruct(images) > 0.5) == (images > 0)
    assert agreeing.float().mean() > 0.95
    assert len(lines) <= 11
    assert "ae-256: best validation loss" in lines[-1]


def test_it_is_frozen_afterwards_and_its_features_are_of_unit_scale(batch):
    extractor = made()
    fit(extractor, batch[:6], batch[6:])
    assert not extractor.trainable
    features = extractor(extractor.inputs(batch[:6]))
    assert not features.requires_grad
    assert features.square().mean().sqrt().item() == pytest.approx(1, rel=1e-5)


def test_the_same_seed_learns_the_same(batch):
    one, other, third = made(), made(), made()
    for extractor, seed in ((one, 0), (other, 0), (third, 1)):
        extractor.config = made(batch_size=2).config
        fit(extractor, batch[:6], batch[6:], seed)
    assert same_tensors(one, other)
    assert not same_tensors(one, third)


def test_effects_are_not_looked_at(batch):
    other = fake_batch(np.random.default_rng(5), 10, num_samples=12)
    for name in ("com", "pose", "support_points"):
        getattr(other, name)[:] = np.nan
    one, two = made(), made()
    fit(one, batch[:6], batch[6:])
    fit(two, other[:6], other[6:])
    assert same_tensors(one, two)


def test_reduced_precision_is_for_training_alone(batch):
    exact, reduced = made(), made()
    reduced.precision = "bfloat16"
    for extractor in (exact, reduced):
        fit(extractor, batch[:6], batch[6:])
    assert not same_tensors(exact, reduced)
    assert all(p.dtype == torch.float32 for p in reduced.parameters())
    assert reduced.train()(reduced.inputs(batch)).dtype == torch.float32


def test_it_keeps_the_best_epoch(batch):
    extractor = made(epochs=4)
    losses = iter([3.0, 1.0, 2.0, 2.0])
    kept = []

    def scripted(images):
        kept.append({name: tensor.clone() for name, tensor in extractor.network.state_dict().items()})
        return next(losses)

    extractor._mean_loss = scripted
    lines = fit(extractor, batch[:6], batch[6:])
    assert len(kept) == 4
    assert "1 in epoch 2" in lines[-1]
    assert all(torch.equal(tensor, kept[1][name]) for name, tensor in extractor.network.state_dict().items())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"epochs": 0}, "epochs must be at least 1, not 0"),
        ({"width": 1}, "width must be at least 2, not 1"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
    ],
)
def test_absurd_settings_are_refused(options, message):
    with pytest.raises(TrainingError, match=message):
        Autoencoder512(**options)


def test_a_diverging_training_is_stopped_and_frozen(batch):
    extractor = made(learning_rate=1e30)
    with pytest.raises(TrainingError, match=r"ae-256: the validation loss is (nan|inf) in epoch \d"):
        fit(extractor, batch[:6], batch[6:])
    assert not extractor.trainable
