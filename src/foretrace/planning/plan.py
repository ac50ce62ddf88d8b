"""Choose where, which way and how a tool acts on an object, by what is imagined of the candidates."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float

from foretrace.actions import Action
from foretrace.errors import PlanningError, check_choices, check_ranges, check_type, is_whole, shown
from foretrace.extras import MissingExtraError
from foretrace.geometry import Numbers, finite_array
from foretrace.imagined import IMAGINERS, Belief, Imaginer
from foretrace.imagined.context import Context, first_action, told_of
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel
from foretrace.planning.candidates import Scene
from foretrace.planning.goals import Goal, as_goal, describe
from foretrace.planning.result import Plan, pose_on_table
from foretrace.planning.scores import Criterion
from foretrace.planning.search import Search

Reach = Callable[[Action], str | None]
"""Why the robot cannot carry out an action in the object's frame; None: it can."""


@dataclass(frozen=True)
class PlanConfig:
    """How a planner searches.

    Raises:
        PlanningError: A value is out of its range.
    """

    spacing: float = 0.005
    """Distance of contacts along the outline [m]; larger on an outline that would have more than 120."""
    cone: float | None = None
    """Largest angle of a direction to the inward normal [rad]; by default the action's own: 0.2 for lever-ups, 0.7 for
    pushes."""
    directions: int = 3
    """Directions at each contact, spread evenly over the cone; 1: the normal alone."""
    vary_path: bool | None = None
    """Vary the path's parameters that the imaginer is conditioned on, too; by default of pushes alone."""
    refine: int = 2
    """Rounds in which the best candidates are improved by drawing others around them; 0 leaves this stage out."""
    samples: int = 64
    """Candidates drawn in each round."""
    check: int = 8
    """Number of the best candidates that are checked by a second imaginer, the twin; 0 leaves this stage out."""
    criterion: Criterion = "expected"
    """How futures are weighed: expected, cvar, likeliest."""
    tail: float = 0.2
    """Share of the worst futures that count for cvar."""
    seed: int = 0
    """Decides what is drawn."""

    def __post_init__(self) -> None:
        for name, most in (("directions", 31), ("refine", 100), ("samples", 10_000), ("check", 1000)):
            least = 1 if name in ("directions", "samples") else 0
            if not is_whole(value := getattr(self, name), least, most):
                raise PlanningError(f"{name} is {shown(value)}: give a whole number from {least} to {most}")
        if not is_whole(self.seed, 0, 2**63 - 1):
            raise PlanningError(f"seed is {shown(self.seed)}: give a whole number from 0 to {2**63 - 1}")
        check_type("vary_path", self.vary_path, (bool, type(None)), PlanningError)
        limits = {"spacing": (0.001, 0.1), "tail": (0.001, 1.0)}
        limits |= {} if self.cone is None else {"cone": (0.0, 0.8)}
        check_ranges(PlanningError, "plan", self, limits)
        check_choices(PlanningError, self)


LEARNING = PlanConfig(spacing=0.02, directions=1, refine=0)
"""How candidates are searched where a goal asks what they tell, which takes a fifth of a second for each."""


def plan(
    seen: ObjectModel | TopDownView,
    goal: Goal | Callable[..., Any],
    imaginer: Imaginer | None = None,
    context: Context | Belief = None,
    *,
    checker: Imaginer | None = None,
    config: PlanConfig | None = None,
    com: Numbers | None = None,
    T_table_object: Float[np.ndarray, "4 4"] | None = None,
    reach: Reach | None = None,
) -> Plan:
    """Choose the action whose imagined outcome suits a goal best.

    Three stages: the imaginer looks at contacts all around the outline, and directions within a cone about the
    inward normal, in one batch; the best are refined by drawing others around them (iCEM: Pinneri et al., 2020); the
    best few of these, which differ, are checked by a second imaginer. The result says what each stage changed.

    Args:
        seen: The object, or a view of it from above. In a view, the object's frame is the view's.
        goal: What is to happen: one of `foretrace.planning.goals`, a sum of them, or a function of `Motions` that
            returns costs. Everything in it lies in the object's frame.
        imaginer: Imagines the candidates, and says what kind of action they are; by default the predictor that comes
            with foretrace, of lever-ups. `SlidingTwin` is one of pushes.
        context: What both imaginers are told, as of `Imaginer.imagine`.
        checker: Checks the best candidates; by default the twin, which simulates lever-ups, but not for `Learn`. Where
            simulation is not installed they are not checked, and a warning says so.
        config: How candidates are searched; stages can be left out. By default `PlanConfig`, and `LEARNING` for
            `Learn`.
        com: Centre of mass at rest in the object's frame [m]; by default the object's own, or estimated from the view.
        T_table_object: The object's pose in the table frame, if the plan is for a robot.
        reach: Says why the robot cannot carry out an action, or None.

    Returns:
        The plan: also where nothing reaches the goal, then with a `note`.

    Raises:
        PlanningError: The goal is none, is impossible for this object, or needs what the imaginer does not tell; no
            contact is free, or the robot reaches none of the best; `Learn` has no belief as context.
        PredictionError: The view does not show one object, or the context is of no use to an imaginer.
    """
    check_type("config", config, (PlanConfig, type(None)), PlanningError)
    for name, value in (("imaginer", imaginer), ("checker", checker)):
        check_type(name, value, (Imaginer, type(None)), PlanningError, "an imaginer, such as a predictor")
    if reach is not None and not callable(reach):
        raise PlanningError(f"reach is {shown(reach)}: give a function of an action, or None")
    if T_table_object is not None:
        T_table_object = pose_on_table(T_table_object)
    aim, scene = as_goal(goal), Scene.of(seen)
    aim.check(scene.outline)
    if com is not None:
        scene = scene.loaded(finite_array("com (x, y, z) [m]", com, (3,), PlanningError))
    learns = aim.needs_gain()
    if learns and not isinstance(context, Belief):
        raise PlanningError(
            f"the goal {describe(aim)} is about what a belief does not know yet: give a Belief as context, such as "
            "ft.Belief() or what ft.identify returns"
        )
    config = config or (LEARNING if learns else PlanConfig())
    own = _learned() if imaginer is None else imaginer
    second = checker if config.check else None
    if second is not None and second.action is not own.action:
        raise PlanningError(
            f"the {own.name} imagines a {own.action.label}, the checker {second.name} a {second.action.label}: give "
            "two that imagine the same kind of action"
        )
    if config.check and checker is None and own.action is first_action() and not learns:
        second = _twin(scene.object)
    if context is None and scene.object is not None:
        context = told_of(scene.object, *(each.context for each in (own, second) if each is not None))
    return Search(scene, aim, own, second, context, config, reach).run(T_table_object)


def _twin(obj: ObjectModel | None) -> Imaginer | None:
    """The twin; None, with a warning, where simulation is not installed."""
    try:
        return IMAGINERS.find("twin")(obj)
    except MissingExtraError as missing:
        warnings.warn(f"the best candidates are not checked by the twin: {missing}", stacklevel=3)
        return None


@lru_cache(maxsize=1)
def _learned() -> Imaginer:
    return IMAGINERS.find("learned")(None)
