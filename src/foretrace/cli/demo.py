"""The whole job in a few minutes: simulate, learn, predict, compare."""

import time
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from foretrace.cli.console import print_report

if TYPE_CHECKING:
    from foretrace.actions import LeverUp
    from foretrace.interactions.record import Effect, Interaction
    from foretrace.interactions.topdown import TopDownView
    from foretrace.monitoring import Verdict
    from foretrace.objects import Prism
    from foretrace.pictures.scene import Scene
    from foretrace.predictor import EffectPredictor

RACKET_SCALE = 0.0005
"""Metres per pixel of the shipped silhouette of a table-tennis racket."""
RACKET_HEIGHT = 0.015
"""Thickness assumed for it [m]."""
HELD_OUT_CORNERS = (4, 6, 9)
"""Corner counts of the new shapes in the picture."""
LONGER = 4
"""Passes and steps of the one-shot predictor's training, times those of the others."""
SHORT = 0.008
"""How far the blade is pushed in where an object slips [m]; 0.022 is nominal."""
PAGE = """\
<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>foretrace: demo</title>
<style>
body {{ margin: 2rem auto; max-width: 70rem; padding: 0 1rem; font-family: sans-serif; color: #22262e }}
figure {{ margin: 0 0 3rem }}
h2 {{ font-size: 1rem; margin: 0 }}
figcaption {{ margin-bottom: 0.7rem; max-width: 48rem; line-height: 1.4 }}
figcaption p {{ margin: 0.3rem 0 0 }}
img {{ max-width: 100%; height: auto }}
</style>
<h1>foretrace</h1>
<p>How objects move when a screwdriver levers them up: predicted before the touch, planned, watched, and learned.</p>
{figures}
</html>
"""


def demo(
    out: Path = Path("demo"),
    objects: int = 48,
    contacts_per_edge: int = 2,
    epochs: int = 20,
    min_steps: int = 300,
    workers: int | None = None,
    seed: int = 0,
) -> None:
    """Predict, plan and watch with what comes with foretrace; then simulate lever-ups, learn from them, and compare.

    Ends with one page, index.html, of all pictures.

    Args:
        out: Folder for data, trainings and pictures; the same command goes on where an interrupted one stopped.
        objects: Number of objects to learn from; the paper has 160.
        contacts_per_edge: Lever-ups at each of their edges.
        epochs: Passes over the training part.
        min_steps: Optimiser steps, at least: little data are passed over more often.
        workers: Number of processes that simulate; by default one for each core.
        seed: Seed of everything.
    """
    from rich.console import Console

    from foretrace.evaluation.run import run_experiment
    from foretrace.experiments.predictor import Predictor
    from foretrace.interactions.dataset import Dataset
    from foretrace.pictures.contact_sheet import contact_sheet
    from foretrace.pictures.scene import comparison_figure
    from foretrace.predictor import LstmConfig, OneShotConfig, TrainConfig, load_predictor, train_predictor
    from foretrace.simulation.collect import CollectConfig, collect

    started = time.monotonic()
    collected = CollectConfig(objects, contacts_per_edge, seed)
    # One thread: two on a core that something else uses would be many times slower.
    config = TrainConfig(epochs=epochs, min_steps=min_steps, split=None, seed=seed, threads=1)
    print("1. The predictor that comes with foretrace, and the twin, on shapes that neither has seen")
    shown = {f"New shape, {n} corners": _new_shape(n, seed) for n in HELD_OUT_CORNERS}
    shown["Table-tennis racket"] = _racket()
    out.mkdir(parents=True, exist_ok=True)
    pictures = _show_shipped(out, shown)
    print("2. Plans for two goals")
    pictures += _show_plans(out, seed)
    print("3. An execution that goes wrong")
    pictures += _show_slip(out, seed)
    print(f"4. Simulating lever-ups of {objects} objects with a UR10 and a screwdriver")
    counts = collect(collected, out / "data", workers)
    print("   " + ", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    dataset = Dataset.open(out / "data")
    contact_sheet(dataset).savefig(out / "interactions.png")
    pictures.append(
        Picture(
            "interactions.png",
            "Some of the simulated lever-ups",
            "Each from above. The arrow is the push of the screwdriver, the line the path of the centre of mass. "
            "Support points are the two points on the table about which the object turns.",
        )
    )

    # Its networks are small, and take several times as many steps in the same time.
    longer = replace(
        config,
        epochs=LONGER * epochs,
        min_steps=LONGER * min_steps,
        learning_rate=OneShotConfig.training.learning_rate,
    )
    trainings = {
        "no feature": (LstmConfig(features="none"), config),
        "Im-CNN": (LstmConfig(features="im-cnn"), config),
        "one-shot": (OneShotConfig(), longer),
    }
    predictors: dict[str, EffectPredictor] = {}
    for name, (settings, training) in trainings.items():
        print(f"5. Training on these: {name}")
        label = name.replace("no feature", "none").lower()
        run = train_predictor(dataset, settings, out / "runs" / label, training)
        predictors[name] = load_predictor(run)
        print_report(run_experiment(Predictor(run, out / "data"), console=Console(quiet=True)).report)
    scenes = {title: _scene(predictors, title, *interaction) for title, interaction in shown.items()}
    comparison_figure(scenes).savefig(out / "predictions.png")
    pictures.append(
        Picture(
            "predictions.png",
            "Three predictors that learned from these lever-ups alone",
            "Without a feature a network is not shown the object; Im-CNN sees it from above. Both predict one moment "
            "after the other. One-shot sees it too, and predicts the whole motion at once. Numbers are mean distances "
            "of the predicted centre of mass from the simulated one.",
        )
    )
    page = write_page(out, pictures)
    print(f"Done in {time.monotonic() - started:.0f} s. All pictures are on one page:")
    print(page)


class Picture(NamedTuple):
    """A picture of the page."""

    file: str
    """Its name in the folder."""
    title: str
    """What it shows, in a line."""
    about: str
    """What its words and lines mean."""


def _show_shipped(out: Path, shown: "dict[str, tuple[Interaction, TopDownView]]") -> list[Picture]:
    """The shipped predictor and the twin beside what is simulated."""
    from foretrace.pictures.animation import scene_animation
    from foretrace.pictures.prediction import scene_of
    from foretrace.pictures.scene import comparison_figure
    from foretrace.predictor import load_imaginer
    from foretrace.twin import TwinImaginer

    shipped, twin, scenes = load_imaginer(), TwinImaginer(), {}
    for title, (interaction, view) in shown.items():
        obj, action = interaction.object, interaction.action
        imagined = shipped.imagine(view, action)
        scene = scene_of(obj, action, imagined, "shipped predictor", interaction)  # pyright: ignore[reportArgumentType]
        path = twin.imagine(view, action).until(action.duration).com_trajectory
        scenes[title] = replace(scene, title=title, predictions={**scene.predictions, "twin": path})
    comparison_figure(scenes).savefig(out / "shipped.png")
    scene_animation(scenes["New shape, 6 corners"], out / "prediction.gif")
    return [
        Picture(
            "prediction.gif",
            "Predicted before the touch (orange) and simulated (green)",
            "Lines are paths of the centre of mass, the orange edges the object as predicted. The translucent region "
            "is meant to hold the path with a probability of 90 %.",
        ),
        Picture(
            "shipped.png",
            "Predictor and twin beside the simulation, from above and from the side",
            "The predictor has learned from many lever-ups. The twin has learned nothing: it simulates the lever-up on "
            "the object that is seen. Support points are the two points on the table about which the object turns. "
            "Numbers are mean distances of the predicted centre of mass from the simulated one.",
        ),
    ]


def _show_plans(out: Path, seed: int) -> list[Picture]:
    """Where to lever for two goals."""
    import numpy as np

    from foretrace.imagined.shown import percentage
    from foretrace.objects import sample_prism
    from foretrace.pictures.plan import plan_figure
    from foretrace.planning import goals, plan

    prism = sample_prism(np.random.default_rng([seed, 2]), 6)
    pictures: list[Picture] = []
    for name, goal, what in (
        ("plan-lift.png", goals.Lift(max_slip=0.05), "Where to lever so that it rises as far as possible"),
        ("plan-move.png", goals.Move((1.0, 0.0)), "Where to lever so that it moves to the right"),
    ):
        found = plan(prism, goal)
        plan_figure(found).savefig(out / name)
        print(f"   {found.goal}: reached with a probability of {percentage(found.reached)}")
        about = (
            "Dots are contacts around the rim: the lighter, the lower the cost, and the better the goal is reached. "
            "The arrow is the chosen contact; on the right is what is predicted of it."
        )
        pictures.append(Picture(name, what, about))
    return pictures


def _show_slip(out: Path, seed: int) -> list[Picture]:
    """A monitor watches an object slip that was to be levered: the blade is pushed in less far than commanded."""
    from foretrace.imagined import Belief
    from foretrace.interactions.topdown import TopDownView
    from foretrace.monitoring import Monitor
    from foretrace.pictures.watched import monitor_figure, turning_point
    from foretrace.predictor import load_imaginer

    prism, action, effect = _slip(seed)
    imagined = load_imaginer().imagine(TopDownView.of(prism, action), action, context=Belief())
    monitor = Monitor(imagined)
    verdicts = [
        monitor.update(float(t), pose) for t, pose in zip(effect.times, effect.pose_trajectory, strict=True)
    ]
    title = f"To be levered; {effect.outcome}"
    monitor_figure(imagined, verdicts, effect.com_trajectory, title, "simulated").savefig(out / "monitor.png")
    alarm = next((each for each in verdicts if each.alarm), None)
    sure = turning_point(verdicts)
    print("   not noticed" if sure is None else f"   the monitor knows at {sure.time:.2f} s that it slips")
    title = "Watched by a monitor: an object that was to be levered slips"
    return [Picture("monitor.png", title, _about_slip(effect, sure, alarm))]


def _about_slip(effect: "Effect", sure: "Verdict | None", alarm: "Verdict | None") -> str:
    """What the monitor said of a slip, and what its words mean."""
    assert effect.slip_index is not None
    said = [f"The object leaves the blade at {effect.times[effect.slip_index]:.2f} s."]
    if sure is not None:
        said.append(
            f"At {sure.time:.2f} s (dotted) the monitor knows: a slip is now the most probable outcome."
        )
    if alarm is not None:
        said.append(f"At {alarm.time:.2f} s it raises an alarm.")
    elif sure is not None:
        said.append(
            "It raises no alarm, since a slip was foreseen as possible: alarms are for motions that nothing foreseen "
            "explains. So the score stays below the threshold."
        )
    return " ".join(said) + (
        " Worlds (grey) are the motions predicted with the frictions, density and contact that may be. The score is "
        "the largest deviation so far from the one that fits best, in widths of the band about it: 1 mm, and more "
        "where it is fast. Above the threshold it is an alarm."
    )


def _slip(seed: int) -> "tuple[Prism, LeverUp, Effect]":
    """An object that would be levered; drawn again until it slips where the blade is pushed in less far."""
    import numpy as np

    from foretrace.actions import LeverUp, ToolPath
    from foretrace.interactions.record import Outcome
    from foretrace.objects import sample_prism
    from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up

    rng, simulation = np.random.default_rng([seed, 3]), SimulationConfig(embodiment="tool")
    while True:
        prism = sample_prism(rng, 6)
        action = LeverUp.at_edge(prism, int(rng.integers(6)), 0.5)
        short = replace(action, path=ToolPath(insertion=SHORT))
        effect = simulate_lever_up(prism, short, simulation).effect
        if (
            effect.outcome != Outcome.SLIPPED
            or effect.slip_index is None
            or effect.times[effect.slip_index] < 1.2
        ):
            continue
        if simulate_lever_up(prism, action, simulation).effect.outcome == Outcome.LEVERED:
            return prism, action, effect


def write_page(out: Path, pictures: list[Picture]) -> Path:
    """One page in HTML with all pictures, beside them."""
    from foretrace.files import write_text

    figures = "\n".join(
        f"<figure><figcaption><h2>{escape(each.title)}</h2><p>{escape(each.about)}</p></figcaption>"
        f'<img src="{escape(each.file)}" alt="{escape(each.title)}"></figure>'
        for each in pictures
    )
    write_text(out / "index.html", PAGE.format(figures=figures))
    return out / "index.html"


def _new_shape(num_corners: int, seed: int) -> "tuple[Interaction, TopDownView]":
    """A lever-up of a shape drawn apart from the data set's; drawn again until it does not slip."""
    import numpy as np

    from foretrace.actions import LeverUp
    from foretrace.interactions.record import Outcome
    from foretrace.objects import sample_prism
    from foretrace.simulation.lever_up import simulate_lever_up

    rng = np.random.default_rng([seed, num_corners, 1_000_003])
    while True:
        prism = sample_prism(rng, num_corners)
        action = LeverUp.at_edge(prism, int(rng.integers(num_corners)), float(rng.uniform(0.2, 0.8)))
        interaction = simulate_lever_up(prism, action)
        # The predictors have learned from levered objects only.
        if interaction.effect.outcome == Outcome.LEVERED:
            return interaction, interaction.view


def _racket() -> "tuple[Interaction, TopDownView]":
    """A lever-up of a table-tennis racket at the rim of its blade, seen as a silhouette."""
    from foretrace.actions import LeverUp
    from foretrace.interactions.topdown import TopDownView
    from foretrace.objects import Prism
    from foretrace.objects.shape_files import read_silhouette_image
    from foretrace.simulation.lever_up import simulate_lever_up

    mask = read_silhouette_image(Path(__file__).parents[1] / "assets" / "racket.png")
    racket = Prism.from_mask(mask, RACKET_SCALE, RACKET_HEIGHT)
    action = LeverUp.nearest(racket, (0.06, 0.09))
    view = TopDownView.from_mask(mask, RACKET_SCALE, action.contact, action.direction, RACKET_HEIGHT)
    return simulate_lever_up(racket, action), view


def _scene(
    predictors: "dict[str, EffectPredictor]", title: str, interaction: "Interaction", view: "TopDownView"
) -> "Scene":
    from foretrace.pictures.scene import Scene

    paths = {name: predictor.imagine(view).com_trajectory for name, predictor in predictors.items()}
    return replace(Scene.observed(interaction, paths), title=title)
