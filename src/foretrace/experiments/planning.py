"""How well plans choose: the planner beside rules, and beside an oracle that may simulate every candidate.

Every object is seen once from above, on a pixel grid that lies at random; contacts all around its fitted outline, along
the inward normal, are the candidates of all methods. Truths: ``nominal`` is MuJoCo with the whole arm and nominal
constants; ``other`` is Bullet, with frictions and density drawn at random for each object, of which no method is told.
There, ``identified`` has seen one lever-up of the object, at a contact drawn at random, as a tracker sees it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure

from foretrace.actions import FAILED, Action, LeverUp, ToolPath
from foretrace.errors import ForetraceError, ResultsError
from foretrace.evaluation.experiment import Experiment, Row, Trial, chosen
from foretrace.experiments import SUMMARIES
from foretrace.experiments.executions import observed
from foretrace.experiments.planning_report import GOALS, METHODS, draw, report_of, summary_of
from foretrace.experiments.planning_rules import ClosedForm, choose_by_rule
from foretrace.experiments.transfer_objects import Subject, read_silhouettes
from foretrace.files import short_hash
from foretrace.imagined import Belief, Futures, ImaginedBatch, Imaginer, estimate_com
from foretrace.imagined.belief import NOMINAL_BEVEL
from foretrace.imagined.observed import rotations_since_rest
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.record import Interaction, Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.monitoring import identify
from foretrace.objects import ObjectModel, sample_prism
from foretrace.objects.solid import sample_box
from foretrace.planning import Motions, PlanConfig, goals, plan
from foretrace.planning.candidates import LOOK_AHEAD, Rim, Scene, find_free, place
from foretrace.planning.goals import Goal
from foretrace.predictor import load_predictor
from foretrace.predictor.loading import MODEL, default_checkpoint
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.randomisation import RANDOMISED
from foretrace.simulation.recipes import ROUND
from foretrace.twin import TwinConfig, TwinImaginer

if TYPE_CHECKING:
    from foretrace.predictor.base import EffectPredictor

SILHOUETTE = "silhouette"
FAMILIES = ("polygon", "outline", "box", SILHOUETTE)
"""The paper's prisms; round, organic and dented outlines; boxes; silhouettes of real objects."""
WORLDS = ("nominal", "other")
LEAST_FREE = 12
"""An object with fewer free contacts is drawn anew."""
STREAM = 71
"""Tells the random numbers of these objects from those of data sets with the same seed."""
BELIEVED = Belief(NOMINAL_BEVEL, worlds=8)
"""What is believed of frictions and density before the first lever-up, and the draws that a plan averages over."""
DISTANCE = 0.03
"""How far away the place of goal ``move-to`` is [m]."""


@dataclass(frozen=True)
class PlanningTrial(Trial):
    """One object."""

    family: str
    """One of FAMILIES."""
    number: int
    """Number of the object within its family."""


@dataclass(frozen=True)
class Planning(Experiment):
    """Choose contacts of unseen objects for five goals: planner, rules and oracle."""

    objects: int = 20
    """Objects of each family. 0: nothing is run, results that are there are drawn again."""
    families: tuple[str, ...] = ()
    """Which families; by default all."""
    silhouettes: Path | None = None
    """Folder of pictures of silhouettes, which are a further family; without one, it is left out."""
    worlds: tuple[str, ...] = WORLDS
    """Which truths."""
    contacts: int = 40
    """Contacts around an outline."""
    baseline: Path | None = None
    """Folder of a training of im-cnn with an LSTM (`--state pose`), with which the planner is run, too."""
    seed: int = 0
    """Decides objects, views, goals and physics."""

    label = "planning"
    summary = SUMMARIES["planning"]
    trial = PlanningTrial

    def __post_init__(self) -> None:
        if not 0 <= self.objects <= 100_000:
            raise ResultsError(f"--objects is {self.objects}: give a number from 0 on")
        if not 3 <= self.contacts <= 120:
            raise ResultsError(f"--contacts is {self.contacts}: give a number from 3 to 120")
        chosen("world", self.worlds, WORLDS)

    def trials(self) -> Sequence[PlanningTrial]:
        """Object by object, the families in turn."""
        if self.silhouettes is not None:
            _ = self._subjects  # refuses pictures that show no objects before anything runs
        elif SILHOUETTE in self.families:
            raise ResultsError(
                f"the family {SILHOUETTE} needs pictures: give their folder with --silhouettes"
            )
        some = FAMILIES if self.silhouettes is not None else FAMILIES[:-1]
        families = chosen("family", self.families, some)
        if self.baseline is not None:
            if self._im_cnn.label != "lstm":
                raise ResultsError(f"{self.baseline} is a training of {self._im_cnn.label}: give one of lstm")
            if self._im_cnn.state != "pose":
                raise ResultsError(f"{self.baseline} predicts positions alone: train it with --state pose")
        return [PlanningTrial(family, number) for number in range(self.objects) for family in families]

    def identity(self) -> dict[str, Any] | None:
        """What decides the results of an object."""
        if not self.objects:
            return None
        identity = {
            "seed": self.seed,
            "contacts": self.contacts,
            "worlds": list(self.worlds),
            "predictor": short_hash([(default_checkpoint() / MODEL).read_bytes()]),
        }
        if self.baseline is not None:
            identity["baseline"] = short_hash([(self.baseline / MODEL).read_bytes()])
        return identity

    def run(self, trial: PlanningTrial, folder: Path) -> Sequence[Row]:
        """Cost, success and slip of each method's choice, by goal and world."""
        rng = np.random.default_rng([self.seed, STREAM, FAMILIES.index(trial.family), trial.number])
        case = self._draw(trial, rng)
        rows: list[Row] = []
        for world in self.worlds:
            truth, seen = case.truths(world), {} if world == "nominal" else {"context": "unknown"}
            for name, goal in case.goals.items():
                costs = goal.cost(truth)[:, 0]
                reached, slipped = goal.reached(truth)[:, 0], truth.is_outcome("slipped")[:, 0]
                for method, (row, seconds) in self._choices(case, goal, costs, world, seen).items():
                    mean = row is None  # a contact drawn at random: its expectation
                    values = (
                        (costs, reached, slipped)
                        if mean
                        else (each[row] for each in (costs, reached, slipped))
                    )
                    cost, success, slip = (float(np.mean(value)) for value in values)
                    rows.append(
                        {
                            "goal": name,
                            "world": world,
                            "method": method,
                            "cost": cost,
                            "reached": success,
                            "slipped": slip,
                            "seconds": seconds,
                        }
                    )
        return rows

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By world and method: share of the gap closed, successes, slips, with intervals over objects."""
        return summary_of(rows)

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """Tables of them."""
        return report_of(summary, rows)

    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Share of the gap that is closed, method by method."""
        return draw(rows)

    def _choices(
        self,
        case: "Case",
        goal: Goal,
        costs: Float[np.ndarray, " n"],
        world: str,
        seen: Mapping[str, Any],
    ) -> dict[str, tuple[int | None, float]]:
        """Row of each method's contact, and the seconds that a plan took."""
        found: dict[str, tuple[int | None, float]] = {
            "random": (None, 0.0),
            "oracle": (int(costs.argmin()), 0.0),
        }
        outline, com, contacts = case.scene.outline, case.com, case.contacts
        for rule in ("longest edge", "far"):
            found[rule] = (choose_by_rule(rule, contacts, outline, com), 0.0)
        whole = PlanConfig(self._spacing(case), directions=1, refine=0, check=0)
        check, few = replace(whole, check=8), replace(whole, check=4)
        plans: dict[str, tuple[Imaginer, Imaginer | None, PlanConfig, Mapping[str, Any]]] = {
            "closed form": (self._rule, None, whole, {}),
            "without uncertainty": (self._learned, None, replace(whole, criterion="likeliest"), seen),
            "learned": (self._learned, None, whole, seen),
            "learned, checked": (self._learned, self._twin, check, seen),
            "twin": (case.remembered(self._twin), None, whole, {}),
        }
        if world != "nominal":
            learned = {"context": case.identified(self._learned)}
            plans |= {
                "learned, checked": (self._learned, self._unsure_twin, few, seen),
                "identified": (self._learned, None, whole, learned),
                "identified, checked": (self._learned, self._twin, few, learned),
            }
        if self.baseline is not None:
            plans["im-cnn"] = (self._im_cnn, None, whole, {})
        for method, (imaginer, checker, config, told) in plans.items():
            wanted = without_outcomes(goal) if method == "im-cnn" else goal
            started = perf_counter()
            made = plan(case.scene.view, wanted, imaginer, config=config, checker=checker, **told)
            seconds = perf_counter() - started
            apart = np.linalg.norm(contacts - made.action.contact, axis=1)
            found[method] = (int(apart.argmin()), seconds)
        return {method: found[method] for method in METHODS if method in found}

    def _spacing(self, case: "Case") -> float:
        return float(np.clip(Rim(case.scene.outline).length / self.contacts, 0.001, 0.1))

    def _draw(self, trial: PlanningTrial, rng: np.random.Generator) -> "Case":
        """An object with enough free contacts, and everything about it that is drawn."""
        for _ in range(100):
            if trial.family == "polygon":
                obj: ObjectModel = sample_prism(rng, 3 + trial.number % 8)
            elif trial.family == "box":
                obj = sample_box(rng)
            elif trial.family == SILHOUETTE:
                obj = self._subjects[trial.number % len(self._subjects)].obj
            else:
                obj = list(ROUND.values())[trial.number % len(ROUND)](rng)
            angle, physics = rng.uniform(0, 2 * np.pi), _draw_physics(rng)
            way = np.array([np.cos(angle), np.sin(angle)])
            middle = (obj.corners.min(axis=0) + obj.corners.max(axis=0)) / 2
            camera = LeverUp(middle - LOOK_AHEAD * way, way)
            try:
                scene = Scene.of(TopDownView.of(obj, camera))
            except ForetraceError:
                continue
            rim = Rim(scene.outline)
            along = (np.arange(self.contacts) + 0.5) * rim.length / self.contacts
            pool = place(LeverUp, rim, along, np.zeros(self.contacts), [ToolPath()] * self.contacts)
            pool = pool[np.flatnonzero(find_free(scene, pool)[0])]
            if len(pool) >= LEAST_FREE:
                return Case(obj, camera, scene, pool.actions, physics, int(rng.integers(1 << 32)))
        raise ResultsError(
            f"no {trial.family} with {LEAST_FREE} free contacts was drawn: give more --contacts"
        )

    @cached_property
    def _subjects(self) -> list[Subject]:
        assert self.silhouettes is not None
        return read_silhouettes(self.silhouettes)

    @cached_property
    def _learned(self) -> Imaginer:
        return load_predictor()

    @cached_property
    def _im_cnn(self) -> "EffectPredictor":
        predictor = load_predictor(self.baseline)
        predictor.learned_from = ("levered",)  # it tells no outcomes: whatever it imagines stays on the blade
        return predictor

    @cached_property
    def _twin(self) -> TwinImaginer:
        return TwinImaginer(config=TwinConfig(workers=1))

    @cached_property
    def _unsure_twin(self) -> TwinImaginer:
        return TwinImaginer(config=TwinConfig(worlds=4, workers=1))

    @cached_property
    def _rule(self) -> Imaginer:
        return ClosedForm()


def _draw_physics(rng: np.random.Generator) -> Physics:
    ranges = {name: getattr(RANDOMISED, name) for name in ("friction", "tool_friction", "density")}
    return Physics(**{name: float(rng.uniform(*limits)) for name, limits in ranges.items()})


def without_outcomes(goal: Goal) -> Goal:
    """The same goal for an imaginer of motions alone: slips have no limit, and a tumble is what looks like one."""
    if isinstance(goal, goals.TurnOver):
        return goals.Own(goal.cost)
    return replace(goal, max_slip=None) if isinstance(goal, (goals.Lift, goals.Tilt)) else goal


@dataclass(eq=False)
class Case:
    """One object, its candidates in the view's frame, and what becomes of them."""

    obj: ObjectModel
    camera: LeverUp
    scene: Scene
    actions: tuple[Action, ...]
    physics: Physics
    """Constants of the other world."""
    seed: int
    """Decides which lever-up is learned from, and how it is tracked."""

    @cached_property
    def contacts(self) -> Float[np.ndarray, "n 2"]:
        """Contacts in the view's frame [m]."""
        return np.array([action.contact for action in self.actions])

    @cached_property
    def com(self) -> Float[np.ndarray, "2"]:
        """Centre of mass as the view tells it [m]."""
        return estimate_com(InteractionBatch.from_views([self.scene.view]))[0, :2]

    @cached_property
    def goals(self) -> dict[str, Goal]:
        """What is wanted, in the view's frame, whose directions mean nothing to the object."""
        position = self.com + np.array([0.0, DISTANCE])
        made = (
            goals.Lift(),
            goals.Tilt(0.5),
            goals.Move((1.0, 0.0)),
            goals.MoveTo(tuple(position.tolist())),
            goals.TurnOver(direction=(0.0, -1.0)),
        )
        return dict(zip(GOALS, made, strict=True))

    def truths(self, world: str) -> Motions:
        """What becomes of each candidate: a single future, which happened."""
        if world == "nominal":
            played = [simulate_lever_up(self.obj, each, SimulationConfig()) for each in self.placed]
        else:
            played = self.elsewhere
        return _as_motions(played, self.actions, self.scene)

    @cached_property
    def placed(self) -> list[LeverUp]:
        """The candidates in the object frame."""
        turn, shift = self.camera.T_action_object[:2, :2], self.camera.contact
        return [
            replace(LeverUp.nearest(self.obj, each.contact @ turn + shift), direction=each.direction @ turn)
            for each in self.actions
        ]

    @cached_property
    def elsewhere(self) -> list[Interaction]:
        """What becomes of the candidates in the other world."""
        config = SimulationConfig(engine="bullet", embodiment="tool", physics=self.physics)
        return [simulate_lever_up(self.obj, each, config) for each in self.placed]

    def identified(self, imaginer: Imaginer) -> Belief:
        """What one lever-up in the other world, at a contact drawn at random, tells of its constants."""
        if not hasattr(self, "_identified"):
            rng = np.random.default_rng(self.seed)
            k = rng.choice([k for k, each in enumerate(self.elsewhere) if each.effect.outcome != FAILED])
            action, effect = self.placed[k], self.elsewhere[k].effect
            motion = observed(effect.pose_trajectory, effect.times, rng)
            view = TopDownView.of(self.obj, action)
            self._identified = identify(view, action, motion, BELIEVED, imaginer=imaginer)
        return self._identified

    def remembered(self, twin: TwinImaginer) -> Imaginer:
        """The twin, which simulates these candidates once for all goals."""
        if not hasattr(self, "_remembered"):
            self._remembered = Remembered(twin, self)
        return self._remembered


class Remembered(Imaginer):
    """What another imaginer imagines of the candidates of a case, once."""

    context = TwinImaginer.context
    marginal = True

    def __init__(self, imaginer: TwinImaginer, case: Case) -> None:
        self.imaginer = imaginer
        self._batch = imaginer.imagine_candidates(case.scene.view, case.actions)

    @property
    def sample_times(self) -> Float[np.ndarray, " time"]:
        """Those of the other."""
        return self.imaginer.sample_times

    def imagine_scenes(self, scenes: Any) -> ImaginedBatch:
        """The rows in their order, or a single one, by where it acts."""
        if len(scenes) == len(self._batch):
            return self._batch
        return self.imaginer.imagine_scenes(scenes)


def _as_motions(played: Sequence[Interaction], actions: Sequence[Action], scene: Scene) -> Motions:
    """Simulated effects as futures that are certain; one that diverged stays where it was, and has failed."""
    times = max((each.effect.times for each in played), key=len)
    com, turned = np.zeros((len(played), len(times), 3)), np.zeros((len(played), len(times), 3))
    outcomes = [str(each.effect.outcome) for each in played]
    for row, each in enumerate(played):
        if outcomes[row] == FAILED:
            continue
        count = len(each.effect.times)
        com[row, :count], turned[row, :count] = (
            each.effect.com_trajectory,
            rotations_since_rest(each.effect.pose_trajectory),
        )
        com[row, count:], turned[row, count:] = com[row, count - 1], turned[row, count - 1]
    names = (*LeverUp.outcomes, FAILED)
    point = Futures.point(com, turned, "levered")
    batch = ImaginedBatch(times, com, None, point)
    motions = Motions.of(batch, actions, scene.outline, scene.height)
    return Certain(**vars(motions), happened=np.array([names.index(name) for name in outcomes]), names=names)


@dataclass(frozen=True, eq=False, kw_only=True)
class Certain(Motions):
    """Motions that happened, with the outcome of each."""

    happened: np.ndarray
    """Number of each one's outcome."""
    names: tuple[str, ...]
    """The outcomes."""

    def is_outcome(self, *names: str) -> np.ndarray:
        """Whether the outcome was one of these: (batch, 1) bool."""
        return np.isin(np.array(self.names)[self.happened], names)[:, None]
