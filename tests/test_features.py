"""One suite over every entry of FEATURES, and what is particular to the convolutional ones."""

from copy import deepcopy
from functools import cache

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from factories import QUICK_OPTIONS, fake_batch
from foretrace.errors import TrainingError
from foretrace.features import FEATURES, FitPart, ImageCnn, make_features
from foretrace.features import base as base_module
from foretrace.features.base import fast_precision
from foretrace.features.windows import convolve_windows
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.topdown import TopDownView

every_label = pytest.mark.parametrize("label", list(FEATURES))


@pytest.fixture(scope="module")
def batch():
    torch.set_num_threads(1)
    return fake_batch(np.random.default_rng(0), 6)


def fitted(label: str):
    """A copy of the extractor, fitted to six interactions."""
    return deepcopy(_fitted(label))


@cache
def _fitted(label: str):
    torch.manual_seed(0)
    batch = fake_batch(np.random.default_rng(0), 6)
    extractor = make_features(label, **QUICK_OPTIONS.get(label, {}))
    part = FitPart(extractor.inputs(batch), batch)
    extractor.fit(part, part, seed=0, report=lambda line: None)
    return extractor


@every_label
def test_one_row_of_num_features_per_interaction(label, batch):
    extractor = fitted(label).eval()
    inputs = extractor.inputs(batch)
    assert len(inputs) == len(batch)
    assert inputs.device.type == "cpu"
    features = extractor(inputs)
    assert features.shape == (len(batch), extractor.num_features)
    assert features.dtype == torch.float32
    assert torch.isfinite(features).all()


@every_label
def test_label_is_the_key(label):
    assert FEATURES[label].label == label
    assert isinstance(FEATURES[label].oracle, bool)


@every_label
def test_a_batch_equals_its_singles(label, batch):
    extractor = fitted(label).eval()
    together = extractor(extractor.inputs(batch))
    alone = torch.cat([extractor(extractor.inputs(batch[k : k + 1])) for k in range(len(batch))])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-5)


@every_label
def test_gradient_if_and_only_if_trainable(label, batch):
    extractor = fitted(label).train()
    features = extractor(extractor.inputs(batch))
    assert features.requires_grad == extractor.trainable
    if extractor.trainable:
        features.square().sum().backward()
        gradients = [p.grad for p in extractor.parameters() if p.requires_grad]
        assert all(gradient is not None and gradient.abs().sum() > 0 for gradient in gradients)


@every_label
def test_preparing_inputs_learns_and_draws_nothing(label, batch):
    extractor = fitted(label)
    before = torch.random.get_rng_state()
    first, second = extractor.inputs(batch), extractor.inputs(batch)
    assert torch.equal(first, second)
    assert torch.equal(before, torch.random.get_rng_state())


@every_label
def test_remade_from_label_options_and_tensors(label, batch):
    extractor = fitted(label).eval()
    again = make_features(label, **extractor.options).eval()
    again.load_state_dict(extractor.state_dict())
    inputs = extractor.inputs(batch)
    assert torch.equal(extractor(inputs), again(again.inputs(batch)))


@every_label
def test_only_oracles_read_the_effect(label, batch):
    extractor = fitted(label).eval()
    other = fake_batch(np.random.default_rng(0), 6)
    for name in ("com", "pose", "support_points"):
        getattr(other, name)[:] += 0.01
    same = torch.equal(extractor(extractor.inputs(batch)), extractor(extractor.inputs(other)))
    assert same != extractor.oracle


@every_label
def test_a_view_alone_has_features(label, batch):
    extractor = fitted(label).eval()
    views = InteractionBatch.from_views(
        [TopDownView(m, h) for m, h in zip(batch.mask, batch.height, strict=True)]
    )
    features = extractor(extractor.inputs(views))
    assert features.shape == (len(batch), extractor.num_features)
    assert torch.isfinite(features).all()


def test_unknown_labels_are_refused_with_the_alternatives():
    with pytest.raises(TrainingError, match=r"'im-cmm'; available: none, im-cnn"):
        make_features("im-cmm")


def test_unknown_options_are_refused_with_the_alternatives():
    with pytest.raises(TrainingError, match=r"im-cnn has no option 'chanel'; it has: channel"):
        make_features("im-cnn", chanel="mask")
    with pytest.raises(TrainingError, match=r"none has no option 'width'; it has: none"):
        make_features("none", width=3)


def test_the_cnn_is_the_papers_stack(batch):
    extractor = fitted("im-cnn").eval()
    shapes = [tuple(p.shape) for name, p in extractor.stack.named_parameters() if name.endswith("weight")]
    assert shapes == [(32, 1, 3, 3), (64, 32, 3, 3), (128, 64, 3, 3), (256, 128, 3, 3)]

    def stack(x):
        for convolution in extractor.stack.convolutions:  # written as the paper says it: ReLU, then pooling
            weight = convolution.weight.detach().contiguous()
            x = F.max_pool2d(F.relu(F.conv2d(x.contiguous(), weight, convolution.bias, padding=1)), 2)
        return x

    x = convolve_windows(extractor.inputs(batch), stack, channels=256)
    assert x.shape == (len(batch), 256, 8, 8)
    expected = F.relu(F.linear(x.flatten(1), extractor.dense.weight, extractor.dense.bias))
    torch.testing.assert_close(extractor(extractor.inputs(batch)), expected, rtol=1e-4, atol=1e-5)


def test_the_cnn_sees_the_channel_it_is_told_to(batch):
    mask, height = ImageCnn().inputs(batch), ImageCnn(channel="height").inputs(batch)
    assert mask.dtype == torch.uint8
    np.testing.assert_array_equal(mask[:, 0].numpy().astype(bool), batch.mask)
    np.testing.assert_allclose(height[:, 0].numpy() * 0.1, batch.height, atol=1e-7)


def test_reduced_precision_is_for_training_alone(batch):
    extractor = ImageCnn(dropout=0.0)
    inputs = extractor.inputs(batch)
    exact = extractor.eval()(inputs)
    extractor.precision = "bfloat16"
    assert torch.equal(extractor.eval()(inputs), exact)
    reduced = extractor.train()(inputs)
    assert not torch.equal(reduced, exact)
    torch.testing.assert_close(reduced, exact, rtol=0.05, atol=0.02)
    assert reduced.dtype == torch.float32


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [
        ({}, "float32"),
        ({"amx_bf16": True}, "bfloat16"),
        ({"avx512_bf16": True, "amx_bf16": False}, "bfloat16"),
    ],
)
def test_precision_follows_the_hardware(monkeypatch, capabilities, expected):
    monkeypatch.setattr(base_module.torch.cpu, "get_capabilities", lambda: capabilities)
    assert fast_precision(torch.device("cpu")) == expected
