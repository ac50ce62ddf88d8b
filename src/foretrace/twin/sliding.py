"""A twin of planar pushes: the quasi-static model, with constants that are identified from recorded pushes."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from foretrace.actions import Push
from foretrace.errors import ActionError, PredictionError, is_number, is_whole, shown
from foretrace.geometry import invert_transform, rotate_plane
from foretrace.imagined import ImaginedBatch, Imaginer, Scenes
from foretrace.imagined.context import EXACT
from foretrace.interactions.batch import Candidates
from foretrace.interactions.pushes import RecordedPushes
from foretrace.objects import ObjectModel
from foretrace.objects.footed import feet_of
from foretrace.simulation.randomisation import RANDOMISED
from foretrace.twin.outline import SeenObject, see_object
from foretrace.twin.pushed import OUTCOMES, PushWorlds, gather_pushes, states_over_time, with_regions
from foretrace.twin.sliding_constants import (
    AS_IT_IS,
    FRICTION,
    MOST_FITTED,
    NAMES,
    OWN,
    SHARED,
    SPREADS,
    STEPS,
    Change,
    Group,
    check_pushes,
    fit_constants,
    groups_of,
    play_pushes,
)

SAMPLE_PERIOD = 0.05
"""Time between imagined samples [s]."""
TOGETHER = 2048
"""Worlds that are played at once, about."""


@dataclass(eq=False)
class SlidingTwin(Imaginer):
    """Imagines pushes by the quasi-static model: it simulates them on the object that the view shows.

    Where no context is given, the twin's own constants count, and each push is played once. Where the rod's friction
    or the contact's error is not told, it is played in many worlds: what is not told is drawn, and so is how the
    weight is spread; regions hold as many of the drawn motions as they say.

    Raises:
        PredictionError: A setting is out of its range.
    """

    shared: Float[np.ndarray, " names"] = field(default_factory=lambda: np.zeros(len(NAMES)))
    """Values of a shape that was never pushed. How its weight is spread is nominal: shapes differ in that among each
    other as much as from an even spread."""
    own: dict[Group, Float[np.ndarray, " names"]] = field(default_factory=dict)
    """Values of each shape on its surface."""
    doubt: Float[np.ndarray, "names names"] = field(default_factory=lambda: np.diag(SHARED**2 + OWN**2))
    """Covariance of ``shared`` for an object: by default, as shapes differ."""
    own_doubt: dict[Group, Float[np.ndarray, "names names"]] = field(default_factory=dict)
    """The same of each shape's own values, as its pushes left it."""
    worlds: int = 32
    """Worlds in which a push is played of which something is not told."""
    duration: float = 6.0
    """Time that is imagined [s]; pushes must not take longer."""
    steps: int = STEPS
    """Steps into which an imagined push is cut."""
    seed: int = 0
    """Decides what is drawn."""
    errors: Float[np.ndarray, " pushes"] | None = None
    """How far centres of objects that were pushed came to rest from where the twin predicts them [m]."""

    context = ("tool_friction", EXACT, *Push.nominal_parameters())
    marginal = True
    rests = True

    def __post_init__(self) -> None:
        shared = np.shape(self.shared) == (len(NAMES),) and np.isfinite(self.shared).all()
        if not is_whole(self.steps, 1, 10_000) or not is_whole(self.seed, 0, 2**63 - 1) or not shared:
            raise PredictionError(
                f"steps is {shown(self.steps)}, seed {shown(self.seed)}, shared {shown(self.shared)}: give whole "
                f"numbers from 1 and from 0, and {len(NAMES)} finite values"
            )
        fits = is_number(self.duration) and 0.5 <= self.duration <= 600
        if not fits or not is_whole(self.worlds, 2, 65536):
            raise PredictionError(
                f"worlds is {shown(self.worlds)}, duration {shown(self.duration)}: give a whole number from 2 to "
                "65536, and seconds from 0.5 to 600"
            )

    @property
    def name(self) -> str:
        """Name in messages."""
        return "sliding twin"

    @property
    def sample_times(self) -> Float[np.ndarray, " time"]:
        """Times of the imagined samples [s]."""
        return np.arange(round(self.duration / SAMPLE_PERIOD) + 1) * SAMPLE_PERIOD

    @property
    def learned_outcomes(self) -> tuple[str, ...]:
        """Those of pushes."""
        return OUTCOMES

    @property
    def friction(self) -> float:
        """Friction coefficient between rod and object."""
        return FRICTION * float(np.exp(self.shared[0]))

    @property
    def nominal(self) -> Mapping[str, float]:
        """The twin's own friction, and a contact as commanded."""
        return {"tool_friction": self.friction, EXACT: 0.0}

    def of_shape(self, surface: str, shape: str) -> "SlidingTwin":
        """The twin of one shape on one surface, with the constants that were identified for it.

        Raises:
            PredictionError: It was never pushed there.
        """
        if (surface, shape) not in self.own:
            known = ", ".join(f"{name} on {shown(place)}" for place, name in self.own) or "none"
            raise PredictionError(
                f"shape {shown(shape)} on {shown(surface)} was never pushed: choose from {known}"
            )
        key = surface, shape
        return replace(self, shared=self.own[key], doubt=self.own_doubt.get(key, self.doubt))

    def imagine_scenes(self, scenes: Scenes) -> ImaginedBatch:
        """Play the pushes, each in one world or, where something is not told, in many."""
        told = dict(zip(self.context, scenes.context.T, strict=True))
        pushes = [self._push(scenes, row, told) for row in range(len(scenes))]
        unsure = ~(np.isfinite(told["tool_friction"]) & np.isfinite(told[EXACT]))
        worlds = self.worlds if unsure.any() else 1
        seen = self._see(scenes)
        states = np.zeros((len(scenes), worlds, len(self.sample_times), 6))
        outcome = np.zeros((len(scenes), worlds), dtype=np.int64)
        for model in {id(each.model): each.model for each in seen}.values():
            rows = np.array([row for row, each in enumerate(seen) if each.model is model])
            for few in np.array_split(rows, -(-len(rows) * worlds // TOGETHER)):
                places = np.array([seen[row].T_action_object for row in few])
                several = [pushes[row] for row in few]
                some = {name: values[few] for name, values in told.items()}
                turns = _axes(scenes, few)
                states[few], outcome[few] = self._play(
                    model, places, several, some, scenes.com[few], turns, worlds
                )
        imagined = gather_pushes(states, outcome, self.sample_times)
        if worlds == 1 and self.errors is not None:
            imagined = replace(imagined, futures=with_regions(imagined.futures, self.errors))
        return replace(imagined, warnings=tuple(each.notes for each in seen))

    def _see(self, scenes: Scenes) -> list[SeenObject]:
        """The object of each push, in the frame of that push."""
        source = scenes.source
        if not isinstance(source, Candidates):
            return [see_object(*each) for each in zip(source.mask, source.height, strict=True)]
        seen = see_object(source.view.mask, source.view.height)  # one object, looked at once
        return [
            replace(seen, T_action_object=action.T_action_object @ seen.T_action_object)
            for action in source.actions
        ]

    def _play(
        self,
        model: ObjectModel,
        places: Float[np.ndarray, "rows 4 4"],
        pushes: list[Push],
        told: Mapping[str, Float[np.ndarray, " rows"]],
        com: Float[np.ndarray, "rows 3"],
        turns: Float[np.ndarray, "rows 2 2"],
        worlds: int,
    ) -> tuple[Float[np.ndarray, "rows worlds time 6"], Int[np.ndarray, "rows worlds"]]:
        """Motions and outcomes of pushes of one object, each in a number of worlds.

        Args:
            model: The object.
            places: Its frame at rest in the frame of each push.
            pushes: The pushes.
            told: What each is told, by name; NaN: nothing.
            com: Its centre of mass at rest in the frame of each push [m].
            turns: Turn from the model's axes to those in which the twin's constants are.
            worlds: Number of worlds.
        """
        count, rng = len(pushes), np.random.default_rng(self.seed)
        values = np.tile(self.shared, (worlds, 1))
        offset = np.zeros((worlds, 3))  # of the rod: ahead, left [m], turn [rad]
        if worlds > 1:
            values += rng.multivariate_normal(np.zeros(len(NAMES)), self.doubt, worlds)
            reach = [getattr(RANDOMISED, f"execution_{name}") for name in ("ahead", "left", "turn")]
            offset = rng.uniform(-1, 1, (worlds, 3)) * reach
        friction = np.where(
            np.isfinite(told["tool_friction"])[:, None],
            told["tool_friction"][:, None],
            FRICTION * np.exp(values[:, 0]),
        )
        offset = np.where(np.isfinite(told[EXACT])[:, None, None], 0.0, offset)  # (rows, worlds, 3)
        T_object_action = np.array([invert_transform(each) for each in places])
        direction = T_object_action[:, None, :2, 0] * np.cos(offset[..., 2:])
        direction = direction + T_object_action[:, None, :2, 1] * np.sin(offset[..., 2:])
        length = np.array([push.path.length for push in pushes])[:, None, None]
        back = np.array([push.path.approach + push.tool.radius for push in pushes])[:, None, None]
        touch = T_object_action[:, None, :2, 3] + np.einsum(
            "nij,nwj->nwi", T_object_action[:, :2, :2], offset[..., :2]
        )
        own = np.einsum("nij,nj->ni", T_object_action[:, :2, :3], com) + T_object_action[:, :2, 3]
        feet = feet_of(model.corners, "uniform")
        around = np.einsum("nij,fj->nfi", turns, feet - feet.mean(axis=0))
        around = around[:, None] * np.exp(values[:, None, 1:3]) + 1e-2 * values[:, None, 3:5]
        feet = own[:, None, None] + np.einsum("nji,nwfj->nwfi", turns, around)
        flat = PushWorlds(
            model.corners,
            feet.reshape(count * worlds, -1, 2),
            friction.ravel(),
            (touch - back * direction).reshape(-1, 2),
            (length * direction).reshape(-1, 2),
            np.repeat([push.tool.radius for push in pushes], worlds),
        )
        found, outcome = flat.play(self.steps)
        states = states_over_time(
            found,
            [push for push in pushes for _ in range(worlds)],
            self.sample_times,
            np.repeat(com, worlds, axis=0),
            np.repeat(places, worlds, axis=0),
        )
        return states.reshape(count, worlds, *states.shape[1:]), outcome.reshape(count, worlds)

    def _push(self, scenes: Scenes, row: int, told: Mapping[str, np.ndarray]) -> Push:
        """A push by its path and rod; its place does not matter.

        Raises:
            PredictionError: It is impossible, or takes longer than what is imagined.
        """
        known = Push.nominal() if scenes.actions is None else scenes.actions[row]
        if not isinstance(known, Push):
            raise PredictionError(
                f"the {self.name} plays pushes, action {row} is a {known.label}: give a Push"
            )
        values = {name: float(told[name][row]) for name in known.parameters() if np.isfinite(told[name][row])}
        try:
            push = replace(known, path=replace(known.path, **values))
        except ActionError as error:
            raise PredictionError(f"the twin cannot play the push: {error}") from error
        if push.duration > self.duration + SAMPLE_PERIOD:
            raise PredictionError(
                f"the push takes {push.duration:.3g} s, the twin imagines {self.duration:g} s: give a shorter one, or "
                "a SlidingTwin of a longer duration"
            )
        return push

    def predict(self, pushes: RecordedPushes, change: Change = AS_IT_IS) -> Float[np.ndarray, "pushes 3"]:
        """Displacement [m] and turn [rad] of each object, in its own frame at rest.

        Raises:
            PredictionError: What is given are no `RecordedPushes`.
        """
        check_pushes(pushes)
        found = np.zeros((len(pushes), 3))
        for group, rows in groups_of(pushes).items():
            found[rows] = play_pushes(
                pushes[rows], self.own.get(group, self.shared)[None], change, self.steps
            )[0]
        return found

    def calibrated(self, pushes: RecordedPushes) -> "SlidingTwin":
        """The twin with regions that as many of such pushes hold as they say (split-conformal), where all is told.

        What counts is how they differ from what `imagine` plays: by the constants that all shapes share, or those of
        one shape in a twin `of_shape`. Pushes may be known at their ends alone: before its end, a motion's region is
        narrower as it has come less far.

        Args:
            pushes: Pushes that were carried out, none of those that the constants were identified from.

        Raises:
            PredictionError: There are no pushes.
        """
        check_pushes(pushes)
        if len(pushes) == 0:
            raise PredictionError("no push to calibrate with: give at least one, better a hundred")
        centre = np.array([shape.centroid for shape in pushes.shapes])[pushes.shape]
        ends = [
            moved[:, :2] + rotate_plane(centre, moved[:, 2])
            for moved in (replace(self, own={}).predict(pushes), pushes.displacement())
        ]
        return replace(self, errors=np.linalg.norm(ends[0] - ends[1], axis=1))

    @classmethod
    def identified(cls, pushes: RecordedPushes, seed: int = 0) -> "SlidingTwin":
        """The twin whose constants explain recorded pushes best.

        Args:
            pushes: Pushes to learn from.
            seed: Decides which pushes are used where there are more than `MOST_FITTED` of a shape.

        Raises:
            PredictionError: There are no pushes, or the seed is no whole number from 0.
        """
        check_pushes(pushes)
        if not is_whole(seed, 0, 2**63 - 1):
            raise PredictionError(f"seed is {shown(seed)}: give a whole number from 0")
        if len(pushes) == 0:
            raise PredictionError("no push to identify constants from: give at least one")
        rng = np.random.default_rng(seed)
        some = rng.permutation(len(pushes))[: 2 * MOST_FITTED]
        shared, _ = fit_constants(pushes[np.sort(some)], np.zeros(len(NAMES)), SHARED)
        own, doubt = {}, {}
        for group, rows in groups_of(pushes).items():
            kept = np.sort(rng.permutation(rows)[:MOST_FITTED])
            own[group], doubt[group] = fit_constants(pushes[kept], shared, OWN)
        nominal = np.where(np.isin(np.arange(len(NAMES)), SPREADS), 0.0, shared)
        return cls(nominal, own, own_doubt=doubt)


def _axes(scenes: Scenes, rows: np.ndarray) -> Float[np.ndarray, "rows 2 2"]:
    """Turn from the frame in which the objects of scenes are seen to the object frame: that of the action's place."""
    if isinstance(scenes.source, Candidates) or scenes.actions is None:
        return np.tile(np.eye(2), (len(rows), 1, 1))  # the view's frame takes the place of the object's
    return np.array([scenes.actions[row].T_action_object[:2, :2].T for row in rows])
