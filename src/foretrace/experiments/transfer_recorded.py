"""Predictions against recorded lever-ups: the paper's tables 1 and 2 of whatever was filmed (section 5.4).

Every recording takes the place of one lever-up of the stand-in. The simulator levers up the same object at the same
contact, with the constants that the data set states; the predictor sees the recorded view.
"""

from collections import Counter

import numpy as np
import pandas as pd
import shapely

from foretrace.errors import DatasetError, ForetraceError
from foretrace.experiments.transfer import Transfer, check_sees, compare_played
from foretrace.experiments.transfer_objects import Played
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Interaction
from foretrace.predictor.base import EffectPredictor
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.stand_in import Observation


def evaluate_recorded(predictor: EffectPredictor, dataset: Dataset) -> Transfer:
    """Compare what a predictor imagines, and what the simulator gives, with what was recorded.

    Args:
        predictor: Imagines from the recorded views.
        dataset: Recorded interactions. Contacts are numbered by the object's edges, and what was recorded at one edge
            of one object counts as repetitions.

    Raises:
        PredictionError: The predictor's features cannot be had from a view.
        DatasetError: There is nothing to compare, something was not recorded, or the simulator cannot repeat it.
    """
    check_sees(predictor)
    if len(dataset) == 0:
        raise DatasetError(f"{dataset.path} has no interaction: import a recording")
    repetitions: Counter[tuple[str, int]] = Counter()
    rows, examples = [], []
    for interaction, number in zip(dataset, dataset.index["object_id"].to_pylist(), strict=True):
        if interaction.provenance.source != "recorded":
            raise DatasetError(
                f"interaction {interaction.id} of {dataset.path} is {interaction.provenance.source}: give a data set "
                "that `foretrace import` made"
            )
        name, edge = f"object {number}", levered_edge(interaction) + 1
        config = SimulationConfig(physics=interaction.physics)
        try:
            simulated = simulate_lever_up(interaction.object, interaction.action, config)
        except ForetraceError as error:
            raise DatasetError(
                f"interaction {interaction.id} of {dataset.path} cannot be simulated: {error}"
            ) from error
        played = Played(simulated, (observation_of(interaction),))
        found, example = compare_played(predictor, name, "recorded", edge, played)
        rows.append({"interaction": interaction.id, **found[0], "repetition": repetitions[name, edge]})
        if repetitions[name, edge] == 0:
            examples.append(example)
        repetitions[name, edge] += 1
    order = sorted(range(len(examples)), key=lambda k: (examples[k].name, examples[k].contact))
    return Transfer(pd.DataFrame(rows), [examples[k] for k in order])


def observation_of(interaction: Interaction) -> Observation:
    """A recorded interaction as what was seen of it, up to where the object slips."""
    effect = interaction.effect
    slip = effect.slip_index
    return Observation(
        view=interaction.view,
        times=effect.times[:slip],
        com=effect.com_trajectory[:slip],
        slip_time=None if slip is None else float(effect.times[slip]),
        outcome=effect.outcome,
        perturbation=None,
        physics=interaction.physics,
    )


def levered_edge(interaction: Interaction) -> int:
    """The edge that the contact lies on: edge k runs from corner k to corner k + 1."""
    corners = interaction.object.corners
    edges = shapely.linestrings(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))
    return int(shapely.distance(edges, shapely.Point(interaction.action.contact)).argmin())
