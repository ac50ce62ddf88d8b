"""Predictions against a stand-in for the real robot, or against recordings (paper, section 5.4; tables 1 and 2).

Every lever-up is played several times by the stand-in, each time with other differences from what simulator and
predictor are told, and its observed path is compared with the path that the simulator of the training data gives for
the commanded contact, and with the imagined path. Paths are compared as in the paper: the mean Euclidean distance
after dynamic time warping. Where the object slips off the blade, both end: afterwards nothing is predicted.

A recording takes the place of one lever-up of the stand-in: the simulator levers up the same object at the same
contact, with the constants that the data set states; the predictor has the recorded view.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import shapely
from jaxtyping import Float
from matplotlib.figure import Figure
from tyro.conf import Fixed, Positional, Suppress

from foretrace.errors import DatasetError, ForetraceError, PredictionError, ResultsError, ShapeError, shown
from foretrace.evaluation.experiment import Experiment, Row, Trial
from foretrace.experiments import SUMMARIES
from foretrace.experiments.training import weights_of
from foretrace.experiments.transfer_figures import objects_figure, paths_figure
from foretrace.experiments.transfer_objects import (
    GIVEN_HEIGHT,
    GIVEN_SIZE,
    Played,
    Subject,
    everyday_objects,
    play,
    printed_shapes,
    read_prisms,
    read_silhouettes,
)
from foretrace.experiments.transfer_report import PAPER_OBJECTS, RECORDED, report, summarise
from foretrace.imagined.context import true_context
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Interaction
from foretrace.interactions.topdown import TopDownView
from foretrace.predictor import EffectPredictor, load_predictor
from foretrace.predictor.run_folder import fingerprint
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.stand_in import Observation, StandIn, hull_of
from foretrace.trajectories import warped_distance

CM = 100.0
PRINTED_SHOWN = (("pentagon", 1), ("pentagon", 3), ("heptagon", 2), ("heptagon", 6))
ABOUT_STAND_IN = ("repeats", "seed", "silhouettes", "size", "scale", "prisms", "height")
"""Options that go with no recordings."""
DRAWN = {"everyday": "figure-15", "silhouettes": "silhouettes", "prisms": "prisms"}
"""Groups whose masks and errors are drawn, and the name of the picture."""


@dataclass(frozen=True)
class TransferTrial(Trial):
    """All lever-ups at one contact of one object."""

    group: str
    """Where the object comes from."""
    object: str
    """Its name."""
    contact: int
    """Number of the contact, from 1; of a recording, of the levered edge."""


@dataclass(frozen=True)
class Transfer(Experiment):
    """Compare predictions with reality, or with a stand-in for it: the paper's tables 1 and 2, and figure 15.

    Reality is what `foretrace import` recorded. Without it the stand-in is the other physics engine, Bullet, with other
    friction, density and thickness, errors of contact, direction, camera and marker, and another sampling rate, all
    drawn anew every time.
    """

    predictor: Positional[Path | None] = None
    """Folder of the training; by default the predictor that comes with foretrace."""
    recorded: Path | None = None
    """Folder of a recorded data set, which takes the place of the stand-in: all options that follow are about that
    one."""
    repeats: int | None = None
    """Lever-ups by the stand-in at every contact; 10 by default."""
    seed: int | None = None
    """Seed of all that is drawn; 0 by default."""
    silhouettes: Path | None = None
    """Folder of images of more objects, one silhouette each, white on black."""
    size: float | None = None
    """Longer side of each silhouette [m]; 0.18 by default."""
    scale: float | None = None
    """Metres per pixel of all silhouettes, instead of --size."""
    prisms: Path | None = None
    """JSON file of more objects: by name, corners_m and, if they are known, mass_kg and height_m."""
    height: float | None = None
    """Thickness of silhouettes, and of prisms whose file does not give it [m]; 0.02 by default."""
    stand_in: Suppress[Fixed[StandIn | None]] = None
    """What stands in for the real robot, if not the usual one."""
    subjects: Suppress[Fixed[tuple[Subject, ...]]] = ()
    """Objects, if not the paper's."""

    label = "transfer"
    summary = SUMMARIES["transfer"]
    trial = TransferTrial

    def __post_init__(self) -> None:
        given = {each.name: getattr(self, each.name) for each in fields(self)}
        given = {name: value for name, value in given.items() if value is not None}
        idle = [f"--{name}" for name in ABOUT_STAND_IN if name in given]
        if idle and self.recorded is not None:
            raise ResultsError(f"{', '.join(idle)} is about the stand-in: leave it out with --recorded")
        for name, least in (("repeats", 1), ("seed", 0)):
            if given.get(name, least) < least:
                raise ResultsError(f"--{name} is {given[name]}, it must be at least {least}")
        for name in ("size", "scale", "height"):
            if not 0 < given.get(name, 1.0) < float("inf"):
                raise ShapeError(f"--{name} is {given[name]}: give a positive length in metres")

    def trials(self) -> Sequence[TransferTrial]:
        """One for each contact."""
        if self.recorded is not None:
            return sorted(self._recordings, key=lambda trial: (trial.object, trial.contact))
        return [
            TransferTrial(group, name, contact + 1)
            for (group, name), subject in self._subjects.items()
            for contact in range(len(subject.actions))
        ]

    def identity(self) -> dict[str, Any]:
        """The predictor, and the recordings or the stand-in."""
        check_sees(self._predictor)
        about = {"model": weights_of(self.predictor), "features": self._predictor.features.label}
        if self.recorded is not None:
            return about | {"recorded": fingerprint(self._dataset.batch())}
        drawn = {"repeats": self.repeats or 10, "seed": self.seed or 0}
        return about | drawn | {"stand_in": asdict(self._stand_in)}

    def run(self, trial: TransferTrial, folder: Path) -> Sequence[Row]:
        """A row for each lever-up: distances [cm], and what was drawn in SI units; the first one has paths, too."""
        if self.recorded is not None:
            return self._run_recorded(trial)
        subject = self._subjects[trial.group, trial.object]
        played = play(subject, trial.contact - 1, self._stand_in, self.repeats or 10, self.seed or 0)
        return compare_played(self._predictor, played, subject.hull, paths=trial.group == "printed")

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """As from `foretrace.experiments.transfer_report.summarise`."""
        return summarise(rows)

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """The paper's tables 1 and 2 and figure 15b with ours beside them."""
        return report(summary, rows)

    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Paths at some printed or at all recorded edges; masks and errors of the other objects."""
        figures = {}
        if "paths_cm" in rows:
            drawn = rows.loc[rows["paths_cm"].notna()]
            recorded = drawn.loc[drawn["group"].eq(RECORDED)]
            places = pd.MultiIndex.from_frame(drawn[["object", "contact"]])
            shown = drawn.loc[places.isin(PRINTED_SHOWN)]
            if len(recorded):
                note = "The first recording at each edge; the table is grey"
                figures["figure-14"] = paths_figure(recorded, "recorded", note)
            elif len(shown):
                figures["figure-14"] = paths_figure(shown)
        for group, name in DRAWN.items():
            mine = rows.loc[rows["group"].eq(group)]
            places = [(group, name) for name in mine["object"].unique()]
            subjects = [self._subjects[place] for place in places if place in self._subjects]
            if subjects:
                paper = PAPER_OBJECTS if group == "everyday" else {}
                figures[name] = objects_figure(subjects, mine, self._stand_in, paper)
        return figures

    @cached_property
    def _stand_in(self) -> StandIn:
        return self.stand_in or StandIn()

    @cached_property
    def _predictor(self) -> EffectPredictor:
        return load_predictor(self.predictor)

    @cached_property
    def _subjects(self) -> dict[tuple[str, str], Subject]:
        subjects = list(self.subjects) or printed_shapes() + everyday_objects()
        height = GIVEN_HEIGHT if self.height is None else self.height
        if self.silhouettes is not None:
            size = GIVEN_SIZE if self.size is None else self.size
            subjects += read_silhouettes(self.silhouettes, size, self.scale, height)
        if self.prisms is not None:
            subjects += read_prisms(self.prisms, height)
        found = {(str(subject.group), subject.name): subject for subject in subjects}
        if len(found) < len(subjects):
            names = [(subject.group, subject.name) for subject in subjects]
            group, name = next(each for each in names if names.count(each) > 1)
            raise ShapeError(f"two of the {group} are called {shown(name)}: give every object its own name")
        return found

    @cached_property
    def _dataset(self) -> Dataset:
        assert self.recorded is not None
        dataset = Dataset.open(self.recorded)
        if len(dataset) == 0:
            raise DatasetError(f"{self.recorded} has no interaction: import a recording")
        return dataset

    @cached_property
    def _recordings(self) -> dict[TransferTrial, list[Interaction]]:
        """Recordings by object and levered edge; those at one edge of one object count as repetitions."""
        found: dict[TransferTrial, list[Interaction]] = {}
        for interaction, number in zip(
            self._dataset, self._dataset.index["object_id"].to_pylist(), strict=True
        ):
            if interaction.provenance.source != "recorded":
                raise DatasetError(
                    f"interaction {interaction.id} of {self.recorded} is {interaction.provenance.source}: give a data "
                    "set that `foretrace import` made"
                )
            place = TransferTrial(RECORDED, f"object {number}", levered_edge(interaction) + 1)
            found.setdefault(place, []).append(interaction)
        return found

    def _run_recorded(self, trial: TransferTrial) -> list[Row]:
        rows: list[Row] = []
        for repetition, interaction in enumerate(self._recordings[trial]):
            config = SimulationConfig(physics=interaction.physics)
            try:
                simulated = simulate_lever_up(interaction.object, interaction.action, config)
            except ForetraceError as error:
                raise DatasetError(
                    f"interaction {interaction.id} of {self.recorded} cannot be simulated: {error}"
                ) from error
            played = Played(simulated, (observation_of(interaction),))
            found = compare_played(self._predictor, played, paths=repetition == 0)
            rows.append({"interaction": interaction.id, **found[0], "repetition": repetition})
        return rows


def check_sees(predictor: EffectPredictor) -> None:
    """Refuse a predictor for which a view is not enough.

    Raises:
        PredictionError: Its features cannot be had from one.
    """
    if predictor.features.oracle:
        raise PredictionError(
            f"features {shown(predictor.features.label)} are observed during the action and cannot be had from a view: "
            "use a predictor with other features, such as im-cnn"
        )


def compare_played(
    predictor: EffectPredictor, played: Played, hull: bool = False, paths: bool = False
) -> list[dict[str, Any]]:
    """Distances of all that was observed at one contact, as rows; the first one may get the paths, as text."""
    exact = played.simulated.view
    own = own_error(predictor, hull_of(exact) if hull else exact, played.simulated)
    rows = []
    for repetition, observed in enumerate(played.observed):
        view = hull_of(observed.view) if hull else observed.view
        row, imagined = compare(predictor, view, observed, played.simulated)
        drawn = {} if observed.perturbation is None else asdict(observed.perturbation)
        rows.append({"repetition": repetition, **row, "distance_simulated_predicted_cm": own, **drawn})
        if paths and repetition == 0 and len(observed.com):
            rows[-1]["paths_cm"] = paths_as_text(played.simulated, observed, imagined)
    return rows


def paths_as_text(
    simulated: Interaction, observed: Observation, imagined: Float[np.ndarray, "time 3"]
) -> str:
    """Observed, predicted and simulated paths [cm] up to the first slip, as JSON."""
    effect, end = simulated.effect, simulated.effect.slip_index
    if observed.slip_time is not None:
        slip = int(np.searchsorted(effect.times, observed.slip_time))
        end = slip if end is None else min(end, slip)
    found = {"observed": observed.com, "predicted": imagined, "simulated": effect.com_trajectory[:end]}
    return json.dumps({name: np.round(CM * path, 4).tolist() for name, path in found.items()})


def compare(
    predictor: EffectPredictor,
    view: TopDownView,
    observed: Observation,
    simulated: Interaction,
) -> tuple[dict[str, Any], Float[np.ndarray, "time 3"]]:
    """Distances of one observed path from the simulated and the imagined one.

    As in the paper, the roll-out starts where the marker is seen before the action. How much of the distance that
    start takes away is told by ``distance_predicted_from_view_cm``, where it is estimated from the view.

    Returns:
        Outcomes and distances [cm], a part of a row; and the imagined path [m], cut where the observed one ends.
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
    context = true_context(observed.physics, predictor.context)
    start = predictor.imagine(view, context=context, com=observed.com[0])
    imagined = start.com_trajectory[_before(start.times, slip)]
    blind = predictor.imagine(view, context=context)
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
    context = true_context(simulated.physics, predictor.context, simulated.action.parameters())
    imagined = predictor.imagine(view, context=context, com=effect.com_trajectory[0]).com_trajectory
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
