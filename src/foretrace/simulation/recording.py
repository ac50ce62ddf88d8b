"""Recordings of simulated lever-ups, with markers on object and table, as a camera above a table takes them."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
import shapely
from jaxtyping import Float, UInt8

from foretrace.actions import LeverUp, Motion
from foretrace.errors import SimulationError, check_choices, check_ranges, check_type, shown
from foretrace.files import write_json
from foretrace.geometry import (
    invert_transform,
    matrix_to_pose,
    planar_transform,
    pose_to_matrix,
    rigid_transform,
    transform_points,
)
from foretrace.interactions import recording_folder
from foretrace.interactions.marker_patterns import draw_marker
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.record import Interaction
from foretrace.interactions.recording_folder import Frame, RecordingNotes, write_recording
from foretrace.objects import ObjectModel
from foretrace.simulation.engine import make_engine
from foretrace.simulation.lens import SLAB, WEBCAM, Faults, LensCamera, add_image, spoil, spoil_depth
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.scene import body_origin, build_scene
from foretrace.simulation.stage import ObjectColour, TableTop, cast_shadows, set_stage
from foretrace.trajectories import interpolate

DICTIONARY = "apriltag_36h11"
MODULES = 8
"""Modules along a side of such a marker, its black rim included; a white margin of one goes round it."""
IMAGE_PIXELS = 40
"""Pixels along a module of a marker's texture."""
FINE_PERIOD = 0.01
"""Time between the states that a recording is interpolated from [s]."""
TABLE_SPOTS = ((0.33, 0.15), (0.33, -0.15), (-0.13, 0.21), (-0.13, -0.21))
"""Where the table's markers lie in the action frame [m]: clear of any object of 10 cm radius."""
OBJECT_ID = 10
X_Z_PITCH = (0, 2, 4)
"""Coordinates in which a lever-up's tool moves."""
OUT_OF_SIGHT = (0.0, 0.0, -5.0)
FAULTS = Faults()
"""The nominal ones."""
WIDTH_RANGE = {"width": (64, 7680)}
RANGES = {
    "distance": (0.1, 10.0),
    "slant": (0.0, 1.5),
    "azimuth": (-10.0, 10.0),
    "frames_per_second": (1.0, 100.0),
    "lead_time": (0.0, 60.0),
    "tail_time": (-60.0, 60.0),
    "exposures": (1, 100),
    "depth_every": (0, 1_000_000),
    "table_side": (0.001, 1.0),
    "largest_side": (0.001, 1.0),
}
"""What can be recorded."""
WITHIN = "beyond, images do not fit into memory, or the camera is below the table or in the object"


@dataclass(frozen=True)
class RecordingConfig:
    """How a lever-up is recorded."""

    camera: PinholeCamera = WEBCAM
    """The camera's true intrinsics."""
    distance: float = 0.7
    """From the camera to the point on the table that it looks at, before the contact point [m]."""
    slant: float = 0.6
    """Angle of its line of sight from the vertical [rad]."""
    azimuth: float = 1.0
    """Where it stands about that point, from the action's direction towards its left [rad]: ahead of the object, whose
    upper face turns that way."""
    frames_per_second: float = 30.0
    """Frames per second."""
    lead_time: float = 0.4
    """Time recorded before the blade's path starts [s]."""
    tail_time: float = 0.1
    """Time recorded after its end [s]; below 0, the recording ends before."""
    exposures: int = 2
    """Moments within a hundredth of a second that are blended into one frame: motion blur."""
    depth_every: int = 1
    """Colour frames from one with depth to the next; 0: no depth."""
    faults: Faults = field(default_factory=Faults)
    """What spoils the images."""
    shadows: bool = False
    """A slanted lamp of some size casts soft shadows."""
    table: TableTop = "plain"
    """How the table looks."""
    object_colour: ObjectColour = "blue"
    """The object's colour; grey resembles the plain table, brown the wooden one."""
    table_side: float = 0.05
    """Side of the table's markers [m]."""
    largest_side: float = 0.045
    """Side of the object's marker, if it has room [m]."""
    simulation: SimulationConfig = field(default_factory=lambda: SimulationConfig(embodiment="tool"))
    """How the lever-up is simulated; MuJoCo alone can record."""

    def __post_init__(self) -> None:
        check_type("simulation", self.simulation, SimulationConfig, SimulationError)
        check_type("camera", self.camera, PinholeCamera, SimulationError)
        check_type("faults", self.faults, Faults, SimulationError)
        if self.simulation.engine != "mujoco":
            raise SimulationError(f"engine {shown(self.simulation.engine)} cannot record: take mujoco")
        check_ranges(SimulationError, "film", self.camera, WIDTH_RANGE, WITHIN)
        check_ranges(SimulationError, "film", self, RANGES, WITHIN)
        check_choices(SimulationError, self)


@dataclass(frozen=True)
class RecordingTruth:
    """What a recording shows, known exactly."""

    interaction: Interaction
    """The lever-up that was recorded."""
    times: Float[np.ndarray, " frame"]
    """Time stamps [s]."""
    T_table_object: Float[np.ndarray, "frame 4 4"]
    """The object in the table frame, frame by frame."""
    T_table_camera: Float[np.ndarray, "4 4"]
    """The camera in the table frame."""
    T_table_action: Float[np.ndarray, "4 4"]
    """The action frame in the table frame."""
    action_start: float
    """Time stamp at which the blade's path starts [s]."""

    def to_dict(self) -> dict[str, Any]:
        """The truth as plain JSON values."""
        effect = self.interaction.effect
        return {
            "object": self.interaction.object.to_dict(),
            "contact": self.interaction.action.contact.tolist(),
            "direction": self.interaction.action.direction.tolist(),
            "outcome": str(effect.outcome),
            "action_start": self.action_start,
            "T_table_camera": self.T_table_camera.tolist(),
            "T_table_action": self.T_table_action.tolist(),
            "times": self.times.tolist(),
            "object_poses_in_table": matrix_to_pose(self.T_table_object).tolist(),
        }


def record_lever_up(
    obj: ObjectModel,
    action: LeverUp,
    folder: Path,
    config: RecordingConfig = RecordingConfig(),
    *,
    seed: int = 0,
) -> RecordingTruth:
    """Record a simulated lever-up into a folder: frames, time stamps, background, marker layout, and the truth.

    The camera's intrinsics are left out: they are to be found by calibration.

    Args:
        obj: The object.
        action: The lever-up.
        folder: An empty or new folder.
        config: How it is recorded.
        seed: Seed of the noise, of where marker and lamp are, of the clock, and of the table's pattern.

    Raises:
        SimulationError: The machine cannot render.
        ActionError: The contact is not on the outline.
    """
    rng = np.random.default_rng(seed)
    simulation = config.simulation
    interaction = simulate_lever_up(obj, action, simulation, seed=seed)
    engine = make_engine("mujoco", simulation.embodiment, simulation.timestep, FINE_PERIOD)
    motion = engine.play(
        obj, action.T_action_object, action.tool, action.tool_motion, action.duration, simulation.physics
    )
    T_object_marker, side = marker_spot(obj, config.largest_side, rng)
    T_action_camera = camera_pose(config)
    spec = build_scene(
        obj, simulation.physics, action.tool, simulation.embodiment, simulation.timestep, X_Z_PITCH
    )
    T_action_table = _add_markers(spec, obj, T_object_marker, side, config, rng)
    T_table_action = invert_transform(T_action_table)
    set_stage(spec, config.table, config.object_colour, np.random.default_rng([seed, 1]))
    lamp = cast_shadows(spec, np.random.default_rng([seed, 2])) if config.shadows else None
    action_start = round(float(rng.uniform(5.0, 50.0)), 3)
    times = _frame_times(action, action_start, config)
    poses = _poses_at(motion, motion.object_pose, times - action_start)
    with LensCamera(spec, config.camera, T_action_camera, lamp) as lens:
        folder.mkdir(parents=True, exist_ok=True)
        take = _Take(lens, obj, motion, config, rng)
        recording_folder.write_image(folder / recording_folder.BACKGROUND, take.background())
        write_recording(folder, take.frames(times, action_start), RecordingNotes())
    truth = RecordingTruth(
        interaction,
        times,
        T_table_action @ pose_to_matrix(poses),
        T_table_action @ T_action_camera,
        T_table_action,
        action_start,
    )
    layout = _layout(T_table_action, side, config)
    for name, content in (("truth.json", truth.to_dict()), (recording_folder.MARKERS, layout)):
        write_json(folder / name, content)
    return truth


def _frame_times(
    action: LeverUp, action_start: float, config: RecordingConfig
) -> Float[np.ndarray, " frame"]:
    duration = config.lead_time + action.duration + config.tail_time
    count = max(1, round(duration * config.frames_per_second))
    return action_start - config.lead_time + np.arange(count) / config.frames_per_second


def photograph_board(
    image: UInt8[np.ndarray, "rows columns"],
    size: tuple[float, float],
    camera: PinholeCamera = WEBCAM,
    num: int = 15,
    faults: Faults = FAULTS,
    *,
    seed: int = 0,
) -> Iterator[UInt8[np.ndarray, "rows columns 3"]]:
    """Images of a printed board held before a camera, slanted this way and that.

    Args:
        image: What is printed on it, in grey.
        size: Width and height of the print [m].
        camera: The camera's true intrinsics.
        num: Number of images.
        faults: What spoils them.
        seed: Seed of the poses and of the noise.
    """
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4] * 3, [0.5] * 3
    spec.visual.headlight.specular = [0.0] * 3
    board = spec.worldbody.add_body(name="board")
    board.add_freejoint()
    board.mass, board.inertia, board.explicitinertial = 1.0, [1.0, 1.0, 1.0], True
    margin = round(0.05 * max(image.shape))
    metres = size[0] / image.shape[1]
    paper = np.pad(image, margin, constant_values=255)
    whole = (metres * paper.shape[1], metres * paper.shape[0])
    add_image(board, spec, "board", paper, whole, np.array([0.0, 0, 0, 1, 0, 0, 0]))
    with LensCamera(spec, camera, np.eye(4)) as lens:
        for _ in range(num):
            lens.data.qpos[:] = matrix_to_pose(_held(camera, max(size), rng))
            yield spoil(lens.colours(), faults, rng.uniform(-1, 1), rng)


def _held(camera: PinholeCamera, size: float, rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
    """A pose in which a board of that size fills a good part of the image."""
    pixel = rng.uniform([0.3, 0.3], [0.7, 0.7]) * [camera.width, camera.height]
    distance = rng.uniform(1.1, 1.9) * size * camera.fx / camera.width * 1.6
    turn, _ = cv2.Rodrigues(rng.uniform([-0.6, -0.6, -0.4], [0.6, 0.6, 0.4]))
    facing = turn @ np.diag([1.0, -1.0, -1.0])  # the board faces the camera
    return rigid_transform(facing, distance * camera.rays(pixel[None])[0])


def camera_pose(config: RecordingConfig) -> Float[np.ndarray, "4 4"]:
    """T_action_camera: looking at a point 8 cm ahead of the contact point."""
    aim = np.array([0.08, 0.0, 0.0])
    horizontal = np.array([np.cos(config.azimuth), np.sin(config.azimuth), 0.0])
    away = np.sin(config.slant) * horizontal + np.array([0.0, 0.0, np.cos(config.slant)])
    right = np.cross([0.0, 0.0, 1.0], horizontal)
    axes = np.column_stack([right, np.cross(-away, right), -away])
    return rigid_transform(axes, aim + config.distance * away)


def marker_spot(
    obj: ObjectModel, largest: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Where on an object's top a marker has most room, turned at random: T_object_marker, and its side [m]."""
    circle = shapely.maximum_inscribed_circle(shapely.Polygon(obj.corners))
    middle, rim = np.array(circle.coords)
    half_diagonal = np.linalg.norm(rim - middle)
    side = min(largest, float(half_diagonal) * np.sqrt(2) * MODULES / (MODULES + 2))
    return planar_transform([*middle, obj.height + SLAB], rng.uniform(-np.pi, np.pi)), side


def marker_image(id: int) -> UInt8[np.ndarray, "rows columns"]:
    """A marker with its white margin."""
    return np.pad(draw_marker(DICTIONARY, id, IMAGE_PIXELS), IMAGE_PIXELS, constant_values=255)


def _add_markers(
    spec: mujoco.MjSpec,
    obj: ObjectModel,
    T_object_marker: Float[np.ndarray, "4 4"],
    side: float,
    config: RecordingConfig,
    rng: np.random.Generator,
) -> Float[np.ndarray, "4 4"]:
    """Puts the markers into the scene; returns T_action_table, the first table marker's pose."""
    paper = (MODULES + 2) / MODULES
    on_body = T_object_marker.copy()
    on_body[:3, 3] -= body_origin(obj) + np.array([0.0, 0.0, SLAB / 2])
    add_image(
        spec.body("object"),
        spec,
        "tag",
        marker_image(OBJECT_ID),
        (paper * side, paper * side),
        matrix_to_pose(on_body),
    )
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
    size = (paper * config.table_side, paper * config.table_side)
    for id, spot in enumerate(TABLE_SPOTS):
        pose = np.array([*spot, SLAB / 2, *turn])
        add_image(spec.worldbody, spec, f"tag_{id}", marker_image(id), size, pose)
    return pose_to_matrix(np.array([*TABLE_SPOTS[0], SLAB, *turn]))


def _layout(T_table_action: Float[np.ndarray, "4 4"], side: float, config: RecordingConfig) -> dict[str, Any]:
    """The marker layout, as measured with a ruler."""
    spots = np.column_stack([TABLE_SPOTS, np.zeros(len(TABLE_SPOTS))])
    in_table = transform_points(T_table_action, spots)[:, :2].round(6)
    table = [
        {"id": id, "side": config.table_side, "position": spot, "angle_deg": 0.0}
        for id, spot in enumerate(in_table.tolist())
    ]
    layout = {"format": "foretrace-markers", "version": 1, "dictionary": DICTIONARY}
    return layout | {"table": table, "object": [{"id": OBJECT_ID, "side": side}]}


def _poses_at(
    motion: Motion, poses: Float[np.ndarray, "time 7"], times: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 7"]:
    """Poses between the engine's samples, at rest before the first and after the last."""
    mixed = interpolate(motion.times, poses, times)
    mixed[:, 3:] /= np.linalg.norm(mixed[:, 3:], axis=1, keepdims=True)
    return mixed


@dataclass(frozen=True)
class _Take:
    """A motion in front of a camera."""

    lens: LensCamera
    obj: ObjectModel
    motion: Motion
    config: RecordingConfig
    rng: np.random.Generator

    def frames(self, times: Float[np.ndarray, " frame"], action_start: float) -> Iterator[Frame]:
        """The motion, frame by frame."""
        config, rng = self.config, self.rng
        phase = rng.uniform(0, 2 * np.pi)
        offsets = 0.01 * (np.arange(config.exposures) - (config.exposures - 1) / 2) / config.exposures
        for number, time in enumerate(times):
            blended = np.zeros((config.camera.height, config.camera.width, 3), dtype=np.float32)
            for offset in offsets:
                self.place(time - action_start + offset)
                blended += self.lens.colours() / config.exposures
            light = np.sin(phase + 2 * np.pi * 0.3 * (time - times[0]))
            image = spoil(blended, config.faults, float(light), rng)
            depth = None
            if config.depth_every and number % config.depth_every == 0:
                self.place(time - action_start)
                depth = spoil_depth(self.lens.depths(), config.faults, rng)
            yield Frame(round(float(time), 6), image, depth)

    def background(self) -> UInt8[np.ndarray, "rows columns 3"]:
        """The table before the object was put there, in the mean of some images."""
        self.place(0.0)
        self.lens.data.qpos[:3] = OUT_OF_SIGHT
        perfect, rng = self.lens.colours(), self.rng
        images = [spoil(perfect, self.config.faults, rng.uniform(-1, 1), rng) for _ in range(4)]
        return np.rint(np.mean(images, axis=0)).astype(np.uint8)

    def place(self, time: float) -> None:
        """Puts object and tool where they are at a time since the path's start."""
        motion, now, qpos = self.motion, np.array([time]), self.lens.data.qpos
        pose, tool = (_poses_at(motion, poses, now)[0] for poses in (motion.object_pose, motion.tool_pose))
        qpos[:7] = matrix_to_pose(pose_to_matrix(pose) @ planar_transform(body_origin(self.obj), 0.0))
        if motion.joints.shape[1]:
            qpos[7:] = interpolate(motion.times, motion.joints, now)[0]
        else:
            qpos[7:] = [tool[0], tool[2], 2 * np.arctan2(tool[5], tool[3])]
