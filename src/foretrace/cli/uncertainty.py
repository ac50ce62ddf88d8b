"""The command that judges futures, their probabilities and their regions."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import pandas as pd

KEPT = "trainings"
"""Folder of the trainings within the results."""


def evaluate_uncertainty(
    data: Path,
    out: Path,
    seeds: tuple[int, ...] = (0, 1, 2),
    splits: tuple[Literal["shuffled", "novel-shapes"], ...] = ("shuffled", "novel-shapes"),
    held_out: tuple[int, ...] = (5, 6),
    epochs: int | None = None,
    samples: int = 100,
    unlike: Path | None = None,
    threads: int = 1,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> None:
    """Judge what the one-shot predictor says may happen: probabilities, regions, samples, and observed beginnings.

    The same command goes on where an interrupted one stopped; with more seeds or splits it adds to what is there.

    Args:
        data: Folder of the data set; all outcomes in it are learned and judged.
        out: Folder to write to: rows.csv, summary.json, uncertainty.md, and as PNG and SVG reliability, observed and
            confusion; and the trainings.
        seeds: Seeds of splits, trainings and samples.
        splits: shuffled: the paper's sizes, any interaction in any part. novel-shapes: tested on corner counts that
            were not learned from.
        held_out: Corner counts of the novel shapes.
        epochs: Passes over the training part, as in `foretrace train`.
        samples: Motions drawn at random for each interaction.
        unlike: Folder of a data set with other physics, sampled at the same times, for instance simulated with
            `--randomise`. What observed beginnings are worth is judged on it, too, for shuffled splits.
        threads: Threads of PyTorch.
        device: Where to train.
    """
    from dataclasses import replace

    import pandas as pd

    from foretrace.cli.console import say
    from foretrace.errors import ResultsError
    from foretrace.experiments import uncertainty as experiment
    from foretrace.predictor import OneShotPredictor, load_predictor
    from foretrace.predictor.runtime import thread_count

    if out.exists() and not out.is_dir():
        raise ResultsError(f"{out} is a file: give a folder to write to")
    if not seeds or not splits or min(seeds) < 0:
        raise ResultsError(f"seeds {seeds}, splits {splits}: give at least one of each, seeds from 0")
    if samples < 2:
        raise ResultsError(f"--samples is {samples}: give a number from 2")
    config = replace(experiment.RECIPE, threads=threads, device=device)
    config = config if epochs is None else replace(config, epochs=epochs)
    batch = experiment.load(data)
    other = None if unlike is None else experiment.load(unlike, like=batch)
    parts = {
        (setting, seed): experiment.split_of(batch, setting, seed, held_out)
        for setting in dict.fromkeys(splits)
        for seed in dict.fromkeys(seeds)
    }
    (out / KEPT).mkdir(parents=True, exist_ok=True)
    (out / KEPT / ".gitignore").write_text("*\n", encoding="utf-8")
    tables = []
    for (setting, seed), split in parts.items():
        say(f"split {setting}, seed {seed}")
        predictor = load_predictor(
            experiment.train(batch, out / KEPT / f"{setting}-{seed}", seed, split, config)
        )
        assert isinstance(predictor, OneShotPredictor)
        with thread_count(threads):
            rows = experiment.measure(
                predictor, batch, split, seed, samples, other if setting == "shuffled" else None
            )
        rows.insert(0, "split", setting)
        rows.insert(0, "seed", seed)
        tables.append(rows)
    _write(out, pd.concat(tables, ignore_index=True))


def _write(out: Path, rows: "pd.DataFrame") -> None:
    """Table, summary and pictures; the tables are printed, too."""
    import json

    import matplotlib as mpl

    from foretrace.experiments import uncertainty_figures as figures
    from foretrace.experiments import uncertainty_report as report

    summary = report.summarise(rows)
    text = report.markdown(summary)
    rows.to_csv(out / "rows.csv", index=False, float_format="%.6g")
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    (out / "uncertainty.md").write_text(text, encoding="utf-8")
    names = ["rows.csv", "summary.json", "uncertainty.md"]
    drawn = {
        "reliability": figures.reliability_figure(rows),
        "observed": figures.observed_figure(rows),
        "confusion": figures.confusion_figure(rows),
    }
    for name, figure in drawn.items():
        figure.savefig(out / f"{name}.png")
        # The same picture is the same file: neither a date nor random names.
        with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
            figure.savefig(out / f"{name}.svg", metadata={"Date": None})
        names += [f"{name}.png", f"{name}.svg"]
    print(text)
    for name in names:
        print(out / name)
