"""What every registered experiment has to do, on data that are made in a moment; and the mechanism on toy trials."""

import json
import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from rich.console import Console

import factories
from foretrace import cli
from foretrace.actions import LeverUp
from foretrace.errors import ResultsError, TrainingError
from foretrace.evaluation.experiment import EXPERIMENTS, SUMMARIES, Experiment, Trial
from foretrace.evaluation.run import Results, count_missing, run_experiment
from foretrace.evaluation.storage import (
    INFINITE,
    REPORT,
    ROWS,
    SUMMARY,
    TRIALS,
    Store,
    format_rows,
    parse_rows,
    plain,
    read_rows,
    table_of,
)
from foretrace.experiments.novel_families import family_of
from foretrace.experiments.training import Recipe
from foretrace.experiments.transfer_objects import PENTAGON, Subject
from foretrace.objects import Box, Cylinder, Footed, Prism
from foretrace.predictor import save_checkpoint, train_predictor
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.randomisation import RANDOMISED
from foretrace.simulation.stand_in import StandIn
from foretrace.twin.residual_network import ResidualConfig

QUIET = Console(quiet=True)
RECORDINGS = Path(__file__).parents[1] / "examples" / "replay_recording" / "recordings.json"
QUICK = {
    name: Recipe.of(name).change(hidden=8, epochs=1, min_steps=1, threads=1) for name in ("lstm", "one-shot")
}
STAND_IN = StandIn(engine="mujoco", embodiment="tool", sample_rate=25.0)


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with small data sets and trainings for all experiments."""
    root = tmp_path_factory.mktemp("experiments")
    factories.fake_data_set(root / "plain")
    factories.fake_data_set(root / "varied", RANDOMISED)
    tool = SimulationConfig(embodiment="tool", watch_time=1.5)
    collect(CollectConfig(9, 1, 0, tool, "solids"), root / "solids", 1, console=QUIET)
    blade = SimulationConfig(embodiment="tool")
    collect(CollectConfig(4, 1, 0, blade), root / "blade", 1, console=QUIET)
    from foretrace.interactions.dataset import Dataset

    recipe = QUICK["lstm"].change(
        features="ae-256", feature_options=factories.QUICK_OPTIONS["ae-256"], split=(30, 4, 6)
    )
    train_predictor(
        Dataset.open(root / "plain"), recipe.predictor, root / "run", recipe.training, progress=False
    )
    for name, state in (("untrained", "position"), ("poses", "pose")):
        save_checkpoint(root / name, QUICK["lstm"].change(features="none", state=state).make(60))
    return root


PENTAGON_EDGE = Subject("pentagon", "printed", PENTAGON, (LeverUp.at_edge(PENTAGON, 0),))
CASES: dict[str, Callable[[Path], dict[str, Any]]] = {
    "predictor": lambda root: {"run_folder": root / "run", "data": root / "plain"},
    "paper": lambda root: {"data": root / "plain", "experiments": ("features", "support-points"), "seeds": (0,),
                           "features": ("none", "chance"), "settings": ("shuffled", "100"), "proportional": True,
                           "recipes": QUICK},
    "randomisation": lambda root: {"plain": root / "plain", "varied": root / "varied", "features": ("none",),
                                   "seeds": (0,), "repeats": 0, "recipe": QUICK["lstm"]},
    "reconstruction": lambda root: {"runs": (root / "run",), "data": root / "plain", "columns": 3},
    "replay": lambda root: {"recordings": (RECORDINGS,)},
    "transfer": lambda root: {"predictor": root / "untrained", "repeats": 2, "stand_in": STAND_IN,
                              "subjects": (PENTAGON_EDGE, replace(PENTAGON_EDGE, group="everyday", hull=True))},
    "non-flat": lambda root: {"data": root / "solids", "seeds": (0,), "splits": ("by-outline",), "probes": 1,
                              "recipe": QUICK["lstm"].change(features="im-cnn")},
    "twin": lambda root: {"data": root / "blade", "everyday": root / "solids", "parts": ("shuffled", "not-flat"),
                          "imaginers": ("twin", "residual", "one-shot"), "proportional": True,
                          "recipe": QUICK["one-shot"]},
    "other-world": lambda root: {"data": root / "blade", "lever_ups": (0, 6), "seeds": (0,), "proportional": True,
                                 "recipe": QUICK["one-shot"],
                                 "residual": ResidualConfig(hidden=8, epochs=1, min_steps=2, ensemble=2)},
    "novel-families": lambda root: {"data": root / "plain", "families": ("few corners",),
                                    "recipe": QUICK["one-shot"].change(outcomes=("levered", "slipped"))},
    "active": lambda root: {"data": root / "plain", "counts": (6, 9), "random_counts": (6, 12), "seeds": (0,),
                            "recipe": QUICK["one-shot"].change(outcomes=("levered", "slipped"))},
    "identified-world": lambda root: {"draws": 1, "tests": 2, "lever_ups": (1,), "worlds": ("bullet",),
                                      "residual": ResidualConfig(hidden=8, epochs=1, min_steps=2, ensemble=2)},
    "identification": lambda root: {"objects": 1, "lever_ups": 1},
    "monitoring": lambda root: {"executions": 2, "faults": 1, "successes": 2,
                                "parts": ("calibration", "normal", "round and dented outlines", "slip", "freeze")},
    "shipped": lambda root: {"objects": 2, "twin": True},
    "pushes": lambda root: dict(zip(("pushes", "shapes"), factories.write_push_table(root, 90), strict=True))
                           | {"methods": ("nearest", "simulation", "learned")},
    "sequences": lambda root: {"pushed": 1, "levered": 0, "few": 2},
    "planning": lambda root: {"objects": 1, "families": ("polygon",), "worlds": ("nominal",), "contacts": 16,
                              "baseline": root / "poses"},
    "uncertainty": lambda root: {"data": root / "plain", "seeds": (0,), "splits": ("shuffled",), "samples": 3,
                                 "recipe": QUICK["one-shot"]},
}  # fmt: skip
"""Options of a small run of every experiment."""


@dataclass(frozen=True)
class Case:
    """A small run of an experiment."""

    experiment: Experiment
    out: Path
    results: Results


@pytest.fixture(scope="session", params=list(SUMMARIES))
def case(request: pytest.FixtureRequest, world: Path, tmp_path_factory: pytest.TempPathFactory) -> Case:
    label = request.param
    experiment = EXPERIMENTS[label](**CASES[label](world))
    out = tmp_path_factory.mktemp("results") / label
    return Case(experiment, out, run_experiment(experiment, out, workers=1, console=QUIET))


def never(*_: Any) -> Any:
    raise AssertionError("a finished trial was run again")


def test_every_experiment_has_a_case_and_a_line():
    assert set(CASES) == set(SUMMARIES) == set(EXPERIMENTS)
    for label, summary in SUMMARIES.items():
        assert (EXPERIMENTS[label].label, EXPERIMENTS[label].summary) == (label, summary)


def test_trials_are_unique_stable_and_travel(case: Case):
    trials = list(case.experiment.trials())
    assert len(set(trials)) == len(trials) > 0
    assert len({trial.key for trial in trials}) == len(trials)
    again = pickle.loads(pickle.dumps(case.experiment))
    assert list(again.trials()) == trials
    assert again.identity() == case.experiment.identity()
    json.dumps(again.identity())


def test_every_trial_gives_rows_of_plain_values(case: Case):
    assert case.results.failures == []
    for trial in case.experiment.trials():
        content = json.loads((case.out / TRIALS / f"{trial.key}.json").read_text())
        assert content["trial"] == trial.settings
        assert content["rows"]
        for row in content["rows"]:
            row = {name: float(value) if value in INFINITE else value for name, value in row.items()}
            assert plain(row) == row
            assert not set(row) & set(trial.settings)


def test_everything_is_written(case: Case):
    names = {file.name for file in case.results.files}
    assert {ROWS, SUMMARY, REPORT} < names, "there are figures, too"
    summary = json.loads((case.out / SUMMARY).read_text())
    assert summary["identity"]["experiment"] == case.experiment.label
    assert summary["machines"][0]["hours"] >= 0
    assert (case.out / REPORT).read_text().startswith("# ")
    json.dumps(summary, allow_nan=False)


def test_resuming_runs_nothing_and_gives_the_same_bytes(case: Case, monkeypatch: pytest.MonkeyPatch):
    before = {file: file.read_bytes() for file in case.results.files}
    monkeypatch.setattr(type(case.experiment), "run", never)
    again = run_experiment(case.experiment, case.out, console=QUIET)
    pd.testing.assert_frame_equal(again.rows, case.results.rows)
    assert {file: file.read_bytes() for file in again.files} == before
    assert sum(count_missing(case.experiment, case.out).values()) == 0


def test_the_table_alone_is_enough_to_redraw_and_to_go_on(case: Case, tmp_path: Path, monkeypatch):
    for name in (ROWS, SUMMARY):
        (tmp_path / name).write_bytes((case.out / name).read_bytes())
    pd.testing.assert_frame_equal(read_rows(tmp_path), case.results.rows)
    monkeypatch.setattr(type(case.experiment), "run", never)
    for redraw in (False, True):
        again = run_experiment(case.experiment, tmp_path, console=QUIET, redraw=redraw)
        assert (tmp_path / ROWS).read_bytes() == (case.out / ROWS).read_bytes()
        assert (tmp_path / REPORT).read_bytes() == (case.out / REPORT).read_bytes()
        assert {file.name for file in again.files} == {file.name for file in case.results.files}
    assert not (tmp_path / TRIALS).exists()


def test_summary_report_and_figures_are_functions_of_the_rows(case: Case):
    experiment = pickle.loads(pickle.dumps(case.experiment))  # nothing is left of the run
    rows = read_rows(case.out)
    summary = experiment.summarise(rows)
    assert experiment.report(summary, rows) == case.results.report
    assert experiment.judge(rows) == case.results.claims
    figures = experiment.figures(rows)
    assert figures
    assert all(isinstance(figure, Figure) for figure in figures.values())


def test_another_identity_is_refused_with_the_first_difference(case: Case, monkeypatch: pytest.MonkeyPatch):
    identity = {**(case.experiment.identity() or {}), "another": 7}
    monkeypatch.setattr(type(case.experiment), "identity", lambda self: identity)
    with pytest.raises(ResultsError, match="another = None, asked for is 7: choose another folder") as caught:
        run_experiment(case.experiment, case.out, console=QUIET)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("label", SUMMARIES)
def test_an_unknown_option_or_a_file_in_the_way_is_no_traceback(label: str, tmp_path: Path, capsys):
    assert cli.main(["evaluate", label, "--levitate"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"; `foretrace evaluate {label} --help` lists the options" in told
    # Where options are required, the missing ones come first.
    assert ("Missing" if label in ("predictor", "reconstruction", "pushes") else "--levitate") in told


@pytest.mark.parametrize(
    ("label", "options", "words"),
    [
        ("identified-world", "--seed -1", "seed -1 is negative: choose seeds from 0"),
        ("identification", "--seed -1", "seed -1 is negative: choose seeds from 0"),
        (
            "monitoring",
            "--false-alarms 2",
            "false_alarms is 2.0: give a share of executions from 0.01 to 0.5",
        ),
        (
            "monitoring",
            "--false-alarms nan",
            "false_alarms is nan: give a share of executions from 0.01 to 0.5",
        ),
    ],
)
@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_a_value_out_of_range_is_refused_before_anything_runs(label, options, words, dry, tmp_path, capsys):
    assert cli.main(["evaluate", label, *options.split(), "--out", str(tmp_path / "out"), *dry]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("obj", "family"),
    [
        (Box(0.1, 0.1, 0.02), "solid"),
        (Footed(Prism([(0, 0), (0.1, 0), (0, 0.1)])), "few corners"),
        (Cylinder(0.03, 0.1), "solid"),
    ],
)
def test_objects_of_every_kind_have_a_family(obj, family):
    assert family_of(obj.to_dict()) == family
    assert family_of({"kind": "mesh"}) == ""


# --- the mechanism --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ToyTrial(Trial):
    name: str
    seed: int


@dataclass(frozen=True)
class Toy(Experiment):
    seeds: tuple[int, ...] = (0, 1, 2)
    offset: float = 0.5
    odd_fail: bool = False
    stop_at: int = -1

    trial = ToyTrial

    def trials(self) -> list[ToyTrial]:
        return [ToyTrial("a/b & c", seed) for seed in self.seeds]

    def identity(self) -> dict[str, Any]:
        return {"offset": self.offset, "nested": {"values": (1, 2)}}

    def run(self, trial: ToyTrial, folder: Path) -> list[dict[str, Any]]:
        if trial.seed == self.stop_at:
            raise KeyboardInterrupt
        if self.odd_fail and trial.seed % 2:
            raise TrainingError(f"seed {trial.seed} is odd")
        values = {"value": np.float32(trial.seed + self.offset), "third": 1 / 3, "process": os.getpid()}
        return [{"metric": "error", **values}, {"metric": "other", "value": float("inf"), "third": None}]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        return {"mean": float(rows.loc[rows["metric"].eq("error"), "value"].mean())}

    def report(self, summary: Any, rows: pd.DataFrame) -> str:
        return f"mean {summary['mean']:.2f}\n"


@pytest.mark.parametrize("workers", [1, 2])
def test_failed_trials_are_listed_and_do_not_lose_the_others(workers: int, tmp_path: Path):
    found = run_experiment(Toy(tuple(range(5)), odd_fail=True), tmp_path, workers=workers, console=QUIET)
    assert sorted((failed.seed, message) for failed, message in found.failures) == [
        (1, "seed 1 is odd"),
        (3, "seed 3 is odd"),
    ]
    assert sorted(set(found.rows["seed"])) == [0, 2, 4]
    in_parent = found.rows["process"].dropna().eq(os.getpid())
    assert in_parent.all() if workers == 1 else not in_parent.any()
    assert [each["message"] for each in json.loads((tmp_path / SUMMARY).read_text())["failed"]]


def test_a_row_that_changes_a_field_of_its_trial_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Toy, "run", lambda self, trial, folder: [{"seed": 7, "value": 1.0}])
    found = run_experiment(Toy((0,)), tmp_path, console=QUIET)
    assert [message for _, message in found.failures] == [
        "a row has seed = 7, its trial has 0: call the column otherwise"
    ]


def test_a_crash_between_trials_loses_nothing(tmp_path: Path):
    with pytest.raises(KeyboardInterrupt):
        run_experiment(Toy(stop_at=2), tmp_path, console=QUIET)
    assert count_missing(Toy(), tmp_path) == {"a/b & c": 1}
    (tmp_path / TRIALS / ".half.json.1.partial").write_text("{")  # what a killed process leaves
    rows = run_experiment(Toy(), tmp_path, console=QUIET).rows
    pd.testing.assert_frame_equal(
        rows.drop(columns="process"),
        run_experiment(Toy(), tmp_path / "whole", console=QUIET).rows.drop(columns="process"),
    )


def test_a_committed_table_is_extended(tmp_path: Path):
    first = run_experiment(Toy((0,)), tmp_path, console=QUIET).rows
    (tmp_path / TRIALS).rename(tmp_path / "elsewhere")
    found = run_experiment(Toy((1,)), tmp_path, console=QUIET).rows
    assert found["seed"].tolist() == [1, 1, 0, 0]
    pd.testing.assert_frame_equal(found.iloc[2:].reset_index(drop=True), first)
    assert len(list((tmp_path / TRIALS).glob("*.json"))) == 2
    assert len(json.loads((tmp_path / SUMMARY).read_text())["machines"]) == 2


def test_every_finished_trial_is_a_line_where_there_is_no_terminal(tmp_path: Path, capsys):
    run_experiment(Toy((0,)), tmp_path, console=QUIET)
    run_experiment(Toy((0, 1, 2), odd_fail=True), tmp_path)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "1 of 3 trials are there already"
    assert [line.split("min: ")[-1].split("/s: ")[-1] for line in lines[1:]] == [
        "name a/b & c, seed 1: failed",
        "name a/b & c, seed 2: error 2.500 in 0 s",
    ]


def test_values_come_back_to_the_last_bit(tmp_path: Path):
    done = {
        ToyTrial("x", 0): [plain({"a": 0.1 + 0.2, "b": 7, "c": True, "d": "2 cm, wide", "e": float("inf")})]
    }
    (tmp_path / ROWS).write_text(format_rows(done))
    assert parse_rows(tmp_path / ROWS, ToyTrial) == done
    for wrong in ("3", "1e5", "", "nan", "True"):
        with pytest.raises(TypeError, match="reads like a number"):
            plain({"a": wrong})
    with pytest.raises(TypeError, match="give a text or a number"):
        plain({"a": [1]})
    assert plain({"a": None, "b": np.nan, "c": np.int64(3), "d": np.str_("word")}) == {"c": 3, "d": "word"}


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        (ROWS, "name,value\n", "lacks the columns seed"),
        (ROWS, "name,seed,value\na,zero,1\n", "line 2 is no row of results"),
        (ROWS, "name,seed,value\na,0\n", "line 2 is no row of results"),
        (SUMMARY, "{", "cannot be read as JSON"),
        (SUMMARY, '{"format": "else"}', "does not describe a foretrace-results"),
        (SUMMARY, '{"format": "foretrace-results", "version": 9}', "format version 9"),
    ],
)
def test_damage_is_an_error_of_one_line(file: str, content: str, message: str, tmp_path: Path):
    run_experiment(Toy((0,)), tmp_path, console=QUIET)
    (tmp_path / TRIALS).rename(tmp_path / "elsewhere")
    (tmp_path / file).write_text(content)
    with pytest.raises(ResultsError, match=message) as caught:
        run_experiment(Toy((0,)), tmp_path, console=QUIET)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rows", None),
        ("rows", [3]),
        ("identity", "x"),
        ("trial", []),
        ("trial", {"name": "a"}),
        ("trial", {"seed": "x"}),
    ],
)
def test_a_damaged_trial_is_an_error_of_one_line(name: str, value: Any, tmp_path: Path):
    run_experiment(Toy((0,)), tmp_path, console=QUIET)
    (file,) = (tmp_path / TRIALS).glob("*.json")
    file.write_text(json.dumps(json.loads(file.read_text()) | {name: value}))
    with pytest.raises(ResultsError, match=r"(entry|trial) .*: remove it") as caught:
        run_experiment(Toy((0,)), tmp_path, console=QUIET)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("change", ["lost", "other", "trial", "none"])
def test_a_trial_whose_numbers_are_not_those_that_were_written_is_refused(change: str, tmp_path: Path):
    run_experiment(Toy((0,)), tmp_path, console=QUIET)
    (file, *_) = sorted((tmp_path / TRIALS).glob("*.json"))
    content = json.loads(file.read_text())
    if change == "lost":
        del content["rows"][0]["value"]
    elif change == "other":
        content["rows"][0]["value"] += 1.0
    elif change == "trial":
        content["trial"]["seed"] = 7
    else:  # as files were written before they had a checksum
        del content["checksum"]
    file.write_text(json.dumps(content))
    if change == "none":
        assert not run_experiment(Toy((0,)), tmp_path, console=QUIET).rows["value"].isna().any()
        return
    with pytest.raises(ResultsError, match=r"differ from what was written: remove it"):
        run_experiment(Toy((0,)), tmp_path, console=QUIET)


def test_what_cannot_be_run_is_refused(tmp_path: Path):
    with pytest.raises(ResultsError, match="takes long and has to keep its results"):
        run_experiment(EXPERIMENTS["paper"]())
    with pytest.raises(ResultsError, match="holds no results to draw"):
        run_experiment(EXPERIMENTS["paper"](), tmp_path)
    with pytest.raises(ResultsError, match="is a file: give a folder"):
        run_experiment(Toy(), Path(__file__))
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "manifest.json").write_text("{}")
    with pytest.raises(ResultsError, match="is a data set: give another folder"):
        run_experiment(Toy(), tmp_path / "data")
    with pytest.raises(ResultsError, match="workers is 0"):
        run_experiment(Toy(), tmp_path / "out", workers=0)
    with pytest.raises(ResultsError, match="threads is 0"):
        run_experiment(Toy(), tmp_path / "out", threads=0)
    assert not (tmp_path / "out").exists()
    with pytest.raises(ResultsError, match="unknown experiment 'alchemy'; available: predictor, paper"):
        EXPERIMENTS.find("alchemy")
    with pytest.raises(ResultsError, match=r"rows\.csv is missing"):
        read_rows(tmp_path / "nowhere")


def test_two_processes_may_share_a_folder(tmp_path: Path):
    store = Store(tmp_path, Toy(), {"offset": 0.5})
    store.prepare({})
    for value in (1.0, 2.0):
        store.save(ToyTrial("x", 0), [{"value": value}], 0.0)
    assert table_of(store.done())["value"].tolist() == [2.0]


def test_an_experiment_without_a_summary_is_refused():
    with pytest.raises(TypeError, match="has a label and no summary"):
        type("Half", (Experiment,), {"label": "half"})
