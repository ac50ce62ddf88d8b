"""Sequences: several actions in a row, by where each is expected to leave the object."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from foretrace.actions import Action
from foretrace.errors import ForetraceError, PlanningError, check_type, fault, is_whole, shown
from foretrace.files import as_path, write_json
from foretrace.geometry import Numbers, finite_array, invert_transform
from foretrace.imagined import IMAGINERS, Belief, ImaginedBatch, Imaginer
from foretrace.imagined.context import Context
from foretrace.imagined.shown import percentage
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel
from foretrace.planning.candidates import Scene
from foretrace.planning.goals import Goal, as_goal, describe
from foretrace.planning.goals.base import LEVERED
from foretrace.planning.lessons import Lesson, taught
from foretrace.planning.motions import Motions
from foretrace.planning.plan import PlanConfig
from foretrace.planning.resting import SURE, com_of, judge_rest
from foretrace.planning.result import Plan
from foretrace.planning.scores import score
from foretrace.planning.search import Search

FORMAT, VERSION = "foretrace-sequence", 1
MOST_STEPS = 20
"""Actions in a row, at most."""
BEAM = 64
"""Beginnings of sequences that are continued by every candidate."""
SAMPLES = 6
"""Samples of each motion that goals look at in a sequence."""
STEP_COST = 0.02
"""A further action has to lower the cost by more than this: 2 mm."""
SIMULATED = PlanConfig(spacing=0.02, directions=1, refine=0)
"""How candidates are searched where each takes a simulation."""


@dataclass(frozen=True, eq=False)
class Sequence:
    """Actions in a row. The goal's frame is the object's frame before the first."""

    plan: Plan
    """The first action, as a plan of its own in the object's frame now; its costs are those of the goal after it."""
    actions: tuple[Action, ...]
    """All actions, each in the object's frame where it is expected to lie before it."""
    frames: Float[np.ndarray, "steps_and_one 4 4"]
    """The object's frame before each action and after the last, as expected, in the goal's frame."""
    cost: float
    """Cost after the last action."""
    reached: float
    """Probability that the last action reaches the goal, if the others end as expected."""
    goal: str
    """The goal, in words."""
    note: str
    """What stands in the way; empty where the goal is reached more probably than not."""

    @property
    def action(self) -> Action:
        """The first action, in the object's frame."""
        return self.actions[0]

    def __repr__(self) -> str:
        note = f", {self.note}" if self.note else ""
        count, label = len(self.actions), self.action.label
        plural = "" if count == 1 else "es" if label.endswith("sh") else "s"
        return (
            f"Sequence({self.goal}: {count} {label}{plural}, cost {self.cost:.3f}, "
            f"reached {self.reached:.3f}{note})"
        )

    def save(self, path: str | Path) -> Path:
        """Write actions and expected frames as JSON; returns the file. The first action's `plan` is a file of its own.

        Raises:
            PlanningError: The path is none.
            OSError: The system refuses to write it.
        """
        file = as_path(path, PlanningError)
        content = {
            "format": FORMAT,
            "format_version": VERSION,
            "goal": self.goal,
            "note": self.note,
            "cost": self.cost,
            "reached": self.reached,
            "actions": [action.to_dict() for action in self.actions],
            "T_start_object": self.frames.tolist(),
        }
        write_json(file, content)
        return file


@runtime_checkable
class World(Protocol):
    """Where actions are carried out: a robot with its camera, or a `SimulatedWorld`."""

    def observe(self) -> ObjectModel | TopDownView:
        """The object as it lies, in its own frame."""
        ...

    def locate(self) -> Float[np.ndarray, "4 4"]:
        """The object's frame in a frame that stays, such as the table's."""
        ...

    def act(self, action: Action, T_table_object: Float[np.ndarray, "4 4"]) -> str:
        """Carry out an action until the object rests; returns the outcome.

        Args:
            action: The action, in the object's frame.
            T_table_object: That frame, in the frame that stays.
        """
        ...


@dataclass(frozen=True, eq=False)
class Execution:
    """What became of a sequence."""

    actions: tuple[Action, ...]
    """The actions that were carried out, each in the object's frame as it was observed or expected before it."""
    outcomes: tuple[str, ...]
    """Their outcomes."""
    frames: Float[np.ndarray, "steps_and_one 4 4"]
    """The object's frame before each and after the last, as observed, in the object's frame at the start."""
    sequences: tuple[Sequence, ...]
    """What was planned: one before each action, or a single one where nothing was planned again."""
    reached: bool
    """Whether the goal is reached."""
    cost: float
    """Cost at the end."""


def plan_sequence(
    seen: ObjectModel | TopDownView,
    goal: Goal | Callable[..., Any],
    steps: int = 5,
    imaginer: Imaginer | None = None,
    context: Context | Belief = None,
    *,
    config: PlanConfig | None = None,
    com: Numbers | None = None,
) -> Sequence:
    """Plan up to ``steps`` actions in a row, so that the goal is reached after the last.

    All candidates around the outline are imagined once: where an action leaves an object depends on how it acts on the
    object, not on where that lies. Sequences of them are composed from the first on, the best `BEAM` of each length are
    continued, and the shortest that reaches the goal is taken. A last action that is also the first is refined.

    Args:
        seen: The object, or a view of it from above, as of `foretrace.plan`.
        goal: What shall be the case after the last action, in the object's frame now.
        steps: Actions, at most.
        imaginer: Imagines actions until the object rests: `SlidingTwin` for pushes, `TwinImaginer` with ``set_down``
            for lever-ups, which is taken by default.
        context: What it is told.
        config: How candidates are searched; nothing is checked by a second imaginer. By default as in `foretrace.plan`,
            without an imaginer at contacts every 2 cm along the normal.
        com: Centre of mass at rest in the object's frame [m]; by default the object's own, or estimated from the view.

    Raises:
        PlanningError: As `foretrace.plan`; or the imaginer does not tell how an object comes to rest, or the goal is
            reached already.
    """
    config = _config(config, imaginer)
    aim, scene = _begin(seen, goal, steps, com)
    own = _resting(imaginer, scene)
    if judge_rest(aim, scene, com_of(scene), np.eye(4)).reached:
        raise PlanningError(f"the goal {describe(aim)} is reached already: give another one")
    return _plan(scene, aim, steps, own, context, config)[0]


def execute_sequence(
    world: World,
    goal: Goal | Callable[..., Any],
    steps: int = 5,
    imaginer: Imaginer | None = None,
    context: Context | Belief = None,
    *,
    config: PlanConfig | None = None,
    replan: bool = True,
) -> Execution:
    """Act, observe and plan again until the goal is reached or ``steps`` actions are carried out.

    Args:
        world: Where actions are carried out.
        goal: As of `plan_sequence`, in the object's frame as it is first observed.
        steps: Actions, at most.
        imaginer: As of `plan_sequence`.
        context: What it is told.
        config: As of `plan_sequence`.
        replan: Plan again after each action, corrected by how far similar earlier actions ended from where they were
            imagined to; otherwise carry out the first sequence as planned, where the object is expected.

    Raises:
        PlanningError: As `plan_sequence`, before the first action; later, a plan that cannot be made ends the
            sequence. Or the world's `locate` returns no frame.
    """
    check_type("world", world, World, PlanningError, "a World: observe, locate, act")
    seen, T_table_start = _observed(world), _located(world)
    config = _config(config, imaginer)
    aim, scene = _begin(seen, goal, steps, None)
    own = _resting(imaginer, scene)
    T_start_table, com = invert_transform(T_table_start), com_of(scene)
    frames, actions, outcomes, sequences = [np.eye(4)], [], [], []
    expected: list[tuple[Action, np.ndarray]] = []
    state = judge_rest(aim, scene, com, np.eye(4))
    known: Search | None = None
    lessons: list[Lesson] = []
    while len(actions) < steps and not state.reached:
        if replan or not sequences:
            try:
                if actions:
                    scene = replace(Scene.of(_observed(world)), T_start_now=frames[-1], com_start=com)
                found, known = _plan(scene, aim, steps - len(actions), own, context, config, known, lessons)
            except ForetraceError:
                if not actions:
                    raise
                break  # it lies where nothing gets there, or on another side
            if actions and found.cost >= state.cost:
                break  # nothing brings it nearer
            sequences.append(found)
            expected = list(zip(found.actions, found.frames, strict=False))
        if not expected:
            break
        action, T_start_expected = expected.pop(0)
        T_start_now = frames[-1] if replan else T_start_expected
        outcomes.append(world.act(action, T_table_start @ T_start_now))
        actions.append(action)
        frames.append(T_start_table @ _located(world))
        if replan:
            # Against what was imagined: what was expected after earlier lessons would count these twice.
            imagined = _first_motion(sequences[-1].plan, scene).resting_frames()[0][0]
            lessons.append(Lesson.of(action, imagined, invert_transform(frames[-2]) @ frames[-1]))
        state = judge_rest(aim, scene, com, frames[-1], outcomes[-1])
    return Execution(
        tuple(actions), tuple(outcomes), np.array(frames), tuple(sequences), state.reached, state.cost
    )


def _observed(world: World) -> ObjectModel | TopDownView:
    seen = world.observe()
    check_type("the world's observe() returned a value", seen, (ObjectModel, TopDownView), PlanningError)
    return seen


def _located(world: World) -> Float[np.ndarray, "4 4"]:
    return finite_array("the frame that the world's locate() returns", world.locate(), (4, 4), PlanningError)


def _begin(seen: Any, goal: Any, steps: int, com: Numbers | None) -> tuple[Goal, Scene]:
    """The goal and the scene, checked."""
    if not is_whole(steps, 1, MOST_STEPS):
        raise fault(PlanningError, isinstance(steps, int))(
            f"steps is {shown(steps)}: give a whole number from 1 to {MOST_STEPS}"
        )
    aim, scene = as_goal(goal), Scene.of(seen)
    aim.check(scene.outline)
    if aim.needs_gain():
        raise PlanningError(
            f"the goal {describe(aim)} is about one action: plan it with ft.plan, ft.identify, and plan again"
        )
    if LEVERED in aim.needed_outcomes():
        raise PlanningError(
            f"the goal {describe(aim)} is about an object that is {LEVERED}, a sequence ends with the object at rest: "
            "give a goal about where it lies, or plan a single action"
        )
    if not aim.tells_reached():
        raise PlanningError(
            f"the goal {describe(aim)} is a function, which does not tell when it is reached: add a goal that does, or "
            "plan a single action"
        )
    if com is not None:
        scene = scene.loaded(finite_array("com (x, y, z) [m]", com, (3,), PlanningError))
    return aim, scene


def _config(config: PlanConfig | None, imaginer: Imaginer | None) -> PlanConfig:
    check_type("config", config, (PlanConfig, type(None)), PlanningError)
    return config or (SIMULATED if imaginer is None else PlanConfig())


def _resting(imaginer: Imaginer | None, scene: Scene) -> Imaginer:
    check_type(
        "imaginer", imaginer, (Imaginer, type(None)), PlanningError, "an imaginer, such as SlidingTwin()"
    )
    found = IMAGINERS.find("twin-to-rest")(scene.object) if imaginer is None else imaginer
    if not found.rests:
        raise PlanningError(
            f"the {found.name} imaginer does not tell how an object comes to rest, which the next action needs: give "
            "SlidingTwin(), or TwinImaginer(config=TwinConfig(set_down=True))"
        )
    return found


def _plan(
    scene: Scene,
    aim: Goal,
    steps: int,
    imaginer: Imaginer,
    context: Context | Belief,
    config: PlanConfig,
    known: Search | None = None,
    lessons: Iterable[Lesson] = (),
) -> tuple[Sequence, Search]:
    """The best sequence from how the object lies now, and its search, which later ones begin with."""
    search = Search(scene, aim, imaginer, None, context, config, known=known, lessons=tuple(lessons))
    around, scores = search.look_around()
    pool, scores = search.refine(around, scores) if config.refine else (around, scores)
    start = np.eye(4) if scene.T_start_now is None else scene.T_start_now
    rows, cost, reached = np.zeros(0, dtype=np.int64), np.inf, 0.0
    if steps > 1 and scores.reached[scores.order()[0]] < SURE:
        rows, cost, reached = _compose(search, start, com_of(scene), steps)
    if len(rows) < 2:
        plan = search.finish(pool, scores)
        actions, cost, reached = (plan.action,), plan.cost, plan.reached
        moved = taught(_first_motion(plan, scene), search.lessons).resting_frames()[0]
    else:
        plan = search.finish(pool, scores, chosen=int(rows[0]))
        actions, moved = tuple(around.actions[k] for k in rows), search.around.resting_frames()[0][rows]
    frames = [start]
    for each in moved:
        frames.append(frames[-1] @ each)
    note = ""
    if reached < SURE:
        several = "one action does" if steps == 1 else f"{steps} actions do"
        nearest = f"this comes nearest, with a probability of {percentage(reached)}"
        note = f"{several} not reach the goal {describe(aim)}: {nearest}"
    return Sequence(plan, actions, np.array(frames), cost, reached, describe(aim), note), search


def _first_motion(plan: Plan, scene: Scene) -> Motions:
    """What is imagined of a plan's action, until the object rests."""
    effect = plan.imagined
    batch = ImaginedBatch(effect.times, effect.com_trajectory[None], None, effect.futures)
    return Motions.of(batch, (plan.action,), scene.outline, scene.height, whole=True)


def _compose(
    search: Search, start: Float[np.ndarray, "4 4"], com: Float[np.ndarray, "3"], steps: int
) -> tuple[Int[np.ndarray, " steps"], float, float]:
    """The shortest sequence of candidates that reaches the goal, or the best one: rows, cost, probability.

    Args:
        search: The search that has imagined the candidates.
        start: The object's frame now in the goal's.
        com: Centre of mass at the very start [m].
        steps: Actions, at most.
    """
    motions, config = search.around.thinned(SAMPLES), search.config
    moved, flat = search.around.resting_frames()
    beginnings: list[tuple[list[int], np.ndarray]] = [([], start)]
    best, chosen, reached = (np.inf, np.inf), [], 0.0
    for _ in range(steps):
        found = [
            score(search.goal, motions.continuing(T, com), config.criterion, config.tail)
            for _, T in beginnings
        ]
        excess, cost, sure = (
            np.concatenate([getattr(each, name) for each in found]) for name in ("excess", "cost", "reached")
        )
        order = np.lexsort((cost, excess))
        first = int(order[0])
        if (excess[first], cost[first]) < (best[0], best[1] - STEP_COST):
            best, reached = (float(excess[first]), float(cost[first])), float(sure[first])
            chosen = [*beginnings[first // len(motions)][0], first % len(motions)]
        if reached >= SURE:
            break
        order = order[flat[order % len(motions)]]  # what lies on another side has to be seen first
        spread = np.linspace(BEAM // 2, max(BEAM // 2, len(order) - 1), BEAM // 2).astype(int)
        kept = (
            order[np.unique(np.minimum([*range(BEAM // 2), *spread], len(order) - 1))]
            if len(order)
            else order
        )
        beginnings = [
            (
                [*beginnings[k // len(motions)][0], k % len(motions)],
                beginnings[k // len(motions)][1] @ moved[k % len(motions)],
            )
            for k in kept.tolist()
        ]
        if not beginnings:
            break
    return np.array(chosen, dtype=np.int64), best[1], reached
