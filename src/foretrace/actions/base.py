"""The contract of an action: where it meets the object, how its tool moves, and what may come of it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Annotated, Any, ClassVar, TypeVar, get_type_hints

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.actions.motion import FAILED, Judgement, Motion
from foretrace.actions.tool import Tool
from foretrace.errors import ActionError, check_type, fault, is_number, is_whole, shown
from foretrace.geometry import Numbers, inward_normals
from foretrace.objects import ObjectModel
from foretrace.registry import Registry

CORNER_MARGIN = 0.001
"""A contact point snapped to the outline keeps this distance from the corners [m]."""
LARGEST_SNAP = 0.02
"""A contact point farther from the outline is a mistake and is not moved there [m]."""
CONTACT_TOLERANCE = 0.005
"""A contact may lie this far from the outline, as when it was measured with an error [m]."""
FARTHEST = 100.0
"""A contact with a larger coordinate is a mistake, such as one in other units [m]."""
SHORTEST, LONGEST = 1e-9, 1e9
"""Bounds of a given direction's length, which does not matter otherwise."""
SETTLE_TIME = 0.3
"""Time in which an object comes to rest after an action [s]."""
UNIT_TOLERANCE = 1e-9
"""A stored direction differs from unit length by less than this."""

Placed = TypeVar("Placed", bound="Action")
ACTIONS: Registry[type["Action"]] = Registry("action", "foretrace.actions", ActionError)
"""Every action by its label."""


@dataclass(frozen=True, eq=False)
class Action(ABC):
    """An action, placed on its object.

    A subclass is a frozen dataclass (``eq=False``) with a label, outcomes and defaults for path and tool; it registers
    itself. All that decides its motion is in the four fields: a path is a frozen dataclass of numbers.

    Raises:
        ActionError: If a value is not finite or the direction has no length.
    """

    label: ClassVar[str]
    """Name in records and messages."""
    outcomes: ClassVar[tuple[str, ...]]
    """What its judge can conclude; beside them, every action can have `FAILED`."""
    approach: ClassVar[tuple[float, float, float]] = (0.0035, 0.002, 0.3)
    """Free space that the tool takes before a contact: half its width, its nearest and its farthest end [m]."""
    cone: ClassVar[float] = 0.2
    """Largest angle between direction and inward normal that a planner tries by default [rad]."""
    units: ClassVar[Mapping[str, str]] = {}
    """Units of the path's parameters, in words: ``in m``. One that is not here is in SI units."""
    varied: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Parameters of the path that a planner may vary, with their ranges [SI]."""
    path_matters: ClassVar[bool] = False
    """Whether a planner varies the path by default."""
    sets_down: ClassVar[bool] = False
    """Whether the object comes to rest only when the tool goes back the way it came."""

    contact: Annotated[Any, Float[np.ndarray, "2"]]
    """Point of the outline where the tool meets it, in the object frame [m]."""
    direction: Annotated[Any, Float[np.ndarray, "2"]]
    """Unit vector along which the tool goes, in the object frame; usually the inward edge normal."""
    path: Any
    """Parameters of the tool's path in the action frame: a frozen dataclass of numbers."""
    tool: Tool
    """The tool."""

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if "label" not in cls.__dict__:
            return
        outcomes = getattr(cls, "outcomes", ())
        named = len(outcomes) > 0 and all(isinstance(name, str) and name for name in outcomes)
        if not named or len({*outcomes, FAILED}) <= len(outcomes):
            raise TypeError(
                f"action {shown(cls.label)}: outcomes = {shown(outcomes)}: name some, each once, none {shown(FAILED)}"
            )
        ACTIONS.add(cls.label, cls)

    def __post_init__(self) -> None:
        contact = plane_vector("contact", self.contact)
        direction = plane_vector("direction", self.direction)
        longest = np.abs(direction).max()  # within bounds before it is squared
        if longest > LONGEST or (length := np.linalg.norm(direction)) < SHORTEST:
            wrong = "is too long" if longest > LONGEST else "has no length"
            raise ActionError(f"direction {direction.tolist()} {wrong}: give a unit vector into the object")
        if (far := np.abs(contact).max()) > FARTHEST:
            raise ActionError(
                f"contact {contact.tolist()} lies {far:g} m away: give metres, up to {FARTHEST:g} m"
            )
        self._place(contact, direction / length)
        for name, kind in _kinds(type(self)).items():
            if not isinstance(getattr(self, name), kind):
                raise ActionError(
                    f"{self.label}: {name} = {shown(getattr(self, name))}: give a {kind.__name__}"
                )

    def _place(self, contact: np.ndarray, direction: np.ndarray) -> None:
        for name, vector in (("contact", contact), ("direction", direction)):
            vector.setflags(write=False)
            object.__setattr__(self, name, vector)

    @property
    @abstractmethod
    def duration(self) -> float:
        """Time from start to end [s]."""

    @abstractmethod
    def tool_motion(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 6"]:
        """Planned motion of the tool's frame in the action frame.

        Args:
            times: Times since the start [s]; the tool rests before its start and after its end.

        Returns:
            Position [m] and rotation vector [rad]; the tool turns about one axis of the action frame at most.
        """

    def motion_to_rest(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 6"]:
        """As `tool_motion`, but the tool then goes back the way it came, where that `sets_down` the object."""
        if not self.sets_down:
            return self.tool_motion(times)
        times = np.asarray(times, dtype=float)
        return self.tool_motion(np.where(times <= self.duration, times, 2 * self.duration - times))

    @property
    def time_to_rest(self) -> float:
        """Time until the object has come to rest, the tool back where it began if it `sets_down` [s]."""
        return (2 if self.sets_down else 1) * self.duration + SETTLE_TIME

    @abstractmethod
    def judge(self, motion: Motion, obj: ObjectModel, com: Float[np.ndarray, "time 3"]) -> Judgement:
        """What became of the object.

        Args:
            motion: What was seen; it did not diverge. Without an observed contact, the object's motion alone decides.
            obj: The object.
            com: Centre of mass in the action frame [m].
        """

    @abstractmethod
    def parameters(self) -> dict[str, float]:
        """Parameters of the path by name [SI], which predictors can be conditioned on."""

    @classmethod
    def nominal_parameters(cls) -> dict[str, float]:
        """Parameters of the default path."""
        return cls.nominal().parameters()

    @classmethod
    def nominal(cls: type[Placed]) -> Placed:
        """The action on its default path, at the origin along x."""
        return cls((0.0, 0.0), (1.0, 0.0))  # pyright: ignore[reportCallIssue]

    @classmethod
    def path_of(cls, **parameters: float) -> Any:
        """The default path with other parameters.

        Raises:
            ActionError: One of them is out of its range.
        """
        return replace(cls.nominal().path, **parameters)

    def settings(self) -> dict[str, float]:
        """All that decides the path, by name: its `parameters`, and its other values."""
        return vars(self.path) | self.parameters()

    @classmethod
    def at_edge(
        cls: type[Placed], obj: ObjectModel, edge: int, fraction: float = 0.5, **settings: Any
    ) -> Placed:
        """The action at a fraction of an edge, along its inward normal.

        Args:
            obj: The object.
            edge: Number of the edge; edge k runs from corner k to corner k + 1.
            fraction: Share of the edge before the contact, strictly between 0 and 1.
            **settings: Path and tool, if not the default ones.

        Raises:
            ActionError: If there is no such edge or the fraction leaves it.
        """
        check_type("obj", obj, ObjectModel, ActionError)
        num_edges = len(obj.corners)
        if not is_whole(edge, 0, num_edges - 1):
            raise ActionError(
                f"edge {shown(edge)} of an object with {num_edges} edges: choose 0 to {num_edges - 1}"
            )
        if not is_number(fraction) or not 0 < fraction < 1:
            raise ActionError(
                f"fraction {shown(fraction)} of an edge: choose one between 0 and 1, both excluded"
            )
        start, stop = obj.corners[edge], obj.corners[(edge + 1) % num_edges]
        return cls(start + fraction * (stop - start), inward_normals(obj.corners)[edge], **settings)

    @classmethod
    def nearest(cls: type[Placed], obj: ObjectModel, point: Numbers, **settings: Any) -> Placed:
        """The action at the point of the outline nearest to a given one, along that edge's inward normal.

        Near a corner the contact keeps a millimetre from it (or half of a shorter edge), on the edge that
        faces the point more directly. A point farther than `LARGEST_SNAP` from the outline is a mistake.

        Args:
            obj: The object.
            point: The point, in the object frame [m].
            **settings: Path and tool, if not the default ones.

        Raises:
            ActionError: If the point is not finite or too far from the outline.
        """
        check_type("obj", obj, ObjectModel, ActionError)
        point = plane_vector("contact point", point)
        starts, stops = obj.corners, np.roll(obj.corners, -1, axis=0)
        lengths = np.linalg.norm(stops - starts, axis=1)
        along = ((point - starts) * (stops - starts)).sum(axis=1) / lengths**2
        margin = np.minimum(CORNER_MARGIN / lengths, 0.5)
        fractions = np.clip(along, margin, 1 - margin)
        contacts = starts + fractions[:, None] * (stops - starts)
        with np.errstate(over="ignore"):
            gaps = np.linalg.norm(contacts - point, axis=1)
        edge = int(np.argmin(gaps))
        if gaps[edge] > LARGEST_SNAP:
            near = contacts[edge]
            raise ActionError(
                f"contact point ({point[0]:.4g}, {point[1]:.4g}) m lies {gaps[edge]:.3g} m from the outline, whose "
                f"nearest place is ({near[0]:.4g}, {near[1]:.4g}): choose one within {LARGEST_SNAP} m of it, in metres"
            )
        return cls(contacts[edge], inward_normals(obj.corners)[edge], **settings)

    def check_contact(self, obj: ObjectModel) -> None:
        """Refuse an action that does not start on an object's outline.

        Raises:
            ActionError: If the contact lies more than ``CONTACT_TOLERANCE`` from it.
        """
        distance = shapely.distance(shapely.LinearRing(obj.corners), shapely.Point(self.contact))
        if distance > CONTACT_TOLERANCE:
            x, y = self.contact
            name = type(self).__name__
            raise ActionError(
                f"contact ({x:.4f}, {y:.4f}) m lies {1e3 * distance:.1f} mm from the object's outline: "
                f"take {name}.nearest or {name}.at_edge"
            )

    def moved(self: Placed, ahead: float, left: float, turn: float) -> Placed:
        """The action shifted along its direction and to its left [m], then turned to the left [rad]."""
        for name, value in (("ahead", ahead), ("left", left), ("turn", turn)):
            if not is_number(value) or not abs(value) <= FARTHEST:
                raise ActionError(
                    f"{name} is {shown(value)}: give a number of metres or radians, up to {FARTHEST:g}"
                )
        x, y = self.direction
        contact = self.contact + ahead * np.array([x, y]) + left * np.array([-y, x])
        c, s = np.cos(turn), np.sin(turn)
        return replace(self, contact=contact, direction=np.array([c * x - s * y, s * x + c * y]))

    @property
    def T_action_object(self) -> Float[np.ndarray, "4 4"]:
        """Transform from the object frame at rest to the action frame.

        The contact point becomes the origin, the direction the x axis; z is kept.
        """
        return action_transform(self.contact, self.direction)

    def to_dict(self) -> dict[str, Any]:
        """All that decides the motion, JSON-able."""
        return {
            "label": self.label,
            "contact": self.contact.tolist(),
            "direction": self.direction.tolist(),
            "path": asdict(self.path),
            "tool": self.tool.to_dict(),
        }

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> "Action":
        """The action that `to_dict` described, with the same bits; its tool may be there already.

        Raises:
            ActionError: There is no such action, or an entry is missing or impossible.
        """
        check_type("action", content, Mapping, ActionError)
        kind = ACTIONS.find(content.get("label"))
        try:
            path = _kinds(kind)["path"](**content["path"])
            tool = content["tool"] if isinstance(content["tool"], Tool) else Tool.from_dict(content["tool"])
            action = kind(content["contact"], content["direction"], path, tool)
            direction = np.array(
                content["direction"], dtype=float
            )  # finite, and of a length, or refused above
        except (KeyError, TypeError, ValueError) as reason:
            raise ActionError(
                f"action {shown(kind.label)} cannot be read ({shown(reason)}): write it with to_dict"
            ) from None
        if abs(np.linalg.norm(direction) - 1) > UNIT_TOLERANCE:
            raise ActionError(
                f"direction {direction.tolist()} has not the length 1: write the action with to_dict"
            )
        # Dividing by a length of almost 1 once more would change its last bits.
        action._place(action.contact, direction)
        return action


@lru_cache(maxsize=64)
def _kinds(action: type[Action]) -> dict[str, type]:
    """Classes of an action's path and tool, as it declares them."""
    hints = get_type_hints(action)
    return {name: hints[name] for name in ("path", "tool")}


def action_transform(
    contact: Float[np.ndarray, "2"], direction: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "4 4"]:
    """Transform from the object frame at rest to the frame of an action with a unit direction."""
    transform = np.eye(4)
    transform[:2, :2] = [direction, [-direction[1], direction[0]]]
    transform[:2, 3] = -transform[:2, :2] @ contact
    return transform


def plane_vector(name: str, values: Any) -> Float[np.ndarray, "2"]:
    """Two finite numbers as an array of its own.

    Raises:
        ActionError: Naming the vector, if the values are anything else.
    """
    try:
        vector = np.array(values, dtype=float)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (2,) or not np.isfinite(vector).all():
        text = shown(values.tolist() if isinstance(values, np.ndarray) else values)
        raise fault(ActionError, vector.size > 0)(f"{name} {text}: expected two finite numbers, object frame")
    return vector


def minimum_jerk(phase: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
    """Smooth step from 0 to 1 with zero speed and acceleration at both ends (Flash and Hogan, 1985)."""
    s = np.clip(phase, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)
