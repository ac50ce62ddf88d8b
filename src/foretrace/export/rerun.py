"""Interactions as Rerun recordings: the scene over time, images, curves, and how the viewer arranges them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float

from foretrace.export.delivery import delivered, watched
from foretrace.export.episodes import Episode
from foretrace.export.images import RenderedImages, images_of_samples
from foretrace.export.scenery import IMAGINED, OBJECT, OBSERVED, Colour
from foretrace.files import write_bytes
from foretrace.geometry import quaternion_to_matrix, tilt
from foretrace.interactions.record import Effect
from foretrace.objects.surface import triangles_of
from foretrace.trajectories import interpolate

TIMELINE = "time"
APPLICATION = "foretrace"
PATH_RADIUS = 0.0015
"""Radius of drawn paths [m]."""
TABLE = np.array([0.5, 0.4, 0.002])
"""Size of the drawn part of the table [m]."""


def export_rerun(episodes: Sequence[Episode], out: Path, camera: bool = True) -> None:
    """Write one recording for each interaction, with a blueprint. Nothing is sent anywhere.

    Args:
        episodes: What to write.
        out: Folder to make: ``interaction-000012.rrd`` and so on.
        camera: Whether simulated interactions get the images of a camera beside the table.

    Raises:
        ExportError: The folder exists, or the machine cannot render.
    """
    with delivered(out) as folder:
        for episode in watched(episodes, "recordings"):
            write_recording(episode, folder / f"interaction-{episode.interaction.id:06d}.rrd", camera)


def write_recording(episode: Episode, path: Path, camera: bool) -> None:
    """Write one interaction to one file."""
    interaction = episode.interaction
    effect = interaction.effect
    seen = images_of_samples(interaction) if camera else None
    # Ids of its own, and no properties: equal interactions give recordings of equal contents.
    recording = rr.RecordingStream(
        APPLICATION, recording_id=f"interaction-{interaction.id}", send_properties=False
    )
    # In memory first: the thread that writes files for Rerun never ends on a full disk, at times.
    memory = recording.memory_recording()
    recording.send_blueprint(_blueprint(seen is not None), make_active=False)
    recording.send_recording_name(f"interaction {interaction.id}: {effect.outcome}")
    _log_scene(recording, episode)
    _log_motion(recording, episode)
    _log_curves(recording, episode)
    if seen is not None:
        _log_images(recording, effect.times, seen)
    recording.flush()
    write_bytes(path, memory.drain_as_bytes())
    recording.disconnect()


def _blueprint(camera: bool) -> rrb.Blueprint:
    """The scene on the left; images and curves on the right."""
    scene = rrb.Spatial3DView(
        name="Action frame",
        origin="/action",
        contents=["$origin/**", "- /action/camera/**"],
        background=[246, 247, 249],
        eye_controls=rrb.EyeControls3D(position=(0.25, -0.42, 0.3), look_target=(0.05, 0.0, 0.03)),
    )
    images = [rrb.Spatial2DView(name="Height from above", origin="/view/height")]
    if camera:
        images += [
            rrb.Spatial2DView(name="Camera", origin="/action/camera", contents=["$origin/color"]),
            rrb.Spatial2DView(name="Depth", origin="/action/camera", contents=["$origin/depth"]),
        ]
    curves = [
        rrb.TimeSeriesView(name=title, origin=f"/curves/{name}")
        for name, title in (("com", "Centre of mass [cm]"), ("tilt", "Tilt [deg]"), ("error", "Error [cm]"))
    ]
    right = rrb.Vertical(rrb.Horizontal(*images), *curves, row_shares=[2, 2, 1, 1])
    return rrb.Blueprint(
        rrb.Horizontal(scene, right, column_shares=[3, 2]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        collapse_panels=True,
    )


def _log_scene(recording: rr.RecordingStream, episode: Episode) -> None:
    """What does not change: table, shapes, the view from above, the whole imagined path."""
    interaction = episode.interaction
    vertices, triangles = triangles_of(interaction.object)
    # Every triangle with corners of its own, so that edges are shaded as edges.
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    flat, facing = corners.reshape(-1, 3), np.repeat(normals, 3, axis=0)

    def log(entity: str, *components: rr.AsComponents) -> None:
        recording.log(entity, *components, static=True)

    log("action", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    log(
        "action/table",
        rr.Boxes3D(centers=[[0.1, 0, -TABLE[2] / 2]], sizes=[TABLE], colors=[_bytes((0.87, 0.86, 0.83))]),
    )
    log(
        "action/object/shape",
        rr.Mesh3D(vertex_positions=flat, vertex_normals=facing, albedo_factor=[*_bytes(OBJECT), 150]),
    )
    if episode.imagined_pose is not None:
        log(
            "action/imagined/object/shape",
            rr.Mesh3D(vertex_positions=flat, vertex_normals=facing, albedo_factor=[*_bytes(IMAGINED), 90]),
        )
    for part in interaction.action.tool.parts():
        colour = [_bytes(part.colour)]
        solid: rr.AsComponents = rr.Boxes3D(
            centers=[part.start], half_sizes=[part.end], colors=colour, fill_mode="solid"
        )
        if part.shape == "capsule":
            solid = rr.Cylinders3D(
                lengths=[part.length + 2 * part.radius],
                radii=[part.radius],
                centers=[part.pose[:3]],
                quaternions=[rr.Quaternion(xyzw=part.pose[[4, 5, 6, 3]])],
                colors=colour,
                fill_mode="solid",
            )
        log(f"action/tool/{part.name}", solid)
    log("view/height", rr.DepthImage(interaction.view.height, meter=1.0))
    if episode.imagined is not None:
        log("action/imagined/path", _strip(episode.imagined.com_trajectory, IMAGINED))


def _log_motion(recording: rr.RecordingStream, episode: Episode) -> None:
    """What moves: object, tool, centres of mass, and the observed path as it grows."""
    effect, ghost = episode.interaction.effect, episode.imagined_pose
    for k, time in enumerate(effect.times):
        recording.set_time(TIMELINE, duration=float(time))
        recording.log("action/object", _placed(effect.pose_trajectory[k]))
        recording.log("action/tool", _placed(effect.tool_trajectory[k]))
        recording.log("action/observed/com", _dot(effect.com_trajectory[k], OBSERVED))
        recording.log("action/observed/path", _strip(effect.com_trajectory[: k + 1], OBSERVED))
    if episode.imagined is None:
        return
    for k, time in enumerate(episode.imagined.times):
        recording.set_time(TIMELINE, duration=float(time))
        recording.log("action/imagined/com", _dot(episode.imagined.com_trajectory[k], IMAGINED))
        if ghost is not None:
            recording.log("action/imagined/object", _placed(ghost[k]))


def _log_curves(recording: rr.RecordingStream, episode: Episode) -> None:
    """Centres of mass, tilt and error over time."""
    effect, imagined = episode.interaction.effect, episode.imagined
    _curves(recording, "observed", effect.times, effect.com_trajectory, OBSERVED, effect.pose_trajectory)
    if imagined is None:
        return
    _curves(recording, "imagined", imagined.times, imagined.com_trajectory, IMAGINED, episode.imagined_pose)
    times, error = distances(effect, imagined.times, imagined.com_trajectory)
    _curve(recording, "error/distance", "distance", times, 100 * error, IMAGINED)


def distances(
    effect: Effect, times: Float[np.ndarray, " imagined"], com: Float[np.ndarray, "imagined 3"]
) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, " time"]]:
    """How far the imagined centre of mass is from the observed one [m], at the observed times [s] that both have."""
    common = effect.times[(effect.times >= times[0]) & (effect.times <= times[-1])]
    there = interpolate(times, com, common)
    here = effect.com_trajectory[np.isin(effect.times, common)]
    return common, np.linalg.norm(here - there, axis=1)


def _curves(
    recording: rr.RecordingStream,
    name: str,
    times: Float[np.ndarray, " time"],
    com: Float[np.ndarray, "time 3"],
    colour: Colour,
    pose: Float[np.ndarray, "time 7"] | None,
) -> None:
    for axis, values in zip("xyz", com.T, strict=True):
        _curve(recording, f"com/{axis}/{name}", f"{axis} {name}", times, 100 * values, colour)
    if pose is not None:
        angle = np.rad2deg(tilt(quaternion_to_matrix(pose[:, 3:])))
        _curve(recording, f"tilt/{name}", name, times, angle, colour)


def _curve(
    recording: rr.RecordingStream,
    entity: str,
    name: str,
    times: Float[np.ndarray, " time"],
    values: Float[np.ndarray, " time"],
    colour: Colour,
) -> None:
    recording.log(f"curves/{entity}", rr.SeriesLines(colors=[_bytes(colour)], names=[name]), static=True)
    index = rr.TimeColumn(TIMELINE, duration=times)
    recording.send_columns(f"curves/{entity}", indexes=[index], columns=rr.Scalars.columns(scalars=values))


def _log_images(
    recording: rr.RecordingStream, times: Float[np.ndarray, " time"], seen: RenderedImages
) -> None:
    camera = seen.camera
    pinhole = rr.Pinhole(
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx + 0.5, camera.cy + 0.5],  # Rerun counts from the pixel's corner
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.08,
    )
    pose = rr.Transform3D(translation=seen.T_action_camera[:3, 3], mat3x3=seen.T_action_camera[:3, :3])
    recording.log("action/camera", pose, pinhole, static=True)
    for k, time in enumerate(times):
        recording.set_time(TIMELINE, duration=float(time))
        recording.log("action/camera/color", rr.Image(seen.rgb[k]).compress(jpeg_quality=90))
        recording.log("action/camera/depth", rr.DepthImage(seen.depth[k], meter=1.0))


def _placed(pose: Float[np.ndarray, "7"]) -> rr.Transform3D:
    w, x, y, z = pose[3:]
    return rr.Transform3D(translation=pose[:3], quaternion=rr.Quaternion(xyzw=[x, y, z, w]))


def _strip(path: Float[np.ndarray, "n 3"], colour: Colour) -> rr.LineStrips3D:
    return rr.LineStrips3D([path], colors=[_bytes(colour)], radii=PATH_RADIUS)


def _dot(point: Float[np.ndarray, "3"], colour: Colour) -> rr.Points3D:
    return rr.Points3D([point], colors=[_bytes(colour)], radii=4 * PATH_RADIUS)


def _bytes(colour: Colour) -> list[int]:
    return [round(255 * part) for part in colour]
