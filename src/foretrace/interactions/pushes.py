"""Recorded planar pushes: a table of object poses and rod positions before and after, and a file of shapes."""

import csv
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NotRequired, TypedDict

import numpy as np
import shapely
from jaxtyping import Float, Int
from msgspec import Meta

from foretrace.actions import FAILED, Push, PushOutcome, PushPath, Rod
from foretrace.errors import ActionError, DatasetError, ShapeError, check_type, is_number, shown
from foretrace.files import read_json
from foretrace.geometry import invert_transform, pose_to_matrix, rotate_plane, wrap_angle
from foretrace.interactions.record import Interaction
from foretrace.objects import NO_BEVEL, Prism
from foretrace.schema import Positive, Vector2

POSES = ("x0", "y0", "theta0", "x1", "y1", "theta1")
RODS = ("tip_x0", "tip_y0", "tip_x1", "tip_y1")
NUMBERS = (*POSES, *RODS, "speed_mm_s")
"""Columns of numbers that every table of pushes has."""
ROD_RADIUS = 0.00475
"""Radius of the rod of M. Bauza, K.-T. Yu and A. Rodriguez's recordings [m]."""
SMALLEST_ROD, LARGEST_ROD = 0.0005, 0.1
"""Bounds of a rod's radius [m]."""
SLOWEST, FASTEST = 0.5, 1000.0
"""Bounds of the rod's speed [mm/s]."""
FARTHEST = 10.0
"""Larger coordinates are no metres [m]."""
LARGEST_ANGLE = 4 * np.pi
"""Larger angles are no radians."""
DEEPEST = 0.015
"""A rod that starts farther inside the object than this is in another frame [m]."""
LARGEST_START = 0.2
"""A rod that starts farther from the object than this is in another frame [m]."""
SHORTEST = 0.001
"""A rod that moves by less pushes nothing [m]."""
MOST_LISTED = 5
"""Rows that a message names."""
THROWN = 0.1
"""An object that is moved farther than the rod by more than this was not pushed by it [m]."""
STEPS = 200
"""Places along the rod's path at which it may first touch the object."""
TOUCH = 1e-4
"""Distance at which the rod touches the object [m]."""


class _Shape(TypedDict):
    """Schema of a shape."""

    outline: Annotated[list[Vector2], Meta(min_length=3, max_length=1000)]
    thickness: Positive
    mass: Positive
    centroid: NotRequired[Vector2]


@dataclass(frozen=True, eq=False)
class PushedShape:
    """A flat object that was pushed."""

    name: str
    """Its name in the table."""
    model: Prism
    """The object without a bevel, in the frame of its poses."""
    mass: float
    """Mass [kg]."""

    @property
    def centroid(self) -> Float[np.ndarray, "2"]:
        """Centre of its outline, in the object frame [m]."""
        return self.model.mass_properties(1.0).com[:2]

    @property
    def density(self) -> float:
        """Density that gives it its mass [kg/m^3]."""
        return self.mass / self.model.mass_properties(1.0).mass


@dataclass(frozen=True, eq=False)
class RecordedPushes:
    """Pushes of several shapes, row by row; poses in the frame of the table: x, y [m] and angle [rad]."""

    shapes: tuple[PushedShape, ...]
    """Shapes that were pushed."""
    shape: Int[np.ndarray, " pushes"]
    """Number of each push's shape."""
    surface: tuple[str, ...]
    """Name of the surface of each push."""
    speed: Float[np.ndarray, " pushes"]
    """Speed of the rod [m/s]."""
    before: Float[np.ndarray, "pushes 3"]
    """Pose of the object before."""
    after: Float[np.ndarray, "pushes 3"]
    """Pose of the object after."""
    rod: Float[np.ndarray, "pushes 2 2"]
    """Centre of the rod before and after [m]."""
    peers: dict[str, Float[np.ndarray, "pushes 3"]]
    """Poses after the push as other models in the table give them, by their names."""
    line: Int[np.ndarray, " pushes"]
    """Line of each push in its file."""
    radius: float = ROD_RADIUS
    """Radius of the rod [m]."""

    def __len__(self) -> int:
        return len(self.shape)

    def __getitem__(self, rows: slice | list[int] | np.ndarray) -> "RecordedPushes":
        numbers = np.arange(len(self))[rows]
        return RecordedPushes(
            self.shapes,
            self.shape[rows],
            tuple(self.surface[k] for k in numbers),
            self.speed[rows],
            self.before[rows],
            self.after[rows],
            self.rod[rows],
            {name: poses[rows] for name, poses in self.peers.items()},
            self.line[rows],
            self.radius,
        )

    @property
    def start(self) -> Float[np.ndarray, "pushes 2"]:
        """Centre of the rod before each push, in the object frame at rest [m]."""
        return rotate_plane(self.rod[:, 0] - self.before[:, :2], -self.before[:, 2])

    @property
    def motion(self) -> Float[np.ndarray, "pushes 2"]:
        """Displacement of the rod, in the object frame at rest [m]."""
        return rotate_plane(self.rod[:, 1] - self.rod[:, 0], -self.before[:, 2])

    def displacement(
        self, after: Float[np.ndarray, "pushes 3"] | None = None
    ) -> Float[np.ndarray, "pushes 3"]:
        """Displacement [m] and turn [rad] of the object, in the object frame at rest.

        Args:
            after: Poses after the pushes; by default the recorded ones.
        """
        after = self.after if after is None else after
        moved = rotate_plane(after[:, :2] - self.before[:, :2], -self.before[:, 2])
        return np.column_stack([moved, wrap_angle(after[:, 2] - self.before[:, 2])])

    @classmethod
    def of(cls, interactions: Sequence[Interaction], surface: str = "") -> "RecordedPushes":
        """Pushes that were carried out, simulated or recorded; objects that are equal are one shape.

        Shapes are named ``object 0``, ``object 1`` and so on. Before each push, the table's frame is the object's.

        Args:
            interactions: Pushes with their effects, all with rods of one radius.
            surface: Name of the table's surface.

        Raises:
            DatasetError: There is none, or one is no push that moved its object without tipping it.
        """
        names: dict[str, int] = {}
        shapes: list[PushedShape] = []
        numbers, after, rods = [], [], []
        for each in interactions:
            check_type("an interaction", each, Interaction, DatasetError)
            action, effect = each.action, each.effect
            if not isinstance(action, Push) or effect.outcome in (FAILED, PushOutcome.TIPPED):
                raise DatasetError(
                    f"interaction {each.id} is a {action.label} that ended {shown(str(effect.outcome))}: give pushes "
                    "that left their objects flat"
                )
            number = names.setdefault(json.dumps(each.object.to_dict()), len(names))
            if number == len(shapes):
                mass = each.object.mass_properties(each.physics.density).mass
                shapes.append(
                    PushedShape(
                        f"object {number}", Prism(each.object.corners, each.object.height, NO_BEVEL), mass
                    )
                )
            pose = pose_to_matrix(effect.pose_trajectory[[0, -1]])
            moved = invert_transform(pose[0]) @ pose[1]
            start = action.contact - (action.path.approach + action.tool.radius) * action.direction
            numbers.append(number)
            after.append([*moved[:2, 3], np.arctan2(moved[1, 0], moved[0, 0])])
            rods.append([start, start + action.path.length * action.direction])
        if not numbers:
            raise DatasetError("there are no interactions: give at least one push")
        radii = {each.action.tool.radius for each in interactions}  # pyright: ignore[reportAttributeAccessIssue]
        if len(radii) != 1:
            raise DatasetError(
                f"the rods of the pushes have the radii {shown(sorted(radii))} m: give pushes with one rod"
            )
        count = len(numbers)
        speed = np.array([each.action.path.speed for each in interactions])
        return cls(
            tuple(shapes), np.array(numbers), (surface,) * count, speed, np.zeros((count, 3)), np.array(after),
            np.array(rods), {}, np.arange(count), radii.pop(),
        )  # fmt: skip

    def action(self, row: int) -> Push | None:
        """The push of a row, placed on its object; None where the rod passes the object or hardly touches it.

        None, too, where its path is out of the range of paths: it starts too far away, or is too slow or too long.
        """
        start, motion = self[[row]].start[0], self[[row]].motion[0]
        length = float(np.linalg.norm(motion))
        direction = motion / length
        outline = shapely.Polygon(self.shapes[self.shape[row]].model.corners)
        ways = np.linspace(0.0, length, STEPS + 1)
        places = shapely.points(start + ways[:, None] * direction)
        touching = shapely.distance(outline, places) <= self.radius + TOUCH
        if not touching.any():
            return None
        first = places[int(touching.argmax())]
        touched = shapely.get_coordinates(shapely.shortest_line(outline.exterior, first))[0]
        ahead = float((touched - start) @ direction)
        crossed = shapely.get_coordinates(
            shapely.intersection(outline.exterior, shapely.LineString([start, start + direction]))
        )
        if len(crossed):
            # The rod's centre meets the outline a little behind the point that its flank touches.
            meets = float(((crossed - start) @ direction).min())
            ahead = meets if meets - ahead < 3 * self.radius else ahead
        approach = ahead - self.radius
        try:
            path = PushPath(distance=length - approach, approach=approach, speed=float(self.speed[row]))
        except ActionError:
            return None
        return Push(start + ahead * direction, direction, path, Rod(radius=self.radius))


def read_shapes(path: Path) -> dict[str, PushedShape]:
    """The shapes of a JSON file: outline [m], thickness [m] and mass [kg] by name.

    Raises:
        DatasetError: The file is no such file.
        ShapeError: An outline is not usable.
    """
    found = read_json(path, dict[str, _Shape], DatasetError, "give outline, thickness and mass of each shape")
    shapes = {}
    for name, values in found.items():
        try:
            shapes[name] = PushedShape(
                name, Prism(values["outline"], values["thickness"], NO_BEVEL), values["mass"]
            )
        except ShapeError as reason:
            raise ShapeError(f"shape {shown(name)} of {path.name}: {reason}") from None
    if not shapes:
        raise DatasetError(f"{path} has no shapes: give outline, thickness and mass of each")
    return shapes


def read_pushes(
    table: Path, shapes: Path, skip_bad: bool = False, radius: float = ROD_RADIUS
) -> tuple[RecordedPushes, list[str]]:
    """The pushes of a table, and what is wrong with the rows that were left out.

    Args:
        table: A CSV file with the columns ``shape``, ``speed_mm_s``, ``x0 y0 theta0 x1 y1 theta1`` (pose of the object
            before and after [m, rad]) and ``tip_x0 tip_y0 tip_x1 tip_y1`` (rod); optionally ``surface``, and columns
            like ``poly4_x1 poly4_y1 poly4_theta1`` with the poses that another model gives.
        shapes: A file for `read_shapes`.
        skip_bad: Leave rows out that are wrong.
        radius: Radius of the rod [m].

    Raises:
        DatasetError: A file is missing or no such file, or rows are wrong and are not to be left out.
        ShapeError: An outline is not usable.
    """
    if not is_number(radius) or not SMALLEST_ROD <= radius <= LARGEST_ROD:
        raise DatasetError(f"rod_radius = {shown(radius)} m: give {SMALLEST_ROD:g} to {LARGEST_ROD:g} m")
    known = read_shapes(shapes)
    columns, lines = _read_table(table)
    faults: dict[int, str] = {}
    for row, name in enumerate(columns["shape"]):
        if name not in known:
            faults[row] = f"shape {shown(name)} is not in {shapes.name}, which has {', '.join(sorted(known))}"
    numbers = {name: _numbers(columns[name], faults, name) for name in NUMBERS}
    peers = {
        name: np.column_stack(
            [_numbers(columns[f"{name}_{each}"], {}, "") for each in ("x1", "y1", "theta1")]
        )
        for name in _peer_names(columns)
    }
    used = {name: k for k, name in enumerate(known) if name in set(columns["shape"])}
    order = {name: k for k, name in enumerate(used)}
    pushes = RecordedPushes(
        shapes=tuple(known[name] for name in used),
        shape=np.array([order.get(name, 0) for name in columns["shape"]], dtype=int),
        surface=tuple(columns.get("surface", [""] * len(lines))),
        speed=numbers["speed_mm_s"] / 1000,
        before=np.column_stack([numbers[name] for name in POSES[:3]]),
        after=np.column_stack([numbers[name] for name in POSES[3:]]),
        rod=np.column_stack([numbers[name] for name in RODS]).reshape(-1, 2, 2),
        peers=peers,
        line=np.array(lines, dtype=int),
        radius=radius,
    )
    _find_faults(pushes, faults)
    if faults and not skip_bad:
        raise DatasetError(_told(table, lines, faults))
    if len(faults) == len(lines):
        raise DatasetError(_told(table, lines, faults))
    kept = np.array([row for row in range(len(lines)) if row not in faults], dtype=int)
    return pushes[kept], [f"line {lines[row]}: {faults[row]}" for row in sorted(faults)]


def _read_table(path: Path) -> tuple[dict[str, list[str]], list[int]]:
    """The columns of a CSV file by name, and the line of each row."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            first = file.readline()
            file.seek(0)
            delimiter = max((",", ";", "\t"), key=first.count)
            reader = csv.reader(file, delimiter=delimiter)
            head = [name.strip() for name in next(reader, [])]
            rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except FileNotFoundError:
        raise DatasetError(f"{path} does not exist: give a CSV file of pushes") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path} cannot be read as UTF-8: save it as CSV in UTF-8") from None
    except (OSError, csv.Error) as reason:
        raise DatasetError(f"{path} cannot be read ({shown(reason)}): give a CSV file of pushes") from None
    twice = [name for name in dict.fromkeys(head) if head.count(name) > 1]
    if twice:
        raise DatasetError(f"{path.name} has the column {shown(twice[0])} twice: name each column once")
    missing = [name for name in ("shape", *NUMBERS) if name not in head]
    if missing:
        raise DatasetError(
            f"{path.name} has no column {', '.join(missing)}: name the columns shape, {', '.join(NUMBERS)}"
        )
    if not rows:
        raise DatasetError(f"{path.name} has no pushes: give at least one row below the headings")
    comma = delimiter != ","
    filled = [(*(cell.strip() for cell in row), *[""] * (len(head) - len(row))) for _, row in rows]
    columns = {
        name: [row[k].replace(",", ".") if comma and name != "shape" else row[k] for row in filled]
        for k, name in enumerate(head)
    }
    return columns, [line for line, _ in rows]


def _peer_names(columns: dict[str, list[str]]) -> list[str]:
    names = [name[: -len("_x1")] for name in columns if name.endswith("_x1") and name != "tip_x1"]
    return [name for name in names if {f"{name}_y1", f"{name}_theta1"} <= columns.keys()]


def _numbers(cells: Sequence[str], faults: dict[int, str], name: str) -> Float[np.ndarray, " pushes"]:
    values = np.full(len(cells), np.nan)
    for row, cell in enumerate(cells):
        with suppress(ValueError):
            values[row] = float(cell)
        if not np.isfinite(values[row]):
            faults.setdefault(row, f"{name} is {shown(cell)}: give a finite number")
            values[row] = np.nan
    return values


def _find_faults(pushes: RecordedPushes, faults: dict[int, str]) -> None:
    """What is wrong with whole rows, beside what is known already."""
    sound = [row for row in range(len(pushes)) if row not in faults]
    places = np.column_stack([pushes.before[:, :2], pushes.after[:, :2], pushes.rod.reshape(-1, 4)])
    length = np.linalg.norm(pushes.rod[:, 1] - pushes.rod[:, 0], axis=1)
    gaps = _start_gaps(pushes, np.array(sound, dtype=int))
    seen: dict[bytes, int] = {}
    for row in sound:
        angle = np.abs([pushes.before[row, 2], pushes.after[row, 2]]).max()
        far = np.abs(places[row]).max()
        same = np.concatenate([places[row], pushes.before[row, 2:], pushes.after[row, 2:]]).tobytes()
        first = seen.setdefault(same, row)
        if far > FARTHEST:
            faults[row] = f"a coordinate of {far:g} m: give metres (these look like millimetres)"
        elif angle > LARGEST_ANGLE:
            faults[row] = f"an angle of {angle:g} rad: give radians (these look like degrees)"
        elif not SLOWEST <= 1000 * pushes.speed[row] <= FASTEST:
            faults[row] = f"speed_mm_s is {1000 * pushes.speed[row]:g}: give {SLOWEST:g} to {FASTEST:g} mm/s"
        elif length[row] < SHORTEST:
            faults[row] = f"the rod moves by {1000 * length[row]:.2g} mm: it pushes nothing"
        elif (moved := np.linalg.norm(np.diff(places[row, :4].reshape(2, 2), axis=0))) > length[row] + THROWN:
            faults[row] = (
                f"the object moves by {moved:.2g} m, the rod by {length[row]:.2g} m: are its poses in one frame?"
            )
        elif first != row:
            faults[row] = f"repeats line {pushes.line[first]}"
        elif gaps[row] < -DEEPEST:
            faults[row] = (
                f"the rod starts {-1000 * gaps[row]:.1f} mm inside the object: are its poses in another frame?"
            )
        elif gaps[row] > LARGEST_START:
            faults[row] = f"the rod starts {gaps[row]:.2g} m from the object: are its poses in another frame?"


def _start_gaps(pushes: RecordedPushes, rows: Int[np.ndarray, " rows"]) -> Float[np.ndarray, " pushes"]:
    """Gap between rod and object before each push [m]; NaN in rows that are not asked for."""
    gaps, start = np.full(len(pushes), np.nan), pushes.start
    for number, shape in enumerate(pushes.shapes):
        own = rows[pushes.shape[rows] == number]
        outline, places = shapely.Polygon(shape.model.corners), shapely.points(start[own])
        away = shapely.distance(outline.exterior, places)
        gaps[own] = np.where(shapely.contains(outline, places), -away, away) - pushes.radius
    return gaps


def _told(path: Path, lines: Sequence[int], faults: dict[int, str]) -> str:
    """A message about wrong rows."""
    rows = sorted(faults)
    named = "; ".join(f"line {lines[row]}: {faults[row]}" for row in rows[:MOST_LISTED])
    more = f"; and {len(rows) - MOST_LISTED} more" if len(rows) > MOST_LISTED else ""
    wrong = f"{len(rows)} of {len(lines)} rows are wrong"
    return f"{path.name}: {wrong}: {named}{more}: mend them, or leave them out with --skip-bad"
