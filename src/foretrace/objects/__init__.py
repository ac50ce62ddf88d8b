"""What an object is: an extruded outline, a box, a lying cylinder or a closed mesh; and random sets of them."""

from foretrace.objects.flat import (
    sample_dented,
    sample_organic,
    sample_oval,
    sample_rounded,
    sample_sized_prism,
)
from foretrace.objects.footed import FOOTINGS, Footed
from foretrace.objects.mesh import MeshObject
from foretrace.objects.model import (
    BEVEL,
    NO_BEVEL,
    OBJECTS,
    Bevel,
    CollisionShape,
    CylinderShape,
    HullShape,
    MassProperties,
    ObjectModel,
    object_from_dict,
    object_from_json,
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
from foretrace.objects.weighted import Weighted

__all__ = [
    "BEVEL",
    "CIRCLE_RADIUS",
    "CORNER_COUNTS",
    "FOOTINGS",
    "NO_BEVEL",
    "OBJECTS",
    "Bevel",
    "Box",
    "CollisionShape",
    "Cylinder",
    "CylinderShape",
    "Footed",
    "HullShape",
    "MassProperties",
    "MeshObject",
    "ObjectModel",
    "Prism",
    "Weighted",
    "look_alikes",
    "object_from_dict",
    "object_from_json",
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
