"""The panel of a visitor's page, in viser: buttons and sliders, made from the choices and their limits."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from foretrace.imagined import ImaginedEffect
from foretrace.studio.choices import LIMITS, PHYSICS, Choices, GoalName
from foretrace.studio.photographs import PhotoPanel
from foretrace.studio.session import LEVEL
from foretrace.studio.shapes import EXAMPLES
from foretrace.studio.texts import result_html, verdict_html
from foretrace.studio.watching import SURPRISE, WISHES, Watched

OWN = "your own"
"""What the list of examples says of an object that is none of them."""
DEGREE = float(np.pi / 180)


@dataclass(frozen=True)
class Knob:
    """One slider."""

    label: str
    """What it says, with the unit."""
    unit: float
    """What one of its units is [SI]."""
    step: float
    """Its step, in its units."""
    hint: str
    """What it does."""

    @property
    def digits(self) -> int:
        """Digits after the point."""
        return max(0, round(-np.log10(self.step) + 0.49))


KNOBS: Mapping[str, Knob] = {
    "along": Knob("place on the outline [%]", 0.01, 0.1, "From the first corner on, counter-clockwise."),
    "turn": Knob("direction [°]", DEGREE, 1.0, "To the left of the outline's inward normal."),
    "insertion": Knob("insertion [mm]", 0.001, 0.5, "How far the blade is pushed under the object."),
    "arc_radius": Knob("arc radius [cm]", 0.01, 0.5, "Radius of the arc on which the blade lifts."),
    "sweep": Knob("arc [°]", DEGREE, 1.0, "How far the blade lifts along its arc."),
    "speed": Knob("speed", 1.0, 0.05, "A multiple of the usual one."),
    "friction": Knob("friction, table", 1.0, 0.05, "Of object and table. Leftmost: unknown."),
    "tool_friction": Knob("friction, blade", 1.0, 0.01, "Of object and blade. Leftmost: unknown."),
    "density": Knob("density [kg/m³]", 1.0, 50.0, "Of the object. Leftmost: unknown."),
    "angle": Knob("angle [°]", DEGREE, 1.0, "To tilt to."),
    "heading": Knob("towards [°]", DEGREE, 5.0, "Direction on the table, counter-clockwise from the x axis."),
    "distance": Knob("distance [mm]", 0.001, 1.0, "How far the centre of mass is to go."),
}
"""Every slider by the choice that it changes."""
SHOWN_WITH = {"angle": ("tilt",), "heading": ("turn-over", "move", "move-to"), "distance": ("move-to",)}
"""Goals that a slider is for."""


class Slider:
    """A slider of one choice; of what may be unknown, the leftmost position says so.

    Args:
        gui: The visitor's panel.
        name: The choice.
        value: Its value at first [SI]; None: unknown.
        moved: Called when the visitor has moved it.
    """

    def __init__(self, gui: Any, name: str, value: float | None, moved: Callable[[str], None]) -> None:
        self._knob, self._optional = KNOBS[name], name in PHYSICS
        low, high = (each / self._knob.unit for each in LIMITS[name])
        step = self._knob.step
        self._low = round(low - step if self._optional else low, 4)
        self._least, self._most = low, high
        self.handle = gui.add_slider(
            self._knob.label, min=self._low, max=round(high, 4), step=step, initial_value=self._shown(value),
            hint=self._knob.hint,
        )  # fmt: skip
        self._name_it()

        @self.handle.on_update
        async def _(event: Any) -> None:
            if event.client_id is not None:  # moved by the visitor, not by the page
                self._name_it()
                moved(name)

    @property
    def value(self) -> float | None:
        """Where it stands [SI]; None: unknown."""
        value = float(self.handle.value)
        if self._optional and value < self._least - 1e-6:
            return None
        return float(np.clip(value, self._least, self._most)) * self._knob.unit

    def show(self, value: float | None) -> None:
        """Move it."""
        self.handle.value = self._shown(value)
        self._name_it()

    def _shown(self, value: float | None) -> float:
        if value is None:
            return self._low
        return round(float(np.clip(value / self._knob.unit, self._least, self._most)), 4)

    def _name_it(self) -> None:
        label = f"{self._knob.label.split(' [')[0]}: unknown" if self.value is None else self._knob.label
        if self.handle.label != label:
            self.handle.label = label


class Controls:
    """All buttons and sliders of a page.

    Args:
        gui: The visitor's panel.
        choices: What is chosen at first.
        moved: Called with the name of the choice that the visitor has changed.
        data: Whether there is a data set to take objects from.
    """

    def __init__(self, gui: Any, choices: Choices, moved: Callable[[str], None], data: bool) -> None:
        self._gui = gui
        self.result = gui.add_html("")
        self.time = gui.add_slider("time [s]", min=0.0, max=3.0, step=0.05, initial_value=0.0)
        self.play = gui.add_checkbox("play", True, hint="Let time run, again and again.")
        tabs = gui.add_tab_group()
        self.sliders: dict[str, Slider] = {}
        self._moved, self._choices = moved, choices
        with tabs.add_tab("Act"):
            self._add_action(choices)
        with tabs.add_tab("Object"):
            self._add_object(choices, data)
        with tabs.add_tab("Plan"):
            self._add_goal(choices)
        with tabs.add_tab("Watch"):
            self._add_watch()
        with tabs.add_tab("Save"):
            self._add_save()
        self.show_goal(choices.goal)

    def _slider(self, name: str) -> None:
        self.sliders[name] = Slider(self._gui, name, getattr(self._choices, name), self._moved)

    def _add_action(self, choices: Choices) -> None:
        gui = self._gui
        gui.add_markdown("Drag the orange ball, or the screwdriver, round the object. With shift: turn.")
        for name in ("along", "turn"):
            self._slider(name)
        self.simulate = gui.add_button(
            "simulate it", hint="MuJoCo plays it; what is unknown is drawn at random."
        )
        self.simulated = gui.add_markdown("")
        with gui.add_folder("Physics"):
            for name in PHYSICS:
                self._slider(name)
            self.exact = gui.add_checkbox("contact is met exactly", choices.exact)
        with gui.add_folder("Path of the blade", expand_by_default=False):
            for name in ("insertion", "arc_radius", "sweep", "speed"):
                self._slider(name)
        with gui.add_folder("Show", expand_by_default=False):
            self.imaginer = gui.add_dropdown(
                "imagined by", ("learned", "twin"), initial_value=choices.imaginer
            )
            self.tubes = gui.add_checkbox(f"{LEVEL:.0%} region", True)
            self.arm = gui.add_checkbox("arm", False, hint="The UR10 that leads the screwdriver.")
            self.twin = gui.add_checkbox(
                "twin beside it", False, hint="The twin simulates what it sees: purple."
            )

    def _add_object(self, choices: Choices, data: bool) -> None:
        gui = self._gui
        name = next((name for name, each in EXAMPLES.items() if each is choices.object), OWN)
        self.example = gui.add_dropdown("example", (*EXAMPLES, OWN), initial_value=name)
        self.draw = gui.add_button("draw an outline", hint="Click its corners on the table.")
        self.drawn = gui.add_button("finish the outline", color="green", visible=False)
        self.undraw = gui.add_button("cancel", color="gray", visible=False)
        self.height = gui.add_number(
            "height [mm]",
            20.0,
            min=1.0,
            max=200.0,
            step=1.0,
            hint="Of what is drawn, masked or photographed.",
        )
        with gui.add_folder("Corners as text", expand_by_default=False):
            self.corners = gui.add_text("x y [m]", "", multiline=True)
            self.use_corners = gui.add_button("use these corners")
        with gui.add_folder("Mask, mesh or table of corners", expand_by_default=False):
            self.scale = gui.add_number(
                "scale [mm]",
                0.5,
                min=0.001,
                max=1000.0,
                step=0.001,
                hint="Of a pixel, or a unit of a mesh or table.",
            )
            self.upload = gui.add_upload_button(
                "choose a file", hint="PNG, STL, OBJ, PLY, OFF, CSV, TXT, JSON."
            )
        self.photo = PhotoPanel(gui)
        self.row = gui.add_number("row of the data set", 0, min=0, step=1, visible=data)
        self.use_row = gui.add_button(
            "use this row", visible=data, hint="Its object and lever-up; what was recorded of it is green."
        )

    def _add_goal(self, choices: Choices) -> None:
        gui = self._gui
        self.goal = gui.add_dropdown("goal", get_args(GoalName), initial_value=choices.goal)
        for name in SHOWN_WITH:
            self._slider(name)
        self.rim = gui.add_checkbox("cost around the rim", True, hint="The lighter, the better.")
        self.plan = gui.add_button("plan", color="green", hint="Jump to the best lever-up.")
        self.planned = gui.add_markdown("")
        self.alternatives = gui.add_dropdown("look at", ("-",), visible=False)

    def _add_watch(self) -> None:
        gui = self._gui
        gui.add_markdown("A monitor watches a simulated execution in which something goes wrong.")
        self.wish = gui.add_dropdown("what goes wrong", WISHES, initial_value=SURPRISE)
        self.watch = gui.add_button("watch", color="green")
        self.verdict = gui.add_html("")
        self.learn = gui.add_button(
            "three lever-ups", hint="What three simulated lever-ups tell of friction and density."
        )
        self.learned = gui.add_html("")

    def _add_save(self) -> None:
        gui = self._gui
        self.save_picture = gui.add_button("picture (PNG)")
        self.save_animation = gui.add_button("animation (GIF)")
        self.save_video = gui.add_button("animation (MP4)")
        self.save_plan = gui.add_button("plan.json")
        self.save_lines = gui.add_button("the same in Python")
        self.link = gui.add_text("link", "", hint="Opens this page with these choices.")

    # --- what they show ----------------------------------------------------------------------------------

    def show_goal(self, goal: str) -> None:
        """Hide the sliders that are not for a goal."""
        for name, goals in SHOWN_WITH.items():
            self.sliders[name].handle.visible = goal in goals

    def show_choices(self, choices: Choices) -> None:
        """Move everything to where the choices are."""
        for name, slider in self.sliders.items():
            slider.show(getattr(choices, name))
        self.goal.value, self.exact.value = choices.goal, choices.exact
        self.example.value = next((name for name, each in EXAMPLES.items() if each is choices.object), OWN)
        self.show_goal(choices.goal)

    def show_verdict(self, watched: Watched | None, k: int) -> None:
        """What the monitor said up to a sample; nothing where nothing is watched."""
        self.verdict.content = "" if watched is None else verdict_html(watched, k)

    def show_result(self, imagined: ImaginedEffect | None, message: str = "") -> None:
        """Outcomes with their probabilities, and a message."""
        self.result.content = result_html(imagined, message)
