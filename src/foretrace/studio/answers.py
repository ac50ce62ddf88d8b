"""What the service answers, for its description."""

from typing import Any

from pydantic import BaseModel, ConfigDict

Vector = list[float]


class _Answer(BaseModel):
    model_config = ConfigDict(use_attribute_docstrings=True)


class Refused(_Answer):
    """Why a request was refused."""

    detail: str
    """In one line, with the remedy."""


class FutureTold(_Answer):
    """One way in which the object may move, in the action frame."""

    outcome: str
    """What becomes of the object: levered, slipped, ..."""
    probability: float
    """Probability of this future."""
    com_trajectory: list[Vector]
    """Centre of mass at each time: x, y, z [m]."""
    pose_trajectory: list[Vector]
    """At each time the centre of mass x, y, z [m], and the quaternion w, x, y, z of the rotation since rest, about the
    action frame's axes."""
    radius: list[float] | None
    """Radius of the region about the centre of mass at each time [m]; null where no region is known."""
    support_points: list[Vector]
    """The two points on the table about which the object turns, x, y each [m]."""


class Predicted(_Answer):
    """What is predicted, in the action frame: origin at the contact on the table top, x along the action, z up."""

    times: Vector
    """Times of the samples, from the moment before the blade moves [s]."""
    warnings: list[str]
    """Respects in which object or action are unlike those that the predictor has learned from."""
    outcomes: dict[str, float]
    """Probability of each outcome."""
    level: float
    """Probability with which the whole motion stays in the region of one future."""
    futures: list[FutureTold]
    """The most probable futures, the most probable first."""


class Planned(_Answer):
    """A plan, as `foretrace plan` writes it to plan.json; further entries are those of the file."""

    model_config = ConfigDict(extra="allow")

    goal: str
    """The goal."""
    action: dict[str, Any]
    """The chosen lever-up, in the object frame: contact x, y [m], direction as a unit vector, path [m, rad, s]."""
    table: dict[str, Vector] | None
    """Contact [m] and direction in the table frame; null if T_table_object was not given."""
    reached: float
    """Probability that the goal is reached and nothing happens that must not."""
    risk: float
    """Largest probability of anything that must not happen."""
    cost: float
    """Its cost: 1 stands for 10 cm, or a quarter turn."""
    note: str
    """What stands in the way; empty where nothing does."""


class Begun(_Answer):
    """A monitor that has begun."""

    id: str
    """Name of the monitor in addresses."""
    threshold: float
    """Score above which there is an alarm."""
    life: float
    """It is forgotten this long after it was last asked [s]."""


class VerdictTold(_Answer):
    """What a monitor says after a sample."""

    time: float
    """Time of the sample [s]."""
    alarm: bool
    """Whether no future explains what was observed, now or before."""
    cause: str | None
    """The most probable cause of an alarm; null without one."""
    score: float | None
    """Largest deviation so far from the future that fits best, in widths of its band."""
    threshold: float
    """Score above which there is an alarm."""
    transition: bool
    """Whether another outcome than the one expected at first has taken over, as foreseen: no alarm."""
    outcomes: dict[str, float | None]
    """Probability of each outcome, given the samples so far."""
    causes: dict[str, float | None]
    """Probability of each cause, where there is an alarm."""
    message: str
    """The same in a line."""
