"""A visitor's page: passes on what the visitor does to the session, and draws what follows."""

from collections.abc import Callable
from contextlib import suppress
from threading import Event, Thread
from time import perf_counter
from typing import Any

import numpy as np

from foretrace.actions import LeverUp
from foretrace.errors import ForetraceError, StudioError
from foretrace.imagined import Belief
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Interaction
from foretrace.perception.photo import PhotoView
from foretrace.studio.choices import Choices, link_of
from foretrace.studio.controls import OWN, Controls
from foretrace.studio.drawing import Drawing
from foretrace.studio.photographs import PhotoRequest, picture_of
from foretrace.studio.saving import animation, picture, plan_file, python_lines
from foretrace.studio.scenery import Moving, futures_of, observed_motion, shown_times
from foretrace.studio.session import LEVEL, Session
from foretrace.studio.shapes import checked, example, from_file, from_text
from foretrace.studio.stage import LOOK_AT, Stage
from foretrace.studio.texts import learned_html, plan_text, simulated_text
from foretrace.studio.uploads import bound_uploads
from foretrace.studio.work_queue import WorkQueue

FRAME = 1 / 25
"""Time between two pictures while time runs [s]."""
PAUSE = 0.8
"""How long the end is shown before time begins anew [s]."""


class Page:
    """The page of one visitor.

    Args:
        client: The visitor's browser.
        choices: What is chosen at first.
        data: Data set that objects can be taken from.
        message: What the visitor is told at first.
        address: Host and port by which the visitor came, for links.
    """

    def __init__(
        self, client: Any, choices: Choices, data: Dataset | None = None, message: str = "", address: str = ""
    ) -> None:
        self.session = Session(choices)
        """What is chosen, and what follows."""
        self.latencies: list[float] = []
        """Seconds from each of the last events to its picture."""
        self._client, self._data, self._address = client, data, address
        self._work, self._closed = WorkQueue(), Event()
        self._dragged: tuple[np.ndarray, bool] | None = None
        self._told = -1
        self._message = ""
        self._photo: PhotoView | None = None
        self.stage = Stage(client)
        self.controls = Controls(client.gui, choices, self._choose, data is not None)
        self._drawing = Drawing(client.scene, self.controls, self.stage)
        self._connect()
        self.stage.show_object(choices.object)
        self.act(lambda: None, message)
        self._player = Thread(target=self._let_time_run, daemon=True, name="foretrace-studio-time")
        self._player.start()

    def show_from(self, eye: tuple[float, float, float]) -> None:
        """Look at the object from a place in its frame [m]."""
        self._client.camera.position = eye
        self._client.camera.look_at = LOOK_AT

    def close(self) -> None:
        """The visitor has gone."""
        self._closed.set()
        self._work.end()

    # --- what the visitor does ---------------------------------------------------------------------------

    def act(self, work: Callable[[], None], message: str = "") -> None:
        """Do something after all that was wished before, and draw what follows unless something else waits already.

        Args:
            work: What is to be done.
            message: What the visitor is told about it; an error takes its place.
        """
        started = perf_counter()
        self._work.add(lambda number: self._act(number, work, message, started))

    def _act(self, number: int, work: Callable[[], None], message: str, started: float) -> None:
        if self._closed.is_set():
            return
        self._message = message
        try:
            work()
        except ForetraceError as error:
            self._message = str(error)
        if self._work.is_latest(number) and not self._closed.is_set():
            self._draw()
            self.latencies = [*self.latencies[-999:], perf_counter() - started]
            self._draw_what_takes_time(number)

    def _choose(self, name: str) -> None:
        """Note at once what the visitor has chosen: what is drawn meanwhile shows the former choice again."""
        slider = self.controls.sliders.get(name)
        value = slider.value if slider else getattr(self.controls, name).value
        self.act(lambda: self._take_choice(name, value))

    def _take_choice(self, name: str, value: Any) -> None:
        if name != "example":
            self.session.change(**{name: value})
        elif value != OWN:
            self._take(example(value))

    def _connect(self) -> None:
        controls = self.controls
        for name in ("exact", "imaginer", "goal", "example"):
            _on(getattr(controls, name), lambda name=name: self._choose(name))
        for handle in (controls.tubes, controls.twin, controls.rim, controls.arm):
            _on(handle, lambda: self.act(lambda: None))
        _on(controls.draw, lambda: self.act(self._begin_outline))
        _on(controls.undraw, lambda: self.act(self._drawing.end))
        _on(controls.drawn, lambda: self.act(self._finish_outline))
        _on(controls.use_corners, lambda: self.act(self._take_corners))
        _on(controls.use_row, lambda: self.act(self._take_row))
        _on(controls.plan, lambda: self.act(self._plan))
        _on(controls.alternatives, lambda: self.act(self._look_at))
        _on(controls.simulate, lambda: self.act(self._simulate))
        _on(controls.watch, lambda: self.act(self._watch))
        _on(controls.learn, lambda: self.act(self._learn))
        for handle, name, make in (
            (controls.save_picture, "foretrace.png", lambda: picture(self.session, self._truth)),
            (controls.save_animation, "foretrace.gif", lambda: animation(self.session, self._truth)),
            (controls.save_video, "foretrace.mp4", lambda: animation(self.session, self._truth, ".mp4")),
            (controls.save_plan, "plan.json", lambda: plan_file(self.session.plan)),
            (controls.save_lines, "foretrace_lines.py", lambda: python_lines(self.session).encode()),
        ):
            _on(handle, lambda name=name, make=make: self.act(lambda: self._save(name, make)))
        controls.upload.on_upload(lambda event: self.act(self._take_file))
        photo = controls.photo
        for kind, button in photo.uploads.items():
            button.on_upload(lambda event, kind=kind: self.act(lambda: photo.take(kind)))
        _on(photo.example, lambda: self.act(self._take_example_photo))
        _on(photo.find, lambda: self.act(lambda: self._take_photo(photo.request(self._height()))))
        bound_uploads(self._client.gui, lambda text: self.act(lambda: None, text))
        for handle in (self.stage.grip, *self.stage.parts):
            for modifier in (None, "shift"):
                handle.on_drag("left", modifier=modifier)(self._drag)

    async def _drag(self, event: Any) -> None:
        """Note where the pointer is on the table; in order, and at once. What follows is worked out elsewhere."""
        eye = np.array(event.client.camera.position)
        way = np.array(event.end_position) - eye
        if abs(way[2]) < 1e-6 or (reach := -eye[2] / way[2]) <= 0:
            return
        self._dragged = (eye + reach * way)[:2], event.modifier == "shift"
        self.act(self._follow)

    def _follow(self) -> None:
        """Bring the contact, or the direction, to where the pointer is."""
        if self._dragged is None:
            return
        point, turns = self._dragged
        if turns:
            self.session.turn_from(point)
        else:
            self.session.move_to(point)

    def _take(self, obj: Any) -> None:
        """Another object; an outline that is being drawn is given up."""
        self._drawing.end()
        self.session.change(object=obj, along=0.1, turn=0.0)
        self._photo = None
        self.controls.learned.content = ""
        self.stage.show_object(obj)
        middle = obj.corners.mean(axis=0)
        self._client.camera.look_at = (*middle.tolist(), 0.03)

    def _take_corners(self) -> None:
        self._take(from_text(self.controls.corners.value, self._height()))

    def _take_file(self) -> None:
        file = self.controls.upload.value
        scale = 0.001 * float(self.controls.scale.value)
        self._take(from_file(file.name, file.content, self._height(), scale))

    def _take_row(self) -> None:
        if self._data is None:
            return
        interaction = self._data.with_id(int(self.controls.row.value))
        self._take(checked(interaction.object))
        self.session.replay(interaction)
        self._begin_time()

    def _take_photo(self, request: PhotoRequest) -> None:
        """The object that a photograph shows, levered there."""
        seen = request.observe()
        self._take(checked(seen.placed.object))
        self.session.take(seen.action)
        self._photo = seen

    def _take_example_photo(self) -> None:
        request = self.controls.photo.take_example()
        self.controls.height.value = round(1000 * request.height, 3)
        self._take_photo(request)

    def _height(self) -> float:
        return 0.001 * float(self.controls.height.value)

    def _begin_outline(self) -> None:
        async def clicked(event: Any) -> None:
            self.act(lambda: self._add_corner(event))

        self._drawing.begin(clicked)
        self._message = "click the corners of an outline on the table, in order"

    def _add_corner(self, event: Any) -> None:
        self._message = self._drawing.add(event)

    def _finish_outline(self) -> None:
        self._take(self._drawing.finish(self._height()))

    def _plan(self) -> None:
        self.controls.planned.content = "looking around ..."
        try:
            found = self.session.plan_best()
        except ForetraceError:
            self.controls.planned.content = ""
            raise
        self.controls.planned.content = plan_text(found)
        names = ["the best", *(f"alternative {k}" for k in range(2, len(found.alternatives) + 2))]
        self.controls.alternatives.options = tuple(names)
        self.controls.alternatives.value = names[0]
        self.controls.alternatives.visible = len(names) > 1

    def _look_at(self) -> None:
        found, name = self.session.plan, self.controls.alternatives.value
        if found is None:
            return
        number = 1 if name == "the best" else int(name.split()[-1])
        self.session.take(found.action if number == 1 else found.alternatives[number - 2].action)
        self.session.plan = found

    def _simulate(self) -> None:
        simulated = self.session.simulate()
        self.controls.simulated.content = simulated_text(simulated, self.session.simulations)

    def _watch(self) -> None:
        self.session.watch(self.controls.wish.value)
        self._begin_time()

    def _begin_time(self) -> None:
        self.controls.play.value = True
        self.controls.time.value = 0.0
        self._told = -1

    def _learn(self) -> None:
        def tell(truth: dict[str, float], beliefs: list[Belief]) -> None:
            self.controls.learned.content = learned_html(truth, beliefs)

        tell(*self.session.learn(tell))

    def _save(self, name: str, make: Callable[[], bytes]) -> None:
        self._client.send_file_download(name, make())

    @property
    def _truth(self) -> Interaction | None:
        return None if self.session.simulated is None else self.session.simulated.interaction

    # --- what the visitor sees ---------------------------------------------------------------------------

    def _draw(self) -> None:
        """Draw what follows from the choices; within a drag, this is what takes time."""
        session, controls, stage = self.session, self.controls, self.stage
        if self._drawing.active:
            controls.show_result(None, self._message)
            return
        action = session.action
        try:
            imagined = session.imagined
        except ForetraceError as error:
            imagined = None
            self._message = self._message or str(error)
        with self._client.atomic():
            controls.show_choices(session.choices)
            controls.show_result(imagined, self._message)
            times = np.zeros(1) if imagined is None else shown_times(imagined, action)
            futures = [] if imagined is None else futures_of(imagined, action, LEVEL)
            stage.show_contact(action, times)
            stage.show_futures(futures, controls.tubes.value)
            stage.show_other("simulated", self._happened(action))
            controls.link.value = self._link()
            if not controls.twin.value:
                stage.show_other("twin", None)
            if controls.time.max != (end := max(float(times[-1]), 0.05)):
                controls.time.max = end
        stage.show_time(float(controls.time.value))

    def _happened(self, action: LeverUp) -> Moving | None:
        """What was simulated or watched last; texts about what no longer holds are removed."""
        session = self.session
        com = session.choices.object.mass_properties(1.0).com
        if session.simulated is None:
            self.controls.simulated.content = ""
        if session.watched is not None:
            return observed_motion(session.watched.poses, action, com)
        self.controls.show_verdict(None, 0)
        if session.simulated is None:
            return None
        return observed_motion(session.simulated.interaction.effect.pose_trajectory, action, com)

    def _link(self) -> str:
        try:
            return link_of(self._address, self.session.choices)
        except StudioError as error:
            return str(error)

    def _draw_what_takes_time(self, number: int) -> None:
        """The twin's motion and the rim, unless the visitor has gone on meanwhile."""
        session, stage = self.session, self.stage
        if self._drawing.active:
            stage.show_rim(None)
            return
        for wanted, show in (
            (self.controls.arm.value, self._draw_arm),
            (self.controls.rim.value, self._draw_rim),
            (self.controls.twin.value, self._draw_twin),
            (self._photo is not None, self._draw_photo),
        ):
            if wanted and self._work.is_latest(number):
                try:
                    show()
                except ForetraceError as error:
                    self.controls.show_result(None, str(error))
        if not self.controls.rim.value:
            stage.show_rim(None)
        if not self.controls.arm.value:
            stage.show_arm(None)
        if self._photo is None:
            self.controls.photo.show(None)
        with suppress(ForetraceError):
            self.controls.show_result(session.imagined, self._message)

    def _draw_rim(self) -> None:
        self.stage.show_rim(self.session.rim)

    def _draw_arm(self) -> None:
        self.stage.show_arm(self.session.choices.path)
        self.stage.show_time(float(self.controls.time.value))

    def _draw_photo(self) -> None:
        if self._photo is not None:
            self.controls.photo.show(picture_of(self._photo, self.session.action, self.session.imagined))

    def _draw_twin(self) -> None:
        action = self.session.action
        futures = futures_of(self.session.twin, action, LEVEL)
        self.stage.show_other("twin", futures[0])
        self.stage.show_time(float(self.controls.time.value))

    def _show_time(self, time: float) -> None:
        self.stage.show_time(time)
        if (watched := self.session.watched) is not None:
            k = int(np.searchsorted(watched.times, time + 1e-6, side="right")) - 1
            if k != self._told:
                self._told = k
                self.controls.show_verdict(watched, k)

    def _let_time_run(self) -> None:
        """While `play` is on, until the visitor goes; else show the time that the visitor chooses."""
        now, last = float(self.controls.time.value), perf_counter()
        while not self._closed.wait(FRAME):
            elapsed, last = perf_counter() - last, perf_counter()
            if not self.controls.play.value or self._drawing.active:
                if (chosen := float(self.controls.time.value)) != now:
                    self._show_time(chosen)
                now = chosen
                continue
            end = float(self.controls.time.max)
            now = 0.0 if now > end + PAUSE else now + elapsed
            self.controls.time.value = min(round(now / 0.05) * 0.05, end)
            self._show_time(min(now, end))


def _on(handle: Any, work: Callable[[], None]) -> None:
    """Do something short, in the order of messages, when the visitor, not the page, uses a control."""
    listen = getattr(handle, "on_click", None) or handle.on_update

    @listen
    async def _(event: Any) -> None:  # other functions are called by many threads, in any order
        if event.client_id is not None:
            work()
