"""Commands that judge predictors: one that was trained, or all of the paper's comparisons."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from foretrace.cli.console import say

if TYPE_CHECKING:
    import pandas as pd


def evaluate_predictor(
    run: Positional[Path],
    data: Path,
    part: Literal["train", "validation", "test", "all"] = "test",
    out: Path | None = None,
) -> None:
    """Errors of a predictor as the paper defines them: over the full trajectory and at its end, in cm.

    Args:
        run: Folder of the training.
        data: Folder of the data set that it was trained on, or of any other with --part all.
        part: Which part of the training's split to judge by; all: every interaction of the data set, as of one that the
            training never saw, such as imported recordings.
        out: CSV file to write the rows to.
    """
    import pandas as pd

    from foretrace.evaluation import metrics as experiments
    from foretrace.interactions.dataset import Dataset
    from foretrace.predictor import load_predictor, part_of

    dataset = Dataset.open(data)
    batch = dataset.batch() if part == "all" else part_of(run, dataset, part)
    rows = experiments.evaluate_predictor(load_predictor(run), batch)
    print_errors(rows, f"{run}, all of {data}" if part == "all" else f"{run}, {part} part of {data}")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(rows).to_csv(out, index=False, float_format="%.5f")
        print(out)


def evaluate_paper(
    data: Path,
    out: Path,
    experiments: tuple[str, ...] = (),
    features: tuple[str, ...] = (),
    settings: tuple[str, ...] = (),
    seeds: tuple[int, ...] = tuple(range(10)),
    epochs: int | None = None,
    proportional: bool = False,
    workers: int | None = None,
    threads: int = 1,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    dry_run: bool = False,
) -> int:
    """The paper's comparisons of features, training sizes, steps ahead and novel shapes, as one table of results.

    The same command goes on where an interrupted one stopped; with other experiments, features, settings or seeds it
    adds to the table. The exit status is 1 if trainings failed.

    Args:
        data: Folder of the data set.
        out: Folder of the results: results.csv and results.json.
        experiments: Which comparisons, in this order; by default all. An unknown one lists the choices.
        features: Which features; by default all.
        settings: Which settings of the experiments; by default all.
        seeds: Seeds of splits and trainings.
        epochs: Passes over the training part, as in `foretrace train`.
        proportional: Split in the paper's proportions instead of its 1400, 100 and 300 interactions.
        workers: Processes; by default one for each core, and a single one with a CUDA device.
        threads: Threads of each of them.
        device: Where to compute.
        dry_run: Say how many trainings are missing, and do nothing.
    """
    from dataclasses import replace

    from foretrace.evaluation.results import read_results
    from foretrace.experiments import paper_protocol as protocol
    from foretrace.experiments.paper_trials import plan

    trials = plan(experiments or None, features or None, settings or None, seeds)
    recipe = protocol.Recipe(proportional=proportional)
    if epochs is not None:
        training, one_shot = (replace(config, epochs=epochs) for config in (recipe.training, recipe.one_shot))
        recipe = replace(recipe, training=training, one_shot=one_shot)
    if dry_run:
        for name, count in protocol.count_missing(data, out, trials, recipe).items():
            print(f"{name:20s} {count:5d} trainings missing")
        return 0
    try:
        failures = protocol.run_protocol(
            data, out, trials, recipe, workers=workers, threads=threads, device=device
        )
    except KeyboardInterrupt:
        say(f"interrupted; finished trainings stay in {out}, the same command goes on from there")
        raise
    table = read_results(out)
    for name in dict.fromkeys(trial.experiment for trial in trials):
        print_summary(table, name)
    for trial, message in failures:
        say(f"failed: {trial}: {' '.join(message.split())}")
    print(f"results: {out}")
    return 1 if failures else 0


def print_errors(rows: list[dict[str, Any]], title: str) -> None:
    """A table of the errors that start from the observed first sample, with the overall ones also from the view."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"Errors in cm: {title}", title_justify="left")
    table.add_column("interactions", no_wrap=True)
    table.add_column("number", justify="right")
    for metric in ("full", "final"):
        for figure in ("mean", "median", "95 %"):
            table.add_column(f"{metric}\n{figure}", justify="right")
    for start, group, value in dict.fromkeys((row["start"], row["group"], row["value"]) for row in rows):
        if start == "estimated" and group != "all":
            continue
        chosen = [row for row in rows if (row["start"], row["group"], row["value"]) == (start, group, value)]
        name = {"all": "all", "outcome": value, "corners": f"{value} corners"}[group]
        name += ", start from view" if start == "estimated" else ""
        figures = [f"{row[f'{figure}_cm']:.2f}" for row in chosen for figure in ("mean", "median", "p95")]
        table.add_row(name, str(chosen[0]["count"]), *figures)
    Console().print(table)


def print_summary(table: "pd.DataFrame", experiment: str) -> None:
    """One experiment's accuracy or error: mean and 95 % interval over the seeds, features by settings."""
    from rich.console import Console
    from rich.table import Table

    from foretrace.evaluation.statistics import mean_interval

    rows = table.loc[(table["experiment"] == experiment) & table["metric"].isin(["full", "accuracy"])]
    if rows.empty:
        return
    unit = "share with both support points right" if "accuracy" in set(rows["metric"]) else "mean error in cm"
    settings = sorted(set(rows["setting"]), key=lambda setting: (len(setting), setting))
    shown = Table("features")
    for setting in settings:
        shown.add_column(setting, justify="right")
    for label in dict.fromkeys(rows["features"]):
        cells = []
        for setting in settings:
            values = rows.loc[(rows["features"] == label) & (rows["setting"] == setting), "value"].tolist()
            mean, low, high = mean_interval(values)
            interval = f"\n{low:.3f} to {high:.3f}" if len(values) > 1 else ""
            cells.append(f"{mean:.3f} ({len(values)}){interval}" if values else "")
        shown.add_row(label, *cells)
    print(f"{experiment}: {unit}, 95 % interval (seeds)")
    Console().print(shown)
