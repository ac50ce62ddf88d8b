"""The command that compares predictions with a stand-in for the real robot."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

if TYPE_CHECKING:
    from foretrace.evaluation.transfer import Transfer


def evaluate_transfer(
    run: Positional[Path],
    out: Path,
    repeats: int = 10,
    seed: int = 0,
    workers: int = 1,
    silhouettes: Path | None = None,
    size: float = 0.18,
    scale: float | None = None,
    prisms: Path | None = None,
    height: float = 0.02,
) -> None:
    """Compare predictions with a stand-in for the real robot: the paper's tables 1 and 2, and figure 15.

    There is no robot: the stand-in is the other physics engine, Bullet, with other friction, density and thickness,
    errors of contact, direction, camera and marker, and another sampling rate, all drawn anew every time.

    Args:
        run: Folder of the training.
        out: Folder to write to: transfer.csv, transfer.md, summary.json, figure-14.png, figure-15.png.
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
    from foretrace.evaluation import transfer, transfer_objects, transfer_report
    from foretrace.evaluation.stand_in import StandIn
    from foretrace.predictor import load_predictor

    if out.exists() and not out.is_dir():
        raise ResultsError(f"{out} is a file: give a folder to write to")
    for name, value in (("size", size), ("scale", scale), ("height", height)):
        if value is not None and not value > 0:
            raise ShapeError(f"--{name} is {value}: give a positive length in metres")
    predictor = load_predictor(run)
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
    settings = _settings(run, predictor.features.label, stand_in, repeats, seed)
    for file in _write(out, found, {**settings, **summary}, transfer_report.markdown(summary, repeats)):
        print(file)


def _settings(run: Path, features: str, stand_in: Any, repeats: int, seed: int) -> dict[str, Any]:
    """What decides the numbers."""
    from dataclasses import asdict
    from importlib.metadata import version

    import foretrace
    from foretrace.evaluation.transfer_report import NOTE

    versions = {name: version(name) for name in ("mujoco", "pybullet", "torch", "numpy")}
    return {
        "note": NOTE,
        "predictor": str(run),
        "features": features,
        "repeats": repeats,
        "seed": seed,
        "stand_in": asdict(stand_in),
        "versions": {"foretrace": foretrace.__version__, **versions},
    }


def _write(out: Path, found: "Transfer", summary: dict[str, Any], tables: str) -> list[Path]:
    """Table, summary and pictures; the tables are printed, too."""
    import json

    from foretrace.evaluation.transfer_figures import objects_figure, paths_figure
    from foretrace.evaluation.transfer_report import PAPER_OBJECTS

    out.mkdir(parents=True, exist_ok=True)
    files = [out / name for name in ("transfer.csv", "transfer.md", "summary.json")]
    found.rows.to_csv(files[0], index=False, float_format="%.6g")
    files[1].write_text(tables, encoding="utf-8")
    files[2].write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    print(tables)
    shown = {("pentagon", 0), ("pentagon", 2), ("heptagon", 1), ("heptagon", 5)}
    printed = [
        each
        for each in found.examples
        if each.subject.group == "printed" and (each.subject.name, each.contact) in shown
    ]
    figures = {"figure-14.png": paths_figure(printed)}
    groups = {"everyday": "figure-15.png", "silhouettes": "silhouettes.png", "prisms": "prisms.png"}
    for group, name in groups.items():
        examples = [each for each in found.examples if each.subject.group == group]
        if examples:
            paper = PAPER_OBJECTS if group == "everyday" else None
            figures[name] = objects_figure(examples, found.rows.loc[found.rows["group"].eq(group)], paper)
    for name, figure in figures.items():
        figure.savefig(out / name)
    return [*files, *(out / name for name in figures)]
