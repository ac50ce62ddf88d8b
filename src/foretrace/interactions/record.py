"""The record of one interaction: object seen, action taken, effect observed (paper, section 1).

Everything lies in the *action frame*: origin at the contact point on the table top, x along the action
(the inward edge normal), y to the left, z up. SI units. Quaternions are ``w, x, y, z``.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from foretrace.actions import Action, Judgement, Motion
from foretrace.actions import Outcome as Outcome
from foretrace.errors import ActionError, shown
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel


@dataclass(frozen=True)
class Effect:
    """What happened to the object during one action (paper, section 4)."""

    times: Float[np.ndarray, " time"]
    """Time of each sample [s], from the moment before the tool moves."""
    pose_trajectory: Float[np.ndarray, "time 7"]
    """Object frame in the action frame: position [m] and unit quaternion (w, x, y, z)."""
    com_trajectory: Float[np.ndarray, "time 3"]
    """Centre of mass in the action frame [m], one row per sample."""
    tool_trajectory: Float[np.ndarray, "time 7"]
    """Tool frame, at its tip, in the action frame: position [m] and unit quaternion (w, x, y, z)."""
    joint_trajectory: Float[np.ndarray, "time joints"]
    """Joint angles of the arm [rad]; no columns when the tool moved alone."""
    support_points: Float[np.ndarray, "2 2"]
    """The two corners that the object turned about, in the action frame at rest [m]; NaN where not observed."""
    support_corners: tuple[int, ...]
    """Indices into the object's corners of all that stood on the table for most of the lift."""
    outcome: str
    """What became of the object: one of the action's outcomes (`Outcome` for lever-ups), or ``failed``."""
    slip_index: int | None = None
    """First sample at which the object was off the tool for good after having been lifted, or None; none of an object
    that rolled or tumbled."""
    fall_index: int | None = None
    """First sample at which the object was falling off the table, or None; the record ends above the floor."""
    path_error: float = 0.0
    """Largest distance of the tool's tip from its planned path [m]."""

    @classmethod
    def judged(
        cls,
        motion: Motion,
        obj: ObjectModel,
        action: Action,
        com: Float[np.ndarray, "time 3"],
        fall_index: int | None = None,
    ) -> "Effect":
        """What was seen, and what the action's judge concludes.

        Args:
            motion: The motion in the frame of the executed action.
            obj: The object.
            action: The executed action.
            com: Centre of mass over time [m].
            fall_index: First sample at which the object falls off the table.

        Raises:
            ActionError: The judge returns no Judgement, or names an outcome that the action does not have.
        """
        judgement = action.judge(motion, obj, com)
        if not isinstance(judgement, Judgement):
            raise ActionError(
                f"action {shown(action.label)} was judged {shown(judgement)}: its judge is to return a Judgement"
            )
        if judgement.outcome not in action.outcomes:
            raise ActionError(
                f"action {shown(action.label)} was judged {shown(judgement.outcome)}, which is none of its outcomes: "
                f"{', '.join(action.outcomes)}"
            )
        support = judgement.support_points
        return cls(
            times=motion.times,
            pose_trajectory=motion.object_pose,
            com_trajectory=com,
            tool_trajectory=motion.tool_pose,
            joint_trajectory=motion.joints,
            support_points=np.full((2, 2), np.nan) if support is None else support,
            support_corners=judgement.support_corners,
            outcome=judgement.outcome,
            slip_index=judgement.slip_index,
            fall_index=fall_index,
            path_error=motion.path_error,
        )

    def __repr__(self) -> str:
        return f"Effect({self.outcome}, {len(self.times)} samples)"


@dataclass(frozen=True)
class Physics:
    """The physical constants of one interaction."""

    density: float = 600.0
    """Density of the object [kg/m^3]."""
    friction: float = 0.8
    """Coulomb friction coefficient between object and table."""
    tool_friction: float = 0.3
    """Coulomb friction coefficient between object and tool."""
    rolling_friction: float = 1e-4
    """Lever arm of the table's resistance to rolling [m]; felt by round objects alone."""
    table_edge: float | None = None
    """Distance of the table's far edge ahead of the contact point [m]; None: no edge within reach."""


PHYSICS_RANGES = {"friction": (0.0, 10.0), "tool_friction": (0.0, 10.0), "density": (1.0, 100_000.0)}
"""What is possible: friction coefficients, densities of anything solid [kg/m^3]."""


@dataclass(frozen=True)
class ExecutionOffset:
    """Execution error: offset of the executed action from the commanded one, as in `Action.moved`.

    View, action and effect are in the commanded action's frame, the one that the robot knows.
    """

    ahead: float = 0.0
    """Distance ahead along the action [m]."""
    left: float = 0.0
    """Distance to the left [m]."""
    turn: float = 0.0
    """Angle to the left [rad]."""


NO_OFFSET = ExecutionOffset()
"""Execution exactly as commanded."""


@dataclass(frozen=True)
class Provenance:
    """Origin of an interaction: with object, action, physics and execution error, enough to simulate it again."""

    source: str = "simulated"
    """``simulated`` or ``recorded``."""
    engine: str = "mujoco"
    """Name of the physics engine; empty for a recording."""
    embodiment: str = "arm"
    """``arm``: the whole robot; ``tool``: the tool alone on the same path."""
    camera: str = "exact"
    """``exact``: view from geometry; ``rgbd``: from a rendered depth image; ``recorded``."""
    seed: int = 0
    """Seed of this interaction's random draws."""
    timestep: float = 0.002
    """Time step of the simulation [s]; 0 for a recording."""
    sample_period: float = 0.05
    """Time between recorded samples [s]."""
    watch_time: float = 0.0
    """Time for which the object was observed after the end of the tool's path [s]."""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of foretrace and of the libraries that shaped the numbers."""


@dataclass(frozen=True)
class Interaction:
    """One action on one object: the paper's triple, with its provenance."""

    object: ObjectModel
    """The object, in its own frame."""
    action: Action
    """The commanded action, in the object frame, with its path and tool."""
    view: TopDownView
    """The object seen from above before the action, in the action frame."""
    effect: Effect
    """What happened."""
    physics: Physics = Physics()
    """Friction and density."""
    provenance: Provenance = Provenance()
    """Origin of the interaction."""
    execution_error: ExecutionOffset = NO_OFFSET
    """Offset of the executed action from the commanded one."""
    id: int = 0
    """Number within its data set."""

    def __repr__(self) -> str:
        made = self.provenance
        return (
            f"Interaction({self.id}: {self.action.label} of a {self.object.shape.kind}, {self.effect.outcome}, "
            f"{len(self.effect.times)} samples, {made.source})"
        )
