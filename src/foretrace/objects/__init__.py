"""What an object is: an extruded outline, a box, a lying cylinder or a closed mesh; and random sets of them."""

from typing import Any

from foretrace.errors import ShapeError
from foretrace.objects.flat import (
    sample_dented,
    sample_organic,
    sample_oval,
    sample_rounded,
    sample_sized_prism,
)
from foretrace.objects.mesh import MeshObject
from foretrace.objects.model import (
    BEVEL,
    NO_BEVEL,
    Bevel,
    CollisionShape,
    CylinderShape,
    HullShape,
    MassProperties,
    ObjectModel,
)
from foretrace.objects.prism import CIRCLE_RADIUS, CORNER_COUNTS, Prism, paper_objects, sample_prism
from foretrace.objects.silhouette import read_silhouette, silhouette_origin
from foretrace.objects.solid import (
    Box,
    Cylinder,
    look_alikes,
    sample_box,
    sample_cylinder,
    sample_look_alikes,
)

__all__ = [
    "BEVEL",
    "CIRCLE_RADIUS",
    "CORNER_COUNTS",
    "NO_BEVEL",
    "Bevel",
    "Box",
    "CollisionShape",
    "Cylinder",
    "CylinderShape",
    "HullShape",
    "MassProperties",
    "MeshObject",
    "ObjectModel",
    "Prism",
    "look_alikes",
    "object_from_dict",
    "paper_objects",
    "read_silhouette",
    "sample_box",
    "sample_cylinder",
    "sample_dented",
    "sample_look_alikes",
    "sample_organic",
    "sample_oval",
    "sample_prism",
    "sample_rounded",
    "sample_sized_prism",
    "silhouette_origin",
]

KINDS: dict[str, type[Prism] | type[Cylinder] | type[MeshObject]] = {
    "prism": Prism,
    "box": Box,
    "cylinder": Cylinder,
    "mesh": MeshObject,
}
"""Objects by the name that ``to_dict`` gives them."""


def object_from_dict(values: dict[str, Any]) -> ObjectModel:
    """The object that ``ObjectModel.to_dict`` described.

    Raises:
        ShapeError: if the kind is unknown, a value is missing or the geometry is not usable.
    """
    kind = values.get("kind")
    if kind not in KINDS:
        raise ShapeError(f"object of kind {kind!r}: available are {', '.join(KINDS)}")
    try:
        return KINDS[kind].from_dict(values)
    except (KeyError, TypeError, ValueError) as error:
        raise ShapeError(f"description of a {kind} is not usable ({error!r}): write it by to_dict") from error
