"""The command line: ``foretrace simulate | doctor | show | ...``.

A command is a function of plain arguments in `COMMANDS`; tyro makes options from its signature and help from
its docstring. Whatever is slow to import is imported inside, so that ``foretrace --help`` answers at once.
"""

import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import tyro
from tyro.conf import Positional

from foretrace.errors import DatasetError, ForetraceError


def simulate(
    out: Path,
    objects: int = 160,
    contacts_per_edge: int = 2,
    engine: str = "mujoco",
    embodiment: Literal["arm", "tool"] = "arm",
    camera: Literal["exact", "rgbd"] = "exact",
    seed: int = 0,
    workers: int | None = None,
) -> None:
    """Simulate lever-ups of many objects into a data set.

    The same command goes on where an interrupted one stopped. The same seed gives the same data, however many
    workers there are.

    Args:
        out: Folder of the data set.
        objects: Number of objects, spread evenly over 3 to 10 corners.
        contacts_per_edge: Lever-ups at each edge of each object.
        engine: Physics engine.
        embodiment: The whole robot, or the blade alone on the same path (faster).
        camera: How the view from above is made: from geometry, or from a rendered depth image.
        seed: Seed of objects, contact points and simulations.
        workers: Processes; by default one for each core.
    """
    from foretrace.simulation.collect import CollectConfig, collect
    from foretrace.simulation.lever_up import SimulationConfig

    simulation = SimulationConfig(engine=engine, embodiment=embodiment, camera=camera)
    config = CollectConfig(objects, contacts_per_edge, seed, simulation)
    try:
        counts = collect(config, out, workers)
    except KeyboardInterrupt:
        _say(f"interrupted; what is done stays in {out}, the same command goes on from there")
        raise
    _print_outcomes(counts)
    print(f"data set: {out}")


def doctor(path: Positional[Path], repair: bool = False) -> int:
    """Check a data set: checksums, schema, numbers, ids. The exit status is 1 if something is left to mend.

    Args:
        path: Folder of the data set.
        repair: Remove leftovers, set corrupt shards aside (`foretrace simulate` makes them again), and enter
            whole shards that miss their checksum.
    """
    from foretrace.interactions.doctor import examine

    diagnosis = examine(path, repair)
    for finding in diagnosis.findings:
        print(f"{'repaired' if finding.repaired else 'found'}: {finding.file}: {finding.problem}")
    left = sum(not finding.repaired for finding in diagnosis.findings)
    _print_outcomes(diagnosis.outcomes)
    print(f"{path}: {diagnosis.num_interactions} interactions, {left or 'no'} problem{'s'[: left != 1]} left")
    return int(left > 0)


def show(path: Positional[Path], id: int | None = None, out: Path | None = None) -> None:
    """Draw a contact sheet of a data set, or one interaction as a picture and an animation.

    Args:
        path: Folder of the data set.
        id: The interaction to draw; without it, the contact sheet is drawn.
        out: File to write (.png, .svg, .pdf; with an id also .gif, .mp4). By default pictures go to the
            folder's ``figures``.
    """
    from foretrace.evaluation.animation import interaction_animation
    from foretrace.evaluation.figures import contact_sheet, interaction_figure
    from foretrace.interactions.dataset import Dataset

    moving, still = (".gif", ".mp4"), (".png", ".svg", ".pdf")
    if out is not None and out.suffix.lower() not in moving + still:
        raise DatasetError(f"cannot draw to {out}: choose a name that ends in {', '.join(still + moving)}")
    if out is not None and out.suffix.lower() in moving and id is None:
        raise DatasetError(f"{out} would be an animation: choose the interaction with --id")
    dataset = Dataset.open(path)
    stem = path / "figures" / ("contact-sheet" if id is None else f"interaction-{id}")
    if out is not None:
        targets = [out]
    else:
        targets = [stem.with_suffix(".png")] + ([stem.with_suffix(".gif")] if id is not None else [])
    for target in targets:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.suffix.lower() in moving and id is not None:
            interaction_animation(dataset.with_id(id), target)
        else:
            figure = contact_sheet(dataset) if id is None else interaction_figure(dataset.with_id(id))
            figure.savefig(target)
        print(target)


COMMANDS: dict[str, Callable[..., int | None]] = {"simulate": simulate, "doctor": doctor, "show": show}
"""Every command by its name."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status.

    0: done. 1: `doctor` has something left to mend. 2: an error, printed as one line. 130: interrupted.
    """
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: _say(f"warning: {message}")
        try:
            status = tyro.extras.subcommand_cli_from_dict(
                COMMANDS,
                prog="foretrace",
                description="Predict how an object will move before the robot touches it.",
                args=arguments,
            )
        except ForetraceError as error:
            _say(f"error: {' '.join(str(error).split())}")
            return 2
        except KeyboardInterrupt:
            return 130
    return status or 0


def _say(line: Any) -> None:
    print(f"foretrace: {line}", file=sys.stderr)


def _print_outcomes(counts: dict[str, int]) -> None:
    total = sum(counts.values())
    for outcome, count in counts.items():
        print(f"{outcome:>10} {count:7d} {100 * count / total:6.1f} %")
    print(f"{'total':>10} {total:7d}")
