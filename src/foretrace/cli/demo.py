"""The whole job in a few minutes: simulate, learn, predict, compare."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from foretrace.cli.console import print_report

if TYPE_CHECKING:
    from foretrace.interactions.record import Interaction
    from foretrace.interactions.topdown import TopDownView
    from foretrace.pictures.scene import Scene
    from foretrace.predictor import EffectPredictor

RACKET_SCALE = 0.0005
"""Metres per pixel of the shipped silhouette of a table-tennis racket."""
RACKET_HEIGHT = 0.015
"""Thickness assumed for it [m]."""
HELD_OUT_CORNERS = (4, 6, 9)
"""Corner counts of the new shapes in the picture."""


def demo(
    out: Path = Path("demo"),
    objects: int = 48,
    contacts_per_edge: int = 2,
    epochs: int = 20,
    min_steps: int = 300,
    workers: int | None = None,
    seed: int = 0,
) -> None:
    """Simulate lever-ups, learn from them, and predict new shapes and a real object's silhouette.

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
    from foretrace.pictures.animation import scene_animation
    from foretrace.pictures.contact_sheet import contact_sheet
    from foretrace.pictures.scene import comparison_figure
    from foretrace.predictor import LstmConfig, TrainConfig, load_predictor, train_predictor
    from foretrace.simulation.collect import CollectConfig, collect

    started = time.monotonic()
    # One thread: two on a core that something else uses would be many times slower.
    config = TrainConfig(epochs=epochs, min_steps=min_steps, split=None, seed=seed, threads=1)
    print(f"1. Simulating lever-ups of {objects} objects with a UR10 and a screwdriver")
    counts = collect(CollectConfig(objects, contacts_per_edge, seed), out / "data", workers)
    print("   " + ", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    dataset = Dataset.open(out / "data")
    contact_sheet(dataset).savefig(out / "interactions.png")

    predictors: dict[str, EffectPredictor] = {}
    for label, name in (("none", "no feature"), ("im-cnn", "Im-CNN")):
        print(f"2. Training the LSTM with {name}")
        run = train_predictor(dataset, LstmConfig(features=label), out / "runs" / label, config)
        predictors[name] = load_predictor(run)
        print_report(run_experiment(Predictor(run, out / "data"), console=Console(quiet=True)).report)

    print("3. Predicting shapes and an object that were not in the data, and simulating them")
    shown = {f"New shape, {n} corners": _new_shape(n, seed) for n in HELD_OUT_CORNERS}
    shown["Table-tennis racket"] = _racket()
    scenes = {title: _scene(predictors, title, *interaction) for title, interaction in shown.items()}
    comparison_figure(scenes).savefig(out / "predictions.png")
    scene_animation(scenes["New shape, 6 corners"], out / "prediction.gif")
    print(f"Done in {time.monotonic() - started:.0f} s. Look at:")
    for name, content in (
        ("interactions.png", "some of the simulated lever-ups"),
        ("predictions.png", "predicted beside simulated motion"),
        ("prediction.gif", "one of them as an animation"),
        ("runs/im-cnn", "the trained predictor, for foretrace predict"),
    ):
        print(f"  {out / name}  {content}")


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
    from dataclasses import replace

    from foretrace.pictures.scene import Scene

    paths = {name: predictor.imagine(view).com_trajectory for name, predictor in predictors.items()}
    return replace(Scene.observed(interaction, paths), title=title)
