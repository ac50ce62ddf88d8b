"""Moving pictures of interactions: the solid object, the blade, and the paths as they unroll.

Matplotlib draws once what stays the same, diagrams and legends; what moves is drawn onto it, which takes milliseconds.
"""

from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from foretrace.geometry import invert_transform, pose_to_matrix, transform_points
from foretrace.interactions.record import Interaction
from foretrace.objects import MeshObject
from foretrace.objects.surface import faces_of
from foretrace.pictures.animation_files import write_animation
from foretrace.pictures.scene import TOOL_REACH, Scene, Trace, draw_over_time, legend_of, tool_line
from foretrace.pictures.style import (
    CM,
    INK,
    OBJECT_EDGE,
    PREDICTION_COLORS,
    STYLE,
    SUPPORT_COLOR,
    TOOL_COLOR,
)

AZIMUTH, ELEVATION = np.radians(-60.0), np.radians(30.0)
"""Where the camera stands: turned from the action's direction towards its right, and raised."""
LIGHT = np.array([-0.35, -0.55, 0.76])
"""Direction towards the light."""
BLADE_WIDTH, BLADE_LENGTH = 0.0055, 0.045
"""The drawn blade [m]; a thinner shaft continues it."""
DRAWN_FACETS = 4
"""Of a cylinder's facets every fourth edge is drawn, so that one sees it roll."""
TUBE_STRENGTH = 0.2
"""Opacity of the prediction region."""
DASH = 8.0
"""Length of the dashes of predicted paths, and of the gaps between them [pixels]."""
SUBPIXELS = 4
"""Bits of the fraction of a pixel to which shapes are drawn."""


def interaction_animation(
    interaction: Interaction,
    path: str | Path,
    predictions: Mapping[str, np.ndarray] | None = None,
) -> Path:
    """Write an interaction as a GIF or MP4 in real time, with what was imagined beside what happened.

    Args:
        interaction: What happened.
        path: The file to write; its ending decides between ``.gif`` and ``.mp4``.
        predictions: Imagined paths (time, 3) of the centre of mass in the action frame [m], by name.

    Raises:
        DatasetError: The interaction failed and has no motion.
        PredictionError: A path is not (time, 3), the ending is unknown, or MP4 cannot be written here.
    """
    return scene_animation(Scene.observed(interaction, predictions), path)


def scene_animation(scene: Scene, path: str | Path) -> Path:
    """The animation of `interaction_animation` for any scene."""
    period = float(np.median(np.diff(scene.times))) if len(scene.times) > 1 else 0.05
    return write_animation(Path(path), frames(scene), period)


def frames(
    scene: Scene,
    width: int = 960,
    height: int = 450,
    diagrams: Callable[[list[Axes], Scene], None] = draw_over_time,
    news: tuple[int, str] | None = None,
) -> Iterator[np.ndarray]:
    """One (height, width, 3) uint8 picture for each sample of a scene.

    Args:
        scene: What is shown.
        width: Width [pixels].
        height: Height [pixels].
        diagrams: Draws over time into three axes.
        news: A sample, and what takes the title's place from there on.
    """
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(width / 100, height / 100), dpi=100)
        canvas = FigureCanvasAgg(fig)
        handles = legend_of(scene)
        grid = fig.add_gridspec(3, 2, width_ratios=[1.7, 1.0], left=0.01, right=0.985, bottom=0.24, top=0.88)
        axes = [fig.add_subplot(grid[k, 1]) for k in range(3)]
        diagrams(axes, scene)
        for ax in axes:
            ax.set_xlim(float(scene.times[0]), max(float(scene.times[-1]), float(scene.times[0]) + 0.05))
        title = fig.suptitle(scene.title, x=0.015, ha="left", fontsize=12, fontweight="bold")
        fig.legend(handles=handles, loc="lower left", fontsize=8.5, ncols=1 if len(handles) < 3 else 2)
        stage = fig.add_axes((0.01, 0.15, 0.56, 0.78))
        (x0, x1), (y0, y1) = _limits(scene)
        stage.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", anchor="C")
        stage.axis("off")
        stills = [_drawn(canvas)]
        if news is not None:
            title.set(text=news[1], color=PREDICTION_COLORS[0])
            stills.append(_drawn(canvas))
        origin, one = stage.transData.transform([[0.0, 0.0], [1.0, 1.0]])
        shown = _Stage(scene, one - origin, origin, (height, int(stage.bbox.extents[2])))
        bars = [ax.bbox.extents for ax in axes]
    for still in stills:
        shown.draw_table(still)
    low, high = axes[0].get_xlim()
    for k, time in enumerate(scene.times):
        picture = stills[news is not None and k >= news[0]].copy()
        shown.draw(picture, k)
        for left, bottom, right, top in bars:
            column = left + (right - left) * (time - low) / (high - low)
            _line(picture, np.array([[column, height - top], [column, height - bottom]]), INK, 1)
        yield picture


def _drawn(canvas: FigureCanvasAgg) -> np.ndarray:
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def project(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Points in the action frame as the camera sees them: right, up, towards the camera (orthographic)."""
    return points @ _VIEW.T


def _view() -> Float[np.ndarray, "3 3"]:
    right = np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0])
    towards = np.array(
        [np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)]
    )
    return np.stack([right, np.cross(towards, right), towards])


_VIEW = _view()
"""Rows: the camera's axes, to the right, up, and towards it."""


class _Solid:
    """Flat faces that move together.

    Args:
        faces: Each one's corners in the solid's frame, counter-clockwise from outside [m].
        color: Their colour where the light falls on them.
        edge: Colour of their edges; None: that of the face.
        both: Whether they are seen from both sides.
    """

    def __init__(self, faces: list[np.ndarray], color: str, edge: str | None, both: bool = False):
        self.points, self._ends = np.concatenate(faces), np.cumsum([len(face) for face in faces])[:-1]
        self._normals, self._both = np.stack([_normal(face) for face in faces]), both
        self._color, self.edge = np.array(to_rgb(color)), edge

    def seen(
        self, pose: Float[np.ndarray, "4 4"]
    ) -> list[tuple[float, Float[np.ndarray, "_ 2"], tuple[float, ...]]]:
        """Of each face that is seen: how near it is, its corners in the camera's plane [m], and its colour."""
        flat = project(transform_points(pose, self.points))
        normals = self._normals @ pose[:3, :3].T
        shades = np.clip(self._color * (0.72 + 0.36 * np.maximum(normals @ LIGHT, 0.0))[:, None], 0, 1)
        shown = self._both | (normals @ _VIEW[2] > 0)
        return [
            (float(corners[:, 2].mean()), corners[:, :2], tuple(shade))
            for corners, shade, visible in zip(
                np.split(flat, self._ends), shades.tolist(), shown, strict=True
            )
            if visible
        ]


class _Stage:
    """The part of a picture that moves.

    Args:
        scene: What is shown.
        scale: Pixels per projected centimetre, to the right and up.
        origin: Pixel of the projected origin, counted up from below.
        size: Height of the picture, and the column where this part of it ends [pixels].
    """

    def __init__(self, scene: Scene, scale: np.ndarray, origin: np.ndarray, size: tuple[int, int]):
        self.scene, self._scale, self._origin, self._size = scene, scale, origin, size
        is_mesh = isinstance(scene.obj.shape, MeshObject)
        edge = None if is_mesh else OBJECT_EDGE  # no triangles on meshes
        self._body = _Solid(faces_of(scene.obj, DRAWN_FACETS), "#c3d3e6", edge)
        self._blade = _Solid(_tool_faces(), TOOL_COLOR, None, both=True)
        self._traces = [(trace, self._pixels(trace.path)) for trace in scene.paths()]
        self._tube = self._shape_of_tube()

    def draw_table(self, picture: np.ndarray) -> None:
        """The table top around the object."""
        corners = self._pixels(_table_corners(self.scene))
        _fill(picture, corners, "#f1f2f4")
        _line(picture, np.concatenate([corners, corners[:1]]), "#d9dce1", 1)

    def draw(self, picture: np.ndarray, k: int) -> None:
        """The object's shadow, object and blade, other motions, the region, and the paths up to sample ``k``."""
        scene = self.scene
        pose = pose_to_matrix(scene.pose[k])
        shadow = _hull(transform_points(pose, self._body.points)[:, :2])
        _fill(picture, self._pixels(np.column_stack([shadow, np.zeros(len(shadow))])), "#cfd3da")
        faces = [(*face, self._body.edge) for face in self._body.seen(pose)]
        if scene.tool is not None:
            faces += [(*face, None) for face in self._blade.seen(pose_to_matrix(scene.tool[k]))]
        faces.sort(key=lambda face: face[0])  # the far ones first
        for _, flat, color, edge in faces:
            corners = self._in_picture(flat)
            _fill(picture, corners, color)
            _line(picture, np.concatenate([corners, corners[:1]]), edge or color, 1)
        for ghost in scene.ghosts:
            self._draw_edges(picture, ghost.pose[min(k, len(ghost.pose) - 1)], ghost.color, ghost.width)
        if scene.support_points is not None:
            at_rest = np.column_stack([scene.support_points, np.zeros(2)])
            ends = self._pixels(transform_points(pose @ invert_transform(scene.placement), at_rest))
            _line(picture, ends, SUPPORT_COLOR, 2)
            for end in ends:
                _dot(picture, end, SUPPORT_COLOR, 4.0)
        if self._tube is not None:
            box, shape = self._tube
            part = picture[box]
            tinted = part * (1 - shape) + shape * np.array(_rgb(PREDICTION_COLORS[0]))
            part[:] = tinted.astype(np.uint8)
        for trace, pixels in self._traces:
            self._draw_trace(picture, trace, pixels, k)

    def _draw_edges(self, picture: np.ndarray, pose: np.ndarray, color: str, width: float) -> None:
        for _, flat, _ in self._body.seen(pose_to_matrix(pose)):
            corners = self._in_picture(flat)
            _line(picture, np.concatenate([corners, corners[:1]]), color, round(width))

    def _draw_trace(self, picture: np.ndarray, trace: Trace, pixels: np.ndarray, k: int) -> None:
        _line(picture, pixels, _paler(trace.color), 1)
        so_far = pixels[: k + 1]
        for part in [so_far] if trace.style == "-" else _dashes(so_far):
            _line(picture, part, trace.color, 2 if trace.width < 2 else 3)
        _dot(picture, so_far[-1], trace.color, 5.0)

    def _shape_of_tube(self) -> "tuple[tuple[slice, slice], np.ndarray] | None":
        """Where the prediction region lies in the picture, and its opacity there (rows, columns, 1)."""
        band = self.scene.band
        if band.radius is None:
            return None
        around = band.path[:, None] + band.radius[:, None, None] * _BALL
        around[..., 2] = np.maximum(
            around[..., 2], min(0.0, band.path[:, 2].min())
        )  # nothing is below the table
        shape = np.zeros(self._size, dtype=np.uint8)
        hulls = [_hull(self._pixels(points)) for points in around]
        for pair in pairwise(hulls):
            swept = _fixed(_hull(np.concatenate(pair)))
            cv2.fillConvexPoly(shape, swept, (255.0,), cv2.LINE_AA, SUBPIXELS)
        columns, rows = np.flatnonzero(shape.any(axis=0)), np.flatnonzero(shape.any(axis=1))
        if not len(columns):
            return None
        box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
        return box, TUBE_STRENGTH * shape[box][..., None] / 255.0

    def _pixels(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Columns and rows of points in the action frame."""
        return self._in_picture(project(points)[:, :2])

    def _in_picture(self, flat: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Columns and rows of points in the camera's plane [m]."""
        places = flat * CM * self._scale + self._origin
        return np.column_stack([places[:, 0], self._size[0] - places[:, 1]])


_BALL = np.concatenate([
    np.column_stack([np.sqrt(1 - z**2) * np.cos(a), np.sqrt(1 - z**2) * np.sin(a), np.full(32, z)])
    for z in np.linspace(-1, 1, 17)
    for a in [np.linspace(0, 2 * np.pi, 32, endpoint=False)]
])  # fmt: skip
"""Points on a ball."""
_CIRCLE = np.column_stack([f(np.linspace(0, 2 * np.pi, 32, endpoint=False)) for f in (np.cos, np.sin)])


def _rgb(color: Any) -> tuple[float, float, float]:
    red, green, blue = (255 * value for value in to_rgb(color))
    return red, green, blue


def _paler(color: str) -> tuple[float, ...]:
    return tuple(0.35 * value + 0.65 * 0.92 for value in to_rgb(color))


def _fixed(points: np.ndarray) -> np.ndarray:
    """Pixels as OpenCV takes them, in fractions; a pixel's middle is a whole number there."""
    return np.round((points - 0.5) * 2**SUBPIXELS).astype(np.int32)


def _hull(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "k 2"]:
    """Convex hull, as precise as pixels are."""
    return cv2.convexHull(points.astype(np.float32))[:, 0].astype(float)


def _fill(picture: np.ndarray, corners: np.ndarray, color: Any) -> None:
    cv2.fillPoly(picture, [_fixed(corners)], _rgb(color), cv2.LINE_AA, SUBPIXELS)


def _line(picture: np.ndarray, points: np.ndarray, color: Any, width: int) -> None:
    cv2.polylines(picture, [_fixed(points)], False, _rgb(color), max(width, 1), cv2.LINE_AA, SUBPIXELS)


def _dot(picture: np.ndarray, point: np.ndarray, color: Any, radius: float) -> None:
    _fill(picture, point + radius * _CIRCLE, color)


def _dashes(points: Float[np.ndarray, "n 2"]) -> list[Float[np.ndarray, "_ 2"]]:
    """Parts of a path, every other one of the length of a dash."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    places = np.arange(0.0, length[-1], DASH / 4)
    fine = np.column_stack([np.interp(places, length, points[:, column]) for column in (0, 1)])
    return [fine[k : k + 5] for k in range(0, len(fine), 8)]


def _tool_faces() -> list[np.ndarray]:
    """Blade and shaft as flat strips in the tip's frame, which points along the blade."""
    half, shaft = BLADE_WIDTH / 2, 0.004
    blade = [[0, -half], [0, half], [-BLADE_LENGTH, half], [-BLADE_LENGTH, -half]]
    handle = [[-BLADE_LENGTH, -shaft], [-BLADE_LENGTH, shaft], [-TOOL_REACH, shaft], [-TOOL_REACH, -shaft]]
    return [np.column_stack([xy, np.zeros(4)]) for xy in np.array([blade, handle], dtype=float)]


def _normal(face: np.ndarray) -> np.ndarray:
    """Unit normal by Newell's sum, which holds for polygons that are not convex, too."""
    normal = np.cross(face, np.roll(face, -1, axis=0)).sum(axis=0)
    return normal / max(np.linalg.norm(normal), 1e-12)


def _table_corners(scene: Scene) -> np.ndarray:
    """(4, 3) corners of the drawn part of the table."""
    # As far as an object rolls; one that falls has left the table.
    on_table = [path[path[:, 2] > 0, :2] for _, path, *_ in scene.paths()]
    seen = np.concatenate([scene.outline, *on_table])
    (x0, y0), (x1, y1) = seen.min(axis=0) - 0.04, seen.max(axis=0) + 0.04
    x0, x1 = x0 - 0.04, x1 + 0.03
    return np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])


def _limits(scene: Scene) -> tuple[tuple[float, float], tuple[float, float]]:
    """Range of the projected scene over its whole time [cm]."""
    faces = np.concatenate(faces_of(scene.obj, DRAWN_FACETS))
    moved = [scene.pose, *(ghost.pose for ghost in scene.ghosts)]
    few = np.concatenate([pose[:: max(1, len(pose) // 12)] for pose in moved])
    seen = [_table_corners(scene), *(transform_points(pose_to_matrix(pose), faces) for pose in few)]
    seen += [path for _, path, *_ in scene.paths()]
    if scene.tool is not None:
        seen += [tool_line(pose) for pose in scene.tool[[0, -1]]]
    flat = project(np.concatenate(seen))[:, :2] * CM
    low, high = flat.min(axis=0) - 0.5, flat.max(axis=0) + 0.5
    return (low[0], high[0]), (low[1], high[1])
