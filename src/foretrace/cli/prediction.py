"""The command that predicts the motion of an object."""

from dataclasses import asdict, dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from foretrace.actions import ToolPath
from foretrace.cli.contact import ContactOptions
from foretrace.cli.parsing import adapt
from foretrace.errors import PredictionError
from foretrace.imagined.context import CONSTANTS, CONTEXT, EXACT, PARAMETERS, nominal_constants
from foretrace.perception.photo import PhotoConfig

if TYPE_CHECKING:
    from foretrace.actions import LeverUp
    from foretrace.interactions.record import Interaction
    from foretrace.interactions.topdown import TopDownView
    from foretrace.objects import ObjectModel
    from foretrace.perception.photo import PhotoView
    from foretrace.predictor import ImaginedEffect


@dataclass(frozen=True)
class ObjectOptions:
    """The object."""

    polygon: Path | None = None
    """File with the outline's corners: a table with one corner per line, GeoJSON or WKT, in metres unless --scale says
    otherwise."""
    image: Path | None = None
    """Image of the object's silhouette, white on black or opaque on transparent; needs --scale."""
    label: str | None = None
    """Value of the object's pixels in an image of several: a number (in an image with a palette its index), or red,
    green and blue as 128,0,0."""
    invert: bool = False
    """The image shows the object black on white."""
    mesh: Path | None = None
    """STL, OBJ, PLY or OFF file of the object."""
    rest: bool = False
    """Turn the mesh onto the side on which its centre of mass is lowest, where it does not stand right in its file."""
    scale: float | None = None
    """Metres per pixel of the image, or per unit of the mesh or polygon, 1 by default."""
    height: float | None = None
    """Height of a polygon's, image's or photograph's object [m], 0.02 by default; a mesh has its own."""

    def load(self) -> "tuple[ObjectModel, np.ndarray | None]":
        """The object, and the mask of an image.

        Raises:
            PredictionError: Not exactly one object is given, or options do not go together.
            ShapeError: The object cannot be used.
        """
        from foretrace.objects import MeshObject, Prism
        from foretrace.objects.polygon_files import read_polygon
        from foretrace.objects.prism import DEFAULT_HEIGHT
        from foretrace.objects.shape_files import read_silhouette_image

        given = [f"--{name}" for name in ("polygon", "image", "mesh") if getattr(self, name) is not None]
        if len(given) != 1:
            raise PredictionError(
                f"{' and '.join(given) or 'no object'} given: give exactly one of --polygon, --image, --mesh"
            )
        if self.rest and self.mesh is None:
            raise PredictionError("--rest goes with --mesh: the others lie flat already")
        if self.height is not None and self.mesh is not None:
            raise PredictionError("--height goes with --polygon and --image: a mesh has its own")
        if self.image is None and (self.label is not None or self.invert):
            raise PredictionError("--label and --invert go with --image: leave them out")
        if self.label is not None and self.invert:
            raise PredictionError(
                "--label and --invert given: a label names the object already, leave one out"
            )
        height = DEFAULT_HEIGHT if self.height is None else self.height
        if self.polygon is not None:
            return Prism(read_polygon(self.polygon, self.scale), height), None
        if self.mesh is not None:
            return MeshObject.load(self.mesh, 1.0 if self.scale is None else self.scale, rest=self.rest), None
        if self.scale is None or self.image is None:
            raise PredictionError("--image needs --scale, the metres per pixel")
        mask = read_silhouette_image(self.image, self._label(), self.invert)
        return Prism.from_mask(mask, self.scale, height), mask

    def _label(self) -> "list[float] | None":
        """The label as numbers."""
        if self.label is None:
            return None
        try:
            return [float(value) for value in self.label.split(",")]
        except ValueError:
            raise PredictionError(
                f"--label is {self.label}: give a number, or red, green and blue as 128,0,0"
            ) from None


@dataclass(frozen=True)
class PhotoOptions:
    """A photograph of the object on a table, in place of object and contact; the prediction is drawn onto it."""

    photo: Path | None = None
    """The photograph."""
    contact_px: tuple[float, float] | None = None
    """Column and row in the photograph of the point to lever at, on the object's upper rim."""
    camera: Path | None = None
    """The camera's file, JSON or YAML of ROS, OpenCV or Kalibr; by default camera.json beside the photograph."""
    markers: Path | None = None
    """Layout of the markers on the table; by default markers.json beside the photograph. Not needed with --depth."""
    depth: Path | None = None
    """Depth image of the photograph's size, PNG, TIFF or .npy: whole numbers in millimetres, fractions in metres. Shows
    the table and measures the object's height, unless --height is given."""
    background: Path | None = None
    """Photograph of the table without the object."""
    found: PhotoConfig = field(default_factory=PhotoConfig)
    """How the object is found."""

    def given(self) -> list[str]:
        """Options that were given. A switch cannot be given with the value that it has anyway."""
        values = {name: value for name, value in asdict(self).items() if name != "found"}
        options = [f"--{name.replace('_', '-')}" for name, value in values.items() if value is not None]
        for each in fields(PhotoConfig):
            value = getattr(self.found, each.name)
            if value != each.default:
                options.append(f"--{'no-' if value is False else ''}{each.name}")
        return options

    def observe(self, height: float | None, needs_contact: bool = True) -> "PhotoView":
        """What the photograph shows.

        Args:
            height: Height of the object, if it is known [m].
            needs_contact: Whether a contact has to be given; else the largest object is meant without one.

        Raises:
            PredictionError: No contact is given.
            PerceptionError: The photograph does not show it.
        """
        from foretrace.perception.photo import open_photo

        if self.photo is None or (self.contact_px is None and needs_contact):
            raise PredictionError("--photo needs --contact-px COLUMN ROW, a pixel on the object's upper rim")
        files = {name: getattr(self, name) for name in ("camera", "markers", "depth", "background")}
        return open_photo(self.photo, self.contact_px, **files, config=replace(self.found, height=height))


def _named(name: str) -> str:
    return f"{name.replace('_', ' ').capitalize()} {CONTEXT[name]}."


ContextOptions = make_dataclass(
    "ContextOptions",
    [
        (name, float | None, field(default=None, metadata={"help": f"{_named(name)}"}))
        for name in CONTEXT
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
    run: Positional[Path | None] = None,
    unknown: bool = False,
    compare: bool = False,
    animation: bool = True,
    out: Path = Path("prediction"),
) -> None:
    """Predict the motion of an object before it is touched.

    Give the object as --polygon, --image or --mesh, and the contact as --edge or --contact; or give a --photo of the
    table and --contact-px.

    Args:
        obj: The object: exactly one of --polygon, --image, --mesh.
        at: The contact: either --edge or --contact.
        photo: A photograph of the object on a table, in place of object and contact.
        context: Context of a predictor that is conditioned on it, and settings of --compare.
        run: Folder of the training, by default the predictor that comes with foretrace; or a plan.json of
            `foretrace plan`, which is shown alone.
        unknown: Tell the predictor only the constants that are given here; by default the others are the nominal ones.
        compare: Simulate the same lever-up and show truth and error beside the prediction.
        animation: Write an animation as well.
        out: Folder for trajectory.json, trajectory.csv, prediction.png and prediction.gif.
    """
    from foretrace.cli.futures import prediction_band, radius_of, say_futures
    from foretrace.interactions.recording_folder import write_image
    from foretrace.pictures.animation import scene_animation
    from foretrace.pictures.scene import Scene, scene_figure
    from foretrace.predictor import load_predictor

    if run is not None and run.is_file() and run.suffix == ".json":
        _show_plan(run, out, [*photo.given(), *_changed(obj), *_changed(at), *_changed(context)])
        return
    predictor = load_predictor(run)
    seen = None
    if photo.photo is not None:
        if replace(obj, height=None) != ObjectOptions() or at != ContactOptions():
            raise PredictionError("--photo shows the object: leave out the other ways, --edge and --contact")
        seen = photo.observe(obj.height)
        object, action, view, com = seen.placed.object, seen.action, seen.view, seen.com
    else:
        if idle := photo.given():
            raise PredictionError(f"{', '.join(idle)} goes with --photo: give one, or leave it out")
        object, action, view, com = _object_and_action(obj, at)
    given = _given_context(asdict(context), predictor.context, compare)
    path = ToolPath.of(**{name: value for name, value in given.items() if name in PARAMETERS})
    action = replace(action, path=path)
    imagined = predictor.imagine(view, action, context=_told(given, predictor.context, unknown), com=com)
    paths = {predictor.display_name: imagined.com_trajectory}
    truth = _simulate(object, action, given) if compare else None
    if truth is not None and len(truth.effect.times) > 0:
        title = f"Predicted and simulated lever-up: {truth.effect.outcome}"
        scene = replace(Scene.observed(truth, paths), title=title)
    else:
        scene = Scene.imagined(object, action, imagined.times, paths)
    scene = replace(scene, band=prediction_band(imagined))
    say_futures(imagined)
    out.mkdir(parents=True, exist_ok=True)
    _write_trajectory(out, run, object, action, imagined, truth)
    scene_figure(scene).savefig(out / "prediction.png")
    if seen is not None:
        write_image(out / "overlay.png", seen.overlay(imagined.com_trajectory, radius_of(imagined)))
    if animation:
        scene_animation(scene, out / "prediction.gif")
    if truth is not None:
        _print_comparison(imagined.com_trajectory, truth)
    print("\n".join(str(file) for file in sorted(out.iterdir())))


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
    given: ObjectOptions, at: ContactOptions
) -> "tuple[ObjectModel, LeverUp, TopDownView, np.ndarray | None]":
    """Object, action, view, and the centre of mass in the action frame where the geometry determines it."""
    from foretrace.geometry import transform_points
    from foretrace.interactions.topdown import TopDownView

    obj, mask = given.load()
    action = at.place(obj)
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


def _told(given: dict[str, float], context: tuple[str, ...], unknown: bool) -> dict[str, float]:
    """What the predictor is told: values that were given, and nominal constants unless only the former are known."""
    usual = {} if unknown else {name: value for name, value in nominal_constants().items() if name in context}
    return usual | {name: value for name, value in given.items() if name in context}


def _simulate(obj: "ObjectModel", action: "LeverUp", given: dict[str, float]) -> "Interaction":
    from foretrace.interactions.record import Physics
    from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up

    physics = Physics(**{name: value for name, value in given.items() if name in CONSTANTS})
    return simulate_lever_up(obj, action, SimulationConfig(physics=physics))


def _write_trajectory(
    out: Path,
    run: Path | None,
    obj: "ObjectModel",
    action: "LeverUp",
    imagined: "ImaginedEffect",
    truth: "Interaction | None",
) -> None:
    import pandas as pd

    from foretrace.cli.futures import futures_content
    from foretrace.files import write_json

    content: dict[str, Any] = {
        "predictor": "default" if run is None else str(run),
        "frame": "action: origin at the contact point on the table top, x along the action, y left, z up",
        "units": {"times": "s", "com_trajectory": "m"},
        "object": obj.to_dict(),
        "contact": action.contact.tolist(),
        "direction": action.direction.tolist(),
        "times": imagined.times.tolist(),
        "com_trajectory": imagined.com_trajectory.tolist(),
    }
    if imagined.pose_trajectory is not None:
        content["pose_trajectory"] = imagined.pose_trajectory.tolist()
    content |= futures_content(imagined)
    if truth is not None:
        content["simulated"] = {
            "outcome": str(truth.effect.outcome),
            "slip_index": truth.effect.slip_index,
            "com_trajectory": truth.effect.com_trajectory.tolist(),
        }
    write_json(out / "trajectory.json", content)
    table = np.column_stack([imagined.times, imagined.com_trajectory])
    pd.DataFrame(table, columns=["time_s", "x_m", "y_m", "z_m"]).to_csv(out / "trajectory.csv", index=False)


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
