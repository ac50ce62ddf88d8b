"""Masks against height maps of objects that are not flat."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from foretrace.cli import main
from foretrace.errors import DatasetError, ResultsError, TrainingError
from foretrace.evaluation.run import run_experiment
from foretrace.experiments import non_flat
from foretrace.experiments.non_flat import NonFlat, example_paths, measure, outcome_sensitivity
from foretrace.experiments.non_flat_data import NonFlatData
from foretrace.experiments.non_flat_figures import paths_figure
from foretrace.experiments.training import Recipe
from foretrace.imagined import Futures, ImaginedBatch
from foretrace.predictor import LstmConfig
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.states import valid_lengths
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.simulation.lever_up import SimulationConfig

PARTS = ("train", "validation", "test")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Three outlines, each of a cylinder, a box and a flat prism levered at every edge."""
    out = tmp_path_factory.mktemp("solids")
    collect(CollectConfig(9, 1, 0, SimulationConfig(embodiment="tool", watch_time=1.5), "solids"), out, 1)
    return out


@pytest.fixture(scope="module")
def data(folder) -> NonFlatData:
    return NonFlatData.open(folder)


@pytest.fixture
def oracle(monkeypatch) -> EffectPredictor:
    """Imagines what was observed, but goes astray where nothing is judged any more."""

    def imagine(batch) -> ImaginedBatch:
        judged = np.arange(len(batch.times)) < valid_lengths(batch)[:, None]
        com = np.where(judged[..., None], batch.com, 9.0)
        return ImaginedBatch(batch.times, com, None, Futures.point(com, None, "levered"))

    predictor = LstmConfig(features="none", hidden=4).make(90)
    monkeypatch.setattr(predictor, "imagine_batch", imagine)
    return predictor


def test_look_alikes_share_outline_and_mask(data):
    assert {kind: int((data.kinds == kind).sum()) for kind in set(data.kinds)} == {
        "cylinder": 12,
        "box": 12,
        "flat prism": 12,
    }
    assert len(set(data.outlines)) == 3
    for contact in np.unique(data.contacts):
        rows = np.flatnonzero(data.contacts == contact)
        assert set(data.kinds[rows]) == {"cylinder", "box", "flat prism"}
        assert len(set(data.outlines[rows])) == 1
        masks, heights = data.batch.mask[rows], data.batch.height[rows]
        assert (masks == masks[0]).all()
        assert np.abs(heights[0] - heights[1]).max() > 0.005


@pytest.mark.parametrize("seed", range(4))
def test_no_outline_is_in_two_parts(data, seed):
    split = data.split("by-outline", seed)
    outlines = [set(data.outlines[getattr(split, part)]) for part in PARTS]
    assert set.union(*outlines) == set(data.outlines)
    assert sum(map(len, outlines)) == len(set(data.outlines))
    for part in PARTS:
        assert set(data.kinds[getattr(split, part)]) == {"cylinder", "box", "flat prism"}


def test_the_random_split_takes_every_interaction_once(data):
    split = data.split("random", 0)
    rows = np.concatenate([getattr(split, part) for part in PARTS])
    np.testing.assert_array_equal(np.sort(rows), np.arange(len(data.batch)))
    assert set(data.outlines[split.train]) & set(data.outlines[split.test])


def test_whole_rolls_are_judged_and_slips_up_to_the_slip(data, oracle):
    rows = np.arange(len(data.batch))
    table = measure(oracle, data, rows)
    assert table["full_cm"].max() == 0
    assert table["final_cm"].max() == 0
    lengths = valid_lengths(data.batch)
    rolled, slipped = (np.flatnonzero(data.batch.outcome == name) for name in ("rolled", "slipped"))
    assert len(rolled) >= 6
    assert (lengths[rolled] == len(data.batch.times)).all()
    assert (lengths[slipped] < len(data.batch.times)).all()
    assert table["still_cm"].to_numpy()[rolled].min() > 1
    k = rolled[0]
    com = data.batch.com[k]
    still = 100 * np.linalg.norm(com - com[0], axis=1).mean()
    assert table["still_cm"][k] == pytest.approx(still)


def test_the_example_is_the_lever_up_whose_fates_lie_farthest_apart(data, oracle):
    rows = np.arange(len(data.batch))
    paths = example_paths({"mask": oracle}, data, rows)
    assert set(paths["path"]) == {"observed", "mask"}
    ends = paths.loc[paths["path"].eq("observed")].groupby("kind").last()[["x_cm", "y_cm", "z_cm"]]
    assert set(ends.index) == {"cylinder", "box", "flat prism"}
    apart = np.linalg.norm(ends.to_numpy()[:, None] - ends.to_numpy(), axis=-1)
    assert apart[~np.eye(3, dtype=bool)].min() > 1
    assert len(paths_figure(paths).axes) == 3
    assert example_paths({}, data, rows[data.kinds == "box"]).empty


def test_equal_lever_ups_end_alike(data, monkeypatch):
    rows = data.drawn[:2].tolist()
    found = [outcome_sensitivity(data, row) for row in rows]
    assert all(1e-5 < each["irreducible_cm"] < 5 for each in found)
    monkeypatch.setattr(non_flat, "NEARLY", 0.0)
    same = [outcome_sensitivity(data, row) for row in rows]
    assert max(each["irreducible_cm"] for each in same) < 1e-9
    assert all(each["same"] for each in same)
    assert [each["id"] for each in same] == [each["id"] for each in found] == data.batch.ids[rows].tolist()


def test_the_summary_compares_seed_by_seed():
    rows = [
        {"setting": "by-outline", "seed": seed, "part": "error", "channel": channel, "id": k, "kind": kind}
        | {"outcome": "rolled", "full_cm": full * (1 + seed), "final_cm": 2 * full, "still_cm": 5.0}
        for seed in (0, 1)
        for channel, full in (("mask", 4.0), ("height", 1.0))
        for k, kind in enumerate(("cylinder", "prism"))
    ]
    rows.append({"setting": "outcome-sensitivity", "seed": 0, "part": "sensitivity", "kind": "cylinder"})
    rows[-1] |= {"irreducible_cm": 0.2, "same": True}
    table, experiment = pd.DataFrame(rows), NonFlat()
    summary = experiment.summarise(table)
    groups = summary["settings"]["by-outline"]["groups"]
    assert set(groups) == {"all", "alike", "cylinder", "prism"}
    found = groups["all"]["mask"]["full_cm"]
    assert (found["mean"], found["low"] < 4.0 < 8.0 < found["high"]) == (6.0, True)
    assert groups["all"]["ratio"] == {"mean": 0.25, "low": 0.25, "high": 0.25}
    assert (groups["all"]["interactions"], groups["alike"]["interactions"]) == (2, 1)
    assert summary["outcome_sensitivity"]["cylinder"]["irreducible_cm"] == 0.2
    text = experiment.report(summary, table)
    assert "| Paper, all |  |  | 7.23 | 2.77 | 0.38 |" in text
    assert "at most 0.2 over all: not met" in text
    assert "| cylinder | 1 | 0.200 | 0.200 | 100 % |" in text
    assert len(experiment.figures(table)["errors"].axes) == 1


def test_seeds_and_probes_add_to_what_is_there(folder, tmp_path):
    quick = Recipe.of("lstm").change(hidden=4, min_steps=1, epochs=1)
    options = {"data": folder, "splits": ("by-outline",), "recipe": quick}
    run_experiment(NonFlat(**options, seeds=(0,), probes=1), tmp_path)
    kept = tmp_path / "trainings" / "by-outline-mask-0" / "metrics.csv"
    first = kept.stat().st_mtime_ns
    found = run_experiment(NonFlat(**options, seeds=(0, 1), probes=2), tmp_path)
    assert kept.stat().st_mtime_ns == first
    assert "Split by-outline, seeds 0, 1" in found.report
    errors = found.rows.loc[found.rows["part"].eq("error")]
    assert errors.groupby(["seed", "channel"]).size().to_dict() == {
        (seed, channel): 12 for seed in (0, 1) for channel in ("mask", "height")
    }
    assert found.summary["outcome_sensitivity"]["alike"]["probes"] == 2
    for channel in ("mask", "height"):
        config = json.loads((tmp_path / "trainings" / f"by-outline-{channel}-0" / "config.json").read_text())
        assert f'"channel": "{channel}"' in json.dumps(config)
        assert '"rolled"' in json.dumps(config)


def test_what_does_not_look_alike_is_refused(tmp_path):
    collect(CollectConfig(1, 1, 0, SimulationConfig(embodiment="tool")), tmp_path, 1)
    with pytest.raises(DatasetError, match="too few objects that look alike"):
        NonFlatData.open(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--data", "{tmp}/none"], "none"),
        (["--seeds", "-1"], "seed -1 is negative"),
        (["--probes", "-1"], "--probes is -1"),
        (["--epochs", "0"], "epochs is 0: give a number from 1"),
        (["--out", "{folder}/manifest.json"], "is a file"),
    ],
)
def test_bad_input_is_one_line(folder, tmp_path, capsys, options, message):
    given = [option.format(tmp=tmp_path, folder=folder) for option in options]
    usual = {"--data": str(folder), "--out": str(tmp_path / "out")}
    arguments = [part for name, value in usual.items() if name not in options for part in (name, value)]
    assert main(["evaluate", "non-flat", *arguments, *given]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_settings_that_do_not_fit_masks_and_height_maps_are_refused(folder, tmp_path):
    recipe = Recipe.of("lstm").change(features="sp-rule")
    with pytest.raises(ResultsError, match="'sp-rule' of lstm do not come from both masks and height maps"):
        run_experiment(NonFlat(folder, recipe=recipe), tmp_path / "out")
    with pytest.raises(TrainingError, match="unknown predictor 'oracle'"):
        run_experiment(NonFlat(folder, predictor="oracle"), tmp_path / "out")
