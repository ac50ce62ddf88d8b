"""Poses of an object as a tracker recorded them: a table, or a bag of ROS."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from foretrace.errors import PerceptionError, shown
from foretrace.files import read_text
from foretrace.perception.bags import choose_topic, open_reader, read_messages

BAGS = (".bag", ".mcap", ".db3")
"""Endings of bags; a folder is one, too."""
COLUMNS = ("time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
"""Columns of a table: time [s], position [m], and quaternion."""
ALIASES = {"t": "time_s", "time": "time_s", "x": "x_m", "y": "y_m", "z": "z_m"}
"""Other names of columns."""
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
TRANSFORMS = "tf2_msgs/msg/TFMessage"
LOST = ("", "none", "null", "na", "n/a")
"""What stands in a table where the object was lost, beside words for what is no number ("nan")."""
REMEDY = f"give a table with the columns {', '.join(COLUMNS)}"


def read_poses(
    path: Path, topic: str | None = None, child: str = "object"
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples 7"]]:
    """Times [s] and poses (position [m], quaternion w, x, y, z) of an object, in the tracker's frame and clock.

    A quaternion of zeros, as some trackers write it, also means that the object was lost. A sample that is repeated as
    it is counts once.

    Args:
        path: A table (CSV with a head, in which empty cells mean that the object was lost: NaN here), or a bag of ROS 1
            or ROS 2 with stamped poses or transforms.
        topic: Of a bag, the topic; needed if several have poses.
        child: Of transforms, the frame whose motion is read.

    Raises:
        PerceptionError: The file cannot be read, or has no poses, or times that do not rise; a topic of a table.
    """
    bag = path.is_dir() or path.suffix.lower() in BAGS
    if topic is not None and not bag:
        raise PerceptionError(
            f"{path} is a table, which has no topic {shown(topic)}: leave it out, or give a bag"
        )
    times, poses = _from_bag(path, topic, child) if bag else _from_table(path)
    if len(times) == 0:
        raise PerceptionError(f"{path} has no pose: {REMEDY}, or a bag with poses")
    poses[(poses[:, 3:] == 0).all(axis=1)] = np.nan
    same = (poses[1:] == poses[:-1]) | (np.isnan(poses[1:]) & np.isnan(poses[:-1]))
    once = np.concatenate([[True], (np.diff(times) != 0) | ~same.all(axis=1)])
    times, poses = times[once], poses[once]
    if (back := np.flatnonzero(np.diff(times) <= 0)).size:
        before, after = (f"{times[int(back[0]) + k]:.15g} s" for k in (0, 1))
        raise PerceptionError(
            f"{path}: two poses at {before}: leave one out"
            if before == after
            else f"{path}: time {after} follows {before}: put the poses into the order of their times"
        )
    return times, poses


def _from_table(path: Path) -> tuple[np.ndarray, np.ndarray]:
    text = read_text(path, PerceptionError, REMEDY)
    head = text.partition("\n")[0]
    delimiter = next((each for each in (";", "\t") if each in head), ",")
    lines = list(csv.reader(text.splitlines(), delimiter=delimiter))
    names = [cell.strip().lower() for cell in lines[0]] if lines else []
    names = [ALIASES.get(name, name) for name in names]
    if missing := [name for name in COLUMNS if name not in names]:
        raise PerceptionError(f"{path} has no column {', '.join(missing)}: {REMEDY}")
    if twice := [name for name in COLUMNS if names.count(name) > 1]:
        raise PerceptionError(f"{path} has two columns {', '.join(twice)}: leave one of each out")
    columns = [names.index(name) for name in COLUMNS]
    rows = [
        [_number(path, number, line, column) for column in columns]
        for number, line in enumerate(lines[1:], start=2)
        if any(cell.strip() for cell in line)
    ]
    values = np.array(rows, dtype=float).reshape(-1, len(COLUMNS))
    if not np.isfinite(values[:, 0]).all():
        raise PerceptionError(
            f"{path}: a line has no time: give one in each line, also where the object was lost"
        )
    values[~np.isfinite(values).all(axis=1), 1:] = np.nan
    return values[:, 0], values[:, 1:]


def _number(path: Path, number: int, line: list[str], column: int) -> float:
    cell = line[column].strip() if column < len(line) else ""
    if cell.lower() in LOST:
        return np.nan
    try:
        value = float(cell.replace(",", "."))
    except ValueError:
        raise PerceptionError(
            f"{path}, line {number}: {shown(cell)} is no number: give one, or leave the cell empty where the object "
            "was lost"
        ) from None
    if np.isinf(value):
        raise PerceptionError(f"{path}, line {number}: {cell} is not finite: leave the cell empty")
    return value


def _from_bag(path: Path, topic: str | None, child: str) -> tuple[np.ndarray, np.ndarray]:
    times, poses, frames = [], [], set()
    with open_reader(path) as reader:
        kinds = {c.topic: c.msgtype for c in reader.connections if c.msgcount}
        usable = sorted(
            name
            for name, kind in kinds.items()
            if kind in POSES or (kind == TRANSFORMS and name != "/tf_static")
        )
        if not usable:
            raise PerceptionError(
                f"bag {path} has no topic with poses: record PoseStamped, PoseWithCovarianceStamped or transforms (/tf)"
            )
        chosen = choose_topic(path, topic, usable, "pose topic", "--topic")
        for _, recorded, message in read_messages(reader, path, [chosen]):
            for stamped, pose in _stamped(message, kinds[chosen], child, frames):
                stamp = stamped.header.stamp
                times.append(stamp.sec + 1e-9 * stamp.nanosec or recorded)
                poses.append(pose)
    if kinds[chosen] == TRANSFORMS and not poses:
        found = ", ".join(sorted(frames)) or "none"
        raise PerceptionError(
            f"bag {path}: {chosen} has no frame {shown(child)}: name one of {found} with --child"
        )
    return np.array(times), np.array(poses).reshape(-1, 7)


def _stamped(message: Any, kind: str, child: str, frames: set[str]) -> list[tuple[Any, list[float]]]:
    """The stamped parts of a message that tell the object's pose, each with it."""
    if kind == TRANSFORMS:
        frames |= {each.child_frame_id for each in message.transforms}
        own = [each for each in message.transforms if each.child_frame_id == child]
        return [(each, _pose(each.transform.translation, each.transform.rotation)) for each in own]
    pose = message.pose.pose if kind == POSES[1] else message.pose
    return [(message, _pose(pose.position, pose.orientation))]


def _pose(place: Any, turn: Any) -> list[float]:
    return [place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z]
