"""What the stand-in for the real robot levers up: the paper's printed shapes, everyday objects, and given ones.

The paper prints a pentagon and a heptagon (tables 1 and 2) and takes a book, a PCB, an HDD and a table-tennis racket
(figure 15); it tells no dimensions. Those here are of usual sizes. All are slabs with a bevelled lower rim.

Nothing here needs torch: worker processes start with this module.
"""

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, NotRequired, TypedDict

import numpy as np
import shapely

from foretrace.actions import LeverUp
from foretrace.errors import ForetraceError, ShapeError
from foretrace.files import read_json
from foretrace.geometry import convex_hull, inward_normals
from foretrace.images import SUFFIXES
from foretrace.interactions.record import Interaction, Physics
from foretrace.objects import Prism, read_silhouette
from foretrace.objects.everyday import EVERYDAY, HEPTAGON, PENTAGON
from foretrace.objects.model import fitting_bevel
from foretrace.objects.shape_files import read_silhouette_image
from foretrace.schema import Positive, Vector2
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.stand_in import Observation, StandIn

Group = Literal["printed", "everyday", "silhouettes", "prisms"]
GIVEN_SIZE = 0.18
"""Longer side of given silhouettes [m]."""
GIVEN_HEIGHT = 0.02
"""Thickness of given objects that do not tell it [m]."""
NUM_CONTACTS = 5
"""Contact points of an object that is not printed."""
FIRST_CONTACT = 0.3
"""Where the first one lies, as a share of the way to the second: not symmetric on a rectangle."""
CORNER_DISTANCE = 0.01
"""Contact points keep this distance from corners, or stay in the middle of shorter edges [m]."""
ON_HULL = 0.001
"""An edge whose middle is nearer than this to the convex hull's outline lies on it [m]."""


@dataclass(frozen=True)
class Subject:
    """An object and where it is levered up."""

    name: str
    """Name in tables."""
    group: Group
    """Where it comes from."""
    obj: Prism
    """The object as simulator and predictor are told of it."""
    actions: tuple[LeverUp, ...]
    """Lever-ups as they are told."""
    density: float = Physics.density
    """Density [kg/m^3]."""
    hull: bool = False
    """Whether the predictor sees the convex hull of its mask (paper, figure 15)."""


class Played(NamedTuple):
    """One contact of one object: as the simulator of the training data has it, and as the stand-in has it."""

    simulated: Interaction
    """What the simulator makes of the lever-up as told."""
    observed: tuple[Observation, ...]
    """What the stand-in shows, once for each repetition."""


def printed_shapes() -> list[Subject]:
    """Pentagon and heptagon, levered at the middle of every edge (paper, tables 1 and 2)."""
    return [
        Subject(name, "printed", obj, tuple(LeverUp.at_edge(obj, k) for k in range(len(obj.corners))))
        for name, obj in (("pentagon", PENTAGON), ("heptagon", HEPTAGON))
    ]


def everyday_objects() -> list[Subject]:
    """HDD, PCB, book and racket (paper, figure 15)."""
    return [make_subject(name, "everyday", obj, mass) for name, (obj, mass) in EVERYDAY.items()]


def make_subject(name: str, group: Group, obj: Prism, mass: float | None = None) -> Subject:
    """An object of a mass [kg], levered at points all around it."""
    density = Physics.density if mass is None else mass / obj.mass_properties(1.0).mass
    return Subject(name, group, obj, contacts_around(obj, NUM_CONTACTS), density, hull=True)


def contacts_around(obj: Prism, count: int) -> tuple[LeverUp, ...]:
    """Lever-ups at equal distances along the outline, where it lies on its convex hull.

    Elsewhere, the blade would meet the object behind the outline that a predictor is shown. An object that nowhere
    lies on its hull, such as a star, is levered all around it.
    """
    starts, stops = obj.corners, np.roll(obj.corners, -1, axis=0)
    lengths = np.linalg.norm(stops - starts, axis=1)
    hull = shapely.LinearRing(convex_hull(obj.corners))
    lengths_on_hull = np.where(
        shapely.distance(hull, shapely.points((starts + stops) / 2)) < ON_HULL, lengths, 0.0
    )
    lengths_used = lengths_on_hull if lengths_on_hull.any() else lengths
    ends, normals, actions = np.cumsum(lengths_used), inward_normals(obj.corners), []
    for k in range(count):
        place = (k + FIRST_CONTACT) / count * ends[-1]
        edge = int(np.searchsorted(ends, place, side="right"))
        margin = min(CORNER_DISTANCE, lengths[edge] / 2)
        along = np.clip(place - (ends[edge] - lengths_used[edge]), margin, lengths[edge] - margin)
        contact = starts[edge] + (stops - starts)[edge] * along / lengths[edge]
        actions.append(LeverUp(contact, normals[edge]))
    return tuple(actions)


def play(subject: Subject, contact: int, stand_in: StandIn, repeats: int, seed: int) -> Played:
    """Play one contact of a subject, once in the simulator of the training data and several times by the stand-in.

    Raises:
        ShapeError: The object does not fit in the view, or is too thin for its bevel.
    """
    action = subject.actions[contact]
    stream = zlib.crc32(f"{subject.group}/{subject.name}".encode())
    try:
        simulated = simulate_lever_up(subject.obj, action, SimulationConfig())
        observed = [
            stand_in.observe(subject.obj, action, stand_in.draw(rng), subject.density)
            for rng in (np.random.default_rng([seed, stream, contact, k]) for k in range(repeats))
        ]
    except ForetraceError as error:
        raise ShapeError(f"{subject.name}, contact {contact + 1}: {error}") from error
    return Played(simulated, tuple(observed))


def read_silhouettes(
    folder: Path, size: float = GIVEN_SIZE, scale: float | None = None, height: float = GIVEN_HEIGHT
) -> list[Subject]:
    """Objects from a folder of pictures, one silhouette each, white on black; sizes in metres.

    ``size`` is the longer side of a silhouette's bounding box; ``scale``, of a pixel, takes its place.

    Raises:
        ShapeError: The folder is missing or has no picture, or one of them does not show one whole object.
    """
    if not folder.is_dir():
        raise ShapeError(f"{folder} is no folder: give one with pictures of silhouettes, white on black")
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)
    if not files:
        raise ShapeError(
            f"{folder} has no silhouettes: put images there ({', '.join(SUFFIXES)}), one object each"
        )
    subjects = []
    for file in files:
        mask = read_silhouette_image(file)
        try:
            metres = size / (np.ptp(np.argwhere(read_silhouette(mask)), axis=0).max() + 1)
            obj = Prism.from_mask(mask, metres if scale is None else scale, height)
            subjects.append(make_subject(file.stem, "silhouettes", obj))
        except ForetraceError as error:
            raise ShapeError(f"{file}: {error}") from error
    return subjects


class PrismEntries(TypedDict):
    """Schema of an object in a file of prisms."""

    corners_m: list[Vector2]
    mass_kg: NotRequired[Positive | None]
    height_m: NotRequired[Positive]


def read_prisms(file: Path, height: float = GIVEN_HEIGHT) -> list[Subject]:
    """Objects from a JSON file: by name, ``corners_m`` and, if they are known, ``mass_kg`` and ``height_m``.

    Raises:
        ShapeError: The file is missing or not such a file, or an outline is not usable.
    """
    remedy = 'write {"name": {"corners_m": [[x, y], ...], "mass_kg": 0.2, "height_m": 0.02}, ...}'
    content = read_json(file, dict[str, PrismEntries], ShapeError, remedy)
    if not content:
        raise ShapeError(f"{file} names no prism: {remedy}")
    subjects = []
    for name, values in content.items():
        corners, mass = np.array(values["corners_m"], dtype=float), values.get("mass_kg")
        thickness = values.get("height_m", height)
        try:
            obj = Prism(corners, thickness, fitting_bevel(Prism(corners).corners, thickness))
            subjects.append(make_subject(name, "prisms", obj, mass))
        except ForetraceError as error:
            raise ShapeError(f"{file}: {name}: {error}") from error
    return subjects
