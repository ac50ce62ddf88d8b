"""Draws docs/images/data-curve.png: the error of the direct predictor against the number of training interactions."""

from pathlib import Path

import matplotlib as mpl
import pandas as pd
from matplotlib.figure import Figure

from foretrace.evaluation.storage import read_rows
from foretrace.pictures.style import INK, STYLE

RESULTS = Path(__file__).parents[1] / "results"
LEVERED = 1814
"""Levered interactions of the paper's recipe, of which figure 11 takes percentages."""
GOAL = 0.05
"""Of the error without features."""


def rows() -> pd.DataFrame:
    """Rows of one-shot, and of no feature, with the number of interactions learned from."""
    folders = ("paper", "more-data")
    table = pd.concat([read_rows(RESULTS / folder) for folder in folders], ignore_index=True)
    kept = table["experiment"].isin(["training-size", "more-data"])
    kept |= table["experiment"].eq("features") & table["setting"].eq("shuffled")
    table = table[kept & table["features"].isin(["one-shot", "none"])].copy()
    percent = table["experiment"].eq("training-size")
    table.loc[table["setting"].eq("shuffled"), "setting"] = "1400"
    table["size"] = table["setting"].astype(int)
    table.loc[percent, "size"] = (table.loc[percent, "size"] / 100 * LEVERED).round().astype(int)
    return table


def main() -> None:
    """Draw it."""
    table = rows()
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(7.2, 4.4), layout="constrained")
        ax = fig.subplots()
        lines = (("one-shot", "full", "#0072b2", "o-", "one-shot, mean"),
                 ("one-shot", "full_median", "#56b4e9", "s--", "one-shot, median over lever-ups"),
                 ("none", "full", INK, "x-", "no feature, mean"))  # fmt: skip
        for features, metric, color, style, label in lines:
            mine = table[table["features"].eq(features) & table["metric"].eq(metric)]
            found = mine.groupby("size")["value"].mean()
            ax.plot(found.index, found.to_numpy(), style, color=color, label=label)
            if metric == "full":
                for size, value in found.drop(1161).items():  # beside 1400
                    ax.annotate(
                        f"{value:.3f}",
                        (size, value),
                        (0, 6),
                        textcoords="offset points",
                        ha="center",
                        fontsize=8,
                    )
        none = table[table["features"].eq("none") & table["metric"].eq("full") & table["size"].eq(1400)][
            "value"
        ]
        ax.axhline(GOAL * none.mean(), color=INK, lw=0.9, ls=(0, (2, 2)))
        ax.annotate(
            "0.05 of no feature with 1400",
            (40, GOAL * none.mean()),
            (0, 4),
            textcoords="offset points",
            fontsize=8,
        )
        ax.set(xscale="log", yscale="log", xlabel="levered interactions learned from",
               ylabel="error, full trajectory [cm]")  # fmt: skip
        ax.set_yticks([0.02, 0.05, 0.1, 0.2, 0.5], ["0.02", "0.05", "0.1", "0.2", "0.5"])
        ax.set_yticks([], minor=True)
        ax.legend(loc="upper right", bbox_to_anchor=(1.0, 0.86))
        fig.savefig(Path(__file__).with_name("data-curve.png"), dpi=120)


if __name__ == "__main__":
    main()
