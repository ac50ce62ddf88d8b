"""A Gymnasium environment: see an object from above, choose a lever-up, and be rewarded by a goal (``foretrace[gym]``).

Importing this module registers ``foretrace/LeverUp-v1``; where the package is installed, Gymnasium does so itself.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import cv2
import gymnasium
import numpy as np
import shapely
from gymnasium import spaces
from jaxtyping import Float

from foretrace.actions import LeverUp, ToolPath
from foretrace.actions.lever_up import VARIED_ACTION
from foretrace.errors import ForetraceError, PlanningError, check_type, fault
from foretrace.geometry import inward_normals
from foretrace.imagined import Futures, ImaginedBatch, Imaginer
from foretrace.imagined.context import CONSTANTS, nominal_constants
from foretrace.imagined.observed import rotations_since_rest
from foretrace.interactions.record import Effect, Physics
from foretrace.interactions.topdown import VIEW_SIZE, TopDownView
from foretrace.objects import ObjectModel, sample_prism
from foretrace.planning import Motions, Plan, goals
from foretrace.planning.candidates import LOOK_AHEAD, Candidates, Scene, find_free
from foretrace.planning.goals import Goal, as_goal
from foretrace.planning.scores import score
from foretrace.predictor import load_imaginer
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.randomisation import RANDOMISED

ENVIRONMENT = "foretrace/LeverUp-v1"
CONE = 0.2
"""Largest angle of a lever-up to the inward normal [rad]."""
REFUSED = -1.0
"""Reward of a contact that no blade gets to."""
BROKEN = 1.0
"""What each thing that must not happen costs, where it happens."""
TOLD = tuple(name for name in CONSTANTS if name in Physics.__dataclass_fields__)
SCALE = 3
"""Pixels of a picture for one of the view."""


class LeverUpEnv(gymnasium.Env[Any, np.ndarray]):
    """One lever-up of an object that is drawn anew for each episode.

    Observation: ``mask`` and ``height`` [m] of the view from above, (128, 128), on a pixel grid that lies at random,
    and ``context``: friction, tool friction and density, relative to the nominal ones. Action, each from -1 to 1: the
    direction in which the contact lies, seen from the middle of the object, as a share of half a turn to the left of
    the view's x axis; the turn of the blade from the inward normal, as a share of `CONE`; with ``vary_path``,
    insertion, arc radius, sweep and speed within their ranges. Reward: minus the goal's cost, and minus one for each
    thing that happens which must not. An episode has one step.

    Args:
        goal: What is rewarded, in the view's frame: a goal, or a function of motions that returns costs.
        objects: Draws an object; by default the paper's prisms.
        randomise: Draw friction and density anew; they are observed.
        vary_path: Whether the action has the path's parameters.
        embodiment: ``tool`` or ``arm``.
        render_mode: ``rgb_array`` or ``human``.

    Raises:
        PlanningError: An argument is none of these.
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
    ) -> None:
        self.goal = goals.Lift() if goal is None else as_goal(goal)
        if objects is not None and not callable(objects):
            raise fault(PlanningError, False)(f"objects of type {type(objects).__name__}: give a function")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise PlanningError(f"render_mode is {render_mode!r}: choose rgb_array or human")
        self.objects = objects or _draw_prism
        self.randomise, self.vary_path, self.render_mode = randomise, vary_path, render_mode
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
        self._drawn: tuple[ObjectModel, LeverUp, Scene, Physics] | None = None
        self._last: tuple[LeverUp, Effect] | None = None
        self._over = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Draw an object, the place of the camera and the physics; ``options={"object": model}`` gives the object."""
        super().reset(seed=seed)
        rng, given = self.np_random, (options or {}).get("object")
        for _ in range(100):
            obj = self.objects(rng) if given is None else given
            check_type("object", obj, ObjectModel, PlanningError)
            angle = rng.uniform(0, 2 * np.pi)
            way = np.array([np.cos(angle), np.sin(angle)])
            middle = (obj.corners.min(axis=0) + obj.corners.max(axis=0)) / 2
            camera = LeverUp(middle - LOOK_AHEAD * way, way)
            try:
                scene = Scene.of(TopDownView.of(obj, camera))
                break
            except ForetraceError as error:
                if given is not None:
                    raise PlanningError(f"the object cannot be shown: {error}") from error
        else:
            raise PlanningError("no object of 100 drawn ones fits into the view: draw smaller ones")
        physics = Physics()
        if self.randomise:
            physics = Physics(**{name: float(rng.uniform(*getattr(RANDOMISED, name))) for name in TOLD})
        self._drawn, self._last, self._over = (obj, camera, scene, physics), None, False
        return self._observation(), {"object": obj, "physics": physics}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Lever the object up; the episode is over then."""
        if self._drawn is None or self._over:
            raise PlanningError("there is no object yet, or its episode is over: call reset first")
        obj, camera, scene, physics = self._drawn
        lever = self.lever_up(action)
        self._over = True
        one = Candidates(np.zeros(1), np.zeros(1), (lever,))
        if not find_free(scene, one)[0][0]:
            self._last = None
            return self._observation(), REFUSED, True, False, {"free": False}
        turn = camera.T_action_object[:2, :2]
        snapped = LeverUp.nearest(obj, lever.contact @ turn + camera.contact, path=lever.path)
        placed = replace(snapped, direction=lever.direction @ turn)
        config = replace(self.config, physics=physics)
        effect = simulate_lever_up(obj, placed, config).effect
        if effect.outcome not in LeverUp.outcomes:
            return self._observation(), REFUSED, True, False, {"free": True, "outcome": str(effect.outcome)}
        motions = _happened(effect, lever, scene)
        reward = -float(self.goal.cost(motions)[0, 0])
        broken = [each.name for each in self.goal.constraints() if each.happens(motions)[0, 0]]
        self._last = (lever, effect)
        info = {
            "free": True,
            "outcome": str(effect.outcome),
            "broken": broken,
            "reached": bool(self.goal.reached(motions)[0, 0]) and not broken,
            "contact": lever.contact.tolist(),
            "direction": lever.direction.tolist(),
        }
        if self.render_mode == "human":
            self.render()
        return self._observation(), reward - BROKEN * len(broken), True, False, info

    def lever_up(self, action: np.ndarray) -> LeverUp:
        """The lever-up that an action means, in the view's frame."""
        values = np.asarray(action, dtype=float)
        if values.shape != self.action_space.shape or not np.isfinite(values).all():
            raise PlanningError(
                f"the action has the shape {values.shape}: give {self.action_space.shape} finite numbers"
            )
        assert self._drawn is not None
        return _lever_up(self._drawn[2].outline, values)

    def action_of(self, plan: Plan) -> np.ndarray:
        """The action that comes nearest to a plan that was made from the observed view."""
        assert self._drawn is not None
        outline = self._drawn[2].outline
        middle = _middle(outline)
        way = plan.action.contact - middle
        share = np.arctan2(way[1], way[0]) / np.pi
        _, normal = _towards(outline, np.pi * share)
        direction = plan.action.direction
        turn = np.arctan2(normal[0] * direction[1] - normal[1] * direction[0], normal @ direction)
        values = [share, turn / CONE]
        if self.vary_path:
            parameters = plan.action.path.parameters()
            values += [
                2 * (parameters[name] - low) / (high - low) - 1 for name, (low, high) in VARIED_ACTION.items()
            ]
        return np.clip(values, -1.0, 1.0).astype(np.float32)

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The view from above with the last lever-up: an image (384, 384, 3), or a window for ``human``."""
        if self.render_mode is None or self._drawn is None:
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
        assert self._drawn is not None
        view = self._drawn[2].view
        image = np.full((VIEW_SIZE, VIEW_SIZE, 3), 255, np.uint8)
        image[view.mask] = (221, 230, 240)
        image = cv2.resize(image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_NEAREST)

        def pixels(points: np.ndarray) -> np.ndarray:
            return np.rint((view.to_pixels(np.atleast_2d(points))[:, ::-1] + 0.5) * SCALE).astype(np.int32)

        cv2.polylines(image, [pixels(self._drawn[2].outline)], True, (74, 96, 120), 1, cv2.LINE_AA)
        if self._last is not None:
            lever, effect = self._last
            ends = pixels(np.stack([lever.contact - 0.05 * lever.direction, lever.contact]))
            cv2.arrowedLine(
                image, ends[0].tolist(), ends[1].tolist(), (213, 94, 0), 2, cv2.LINE_AA, tipLength=0.3
            )
            axes = lever.T_action_object[:2, :2]
            path = pixels(effect.com_trajectory[:, :2] @ axes + lever.contact)
            cv2.polylines(image, [path], False, (0, 158, 115), 2, cv2.LINE_AA)
        return image

    def _observation(self) -> dict[str, np.ndarray]:
        assert self._drawn is not None
        view, physics = self._drawn[2].view, self._drawn[3]
        told = [getattr(physics, name) / nominal_constants()[name] for name in TOLD]
        return {
            "mask": view.mask.astype(np.int8),
            "height": view.height.copy(),
            "context": np.array(told, dtype=np.float32),
        }


class ImaginedCost:
    """What actions in the environment are expected to cost, without trying them.

    For planners that ask a world model, such as the solvers of stable-worldmodel: they call `get_cost`.

    Args:
        goal: The environment's goal; by default, to lift.
        imaginer: Imagines the lever-ups; by default the predictor that comes with the package.
    """

    def __init__(
        self, goal: Goal | Callable[..., Any] | None = None, imaginer: Imaginer | None = None
    ) -> None:
        self.goal = goals.Lift() if goal is None else as_goal(goal)
        check_type("imaginer", imaginer, (Imaginer, type(None)), PlanningError, "an imaginer of lever-ups")
        self.imaginer = load_imaginer() if imaginer is None else imaginer

    def get_cost(self, info: Mapping[str, Any], candidates: Any) -> Any:
        """Minus the expected reward of each candidate.

        Args:
            info: Observations, one for each environment, arrays or tensors: ``mask`` and ``height``,
                (B, ..., 128, 128), and ``context``, (B, ..., 3). Of several in a row, the last counts.
            candidates: Actions, an array or a tensor (B, S, 1, A) or (B, S, A), S for each environment.

        Returns:
            Costs (B, S), of the type of the candidates.

        Raises:
            PlanningError: Shapes that do not fit, or numbers that are not finite.
        """
        actions = np.asarray(candidates, dtype=float)
        sizes = (2, 2 + len(VARIED_ACTION))
        if (
            actions.ndim not in (3, 4)
            or actions.shape[-1] not in sizes
            or actions.shape[2:-1] not in ((), (1,))
        ):
            raise PlanningError(
                f"candidates have the shape {actions.shape}: give (B, S, 1, A) with A = {sizes[0]} or {sizes[1]}; an "
                "episode has one action"
            )
        if not actions.size or not np.isfinite(actions).all():
            raise PlanningError(
                "candidates are none, or not all finite: give numbers, of which -1 to 1 count"
            )
        count, actions = len(actions), actions.reshape(*actions.shape[:2], -1)
        try:
            seen = {name: np.asarray(info[name]) for name in ("mask", "height", "context")}
            last = {
                name: seen[name].reshape(count, -1, VIEW_SIZE, VIEW_SIZE)[:, -1]
                for name in ("mask", "height")
            }
            last["context"] = seen["context"].reshape(count, -1, len(TOLD))[:, -1]
        except (KeyError, TypeError, ValueError) as error:
            raise PlanningError(
                f"info is not that of {count} environments: give mask, height and context as they are observed"
            ) from error
        costs = np.stack(
            [self._costs({name: last[name][row] for name in last}, actions[row]) for row in range(count)]
        )
        return candidates.new_tensor(costs) if hasattr(candidates, "new_tensor") else costs

    def _costs(
        self, observation: dict[str, np.ndarray], actions: Float[np.ndarray, "samples action"]
    ) -> Float[np.ndarray, " samples"]:
        scene = Scene.of(observed_view(observation))
        levers = tuple(_lever_up(scene.outline, values) for values in actions)
        nowhere = np.zeros(len(levers))
        free = np.flatnonzero(find_free(scene, Candidates(nowhere, nowhere, levers))[0])
        costs = np.full(len(levers), -REFUSED)
        if len(free):
            some = [levers[k] for k in free]
            batch = self.imaginer.imagine_candidates(scene.view, some, context=observed_context(observation))
            scores = score(self.goal, Motions.of(batch, some, scene.outline, scene.height), "expected", 1.0)
            costs[free] = scores.cost + BROKEN * scores.chances.sum(axis=1)
        return costs


def observed_view(observation: dict[str, np.ndarray]) -> TopDownView:
    """The view in an observation, as imaginers and planners take it."""
    return TopDownView(observation["mask"].astype(bool), observation["height"])


def observed_context(observation: dict[str, np.ndarray]) -> dict[str, float]:
    """The physical constants in an observation [SI], as imaginers are told them."""
    told = observation["context"].astype(float)
    values = {name: float(value) * nominal_constants()[name] for name, value in zip(TOLD, told, strict=True)}
    return {**values, "contact_error": 0.0}


def register_environments() -> None:
    """Enter the environment into Gymnasium's registry, unless it is there."""
    if ENVIRONMENT not in gymnasium.registry:
        gymnasium.register(ENVIRONMENT, entry_point="foretrace.environment:LeverUpEnv")


def _draw_prism(rng: np.random.Generator) -> ObjectModel:
    return sample_prism(rng, int(rng.integers(3, 11)))


def _lever_up(outline: Float[np.ndarray, "corners 2"], values: Float[np.ndarray, " action"]) -> LeverUp:
    """The lever-up that an action means."""
    values = np.clip(values, -1.0, 1.0)
    contact, normal = _towards(outline, np.pi * values[0])
    c, s = np.cos(CONE * values[1]), np.sin(CONE * values[1])
    direction = np.array([c * normal[0] - s * normal[1], s * normal[0] + c * normal[1]])
    shares = (values[2:] + 1) / 2
    settings = {
        name: float(low + share * (high - low))
        for share, (name, (low, high)) in zip(shares, VARIED_ACTION.items(), strict=False)
    }
    return LeverUp(contact, direction, ToolPath.of(**settings) if settings else ToolPath())


def _middle(outline: Float[np.ndarray, "corners 2"]) -> Float[np.ndarray, "2"]:
    return shapely.get_coordinates(shapely.centroid(shapely.Polygon(outline)))[0]


def _towards(
    outline: Float[np.ndarray, "corners 2"], angle: float
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The outermost point of an outline in a direction from its middle, off its corners, and the normal there."""
    middle = _middle(outline)
    ray = shapely.LineString([middle, middle + 10.0 * np.array([np.cos(angle), np.sin(angle)])])
    hit = shapely.get_coordinates(shapely.intersection(ray, shapely.LinearRing(outline)))
    point = hit[np.linalg.norm(hit - middle, axis=1).argmax()]
    starts, ends = outline, np.roll(outline, -1, axis=0)
    edges = ends - starts
    lengths = np.linalg.norm(edges, axis=1)
    shares = np.clip(((point - starts) * edges).sum(axis=1) / lengths**2, 0.0, 1.0)
    nearest = int(np.linalg.norm(starts + shares[:, None] * edges - point, axis=1).argmin())
    margin = min(0.001 / lengths[nearest], 0.5)
    share = float(np.clip(shares[nearest], margin, 1 - margin))
    return starts[nearest] + share * edges[nearest], inward_normals(outline)[nearest]


def _happened(effect: Effect, lever: LeverUp, scene: Scene) -> Motions:
    """An effect as a future that is certain."""
    turned = rotations_since_rest(effect.pose_trajectory)
    futures = Futures.point(effect.com_trajectory[None], turned[None], str(effect.outcome))
    batch = ImaginedBatch(effect.times, effect.com_trajectory[None], None, futures)
    return Motions.of(batch, [lever], scene.outline, scene.height)


register_environments()
