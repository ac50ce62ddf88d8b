"""Moving pictures of interactions: the solid object, the blade, and the paths as they unroll."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from foretrace.errors import PredictionError
from foretrace.geometry import convex_hull, invert_transform, pose_to_matrix, transform_points
from foretrace.interactions.record import Interaction
from foretrace.objects import MeshObject
from foretrace.objects.surface import faces_of
from foretrace.pictures.scene import TOOL_REACH, Scene, draw_over_time, legend_of, tool_line
from foretrace.pictures.style import CM, INK, OBJECT_EDGE, STYLE, SUPPORT_COLOR, TOOL_COLOR

AZIMUTH, ELEVATION = np.radians(-60.0), np.radians(30.0)
"""Where the camera stands: turned from the action's direction towards its right, and raised."""
LIGHT = np.array([-0.35, -0.55, 0.76])
"""Direction towards the light."""
BLADE_WIDTH, BLADE_LENGTH = 0.0055, 0.045
"""The drawn blade [m]; a thinner shaft continues it."""
DRAWN_FACETS = 4
"""Of a cylinder's facets every fourth edge is drawn, so that one sees it roll."""
LAST_FRAME_TIME = 1.2
"""How long an animation rests on its end before it repeats [s]."""


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
    path = Path(path)
    writers = {".gif": _write_gif, ".mp4": _write_mp4}
    if path.suffix.lower() not in writers:
        raise PredictionError(f"cannot write an animation to {path}: choose a name ending in .gif or .mp4")
    period = float(np.median(np.diff(scene.times))) if len(scene.times) > 1 else 0.05
    path.parent.mkdir(parents=True, exist_ok=True)
    writers[path.suffix.lower()](path, frames(scene), period)
    return path


def frames(scene: Scene, width: int = 960, height: int = 450) -> Iterator[np.ndarray]:
    """One (height, width, 3) uint8 picture for each sample of a scene."""
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(width / 100, height / 100), dpi=100)
        canvas = FigureCanvasAgg(fig)
        grid = fig.add_gridspec(3, 2, width_ratios=[2.1, 1.0], left=0.01, right=0.985, bottom=0.22, top=0.88)
        stage = fig.add_subplot(grid[:, 0])
        first = fig.add_subplot(grid[0, 1])
        axes = [first, *(fig.add_subplot(grid[k, 1], sharex=first) for k in (1, 2))]
        draw_over_time(axes, scene)
        cursors = [ax.axvline(0, color=INK, linewidth=1) for ax in axes]
        fig.suptitle(scene.title, x=0.015, ha="left", fontsize=12, fontweight="bold")
        fig.legend(handles=legend_of(scene), loc="lower left", fontsize=8.5)
        limits = _limits(scene)
        for k, time in enumerate(scene.times):
            stage.clear()
            _draw_stage(stage, scene, k)
            stage.set(xlim=limits[0], ylim=limits[1], aspect="equal", anchor="W")
            stage.axis("off")
            for cursor in cursors:
                cursor.set_xdata([time, time])
            canvas.draw()
            yield np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def project(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Points in the action frame as the camera sees them: right, up, towards the camera (orthographic)."""
    right = np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0])
    towards = np.array(
        [np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)]
    )
    return points @ np.stack([right, np.cross(towards, right), towards]).T


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


def _faces_us(face: np.ndarray) -> bool:
    return bool(project(_normal(face))[2] > 0)


def _shaded(color: str, face: np.ndarray) -> np.ndarray:
    """The colour of a face under the light."""
    facing = max(float(_normal(face) @ LIGHT), 0.0)
    return np.clip(np.array(to_rgb(color)) * (0.72 + 0.36 * facing), 0, 1)


def _draw_stage(ax: Axes, scene: Scene, k: int) -> None:
    """The table, the object's shadow, object and blade, and the paths up to sample ``k``."""
    _draw_table(ax, scene)
    pose = pose_to_matrix(scene.pose[k])
    body = [transform_points(pose, face) for face in faces_of(scene.obj, DRAWN_FACETS)]
    shadow = convex_hull(np.concatenate(body)[:, :2])
    ground = project(np.column_stack([shadow, np.zeros(len(shadow))]))[:, :2] * CM
    ax.fill(*ground.T, color="#cfd3da", linewidth=0, zorder=1)
    faces = [(face, _shaded("#c3d3e6", face)) for face in body if _faces_us(face)]
    if scene.tool is not None:
        tip = pose_to_matrix(scene.tool[k])
        blade = [transform_points(tip, face) for face in _tool_faces()]
        faces += [(face, _shaded(TOOL_COLOR, face)) for face in blade]
    faces.sort(key=lambda face: project(face[0])[:, 2].mean())  # the far ones first
    polygons, colors = [project(face)[:, :2] * CM for face, _ in faces], [color for _, color in faces]
    edges = colors if isinstance(scene.obj.shape, MeshObject) else OBJECT_EDGE  # no triangles on meshes
    ax.add_collection(PolyCollection(polygons, facecolors=colors, edgecolors=edges, linewidths=0.9, zorder=2))
    if scene.support_points is not None:
        at_rest = np.column_stack([scene.support_points, np.zeros(2)])
        carried = project(transform_points(pose @ invert_transform(scene.placement), at_rest)) * CM
        ax.plot(*carried[:, :2].T, color=SUPPORT_COLOR, linewidth=2, marker="o", zorder=3)
    for _, path, color, style, width in scene.paths():
        faint, so_far = project(path)[:, :2] * CM, project(path[: k + 1])[:, :2] * CM
        ax.plot(*faint.T, color=color, linewidth=1.0, alpha=0.35, zorder=3)
        ax.plot(*so_far.T, color=color, linestyle=style, linewidth=width + 0.4, zorder=4)
        ax.plot(*so_far[-1], color=color, marker="o", markersize=6, zorder=5)


def _draw_table(ax: Axes, scene: Scene) -> None:
    """The table top around the object."""
    flat = project(_table_corners(scene))[:, :2] * CM
    ax.fill(*flat.T, facecolor="#f1f2f4", edgecolor="#d9dce1", linewidth=1, zorder=0)


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
    few = scene.pose[:: max(1, len(scene.pose) // 12)]
    seen = [_table_corners(scene), *(transform_points(pose_to_matrix(pose), faces) for pose in few)]
    seen += [path for _, path, *_ in scene.paths()]
    if scene.tool is not None:
        seen += [tool_line(pose) for pose in scene.tool[[0, -1]]]
    flat = project(np.concatenate(seen))[:, :2] * CM
    low, high = flat.min(axis=0) - 0.5, flat.max(axis=0) + 0.5
    return (low[0], high[0]), (low[1], high[1])


def _write_gif(path: Path, pictures: Iterator[np.ndarray], period: float) -> None:
    images = [Image.fromarray(picture) for picture in pictures]
    palette = images[len(images) // 2].quantize(128, dither=Image.Dither.NONE)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    durations = [round(1000 * period)] * (len(images) - 1) + [round(1000 * LAST_FRAME_TIME)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=False)


def _write_mp4(path: Path, pictures: Iterator[np.ndarray], period: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise PredictionError(
            f"cannot write {path}: MP4 needs `pip install foretrace[video]`; or choose a .gif"
        ) from error
    shown = list(pictures)
    height, width, _ = shown[0].shape
    rate: Any = 1 / period
    writer: Any = imageio_ffmpeg.write_frames(str(path), (width, height), fps=rate, macro_block_size=2)
    writer.send(None)
    for picture in [*shown, *[shown[-1]] * round(LAST_FRAME_TIME / period)]:
        writer.send(np.ascontiguousarray(picture))
    writer.close()
