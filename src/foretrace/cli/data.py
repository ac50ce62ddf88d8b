"""Commands about data sets: simulate, doctor, show, describe."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from foretrace.cli.console import say
from foretrace.errors import DatasetError

ROLLING_TIME = 1.5
"""How long solids are watched after the blade has stopped [s]: most have rolled more than their length by then."""


def simulate(
    out: Path,
    objects: int = 160,
    contacts_per_edge: int = 2,
    engine: str = "mujoco",
    embodiment: Literal["arm", "tool"] = "arm",
    camera: Literal["exact", "rgbd"] = "exact",
    seed: int = 0,
    workers: int | None = None,
    recipe: Literal["paper", "solids", "mixed", "everyday"] = "paper",
    watch_time: float | None = None,
    table_edge: float | None = None,
    randomise: bool = False,
    vary_action: bool = False,
) -> None:
    """Simulate lever-ups of many objects into a data set.

    The same command goes on where an interrupted one stopped. The same seed gives the same data, however many
    workers there are.

    Args:
        out: Folder of the data set.
        objects: Number of objects; prisms are spread evenly over 3 to 10 corners.
        contacts_per_edge: Lever-ups at each edge of each object; round outlines have as many as four edges.
        engine: Physics engine.
        embodiment: The whole robot, or the blade alone on the same path (faster).
        camera: How the view from above is made: from geometry, or from a rendered depth image.
        seed: Seed of objects, contact points and simulations.
        workers: Processes; by default one for each core.
        recipe: Which objects. paper: prisms. solids: lying cylinders, boxes and flat prisms, always three with one
            outline. mixed: prisms and solids. everyday: the same with prisms of many sizes, and flat objects with
            round, organic and dented outlines.
        watch_time: Seconds to go on watching after the blade has stopped; by default 0 for the paper's prisms,
            and 1.5 otherwise, since solids may roll.
        table_edge: Distance of the table's edge ahead of the contact point, in metres: objects can fall off. By
            default no edge is within reach.
        randomise: Draw friction, density, thickness and bevel anew for every lever-up, and let the blade err in
            place and direction. Objects, contact points and what is told of them stay the same.
        vary_action: Draw how deep the blade goes, on what arc it lifts and how fast anew for every lever-up.
    """
    from dataclasses import replace

    from foretrace.interactions.record import Physics
    from foretrace.simulation.collect import CollectConfig, collect
    from foretrace.simulation.lever_up import SimulationConfig
    from foretrace.simulation.randomisation import NOTHING, RANDOMISED, VARIED_ACTION

    if watch_time is None:
        watch_time = 0.0 if recipe == "paper" else ROLLING_TIME
    simulation = SimulationConfig(
        engine=engine,
        embodiment=embodiment,
        camera=camera,
        watch_time=watch_time,
        physics=Physics(table_edge=table_edge),
    )
    randomisation = RANDOMISED if randomise else NOTHING
    if vary_action:
        randomisation = replace(randomisation, **VARIED_ACTION)
    config = CollectConfig(objects, contacts_per_edge, seed, simulation, recipe, randomisation)
    try:
        counts = collect(config, out, workers)
    except KeyboardInterrupt:
        say(f"interrupted; what is done stays in {out}, the same command goes on from there")
        raise
    _print_outcomes(counts)
    print(f"data set: {out}")


def doctor(path: Positional[Path], repair: bool = False, upgrade: bool = False) -> int:
    """Check a data set: checksums, schema, numbers, ids. The exit status is 1 if something is left to mend.

    Args:
        path: Folder of the data set.
        repair: Remove leftovers, set corrupt shards aside (`foretrace simulate` makes them again), and enter
            whole shards that miss their checksum.
        upgrade: Bring a data set of format version 1 to today's format first, in place.
    """
    from foretrace.interactions.doctor import examine
    from foretrace.interactions.upgrade import upgrade as upgrade_in_place

    if upgrade:
        print(f"{path}: {upgrade_in_place(path) or 'no'} interactions upgraded")
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
    from foretrace.interactions.dataset import Dataset
    from foretrace.pictures.animation import interaction_animation
    from foretrace.pictures.scene import contact_sheet, interaction_figure

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


def describe(path: Positional[Path], out: Path | None = None) -> None:
    """Describe a data set: outcomes, how far objects were lifted, and what they stood on.

    Args:
        path: Folder of the data set.
        out: JSON file to write the figures to.
    """
    import json

    from foretrace.interactions.dataset import Dataset
    from foretrace.interactions.description import describe_dataset

    figures = describe_dataset(Dataset.open(path))
    _print_outcomes(figures["outcomes"])
    if len(kinds := figures["outcomes_by_kind"]) > 1:
        for kind, counts in kinds.items():
            print(f"{kind:>10}: " + ", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    for name, (low, high) in figures["varies"].items():
        print(f"{name.replace('_', ' '):>42} {low:10.4g} to {high:.4g}")
    for name, value in figures.items():
        if not isinstance(value, dict) and name != "interactions":
            print(f"{name.replace('_', ' '):>42} {value:10.4g}")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(figures, indent=2) + "\n")


def _print_outcomes(counts: dict[str, int]) -> None:
    total = sum(counts.values())
    for outcome, count in counts.items():
        print(f"{outcome:>10} {count:7d} {100 * count / total:6.1f} %")
    print(f"{'total':>10} {total:7d}")
