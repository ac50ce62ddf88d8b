"""Commands about predictors: train, predict."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from foretrace.cli.console import say
from foretrace.errors import ActionError, PredictionError, TrainingError

if TYPE_CHECKING:
    import numpy as np

    from foretrace.actions import LeverUp
    from foretrace.interactions.topdown import TopDownView
    from foretrace.objects import ObjectModel

LARGEST_SNAP = 0.02
"""A contact point farther from the outline is a mistake, not one to move there [m]."""


def train(
    data: Path,
    out: Path,
    predictor: str = "lstm",
    features: str | None = None,
    heights: bool | None = None,
    context: tuple[str, ...] | None = None,
    state: Literal["position", "pose", "turn"] | None = None,
    steps_ahead: int | None = None,
    hidden: int | None = None,
    window: int | None = None,
    residual: bool | None = None,
    layers: int | None = None,
    ensemble: int | None = None,
    components: int | None = None,
    pivot_edges: int | None = None,
    mirrored: bool | None = None,
    epochs: int | None = None,
    batch_size: int | None = None,
    learning_rate: float | None = None,
    outcomes: tuple[str, ...] | None = None,
    split: tuple[int, int, int] | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    threads: int | None = None,
    fresh: bool = False,
) -> None:
    """Train a predictor on a data set.

    The same command goes on where an interrupted one stopped.

    Args:
        data: Folder of the data set.
        out: Folder of the training: model, settings, metrics, split, TensorBoard events.
        predictor: Kind of predictor: lstm, one-shot, or one that a plug-in adds.
        features: Features of the object; an unknown label lists the choices. By default im-cnn for lstm, outline for
            one-shot.
        heights: Give height maps to the one-shot predictor, too, for objects that are not flat.
        context: Conditioning variables beside the view: friction, tool_friction, density; of the action insertion,
            arc_radius, sweep, speed.
        state: Predict the centre of mass, or the whole pose (lstm).
        steps_ahead: States predicted per iteration, n in the paper (lstm).
        hidden: Units of the LSTM, by default 256; or of each layer of the one-shot predictor, by default 128.
        window: States per training sequence (lstm).
        residual: Predict changes of the state (lstm).
        layers: Hidden layers (one-shot).
        ensemble: Size of the ensemble (one-shot).
        components: Components of the PCA basis of trajectories (one-shot).
        pivot_edges: Candidate pivot edges, 1 or 2 (one-shot).
        mirrored: See every lever-up in the mirror, too (one-shot).
        epochs: Passes over the training part; more where it is small, for 300 optimiser steps at least. By default 15
            for lstm, 150 for one-shot.
        batch_size: Trajectories per optimiser step.
        learning_rate: Adam's largest learning rate; it rises to it and falls to 0. By default 0.008 for lstm, 0.004 for
            one-shot.
        outcomes: Outcomes of the interactions to learn from, by default levered.
        split: Sizes of training, validation and test part; by default the paper's 1400 100 300, or in the same
            proportion where the data set is smaller.
        seed: Seed of the split, the first weights, the order and the dropout.
        device: Where to compute.
        threads: Threads on the CPU; by default as many as are worth it.
        fresh: Discard the training in the folder instead of going on with it.
    """
    from dataclasses import fields, replace

    from foretrace.interactions.dataset import Dataset
    from foretrace.interactions.splits import PAPER_SIZES
    from foretrace.predictor import PREDICTORS, train_predictor

    config_class = PREDICTORS.find(predictor).config_class
    chosen: dict[str, Any] = {"features": features, "context": context, "state": state, "hidden": hidden}
    chosen |= {"steps_ahead": steps_ahead, "window": window, "residual": residual, "layers": layers}
    chosen |= {"ensemble": ensemble, "components": components, "pivot_edges": pivot_edges}
    chosen |= {"mirrored": mirrored, "feature_options": None if heights is None else {"heights": heights}}
    names = [field.name for field in fields(config_class)]
    if "outcomes" in names:
        chosen["outcomes"] = outcomes
    chosen = {name: value for name, value in chosen.items() if value is not None}
    if odd := [name for name in chosen if name not in names]:
        raise TrainingError(
            f"--{odd[0].replace('_', '-')} is no setting of the {predictor} predictor, which has {', '.join(names)}"
        )
    loop = {"epochs": epochs, "batch_size": batch_size, "learning_rate": learning_rate, "outcomes": outcomes}
    loop = {name: value for name, value in loop.items() if value is not None}
    config = config_class(**chosen)
    training = replace(config.training, seed=seed, device=device, threads=threads, **loop)
    dataset = Dataset.open(data).where(outcome=training.outcomes or ("levered",))
    if split is None:
        split = PAPER_SIZES if len(dataset) >= sum(PAPER_SIZES) else None
    try:
        train_predictor(dataset, config, out, replace(training, split=split), resume=not fresh)
    except KeyboardInterrupt:
        say(f"interrupted; the best model so far is in {out}, the same command goes on from there")
        raise
    print(f"predictor: {out}")


def predict(
    run: Positional[Path | None] = None,
    polygon: Path | None = None,
    image: Path | None = None,
    scale: float | None = None,
    mesh: Path | None = None,
    height: float | None = None,
    edge: int | None = None,
    fraction: float = 0.5,
    contact: tuple[float, float] | None = None,
    photo: Path | None = None,
    camera: Path | None = None,
    markers: Path | None = None,
    contact_px: tuple[float, float] | None = None,
    mask: Literal["background", "threshold", "colour", "grabcut", "depth"] | None = None,
    depth: Path | None = None,
    flat: bool = True,
    background: Path | None = None,
    shadows: bool = True,
    box: tuple[int, int, int, int] | None = None,
    hull: bool = False,
    friction: float | None = None,
    tool_friction: float | None = None,
    density: float | None = None,
    insertion: float | None = None,
    arc_radius: float | None = None,
    sweep: float | None = None,
    speed: float | None = None,
    compare: bool = False,
    animation: bool = True,
    out: Path = Path("prediction"),
) -> None:
    """Predict the motion of an object before it is touched.

    Give the object as --polygon, --image or --mesh, and the contact as --edge or --contact; or give a --photo of the
    table and --contact-px.

    Args:
        run: Folder of the training; by default the predictor that comes with foretrace.
        polygon: File with the outline's corners, one "x y" or "x,y" per line [m].
        image: Picture of the object's silhouette, white on black; needs --scale.
        scale: Metres per pixel of the image, or per unit of the mesh (1 by default).
        mesh: STL or OBJ file of the object.
        height: Height of a polygon's, image's or photograph's object [m], 0.02 by default; a mesh has its own.
        edge: Number of the outline's edge to lever at; edge k runs from corner k to corner k + 1.
        fraction: How far along that edge, between 0 and 1.
        contact: Point to lever at instead, in the object's frame [m]; snapped to the outline. An image's frame has
            its origin at the silhouette's centroid, x to the right and y up.
        photo: Photograph of the object on the table; the prediction is drawn onto it.
        camera: The camera's JSON file, from `foretrace calibrate`; by default camera.json beside the photograph.
        markers: Layout of the markers on the table; by default markers.json beside the photograph. Not needed with
            --depth, which shows the table, too.
        contact_px: Column and row in the photograph of the point to lever at, on the object's upper rim.
        mask: How the object is found in the photograph; by default grabcut with --box, otherwise by background or
            depth, whichever is given.
        depth: Depth image of the photograph's size: PNG of 16 bits in millimetres, or .npy in metres. It measures the
            object's height, unless --height is given.
        flat: Whether the object's top is level; otherwise the view has the heights of the depth image.
        background: Photograph of the table without the object, for --mask background.
        shadows: Whether the object may cast shadows, which --mask background then tells from it.
        box: Left, top, width and height of a box round the object, for --mask grabcut.
        hull: Take the convex hull of the outline in the photograph, as the paper does.
        friction: Friction coefficient between object and table, for a predictor that is conditioned on it and for --compare.
        tool_friction: Friction coefficient between object and blade, likewise.
        density: Density of the object [kg/m^3], likewise.
        insertion: How far the blade goes under the object [m], likewise.
        arc_radius: Radius of the arc on which it lifts [m], likewise.
        sweep: Angle of that arc [rad], likewise.
        speed: Times as fast as usual, likewise.
        compare: Simulate the same lever-up and show truth and error beside the prediction.
        animation: Write an animation as well.
        out: Folder for trajectory.json, trajectory.csv, prediction.png and prediction.gif.
    """
    from dataclasses import replace

    from foretrace.actions import Stroke
    from foretrace.cli.futures import outlook_of, radius_of, say_futures
    from foretrace.interactions.record import Physics
    from foretrace.perception.photo import PhotoConfig, open_photo
    from foretrace.pictures.animation import scene_animation
    from foretrace.pictures.scene import Scene, scene_figure
    from foretrace.predictor import load_predictor
    from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up

    predictor = load_predictor(run)
    seen = None
    if photo is not None:
        if any(value is not None for value in (polygon, image, scale, mesh, edge, contact)):
            raise PredictionError(
                "--photo shows the object: leave out the other ways, and --edge and --contact"
            )
        if contact_px is None:
            raise PredictionError("--photo needs --contact-px COLUMN ROW, a pixel on the object's upper rim")
        seen = open_photo(
            photo,
            contact_px,
            camera=camera,
            markers=markers,
            depth=depth,
            background=background,
            config=PhotoConfig(mask, box, height, hull, shadows, flat),
        )
        obj, action, view, com = seen.placed.object, seen.action, seen.view, seen.com
    else:
        of_photo = {"camera": camera, "markers": markers, "contact-px": contact_px}
        of_photo |= {
            "mask": mask,
            "depth": depth,
            "no-flat": not flat or None,
            "background": background,
            "no-shadows": not shadows or None,
            "box": box,
            "hull": hull or None,
        }
        if idle := [f"--{option}" for option, value in of_photo.items() if value is not None]:
            raise PredictionError(f"{', '.join(idle)} goes with --photo: give one, or leave it out")
        obj, action, view, com = _object_and_action(
            polygon, image, scale, mesh, height, edge, fraction, contact
        )
    constants = {"friction": friction, "tool_friction": tool_friction, "density": density}
    parameters = {"insertion": insertion, "arc_radius": arc_radius, "sweep": sweep, "speed": speed}
    told = _told_values(constants | parameters, predictor.context, compare)
    imagined = predictor.imagine(view, context={name: told[name] for name in predictor.context}, com=com)
    paths = {predictor.display_name: imagined.com_trajectory}
    physics = Physics(**{name: told[name] for name in constants if name in told})
    stroke = Stroke(**{name: told[name] for name in parameters if name in told})
    simulation = SimulationConfig(physics=physics, path=stroke.path())
    truth = simulate_lever_up(obj, action, simulation) if compare else None
    if truth is not None and len(truth.effect.times) > 0:
        title = f"Predicted and simulated lever-up: {truth.effect.outcome}"
        scene = replace(Scene.observed(truth, paths), title=title)
    else:
        scene = Scene.imagined(obj, action, imagined.times, paths)
    scene = replace(scene, outlook=outlook_of(imagined))
    say_futures(imagined)
    out.mkdir(parents=True, exist_ok=True)
    _write_trajectory(out, run, obj, action, imagined, truth)
    scene_figure(scene).savefig(out / "prediction.png")
    if seen is not None:
        seen.save_overlay(out / "overlay.png", imagined.com_trajectory, radius_of(imagined))
    if animation:
        scene_animation(scene, out / "prediction.gif")
    if truth is not None:
        _print_comparison(imagined.com_trajectory, truth)
    print("\n".join(str(file) for file in sorted(out.iterdir())))


def _told_values(given: dict[str, float | None], knows: tuple[str, ...], simulated: bool) -> dict[str, float]:
    """The constants and parameters that the command line names.

    Raises:
        PredictionError: One that the predictor is conditioned on is missing, is not above 0, or is of no use.
    """
    told = {name: value for name, value in given.items() if value is not None}
    for name, value in given.items():
        option = f"--{name.replace('_', '-')}"
        if value is None and name in knows:
            raise PredictionError(f"the predictor is conditioned on {name}: give {option}")
        if value is not None and not 0 < value < float("inf"):
            raise PredictionError(f"{option} is {value}: give a number above 0")
        if value is not None and name not in knows and not simulated:
            raise PredictionError(f"the predictor is not conditioned on {name}: leave {option} out, or --compare")
    return told


def _object_and_action(
    polygon: Path | None,
    image: Path | None,
    scale: float | None,
    mesh: Path | None,
    height: float | None,
    edge: int | None,
    fraction: float,
    contact: tuple[float, float] | None,
) -> "tuple[ObjectModel, LeverUp, TopDownView, np.ndarray | None]":
    """Object, action, view, and the centre of mass in the action frame where the geometry tells it."""
    import numpy as np

    from foretrace.actions import LeverUp
    from foretrace.geometry import transform_points
    from foretrace.interactions.topdown import TopDownView
    from foretrace.objects import MeshObject, Prism
    from foretrace.objects.shape_files import read_polygon, read_silhouette_image

    given = [name for name, value in (("polygon", polygon), ("image", image), ("mesh", mesh)) if value]
    if len(given) != 1:
        raise PredictionError(
            f"{' and '.join('--' + name for name in given) or 'no object'} given: give exactly one of "
            "--polygon, --image, --mesh"
        )
    if (edge is None) == (contact is None):
        raise PredictionError("give either --edge (with --fraction) or --contact X Y")
    if scale is not None and polygon is not None:
        raise PredictionError("--scale goes with --image and --mesh: write a polygon's corners in metres")
    if height is not None and mesh is not None:
        raise PredictionError("--height goes with --polygon and --image: a mesh has its own")
    height, mask = 0.02 if height is None else height, None
    if polygon is not None:
        obj: ObjectModel = Prism(read_polygon(polygon), height)
    elif mesh is not None:
        obj = MeshObject.load(mesh, 1.0 if scale is None else scale)
    else:
        if scale is None:
            raise PredictionError("--image needs --scale, the metres per pixel")
        assert image is not None
        mask = read_silhouette_image(image)
        obj = Prism.from_mask(mask, scale, height)
    if contact is not None:
        action = LeverUp.nearest(obj, contact)
        gap = float(np.linalg.norm(action.contact - contact))
        if gap > LARGEST_SNAP:
            raise ActionError(
                f"contact {contact} lies {gap:.3f} m from the outline: choose a point within {LARGEST_SNAP} m of it"
            )
    else:
        assert edge is not None
        action = LeverUp.at_edge(obj, edge, fraction)
    if mask is not None and scale is not None:
        view = TopDownView.from_mask(mask, scale, action.contact, action.direction, height)
        return obj, action, view, None
    com = transform_points(action.T_action_object, obj.mass_properties(1.0).com[None])[0]
    return obj, action, TopDownView.of(obj, action), com


def _write_trajectory(out: Path, run: Path | None, obj: Any, action: Any, imagined: Any, truth: Any) -> None:
    import json

    import numpy as np
    import pandas as pd

    from foretrace.cli.futures import futures_content

    content = {
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
    (out / "trajectory.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    table = np.column_stack([imagined.times, imagined.com_trajectory])
    pd.DataFrame(table, columns=["time_s", "x_m", "y_m", "z_m"]).to_csv(out / "trajectory.csv", index=False)


def _print_comparison(imagined: "np.ndarray", truth: Any) -> None:
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
