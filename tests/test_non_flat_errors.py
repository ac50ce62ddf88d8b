"""Masks against height maps of objects that are not flat."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from foretrace.experiments.non_flat_errors import NonFlatData, example_paths, measure, spread_of_fates
from foretrace.experiments.non_flat_report import errors_figure, markdown, paths_figure, summarise
from PIL import Image

from foretrace.cli import main
from foretrace.errors import DatasetError
from foretrace.experiments import non_flat_errors
from foretrace.imagined import ImaginedBatch
from foretrace.predictor import TrainConfig, train_predictor
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
        return ImaginedBatch(batch.times, np.where(judged[..., None], batch.com, 9.0))

    predictor = TrainConfig(features="none", hidden=4).make_predictor(90)
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


def test_equal_lever_ups_have_one_fate(data, monkeypatch):
    found = spread_of_fates(data, 2)
    assert found["floor_cm"].between(1e-5, 5).all()
    monkeypatch.setattr(non_flat_errors, "NEARLY", 0.0)
    same = spread_of_fates(data, 2)
    assert same["floor_cm"].max() < 1e-9
    assert same["same"].all()
    np.testing.assert_array_equal(same["id"], found["id"])
    assert spread_of_fates(data, 0).empty


def test_the_summary_compares_seed_by_seed():
    rows = [
        {
            "setting": "by-outline",
            "seed": seed,
            "channel": channel,
            "id": k,
            "kind": kind,
            "outcome": "rolled",
        }
        | {"full_cm": full * (1 + seed), "final_cm": 2 * full, "still_cm": 5.0}
        for seed in (0, 1)
        for channel, full in (("mask", 4.0), ("height", 1.0))
        for k, kind in enumerate(("cylinder", "prism"))
    ]
    floors = pd.DataFrame({"kind": ["cylinder"], "floor_cm": [0.2], "same": [True]})
    summary = summarise(pd.DataFrame(rows), floors)
    groups = summary["settings"]["by-outline"]["groups"]
    assert set(groups) == {"all", "alike", "cylinder", "prism"}
    assert groups["all"]["mask"]["full_cm"] == {"mean": 6.0, "low": 4.0, "high": 8.0}
    assert groups["all"]["ratio"] == {"mean": 0.25, "low": 0.25, "high": 0.25}
    assert (groups["all"]["interactions"], groups["alike"]["interactions"]) == (2, 1)
    assert summary["floors"]["cylinder"]["floor_cm"] == 0.2
    text = markdown(summary)
    assert "| Paper, all |  |  | 7.23 | 2.77 | 0.38 |" in text
    assert "at most 0.2 over all: not met" in text
    assert len(errors_figure(summary).axes) == 1


def test_the_command_adds_seeds_to_what_is_there(folder, tmp_path, monkeypatch, capsys):
    def train_little(batch, config, *arguments, **options):
        config = replace(config, hidden=4, min_steps=1)
        assert set(config.outcomes) >= {"rolled", "slipped"}
        return train_predictor(batch, config, *arguments, **options)

    monkeypatch.setattr(non_flat_errors, "train_predictor", train_little)
    out = tmp_path / "out"
    command = (
        f"evaluate non-flat --data {folder} --out {out} --splits by-outline --epochs 1 --probes 1".split()
    )
    assert main([*command, "--seeds", "0"]) == 0
    first = (out / "trainings" / "by-outline-mask-0" / "metrics.csv").stat().st_mtime_ns
    assert main([*command, "--seeds", "0", "1"]) == 0
    assert (out / "trainings" / "by-outline-mask-0" / "metrics.csv").stat().st_mtime_ns == first
    assert "Split by-outline, seeds 0, 1" in capsys.readouterr().out
    errors = pd.read_csv(out / "errors.csv")
    assert errors.groupby(["seed", "channel"]).size().to_dict() == {
        (seed, channel): 12 for seed in (0, 1) for channel in ("mask", "height")
    }
    for channel in ("mask", "height"):
        config = json.loads((out / "trainings" / f"by-outline-{channel}-0" / "config.json").read_text())
        assert config["features"]["options"]["channel"] == channel
    assert json.loads((out / "summary.json").read_text())["settings"]["by-outline"]["seeds"] == [0, 1]
    for name in ("errors.png", "paths.png"):
        assert Image.open(out / name).width > 500
    assert main([*command, "--seeds", "0", "--epochs", "2"]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("foretrace: error: ")


def test_what_does_not_look_alike_is_refused(tmp_path):
    collect(CollectConfig(1, 1, 0, SimulationConfig(embodiment="tool")), tmp_path, 1)
    with pytest.raises(DatasetError, match="too few objects that look alike"):
        NonFlatData.open(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--data", "{tmp}/none"], "none"),
        (["--seeds", "-1"], "seeds (-1,)"),
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


def test_the_defaults_train_as_everywhere(data, tmp_path, monkeypatch):
    seen = {}
    monkeypatch.setattr(
        non_flat_errors, "train_predictor", lambda batch, config, out, **_: seen.update(config=config) or out
    )
    non_flat_errors.train(data, tmp_path, "height", "random", 3, TrainConfig())
    usual = TrainConfig()
    assert seen["config"].seed == 3
    assert (seen["config"].epochs, seen["config"].learning_rate) == (usual.epochs, usual.learning_rate)
