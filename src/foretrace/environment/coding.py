"""Observations and actions of the environment as numbers, and back."""

import numpy as np
import shapely
from jaxtyping import Float

from foretrace.actions import Action, LeverUp, ToolPath
from foretrace.actions.lever_up import VARIED_ACTION
from foretrace.errors import PlanningError
from foretrace.geometry import cross, inward_normals
from foretrace.imagined.context import CONSTANTS, nominal_constants
from foretrace.interactions.record import Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.planning.goals import Goal, describe

CONE = 0.2
"""Largest angle of a lever-up to the inward normal [rad]."""
REFUSED = -1.0
"""Reward of a contact that no blade gets to."""
BROKEN = 1.0
"""What each thing that must not happen costs, where it happens."""
TOLD = tuple(name for name in CONSTANTS if name in Physics.__dataclass_fields__)
"""Constants that are observed."""


def check_goal(goal: Goal) -> None:
    """Refuse a goal that is not about motions.

    Raises:
        PlanningError: It is about what is believed.
    """
    if goal.needs_gain():
        raise PlanningError(
            f"the goal {describe(goal)} is about what is believed of the object, which nothing is in an environment: "
            "give a goal about its motion, such as foretrace.goals.Lift()"
        )


def observed_view(observation: dict[str, np.ndarray]) -> TopDownView:
    """The view in an observation, as imaginers and planners take it."""
    return TopDownView(observation["mask"].astype(bool), observation["height"])


def observed_context(observation: dict[str, np.ndarray]) -> dict[str, float]:
    """The physical constants in an observation [SI], as imaginers are told them."""
    told = observation["context"].astype(float)
    values = {name: float(value) * nominal_constants()[name] for name, value in zip(TOLD, told, strict=True)}
    return {**nominal_constants(), **values}


def decode_action(outline: Float[np.ndarray, "corners 2"], values: Float[np.ndarray, " action"]) -> LeverUp:
    """The lever-up that an action means, in the frame of the outline."""
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


def encode_action(outline: Float[np.ndarray, "corners 2"], lever: Action, with_path: bool) -> np.ndarray:
    """The action that comes nearest to a lever-up, float32.

    Args:
        outline: The object's outline in the view's frame [m].
        lever: The lever-up in that frame.
        with_path: Whether the path's parameters belong to the action.
    """
    way = lever.contact - _middle(outline)
    share = np.arctan2(way[1], way[0]) / np.pi
    _, normal = _towards(outline, np.pi * share)
    turn = np.arctan2(cross(normal, lever.direction), normal @ lever.direction)
    values = [share, turn / CONE]
    if with_path:
        parameters = lever.path.parameters()
        values += [
            2 * (parameters[name] - low) / (high - low) - 1 for name, (low, high) in VARIED_ACTION.items()
        ]
    return np.clip(values, -1.0, 1.0).astype(np.float32)


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
