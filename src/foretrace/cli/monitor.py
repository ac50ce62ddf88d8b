"""The command that watches an action, recorded or under way, with a monitor."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from tyro.conf import OmitArgPrefixes, Positional, arg

from foretrace.cli.console import say
from foretrace.errors import DatasetError, MonitoringError
from foretrace.files import atomic_path, make_folder
from foretrace.geometry import invert_transform, matrix_to_pose, pose_to_matrix, transform_points
from foretrace.imagined import Belief, ImaginedEffect
from foretrace.monitoring import Monitor, Verdict
from foretrace.monitoring.causes import BAD_INPUT
from foretrace.pictures.scene import Scene
from foretrace.pictures.watched import monitor_figure, monitor_film
from foretrace.planning import Plan
from foretrace.predictor import load_imaginer

Sample = tuple[float, Float[np.ndarray, "7"] | None]
"""Time since the beginning of the action [s], and a pose; None where the object was lost."""
PICTURES, FILMS = (".png", ".svg", ".pdf"), (".gif", ".mp4")


@dataclass(frozen=True)
class TrackOptions:
    """Poses of a tracker, for a plan."""

    poses: Path | None = None
    """Table of poses (CSV) or bag of ROS, from the beginning of the action on."""
    topic: str | None = None
    """Topic of the poses in a bag; needed if several have poses."""
    child: str = "object"
    """Frame of the object, where a bag has transforms."""
    table: bool = False
    """The poses are in the table frame of the plan; otherwise in the action frame."""
    start: float | None = None
    """Time at which the action began, by the clock of the poses [s]; by default that of the first one."""


@dataclass(frozen=True)
class CameraOptions:
    """A camera that films the object while a plan is carried out (experimental)."""

    camera: str | None = None
    """Number of a camera for OpenCV; or a video, or a folder of frames, which stands for one."""
    markers: Path | None = None
    """Marker layout of table and object."""
    intrinsics: Path | None = None
    """The camera's file, as `calibrate` writes it."""
    delay: float = 0.0
    """Time from the first image to the beginning of the action [s]."""


@dataclass(frozen=True, eq=False)
class _Watched:
    """What happened, and what a monitor said of it."""

    scene: Scene
    imagined: ImaginedEffect
    verdicts: list[Verdict]
    com: Float[np.ndarray, "samples 3"]
    """Observed centre of mass, NaN where the object was lost."""


def monitor(
    data: Positional[Path],
    id: Positional[int | None] = None,
    *,
    out: Path,
    track: OmitArgPrefixes[TrackOptions] = TrackOptions(),
    live: Annotated[OmitArgPrefixes[CameraOptions], arg(name="camera")] = CameraOptions(),
    run: Path | None = None,
    false_alarms: float = 0.05,
    calibration: Path | None = None,
    worlds: int = Belief().worlds,
) -> None:
    """Watch a recorded or simulated action, sample by sample, as a monitor would have watched it under way.

    It is an interaction of a data set, or a plan with the poses that a tracker recorded while it was carried out. With
    --camera, a plan is watched while it is carried out (experimental: never tried with a camera).

    Writes an image of the score over time with its threshold, of the outcomes' probabilities, and of the height as
    imagined and observed, or a film in which the object moves beside them, with its expected edges; and prints when
    there was an alarm, and why.

    Args:
        data: Folder of the data set, or a plan.json.
        id: Number of the interaction.
        out: The image to write: .png, .svg or .pdf; or the film: .gif or .mp4.
        track: Poses, for a plan.
        live: Camera, for a plan.
        run: Folder of the training; by default the predictor that comes with foretrace.
        false_alarms: Share of whole normal executions that may alarm.
        calibration: File of another calibration than the one that comes with foretrace.
        worlds: Number of worlds in which the action is imagined.
    """
    if out.suffix.lower() not in PICTURES + FILMS:
        raise MonitoringError(
            f"cannot draw into {out}: choose a name that ends in {', '.join(PICTURES + FILMS)}"
        )
    belief = Belief(worlds=worlds)
    if data.suffix.lower() == ".json":
        if id is not None or (track.poses is None) == (live.camera is None):
            raise MonitoringError(
                f"{data} is a plan: give --poses FILE or --camera, and no number of an interaction"
            )
        watched = _watch_plan(data, track, live, run, belief, false_alarms, calibration)
    else:
        if id is None or track != TrackOptions() or live != CameraOptions():
            raise MonitoringError(
                f"{data} is a data set: give the number of an interaction, and no options of poses or of a camera, "
                "which belong to a plan.json"
            )
        watched = _watch_interaction(data, id, run, belief, false_alarms, calibration)
    make_folder(out.parent, MonitoringError)
    if out.suffix.lower() in FILMS:
        monitor_film(watched.scene, watched.imagined, watched.verdicts, out)
    else:
        figure = monitor_figure(
            watched.imagined, watched.verdicts, watched.com, watched.scene.title, watched.scene.source
        )
        with atomic_path(out) as temporary:
            figure.savefig(temporary, format=out.suffix[1:].lower())
    alarm, last = next((each for each in watched.verdicts if each.alarm), None), watched.verdicts[-1]
    if alarm is None:
        print(f"no alarm: score {last.score:.2f} of {last.threshold:.2f}; {last.message}")
    else:
        print(f"alarm at {alarm.time:.2f} s: {alarm.cause}; in the end: {last.message}")
    print(out)


def _watch_interaction(
    data: Path, id: int, run: Path | None, belief: Belief, false_alarms: float, calibration: Path | None
) -> _Watched:
    from foretrace.interactions.dataset import Dataset

    dataset = Dataset.open(data)
    rows = np.flatnonzero(dataset.index["id"].to_numpy() == id)
    if len(rows) == 0:
        raise DatasetError(f"{data} has no interaction {id}: choose one of `foretrace show {data}`")
    interaction = dataset[int(rows[0])]
    effect = interaction.effect
    if len(effect.times) == 0:
        raise MonitoringError(f"interaction {id} has no samples: choose one that did not fail")
    imagined = load_imaginer(run).imagine(interaction.view, interaction.action, context=belief)
    watching = Monitor(imagined, false_alarms, calibration=calibration)
    verdicts = [
        watching.update(float(t), pose) for t, pose in zip(effect.times, effect.pose_trajectory, strict=True)
    ]
    scene = replace(Scene.observed(interaction), title=f"Interaction {id}: {effect.outcome}")
    return _Watched(scene, imagined, verdicts, effect.com_trajectory)


def _watch_plan(
    file: Path,
    track: TrackOptions,
    live: CameraOptions,
    run: Path | None,
    belief: Belief,
    false_alarms: float,
    calibration: Path | None,
) -> _Watched:
    plan = Plan.open(file)
    filmed = live.camera is not None
    T_table_action = plan.T_table_action if track.table or filmed else None
    if (track.table or filmed) and T_table_action is None:
        raise MonitoringError(
            f"{file} does not say where the object lies on the table: plan with --pose or --photo, or give poses in "
            "the action frame"
        )
    imaginer = load_imaginer(run)
    if not isinstance(plan.action, imaginer.action):
        raise MonitoringError(
            f"{file} plans a {plan.action.label}, and the {imaginer.name} predictor imagines a "
            f"{imaginer.action.label}: give --run with one of a {plan.action.label}, or use ft.Monitor in Python"
        )
    source = track.poses.name if track.poses else f"camera {live.camera}"
    samples = (
        _filmed(live, plan.action.duration) if filmed else _poses_since_start(track, plan.action.duration)
    )
    plan = plan.imagined_by(imaginer, belief)
    watching = Monitor(plan, false_alarms, T_table_action=T_table_action, calibration=calibration)
    times, poses, verdicts = [], [], []
    for t, pose in samples:
        verdict = watching.update(t, pose)
        if filmed and verdict.alarm and not (verdicts and verdicts[-1].alarm):
            say(f"alarm at {t:.2f} s: {verdict.cause}")
        times.append(t)
        poses.append(np.full(7, np.nan) if pose is None else pose)
        verdicts.append(verdict)
    times, poses = np.array(times), np.array(poses).reshape(-1, 7)
    lost = np.isnan(poses[:, 0])
    if (~lost).sum() < 2:
        raise MonitoringError(
            f"{source}: the object is seen in {(~lost).sum()} images while the action lasts: check --markers, light "
            "and --delay"
        )
    if (first := verdicts[int(np.argmin(lost))]).cause == BAD_INPUT:
        raise MonitoringError(f"{source}, first pose: {first.message}")
    # Whichever frame of the object is tracked: it has moved from where the plan saw the object at rest.
    seen = pose_to_matrix(poses[np.maximum.accumulate(np.where(lost, np.argmin(lost), np.arange(len(lost))))])
    if T_table_action is not None:
        seen = invert_transform(T_table_action) @ seen
    moved = seen @ invert_transform(seen[0])
    rest, middle = plan.action.T_action_object, plan.imagined.com_trajectory[:1]
    com = np.array([transform_points(each, middle)[0] for each in moved])
    scene = Scene.imagined(plan.shown_object, plan.action, times, {}, matrix_to_pose(moved @ rest))
    scene = replace(scene, com=com, title=f"{plan.goal}: {source}")
    return _Watched(scene, plan.imagined, verdicts, np.where(lost[:, None], np.nan, com))


def _filmed(live: CameraOptions, duration: float) -> Iterator[Sample]:
    """Times since the beginning of an action [s], and poses in the table frame as they come.

    Raises:
        PerceptionError: The camera or a file cannot be used.
        MonitoringError: A file is not named, or the delay is none.
    """
    from foretrace.interactions.pinhole import PinholeCamera
    from foretrace.perception.live import LiveTracker, live_frames
    from foretrace.perception.markers import MarkerLayout

    if live.markers is None or live.intrinsics is None:
        raise MonitoringError("--camera needs --markers and --intrinsics: give both files")
    if not 0 <= live.delay < np.inf:
        raise MonitoringError(
            f"--delay is {live.delay}: give the seconds before the action begins, from 0 on"
        )
    tracker = LiveTracker(PinholeCamera.load(live.intrinsics), MarkerLayout.load(live.markers))
    begin = None
    for frame in live_frames(str(live.camera)):
        begin = frame.time + live.delay if begin is None else begin
        if (now := frame.time - begin) > duration:
            return
        T = tracker.update(frame.time, frame.image)
        if now >= 0:
            yield now, None if T is None else matrix_to_pose(T)


def _poses_since_start(track: TrackOptions, duration: float) -> Iterator[Sample]:
    """Times since the beginning of an action [s], and poses from then on.

    Raises:
        PerceptionError: The file cannot be read.
        MonitoringError: There are not two poses while the action lasts.
    """
    from foretrace.perception.pose_files import read_poses

    assert track.poses is not None
    if track.start is not None and not np.isfinite(track.start):
        raise MonitoringError(f"--start is {track.start}: give a time by the clock of the poses, in seconds")
    times, poses = read_poses(track.poses, track.topic, track.child)
    start, last = (times[0] if track.start is None else track.start), times[-1]
    if start > last:
        raise MonitoringError(
            f"--start {start:.15g} is after the last pose, at {last:.15g}: give a time by the clock of the poses"
        )
    kept = times - start >= -1e-9
    times, poses = times[kept] - start, poses[kept]
    if (count := int((np.isfinite(poses[:, 0]) & (times <= duration)).sum())) < 2:
        poses_are = f"{count} pose{'' if count == 1 else 's'}"
        raise MonitoringError(
            f"{track.poses} has {poses_are} within the {duration:.1f} s that the action takes from {start:.15g} on: "
            "give times in seconds, and poses while it runs"
        )
    for t, pose in zip(times.tolist(), poses, strict=True):
        yield t, None if np.isnan(pose[0]) else pose
