"""The stages of a plan: candidates on the whole outline, refinement of the best, check of the best few."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from foretrace.actions import Action
from foretrace.errors import PlanningError
from foretrace.imagined import Belief, ImaginedBatch, ImaginedEffect, Imaginer
from foretrace.imagined.context import Context
from foretrace.planning.candidates import Candidates, Rim, Scene, find_free, place
from foretrace.planning.goals import Goal, describe
from foretrace.planning.lessons import Lesson, taught
from foretrace.planning.motions import Motions
from foretrace.planning.reasons import TIE, UNREACHED, note, reasons, why_lost, worth
from foretrace.planning.result import Alternative, Plan, RimCost, Stage
from foretrace.planning.scores import Scores, check_outcomes, score

if TYPE_CHECKING:
    from foretrace.planning.plan import PlanConfig

MOST_CONTACTS = 120
"""Contacts around an outline, at most."""
PATHS = 2
"""Paths drawn at random at each contact beside the nominal one, where the path may vary."""
MODES = 6
"""Places of the outline around which candidates are drawn."""
APART = 0.006
"""Contacts nearer than this along the outline are the same place [m]."""
CROWDED = 0.02
"""The same where candidates were drawn around the best, which would otherwise all be checked at one place [m]."""
DIFFERENT = 0.015
"""An alternative is further than this from the contacts of better ones [m]."""
ALTERNATIVES = 5
"""Alternatives, at most."""
WIDTH = 0.004
"""Standard deviation of contacts that are drawn in the first round [m]; each further round halves it."""
TURN_SHARE = 0.5
"""The same of directions, as a share of the cone, and of a path's parameters, as a share of their ranges / 2."""
TRUST = 0.75
"""Weight of the checker's costs and probabilities beside the imaginer's own."""
ERROR = 0.004
"""Contacts within this distance are where the blade may arrive instead [m]."""
TRIED = 64
"""Candidates that a robot's reach is asked about, at most."""


@dataclass
class Search:
    """One search, and what it has found so far."""

    scene: Scene
    goal: Goal
    imaginer: Imaginer
    checker: Imaginer | None
    context: Context | Belief
    config: "PlanConfig"
    reach: Callable[[Action], str | None] | None = None
    known: "Search | None" = None
    """A search for the same object, which has imagined the candidates around the outline."""
    lessons: Sequence[Lesson] = ()
    """What earlier actions on the object have shown."""
    rim: Rim = field(init=False)
    rim_cost: RimCost = field(init=False)
    imagined: Motions = field(init=False)
    """Motions of the candidates around the outline, as imagined."""
    around: Motions = field(init=False)
    """The same after the lessons."""
    lost: Counter[str] = field(default_factory=Counter, init=False)
    stages: list[Stage] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self.rim = Rim(self.scene.outline)
        self.rng = np.random.default_rng(self.config.seed)
        self.kind = kind = self.imaginer.action
        self.cone = kind.cone if self.config.cone is None else self.config.cone
        if self.checker is not None and self.checker.name == self.imaginer.name:
            self.checker = None  # it would say the same
        self.varied = tuple(name for name in kind.varied if name in self.imaginer.context)
        vary = self.config.vary_path
        self.vary = kind.path_matters and len(self.varied) > 0 if vary is None else vary
        if self.vary and not self.varied:
            raise PlanningError(
                f"the {self.imaginer.name} imaginer is conditioned on no parameter of the path: leave vary_path out"
            )

    def run(self, T_table_object: Float[np.ndarray, "4 4"] | None) -> Plan:
        """All stages.

        Raises:
            PlanningError: No contact is free, or the robot reaches none of the best.
        """
        pool, scores = self.look_around()
        if self.config.refine:
            pool, scores = self.refine(pool, scores)
        return self.finish(pool, scores, T_table_object)

    def finish(
        self,
        pool: Candidates,
        scores: Scores,
        T_table_object: Float[np.ndarray, "4 4"] | None = None,
        chosen: int | None = None,
    ) -> Plan:
        """The plan from what was found: the best of the pool once it is checked, or a row that is chosen already.

        Raises:
            PlanningError: The robot reaches none of the best.
        """
        rim = self.rim_cost
        rows = self._shortlist(pool, scores) if chosen is None else np.array([chosen])
        if self.checker is not None:
            scores, imagined, rows = self._check(pool, scores, rows)
        else:
            imagined = self._imagine(self.imaginer, pool[rows[:1]])[0]
        best = int(rows[0])
        one = scores[[best]]
        return Plan(
            action=pool.actions[best],
            imagined=imagined,
            cost=float(one.cost[0]),
            risk=float(one.risk[0]),
            chances=dict(zip(one.names, one.chances[0].tolist(), strict=True)),
            reached=float(one.reached[0]),
            goal=describe(self.goal),
            note=note(self.goal, one, scores),
            alternatives=self._alternatives(pool, scores, rows, chosen is not None),
            lost=reasons(scores, best, self.lost),
            rim=rim,
            stages=tuple(self.stages),
            outline=self.scene.outline,
            height=self.scene.height,
            object=self.scene.object,
            T_table_object=T_table_object,
            worth=worth(self.goal, float(one.cost[0]), self.config.criterion),
        )

    def look_around(self) -> tuple[Candidates, Scores]:
        """Candidates on the whole outline.

        Raises:
            PlanningError: No contact is free.
        """
        config, started = self.config, perf_counter()
        number = int(np.clip(round(self.rim.length / config.spacing), 3, MOST_CONTACTS))
        along = (np.arange(number) + 0.5) * self.rim.length / number
        turns = np.linspace(-1, 1, config.directions) * self.cone if config.directions > 1 else np.zeros(1)
        along, turn = (each.ravel() for each in np.meshgrid(along, turns, indexing="ij"))
        paths = [self.kind.nominal().path] * len(along)
        if self.vary:
            paths += self._draw_paths(np.full((PATHS * len(along), len(self.varied)), 0.5), 1.0)
            along, turn = np.tile(along, 1 + PATHS), np.tile(turn, 1 + PATHS)
        pool = self._free(place(self.kind, self.rim, along, turn, paths))
        if not len(pool):
            why = ", ".join(f"at {count} {reason}" for reason, count in self.lost.items())
            raise PlanningError(
                f"no contact of the object is free ({why}): move it by hand, or give a smaller cone or another view"
            )
        same = self.known is not None and self.known.scene.object is self.scene.object is not None
        self.imagined = self.known.imagined if self.known and same else self.motions(self.imaginer, pool)
        self.around = taught(self.imagined, self.lessons)
        scores = self._score(self.around)
        self.rim_cost = self._rim_cost(pool, scores)
        self._tell("imagined", pool, scores, started, None)
        return pool, scores

    def refine(self, pool: Candidates, scores: Scores) -> tuple[Candidates, Scores]:
        """Draw candidates around the best, in rounds; whatever was found stays in the pool."""
        config, started = self.config, perf_counter()
        for round in range(config.refine):
            width = 0.5**round
            rows = self._distinct(pool, self._order(pool, scores), MODES)
            parents = rows[self.rng.integers(len(rows), size=config.samples)]
            along = pool.along[parents] + WIDTH * width * self.rng.normal(size=config.samples)
            spread = TURN_SHARE * self.cone * width * self.rng.normal(size=config.samples)
            turn = np.clip(pool.turn[parents] + spread, -self.cone, self.cone)
            paths = [pool.actions[k].path for k in parents]
            if self.vary:
                shares = np.array([self._shares(pool.actions[k]) for k in parents])
                paths = self._draw_paths(shares, TURN_SHARE * width)
            drawn = self._free(place(self.kind, self.rim, along, turn, paths), count=False)
            if len(drawn):
                scores = scores.joined(self._score(taught(self.motions(self.imaginer, drawn), self.lessons)))
                pool = pool.joined(drawn)
        self._tell("refined", pool, scores, started, self.stages[-1].cost)
        return pool, scores

    def _check(
        self, pool: Candidates, scores: Scores, rows: Int[np.ndarray, " k"]
    ) -> tuple[Scores, ImaginedEffect, Int[np.ndarray, " k"]]:
        """Scores with the checked ones blended in, what is imagined of the best, and the checked rows, best first."""
        assert self.checker is not None
        started, chosen = perf_counter(), pool[rows]
        batch = self._imagine(self.checker, chosen)
        own = self._score(self._motions(self.checker, batch, chosen))
        blended = scores[rows].blended(own, TRUST)
        order = self._order(chosen, blended)
        names = ("cost", "reached", "chances")
        merged = {name: getattr(scores, name).copy() for name in names}
        for name in names:
            merged[name][rows] = getattr(blended, name)
        self._tell("checked", chosen, blended, started, float(blended.cost[0]), order)
        return replace(scores, **merged), batch[int(order[0])], rows[order]

    def _imagine(self, imaginer: Imaginer, candidates: Candidates) -> ImaginedBatch:
        return imaginer.imagine_candidates(
            self.scene.view,
            self.scene.in_view(candidates.actions),
            context=self.context,
            com=self.scene.com_in_view,
        )

    def motions(self, imaginer: Imaginer, candidates: Candidates) -> Motions:
        """What an imaginer imagines of candidates.

        Raises:
            PlanningError: The goal is about an outcome that the imaginer does not tell.
        """
        return self._motions(imaginer, self._imagine(imaginer, candidates), candidates)

    def _motions(self, imaginer: Imaginer, batch: ImaginedBatch, candidates: Candidates) -> Motions:
        check_outcomes(self.goal, batch.futures.outcome, imaginer.name)
        scene = self.scene
        found = Motions.of(batch, candidates.actions, scene.outline, scene.height, imaginer.rests)
        if not self.goal.needs_gain() or not isinstance(self.context, Belief):
            return found
        from foretrace.monitoring.information import information_gain  # it imports scipy

        gain = information_gain(
            scene.view,
            scene.in_view(candidates.actions),
            self.context,
            imaginer=self.imaginer,
            com=scene.com_in_view,
        )
        return replace(found, gain=gain)

    def _score(self, motions: Motions) -> Scores:
        """What candidates are worth, from the frame of the goal."""
        scene = self.scene
        if scene.T_start_now is not None and scene.com_start is not None:
            motions = motions.continuing(scene.T_start_now, scene.com_start)
        return score(self.goal, motions, self.config.criterion, self.config.tail)

    def _free(self, candidates: Candidates, count: bool = True) -> Candidates:
        free, reasons = find_free(self.scene, candidates)
        if count:
            self.lost.update(reasons)
        return candidates[np.flatnonzero(free)]

    def _shares(self, action: Action) -> list[float]:
        """Where the parameters of an action's path lie within their ranges."""
        values = action.parameters()
        ranges = {name: self.kind.varied[name] for name in self.varied}
        return [(values[name] - low) / (high - low) for name, (low, high) in ranges.items()]

    def _draw_paths(self, shares: Float[np.ndarray, "n names"], width: float) -> list[Any]:
        """Paths around those with parameters at some shares of their ranges; a width of 1 covers these."""
        drawn = np.clip(shares + width * self.rng.uniform(-0.5, 0.5, size=shares.shape), 0.0, 1.0)
        ranges = [self.kind.varied[name] for name in self.varied]
        values = [low + drawn[:, k] * (high - low) for k, (low, high) in enumerate(ranges)]
        return [
            self.kind.path_of(**dict(zip(self.varied, row, strict=True)))
            for row in np.stack(values, axis=1).tolist()
        ]

    def _order(self, pool: Candidates, scores: Scores) -> Int[np.ndarray, " n"]:
        """Rows from the best on; of those that are as good as the best, first where an error costs least."""
        order = scores.order()
        best = order[0]
        tied = (scores.cost[order] <= scores.cost[best] + TIE) & (scores.excess[order] <= scores.excess[best])
        rows = order[tied]
        if len(rows) > 1:
            apart = np.abs(pool.along[rows][:, None] - pool.along)
            near = np.minimum(apart, self.rim.length - apart) <= ERROR
            loss = scores.cost + scores.excess / np.maximum(scores.limits.min(initial=1.0), 0.01)
            rows = rows[np.argsort((near * loss).sum(axis=1) / near.sum(axis=1), kind="stable")]
        return np.concatenate([rows, order[~tied]])

    def _distinct(
        self, pool: Candidates, order: Int[np.ndarray, " n"], most: int, apart: float = APART
    ) -> Int[np.ndarray, " k"]:
        """The first rows of an order whose contacts differ."""
        contacts, kept = pool.contacts, []
        for row in order.tolist():
            if all(np.linalg.norm(contacts[row] - contacts[k]) > apart for k in kept):
                kept.append(row)
            if len(kept) == most:
                break
        return np.array(kept, dtype=np.int64)

    def _shortlist(self, pool: Candidates, scores: Scores) -> Int[np.ndarray, " k"]:
        """The best rows that differ and that the robot reaches.

        Raises:
            PlanningError: It reaches none.
        """
        wanted = max(1, self.config.check)
        order = self._order(pool, scores)
        apart = CROWDED if self.config.refine else APART
        if self.reach is None:
            return self._distinct(pool, order, wanted, apart)
        kept, first = [], ""
        for row in self._distinct(pool, order, TRIED, apart).tolist():
            reason = self.reach(pool.actions[row])
            if reason is None:
                kept.append(row)
            else:
                self.lost[UNREACHED] += 1
                first = first or reason
            if len(kept) == wanted:
                break
        if not kept:
            count = self.lost[UNREACHED]
            raise PlanningError(
                f"the robot reaches none of the {count} best contacts (the best: {first}): move object or base"
            )
        return np.array(kept, dtype=np.int64)

    def _tell(
        self,
        name: str,
        pool: Candidates,
        scores: Scores,
        started: float,
        before: float | None,
        order: Int[np.ndarray, " n"] | None = None,
    ) -> None:
        best = int((self._order(pool, scores) if order is None else order)[0])
        contact = pool.contacts[best]
        moved = float(np.linalg.norm(contact - self.stages[-1].contact)) if self.stages else 0.0
        cost, risk = float(scores.cost[best]), float(scores.risk[best])
        self.stages.append(
            Stage(name, len(pool), contact, cost, risk, before, moved, perf_counter() - started)
        )

    def _rim_cost(self, pool: Candidates, scores: Scores) -> RimCost:
        """Of each contact, the best direction's cost and risk."""
        order = scores.order()
        _, first = np.unique(pool.along[order], return_index=True)
        rows = order[first]
        return RimCost(pool.contacts[rows], scores.cost[rows], scores.risk[rows])

    def _alternatives(
        self, pool: Candidates, scores: Scores, rows: Int[np.ndarray, " k"], later: bool
    ) -> tuple[Alternative, ...]:
        """Other contacts, the checked ones first, and why they lost; actions may follow later."""
        others = scores.order()
        order = np.concatenate([rows, others[~np.isin(others, rows)]])
        best, found = float(scores.cost[rows[0]]), []
        for row in self._distinct(pool, order, ALTERNATIVES + 1, DIFFERENT).tolist()[1:]:
            one, action = scores[[row]], pool.actions[row]
            cost = float(one.cost[0])
            before = self._why_not(action, later) if cost <= best and row not in rows else ""
            found.append(
                Alternative(
                    action, cost, float(one.risk[0]), float(one.reached[0]), why_lost(one, best, before)
                )
            )
        return tuple(found)

    def _why_not(self, action: Action, later: bool) -> str:
        """Why the cost of an action that is not on the shortlist did not count; empty where it did."""
        if later:
            return "leaves the object worse for the actions after it"
        if self.reach is not None and self.reach(action) is not None:
            return UNREACHED
        if self.checker is None:
            return ""
        imagined = f"as the {self.imaginer.name} imaginer has it"
        return f"{imagined}: it is not among those that the {self.checker.name} checked"
