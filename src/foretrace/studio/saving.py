"""What a visitor takes along: pictures, a plan, and the Python lines that do the same."""

import io
import json
from pathlib import Path
from pprint import pformat
from tempfile import TemporaryDirectory

from foretrace.errors import StudioError
from foretrace.interactions.record import PHYSICS_RANGES, Interaction
from foretrace.objects import ObjectModel, Prism
from foretrace.pictures.animation import scene_animation
from foretrace.pictures.prediction import scene_of
from foretrace.pictures.scene import Scene, scene_figure
from foretrace.planning import Plan, goals
from foretrace.planning.goals import Goal
from foretrace.studio.session import Session

LONGEST = 20_000
"""A description of an object that is longer does not go into the Python lines."""


def picture(session: Session, truth: Interaction | None = None) -> bytes:
    """A PNG of what is imagined, beside a simulation if there is one.

    Raises:
        ForetraceError: Nothing can be imagined.
    """
    written = io.BytesIO()
    scene_figure(_scene(session, truth)).savefig(written, format="png")
    return written.getvalue()


def animation(session: Session, truth: Interaction | None = None, ending: str = ".gif") -> bytes:
    """The same as a GIF or, with the ending ``.mp4``, as a video.

    Raises:
        ForetraceError: Nothing can be imagined.
    """
    with TemporaryDirectory(prefix="foretrace-") as folder:
        return scene_animation(_scene(session, truth), Path(folder) / f"studio{ending}").read_bytes()


def plan_file(plan: Plan | None) -> bytes:
    """A plan as `foretrace plan` writes it.

    Raises:
        StudioError: There is no plan.
    """
    if plan is None:
        raise StudioError("there is no plan yet: press plan first")
    return json.dumps(plan.to_dict(), indent=2).encode()


def python_lines(session: Session) -> str:
    """Python that imagines, plans and simulates the same."""
    chosen, action = session.choices, session.action
    path = ", ".join(f"{name}={value!r}" for name, value in action.parameters().items())
    told = chosen.context
    return f"""import foretrace as ft

{_object_lines(chosen.object)}
path = ft.ToolPath.of({path})
action = ft.LeverUp({tuple(action.contact.tolist())}, {tuple(action.direction.tolist())}, path)
com = action.T_action_object[:3] @ [*obj.mass_properties(1.0).com, 1.0]
context = {told or '"unknown"'}

predictor = ft.{"load_predictor" if chosen.imaginer == "learned" else "TwinImaginer"}()
imagined = predictor.imagine(ft.TopDownView.of(obj, action), action, context=context, com=com)
print(imagined.futures.outcomes())

plan = ft.plan(obj, {_goal_line(chosen.wanted)}, context=context)
print(plan)

interaction = ft.simulate(obj, action, embodiment="tool"{_physics(told)})
print(interaction.effect.outcome)
"""


def _scene(session: Session, truth: Interaction | None) -> Scene:
    return scene_of(session.choices.object, session.action, session.imagined, session.choices.imaginer, truth)


def _object_lines(obj: ObjectModel) -> str:
    if type(obj) is Prism:
        corners = pformat([tuple(each) for each in obj.corners.tolist()], width=100)
        return f"corners = {corners}\nobj = ft.Prism(corners, {obj.height!r}, ft.{obj.bevel!r})"
    if len(text := repr(obj.to_dict())) > LONGEST:
        return 'obj = ft.MeshObject.load("the file that was uploaded", scale=0.001, rest=True)'
    return f"from foretrace.objects import object_from_dict\n\nobj = object_from_dict({text})"


def _goal_line(goal: Goal) -> str:
    values = {name: getattr(goal, name) for name in goal.__dataclass_fields__}  # pyright: ignore[reportAttributeAccessIssue]
    given = ", ".join(f"{name}={value!r}" for name, value in values.items() if value is not None)
    assert type(goal).__name__ in goals.__all__
    return f"ft.goals.{type(goal).__name__}({given})"


def _physics(told: dict[str, float]) -> str:
    values = ", ".join(f"{name}={value!r}" for name, value in told.items() if name in PHYSICS_RANGES)
    return f", physics=ft.Physics({values})" if values else ""
