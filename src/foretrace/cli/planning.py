"""The command that chooses an action, or several in a row."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from foretrace.cli.console import say
from foretrace.cli.context import PhysicsOptions, bevelled, option_name
from foretrace.cli.objects import ObjectOptions, PhotoOptions
from foretrace.cli.parsing import adapt
from foretrace.cli.plan_many import EveryOptions, Task, plan_every
from foretrace.errors import DatasetError, PlanningError
from foretrace.imagined.context import BEVELS
from foretrace.imagined.shown import percentage, radius_of
from foretrace.perception.photo import PhotoConfig
from foretrace.planning import PlanConfig, goals
from foretrace.urls import as_place

if TYPE_CHECKING:
    from foretrace.imagined import Imaginer
    from foretrace.interactions.topdown import TopDownView
    from foretrace.objects import ObjectModel
    from foretrace.perception.photo import PhotoView
    from foretrace.planning import Plan

ActionName = Literal["lever-up", "push"]
GoalName = Literal["lift", "tilt", "tumble", "turn-over", "move", "move-to", "turn", "slide-off", "learn"]
BELONGS: dict[str, tuple[GoalName, ...]] = {
    "max_slip": ("lift", "tilt", "move"),
    "at_least": ("lift", "move", "learn"),
    "angle": ("tilt", "turn"),
    "edge": ("turn-over",),
    "direction": ("turn-over", "move"),
    "position": ("move-to",),
    "turn": ("move-to",),
    "tolerance": ("tilt", "move-to", "turn"),
    "point": ("slide-off",),
    "outward": ("slide-off",),
}
"""Goals that an option is for."""
NEEDED: dict[GoalName, tuple[str, ...]] = {
    "tilt": ("angle",),
    "move": ("direction",),
    "move-to": ("position",),
    "turn": ("angle",),
    "slide-off": ("point", "outward"),
}
"""Options that a goal cannot do without."""
UNIT = "1 stands for 10 cm or a quarter turn"
"""What a cost says where its goal has no words for it."""


@dataclass(frozen=True)
class GoalOptions:
    """What is to happen, in the object's frame. A photograph's object has the origin of its frame at its centroid."""

    goal: GoalName = "lift"
    """What is to happen."""
    max_slip: float | None = None
    """Largest probability of a slip that is accepted: 0.05 by default for lift and tilt, any for move."""
    at_least: float | None = None
    """Rise or distance from which on the goal counts as reached [m], 0.01 by default; or information [nat], 0.5."""
    angle: float | None = None
    """Angle to tilt to, or to turn by about the vertical [rad]."""
    edge: int | None = None
    """Edge of the outline to turn over; edge k runs from corner k to corner k + 1."""
    direction: tuple[float, float] | None = None
    """Direction to move along or to turn over towards, X Y."""
    position: tuple[float, float] | None = None
    """Where the centre of mass shall end, X Y [m]."""
    turn: float | None = None
    """Turn about the vertical that the object shall have at the end [rad]."""
    tolerance: float | None = None
    """Deviation up to which the goal counts as reached [m, or rad for tilt and turn]."""
    point: tuple[float, float] | None = None
    """A point of the table's edge, X Y [m]."""
    outward: tuple[float, float] | None = None
    """Direction off the table, X Y."""
    avoid: tuple[Path, ...] = ()
    """Files with the corners of zones that neither object nor blade may enter, as of --polygon, in metres."""
    keep_upright: bool = False
    """The object must not end on another side."""

    def load(self) -> goals.Goal:
        """The goal.

        Raises:
            PlanningError: Options do not go together, or one is missing.
        """
        from foretrace.objects.polygon_files import read_polygon

        given = {name: getattr(self, name) for name in BELONGS if getattr(self, name) is not None}
        for name in given:
            if self.goal not in BELONGS[name]:
                raise PlanningError(
                    f"{option_name(name)} goes with --goal {' or '.join(BELONGS[name])}: leave it out"
                )
        if missing := [option_name(name) for name in NEEDED.get(self.goal, ()) if name not in given]:
            raise PlanningError(f"--goal {self.goal} needs {' and '.join(missing)}")
        if self.goal == "turn-over" and len(given) != 1:
            raise PlanningError("--goal turn-over needs either --edge or --direction")
        found: goals.Goal = goals.GOALS.find(self.goal)(**given)
        for file in self.avoid:
            found = found + goals.Avoid(read_polygon(file, None))
        return found + goals.KeepUpright() if self.keep_upright else found


@dataclass(frozen=True)
class PlaceOptions:
    """The object of a data set, and where the object lies."""

    data: Path | None = None
    """Data set whose object is to be levered, in place of --polygon, --image or --mesh; needs --id."""
    id: int | None = None
    """Number of its interaction."""
    pose: tuple[float, float, float] | None = None
    """Where the object's frame lies on the table, X Y [m] and its turn [rad]; a photograph tells it."""
    base: Path | None = None
    """JSON file with the calibrated pose of the arm's base in the table frame: only what the arm reaches is planned."""
    speed: float = 0.1
    """Share of the tool path's own speed at which the arm is checked, at most 1."""


@adapt((PhotoConfig, ("height",)))
def plan(
    obj: Annotated[OmitArgPrefixes[ObjectOptions], arg(name="object")],
    aim: Annotated[OmitArgPrefixes[GoalOptions], arg(name="goal")],
    photo: Annotated[OmitArgPrefixes[PhotoOptions], arg(name="photograph")],
    where: Annotated[OmitArgPrefixes[PlaceOptions], arg(name="place")],
    physics: Annotated[OmitArgPrefixes[PhysicsOptions], arg(name="physics")],
    search: Annotated[OmitArgPrefixes[PlanConfig], arg(name="search")],
    run: Positional[Path | None] = None,
    many: Annotated[OmitArgPrefixes[EveryOptions], arg(name="many objects")] = EveryOptions(),  # noqa: B008
    action: ActionName = "lever-up",
    steps: int = 1,
    unknown: bool = False,
    out: Path = Path("plan"),
) -> None:
    """Choose where, which way and how an object is levered up or pushed, so that a goal is reached.

    Give the object as --polygon, --image or --mesh, of a data set as --data and --id, or on a --photo of the table.

    Args:
        obj: The object: exactly one of --polygon, --image, --mesh.
        aim: What is to happen.
        photo: A photograph of the object on a table; --contact-px, a pixel on it, where there are several.
        where: The object of a data set; where the object and the arm are.
        physics: What is known of the physics; by default the nominal constants.
        search: How candidates are searched.
        many: Plans for every object of a data set.
        run: Folder of a training that imagines; by default the predictor that comes with foretrace.
        action: What the object is moved by. Pushes are imagined by the quasi-static twin.
        steps: Actions in a row, at most. With more than one, they are planned until the object rests after each:
            plan.json has the first, sequence.json all of them.
        unknown: Tell the imaginers only the constants that are given here; by default the others are the nominal ones.
            Each push is then imagined 32 times: with --steps, a plan may take a minute; --spacing 0.02 makes it faster.
        out: Folder for plan.json and plan.png, or plans.csv.
    """
    from foretrace.interactions.recording_folder import write_image
    from foretrace.planning import plan as choose

    goal = aim.load()
    if many.every:
        _refuse_with_every(obj, photo, where, physics, steps)
        seen = thing = T_table_object = None
    else:
        if idle := [option_name(name) for name in ("workers", "cluster") if getattr(many, name) is not None]:
            raise PlanningError(f"{' and '.join(idle)} without --every: leave it out")
        seen, thing, T_table_object = _observe(obj, photo, where)
    predictor = imaginer_of(run, action, steps)
    told = physics.context(predictor, aim.goal == "learn", unknown, thing)
    if thing is not None:
        thing = bevelled(thing, physics.given)
    if thing is None or steps != 1:
        if not isinstance(told, Mapping | None):
            raise PlanningError(
                "a belief is about one object and its next action: leave out --every and --steps"
            )
        if thing is None:
            plan_every(as_place(where.data, DatasetError), Task(run, action, goal, told, search), out, many)
        else:
            _plan_several(thing, goal, steps, predictor, told, search, where, out)
        return
    found = choose(
        thing,
        goal,
        predictor,
        told,
        config=None if search == PlanConfig() else search,  # a goal's own
        T_table_object=T_table_object,
        reach=_reach(where, T_table_object),
    )
    out.mkdir(parents=True, exist_ok=True)
    (out / "sequence.json").unlink(missing_ok=True)  # of an earlier plan
    say_plan(found)
    found.save(out / "plan.json")
    draw_plan(found, out / "plan.png")
    written = ["plan.json", "plan.png"]
    if seen is not None and found.object is not None:
        placed = replace(seen, action=found.action)
        picture = placed.overlay(found.imagined.com_trajectory, radius_of(found.imagined))
        write_image(out / "overlay.png", picture)
        written.append("overlay.png")
    print("\n".join(str(out / name) for name in written))


def _refuse_with_every(
    obj: ObjectOptions, photo: PhotoOptions, where: PlaceOptions, physics: PhysicsOptions, steps: int
) -> None:
    """Refuse options that are about one object.

    Raises:
        PlanningError: Naming them.
    """
    if where.data is None:
        raise PlanningError("--every plans for the objects of a data set: give it as --data")
    one = {name for name in ("id", "pose", "base") if getattr(where, name) is not None}
    one |= {name for name, value in vars(obj).items() if value != getattr(ObjectOptions(), name)}
    one |= physics.given.keys() & {*BEVELS}
    one |= {"photo"} if photo.photo is not None else set()
    one |= {"steps"} if steps != 1 else set()
    if one:
        raise PlanningError(
            f"--every plans for many objects: leave out {' and '.join(map(option_name, sorted(one)))}, or --every"
        )


def imaginer_of(run: Path | None, action: ActionName, steps: int) -> "Imaginer":
    """What imagines actions of a kind, to rest if there are several."""
    if run is not None and (action == "push" or steps != 1):
        raise PlanningError(
            f"{run} imagines its own action, once: leave it out, or --action push and --steps"
        )
    if action == "push":
        from foretrace.twin.sliding import SlidingTwin

        return SlidingTwin()
    if steps != 1:
        from foretrace.imagined import IMAGINERS

        return IMAGINERS.find("twin-to-rest")(None)
    from foretrace.predictor import load_imaginer

    return load_imaginer(run)


def _plan_several(
    thing: "ObjectModel | TopDownView",
    goal: goals.Goal,
    steps: int,
    imaginer: "Imaginer",
    told: Any,
    search: PlanConfig,
    where: PlaceOptions,
    out: Path,
) -> None:
    """Plan actions in a row; print and save them."""
    from foretrace.planning.sequence import SIMULATED, plan_sequence

    if where.base is not None:
        raise PlanningError("--base goes with one action: leave it or --steps out")
    simulated = imaginer.name == "twin" and search == PlanConfig()
    found = plan_sequence(thing, goal, steps, imaginer, told, config=SIMULATED if simulated else search)
    out.mkdir(parents=True, exist_ok=True)
    if found.note:
        say(f"note: {found.note}")
    print(f"goal: {found.goal}")
    print("contacts in the object's frame before each action; where it lies, in its frame at the start:")
    for k, (action, T) in enumerate(zip(found.actions, found.frames[1:], strict=True), start=1):
        (x, y), (dx, dy) = action.contact, action.direction
        turn = np.degrees(np.arctan2(T[1, 0], T[0, 0]))
        print(
            f"{action.label} {k}: contact x {100 * x:.2f}, y {100 * y:.2f} cm, direction {dx:.3f}, {dy:.3f}; then the "
            f"object lies at x {100 * T[0, 3]:.2f}, y {100 * T[1, 3]:.2f} cm, turned by {turn:.1f} degrees"
        )
    print(f"reached with a probability of {percentage(found.reached)}, cost {found.cost:.3f} ({UNIT})")
    found.save(out / "sequence.json")
    found.plan.save(out / "plan.json")
    draw_plan(found.plan, out / "plan.png")
    print("\n".join(str(out / name) for name in ("sequence.json", "plan.json", "plan.png")))


def say_plan(found: "Plan") -> None:
    """Print the plan in words; warnings go to the terminal."""
    for warning in found.imagined.warnings:
        say(f"warning: {warning}")
    if found.note:
        say(f"note: {found.note}")
    (x, y), (dx, dy) = found.action.contact, found.action.direction
    print(f"goal: {found.goal}")
    print(
        f"contact: x {100 * x:.2f}, y {100 * y:.2f} cm, direction {dx:.3f}, {dy:.3f}, in the object's frame"
    )
    if (T := found.T_table_action) is not None:
        print(
            f"on the table: x {100 * T[0, 3]:.2f}, y {100 * T[1, 3]:.2f} cm, direction {T[0, 0]:.3f}, {T[1, 0]:.3f}"
        )
    print(
        f"reached with a probability of {percentage(found.reached)}, cost {found.cost:.3f} ({found.worth or UNIT})"
    )
    for name, chance in found.chances.items():
        print(f"probability of {name}: {percentage(chance)}")
    for stage in found.stages:
        print(stage)
    for k, other in enumerate(found.alternatives, start=2):
        x, y = 100 * other.action.contact
        print(f"alternative {k}: x {x:.1f}, y {y:.1f} cm, cost {other.cost:.3f}: {other.lost}")
    print("not chosen: " + ", ".join(f"{count} {reason}" for reason, count in found.lost.items()))


def draw_plan(found: "Plan", file: Path) -> None:
    """Write the picture of a plan."""
    from foretrace.pictures.plan import plan_figure

    plan_figure(found).savefig(file)


def show_plan(file: Path, out: Path) -> None:
    """Print a plan that was saved, and draw it into a folder."""
    from foretrace.planning import Plan

    found = Plan.open(file)
    out.mkdir(parents=True, exist_ok=True)
    say_plan(found)
    draw_plan(found, out / "plan.png")
    print(out / "plan.png")


def _observe(
    obj: ObjectOptions, photo: PhotoOptions, where: PlaceOptions
) -> "tuple[PhotoView | None, ObjectModel | TopDownView, np.ndarray | None]":
    """The photograph's view, what is planned for, and its pose in the table frame.

    Raises:
        PlanningError: Options do not go together.
    """
    from foretrace.geometry import planar_transform

    if (where.data is None) != (where.id is None):
        raise PlanningError("--data and --id go together: the object of one interaction")
    T = None if where.pose is None else planar_transform([*where.pose[:2], 0.0], where.pose[2])
    if photo.photo is not None:
        if replace(obj, height=None) != ObjectOptions() or where.data is not None:
            raise PlanningError("--photo shows the object: leave out the other ways")
        if T is not None:
            raise PlanningError("--photo tells where the object lies: leave --pose out")
        seen = photo.observe(obj.height, needs_contact=False)
        if seen.flat:
            return seen, seen.placed.object, seen.placed.T_table_object
        return seen, seen.view, seen.T_table_action
    if idle := photo.given():
        raise PlanningError(f"{', '.join(idle)} goes with --photo: give one, or leave it out")
    if where.data is not None and where.id is not None:
        if obj != ObjectOptions():
            raise PlanningError("--data gives the object: leave out the other ways")
        from foretrace.interactions.dataset import Dataset

        return None, Dataset.open(where.data).with_id(where.id).object, T
    return None, obj.load()[0], T


def _reach(where: PlaceOptions, T_table_object: np.ndarray | None) -> Any:
    """What says whether the arm reaches a lever-up; None without an arm."""
    if where.base is None:
        return None
    if T_table_object is None:
        raise PlanningError("--base needs to know where the object lies: give --photo or --pose X Y TURN")
    from foretrace.robot.path import read_base_pose
    from foretrace.robot.reach import ArmReach

    return ArmReach(read_base_pose(where.base), T_table_object, where.speed)
