from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from rich.console import Console

import factories
from foretrace.actions import LeverUp, ToolPath
from foretrace.actions.lever_up import VARIED_ACTION
from foretrace.errors import DatasetError, ResultsError
from foretrace.evaluation.run import run_experiment
from foretrace.experiments import randomisation
from foretrace.experiments.randomisation import (
    NAMES,
    RandomisationExperiment,
    Shown,
    distances,
    open_both,
    split_both,
)
from foretrace.experiments.randomisation_figures import BARS, KNOWING, NOMINAL, PLAIN, TESTS, VARIED
from foretrace.experiments.training import Recipe
from foretrace.experiments.transfer_objects import Subject
from foretrace.imagined import Futures, ImaginedBatch
from foretrace.objects.everyday import PENTAGON
from foretrace.predictor import LstmConfig
from foretrace.simulation.randomisation import RANDOMISED, Randomisation
from foretrace.simulation.stand_in import StandIn

QUIET = Console(quiet=True)
QUICK = Recipe.of("lstm").change(hidden=8, epochs=1, min_steps=1)


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("randomisation")
    factories.fake_data_set(root / "plain")
    factories.fake_data_set(root / "varied", RANDOMISED)
    factories.fake_data_set(root / "action", Randomisation(**VARIED_ACTION))
    return root / "plain", root / "varied"


@pytest.fixture(scope="module")
def shown() -> list[Shown]:
    """Three lever-ups by a stand-in that needs no Bullet, as if of both groups."""
    stand_in = StandIn(engine="mujoco", embodiment="tool", sample_rate=25.0)
    found = []
    for k, group in enumerate(("printed", "everyday", "everyday")):
        action = LeverUp.at_edge(PENTAGON, k)
        drawn = stand_in.draw(np.random.default_rng(k))
        subject = Subject("pentagon", group, PENTAGON, (action,), density=700.0, hull=group == "everyday")
        found.append(Shown(subject, stand_in.observe(PENTAGON, action, drawn, 700.0)))
    return found


def compared(folders: tuple[Path, Path], **options) -> RandomisationExperiment:
    usual = {"features": ("none", "sp-rule"), "repeats": 1, "recipe": QUICK}
    return RandomisationExperiment(*folders, **usual | options)


@pytest.fixture(scope="module")
def experiment(folders) -> RandomisationExperiment:
    return compared(folders)


@pytest.fixture(scope="module")
def table(experiment, folders, shown) -> pd.DataFrame:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(randomisation, "play_all", lambda stand_in, repeats: shown)
        found = run_experiment(experiment, folders[0].parent / "results", console=QUIET)
    assert found.failures == []
    return found.rows


def test_no_object_is_learned_from_and_tested_in_either_data_set(folders):
    both = open_both(*folders)
    for seed in range(3):
        splits = split_both(both, seed)
        names = ("train", "validation", "test")
        objects = {
            name: set().union(
                *(batch.object_ids[getattr(s, name)].tolist() for batch, s in zip(both, splits, strict=True))
            )
            for name in names
        }
        assert sum(map(len, objects.values())) == len(set().union(*objects.values())) == 8
        for name in ("train", "validation"):
            assert len(getattr(splits[0], name)) == len(getattr(splits[1], name)) > 0
        for batch, split in zip(both, splits, strict=True):
            tested = np.isin(batch.object_ids, list(objects["test"]))
            np.testing.assert_array_equal(split.test, np.flatnonzero(tested))
    first, again, other = (split_both(both, seed)[0].train for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_every_trial_has_its_numbers(table):
    counts = table.groupby(["features", "setting"])["metric"].nunique()
    assert counts.to_dict() == {
        (label, setting): 12 if setting == KNOWING else 8
        for label in ("none", "sp-rule")
        for setting in (PLAIN, VARIED, KNOWING)
    }
    sizes = table.loc[table["metric"].eq("train")].groupby("seed")["value"].nunique()
    assert sizes.tolist() == [1, 1, 1]
    errors = table.loc[~table["metric"].isin(["train", "seconds"]), "value"]
    assert errors.between(0.01, 100).all()


def test_the_context_is_the_stand_ins_constants_or_the_nominal_ones(shown, monkeypatch):
    predictor = LstmConfig(features="none", hidden=8, context=NAMES).make(60)
    seen = []

    predictor.times.copy_(0.05 * torch.arange(60))

    def imagine_scenes(self, scenes):
        seen.append(scenes.source)
        com = np.repeat(scenes.com[:, None], 60, axis=1)
        return ImaginedBatch(0.05 * np.arange(60), com, None, Futures.point(com, None, "levered"))

    monkeypatch.setattr(type(predictor), "imagine_scenes", imagine_scenes)
    found = distances(predictor, shown)
    distances(predictor, shown, nominal=True)
    true, nominal = seen
    np.testing.assert_allclose(
        true.parameters["friction"], [each.observed.perturbation.friction for each in shown]
    )
    factors = [each.observed.perturbation.density_factor for each in shown]
    np.testing.assert_allclose(true.parameters["density"], 700 * np.array(factors))
    assert nominal.parameters["friction"].tolist() == [0.8] * 3
    assert nominal.parameters["tool_friction"].tolist() == [0.3] * 3
    assert nominal.parameters["density"].tolist() == [700.0] * 3
    np.testing.assert_allclose(true.com[:, 0], [each.observed.com[0] for each in shown])
    assert found.keys() == {"stand_in_printed", "stand_in_everyday"}
    assert min(found.values()) > 0.1


# --- bad input ------------------------------------------------------------------------------------------------


def test_data_that_do_not_fit_are_refused(folders, tmp_path):
    plain, varied = folders
    for pair, kind, message in (
        ((plain, plain), ResultsError, r"friction is the same all over .*: simulate it with --randomise"),
        ((varied, varied), ResultsError, r"friction varies in .*: simulate the plain data without"),
        ((plain, tmp_path / "nothing"), DatasetError, "no such folder"),
        ((plain, None), ResultsError, "give both --plain and --varied"),
    ):
        with pytest.raises(kind, match=message):
            run_experiment(compared(pair), tmp_path / "out", console=QUIET)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"features": ("sp-truth",)}, "'sp-truth' cannot be had from a view: choose from none"),
        ({"features": ("magic",)}, "'magic' cannot be had"),
        ({"seeds": (-1,)}, "seed -1 is negative"),
        ({"repeats": -1}, "repeats is -1"),
        ({"context": ()}, "name what varies, of friction"),
    ],
)
def test_impossible_comparisons_are_refused(folders, wrong, message):
    with pytest.raises(ResultsError, match=message):
        compared(folders, **wrong).trials()


# --- the action's parameters ----------------------------------------------------------------------------------


def test_actions_that_vary_are_context_without_a_stand_in(folders, tmp_path, monkeypatch):
    plain, action = folders[0], folders[0].parent / "action"
    told = []
    measure = randomisation.measure_errors

    def spy(predictor, batch, inputs):
        if predictor.context:
            told.append((predictor.context, batch))
        return measure(predictor, batch, inputs)

    monkeypatch.setattr(randomisation, "measure_errors", spy)
    options = {"features": ("none",), "seeds": (0,), "repeats": 0, "context": tuple(LeverUp.units)}
    varied = compared((plain, action), **options)
    found = run_experiment(varied, tmp_path, console=QUIET)
    table = found.rows
    assert not table["metric"].str.contains("stand_in").any()
    assert table.groupby("setting")["metric"].nunique().to_dict() == {PLAIN: 6, VARIED: 6, KNOWING: 8}
    assert {context for context, _ in told} == {tuple(LeverUp.units)}
    spreads = [np.ptp(batch.parameters["sweep"]) > 0.1 for _, batch in told]
    assert spreads == [False, False, True, False]  # plain, with nominal values, varied, with nominal values
    assert set(told[3][1].parameters["sweep"]) == {ToolPath.sweep}
    assert list(found.summary["none"]) == ["plain test", "varied test"]
    axis = varied.figures(table)["randomisation"].axes[0]
    assert [label.get_text() for label in axis.get_xticklabels()] == ["plain test", "varied test"]
    with pytest.raises(
        ResultsError, match=r"insertion is the same all over .*: simulate it with --vary-action"
    ):
        run_experiment(compared(folders, **options), tmp_path / "other", console=QUIET)


# --- report ---------------------------------------------------------------------------------------------------


def test_the_report_has_means_and_differences_within_seeds(experiment, table):
    assert set(NOMINAL) == set(TESTS.values())
    summary = experiment.summarise(table)
    assert list(summary) == ["none", "sp-rule"]
    found = summary["sp-rule"]["varied test"]
    assert list(found["errors"]) == list(BARS)
    chosen = table.loc[table["features"].eq("sp-rule") & table["metric"].eq("randomised_full")]
    means = chosen.groupby("setting")["value"].mean()
    assert found["errors"]["plain data"]["mean"] == pytest.approx(means[PLAIN], abs=1e-4)
    gain = found["differences"]["varied instead of plain"]
    assert gain["mean"] == pytest.approx(means[VARIED] - means[PLAIN], abs=2e-4)
    assert gain["low"] <= gain["mean"] <= gain["high"]
    text = experiment.report(summary, table)
    assert text.count("| `none` |") == 8
    assert f"{means[PLAIN]:.3f}" in text


def test_the_figure_shows_every_bar_with_its_height(experiment, table):
    fig = experiment.figures(table)["randomisation"]
    heights = sorted(patch.get_height() for patch in fig.axes[0].patches)
    errors = [
        each["mean"]
        for test in experiment.summarise(table)["none"].values()
        for each in test["errors"].values()
    ]
    np.testing.assert_allclose(heights, sorted(errors), atol=1e-4)


def test_an_unfinished_comparison_is_reported_as_far_as_it_is(experiment, table):
    some = table.loc[table["setting"].ne(KNOWING) & table["seed"].eq(0)]
    summary = experiment.summarise(some)
    assert list(summary["none"]["plain test"]["errors"]) == ["plain data", "varied data"]
    assert summary["none"]["plain test"]["errors"]["plain data"]["low"] is None
    assert "| `none` | plain test |" in experiment.report(summary, some)
    assert len(experiment.figures(some)["randomisation"].axes) == 2
