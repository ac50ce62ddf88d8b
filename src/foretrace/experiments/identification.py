"""What lever-ups of an object tell of frictions and centre of mass, and what that is worth for the next ones.

Objects with a centre of mass that is off, in worlds with other frictions, are levered, tracked with noise, and
identified; other lever-ups of the same object are then imagined: told nothing, with what was learned, and told all.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from foretrace.actions import LeverUp
from foretrace.errors import ResultsError, ShapeError, ViewError
from foretrace.evaluation.experiment import Experiment, Row, Trial
from foretrace.experiments import SUMMARIES
from foretrace.experiments.executions import PERIOD, Scene, observed
from foretrace.experiments.identification_report import NAMES, figures, report, summarise
from foretrace.experiments.monitor_calibration import predictor
from foretrace.files import short_hash
from foretrace.geometry import quaternion_to_matrix
from foretrace.imagined import Belief, ObservedMotion
from foretrace.imagined.belief import NOMINAL_BEVEL, RANGES
from foretrace.interactions.record import ExecutionOffset, Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.monitoring import identify
from foretrace.monitoring.identification import first_prior
from foretrace.objects import Prism, Weighted, sample_prism
from foretrace.planning import goals, plan
from foretrace.predictor.loading import default_checkpoint
from foretrace.twin import TwinConfig, TwinImaginer

LEARNED_FROM, TRIED = 3, 3
"""Lever-ups of each object that are learned from, and others that are imagined."""
Choice = Literal["random", "chosen"]
CHOICES: tuple[Choice, ...] = ("random", "chosen")
"""How lever-ups that are learned from are chosen: at random places, or by what they are expected to tell."""
LARGEST_OFFSET = 0.02
"""Largest offset of the centre of mass [m]."""
CM, MM = 100.0, 1000.0


@dataclass(frozen=True)
class IdentificationTrial(Trial):
    """One object in one world."""

    object: int
    """Its number."""
    choice: str
    """How the lever-ups that are learned from are chosen: one of `CHOICES`."""


@dataclass(frozen=True)
class Identification(Experiment):
    """Learn constants from lever-ups of one object, at random places or chosen ones, and imagine others."""

    objects: int = 24
    """Number of objects."""
    seed: int = 911
    """Seed of objects and worlds."""
    exact: bool = False
    """Whether the twin plays the best worlds again."""
    choices: tuple[Choice, ...] = CHOICES
    """How lever-ups are chosen: at random, or by what they are expected to tell."""
    lever_ups: int = LEARNED_FROM
    """Lever-ups that are learned from, from 1 to 3."""

    label = "identification"
    summary = SUMMARIES["identification"]
    trial = IdentificationTrial

    def trials(self) -> Sequence[IdentificationTrial]:
        """One for each object and choice."""
        if self.objects < 1:
            raise ResultsError(f"objects is {self.objects}: give at least 1")
        if not 1 <= self.lever_ups <= LEARNED_FROM:
            raise ResultsError(f"lever_ups is {self.lever_ups}: give a number from 1 to {LEARNED_FROM}")
        return [IdentificationTrial(k, choice) for k in range(self.objects) for choice in self.choices]

    def identity(self) -> dict[str, Any] | None:
        """The predictor, the seed, and what is learned from."""
        config = (default_checkpoint() / "config.json").read_bytes()
        own = {"predictor": short_hash([config]), "seed": self.seed, "lever_ups": self.lever_ups}
        return own | {"exact": True} if self.exact else own

    def run(self, trial: IdentificationTrial, folder: Path) -> Sequence[Row]:
        """Errors of the centre of mass, ranks of the true constants, errors of other lever-ups."""
        rng = np.random.default_rng([self.seed, trial.object])
        case = _draw(rng)
        rows: list[Row] = []
        belief = first_prior(NOMINAL_BEVEL)
        learning = choosing = 0.0
        twin = TwinImaginer(config=TwinConfig(workers=1)) if self.exact else None
        for k in range(self.lever_ups):
            begin = time.process_time()
            action = case.actions[k]
            if trial.choice == "chosen":
                action = case.choose(belief)
            choosing += time.process_time() - begin
            motion = case.observe(action, rng)
            begin = time.process_time()
            view = TopDownView.of(case.prism, action)
            belief = identify(view, action, motion, belief, imaginer=predictor(), exact=twin, seed=k)
            learning += time.process_time() - begin
            rows += _about(belief, case, k + 1)
            rows += _errors(case, {f"after {k + 1}": belief}, rng_of(self.seed, trial.object))
        rows.append({"metric": "seconds", "value": learning / self.lever_ups})
        if trial.choice == "chosen":
            return [*rows, {"metric": "seconds of choosing", "value": choosing / self.lever_ups}]
        return [*rows, *_errors(case, {}, rng_of(self.seed, trial.object))]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """Means with intervals by choice and metric; calibration of ranks; shares of the gain; differences."""
        return summarise(rows)

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """Tables of errors and of calibration."""
        return report(summary, TRIED)

    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Errors of other lever-ups, object by object, and errors by the number of lever-ups."""
        return figures(rows)


@dataclass(frozen=True, eq=False)
class Case:
    """One object in its world."""

    prism: Prism
    """The object as it is seen."""
    object: Weighted
    """The object as it is."""
    physics: Physics
    """Its world."""
    actions: tuple[LeverUp, ...]
    """Lever-ups: those to learn from, then the others."""

    def choose(self, belief: Belief) -> LeverUp:
        """The lever-up that is expected to tell most."""
        found = plan(self.prism, goals.Learn(), predictor(), belief).action
        assert isinstance(found, LeverUp)
        return found

    def observe(self, action: LeverUp, rng: np.random.Generator) -> ObservedMotion:
        """What a tracker sees of a lever-up."""
        poses = self.play(action, rng)
        return observed(poses, PERIOD * np.arange(len(poses)), rng)

    def play(self, action: LeverUp, rng: np.random.Generator) -> np.ndarray:
        """(time, 7) Poses of the object frame in the action frame, with an execution error."""
        offset = ExecutionOffset(
            *(rng.uniform(*RANGES[name]) for name in ("contact_ahead", "contact_left", "contact_turn"))
        )
        poses = Scene(self.object, self.physics, action, offset).play()
        if poses is None:
            raise ResultsError("a simulation blew up: choose another seed")
        return poses


def rng_of(seed: int, number: int) -> np.random.Generator:
    """Random numbers of the other lever-ups: the same ones for whatever imagines them."""
    return np.random.default_rng([seed, number, 1])


def _draw(rng: np.random.Generator) -> Case:
    """An object, its world, and lever-ups of it that fit into a view."""
    while True:
        prism = sample_prism(rng, int(rng.integers(4, 9)))
        angle, far = rng.uniform(0, 2 * np.pi), LARGEST_OFFSET * np.sqrt(rng.random())
        physics = Physics(*(rng.uniform(*RANGES[name]) for name in ("density", "friction", "tool_friction")))
        actions = [
            LeverUp.at_edge(prism, int(rng.integers(len(prism.corners))), rng.uniform(0.25, 0.75))
            for _ in range(LEARNED_FROM + TRIED)
        ]
        try:
            for action in actions:
                TopDownView.of(prism, action)
            loaded = Weighted(prism, far * np.array([np.cos(angle), np.sin(angle)]))
        except (ViewError, ShapeError):
            continue
        return Case(prism, loaded, physics, tuple(actions))


def _about(belief: Belief, case: Case, count: int) -> list[Row]:
    """Error of the centre of mass, spreads, and ranks of the true constants."""
    truth = {name: getattr(case.physics, name) for name in NAMES[:3]}
    truth |= dict(zip(NAMES[3:], case.object.com_offset.tolist(), strict=True))
    off = [belief.mean[name] - truth[name] for name in NAMES[3:]]
    rows: list[Row] = [{"metric": f"com {count}", "value": MM * float(np.linalg.norm(off))}]
    for name in NAMES:
        values = belief.values[:, belief.names.index(name)]
        rank = float(belief.weights[values < truth[name]].sum())
        rows.append({"metric": f"rank {name} {count}", "value": rank})
        rows.append({"metric": f"std {name} {count}", "value": belief.std[name] / belief.prior_std[name]})
    return rows


def _errors(case: Case, beliefs: Mapping[str, Belief], rng: np.random.Generator) -> list[Row]:
    """Mean errors of other lever-ups [cm]: with beliefs, or told nothing and told everything."""
    found: dict[str, list[float]] = {}
    told = {name: getattr(case.physics, name) for name in NAMES[:3]}
    for action in case.actions[LEARNED_FROM:]:
        view = TopDownView.of(case.prism, action)
        poses = case.play(action, rng)
        if beliefs:
            effects = {
                name: predictor().imagine(view, action, context=belief) for name, belief in beliefs.items()
            }
        else:
            own = case.object.mass_properties(case.physics.density).com
            T = action.T_action_object
            effects = {
                "nothing": predictor().imagine(view, action, context="unknown"),
                "told": predictor().imagine(view, action, context=told, com=T[:3, :3] @ own + T[:3, 3]),
            }
        for name, effect in effects.items():
            turns = quaternion_to_matrix(poses[:, 3:]) @ quaternion_to_matrix(poses[0, 3:]).T
            truth = poses[:, :3] + turns @ (effect.com_trajectory[0] - poses[0, :3])
            count = min(len(truth), len(effect.times))
            off = np.linalg.norm(effect.com_trajectory[:count] - truth[:count], axis=1).mean()
            found.setdefault(name, []).append(CM * float(off))
    return [{"metric": f"error {name}", "value": float(np.mean(each))} for name, each in found.items()]
