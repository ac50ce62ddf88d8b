"""What planning returns: the action, what is imagined of it, what else there was, and why that lost."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np
from jaxtyping import Float

from foretrace.actions import Action
from foretrace.errors import ForetraceError, PlanningError, shown
from foretrace.files import as_path, read_versioned, write_json
from foretrace.geometry import Numbers, finite_array, invert_transform
from foretrace.imagined import Belief, Futures, ImaginedEffect, Imaginer
from foretrace.imagined.context import Context
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel, Prism
from foretrace.objects.model import object_from_dict
from foretrace.schema import Count, Finite, Transform, Vector2

FILE_FORMAT, FILE_VERSION = "foretrace-plan", 1
REMEDY = "give a file that plan.save or `foretrace plan` wrote"
ALMOST, LEVEL, RAISED, FARTHEST = 1e-3, float(np.cos(np.deg2rad(5.0))), 0.02, 100.0
"""Deviation of a matrix that is taken for a rotation; of an object on the table the cosine of its largest tilt, its
largest height above it [m] and distance from the table's origin [m]."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another action that was imagined."""

    action: Action
    """The action, in the object's frame."""
    cost: float
    """Its cost."""
    risk: float
    """Probability of what must not happen."""
    reached: float
    """Probability that the goal is reached."""
    lost: str
    """Why it was not chosen."""


@dataclass(frozen=True, eq=False)
class RimCost:
    """Cost along the outline: at each contact that of the best direction, as the first stage has it."""

    points: Float[np.ndarray, "contacts 2"]
    """Contacts in the object's frame [m]."""
    cost: Float[np.ndarray, " contacts"]
    """Cost of each."""
    risk: Float[np.ndarray, " contacts"]
    """Probability of what must not happen, of each."""


@dataclass(frozen=True, eq=False)
class Stage:
    """What one stage of the search did."""

    name: str
    """``imagined``, ``refined`` or ``checked``."""
    count: int
    """Number of candidates that it chose from."""
    contact: Float[np.ndarray, "2"]
    """Contact of its choice in the object's frame [m]."""
    cost: float
    """Cost of its choice."""
    risk: float
    """Probability of what must not happen, of its choice."""
    before: float | None
    """Cost of the former stage's choice, as this stage has it; None: there is no former one."""
    moved: float
    """Distance of its contact from the former stage's [m]."""
    seconds: float | None = None
    """Time that it took [s]; not kept in files."""

    def __str__(self) -> str:
        former = (
            "" if self.before is None else f" (before: {self.before:.3f}, {100 * self.moved:.1f} cm away)"
        )
        took = "" if self.seconds is None else f", {1000 * self.seconds:.0f} ms"
        return f"{self.name}: {self.count} candidates, cost {self.cost:.3f}{former}{took}"


class _Action(TypedDict):
    action: dict[str, Any]
    cost: Finite
    risk: Finite
    reached: Finite


class _Alternative(_Action):
    lost: str


class _Futures(TypedDict):
    probability: list[Finite]
    outcome: list[str]
    states: list[Any]
    spread: list[Any]
    support_points: list[Any]
    quantiles: list[Any]


class _Stage(TypedDict):
    name: str
    count: Count
    contact: Vector2
    cost: Finite
    risk: Finite
    before: Finite | None
    moved: Finite


class _Rim(TypedDict):
    points: list[Vector2]
    cost: list[Finite]
    risk: list[Finite]


class _Plan(_Action):
    """Schema of the file."""

    goal: str
    worth: NotRequired[str]
    note: str
    chances: dict[str, Finite]
    lost: dict[str, Count]
    times: list[Finite]
    futures: _Futures
    warnings: list[str]
    context: dict[str, Finite | None]
    alternatives: list[_Alternative]
    rim: _Rim
    stages: list[_Stage]
    outline: list[Vector2]
    height: Finite
    object: dict[str, Any] | None
    T_table_object: Transform | None


@dataclass(frozen=True, eq=False)
class Plan:
    """The action that was chosen. Plane vectors are in the object's frame; where a view was given, in the view's."""

    action: Action
    """The action, in the object's frame."""
    imagined: ImaginedEffect
    """What is imagined of it, in its action frame: by the checker, or else by the imaginer."""
    cost: float
    """Its cost, by the criterion; where it was checked, both imaginers count."""
    risk: float
    """Largest probability of anything that must not happen; 0 without constraints."""
    chances: Mapping[str, float]
    """Probability of each of them, by name."""
    reached: float
    """Probability that the goal is reached and nothing happens that must not."""
    goal: str
    """The goal, in words."""
    note: str
    """What stands in the way; empty where the goal is reached more probably than not and all constraints are kept."""
    alternatives: tuple[Alternative, ...]
    """Other contacts, from the best on."""
    lost: Mapping[str, int]
    """How many other candidates were not chosen for which reason."""
    rim: RimCost
    """Cost along the outline."""
    stages: tuple[Stage, ...]
    """What each stage did."""
    outline: Float[np.ndarray, "corners 2"]
    """Outline of the object [m], counter-clockwise."""
    height: float
    """Its height [m]."""
    object: ObjectModel | None = None
    """The object, where it is known."""
    T_table_object: Float[np.ndarray, "4 4"] | None = None
    """Its pose in the table frame, where that is known."""
    worth: str = ""
    """What the cost says in plain words; empty where the goal has none."""

    @property
    def futures(self) -> Futures:
        """All futures of the action, one row, in its action frame."""
        return self.imagined.futures

    @property
    def T_table_action(self) -> Float[np.ndarray, "4 4"] | None:
        """The action frame in the table frame; None: where the object lies is not known."""
        if self.T_table_object is None:
            return None
        return self.T_table_object @ invert_transform(self.action.T_action_object)

    @property
    def table_action(self) -> Action:
        """The action in the table frame, as a robot takes it.

        Raises:
            PlanningError: Where the object lies is not known.
        """
        if (T := self.T_table_action) is None:
            raise PlanningError(
                "the plan does not know where the object lies on the table: plan with --photo or "
                "--pose X Y TURN, or give T_table_object in Python"
            )
        return replace(self.action, contact=T[:2, 3], direction=T[:2, 0])

    @property
    def shown_object(self) -> ObjectModel:
        """The object, or a prism of its outline where a view alone was planned from."""
        return self.object or Prism(self.outline, self.height)

    def imagined_by(self, imaginer: Imaginer, context: Context | Belief = None) -> "Plan":
        """The plan with its action imagined anew: a file keeps futures, but not the worlds of a belief.

        Args:
            imaginer: Imagines it.
            context: What it is told. With a `Belief`, a monitor of the plan has the motions of its worlds.

        Raises:
            PredictionError: The imaginer does not imagine this action, or is not told such a context.
            ViewError: The object does not fit into the view.
        """
        view = TopDownView.of(self.shown_object, self.action)
        return replace(self, imagined=imaginer.imagine(view, self.action, context=context))

    def __repr__(self) -> str:
        x, y = 100 * self.action.contact
        note = f", {self.note}" if self.note else ""
        return (
            f"Plan({self.goal}: {self.action.label} at x {x:.1f}, y {y:.1f} cm, cost {self.cost:.3f}, "
            f"risk {self.risk:.3f}, reached {self.reached:.3f}{note})"
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values; contact and direction also in the table frame, where that is known."""
        imagined, futures, T = self.imagined, self.imagined.futures, self.T_table_action
        placed = {} if T is None else {"contact": T[:2, 3].tolist(), "direction": T[:2, 0].tolist()}
        return {
            "format": FILE_FORMAT,
            "format_version": FILE_VERSION,
            "frames": "object: plane vectors; action: futures, origin at the contact, x along the action, z up",
            "units": {"times": "s", "lengths": "m", "angles": "rad"},
            "goal": self.goal,
            "note": self.note,
            "worth": self.worth,
            "action": self.action.to_dict(),
            "T_table_object": None if self.T_table_object is None else self.T_table_object.tolist(),
            "T_table_action": None if T is None else T.tolist(),
            "table": placed or None,
            "cost": self.cost,
            "risk": self.risk,
            "chances": dict(self.chances),
            "reached": self.reached,
            "lost": dict(self.lost),
            "alternatives": [
                {
                    "action": each.action.to_dict(),
                    "cost": each.cost,
                    "risk": each.risk,
                    "reached": each.reached,
                    "lost": each.lost,
                }
                for each in self.alternatives
            ],
            "stages": [
                {name: np.array(value).tolist() for name, value in vars(each).items() if name != "seconds"}
                for each in self.stages
            ],
            "rim": {name: values.tolist() for name, values in vars(self.rim).items()},
            "outline": self.outline.tolist(),
            "height": self.height,
            "object": None if self.object is None else self.object.to_dict(),
            "warnings": list(imagined.warnings),
            "context": {
                name: float(value) if np.isfinite(value) else None for name, value in imagined.context.items()
            },
            "times": imagined.times.tolist(),
            "futures": {
                "outcome": list(futures.outcome),
                "probability": futures.probability[0].tolist(),
                "states": _plain(futures.states[0]),
                "spread": _plain(futures.spread[0]),
                "support_points": _plain(futures.support_points[0]),
                "quantiles": _plain(
                    futures.quantiles if futures.quantiles.ndim == 1 else futures.quantiles[0]
                ),
            },
        }

    def save(self, path: str | Path) -> Path:
        """Write the plan as JSON; returns the file.

        Raises:
            PlanningError: The path is none.
            OSError: The system refuses to write it.
        """
        file = as_path(path, PlanningError)
        write_json(file, self.to_dict())
        return file

    @classmethod
    def open(cls, path: str | Path) -> "Plan":
        """Read a plan that was saved.

        Raises:
            PlanningError: The file is missing, damaged, or no plan.
        """
        file = as_path(path, PlanningError)
        content = read_versioned(file, _Plan, FILE_FORMAT, FILE_VERSION, PlanningError, REMEDY)
        try:
            return _from_content(content)
        except (ForetraceError, ValueError, TypeError) as reason:
            raise PlanningError(f"{file} cannot be read ({reason}): {REMEDY}") from None


def pose_on_table(T_table_object: Numbers) -> Float[np.ndarray, "4 4"]:
    """Pose of an object that lies on the table, as a tracker may have it: a little above it, or tilted.

    Raises:
        PlanningError: It is none, or more than `FARTHEST` away.
    """
    T = finite_array("T_table_object", T_table_object, (4, 4), PlanningError)
    R = T[:3, :3]
    rigid = np.abs(R.T @ R - np.eye(3)).max() < ALMOST and np.abs(T[3] - [0, 0, 0, 1]).max() < ALMOST
    if not rigid or np.linalg.det(R) < 0 or R[2, 2] < LEVEL or abs(T[2, 3]) > RAISED:
        raise PlanningError(
            f"T_table_object is {shown(T.round(4).tolist())}: give a pose on the table, turned about the vertical"
        )
    if (far := float(np.linalg.norm(T[:2, 3]))) > FARTHEST:
        raise PlanningError(
            f"the object lies {far:.3g} m from the table's origin: give metres, at most {FARTHEST:g}"
        )
    return T


def _from_content(content: _Plan) -> Plan:
    """The plan in a file.

    Raises:
        ForetraceError: Action or object are impossible.
        ValueError: Numbers do not have the right shape.
    """
    times = np.array(content["times"])
    given = content["futures"]
    count, time = len(given["outcome"]), len(times)
    futures = Futures(
        probability=_array("probability", [given["probability"]], (1, count)),
        outcome=tuple(given["outcome"]),
        states=_array("states", [given["states"]], (1, count, time, 6)),
        spread=_array("spread", [given["spread"]], (1, count, time)),
        support_points=_array("support_points", [given["support_points"]], (1, count, 2, 2)),
        quantiles=_array("quantiles", given["quantiles"], (99,)),
    )
    best = int(futures.probability[0].argmax())
    pose = None if np.isnan(futures.states[..., 3:]).all() else futures.pose[0, best]
    context = {name: np.nan if value is None else value for name, value in content["context"].items()}
    imagined = ImaginedEffect(times, futures.com[0, best], pose, futures, tuple(content["warnings"]), context)
    T, obj = content["T_table_object"], content["object"]
    return Plan(
        action=Action.from_dict(content["action"]),
        imagined=imagined,
        alternatives=tuple(
            Alternative(**{**each, "action": Action.from_dict(each["action"])})
            for each in content["alternatives"]
        ),
        rim=_rim(content["rim"]),
        stages=tuple(Stage(**{**each, "contact": np.array(each["contact"])}) for each in content["stages"]),
        outline=_array("outline", content["outline"], (len(content["outline"]), 2)),
        object=None if obj is None else object_from_dict(obj),
        T_table_object=None if T is None else pose_on_table(T),
        cost=content["cost"],
        risk=content["risk"],
        chances=content["chances"],
        reached=content["reached"],
        goal=content["goal"],
        note=content["note"],
        worth=content.get("worth", ""),
        lost=content["lost"],
        height=content["height"],
    )


def _rim(content: _Rim) -> RimCost:
    count = len(content["points"])
    return RimCost(
        _array("rim.points", content["points"], (count, 2)),
        _array("rim.cost", content["cost"], (count,)),
        _array("rim.risk", content["risk"], (count,)),
    )


def _array(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers; null is NaN."""
    array = np.array(values, dtype=float)
    if array.shape != shape:
        raise ValueError(f"entry {name} has the shape {array.shape}, {shape} is expected")
    return array


def _plain(values: np.ndarray) -> Any:
    """Lists of numbers; null where one is not finite."""
    found = values.astype(object)
    found[~np.isfinite(values)] = None
    return found.tolist()
