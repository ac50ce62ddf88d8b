import os
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from foretrace.evaluation.results import Metrics, ResultsTable, Trial, read_results
from foretrace.evaluation.runner import run_trials
from foretrace.experiments.paper_protocol import Recipe, count_missing, load_levered, run_protocol
from foretrace.experiments.paper_trials import EXPERIMENTS, plan, split_of
from rich.console import Console

import factories
from foretrace.errors import ResultsError, TrainingError
from foretrace.evaluation.metrics import evaluate_predictor, measure_errors
from foretrace.experiments import paper_protocol as protocol
from foretrace.features import FEATURES
from foretrace.interactions.record import Outcome
from foretrace.predictor import RECIPES, TrainConfig
from foretrace.predictor.training import fit_predictor
from foretrace.simulation.collect import CollectConfig, collect, trial

RECIPE = Recipe(
    TrainConfig(hidden=8, epochs=1, min_steps=1),
    factories.QUICK_OPTIONS,
    proportional=True,
    one_shot=replace(RECIPES["one-shot"], hidden=8, epochs=1, min_steps=1),
)
QUIET = Console(quiet=True)
FEW = ("none", "im-cnn", "sc-800", "ae-256", "sp-pred")
TRIALS = [
    *plan(["support-points", "support-points-novel"], settings=["5", "50", "3&4"], seeds=[0]),
    *plan(["features", "half-plane"], seeds=[0]),
    *plan(["training-size", "steps-ahead", "novel-corners"], FEW, seeds=[0]),
    *plan(["support-points-plain"], ["sp-rule"], seeds=[0]),
    *plan(["ablation"], ["one hinge", "no mirror"], seeds=[0]),
]
"""Something of every experiment."""
ERRORS = {"full", "final", "full_median", "final_median", "best_epoch", "epochs", "seconds"}
OF_POSES = ("one-shot", "one hinge", "no mirror")


def fake_simulate(config: CollectConfig, id: int):
    obj, action, seed = trial(config, id)
    outcome = Outcome.SLIPPED if id % 13 == 7 else Outcome.LEVERED
    return factories.fake_lever_up(obj, action, id=id, seed=seed, num_samples=12, outcome=outcome)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("protocol") / "data"
    collect(CollectConfig(8, 1), folder, workers=1, console=QUIET, simulate=fake_simulate)
    return folder


@pytest.fixture(scope="module")
def interrupted(data: Path) -> list[int]:
    """How many trials were finished at each of two interruptions of the run in `results`."""
    return []


@pytest.fixture(scope="module")
def results(data: Path, interrupted: list[int]) -> pd.DataFrame:
    """TRIALS in this process, interrupted twice."""
    out, calls, measure = data.parent / "results", Counter(), protocol.measure_errors

    def stop_sometimes(*arguments):
        calls["all"] += 1
        if calls["all"] in (5, 50):
            raise KeyboardInterrupt
        return measure(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol, "measure_errors", stop_sometimes)
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                run_protocol(data, out, TRIALS, RECIPE, workers=1, console=QUIET)
            interrupted.append(len(TRIALS) - sum(count_missing(data, out, TRIALS, RECIPE).values()))
        assert run_protocol(data, out, TRIALS, RECIPE, workers=1, console=QUIET) == []
    return read_results(out)


def keyed(table: pd.DataFrame) -> dict[tuple, float]:
    """Every value but the times, by its trial and metric."""
    return {tuple(row[:5]): row[5] for row in table[table["metric"] != "seconds"].itertuples(index=False)}


def test_every_experiment_gives_every_number_once(data, results):
    assert not results.duplicated(["experiment", "features", "seed", "setting", "metric"]).any()
    assert np.isfinite(results["value"]).all()
    groups = results.groupby(["experiment", "features", "seed", "setting"])["metric"].agg(set)
    assert set(groups.index) == {(t.experiment, t.features, t.seed, t.setting) for t in TRIALS}
    for (experiment, name, *_), metrics in groups.items():
        if experiment.startswith("support-points"):
            assert {"accuracy", "accuracy_from_mask", "seconds"} < metrics
        else:
            of_poses = {"rotation", "rotation_median", "add", "add_median"}
            assert metrics == (ERRORS | of_poses if name in OF_POSES else ERRORS)
    usual = [name for name, experiment in EXPERIMENTS.items() if not experiment.on_request]
    assert count_missing(data, data.parent / "results", TRIALS, RECIPE) == dict.fromkeys(usual, 0)


def test_an_interrupted_run_keeps_what_is_finished(results, interrupted):
    # The fifth training was stopped, later the fiftieth call; nine trials before them judge support points only.
    assert interrupted == [9 + 4, 9 + 48]


def test_neither_workers_nor_order_nor_other_trials_change_a_value(data, results, tmp_path):
    trials = plan(
        ["novel-corners", "support-points", "steps-ahead"], ["sc-800", "sp-pred", "ae-256"], ["9&10", "50", "3"],
        seeds=[0],
    )[::-1]  # fmt: skip
    assert len(trials) == 7
    assert run_protocol(data, tmp_path, trials, RECIPE, workers=2, console=QUIET) == []
    found, whole = keyed(read_results(tmp_path)), keyed(results)
    assert len(found) > 6 * 6
    assert {key: whole[key] for key in found} == found


def test_settings_and_seeds_make_a_difference(results):
    values = results[(results["metric"] == "full") & (results["features"] == "sc-800")]["value"]
    assert values.nunique() == len(values) == 2 + 1 + 6 + 4 + 4


def test_the_shuffled_setting_is_what_train_and_evaluate_would_give(data, results):
    batch = load_levered(data)
    config = replace(RECIPE.training, features="sc-200", seed=0, threads=1, device="cpu")
    split = split_of(Trial("features", "sc-200", 0, "shuffled"), batch, proportional=True)
    predictor, _ = fit_predictor(batch, config, split)
    rows = evaluate_predictor(predictor, batch[split.test])
    expected = {r["metric"]: r for r in rows if r["group"] == "all" and r["start"] == "observed"}
    found = measure_errors(predictor, batch[split.test], predictor.features.inputs(batch[split.test]))
    stored = keyed(results)
    for metric in ("full", "final"):
        key = ("features", "sc-200", 0, "shuffled")
        assert found[metric] == pytest.approx(expected[metric]["mean_cm"], rel=1e-6)
        assert stored[(*key, metric)] == pytest.approx(expected[metric]["mean_cm"], rel=1e-6)
        assert stored[(*key, f"{metric}_median")] == pytest.approx(expected[metric]["median_cm"], rel=1e-6)


@pytest.fixture(scope="module")
def paper_batch():
    """As many levered interactions as the paper has, in little more than name."""
    few = factories.fake_batch(np.random.default_rng(0), 16, num_samples=20)
    return few[np.arange(1814) % 16]


@pytest.mark.parametrize("proportional", [False, True])
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_no_trial_is_tested_on_what_it_learned_from(name, proportional, paper_batch):
    if EXPERIMENTS[name].on_request:  # of more data than the paper's
        paper_batch = paper_batch[np.arange(26_000) % len(paper_batch)]
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
    label = EXPERIMENTS[name].features[0]
    splits = [split_of(Trial(name, label, 5, s), paper_batch) for s in EXPERIMENTS[name].settings]
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
    many = paper_batch[np.arange(20_400) % len(paper_batch)]
    splits = [split_of(Trial("more-data", "none", 5, s), many) for s in EXPERIMENTS["more-data"].settings]
    assert [len(split.train) for split in splits] == [2000, 5000, 10000, 20000]
    for smaller, larger in pairwise(splits):
        assert set(smaller.train) < set(larger.train)
        assert (len(smaller.validation), len(smaller.test)) == (100, 300)
        np.testing.assert_array_equal(smaller.test, larger.test)
    with pytest.raises(ResultsError, match="setting 2000 needs 2400 levered interactions, the data has 1814"):
        split_of(Trial("more-data", "none", 0, "2000"), paper_batch)


def test_seeds_draw_other_parts(paper_batch):
    for name in [name for name, experiment in EXPERIMENTS.items() if not experiment.on_request]:
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
    per_seed |= {"training-size": 72, "steps-ahead": 44, "novel-corners": 48, "ablation": 4}
    assert Counter(t.experiment for t in trials) == {name: 10 * count for name, count in per_seed.items()}
    assert {t.features for t in trials if t.experiment == "features"} == set(FEATURES) - {"outline"} | {
        "one-shot"
    }
    for name in EXPERIMENTS:
        seeds = [t.seed for t in trials if t.experiment == name]
        assert seeds == sorted(seeds)


def test_a_plan_keeps_to_what_was_asked():
    assert plan(["steps-ahead"], ["none", "im-cnn"], ["2", "5"], [4]) == [
        ("steps-ahead", "none", 4, "2"), ("steps-ahead", "im-cnn", 4, "2"),
        ("steps-ahead", "none", 4, "5"), ("steps-ahead", "im-cnn", 4, "5"),
    ]  # fmt: skip
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
        ({"seeds": []}, "choose what goes together"),
        ({"features": ["chance"], "settings": ["by-object"]}, "choose what goes together"),
    ],
)
def test_unknown_names_are_refused_with_the_choices(asked, message):
    with pytest.raises(ResultsError, match=message):
        plan(**asked)


def test_options_and_steps_reach_the_training():
    plain = RECIPE.options(Trial("support-points-plain", "sp-pred", 0, "100"))
    assert (plain["aligned"], plain["epochs"]) == (False, 500)
    half = RECIPE.configure(Trial("half-plane", "sc-800", 2, "shuffled"))
    assert (half.features, half.seed, half.feature_options, half.steps_ahead) == (
        "sc-800", 2, {"half_plane": True}, 1,
    )  # fmt: skip
    assert RECIPE.configure(Trial("steps-ahead", "ae-256", 0, "4")).steps_ahead == 4
    assert RECIPE.configure(Trial("training-size", "ae-256", 0, "4")).steps_ahead == 1
    assert RECIPE.configure(Trial("features", "ae-256", 0, "shuffled")).feature_options["width"] == 8
    whole = RECIPE.configure(Trial("features", "one-shot", 3, "shuffled"))
    assert (whole.predictor, whole.features, whole.hidden, whole.seed) == ("one-shot", "outline", 8, 3)
    assert RECIPE.configure(Trial("ablation", "one hinge", 0, "shuffled")).predictor_options == {"hinges": 1}


def test_small_data_needs_proportions(data, tmp_path):
    with pytest.raises(ResultsError, match=r"48 levered interactions, .* need 1800: .*--proportional"):
        run_protocol(data, tmp_path / "out", plan(), Recipe(), workers=1)
    assert not (tmp_path / "out").exists()


def test_another_recipe_needs_another_folder(data, results):
    out = data.parent / "results"
    other = Recipe(TrainConfig(hidden=8, epochs=2, min_steps=1), factories.QUICK_OPTIONS, proportional=True)
    for call in (run_protocol, count_missing):
        with pytest.raises(ResultsError, match=r"recipe\.epochs = 1, asked for is 2"):
            call(data, out, TRIALS, other)


# --- the runner -------------------------------------------------------------------------------------------


def odd_seeds_only(trial: Trial) -> Metrics:
    if trial.seed % 2 == 0:
        raise TrainingError(f"seed {trial.seed} is even")
    return {"full": trial.seed / 10, "process": float(os.getpid()), "seconds": 0.0}


@pytest.mark.parametrize("workers", [1, 2])
def test_failed_trials_do_not_lose_the_others(workers, tmp_path):
    trials = [Trial("any", "none", seed, "some") for seed in range(6)]
    with ResultsTable(tmp_path, {}) as table:
        failures = run_trials(trials, odd_seeds_only, table, workers=workers, console=QUIET)
        assert sorted((failed.seed, message) for failed, message in failures) == [
            (0, "seed 0 is even"),
            (2, "seed 2 is even"),
            (4, "seed 4 is even"),
        ]
        assert table.done() == set(trials[1::2])
        again = run_trials(trials, odd_seeds_only, table, workers=1, console=QUIET)
    assert len(again) == 3
    rows = read_results(tmp_path)
    assert len(rows) == 9
    in_parent = rows[rows["metric"] == "process"]["value"] == os.getpid()
    assert in_parent.all() if workers == 1 else not in_parent.any()


def test_every_finished_trial_is_a_line_where_there_is_no_terminal(tmp_path, capsys):
    trials = [Trial("any", "none", seed, "some") for seed in range(3)]
    with ResultsTable(tmp_path, {}) as table:
        table.append(trials[1], {"full": 0.1, "seconds": 1.0})
        run_trials([*trials, Trial("any", "none", 3, "some")], odd_seeds_only, table)
    assert capsys.readouterr().err.splitlines() == [
        "1 of 4 trainings are there already",
        "2/4  any some, none, seed 0: failed",
        "3/4  any some, none, seed 2: failed",
        "4/4  any some, none, seed 3: full 0.300 in 0 s",
    ]
