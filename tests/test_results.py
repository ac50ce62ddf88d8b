import json
import multiprocessing
from pathlib import Path

import pytest
from foretrace.evaluation.results import (
    DESCRIPTION,
    TABLE,
    ResultsTable,
    Trial,
    describe_machine,
    finished_trials,
    read_results,
)

from foretrace.errors import ResultsError

IDENTITY = {"data": "abc", "recipe": {"epochs": 3, "options": {}}}
FIRST = Trial("features", "none", 0, "shuffled")
SECOND = Trial("novel-corners", "im-cnn", 3, "3&4")
METRICS = {"full": 0.1 + 0.2, "seconds": 2.5, "final": float("inf")}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A results folder with two trials."""
    with ResultsTable(tmp_path / "results", IDENTITY) as table:
        table.append(FIRST, METRICS)
        table.append(SECOND, {"seconds": 7.0, "full": 1.0})
    return tmp_path / "results"


def hold(folder: Path, identity: dict) -> None:
    ResultsTable(folder, identity)


def test_what_was_written_is_read_to_the_bit(folder):
    rows = read_results(folder)
    assert list(rows.columns) == ["experiment", "features", "seed", "setting", "metric", "value"]
    assert list(rows.itertuples(index=False, name=None)) == [
        (*FIRST, "full", 0.1 + 0.2),
        (*FIRST, "final", float("inf")),
        (*FIRST, "seconds", 2.5),
        (*SECOND, "full", 1.0),
        (*SECOND, "seconds", 7.0),
    ]
    assert finished_trials(folder, IDENTITY) == {FIRST, SECOND}


def test_a_table_can_be_read_while_it_grows(folder):
    with ResultsTable(folder, IDENTITY) as table:
        assert table.done() == {FIRST, SECOND}
        table.append(SECOND._replace(seed=4), {"seconds": 1.0})
        assert len(read_results(folder)) == 6


def test_an_empty_table_is_read(tmp_path):
    ResultsTable(tmp_path, IDENTITY).close()
    assert read_results(tmp_path).empty
    assert finished_trials(tmp_path / "nowhere", IDENTITY) == set()


def test_wherever_a_crash_cuts_the_last_trial_is_dropped_and_can_be_added_again(folder):
    whole = (folder / TABLE).read_bytes()
    begin = whole.index(b"novel-corners")
    for end in range(begin, len(whole)):
        (folder / TABLE).write_bytes(whole[:end])
        assert set(read_results(folder)["experiment"]) == {"features"}, end
    for rest in (whole[begin:-1], whole[begin:-9], b"\0" * 40, b"\0" * 40 + b"\n"):
        (folder / TABLE).write_bytes(whole[:begin] + rest)
        with ResultsTable(folder, IDENTITY) as table:
            assert table.done() == {FIRST}
            table.append(SECOND, {"seconds": 7.0, "full": 1.0})
        assert (folder / TABLE).read_bytes() == whole


def test_a_trial_without_its_last_row_is_never_written(folder):
    before = (folder / TABLE).read_bytes()
    with ResultsTable(folder, IDENTITY) as table, pytest.raises(KeyError, match="seconds"):
        table.append(FIRST._replace(seed=1), {"full": 1.0})
    assert (folder / TABLE).read_bytes() == before


def test_damage_in_the_middle_is_an_error_that_names_the_line(folder):
    file = folder / TABLE
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join([*lines[:2], "features,none,zero\n", *lines[2:]]))
    with pytest.raises(ResultsError, match="line 3 is no row"):
        read_results(folder)
    file.write_text("".join([*lines, lines[1]]))
    with pytest.raises(ResultsError, match="line 7 tells full of features shuffled, none, seed 0 once more"):
        read_results(folder)
    file.write_text("".join(["experiment,features,seed,setting,metric\n", *lines[1:]]))
    with pytest.raises(ResultsError, match="lacks value"):
        read_results(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"data": "xyz"}, "data = 'abc', asked for is 'xyz'"),
        ({"recipe": {"epochs": 4, "options": {}}}, "recipe.epochs = 3, asked for is 4"),
        (
            {"recipe": {"epochs": 3, "options": {"ae-256": {"width": 8}}}},
            "recipe.options.ae-256.width = None",
        ),
        ({"foretrace": "9.9"}, "asked for is '9.9'"),
    ],
)
def test_other_data_recipe_or_version_is_refused_and_leaves_the_folder_as_it_is(folder, change, message):
    before = [(folder / name).read_bytes() for name in (TABLE, DESCRIPTION)]
    with pytest.raises(ResultsError, match=message):
        ResultsTable(folder, {**IDENTITY, **change})
    assert [(folder / name).read_bytes() for name in (TABLE, DESCRIPTION)] == before
    ResultsTable(folder, IDENTITY).close()


def test_another_format_is_refused(folder):
    content = json.loads((folder / DESCRIPTION).read_text())
    (folder / DESCRIPTION).write_text(json.dumps({**content, "version": 2}))
    with pytest.raises(ResultsError, match="format version 2"):
        read_results(folder)
    (folder / DESCRIPTION).write_text(json.dumps({**content, "format": "else"}))
    with pytest.raises(ResultsError, match="does not describe foretrace-results"):
        read_results(folder)
    (folder / DESCRIPTION).write_text("{")
    with pytest.raises(ResultsError, match="is not JSON"):
        read_results(folder)
    (folder / DESCRIPTION).unlink()
    with pytest.raises(ResultsError, match="is missing"):
        read_results(folder)
    with pytest.raises(ResultsError, match=r"no results\.json"):
        ResultsTable(folder, IDENTITY)


def test_only_one_process_writes(folder):
    with ResultsTable(folder, IDENTITY), pytest.raises(ResultsError, match="another foretrace writes to"):
        ResultsTable(folder, IDENTITY)
    # A process that died holding the folder holds it no longer.
    process = multiprocessing.get_context("spawn").Process(target=hold, args=(folder, IDENTITY))
    process.start()
    process.join()
    assert process.exitcode == 0
    ResultsTable(folder, IDENTITY).close()


def test_every_machine_is_noted(folder):
    with ResultsTable(folder, IDENTITY, describe_machine("cpu", workers=2, threads=1)):
        pass
    machines = json.loads((folder / DESCRIPTION).read_text())["machines"]
    assert len(machines) == 2
    assert machines[1]["workers"] == 2
    assert machines[1]["device"] == "cpu"
    assert machines[1]["cpu"]
    assert 0 <= machines[1]["hours"] < 0.1
