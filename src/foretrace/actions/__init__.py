"""Actions: where a tool acts on an object, on what path, what may come of it, and which parameters describe it."""

from foretrace.actions.base import (
    ACTIONS,
    CONTACT_TOLERANCE,
    CORNER_MARGIN,
    Action,
    action_transform,
    minimum_jerk,
    plane_vector,
)
from foretrace.actions.lever_up import (
    APPROACH,
    BEHIND,
    LeverUp,
    ToolPath,
    sample_contacts,
    sample_reachable_contacts,
)
from foretrace.actions.lever_up_judge import Outcome
from foretrace.actions.motion import FAILED, Judgement, Motion, tool_poses, tool_transforms
from foretrace.actions.push import Push, PushOutcome, PushPath, sample_pushes
from foretrace.actions.tool import TOOLS, Rod, Screwdriver, Tool, ToolPart

__all__ = [
    "ACTIONS",
    "APPROACH",
    "BEHIND",
    "CONTACT_TOLERANCE",
    "CORNER_MARGIN",
    "FAILED",
    "TOOLS",
    "Action",
    "Judgement",
    "LeverUp",
    "Motion",
    "Outcome",
    "Push",
    "PushOutcome",
    "PushPath",
    "Rod",
    "Screwdriver",
    "Tool",
    "ToolPart",
    "ToolPath",
    "action_transform",
    "minimum_jerk",
    "plane_vector",
    "sample_contacts",
    "sample_pushes",
    "sample_reachable_contacts",
    "tool_poses",
    "tool_transforms",
]
