"""What actions in the environment are expected to cost, by imagining them."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from foretrace.actions.lever_up import VARIED_ACTION
from foretrace.environment.coding import (
    BROKEN,
    REFUSED,
    TOLD,
    check_goal,
    decode_action,
    observed_context,
    observed_view,
)
from foretrace.errors import PlanningError, check_type
from foretrace.imagined import Imaginer
from foretrace.interactions.topdown import VIEW_SIZE
from foretrace.planning import Motions, goals
from foretrace.planning.candidates import Candidates, Scene, find_free
from foretrace.planning.goals import Goal, as_goal
from foretrace.planning.scores import score
from foretrace.predictor import load_imaginer


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
        check_goal(self.goal)
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
        levers = tuple(decode_action(scene.outline, values) for values in actions)
        nowhere = np.zeros(len(levers))
        free = np.flatnonzero(find_free(scene, Candidates(nowhere, nowhere, levers))[0])
        costs = np.full(len(levers), -REFUSED)
        if len(free):
            some = [levers[k] for k in free]
            batch = self.imaginer.imagine_candidates(scene.view, some, context=observed_context(observation))
            scores = score(self.goal, Motions.of(batch, some, scene.outline, scene.height), "expected", 1.0)
            costs[free] = scores.cost + BROKEN * scores.chances.sum(axis=1)
        return costs
