"""What a visitor chooses, within limits, and how that becomes text for a link."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal
from urllib.parse import quote, unquote

import numpy as np

from foretrace.actions import ToolPath
from foretrace.actions.lever_up import VARIED_ACTION
from foretrace.errors import StudioError, check_choices, check_type, is_number, shown
from foretrace.imagined.belief import RANGES
from foretrace.imagined.context import BEVELS, EXACT
from foretrace.objects import Bevel, MeshObject, ObjectModel, Prism
from foretrace.planning import goals
from foretrace.studio.shapes import EXAMPLES, checked, example

LARGEST_TURN = float(np.deg2rad(35.0))
"""Largest angle of the direction to the inward normal [rad]."""
PHYSICS = ("friction", "tool_friction", "density")
"""Constants that may be unknown."""
LIMITS: Mapping[str, tuple[float, float]] = {
    "along": (0.0, 1.0),
    "turn": (-LARGEST_TURN, LARGEST_TURN),
    **VARIED_ACTION,
    **{name: RANGES[name] for name in PHYSICS},
    "angle": (0.1, 1.2),
    "heading": (-np.pi, np.pi),
    "distance": (0.0, 0.1),
}
"""Least and greatest value of each number [SI]."""
FIRST = "pentagon"
"""The object at first."""
UNKNOWN = "unknown"
DIGITS = 5
MOST_LINK = 8000
"""Longest text of a link [characters]."""

GoalName = Literal["lift", "tilt", "tumble", "turn-over", "move", "move-to"]
ImaginerName = Literal["learned", "twin"]


@dataclass(frozen=True)
class Choices:
    """All that a visitor has chosen; what is seen follows from it.

    Raises:
        StudioError: A value is out of its range.
    """

    object: ObjectModel = field(default_factory=lambda: EXAMPLES[FIRST])
    """The object."""
    along: float = 0.1
    """Where on the outline the blade meets it, as a share of its length from the first corner on."""
    turn: float = 0.0
    """Angle of the action to the left of the inward normal [rad]."""
    insertion: float = ToolPath.insertion
    """How far the blade is pushed under the object [m]."""
    arc_radius: float = ToolPath.arc_radius
    """Radius of the arc on which it lifts [m]."""
    sweep: float = ToolPath.sweep
    """Angle of that arc [rad]."""
    speed: float = 1.0
    """Speed, as a multiple of the nominal one."""
    friction: float | None = 0.8
    """Friction of object and table; None: unknown."""
    tool_friction: float | None = 0.3
    """Friction of object and blade; None: unknown."""
    density: float | None = 600.0
    """Density [kg/m^3]; None: unknown."""
    exact: bool = True
    """Whether the contact is executed as commanded."""
    imaginer: ImaginerName = "learned"
    """Who imagines: the predictor that comes with foretrace, or the twin."""
    goal: GoalName = "lift"
    """What a plan is to reach."""
    angle: float = 0.5
    """Angle of the goal tilt [rad]."""
    heading: float = 0.0
    """Direction of the goals turn-over, move and move-to in the object's frame [rad]."""
    distance: float = 0.03
    """Distance of the goal move-to [m]."""

    def __post_init__(self) -> None:
        check_type("object", self.object, ObjectModel, StudioError, "an object")
        for name, (low, high) in LIMITS.items():
            value: Any = getattr(self, name)
            if value is None and name in PHYSICS:
                continue
            # Sliders round: a hair beyond a limit is the limit.
            if value is None or not is_number(value) or not low - 1e-9 <= value <= high + 1e-9:
                raise StudioError(f"{name} is {shown(value)}: give a number from {low:.4g} to {high:.4g}")
            object.__setattr__(self, name, float(np.clip(value, low, high)))
        check_choices(StudioError, self)

    @property
    def path(self) -> ToolPath:
        """The blade's path."""
        return ToolPath.of(**{name: getattr(self, name) for name in VARIED_ACTION})

    @property
    def context(self) -> dict[str, float]:
        """What an imaginer is told [SI]; what is unknown is left out."""
        told = {name: value for name in PHYSICS if (value := getattr(self, name)) is not None}
        bevel = self.object.bevel if isinstance(self.object, Prism | MeshObject) else None
        own = {} if bevel is None else dict(zip(BEVELS, (bevel.width, bevel.height), strict=True))
        return told | own | ({EXACT: 0.0} if self.exact else {})

    @property
    def wanted(self) -> goals.Goal:
        """The goal."""
        way = (float(np.cos(self.heading)), float(np.sin(self.heading)))
        if self.goal == "tilt":
            return goals.Tilt(self.angle)
        if self.goal == "turn-over":
            return goals.TurnOver(direction=way)
        if self.goal == "move":
            return goals.Move(way)
        if self.goal == "move-to":
            com = self.object.mass_properties(1.0).com[:2]
            return goals.MoveTo(tuple((com + self.distance * np.array(way)).tolist()))
        return goals.Tumble() if self.goal == "tumble" else goals.Lift()

    def changed(self, **changes: Any) -> "Choices":
        """The same with other values.

        Raises:
            StudioError: A value is out of its range, or there is none of that name.
        """
        known = {each.name for each in fields(self)}
        if odd := [name for name in changes if name not in known]:
            raise StudioError(f"there is no choice {shown(odd[0])}: choose from {', '.join(sorted(known))}")
        return replace(self, **changes)

    def to_text(self) -> str:
        """All that differs from the first choices, as ``name:value`` with commas between, for links.

        Raises:
            StudioError: The object is a mesh, which is too long for a link.
        """
        parts = []
        first = Choices()
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name == "object":
                parts += [] if value is first.object else [f"object:{_object_text(value)}"]
            elif value != getattr(first, each.name):
                parts.append(f"{each.name}:{_plain(value)}")
        return ",".join(parts)

    @staticmethod
    def from_text(text: str) -> "Choices":
        """The choices of a link.

        Raises:
            StudioError: It is none that `to_text` wrote.
            ShapeError: It describes no object.
        """
        if len(text) > MOST_LINK:
            raise StudioError(f"the link is {len(text)} characters long: give at most {MOST_LINK}")
        found: dict[str, Any] = {}
        for part in filter(None, unquote(text).split(",")):
            name, colon, value = part.partition(":")
            if not colon or name not in Choices.__dataclass_fields__:
                raise StudioError(f"the link says {shown(part)}: give name:value, as the studio writes it")
            found[name] = _object_of(value) if name == "object" else _value_of(name, value)
        return Choices(**found)


def _plain(value: Any) -> str:
    if value is None:
        return UNKNOWN
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else str(value)


def _value_of(name: str, text: str) -> Any:
    if name in ("goal", "imaginer"):
        return text
    if name == "exact":
        if text not in ("True", "False"):
            raise StudioError(f"the link says exact:{shown(text)}: give True or False")
        return text == "True"
    if text == UNKNOWN:
        return None
    try:
        return float(text)
    except ValueError:
        raise StudioError(f"the link says {name}:{shown(text)}: give a number") from None


def _object_text(obj: ObjectModel) -> str:
    """An example's name, or height, bevel and corners in tenths of a millimetre."""
    for name, each in EXAMPLES.items():
        if each is obj:
            return name
    if not isinstance(obj, Prism):
        raise StudioError(f"a {obj.kind} does not fit into a link: save the Python lines")
    sizes = [obj.height, obj.bevel.width, obj.bevel.height]
    numbers = np.round(1e4 * np.concatenate([sizes, obj.corners.ravel()])).astype(int)
    return "_".join(map(str, numbers.tolist()))


def _object_of(text: str) -> ObjectModel:
    if text[:1].isalpha():
        return example(text)
    try:
        numbers = 1e-4 * np.array([int(each) for each in text.split("_")], dtype=float)
        height, width, depth = numbers[:3].tolist()
        corners = numbers[3:].reshape(-1, 2)
    except (ValueError, OverflowError):
        raise StudioError(
            f"the link says object:{shown(text)}: give a name, or height, bevel and corners in tenths of a millimetre"
        ) from None
    return checked(Prism(corners, height, Bevel(width, depth)))


def link_of(address: str, choices: Choices) -> str:
    """Address of a page with these choices.

    The browser's page passes what follows the address of its websocket on to the server.

    Args:
        address: Host and port of the page.
        choices: The choices.

    Raises:
        StudioError: They do not fit into a link.
    """
    text = quote(choices.to_text(), safe=":,_-.")
    return f"http://{address}/?websocket=ws://{address}/{text}" if text else f"http://{address}/"
