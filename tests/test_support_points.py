from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from factories import fake_batch
from foretrace.errors import PredictionError, TrainingError
from foretrace.features import FitPart, make_features, support_point_accuracy, support_points
from foretrace.features.support_points import (
    UNIT,
    RayFrame,
    SupportPointNetwork,
    hull_and_com,
    nearest_edges,
    order_points,
    points_of,
    support_points_by_rule,
)
from foretrace.interactions.hull import approximate_corners

EPOCHS = 150


AT_CONTACT = {"setback": 0.0, "half_width": 0.0}
"""The synthetic objects are lifted at the contact point itself."""


@pytest.fixture(scope="module")
def batch():
    torch.set_num_threads(1)
    return fake_batch(np.random.default_rng(1), 80, num_samples=12)


def without_corners(batch):
    return replace(batch, corners=np.full_like(batch.corners, np.nan))


def fit(extractor, train, validation, seed: int = 0) -> list[str]:
    lines: list[str] = []
    parts = [FitPart(extractor.inputs(part), part) for part in (train, validation)]
    extractor.fit(*parts, seed=seed, report=lines.append)
    return lines


def made(**options):
    torch.manual_seed(0)
    return make_features("sp-pred", **options)


def test_the_rule_names_the_edge_that_the_object_turns_about(batch):
    points = support_points_by_rule(batch, **AT_CONTACT)
    np.testing.assert_allclose(points, order_points(batch.support_points), atol=1e-12)
    assert support_point_accuracy(points, batch.corners, batch.support_points) == 1.0


def test_the_rule_works_on_the_mask_alone(batch):
    points = support_points_by_rule(without_corners(batch), **AT_CONTACT)
    assert support_point_accuracy(points, batch.corners, batch.support_points) > 0.85
    assert np.median(np.linalg.norm(points - support_points_by_rule(batch, **AT_CONTACT), axis=-1)) < 0.005


def test_corners_from_the_mask_are_near_the_objects(batch):
    counts, off = [], []
    for row in range(len(batch)):
        corners = batch.corners[row][: batch.num_corners[row]]
        seen, com = hull_and_com(without_corners(batch), row)
        counts.append(len(seen) - len(corners))
        off.extend(np.linalg.norm(corners[:, None] - seen[None], axis=-1).min(axis=1))
        assert np.linalg.norm(com - hull_and_com(batch, row)[1]) < 0.002
    assert abs(np.mean(counts)) < 0.5
    assert np.median(off) < 0.004


def test_a_pixel_staircase_has_the_corners_of_its_square():
    side = np.arange(10) * 0.0032
    zeros, ends = np.zeros(10), np.full(10, 0.032)
    square = [
        np.stack(p, 1) for p in ((side, zeros), (ends, side), (0.032 - side, ends), (zeros, 0.032 - side))
    ]
    corners = approximate_corners(np.concatenate(square))
    np.testing.assert_allclose(
        sorted(map(tuple, corners)), [(0, 0), (0, 0.032), (0.032, 0), (0.032, 0.032)], atol=1e-6
    )


def test_only_the_hull_of_known_corners_counts(batch):
    star = np.array(
        [[0, -0.02], [0.03, -0.01], [0.1, -0.05], [0.06, 0.0], [0.1, 0.05], [0.03, 0.01], [0, 0.02]]
    )
    one = replace(batch[:1], corners=star[None], num_corners=np.array([7]))
    hull, com = hull_and_com(one, 0)
    assert len(hull) == 4
    assert com[1] == pytest.approx(0)
    np.testing.assert_allclose(support_points_by_rule(one)[0], [[0.1, -0.05], [0.1, 0.05]])


def test_the_line_of_action_and_the_blades_corner_move_the_edge(batch):
    # The centre of mass lies at (0.06, 0.02), so that the ray from the contact point has slope 1 / 3.
    far = np.array([[0.12, -0.05], [0.12, 0.037], [0.0, 0.083], [0.0, -0.05]])

    def edge(setback, half_width, corners=far):
        com = np.array([0.06, 0.02])
        one = replace(batch[:1], corners=corners[None], num_corners=np.array([4]))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(support_points, "hull_and_com", lambda *_: (corners, com))
            return support_points_by_rule(one, setback, half_width)[0].tolist()

    front, side = far[:2].tolist(), far[1:3].tolist()
    assert edge(0.0, 0.0) == side  # at x = 0.12 the ray has y = 0.040
    assert edge(0.02, 0.0) == front  # 0.035
    assert edge(0.0, 0.005) == front  # 0.035
    assert edge(0.0, 0.001) == side  # 0.039


def test_the_right_point_comes_first():
    right, left = [0.1, -0.05], [0.08, 0.05]
    ordered = order_points(np.array([[right, left], [left, right], [[np.nan] * 2] * 2]))
    np.testing.assert_array_equal(ordered[:2], [[right, left]] * 2)
    assert np.isnan(ordered[2]).all()


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 10_000))
def test_the_mirror_image_turns_about_the_mirror_image_of_the_edge(seed):
    batch = fake_batch(np.random.default_rng(seed), 1, num_samples=12)
    flip = np.array([1.0, -1.0])
    mirrored = replace(batch, corners=batch.corners[:, ::-1] * flip)
    expected = support_points_by_rule(batch)[:, ::-1] * flip
    np.testing.assert_allclose(support_points_by_rule(mirrored), expected, atol=1e-12)


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_the_mirror_image_has_the_mirror_image_of_the_prediction(seed):
    batch = fake_batch(np.random.default_rng(seed), 1, num_samples=12)
    flip = np.array([1.0, -1.0])
    mirrored = replace(batch, corners=batch.corners[:, ::-1] * flip)
    for snapped in (False, True):
        extractor = made(snapped=snapped)
        one, other = (points_of(extractor(extractor.inputs(part))) for part in (batch, mirrored))
        np.testing.assert_allclose(other, one[:, ::-1] * flip, atol=1e-6)


def test_the_frame_has_the_centre_of_mass_straight_ahead(batch):
    inputs = make_features("sp-pred").inputs(batch)
    frame = RayFrame.through(inputs[:, 0, :2])
    com, contact = frame.enter(inputs[:, :1]), frame.enter(torch.zeros(len(batch), 1, 2))
    torch.testing.assert_close(com[:, 0, 1], torch.zeros(len(batch)), atol=1e-6, rtol=0)
    assert (com[:, 0, 0] > 0).all()
    assert (com[:, 0, 0] > contact[:, 0, 0]).all()
    assert 0.1 < frame.mirrored.float().mean() < 0.9
    pairs = torch.from_numpy(order_points(batch.support_points) / UNIT).float()
    torch.testing.assert_close(frame.leave(frame.enter(pairs)), pairs)
    inside = frame.enter(pairs).numpy()
    np.testing.assert_array_equal(order_points(inside), inside)  # still right first


def test_a_prediction_is_the_nearest_edge_of_the_hull(batch):
    inputs = make_features("sp-pred").inputs(batch)
    for row in range(0, len(batch), 7):
        hull = hull_and_com(batch, row)[0]
        edges = np.stack([hull, np.roll(hull, -1, axis=0)], axis=1)
        for edge in edges:
            near = torch.from_numpy((0.7 * edge + 0.3 * hull.mean(axis=0)) / UNIT).float()[None]
            found = UNIT * nearest_edges(inputs[row : row + 1], near)[0].double().numpy()
            distances = ((edges - UNIT * near.numpy()) ** 2).sum(axis=(1, 2))
            np.testing.assert_allclose(found, edges[distances.argmin()], atol=1e-7)


def test_features_are_points_in_units_of_10_cm(batch):
    rule = make_features("sp-rule")
    elsewhere = make_features("sp-rule", **AT_CONTACT)
    features = rule(rule.inputs(batch))
    np.testing.assert_allclose(features[:, :2] * UNIT, support_points_by_rule(batch)[:, 0], atol=1e-7)
    np.testing.assert_allclose(points_of(features), support_points_by_rule(batch), atol=1e-7)
    expected = support_points_by_rule(batch, **AT_CONTACT)
    np.testing.assert_allclose(points_of(elsewhere.inputs(batch)), expected, atol=1e-7)


def test_the_truth_is_what_was_observed_or_else_the_rule(batch):
    moved = batch.support_points + np.array([0.003, 0.0])
    moved[3] = np.nan
    partly = replace(batch, support_points=moved)
    truth = make_features("sp-truth")
    points = points_of(truth.inputs(partly))
    rule = support_points_by_rule(batch)
    seen = np.arange(len(batch)) != 3
    np.testing.assert_allclose(
        points[seen], order_points(batch.support_points)[seen] + np.array([0.003, 0.0]), atol=1e-7
    )
    np.testing.assert_allclose(points[3], rule[3], atol=1e-7)
    assert np.isnan(partly.support_points[3]).all()  # the batch itself is left alone
    assert truth.oracle


def test_accuracy_wants_both_corners_and_no_order():
    corners = np.array([[[0.0, -0.05], [0.1, -0.05], [0.1, 0.05], [0.0, 0.05], [np.nan, np.nan]]] * 5)
    observed = np.array([[[0.095, -0.045], [0.095, 0.045]]] * 5)
    predicted = observed.copy()
    predicted[1] = observed[1, ::-1] + 0.01
    predicted[2, 0] = [0.01, -0.05]  # one wrong
    predicted[3, 0] = predicted[3, 1]  # twice the same
    observed[4] = np.nan  # left out
    assert support_point_accuracy(predicted, corners, observed) == 2 / 4
    assert np.isnan(support_point_accuracy(predicted[4:], corners[4:], observed[4:]))


def test_the_network_is_the_papers():
    network = SupportPointNetwork()
    shapes = [tuple(p.shape) for name, p in network.named_parameters() if name.endswith("weight")]
    assert shapes == [(128, 2), (128, 128), (128, 128), (128, 128), (128, 128), (4, 128)]


def test_neither_order_nor_padding_of_corners_matters(batch):
    network = SupportPointNetwork().eval()
    corners = make_features("sp-pred").inputs(batch)
    expected = network(corners)
    torch.testing.assert_close(network(corners.flip(1)), expected)
    padded = torch.cat([corners, torch.zeros(len(batch), 3, 3)], dim=1)
    torch.testing.assert_close(network(padded), expected)


@pytest.mark.parametrize(
    ("options", "learned", "generalised"),
    [
        ({"epochs": 60, "batch_size": 16}, 0.85, 0.7),
        ({"epochs": EPOCHS, "batch_size": 32, "aligned": False, "snapped": False}, 0.6, 0.4),
    ],
)
def test_it_learns_support_points(batch, options, learned, generalised):
    extractor = made(**options)
    train = batch[:60]
    lines = fit(extractor, train, batch[60:])
    assert len(lines) <= 11
    accuracy = [
        support_point_accuracy(
            points_of(extractor(extractor.inputs(part))), part.corners, part.support_points
        )
        for part in (train, batch[60:])
    ]
    assert accuracy[0] > learned
    assert accuracy[1] > generalised  # chance is about a quarter
    assert not extractor.trainable


def test_the_same_seed_learns_the_same_from_what_was_observed(batch):
    def weights(points, seed=0):
        extractor = made(epochs=3)
        part = replace(batch, support_points=points)
        fit(extractor, part[:60], part[60:], seed)
        return extractor.network.state_dict()["output.weight"]

    partly = batch.support_points.copy()
    partly[:5] = np.nan
    partly[70] = np.nan
    one = weights(partly)
    assert torch.isfinite(one).all()
    assert torch.equal(one, weights(partly))
    assert torch.equal(one, weights(partly[:, ::-1]))  # however the two were noted down
    assert not torch.equal(one, weights(partly, seed=1))


def test_the_validation_part_is_not_learned_from(batch):
    def weights(shift):
        extractor = made(epochs=3, patience=3, batch_size=8)
        points = batch.support_points.copy()
        points[60:] = points[60:] + shift
        part = replace(batch, support_points=points)
        lines = fit(extractor, part[:60], part[60:])
        assert "epoch 3" in lines[-1]
        return extractor.network.state_dict()["output.weight"]

    assert torch.equal(weights(0.0), weights(0.001))


def test_nothing_observed_is_refused_in_training_and_endured_in_validation(batch):
    nothing = replace(batch, support_points=np.full_like(batch.support_points, np.nan))
    with pytest.raises(TrainingError, match=r"none of the 60 interactions .* use sp-rule"):
        fit(made(epochs=2), nothing[:60], batch[60:])
    assert "best validation loss" in fit(made(epochs=2), batch[:60], nothing[60:])[-1]


def test_a_contact_at_the_centre_of_mass_is_refused(batch):
    square = np.array([[[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]])
    with pytest.raises(PredictionError, match=r"interaction 0: no edge lies beyond"):
        support_points_by_rule(replace(batch[:1], corners=square))


def test_neither_corners_nor_mask_is_refused(batch):
    blind = without_corners(fake_batch(np.random.default_rng(1), 2, num_samples=12))
    blind.mask[1] = False
    with pytest.raises(PredictionError, match="mask of interaction 1 is empty"):
        make_features("sp-pred").inputs(blind)
