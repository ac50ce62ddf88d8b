"""One check suite over every registered predictor."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
import tyro

from factories import besides_doubt, fake_batch, fake_interactions
from foretrace.actions import LeverUp, ToolPath
from foretrace.errors import PredictionError, TrainingError
from foretrace.geometry import quaternion_to_matrix
from foretrace.imagined import ImaginedBatch
from foretrace.imagined.context import CONSTANTS
from foretrace.imagined.imaginer import UNSURE, UNSURE_OF
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.splits import Split
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Box
from foretrace.predictor import (
    PREDICTORS,
    EffectPredictor,
    LstmConfig,
    ObservedMotion,
    OneShotConfig,
    PredictorConfig,
    TrainConfig,
    fit_predictor,
    load_predictor,
    save_checkpoint,
)
from foretrace.trajectories import mean_distance

SAMPLES = 24
QUICK = TrainConfig(epochs=2, min_steps=1, batch_size=4, split=None, threads=1)
OWN = LeverUp((0.0, 0.0), (1.0, 0.0))
"""The action of a view, in the view's frame."""


def small(config: PredictorConfig) -> PredictorConfig:
    """The same with few units, where it has some."""
    sizes = {"hidden": 16, "ensemble": 2, "components": 8}
    there = {field.name for field in fields(config)}
    return replace(config, **{name: size for name, size in sizes.items() if name in there})


CASES: dict[str, PredictorConfig] = {
    **{label: small(PREDICTORS[label].config_class()) for label in PREDICTORS},
    "lstm, pose": LstmConfig(features="sp-rule", state="pose", steps_ahead=2, hidden=16),
    "lstm, mirrored": LstmConfig(features="im-cnn", feature_options={"width": 8}, hidden=16, mirrored=True),
    "lstm, mirrored poses": LstmConfig(features="sp-rule", state="pose", hidden=16, mirrored=True),
    "lstm, mirrored turns": LstmConfig(
        features="pivot-edge", state="turn", context=("friction",), hidden=16, mirrored=True
    ),
    "lstm, context": LstmConfig(features="none", context=("friction", "sweep"), hidden=16),
    "one-shot, all": OneShotConfig(
        feature_options={"heights": True}, context=("friction",), outcomes=("levered", "slipped"),
        hidden=16, ensemble=2, components=8,
    ),
    "one-shot, bare": OneShotConfig(pivot_edges=1, mirrored=False, hidden=16, ensemble=1, layers=1, components=4),
}  # fmt: skip
"""Every registered predictor as it comes, and settings that change its shapes."""
CASES["lstm"] = replace(CASES["lstm"], feature_options={"width": 8})


@pytest.fixture(scope="module")
def batch() -> InteractionBatch:
    torch.set_num_threads(1)
    return fake_batch(np.random.default_rng(3), 10, num_samples=SAMPLES)


@pytest.fixture(scope="module", params=list(CASES))
def predictor(request, batch) -> EffectPredictor:
    """Hardly trained."""
    config = CASES[request.param]
    rows = np.arange(len(batch))
    if "slipped" not in getattr(config, "outcomes", ("slipped",)):
        rows = rows[batch.outcome == "levered"]
    return fit_predictor(batch, config, Split(rows, rows, rows), QUICK)[0]


def view_of(batch: InteractionBatch, row: int) -> TopDownView:
    return TopDownView(batch.mask[row], batch.height[row])


def context_of(predictor: EffectPredictor) -> dict[str, float]:
    return {name: 0.6 for name in predictor.context}


def with_parameters(batch: InteractionBatch, values: dict[str, float]) -> InteractionBatch:
    columns = {name: np.full(len(batch), value) for name, value in values.items()}
    return replace(batch, parameters=batch.parameters | columns)


def doors(predictor: EffectPredictor, view: TopDownView) -> list[ImaginedBatch]:
    """One scene through all three doors."""
    context = context_of(predictor)
    seen = InteractionBatch.from_views([view])
    seen = with_parameters(seen, context)
    return [
        predictor.imagine_batch(seen, "estimated"),
        predictor.imagine_candidates(view, [OWN], context=context),
    ]


def test_shapes_frames_and_probabilities(predictor, batch):
    imagined = predictor.imagine_batch(batch)
    futures, n = imagined.futures, len(batch)
    np.testing.assert_array_equal(imagined.times, batch.times)
    np.testing.assert_array_equal(predictor.sample_times, batch.times)
    assert imagined.com.shape == (n, SAMPLES, 3)
    assert np.isfinite(imagined.com).all()
    np.testing.assert_allclose(imagined.com[:, 0], batch.com[:, 0], atol=1e-6)
    assert futures.states.shape == (n, len(futures.outcome), SAMPLES, 6)
    np.testing.assert_allclose(futures.probability.sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(sum(futures.outcomes().values()), 1, atol=1e-6)
    best = futures.com[np.arange(n), futures.probability.argmax(axis=1)]
    np.testing.assert_allclose(imagined.com, best, atol=1e-12)
    assert set(futures.outcome) == set(predictor.outcomes or [" or ".join(predictor.learned_from)])
    assert futures.is_point == bool(np.isnan(futures.radius(0.9)).all())
    if predictor.state == "position":
        assert imagined.pose is None
        assert np.isnan(futures.states[..., 3:]).all()
    else:
        turned = quaternion_to_matrix(imagined.pose[..., 3:])
        np.testing.assert_allclose(turned[:, 0], np.broadcast_to(np.eye(3), (n, 3, 3)), atol=0.01)
        rows = np.arange(n), futures.probability.argmax(axis=1)
        np.testing.assert_allclose(quaternion_to_matrix(futures.pose[rows][..., 3:]), turned, atol=1e-6)
    assert [besides_doubt(said) for said in imagined.warnings] == [()] * n


def test_batch_singles_and_candidates_are_the_same(predictor, batch):
    context = context_of(predictor)
    seen = InteractionBatch.from_views([view_of(batch, row) for row in range(len(batch))])
    seen = with_parameters(seen, context)
    whole = predictor.imagine_batch(seen, "estimated")
    for row in (0, 4, 9):
        one = predictor.imagine(view_of(batch, row), context=context)
        candidate = predictor.imagine_candidates(view_of(batch, row), (OWN,), context=context)[0]
        for other in (one, candidate):
            np.testing.assert_allclose(other.com_trajectory, whole.com[row], atol=2e-6)
            np.testing.assert_allclose(
                other.futures.probability[0], whole.futures.probability[row], atol=1e-5
            )
            assert other.warnings == whole.warnings[row]
            assert (other.pose_trajectory is None) == (whole.pose is None)


def test_candidates_are_seen_in_their_own_frames(predictor, batch):
    box = Box(0.15, 0.13, 0.02)
    actions = [LeverUp.at_edge(box, edge, 0.4) for edge in range(4)]
    T = actions[0].T_action_object
    moved = [LeverUp(T[:2, :2] @ a.contact + T[:2, 3], T[:2, :2] @ a.direction) for a in actions]
    context = context_of(predictor)
    many = predictor.imagine_candidates(TopDownView.of(box, actions[0]), iter(moved), context=context)
    alone = [predictor.imagine(TopDownView.of(box, a), context=context).com_trajectory for a in actions]
    np.testing.assert_allclose(many.com[:, 0], [com[0] for com in alone], atol=2e-3)
    moves = np.abs(np.diff(alone, axis=0)).max()
    # Pixels of the views differ, and an untrained network makes much of it.
    assert np.abs(many.com - alone).max() < max(0.5 * moves, 3e-3)


def test_saved_and_loaded_is_the_same(predictor, batch, tmp_path):
    save_checkpoint(tmp_path, predictor)
    again = load_predictor(tmp_path)
    assert type(again) is type(predictor)
    assert again.config == predictor.config
    assert again.learned_from == predictor.learned_from
    assert again.ranges == predictor.ranges
    found, expected = again.imagine_batch(batch), predictor.imagine_batch(batch)
    np.testing.assert_array_equal(found.com, expected.com)
    np.testing.assert_array_equal(found.futures.probability, expected.futures.probability)


@pytest.mark.parametrize("label", [label for label in CASES if "bare" not in label])
def test_four_lever_ups_are_learned_by_heart(label, batch):
    config = CASES[label]
    four = batch[np.flatnonzero(batch.outcome == "levered")[:4]]
    rows = np.arange(4)
    options = {"width": 4, "dropout": 0.0} if config.features == "im-cnn" else config.feature_options
    config = replace(config, hidden=32, feature_options=options)
    training = TrainConfig(epochs=60, min_steps=1, batch_size=4, learning_rate=1e-2, split=None, threads=1)
    predictor, _ = fit_predictor(four, config, Split(rows, rows, rows), training)
    error = mean_distance(predictor.imagine_batch(four).com, four.com).mean()
    still = mean_distance(np.repeat(four.com[:, :1], SAMPLES, axis=1), four.com).mean()
    assert error < 0.2 * still


def test_mirror_images_have_mirrored_motions_where_claimed(predictor, batch):
    apart = np.abs(
        predictor.imagine_batch(batch.mirrored()).com * [1, -1, 1] - predictor.imagine_batch(batch).com
    ).max()
    assert (apart < 1e-5) == predictor.is_symmetric


def test_an_object_that_is_unusual_is_pointed_out_at_every_door(predictor):
    large = Box(0.28, 0.26, 0.09)
    view = TopDownView.of(large, LeverUp.at_edge(large, 0))
    one = predictor.imagine(view, context=context_of(predictor)).warnings
    assert {line.split()[0] for line in one} >= {"length", "width", "height"}
    for imagined in doors(predictor, view):
        assert imagined.warnings == (one,)


def test_an_expected_error_of_a_centimetre_is_pointed_out(predictor, batch):
    imagined = predictor.imagine_batch(batch)
    errors = imagined.futures.expected_error()
    for error, said in zip(errors, imagined.warnings, strict=True):
        doubts = [line for line in said if line.startswith("an error of")]
        assert doubts == [UNSURE_OF.format(100 * error)] * bool(error > UNSURE)
    assert np.isnan(errors).all() == imagined.futures.is_point


def test_a_path_that_is_not_nominal_is_pointed_out_at_every_door(predictor, batch):
    action = replace(OWN, path=ToolPath(sweep=0.5).faster(1.2))
    view = view_of(batch, 4)
    context = {name: value for name, value in context_of(predictor).items() if name in CONSTANTS}
    one = predictor.imagine(view, action, context=context)
    names = {"sweep": 0.5, "speed": 1.2}
    expected = [
        f"{name} {value} is not the nominal {1 if name == 'speed' else 0.75}, and the predictor is not "
        "conditioned on it"
        for name, value in names.items()
        if name not in predictor.context
    ]
    told = [f"{name} " for name in names if name in predictor.context and name in predictor.ranges]
    found = besides_doubt(one.warnings)
    assert [line for line in found if "is far outside" not in line] == expected
    assert all(any(line.startswith(name) and "far outside" in line for line in found) for name in told)
    seen = with_parameters(InteractionBatch.from_views([view]), context | names)
    assert predictor.imagine_batch(seen, "estimated").warnings == (one.warnings,)
    candidates = predictor.imagine_candidates(view, [action, OWN], context=context)
    assert candidates.warnings[0] == one.warnings
    assert besides_doubt(candidates.warnings[1]) == ()
    np.testing.assert_allclose(candidates.com[0], one.com_trajectory, atol=2e-6)
    steep = predictor.imagine(view, replace(OWN, path=ToolPath(pitch=0.35)), context=context).warnings
    assert besides_doubt(steep) == (
        "pitch 0.35 is not the nominal 0.28, and the predictor is not conditioned on it",
    )
    if "sweep" in predictor.context:
        with pytest.raises(
            PredictionError, match=r"context sweep is 0.9, the action's path has 0.5: give one"
        ):
            predictor.imagine(view, action, context=context | {"sweep": 0.9})


def test_the_beginning_of_a_motion_is_used_or_refused(predictor, batch):
    view, context = view_of(batch, 0), context_of(predictor)
    effect = fake_interactions(np.random.default_rng(3), 1, SAMPLES)[0].effect
    if not predictor.observes:
        with pytest.raises(
            PredictionError, match=f"{predictor.label} predictor makes no use of observed samples"
        ):
            predictor.imagine(view, observed=ObservedMotion.of(effect, 0.5), context=context)
        with pytest.raises(PredictionError, match="makes no use of observed samples"):
            predictor.imagine_batch(batch, observed=4)
        return
    one = predictor.imagine(view, observed=ObservedMotion.of(effect, effect.times[11]), context=context)
    np.testing.assert_allclose(one.com_trajectory[:12], effect.com_trajectory[:12], atol=1e-9)
    batch = with_parameters(batch, context)
    many = predictor.imagine_batch(batch, observed=12)
    np.testing.assert_allclose(many.com[0], one.com_trajectory, atol=1e-5)


def test_an_exported_network_computes_the_same(predictor, batch):
    from foretrace.export.networks import draw_inputs, network_of

    network = network_of(predictor)
    for noise in (False, True):
        inputs = draw_inputs(network, np.random.default_rng(0), 3, noise)
        assert list(inputs) == list(network.inputs)
        with torch.no_grad():
            outputs = dict(
                zip(network.outputs, network(*map(torch.from_numpy, inputs.values())), strict=True)
            )
        expected = network.imagine(inputs)
        np.testing.assert_allclose(outputs["com_trajectory"], expected["com_trajectory"], atol=1e-5)


BOX = Box(0.15, 0.14, 0.02)
VIEW = TopDownView.of(BOX, LeverUp.at_edge(BOX, 0))
NO_MASK = TopDownView(np.zeros((128, 128), dtype=bool), np.zeros((128, 128), dtype=np.float32))
TWO = TopDownView(VIEW.mask | np.roll(VIEW.mask, -50, 0), VIEW.height + np.roll(VIEW.height, -50, 0))
NONSENSE = {
    "mask is empty": lambda p, **more: p.imagine(NO_MASK, **more),
    "interaction 0: the view's mask is empty": lambda p, **more: p.imagine_batch(
        InteractionBatch.from_views([NO_MASK]), "estimated"
    ),
    "shows 2 objects": lambda p, **more: p.imagine_candidates(TWO, [OWN], **more),
    "no candidate to imagine": lambda p, **more: p.imagine_candidates(VIEW, [], **more),
    r"candidate 1: the contact point is \d+.\d cm from the object": lambda p, **more: p.imagine_candidates(
        VIEW, [OWN, LeverUp((-0.7, 0.0), (1.0, 0.0))], **more
    ),
    "candidate 0: the contact point lies in the object": lambda p, **more: p.imagine_candidates(
        VIEW, [LeverUp((0.05, 0.0), (1.0, 0.0))], **more
    ),
    "candidate 0: the object lies behind": lambda p, **more: p.imagine_candidates(
        VIEW, [LeverUp((0.0, 0.0), (-1.0, 0.0))], **more
    ),
    "com .* holds a value that is not finite": lambda p, **more: p.imagine(VIEW, com=[0.1, np.nan, 0.0], **more),
    "com .* must be numbers in the shape": lambda p, **more: p.imagine_candidates(VIEW, [OWN], com=[0.1, 0.0], **more),
    "observed is -3: give a number of samples from 0": lambda p, **more: p.imagine_batch(
        InteractionBatch.from_views([VIEW]), observed=-3
    ),
    "has no recorded centre of mass: take start='estimated'": lambda p, **more: p.imagine_batch(
        InteractionBatch.from_views([VIEW])
    ),
    "context is 0.5: give values by name": lambda p, **more: p.imagine(VIEW, context=0.5),
    "context is 'friction': give values by name": lambda p, **more: p.imagine(VIEW, context="friction"),
    "view of type ndarray: give TopDownView": lambda p, **more: p.imagine(VIEW.mask, **more),
    "action of type str: give Action": lambda p, **more: p.imagine(VIEW, "lever-up", **more),
    "actions of type LeverUp: give a list of actions": lambda p, **more: p.imagine_candidates(VIEW, OWN, **more),
    "candidate 1 of type NoneType": lambda p, **more: p.imagine_candidates(VIEW, [OWN, None], **more),
    "batch of type TopDownView": lambda p, **more: p.imagine_batch(VIEW),
    "the batch is empty": lambda p, **more: p.imagine_batch(InteractionBatch.from_views([])),
    "mask of the batch has the type float64": lambda p, **more: p.imagine_batch(
        replace(InteractionBatch.from_views([VIEW]), mask=VIEW.mask[None] * 1.0)
    ),
    r"mask and height of the batch have the shapes \(1, 64, 128\)": lambda p, **more: p.imagine_batch(
        replace(InteractionBatch.from_views([VIEW]), mask=VIEW.mask[None, :64])
    ),
    r"rest \[5.0, 0.0, 0.0\] m lies \d+ cm outside the object": lambda p, **more: p.imagine(
        VIEW, com=[5.0, 0.0, 0.0], **more
    ),
    r"rest \[0.05, 0.0, -1.0\] m lies 100 cm outside": lambda p, **more: p.imagine_candidates(
        VIEW, [OWN], com=[0.05, 0.0, -1.0], **more
    ),
    "a height in the view is 20 m, more than 2 m": lambda p, **more: p.imagine(
        TopDownView(VIEW.mask, VIEW.height * 1000), **more
    ),
    "every height in the view is 0": lambda p, **more: p.imagine(TopDownView(VIEW.mask, VIEW.height * 0), **more),
    "not on 'colour': leave it out of context": lambda p, context: p.imagine(VIEW, context=context | {"colour": 3.0}),
}  # fmt: skip


@pytest.mark.parametrize("message", NONSENSE)
def test_nonsense_is_refused(predictor, message, untyped):
    if any(word in message for word in ("interaction", "recorded", "-3", "batch")):
        predictor.context, context = (), predictor.context
        try:
            with pytest.raises(PredictionError, match=message):
                NONSENSE[message](predictor)
        finally:
            predictor.context = context
        return
    with pytest.raises(PredictionError, match=message):
        NONSENSE[message](predictor, context=context_of(predictor))


# --- the registry ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("label", list(PREDICTORS))
def test_a_config_is_a_command_line_and_makes_its_predictor(label, capsys):
    config_class = PREDICTORS[label].config_class
    assert tyro.cli(config_class, args=[]) == config_class()
    assert type(config_class().make(5)) is PREDICTORS[label]
    assert isinstance(config_class.training, TrainConfig)
    assert isinstance(tyro.cli(TrainConfig, args=["--epochs", "3", "--outcomes", "levered"]), TrainConfig)
    with pytest.raises(SystemExit):
        tyro.cli(config_class, args=["--help"])
    told = " ".join(capsys.readouterr().out.split())
    for field in fields(config_class):
        option = f"--{field.name.replace('_', '-')}"
        assert option in told
        assert f"{option} (" not in told  # every option has a line of help before its default


def test_a_predictor_registers_itself(registered):
    class OwnConfig(PredictorConfig):
        pass

    class Own(EffectPredictor):
        label, config_class = "own", OwnConfig

        def training_loss(self, features, effects):
            raise NotImplementedError

        def roll_out(self, features, first):
            return first[:, None].expand(-1, self.num_samples, -1)

    assert PREDICTORS.find("own") is Own
    predictor = OwnConfig().make(4)
    assert isinstance(predictor, Own)
    np.testing.assert_allclose(np.ptp(predictor.imagine(VIEW).com_trajectory, axis=0), 0, atol=1e-8)
    with pytest.raises(TypeError, match="needs a label and a config_class of its own"):
        type("Nameless", (EffectPredictor,), {"roll_out": Own.roll_out})
    with pytest.raises(TypeError, match="OwnConfig makes Own already"):
        type("Other", (EffectPredictor,), {"label": "other", "config_class": OwnConfig})
    with pytest.raises(TypeError, match="label 'lstm' is taken"):
        type("Lstm", (EffectPredictor,), {"label": "lstm", "config_class": type("C", (PredictorConfig,), {})})
    with pytest.raises(TypeError, match="abstract"):
        type(
            "Half", (EffectPredictor,), {"label": "half", "config_class": type("D", (PredictorConfig,), {})}
        )(PredictorConfig(), 3)


def test_unknown_predictors_and_wrong_kinds_are_refused(batch):
    with pytest.raises(TrainingError, match="unknown predictor 'one-shoot'; available: lstm, one-shot"):
        PREDICTORS.find("one-shoot")
