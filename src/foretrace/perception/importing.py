"""From a film to an interaction: the object on the table, its path, the view of it, and what became of it."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version

import numpy as np
from jaxtyping import Bool, Float, UInt8

from foretrace.actions import LeverUp, Motion, ToolPath, tool_poses
from foretrace.errors import PerceptionError
from foretrace.geometry import continuous_quaternions, invert_transform, matrix_to_pose, transform_points
from foretrace.interactions.film_folder import Frame
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.record import Effect, Interaction, Provenance
from foretrace.interactions.topdown import MINIMAL_HEIGHT
from foretrace.objects import BEVEL, ObjectModel
from foretrace.perception.films import Film
from foretrace.perception.markers import (
    Detections,
    MarkerLayout,
    align_patterns,
    detect_markers,
    fitting_dictionaries,
    picture_fault,
)
from foretrace.perception.masks import (
    cover_by_background,
    cover_of,
    heights_above_table,
    mask_by_height,
    pick_object,
)
from foretrace.perception.tracking import Track, TrackConfig, slerp, still_pose, track
from foretrace.perception.views import PlacedObject, Sight, contact_at_pixel, fit_object, place_object, see

ONSET = 0.407
"""Time from the start of the blade's usual path until the object has moved by a millimetre [s]: the median of the
simulated lever-ups, whose standard deviation is 0.016 s."""
ONSET_SHIFT = 0.001
"""How far that is [m]."""
REST_TIME = 0.2
"""So long the object must be seen at rest before it moves [s]."""
TABLE_LOOKS = 15
"""Frames whose table markers are measured with care; the camera stands still."""
LEAST_LEVEL = 0.03
"""A marker's height on an object may err by this much before the film is refused [m]."""


@dataclass(frozen=True)
class ImportConfig:
    """How films become interactions."""

    track: TrackConfig = field(default_factory=TrackConfig)
    """How markers are followed."""
    path: ToolPath = field(default_factory=ToolPath)
    """The blade's path, as planned; it is recorded as the tool's, since nobody filmed it."""
    sample_period: float = 0.05
    """Time between the samples of the interaction [s]: that of the data that it joins."""
    start: float | None = None
    """Time stamp at which the blade's path starts [s]; by default the film's note, else from the object's motion."""
    height: float | None = None
    """Height of an object of unknown shape [m]; by default that of its marker above the table."""
    shadows: bool = True
    """Whether there may be shadows, which are then told from the object."""

    def __post_init__(self) -> None:
        if self.start is not None and not np.isfinite(self.start):
            raise PerceptionError(f"start = {self.start}: give a time stamp of the film in seconds")


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
                "say where the object is levered: give exactly one of point, pixel and edge"
            )


@dataclass(frozen=True)
class Imported:
    """An interaction, and how it was found."""

    interaction: Interaction
    """The interaction."""
    sight: Sight
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
        return invert_transform(self.sight.T_table_action) @ self.T_table_camera


def import_film(
    film: Film,
    camera: PinholeCamera,
    layout: MarkerLayout,
    contact: Contact,
    shape: ObjectModel | None = None,
    config: ImportConfig = ImportConfig(),
) -> Imported:
    """Turns a film of one lever-up into an interaction.

    Args:
        film: The film; its first frames show the object at rest.
        camera: The calibrated camera, which stands still.
        layout: The markers on table and object.
        contact: Where the object is levered.
        shape: The object; None: the prism that its outline shows.
        config: How.

    Raises:
        PerceptionError: The film does not tell the interaction: no markers, too large a gap, no rest, no mask...
    """
    first, times, detections = _look_through(film, camera, layout)
    T_table_camera = invert_transform(
        still_pose(_careful(detections, layout), layout.table, camera, config.track)
    )
    followed = track(times, detections, layout.object, camera, config.track)
    T_table_body = T_table_camera @ followed.T_camera_body
    at_rest = _rest(times, T_table_body)
    T_table_start = _mean_transform(T_table_body[at_rest])
    placed = _place(first, film, camera, layout, T_table_camera, T_table_start, shape, config)
    T_table_object = T_table_body @ (invert_transform(T_table_start) @ placed.T_table_object)
    sight = see_contact(placed, contact, camera, T_table_camera)
    start = config.start if config.start is not None else film.notes.action_start
    com = placed.object.mass_properties(1.0).com
    if start is None:
        start = _onset(times, transform_points(T_table_object, com[None])[:, 0], at_rest) - ONSET
    interaction = _record(times, T_table_object, sight, start, config, followed)
    return Imported(interaction, sight, followed, T_table_camera, T_table_object, start)


def see_contact(
    placed: PlacedObject, contact: Contact, camera: PinholeCamera, T_table_camera: Float[np.ndarray, "4 4"]
) -> Sight:
    """The lever-up that a contact means.

    Raises:
        PerceptionError: It lies far from the outline.
        ActionError: There is no such edge.
    """
    if contact.edge is not None:
        action = LeverUp.at_edge(placed.object, *contact.edge)
        return see(placed, action.contact)
    if contact.pixel is not None:
        return see(placed, contact_at_pixel(placed, contact.pixel, camera, T_table_camera))
    return see(placed, np.array(contact.point, dtype=float))


def _look_through(
    film: Film, camera: PinholeCamera, layout: MarkerLayout
) -> tuple[list[Frame], Float[np.ndarray, " frame"], list[Detections]]:
    """The first frame, and times and markers of all."""
    first, times, detections = [], [], []
    table, thing = set(layout.table.ids), set(layout.object.ids)
    hopeless = None
    for number, frame in enumerate(film.frames()):
        camera.check_picture(frame.picture, f"frame {number} of {film.path}")
        if times and frame.time <= times[-1]:
            raise PerceptionError(
                f"time stamps of {film.path} do not increase: frame {number} at {frame.time:.6f} s follows "
                f"{times[-1]:.6f} s; sort or film again"
            )
        if frame.depth is not None:
            camera.check_picture(frame.depth, f"depth picture {number} of {film.path}")
        seen = detect_markers(frame.picture, layout.dictionary)
        wanted = thing | table if number < TABLE_LOOKS else thing
        detections.append(align_patterns(frame.picture, seen, layout.dictionary, wanted))
        times.append(frame.time)
        first = first or [frame]
        if hopeless is None and not (table | thing) & set(seen.ids.tolist()):
            hopeless = frame.picture
    for name, ids in (("object", thing), ("table", table)):
        count = sum(bool(ids & set(seen.ids.tolist())) for seen in detections)
        if count < 2:
            raise PerceptionError(
                f"the {name}'s markers {sorted(ids)} are seen in {count} of {len(times)} frames of {film.path}: "
                f"{_excuse(first[0].picture if hopeless is None else hopeless, layout)}"
            )
    return first, np.array(times), detections


def _excuse(picture: UInt8[np.ndarray, "rows columns 3"], layout: MarkerLayout) -> str:
    """Why markers may not have been found in a picture."""
    if fault := picture_fault(picture):
        return fault
    fitting = [name for name in fitting_dictionaries(picture) if name != layout.dictionary.lower()]
    here = detect_markers(picture, layout.dictionary).ids.tolist()
    if here:
        return f"seen are {sorted(here)}; check the ids in the marker layout"
    if fitting:
        return f"the picture has markers of {fitting[0]}; check the dictionary in the marker layout"
    return "no marker of any known dictionary is in the picture; bring it nearer or light it better"


def _careful(detections: Sequence[Detections], layout: MarkerLayout) -> list[Detections]:
    """The frames in which the table is looked at: the first that show it."""
    wanted = set(layout.table.ids)
    return [seen for seen in detections[:TABLE_LOOKS] if wanted & set(seen.ids.tolist())] or list(detections)


def _rest(
    times: Float[np.ndarray, " frame"], T_table_body: Float[np.ndarray, "frame 4 4"]
) -> Bool[np.ndarray, " frame"]:
    """The frames at the beginning in which the object lies still."""
    there = np.isfinite(T_table_body[:, 0, 0])
    begin = times[there][0]
    early = there & (times <= begin + REST_TIME)
    shift = np.linalg.norm(T_table_body[early, :3, 3] - T_table_body[early][0, :3, 3], axis=1)
    if early.sum() < 2 or shift.max() > 3 * ONSET_SHIFT:
        raise PerceptionError(
            f"the object moves by {1e3 * shift.max(initial=0):.1f} mm in the film's first {REST_TIME} s: start filming "
            "before the blade touches it"
        )
    return early


def _mean_transform(transforms: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "4 4"]:
    """The mean of poses that are nearly alike."""
    mean = np.eye(4)
    u, _, vt = np.linalg.svd(transforms[:, :3, :3].mean(axis=0))
    mean[:3, :3] = u @ vt
    mean[:3, 3] = transforms[:, :3, 3].mean(axis=0)
    return mean


def _place(
    first: Sequence[Frame],
    film: Film,
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
    mask, rim = find_mask(first[0], film, camera, T_table_camera, point, config.shadows)
    seen = place_object(mask, camera, T_table_camera, height, min(rim, 0.5 * height))
    return seen if shape is None else fit_object(seen, shape)


def find_mask(
    frame: Frame,
    film: Film,
    camera: PinholeCamera,
    T_table_camera: Float[np.ndarray, "4 4"],
    point: tuple[float, float],
    shadows: bool = True,
) -> tuple[Bool[np.ndarray, "rows columns"] | Float[np.ndarray, "rows columns"], float]:
    """The object in the first frame by the film's background or its depth, and where above the table it begins [m].

    By the background: which part of each pixel it covers. By depth where the background does not tell.

    Raises:
        PerceptionError: The film has neither, or what it has does not tell.
    """
    background = film.background()
    if background is not None:
        try:
            cover = cover_by_background(frame.picture, background, shadows=shadows)
            return cover_of(cover, pick_object(cover > 0.5, point)), BEVEL.height
        except PerceptionError as error:
            if frame.depth is None:
                raise
            warnings.warn(f"the object is found by depth, since by background: {error}", stacklevel=2)
    if frame.depth is not None:
        heights = heights_above_table(frame.depth, camera, T_table_camera)
        return pick_object(mask_by_height(heights), point), 2 * MINIMAL_HEIGHT
    raise PerceptionError(
        f"{film.path} has neither background.png nor depth to find the object by: film the empty table, or say where "
        "the marker sits on the object with object_pose in the marker layout"
    )


def level(T_table_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The pose of an object that lies flat on the table, nearest to a measured one."""
    angle = np.arctan2(T_table_object[1, 0], T_table_object[0, 0])
    flat = np.eye(4)
    flat[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    flat[:2, 3] = T_table_object[:2, 3]
    return flat


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
            "the object moves from the first frame on: start filming before the blade touches it"
        )
    share = (ONSET_SHIFT - shift[k - 1]) / max(shift[k] - shift[k - 1], 1e-9)
    return float(times[k - 1] + np.clip(share, 0, 1) * (times[k] - times[k - 1]))


def _record(
    times: Float[np.ndarray, " frame"],
    T_table_object: Float[np.ndarray, "frame 4 4"],
    sight: Sight,
    start: float,
    config: ImportConfig,
    followed: Track,
) -> Interaction:
    """The interaction on the data's time grid, in the action frame."""
    count = round(config.path.duration / config.sample_period) + 1
    grid = config.sample_period * np.arange(count)
    grid = grid[: int(np.searchsorted(grid, times[-1] - start + 1e-6, side="right"))]
    if len(grid) < 2 or start + grid[-1] < start + config.path.lift_start:
        raise PerceptionError(
            f"the film ends {times[-1] - start:.2f} s after the blade starts, before the lift: film to the end"
        )
    if start < times[0] - ONSET:
        raise PerceptionError(
            f"the blade starts at {start:.2f} s, the film at {times[0]:.2f} s: the object was not filmed at rest"
        )
    for begin, end in followed.gaps():
        if end >= start and begin <= start + grid[-1]:
            raise PerceptionError(
                f"the object's markers are not seen from {begin:.2f} to {end:.2f} s, longer than the "
                f"{config.track.largest_gap} s that are bridged: covered, or seen too flatly; film again from elsewhere"
            )
    T_action_table = invert_transform(sight.T_table_action)
    there = np.isfinite(T_table_object[:, 0, 0])
    known = T_action_table @ T_table_object[there]
    stamps = times[there] - start
    poses = np.tile(np.eye(4), (len(grid), 1, 1))
    poses[:, :3, 3] = np.column_stack([np.interp(grid, stamps, known[:, i, 3]) for i in range(3)])
    poses[:, :3, :3] = slerp(stamps, known[:, :3, :3], grid)
    trajectory = matrix_to_pose(poses)
    trajectory[:, 3:] = continuous_quaternions(trajectory[:, 3:])
    obj = sight.placed.object
    com = transform_points(poses, obj.mass_properties(1.0).com[None])[:, 0]
    action = replace(sight.action, path=config.path)
    tool = tool_poses(action.tool_motion(grid))
    judgement = action.judge(Motion(grid, trajectory, tool, np.empty((len(grid), 0))), obj, com)
    effect = Effect(
        times=grid,
        pose_trajectory=trajectory,
        com_trajectory=com,
        tool_trajectory=tool,
        joint_trajectory=np.empty((len(grid), 0)),
        support_points=np.full((2, 2), np.nan),
        support_corners=(),
        outcome=judgement.outcome,
        slip_index=judgement.slip_index,
    )
    versions = {name: version(name) for name in ("foretrace", "numpy")}
    provenance = Provenance(
        source="recorded",
        engine="",
        camera="recorded",
        timestep=0.0,
        sample_period=config.sample_period,
        versions=versions,
    )
    return Interaction(obj, action, sight.view, effect, provenance=provenance)
