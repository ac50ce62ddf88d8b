"""The command that compares predictions with recorded lever-ups, or with a stand-in for the real robot."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from foretrace.experiments.transfer import Transfer
    from foretrace.predictor.base import EffectPredictor


def evaluate_transfer(
    run: Positional[Path | None] = None,
    *,
    out: Path,
    recorded: Path | None = None,
    repeats: int = 10,
    seed: int = 0,
    workers: int = 1,
    silhouettes: Path | None = None,
    size: float = 0.18,
    scale: float | None = None,
    prisms: Path | None = None,
    height: float = 0.02,
) -> None:
    """Compare predictions with reality, or with a stand-in for it: the paper's tables 1 and 2, and figure 15.

    Reality is what `foretrace import` recorded. Without it the stand-in is the other physics engine, Bullet, with other
    friction, density and thickness, errors of contact, direction, camera and marker, and another sampling rate, all
    drawn anew every time.

    Args:
        run: Folder of the training; by default the predictor that comes with foretrace.
        out: Folder to write to: transfer.csv, transfer.md, summary.json, figure-14.png; without --recorded also
            figure-15.png.
        recorded: Folder of a recorded data set, which takes the place of the stand-in: all options that follow are
            about that one.
        repeats: Lever-ups by the stand-in at every contact.
        seed: Seed of all that is drawn.
        workers: Processes that simulate.
        silhouettes: Folder of pictures of more objects, one silhouette each, white on black.
        size: Longer side of each silhouette [m].
        scale: Metres per pixel of all silhouettes, instead of --size.
        prisms: JSON file of more objects: by name, corners_m and, if they are known, mass_kg and height_m.
        height: Thickness of silhouettes, and of prisms that do not tell it [m].
    """
    from foretrace.errors import ResultsError, ShapeError
    from foretrace.experiments import transfer, transfer_objects, transfer_report
    from foretrace.predictor import load_predictor
    from foretrace.simulation.stand_in import StandIn

    if out.exists() and not out.is_dir():
        raise ResultsError(f"{out} is a file: give a folder to write to")
    predictor = load_predictor(run)
    if recorded is not None:
        of_stand_in = {"repeats": repeats != 10, "seed": seed != 0, "workers": workers != 1}
        of_stand_in |= {"silhouettes": silhouettes, "size": size != 0.18, "scale": scale}
        of_stand_in |= {"prisms": prisms, "height": height != 0.02}
        if idle := [f"--{name}" for name, value in of_stand_in.items() if value]:
            raise ResultsError(f"{', '.join(idle)} is about the stand-in: leave it out with --recorded")
        _evaluate_recorded(predictor, recorded, out, _settings(run, predictor, "mujoco"))
        return
    for name, value in (("size", size), ("scale", scale), ("height", height)):
        if value is not None and not 0 < value < float("inf"):
            raise ShapeError(f"--{name} is {value}: give a positive length in metres")
    stand_in = StandIn()
    subjects = transfer_objects.printed_shapes() + transfer_objects.everyday_objects()
    if silhouettes is not None:
        subjects += transfer_objects.read_silhouettes(silhouettes, size, scale, height)
    if prisms is not None:
        subjects += transfer_objects.read_prisms(prisms, height)
    found = transfer.evaluate_transfer(
        predictor, subjects, stand_in, repeats=repeats, seed=seed, workers=workers
    )
    summary = transfer_report.summarise(found.rows)
    played = {"repeats": repeats, "seed": seed, "stand_in": asdict(stand_in)}
    note = {"note": transfer_report.NOTE, **_settings(run, predictor, "mujoco", "pybullet")}
    tables = transfer_report.markdown(summary, repeats)
    _write(out, found, {**note, **played, **summary}, tables, _stand_in_figures(found))


def _evaluate_recorded(
    predictor: "EffectPredictor", recorded: Path, out: Path, settings: dict[str, Any]
) -> None:
    """Tables and picture of a recorded data set."""
    from foretrace.experiments import transfer_report
    from foretrace.experiments.transfer_figures import paths_figure
    from foretrace.experiments.transfer_recorded import evaluate_recorded
    from foretrace.interactions.dataset import Dataset

    found = evaluate_recorded(predictor, Dataset.open(recorded))
    summary = transfer_report.summarise(found.rows)
    note = {"note": transfer_report.RECORDED_NOTE, **settings, "recorded": str(recorded)}
    tables = transfer_report.recorded_markdown(summary, found.rows)
    figure = paths_figure(found.examples, "recorded", "The first recording at each edge; the table is grey")
    _write(out, found, {**note, **summary}, tables, {"figure-14.png": figure})


def _settings(run: Path | None, predictor: "EffectPredictor", *engines: str) -> dict[str, Any]:
    """What decides the numbers."""
    from importlib.metadata import version

    import foretrace

    versions = {name: version(name) for name in (*engines, "torch", "numpy")}
    return {
        "predictor": "default" if run is None else str(run),
        "features": predictor.features.label,
        "versions": {"foretrace": foretrace.__version__, **versions},
    }


def _stand_in_figures(found: "Transfer") -> dict[str, "Figure"]:
    """Paths at some printed edges, and masks and errors of each group of other objects, by file name."""
    from foretrace.experiments.transfer_figures import objects_figure, paths_figure
    from foretrace.experiments.transfer_report import PAPER_OBJECTS

    shown = {("pentagon", 1), ("pentagon", 3), ("heptagon", 2), ("heptagon", 6)}
    printed = [
        each for each in found.examples if each.group == "printed" and (each.name, each.contact) in shown
    ]
    figures = {"figure-14.png": paths_figure(printed)}
    groups = {"everyday": "figure-15.png", "silhouettes": "silhouettes.png", "prisms": "prisms.png"}
    for group, name in groups.items():
        examples = [each for each in found.examples if each.group == group]
        if examples:
            paper = PAPER_OBJECTS if group == "everyday" else None
            figures[name] = objects_figure(examples, found.rows.loc[found.rows["group"].eq(group)], paper)
    return figures


def _write(
    out: Path, found: "Transfer", summary: dict[str, Any], tables: str, figures: dict[str, "Figure"]
) -> None:
    """Table, summary and pictures; the tables are printed, too."""
    import json

    out.mkdir(parents=True, exist_ok=True)
    files = [out / name for name in ("transfer.csv", "transfer.md", "summary.json")]
    found.rows.to_csv(files[0], index=False, float_format="%.6g")
    files[1].write_text(tables, encoding="utf-8")
    files[2].write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    print(tables)
    for name, figure in figures.items():
        figure.savefig(out / name)
    for file in [*files, *(out / name for name in figures)]:
        print(file)
