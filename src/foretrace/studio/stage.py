"""The three-dimensional part of a visitor's page, in viser: table, object, screwdriver, futures, tubes, rim."""

from collections.abc import Sequence
from threading import RLock
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_rgb

from foretrace.actions import LeverUp, ToolPath
from foretrace.geometry import matrix_to_pose
from foretrace.imagined.shown import percentage
from foretrace.objects import ObjectModel
from foretrace.objects.surface import triangles_of
from foretrace.pictures.style import (
    INK,
    OBJECT_EDGE,
    OUTCOME_COLORS,
    SUPPORT_COLOR,
    TRUTH_COLOR,
)
from foretrace.planning import RimCost
from foretrace.studio.arm import ShownArm
from foretrace.studio.scenery import (
    MOST_FUTURES,
    Moving,
    edges_of,
    rim_segments,
    tool_poses_of,
    tube,
)

OBJECT = (158, 186, 214)
TABLE = (188, 192, 198)
GRIP = (240, 120, 20)
TWIN = (150, 90, 170)
GRIP_BEHIND, GRIP_RADIUS = 0.05, 0.007
"""The grip lies so far behind the contact; its radius [m]."""
CAMERA, LOOK_AT = (0.14, -0.3, 0.22), (0.0, 0.0, 0.02)
"""Where the camera is at first, and what it looks at [m]."""
TABLE_SIZE, TABLE_WITH_ARM = (0.9, 0.9, 0.012), (2.4, 2.4, 0.012)
"""The table, and the one on which the arm stands, too [m]."""
WIDE = 0.05
"""Of futures beside the expected one, wider tubes are left out: they would hide everything [m]."""
LABEL = 0.022
"""Distance of labels [m]."""
RIM = 0.006
"""Thickness of the coloured rim [m]."""
SHRUNK = 0.985
"""Ghosts are that much smaller, so that they are hidden in the object where they do not differ from it."""
LINE = 0.0009
"""Thickness of lines [m]."""


def colour_of(name: str) -> tuple[int, int, int]:
    """Colour of an outcome, or of a name of matplotlib: red, green and blue, 0 to 255."""
    red, green, blue = to_rgb(OUTCOME_COLORS.get(name, name if name.startswith("#") else INK))
    return round(255 * red), round(255 * green), round(255 * blue)


class Stage:
    """What one visitor sees in three dimensions.

    Args:
        client: The visitor's browser.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._scene = client.scene
        self._movers: dict[str, tuple[Any, Moving]] = {}
        self._moving = RLock()  # time runs in a thread of its own
        self._ghosts: list[Any] = []
        self._object: Any = None
        self._rim: RimCost | None = None
        self._tool_poses = np.zeros((0, 4, 4))
        self._times = np.zeros(0)
        client.camera.position, client.camera.look_at = CAMERA, LOOK_AT
        client.camera.near, client.camera.min_orbit_distance = 0.005, 0.05
        self._show_table(TABLE_SIZE)
        x, y, _ = TABLE_SIZE
        self._scene.add_grid(
            "/grid", width=x, height=y, cell_size=0.01, section_size=0.1, cell_color=(178, 182, 188),
            section_color=(160, 165, 172), cell_thickness=0.6, position=(0, 0, 0.0003), shadow_opacity=0.0,
        )  # fmt: skip
        self.tool = self._scene.add_frame("/tool", show_axes=False)
        self.parts: list[Any] = []
        self.grip = self._scene.add_icosphere("/grip", radius=GRIP_RADIUS, color=GRIP)
        self._add_tool()
        self._arm = ShownArm(self._scene)

    def _show_table(self, size: tuple[float, float, float]) -> None:
        middle = (0, 0, -size[2] / 2)
        self._scene.add_box("/table", dimensions=size, position=middle, color=TABLE, cast_shadow=False)

    def _add_tool(self) -> None:
        for part in LeverUp((0, 0), (1, 0)).tool.parts():
            name, colour = f"/tool/{part.name}", tuple(round(255 * each) for each in part.colour)
            place = {"position": part.pose[:3], "wxyz": part.pose[3:], "color": colour}
            if part.shape == "box":
                self.parts.append(
                    self._scene.add_box(name, dimensions=tuple(2 * each for each in part.end), **place)
                )
            else:
                height = part.length + 2 * part.radius
                self.parts.append(self._scene.add_cylinder(name, radius=part.radius, height=height, **place))

    # --- what is there -----------------------------------------------------------------------------------

    def show_object(self, obj: ObjectModel) -> None:
        """Another object, at rest."""
        with self._moving:
            self._replace_object(obj)

    def _replace_object(self, obj: ObjectModel) -> None:
        self._movers = {}
        for name in (
            "/object",
            "/rest",
            "/twin",
            "/simulated",
            *(f"/ghost{k}" for k in range(1, MOST_FUTURES)),
        ):
            self._remove(name)
        self._object = obj
        vertices, faces = triangles_of(obj)
        look: dict[str, Any] = {"vertices": vertices, "faces": faces, "flat_shading": True}
        self._scene.add_mesh_simple("/object", color=OBJECT, **look)
        edges, edge_colour = edges_of(obj), colour_of(OBJECT_EDGE)
        if len(edges):
            self._scene.add_line_segments("/object/edges", edges, edge_colour, thickness=LINE)
        middle = vertices.mean(axis=0)
        look["vertices"] = middle + SHRUNK * (vertices - middle)
        closed = np.stack([obj.corners, np.roll(obj.corners, -1, axis=0)], axis=1)
        rest = np.concatenate([closed, np.full((*closed.shape[:2], 1), 0.0008)], axis=-1)
        self._scene.add_line_segments("/rest", rest, edge_colour, thickness=LINE)
        for k in range(1, MOST_FUTURES):
            self._scene.add_mesh_simple(f"/ghost{k}", opacity=0.22, visible=False, cast_shadow=False, **look)
        self._scene.add_mesh_simple(
            "/twin", color=TWIN, opacity=0.35, visible=False, cast_shadow=False, **look
        )
        self._scene.add_mesh_simple(
            "/simulated", color=colour_of(TRUTH_COLOR), opacity=0.45, visible=False, cast_shadow=False, **look
        )

    def show_contact(self, action: LeverUp, times: Float[np.ndarray, " time"]) -> None:
        """Where the blade meets the object, and how it moves."""
        self._times, self._tool_poses = times, tool_poses_of(action, times)
        self._arm.place(action)
        tail = action.contact - GRIP_BEHIND * action.direction
        self.grip.position = (*tail.tolist(), GRIP_RADIUS)
        arrow = np.array([[[*tail, 0.0015], [*(action.contact - 0.004 * action.direction), 0.0015]]])
        self._scene.add_arrows(
            "/arrow", arrow, GRIP, shaft_radius=0.0012, head_radius=0.0035, head_length=0.01
        )

    def show_futures(self, futures: Sequence[Moving], tubes: bool) -> None:
        """The expected future as the object, others as ghosts, and regions as tubes."""
        for k in range(MOST_FUTURES):
            name = "/object" if k == 0 else f"/ghost{k}"
            future = futures[k] if k < len(futures) else None
            self._put(name, future)
            wide = future is not None and future.radius is not None and k > 0 and future.radius.max() > WIDE
            if future is None or future.radius is None or wide or not tubes:
                self._remove(f"/tube{k}")
            else:
                vertices, faces = tube(future.path, future.radius)
                opacity = 0.3 if k == 0 and future.radius.max() < WIDE else 0.13
                self._mesh(f"/tube{k}", vertices, faces, colour_of(future.outcome), opacity)
            self._path(f"/path{k}", future)
            if future is not None and k > 0:
                self._scene.get_handle_by_name(name).color = colour_of(future.outcome)
        self._show_labels(futures if len(futures) > 1 else [])

    def show_other(self, name: str, moving: Moving | None) -> None:
        """The motion of the ``twin``, or the ``simulated`` one; None: none."""
        self._put(f"/{name}", moving)
        self._path(f"/{name}_path", moving, TWIN if name == "twin" else colour_of(TRUTH_COLOR))

    def show_arm(self, path: ToolPath | None) -> None:
        """The arm that leads the screwdriver along a path; None: the screwdriver alone.

        Raises:
            ActionError: The arm cannot follow the path.
        """
        if (path is not None) != self._arm.visible:
            self._show_table(TABLE_SIZE if path is None else TABLE_WITH_ARM)
        if path is None:
            self._arm.hide()
        else:
            self._arm.follow(path)

    def show_rim(self, rim: RimCost | None) -> None:
        """Cost of each contact around the object; None: no rim."""
        if rim is self._rim:
            return
        self._rim = rim
        if rim is None:
            self._remove("/rim")
            return
        points, colours = rim_segments(rim, self._object.corners)
        self._scene.add_line_segments("/rim", points, colours, thickness=RIM)

    def show_drawing(self, points: Float[np.ndarray, "n 2"]) -> None:
        """Corners of an outline that is being drawn."""
        self._remove("/drawing")
        if not len(points):
            return
        corners = np.column_stack([points, np.full(len(points), 0.002)])
        ink = colour_of(SUPPORT_COLOR)
        self._scene.add_point_cloud("/drawing", corners, ink, point_size=0.006, point_shape="circle")
        if len(points) > 1:
            lines = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
            self._scene.add_line_segments("/drawing/lines", lines, ink, thickness=2 * LINE)

    def clear(self, cleared: bool) -> None:
        """Clear the table while an outline is drawn."""
        for name in ("/object", "/rest", "/tool", "/grip", "/arrow"):
            if (handle := self._scene.get_handle_by_name(name)) is not None:
                handle.visible = not cleared
        if cleared:
            self.show_futures([], tubes=False)
            for other in ("twin", "simulated"):
                self.show_other(other, None)
            self.show_rim(None)
            self.show_arm(None)
            self._scene.get_handle_by_name("/object").visible = False

    # --- when ----------------------------------------------------------------------------------------------

    def show_time(self, time: float) -> None:
        """Everything as it is at a time [s]."""
        if not len(self._times):
            return
        k = int(np.abs(self._times - time).argmin())
        with self._moving, self._client.atomic():
            _place(self.tool, self._tool_poses[k])
            self._arm.show_time(time)
            for handle, moving in self._movers.values():
                _place(handle, moving.poses[min(k, len(moving.poses) - 1)])

    # ---------------------------------------------------------------------------------------------------------

    def _put(self, name: str, moving: Moving | None) -> None:
        handle = self._scene.get_handle_by_name(name)
        if handle is None:
            return
        handle.visible = moving is not None or name == "/object"
        with self._moving:
            if moving is not None:
                self._movers[name] = (handle, moving)
            elif self._movers.pop(name, None) is not None and name == "/object":
                _place(handle, np.eye(4))

    def _mesh(self, name: str, vertices: np.ndarray, faces: np.ndarray, colour: Any, opacity: float) -> None:
        self._scene.add_mesh_simple(
            name,
            vertices,
            faces,
            color=colour,
            opacity=opacity,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )

    def _path(self, name: str, moving: Moving | None, colour: tuple[int, int, int] | None = None) -> None:
        if moving is None:
            self._remove(name)
            return
        lines = np.stack([moving.path[:-1], moving.path[1:]], axis=1)
        self._scene.add_line_segments(name, lines, colour or colour_of(moving.outcome), thickness=1.5 * LINE)

    def _show_labels(self, futures: Sequence[Moving]) -> None:
        """What becomes of the object in each future, at the end of its path, or above another label there."""
        places: list[np.ndarray] = []
        for future in futures:
            place = future.path[-1] + np.array([0.0, 0.0, LABEL / 2])
            while any(np.linalg.norm(place - other) < LABEL for other in places):
                place = place + np.array([0.0, 0.0, LABEL / 4])
            places.append(place)
        for k in range(MOST_FUTURES):
            self._remove(f"/label{k}")
            if k < len(futures):
                text = f"{futures[k].outcome} {percentage(futures[k].probability)}"
                self._scene.add_label(
                    f"/label{k}", text, position=places[k], anchor="bottom-center", font_screen_scale=0.9
                )

    def _remove(self, name: str) -> None:
        if (handle := self._scene.get_handle_by_name(name)) is not None:
            handle.remove()


def _place(handle: Any, T: Float[np.ndarray, "4 4"]) -> None:
    pose = matrix_to_pose(T)
    handle.position, handle.wxyz = pose[:3], pose[3:]
