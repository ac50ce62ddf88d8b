"""Predictions against a stand-in for the real robot (paper, section 5.4; tables 1 and 2, figure 15).

Every lever-up is played several times by the stand-in, each time with other differences from what simulator and
predictor are told, and its observed path is compared with the path that the simulator of the training data gives for
the contact as it was told, and with the imagined path. Paths are compared as in the paper: the mean Euclidean distance
after dynamic time warping. Where the object slips off the blade, both end: afterwards nothing is predicted.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, cast

import numpy as np
import pandas as pd
from jaxtyping import Float
from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from foretrace.errors import PredictionError, ShapeError, SimulationError
from foretrace.experiments.transfer_objects import Played, Subject, play
from foretrace.interactions.record import Interaction, Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.context import true_values
from foretrace.simulation.stand_in import Observation, StandIn, hull_of
from foretrace.trajectories import warped_distance
from foretrace.workers import _ctrl_c_later as ctrl_c_later

CM = 100.0


class Example(NamedTuple):
    """The first repetition at one contact, for pictures."""

    name: str
    """Name of the object."""
    group: str
    """Where it comes from."""
    contact: int
    """Number of the contact, from 1."""
    view: TopDownView
    """What the predictor saw."""
    simulated: Interaction
    """What the simulator made of it."""
    observed: Observation
    """What the stand-in showed, or the camera."""
    imagined: Float[np.ndarray, "time 3"]
    """The imagined path, up to where the observed one ends [m]."""


@dataclass(frozen=True)
class Transfer:
    """All comparisons of one predictor."""

    rows: pd.DataFrame
    """One row per observed lever-up; distances in cm, what was drawn in SI units."""
    examples: list[Example]
    """One for each contact."""


def evaluate_transfer(
    predictor: EffectPredictor,
    subjects: Sequence[Subject],
    stand_in: StandIn | None = None,
    *,
    repeats: int = 10,
    seed: int = 0,
    workers: int = 1,
    console: Console | None = None,
) -> Transfer:
    """Compare what a predictor imagines, and what the simulator gives, with the stand-in.

    Args:
        predictor: Imagines from the stand-in's noisy views.
        subjects: Objects and where they are levered.
        stand_in: What stands in for the real robot; by default `StandIn()`.
        repeats: Lever-ups by the stand-in for each contact.
        seed: Seed of all that is drawn; what is drawn for one contact does not depend on the other ones.
        workers: Processes that simulate.
        console: Where progress is reported; standard error by default.

    Raises:
        PredictionError: The predictor's features cannot be had from a view.
        SimulationError: There is nothing to repeat, pybullet is missing, or a worker was killed.
        ShapeError: Two objects have the same name, or one does not fit in the view.
    """
    stand_in = StandIn() if stand_in is None else stand_in
    check_sees(predictor)
    for name, value, least in (("repeats", repeats, 1), ("workers", workers, 1), ("seed", seed, 0)):
        if value < least:
            raise SimulationError(f"{name} is {value}, it must be at least {least}")
    names = [(subject.group, subject.name) for subject in subjects]
    for group, name in names:
        if names.count((group, name)) > 1:
            raise ShapeError(f"two of the {group} are called {name!r}: give every object its own name")
    contacts = [(subject, k) for subject in subjects for k in range(len(subject.actions))]
    rows: list[dict[str, Any]] = []
    examples: list[Example] = []
    all_played = _play_all(contacts, stand_in, repeats, seed, workers)
    for (subject, contact), played in _reported(contacts, all_played, console or Console(stderr=True)):
        found = compare_played(predictor, subject.name, subject.group, contact + 1, played, subject.hull)
        rows += found[0]
        examples.append(found[1])
    return Transfer(pd.DataFrame(rows), examples)


def check_sees(predictor: EffectPredictor) -> None:
    """Refuse a predictor that cannot do with a view.

    Raises:
        PredictionError: Its features cannot be had from one.
    """
    if predictor.features.oracle:
        raise PredictionError(
            f"features {predictor.features.label!r} are observed during the action and cannot be had from a view: "
            "use a predictor with other features, such as im-cnn"
        )


def compare_played(
    predictor: EffectPredictor, name: str, group: str, contact: int, played: Played, hull: bool = False
) -> tuple[list[dict[str, Any]], Example]:
    """Distances of all that was observed at one contact, as rows; and the first of it.

    Args:
        predictor: The predictor.
        name: Name of the object.
        group: Where it comes from.
        contact: Number of the contact, from 1.
        played: What was simulated and observed there.
        hull: Whether the predictor sees the convex hull of the object's mask.
    """
    exact = played.simulated.view
    own = own_error(predictor, hull_of(exact) if hull else exact, played.simulated)
    rows, examples = [], []
    for repetition, observed in enumerate(played.observed):
        view = hull_of(observed.view) if hull else observed.view
        row, imagined = compare(predictor, view, observed, played.simulated)
        place = {"object": name, "group": group, "contact": contact, "repetition": repetition}
        drawn = {} if observed.perturbation is None else asdict(observed.perturbation)
        rows.append({**place, **row, "distance_simulated_predicted_cm": own, **drawn})
        examples.append(Example(name, group, contact, view, played.simulated, observed, imagined))
    return rows, examples[0]


def compare(
    predictor: EffectPredictor,
    view: TopDownView,
    observed: Observation,
    simulated: Interaction,
    told: Physics | None = None,
) -> tuple[dict[str, Any], Float[np.ndarray, "time 3"]]:
    """Distances of one observed path from the simulated and the imagined one.

    As in the paper, the roll-out starts where the marker is seen before the action. How much of the distance that
    start takes away is told by ``distance_predicted_from_view_cm``, where it is estimated from the view.

    Args:
        predictor: The predictor.
        view: What it sees.
        observed: What the stand-in showed.
        simulated: What the simulator of the training data made of it.
        told: What a predictor that knows physical constants is told of them; by default the stand-in's own.

    Returns:
        The outcomes and distances [cm] as a part of a row; and the imagined path, cut where the observed one ends [m].
    """
    effect, slip = simulated.effect, observed.slip_time
    slipped_at = None if effect.slip_index is None else float(effect.times[effect.slip_index])
    row: dict[str, Any] = {
        "outcome": str(observed.outcome),
        "simulated_outcome": str(effect.outcome),
        "slip_time": np.nan if slip is None else slip,
        "distance_simulated_cm": np.nan,
        "distance_predicted_cm": np.nan,
        "distance_predicted_from_view_cm": np.nan,
        "final_predicted_cm": np.nan,
    }
    if len(observed.com) == 0:
        return row, np.empty((0, 3))
    physics = observed.physics if told is None else told
    known = true_values(physics, predictor.known)
    start = predictor.imagine(view, observed.com[0], known)
    imagined = start.com_trajectory[_before(start.times, slip)]
    blind = predictor.imagine(view, known=known)
    row["distance_predicted_cm"] = distance_until_slip(observed, start.times, start.com_trajectory)
    row["distance_predicted_from_view_cm"] = distance_until_slip(observed, blind.times, blind.com_trajectory)
    row["final_predicted_cm"] = CM * float(np.linalg.norm(imagined[-1] - observed.com[-1]))
    if len(effect.times) > 0:
        row["distance_simulated_cm"] = distance_until_slip(
            observed, effect.times, effect.com_trajectory, slipped_at
        )
    return row, imagined


def own_error(predictor: EffectPredictor, view: TopDownView, simulated: Interaction) -> float:
    """Distance of the imagined path from the simulator's, of which everything is told [cm]; NaN if that diverged.

    What is left of a prediction's error where nothing differs: it has not been learned better.
    """
    effect = simulated.effect
    if len(effect.times) == 0:
        return np.nan
    known = true_values(simulated.physics, predictor.known, simulated.action.parameters())
    imagined = predictor.imagine(view, effect.com_trajectory[0], known).com_trajectory
    end = slice(None) if effect.slip_index is None else slice(max(1, effect.slip_index))
    return CM * warped_distance(effect.com_trajectory[end], imagined[end]).distance


def distance_until_slip(
    observed: Observation,
    times: Float[np.ndarray, " time"],
    com: Float[np.ndarray, "time 3"],
    slip_time: float | None = None,
) -> float:
    """Mean distance of the observed path from another one after dynamic time warping [cm].

    Args:
        observed: What the stand-in showed, up to where the object slips.
        times: Sample times of the other path, from the same beginning [s].
        com: The other path [m].
        slip_time: When the object slips in the other path [s]; both end at the earlier slip.
    """
    ends = [time for time in (observed.slip_time, slip_time) if time is not None]
    end = min(ends) if ends else None
    ours, theirs = observed.com[_before(observed.times, end)], com[_before(times, end)]
    return CM * warped_distance(ours, theirs).distance


def _before(times: Float[np.ndarray, " time"], end: float | None) -> slice:
    """Samples before a time [s], the first one in any case."""
    return slice(None) if end is None else slice(max(1, int(np.searchsorted(times, end))))


def _play_all(
    contacts: Sequence[tuple[Subject, int]], stand_in: StandIn, repeats: int, seed: int, workers: int
) -> Iterator[Played]:
    jobs = (delayed(play)(subject, contact, stand_in, repeats, seed) for subject, contact in contacts)
    with parallel_config("loky", n_jobs=min(workers, max(1, len(contacts))), inner_max_num_threads=1):
        try:
            with ctrl_c_later():
                played = Parallel(return_as="generator", batch_size=1, pre_dispatch="2*n_jobs")(jobs)  # pyright: ignore
            yield from cast(Iterator[Played], played)
        except TerminatedWorkerError as error:
            raise SimulationError(
                f"a worker process was killed, perhaps for want of memory: repeat with fewer than {workers} workers"
            ) from error


def _reported(
    contacts: Sequence[tuple[Subject, int]], all_played: Iterator[Played], console: Console
) -> Iterator[tuple[tuple[Subject, int], Played]]:
    """The contacts with what was played; progress is a bar on a terminal, elsewhere a line for each object."""
    columns = (MofNCompleteColumn(), BarColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=len(contacts))
        for number, (place, played) in enumerate(zip(contacts, all_played, strict=True), 1):
            yield place, played
            subject, contact = place
            bar.update(task, completed=number, description=subject.name)
            if not console.is_terminal and contact == len(subject.actions) - 1:
                console.print(
                    f"{number}/{len(contacts)} contacts: {subject.name}", highlight=False, markup=False
                )
