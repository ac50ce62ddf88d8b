import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from factories import fake_batch
from foretrace.actions import LeverUp, Push, ToolPath
from foretrace.cli import main
from foretrace.cli.prediction import _given_context
from foretrace.errors import CheckpointError, PredictionError, TrainingError
from foretrace.evaluation.metrics import measure_errors
from foretrace.imagined import LEVELS
from foretrace.imagined.context import (
    CONSTANTS,
    context_units,
    nominal_constants,
    nominal_parameters,
    told_of,
    true_context,
)
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.record import Physics
from foretrace.interactions.splits import split_by_seed
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Box, Cylinder, Prism
from foretrace.predictor import LstmConfig, OneShotConfig, TrainConfig, load_predictor, train_predictor
from foretrace.predictor.checkpoint import read_config
from foretrace.predictor.run_folder import fingerprint
from foretrace.predictor.training import fit_predictor

NAMES = ("friction", "density")
CONFIG = LstmConfig(features="none", hidden=16, window=6)
CONDITIONED = replace(CONFIG, context=NAMES)
TRAINING = TrainConfig(epochs=3, min_steps=1, split=None, device="cpu")
LONGER = replace(TRAINING, epochs=40)


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def batch() -> InteractionBatch:
    """Objects lift the less the higher the friction."""
    rng = np.random.default_rng(7)
    made = fake_batch(rng, 40, num_samples=20)
    friction, density = rng.uniform(0.4, 1.2, 40), rng.uniform(300, 1200, 40)
    rest = made.com[:, :1]
    com = rest + (made.com - rest) * (1.3 - friction)[:, None, None]
    return replace(made, com=com, parameters=made.parameters | {"friction": friction, "density": density})


@pytest.fixture(scope="module")
def run(tmp_path_factory, batch):
    return train_predictor(
        batch, CONDITIONED, tmp_path_factory.mktemp("context") / "run", TRAINING, progress=False
    )


def view_of(batch: InteractionBatch, k: int) -> TopDownView:
    return TopDownView(batch.mask[k], batch.height[k])


def test_the_context_is_standardised_by_the_training_part(run, batch):
    tensors = load_file(run / "model.safetensors")
    train = json.loads((run / "split.json").read_text())["train"]  # ids are row numbers here
    for k, name in enumerate(NAMES):
        values = batch.parameters[name][train]
        assert tensors["known_mean"][k] == pytest.approx(values.mean())
        assert tensors["known_scale"][k] == pytest.approx(values.std())
    predictor = load_predictor(run)
    values = np.stack([batch.parameters["friction"], batch.parameters["density"]], axis=1)[train]
    inputs = predictor.add_context(torch.zeros(len(values), 0), values)
    torch.testing.assert_close(inputs.mean(0), torch.zeros(2), atol=1e-5, rtol=0)
    torch.testing.assert_close(inputs.std(0, correction=0), torch.ones(2))


def test_constants_that_never_vary_are_only_shifted(batch):
    same = replace(
        batch, parameters=batch.parameters | {"friction": np.full(40, 0.8), "density": np.full(40, 600.0)}
    )
    predictor, _ = fit_predictor(same, CONDITIONED, split_by_seed(40, 0, None), TRAINING)
    assert predictor.known_scale.tolist() == [1.0, 1.0]
    assert np.isfinite(predictor.imagine_batch(same).com).all()


def test_a_saved_predictor_imagines_the_same_alone_and_in_a_batch(run, batch):
    predictor = load_predictor(run)
    assert predictor.context == NAMES
    whole = predictor.imagine_batch(batch).com
    for k in (0, 17):
        context = {
            "friction": float(batch.parameters["friction"][k]),
            "density": float(batch.parameters["density"][k]),
        }
        alone = predictor.imagine(view_of(batch, k), context=context, com=batch.com[k, 0])
        np.testing.assert_allclose(alone.com_trajectory, whole[k], atol=1e-6)
    context = {"friction": 0.1, "density": 600.0}
    other = predictor.imagine(view_of(batch, 0), context=context, com=batch.com[0, 0])
    assert np.abs(other.com_trajectory - whole[0]).max() > 1e-5


def test_context_helps_where_it_decides(batch):
    """Without a feature that tells them apart, only friction explains how far objects are lifted."""
    split = split_by_seed(40, 0, None)
    errors = {}
    for context in ((), ("friction",)):
        config = replace(CONFIG, context=context, hidden=32)
        predictor, _ = fit_predictor(batch, config, split, LONGER)
        inputs = predictor.features.inputs(batch)
        errors[context] = measure_errors(predictor, batch[split.train], inputs[split.train])["full"]
    assert errors[("friction",)] < 0.9 * errors[()]


def test_an_interrupted_training_goes_on_and_another_one_is_refused(tmp_path, run, batch):
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    train_predictor(batch, CONDITIONED, folder, TRAINING, progress=False)
    with pytest.raises(TrainingError, match=r"config\.context = \['friction', 'density'\], not \[\]"):
        train_predictor(batch, CONFIG, folder, TRAINING, progress=False)
    assert fingerprint(batch, NAMES) != fingerprint(batch)
    heavier = replace(batch, parameters=batch.parameters | {"density": 2 * batch.parameters["density"]})
    assert fingerprint(heavier) == fingerprint(batch)
    with pytest.raises(TrainingError, match=r"training\.data"):
        train_predictor(heavier, CONDITIONED, folder, TRAINING, progress=False)


def test_without_context_there_are_no_tensors_for_it(tmp_path, batch):
    run = train_predictor(batch, CONFIG, tmp_path / "run", TRAINING, progress=False)
    assert read_config(run)["config"]["context"] == []
    assert not [name for name in load_file(run / "model.safetensors") if "known" in name]
    assert load_predictor(run).context == ()


# --- bad input ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("context", "message"),
    [
        (
            "unknown",
            r"is conditioned on friction, density: give context=\{'friction': value of object and table, 'density'",
        ),
        ({"friction": 0.8}, "is conditioned on density: give context="),
        (
            {"friction": 0.8, "density": float("nan")},
            r"context density is nan: give a finite value in kg/m\^3",
        ),
        (
            {"friction": 0.8, "density": 600.0, "colour": 3.0},
            "friction, density, not on 'colour': leave it out",
        ),
    ],
)
def test_missing_unknown_or_infinite_context_is_refused(run, batch, context, message):
    predictor = load_predictor(run)
    with pytest.raises(PredictionError, match=message):
        predictor.imagine(view_of(batch, 0), context=context)
    with pytest.raises(PredictionError, match=message):
        predictor.imagine_candidates(view_of(batch, 0), [LeverUp((0, 0), (1, 0))], context=context)


def test_context_for_a_predictor_without_any_is_refused(batch):
    with pytest.raises(PredictionError, match="conditioned on nothing but the view, not on 'friction'"):
        CONFIG.make(20).imagine(view_of(batch, 0), context={"friction": 0.8})


def test_interactions_without_a_record_are_named(run, batch):
    density = np.where(batch.ids == 11, np.nan, batch.parameters["density"])
    unknown = replace(batch, parameters=batch.parameters | {"density": density})
    message = (
        "interaction 11 has density = nan: record its density, leave it out, or use a predictor that is not"
    )
    with pytest.raises(PredictionError, match=message):
        load_predictor(run).imagine_batch(unknown)
    with pytest.raises(PredictionError, match=message):
        fit_predictor(unknown, CONDITIONED, split_by_seed(40, 0, None), TRAINING)
    fit_predictor(unknown, CONFIG, split_by_seed(40, 0, None), replace(TRAINING, epochs=1))


@pytest.mark.parametrize(
    ("context", "message"),
    [(("mass",), "'mass' is no context .* choose from friction"), (("density", "density"), "named twice")],
)
def test_impossible_names_are_refused(context, message):
    with pytest.raises(TrainingError, match=message):
        LstmConfig(context=context)


def test_a_checkpoint_with_nonsense_for_context_is_refused(tmp_path, run):
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    config = json.loads((folder / "config.json").read_text())
    config["config"]["context"] = ["friction", "mass"]
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match="'mass' is no context"):
        load_predictor(folder)
    config["config"]["context"] = []
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match="unexpected tensors known_mean, known_scale"):
        load_predictor(folder)


@pytest.mark.parametrize(
    ("given", "knows", "simulated", "message"),
    [
        ({"tool_friction": 0.0}, ("tool_friction",), False, "--tool-friction is 0.0: give a number above 0"),
        ({"density": 600.0}, (), False, "is not conditioned on density: leave --density out"),
    ],
)
def test_options_of_predict_are_checked(given, knows, simulated, message):
    with pytest.raises(PredictionError, match=message):
        _given_context(given, knows, simulated)
    assert _given_context({"friction": 0.7, "density": None}, (), True) == {"friction": 0.7}


def test_the_actions_parameters_are_context_as_constants_are(batch):
    units = context_units()
    assert {*LeverUp.nominal_parameters(), *Push.nominal_parameters()} <= set(units)
    assert units["speed"].startswith("as a multiple of the nominal one (lever-up), in m/s (push)")
    assert units["distance"].startswith("in m")
    rng = np.random.default_rng(3)
    sweep = rng.uniform(0.4, 1.0, 40)
    rest = batch.com[:, :1]
    moved = rest + (batch.com - rest) * sweep[:, None, None]
    farther = replace(batch, com=moved, parameters=batch.parameters | {"sweep": sweep})
    config = replace(CONFIG, context=("sweep", "speed"), hidden=32)
    split = split_by_seed(40, 0, None)
    predictor, _ = fit_predictor(farther, config, split, LONGER)
    low, high = (
        predictor.imagine(
            view_of(batch, 0), context={"sweep": value, "speed": 1.0}, com=batch.com[0, 0]
        ).com_trajectory
        for value in (0.45, 0.95)
    )
    way = [np.linalg.norm(path[-1] - path[0]) for path in (low, high)]
    assert way[1] > 1.3 * way[0]
    one, other = (
        predictor.imagine(view_of(batch, 0), context=context).com_trajectory
        for context in ({"sweep": 0.5}, {"sweep": 0.5, "speed": 1.0})
    )
    np.testing.assert_array_equal(one, other)  # by default, the nominal path


def test_predict_is_conditioned_on_the_action_and_compares_with_it(tmp_path, batch, capsys):
    sweep = np.random.default_rng(3).uniform(0.4, 1.0, 40)
    swept = replace(batch, parameters=batch.parameters | {"sweep": sweep})
    config = replace(CONFIG, context=("sweep",))
    run = train_predictor(swept, config, tmp_path / "run", TRAINING, progress=False)
    polygon = tmp_path / "polygon.txt"
    polygon.write_text("0.1 0\n0.02 0.09\n-0.08 0.05\n-0.07 -0.06\n0.04 -0.09\n")
    command = ["predict", str(run), "--polygon", str(polygon), "--edge", "1", "--compare", "--no-animation"]
    assert main([*command, "--unknown", "--friction", "-1"]) == 2
    assert "--friction is -1.0: give a number above 0" in capsys.readouterr().err
    rises = {}
    for told in (0.45, 0.95):
        out = tmp_path / f"{told}"
        assert main([*command, "--sweep", str(told), "--speed", "1.3", "--out", str(out)]) == 0
        content = json.loads((out / "trajectory.json").read_text())
        rises[told] = [
            np.array(path)[:, 2].max() - path[0][2]
            for path in (content["com_trajectory"], content["simulated"]["com_trajectory"])
        ]
        faster = ToolPath(sweep=told).faster(1.3).duration
        assert len(content["simulated"]["com_trajectory"]) == round(faster / 0.05) + 1
    assert rises[0.95][0] != rises[0.45][0]
    assert rises[0.95][1] > 1.5 * rises[0.45][1]


def test_true_context_is_that_of_physics_and_path():
    names = ("sweep", "friction", "insertion")
    found = true_context(Physics(friction=0.6), names, nominal_parameters() | {"insertion": 0.03})
    assert found == {"sweep": ToolPath.sweep, "friction": 0.6, "insertion": 0.03}
    assert list(found) == list(names)


# --- constants that need not be told --------------------------------------------------------------------------


MARGINAL = OneShotConfig(
    context=("friction", "density", "contact_error"), hidden_share=0.7, hidden=32, ensemble=2
)


@pytest.fixture(scope="module")
def marginal(tmp_path_factory, batch):
    """A predictor that can do without the friction on which the motions depend."""
    training = TrainConfig(epochs=60, min_steps=1, split=(26, 6, 4), device="cpu", outcomes=("levered",))
    known = replace(batch, parameters=batch.parameters | {"contact_error": np.zeros(len(batch))})
    return load_predictor(
        train_predictor(
            known, MARGINAL, tmp_path_factory.mktemp("marginal") / "run", training, progress=False
        )
    )


def test_none_is_nominal_and_a_mapping_tells_what_it_names(marginal, batch):
    view = view_of(batch, 0)
    nominal = {"friction": 0.8, "density": 600.0, "contact_error": 0.0}
    by_default, told = (marginal.imagine(view, context=context) for context in (None, nominal))
    np.testing.assert_array_equal(by_default.com_trajectory, told.com_trajectory)
    assert by_default.context == nominal
    assert "nominal physics" in repr(by_default)
    assert "told friction 0.7, not told density, contact_error" in repr(
        marginal.imagine(view, context={"friction": 0.7})
    )
    some, nothing, empty = (
        marginal.imagine(view, context=context) for context in ({"friction": 0.8}, "unknown", {})
    )
    assert some.context["friction"] == 0.8
    assert np.isnan(some.context["density"])
    assert "not told density, contact_error" in repr(some)
    np.testing.assert_array_equal(nothing.com_trajectory, empty.com_trajectory)
    assert all(np.isnan(value) for value in nothing.context.values())


def test_what_is_not_told_is_in_the_spread(marginal, batch):
    known = replace(batch, parameters=batch.parameters | {"contact_error": np.zeros(len(batch))})
    told, hidden = (marginal.imagine_batch(known, context=context) for context in ("recorded", "unknown"))
    errors = [np.nanmean(np.linalg.norm(imagined.com - batch.com, axis=2)) for imagined in (told, hidden)]
    assert errors[0] < 0.8 * errors[1]
    widths = [np.nanmean(imagined.futures.radius(0.8)[:, :, -1]) for imagined in (told, hidden)]
    assert widths[0] < widths[1]
    at_low, at_high = (
        marginal.imagine_batch(known, context={"friction": friction}).com[:, -1, 2].mean()
        for friction in (0.5, 1.1)
    )
    assert at_low > at_high


def test_a_value_that_was_not_recorded_is_not_told(marginal, batch):
    density = np.where(batch.ids == 3, np.nan, batch.parameters["density"])
    error = np.where(batch.ids == 4, 0.002, 0.0)
    mixed = replace(batch, parameters=batch.parameters | {"density": density, "contact_error": error})
    context = marginal.imagine_batch(mixed).context
    np.testing.assert_array_equal(np.isnan(context["density"]), batch.ids == 3)
    np.testing.assert_array_equal(np.isnan(context["contact_error"]), batch.ids == 4)


def test_regions_depend_on_start_and_on_what_is_told(marginal, batch):
    known = replace(batch, parameters=batch.parameters | {"contact_error": np.zeros(len(batch))})
    quantiles = {
        (start, str(context)): marginal.imagine_batch(known, start, context=context).futures.quantiles
        for start in ("observed", "estimated")
        for context in ("recorded", {"friction": 0.8}, "unknown")
    }
    assert all(found.shape == (len(batch), len(LEVELS)) for found in quantiles.values())
    for start in ("observed", "estimated"):
        told, some, hidden = (found for (name, _), found in quantiles.items() if name == start)
        np.testing.assert_array_equal(some, np.maximum(told, hidden))
    with pytest.raises(
        PredictionError, match=r"context contact_error is 0\.002: give 0 for a contact as commanded"
    ):
        marginal.imagine(view_of(batch, 0), context={"contact_error": 0.002})


def test_training_hides_a_share(marginal):
    inputs = torch.ones(20_000, marginal.num_inputs)
    hidden = 1 - marginal.hide_context(inputs)[:, -3:]
    every = hidden.all(dim=1).float().mean()
    assert every == pytest.approx(0.35 + 0.35 / 8, abs=0.02)
    assert hidden.any(dim=1).float().mean() == pytest.approx(0.35 + 0.35 * 7 / 8, abs=0.02)


def test_a_lying_cylinder_is_told_no_bevel():
    predictor = load_predictor()
    box, cylinder = Box(0.12, 0.06, 0.05), Cylinder(0.025, 0.12)
    action = LeverUp((0.0, -0.03), (0.0, 1.0))
    told = {"bevel_width": 0.009, "bevel_height": 0.003}
    for obj, has in ((box, True), (cylinder, False)):
        own = action if has else LeverUp((0.0, -0.025), (0.0, 1.0))
        view = TopDownView.of(obj, own)
        for context in (None, told):
            assert np.isfinite(predictor.imagine(view, context=context).context["bevel_width"]) == has
        together = predictor.imagine_candidates(TopDownView.of(obj, LeverUp((0, 0), (1, 0))), [own])
        assert np.isfinite(together.context["bevel_height"][0]) == has
        without = {
            name: value for name, value in predictor.imagine(view).context.items() if name in CONSTANTS
        }
        without = {name: value for name, value in without.items() if name not in told}
        same = predictor.imagine(view, context=without).com_trajectory
        assert np.array_equal(same, predictor.imagine(view).com_trajectory) != has
    rolled = predictor.imagine(
        TopDownView.of(cylinder, LeverUp((0.0, -0.025), (0.0, 1.0)))
    ).futures.outcomes()
    assert rolled["rolled"][0] > 0.5


PENTAGON = Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])


def seen(obj, edge):
    action = LeverUp.at_edge(obj, edge)
    return TopDownView.of(obj, action), action


def test_a_context_unlike_what_was_learned_is_pointed_out():
    predictor, (view, action) = load_predictor(), seen(PENTAGON, 2)
    for context, words in (
        (
            {"bevel_height": 0.0015},
            "bevel_height 1.5 mm is far outside what was learned from, 2.28 to 3.59 mm",
        ),
        ({"speed": 3.0}, "speed 3 is far outside"),
        ({"friction": 2.0}, "friction 2 is far outside"),
    ):
        assert any(words in line for line in predictor.imagine(view, context=context).warnings)
    slow = replace(action, path=ToolPath.of(speed=0.3))
    assert any("speed 0.3 is far outside" in line for line in predictor.imagine(view, slow).warnings)
    assert not predictor.imagine(view, action).warnings


@pytest.mark.parametrize(
    ("context", "words"),
    [
        ({"speed": 0.0}, "context speed: tool path: speed = 0"),
        (
            {"bevel_width": 0.0, "bevel_height": 0.003},
            r"context bevel_width is 0\.0, bevel_height is 0\.003: give two",
        ),
        ({"bevel_width": 0.2}, r"context bevel_width is 0\.2: give a value from 0 to 0\.1"),
    ],
)
def test_a_context_that_no_action_or_object_has(context, words):
    with pytest.raises(PredictionError, match=words):
        load_predictor().imagine(seen(PENTAGON, 2)[0], context=context)


def test_slender_objects_are_told_the_bevel_that_they_bear():
    predictor, slender = load_predictor(), Box(0.16, 0.02, 0.02)
    view, action = seen(slender, 0)
    told = predictor.imagine(view, action).context
    assert told["bevel_width"] == pytest.approx(slender.bevel.width, rel=0.15) != 0.009
    assert told["bevel_height"] == pytest.approx(slender.bevel.height, rel=0.15)
    own = dict(zip(("bevel_width", "bevel_height"), (slender.bevel.width, slender.bevel.height), strict=True))
    assert told_of(slender, predictor.context) == dict(nominal_constants()) | own
    assert told_of(PENTAGON, predictor.context) is None
    assert told_of(slender, ("friction",)) is None
    bare = InteractionBatch.from_views([view])
    same = predictor.imagine_batch(bare, "estimated", context=None).com[0]
    np.testing.assert_allclose(same, predictor.imagine(view).com_trajectory, atol=1e-7)


def test_an_object_without_a_bevel_is_told_none():
    view, action = seen(PENTAGON, 2)
    imagined = load_predictor().imagine(view, action, context={"bevel_width": 0.0, "bevel_height": 0.0})
    assert np.isnan(imagined.context["bevel_width"])
