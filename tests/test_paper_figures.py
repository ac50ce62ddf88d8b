import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from foretrace.evaluation.results import ResultsTable, Trial
from foretrace.experiments.charts import seeds_in_words
from foretrace.experiments.claims import CLAIMS
from matplotlib.figure import Figure
from PIL import Image

from foretrace import cli
from foretrace.experiments.paper_figures import FIGURES, write_figures
from result_tables import ERRORS, paper_like


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return paper_like(num_seeds=5)


def words(fig: Figure) -> str:
    """All that is written in a picture."""
    fig.canvas.draw()
    parts = [fig.get_suptitle(), *(text.get_text() for text in fig.texts)]
    for ax in fig.axes:
        parts += [
            ax.get_title(loc="left"),
            ax.get_xlabel(),
            ax.get_ylabel(),
            *(t.get_text() for t in ax.texts),
        ]
        parts += [t.get_text() for t in ax.get_xticklabels()]
    parts += [text.get_text() for legend in fig.legends for text in legend.get_texts()]
    return "\n".join(parts)


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_tells_units_seeds_and_every_predictor(table, name):
    fig = FIGURES[name](table)
    assert fig is not None
    written = words(fig)
    assert "5 seeds" in written
    assert ("[%]" if name.startswith("figure-9") else "[cm]") in written
    expected = {"sp-pred", "sp-rule", "chance"} if name.startswith("figure-9") else set(ERRORS)
    if name == "figure-11":
        expected = expected - {"sp-rule"}
    assert expected <= set(written.split("\n"))


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_draws_what_there_is(table, name):
    """One or two seeds, of two predictors, and not every setting."""
    few = table[table["features"].isin(["im-cnn", "sp-pred", "chance"]) & (table["seed"] < 2)]
    few = few[~few["setting"].isin(["2", "5&6", "100", "5"])]
    few = few[(few["seed"] == 0) | (few["features"] != "sp-pred")]
    few = pd.concat([few, few.tail(1).assign(value=np.nan, seed=7)])
    fig = FIGURES[name](few)
    assert fig is not None
    assert "seed" in words(fig)


@pytest.mark.parametrize("name", FIGURES)
def test_without_rows_there_is_no_figure(table, name):
    assert FIGURES[name](table.iloc[:0]) is None


def test_accuracy_is_drawn_in_per_cent_of_every_training_size(table):
    fig = FIGURES["figure-9a"](table)
    assert fig is not None
    line = next(line for line in fig.axes[0].lines if len(line.get_xdata()) == 6)
    assert list(line.get_xdata()) == [5, 10, 25, 50, 75, 100]
    rows = table.query("experiment == 'support-points' and features == 'sp-pred' and metric == 'accuracy'")
    assert line.get_ydata()[-1] == pytest.approx(100 * rows.query("setting == '100'")["value"].mean())


def test_one_state_at_once_comes_from_the_same_seeds(table):
    """Seeds that were not trained with several states must not shift the first point."""
    shifted = table.assign(value=table["value"].where(table["seed"] < 3, table["value"] + 1))
    several = shifted[(shifted["experiment"] != "steps-ahead") | (shifted["seed"] < 3)]
    fig = FIGURES["figure-12"](several)
    assert fig is not None
    assert "over 3 seeds" in words(fig)
    assert fig.axes[0].get_ylim()[1] < 1


def test_seeds_are_counted():
    rows = pd.DataFrame(
        [("none", "2", 0), ("none", "2", 1), ("none", "4", 0)], columns=["features", "setting", "seed"]
    )
    assert seeds_in_words(rows) == "1 to 2 seeds"
    assert seeds_in_words(rows[:2]) == "2 seeds"
    assert seeds_in_words(rows[2:]) == "1 seed"


def test_the_same_table_gives_the_same_bytes(table, tmp_path):
    some = table[table["experiment"].isin(["support-points", "features"])]
    told: list[str] = []
    first = write_figures(some, tmp_path / "a", report=told.append)
    second = write_figures(some, tmp_path / "b", report=told.append)
    assert [path.name for path in first] == [
        f"{name}.{suffix}"
        for name in ("figure-9a", "figure-10a", "figure-10b", "figure-10-by-object")
        for suffix in ("png", "svg")
    ]
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert told[: len(told) // 2] == [
        f"{name} is left out: no rows for it" for name in ("figure-9b", "figure-11", "figure-12", "figure-13")
    ]
    with Image.open(first[0]) as picture:
        assert picture.size == (1080, 660)  # 150 dpi


def results_folder(folder: Path, table: pd.DataFrame) -> Path:
    with ResultsTable(folder, {"recipe": "made up"}) as results:
        for (experiment, features, seed, setting), rows in table.groupby(
            ["experiment", "features", "seed", "setting"]
        ):
            metrics = dict(zip(rows["metric"], rows["value"], strict=True))
            results.append(Trial(experiment, features, int(seed), setting), {**metrics, "seconds": 1.0})
    return folder


def test_figures_command(tmp_path, capsys):
    table = paper_like(num_seeds=3)
    folder = results_folder(tmp_path / "results", table[table["experiment"] == "support-points"])
    assert cli.main(["figures", str(folder)]) == 0
    printed = capsys.readouterr()
    out = folder / "figures"
    written = ["figure-9a.png", "figure-9a.svg", "claims.json", "claims.md", "summary.csv"]
    assert sorted(path.name for path in out.iterdir()) == sorted(written)
    assert printed.out.splitlines()[-5:] == [str(out / name) for name in written]
    assert "undecided" in printed.out
    assert "yes" in printed.out
    assert printed.err.count("is left out: no rows for it") == 7
    assert len(json.loads((out / "claims.json").read_text())) == len(CLAIMS)
    assert cli.main(["figures", str(folder), "--out", str(tmp_path / "elsewhere")]) == 0
    assert (tmp_path / "elsewhere" / "figure-9a.png").is_file()


def test_figures_command_with_several_folders(tmp_path, capsys):
    table = paper_like(num_seeds=1)
    parts = {name: table[table["experiment"] == name] for name in ("support-points", "features")}
    folders = [str(results_folder(tmp_path / name, part)) for name, part in parts.items()]
    assert cli.main(["figures", *folders]) == 0
    drawn = {path.name for path in (tmp_path / "support-points" / "figures").iterdir()}
    assert {"figure-9a.png", "figure-10a.png"} <= drawn
    assert cli.main(["figures", *folders, folders[0]]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("foretrace: error: support-points, ")
    assert error.endswith("is in two folders: leave one out")


def test_figures_command_without_results(tmp_path, capsys):
    assert cli.main(["figures", str(tmp_path / "nowhere")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("foretrace: error: ")
    assert printed.err.count("\n") == 1
    assert not (tmp_path / "nowhere").exists()
    folder = results_folder(tmp_path / "results", paper_like(num_seeds=1).iloc[:1])
    description = json.loads((folder / "results.json").read_text())
    (folder / "results.json").write_text(json.dumps({**description, "version": 99}))
    assert cli.main(["figures", str(folder)]) == 2
    assert "version 99" in capsys.readouterr().err
