"""Plans for every object of a data set: one row of a table each, on as many processes or machines as there are."""

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass, fields
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foretrace.cli.console import when_interrupted
from foretrace.errors import ForetraceError, PlanningError, counted
from foretrace.extras import named_extras
from foretrace.files import (
    as_json,
    first_difference,
    first_stranger,
    make_folder,
    read_json,
    sole_writer,
    write_json,
    write_text,
)
from foretrace.planning import PlanConfig, goals
from foretrace.urls import Url

if TYPE_CHECKING:
    from foretrace.imagined import Imaginer

TABLE, CONFIG, ROWS = "plans.csv", "plans.json", "rows"
REMEDY = "choose another --out"


@dataclass(frozen=True)
class EveryOptions:
    """Plans for many objects."""

    every: bool = False
    """Plan for every object of --data: one row each in plans.csv. The same command continues an interrupted one."""
    workers: int | None = None
    """Objects at the same time, with --every; by default one for each core."""
    cluster: str | None = None
    """Address of a Ray cluster that plans, with --every: HOST:PORT, ray://HOST:PORT, or local:N."""


@dataclass(frozen=True)
class Task:
    """What is planned for each object."""

    run: Path | None
    """Folder of the training that imagines; None: what comes with foretrace."""
    action: str
    """Label of the action."""
    goal: goals.Goal
    """What is to happen."""
    told: Mapping[str, float] | None
    """Context."""
    search: PlanConfig
    """How candidates are searched."""


@dataclass(frozen=True)
class Row:
    """A plan; the columns of the table."""

    object_id: int
    """Number of the object in its data set."""
    interaction: int
    """Number of its first interaction, whose thickness and bevel count."""
    action: str = ""
    """Label of the chosen action; empty where none can be used."""
    contact_x_m: float | None = None
    contact_y_m: float | None = None
    direction_x: float | None = None
    direction_y: float | None = None
    path: str = ""
    """Parameters of the tool's path, as JSON."""
    reached: float | None = None
    """Probability that the goal is reached."""
    cost: float | None = None
    """Cost by the criterion."""
    note: str = ""
    """What stands in the way."""


def plan_every(data: Path | Url, task: Task, out: Path, many: EveryOptions) -> None:
    """Plan for every object of a data set, and write the table.

    Args:
        data: Folder or URL of the data set.
        task: What is planned.
        out: Folder of the table, and of a file for each object until all are there.
        many: On how many processes, or on which cluster.

    Raises:
        PlanningError: The folder holds other plans.
    """
    with named_extras():
        from foretrace.workers import ProgressReport, count_workers, on_cluster, run_jobs

    objects = _objects(data)
    settings = asdict(task) | {"data": str(data), "goal": str(task.goal), "run": task.run and str(task.run)}
    rows = out / ROWS
    if not (out / CONFIG).is_file() and (stranger := first_stranger(out, (TABLE, ROWS))):
        raise PlanningError(f"{out} holds {stranger} and no plans: {REMEDY}")
    make_folder(rows, PlanningError)
    with sole_writer(out, PlanningError):
        _claim(out, as_json(settings))
        todo = [each for each in objects if not (rows / f"{each[0]}.json").is_file()]
        with (
            when_interrupted(f"what is done stays in {out}, the same command goes on from there"),
            on_cluster(many.cluster),
            ProgressReport("plans", len(objects), len(objects) - len(todo)) as report,
        ):
            workers = count_workers(many.workers, PlanningError)
            for number in run_jobs(partial(_plan_into, rows, task), todo, workers, error=PlanningError):
                report.add(1, f"object {number}")
        table = [read_json(rows / f"{number}.json", Row, PlanningError, REMEDY) for number, _, _ in objects]
        text = io.StringIO()
        names = [each.name for each in fields(Row)]
        csv.writer(text, lineterminator="\n").writerows([names, *(astuple(row) for row in table)])
        write_text(out / TABLE, text.getvalue())
    reached = sum((row.reached or 0.0) > 0.5 for row in table)
    print(f"{counted(len(table), 'plan')}, {reached} reached more probably than not: {out / TABLE}")


def _objects(data: Path | Url) -> list[tuple[int, int, str]]:
    """Each object: its number, that of its first interaction, its description."""
    from foretrace.interactions.dataset import Dataset

    dataset = Dataset.open(data)
    numbers, rows = np.unique(dataset.index["object_id"].to_numpy(), return_index=True)
    order = np.argsort(rows)
    described = map(json.dumps, dataset[rows[order]].objects())
    found = zip(numbers[order].tolist(), dataset.ids[rows[order]].tolist(), described, strict=True)
    return sorted(found)


def _claim(out: Path, settings: dict[str, Any]) -> None:
    """Note what is planned in a folder, or compare it with what was."""
    if not (out / CONFIG).is_file():
        write_json(out / CONFIG, settings)
        return
    there = read_json(out / CONFIG, dict[str, Any], PlanningError, REMEDY)
    if different := first_difference(there, settings):
        name, was, asked = different
        raise PlanningError(f"{out} holds plans with {name} = {was}, asked for is {asked}: {REMEDY}")


def _plan_into(rows: Path, task: Task, job: tuple[int, int, str]) -> int:
    """Plan for an object, in any process, and write its row; the object's number."""
    number, interaction, description = job
    write_json(rows / f"{number}.json", asdict(_plan(task, number, interaction, description)))
    return number


def _plan(task: Task, number: int, interaction: int, description: str) -> Row:
    from foretrace.objects import object_from_json
    from foretrace.planning import plan

    try:
        found = plan(
            object_from_json(description),
            task.goal,
            _imaginer(task.run, task.action),
            dict(task.told) if task.told is not None else None,
            config=task.search,
        )
    except ForetraceError as reason:
        return Row(number, interaction, note=" ".join(str(reason).split()))
    (x, y), (dx, dy) = found.action.contact.tolist(), found.action.direction.tolist()
    path = json.dumps(asdict(found.action.path))
    place = found.action.label, x, y, dx, dy, path
    return Row(number, interaction, *place, float(found.reached), float(found.cost), found.note)


@lru_cache(maxsize=1)
def _imaginer(run: Path | None, action: Any) -> "Imaginer":
    """The imaginer of a process."""
    from foretrace.cli.planning import imaginer_of

    return imaginer_of(run, action, 1)
