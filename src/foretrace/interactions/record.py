"""The record of one interaction: object seen, action done, effect observed (paper, section 1).

Everything lies in the *action frame*: origin at the contact point on the table top, x along the action
(the inward edge normal), y to the left, z up. SI units. Quaternions are ``w, x, y, z``.
"""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from foretrace.actions import USUAL_STROKE, LeverUp, Stroke
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel


class Outcome(StrEnum):
    """What became of the object, judged once the tool has come to rest."""

    LEVERED = "levered"
    """Lifted along the whole path and still on the blade at its end."""
    SLIPPED = "slipped"
    """Lifted, then lost from the blade before the path's end."""
    TUMBLED = "tumbled"
    """Turned over its support edge, onto another side."""
    ROLLED = "rolled"
    """Rolled away instead of being lifted."""
    MISSED = "missed"
    """Never lifted: the blade passed beside or only pushed it."""
    FAILED = "failed"
    """The simulation diverged; there is no effect to learn from."""


@dataclass(frozen=True)
class Effect:
    """What happened to the object during one lever-up (paper, section 4)."""

    times: Float[np.ndarray, " time"]
    """Time of each sample [s], from the moment before the blade touches the object."""
    pose_trajectory: Float[np.ndarray, "time 7"]
    """Object frame in the action frame: position [m] and unit quaternion (w, x, y, z)."""
    com_trajectory: Float[np.ndarray, "time 3"]
    """Centre of mass in the action frame [m], one row per sample."""
    tool_trajectory: Float[np.ndarray, "time 7"]
    """Blade tip frame in the action frame: position [m] and unit quaternion (w, x, y, z)."""
    joint_trajectory: Float[np.ndarray, "time joints"]
    """Joint angles of the arm [rad]; no columns when the tool moved alone."""
    support_points: Float[np.ndarray, "2 2"]
    """The two corners that the object turned about, in the action frame at rest [m]; NaN where not observed."""
    support_corners: tuple[int, ...]
    """Indices into the object's corners of all that stood on the table for most of the lift."""
    outcome: Outcome
    """What became of the object."""
    slip_index: int | None = None
    """First sample at which the object was off the blade after having been lifted, or None. An object that rolled or
    tumbled has none: leaving the blade is what it did."""
    fall_index: int | None = None
    """First sample at which the object was falling off the table, or None; the record ends above the floor."""
    path_error: float = 0.0
    """Largest distance of the blade tip from its planned path [m]."""


@dataclass(frozen=True)
class Physics:
    """The physical constants of one interaction."""

    density: float = 600.0
    """Density of the object [kg/m^3]."""
    friction: float = 0.8
    """Coulomb friction coefficient between object and table."""
    tool_friction: float = 0.3
    """Coulomb friction coefficient between object and blade."""
    rolling_friction: float = 1e-4
    """Lever arm of the table's resistance to rolling [m]; felt by round objects alone."""
    table_edge: float | None = None
    """Distance of the table's far edge ahead of the contact point [m]; None: no edge within reach."""


@dataclass(frozen=True)
class Misplacement:
    """Where the blade really acted, seen from where it was told to: as `LeverUp.moved`.

    View, action and effect are in the frame that was told, the one in which the robot believes to act.
    """

    ahead: float = 0.0
    """How far ahead along the action [m]."""
    left: float = 0.0
    """How far to the left [m]."""
    turn: float = 0.0
    """By how much it pointed to the left [rad]."""


AS_TOLD = Misplacement()
"""No misplacement."""


@dataclass(frozen=True)
class Provenance:
    """Where an interaction comes from, enough to make it again."""

    source: str = "simulated"
    """``simulated`` or ``recorded``."""
    engine: str = "mujoco"
    """Name of the physics engine; empty for a recording."""
    embodiment: str = "arm"
    """``arm``: the whole robot; ``tool``: the blade alone on the same path."""
    seed: int = 0
    """Seed of this interaction's random draws."""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of foretrace and of the libraries that shaped the numbers."""


@dataclass(frozen=True)
class Interaction:
    """One lever-up of one object: the paper's triple, with its provenance."""

    object: ObjectModel
    """The object, in its own frame."""
    action: LeverUp
    """What was done, in the object frame; of a misplaced lever-up, what was told."""
    view: TopDownView
    """The object seen from above before the action, in the action frame."""
    effect: Effect
    """What happened."""
    physics: Physics = Physics()
    """Friction and density."""
    provenance: Provenance = Provenance()
    """Where it comes from."""
    misplacement: Misplacement = AS_TOLD
    """How far from what was told the blade acted."""
    stroke: Stroke = USUAL_STROKE
    """How deep, how far and how fast the blade went."""
    id: int = 0
    """Number within its data set."""
