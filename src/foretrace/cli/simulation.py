"""The command that simulates data sets."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, arg

from foretrace.cli.console import print_outcomes, when_interrupted
from foretrace.cli.parsing import adapt
from foretrace.errors import DatasetError, SimulationError, shown
from foretrace.simulation.collect import CollectConfig, collect, trial
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.randomisation import LARGEST_COM_OFFSET, NOTHING, RANDOMISED, RANGES
from foretrace.urls import as_place
from foretrace.workers import on_cluster

ROLLING_TIME = 1.5
"""Time for which solids are observed after the blade has stopped [s]: most have then rolled more than their length."""


@adapt((CollectConfig, ("randomisation", "tool", "trials")), (SimulationConfig, ("watch_time",)))
def simulate(
    out: Path,
    config: Annotated[OmitArgPrefixes[CollectConfig], arg(name="")],
    watch_time: float | None = None,
    randomise: bool = False,
    vary_action: bool = False,
    off_centre: bool = False,
    exact_share: float = 0.0,
    active: int | None = None,
    workers: int | None = None,
    cluster: str | None = None,
) -> None:
    """Simulate lever-ups of many objects into a data set.

    The same command continues an interrupted simulation. The same seed gives the same data, whatever the number of
    workers.

    Args:
        out: Folder or URL of the data set, as s3://BUCKET/NAME.
        config: Content of the data set.
        watch_time: Time for which the object is observed after the blade has stopped [s]; by default 0 for the paper's
            prisms, and 1.5 otherwise, since solids may roll.
        randomise: Draw friction, density, thickness and bevel anew for every lever-up, and offset the blade in place
            and direction. Objects and commanded contacts stay the same.
        vary_action: Draw insertion, arc and speed of the blade anew for every lever-up, or the distance of every push.
        exact_share: Share of the lever-ups whose contact is as commanded, with --randomise.
        active: Active learning: simulate only this many of the lever-ups, a hundred at random, then a diverse
            selection.
        off_centre: Move the centre of mass of half the prisms and boxes away from the middle.
        workers: Number of processes; by default one for each core.
        cluster: Address of a Ray cluster that does the work: HOST:PORT, ray://HOST:PORT, or local:N. All nodes must
            share the folder, or reach the URL.
    """
    if watch_time is None:
        watch_time = 0.0 if config.recipe == "paper" else ROLLING_TIME
    randomisation = RANDOMISED if randomise else NOTHING
    if vary_action:
        action = trial(config, 0)[1]
        if not action.varied or not set(action.varied) <= set(RANGES):
            raise SimulationError(
                f"--vary-action varies lever-ups and pushes, and recipe {shown(config.recipe)} has a {action.label}: "
                "leave it out"
            )
        randomisation = replace(randomisation, **action.varied)
    if exact_share:
        randomisation = replace(randomisation, execution_share=1 - exact_share)
    if off_centre:
        randomisation = replace(randomisation, com_offset=LARGEST_COM_OFFSET)
    simulation = replace(config.simulation, watch_time=watch_time)
    config = replace(config, simulation=simulation, randomisation=randomisation)
    place = as_place(out, DatasetError)
    with (
        when_interrupted(f"what is done stays in {place}, the same command goes on from there"),
        on_cluster(cluster),
    ):
        if active is None:
            counts = collect(config, place, workers)
        else:
            from foretrace.cli.active import collect_actively  # trains predictors

            counts = collect_actively(config, place, active, workers)
    print_outcomes(counts)
    print(f"data set: {place}")
