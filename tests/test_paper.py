"""The paper's comparisons: their plan, their splits, and that their numbers are those of a training by hand."""

from collections import Counter
from dataclasses import fields, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

import factories
from foretrace.errors import ResultsError
from foretrace.evaluation.claims import Cell
from foretrace.evaluation.metrics import evaluate_predictor, measure_errors
from foretrace.evaluation.run import count_missing, run_experiment
from foretrace.experiments.paper import Paper
from foretrace.experiments.paper_comparisons import COMPARISONS, PaperTrial, plan, ratio_of, split_of
from foretrace.experiments.training import Recipe, load_levered
from foretrace.features import FEATURES
from foretrace.interactions.dataset import InteractionBatch
from foretrace.predictor import PREDICTORS
from foretrace.predictor.run_folder import processor_independent_fingerprint

QUICK = {name: Recipe.of(name).change(hidden=8, epochs=1, min_steps=1) for name in PREDICTORS}
QUIET = Console(quiet=True)
TRIALS = [
    *plan(["support-points-novel", "support-points"], settings=["5", "3&4"], seeds=[0]),
    *plan(["features"], ["none", "sc-200", "ae-256", "sp-pred", "one-shot"], seeds=[0]),
    *plan(["half-plane"], ["sc-800"], seeds=[0]),
    *plan(["training-size"], ["sc-200"], ["2", "64"], seeds=[0]),
    *plan(["steps-ahead"], ["sc-200"], ["3"], seeds=[0]),
    *plan(["novel-corners"], ["sp-pred"], ["9&10"], seeds=[0]),
    *plan(["support-points-plain"], ["sp-rule"], seeds=[0]),
    *plan(["ablation"], ["one hinge", "no mirror"], seeds=[0]),
]
"""Something of every comparison."""
ERRORS = {"full", "final", "full_median", "final_median", "best_epoch", "epochs", "seconds"}
OF_POSES = ("one-shot", "one hinge", "no mirror")


def paper(data: Path, trials: list[PaperTrial]) -> Paper:
    """The comparisons with some trials only, quick to train."""
    experiment = Paper(data=data, proportional=True, recipes=QUICK, feature_options=factories.QUICK_OPTIONS)
    object.__setattr__(experiment, "trials", lambda: trials)
    return experiment


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return factories.fake_data_set(tmp_path_factory.mktemp("paper") / "data")


@pytest.fixture(scope="module")
def results(data: Path) -> pd.DataFrame:
    found = run_experiment(paper(data, TRIALS), data.parent / "results", workers=1, console=QUIET)
    assert found.failures == []
    return found.rows


def keyed(table: pd.DataFrame) -> dict[tuple, float]:
    """Every value but the times, by its trial and metric."""
    return {tuple(row): value for *row, value in table[table["metric"] != "seconds"].itertuples(index=False)}


def test_every_comparison_gives_every_number_once(results):
    assert not results.duplicated(["experiment", "features", "seed", "setting", "metric"]).any()
    assert np.isfinite(results["value"]).all()
    groups = results.groupby(["experiment", "features", "seed", "setting"])["metric"].agg(set)
    assert set(groups.index) == {tuple(trial.settings.values()) for trial in TRIALS}
    assert set(results["experiment"]) == {name for name, each in COMPARISONS.items() if not each.on_request}
    for (experiment, name, *_), metrics in groups.items():
        if experiment.startswith("support-points"):
            assert {"accuracy", "accuracy_from_mask", "seconds"} < metrics
        else:
            of_poses = {"rotation", "rotation_median", "add", "add_median"}
            assert metrics == (ERRORS | of_poses if name in OF_POSES else ERRORS)


def test_neither_workers_nor_order_nor_other_trials_change_a_value(data, results, tmp_path):
    experiment = Paper(
        data, ("novel-corners", "support-points"), ("sp-pred",), ("9&10", "5"), (0,),
        proportional=True, recipes=QUICK, feature_options=factories.QUICK_OPTIONS,
    )  # fmt: skip
    found = keyed(run_experiment(experiment, tmp_path, workers=2, console=QUIET).rows)
    whole = keyed(results)
    assert len(found) > 2 * 6
    assert {key: whole[key] for key in found} == found


def test_settings_make_a_difference(results):
    values = results[(results["metric"] == "full") & (results["features"] == "sc-200")]["value"]
    assert values.nunique() == len(values) == 2 + 2 + 1


def test_the_shuffled_setting_is_what_train_and_evaluate_would_give(data, results):
    batch = load_levered(data)
    trial = PaperTrial("features", "sc-200", 0, "shuffled")
    split = split_of(trial, batch, proportional=True)
    predictor, _ = QUICK["lstm"].change(features="sc-200", seed=0, threads=1, device="cpu").fit(batch, split)
    rows = evaluate_predictor(predictor, batch[split.test])
    expected = {r["metric"]: r for r in rows if r["group"] == "all" and r["start"] == "observed"}
    found = measure_errors(predictor, batch[split.test], predictor.features.inputs(batch[split.test]))
    stored = keyed(results)
    for metric in ("full", "final"):
        key = tuple(trial.settings.values())
        assert found[metric] == pytest.approx(expected[metric]["mean_cm"], rel=1e-6)
        assert stored[(*key, metric)] == pytest.approx(expected[metric]["mean_cm"], rel=1e-6)
        assert stored[(*key, f"{metric}_median")] == pytest.approx(expected[metric]["median_cm"], rel=1e-6)


@cache
def many(size: int) -> InteractionBatch:
    """A batch of any size, in little more than name: its images and motions are those of one interaction."""
    few = factories.fake_batch(np.random.default_rng(0), 16, num_samples=20)
    wide = {
        each.name: np.broadcast_to(getattr(few, each.name)[:1], (size, *getattr(few, each.name).shape[1:]))
        for each in fields(few)
        if np.ndim(getattr(few, each.name)) > 1
    }
    flat = {
        each.name: getattr(few, each.name)[np.arange(size) % 16]
        for each in fields(few)
        if np.ndim(getattr(few, each.name)) == 1 and each.name != "times"
    }
    return replace(few, **wide, **flat)


@pytest.fixture(scope="module")
def paper_batch():
    """As many levered interactions as the paper has, in little more than name."""
    return many(1814)


@pytest.mark.parametrize("proportional", [False, True])
@pytest.mark.parametrize("name", COMPARISONS)
def test_no_trial_is_tested_on_what_it_learned_from(name, proportional, paper_batch):
    if name == "more-data":
        paper_batch = many(26_000)
    for chosen in plan([name], seeds=[0, 3]):
        split = split_of(chosen, paper_batch, proportional)
        parts = [set(split.train), set(split.validation), set(split.test)]
        assert all(parts)
        assert sum(map(len, parts)) == len(set.union(*parts))
        assert set.union(*parts) <= set(range(len(paper_batch)))
        if chosen.setting == "by-object":
            objects = [set(paper_batch.object_ids[list(part)]) for part in parts]
            assert sum(map(len, objects)) == len(set.union(*objects))
        if "&" in chosen.setting:
            corners = {int(count) for count in chosen.setting.split("&")}
            assert set(paper_batch.num_corners[split.test]) == corners
            assert not corners & set(paper_batch.num_corners[np.r_[split.train, split.validation]])


@pytest.mark.parametrize("name", ["training-size", "support-points"])
def test_smaller_training_parts_are_within_larger_ones(name, paper_batch):
    label = COMPARISONS[name].features[0]
    splits = [split_of(PaperTrial(name, label, 5, s), paper_batch) for s in COMPARISONS[name].settings]
    for smaller, larger in pairwise(splits):
        assert set(smaller.train) < set(larger.train)
        assert set(smaller.validation) == set(larger.validation)
        assert len(smaller.validation) == 100
    sizes = [len(split.train) for split in splits]
    if name == "training-size":
        assert sizes == [36, 73, 145, 290, 580, 1161]
        assert [len(split.test) for split in splits] == [1714 - size for size in sizes]
    else:
        assert sizes == [70, 140, 350, 700, 1050, 1400]
        assert {len(split.test) for split in splits} == {300}


def test_more_data_is_tested_on_the_same_interactions(paper_batch):
    batch = many(26_000)
    splits = [
        split_of(PaperTrial("more-data", "none", 5, s), batch) for s in COMPARISONS["more-data"].settings
    ]
    assert [len(split.train) for split in splits] == [2000, 5000, 10000, 20000]
    for smaller, larger in pairwise(splits):
        assert set(smaller.train) < set(larger.train)
        assert (len(smaller.validation), len(smaller.test)) == (100, 300)
        np.testing.assert_array_equal(smaller.test, larger.test)
    with pytest.raises(ResultsError, match="setting 2000 needs 2400 levered interactions, the data has 1814"):
        split_of(PaperTrial("more-data", "none", 0, "2000"), paper_batch)


def test_seeds_draw_other_parts(paper_batch):
    for name in [name for name, experiment in COMPARISONS.items() if not experiment.on_request]:
        first, second = plan([name], seeds=[0, 1])[0], plan([name], seeds=[1])[0]
        parts = (split_of(t, paper_batch).train.tolist() for t in (first, second))
        assert len({tuple(part) for part in parts}) == 2, name


def test_the_plan_is_the_papers():
    trials = plan()
    assert len(set(trials)) == len(trials)
    per_seed = {
        "support-points": 18,
        "support-points-novel": 12,
        "support-points-plain": 2,
        "features": 24,
        "half-plane": 3,
    }
    per_seed |= {"training-size": 72, "steps-ahead": 44, "novel-corners": 48, "ablation": 5}
    assert Counter(t.experiment for t in trials) == {name: 10 * count for name, count in per_seed.items()}
    assert {t.features for t in trials if t.experiment == "features"} == set(FEATURES) - {
        "outline",
        "pivot-edge",
    } | {"one-shot"}
    for name in COMPARISONS:
        seeds = [t.seed for t in trials if t.experiment == name]
        assert seeds == sorted(seeds)


def test_a_plan_keeps_to_what_was_asked():
    assert plan(["steps-ahead"], ["none", "im-cnn"], ["2", "5"], [4]) == [
        PaperTrial("steps-ahead", name, 4, setting) for setting in ("2", "5") for name in ("none", "im-cnn")
    ]
    assert [t.experiment for t in plan(["novel-corners", "features"], ["none"], seeds=[0])][::4] == [
        "novel-corners",
        "features",
    ]
    assert len(plan(["half-plane", "half-plane"], ["sc-200", "sc-200"], seeds=[1, 1])) == 1


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"experiments": ["figure-10"]}, "experiment 'figure-10' is unknown: choose from support-points, "),
        ({"features": ["sift"]}, "features 'sift' is unknown: choose from sp-pred, sp-rule, chance, none"),
        (
            {"experiments": ["features"], "features": ["chance"]},
            "features 'chance' is unknown: choose from none",
        ),
        (
            {"experiments": ["steps-ahead"], "settings": ["1"]},
            "setting '1' is unknown: choose from 2, 3, 4, 5",
        ),
        ({"seeds": [0, -2]}, "seed -2 is negative"),
        ({"seeds": []}, "no seed is given"),
        ({"features": ["chance"], "settings": ["by-object"]}, "choose what goes together"),
    ],
)
def test_unknown_names_are_refused_with_the_choices(asked, message):
    with pytest.raises(ResultsError, match=message):
        plan(**asked)


def test_options_and_steps_reach_the_training():
    experiment = Paper(recipes=QUICK, feature_options=factories.QUICK_OPTIONS, epochs=3)
    half = experiment.recipe_of(PaperTrial("half-plane", "sc-800", 2, "shuffled"))
    assert (half.features, half.training.seed, half.feature_options) == ("sc-800", 2, {"half_plane": True})
    assert (half.predictor.steps_ahead, half.training.epochs) == (1, 3)
    assert experiment.recipe_of(PaperTrial("steps-ahead", "ae-256", 0, "4")).predictor.steps_ahead == 4
    assert experiment.recipe_of(PaperTrial("training-size", "ae-256", 0, "4")).predictor.steps_ahead == 1
    assert experiment.recipe_of(PaperTrial("features", "ae-256", 0, "shuffled")).feature_options["width"] == 8
    direct = experiment.recipe_of(PaperTrial("features", "one-shot", 3, "shuffled"))
    assert (direct.predictor.predictor_class.label, direct.features) == ("one-shot", "outline")
    assert (direct.predictor.hidden, direct.training.seed) == (8, 3)
    longer = experiment.recipe_of(PaperTrial("longer", "pivot-edge", 1, "60 epochs, mirrored"))
    assert (longer.features, longer.predictor.mirrored, longer.training.epochs) == ("pivot-edge", True, 60)
    assert experiment.recipe_of(PaperTrial("ablation", "one hinge", 0, "shuffled")).predictor.pivot_edges == 1


def test_data_made_on_another_processor_are_the_same_data():
    """Differences as measured: in the last bit everywhere, of 0.1 mm in some lever-ups."""
    rng = np.random.default_rng(0)
    batch = factories.fake_batch(rng, 200)
    noise = rng.normal(0.0, 1e-12, batch.com.shape)
    noise[::50] *= 1e8
    other = replace(batch, com=batch.com + noise)
    assert processor_independent_fingerprint(other) == processor_independent_fingerprint(batch)
    mask = batch.mask.copy()
    mask[3, 64, 64] ^= True
    for changed in (
        batch[1:],
        replace(batch, mask=mask),
        replace(batch, com=batch.com + 1e-4),
        replace(batch, parameters=batch.parameters | {"friction": np.full(len(mask), 0.7)}),
    ):
        assert processor_independent_fingerprint(changed) != processor_independent_fingerprint(batch)


def test_small_data_needs_proportions(data, tmp_path):
    with pytest.raises(ResultsError, match=r"48 levered interactions, .* need 1800: .*--proportional"):
        run_experiment(Paper(data), tmp_path / "out", workers=1)
    assert not (tmp_path / "out").exists()


def test_another_recipe_needs_another_folder(data, results):
    other = Paper(data, proportional=True, recipes=QUICK, feature_options=factories.QUICK_OPTIONS, epochs=2)
    for call in (run_experiment, count_missing):
        with pytest.raises(
            ResultsError, match=r"recipe\.predictors\.lstm\.training\.epochs = 1, asked for is 2"
        ):
            call(other, data.parent / "results")


@pytest.mark.parametrize(("name", "setting"), [("features", "shuffled"), ("training-size", "16"),
                                               ("novel-corners", "5&6"), ("support-points", "25")])  # fmt: skip
def test_the_ratio_of_an_interval_is_that_of_the_split(name, setting):
    few = factories.fake_batch(np.random.default_rng(0), 16, num_samples=20)
    corners = np.repeat(
        np.arange(3, 11), 2 * 20 * np.arange(3, 11)
    )  # two lever-ups at each edge of 20 objects
    rows = np.array([int(np.flatnonzero(few.num_corners == n)[0]) for n in corners])
    rows = np.random.default_rng(0).permutation(rows)
    split = split_of(PaperTrial(name, COMPARISONS[name].features[0], 0, setting), few[rows[:1814]])
    expected = len(split.test) / len(split.train)
    assert ratio_of(Cell(name, "", setting, "full")) == pytest.approx(expected, rel=0.1)
