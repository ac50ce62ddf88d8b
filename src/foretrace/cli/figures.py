"""The command that draws the paper's figures from results."""

from pathlib import Path

from tyro.conf import Positional

from foretrace.cli.console import say


def figures(results: Positional[tuple[Path, ...]], out: Path | None = None) -> None:
    """Draw the paper's figures from tables of results, and test the paper's claims on them.

    Nothing is trained. Figures that there are no results for yet are left out.

    Args:
        results: Folder of the results; or several, that are put together.
        out: Folder for figures, claims and summary; by default ``figures`` in the first folder.
    """
    import pandas as pd

    from foretrace.errors import ResultsError
    from foretrace.evaluation.results import read_results
    from foretrace.experiments.claims import judge_claims, write_claims
    from foretrace.experiments.paper_figures import write_figures

    if not results:
        raise ResultsError("no folder of results: give at least one")
    table = pd.concat([read_results(folder) for folder in results], ignore_index=True)
    if (twice := table.duplicated(["experiment", "features", "seed", "setting", "metric"])).any():
        row = table[twice].iloc[0]
        raise ResultsError(
            f"{row.experiment}, {row.features}, seed {row.seed}, setting {row.setting} is in two folders: leave one out"
        )
    out = out or results[0] / "figures"
    paths = write_figures(table, out, report=say) + write_claims(table, out)
    _print_claims(judge_claims(table))
    for path in paths:
        print(path)


def _print_claims(rows: list[dict]) -> None:
    """The paper's claims and whether they hold, as a table."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from foretrace.experiments.claims import holds_in_words, tally

    printed = Table("paper", "claim", "holds here", "result", title="The paper's claims")
    for row in rows:
        printed.add_row(row["section"], escape(row["claim"]), holds_in_words(row), escape(tally(row)))
    Console().print(printed)
