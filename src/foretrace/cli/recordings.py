"""The command that imports a recording."""

import warnings
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from foretrace.cli.contact import ContactOptions
from foretrace.cli.parsing import adapt
from foretrace.errors import PerceptionError
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.recorded import add_recorded, find_recorded, place_of
from foretrace.interactions.recording_folder import CAMERA, MARKERS
from foretrace.objects.shape_files import read_shape
from foretrace.perception import importing
from foretrace.perception.importing import Contact, ImportConfig
from foretrace.perception.markers import MarkerLayout
from foretrace.perception.recordings import open_recording
from foretrace.perception.tracking import TrackConfig


@adapt(
    (TrackConfig, [each.name for each in fields(TrackConfig) if each.name != "largest_gap"]),
    largest_gap="max_gap",
)
def import_recording(
    recording: Positional[Path],
    out: Path,
    at: Annotated[OmitArgPrefixes[ContactOptions], arg(name="contact")],
    config: Annotated[OmitArgPrefixes[ImportConfig], arg(name="import")],
    contact_px: tuple[float, float] | None = None,
    camera: Path | None = None,
    markers: Path | None = None,
    object: Path | None = None,
    scale: float | None = None,
    rest: bool = False,
    topic: str | None = None,
    depth_topic: str | None = None,
) -> None:
    """Turn the recording of a lever-up into an interaction of a data set, beside those that are there already.

    Name the contact with --contact, --contact-px or --edge. Friction and density are not measured: the
    nominal values stand in the data set. The tool's path is the planned one.

    Args:
        recording: Folder of frames with timestamps.csv, video file, bag of ROS 1 or ROS 2, or RealSense recording.
        out: Folder of the data set.
        at: Where it was levered, unless --contact-px says so.
        config: How the recording is read.
        contact_px: Column and row of the contact in the first frame, on the object's upper rim.
        camera: The camera's file, JSON or YAML of ROS, OpenCV or Kalibr; by default camera.json beside the recording,
            or what a bag or a RealSense recording has.
        markers: Marker layout; by default markers.json beside the recording.
        object: The object's shape: a .json file from `to_dict`, a mesh (.stl, .obj, .ply, .off), or a text file with
            the outline's corners. Without it, the prism that its outline in the first frame shows.
        scale: Metres per unit of the object's mesh or outline, 1 by default.
        rest: Turn a mesh onto the side on which its centre of mass is lowest.
        topic: Image topic of a bag, if it has several.
        depth_topic: Depth topic of a bag, aligned with the images; by default the one in the same frame, if any.
    """
    if object is None and (scale is not None or rest):
        raise PerceptionError("--scale and --rest go with --object: give one, or leave them out")
    opened = open_recording(recording, topic, depth_topic)
    intrinsics = camera or (None if opened.camera is not None else opened.beside(CAMERA))
    taken_by = opened.camera if intrinsics is None else PinholeCamera.load(intrinsics)
    if taken_by is None:
        reason = f" ({opened.no_camera})" if opened.no_camera else ""
        raise PerceptionError(
            f"{recording} names no camera{reason}: give --camera, a file of `foretrace calibrate`, ROS or Kalibr"
        )
    layout = markers or opened.beside(MARKERS)
    if layout is None:
        raise PerceptionError(f"{recording} has no {MARKERS} beside it: give --markers")
    where = Contact(at.contact, contact_px, at.share)
    shape = None if object is None else read_shape(object, config.height, scale, rest)
    found = importing.import_recording(opened, taken_by, MarkerLayout.load(layout), where, shape, config)
    notes = _notes(place_of(recording, out) | {"topic": topic}, taken_by, found)
    id = find_recorded(out, found.interaction, notes)
    if id is None:
        id = add_recorded(out, found.interaction, notes)
    else:
        warnings.warn(f"{out} has this recording already: nothing is added", stacklevel=2)
    effect, track = found.interaction.effect, found.track
    missing = int((~track.seen).sum())
    print(
        f"interaction {id}: {effect.outcome}, {len(effect.times)} samples from {found.start:.3f} s of the recording on"
    )
    print(
        f"markers seen in {len(track.seen) - missing} of {len(track.seen)} frames, corners to {track.noise:.2f} pixels"
    )
    print(f"data set: {out}")


def _notes(place: Mapping[str, Any], camera: PinholeCamera, found: Any) -> dict[str, Any]:
    """What is kept beside an interaction: enough to draw it onto the recording again."""

    def plain(values: np.ndarray) -> list[float | None]:
        return [float(value) if np.isfinite(value) else None for value in values]

    track = found.track
    deviations = np.sqrt(np.diagonal(track.covariance, axis1=1, axis2=2))
    return {
        **place,
        "camera": camera.to_dict(),
        "T_action_camera": found.T_action_camera.tolist(),
        "start": found.start,
        "frame_times": track.times.tolist(),
        "seen": track.seen.tolist(),
        "corner_noise_pixels": track.noise,
        "reprojection_error_pixels": plain(track.errors),
        "rotation_deviation_rad": plain(deviations[:, :3].max(axis=1)),
        "position_deviation_m": plain(deviations[:, 3:].max(axis=1)),
    }
