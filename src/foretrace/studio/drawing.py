"""An outline that a visitor draws by clicking its corners on the table."""

from collections.abc import Callable, Coroutine
from typing import Any

import numpy as np

from foretrace.errors import StudioError
from foretrace.objects import Prism
from foretrace.studio.controls import OWN, Controls
from foretrace.studio.shapes import MOST_CORNERS, prism_of
from foretrace.studio.stage import Stage


class Drawing:
    """The outline that is being drawn, if one is.

    Args:
        scene: The visitor's scene, in viser.
        controls: The panel, whose buttons begin and end it.
        stage: Where it is shown.
    """

    def __init__(self, scene: Any, controls: Controls, stage: Stage) -> None:
        self._scene, self._controls, self._stage = scene, controls, stage
        self._corners: list[np.ndarray] = []
        self.active = False
        """Whether an outline is being drawn."""

    def begin(self, clicked: Callable[[Any], Coroutine[Any, Any, None]]) -> None:
        """Clear the table, and wait for clicks on it."""
        self._switch(True)
        self._scene.on_click()(clicked)

    def end(self) -> None:
        """Give it up."""
        if self.active:
            self._switch(False)

    def add(self, event: Any) -> str:
        """One more corner, where the pointer is on the table; returns what is to be said of it.

        Raises:
            StudioError: There are too many.
        """
        origin, way = np.array(event.ray_origin), np.array(event.ray_direction)
        if self.active and way[2] < -1e-6:
            if len(self._corners) >= MOST_CORNERS:
                raise StudioError(f"the outline has {MOST_CORNERS} corners already: finish it")
            self._corners.append((origin - origin[2] / way[2] * way)[:2])
            self._stage.show_drawing(np.array(self._corners))
        return f"{len(self._corners)} corners" if self.active else ""

    def finish(self, height: float) -> Prism:
        """The prism that was drawn.

        Raises:
            ShapeError: It is no outline of an object; one can go on drawing.
        """
        prism = prism_of(np.array(self._corners).reshape(-1, 2), height)
        self.end()
        return prism

    def _switch(self, begins: bool) -> None:
        self.active, self._corners = begins, []
        controls = self._controls
        controls.draw.visible = not begins
        controls.drawn.visible = controls.undraw.visible = begins
        if begins:
            controls.example.value = OWN  # so that any example gives it up, the former one, too
        self._stage.clear(begins)
        self._stage.show_drawing(np.zeros((0, 2)))
        self._scene.remove_click_callback("all")
