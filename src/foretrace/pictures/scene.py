"""Pictures of interactions: what was seen, what was done, what happened, and what was imagined.

All is drawn in the action frame: x along the action, y to the left, z up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from foretrace.actions import Action
from foretrace.errors import DatasetError, PredictionError
from foretrace.geometry import (
    matrix_to_pose,
    pose_to_matrix,
    rotation_vector_to_quaternion,
    transform_points,
)
from foretrace.interactions.record import Interaction
from foretrace.objects import MeshObject, ObjectModel
from foretrace.pictures.bands import PredictionBand
from foretrace.pictures.style import (
    CM,
    GREY,
    INK,
    OBJECT_COLOR,
    OBJECT_EDGE,
    PREDICTION_COLORS,
    PREDICTION_LINES,
    SUPPORT_COLOR,
    TOOL_COLOR,
    TRUTH_COLOR,
    headline,
    new_figure,
    styled,
)

TOOL_REACH = 0.12
"""How much of the screwdriver is drawn, from its tip backwards [m]."""
ARROW_LENGTH = 0.045
"""Length of the arrow that shows the action [m]."""

LEGEND, LEGEND_ROW = 0.6, 0.2
"""Height of what is below the axes, and of each row of the legend there [inches]."""


class Ghost(NamedTuple):
    """A motion of the object that is predicted beside the one that is shown, drawn as its edges."""

    pose: np.ndarray
    """Object frame in the action frame over time (time, 7)."""
    color: str
    """Its colour."""
    width: float
    """Width of its edges."""


class Trace(NamedTuple):
    """A path of the centre of mass, and how it is drawn."""

    name: str
    path: np.ndarray
    color: str
    style: Any
    width: float


@dataclass(frozen=True)
class Scene:
    """What a picture shows, whether it was observed or only imagined."""

    obj: ObjectModel
    """The object, in its own frame."""
    placement: Float[np.ndarray, "4 4"]
    """Object frame -> action frame at rest."""
    times: Float[np.ndarray, " time"]
    """Sample times [s]."""
    pose: Float[np.ndarray, "time 7"]
    """Object frame over time: position [m], quaternion (w, x, y, z)."""
    predictions: Mapping[str, np.ndarray]
    """Imagined paths (time, 3) of the centre of mass [m], by name."""
    com: Float[np.ndarray, "time 3"] | None = None
    """Path of the centre of mass as it was observed or simulated [m]."""
    source: str = "observed"
    """What that path is called: ``observed`` or ``simulated``."""
    tool: Float[np.ndarray, "time 7"] | None = None
    """Blade tip over time."""
    support_points: Float[np.ndarray, "2 2"] | None = None
    """The two observed support points [m]."""
    slip_index: int | None = None
    """First sample off the blade."""
    title: str = ""
    """What it is, in a line."""
    band: PredictionBand = field(default_factory=PredictionBand)
    """What else may happen; drawn in the colour of the first prediction."""
    ghosts: Sequence[Ghost] = ()
    """Other motions of the object, which animations show."""

    @classmethod
    def observed(
        cls, interaction: Interaction, predictions: Mapping[str, np.ndarray] | None = None
    ) -> "Scene":
        """An interaction that happened, with what had been imagined about it.

        Raises:
            DatasetError: Its simulation failed: there is nothing to draw.
        """
        effect, num_corners = interaction.effect, len(interaction.object.corners)
        if len(effect.times) == 0:
            raise DatasetError(
                f"interaction {interaction.id} failed: it has no motion to draw; choose another"
            )
        known = np.isfinite(effect.support_points).all()
        return cls(
            obj=interaction.object,
            placement=interaction.action.T_action_object,
            times=effect.times,
            pose=effect.pose_trajectory,
            predictions=_checked(predictions or {}),
            com=effect.com_trajectory,
            source="simulated" if interaction.provenance.source == "simulated" else "observed",
            tool=effect.tool_trajectory,
            support_points=effect.support_points if known else None,
            slip_index=effect.slip_index,
            title=f"Interaction {interaction.id}: {num_corners} corners, {effect.outcome}",
        )

    @classmethod
    def imagined(
        cls,
        obj: ObjectModel,
        action: Action,
        times: Float[np.ndarray, " time"],
        predictions: Mapping[str, np.ndarray],
        pose: Float[np.ndarray, "time 7"] | None = None,
    ) -> "Scene":
        """An action that has not happened, with the tool's planned path.

        Without imagined poses the object is drawn at rest, and the title says so.
        """
        at_rest = np.tile(matrix_to_pose(action.T_action_object), (len(times), 1))
        planned = action.tool_motion(times)
        turned = rotation_vector_to_quaternion(planned[:, 3:])
        title = (
            f"Predicted {action.label}"
            if pose is not None
            else f"Predicted path of a {action.label}; object at rest"
        )
        return cls(
            obj=obj,
            placement=action.T_action_object,
            times=times,
            pose=at_rest if pose is None else pose,
            predictions=_checked(predictions),
            tool=np.concatenate([planned[:, :3], turned], axis=1),
            title=f"{title}, {len(obj.corners)} corners",
        )

    @property
    def outline(self) -> Float[np.ndarray, "n 2"]:
        """Outline of the object at rest, in the action frame [m]."""
        return self.obj.corners @ self.placement[:2, :2].T + self.placement[:2, 3]

    def paths(self) -> list[Trace]:
        """Everything to trace; what happened first."""
        traced = [] if self.com is None else [Trace(self.source, self.com, TRUTH_COLOR, "-", 2.4)]
        for k, (name, path) in enumerate(self.predictions.items()):
            k %= len(PREDICTION_COLORS)
            traced.append(Trace(name, path, PREDICTION_COLORS[k], PREDICTION_LINES[k], 1.8))
        return traced

    def times_of(self, path: np.ndarray) -> Float[np.ndarray, " samples"]:
        """Times of a path that may be longer than what was observed [s]."""
        if len(path) <= len(self.times):
            return self.times[: len(path)]
        period = self.times[1] - self.times[0] if len(self.times) > 1 else 1.0
        return self.times[0] + period * np.arange(len(path))


def _checked(predictions: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    for name, path in predictions.items():
        if np.ndim(path) != 2 or np.shape(path)[1] != 3 or len(path) == 0:
            raise PredictionError(f"path of {name} has shape {np.shape(path)}: expected (time, 3) in metres")
    return dict(predictions)


def interaction_figure(
    interaction: Interaction, predictions: Mapping[str, np.ndarray] | None = None
) -> Figure:
    """One interaction from above, from the side and over time, with what was imagined beside what happened.

    Args:
        interaction: What happened.
        predictions: Imagined paths (time, 3) of the centre of mass in the action frame [m], by name.

    Raises:
        DatasetError: The interaction failed and has no motion.
        PredictionError: A path is not (time, 3).
    """
    return scene_figure(Scene.observed(interaction, predictions))


@styled
def scene_figure(scene: Scene) -> Figure:
    """The picture of `interaction_figure` for any scene. Places are fixed: to find them takes as long as to draw."""
    width, height = 13.2, 4.9
    fig, handles = new_figure(width, height, layout=None), legend_of(scene)
    bottom = LEGEND + LEGEND_ROW * -(-len(handles) // 2)
    grid = fig.add_gridspec(
        3, 3, width_ratios=[1.0, 1.28, 1.05], left=0.04, right=0.99, bottom=bottom / height, top=0.89, wspace=0.15,
        hspace=0.11,
    )  # fmt: skip
    draw_from_above(fig.add_subplot(grid[:, 0]), scene)
    draw_from_the_side(fig.add_subplot(grid[:, 1]), scene)
    first = fig.add_subplot(grid[0, 2])
    axes = [first, *(fig.add_subplot(grid[k, 2], sharex=first) for k in (1, 2))]
    draw_over_time(axes, scene)
    headline(fig, scene.title)
    fig.legend(handles=handles, loc="lower center", ncols=2, fontsize=9)
    return fig


def legend_of(scene: Scene) -> list[Line2D | Patch]:
    """Legend entries of a scene; predictions carry their error where the truth is known."""
    handles: list[Line2D | Patch] = []
    for name, path, color, style, width in scene.paths():
        label = f"centre of mass, {name}"
        if scene.com is not None and path is not scene.com:
            mean, final = _errors(scene, path)
            label += f" (mean error {mean:.2f} cm, at the end {final:.2f} cm)"
        handles.append(Line2D([], [], color=color, linestyle=style, linewidth=width, label=label))
    handles += scene.band.handles(PREDICTION_COLORS[0])
    if scene.support_points is not None:
        handles.append(support_handle())
    return handles


def support_handle() -> Line2D:
    """Legend entry of the support points."""
    return Line2D([], [], color=SUPPORT_COLOR, marker="o", markersize=5, label="support points")


def draw_arrow(ax: Axes, width: float, head: float = 0.2) -> None:
    """The action from above: an arrow upwards that ends at the contact."""
    style = f"-|>,head_width={head},head_length={2 * head}"
    arrow = {"arrowstyle": style, "color": TOOL_COLOR, "linewidth": width, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", (0, 0), (0, -ARROW_LENGTH * CM), arrowprops=arrow)


def draw_path(ax: Axes, path: Float[np.ndarray, "time 2"], color: str, style: Any, width: float) -> None:
    """A path [cm] and a dot at its end."""
    ax.plot(*path.T, color=color, linestyle=style, linewidth=width, zorder=4)
    ax.plot(*path[-1:].T, "o", color=color, markersize=4.5, zorder=5)


def draw_table(ax: Axes, depth: float) -> None:
    """The table from the side, down to a depth [cm]."""
    ax.axhspan(-depth, 0, color="#f1f2f4", zorder=-1)
    ax.axhline(0, color=GREY, linewidth=1.2, zorder=0)


def draw_instant(
    ax: Axes,
    obj: ObjectModel,
    pose: Float[np.ndarray, "7"],
    tool: Float[np.ndarray, "7"] | None,
    strength: float,
    width: float = 2.4,
) -> None:
    """Object and blade from the side at one moment."""
    for ring in silhouette(obj, pose):
        ax.fill(*ring.T * CM, facecolor=OBJECT_COLOR, alpha=0.35, linewidth=0)
        ax.plot(*ring.T * CM, color=OBJECT_EDGE, alpha=strength, linewidth=1.2)
    if tool is not None:
        ax.plot(*tool_line(tool)[:, [0, 2]].T * CM, color=TOOL_COLOR, alpha=strength, linewidth=width)


def draw_from_above(ax: Axes, scene: Scene, margin: float = 0.025) -> None:
    """The object at rest, the action's arrow, support points and paths; the action points up."""
    outline = scene.outline * CM
    ax.fill(outline[:, 1], outline[:, 0], facecolor=OBJECT_COLOR, edgecolor=OBJECT_EDGE, linewidth=1.4)
    draw_arrow(ax, 2.6, 0.35)
    if scene.support_points is not None:
        points = scene.support_points * CM
        ax.plot(points[:, 1], points[:, 0], color=SUPPORT_COLOR, linewidth=2, marker="o", zorder=3)
    for _, path, color, style, width in scene.paths():
        draw_path(ax, path[:, [1, 0]] * CM, color, style, width)
    paths = [path[:, :2] for _, path, *_ in scene.paths()]
    paths.append(scene.band.draw_in_plane(ax, [1, 0], PREDICTION_COLORS[0])[:, ::-1])
    seen = np.concatenate([scene.outline, [[-ARROW_LENGTH, 0]], *paths])
    low, high = (seen.min(axis=0) - margin) * CM, (seen.max(axis=0) + margin) * CM
    ax.set(xlim=(high[1], low[1]), ylim=(low[0], high[0]), aspect="equal", title="From above")
    ax.set(xlabel="y, to the left [cm]", ylabel="x, along the action [cm]", anchor="N")


def draw_from_the_side(ax: Axes, scene: Scene, instants: int = 5) -> None:
    """Silhouette of object and blade at several instants, from light to dark, and the paths in x and z."""
    lifted = np.flatnonzero(np.abs(scene.pose - scene.pose[0]).max(axis=1) > 1e-3)
    first = int(lifted[0]) if len(lifted) else 0
    last = len(scene.pose) - 1
    chosen = np.unique(np.linspace(first, last, instants).round().astype(int))
    for strength, k in zip(np.linspace(0.25, 1.0, len(chosen)), chosen, strict=True):
        draw_instant(ax, scene.obj, scene.pose[k], None if scene.tool is None else scene.tool[k], strength)
    for _, path, color, style, width in scene.paths():
        draw_path(ax, path[:, [0, 2]] * CM, color, style, width)
    scene.band.draw_in_plane(ax, [0, 2], PREDICTION_COLORS[0])
    (left, right), top = ax.get_xlim(), max(ax.get_ylim()[1], 6.0)
    draw_table(ax, 50.0)
    if scene.tool is not None:
        x, _, z = tool_line(scene.tool[-1])[1] * CM
        ax.text(x, z, "  blade", color=TOOL_COLOR)
    lowest = min([path[:, 2].min() * CM - 1.0 for _, path, *_ in scene.paths()], default=0.0)  # it may fall
    ax.set(xlim=(left, right), ylim=(min(-1.2, lowest), top), aspect="equal", title="From the side")
    ax.set(xlabel="x, along the action [cm]", ylabel="z, up [cm]", anchor="N")


def draw_over_time(axes: list[Axes], scene: Scene) -> None:
    """The centre of mass over time, one axis for each coordinate."""
    for k, (ax, name) in enumerate(zip(axes, ("x", "y", "z"), strict=True)):
        for _, path, color, style, width in scene.paths():
            ax.plot(scene.times_of(path), path[:, k] * CM, color=color, linestyle=style, linewidth=width)
        scene.band.draw_over_time(ax, scene.times_of(scene.band.path), k, PREDICTION_COLORS[0])
        if scene.slip_index is not None and scene.slip_index < len(scene.times):
            ax.axvline(scene.times[scene.slip_index], color=GREY, linestyle=":", linewidth=1.2)
            if k == 0:
                place = (scene.times[scene.slip_index], 1.0)
                ax.annotate("slip", place, xycoords=("data", "axes fraction"), fontsize=8.5, color=INK,
                            xytext=(3, -9), textcoords="offset points")  # fmt: skip
        low, high = ax.get_ylim()
        middle, half = (low + high) / 2, max((high - low) / 2, 0.5)  # a path that hardly moves shall look so
        ax.set(ylabel=f"{name} [cm]", ylim=(middle - half, middle + half))
        ax.grid(axis="y", color="#e6e8ec", linewidth=0.8)
        ax.tick_params(labelbottom=k == 2)
    axes[0].set_title("Centre of mass over time")
    axes[2].set_xlabel("time [s]")
    axes[0].figure.align_ylabels(axes)


def silhouette(obj: ObjectModel, pose: Float[np.ndarray, "7"]) -> list[Float[np.ndarray, "_ 2"]]:
    """Outlines of an object seen from the side: closed rings of x and z in the action frame [m]."""
    obj, transform = obj.shape, pose_to_matrix(pose)
    if isinstance(obj, MeshObject):
        return obj.side_view(transform)
    hulls = [
        shapely.MultiPoint(transform_points(transform, piece)[:, [0, 2]]).convex_hull
        for piece in obj.convex_pieces()
    ]
    whole = shapely.union_all(hulls).buffer(1e-6)  # closes hairlines between neighbouring pieces
    return [shapely.get_coordinates(part.exterior) for part in getattr(whole, "geoms", [whole])]


def tool_line(pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "2 3"]:
    """The screwdriver as a line from its tip backwards, in the action frame [m]."""
    return transform_points(pose_to_matrix(pose), np.array([[0.0, 0, 0], [-TOOL_REACH, 0, 0]]))


@styled
def comparison_figure(scenes: Mapping[str, Scene]) -> Figure:
    """Several lever-ups side by side, each from above and from the side, imagined beside observed.

    Args:
        scenes: What to show, by the title of its column.
    """
    fig = new_figure(3.5 * len(scenes), 7.4)
    axes = fig.subplots(2, len(scenes), squeeze=False)
    for column, (title, scene) in enumerate(scenes.items()):
        draw_from_above(axes[0, column], scene)
        draw_from_the_side(axes[1, column], scene)
        errors = [f"{name}: {_errors(scene, path)[0]:.2f} cm" for name, path in scene.predictions.items()]
        axes[0, column].set_title("\n".join([title, *errors]), fontsize=10)
        axes[1, column].set_title("")
        if column > 0:
            axes[0, column].set_ylabel("")
            axes[1, column].set_ylabel("")
    handles = [
        Line2D([], [], color=color, linestyle=style, linewidth=width, label=f"centre of mass, {name}")
        for name, _, color, style, width in next(iter(scenes.values())).paths()
    ]
    handles += [*next(iter(scenes.values())).band.handles(PREDICTION_COLORS[0])][:1]
    fig.legend(handles=[*handles, support_handle()], loc="outside lower center", ncols=5)
    return fig


def _errors(scene: Scene, path: np.ndarray) -> tuple[float, float]:
    """Mean and final distance of a path from the observed one, up to a slip [cm]; NaN where nothing was observed."""
    if scene.com is None:
        return np.nan, np.nan
    end = min(len(path), len(scene.com), scene.slip_index or len(scene.com))
    distance = CM * np.linalg.norm(path[:end] - scene.com[:end], axis=1)
    return float(distance.mean()), float(distance[-1])
