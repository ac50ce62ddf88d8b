"""The lever-up action: a blade is pushed under the object and lifts it (paper, section 4)."""

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.actions.base import Action, minimum_jerk
from foretrace.actions.lever_up_judge import Outcome, judge_lever_up
from foretrace.actions.motion import FAILED, Judgement, Motion
from foretrace.actions.tool import Screwdriver
from foretrace.errors import ActionError, check_ranges, is_number, shown
from foretrace.objects import ObjectModel

APPROACH = (0.0035, 0.002, 0.3)
"""Free space before a sampled contact: half its width, its nearest and its farthest end [m]."""
SCREWDRIVER = Screwdriver()
BEHIND = 0.085
"""The view from above ends a little farther behind the contact than this [m]."""


@dataclass(frozen=True)
class ToolPath:
    """The open-loop path of the blade, always the same in the action frame (paper, section 4).

    The blade waits before the rim, is pushed under it, lifts on an arc about the far side while its pitch
    follows the object's tilt, and holds. Every phase starts and ends at rest (minimum-jerk time law: Flash and
    Hogan, 1985). The motion stays in the action frame's x-z plane.

    Raises:
        ActionError: If a value is out of its range.
    """

    insertion: float = 0.022
    """Distance that the blade tip is pushed under the object, past the contact point [m]."""
    arc_radius: float = 0.14
    """Radius of the arc on which the tip is lifted [m]."""
    sweep: float = 0.75
    """Angle of that arc [rad]."""
    pitch: float = 0.28
    """Pitch of the blade while it is pushed in, tip down [rad]."""
    pitch_gain: float = 0.8
    """Growth of the pitch per angle of the arc."""
    standoff: float = 0.008
    """Distance of the tip from the contact point at the start [m]."""
    clearance: float = 0.0004
    """Gap between the tip's lower edge and the table [m]."""
    wait_time: float = 0.1
    """Time at rest before the blade moves [s]."""
    insert_time: float = 0.6
    """Time to push the blade in [s]."""
    lift_time: float = 1.7
    """Time to lift [s]."""
    hold_time: float = 0.55
    """Time to hold at the end [s]."""

    def __post_init__(self) -> None:
        limits = {
            "insertion": (0.0, 0.1),
            "arc_radius": (0.02, 1.0),
            "sweep": (0.0, np.pi / 2),
            "pitch": (0.0, np.pi / 3),
            "pitch_gain": (-1.0, 2.0),
            "standoff": (0.0, 0.05),
            "clearance": (0.0, 0.01),
            "wait_time": (0.0, 10.0),
            "insert_time": (0.05, 60.0),
            "lift_time": (0.05, 60.0),
            "hold_time": (0.0, 60.0),
        }
        check_ranges(ActionError, "tool path", self, limits)

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.wait_time + self.insert_time + self.lift_time + self.hold_time

    @property
    def lift_start(self) -> float:
        """Time at which the lift begins [s]."""
        return self.wait_time + self.insert_time

    def faster(self, speed: float) -> "ToolPath":
        """The path pushed in and lifted at a multiple of its speed; it waits and holds as long as before.

        Raises:
            ActionError: If the speed is not above 0, or too high.
        """
        if not is_number(speed) or not speed > 0:
            raise ActionError(
                f"tool path: speed = {shown(speed)} times the nominal one: give a number above 0"
            )
        return replace(self, insert_time=self.insert_time / speed, lift_time=self.lift_time / speed)

    @classmethod
    def phases(cls) -> tuple[float, float]:
        """Start of the nominal path's push, and the time that it takes to push and lift, which speed shortens [s]."""
        return cls.wait_time, NOMINAL_TIME

    def at(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 3"]:
        """Blade tip over time.

        Args:
            times: Times since the start [s]; the path rests before its start and after its end.

        Returns:
            x and z of the tip's lower edge in the action frame [m] and the blade's pitch [rad], tip down.
        """
        inserted = minimum_jerk((times - self.wait_time) / self.insert_time)
        angle = self.sweep * minimum_jerk((times - self.lift_start) / self.lift_time)
        x = -self.standoff + (self.insertion + self.standoff) * inserted
        x = x + self.arc_radius * (1 - np.cos(angle))
        z = self.clearance + self.arc_radius * np.sin(angle)
        return np.stack([x, z, self.pitch + self.pitch_gain * angle], axis=-1)

    def parameters(self) -> dict[str, float]:
        """``insertion`` [m], ``arc_radius`` [m], ``sweep`` [rad] and ``speed`` as a multiple of the nominal path's."""
        speed = NOMINAL_TIME / (self.insert_time + self.lift_time)
        return {
            "insertion": self.insertion,
            "arc_radius": self.arc_radius,
            "sweep": self.sweep,
            "speed": speed,
        }

    @classmethod
    def of(cls, speed: float = 1.0, **settings: Any) -> "ToolPath":
        """The nominal path with other settings, pushed in and lifted at a multiple of its speed.

        Raises:
            ActionError: One of them is out of its range.
        """
        return cls(**settings).faster(speed)


VARIED_ACTION = {
    "insertion": (0.012, 0.03),
    "arc_radius": (0.10, 0.18),
    "sweep": (0.45, 1.0),
    "speed": (2 / 3, 1.5),
}
"""Ranges of a path's parameters around the nominal ones, within the arm's reach and speed: what
``foretrace simulate --vary-action`` draws from, and a planner that may vary the path."""
NOMINAL_TIME = ToolPath.insert_time + ToolPath.lift_time
"""Time in which the nominal path is pushed in and lifted [s]."""


@dataclass(frozen=True, eq=False)
class LeverUp(Action):
    """A lever-up, placed on its object (paper, section 4).

    Raises:
        ActionError: If a value is not finite or the direction has no length.
    """

    label = "lever-up"
    outcomes = tuple(str(outcome) for outcome in Outcome if outcome != FAILED)
    approach = APPROACH
    units = MappingProxyType(
        {
            "insertion": "in m",
            "arc_radius": "in m",
            "sweep": "in rad",
            "speed": "as a multiple of the nominal one",
        }
    )
    varied = VARIED_ACTION
    sets_down = True
    path: ToolPath = ToolPath()
    """Path of the blade's tip."""
    tool: Screwdriver = SCREWDRIVER
    """The screwdriver."""

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.path.duration

    def tool_motion(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 6"]:
        """Planned motion of the blade's tip: x, z and pitch change."""
        coordinates = np.zeros((len(times), 6))
        coordinates[:, [0, 2, 4]] = self.path.at(times)
        return coordinates

    def judge(self, motion: Motion, obj: ObjectModel, com: Float[np.ndarray, "time 3"]) -> Judgement:
        """Outcome, slip and support points; the same rules for simulated and for recorded lever-ups."""
        return judge_lever_up(motion, obj, com, self.T_action_object)

    def parameters(self) -> dict[str, float]:
        """``insertion``, ``arc_radius``, ``sweep`` and ``speed`` of the path [SI] (paper, section 6)."""
        return self.path.parameters()

    @classmethod
    def path_of(cls, **parameters: float) -> ToolPath:
        """The nominal path with other parameters."""
        return ToolPath.of(**parameters)

    def settings(self) -> dict[str, float]:
        """Parameters and other values of the path; times that the speed scales are those at the nominal speed."""
        parameters = self.parameters()
        scaled = {
            name: getattr(self.path, name) * parameters["speed"] for name in ("insert_time", "lift_time")
        }
        return vars(self.path) | scaled | parameters


def sample_contacts(obj: ObjectModel, rng: np.random.Generator, per_edge: int = 2) -> list[LeverUp]:
    """Lever-ups at uniformly sampled points of every edge (paper, section 4: two on each edge)."""
    return [
        LeverUp.at_edge(obj, edge, rng.uniform(np.nextafter(0.0, 1.0), 1.0))
        for edge in range(len(obj.corners))
        for _ in range(per_edge)
    ]


def sample_reachable_contacts(obj: ObjectModel, rng: np.random.Generator, count: int) -> list[LeverUp]:
    """Lever-ups uniformly over the length of an outline, wherever a blade gets there straight from outside.

    For outlines of many short edges, where two at each edge would be too many, and for outlines with dents, some of
    which are too narrow for a blade. Nothing of the object lies more than ``BEHIND`` behind the contact.
    """
    starts, stops = obj.corners, np.roll(obj.corners, -1, axis=0)
    lengths = np.linalg.norm(stops - starts, axis=1)
    outline = shapely.Polygon(obj.corners)
    side, near, far = APPROACH
    actions: list[LeverUp] = []
    while len(actions) < count:
        action = LeverUp.at_edge(
            obj,
            int(rng.choice(len(lengths), p=lengths / lengths.sum())),
            rng.uniform(np.nextafter(0.0, 1.0), 1.0),
        )
        way = [action.contact - distance * action.direction for distance in (near, far)]
        free = not shapely.intersects(outline, shapely.LineString(way).buffer(side, cap_style="flat"))
        if free and ((obj.corners - action.contact) @ action.direction).min() > -BEHIND:
            actions.append(action)
    return actions
