"""The planar push: a vertical rod moves in a straight line and slides an object over the table."""

from dataclasses import asdict, dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.actions.base import Action
from foretrace.actions.motion import FAILED, Judgement, Motion
from foretrace.actions.tool import Rod
from foretrace.errors import ActionError, check_ranges
from foretrace.geometry import quaternion_to_matrix, tilt
from foretrace.objects import ObjectModel

ROD = Rod(radius=0.00475)
MOVED, TURNED = 0.001, np.deg2rad(1.0)
"""An object that moves [m] and turns [rad] by less has been missed."""
TIPPED = np.deg2rad(10.0)
"""An object that tilts by more than this has tipped [rad]."""
LOST_GAP = 0.0015
"""A rod that ends farther than this from the object has lost it [m]."""
DEEPEST = 0.002
"""A rod that starts farther inside an object than this is refused [m]."""
SHORTEST = 0.0005
"""Shortest motion of a rod [m]."""
RAMP = 0.05
"""Time in which the rod gains or loses its speed [s]."""


class PushOutcome(StrEnum):
    """What became of a pushed object, judged once the rod has come to rest."""

    PUSHED = "pushed"
    """Moved, and the rod touches it at the end."""
    TURNED_AWAY = "turned away"
    """Moved, and left by the rod before the end: it turned out of the way."""
    TIPPED = "tipped"
    """Tilted over an edge."""
    MISSED = "missed"
    """Not moved."""
    FAILED = FAILED
    """The simulation diverged; there is no effect to learn from."""


PUSHED, TURNED_AWAY, MISSED = (
    str(each) for each in (PushOutcome.PUSHED, PushOutcome.TURNED_AWAY, PushOutcome.MISSED)
)


def find_missed(shift: Any, turn: Any) -> Any:
    """Whether objects that moved [m] and turned [rad] by so much have been missed."""
    return (shift < MOVED) & (np.abs(turn) < TURNED)


@dataclass(frozen=True)
class PushPath:
    """The straight, open-loop path of the rod: it waits, moves at a constant speed along x, and holds.

    Raises:
        ActionError: If a value is out of its range.
    """

    distance: float = 0.05
    """Distance that the rod moves on from where it would touch the contact point [m]."""
    speed: float = 0.02
    """Speed of the rod [m/s]."""
    approach: float = 0.005
    """Gap between the rod and the contact point at the start, along the path [m]."""
    clearance: float = 0.002
    """Gap between the rod's lower end and the table [m]."""
    wait_time: float = 0.1
    """Time at rest before the rod moves [s]."""
    hold_time: float = 0.1
    """Time to hold at the end [s]."""

    def __post_init__(self) -> None:
        limits = {
            "distance": (0.001, 0.5),
            "speed": (0.001, 1.0),
            "approach": (-0.05, 0.1),
            "clearance": (0.0, 0.1),
            "wait_time": (0.0, 10.0),
            "hold_time": (0.0, 60.0),
        }
        check_ranges(ActionError, "push path", self, limits)
        if self.length < SHORTEST:
            raise ActionError(
                f"push path: with approach = {self.approach:g} and distance = {self.distance:g} the rod moves by "
                f"{self.length:g} m: give {SHORTEST:g} m or more"
            )

    @property
    def length(self) -> float:
        """Length of the motion [m]."""
        return self.approach + self.distance

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.wait_time + self.length / self.speed + RAMP + self.hold_time

    def at(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
        """Distance that the rod has moved [m]; its acceleration is constant within the ramps.

        Args:
            times: Times since the start [s].
        """
        moving = self.length / self.speed
        ramp = min(RAMP, moving)
        t = np.clip(np.asarray(times, dtype=float) - self.wait_time, 0.0, moving + ramp)
        passed = (np.maximum(t - start, 0.0) ** 2 for start in (0.0, ramp, moving, moving + ramp))
        begun, fast, slower, ended = passed
        return self.speed / (2 * ramp) * (begun - fast - slower + ended)


@dataclass(frozen=True, eq=False)
class Push(Action):
    """A push, placed on its object.

    The rod's centre moves along the line through the contact point in the action's direction, so at a slanting push
    the rod first touches the object a little beside the contact point.

    Raises:
        ActionError: If a value is not finite or the direction has no length.
    """

    label = "push"
    outcomes = tuple(str(outcome) for outcome in PushOutcome if outcome != FAILED)
    approach = (ROD.radius, PushPath.approach, PushPath.approach + 2 * ROD.radius)
    cone = 0.7
    units = MappingProxyType({"distance": "in m", "speed": "in m/s", "approach": "in m"})
    varied = MappingProxyType({"distance": (0.002, 0.1)})
    path_matters = True
    path: PushPath = PushPath()
    """Path of the rod."""
    tool: Rod = ROD
    """The rod."""

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.path.duration

    def tool_motion(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 6"]:
        """Planned motion of the rod's lower end, which points down: x alone changes."""
        coordinates = np.zeros((len(times), 6))
        coordinates[:, 0] = self.path.at(times) - self.path.approach - self.tool.radius
        coordinates[:, 2], coordinates[:, 4] = self.path.clearance, np.pi / 2
        return coordinates

    def judge(self, motion: Motion, obj: ObjectModel, com: Float[np.ndarray, "time 3"]) -> Judgement:
        """Outcome of a simulated or recorded push; the motion's ends are enough."""
        rotation = quaternion_to_matrix(motion.object_pose[:, 3:])
        if tilt(rotation).max() > TIPPED:
            return Judgement(PushOutcome.TIPPED)
        turn = rotation[0].T @ rotation[-1]
        shift = np.linalg.norm(com[-1, :2] - com[0, :2])
        if find_missed(shift, np.arctan2(turn[1, 0], turn[0, 0])):
            return Judgement(PushOutcome.MISSED)
        outline = obj.corners @ rotation[-1, :2, :2].T + motion.object_pose[-1, :2]
        gap = (
            shapely.distance(shapely.Polygon(outline), shapely.Point(motion.tool_pose[-1, :2]))
            - self.tool.radius
        )
        return Judgement(PushOutcome.TURNED_AWAY if gap > LOST_GAP else PushOutcome.PUSHED)

    def check_contact(self, obj: ObjectModel) -> None:
        """Refuse a push that does not start on an object's outline, or whose rod starts inside the object.

        Raises:
            ActionError: Naming how far it is off.
        """
        super().check_contact(obj)
        start = self.contact - (self.path.approach + self.tool.radius) * self.direction
        outline = shapely.Polygon(obj.corners)
        inside = self.tool.radius - float(shapely.distance(outline, shapely.Point(start)))
        if inside > DEEPEST:
            raise ActionError(
                f"the rod starts {1000 * inside:.1f} mm inside the object: give a direction into it, or a "
                f"longer approach than {self.path.approach:g} m"
            )

    def parameters(self) -> dict[str, float]:
        """``distance`` [m], ``speed`` [m/s] and ``approach`` [m] of the path."""
        return {name: value for name, value in asdict(self.path).items() if name in self.units}


AHEAD = 0.005
"""The middle of a pushed object lies at least this far ahead of a sampled contact [m]."""
BEHIND, BESIDE = 0.085, 0.19
"""The view from above ends a little farther behind and beside the contact than this [m]."""
WIDEST = np.deg2rad(50.0)
"""Largest angle of a sampled push's direction from the inward normal [rad]."""


def sample_pushes(obj: ObjectModel, rng: np.random.Generator, count: int) -> list[Push]:
    """Pushes uniformly over the length of an outline, within a cone about the inward normal, inside the view.

    Args:
        obj: The object.
        rng: Random numbers.
        count: Number of pushes.
    """
    starts, stops = obj.corners, np.roll(obj.corners, -1, axis=0)
    lengths = np.linalg.norm(stops - starts, axis=1)
    pushes: list[Push] = []
    outline = shapely.Polygon(obj.corners)
    while len(pushes) < count:
        edge = int(rng.choice(len(lengths), p=lengths / lengths.sum()))
        head_on = Push.at_edge(obj, edge, rng.uniform(np.nextafter(0.0, 1.0), 1.0))
        push = head_on.moved(0.0, 0.0, rng.uniform(-WIDEST, WIDEST))
        start = push.contact - (push.path.approach + push.tool.radius) * push.direction
        # At a slanting push beside a corner or in a dent the rod would start inside the object.
        free = shapely.distance(outline, shapely.Point(start)) > push.tool.radius
        left = np.array([-push.direction[1], push.direction[0]])
        behind, beside = (((obj.corners - push.contact) @ axis) for axis in (push.direction, left))
        middle = (shapely.get_coordinates(outline.centroid)[0] - push.contact) @ push.direction
        if free and middle > AHEAD and behind.min() > -BEHIND and np.abs(beside).max() < BESIDE:
            pushes.append(push)
    return pushes
