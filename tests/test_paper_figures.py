import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from PIL import Image

from foretrace import cli
from foretrace.errors import ResultsError
from foretrace.evaluation.charts import STYLES, columns_of, family_of, present, seeds_in_words, style_of
from foretrace.evaluation.run import run_experiment, write_figures
from foretrace.evaluation.storage import REPORT, ROWS, SUMMARY, summary_content
from foretrace.experiments.paper import Paper
from foretrace.experiments.paper_claims import CLAIMS
from foretrace.experiments.paper_figures import FIGURES
from foretrace.files import write_json
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


def test_a_predictor_of_another_family_has_a_panel_of_its_own(table):
    rows = table[table["experiment"].eq("training-size")]
    fig = FIGURES["figure-11"](
        pd.concat([rows, rows[rows["features"].eq("sp-pred")].assign(features="one-shot")])
    )
    assert fig is not None
    panels = {ax.get_title(loc="left"): [text.get_text() for text in ax.texts] for ax in fig.axes}
    assert [name for name, shown in panels.items() if "one-shot" in shown] == ["Direct"]


@pytest.mark.parametrize("name", ["figure-10-by-object", "figure-11", "figure-12"])
def test_panels_of_a_figure_have_the_same_ticks_and_show_all(table, name):
    fig = FIGURES[name](table)
    assert fig is not None
    assert len({tuple(ax.get_yticks()) for ax in fig.axes}) == 1
    for ax in fig.axes:
        drawn = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in ax.lines])
        assert np.nanmax(drawn) <= ax.get_ylim()[1]


def test_no_entry_of_a_legend_stands_alone():
    assert columns_of(12) == 12
    for count in range(2, 60):
        columns = columns_of(count)
        assert columns <= 12
        assert (count - 1) % columns > 0


def test_seeds_are_counted():
    rows = pd.DataFrame(
        [("none", "2", 0), ("none", "2", 1), ("none", "4", 0)], columns=["features", "setting", "seed"]
    )
    assert seeds_in_words(rows) == "1 to 2 seeds"
    assert seeds_in_words(rows[:2]) == "2 seeds"
    assert seeds_in_words(rows[2:]) == "1 seed"


@pytest.mark.parametrize("name", ["figure-10a", "figure-11", "figure-13"])
def test_what_has_no_style_of_its_own_is_drawn_with_its_label(name, table):
    own = table[table["features"].eq("sc-800")].assign(features="my-features")
    fig = FIGURES[name](pd.concat([table, own]))
    assert fig is not None
    assert "my-features" in words(fig).split("\n")
    assert style_of("my-features") == style_of("my-features") not in STYLES.values()
    assert family_of("my-features") == "others"
    assert present(pd.concat([own, table]))[-1] == "my-features"


def test_the_same_table_gives_the_same_bytes(table, tmp_path):
    some = table[table["experiment"].isin(["support-points", "features"])]
    files = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        files.append(write_figures(Paper().figures(some), folder, Paper.formats))
    assert [path.name for path in files[0]] == [
        f"{name}.{suffix}"
        for name in ("figure-9a", "figure-10a", "figure-10b", "figure-10-by-object")
        for suffix in ("png", "svg")
    ]
    for one, other in zip(*files, strict=True):
        assert one.read_bytes() == other.read_bytes()
    with Image.open(files[0][0]) as picture:
        assert picture.size == (1080, 660)  # 150 dpi


def results_folder(folder: Path, table: pd.DataFrame) -> Path:
    folder.mkdir()
    table.to_csv(folder / ROWS, index=False)
    write_json(folder / SUMMARY, summary_content({"experiment": "paper", "recipe": "made up"}, {}))
    return folder


def test_results_are_judged_and_drawn_without_data(tmp_path, capsys):
    table = paper_like(num_seeds=3)
    folder = results_folder(tmp_path / "results", table[table["experiment"] == "support-points"])
    assert cli.main(["evaluate", "paper", "--out", str(folder)]) == 0
    printed = capsys.readouterr()
    names = [ROWS, SUMMARY, REPORT, "figure-9a.png", "figure-9a.svg"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    assert printed.out.splitlines()[-5:] == [str(folder / name) for name in names]
    assert "| undecided |" in printed.out
    assert "| yes |" in printed.out
    summary = json.loads((folder / SUMMARY).read_text())
    assert len(summary["claims"]) == len(CLAIMS)
    assert summary["identity"] == {"experiment": "paper", "recipe": "made up"}


def test_further_folders_of_results_are_taken_in(tmp_path):
    table = paper_like(num_seeds=1)
    first, second = (
        results_folder(tmp_path / name, table[table["experiment"] == name])
        for name in ("support-points", "features")
    )
    found = run_experiment(Paper(results=(second,)), first)
    assert {"figure-9a.png", "figure-10a.png"} <= {file.name for file in found.files}
    assert set(found.rows["experiment"]) == {"support-points"}
    with pytest.raises(ResultsError, match=r"support-points, .* is in two folders: leave one out"):
        run_experiment(Paper(results=(second, first)), first)


def twin_results(folder: Path) -> Path:
    """Results of twins, as `foretrace evaluate twin` leaves them."""
    rows = [
        (part, imaginer, seed, metric, value + 0.001 * seed)
        for part in ("shuffled", "3&4", "silhouettes")
        for imaginer, value in (("twin", 0.06), ("residual", 0.04), ("one-shot", 0.05))
        for seed in range(2)
        for metric in ("full_mean", "final_mean", "full_median")
    ]
    folder.mkdir()
    pd.DataFrame(rows, columns=["part", "imaginer", "seed", "metric", "value"]).to_csv(
        folder / ROWS, index=False
    )
    write_json(folder / SUMMARY, summary_content({"experiment": "twin"}, {}))
    return folder


def test_twins_stand_beside_the_predictors_in_figures_and_change_no_claim(table, tmp_path):
    folder = twin_results(tmp_path / "twin")
    with_twins, without = Paper(twins=(folder, folder)), Paper()
    shown = {name: words(figure).split("\n") for name, figure in with_twins.figures(table).items()}
    for name in ("figure-10a", "figure-10b", "figure-11", "figure-13"):
        assert "twin" in shown[name]
        assert ("residual" in shown[name]) == (name != "figure-11")
    assert not any("twin" in shown[name] for name in ("figure-9a", "figure-12"))
    assert with_twins.judge(table) == without.judge(table)
    drawn = with_twins.figures(table)["figure-13"].axes[0]
    ends = {round(float(np.asarray(line.get_ydata())[0]), 4) for line in drawn.lines if len(line.get_ydata())}
    assert {0.0605, 0.0405} <= ends  # the mean over both seeds, once


def test_results_of_another_experiment_are_no_twins(table, tmp_path):
    folder = twin_results(tmp_path / "twin")
    table.to_csv(folder / ROWS, index=False)
    with pytest.raises(ResultsError):
        Paper(twins=(folder,)).figures(table)
