"""How far a simulated motion strays from a recorded one that started in the same way."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation
from tyro.conf import Positional

from foretrace.errors import DatasetError
from foretrace.evaluation.charts import finish, grid, style_of
from foretrace.evaluation.experiment import Experiment, Row, Trial
from foretrace.evaluation.tables import markdown_table
from foretrace.experiments import SUMMARIES
from foretrace.files import short_hash
from foretrace.geometry import quaternion_to_matrix, rotation_angle
from foretrace.interactions.motions import Recording, read_recordings
from foretrace.pictures.style import new_figure, styled
from foretrace.simulation.free_motion import simulate_free_motion

FACE_TOLERANCE = np.deg2rad(20.0)
"""The same side is down if its direction differs by less than this [rad]."""
ESTIMATE_TIME = 0.1
"""Velocities that are not recorded are estimated from the frames of this time [s], from at least three."""
CLEARANCE = 0.002
"""Height above the table from which a tracked object is taken to touch nothing [m]."""
TIMESTEP = 0.001
"""Time step of the simulation [s]."""
COLUMNS = {
    "duration_s": ("Time [s]", 1, 2),
    "mean_position_error_m": ("Position error, mean [cm]", 100, 2),
    "final_position_error_m": ("Final [cm]", 100, 2),
    "mean_rotation_error_deg": ("Rotation error, mean [°]", 1, 1),
    "final_rotation_error_deg": ("Final [°]", 1, 1),
}
"""Columns of the report: heading, factor and digits of a number of the summary."""


@dataclass(frozen=True)
class RecordingTrial(Trial):
    """One recorded motion."""

    recording: str
    """Its name."""


@dataclass(frozen=True)
class ReplayExperiment(Experiment):
    """Simulate recorded motions of rigid bodies from their first frame, and measure how far the simulation strays."""

    recordings: Positional[tuple[Path, ...]]
    """Files of recordings."""
    engine: Literal["mujoco", "bullet"] = "mujoco"
    """Physics engine."""
    timestep: float = TIMESTEP
    """Time step in seconds."""

    label = "replay"
    summary = SUMMARIES["replay"]
    trial = RecordingTrial
    needs_folder = False

    def __post_init__(self) -> None:
        if not self.recordings:
            raise DatasetError("no recording is given: name at least one file")

    def trials(self) -> Sequence[RecordingTrial]:
        """One for each recording."""
        return [RecordingTrial(name) for name in self._read]

    def identity(self) -> dict[str, Any]:
        """The files, engine and time step."""
        files = [short_hash([file.read_bytes()]) for file in self.recordings]
        return {"recordings": files, "engine": self.engine, "timestep_s": self.timestep}

    def run(self, trial: RecordingTrial, folder: Path) -> Sequence[Row]:
        """The errors over time, and what is the same in all rows of a recording."""
        found = replay(self._read[trial.recording], self.engine, self.timestep)
        start = "estimated" if found.recording.velocity is None else "recorded"
        same = {"start_velocity": start, "down_error_deg": float(np.rad2deg(found.down_error))}
        rows = pd.DataFrame(
            {
                "time": found.recording.times,
                "position_error_m": found.position_error,
                "rotation_error_deg": np.rad2deg(found.rotation_error),
            }
        )
        return rows.assign(**same).to_dict("records")

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """The errors of each recording in a few numbers, and the share of those that end on the recorded side."""
        recordings = []
        for name, part in rows.groupby("recording", sort=False):
            position, turned = part["position_error_m"], part["rotation_error_deg"]
            last = part.iloc[-1]
            recordings.append(
                {
                    "recording": name,
                    "duration_s": float(last["time"]),
                    "frames": len(part),
                    "start_velocity": last["start_velocity"],
                    "mean_position_error_m": float(np.mean(position.to_numpy(float))),
                    "largest_position_error_m": float(position.to_numpy(float).max()),
                    "final_position_error_m": float(last["position_error_m"]),
                    "mean_rotation_error_deg": float(np.mean(turned.to_numpy(float))),
                    "final_rotation_error_deg": float(last["rotation_error_deg"]),
                    "down_error_deg": float(last["down_error_deg"]),
                    "right_face": bool(last["down_error_deg"] < np.rad2deg(FACE_TOLERANCE)),
                }
            )
        share = sum(each["right_face"] for each in recordings) / len(recordings)
        return {"share_right_face": share, "recordings": recordings}

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """A line for each recording."""
        lines = [
            [
                each["recording"],
                *(f"{scale * each[name]:.{digits}f}" for name, (_, scale, digits) in COLUMNS.items()),
                "right" if each["right_face"] else "wrong",
            ]
            for each in summary["recordings"]
        ]
        head = ["Recording", *(words for words, _, _ in COLUMNS.values()), "Side down at the end"]
        return f"# Recorded against simulated motions in {self.engine}\n\n{markdown_table(head, lines)}\n"

    @styled
    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Errors of position and rotation over time."""
        fig = new_figure(9.6, 4.2)
        axes = fig.subplots(1, 2)
        for name, part in rows.groupby("recording", sort=False):
            style = style_of(str(name))
            for ax, column, scale in zip(
                axes, ("position_error_m", "rotation_error_deg"), (100, 1), strict=True
            ):
                ax.plot(
                    part["time"],
                    scale * part[column],
                    linestyle=style.line,
                    color=style.color,
                    label=str(name),
                )
        for ax, words in zip(axes, ("position error [cm]", "rotation error [°]"), strict=True):
            grid(ax, xlabel="time [s]", ylabel=words, ylim=(0, None))
        fig.legend(handles=axes[0].lines, loc="outside lower center", ncols=4)
        finish(fig, "Simulated against recorded motions", f"both start from the first frame; {self.engine}")
        return {"errors": fig}

    @cached_property
    def _read(self) -> dict[str, Recording]:
        found = [recording for file in self.recordings for recording in read_recordings(file)]
        if len({recording.name for recording in found}) < len(found):
            raise DatasetError("two recordings have the same name: give every one its own")
        return {recording.name: recording for recording in found}


@dataclass(frozen=True, eq=False)
class Replay:
    """A recording and what the simulation made of its first frame."""

    recording: Recording
    """What was recorded."""
    poses: Float[np.ndarray, "time 7"]
    """Simulated object frame at the recorded times: position [m], quaternion (w, x, y, z)."""
    position_error: Float[np.ndarray, " time"]
    """Distance of the simulated from the recorded centre of mass [m]."""
    rotation_error: Float[np.ndarray, " time"]
    """Angle between simulated and recorded orientation [rad]."""
    down_error: float
    """Angle between the directions that point down at the end, in the object frame [rad]."""

    @property
    def right_face(self) -> bool:
        """Whether the simulated object ends on the recorded side."""
        return bool(self.down_error < FACE_TOLERANCE)


def replay(recording: Recording, engine: str = "mujoco", timestep: float = TIMESTEP) -> Replay:
    """Simulates a recorded motion from its first frame and compares.

    A first frame that noise has put into the table is lifted out of it. The time step is in seconds.

    Raises:
        SimulationError: If the engine is unknown or not installed, or the numbers blow up.
    """
    start = recording.poses[0].copy()
    start[2] += max(0.0, -recording.body.lowest(start))
    velocity = estimate_velocity(recording) if recording.velocity is None else recording.velocity
    motion = simulate_free_motion(
        recording.body,
        start,
        float(recording.times[-1]),
        velocity=velocity,
        contact_parameters=recording.contact_parameters,
        engine=engine,
        timestep=timestep,
    ).at(recording.times)
    seen, simulated = quaternion_to_matrix(recording.poses[:, 3:]), quaternion_to_matrix(motion.poses[:, 3:])
    com = recording.body.mass.com
    apart = motion.poses[:, :3] + simulated @ com - recording.poses[:, :3] - seen @ com
    return Replay(
        recording=recording,
        poses=motion.poses,
        position_error=np.linalg.norm(apart, axis=1),
        rotation_error=rotation_angle(seen, simulated),
        down_error=_down_error(seen[-1], simulated[-1], recording.is_round),
    )


def estimate_velocity(recording: Recording) -> Float[np.ndarray, " 6"]:
    """Velocity of the centre of mass [m/s] and angular velocity [rad/s] in the first frame.

    They are fitted to the frames of the first ``ESTIMATE_TIME``, up to the first contact with the table, as free
    flight: gravity is known, and the angular momentum stays the same. An object that is in the air in fewer than three
    of them is taken to move steadily: parabolas are fitted to the centre of mass and to the rotation since the first
    frame, or straight lines where there are fewer than four frames.
    """
    num = max(int((recording.times <= ESTIMATE_TIME).sum()), min(3, len(recording.times)))
    free = _frames_in_flight(recording, num)
    flies = free >= 3
    times, poses = (each[: free if flies else num] for each in (recording.times, recording.poses))
    rotations, mass = quaternion_to_matrix(poses[:, 3:]), recording.body.mass
    com = poses[:, :3] + rotations @ mass.com
    turned = Rotation.from_matrix(rotations @ rotations[0].T).as_rotvec()
    if flies:
        fallen = 0.5 * np.outer(times**2, recording.contact_parameters.gravity)
        linear = np.linalg.lstsq(np.vander(times, 2, increasing=True), com - fallen, rcond=None)[0][1]
        return np.concatenate([linear, _spin_in_flight(times, rotations, turned, mass.inertia)])
    powers = np.vander(times, 3 if num >= 4 else 2, increasing=True)
    solution = np.linalg.lstsq(powers, np.hstack([com, turned]), rcond=None)[0]
    return solution[1]


def _frames_in_flight(recording: Recording, most: int) -> int:
    """Number of frames before the object meets the table, ``most`` at the most.

    An object whose next frame would be in the table has touched it by then, even where that frame shows it above.
    """
    heights = np.array([recording.body.lowest(pose) for pose in recording.poses[:most]])
    speeds = np.diff(heights) / np.diff(recording.times[:most])
    expected = heights.copy()
    expected[2:] = heights[1:-1] + speeds[:-1] * np.diff(recording.times[:most])[1:]
    return int(np.argmin([*(np.minimum(heights, expected) > CLEARANCE), False]))


def _spin_in_flight(
    times: Float[np.ndarray, " time"],
    rotations: Float[np.ndarray, "time 3 3"],
    turned: Float[np.ndarray, "time 3"],
    inertia: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, " 3"]:
    """Angular velocity at the first time [rad/s] of a body without torque.

    The rotation vector since the first frame grows by ``J(turned) R inertia^-1 R^T L``, with the inverse left Jacobian
    J of SO(3) (Sola et al., 2018, equation 146) and the constant angular momentum L: linear in L, which is fitted.
    """
    rates = rotations @ np.linalg.inv(inertia) @ rotations.swapaxes(1, 2)
    skew = np.cross(turned[:, None, :], np.eye(3)).swapaxes(1, 2)
    angle = np.maximum(np.linalg.norm(turned, axis=1), 1e-4)[:, None, None]
    jacobian = np.eye(3) - skew / 2 + (1 / angle**2 - 0.5 / (angle * np.tan(angle / 2))) * skew @ skew
    grown = cumulative_trapezoid(jacobian @ rates, times, axis=0, initial=0)
    design = np.concatenate([np.broadcast_to(np.eye(3), grown.shape), grown], axis=2)
    return rates[0] @ np.linalg.lstsq(design.reshape(-1, 6), turned.ravel(), rcond=None)[0][3:]


def _down_error(seen: Float[np.ndarray, "3 3"], simulated: Float[np.ndarray, "3 3"], is_round: bool) -> float:
    """Angle between two downward directions in the object frame [rad]; a cylinder's axis alone counts."""
    first, second = -seen[2], -simulated[2]
    if is_round:
        first, second = ([np.hypot(x, y), 0.0, z] for x, y, z in (first, second))
    return float(np.arccos(np.clip(np.dot(first, second), -1, 1)))
