"""See an object from above, choose a lever-up, and be rewarded by a goal."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Float

from foretrace.actions import FAILED, LeverUp
from foretrace.actions.lever_up import VARIED_ACTION
from foretrace.environment.coding import BROKEN, REFUSED, TOLD, check_goal, decode_action, encode_action
from foretrace.errors import ForetraceError, PlanningError, check_type, fault, is_whole, shown
from foretrace.geometry import invert_transform, transform_points
from foretrace.imagined import Futures, ImaginedBatch
from foretrace.imagined.context import nominal_constants
from foretrace.imagined.observed import rotations_since_rest
from foretrace.interactions.record import Effect, Physics
from foretrace.interactions.topdown import VIEW_SIZE, TopDownView
from foretrace.objects import ObjectModel, sample_prism
from foretrace.planning import Motions, Plan, goals
from foretrace.planning.candidates import LOOK_AHEAD, Candidates, Scene, find_free
from foretrace.planning.goals import Goal, as_goal, describe
from foretrace.planning.goals.base import LEVERED
from foretrace.planning.resting import com_of, judge_rest
from foretrace.planning.sequence import MOST_STEPS
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.randomisation import RANDOMISED
from foretrace.simulation.world import SimulatedWorld

SCALE = 3
"""Pixels of a picture for one of the view."""


@dataclass(eq=False)
class Episode:
    """One object, and what has become of it."""

    obj: ObjectModel
    camera: LeverUp
    """Where the view's frame lies in the object's frame at the start."""
    scene: Scene
    """What is seen now."""
    first: Scene
    """What was seen at the start."""
    physics: Physics
    world: SimulatedWorld
    """Where the lever-ups of several steps are carried out; its table frame is the object's frame at the start."""
    steps: int = 0
    """Lever-ups so far."""
    over: bool = False
    last: tuple[LeverUp, Float[np.ndarray, "time 2"]] | None = None
    """The last lever-up, and the way of the centre of mass from above, in the view's frame [m]."""

    @property
    def T_view_now(self) -> Float[np.ndarray, "4 4"]:
        """The object's frame now, in the view's frame."""
        return self.camera.T_action_object @ self.world.T_table_object

    @property
    def T_start_now(self) -> Float[np.ndarray, "4 4"]:
        """How the object has moved since the start, in the view's frame."""
        return self.T_view_now @ invert_transform(self.camera.T_action_object)

    def place(self, lever: LeverUp) -> LeverUp:
        """A lever-up in the view's frame, in that of the object as it lies now, its contact on the object's outline."""
        turn, shift = self.T_view_now[:2, :2], self.T_view_now[:2, 3]
        snapped = LeverUp.nearest(self.obj, (lever.contact - shift) @ turn, path=lever.path)
        return replace(snapped, direction=lever.direction @ turn)

    def look(self) -> None:
        """See the object as it lies now; the camera stays.

        Raises:
            ForetraceError: It reaches beyond the view, or lies on another side.
        """
        T = self.world.T_table_object
        own = replace(
            self.camera,
            contact=(self.camera.contact - T[:2, 3]) @ T[:2, :2],
            direction=self.camera.direction @ T[:2, :2],
        )
        self.world.observe()
        self.scene = Scene.of(TopDownView.of(self.obj, own))


class LeverUpEnv(gymnasium.Env[Any, np.ndarray]):
    """Lever-ups of an object that is drawn anew for each episode.

    Observation: ``mask`` and ``height`` [m] of the view from above, (128, 128), on a pixel grid that lies at random,
    and ``context``: friction, tool friction and density, relative to the nominal ones. Action, each from -1 to 1: the
    direction in which the contact lies, seen from the middle of the object, as a share of half a turn to the left of
    the view's x axis; the turn of the blade from the inward normal, as a share of `CONE`; with ``vary_path``,
    insertion, arc radius, sweep and speed within their ranges.

    With one step, an episode is one lever-up, and its reward is minus the goal's cost. With several, the blade sets the
    object down again after each lever-up, the camera stays, and the reward is by how much the cost of where the object
    lies falls. The episode ends when the goal is reached, which functions of motions do not tell, when the object lies
    on another side, and when it leaves the view; it is cut off after the last step. In both cases each thing that
    happens and must not costs `BROKEN`, and a contact that no blade gets to earns `REFUSED`.

    Args:
        goal: What is rewarded, in the view's frame: a goal, or a function of motions that returns costs.
        objects: Draws an object; by default the paper's prisms.
        randomise: Draw friction and density anew; they are observed.
        vary_path: Whether the action has the path's parameters.
        embodiment: ``tool`` or ``arm``.
        render_mode: ``rgb_array`` or ``human``.
        steps: Lever-ups of an episode, at most.

    Raises:
        PlanningError: An argument is none of these, the goal is about what is believed, or several steps have a goal
            about an object on the blade.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 1}  # noqa: RUF012

    def __init__(
        self,
        goal: Goal | Callable[..., Any] | None = None,
        objects: Callable[[np.random.Generator], ObjectModel] | None = None,
        randomise: bool = False,
        vary_path: bool = False,
        embodiment: str = "tool",
        render_mode: str | None = None,
        steps: int = 1,
    ) -> None:
        if not is_whole(steps, 1, MOST_STEPS):
            raise fault(PlanningError, isinstance(steps, int))(
                f"steps is {shown(steps)}: give a whole number from 1 to {MOST_STEPS}"
            )
        self.goal = goals.Lift() if goal is None else as_goal(goal)
        check_goal(self.goal)
        if steps > 1 and LEVERED in self.goal.needed_outcomes():
            raise PlanningError(
                f"steps is {steps}, and the goal is about an object on the blade: give a goal about where it lies, "
                "such as foretrace.goals.Turn(1.5)"
            )
        if objects is not None and not callable(objects):
            raise fault(PlanningError, False)(f"objects of type {type(objects).__name__}: give a function")
        for name, value in (("randomise", randomise), ("vary_path", vary_path)):
            check_type(name, value, bool, PlanningError, "True or False")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise PlanningError(f"render_mode is {render_mode!r}: choose rgb_array or human")
        self.objects = objects or _draw_prism
        self.randomise, self.vary_path, self.render_mode, self.steps = (
            randomise,
            vary_path,
            render_mode,
            steps,
        )
        self.config = SimulationConfig(embodiment=embodiment)
        side = (VIEW_SIZE, VIEW_SIZE)
        self.observation_space = spaces.Dict(
            {
                "mask": spaces.MultiBinary(side),
                "height": spaces.Box(0.0, 2.0, side, np.float32),
                "context": spaces.Box(0.0, 10.0, (len(TOLD),), np.float32),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (2 + len(VARIED_ACTION) * vary_path,), np.float32)
        self.episode: Episode | None = None
        """The object, and what has become of it; None before the first `reset`."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Draw an object, the place of the camera and the physics; ``options={"object": model}`` gives the object.

        What does not fit into the view, cannot have the goal, or has reached it already before several steps, is drawn
        anew.

        Raises:
            PlanningError: None of 100 objects will do, or the given one does not.
        """
        check_type("options", options, (Mapping, type(None)), PlanningError, '{"object": model}')
        super().reset(seed=seed)
        rng, given, reason = self.np_random, (options or {}).get("object"), ""
        for _ in range(100):
            obj = self.objects(rng) if given is None else given
            check_type("object", obj, ObjectModel, PlanningError)
            angle = rng.uniform(0, 2 * np.pi)
            way = np.array([np.cos(angle), np.sin(angle)])
            middle = (obj.corners.min(axis=0) + obj.corners.max(axis=0)) / 2
            camera = LeverUp(middle - LOOK_AHEAD * way, way)
            try:
                scene = Scene.of(TopDownView.of(obj, camera))
                self._check(scene)
                break
            except ForetraceError as error:
                if given is not None:
                    raise PlanningError(f"this object cannot be taken: {error}") from error
                reason = str(error)
        else:
            raise PlanningError(f"none of 100 drawn objects can be taken; the last one: {reason}")
        physics = Physics()
        if self.randomise:
            physics = Physics(**{name: float(rng.uniform(*getattr(RANDOMISED, name))) for name in TOLD})
        world = SimulatedWorld(obj, replace(self.config, physics=physics))
        self.episode = Episode(obj, camera, scene, scene, physics, world)
        return self._observation(), {"object": obj, "physics": physics}

    def _check(self, scene: Scene) -> None:
        """Refuse a goal that this object cannot have, or has reached before the first of several steps.

        Raises:
            PlanningError: Naming it.
        """
        self.goal.check(scene.outline)
        if self.steps == 1 or not self.goal.tells_reached():
            return
        if judge_rest(self.goal, scene, com_of(scene), np.eye(4)).reached:
            raise PlanningError(f"the goal {describe(self.goal)} is reached already: give another one")

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Lever the object up.

        Returns:
            Observation, reward, whether the episode ended, whether it was cut off, and more: ``free``, ``outcome``,
            ``broken``, ``reached``, ``contact`` and ``direction`` (view's frame) and, with several steps, ``cost`` and
            ``T_start_now``, how the object has moved since the start, in the view's frame.
        """
        now = self.episode
        if now is None or now.over:
            raise PlanningError("there is no object yet, or its episode is over: call reset first")
        lever = self.lever_up(action)
        now.steps, now.last = now.steps + 1, None
        one = Candidates(np.zeros(1), np.zeros(1), (lever,))
        info: dict[str, Any] = {"free": bool(find_free(now.scene, one)[0][0])}
        reward, ended = (REFUSED, False) if not info["free"] else self._act(now, lever, info)
        cut = not ended and now.steps >= self.steps
        if self.steps == 1:
            ended, cut = True, False
        now.over = ended or cut
        if self.render_mode == "human":
            self.render()
        return self._observation(), reward, ended, cut, info

    def _act(self, now: Episode, lever: LeverUp, info: dict[str, Any]) -> tuple[float, bool]:
        """Carry out a lever-up: reward, and whether the episode ends; what else there is to say enters the info."""
        info |= {"contact": lever.contact.tolist(), "direction": lever.direction.tolist()}
        if self.steps > 1:
            return self._act_to_rest(now, lever, info)
        effect = simulate_lever_up(now.obj, now.place(lever), now.world.config).effect
        info["outcome"] = str(effect.outcome)
        if effect.outcome not in LeverUp.outcomes:
            return REFUSED, True
        motions = _happened(effect, lever, now.scene)
        broken = [each.name for each in self.goal.constraints() if each.happens(motions)[0, 0]]
        now.last = lever, effect.com_trajectory[:, :2] @ lever.T_action_object[:2, :2] + lever.contact
        info |= {"broken": broken, "reached": bool(self.goal.reached(motions)[0, 0]) and not broken}
        return -float(self.goal.cost(motions)[0, 0]) - BROKEN * len(broken), True

    def _act_to_rest(self, now: Episode, lever: LeverUp, info: dict[str, Any]) -> tuple[float, bool]:
        """The same with the object set down in the end."""
        com = com_of(now.first)
        before = judge_rest(self.goal, now.first, com, now.T_start_now)
        info["outcome"] = outcome = now.world.act(now.place(lever), now.world.locate())
        if outcome == FAILED:
            return REFUSED, False
        after = judge_rest(self.goal, now.first, com, now.T_start_now, outcome)
        frames = now.camera.T_action_object @ now.world.played[-1].object_frame
        way = frames @ invert_transform(now.camera.T_action_object)
        now.last = lever, np.array([transform_points(each, com[None])[0, :2] for each in way])
        info |= {"cost": after.cost, "T_start_now": now.T_start_now, "broken": list(after.broken)}
        info["reached"] = after.reached and not after.broken and self.goal.tells_reached()
        ended = info["reached"]
        try:
            now.look()
        except ForetraceError as error:
            ended, info["lost"] = True, str(error)
        return before.cost - after.cost - BROKEN * len(after.broken), ended

    def lever_up(self, action: np.ndarray) -> LeverUp:
        """The lever-up that an action means, in the view's frame."""
        try:
            values = np.asarray(action, dtype=float)
        except (TypeError, ValueError):
            wanted = self.action_space.shape
            raise fault(PlanningError, False)(
                f"the action is {shown(action)}: give {wanted} finite numbers"
            ) from None
        if values.shape != self.action_space.shape or not np.isfinite(values).all():
            raise PlanningError(
                f"the action has the shape {values.shape}: give {self.action_space.shape} finite numbers"
            )
        assert self.episode is not None
        return decode_action(self.episode.scene.outline, values)

    def action_of(self, plan: Plan) -> np.ndarray:
        """The action that comes nearest to a plan that was made from the observed view."""
        assert self.episode is not None
        return encode_action(self.episode.scene.outline, plan.action, self.vary_path)

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The view from above with the last lever-up: an image (384, 384, 3), or a window for ``human``."""
        if self.render_mode is None or self.episode is None:
            return None
        image = self._picture()
        if self.render_mode == "human":
            import matplotlib.pyplot as plt

            plt.figure("foretrace/LeverUp-v1").clf()
            plt.imshow(image)
            plt.axis("off")
            plt.pause(0.01)
            return None
        return image

    def _picture(self) -> np.ndarray:
        assert self.episode is not None
        view = self.episode.scene.view
        image = np.full((VIEW_SIZE, VIEW_SIZE, 3), 255, np.uint8)
        image[view.mask] = (221, 230, 240)
        image = cv2.resize(image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_NEAREST)

        def pixels(points: np.ndarray) -> np.ndarray:
            return np.rint((view.to_pixels(np.atleast_2d(points))[:, ::-1] + 0.5) * SCALE).astype(np.int32)

        cv2.polylines(image, [pixels(self.episode.scene.outline)], True, (74, 96, 120), 1, cv2.LINE_AA)
        if self.episode.last is not None:
            lever, way = self.episode.last
            ends = pixels(np.stack([lever.contact - 0.05 * lever.direction, lever.contact]))
            cv2.arrowedLine(
                image, ends[0].tolist(), ends[1].tolist(), (213, 94, 0), 2, cv2.LINE_AA, tipLength=0.3
            )
            cv2.polylines(image, [pixels(way)], False, (0, 158, 115), 2, cv2.LINE_AA)
        return image

    def _observation(self) -> dict[str, np.ndarray]:
        assert self.episode is not None
        view, physics = self.episode.scene.view, self.episode.physics
        told = [getattr(physics, name) / nominal_constants()[name] for name in TOLD]
        return {
            "mask": view.mask.astype(np.int8),
            "height": view.height.copy(),
            "context": np.array(told, dtype=np.float32),
        }


def _draw_prism(rng: np.random.Generator) -> ObjectModel:
    return sample_prism(rng, int(rng.integers(3, 11)))


def _happened(effect: Effect, lever: LeverUp, scene: Scene) -> Motions:
    """An effect as a future that is certain."""
    turned = rotations_since_rest(effect.pose_trajectory)
    futures = Futures.point(effect.com_trajectory[None], turned[None], str(effect.outcome))
    batch = ImaginedBatch(effect.times, effect.com_trajectory[None], None, futures)
    return Motions.of(batch, [lever], scene.outline, scene.height)
