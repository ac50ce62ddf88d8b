"""The command that turns a table of recorded pushes into a data set."""

import warnings
from pathlib import Path

from rich.console import Console
from tyro.conf import Positional

from foretrace.interactions.pushes import ROD_RADIUS, read_pushes
from foretrace.interactions.pushes_data import write_pushes
from foretrace.workers import ProgressReport


def import_pushes(
    table: Positional[Path],
    shapes: Path,
    out: Path,
    skip_bad: bool = False,
    rod_radius: float = ROD_RADIUS,
) -> None:
    """Turn a table of recorded pushes into a data set of interactions, known at their ends alone.

    Args:
        table: CSV file with a row for each push: shape, pose of the object and place of the rod before and after.
        shapes: JSON file with outline, thickness and mass of each shape.
        out: Folder of the data set, a new one.
        skip_bad: Leave out rows that are wrong, and list them.
        rod_radius: Radius of the rod in metres.
    """
    pushes, faults = read_pushes(table, shapes, skip_bad, rod_radius)
    for fault in faults:
        warnings.warn(f"left out: {fault}", stacklevel=1)
    with ProgressReport("pushes", len(pushes), 0, Console(stderr=True)) as report:
        written, missed = write_pushes(pushes, out, lambda count: report.add(count))
    print(
        f"{written} pushes of {len(pushes.shapes)} shapes, {missed} left out: the rod passes or leaves the view"
    )
    print(f"data set: {out}")
