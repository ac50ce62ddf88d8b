"""Actions: where a tool acts on an object, on what path, and which parameters describe it."""

from foretrace.actions.lever_up import (
    APPROACH,
    BEHIND,
    CONTACT_TOLERANCE,
    CORNER_MARGIN,
    USUAL_STROKE,
    LeverUp,
    Stroke,
    ToolPath,
    plane_vector,
    sample_contacts,
    sample_reachable_contacts,
)

__all__ = [
    "APPROACH",
    "BEHIND",
    "CONTACT_TOLERANCE",
    "CORNER_MARGIN",
    "USUAL_STROKE",
    "LeverUp",
    "Stroke",
    "ToolPath",
    "plane_vector",
    "sample_contacts",
    "sample_reachable_contacts",
]
