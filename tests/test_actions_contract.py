"""What every action and every engine owes, whoever wrote it; an action of one's own takes the same tests."""

import importlib.util
import sys
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from engines_at_hand import every_engine
from foretrace import Dataset, collect, replay
from foretrace.actions import ACTIONS, FAILED, TOOLS, Action, LeverUp, Motion, Tool, tool_poses
from foretrace.errors import ActionError, DatasetError, SimulationError
from foretrace.interactions import storage
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.doctor import examine
from foretrace.objects import Cylinder, ObjectModel, Prism
from foretrace.simulation.collect import CollectConfig
from foretrace.simulation.engine import ENGINES, Engine, make_engine
from foretrace.simulation.lever_up import SimulationConfig, simulate
from foretrace.simulation.recipes import RECIPES

SQUARE = Prism([(0.0, 0.0), (0.16, 0.0), (0.16, 0.12), (0.0, 0.12)])
CYLINDER = Cylinder(0.03, 0.12)
EXAMPLE = Path(__file__).parents[1] / "examples" / "own_action.py"


def load_example():
    """The module of the example, whose action registers itself."""
    spec = importlib.util.spec_from_file_location("own_action", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    sys.modules["own_action"] = module
    spec.loader.exec_module(module)
    return module


EXAMPLE_MODULE = load_example()
EVERY_ACTION = pytest.mark.parametrize("label", ["lever-up", "push", "nudge"])


def test_every_registered_action_is_tested():
    assert {"lever-up", "push", "nudge"} == set(ACTIONS)
    assert ACTIONS["nudge"] is EXAMPLE_MODULE.Nudge


def placed(label: str, obj: ObjectModel = SQUARE) -> Action:
    return ACTIONS.find(label).at_edge(obj, 0, 0.4)


@EVERY_ACTION
def test_the_tool_starts_and_ends_at_rest_and_never_jumps(label):
    action = placed(label)
    assert 0 < action.duration < 60
    step = 1e-4
    times = np.arange(-0.1, action.duration + 0.1, step)
    motion = action.tool_motion(times)
    assert motion.shape == (len(times), 6)
    assert np.isfinite(motion).all()
    assert (motion[:, 3:] != 0).any(axis=0).sum() <= 1, "turns about one axis"
    for end in (times <= 0, times >= action.duration):
        assert (motion[end] == motion[end][0]).all()
    speed = np.diff(motion, axis=0) / step
    assert np.abs(speed).max() < 10
    assert np.abs(np.diff(speed, axis=0)).max() / step < 100
    # A motion is a function of time, whatever the other times are.
    np.testing.assert_array_equal(action.tool_motion(times[::7]), motion[::7])


@EVERY_ACTION
def test_an_action_comes_back_from_its_description(label):
    action = placed(label).moved(0.001, 0.002, 0.3)
    again = Action.from_dict(action.to_dict())
    assert type(again) is type(action)
    for field in fields(action):
        one, other = getattr(action, field.name), getattr(again, field.name)
        assert one.tobytes() == other.tobytes() if isinstance(one, np.ndarray) else one == other
    assert is_dataclass(action.path)
    assert all(isinstance(value, float) for value in asdict(action.path).values())


@EVERY_ACTION
def test_parameters_are_finite_numbers_of_the_path(label):
    action = placed(label)
    parameters = action.parameters()
    assert parameters
    assert all(np.isfinite(value) for value in parameters.values())
    assert parameters == type(action).nominal_parameters()
    name = next(name for name in parameters if hasattr(action.path, name))
    other = replace(action, path=replace(action.path, **{name: 0.9 * parameters[name]}))
    assert other.parameters()[name] == pytest.approx(0.9 * parameters[name])


@EVERY_ACTION
@pytest.mark.parametrize("obj", [SQUARE, CYLINDER], ids=["square", "cylinder"])
def test_its_judge_names_one_of_its_outcomes_with_and_without_observed_contacts(label, obj):
    action = placed(label, obj)
    seen = simulate(obj, action, embodiment="tool").effect
    assert seen.outcome in action.outcomes
    assert FAILED not in action.outcomes
    unseen = Motion(seen.times, seen.pose_trajectory, seen.tool_trajectory, seen.joint_trajectory)
    assert action.judge(unseen, obj, seen.com_trajectory).outcome in action.outcomes
    still = replace(unseen, object_pose=np.repeat(seen.pose_trajectory[:1], len(seen.times), axis=0))
    com = np.repeat(seen.com_trajectory[:1], len(seen.times), axis=0)
    assert action.judge(still, obj, com).outcome == "missed"


@EVERY_ACTION
@every_engine
def test_engines_play_it_along_its_path_and_a_record_replays(label, engine):
    action = placed(label)
    made = simulate(SQUARE, action, engine=engine, embodiment="tool")
    effect = made.effect
    wanted = tool_poses(action.tool_motion(effect.times))
    np.testing.assert_allclose(effect.tool_trajectory[:, :3], wanted[:, :3], atol=1e-3)
    np.testing.assert_allclose(
        np.abs((effect.tool_trajectory[:, 3:] * wanted[:, 3:]).sum(axis=1)), 1, atol=1e-5
    )
    row = storage.to_table([storage.encode(made, object_id=0)]).to_pylist()[0]
    again = replay(storage.decode(row)).effect
    for name in ("pose_trajectory", "com_trajectory", "tool_trajectory"):
        assert getattr(again, name).tobytes() == getattr(effect, name).tobytes()


@EVERY_ACTION
def test_engines_agree(label):
    pytest.importorskip("pybullet")
    first, second = (
        simulate(SQUARE, placed(label), engine=engine, embodiment="tool").effect
        for engine in ("mujoco", "bullet")
    )
    assert first.outcome == second.outcome
    apart = np.linalg.norm(first.com_trajectory - second.com_trajectory, axis=1)
    assert apart.mean() < 5e-3


@EVERY_ACTION
@pytest.mark.parametrize(
    ("contact", "direction", "message"),
    [
        ((np.nan, 0.0), (1.0, 0.0), "contact .* expected two finite numbers"),
        ((0.0, 0.0, 0.0), (1.0, 0.0), "contact .* expected two finite numbers"),
        (None, (1.0, 0.0), "contact None: expected two finite numbers"),
        ((0.0, 0.0), (0.0, 0.0), "has no length"),
        ((0.0, 0.0), "ahead", "direction .ahead.: expected two finite numbers"),
        ((0.5, 0.5), (1.0, 0.0), "from the object's outline: take .*at_edge"),
    ],
)
def test_nonsense_is_refused(label, contact, direction, message):
    with pytest.raises(ActionError, match=message):
        ACTIONS[label](contact, direction).check_contact(SQUARE)


@pytest.mark.parametrize("label", TOOLS)
def test_tools_are_solid_parts_and_come_back(label):
    tool = TOOLS[label]()
    assert Tool.from_dict(tool.to_dict()) == tool
    parts = tool.parts()
    assert len({part.name for part in parts}) == len(parts) > 0
    assert all(part.mass > 0 and (part.radius > 0) == (part.shape == "capsule") for part in parts)
    with pytest.raises(ActionError, match=f"{'length'} = -1"):
        replace(tool, length=-1.0)


def test_actions_of_ones_own_must_name_their_outcomes():
    with pytest.raises(TypeError, match="name some, each once, none 'failed'"):
        type("Kick", (Action,), {"label": "kick", "outcomes": ("kicked", "failed")})
    with pytest.raises(TypeError, match="'push' is taken by"):
        type("Other", (Action,), {"label": "push", "outcomes": ("nudged",)})
    assert "kick" not in ACTIONS


def test_an_outcome_that_was_not_declared_is_an_error(monkeypatch):
    monkeypatch.setattr(EXAMPLE_MODULE.Nudge, "outcomes", ("flown",))
    with pytest.raises(
        ActionError, match="'nudge' was judged 'nudged', which is none of its outcomes: flown"
    ):
        simulate(SQUARE, placed("nudge"), embodiment="tool")


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        (lambda times: np.zeros((len(times), 3)), r"has the shape \(\d+, 3\)"),
        (lambda times: np.full((len(times), 6), np.nan), "is not finite"),
        (lambda times: np.ones((len(times), 6)), r"more than one axis \(roll, pitch, yaw\)"),
    ],
)
@every_engine
def test_impossible_motions_of_the_tool_are_refused(engine, motion, message):
    made = make_engine(engine, "tool", 0.002, 0.05)
    action = placed("push")
    with pytest.raises(SimulationError, match=message):
        made.play(
            SQUARE, action.T_action_object, action.tool, motion, 1.0, CollectConfig().simulation.physics
        )


@every_engine
def test_engines_are_registered_and_refuse_what_they_cannot_play(engine):
    assert engine in ENGINES
    kind = ENGINES.find(engine)
    assert issubclass(kind, Engine)
    assert kind.name == engine
    for wrong in (("hand", 0.002, 0.05), ("tool", 0.003, 0.05), ("tool", -1.0, 0.05)):
        with pytest.raises(SimulationError):
            kind(*wrong)


def test_an_engine_of_ones_own_registers_itself():
    class Still(Engine):
        name, library = "still", "numpy"
        play_freely = staticmethod(lambda *arguments: None)

        def __init__(self, embodiment, timestep, sample_period):
            self.period = sample_period

        def play(self, obj, T_action_object, tool, tool_motion, duration, physics):
            times = np.arange(round(duration / self.period) + 1) * self.period
            pose = np.tile([0.0, 0, 0, 1, 0, 0, 0], (len(times), 1))
            return Motion(times, pose, tool_poses(tool_motion(times)), np.empty((len(times), 0)))

    try:
        made = simulate(SQUARE, placed("push"), engine="still", embodiment="tool")
    finally:
        del ENGINES._entries["still"]
    assert made.effect.outcome == "missed"
    assert made.provenance.engine == "still"


def test_a_data_set_of_another_action(tmp_path):
    RECIPES.add("nudges", EXAMPLE_MODULE.Nudges(("prism",)))
    try:
        config = CollectConfig(1, 1, 0, SimulationConfig(embodiment="tool"), "nudges")
        counts = collect(config, tmp_path, workers=1)
    finally:
        del RECIPES._entries["nudges"]
    dataset = Dataset.open(tmp_path)
    assert counts == dataset.outcomes() == {"nudged": 3}
    assert examine(tmp_path).findings == ()
    assert len(dataset.where(outcome="nudged", distance=0.06)) == 3
    with pytest.raises(
        DatasetError, match=r"no outcome 'levered': choose from nudged, toppled, missed, failed"
    ):
        dataset.where(outcome="levered")
    with pytest.raises(DatasetError, match="no column 'insertion'"):
        dataset.where(insertion=0.02)
    mixed = InteractionBatch.from_interactions(
        [dataset[0], simulate(SQUARE, placed("lever-up"), embodiment="tool")]
    )
    assert mixed.parameters["distance"].tolist() == pytest.approx([0.06, np.nan], nan_ok=True)
    assert mixed.parameters["sweep"].tolist() == pytest.approx([np.nan, 0.75], nan_ok=True)
    assert isinstance(simulate(SQUARE, placed("lever-up"), embodiment="tool").action, LeverUp)
