"""Sequences of pushes and of lever-ups: planned again after each action, or carried out blindly.

Truth is MuJoCo. Pushes are planned by the quasi-static twin, nominal or with constants that are identified from a few
other pushes in that world; friction of the rod, how the object's weight is spread, and its centre of mass are drawn at
random and not told. Lever-ups are planned by the twin that plays them until the object is set down, with nominal
constants; frictions and density of the world are drawn at random and not told.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure

from foretrace.actions import FAILED, PushOutcome, sample_pushes
from foretrace.errors import ResultsError
from foretrace.evaluation.charts import BLUE, GREEN, ORANGE, finish, grid
from foretrace.evaluation.experiment import Experiment, Row, Trial
from foretrace.evaluation.tables import markdown_table
from foretrace.experiments import SUMMARIES
from foretrace.imagined import ImaginedBatch, Imaginer, Scenes
from foretrace.imagined.context import EXACT, Context
from foretrace.interactions.batch import Candidates
from foretrace.interactions.pushes import RecordedPushes
from foretrace.interactions.record import Physics
from foretrace.objects import FOOTINGS, NO_BEVEL, Footed, ObjectModel, Prism, Weighted, sample_prism
from foretrace.objects.solid import sample_box
from foretrace.pictures.style import GREY, INK, new_figure, styled
from foretrace.planning import Execution, PlanConfig, execute_sequence, goals
from foretrace.planning.goals import Goal
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.randomisation import RANDOMISED, Randomisation
from foretrace.simulation.world import SimulatedWorld
from foretrace.twin import TwinConfig, TwinImaginer
from foretrace.twin.sliding import SlidingTwin

TASKS = ("push", "turn", "edge")
"""Push to a pose; turn by a quarter and walk to the table's edge by lever-ups."""
METHODS = {
    "push": ("identified", "nominal", "identified, blind", "nominal, blind"),
    "turn": ("several worlds", "nominal", "nominal, blind"),
    "edge": ("several worlds", "nominal", "nominal, blind"),
}
"""``nominal`` and ``identified``: constants of the twin. ``several worlds``: these are drawn. Blind: planned once."""
WORDS = {
    "push": "Push to a pose within 5 mm and 5 degrees",
    "turn": "Turn by 90 degrees within 10, by lever-ups",
    "edge": "Walk 6 cm to the table's edge by lever-ups",
}
STEPS = {"push": 5, "turn": 12, "edge": 12}
"""Actions, at most."""
STREAM = 83
"""Tells the random numbers of these objects from those of other experiments with the same seed."""
THICKNESS = 0.013
"""Height of pushed objects [m]."""
FRICTION = (0.1, 0.5)
"""Range of the rod's friction coefficient."""
OFF_CENTRE = 0.008
"""Largest distance of the centre of mass from that of the uniform object [m]."""
DISTANCE, ANGLE = (0.03, 0.12), np.deg2rad(45.0)
"""Range of distances, and the largest turn, to the pose that a push shall reach [m, rad]."""
POSITION, TURN = 0.005, np.deg2rad(5.0)
"""Tolerances of that pose [m, rad]."""
QUARTER, QUARTER_OFF = np.pi / 2, np.deg2rad(10.0)
"""Turn and tolerance of the task ``turn`` [rad]."""
EDGE = 0.06
"""Distance of the centre of mass from the table's edge at the start of the task ``edge`` [m]."""
PUSH_SEARCH = PlanConfig(spacing=0.02, refine=3, samples=24, check=0)
LEVER_SEARCH = PlanConfig(spacing=0.02, directions=1, refine=0, check=0)
NOT_TOLD = ("friction", "tool_friction", "density")
"""Constants that are drawn for every object that is levered up, and in the worlds of a twin that is not told them."""
LEVER_TWIN = TwinConfig(
    worlds=8,
    set_down=True,
    outline_noise=0.0,
    ranges=Randomisation(**{name: getattr(RANDOMISED, name) for name in NOT_TOLD}),
    workers=1,
)
PUSHED = SimulationConfig(embodiment="tool", timestep=0.004, sample_period=0.04)
MEDIANS = ("position_mm", "rotation_deg", "seconds")
DRAWS = 2000
"""Bootstrap samples of an interval."""


@dataclass(frozen=True)
class SequenceTrial(Trial):
    """One object in one world."""

    kind: str
    """``push`` or ``lever-up``."""
    number: int
    """Number of the object."""


@dataclass(frozen=True)
class Sequences(Experiment):
    """Reach goals by several pushes or lever-ups, planned again after each or carried out blindly."""

    pushed: int = 100
    """Objects that are pushed. 0: none."""
    levered: int = 60
    """Objects that are levered up. 0: none."""
    few: int = 5
    """Pushes that the twin's constants are identified from."""
    seed: int = 0
    """Decides objects, worlds and goals."""

    label = "sequences"
    summary = SUMMARIES["sequences"]
    trial = SequenceTrial

    def __post_init__(self) -> None:
        for name in ("pushed", "levered"):
            if not 0 <= getattr(self, name) <= 100_000:
                raise ResultsError(f"--{name} is {getattr(self, name)}: give a number from 0 on")
        if not 1 <= self.few <= 1000:
            raise ResultsError(f"--few is {self.few}: give a number from 1 to 1000")

    def trials(self) -> Sequence[SequenceTrial]:
        """Object by object."""
        wanted = [SequenceTrial("push", k) for k in range(self.pushed)]
        return [*wanted, *(SequenceTrial("lever-up", k) for k in range(self.levered))]

    def identity(self) -> dict[str, Any]:
        """What decides the results of an object."""
        return {"seed": self.seed, "few": self.few}

    def run(self, trial: SequenceTrial, folder: Path) -> Sequence[Row]:
        """One row for each task and method."""
        rng = np.random.default_rng([self.seed, STREAM, trial.kind == "push", trial.number])
        return self._push(trial, rng) if trial.kind == "push" else self._lever(trial, rng)

    def _push(self, trial: SequenceTrial, rng: np.random.Generator) -> list[Row]:
        outline = sample_prism(rng, 3 + trial.number % 8).corners
        seen = Prism(outline, THICKNESS, NO_BEVEL)
        angle, far = rng.uniform(0, 2 * np.pi), OFF_CENTRE * np.sqrt(rng.random())
        truth = Footed(
            Weighted(seen, far * np.array([np.cos(angle), np.sin(angle)])),
            FOOTINGS[int(rng.integers(len(FOOTINGS)))],
        )
        config = replace(PUSHED, physics=Physics(tool_friction=float(rng.uniform(*FRICTION))))
        middle, way = seen.mass_properties(1.0).com[:2], rng.uniform(0, 2 * np.pi)
        place = middle + rng.uniform(*DISTANCE) * np.array([np.cos(way), np.sin(way)])
        goal = goals.MoveTo(place, float(rng.uniform(-ANGLE, ANGLE)), POSITION, TURN)
        twins = {"nominal": SlidingTwin(steps=24), "identified": self._identified(truth, config, rng)}
        kept = {name: Remembered(twin) for name, twin in twins.items()}
        return [
            _row(
                "push",
                method,
                SimulatedWorld(truth, config, seen),
                goal,
                kept[method.split(",")[0]],
                PUSH_SEARCH,
            )
            for method in METHODS["push"]
        ]

    def _identified(
        self, truth: ObjectModel, config: SimulationConfig, rng: np.random.Generator
    ) -> SlidingTwin:
        """The twin with constants from a few pushes of this object in this world."""
        played = []
        while len(played) < self.few:
            for push in sample_pushes(truth, rng, self.few):
                found = simulate_lever_up(truth, push, config)
                if found.effect.outcome not in (FAILED, PushOutcome.TIPPED):
                    played.append(found)
        pushes = RecordedPushes.of(played[: self.few])
        return replace(SlidingTwin.identified(pushes, self.seed).of_shape("", "object 0"), steps=24)

    def _lever(self, trial: SequenceTrial, rng: np.random.Generator) -> list[Row]:
        number = trial.number
        obj = sample_box(rng) if number % 2 else sample_prism(rng, 3 + (number // 2) % 8)
        drawn = {name: getattr(RANDOMISED, name) for name in NOT_TOLD}
        physics = Physics(**{name: float(rng.uniform(*limits)) for name, limits in drawn.items()})
        config = SimulationConfig(embodiment="tool", physics=physics)
        side, angle = rng.choice([-1.0, 1.0]), rng.uniform(0, 2 * np.pi)
        outward = np.array([np.cos(angle), np.sin(angle)])
        edge = obj.mass_properties(1.0).com[:2] + EDGE * outward
        wanted = {
            "turn": goals.Turn(float(side * QUARTER), float(QUARTER_OFF)),
            "edge": goals.SlideOff(edge, outward),
        }
        kept = {name: Remembered(TwinImaginer(config=LEVER_TWIN)) for name in ("several worlds", "nominal")}
        return [
            _row(
                task,
                method,
                SimulatedWorld(obj, config),
                goal,
                kept[method.split(",")[0]],
                LEVER_SEARCH,
                {EXACT: 0.0} if method == "several worlds" else None,
            )
            for task, goal in wanted.items()
            for method in METHODS[task]
        ]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """Success of each task and method with its interval, actions, and errors at the end."""
        return summary_of(rows)

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """A table for each task."""
        parts = ["# Sequences of actions"]
        for task, found in summary.items():
            lines = [
                [
                    method,
                    str(numbers["episodes"]),
                    "{mean:.0f} % [{low:.0f}, {high:.0f}]".format(**numbers["success_percent"]),
                    f"{numbers['actions']:.1f}",
                    f"{numbers['position_mm']:.1f} mm, {numbers['rotation_deg']:.1f}°",
                    f"{numbers['seconds']:.1f}",
                ]
                for method, numbers in found.items()
            ]
            head = [
                "Twin",
                "Episodes",
                "Success",
                "Actions",
                "Off at the end, median",
                "Episode, median [s]",
            ]
            parts += [f"## {WORDS[task]}", markdown_table(head, lines)]
        return "\n\n".join(parts) + "\n"

    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Success of each task and method."""
        return draw(summary_of(rows))


class Remembered(Imaginer):
    """Another imaginer, which imagines the same candidates once."""

    marginal, rests = True, True

    def __init__(self, imaginer: Imaginer) -> None:
        self.imaginer, self.context = imaginer, imaginer.context
        self._known: dict[bytes, ImaginedBatch] = {}

    @property
    def sample_times(self) -> Float[np.ndarray, " time"]:
        """Those of the other."""
        return self.imaginer.sample_times

    @property
    def learned_outcomes(self) -> tuple[str, ...]:
        """Those of the other."""
        return self.imaginer.learned_outcomes

    @property
    def nominal(self) -> Mapping[str, float]:
        """Those of the other."""
        return self.imaginer.nominal

    def imagine_scenes(self, scenes: Scenes) -> ImaginedBatch:
        """What is known of these candidates, or what the other imagines."""
        source = scenes.source
        if not isinstance(source, Candidates):
            return self.imaginer.imagine_scenes(scenes)
        arrays = (source.view.mask, source.contacts, source.directions, scenes.context)
        key = b"".join(np.ascontiguousarray(each).tobytes() for each in arrays)
        if key not in self._known:
            self._known[key] = self.imaginer.imagine_scenes(scenes)
        return self._known[key]


def _row(
    task: str,
    method: str,
    world: SimulatedWorld,
    goal: Goal,
    imaginer: Imaginer,
    search: PlanConfig,
    context: Context = None,
) -> Row:
    """What became of one episode."""
    started, aim = perf_counter(), goal if task == "push" else goal + goals.KeepUpright()
    found = execute_sequence(
        world, aim, STEPS[task], imaginer, context, config=search, replan=not method.endswith("blind")
    )
    seconds = perf_counter() - started
    position, rotation = _off(goal, world, found)
    return {
        "task": task,
        "method": method,
        "reached": found.reached,
        "actions": len(found.actions),
        "planned": len(found.sequences[0].actions),
        "position_mm": position,
        "rotation_deg": rotation,
        "seconds": seconds,
        "outcomes": " ".join(outcome.replace(" ", "-") for outcome in found.outcomes) or "none",
    }


def _off(goal: Goal, world: SimulatedWorld, found: Execution) -> tuple[float, float]:
    """How far the object is from what was wanted at the end [mm, degrees]; 0 for what the goal is not about."""
    T = found.frames[-1]
    middle = world.object.shape.mass_properties(1.0).com[:2]
    place, turn = T[:2, :2] @ middle + T[:2, 3], np.arctan2(T[1, 0], T[0, 0])
    if isinstance(goal, goals.SlideOff):
        return 1000 * max(0.0, float((np.array(goal.point) - place) @ np.array(goal.outward))), 0.0
    wanted = goal.angle if isinstance(goal, goals.Turn) else getattr(goal, "turn", 0.0)
    off = abs(float(np.angle(np.exp(1j * (turn - wanted)))))
    far = float(np.linalg.norm(place - np.array(goal.position))) if isinstance(goal, goals.MoveTo) else 0.0
    return 1000 * far, float(np.degrees(off))


def summary_of(rows: pd.DataFrame) -> dict[str, Any]:
    """By task and method, with 95 % bootstrap intervals over objects."""
    summary: dict[str, Any] = {}
    for task in TASKS:
        found = {}
        for method in METHODS[task]:
            mine = rows[(rows["task"] == task) & (rows["method"] == method)] if len(rows) else rows
            if not len(mine):
                continue
            reached = 100.0 * np.asarray(mine["reached"], dtype=bool)
            rng = np.random.default_rng(0)
            means = reached[rng.integers(len(reached), size=(DRAWS, len(reached)))].mean(axis=1)
            low, high = np.percentile(means, [2.5, 97.5])
            found[method] = {
                "episodes": len(mine),
                "success_percent": {"mean": round(float(reached.mean()), 2), "low": round(float(low), 2),
                                    "high": round(float(high), 2)},
                "actions": round(float(np.mean(np.asarray(mine["actions"]))), 3),
                **{name: round(float(np.median(np.asarray(mine[name]))), 3) for name in MEDIANS},
            }  # fmt: skip
        if found:
            summary[task] = found
    return summary


@styled
def draw(summary: Mapping[str, Any]) -> dict[str, Figure]:
    """Success by task and method."""
    if not summary:
        return {}
    colors = {
        "identified": GREEN,
        "several worlds": GREEN,
        "nominal": BLUE,
        "identified, blind": ORANGE,
        "nominal, blind": GREY,
    }
    fig = new_figure(9.0, 3.8)
    axes = np.ravel(fig.subplots(1, len(summary), sharey=True, squeeze=False))
    for ax, (task, found) in zip(axes, summary.items(), strict=True):
        for k, (method, numbers) in enumerate(found.items()):
            success = numbers["success_percent"]
            ax.bar(k, success["mean"], color=colors[method], width=0.7)
            ax.plot([k, k], [success["low"], success["high"]], color=INK, linewidth=1.2)
            ax.text(k, success["high"] + 2, f"{success['mean']:.0f}", ha="center", fontsize=8.5)
        ax.set_xticks(range(len(found)), [name.replace(" ", "\n") for name in found], fontsize=7.5)
        count = next(iter(found.values()))["episodes"]
        grid(ax, title=f"{task}, {count} objects", ylim=(0, 112))
    axes[0].set_ylabel("goal reached [%]")
    finish(fig, "Sequences of actions", "95 % bootstrap intervals over objects; blind: planned once")
    return {"success": fig}
