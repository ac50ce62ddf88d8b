"""The command that compares plain with randomised training data."""

from pathlib import Path

from foretrace.cli.console import say
from foretrace.errors import TrainingError

FEATURES = {"lstm": ("sp-rule", "sc-800", "im-cnn"), "one-shot": ("outline",)}
"""What a kind of predictor is compared with, unless somebody asks for something else."""


def evaluate_randomisation(
    plain: Path,
    varied: Path,
    out: Path,
    features: tuple[str, ...] | None = None,
    seeds: tuple[int, ...] = (0, 1, 2),
    repeats: int = 3,
    known: tuple[str, ...] = ("friction", "tool_friction", "density"),
    predictor: str = "lstm",
    epochs: int | None = None,
    workers: int = 1,
) -> int:
    """What randomised training data do for transfer, and what it helps to know what was drawn.

    Predictors learn from plain data, from randomised data, and from those knowing friction, tool friction and density,
    or what else varies: the action's parameters. All are judged by plain and randomised interactions with objects that
    none of them has seen, and by the stand-in of `evaluate transfer`. The same command goes on where an interrupted one
    stopped, and with other features or seeds it adds to the results. The exit status is 1 if trainings failed.

    Args:
        plain: Folder of the plain data set.
        varied: Folder of a data set that was simulated with --randomise or --vary-action.
        out: Folder to write to: results.csv, results.json, summary.json, randomisation.md, randomisation.png.
        features: What the predictors know about the object; by default sp-rule, sc-800 and im-cnn for lstm, outline for
            one-shot.
        seeds: Seeds of splits and trainings.
        repeats: Lever-ups by the stand-in at every contact; 0 leaves it out. It levers with the usual action.
        known: What varies, and is known to the predictors that are told: as in `foretrace train`.
        predictor: Kind of predictor: lstm or one-shot.
        epochs: Passes over the training part, as in `foretrace train`.
        workers: Processes.
    """
    import json
    from dataclasses import replace

    from foretrace.evaluation.results import read_results
    from foretrace.experiments import randomisation, randomisation_report
    from foretrace.predictor import RECIPES

    if predictor not in RECIPES:
        raise TrainingError(f"unknown predictor {predictor!r}; available: {', '.join(RECIPES)}")
    features = features or FEATURES[predictor]
    training = replace(RECIPES[predictor], device="cpu", threads=1)
    if epochs is not None:
        training = replace(training, epochs=epochs)
    recipe = randomisation.RandomisationRecipe(training, repeats=repeats, known=known)
    try:
        failures = randomisation.run_randomisation(
            plain, varied, out, features, seeds, recipe, workers=workers
        )
    except KeyboardInterrupt:
        say(f"interrupted; finished trainings stay in {out}, the same command goes on from there")
        raise
    for trial, message in failures:
        say(f"failed: {trial}: {' '.join(message.split())}")
    table = read_results(out)
    if len(table):
        summary = randomisation_report.summarise(table)
        (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
        text = randomisation_report.markdown(summary)
        (out / "randomisation.md").write_text(text, encoding="utf-8")
        randomisation_report.randomisation_figure(table).savefig(out / "randomisation.png")
        print(text)
    print(f"results: {out}")
    return 1 if failures else 0
