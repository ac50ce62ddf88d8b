"""How several futures are judged: outcomes, errors, regions, samples, observed beginnings."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from rich.console import Console

import factories
from foretrace.cli import main
from foretrace.errors import DatasetError
from foretrace.evaluation.run import run_experiment
from foretrace.experiments import uncertainty
from foretrace.experiments import uncertainty_metrics as metrics
from foretrace.experiments.training import Recipe
from foretrace.experiments.uncertainty import Uncertainty
from foretrace.experiments.uncertainty_metrics import ALL, Part, constant_deviations, score
from foretrace.imagined import LEVELS
from foretrace.interactions.record import NO_OFFSET, Outcome
from foretrace.predictor import Futures, ImaginedBatch, load_predictor
from foretrace.predictor.states import decode_poses
from foretrace.simulation.collect import CollectConfig, collect

QUICK = Recipe.of("one-shot").change(hidden=8, epochs=1, min_steps=1)
QUIET = Console(quiet=True)
HALF = 12.7062 * (0.5 * (1 / 2 + 300 / 1400)) ** 0.5
"""Half the width of the interval of two values that are 1 apart."""


def found_of(rows: metrics.Found) -> dict[tuple[str, str, float], float]:
    """By metric, group and level (-1 where there is none)."""
    return {(m, g, -1.0 if np.isnan(level) else level): value for m, g, level, value in rows}


@pytest.fixture(scope="module")
def batch():
    return factories.fake_batch(np.random.default_rng(0), 20, num_samples=20)


@pytest.fixture(scope="module")
def part(batch) -> Part:
    torch.set_num_threads(1)
    predictor = QUICK.change(outcomes=("levered", "slipped")).make(20)
    return Part.of(predictor, batch)


def told(part: Part, *com: np.ndarray, probability: tuple[float, ...], spread: float = 0.01) -> ImaginedBatch:
    """Futures with these positions, turned as it happened; the outcomes by turns levered and slipped."""
    n, shape = len(part), (len(part), len(com))
    positions = np.stack(com, axis=1)
    states = np.concatenate([positions, np.stack([part.states[..., 3:]] * len(com), 1)], axis=-1)
    futures = Futures(
        probability=np.tile(probability, (n, 1)).astype(float),
        outcome=tuple(("levered", "slipped")[k % 2] for k in range(len(com))),
        states=states,
        spread=np.full((*shape, positions.shape[2]), spread),
        support_points=np.zeros((*shape, 2, 2)),
        quantiles=LEVELS,
    )
    return ImaginedBatch(part.batch.times, positions[:, 0], decode_poses(states[:, 0]), futures)


def test_outcomes_by_hand():
    said = {"levered": np.array([0.9, 0.6, 0.2, 0.7]), "slipped": np.array([0.1, 0.4, 0.8, 0.3])}
    truth = np.array(["levered", "levered", "slipped", "slipped"])
    found = found_of(metrics.evaluate_outcomes({**said, "rolled": np.zeros(4)}, truth))
    assert found["confusion", "slipped, predicted levered", -1] == 1
    assert found["confusion", "levered, predicted levered", -1] == 2
    assert found["f1", "levered", -1] == pytest.approx(4 / 5)
    assert found["f1", "slipped", -1] == pytest.approx(2 / 3)
    assert ("f1", "rolled", -1) not in found, "an outcome that neither happened nor was said has no score"
    assert found["macro_f1", ALL, -1] == pytest.approx((4 / 5 + 2 / 3) / 2)
    assert (found["accuracy", ALL, -1], found["accuracy_of_most_common", ALL, -1]) == (0.75, 0.5)
    assert found["brier", ALL, -1] == pytest.approx(2 * (0.01 + 0.16 + 0.04 + 0.49) / 4)


def test_errors_are_those_of_the_most_probable_and_of_the_nearest_future_that_counts(part):
    off = [part.com + np.array([shift, 0, 0]) for shift in (0.02, 0.01, 0.0)]
    found = found_of(metrics.evaluate_errors(told(part, *off, probability=(0.7, 0.29, 0.01)), part))
    for name in ("full", "final", "full_median", "until_slip_full", "until_slip_final"):
        assert found[name, ALL, -1] == pytest.approx(2), name
    for name in ("nearest_full", "nearest_final"):
        assert found[name, ALL, -1] == pytest.approx(1), "the exact one is too improbable to count"
    assert found["futures", ALL, -1] == 2
    assert found["rotation", ALL, -1] == pytest.approx(0, abs=1e-6)


def test_errors_until_the_slip_know_nothing_of_what_follows(part):
    stray = part.com.copy()
    for row, slip in enumerate(part.batch.slip_index):
        stray[row, slip:] += [0, 0, 0.05]
    found = found_of(metrics.evaluate_errors(told(part, stray, probability=(1.0,)), part))
    assert found["final", "slipped", -1] == pytest.approx(5)
    assert found["until_slip_full", "slipped", -1] == pytest.approx(0, abs=1e-9)
    assert found["full", "levered", -1] == pytest.approx(0, abs=1e-9)


def test_a_motion_is_covered_if_it_never_leaves_one_of_the_tubes(part):
    # The radius is the level times (1 cm + 0.1 mm).
    once = part.com.copy()
    once[:, 7] += [0, 0.005, 0]
    futures = metrics.futures_of(told(part, part.com + 1, once, probability=(0.6, 0.4)))
    found = found_of(metrics.evaluate_regions(futures, part))
    assert found["coverage", ALL, 0.49] == 0
    assert found["coverage", ALL, 0.5] == 1
    assert found["tube", "levered", 0.9] == pytest.approx(0.9 * 1.01)
    # Two halves of two futures are none.
    halves = [part.com.copy(), part.com.copy()]
    halves[0][:, 5:] += 1
    halves[1][:, :5] += 1
    futures = metrics.futures_of(told(part, *halves, probability=(0.5, 0.5)))
    assert found_of(metrics.evaluate_regions(futures, part))["coverage", ALL, 0.99] == 0


def test_the_rest_of_a_motion_is_judged_from_the_first_sample_that_was_not_observed(part, monkeypatch):
    asked = []

    def imagine(features, com, seen):
        """2 cm off, but 1 cm once something was observed; what was observed itself is nonsense."""
        rows = [int(np.flatnonzero((part.com[:, 0] == each).all(axis=1))[0]) for each in com]
        chosen = Part(part.batch[rows], features, part.states[rows], part.valid[rows])
        path = chosen.com + np.array([0.02 if seen is None else 0.01, 0, 0])
        if seen is not None:
            asked.append(seen.shape[1])
            np.testing.assert_array_equal(seen, chosen.states[:, : seen.shape[1]])
            path[:, : seen.shape[1]] = 9
        return told(chosen, path, path, probability=(0.6, 0.4))

    predictor = QUICK.change(outcomes=("levered", "slipped")).make(20)
    monkeypatch.setattr(predictor, "imagine_effects", imagine)
    monkeypatch.setattr(metrics, "OBSERVED", (0, 5, 15, 30))
    found = found_of(metrics.evaluate_observed(predictor, part))
    assert found["record_rest", ALL, 0] == found["record_rest_unobserved", ALL, 0] == pytest.approx(2)
    assert found["record_rest", ALL, 5] == pytest.approx(1)
    assert found["record_rest_ratio", "slipped", 5] == pytest.approx(0.5)
    assert found["record_rest_count", ALL, 15] == (part.batch.length > 15).sum() < len(part)
    assert ("record_rest", ALL, 30) not in found
    # The factory's objects rest for the first samples.
    first = np.argmax(np.linalg.norm(part.com - part.com[:, :1], axis=2) > 0.001, axis=1)
    assert first.min() > 0
    assert set(asked) == {5, 15} | set(first) | {n + 5 for n in first} | {
        n + 15 for n, length in zip(first, part.batch.length, strict=True) if n + 15 < length
    }


def test_scores_of_samples_that_all_agree_are_their_errors():
    com = np.zeros((2, 5, 3))
    valid = np.arange(5) < np.array([[5], [3]])
    drawn = np.full((2, 4, 5, 3), [0.03, 0.0, 0.04])
    drawn[1, :, 3:] = np.nan
    found = score(drawn, com, valid)
    for name in ("energy_full", "energy_final"):
        np.testing.assert_allclose(found[name], 5)
    np.testing.assert_allclose(found["crps"], 7 / 3)


def test_who_draws_from_the_truth_has_the_best_score():
    rng = np.random.default_rng(0)
    shape = (60, 40, 2, 3)
    com, valid = 0.01 * rng.standard_normal((60, 2, 3)), np.ones((60, 2), dtype=bool)
    means = [
        {
            name: values.mean()
            for name, values in score(width * rng.standard_normal(shape), com, valid).items()
        }
        for width in (0.01, 0.001, 0.03)
    ]
    for name in means[0]:
        assert means[0][name] < min(means[1][name], means[2][name]), name


def test_the_constant_gaussian_is_fitted_sample_by_sample():
    rng = np.random.default_rng(0)
    wide = np.array([0.001, 0.004, 0.0])
    off = wide[:, None] * rng.standard_normal((4000, 3, 3))
    valid = np.ones((4000, 3), dtype=bool)
    valid[:, 2] = False  # nobody has this sample: the one before speaks for it
    off[:, 2] = 7
    for name, found in constant_deviations(off, valid).items():
        np.testing.assert_allclose(found, [0.001, 0.004, 0.004], rtol=0.05, err_msg=name)
    off[:40] *= 100  # a few gross errors
    valid[:, 2] = True
    found = constant_deviations(off[:, :2], valid[:, :2])
    assert (found["gaussian"] > 5 * found["sharp"]).all()


def test_the_summary_tells_of_seeds_and_of_rare_outcomes():
    rows = pd.DataFrame(
        [
            {
                "seed": seed,
                "split": "shuffled",
                "metric": metric,
                "group": group,
                "level": level,
                "value": value,
            }
            for seed in (0, 1)
            for metric, group, level, value in (
                ("full", ALL, np.nan, 1.0 + seed),
                ("count_test", "levered", np.nan, 30),
                ("count_test", "slipped", np.nan, 3),
                ("coverage", ALL, 0.9, 0.8 + seed / 10),
                ("coverage", ALL, 0.91, 0.8),
                ("tube", ALL, 0.95, np.inf),
            )
        ]
    )
    found = Uncertainty().summarise(rows)["shuffled"]
    assert found["seeds"] == [0, 1]
    assert found["few"] == ["slipped"]
    assert found["values"]["full"][ALL] == pytest.approx(
        {"mean": 1.5, "low": 1.5 - HALF, "high": 1.5 + HALF}, abs=1e-4
    )
    coverage = pytest.approx({"mean": 0.85, "low": 0.85 - HALF / 10, "high": 0.85 + HALF / 10}, abs=1e-4)
    assert found["values"]["coverage"][ALL] == {"0.9": coverage}
    assert found["values"]["tube"][ALL]["0.95"]["mean"] is None
    json.dumps(found, allow_nan=False)


# --- from data to pictures ------------------------------------------------------------------------------------


def fake_simulate(config, id):
    """Every fourth lever-up slips."""
    interaction = factories.fake_interaction(
        np.random.default_rng(id),
        id,
        outcome=Outcome.SLIPPED if id % 4 == 1 else Outcome.LEVERED,
        num_samples=20,
    )
    return replace(interaction, execution_error=NO_OFFSET)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("uncertainty") / "data"
    collect(CollectConfig(4, 2), out, workers=1, console=QUIET, simulate=fake_simulate)
    return out


def test_an_experiment_measures_what_its_kept_trainings_give(folder, tmp_path):
    experiment = Uncertainty(folder, seeds=(1,), held_out=(5,), samples=3, unlike=folder, recipe=QUICK)
    found = run_experiment(experiment, tmp_path)
    batch, rows = uncertainty.load(folder), found.rows
    predictor = load_predictor(tmp_path / "trainings" / "shuffled-1")
    split = uncertainty.split_of(batch, "shuffled", 1)
    again = uncertainty.measure(predictor, batch, split, 1, samples=3, unlike=batch)
    mine = rows.loc[rows["split"].eq("shuffled"), list(again)].reset_index(drop=True)
    pd.testing.assert_frame_equal(mine, again, rtol=1e-6)
    # All of the other data count, and only once.
    other = rows.loc[rows["metric"].eq("unlike_record_rest_count") & rows["level"].eq(0)]
    assert set(other["split"]) == {"shuffled"}
    assert other.loc[other["group"].eq("all"), "value"].tolist() == [len(batch)]
    assert "### The same of lever-ups with other physics" in found.report
    assert "## Novel shapes, seeds 1" in found.report
    novel = rows.loc[rows["split"].eq("novel-shapes") & rows["metric"].str.startswith("count_")]
    assert novel.loc[novel["metric"].eq("count_test"), "value"].sum() == (batch.num_corners == 5).sum()
    assert novel["value"].sum() == len(batch)
    assert set(experiment.figures(rows)) == {"reliability", "observed", "confusion"}


def test_no_interaction_is_in_two_parts_and_novel_shapes_are_never_learned_from(batch):
    for setting in uncertainty.SETTINGS:
        split = uncertainty.split_of(batch, setting, 1)
        rows = np.concatenate([split.train, split.validation, split.test])
        assert sorted(rows) == list(range(len(batch)))
    learned = batch.num_corners[np.concatenate([split.train, split.validation])]
    assert not set(learned) & set(uncertainty.HELD_OUT)
    assert set(batch.num_corners[split.test]) == set(uncertainty.HELD_OUT)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seeds", "-1"], "seed -1 is negative"),
        (["--samples", "1"], "--samples is 1"),
        (["--epochs", "0"], "epochs is 0: give a number from 1"),
        (["--held-out", "17"], "no object has [17] corners"),
        (["--out", "{folder}/manifest.json"], "is a file"),
    ],
)
def test_bad_input_is_one_line(folder, tmp_path, capsys, options, message):
    given = [option.format(folder=folder) for option in options]
    usual = {"--data": str(folder), "--out": str(tmp_path / "out")}
    arguments = [part for name, value in usual.items() if name not in options for part in (name, value)]
    assert main(["evaluate", "uncertainty", *arguments, *given]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_other_physics_are_judged_at_the_same_times(folder):
    batch = uncertainty.load(folder)
    assert len(uncertainty.load(folder, like=batch)) == len(batch)
    with pytest.raises(
        DatasetError, match=r"samples up to .* s, the data that are learned from .*: simulate both"
    ):
        uncertainty.load(folder, like=replace(batch, times=2 * batch.times))


def test_data_without_motions_are_refused(tmp_path):
    def never_moved(config, id):
        interaction = factories.fake_interaction(np.random.default_rng(id), id, num_samples=1)
        return replace(interaction, execution_error=NO_OFFSET)

    collect(CollectConfig(1, 1), tmp_path, workers=1, console=QUIET, simulate=never_moved)
    with pytest.raises(DatasetError, match="motion of two samples"):
        uncertainty.load(tmp_path)
