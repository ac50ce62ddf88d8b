"""The lever-up action: where the blade goes under the object, and which way it pushes."""

from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.errors import ActionError
from foretrace.geometry import Numbers, inward_normals
from foretrace.objects import ObjectModel

CORNER_MARGIN = 0.001
"""A contact point snapped to the outline keeps this distance from the corners [m]."""
CONTACT_TOLERANCE = 0.005
"""A contact may lie this far from the outline, as when it was measured with an error [m]."""
APPROACH = (0.0035, 0.002, 0.3)
"""What must be free before a sampled contact: this far to either side, from so near to so far away [m]."""
BEHIND = 0.085
"""The view from above ends a little farther behind the contact than this [m]."""


@dataclass(frozen=True, eq=False, init=False)
class LeverUp:
    """A lever-up, placed on its object (paper, section 4).

    Raises:
        ActionError: if a value is not finite or the direction has no length.
    """

    contact: Float[np.ndarray, "2"]
    """Where the blade meets the outline, in the object frame [m]."""
    direction: Float[np.ndarray, "2"]
    """Unit vector along which the blade is pushed, in the object frame; usually the inward edge normal."""

    def __init__(self, contact: Numbers, direction: Numbers) -> None:
        contact = plane_vector("contact", contact)
        direction = plane_vector("direction", direction)
        length = np.linalg.norm(direction)
        if length < 1e-9:
            raise ActionError(f"direction {direction.tolist()} has no length: give a vector into the object")
        object.__setattr__(self, "contact", contact)
        object.__setattr__(self, "direction", direction / length)
        self.contact.setflags(write=False)
        self.direction.setflags(write=False)

    @classmethod
    def at_edge(cls, obj: ObjectModel, edge: int, fraction: float = 0.5) -> "LeverUp":
        """The lever-up at a fraction of an edge, pushing along its inward normal.

        Args:
            obj: the object.
            edge: number of the edge; edge k runs from corner k to corner k + 1.
            fraction: how far along the edge, strictly between 0 and 1.

        Raises:
            ActionError: if there is no such edge or the fraction leaves it.
        """
        num_edges = len(obj.corners)
        if not 0 <= edge < num_edges:
            raise ActionError(f"edge {edge} of an object with {num_edges} edges: choose 0 to {num_edges - 1}")
        if not 0 < fraction < 1:
            raise ActionError(f"fraction {fraction} of an edge: choose one between 0 and 1, both excluded")
        start, stop = obj.corners[edge], obj.corners[(edge + 1) % num_edges]
        return cls(start + fraction * (stop - start), inward_normals(obj.corners)[edge])

    @classmethod
    def nearest(cls, obj: ObjectModel, point: Numbers) -> "LeverUp":
        """The lever-up at the point of the outline nearest to a given one, pushing along that edge's normal.

        Near a corner the contact keeps a millimetre from it (or half of a shorter edge), on the edge that
        faces the point more directly.

        Raises:
            ActionError: if the point is not finite.
        """
        point = plane_vector("contact point", point)
        starts, stops = obj.corners, np.roll(obj.corners, -1, axis=0)
        lengths = np.linalg.norm(stops - starts, axis=1)
        along = ((point - starts) * (stops - starts)).sum(axis=1) / lengths**2
        margin = np.minimum(CORNER_MARGIN / lengths, 0.5)
        fractions = np.clip(along, margin, 1 - margin)
        contacts = starts + fractions[:, None] * (stops - starts)
        edge = int(np.argmin(np.linalg.norm(contacts - point, axis=1)))
        return cls(contacts[edge], inward_normals(obj.corners)[edge])

    def check_contact(self, obj: ObjectModel) -> None:
        """Refuse an action that does not start on an object's outline.

        Raises:
            ActionError: if the contact lies more than ``CONTACT_TOLERANCE`` from it.
        """
        distance = shapely.distance(shapely.LinearRing(obj.corners), shapely.Point(self.contact))
        if distance > CONTACT_TOLERANCE:
            x, y = self.contact
            raise ActionError(
                f"contact ({x:.4f}, {y:.4f}) m lies {1e3 * distance:.1f} mm from the object's outline: "
                "take LeverUp.nearest or LeverUp.at_edge"
            )

    def moved(self, ahead: float, left: float, turn: float) -> "LeverUp":
        """The action shifted along its direction and to its left [m], then turned to the left [rad]."""
        x, y = self.direction
        contact = self.contact + ahead * np.array([x, y]) + left * np.array([-y, x])
        c, s = np.cos(turn), np.sin(turn)
        return LeverUp(contact, np.array([c * x - s * y, s * x + c * y]))

    @property
    def T_action_object(self) -> Float[np.ndarray, "4 4"]:
        """Transform from the object frame at rest to the action frame.

        The contact point becomes the origin, the direction the x axis; z is kept.
        """
        transform = np.eye(4)
        transform[:2, :2] = [self.direction, [-self.direction[1], self.direction[0]]]
        transform[:2, 3] = -transform[:2, :2] @ self.contact
        return transform


def plane_vector(name: str, values: Numbers) -> Float[np.ndarray, "2"]:
    """Two finite numbers as an array of its own.

    Raises:
        ActionError: naming the vector, if the values are anything else.
    """
    vector = np.array(values, dtype=float)
    if vector.shape != (2,) or not np.isfinite(vector).all():
        raise ActionError(f"{name} {vector.tolist()}: expected two finite numbers, object frame")
    return vector


def sample_contacts(obj: ObjectModel, rng: np.random.Generator, per_edge: int = 2) -> list[LeverUp]:
    """Lever-ups at uniformly sampled points of every edge (paper, section 4: two on each edge)."""
    return [
        LeverUp.at_edge(obj, edge, rng.uniform(np.nextafter(0.0, 1.0), 1.0))
        for edge in range(len(obj.corners))
        for _ in range(per_edge)
    ]


def sample_reachable_contacts(obj: ObjectModel, rng: np.random.Generator, count: int) -> list[LeverUp]:
    """Lever-ups uniformly over the length of an outline, wherever a blade gets there straight from outside.

    For outlines of many short edges, of which each would be too many; and for dents, of which the narrow ones have
    no room for a blade. Nothing of the object lies more than ``BEHIND`` behind the contact.
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


@dataclass(frozen=True)
class ToolPath:
    """The open-loop path of the blade, always the same in the action frame (paper, section 4).

    The blade waits before the rim, is pushed under it, lifts on an arc about the far side while its pitch
    follows the object's tilt, and holds. Every phase starts and ends at rest (minimum-jerk time law: Flash and
    Hogan, 1985). The motion stays in the action frame's x-z plane.

    Raises:
        ActionError: if a value is out of its range.
    """

    insertion: float = 0.022
    """How far the blade tip is pushed under the object, past the contact point [m]."""
    arc_radius: float = 0.14
    """Radius of the arc on which the tip is lifted [m]."""
    sweep: float = 0.75
    """Angle of that arc [rad]."""
    pitch: float = 0.28
    """Pitch of the blade while it is pushed in, tip down [rad]."""
    pitch_gain: float = 0.8
    """By how much the pitch grows per angle of the arc."""
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
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ActionError(f"tool path: {name} = {value} is outside {low:g} to {high:g}")

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.wait_time + self.insert_time + self.lift_time + self.hold_time

    @property
    def lift_start(self) -> float:
        """Time at which the lift begins [s]."""
        return self.wait_time + self.insert_time

    def faster(self, speed: float) -> "ToolPath":
        """The path pushed in and lifted so many times as fast; it waits and holds as long as before.

        Raises:
            ActionError: if the speed is not above 0, or too much of it is asked for.
        """
        if not speed > 0:
            raise ActionError(f"tool path: speed = {speed} times the usual one: give a number above 0")
        return replace(self, insert_time=self.insert_time / speed, lift_time=self.lift_time / speed)

    def at(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 3"]:
        """Blade tip over time.

        Args:
            times: Times since the start [s]; the path rests before its start and after its end.

        Returns:
            x and z of the tip's lower edge in the action frame [m] and the blade's pitch [rad], tip down.
        """
        inserted = _minimum_jerk((times - self.wait_time) / self.insert_time)
        angle = self.sweep * _minimum_jerk((times - self.lift_start) / self.lift_time)
        x = -self.standoff + (self.insertion + self.standoff) * inserted
        x = x + self.arc_radius * (1 - np.cos(angle))
        z = self.clearance + self.arc_radius * np.sin(angle)
        return np.stack([x, z, self.pitch + self.pitch_gain * angle], axis=-1)


@dataclass(frozen=True)
class Stroke:
    """What may differ from one lever-up's tool path to the next: the action's parameters (paper, section 6)."""

    insertion: float = ToolPath.insertion
    """How far the blade tip is pushed under the object, past the contact point [m]."""
    arc_radius: float = ToolPath.arc_radius
    """Radius of the arc on which the tip is lifted [m]."""
    sweep: float = ToolPath.sweep
    """Angle of that arc [rad]."""
    speed: float = 1.0
    """Times as fast as usual the blade is pushed in and lifts."""

    @classmethod
    def of(cls, path: ToolPath) -> "Stroke":
        """What a path does; its speed is that of pushing in and lifting together."""
        usual = ToolPath.insert_time + ToolPath.lift_time
        speed = usual / (path.insert_time + path.lift_time)
        return cls(path.insertion, path.arc_radius, path.sweep, speed)

    def path(self) -> ToolPath:
        """The usual path with these parameters.

        Raises:
            ActionError: One of them is out of its range.
        """
        return ToolPath(self.insertion, self.arc_radius, self.sweep).faster(self.speed)


USUAL_STROKE = Stroke()
"""That of the usual path."""


def _minimum_jerk(phase: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
    """Smooth step from 0 to 1 with zero speed and acceleration at both ends."""
    s = np.clip(phase, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)
