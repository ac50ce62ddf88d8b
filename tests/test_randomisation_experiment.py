from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foretrace.predictor.context import PARAMETERS
from rich.console import Console

import factories
from engines_at_hand import WITHOUT_BULLET
from foretrace.actions import LeverUp, ToolPath
from foretrace.cli import main
from foretrace.errors import DatasetError, ResultsError
from foretrace.evaluation.results import Trial, read_results
from foretrace.experiments import randomisation
from foretrace.experiments.randomisation import (
    KNOWING,
    NAMES,
    PLAIN,
    VARIED,
    RandomisationRecipe,
    Shown,
    distances,
    open_both,
    run_randomisation,
    split_both,
)
from foretrace.experiments.randomisation_report import (
    BARS,
    JUDGES,
    NOMINAL,
    markdown,
    randomisation_figure,
    summarise,
)
from foretrace.experiments.transfer_objects import PENTAGON, Subject
from foretrace.imagined import ImaginedBatch
from foretrace.interactions.record import Outcome, Physics
from foretrace.predictor import TrainConfig
from foretrace.predictor.base import EffectPredictor
from foretrace.simulation.collect import CollectConfig, collect, trial
from foretrace.simulation.randomisation import NOTHING, RANDOMISED, VARIED_ACTION, Randomisation
from foretrace.simulation.stand_in import StandIn

QUIET = Console(quiet=True)
RECIPE = RandomisationRecipe(TrainConfig(hidden=8, epochs=1, min_steps=1, device="cpu", threads=1), repeats=1)

ACTION = replace(RECIPE, repeats=0, known=tuple(PARAMETERS))


def fake_simulate(config: CollectConfig, id: int):
    """Made-up motions with the constants that would have been drawn; more slip where they vary."""
    obj, action, seed = trial(config, id)
    varied = config.randomisation != NOTHING
    outcome = Outcome.SLIPPED if id % (5 if varied else 13) == 3 else Outcome.LEVERED
    made = factories.fake_lever_up(obj, action, id=id, seed=seed, num_samples=12, outcome=outcome)
    _, physics, path, _ = config.randomisation.vary(obj, Physics(), ToolPath(), np.random.default_rng(id))
    return replace(made, physics=physics, action=replace(made.action, path=path))


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("randomisation")
    plain = CollectConfig(8, 1)
    action = Randomisation(**VARIED_ACTION)
    for name, drawn in (("plain", NOTHING), ("varied", RANDOMISED), ("action", action)):
        config = replace(plain, randomisation=drawn)
        collect(config, root / name, workers=1, console=QUIET, simulate=fake_simulate)
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


@pytest.fixture(scope="module")
def results(folders, shown):
    out = folders[0].parent / "results"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(randomisation, "_shown_once", lambda stand_in, repeats: shown)
        assert run_randomisation(*folders, out, ["none", "sp-rule"], [0, 1, 2], RECIPE, console=QUIET) == []
    return out


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


def test_every_trial_has_its_numbers(results):
    table = read_results(results)
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


def test_results_are_the_same_again_and_only_what_is_missing_is_done(
    results, folders, shown, tmp_path, monkeypatch
):
    monkeypatch.setattr(randomisation, "_shown_once", lambda stand_in, repeats: shown)
    again = tmp_path / "again"
    assert run_randomisation(*folders, again, ["sp-rule"], [1], RECIPE, console=QUIET) == []
    whole, part = read_results(results), read_results(again)
    merged = part.merge(whole, on=["experiment", "features", "seed", "setting", "metric"])
    assert len(merged) == len(part)
    merged = merged.loc[merged["metric"].ne("seconds")]
    np.testing.assert_array_equal(merged["value_x"], merged["value_y"])

    def refuse(*arguments):
        raise AssertionError("trained again")

    monkeypatch.setattr(randomisation, "fit_predictor", refuse)
    assert run_randomisation(*folders, again, ["sp-rule"], [1], RECIPE, console=QUIET) == []
    with pytest.raises(ResultsError, match=r"holds results with recipe\.repeats = 1, asked for is 2"):
        run_randomisation(*folders, again, ["sp-rule"], [1], replace(RECIPE, repeats=2), console=QUIET)


def test_who_knows_is_told_the_stand_ins_constants_or_the_usual_ones(shown, monkeypatch):
    predictor = TrainConfig(features="none", hidden=8, known=NAMES).make_predictor(60)
    seen = []

    def imagine(self, batch, start="observed"):
        seen.append(batch)
        return ImaginedBatch(0.05 * np.arange(60), np.array(batch.com))

    monkeypatch.setattr(EffectPredictor, "imagine_batch", imagine)
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
    with pytest.raises(ResultsError, match=r"friction is the same all over .*: simulate it with --randomise"):
        run_randomisation(plain, plain, tmp_path / "out", console=QUIET)
    with pytest.raises(ResultsError, match=r"friction varies in .*: simulate the plain data without"):
        run_randomisation(varied, varied, tmp_path / "out", console=QUIET)
    with pytest.raises(DatasetError, match="no such folder"):
        run_randomisation(plain, tmp_path / "nothing", tmp_path / "out", console=QUIET)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"features": ["sp-truth"]}, "'sp-truth' cannot be had from a view: choose from none"),
        ({"features": ["magic"]}, "'magic' cannot be had"),
        ({"seeds": [-1]}, "seed -1 is negative"),
        ({"workers": 0}, "workers is 0"),
    ],
)
def test_impossible_comparisons_are_refused(folders, tmp_path, wrong, message):
    with pytest.raises(ResultsError, match=message):
        run_randomisation(*folders, tmp_path, **wrong, console=QUIET)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"repeats": -1}, "repeats is -1"), ({"known": ()}, "name what varies, of friction")],
)
def test_impossible_recipes_are_refused(wrong, message):
    with pytest.raises(ResultsError, match=message):
        RandomisationRecipe(**wrong)


# --- the action's parameters ----------------------------------------------------------------------------------


def test_what_the_default_recipe_says_of_itself_has_not_changed():
    assert "known" not in RandomisationRecipe().describe()
    assert ACTION.describe()["known"] == tuple(PARAMETERS)


def test_actions_that_vary_are_told_without_a_stand_in(folders, tmp_path, monkeypatch):
    plain, action = folders[0], folders[0].parent / "action"
    told = []
    measure = randomisation.measure_errors

    def spy(predictor, batch, inputs):
        if predictor.known:
            told.append((predictor.known, batch))
        return measure(predictor, batch, inputs)

    monkeypatch.setattr(randomisation, "measure_errors", spy)
    assert run_randomisation(plain, action, tmp_path, ["none"], [0], ACTION, console=QUIET) == []
    table = read_results(tmp_path)
    assert not table["metric"].str.contains("stand_in").any()
    assert table.groupby("setting")["metric"].nunique().to_dict() == {PLAIN: 6, VARIED: 6, KNOWING: 8}
    assert {known for known, _ in told} == {tuple(PARAMETERS)}
    spreads = [np.ptp(batch.parameters["sweep"]) > 0.1 for _, batch in told]
    assert spreads == [False, False, True, False]  # plain, told the usual, varied, told the usual
    assert set(told[3][1].parameters["sweep"]) == {ToolPath.sweep}
    assert list(summarise(table)["none"]) == ["plain test", "randomised test"]
    assert [label.get_text() for label in randomisation_figure(table).axes[0].get_xticklabels()] == [
        *("plain test", "randomised test")
    ]
    with pytest.raises(
        ResultsError, match=r"insertion is the same all over .*: simulate it with --vary-action"
    ):
        run_randomisation(*folders, tmp_path / "other", ["none"], [0], ACTION, console=QUIET)
    with pytest.raises(ResultsError, match=r"holds results with data"):
        run_randomisation(*folders, tmp_path, ["none"], [0], RECIPE, console=QUIET)


# --- report ---------------------------------------------------------------------------------------------------


def test_the_report_has_means_and_differences_within_seeds(results):
    table = read_results(results)
    assert set(NOMINAL) == set(JUDGES.values())
    summary = summarise(table)
    assert list(summary) == ["none", "sp-rule"]
    found = summary["sp-rule"]["randomised test"]
    assert list(found["errors"]) == list(BARS)
    chosen = table.loc[table["features"].eq("sp-rule") & table["metric"].eq("randomised_full")]
    means = chosen.groupby("setting")["value"].mean()
    assert found["errors"]["plain data"]["mean"] == pytest.approx(means[PLAIN], abs=1e-4)
    gain = found["differences"]["randomised instead of plain"]
    assert gain["mean"] == pytest.approx(means[VARIED] - means[PLAIN], abs=2e-4)
    assert gain["low"] <= gain["mean"] <= gain["high"]
    text = markdown(summary)
    assert text.count("| `none` |") == 8
    assert f"{means[PLAIN]:.3f}" in text


def test_the_figure_shows_every_bar_with_its_height(results):
    table = read_results(results)
    fig = randomisation_figure(table)
    heights = sorted(patch.get_height() for patch in fig.axes[0].patches)
    errors = [
        each["mean"] for judge in summarise(table)["none"].values() for each in judge["errors"].values()
    ]
    np.testing.assert_allclose(heights, sorted(errors), atol=1e-4)


def test_an_unfinished_comparison_is_reported_as_far_as_it_is(results):
    table = read_results(results)
    some = table.loc[table["setting"].ne(KNOWING) & table["seed"].eq(0)]
    summary = summarise(some)
    assert list(summary["none"]["plain test"]["errors"]) == ["plain data", "randomised data"]
    assert summary["none"]["plain test"]["errors"]["plain data"]["low"] is None
    assert "| `none` | plain test |" in markdown(summary)
    assert len(randomisation_figure(some).axes) == 2


@WITHOUT_BULLET
def test_the_command_writes_table_summary_and_picture(folders, shown, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(randomisation, "_shown_once", lambda stand_in, repeats: shown)
    monkeypatch.setattr("foretrace.predictor.RECIPES", {"lstm": TrainConfig(hidden=8, min_steps=1)})
    out = tmp_path / "out"
    plain, varied = map(str, folders)
    options = ["--features", "none", "--seeds", "0", "--epochs", "1", "--repeats", "1"]
    assert (
        main(["evaluate", "randomisation", "--plain", plain, "--varied", varied, "--out", str(out), *options])
        == 0
    )
    names = {file.name for file in out.iterdir()} - {".lock"}
    assert names == {"results.csv", "results.json", "summary.json", "randomisation.md", "randomisation.png"}
    assert "values known" in capsys.readouterr().out
    assert Trial("randomisation", "none", 0, KNOWING) in {
        Trial(*row)
        for row in read_results(out)[["experiment", "features", "seed", "setting"]].itertuples(index=False)
    }
