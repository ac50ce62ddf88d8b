"""The command that compares masks with height maps on objects that are not flat."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import pandas as pd

    from foretrace.experiments.non_flat_errors import NonFlatData, Setting
    from foretrace.predictor import EffectPredictor, TrainConfig

KEPT = "trainings"
"""Folder of the trainings within the results."""


def evaluate_non_flat(
    data: Path,
    out: Path,
    seeds: tuple[int, ...] = (0, 1, 2),
    splits: tuple[Literal["by-outline", "random"], ...] = ("by-outline", "random"),
    predictor: Literal["lstm", "one-shot"] = "lstm",
    told_heights: bool = True,
    epochs: int | None = None,
    probes: int = 60,
    threads: int = 1,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> None:
    """Train on masks and on height maps of objects that are not flat, and compare (paper, section 5.5).

    The same command goes on where an interrupted one stopped; with more seeds or splits it adds to what is there.

    Args:
        data: Folder of the data set: that of `foretrace simulate --recipe mixed` or `solids`.
        out: Folder to write to: errors.csv, paths.csv, floors.csv, summary.json, non-flat.md, errors.png, paths.png;
            and the trainings.
        seeds: Seeds of splits and trainings.
        splits: by-outline: objects that look alike are all in one part. random: any interaction in any part.
        predictor: lstm: im-cnn with an LSTM, as in the paper. one-shot: the predictor of whole motions.
        told_heights: Whether predictors are told how high the centre of mass lies at rest. That tells a box from a
            flat prism, which a mask does not.
        epochs: Passes over the training part, as in `foretrace train`.
        probes: Lever-ups that are simulated again, nearly equal, to see how far their fates spread. 0 for none.
        threads: Threads of PyTorch.
        device: Where to compute.
    """
    from dataclasses import replace

    import pandas as pd

    from foretrace.errors import ResultsError
    from foretrace.experiments import non_flat_errors as experiment
    from foretrace.predictor import RECIPES

    if out.exists() and not out.is_dir():
        raise ResultsError(f"{out} is a file: give a folder to write to")
    if not seeds or not splits or min(seeds) < 0:
        raise ResultsError(f"seeds {seeds}, splits {splits}: give at least one of each, seeds from 0")
    if probes < 0:
        raise ResultsError(f"--probes is {probes}: give a number from 0")
    config = replace(RECIPES[predictor], threads=threads, device=device)
    if predictor == "one-shot":
        config = replace(config, **experiment.ONE_SHOT)
    if epochs is not None:
        config = replace(config, epochs=epochs)
    found = experiment.NonFlatData.open(data, told_heights)
    (out / KEPT).mkdir(parents=True, exist_ok=True)
    (out / KEPT / ".gitignore").write_text("*\n", encoding="utf-8")
    tables, paths = [], pd.DataFrame()
    for setting in dict.fromkeys(splits):
        for seed in dict.fromkeys(seeds):
            rows, predictors = _one_split(found, out / KEPT, setting, seed, config)
            tables.append(rows)
            if paths.empty:
                paths = experiment.example_paths(predictors, found, found.split(setting, seed).test)
    _write(out, pd.concat(tables, ignore_index=True), paths, experiment.spread_of_fates(found, probes))


def _one_split(
    data: "NonFlatData", folder: Path, setting: "Setting", seed: int, config: "TrainConfig"
) -> "tuple[pd.DataFrame, dict[Any, EffectPredictor]]":
    """Both channels' errors on the test part of one split, and their predictors."""
    import pandas as pd

    from foretrace.cli.console import say
    from foretrace.experiments import non_flat_errors as experiment
    from foretrace.predictor import load_predictor

    tables, predictors = [], {}
    for channel in experiment.CHANNELS:
        say(f"split {setting}, seed {seed}: {channel}")
        run = experiment.train(data, folder, channel, setting, seed, config)
        predictors[channel] = load_predictor(run)
        rows = experiment.measure(predictors[channel], data, data.split(setting, seed).test)
        rows.insert(0, "channel", channel)
        rows.insert(0, "seed", seed)
        rows.insert(0, "setting", setting)
        tables.append(rows)
    return pd.concat(tables, ignore_index=True), predictors


def _write(out: Path, errors: "pd.DataFrame", paths: "pd.DataFrame", floors: "pd.DataFrame") -> None:
    """Tables, summary and pictures; the table is printed, too."""
    import json

    from foretrace.experiments import non_flat_report as report

    for name, table in (("errors.csv", errors), ("paths.csv", paths), ("floors.csv", floors)):
        if not table.empty:
            table.to_csv(out / name, index=False, float_format="%.4f")
            print(out / name)
    summary = report.summarise(errors, floors)
    text = report.markdown(summary)
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    (out / "non-flat.md").write_text(text, encoding="utf-8")
    figures = {"errors.png": report.errors_figure(summary)}
    if not paths.empty:
        figures["paths.png"] = report.paths_figure(paths)
    for name, figure in figures.items():
        figure.savefig(out / name)
    for name in ("summary.json", "non-flat.md", *figures):
        print(out / name)
    print(text)
