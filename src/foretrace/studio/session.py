"""One visitor's session: what follows from the choices. It knows no browser, and is tested without one."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import shapely

from foretrace.actions import Action, LeverUp
from foretrace.errors import ForetraceError, StudioError
from foretrace.geometry import Numbers, finite_array, transform_points
from foretrace.imagined import IMAGINERS, Belief, ImaginedEffect, Imaginer, conformal_scores
from foretrace.imagined.belief import EXECUTION
from foretrace.interactions.record import ExecutionOffset, Interaction, Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.monitoring import identify
from foretrace.objects import Prism
from foretrace.planning import Plan, PlanConfig, RimCost, plan
from foretrace.planning.candidates import Rim, place
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.studio.choices import LARGEST_TURN, PHYSICS, Choices
from foretrace.studio.watching import SURPRISE, Watched, watch, watch_again
from foretrace.twin import TwinConfig, TwinImaginer

LEVEL = 0.9
"""Probability with which a motion stays in the region that is drawn."""
TWIN = TwinConfig(worlds=8, workers=1)
"""A few worlds in this process: a visitor waits for it, and others do meanwhile."""
WORLDS = 128
"""Worlds of a belief that a monitor compares an execution with."""
LEVER_UPS = 3
"""Lever-ups from which constants are learned."""
NEAREST = 1e-3
"""Points nearer to the contact than this say no direction [m]."""
LOOK_AROUND = PlanConfig(refine=0, check=0)
"""What colours the rim: the first stage of a plan alone."""


@dataclass(frozen=True)
class Simulated:
    """What MuJoCo made of a lever-up."""

    interaction: Interaction
    """The interaction."""
    held: bool | None
    """Whether the region held the motion; None: the region is not known."""
    drawn: dict[str, float]
    """Constants that were unknown, and what they were drawn as [SI]."""


@lru_cache(maxsize=1)
def learned() -> Imaginer:
    """The predictor that comes with foretrace; all visitors share it."""
    return IMAGINERS.find("learned")(None)


class Session:
    """What one visitor sees.

    Args:
        choices: What is chosen at first.
        seed: Decides which worlds are drawn for what is unknown.
    """

    def __init__(self, choices: Choices | None = None, seed: int = 0) -> None:
        self.choices = Choices() if choices is None else choices
        """What is chosen."""
        self.simulations: list[bool] = []
        """Of the simulations with the present choices, whether the region held the motion."""
        self.simulated: Simulated | None = None
        """The last of them."""
        self.watched: Watched | None = None
        """The last execution that was watched; or None, if one was simulated after it."""
        self.plan: Plan | None = None
        """The last plan for this object and goal."""
        self._rng = np.random.default_rng(seed)
        self._known: dict[str, Any] = {}

    # --- choosing ------------------------------------------------------------------------------------------

    def change(self, **changes: Any) -> None:
        """Choose other values; what followed from the former ones is forgotten.

        Raises:
            StudioError: A value is out of its range, or there is none of that name.
        """
        before, self.choices = self.choices, self.choices.changed(**changes)
        kept = ("goal", "angle", "heading", "distance")
        if any(getattr(before, name) != getattr(self.choices, name) for name in changes if name not in kept):
            self.simulations, self.simulated, self.watched = [], None, None
            self._known = {name: each for name, each in self._known.items() if name == "rim"}
        if any(name not in ("along", "turn", "imaginer") for name in changes):
            self._known.pop("rim", None)
            self.plan = None

    def move_to(self, point: Numbers) -> None:
        """Bring the contact to the point of the outline that is nearest to another one [m], object frame.

        Raises:
            StudioError: The point is no two finite numbers.
        """
        point = finite_array("the contact (x, y) [m]", point, (2,), StudioError)
        ring = shapely.LinearRing(self.choices.object.corners)
        self.change(along=float(ring.project(shapely.Point(point)) / ring.length))

    def turn_from(self, point: Numbers) -> None:
        """Turn the direction as if the tool came from a point [m], object frame, as far as it may be turned.

        Raises:
            StudioError: The point is no two finite numbers.
        """
        point = finite_array("the point (x, y) [m]", point, (2,), StudioError)
        action = self.action
        way = action.contact - point
        if np.linalg.norm(way) < NEAREST:
            return
        change = np.arctan2(way[1], way[0]) - np.arctan2(action.direction[1], action.direction[0])
        turn = self.choices.turn + (change + np.pi) % (2 * np.pi) - np.pi
        self.change(turn=float(np.clip(turn, -LARGEST_TURN, LARGEST_TURN)))

    def take(self, action: Action) -> None:
        """Choose contact, direction and path of a lever-up on this object."""
        ring = shapely.LinearRing(self.choices.object.corners)
        along = float(ring.project(shapely.Point(action.contact)) / ring.length)
        rim = Rim(self.choices.object.corners)
        normal = rim.normals(rim.off_corners(np.array([along * rim.length])))[0]
        across = normal[0] * action.direction[1] - normal[1] * action.direction[0]
        turn = float(np.clip(np.arctan2(across, normal @ action.direction), -LARGEST_TURN, LARGEST_TURN))
        self.change(along=along, turn=turn, **action.parameters())

    # --- what follows --------------------------------------------------------------------------------------

    @property
    def action(self) -> LeverUp:
        """The lever-up that is chosen, in the object's frame."""
        rim, chosen = Rim(self.choices.object.corners), self.choices
        along = np.array([chosen.along * rim.length])
        found = place(LeverUp, rim, along, np.array([chosen.turn]), [chosen.path]).actions[0]
        assert isinstance(found, LeverUp)
        return found

    @property
    def imagined(self) -> ImaginedEffect:
        """What is imagined of it.

        Raises:
            ForetraceError: The object does not fit into the action's view, or cannot be levered there.
        """
        return self._once("imagined", lambda: self._imagine(self._imaginer()))

    @property
    def twin(self) -> ImaginedEffect:
        """What the twin imagines of it, to be seen beside the other.

        Raises:
            ForetraceError: As of `imagined`.
        """
        return self._once("twin", lambda: self._imagine(self._twin()))

    @property
    def rim(self) -> RimCost:
        """Cost of each contact all around the object, for the goal.

        Raises:
            PlanningError: No contact is free, or the goal is impossible for this object.
        """
        return self._once("rim", lambda: self._plan(LOOK_AROUND).rim)

    def plan_best(self) -> Plan:
        """Plan for the goal, and choose the best lever-up.

        Raises:
            PlanningError: As `foretrace.plan`.
        """
        found = self._plan(PlanConfig())
        self.take(found.action)
        self.plan = found
        self._known["rim"] = found.rim
        return found

    def simulate(self) -> Simulated:
        """Let MuJoCo play the lever-up, the blade alone; what is unknown is drawn from the usual ranges.

        Raises:
            ForetraceError: The lever-up cannot be simulated.
        """
        physics, offset, drawn = self.draw()
        config = SimulationConfig(embodiment="tool", physics=physics)
        interaction = simulate_lever_up(self.choices.object, self.action, config, execution_error=offset)
        held = self._holds(interaction)
        if held is not None:
            self.simulations.append(held)
        self.simulated, self.watched = Simulated(interaction, held, drawn), None
        return self.simulated

    def watch(self, wish: str = SURPRISE) -> Watched:
        """Simulate an execution in which something goes wrong, watched by a monitor with a belief over the physics.

        Args:
            wish: What is to go wrong, one of `foretrace.studio.watching.WISHES`.

        Raises:
            ForetraceError: The lever-up cannot be imagined or simulated, or there is no such fault.
        """
        imagined = self._once("believed", self._believe)
        physics, offset, _ = self.draw()
        self.watched = watch(self.choices.object, self.action, imagined, (physics, offset), wish, self._rng)
        self.simulated = None
        return self.watched

    def replay(self, interaction: Interaction) -> Watched:
        """Take object and lever-up of an interaction, and let a monitor watch what was recorded.

        Raises:
            ForetraceError: It is no lever-up, has no motion, or cannot be imagined.
        """
        if not isinstance(interaction.action, LeverUp):
            raise StudioError("the row is no lever-up with a motion: choose another one")
        self.change(object=interaction.object, along=0.1, turn=0.0)
        self.take(interaction.action)
        self.watched = watch_again(interaction, self._once("believed", self._believe))
        return self.watched

    def learn(
        self, tell: Callable[[dict[str, float], list[Belief]], None] = lambda drawn, beliefs: None
    ) -> tuple[dict[str, float], list[Belief]]:
        """Three lever-ups around the object in one world, simulated, and what each of them tells of its constants.

        Args:
            tell: Is told the world's constants and what is believed so far, before each lever-up.

        Returns:
            The world's constants, all of them drawn, and what is believed after each lever-up.

        Raises:
            ForetraceError: One of the lever-ups cannot be imagined or simulated.
        """
        unknown = Session(self.choices.changed(**dict.fromkeys(PHYSICS), exact=True))
        unknown._rng = self._rng
        physics, _, drawn = unknown.draw()
        config = SimulationConfig(embodiment="tool", physics=physics)
        beliefs: list[Belief] = []
        for number in range(LEVER_UPS):
            tell(drawn, beliefs)
            unknown.change(along=(self.choices.along + number / LEVER_UPS) % 1.0)
            action, obj = unknown.action, self.choices.object
            effect = simulate_lever_up(obj, action, config).effect
            prior = beliefs[-1] if beliefs else Belief()
            beliefs.append(identify(TopDownView.of(obj, action), action, effect, prior, imaginer=learned()))
        return drawn, beliefs

    def draw(self) -> tuple[Physics, ExecutionOffset, dict[str, float]]:
        """Constants and execution error of one world, and those of them that were unknown by name."""
        world = Belief(particles=2, seed=int(self._rng.integers(2**31))).sample(1, self._rng)
        drawn = {name: float(world[name][0]) for name in PHYSICS if getattr(self.choices, name) is None}
        if not self.choices.exact:
            drawn |= {name: float(world[name][0]) for name in EXECUTION}
        known = {name: value for name, value in self.choices.context.items() if name in PHYSICS}
        physics = Physics(**known | {name: value for name, value in drawn.items() if name in PHYSICS})
        offsets = {name.removeprefix("contact_"): value for name, value in drawn.items() if name in EXECUTION}
        return physics, ExecutionOffset(**offsets), drawn

    # ---------------------------------------------------------------------------------------------------------

    def _once(self, name: str, work: Callable[[], Any]) -> Any:
        """What a piece of work gave, or its error, until something else is chosen."""
        if name not in self._known:
            try:
                self._known[name] = work()
            except ForetraceError as error:
                self._known[name] = error
        if isinstance(found := self._known[name], ForetraceError):
            raise found
        return found

    def _imaginer(self) -> Imaginer:
        return learned() if self.choices.imaginer == "learned" else self._twin()

    def _twin(self) -> Imaginer:
        obj = self.choices.object
        return TwinImaginer(config=TWIN, object=None if type(obj) is Prism else obj)

    def _imagine(self, imaginer: Imaginer, belief: Belief | None = None) -> ImaginedEffect:
        action, obj = self.action, self.choices.object
        com = transform_points(action.T_action_object, obj.mass_properties(1.0).com[None])[0]
        view = TopDownView.of(obj, action)
        told = self._told(imaginer) if belief is None else belief
        return imaginer.imagine(view, action, context=told, com=com)

    def _believe(self) -> ImaginedEffect:
        return self._imagine(learned(), Belief(worlds=WORLDS))

    def _told(self, imaginer: Imaginer) -> dict[str, float]:
        return {name: value for name, value in self.choices.context.items() if name in imaginer.context}

    def _plan(self, config: PlanConfig) -> Plan:
        imaginer = learned()
        checker = self._twin() if config.check else None
        told = self._told(imaginer)
        return plan(self.choices.object, self.choices.wanted, imaginer, told, checker=checker, config=config)

    def _holds(self, interaction: Interaction) -> bool | None:
        """Whether the region holds a motion; None: it is not known."""
        imagined, effect = self.imagined, interaction.effect
        count = min(len(imagined.times), len(effect.times))
        futures = imagined.futures
        wide = float(np.ravel(futures.width(LEVEL))[0])
        if count == 0 or not np.isfinite(wide):
            return None
        cut = replace(futures, states=futures.states[:, :, :count], spread=futures.spread[:, :, :count])
        score = conformal_scores(cut, effect.com_trajectory[None, :count], np.array([count]))[0]
        return bool(score <= wide)
