"""From a recording to an interaction: the object on the table, its path, the view of it, and what became of it."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from foretrace.actions import LeverUp, Motion, ToolPath, tool_poses
from foretrace.errors import PerceptionError, check_choices, check_ranges, check_type, is_number, shown
from foretrace.files import versions_of
from foretrace.geometry import (
    continuous_quaternions,
    invert_transform,
    matrix_to_pose,
    planar_transform,
    rigid_transform,
    transform_points,
)
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.record import Effect, Interaction, Provenance
from foretrace.interactions.recording_folder import Frame
from foretrace.objects import BEVEL, ObjectModel
from foretrace.perception.markers import Detections, MarkerLayout, align_patterns, detect_markers, image_fault
from foretrace.perception.masks import DEPTH_RIM, find_by_background, find_by_height, heights_above_table
from foretrace.perception.recordings import Recording
from foretrace.perception.tracking import Track, TrackConfig, check_times, still_pose, track
from foretrace.perception.views import (
    Observation,
    PlacedObject,
    check_height,
    contact_at_pixel,
    fit_object,
    observe,
    place_object,
)
from foretrace.trajectories import interpolate_poses

ONSET = 0.407
"""Time from the start of the blade's nominal path until the object has moved by a millimetre [s]: the median of the
simulated lever-ups, whose standard deviation is 0.016 s."""
ONSET_SHIFT = 0.001
"""How far that is [m]."""
REST_TIME = 0.2
"""Least time for which the object lies at rest before it moves [s]."""
SHORTEST_STEP = 0.001
"""Least time from frame to frame [s]: shorter ones are no seconds."""
TABLE_FRAMES = 15
"""Frames whose table markers are measured with care; the camera stands still."""
LEAST_LEVEL = 0.03
"""A marker's height on an object may err by this much before the recording is refused [m]."""


LATEST = 1e11
"""Latest time stamp that is read [s]: in seconds, one of the year 5138."""
PERIODS = (1e-4, 10.0)
"""Shortest and longest time between samples [s]."""


@dataclass(frozen=True)
class ImportConfig:
    """How recordings become interactions."""

    track: TrackConfig = field(default_factory=TrackConfig)
    """How markers are followed."""
    path: ToolPath = field(default_factory=ToolPath)
    """The blade's path, as planned; it is recorded as the tool's, which no camera measures."""
    sample_period: float = 0.05
    """Time between the samples of the interaction [s]: that of the data that it joins."""
    start: float | None = None
    """Time stamp at which the blade's path starts [s]; by default as noted, else from the motion."""
    height: float | None = None
    """Height of an object of unknown shape [m]; by default that of its marker above the table."""
    shadows: bool = True
    """Whether there may be shadows, which are then separated from the object."""

    def __post_init__(self) -> None:
        check_type("track", self.track, TrackConfig, PerceptionError)
        check_type("path", self.path, ToolPath, PerceptionError)
        check_choices(PerceptionError, self)
        check_ranges(PerceptionError, "import", self, {"sample_period": PERIODS}, "give seconds")
        if self.height is not None:
            check_height(self.height)
        if self.start is not None:
            limits = {"start": (-LATEST, LATEST)}
            check_ranges(
                PerceptionError, "import", self, limits, "give a time stamp of the recording in seconds"
            )


@dataclass(frozen=True)
class Contact:
    """Where the object is levered: exactly one of the three."""

    point: tuple[float, float] | None = None
    """Point in the object frame [m]."""
    pixel: tuple[float, float] | None = None
    """Column and row in the first frame, on the object's upper rim."""
    edge: tuple[int, float] | None = None
    """Number of an edge, and how far along it."""

    def __post_init__(self) -> None:
        if sum(value is not None for value in (self.point, self.pixel, self.edge)) != 1:
            raise PerceptionError(
                "the contact is given in no way, or in several: give exactly one of point, pixel and edge"
            )
        pair = next(value for value in (self.point, self.pixel, self.edge) if value is not None)
        if not isinstance(pair, tuple | list | np.ndarray) or not all(
            is_number(n) and np.isfinite(n) for n in pair
        ):
            raise PerceptionError(f"contact of {shown(pair)}: give two numbers")


@dataclass(frozen=True)
class Imported:
    """An interaction, and how it was found."""

    interaction: Interaction
    """The interaction."""
    observation: Observation
    """Object, action and view."""
    track: Track
    """The path of the object's markers in the camera frame, frame by frame."""
    T_table_camera: Float[np.ndarray, "4 4"]
    """The camera over the table."""
    T_table_object: Float[np.ndarray, "frame 4 4"]
    """The object in the table frame, frame by frame; NaN in gaps."""
    start: float
    """Time stamp of the interaction's first moment [s]."""

    @property
    def T_action_camera(self) -> Float[np.ndarray, "4 4"]:
        """The camera in the action frame."""
        return invert_transform(self.observation.T_table_action) @ self.T_table_camera


def import_recording(
    recording: Recording,
    camera: PinholeCamera,
    layout: MarkerLayout,
    contact: Contact,
    shape: ObjectModel | None = None,
    config: ImportConfig = ImportConfig(),
) -> Imported:
    """Turn the recording of one lever-up into an interaction.

    Args:
        recording: The recording; its first frames show the object at rest.
        camera: The calibrated camera, which stands still.
        layout: The markers on table and object.
        contact: Where the object is levered.
        shape: The object; None: the prism that its outline shows.
        config: How.

    Raises:
        PerceptionError: The recording does not tell the interaction: no markers, too large a gap, no rest, no mask...
    """
    first, times, detections = _detect_all(recording, camera, layout)
    T_table_camera = invert_transform(
        still_pose(_careful(detections, layout), layout.table, camera, config.track)
    )
    followed = track(times, detections, layout.object, camera, config.track)
    T_table_body = T_table_camera @ followed.T_camera_body
    at_rest = _rest(times, T_table_body)
    T_table_start = _mean_transform(T_table_body[at_rest])
    placed = _place(first, recording, camera, layout, T_table_camera, T_table_start, shape, config)
    T_table_object = T_table_body @ (invert_transform(T_table_start) @ placed.T_table_object)
    observation = observe_contact(placed, contact, camera, T_table_camera)
    start = config.start if config.start is not None else recording.notes.action_start
    com = placed.object.mass_properties(1.0).com
    if start is None:
        start = _onset(times, transform_points(T_table_object, com[None])[:, 0], at_rest) - ONSET
    interaction = _record(times, T_table_object, observation, start, config, followed)
    return Imported(interaction, observation, followed, T_table_camera, T_table_object, start)


def observe_contact(
    placed: PlacedObject, contact: Contact, camera: PinholeCamera, T_table_camera: Float[np.ndarray, "4 4"]
) -> Observation:
    """The lever-up that a contact means.

    Raises:
        PerceptionError: It lies far from the outline.
        ActionError: There is no such edge.
    """
    if contact.edge is not None:
        action = LeverUp.at_edge(placed.object, *contact.edge)
        return observe(placed, action.contact)
    if contact.pixel is not None:
        return observe(placed, contact_at_pixel(placed, contact.pixel, camera, T_table_camera))
    return observe(placed, np.array(contact.point, dtype=float))


def _detect_all(
    recording: Recording, camera: PinholeCamera, layout: MarkerLayout
) -> tuple[list[Frame], Float[np.ndarray, " frame"], list[Detections]]:
    """The first frame, and times and markers of all."""
    first, times, detections = [], [], []
    table, thing = set(layout.table.ids), set(layout.object.ids)
    hopeless = None
    for number, frame in enumerate(recording.frames()):
        camera.check_image(frame.image, f"frame {number} of {recording.path}")
        if frame.depth is not None:
            camera.check_image(frame.depth, f"depth image {number} of {recording.path}")
        seen = detect_markers(frame.image, layout.dictionary)
        wanted = thing | table if number < TABLE_FRAMES else thing
        detections.append(align_patterns(frame.image, seen, layout.dictionary, wanted))
        times.append(frame.time)
        first = first or [frame]
        if hopeless is None and not (table | thing) & set(seen.ids.tolist()):
            hopeless = frame.image
    check_times(np.array(times), f" of {recording.path}")
    if len(times) < 2:
        raise PerceptionError(f"{recording.path} has a single frame: give the recording of a whole lever-up")
    _check_rate(np.array(times), recording)
    for name, ids in (("object", thing), ("table", table)):
        count = sum(bool(ids & set(seen.ids.tolist())) for seen in detections)
        if count < 2:
            raise PerceptionError(
                f"the {name}'s markers {sorted(ids)} are seen in {count} of {len(times)} frames of {recording.path}: "
                f"{_excuse(first[0].image if hopeless is None else hopeless, layout)}"
            )
    return first, np.array(times), detections


def _check_rate(times: Float[np.ndarray, " frame"], recording: Recording) -> None:
    """Refuse too few frames per second, and time stamps in another unit than seconds."""
    step = float(np.median(np.diff(times)))
    if not SHORTEST_STEP <= step <= REST_TIME + 1e-6:
        raise PerceptionError(
            f"{recording.path} has {1 / step:.3g} frames per second by its time stamps, from {times[0]:.10g} to "
            f"{times[-1]:.10g} s: are they in seconds? Record at 10 frames per second or more"
        )


def _excuse(image: UInt8[np.ndarray, "rows columns 3"], layout: MarkerLayout) -> str:
    """Why markers may not have been found in an image."""
    if here := detect_markers(image, layout.dictionary).ids.tolist():
        return f"seen are {sorted(here)}; check the ids in the marker layout"
    return image_fault(image, layout.dictionary) or (
        "no marker of any known dictionary is in the image; bring it nearer or light it better"
    )


def _careful(detections: Sequence[Detections], layout: MarkerLayout) -> list[Detections]:
    """The frames in which the table is looked at: the first that show it."""
    wanted = set(layout.table.ids)
    return [seen for seen in detections[:TABLE_FRAMES] if wanted & set(seen.ids.tolist())] or list(detections)


def _rest(
    times: Float[np.ndarray, " frame"], T_table_body: Float[np.ndarray, "frame 4 4"]
) -> Bool[np.ndarray, " frame"]:
    """The frames at the beginning in which the object lies still."""
    there = np.isfinite(T_table_body[:, 0, 0])
    begin = times[there][0]
    early = there & (times <= begin + REST_TIME + 1e-6)
    if early.sum() < 2:
        after = times[there][1:2]
        said = f"the next time at {after[0]:.3f} s" if len(after) else "and never again"
        raise PerceptionError(
            f"the object's markers are seen at {begin:.3f} s, {said}: two are needed in the first {REST_TIME} s; "
            "record at 10 frames per second or more"
        )
    shift = np.linalg.norm(T_table_body[early, :3, 3] - T_table_body[early][0, :3, 3], axis=1)
    if shift.max() > 3 * ONSET_SHIFT:
        raise PerceptionError(
            f"the object moves by {1e3 * shift.max():.1f} mm in the recording's first {REST_TIME} s: start "
            "recording before the blade touches it"
        )
    return early


def _mean_transform(transforms: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "4 4"]:
    """Mean of poses that are nearly alike."""
    rotation = Rotation.from_matrix(transforms[:, :3, :3]).mean().as_matrix()
    return rigid_transform(rotation, transforms[:, :3, 3].mean(axis=0))


def _place(
    first: Sequence[Frame],
    recording: Recording,
    camera: PinholeCamera,
    layout: MarkerLayout,
    T_table_camera: Float[np.ndarray, "4 4"],
    T_table_body: Float[np.ndarray, "4 4"],
    shape: ObjectModel | None,
    config: ImportConfig,
) -> PlacedObject:
    """The object at rest: from where its marker sits, or from its outline in the first frame."""
    if shape is not None and layout.T_object_body is not None:
        return PlacedObject(shape, level(T_table_body @ invert_transform(layout.T_object_body)))
    marker_height = float(T_table_body[2, 3])
    guess = marker_height if config.height is None else config.height
    height = guess if shape is None else shape.height
    if not 0 < marker_height < height + LEAST_LEVEL or abs(marker_height - height) > LEAST_LEVEL:
        raise PerceptionError(
            f"the object's marker lies {1e3 * marker_height:.0f} mm above the table, its object is "
            f"{1e3 * height:.0f} mm high: check the sides of the markers, the height and the camera file"
        )
    middle = camera.project(T_table_body[None, :3, 3], invert_transform(T_table_camera))[0]
    point = float(middle[0]), float(middle[1])
    mask, rim = find_mask(first[0], recording, camera, T_table_camera, point, config.shadows)
    seen = place_object(mask, camera, T_table_camera, height, min(rim, 0.5 * height))
    return seen if shape is None else fit_object(seen, shape)


def find_mask(
    frame: Frame,
    recording: Recording,
    camera: PinholeCamera,
    T_table_camera: Float[np.ndarray, "4 4"],
    point: tuple[float, float],
    shadows: bool = True,
) -> tuple[Bool[np.ndarray, "rows columns"] | Float[np.ndarray, "rows columns"], float]:
    """The object in the first frame, by the recording's background or its depth, and the height of its rim [m].

    By background: which part of each pixel it covers. By depth where the background does not tell.

    Raises:
        PerceptionError: The recording has neither, or what it has does not tell.
    """
    background = recording.background()
    if background is not None:
        try:
            return find_by_background(frame.image, background, point, shadows), BEVEL.height
        except PerceptionError as error:
            if frame.depth is None:
                raise
            warnings.warn(f"the object is found by depth, since by background: {error}", stacklevel=2)
    if frame.depth is not None:
        return find_by_height(heights_above_table(frame.depth, camera, T_table_camera), point), DEPTH_RIM
    raise PerceptionError(
        f"{recording.path} has neither background.png nor depth to find the object by: record the empty table, or "
        "give object_pose, the marker's place on the object, in the marker layout"
    )


def level(T_table_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The pose of an object that lies flat on the table, nearest to a measured one."""
    angle = np.arctan2(T_table_object[1, 0], T_table_object[0, 0])
    return planar_transform(T_table_object[:2, 3], float(angle))


def _onset(
    times: Float[np.ndarray, " frame"], com: Float[np.ndarray, "frame 3"], at_rest: Bool[np.ndarray, " frame"]
) -> float:
    """When the object has moved by `ONSET_SHIFT`, between frames [s]."""
    shift = np.linalg.norm(com - com[at_rest].mean(axis=0), axis=1)
    there = np.isfinite(shift)
    shift, times = shift[there], times[there]
    # It must stay away: noise alone comes back.
    moved = np.minimum.accumulate(shift[::-1])[::-1] > ONSET_SHIFT
    if not moved.any():
        raise PerceptionError(
            "the object never moves by a millimetre: give the time stamp at which the blade starts"
        )
    k = int(moved.argmax())
    if k == 0:
        raise PerceptionError(
            "the object moves from the first frame on: start recording before the blade touches it"
        )
    share = (ONSET_SHIFT - shift[k - 1]) / max(shift[k] - shift[k - 1], 1e-9)
    return float(times[k - 1] + np.clip(share, 0, 1) * (times[k] - times[k - 1]))


def _sample_times(
    times: Float[np.ndarray, " frame"], start: float, config: ImportConfig, followed: Track
) -> Float[np.ndarray, " time"]:
    """Times of the interaction's samples since the blade's start [s], as far as the recording has them.

    Raises:
        PerceptionError: The recording begins too late, ends too early, or has too long a gap.
    """
    count = round(config.path.duration / config.sample_period) + 1
    grid = config.sample_period * np.arange(count)
    grid = grid[: int(np.searchsorted(grid, times[-1] - start + 1e-6, side="right"))]
    if len(grid) < 2 or grid[-1] < config.path.lift_start:
        raise PerceptionError(
            f"the recording ends {times[-1] - start:.2f} s after the blade starts, before the lift: record to the end"
        )
    if start < times[0] - ONSET:
        raise PerceptionError(
            f"the blade starts at {start:.2f} s, the recording at {times[0]:.2f} s: the object was not recorded at rest"
        )
    for begin, end in followed.gaps():
        if end >= start and begin <= start + grid[-1]:
            raise PerceptionError(
                f"the object's markers are not seen from {begin:.2f} to {end:.2f} s, longer than the "
                f"{config.track.largest_gap} s that are bridged: covered, or seen too flatly; record from another side"
            )
    return grid


def _record(
    times: Float[np.ndarray, " frame"],
    T_table_object: Float[np.ndarray, "frame 4 4"],
    observation: Observation,
    start: float,
    config: ImportConfig,
    followed: Track,
) -> Interaction:
    """The interaction on the data's time grid, in the action frame."""
    grid = _sample_times(times, start, config, followed)
    T_action_table = invert_transform(observation.T_table_action)
    there = np.isfinite(T_table_object[:, 0, 0])
    known = T_action_table @ T_table_object[there]
    poses = interpolate_poses(times[there] - start, known, grid)
    trajectory = matrix_to_pose(poses)
    trajectory[:, 3:] = continuous_quaternions(trajectory[:, 3:])
    obj = observation.placed.object
    com = transform_points(poses, obj.mass_properties(1.0).com[None])[:, 0]
    action = replace(observation.action, path=config.path)
    tool = tool_poses(action.tool_motion(grid))
    effect = Effect.judged(Motion(grid, trajectory, tool, np.empty((len(grid), 0))), obj, action, com)
    provenance = Provenance(
        source="recorded",
        engine="",
        camera="recorded",
        timestep=0.0,
        sample_period=config.sample_period,
        versions=versions_of("foretrace", "numpy"),
    )
    return Interaction(obj, action, observation.view, effect, provenance=provenance)
