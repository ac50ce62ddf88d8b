"""The command that predicts the motion of an object."""

import csv
import io
from dataclasses import asdict, field, fields, make_dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from foretrace.actions import LeverUp
from foretrace.cli.batch import ManyOptions, predict_many
from foretrace.cli.contact import ContactOptions
from foretrace.cli.context import bevel_of, bevelled
from foretrace.cli.example import say_example, write_example
from foretrace.cli.futures import say_futures
from foretrace.cli.objects import ObjectOptions, PhotoOptions
from foretrace.cli.parsing import adapt
from foretrace.errors import PredictionError
from foretrace.imagined.context import EXACT, context_units, nominal_constants
from foretrace.imagined.shown import LEVEL, radius_of
from foretrace.perception.example import EXAMPLE
from foretrace.perception.photo import PhotoConfig

if TYPE_CHECKING:
    from foretrace.actions import Action
    from foretrace.imagined import ImaginedEffect
    from foretrace.interactions.record import Interaction
    from foretrace.interactions.topdown import TopDownView
    from foretrace.objects import ObjectModel


def _named(name: str, unit: str) -> str:
    return f"{name.replace('_', ' ').capitalize()} {unit}."


ContextOptions = make_dataclass(
    "ContextOptions",
    [
        (name, float | None, field(default=None, metadata={"help": _named(name, unit)}))
        for name, unit in context_units().items()
        if name != EXACT
    ],
    frozen=True,
)
"""One option for everything that a predictor may be conditioned on."""


@adapt((PhotoConfig, ("height",)))
def predict(
    obj: Annotated[OmitArgPrefixes[ObjectOptions], arg(name="object")],
    at: Annotated[OmitArgPrefixes[ContactOptions], arg(name="contact")],
    photo: Annotated[OmitArgPrefixes[PhotoOptions], arg(name="photograph")],
    context: Annotated[OmitArgPrefixes[ContextOptions], arg(name="context")],  # pyright: ignore[reportInvalidTypeForm]
    many: Annotated[OmitArgPrefixes[ManyOptions], arg(name="several at once")],
    run: Positional[Path | None] = None,
    example: bool = False,
    unknown: bool = False,
    compare: bool = False,
    animation: bool = True,
    out: Path = Path("prediction"),
) -> int | None:
    """Predict the motion of an object before it is touched.

    Give the object as --polygon, --image or --mesh, and the contact as --edge or --contact; or give a --photo of the
    table and --contact-px. --example needs none of them. --images and --contacts write one table of many predictions;
    the exit status is 1 if some images cannot be used.

    Args:
        obj: The object: exactly one of --polygon, --image, --mesh.
        at: The contact: either --edge or --contact.
        photo: A photograph of the object on a table, in place of object and contact.
        context: Context of a predictor that is conditioned on it, and settings of --compare.
        many: Many objects or contacts; the predictions go to predictions.csv.
        run: Folder of the training, by default the predictor that comes with foretrace; or a plan.json of
            `foretrace plan`, which is shown alone.
        example: Predict an object that comes with foretrace, and write its mask and a photograph into the folder
            example of --out.
        unknown: Tell the predictor only the constants that are given here; by default the others are the nominal ones.
        compare: Simulate the same lever-up and show truth and error beside the prediction.
        animation: Whether an animation is written, too.
        out: Folder for trajectory.json, trajectory.csv, prediction.png and prediction.gif.
    """
    from foretrace.predictor import load_imaginer

    given = [*photo.given(), *_changed(obj), *_changed(at)]
    if run is not None and run.is_file() and run.suffix == ".json":
        _show_plan(run, out, [*given, *_changed(context), *_changed(many), *["--example"] * example])
        return None
    if example:
        if idle := [*given, *_changed(many)]:
            raise PredictionError(f"--example has object and contact: leave out {', '.join(idle)}")
        obj, at = write_example(out / EXAMPLE)
    predictor = load_imaginer(run)
    values = _given_context(asdict(context), predictor.context, compare)
    kind = predictor.action
    path = kind.path_of(
        **{name: value for name, value in values.items() if name in kind.nominal_parameters()}
    )
    if _changed(many):
        if idle := [*photo.given(), *["--compare"] * compare]:
            raise PredictionError(f"--images and --contacts go without {', '.join(idle)}: leave it out")
        told = partial(_told, values, predictor.context, unknown)
        return predict_many(predictor, obj, at, many, told, path, out)
    seen = None
    if photo.photo is not None:
        if replace(obj, height=None) != ObjectOptions() or at != ContactOptions():
            raise PredictionError("--photo shows the object: leave out the other ways, --edge and --contact")
        if kind is not LeverUp:
            raise PredictionError(
                f"--photo goes with lever-ups, {run} predicts a {kind.label}: give --polygon, --image or --mesh"
            )
        seen = photo.observe(obj.height)
        object, action, view, com = seen.placed.object, seen.action, seen.view, seen.com
    else:
        if idle := photo.given():
            raise PredictionError(f"{', '.join(idle)} goes with --photo: give one, or leave it out")
        object, action, view, com = _object_and_action(obj, at, kind)
    action = replace(action, path=path)
    object = bevelled(object, values)
    told = _told(values, predictor.context, unknown, object)
    imagined = predictor.imagine(view, action, context=told, com=com)
    truth = _simulate(object, action, values) if compare else None
    say_futures(imagined)
    out.mkdir(parents=True, exist_ok=True)
    _write_trajectory(out, run, object, action, imagined, truth)
    _draw(out, object, action, imagined, predictor.display_name, truth, animation)
    if seen is not None:
        from foretrace.interactions.recording_folder import write_image

        write_image(out / "overlay.png", seen.overlay(imagined.com_trajectory, radius_of(imagined)))
    if truth is not None:
        _print_comparison(imagined.com_trajectory, truth)
    print("\n".join(str(file) for file in sorted(out.iterdir()) if file.is_file()))
    if example:
        say_example(out / EXAMPLE)
    return None


def _draw(
    out: Path,
    obj: "ObjectModel",
    action: "Action",
    imagined: "ImaginedEffect",
    name: str,
    truth: "Interaction | None",
    animation: bool,
) -> None:
    from foretrace.pictures.prediction import scene_of
    from foretrace.pictures.scene import scene_figure

    scene = scene_of(obj, action, imagined, name, truth)
    scene_figure(scene).savefig(out / "prediction.png")
    if animation:
        from foretrace.pictures.animation import scene_animation

        scene_animation(scene, out / "prediction.gif")


def _show_plan(file: Path, out: Path, idle: list[str]) -> None:
    """Show a plan that was saved.

    Raises:
        PredictionError: Something else is given beside it.
    """
    from foretrace.cli.planning import show_plan

    if idle:
        raise PredictionError(f"{file} is a plan, which has object and contact: leave out {', '.join(idle)}")
    show_plan(file, out)


def _changed(options: Any) -> list[str]:
    """Names of options that were given."""
    return [
        f"--{each.name.replace('_', '-')}"
        for each in fields(options)
        if getattr(options, each.name) != each.default
    ]


def _object_and_action(
    given: ObjectOptions, at: ContactOptions, kind: "type[Action]"
) -> "tuple[ObjectModel, Action, TopDownView, np.ndarray | None]":
    """Object, action, view, and the centre of mass in the action frame where the geometry determines it."""
    from foretrace.geometry import transform_points
    from foretrace.interactions.topdown import TopDownView

    obj, mask = given.load()
    action = at.place(obj, kind)
    if mask is not None:
        frame = (action.contact, action.direction)
        return obj, action, TopDownView.from_mask(mask, given.scale, *frame, obj.height), None  # pyright: ignore
    com = transform_points(action.T_action_object, obj.mass_properties(1.0).com[None])[0]
    return obj, action, TopDownView.of(obj, action), com


def _given_context(
    options: dict[str, float | None], wanted: tuple[str, ...], simulated: bool
) -> dict[str, float]:
    """The context that was given.

    Raises:
        PredictionError: A value is not above 0, or is of no use.
    """
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        if value is not None and not 0 < value < float("inf"):
            raise PredictionError(f"{option} is {value}: give a number above 0")
        if value is not None and name not in wanted and not simulated:
            raise PredictionError(
                f"the predictor is not conditioned on {name}: leave {option} out, or --compare"
            )
    return {name: value for name, value in options.items() if value is not None}


def _told(
    given: dict[str, float], context: tuple[str, ...], unknown: bool, obj: "ObjectModel"
) -> dict[str, float]:
    """What the predictor is told: what was given; and, unless that alone is known, own bevel and nominal constants."""
    usual = {} if unknown else {**nominal_constants(), **bevel_of(obj)}
    return {name: value for name, value in {**usual, **given}.items() if name in context}


def _simulate(obj: "ObjectModel", action: "Action", given: dict[str, float]) -> "Interaction":
    from foretrace.interactions.record import PHYSICS_RANGES, Physics
    from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up

    physics = Physics(**{name: value for name, value in given.items() if name in PHYSICS_RANGES})
    return simulate_lever_up(obj, action, SimulationConfig(physics=physics))


def _write_trajectory(
    out: Path,
    run: Path | None,
    obj: "ObjectModel",
    action: "Action",
    imagined: "ImaginedEffect",
    truth: "Interaction | None",
) -> None:
    from foretrace.files import write_json, write_text

    content: dict[str, Any] = {
        "predictor": "default" if run is None else str(run),
        "frame": "action: origin at the contact point on the table top, x along the action, y left, z up",
        "units": {
            "times": "s",
            "com_trajectory": "m",
            "pose_trajectory": "m, quaternion w x y z",
            "radius": "m",
        },
        "object": obj.to_dict(),
        "contact": action.contact.tolist(),
        "direction": action.direction.tolist(),
        "times": imagined.times.tolist(),
        "com_trajectory": imagined.com_trajectory.tolist(),
    }
    if imagined.pose_trajectory is not None:
        content["pose_trajectory"] = imagined.pose_trajectory.tolist()
    content |= imagined.to_dict(LEVEL)
    if truth is not None:
        content["simulated"] = {
            "outcome": str(truth.effect.outcome),
            "slip_index": truth.effect.slip_index,
            "com_trajectory": truth.effect.com_trajectory.tolist(),
        }
    write_json(out / "trajectory.json", content)
    columns, table = ["time_s", "x_m", "y_m", "z_m"], [imagined.times[:, None], imagined.com_trajectory]
    if imagined.pose_trajectory is not None:
        columns, table = [*columns, "qw", "qx", "qy", "qz"], [*table, imagined.pose_trajectory[:, 3:]]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *np.concatenate(table, axis=1).tolist()])
    write_text(out / "trajectory.csv", text.getvalue())


def _print_comparison(imagined: "np.ndarray", truth: "Interaction") -> None:
    from foretrace.trajectories import final_distance, mean_distance

    effect = truth.effect
    print(f"simulated outcome: {effect.outcome}")
    end = len(effect.com_trajectory) if effect.slip_index is None else effect.slip_index
    end = min(end, len(imagined))
    if end > 0:
        until = "" if effect.slip_index is None else f" up to the slip at {effect.times[end - 1]:.2f} s"
        full = 100 * float(mean_distance(imagined[:end], effect.com_trajectory[:end]))
        final = 100 * float(final_distance(imagined[:end], effect.com_trajectory[:end]))
        print(f"error{until}: {full:.2f} cm over the trajectory, {final:.2f} cm at its end")
