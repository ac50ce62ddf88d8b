"""Public calls with arguments of other types, sizes and shapes than they should have."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from campaign import Outcome
from campaign.answers import judged

MATERIALS = Path()
NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "1e200",
    "1e-320",
    "1e-12",
    "-0.0",
    "1e9",
    "0.001",
    "0.5",
    "3.7",
)
NEAR = ("0.5", "0.9", "1.1", "2", "-1", "10", "0.001", "1e-12")
SHAPES = (
    (),
    (0,),
    (1,),
    (2,),
    (3,),
    (7,),
    (2, 2),
    (3, 2),
    (4, 3),
    (5, 7),
    (0, 2),
    (128, 128),
    (2, 3, 4),
    (90, 120),
)
TYPES = ("f8", "f4", "f2", "i8", "u1", "?", "c16", "U3", "O")
FILLS = ("zeros", "ones", "nan", "inf", "ramp", "random", "huge")


def values() -> st.SearchStrategy[list[Any]]:
    """Descriptions of values; `value_of` makes them."""
    plain = st.one_of(
        st.none(), st.booleans(), st.integers(-(2**70), 2**70), st.integers(-3, 12), st.text(max_size=12)
    )
    arrays = st.tuples(
        st.just("array"),
        st.sampled_from(SHAPES).map(list),
        st.sampled_from(TYPES),
        st.sampled_from(FILLS),
        st.booleans(),
    )
    numbers = st.tuples(st.just("number"), st.sampled_from(NUMBERS))
    simple = st.one_of(numbers, numbers, st.tuples(st.just("plain"), plain))
    return st.one_of(
        simple,
        simple,
        arrays,
        st.tuples(st.just("list"), st.lists(simple, max_size=4).map(list)),
        st.tuples(st.just("thing"), st.sampled_from(THINGS)),
        st.tuples(st.just("scaled"), st.sampled_from(NUMBERS)),
        *[st.tuples(st.just("scaled"), st.sampled_from(NEAR))] * 3,
        st.tuples(
            st.just("turned"), st.sampled_from(("T", "reversed", "column order", "f4", "list", "squeezed"))
        ),
    ).map(list)


def value_of(told: Any, usual: Any) -> Any:
    """A value from its description, and from what the argument usually is."""
    kind, *rest = told
    if kind == "plain":
        return rest[0]
    if kind == "number":
        return float(rest[0])
    if kind == "list":
        return [value_of(each, usual) for each in rest[0]]
    if kind == "thing":
        return thing(rest[0])
    if kind == "array":
        return _array(*rest)
    try:  # the usual value, a little or much changed
        array = np.asarray(usual)
        if kind == "scaled":
            return usual * float(rest[0]) if isinstance(usual, int | float) else array * float(rest[0])
        ways: dict[str, Callable[[], Any]] = {
            "T": lambda: array.T,
            "reversed": lambda: array[::-1],
            "column order": lambda: np.asfortranarray(array),
            "f4": lambda: array.astype("f4"),
            "list": array.tolist,
            "squeezed": lambda: array[None],
        }
        return ways[rest[0]]()
    except Exception:
        return usual


def _array(shape: list[int], dtype: str, fill: str, transposed: bool) -> np.ndarray:
    size = int(np.prod(shape))
    kinds: dict[str, Callable[[], np.ndarray]] = {
        "zeros": lambda: np.zeros(size),
        "ones": lambda: np.ones(size),
        "nan": lambda: np.full(size, np.nan),
        "inf": lambda: np.full(size, np.inf),
        "ramp": lambda: np.arange(size) / 100,
        "random": lambda: np.random.default_rng(0).normal(size=size),
        "huge": lambda: np.full(size, 1e30),
    }
    with np.errstate(all="ignore"):
        array = kinds[fill]().reshape(shape).astype(dtype)
    return array.T if transposed else array


@cache
def thing(name: str) -> Any:
    """Something sound of the package."""
    import foretrace as ft

    makers: dict[str, Callable[[], Any]] = {
        "box": lambda: ft.Box(0.15, 0.14, 0.02),
        "prism": lambda: ft.Prism([(0.09, -0.02), (0.05, 0.07), (-0.03, 0.08), (-0.09, 0.0), (-0.02, -0.08)]),
        "cylinder": lambda: ft.Cylinder(0.02, 0.12),
        "action": lambda: ft.LeverUp.at_edge(thing("box"), 0),
        "path": ft.ToolPath,
        "view": lambda: ft.TopDownView.of(thing("box"), thing("action")),
        "mask": lambda: np.pad(np.ones((60, 60)), 20),
        "data": lambda: ft.Dataset.open(MATERIALS / "data"),
        "batch": lambda: thing("data").batch(),
        "interaction": lambda: thing("data")[0],
        "effect": lambda: thing("interaction").effect,
        "physics": ft.Physics,
        "bevel": ft.Bevel,
        "predictor": ft.load_predictor,
        "path of a file": lambda: MATERIALS / "outline.txt",
        "generator": lambda: np.random.default_rng(0),
        "camera": _camera,
    }
    return makers[name]()


THINGS = (
    *("box", "cylinder", "action", "path", "view", "mask", "data", "batch", "interaction", "effect"),
    *("physics", "bevel", "predictor", "path of a file", "generator", "camera"),
)


def _camera() -> Any:
    from foretrace.interactions.pinhole import PinholeCamera

    return PinholeCamera()


@dataclass(frozen=True)
class Call:
    """A public function with arguments that it accepts."""

    function: Callable[..., Any]
    usual: dict[str, Any]
    use: Callable[[Any], Any] = lambda answer: answer
    """What is done with the answer."""
    share: int = 2


def _object_used(obj: Any) -> Any:
    import foretrace as ft

    found = obj.mass_properties(600.0)
    assert found.mass > 0, f"a mass of {found.mass} kg"
    action = ft.LeverUp.at_edge(obj, 0)
    return found, obj.corners, obj.height_at(np.zeros((1, 2))), ft.TopDownView.of(obj, action).height


def _view_used(view: Any) -> Any:
    imagined = thing("predictor").imagine(view, thing("action"))
    return view.height, _imagined(imagined)


def _action_used(action: Any) -> Any:
    return action.T_action_object, action.tool_motion(np.linspace(0, 1, 5)), action.parameters()


def _batch_imagined(imagined: Any) -> Any:
    return _imagined(imagined[0]), imagined.futures.outcomes


def _imagined(imagined: Any) -> Any:
    return imagined.com_trajectory, imagined.pose_trajectory, imagined.futures.outcomes, repr(imagined)


def _simulated(interaction: Any) -> Any:
    effect = interaction.effect
    return effect.times, effect.com_trajectory, effect.pose_trajectory, effect.path_error


@cache
def table() -> dict[str, Call]:
    """Every public call by its name."""
    import foretrace as ft
    from foretrace.interactions import splits
    from foretrace.interactions.pinhole import PinholeCamera
    from foretrace.perception import importing, photo, tracking
    from foretrace.perception.calibration import Board
    from foretrace.simulation.lens import Faults
    from foretrace.simulation.randomisation import Randomisation
    from foretrace.simulation.recording import RecordingConfig

    box, action, view, mask = (thing(name) for name in ("box", "action", "view", "mask"))
    predictor, effect, data = thing("predictor"), thing("effect"), thing("data")
    mesh = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.05]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    tool = {"embodiment": "tool"}
    settings: tuple[Callable[..., Any], ...] = (
        *(ft.ToolPath, ft.SimulationConfig, ft.CollectConfig, ft.TrainConfig, ft.LstmConfig),
        *(ft.OneShotConfig, ft.Bevel, PinholeCamera, Board, photo.PhotoConfig, importing.ImportConfig),
        *(tracking.TrackConfig, Faults, Randomisation, RecordingConfig, ft.PlanConfig),
    )
    found = {each.__name__: Call(each, _defaults(each), share=1) for each in settings}
    goals = {
        "Lift": _defaults(ft.goals.Lift),
        "Tilt": {**_defaults(ft.goals.Tilt), "angle": 0.5},
        "TurnOver": {**_defaults(ft.goals.TurnOver), "edge": 1},
        "Move": {**_defaults(ft.goals.Move), "direction": (1.0, 0.0)},
        "MoveTo": {**_defaults(ft.goals.MoveTo), "position": (0.02, 0.01), "turn": 0.1},
        "SlideOff": {"point": (0.1, 0.0), "outward": (1.0, 0.0)},
        "Avoid": {**_defaults(ft.goals.Avoid), "zone": [(0.2, 0.0), (0.3, 0.0), (0.2, 0.1)]},
        "KeepUpright": _defaults(ft.goals.KeepUpright),
    }
    for name, usual in goals.items():
        found[name] = Call(getattr(ft.goals, name), usual, _planned, 1)
    found["Contact"] = Call(importing.Contact, {"point": (0.07, 0.0), "pixel": None, "edge": None}, share=1)
    return found | {
        "Prism": Call(
            ft.Prism, {"corners": thing("prism").corners, "height": 0.02, "bevel": ft.Bevel()}, _object_used, 6
        ),
        "Prism.from_mask": Call(
            ft.Prism.from_mask, {"mask": mask, "metres_per_pixel": 0.001, "height": 0.02}, _object_used, 5
        ),
        "Box": Call(ft.Box, {"width": 0.15, "depth": 0.14, "height": 0.02}, _object_used, 3),
        "Cylinder": Call(ft.Cylinder, {"radius": 0.02, "length": 0.12}, _object_used, 2),
        "MeshObject": Call(ft.MeshObject, {"vertices": mesh, "faces": faces}, _object_used, 5),
        "LeverUp": Call(ft.LeverUp, {"contact": (0.07, 0.0), "direction": (-1.0, 0.0)}, _action_used, 4),
        "LeverUp.at_edge": Call(ft.LeverUp.at_edge, {"obj": box, "edge": 1, "fraction": 0.5}, _action_used, 3),
        "LeverUp.nearest": Call(ft.LeverUp.nearest, {"obj": box, "point": (0.075, 0.01)}, _action_used, 3),
        "LeverUp.from_dict": Call(ft.LeverUp.from_dict, {"content": action.to_dict()}, _action_used, 2),
        "TopDownView": Call(ft.TopDownView, {"mask": view.mask, "height": view.height}, _view_used, 5),
        "TopDownView.of": Call(ft.TopDownView.of, {"obj": box, "action": action}, _view_used, 2),
        "TopDownView.from_mask": Call(
            ft.TopDownView.from_mask,
            {"mask": mask, "metres_per_pixel": 0.001, "contact": (0, 0.03), "direction": (0, -1), "height": 0.02},
            _view_used,
            6,
        ),
        "TopDownView.from_points": Call(
            ft.TopDownView.from_points, {"points": _cloud(), "minimal_height": 0.004}, _view_used, 4
        ),
        "ObservedMotion": Call(
            ft.ObservedMotion, {"times": effect.times, "poses": effect.pose_trajectory}, share=4
        ),
        "simulate": Call(
            ft.simulate, {"obj": box, "action": action, **tool, "seed": 0, "watch_time": 0.0}, _simulated, 5
        ),
        "simulate(physics)": Call(
            lambda **values: ft.simulate(box, action, physics=ft.Physics(**values), **tool),
            _defaults(ft.Physics),
            _simulated,
            3,
        ),
        "simulate(path)": Call(
            lambda **values: ft.simulate(box, action, path=ft.ToolPath(**values), **tool),
            _defaults(ft.ToolPath),
            _simulated,
            3,
        ),
        "simulate(Box)": Call(
            lambda **values: ft.simulate(one := ft.Box(**values), ft.LeverUp.at_edge(one, 0), **tool),
            {"width": 0.15, "depth": 0.14, "height": 0.02},
            _simulated,
            2,
        ),
        "replay": Call(ft.replay, {"interaction": thing("interaction")}, _simulated, 1),
        "imagine": Call(predictor.imagine, {"view": view, "action": action, "context": {}, "com": None}, _imagined, 4),
        "imagine(observed)": Call(
            predictor.imagine,
            {"view": thing("interaction").view, "action": thing("interaction").action, "observed": effect},
            _imagined,
            2,
        ),
        "imagine_candidates": Call(
            predictor.imagine_candidates, {"view": view, "actions": [action, action]}, _batch_imagined, 3
        ),
        "imagine_batch": Call(
            predictor.imagine_batch, {"batch": thing("batch"), "start": "observed", "observed": 0}, _batch_imagined, 2
        ),
        "plan": Call(
            lambda **values: ft.plan(**values, config=ft.PlanConfig(0.02, refine=1, check=0)),
            {"seen": box, "goal": ft.goals.Lift(), "imaginer": predictor, "context": None, "com": None,
             "T_table_object": np.eye(4)},
            lambda plan: (repr(plan), plan.to_dict()),
            3,
        ),
        "Dataset.open": Call(ft.Dataset.open, {"path": MATERIALS / "data", "failed": False}, len, 2),
        "Dataset[]": Call(lambda rows: data[rows], {"rows": 1}, share=2),
        "Dataset.where": Call(lambda outcome: data.where(outcome=outcome), {"outcome": "levered"}, len, 2),
        "Dataset.with_id": Call(data.with_id, {"id": 0}, _simulated, 1),
        "batch[]": Call(lambda rows: thing("batch")[rows], {"rows": [1]}, lambda batch: (batch.com, batch.pose), 2),
        "load_predictor": Call(ft.load_predictor, {"path": MATERIALS / "lstm"}, repr, 1),
        "sample_prism": Call(ft.sample_prism, {"rng": thing("generator"), "num_corners": 5}, _object_used, 1),
        "paper_objects": Call(ft.paper_objects, {"seed": 0, "per_corner_count": 1}, len, 1),
        "collect": Call(
            lambda **values: ft.collect(ft.CollectConfig(1, 1, simulation=ft.SimulationConfig(**tool)), **values),
            {"out": "out", "workers": 1},
            share=1,
        ),
        "split_by_seed": Call(splits.split_by_seed, {"n": 20, "seed": 0, "sizes": (10, 5, 5)}, share=2),
        "split_by_object": Call(
            splits.split_by_object, {"object_ids": np.arange(20), "seed": 0, "fractions": (0.8, 0.1, 0.1)}, share=2
        ),
    }  # fmt: skip


def _planned(goal: Any) -> Any:
    """A plan for a goal that was accepted."""
    import foretrace as ft

    found = ft.plan(thing("box"), goal, thing("predictor"), config=ft.PlanConfig(0.02, refine=0, check=0))
    return repr(found), found.cost, found.risk, found.reached


def _cloud() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0.0, 0.1, 60), np.linspace(-0.05, 0.05, 60))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.02)], axis=1)


def _defaults(settings: Callable[..., Any]) -> dict[str, Any]:
    empty = inspect.Parameter.empty
    parameters = inspect.signature(settings).parameters.items()
    return {name: None if each.default is empty else each.default for name, each in parameters}


def requests(materials: Path) -> st.SearchStrategy[dict[str, Any]]:
    """Trials of all calls: one or two of the arguments are other ones."""
    global MATERIALS
    MATERIALS = materials
    calls = table()
    chosen = [name for name, call in calls.items() for _ in range(call.share)]

    def changed(name: str) -> st.SearchStrategy[dict[str, Any]]:
        names = st.lists(st.sampled_from(sorted(calls[name].usual)), min_size=1, max_size=2, unique=True)
        arguments = names.flatmap(lambda listed: st.fixed_dictionaries(dict.fromkeys(listed, values())))
        return arguments.map(lambda given: {"kind": "call", "call": name, "arguments": given})

    return st.sampled_from(chosen).flatmap(changed)


def load(materials: Path) -> None:
    """Make every sound call once, so that nothing is loaded in the trials.

    Raises:
        AssertionError: One of them is refused.
    """
    global MATERIALS
    MATERIALS = materials
    for name, call in table().items():
        if name == "collect":  # which writes
            continue
        usual = {each: value for each, value in call.usual.items() if value is not inspect.Parameter.empty}
        outcome = judged(lambda call=call, usual=usual: call.use(call.function(**usual)))
        assert outcome.ending == "ok", f"{name}: {outcome}"


def run(request: Any, folder: Path, materials: Path) -> Outcome:
    """One call."""
    call = table()[request["call"]]
    arguments = {name: value_of(told, call.usual.get(name)) for name, told in request["arguments"].items()}
    outcome = judged(lambda: call.use(call.function(**(call.usual | arguments))), tuple(request["arguments"]))
    return outcome
