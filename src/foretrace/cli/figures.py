"""The command that draws the paper's figures from results."""

from pathlib import Path

from tyro.conf import Positional

from foretrace.cli.console import say


def figures(results: Positional[Path], out: Path | None = None) -> None:
    """Draw the paper's figures from a table of results, and test the paper's claims on it.

    Nothing is trained. Figures that there are no results for yet are left out.

    Args:
        results: Folder of the results.
        out: Folder for figures, claims and summary; by default ``figures`` in the results' folder.
    """
    from foretrace.evaluation.claims import judge_claims, write_claims
    from foretrace.evaluation.paper_figures import write_figures
    from foretrace.evaluation.results import read_results

    table = read_results(results)
    out = out or results / "figures"
    paths = write_figures(table, out, report=say) + write_claims(table, out)
    _print_claims(judge_claims(table))
    for path in paths:
        print(path)


def _print_claims(rows: list[dict]) -> None:
    """The paper's claims and whether they hold, as a table."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from foretrace.evaluation.claims import holds_in_words, tally

    printed = Table("paper", "claim", "holds here", "result", title="The paper's claims")
    for row in rows:
        printed.add_row(row["section"], escape(row["claim"]), holds_in_words(row), escape(tally(row)))
    Console().print(printed)
