"""Many predictions at once: one row of a table for each object and contact."""

import csv
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from foretrace.cli.console import say
from foretrace.cli.contact import ContactOptions
from foretrace.cli.objects import ObjectOptions
from foretrace.errors import CommandError, ForetraceError, PredictionError
from foretrace.imagined.shown import LEVEL

if TYPE_CHECKING:
    from foretrace.actions import Action
    from foretrace.imagined import ImaginedBatch, Imaginer
    from foretrace.interactions.topdown import TopDownView
    from foretrace.objects import ObjectModel

TABLE = "predictions.csv"
MOST_CONTACTS = 10_000
"""Largest number of contacts of one object."""


@dataclass(frozen=True)
class ManyOptions:
    """Many predictions, written to predictions.csv."""

    images: Path | None = None
    """Folder of images of silhouettes, each as of --image, of the same --scale and --height."""
    contacts: int | None = None
    """Number of contacts, evenly spaced along each object's outline, in place of --edge and --contact; those that no
    blade reaches are left out."""


class Row(NamedTuple):
    """One prediction; the columns of the table."""

    object: str
    contact_x_m: float
    contact_y_m: float
    direction_x: float
    direction_y: float
    outcome: str
    probability: float
    rise_m: float
    moved_x_m: float
    moved_y_m: float
    tilt_rad: float | str
    region_radius_m: float | str
    warnings: str


def predict_many(
    predictor: "Imaginer",
    obj: ObjectOptions,
    at: ContactOptions,
    many: ManyOptions,
    told: Callable[["ObjectModel"], Mapping[str, float]],
    path: Any,
    out: Path,
) -> int:
    """Predict every object at every contact, and write a table.

    Images that cannot be used are told in a line each, and the others predicted.

    Args:
        predictor: The predictor.
        obj: The object, or how the images are read.
        at: The contact, where the options give none.
        many: Objects and contacts.
        told: The context of an object.
        path: The tool's path.
        out: Folder of the table.

    Returns:
        The exit status: 1 where some images cannot be used.

    Raises:
        CommandError: Options do not go together.
        PredictionError: They do not, a folder has no images, or none of its images can be used.
        ForetraceError: The only object cannot be used.
    """
    from foretrace.files import write_text

    if many.contacts is not None:
        if at != ContactOptions():
            raise PredictionError(
                "--contacts chooses the contacts: leave out --edge, --fraction and --contact"
            )
        if not 1 <= many.contacts <= MOST_CONTACTS:
            raise PredictionError(f"--contacts is {many.contacts}: give a number from 1 to {MOST_CONTACTS}")
    rows: list[Row] = []
    objects, failed = _objects(obj, many), 0
    for name, one in objects:
        try:
            rows += _predict(predictor, name, one, at, many.contacts, told, path)
        except CommandError:
            raise
        except ForetraceError as error:
            if many.images is None:
                raise
            failed += 1
            file = str(many.images / name)
            say(error if str(error).startswith(file) else f"{file}: {error}")
    if failed == len(objects):
        raise PredictionError(
            f"{failed} of {failed} images cannot be used: nothing is written; mend or remove them"
        )
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([Row._fields, *rows])
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / TABLE, text.getvalue())
    print(f"{len(rows)} predictions: {out / TABLE}")
    if failed:
        say(f"{failed} of {len(objects)} images cannot be used and have no row: mend or remove them")
    return int(failed > 0)


def _objects(obj: ObjectOptions, many: ManyOptions) -> list[tuple[str, ObjectOptions]]:
    """Each object's name, and the options that give it."""
    from foretrace.images import SUFFIXES

    if many.images is None:
        file = obj.polygon or obj.image or obj.mesh
        return [("" if file is None else file.name, obj)]
    if obj.polygon is not None or obj.image is not None or obj.mesh is not None:
        raise PredictionError("--images shows the objects: leave out --polygon, --image and --mesh")
    if not many.images.is_dir():
        raise PredictionError(f"--images {many.images} is no folder: give one with images of silhouettes")
    files = sorted(file for file in many.images.iterdir() if file.suffix.lower() in SUFFIXES)
    if not files:
        raise PredictionError(f"{many.images} has no images ({', '.join(SUFFIXES)}): give another --images")
    return [(file.name, replace(obj, image=file)) for file in files]


def _predict(
    predictor: "Imaginer",
    name: str,
    given: ObjectOptions,
    at: ContactOptions,
    contacts: int | None,
    told: Callable[["ObjectModel"], Mapping[str, float]],
    path: Any,
) -> list[Row]:
    """The rows of one object."""
    from foretrace.planning.candidates import Scene

    obj, mask = given.load()
    scene = Scene.of(obj)
    view = scene.view if mask is None else _view_of(mask, given, scene)
    actions = (
        [at.place(obj, predictor.action)] if contacts is None else _around(scene, predictor.action, contacts)
    )
    actions = [replace(action, path=path) for action in actions]
    imagined = predictor.imagine_candidates(
        view, scene.in_view(actions), context=told(obj), com=scene.com_in_view if mask is None else None
    )
    return [_row(name, action, imagined, k) for k, action in enumerate(actions)]


def _view_of(mask: np.ndarray, given: ObjectOptions, scene: Any) -> "TopDownView":
    """The view that shows a mask's own pixels."""
    from foretrace.interactions.topdown import TopDownView

    turn, shift = scene.T_view_object[:2, :2], scene.T_view_object[:2, 3]
    return TopDownView.from_mask(mask, given.scale or 1.0, -turn.T @ shift, turn[0], scene.height)


def _around(scene: Any, kind: "type[Action]", number: int) -> "list[Action]":
    """Actions along the inward normals at evenly spaced points of the outline that the tool gets to.

    Raises:
        PredictionError: There is none.
    """
    from foretrace.planning.candidates import Rim, find_free, place

    rim = Rim(scene.outline)
    along = (np.arange(number) + 0.5) * rim.length / number
    found = place(kind, rim, along, np.zeros(number), [kind.path_of()] * number)
    free, lost = find_free(scene, found)
    if not free.any():
        raise PredictionError(f"no contact can be used ({', '.join(lost)}): give --edge or --contact")
    return list(found[np.flatnonzero(free)].actions)


def _row(name: str, action: "Action", imagined: "ImaginedBatch", k: int) -> Row:
    """A row of the table: where the most probable motion has led at the end of the action."""
    from foretrace.geometry import quaternion_to_matrix, tilt

    effect = imagined[k].until(action.duration)
    futures = effect.futures
    best = int(futures.probability[0].argmax())
    moved = effect.com_trajectory[-1] - effect.com_trajectory[0]
    moved[:2] = moved[:2] @ action.T_action_object[:2, :2]  # in the object's frame
    pose = effect.pose_trajectory
    angle = "" if pose is None else float(tilt(quaternion_to_matrix(pose[-1, 3:])))
    radius = np.nan if futures.is_point else futures.radius(LEVEL)[0, best, -1]
    return Row(
        object=name,
        contact_x_m=float(action.contact[0]),
        contact_y_m=float(action.contact[1]),
        direction_x=float(action.direction[0]),
        direction_y=float(action.direction[1]),
        outcome=futures.outcome[best],
        probability=float(futures.outcomes()[futures.outcome[best]][0]),
        rise_m=float(moved[2]),
        moved_x_m=float(moved[0]),
        moved_y_m=float(moved[1]),
        tilt_rad=angle,
        region_radius_m=float(radius) if np.isfinite(radius) else "",
        warnings="; ".join(effect.warnings),
    )
