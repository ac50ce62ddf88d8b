"""An object on a table in simulation: actions are carried out on it, one after the other, until it rests."""

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.actions import FAILED, Action
from foretrace.errors import SimulationError, check_type
from foretrace.geometry import invert_transform, planar_transform, pose_to_matrix
from foretrace.objects import ObjectModel
from foretrace.simulation.engine import make_engine
from foretrace.simulation.lever_up import SimulationConfig, effect_of

USUAL = SimulationConfig(embodiment="tool")
LEANING = 0.995
"""An object whose own z axis has a smaller vertical part lies on another side."""


@dataclass(frozen=True, eq=False)
class Played:
    """What one action did, on the table."""

    times: Float[np.ndarray, " time"]
    """Time since the start of the action [s]."""
    object_frame: Float[np.ndarray, "time 4 4"]
    """The object's frame."""
    tool: Float[np.ndarray, "time 2"]
    """Place of the tool's tip from above [m]."""

    @property
    def period(self) -> float:
        """Time between samples [s]."""
        return float(self.times[1] - self.times[0])


class SimulatedWorld:
    """An object on a table; it lies flat, and everything about it is known but to those who plan.

    Args:
        obj: The object.
        config: How actions are simulated; its physics are those of this world.
        seen: What is observed in place of the object itself, in the same frame: an object that is told less about.

    Raises:
        SimulationError: An argument is of another type.
    """

    def __init__(
        self,
        obj: ObjectModel,
        config: SimulationConfig = USUAL,
        seen: ObjectModel | None = None,
    ) -> None:
        check_type("obj", obj, ObjectModel, SimulationError)
        check_type("config", config, SimulationConfig, SimulationError)
        check_type("seen", seen, (ObjectModel, type(None)), SimulationError)
        self.object, self.config = obj, config
        self.T_table_object = np.eye(4)
        """The object's frame on the table."""
        self.played: list[Played] = []
        """What each action did that moved the tool."""
        self._seen = obj if seen is None else seen

    def observe(self) -> ObjectModel:
        """The object.

        Raises:
            SimulationError: It lies on another side than at first, on which nothing is known of it.
        """
        if self.T_table_object[2, 2] < LEANING:
            raise SimulationError(
                "the object lies on another side: begin anew with the object as it lies now"
            )
        return self._seen

    def locate(self) -> Float[np.ndarray, "4 4"]:
        """The object's frame on the table."""
        return self.T_table_object.copy()

    def act(self, action: Action, T_table_object: Float[np.ndarray, "4 4"]) -> str:
        """Carry out an action until the object rests; returns its outcome.

        Args:
            action: The action, in an object frame.
            T_table_object: That frame on the table, such as `locate` tells it, or where the object is expected.
        """
        T_action_table = action.T_action_object @ invert_transform(T_table_object)
        pose = T_action_table @ self.T_table_object
        if pose[2, 2] < LEANING or self._blocked(action, pose):
            return FAILED
        config = self.config
        engine = make_engine(config.engine, config.embodiment, config.timestep, config.sample_period)
        duration = np.ceil(action.time_to_rest / config.sample_period - 1e-9) * config.sample_period
        motion = engine.play(
            self.object, pose, action.tool, action.motion_to_rest, float(duration), config.physics
        )
        effect = effect_of(motion, self.object, action, config.physics, to_rest=True)
        if effect.outcome != FAILED:
            poses = invert_transform(T_action_table) @ pose_to_matrix(effect.pose_trajectory)
            tool = invert_transform(T_action_table) @ pose_to_matrix(effect.tool_trajectory)
            self.played.append(Played(effect.times, poses, tool[:, :2, 3]))
            self.T_table_object = _flat(poses[-1])
        return str(effect.outcome)

    def _blocked(self, action: Action, pose: Float[np.ndarray, "4 4"]) -> bool:
        """Whether the object lies where the tool would begin."""
        outline = shapely.Polygon(self.object.corners @ pose[:2, :2].T + pose[:2, 3])
        half, near, _ = action.approach
        return bool(shapely.distance(outline, shapely.Point(-near - half, 0.0)) < half)


def _flat(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The pose of an object that lies flat, without what contacts give way; any other one as it is."""
    if pose[2, 2] < LEANING:
        return pose
    return planar_transform([*pose[:2, 3], 0.0], float(np.arctan2(pose[1, 0], pose[0, 0])))
