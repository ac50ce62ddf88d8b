from dataclasses import replace

import numpy as np
import pytest
import shapely
import torch
from scipy.spatial.transform import Rotation

from factories import fake_batch
from foretrace.actions import LeverUp, sample_contacts
from foretrace.errors import PredictionError, TrainingError
from foretrace.features import Outline
from foretrace.features.outline import pixel_error
from foretrace.features.pivot_edges import NUM_VALUES, PROBES, RIM, find_pivot_edges
from foretrace.features.support_points import HALF_WIDTH, SETBACK
from foretrace.geometry import quaternion_to_matrix
from foretrace.imagined import FLOOR, LEVELS, Futures, quantiles_of
from foretrace.interactions.hull import MAX_CORNERS, UNIT
from foretrace.interactions.splits import Split
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE, TopDownView
from foretrace.objects import sample_prism
from foretrace.predictor import OneShotConfig, OneShotPredictor, one_shot
from foretrace.predictor.mixture import along_edges
from foretrace.predictor.parts import effects_of, features_of, prepare
from foretrace.predictor.states import Effects, encode_states
from foretrace.predictor.training import TrainConfig, fit_predictor, train_predictor
from foretrace.trajectories import mean_distance, rotation_error

CONFIG = OneShotConfig(hidden=32, outcomes=("levered", "slipped"))
QUICK = TrainConfig(epochs=2, min_steps=1, batch_size=4, learning_rate=4e-3, split=None)
LONGER = replace(QUICK, epochs=40, learning_rate=1e-2)


@pytest.fixture(scope="module")
def batch():
    torch.set_num_threads(1)
    return fake_batch(np.random.default_rng(3), 12, num_samples=24)


@pytest.fixture(scope="module")
def quick(batch):
    """A predictor that has hardly learned."""
    return fit_predictor(batch, CONFIG, everything(batch), QUICK)[0]


@pytest.fixture(scope="module")
def longer(batch):
    """A predictor that has learned the batch."""
    return fit_predictor(batch, CONFIG, everything(batch), LONGER)[0]


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


def test_the_ray_through_the_centre_of_mass_leaves_the_bottom_face_at_the_first_edge(batch):
    edges = find_pivot_edges(exact_corners(batch), torch.from_numpy(batch.com[:, 0]))
    ends, axes = edges.ends[:, 0], edges.axes[:, 0, 0]
    for row in range(len(batch)):
        outline = batch.corners[row, : batch.num_corners[row]]
        bottom = shapely.Polygon(outline).buffer(-RIM, join_style="mitre", mitre_limit=50)
        com = batch.com[row, 0, :2]
        lift = np.array([-SETBACK, HALF_WIDTH * np.sign(com[1])])
        ray = shapely.LineString([com, com + 0.5 * (com - lift) / np.linalg.norm(com - lift)])
        left = ray.intersection(bottom.exterior)
        edge = shapely.LineString(ends[row].numpy() - RIM * axes[row, 0, :2].numpy())
        assert shapely.distance(left, edge) < 1e-9
    product = axes @ axes.mT
    torch.testing.assert_close(product, torch.eye(3, dtype=torch.float64).expand_as(product))
    assert (torch.linalg.det(axes) > 0).all()
    # The first axis points out of the object.
    outwards = ends.mean(dim=1) - torch.from_numpy(batch.com[:, 0, :2])
    assert ((axes[:, 0, :2] * outwards).sum(dim=1) > 0).all()


def mirror_corners(corners: torch.Tensor) -> torch.Tensor:
    """Hulls seen in a mirror along the action axis, counter-clockwise again; the first corner fills the row."""
    count = 1 + (corners[:, 1:] != corners[:, :1]).any(dim=2).sum(dim=1, keepdim=True)
    number = torch.arange(corners.shape[1])
    order = torch.where(number < count, -number % count, 0)
    return corners.gather(1, order[..., None].expand(-1, -1, 2)) * corners.new_tensor([1.0, -1.0])


def test_the_second_edge_is_a_neighbour_of_the_first(batch):
    ends = find_pivot_edges(exact_corners(batch), torch.from_numpy(batch.com[:, 0])).ends
    after = (ends[:, 0, 1] - ends[:, 1, 0]).norm(dim=1) < 1e-12
    before = (ends[:, 0, 0] - ends[:, 1, 1]).norm(dim=1) < 1e-12
    assert (after ^ before).all()


def test_mirror_images_have_mirrored_edges(batch):
    corners, com = exact_corners(batch), torch.from_numpy(batch.com[:, 0])
    mirror = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    edges, images = find_pivot_edges(corners, com), find_pivot_edges(mirror_corners(corners), com * mirror)
    torch.testing.assert_close(images.ends.flip(2), edges.ends * mirror[:2])
    torch.testing.assert_close(images.values, edges.values.flip(1))
    torch.testing.assert_close(images.axes * mirror, edges.axes.flip(1))
    torch.testing.assert_close(mirror_corners(mirror_corners(corners)), corners)


def test_heights_are_those_above_the_places_seen_from_the_edge():
    # A block whose height grows along the action, seen as a map of cells as large as pixels.
    corners = torch.tensor([[[0.0, 0.04], [0.0, -0.04], [0.1, -0.04], [0.1, 0.04], [0.0, 0.04]]])
    x = torch.from_numpy((CONTACT_PIXEL[0] - np.arange(VIEW_SIZE)) * METRES_PER_PIXEL).float()
    heights = x[:, None].expand(-1, VIEW_SIZE)[None]
    edges = find_pivot_edges(corners, torch.tensor([[0.05, 0.001, 0.01]]), 1, heights)
    torch.testing.assert_close(edges.axes[0, 0, 0, 0], torch.tensor([1.0, 0.0, 0.0]))
    probed = 0.1 * edges.values[0, :, 0, NUM_VALUES:].unflatten(1, (PROBES, PROBES))
    expected = (torch.arange(PROBES) + 0.5) / PROBES * 0.1
    torch.testing.assert_close(probed, expected[None, :, None].expand(2, PROBES, PROBES), atol=1e-5, rtol=0)


def test_the_object_turns_about_the_second_axis(batch):
    edges = find_pivot_edges(exact_corners(batch), torch.from_numpy(batch.com[:, 0]))
    # The synthetic lever-ups turn about the edge ahead of the contact point, mostly the rule's.
    apart = np.sort(edges.ends[:, 0], axis=1) - np.sort(batch.support_points, axis=1)
    same = (np.abs(apart).max(axis=(1, 2)) < 1e-9) & (batch.outcome == "levered")
    assert same.mean() > 0.7
    states = torch.from_numpy(encode_states(batch, "turn", batch.length))
    turn = along_edges(edges.axes[same, 0, 0], states[same])[:, 11, 3:]
    assert (turn[:, 1] > 0).all()
    torch.testing.assert_close(turn[:, [0, 2]], torch.zeros(int(same.sum()), 2, dtype=torch.float64))


def test_what_is_seen_in_the_mirror_is_the_same_motion(batch):
    corners, com = exact_corners(batch), torch.from_numpy(batch.com[:, 0])
    edges = find_pivot_edges(corners, com)
    motion = torch.from_numpy(encode_states(batch, "turn", batch.length))
    images = motion * torch.tensor([1.0, -1, 1, -1, 1, -1], dtype=torch.float64)
    mirror = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    image_edges = find_pivot_edges(mirror_corners(corners), com * mirror)
    seen, seen_image = along_edges(edges.axes[:, 1], motion), along_edges(image_edges.axes[:, 0], images)
    torch.testing.assert_close(seen, seen_image)


def test_it_learns_what_it_has_seen(batch):
    config, training = replace(CONFIG, hidden=64), replace(QUICK, epochs=150, learning_rate=1e-2)
    predictor, _ = fit_predictor(batch, config, everything(batch), training)
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


def test_an_interrupted_training_ends_with_the_same_model(batch, tmp_path, monkeypatch):
    whole = train_predictor(batch, CONFIG, tmp_path / "whole", QUICK, split=everything(batch), progress=False)
    loss, calls = OneShotPredictor.training_loss, []

    def stopping(self, *args):
        calls.append(1)
        if len(calls) > 4:
            raise KeyboardInterrupt
        return loss(self, *args)

    monkeypatch.setattr(OneShotPredictor, "training_loss", stopping)
    with pytest.raises(KeyboardInterrupt):
        train_predictor(batch, CONFIG, tmp_path / "cut", QUICK, split=everything(batch), progress=False)
    monkeypatch.undo()
    cut = train_predictor(batch, CONFIG, tmp_path / "cut", QUICK, split=everything(batch), progress=False)
    assert (cut / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()


def conditioned(hidden_share):
    torch.manual_seed(0)
    config = replace(CONFIG, context=("friction", "contact_error"), hidden_share=hidden_share)
    predictor = config.make(24)
    predictor.state_mean.copy_(torch.linspace(-0.2, 0.3, 6))
    predictor.state_scale.copy_(torch.linspace(0.5, 1.5, 6))
    return predictor


def moved_effects(predictor, execution):
    """Objects with corners at the executed contact and a centimetre ahead of it, where their positions are, too."""
    rows, turn = len(execution), execution[:, 2]
    ahead = torch.stack([turn.cos(), turn.sin(), 0 * turn], dim=1)
    contact = torch.cat([execution[:, :2], torch.full((rows, 1), 0.02)], dim=1)
    corners = torch.stack([contact, contact + 0.01 * ahead] * (MAX_CORNERS // 2), dim=1)[..., :2]
    states = torch.cat(
        [torch.stack([contact, contact + 0.01 * ahead], dim=1), torch.stack([0 * ahead, ahead], 1)], -1
    )
    states = (states - predictor.state_mean) / predictor.state_scale
    features = (corners / UNIT).flatten(1)
    lengths, outcomes = torch.full((rows,), 2), torch.zeros(rows, dtype=torch.long)
    context = np.column_stack([np.full(rows, 0.8), np.where(execution.any(dim=1), np.nan, 0.0)])
    return predictor.add_context(features, context), Effects(
        states, lengths, outcomes, torch.zeros(rows, 3), execution
    )


def test_actions_executed_elsewhere_are_learned_from_as_exact_ones():
    predictor = conditioned(1e-9)
    execution = torch.tensor([[0.002, -0.001, 0.05], [0.0, 0.0, 0.0], [-0.003, 0.003, -0.04]])
    features, effects = predictor.augment(*moved_effects(predictor, execution))
    assert (features[:, -2:] == 1).all()  # told
    corners = predictor._corners(features)
    torch.testing.assert_close(
        corners[:, :2], torch.tensor([[[0.0, 0.0], [0.01, 0.0]]] * 3), atol=1e-7, rtol=0
    )
    states = effects.states * predictor.state_scale + predictor.state_mean
    there = torch.tensor([[0.0, 0.0, 0.02, 0.0, 0.0, 0.0], [0.01, 0.0, 0.02, 1.0, 0.0, 0.0]])
    torch.testing.assert_close(states, there.expand(3, 2, 6), atol=1e-6, rtol=0)


def test_where_the_contact_is_hidden_half_the_actions_are_commanded_elsewhere():
    predictor = conditioned(1.0)
    inputs, before = moved_effects(predictor, torch.zeros(4000, 3))
    inputs[:100, -1] = 0.0  # recorded, and not known to be exact
    features, effects = predictor.augment(inputs, before)
    contact = predictor._corners(features)[:, 0]
    moved = (contact != 0).any(dim=1)
    hidden = features[:, -1] == 0
    assert not moved[:100].any()
    assert not moved[~hidden].any()
    assert 0.45 < moved[100:][hidden[100:]].float().mean() < 0.55
    assert 0.0029 < contact.abs().max() <= 0.003
    there = (effects.states * predictor.state_scale + predictor.state_mean)[:, 0, :2]
    torch.testing.assert_close(there, contact, atol=1e-6, rtol=0)
    assert (before.states == moved_effects(predictor, torch.zeros(4000, 3))[1].states).all()


def test_motions_that_can_hardly_be_predicted_count_less(batch, monkeypatch):
    monkeypatch.setattr(one_shot, "SCALE_WEIGHT", 0.0)
    predictor = fit_predictor(batch, replace(CONFIG, error_weighting=0.5), everything(batch), QUICK)[0]
    plain = fit_predictor(batch, CONFIG, everything(batch), QUICK)[0]
    plain.load_state_dict(predictor.state_dict())
    part = prepare(batch, predictor)
    features, effects = features_of(part, predictor), effects_of(part, predictor)
    slipped = effects.outcomes == 1
    assert 0 < slipped.sum() < len(effects)
    for each in (predictor, plain):  # the scales of all futures of an outcome are equal
        last = each.networks
        last.weights[-1].data.unflatten(0, (last.size, 2, -1))[:, :, -2] = 0
        last.biases[-1].data.unflatten(0, (last.size, 2, -1))[..., -2] = torch.tensor([-3.0, -1.0])

    def loss(which, rows):
        torch.manual_seed(0)
        return which.training_loss(features[rows], effects[rows])

    rows = torch.arange(len(effects))
    torch.testing.assert_close(loss(predictor, slipped), loss(plain, slipped))
    counts = torch.where(slipped, np.exp(0.5), np.exp(1.5))
    losses = torch.stack([loss(plain, rows[k : k + 1]) for k in range(len(rows))])
    torch.testing.assert_close(
        loss(predictor, rows), (counts * losses).sum() / counts.sum(), rtol=1e-4, atol=0
    )
    with pytest.raises(TrainingError, match="error_weighting"):
        OneShotConfig(error_weighting=2.0)


def test_futures_are_told_apart(batch, longer):
    predictor = longer
    imagined = predictor.imagine_batch(batch)
    futures = imagined.futures
    assert futures is not None
    assert futures.outcome == ("levered", "slipped") * 2
    np.testing.assert_allclose(futures.probability.sum(axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(sum(futures.outcomes().values()), 1, atol=1e-5)
    best = futures.probability.argmax(axis=1)
    rows = np.arange(len(batch))
    np.testing.assert_array_equal(imagined.com, futures.com[rows, best])
    one = imagined[3]
    assert one.futures is not None
    np.testing.assert_array_equal(one.futures.com[0], futures.com[3])
    # Seen again, outcomes are known.
    told = np.array(futures.outcome)[best]
    assert (told == batch.outcome).mean() > 0.9


def test_regions_grow_with_their_level_and_hold_what_was_seen(batch, longer):
    predictor = longer
    futures = predictor.imagine_batch(batch).futures
    assert futures is not None
    narrow, wide = (np.nan_to_num(futures.radius(level)) for level in (0.5, 0.9))
    assert (narrow <= wide).all()
    apart = np.linalg.norm(futures.com - batch.com[:, None], axis=-1)
    inside = (apart <= futures.radius(0.5)) | ~(np.arange(24) < batch.length[:, None])[:, None]
    # The quantiles were taken from the same twelve.
    assert inside.all(axis=2).any(axis=1).sum() >= 6
    with pytest.raises(PredictionError, match=r"level 1.0 of a region: choose one from 0.01 to 0.99"):
        futures.radius(1.0)


def test_scores_in_any_order_give_regions_of_their_level():
    rng = np.random.default_rng(0)
    covered = []
    for _ in range(300):
        quantiles = quantiles_of(rng.exponential(size=99))
        covered.append(rng.exponential(size=50) <= quantiles[[49, 89]][:, None])
    np.testing.assert_allclose(np.mean(covered, axis=(0, 2)), [0.5, 0.9], atol=0.015)
    assert np.isinf(quantiles_of(rng.exponential(size=5))[-1])


def some_futures(probability=(0.7, 0.3)) -> Futures:
    """One interaction with two futures: along x at 1 m/s, and falling from the same line after ten samples."""
    com = np.zeros((2, 20, 3))
    com[..., 0] = np.arange(20) * 0.01
    com[1, 10:, 2] = -0.02 * np.arange(1, 11)
    states = np.concatenate([com, np.zeros((2, 20, 3))], axis=2)[None]
    spread = np.broadcast_to(1e-3 * np.sqrt(np.arange(20)), (1, 2, 20))
    ends = np.zeros((1, 2, 2, 2))
    return Futures(
        np.array([probability]), ("levered", "slipped"), states, spread, ends, np.ones(len(LEVELS))
    )


def test_an_object_keeps_its_distance_from_where_it_was_expected():
    futures = some_futures()
    happened = futures.states[:, 0] + [0.0, 0.005, 0.0, 0.0, 0.0, 0.1]
    given = futures.given(happened[:, :8], sample_period=0.05)
    np.testing.assert_allclose(given.states[:, 0], happened, atol=1e-12)
    np.testing.assert_array_equal(given.states[:, 1, :8], happened[:, :8])
    # A future that falls forgets it: a fifth is left after half a second.
    np.testing.assert_allclose(given.states[0, 1, 17, 1], 0.005 * np.exp(-10 * 0.05 / 0.3), atol=1e-12)
    # Both fit equally well so far.
    np.testing.assert_allclose(given.probability, futures.probability, atol=1e-12)
    assert (given.spread[:, :, :8] == 0).all()
    # 5 mm where 2.6 were expected: what follows is less sure by the same factor.
    factor = 0.005 / (futures.spread[0, 0, 7] + FLOOR)
    np.testing.assert_allclose(given.spread[0, 0, 11], factor * 1e-3 * np.sqrt(11 - 7), rtol=1e-6)


def test_a_future_that_the_beginning_leaves_becomes_improbable():
    futures = some_futures((0.9, 0.1))
    for fate, other in ((0, 1), (1, 0)):
        given = futures.given(futures.states[:, fate, :14], sample_period=0.05)
        assert given.probability[0, fate] > given.probability[0, other]
        np.testing.assert_allclose(given.states[0, fate], futures.states[0, fate], atol=1e-12)
    assert given.radius(0.9)[0, 1, -1] < futures.radius(0.9)[0, 1, -1]


def test_drawn_samples_spread_as_far_as_predicted(batch, longer):
    predictor = longer
    assert isinstance(predictor, OneShotPredictor)
    features = predictor.compute_features(predictor.features.inputs(batch))
    mixture = predictor.mixture(features, torch.from_numpy(batch.com[:, 0]).float())
    alone = torch.full_like(mixture.log_probability, -torch.inf)
    alone[:, 0, 0] = 0.0
    drawn = replace(mixture, log_probability=alone).sample(4000, torch.Generator().manual_seed(0))[..., :3]
    found = (drawn - mixture.states()[:, :1, :, :3]).square().sum(dim=-1).mean(dim=1).sqrt()
    torch.testing.assert_close(found, mixture.spread()[:, 0], rtol=0.05, atol=1e-6)


def test_heights_tell_objects_of_one_outline_apart(batch):
    tall = replace(batch, height=np.where(np.arange(len(batch))[:, None, None] % 2, 2, 1) * batch.height)
    config = replace(CONFIG, feature_options={"heights": True})
    predictor, _ = fit_predictor(tall, config, everything(tall), QUICK)
    lower = replace(tall, height=batch.height)
    changed = np.abs(predictor.imagine_batch(tall).com - predictor.imagine_batch(lower).com).max(axis=(1, 2))
    assert (changed[1::2] > 1e-7).all()
    assert (changed[::2] < 1e-8).all()


@pytest.mark.parametrize("heights", [False, True])
def test_many_contacts_of_one_object_at_once(batch, longer, heights):
    predictor = longer
    if heights:
        config = replace(CONFIG, feature_options={"heights": heights})
        predictor, _ = fit_predictor(batch, config, everything(batch), LONGER)
    rng = np.random.default_rng(5)
    prism = sample_prism(rng, 5)
    actions = sample_contacts(prism, rng, per_edge=2)
    views = [TopDownView.of(prism, action) for action in actions]
    frames = [actions[0].T_action_object @ np.linalg.inv(action.T_action_object) for action in actions]
    many = predictor.imagine_candidates(views[0], [LeverUp(f[:2, 3], f[:2, 0]) for f in frames])
    one = predictor.imagine(views[0])
    np.testing.assert_allclose(many.com[0], one.com_trajectory, atol=2e-6)
    # Pixels hide where exactly the corners are: a millimetre.
    others = np.array([predictor.imagine(view).com_trajectory for view in views])
    apart = np.linalg.norm(many.com - others, axis=2).max(axis=1)
    assert np.median(apart) < 1.5e-3


def test_an_unknown_thickness_is_not_blown_up(batch, longer):
    assert np.ptp(batch.com[:, 0, 2]) < 1e-3  # all are of one thickness
    view = TopDownView(batch.mask[0], batch.height[0])
    ends = [
        longer.imagine(view, com=com).com_trajectory[-1] - com
        for com in batch.com[0, 0] * [[1, 1, 1], [1, 1, 2]]
    ]
    assert np.linalg.norm(ends[0] - ends[1]) < 5e-3


def test_outcomes_that_are_not_learned_are_refused(batch):
    with pytest.raises(TrainingError, match="outcome 'slipped', and the predictor distinguishes levered"):
        fit_predictor(batch, replace(CONFIG, outcomes=("levered",)), everything(batch), QUICK)


def test_the_context_changes_what_is_predicted(batch):
    varied = replace(batch, parameters=batch.parameters | {"friction": np.linspace(0.3, 0.9, len(batch))})
    config = replace(CONFIG, context=("friction",))
    predictor, _ = fit_predictor(varied, config, everything(varied), replace(QUICK, epochs=20))
    other = predictor.imagine_batch(
        replace(varied, parameters=varied.parameters | {"friction": varied.parameters["friction"][::-1]})
    )
    assert not np.allclose(other.com, predictor.imagine_batch(varied).com, atol=1e-7)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"outcomes": ("flown",)}, "unknown outcome 'flown'; choose from levered, slipped"),
        ({"outcomes": ()}, r"outcomes is \(\): name at least one"),
        ({"ensemble": 0}, "ensemble is 0: give a number from 1"),
        ({"components": 100_000}, "components is 100000: give a number from 1 to 1024"),
        ({"pivot_edges": 3}, "pivot_edges is 3: choose from 1, 2"),
        ({"features": "magic"}, "unknown features 'magic'; available: none, im-cnn"),
        ({"features": "im-cnn"}, "not im-cnn: train it with features 'outline'"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(TrainingError, match=message):
        OneShotConfig(**settings).make(24)


def test_centres_of_outlines_along_the_pixels_are_unsure():
    """As far as those of random rectangles, rasterised, are off."""
    rng = np.random.default_rng(0)
    errors, expected = [], []
    for angle in (0.0, 0.3):
        for _ in range(60):
            size, middle = rng.uniform(0.08, 0.16, 2), np.array([0.12, 0.0]) + rng.uniform(-1, 1, 2) * 0.002
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2 @ turn.T + middle
            rows, columns = np.indices((VIEW_SIZE, VIEW_SIZE))
            places = (CONTACT_PIXEL - np.stack([rows, columns], axis=-1)) * METRES_PER_PIXEL
            mask = shapely.contains_xy(shapely.Polygon(corners), *np.moveaxis(places, -1, 0))
            errors.append(np.linalg.norm(places[mask].mean(axis=0) - middle))
            row = torch.from_numpy(corners).float()[[0, 1, 2, 3, *[0] * (MAX_CORNERS - 4)]]
            expected.append(float(pixel_error(row[None])))
    errors, expected = np.reshape(errors, (2, -1)), np.reshape(expected, (2, -1))
    root = np.sqrt((errors**2).mean(axis=1)), np.sqrt((expected**2).mean(axis=1))
    assert root[1][0] == pytest.approx(root[0][0], rel=0.25)
    assert root[1][1] == 0
    assert root[0][1] < 0.3 * root[0][0]


def test_corners_are_read_in_their_unit(batch):
    corners = Outline().inputs(batch).unflatten(1, (MAX_CORNERS, 2)) * UNIT
    assert (corners[:, 0].norm(dim=1) < 0.3).all()
    assert corners.std() > 0.03
