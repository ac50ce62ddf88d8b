"""Commands that start from pictures: import a recording; what `predict` sees in a photograph."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from foretrace.cli.outlines import read_polygon
from foretrace.errors import PerceptionError

if TYPE_CHECKING:
    import numpy as np

    from foretrace.interactions.pinhole import PinholeCamera
    from foretrace.objects import ObjectModel
    from foretrace.perception.views import Sight

MaskMethod = Literal["background", "threshold", "colour", "grabcut"]


def import_recording(
    recording: Positional[Path],
    out: Path,
    camera: Path | None = None,
    markers: Path | None = None,
    object: Path | None = None,
    height: float | None = None,
    contact: tuple[float, float] | None = None,
    contact_px: tuple[float, float] | None = None,
    edge: int | None = None,
    fraction: float = 0.5,
    start: float | None = None,
    max_gap: float = 0.25,
    shadows: bool = True,
    topic: str | None = None,
    depth_topic: str | None = None,
) -> None:
    """Turn the film of a lever-up into an interaction of a data set, beside those that are there already.

    Say where the object was levered with --contact, --contact-px or --edge. Friction and density are not seen: the
    usual values stand in the data set. The tool's path is the planned one.

    Args:
        recording: Folder of frames with timestamps.csv, video file, bag of ROS 1 or ROS 2, or RealSense recording.
        out: Folder of the data set.
        camera: The camera's JSON file; by default camera.json beside the recording, or what a bag or a RealSense
            recording says.
        markers: Marker layout; by default markers.json beside the recording.
        object: The object's shape: a .json file from `to_dict`, an .stl or .obj mesh, or a text file with the outline's
            corners. Without it, the prism that its outline in the first frame shows.
        height: Height of the object, if its shape is a text file or not given [m].
        contact: Contact point in the object frame [m].
        contact_px: Column and row of the contact in the first frame, on the object's upper rim.
        edge: Number of the edge that was levered.
        fraction: How far along that edge.
        start: Time stamp at which the blade's path starts [s]; by default told from when the object moves.
        max_gap: The longest time without markers that is bridged [s].
        shadows: Whether the object may cast shadows, which are then told from it; else all that differs from the
            background is the object.
        topic: Image topic of a bag, if it has several.
        depth_topic: Depth topic of a bag, aligned with the images; by default the one in the same frame, if any.
    """
    from foretrace.interactions.film_folder import CAMERA, MARKERS
    from foretrace.interactions.pinhole import PinholeCamera
    from foretrace.interactions.recorded import add_recorded
    from foretrace.perception.films import open_film
    from foretrace.perception.importing import Contact, ImportConfig, import_film
    from foretrace.perception.markers import MarkerLayout
    from foretrace.perception.tracking import TrackConfig

    film = open_film(recording, topic, depth_topic)
    seen_by = PinholeCamera.load(camera) if camera is not None else film.camera
    if seen_by is None and (beside := film.beside(CAMERA)) is not None:
        seen_by = PinholeCamera.load(beside)
    if seen_by is None:
        raise PerceptionError(f"{recording} names no camera: give --camera, made by `foretrace calibrate`")
    layout = markers or film.beside(MARKERS)
    if layout is None:
        raise PerceptionError(f"{recording} has no {MARKERS} beside it: give --markers")
    where = Contact(contact, contact_px, None if edge is None else (edge, fraction))
    config = ImportConfig(track=TrackConfig(largest_gap=max_gap), start=start, height=height, shadows=shadows)
    shape = None if object is None else read_shape(object, height)
    found = import_film(film, seen_by, MarkerLayout.load(layout), where, shape, config)
    id = add_recorded(out, found.interaction, _notes(recording, seen_by, found))
    effect, track = found.interaction.effect, found.track
    missing = int((~track.seen).sum())
    print(
        f"interaction {id}: {effect.outcome}, {len(effect.times)} samples from {found.start:.3f} s of the film on"
    )
    print(
        f"markers seen in {len(track.seen) - missing} of {len(track.seen)} frames, corners to {track.noise:.2f} pixels"
    )
    print(f"data set: {out}")


def read_shape(path: Path, height: float | None) -> "ObjectModel":
    """An object from a description, a mesh or an outline.

    Raises:
        ShapeError: The file tells no usable object.
        PerceptionError: The description cannot be read.
    """
    import json

    from foretrace.objects import MeshObject, Prism, object_from_dict
    from foretrace.objects.prism import DEFAULT_HEIGHT

    if path.suffix.lower() in (".stl", ".obj"):
        return MeshObject.load(path)
    if path.suffix.lower() == ".json":
        try:
            return object_from_dict(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, AttributeError) as error:
            raise PerceptionError(f"cannot read an object from {path} ({error})") from error
    return Prism(read_polygon(path), DEFAULT_HEIGHT if height is None else height)


def _notes(recording: Path, camera: "PinholeCamera", found: Any) -> dict[str, Any]:
    """What is kept beside an interaction: enough to draw it onto the film again."""
    import numpy as np

    track = found.track
    deviations = np.sqrt(np.diagonal(track.covariance, axis1=1, axis2=2))
    return {
        "recording": str(recording),
        "camera": camera.to_dict(),
        "T_action_camera": found.T_action_camera.tolist(),
        "start": found.start,
        "frame_times": track.times.tolist(),
        "seen": track.seen.tolist(),
        "corner_noise_pixels": track.noise,
        "reprojection_error_pixels": [None if not np.isfinite(v) else float(v) for v in track.errors],
        "rotation_deviation_rad": [
            None if not np.isfinite(v).all() else float(max(v)) for v in deviations[:, :3]
        ],
        "position_deviation_m": [
            None if not np.isfinite(v).all() else float(max(v)) for v in deviations[:, 3:]
        ],
    }


@dataclass(frozen=True)
class LookedAt:
    """What a photograph shows."""

    sight: "Sight"
    """The object, the lever-up, the view."""
    picture: "np.ndarray"
    """The photograph."""
    camera: "PinholeCamera"
    """The camera that took it."""
    T_table_camera: "np.ndarray"
    """Its pose."""

    def save_overlay(self, path: Path, predicted: "np.ndarray", radius: "np.ndarray | None" = None) -> None:
        """Draw the outline, a path in the action frame [m] and how far off it may be [m] onto the photograph."""
        from foretrace.geometry import transform_points
        from foretrace.interactions.film_folder import write_picture
        from foretrace.perception.overlay import PREDICTED, draw_overlay

        in_table = transform_points(self.sight.T_table_action, predicted)
        outline = self.sight.placed.outline(self.sight.placed.object.height)
        paths = {"predicted": (in_table, PREDICTED)}
        radii = None if radius is None else {"predicted": radius}
        scene = self.picture, self.camera, self.T_table_camera, outline, paths
        write_picture(path, draw_overlay(*scene, radii=radii))


def look_at_photo(
    photo: Path,
    camera: Path | None,
    markers: Path | None,
    height: float | None,
    contact_px: tuple[float, float] | None,
    mask: MaskMethod,
    background: Path | None,
    box: tuple[int, int, int, int] | None,
    hull: bool,
    shadows: bool = True,
) -> LookedAt:
    """What a predictor needs to know of a photograph.

    Args:
        photo: The photograph.
        camera: The camera's JSON file; by default camera.json beside the photograph.
        markers: Marker layout, of which the table's markers are used; by default markers.json beside it.
        height: Height of the object [m]; 0.02 if not given.
        contact_px: Column and row of the contact, on the object's upper rim.
        mask: How the object is found.
        background: Picture of the table without the object, for ``background``.
        box: Left, top, width and height of a box round the object, for ``grabcut``.
        hull: Take the convex hull of the outline (paper, section 5.4).
        shadows: Whether there may be shadows, for ``background``.

    Raises:
        PerceptionError: The photograph does not tell it.
    """
    from foretrace.geometry import invert_transform
    from foretrace.interactions.film_folder import CAMERA, MARKERS
    from foretrace.interactions.pinhole import PinholeCamera
    from foretrace.objects import BEVEL
    from foretrace.objects.prism import DEFAULT_HEIGHT
    from foretrace.perception import masks
    from foretrace.perception.calibration import read_picture
    from foretrace.perception.markers import MarkerLayout, align_patterns, detect_markers
    from foretrace.perception.tracking import still_pose
    from foretrace.perception.views import contact_at_pixel, place_object, see

    if contact_px is None:
        raise PerceptionError("--photo needs --contact-px COLUMN ROW, a pixel on the object's upper rim")
    taken_by = PinholeCamera.load(camera or photo.parent / CAMERA)
    layout, picture = MarkerLayout.load(markers or photo.parent / MARKERS), read_picture(photo)
    taken_by.check_picture(picture, str(photo))
    seen = align_patterns(picture, detect_markers(picture, layout.dictionary), layout.dictionary)
    T_table_camera = invert_transform(still_pose([seen], layout.table, taken_by))
    cover = None
    if mask == "background":
        if background is None:
            raise PerceptionError(
                "--mask background needs --background, a picture of the table without the object"
            )
        cover = masks.cover_by_background(picture, read_picture(background), shadows=shadows)
        found = cover > 0.5
    elif mask == "grabcut":
        if box is None:
            raise PerceptionError("--mask grabcut needs --box LEFT TOP WIDTH HEIGHT round the object")
        found = masks.mask_by_grabcut(picture, box)
    elif mask == "colour":
        found = masks.mask_by_colour(picture, contact_px)
    else:
        found = masks.mask_by_threshold(picture)
    whole = masks.pick_object(found, contact_px)
    whole = whole if cover is None else masks.cover_of(cover, whole)
    height = DEFAULT_HEIGHT if height is None else height
    placed = place_object(whole, taken_by, T_table_camera, height, min(BEVEL.height, 0.5 * height), hull)
    sight = see(placed, contact_at_pixel(placed, contact_px, taken_by, T_table_camera))
    return LookedAt(sight, picture, taken_by, T_table_camera)
