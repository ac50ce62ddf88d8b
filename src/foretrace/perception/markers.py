"""Square markers: which are in an image, and where a body that carries them is.

A marker's frame has its origin in the marker's middle, x to the right and y up as one reads it, z out of it (see
`marker_patterns`). A flat square has two poses that look nearly alike from afar; both are kept, for only time can tell
them apart.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, NotRequired, Required, TypedDict

import cv2
import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8
from msgspec import Meta

from foretrace.errors import PerceptionError, shown
from foretrace.files import read_versioned
from foretrace.geometry import invert_transform, planar_transform, rigid_transform, transform_points
from foretrace.interactions.marker_patterns import DICTIONARIES, dictionary
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.alignment import fit_pattern
from foretrace.schema import Count, Finite

FORMAT = "foretrace-markers"
VERSION = 1
DARK = 25
"""An image whose brightest hundredth is below this grey value is dark (of 255)."""
BLURRED = 15.0
"""An image whose Laplacian varies by less than this has no sharp edge (grey values squared)."""
SMALLEST_SIDE = 10.0
"""Least length of the shortest side of a marker whose pose is measured [pixel]."""
LEAST_SLANT = np.deg2rad(15.0)
"""Least angle between marker and line of sight: below, its two poses look alike and its pattern blurs [rad]."""

LARGEST_ALIGNMENT = 6.0
"""Largest shift of a corner by an alignment that has not gone astray [pixel]."""

FARTHEST = 100.0
"""Distances of markers from the origin of their frame are at most that [m]."""


@dataclass(frozen=True)
class Detections:
    """The markers seen in one image."""

    ids: Int[np.ndarray, " markers"]
    """Their numbers."""
    corners: Float[np.ndarray, "markers 4 2"]
    """Their corners in the image [pixel], clockwise as one reads the marker, from its upper left."""

    def of(self, id: int) -> Float[np.ndarray, "4 2"] | None:
        """The corners of one marker, or None where it was not seen, or seen twice."""
        found = np.flatnonzero(self.ids == id)
        return self.corners[found[0]] if len(found) == 1 else None


@lru_cache(maxsize=32)
def _detector(name: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    # A window of at most three tenths of a module: it must not see the marker's own pattern.
    parameters.cornerRefinementWinSize = 5
    parameters.relativeCornerRefinmentWinSize = 0.3
    parameters.cornerRefinementMinAccuracy = 0.005
    parameters.cornerRefinementMaxIterations = 50
    return cv2.aruco.ArucoDetector(dictionary(name), parameters)


def detect_markers(image: UInt8[np.ndarray, "rows columns *channels"], name: str) -> Detections:
    """The markers of a dictionary in an image (grey, or blue-green-red as OpenCV reads it)."""
    corners, ids, _ = _detector(name.lower()).detectMarkers(grey(image))
    if ids is None or len(ids) == 0:
        return Detections(np.zeros(0, dtype=int), np.zeros((0, 4, 2)))
    # OpenCV 4 gives ids as (n, 1), OpenCV 5 as (n,).
    return Detections(np.ravel(ids).astype(int), np.array(corners, dtype=float).reshape(-1, 4, 2))


def align_patterns(
    image: UInt8[np.ndarray, "rows columns *channels"],
    detections: Detections,
    name: str,
    only: Collection[int] | None = None,
) -> Detections:
    """Corners found anew from all of each marker's pattern, not from its outer rim alone; slower.

    A marker whose pattern does not explain the image is covered or smeared, and left out.

    Args:
        image: The image.
        detections: What was detected in it.
        name: The markers' dictionary.
        only: Markers to treat; others are left out. By default all.
    """
    values = grey(image)
    kept, aligned = [], []
    for id, corners in zip(detections.ids, detections.corners, strict=True):
        if only is not None and id not in only:
            continue
        moved = fit_pattern(values, name, int(id), corners)
        if moved is not None and np.linalg.norm(moved - corners, axis=1).max() < LARGEST_ALIGNMENT:
            kept.append(int(id))
            aligned.append(moved)
    return Detections(np.array(kept, dtype=int), np.array(aligned).reshape(-1, 4, 2))


def grey(image: Shaped[np.ndarray, "rows columns *channels"]) -> UInt8[np.ndarray, "rows columns"]:
    """An image in grey."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def fitting_dictionaries(image: UInt8[np.ndarray, "rows columns *channels"]) -> list[str]:
    """Dictionaries with markers in the image, those with most first; of nested ones the smallest."""
    counts: dict[str, int] = {}
    for name in DICTIONARIES:
        family, _, size = name.partition("_")
        nested = "x" in family
        if nested and size != "1000":  # they are the beginnings of the largest
            continue
        if len(ids := detect_markers(image, name).ids):
            smallest = min(count for count in (50, 100, 250, 1000) if ids.max() < count) if nested else 0
            counts[f"{family}_{smallest}" if nested else name] = len(ids)
    return sorted(counts, key=lambda name: -counts[name])


def image_fault(image: UInt8[np.ndarray, "rows columns *channels"], name: str | None = None) -> str:
    """What may keep markers from being found in an image, in words; empty if nothing is apparent.

    Args:
        image: The image.
        name: Dictionary of the markers; if given, an image with markers of other dictionaries alone is at fault.
    """
    values = grey(image)
    if np.percentile(values, 99) < DARK:
        return f"it is dark (99 % of the pixels are below {np.percentile(values, 99):.0f} of 255)"
    sharpness = float(cv2.Laplacian(values, cv2.CV_64F).var())
    if sharpness < BLURRED:
        return f"it is blurred or empty (its Laplacian varies by {sharpness:.1f}, below {BLURRED:g})"
    if name is None:
        return ""
    fitting = fitting_dictionaries(image)
    if fitting and not any(_holds(name.lower(), other) for other in fitting):
        return f"its markers are of {fitting[0]}, not {name}: check the dictionary"
    if not fitting and len(detect_markers(np.ascontiguousarray(values[:, ::-1]), name).ids):
        return "it is mirrored: switch mirroring off in the camera's program"
    return ""


def _holds(name: str, other: str) -> bool:
    """Whether a dictionary has all markers of another one: 5x5_50 is the beginning of 5x5_100."""
    (family, _, size), (other_family, _, other_size) = name.partition("_"), other.partition("_")
    return name == other or (family == other_family and "x" in family and int(size) >= int(other_size))


@dataclass(frozen=True)
class PoseCandidate:
    """A pose that explains what was seen of a body."""

    T_camera_body: Float[np.ndarray, "4 4"]
    """The body in the camera frame."""
    error: float
    """Root mean square of the reprojection error [pixel]."""
    slant: float = np.pi / 2
    """Angle between the line of sight and the plane of the largest marker [rad]."""


@dataclass(frozen=True)
class MarkerBody:
    """A rigid body with markers on it."""

    sides: Mapping[int, float]
    """Length of each marker's side [m], by the marker's number."""
    placements: Mapping[int, Float[np.ndarray, "4 4"]]
    """T_body_marker of each."""

    @classmethod
    def single(cls, id: int, side: float) -> "MarkerBody":
        """A body with one marker, whose frame is the body's."""
        return cls({id: side}, {id: np.eye(4)})

    @property
    def ids(self) -> list[int]:
        """The markers' numbers."""
        return list(self.sides)

    def turned(self) -> "MarkerBody":
        """The body with each marker turned upside down where it is."""
        return MarkerBody(
            self.sides, {id: T @ np.diag([-1.0, -1.0, 1.0, 1.0]) for id, T in self.placements.items()}
        )

    def corners(self, id: int) -> Float[np.ndarray, "4 3"]:
        """The corners of one marker in the body frame [m], in the order of `Detections`."""
        return transform_points(self.placements[id], square(self.sides[id]))

    def matches(self, detections: Detections) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 2"]]:
        """Points of the body [m] and where they were seen [pixel]; no rows where no marker was."""
        seen = [(id, corners) for id in self.ids if (corners := detections.of(id)) is not None]
        if not seen:
            return np.zeros((0, 3)), np.zeros((0, 2))
        return np.concatenate([self.corners(id) for id, _ in seen]), np.concatenate([c for _, c in seen])

    def poses(
        self, detections: Detections, camera: PinholeCamera, least_slant: float = LEAST_SLANT
    ) -> list[PoseCandidate]:
        """Poses that explain the seen markers, the best first: none, one or two.

        A marker that is seen too flat (`LEAST_SLANT`) counts as not seen.

        The two solutions of the largest marker (Collins and Bartoli, 2014), each refined on all corners that are seen.
        """
        sizes = {id: shortest_side(corners) for id in self.ids if (corners := detections.of(id)) is not None}
        sizes = {id: size for id, size in sizes.items() if size >= SMALLEST_SIDE}
        if not sizes:
            return []
        largest = max(sizes, key=lambda id: sizes[id])
        seen = np.asarray(detections.of(largest))
        matrix, (seen, coefficients) = camera.matrix, camera.for_opencv(seen)
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
            square(self.sides[largest]), seen, matrix, coefficients, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        T_marker_body = invert_transform(self.placements[largest])
        points, pixels = self.matches(detections)
        straight, _ = camera.for_opencv(pixels)
        found = []
        for rvec, tvec in zip(rvecs, tvecs, strict=True):
            T = to_transform(rvec, tvec) @ T_marker_body
            rotation, _ = cv2.Rodrigues(T[:3, :3])
            T = to_transform(
                *cv2.solvePnPRefineLM(points, straight, matrix, coefficients, rotation, T[:3, 3:].copy())
            )
            error = np.linalg.norm(camera.project(points, T) - pixels, axis=1)
            seen_from = invert_transform(T @ self.placements[largest])[:3, 3]
            slant = np.arcsin(seen_from[2] / np.linalg.norm(seen_from))
            if np.isfinite(error).all() and slant > least_slant:
                found.append(PoseCandidate(T, float(np.sqrt((error**2).mean())), float(slant)))
        return sorted(found, key=lambda candidate: candidate.error)


def square(side: float) -> Float[np.ndarray, "4 3"]:
    """Corners of a marker in its own frame [m], clockwise from the upper left."""
    return side / 2 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def shortest_side(corners: Float[np.ndarray, "4 2"]) -> float:
    """Length of a quadrilateral's shortest side."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min())


def to_transform(rvec: np.ndarray, tvec: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """OpenCV's rotation and translation vector as a transform."""
    return rigid_transform(cv2.Rodrigues(np.asarray(rvec, dtype=float))[0], np.ravel(tvec))


class Placement(TypedDict, total=False):
    """Schema of a place in the plane of a body."""

    position: Annotated[list[Finite], Meta(min_length=2, max_length=3)]
    """Where it is [m]; in the origin by default."""
    angle_deg: Finite
    """Angle about z [degree]; 0 by default."""


class MarkerEntries(Placement):
    """Schema of a marker in a layout."""

    id: Required[Count]
    """Its number in the dictionary."""
    side: Required[Annotated[float, Meta(ge=0.001, le=1)]]
    """Length of its sides [m]."""


class LayoutEntries(TypedDict):
    """Schema of a layout."""

    dictionary: str
    table: Annotated[list[MarkerEntries], Meta(min_length=1)]
    object: Annotated[list[MarkerEntries], Meta(min_length=1)]
    object_pose: NotRequired[Placement]


@dataclass(frozen=True)
class MarkerLayout:
    """Which markers are used, on the table and on the object."""

    dictionary: str
    """Name of their dictionary."""
    table: MarkerBody
    """Markers that lie on the table; their frame is the table frame."""
    object: MarkerBody
    """Markers on the object, in a frame of their own unless `T_object_body` is known."""
    T_object_body: Float[np.ndarray, "4 4"] | None = None
    """Where that frame lies on the object; None: to be found from the image."""

    @classmethod
    def load(cls, path: str | Path) -> "MarkerLayout":
        """The layout in a JSON file.

        Raises:
            PerceptionError: The file is missing or is no such layout.
        """
        remedy = "give a marker layout with its dictionary, table and object"
        values = read_versioned(
            Path(path), LayoutEntries, FORMAT, VERSION, PerceptionError, remedy, key="version"
        )
        try:
            table, body = (_read_body(values[name]) for name in ("table", "object"))
            pose = _placement(values["object_pose"]) if "object_pose" in values else None
        except ValueError as error:
            raise PerceptionError(f"{path}: {error}: {remedy}, each marker with id and side [m]") from error
        layout = cls(values["dictionary"], table, body, pose)
        size = dictionary(layout.dictionary).bytesList.shape[0]
        ids = layout.table.ids + layout.object.ids
        if len(set(ids)) < len(ids) or not all(0 <= id < size for id in ids):
            raise PerceptionError(f"{path}: marker ids {ids}: each must be there once, from 0 to {size - 1}")
        return layout


def _read_body(entries: Sequence[MarkerEntries]) -> MarkerBody:
    sides = {entry["id"]: float(entry["side"]) for entry in entries}
    if len(sides) < len(entries):
        raise ValueError(f"markers {[entry['id'] for entry in entries]}: ids must differ")
    return MarkerBody(sides, {entry["id"]: _placement(entry) for entry in entries})


def _placement(entry: Placement) -> Float[np.ndarray, "4 4"]:
    """T_body_marker of a marker that lies flat: position [m] and angle about z [degree]."""
    position = entry.get("position", ())
    if any(abs(value) > FARTHEST for value in position):
        raise ValueError(f"a position of {shown(list(position))}: give metres, up to {FARTHEST:g} m")
    return planar_transform(position, np.deg2rad(entry.get("angle_deg", 0.0)))
