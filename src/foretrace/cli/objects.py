"""Options that say which object is meant: from a file, or on a photograph."""

from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from foretrace.errors import CommandError, PredictionError
from foretrace.perception.photo import PhotoConfig

if TYPE_CHECKING:
    from foretrace.objects import ObjectModel
    from foretrace.perception.photo import PhotoView


@dataclass(frozen=True)
class ObjectOptions:
    """The object."""

    polygon: Path | None = None
    """File with the outline's corners: a table with one corner per line, GeoJSON or WKT, in metres unless --scale says
    otherwise."""
    image: Path | None = None
    """Image of the object's silhouette, white on black or opaque on transparent; needs --scale."""
    label: str | None = None
    """Value of the object's pixels in an image of several: a number (in an image with a palette its index), or red,
    green and blue as 128,0,0."""
    invert: bool = False
    """The image shows the object black on white."""
    mesh: Path | None = None
    """STL, OBJ, PLY or OFF file of the object."""
    rest: bool = False
    """Turn the mesh onto the side on which its centre of mass is lowest, where it does not stand right in its file."""
    scale: float | None = None
    """Metres per pixel of the image, or per unit of the mesh or polygon, 1 by default."""
    height: float | None = None
    """Height of a polygon's, image's or photograph's object [m], 0.02 by default; a mesh has its own."""

    def load(self) -> "tuple[ObjectModel, np.ndarray | None]":
        """The object, and the mask of an image.

        Raises:
            CommandError: Not exactly one object is given, or options do not go together.
            ShapeError: The object cannot be used.
        """
        from foretrace.objects import MeshObject, Prism
        from foretrace.objects.model import fitting_bevel
        from foretrace.objects.polygon_files import read_polygon
        from foretrace.objects.prism import DEFAULT_HEIGHT, check_polygon
        from foretrace.objects.shape_files import read_silhouette_image

        given = [f"--{name}" for name in ("polygon", "image", "mesh") if getattr(self, name) is not None]
        if len(given) != 1:
            raise CommandError(
                f"{' and '.join(given) or 'no object'} given: give exactly one of --polygon, --image, --mesh"
            )
        if self.rest and self.mesh is None:
            raise CommandError("--rest goes with --mesh: the others lie flat already")
        if self.height is not None and self.mesh is not None:
            raise CommandError("--height goes with --polygon and --image: a mesh has its own")
        if self.image is None and (self.label is not None or self.invert):
            raise CommandError("--label and --invert go with --image: leave them out")
        if self.label is not None and self.invert:
            raise CommandError("--label and --invert given: a label names the object already, leave one out")
        height = DEFAULT_HEIGHT if self.height is None else self.height
        if self.polygon is not None:
            corners = check_polygon(read_polygon(self.polygon, self.scale))
            return Prism(corners, height, fitting_bevel(corners, height)), None
        if self.mesh is not None:
            return MeshObject.load(self.mesh, 1.0 if self.scale is None else self.scale, rest=self.rest), None
        if self.scale is None or self.image is None:
            raise CommandError("--image needs --scale, the metres per pixel")
        mask = read_silhouette_image(self.image, self._label(), self.invert)
        return Prism.from_mask(mask, self.scale, height), mask

    def _label(self) -> "list[float] | None":
        """The label as numbers."""
        if self.label is None:
            return None
        try:
            return [float(value) for value in self.label.split(",")]
        except ValueError:
            raise CommandError(
                f"--label is {self.label}: give a number, or red, green and blue as 128,0,0"
            ) from None


@dataclass(frozen=True)
class PhotoOptions:
    """A photograph of the object on a table, in place of object and contact; the prediction is drawn onto it."""

    photo: Path | None = None
    """The photograph."""
    contact_px: tuple[float, float] | None = None
    """Column and row in the photograph of the point to lever at, on the object's upper rim."""
    camera: Path | None = None
    """The camera's file, JSON or YAML of ROS, OpenCV or Kalibr; by default camera.json beside the photograph."""
    markers: Path | None = None
    """Layout of the markers on the table; by default markers.json beside the photograph. Not needed with --depth."""
    depth: Path | None = None
    """Depth image of the photograph's size, PNG, TIFF or .npy: whole numbers in millimetres, fractions in metres. Shows
    the table and measures the object's height, unless --height is given."""
    background: Path | None = None
    """Photograph of the table without the object."""
    found: PhotoConfig = field(default_factory=PhotoConfig)
    """How the object is found."""

    def given(self) -> list[str]:
        """Options that were given. A switch cannot be given with the value that it has anyway."""
        values = {name: value for name, value in asdict(self).items() if name != "found"}
        options = [f"--{name.replace('_', '-')}" for name, value in values.items() if value is not None]
        for each in fields(PhotoConfig):
            value = getattr(self.found, each.name)
            if value != each.default:
                options.append(f"--{'no-' if value is False else ''}{each.name}")
        return options

    def observe(self, height: float | None, needs_contact: bool = True) -> "PhotoView":
        """What the photograph shows.

        Args:
            height: Height of the object, if it is known [m].
            needs_contact: Whether a contact has to be given; else the largest object is meant without one.

        Raises:
            PredictionError: No contact is given.
            PerceptionError: The photograph does not show it.
        """
        from foretrace.perception.photo import open_photo

        if self.photo is None or (self.contact_px is None and needs_contact):
            raise PredictionError("--photo needs --contact-px COLUMN ROW, a pixel on the object's upper rim")
        files = {name: getattr(self, name) for name in ("camera", "markers", "depth", "background")}
        return open_photo(self.photo, self.contact_px, **files, config=replace(self.found, height=height))
