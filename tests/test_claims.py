from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from foretrace.evaluation.claims import MIN_SEEDS, Cell, Check, by_cell, cell_table, holds_in_words, tally
from foretrace.evaluation.storage import read_rows
from foretrace.experiments.paper import Paper
from foretrace.experiments.paper_claims import CLAIMS, PAIRS
from result_tables import COLUMNS, in_every_seed, paper_like

PAPER = Paper()


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return paper_like()


def changed(table: pd.DataFrame, value: float, **where: str) -> pd.DataFrame:
    """The table with every value at a place multiplied; the place is named by column."""
    chosen = np.logical_and.reduce([table[column] == content for column, content in where.items()])
    assert chosen.any()
    return table.assign(value=table["value"].where(~chosen, table["value"] * value))


def verdicts(table: pd.DataFrame) -> dict[str, bool | str]:
    return {row["name"]: row["holds"] for row in PAPER.judge(table)}


def test_every_claim_holds_on_a_table_like_the_papers(table):
    assert verdicts(table) == {claim.name: True for claim in CLAIMS}


def test_every_claim_is_undecided_without_rows(table):
    empty = table.iloc[:0]
    assert verdicts(empty) == {claim.name: "undecided" for claim in CLAIMS}
    assert {number["result"] for row in PAPER.judge(empty) for number in row["numbers"]} == {"missing"}


def test_two_seeds_decide_nothing(table):
    assert set(verdicts(table[table["seed"] < MIN_SEEDS - 1]).values()) == {"undecided"}


FULL = {"experiment": "features", "setting": "shuffled", "metric": "full"}
SPOILED = {
    "support-points-all": [(0.95, {"experiment": "support-points", "features": "sp-pred", "setting": "100"})],
    "support-points-half": [(0.9, {"experiment": "support-points", "features": "sp-pred", "setting": "50"})],
    "support-points-chance": [(5.0, {"experiment": "support-points", "features": "chance"})],
    "support-points-novel": [(0.9, {"experiment": "support-points-novel", "features": "sp-pred"})],
    "features-help": [(2.0, {**FULL, "features": "sc-800"})],
    "supervised-better": [(2.0, {**FULL, "features": "im-cnn"}), (2.0, {**FULL, "features": "sc-cnn"})],
    "im-cnn-best-generic": [(0.7, {**FULL, "features": "ae-512"})],
    "support-points-best": [(1.5, {**FULL, "features": "sp-pred"})],
    "steps-ahead": [(3.5, {"experiment": "steps-ahead", "features": "im-cnn", "setting": "4"})],
    "errors-fall": [(9.0, {"experiment": "training-size", "features": "sc-200", "setting": "64"})],
    "networks-fall-fastest": [(0.4, {"experiment": "training-size", "features": "ae-256", "setting": "2"})],
    "good-with-little-data": [(9.0, {"experiment": "training-size", "features": "sp-truth", "setting": "2"})],
    "im-cnn-catches-up": [(0.4, {"experiment": "training-size", "features": "im-cnn", "setting": "2"})],
    "graceful": [(3.0, {"experiment": "novel-corners", "features": "ae-256"})],
    "cnn-stable": [(4.0, {"experiment": "novel-corners", "features": "im-cnn", "setting": "9&10"})],
    "poor-on-triangles": [(0.3, {"experiment": "novel-corners", "features": "ae-512", "setting": "3&4"})],
    "sc-800-fails": [(0.5, {"experiment": "novel-corners", "features": "sc-800"})],
    "im-cnn-generalizes-best": [(1.9, {"experiment": "novel-corners", "features": "im-cnn"})],
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_claim_does_not_hold_where_the_numbers_contradict_it(table, name):
    for factor, where in SPOILED[name]:
        table = changed(table, factor, **where)
    row = next(row for row in PAPER.judge(table) if row["name"] == name)
    assert row["holds"] is False
    assert "contradicted" in {number["result"] for number in row["numbers"]}
    assert holds_in_words(row) == "no"


def test_steadier_fails_where_supervised_errors_scatter_more(table):
    chosen = table["features"].isin(["im-cnn", "sc-cnn"]) & table["metric"].eq("full")
    scattered = table["value"] + np.where(chosen & (table["seed"] % 2 == 0), 0.2, 0.0)
    assert verdicts(table.assign(value=scattered))["supervised-steadier"] is False


def test_every_claim_is_shown_to_fail():
    assert {*SPOILED, "supervised-steadier"} == {claim.name for claim in CLAIMS}


def test_an_interval_on_both_sides_leaves_a_claim_undecided(table):
    noisy = table.copy()
    chosen = noisy["features"].eq("ae-512") & noisy["metric"].eq("full") & noisy["setting"].eq("shuffled")
    noisy.loc[chosen, "value"] = 0.25 + np.where(noisy.loc[chosen, "seed"] % 2 == 0, 0.1, -0.1)
    row = next(row for row in PAPER.judge(noisy) if row["name"] == "im-cnn-best-generic")
    assert row["holds"] == "undecided"
    assert tally(row) == "of 6 comparisons 5 supported, 1 open (ae-512 minus im-cnn)"


def test_a_missing_predictor_leaves_a_claim_undecided_and_says_so(table):
    row = next(
        row for row in PAPER.judge(table[table["features"] != "ae-256"]) if row["name"] == "features-help"
    )
    assert row["holds"] == "undecided"
    missing = [number for number in row["numbers"] if number["result"] == "missing"]
    assert [number["comparison"] for number in missing] == ["none minus ae-256"]
    assert missing[0]["mean"] is None


def test_a_check_pairs_the_seeds():
    rows = [("features", name, seed, "shuffled", "full", seed + more)
            for name, more in (("a", 0.1), ("b", 0.0)) for seed in range(6 if name == "a" else 5)]  # fmt: skip
    cells = tuple(Cell("features", name, "shuffled", "full") for name in "ab")
    check = Check("a minus b", cells, lambda values: values[:, 0] - values[:, 1], above=0.0)
    row = check.evaluate(by_cell(pd.DataFrame(rows, columns=COLUMNS)), lambda cell: 0.0)
    assert row["seeds"] == 5
    assert row["low"] == row["mean"] == row["high"] == pytest.approx(0.1)
    assert (row["result"], row["needed"]) == ("supported", "above 0.000 cm")


def test_degradation_is_the_mean_of_the_pairs_over_the_shuffled_error():
    tables = [in_every_seed("features", "shuffled", "full", {"none": 0.5})]
    errors = dict(zip(PAIRS, (0.5, 0.7, 0.9, 0.9), strict=True))
    tables += [
        in_every_seed("novel-corners", pair, "full", {"none": error}) for pair, error in errors.items()
    ]
    rows = {row["name"]: row for row in PAPER.judge(pd.concat(tables))}
    number = rows["graceful"]["numbers"][0]
    assert number["comparison"] == "none, novel / shuffled"
    assert number["mean"] == pytest.approx(1.5)
    stable = {number["comparison"]: number for number in rows["cnn-stable"]["numbers"]}
    assert stable["none, largest / smallest"]["mean"] == pytest.approx(1.8)


def test_report_and_summary_show_claims_and_numbers(table):
    some = table[table["experiment"] != "steps-ahead"]
    claims, summary = PAPER.judge(some), PAPER.summarise(some)
    assert {"name", "section", "claim", "test", "holds", "numbers"} == set(claims[0])
    assert [row["holds"] for row in claims if row["name"] == "steps-ahead"] == ["undecided"]
    text = PAPER.report(summary, some)
    assert text.count("\n| 5.") == len(CLAIMS)
    assert "## features: mean error in cm, 95 % interval (seeds)" in text
    numbers = summary["features"]["none"]["shuffled"]["full"]
    values = table.query("features == 'none' and metric == 'full' and setting == 'shuffled'")["value"]
    assert numbers["mean"] == pytest.approx(values.mean(), rel=1e-5)
    assert numbers["std"] == pytest.approx(values.std(), rel=1e-5)
    assert numbers["low"] < numbers["mean"] < numbers["high"]
    assert numbers["seeds"] == 10


def test_the_committed_results_leave_the_best_generic_features_undecided():
    """Over seeds that share one set of objects, im-cnn and sc-cnn are not told apart."""
    rows = read_rows(Path(__file__).parents[1] / "docs" / "results" / "paper")
    row = next(row for row in PAPER.judge(rows) if row["name"] == "im-cnn-best-generic")
    number = next(each for each in row["numbers"] if each["comparison"] == "sc-cnn minus im-cnn")
    assert (row["holds"], number["result"]) == ("undecided", "open")
    assert (number["low"], number["high"]) == (
        pytest.approx(-0.007, abs=5e-4),
        pytest.approx(0.033, abs=5e-4),
    )


def test_a_single_seed_has_no_interval(table):
    summary = cell_table(table[table["seed"] == 3])
    assert summary["mean"].notna().all()
    assert summary[["std", "low", "high"]].isna().all(axis=None)
