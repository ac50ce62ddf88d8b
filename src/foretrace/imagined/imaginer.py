"""The contract of everything that imagines effects: one door with the same checks, warnings and shapes."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal, final

import numpy as np
from jaxtyping import Float

from foretrace.actions import Action
from foretrace.errors import PredictionError, check_type, shown
from foretrace.geometry import Numbers, finite_array, rotation_vector_to_quaternion
from foretrace.imagined.belief import RANGES, Belief
from foretrace.imagined.context import (
    BEVELS,
    CONSTANTS,
    UNKNOWN,
    Context,
    column_of,
    find_cut_short,
    find_unconditioned,
    first_action,
    given_context,
    nominal_constants,
    parameters_of,
    recorded_context,
)
from foretrace.imagined.domain import (
    OWN,
    bevel_scales,
    check_arrays,
    check_com,
    check_contacts,
    check_object,
    check_view,
    estimate_com,
    level_tops,
    measure,
    measure_candidates,
)
from foretrace.imagined.futures import Futures, ImaginedBatch, ImaginedEffect
from foretrace.imagined.observed import SAME_TIME, ObservedMotion, observed_motion, rotations_since_rest
from foretrace.imagined.worlds import average_worlds, gather_worlds, play_worlds, wrong_worlds
from foretrace.interactions.batch import Candidates, InteractionBatch
from foretrace.interactions.record import Effect
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel
from foretrace.registry import Registry

Start = Literal["observed", "estimated"]
"""Where a motion's centre of mass at rest comes from: the first recorded sample, or the view from above."""
STARTS: tuple[Start, ...] = ("observed", "estimated")


READY = {"lever-up": "ft.TwinImaginer()", "push": "ft.SlidingTwin()"}
"""Imaginers that messages name, by the label of the action."""
CANDIDATE_WORLDS = 32
"""Worlds that each of several candidates is imagined in, where a belief is averaged over."""
UNSURE = 0.01
"""A prediction whose expected error is larger is pointed out [m]."""
UNSURE_OF = "an error of {:.2g} cm is expected: several motions are likely, or the object is unlike those learned from"


@dataclass(frozen=True)
class Scenes:
    """What is to be imagined, checked; one row for each action."""

    source: InteractionBatch | Candidates
    """Interactions of which everything before the action may be read; or candidates."""
    com: Float[np.ndarray, "batch 3"]
    """Centres of mass at rest in the action frame [m]."""
    context: Float[np.ndarray, "batch context"]
    """Values of the imaginer's context [SI]; NaN: a constant that is not told."""
    start: Start = "observed"
    """Where the centres of mass come from."""
    observed: Float[np.ndarray, "batch samples 6"] | None = None
    """Motions' first samples at the imaginer's sample times, where they are under way: centre of mass in the action
    frame [m] and rotation vector since rest [rad]."""
    actions: tuple[Action, ...] | None = None
    """The actions, where they are known; of a recorded one, the parameters of its path alone are."""

    def __len__(self) -> int:
        return len(self.com)

    @cached_property
    def batch(self) -> InteractionBatch:
        """The objects in the frames of the actions."""
        return self.source.batch() if isinstance(self.source, Candidates) else self.source

    def measure(self) -> dict[str, Float[np.ndarray, " batch"]]:
        """Measures by which objects are compared, see `foretrace.imagined.domain.MEASURES`."""
        if isinstance(self.source, Candidates):
            return measure_candidates(self.source, self.com)
        return measure(self.source, self.com)


class Imaginer(ABC):
    """Imagines the effect of an action on an object seen from above (paper, section 3).

    `imagine`, `imagine_batch` and `imagine_candidates` are final: they check what they are given, find the context, and
    turn it into `Scenes`. A subclass answers those in `imagine_scenes`.
    """

    context: tuple[str, ...] = ()
    """Variables that it is conditioned on beside the view: names of `foretrace.imagined.context.context_units`."""
    marginal: bool = False
    """Whether it can do without constants of its context: its futures then cover what is not told."""
    rests: bool = False
    """Whether imagined motions end with the object at rest and the tool gone, as a sequence of actions needs it."""
    bevels_all: ClassVar[bool] = False
    """Whether it gives a bevel even to objects whose top is not level; others have none to be told."""
    observes: ClassVar[bool] = False
    """Whether it can be shown the first samples of a motion that is under way."""

    @property
    @abstractmethod
    def sample_times(self) -> Float[np.ndarray, " time"]:
        """Times of the imagined samples [s]; the samples that it can be shown are the first of these."""

    @property
    def name(self) -> str:
        """Name in messages."""
        return type(self).__name__

    @property
    def display_name(self) -> str:
        """Name in figures and tables."""
        return self.name

    @property
    def learned_outcomes(self) -> tuple[str, ...]:
        """Outcomes of the motions that it imagines; of none, it imagines any action."""
        return ()

    @property
    def action(self) -> type[Action]:
        """The kind of action that it imagines; by default the first one that can have its learned outcomes."""
        return first_action(self.learned_outcomes)

    @property
    def nominal(self) -> Mapping[str, float]:
        """Constants that it takes where no context is given."""
        return nominal_constants()

    @property
    def needs_effect(self) -> str | None:
        """What it reads that only the effect reveals, so that it cannot imagine from a view; None: nothing."""
        return None

    @abstractmethod
    def imagine_scenes(self, scenes: Scenes) -> ImaginedBatch:
        """Imagine the effects in scenes that have been checked, one row each, with warnings about their objects."""

    @final
    def imagine(
        self,
        view: TopDownView,
        action: Action | None = None,
        *,
        context: Context | Belief = None,
        observed: Effect | ObservedMotion | None = None,
        com: Numbers | None = None,
    ) -> ImaginedEffect:
        """Imagine the effect of the action in whose frame an object is seen.

        Args:
            view: The object from above, in the action frame.
            action: The action. Its path's parameters are context; a path that is not nominal is pointed out if the
                imaginer is not conditioned on it. The view's frame says where it acts. None: the nominal path.
            context: Values of the variables that the imaginer is conditioned on, by name [SI]; a constant that is left
                out is not told. None tells the nominal constants, ``unknown`` none. A `Belief` is averaged over, and
                the effect keeps all its worlds.
            observed: Beginning of the motion, where it is under way: the record's own `Effect`, or poses with times.
            com: The centre of mass at rest in the action frame [m]. By default that of the observed motion, or the one
                estimated from the view: above the centre of the mask's area, at half the object's greatest height.

        Raises:
            PredictionError: The view does not show one object that is levered at its rim; the imaginer cannot do
                without the effect; a context value is missing, not finite, contradictory or of no use; or the observed
                motion cannot be used.
        """
        self._check_sight()
        check_type("view", view, TopDownView, PredictionError)
        check_view(view)
        parameters = {}
        if action is not None:
            check_type("action", action, Action, PredictionError)
            self._check_action(action)
            parameters = parameters_of([action])
        belief = context if isinstance(context, Belief) else None
        batch = InteractionBatch.from_views([view])
        values = self._told(self._without(belief, context), parameters, 1)
        values = self.as_seen(values, batch, context is None)
        motion = None if observed is None else observed_motion(observed)
        if com is None and motion is not None and motion.com is not None:
            com = motion.com[0]
        place = estimate_com(batch)[0] if com is None else _point(com)
        check_com(view, place)
        if belief is not None:
            return self._imagine_worlds(view, action, belief, place, observed is not None)
        seen = None
        if motion is not None:
            self._check_observes()
            seen = motion.states(self.sample_times, place)[None]
        start = "estimated" if com is None else "observed"
        known = None if action is None else (action,)
        return self._answer(Scenes(batch, place[None], values, start, seen, known), parameters)[0]

    @final
    def imagine_batch(
        self,
        batch: InteractionBatch,
        start: Start = "observed",
        observed: int = 0,
        *,
        context: Context | Literal["recorded"] = "recorded",
    ) -> ImaginedBatch:
        """Imagine the effects of many actions, of which some may have been recorded.

        Args:
            batch: The interactions. Of their trajectories only the first sample is read, and not even that if
                ``start`` is ``estimated``; of their constants and parameters those of the context.
            start: Where the centre of mass at rest comes from: the first recorded sample, or the view.
            observed: Number of recorded samples of each motion that are shown to the imaginer.
            context: As of `imagine`, the same for all; by default what was recorded of each.

        Raises:
            PredictionError: As `imagine`, naming the interaction; or no first sample was recorded.
        """
        check_type("batch", batch, InteractionBatch, PredictionError)
        check_arrays(batch.mask, batch.height)
        if not isinstance(start, str) or start not in STARTS:
            raise PredictionError(f"start is {shown(start)}: choose from {', '.join(STARTS)}")
        most = len(self.sample_times) - 1
        if isinstance(observed, bool) or not isinstance(observed, int | np.integer) or observed < 0:
            raise PredictionError(f"observed is {shown(observed)}: give a number of samples from 0 to {most}")
        for id, mask, height in zip(batch.ids, batch.mask, batch.height, strict=True):
            with _naming(f"interaction {id}: "):
                check_object(mask, height)
                check_contacts(mask, *OWN)
        if context == "recorded":
            values = recorded_context(batch, self.context, self.marginal)
        else:
            known = {name: column_of(batch, name) for name in self.action.nominal_parameters()}
            values = self._told(context, known, len(batch))
        values = self.as_seen(values, batch, context is None)
        com = estimate_com(batch)
        if start == "observed":
            com = batch.com[:, 0] if batch.com.shape[1] else np.full_like(com, np.nan)
            if not (there := np.isfinite(com).all(axis=1)).all():
                raise PredictionError(
                    f"interaction {batch.ids[~there][0]} has no recorded centre of mass: take start='estimated'"
                )
        seen = self._observe_batch(batch, int(observed)) if observed else None
        parameters = {name: column_of(batch, name) for name in self.action.nominal_parameters()}
        return self._answer(Scenes(batch, com, values, start, seen), parameters)

    @final
    def imagine_candidates(
        self,
        view: TopDownView,
        actions: Iterable[Action],
        *,
        context: Context | Belief = None,
        com: Numbers | None = None,
    ) -> ImaginedBatch:
        """Imagine the effects of several actions on one object from a single view.

        Args:
            view: The object from above, in any action frame; contact and direction of that frame do not matter.
            actions: The actions, in the view's frame: contact points [m] and directions there, and their paths.
            context: As of `imagine`, the same for all. Of a `Belief`, `CANDIDATE_WORLDS` worlds are imagined.
            com: The centre of mass at rest in the view's frame [m]; by default estimated from the view.

        Returns:
            One row for each action, in the frame of its own action.

        Raises:
            PredictionError: As `imagine`, naming the candidate; or there is none.
        """
        self._check_sight()
        check_type("view", view, TopDownView, PredictionError)
        check_object(view.mask, view.height)
        check_type("actions", actions, Iterable, PredictionError, "a list of actions")
        if getattr(actions, "ndim", 1) == 0:  # an array without axes counts as iterable
            raise PredictionError("actions are one value: give a list of actions")
        actions = tuple(actions)
        if not actions:
            raise PredictionError("there is no candidate to imagine: give at least one action")
        for k, action in enumerate(actions):
            check_type(f"candidate {k}", action, Action, PredictionError)
            self._check_action(action, f"candidate {k}: ")
        candidates = Candidates(view, actions)
        names = [f"candidate {k}: " for k in range(len(actions))]
        check_contacts(view.mask, candidates.contacts, candidates.directions, names)
        parameters = parameters_of(actions)
        belief = context if isinstance(context, Belief) else None
        values = self._told(self._without(belief, context), parameters, len(actions))
        values = self.as_seen(values, candidates, context is None)
        middle = estimate_com(InteractionBatch.from_views([view]))[0] if com is None else _point(com)
        check_com(view, middle)
        if belief is not None:
            return self._average(view, actions, belief, candidates.enter(middle))
        start = "estimated" if com is None else "observed"
        scenes = Scenes(candidates, candidates.enter(middle), values, start, actions=actions)
        return self._answer(scenes, parameters)

    def _check_action(self, action: Action, who: str = "") -> None:
        """Refuse another kind of action than the one whose motions are imagined."""
        odd = [name for name in self.learned_outcomes if name not in action.outcomes]
        if odd:
            ready = f", such as {READY[action.label]}" if action.label in READY else ""
            raise PredictionError(
                f"{who}the {self.name} imaginer imagines a {self.action.label}, not a {action.label}: give an imaginer "
                f"of a {action.label}{ready}"
            )

    def _told(self, context: Context, parameters: dict[str, np.ndarray], number: int) -> np.ndarray:
        """Context of actions, see `given_context`."""
        return given_context(
            self.context, context, parameters, number, self.marginal, kind=self.action, usual=self.nominal
        )

    def as_seen(
        self,
        values: Float[np.ndarray, "n context"],
        source: InteractionBatch | Candidates,
        nominal: bool = False,
    ) -> Float[np.ndarray, "n context"]:
        """Context of actions without the bevels of objects that have none: a width of 0, or seen as a lying cylinder.

        Args:
            values: The context [SI].
            source: The views.
            nominal: Whether these are the nominal constants: slender and thin objects then have a smaller bevel.
        """
        bevels = np.isin(self.context, BEVELS)
        if self.bevels_all or not self.marginal or not bevels.any():
            return values
        if nominal:
            values = np.where(bevels, values * bevel_scales(source)[:, None], values)
        none = ~level_tops(source) | (values[:, bevels] == 0).any(axis=1)
        return np.where(none[:, None] & bevels, np.nan, values)

    def _answer(self, scenes: Scenes, parameters: dict[str, np.ndarray]) -> ImaginedBatch:
        return self._warned(self.imagine_scenes(scenes), scenes.context, parameters, scenes.actions)

    def _warned(
        self,
        imagined: ImaginedBatch,
        context: np.ndarray,
        parameters: dict[str, np.ndarray],
        actions: tuple[Action, ...] | None,
    ) -> ImaginedBatch:
        """Effects with warnings, also about paths that the imaginer is not conditioned on, and what it was told."""
        about_objects = imagined.warnings or ((),) * len(context)
        about_paths = (
            find_unconditioned(parameters, self.context, self.action) if parameters else ((),) * len(context)
        )
        cut = ((),) * len(context) if actions is None else find_cut_short(actions, self.sample_times)
        errors = imagined.futures.expected_error()
        unsure = [(UNSURE_OF.format(100 * error),) if error > UNSURE else () for error in errors]
        about = zip(about_objects, about_paths, cut, unsure, strict=True)
        warnings = tuple(sum(lines, ()) for lines in about)
        return replace(imagined, warnings=warnings, context=dict(zip(self.context, context.T, strict=True)))

    def _without(self, belief: Belief | None, context: Context | Belief) -> Context:
        """The context as it is told; of a belief, the path's parameters alone."""
        if belief is None and not isinstance(context, Belief):
            return context
        return UNKNOWN if self.marginal else None

    def _imagine_worlds(
        self, view: TopDownView, action: Action | None, belief: Belief, com: np.ndarray, observed: bool
    ) -> ImaginedEffect:
        """The effect averaged over a belief, with all its worlds and those in which something is wrong."""
        if observed:
            raise PredictionError(
                "a belief is given as context, and observed samples: give the samples to foretrace.identify, or to a "
                "Monitor of the effect"
            )
        if action is None:
            action = self.action.nominal()
        parameters = {name: float(each[0]) for name, each in parameters_of([action]).items()}
        values, causes = wrong_worlds(belief.sample_ahead(belief.worlds))
        played = play_worlds(self, view, action, com, values, parameters)
        count = belief.worlds
        futures = average_worlds(played.futures[np.arange(count)], count, com[None])
        worlds = gather_worlds(played, values, causes)
        answer = self._finish(futures, played.warnings[:1] or ((),), (action,), belief)
        return replace(answer[0], worlds=worlds)

    def _average(
        self, view: TopDownView, actions: tuple[Action, ...], belief: Belief, com: np.ndarray
    ) -> ImaginedBatch:
        """The effects of several actions, averaged over a belief."""
        count = min(belief.worlds, CANDIDATE_WORLDS)
        values = belief.sample_ahead(count)
        parts, warnings = [], []
        for action, place in zip(actions, com, strict=True):
            parameters = {name: float(each[0]) for name, each in parameters_of([action]).items()}
            played = play_worlds(self, view.seen_from(action), action, place, values, parameters)
            parts.append(average_worlds(played.futures, count, place[None]))
            warnings.append(played.warnings[0] if played.warnings else ())
        names = ("probability", "states", "spread", "support_points")
        together = {name: np.concatenate([getattr(each, name) for each in parts]) for name in names}
        wide = [np.broadcast_to(each.quantiles, (1, each.quantiles.shape[-1])) for each in parts]
        futures = replace(parts[0], **together, quantiles=np.concatenate(wide))
        return self._finish(futures, tuple(warnings), actions, belief)

    def _finish(
        self,
        futures: Futures,
        warnings: tuple[tuple[str, ...], ...],
        actions: tuple[Action, ...],
        belief: Belief,
    ) -> ImaginedBatch:
        """Effects whose averaged futures these are, with warnings and what is told of their contexts."""
        idle = [
            name for name in CONSTANTS if name in RANGES and name not in self.context
            if belief.ranges[name] != RANGES[name]
        ]  # fmt: skip
        if idle:
            verb = "makes" if len(idle) == 1 else "make"
            note = f"the belief's {' and '.join(idle)} {verb} no difference: the {self.name} is not conditioned on them"
            warnings = tuple((*each, note) for each in warnings)
        best = futures.states[np.arange(len(futures)), futures.probability.argmax(axis=1)]
        pose = np.concatenate([best[..., :3], rotation_vector_to_quaternion(best[..., 3:])], axis=-1)
        told, parameters = np.full((len(futures), len(self.context)), np.nan), parameters_of(actions)
        for column, name in enumerate(self.context):
            if name not in CONSTANTS and name in parameters:
                told[:, column] = parameters[name]
        imagined = ImaginedBatch(self.sample_times, best[..., :3], pose, futures, warnings)
        return self._warned(imagined, told, parameters, actions)

    def _observe_batch(self, batch: InteractionBatch, count: int) -> Float[np.ndarray, "batch samples 6"]:
        """The first recorded samples of each motion at the imaginer's sample times."""
        self._check_observes()
        if (short := batch.length < count).any():
            raise PredictionError(
                f"interaction {batch.ids[short][0]} has {batch.length[short][0]} samples, fewer than the "
                f"{count} to be observed: leave it out or observe fewer"
            )
        times, wanted = batch.times[:count], self.sample_times
        if count < len(wanted) and np.allclose(times, wanted[:count], rtol=0, atol=SAME_TIME):
            turned = rotations_since_rest(batch.pose[:, :count])
            return np.concatenate([batch.com[:, :count], turned], axis=-1)
        seen = []
        for id, poses, com in zip(batch.ids, batch.pose[:, :count], batch.com[:, :count], strict=True):
            with _naming(f"interaction {id}: "):
                seen.append(ObservedMotion(times, poses, com).states(wanted, com[0]))
        return np.array(seen)

    def _check_sight(self) -> None:
        if self.needs_effect is not None:
            raise PredictionError(
                f"{self.needs_effect} are observed during the action and cannot be had from a view: use a predictor "
                "with other features"
            )

    def _check_observes(self) -> None:
        if not self.observes:
            raise PredictionError(
                f"the {self.name} predictor makes no use of observed samples: leave them out or use another one"
            )


IMAGINERS: Registry[Callable[[ObjectModel | None], Imaginer]] = Registry(
    "imaginer", "foretrace.imaginers", PredictionError
)
"""What makes the imaginers that come ready for use, each by its label; told the object where it is known."""
IMAGINERS.declare("learned", "foretrace.predictor")
IMAGINERS.declare("twin", "foretrace.twin")
IMAGINERS.declare("twin-to-rest", "foretrace.twin")


@contextmanager
def _naming(name: str) -> Iterator[None]:
    """Errors begin with the name of what they are about."""
    try:
        yield
    except PredictionError as error:
        raise PredictionError(f"{name}{error}") from error


def _point(com: Numbers) -> Float[np.ndarray, "3"]:
    return finite_array("the centre of mass com (x, y, z) [m]", com, (3,), PredictionError)
