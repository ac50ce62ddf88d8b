"""Every record can be played again: with all that it stores, the same bytes come out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rich.console import Console

import factories
from engines_at_hand import WITHOUT_BULLET
from foretrace import replay
from foretrace.actions import Action, LeverUp, Screwdriver, ToolPath
from foretrace.actions.lever_up import VARIED_ACTION
from foretrace.errors import ActionError, SimulationError
from foretrace.interactions import storage
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import ExecutionOffset, Interaction, Physics
from foretrace.objects import MeshObject, Prism
from foretrace.simulation.collect import CollectConfig, collect, num_trials, simulate_trial
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.randomisation import RANDOMISED
from foretrace.simulation.recipes import RECIPES

TOOL = SimulationConfig(embodiment="tool")
PATH = ToolPath(insertion=0.018, pitch=0.33, pitch_gain=0.6, insert_time=0.5, lift_time=1.5, hold_time=0.4)
EVERYTHING = replace(RANDOMISED, **VARIED_ACTION)
QUIET = Console(quiet=True)
PENTAGON = Prism([[0.1, 0.0], [0.02, 0.09], [-0.08, 0.05], [-0.07, -0.06], [0.04, -0.09]])
SLIM = Screwdriver(blade_width=0.004, shaft_radius=0.003)


def assert_same_bytes(stored: Interaction) -> None:
    first, second = (
        storage.to_table([storage.encode(each, object_id=0)]).to_pylist()[0]
        for each in (stored, replay(stored))
    )
    for name, value in first.items():
        if isinstance(value, list):  # NaN is not equal to itself, its bytes are
            assert np.array(value).tobytes() == np.array(second[name]).tobytes(), name
        else:
            assert value == second[name], name


def replay_every(config: CollectConfig, step: int) -> None:
    """Trials of a data set, as its rows hold them; the others are not simulated."""
    for id in range(0, num_trials(config), step):
        row = storage.to_table([storage.encode(simulate_trial(config, id), object_id=0)]).to_pylist()[0]
        assert_same_bytes(storage.decode(row))


def replay_all(config: CollectConfig, folder: Path, every: int = 1) -> None:
    collect(config, folder, workers=1, console=QUIET)
    dataset = Dataset.open(folder, failed=True)
    assert len(dataset) > 0
    for row in range(0, len(dataset), every):
        assert_same_bytes(dataset[row])


@pytest.mark.parametrize("recipe", [name for name in RECIPES if name != "pushes"])
def test_rows_of_every_recipe_with_everything_drawn(recipe):
    objects = len(RECIPES[recipe].families)
    simulation = replace(TOOL, watch_time=0.4)
    replay_every(CollectConfig(objects, 1, 3, simulation, recipe, EVERYTHING, PATH, SLIM), 3)


def test_rows_of_pushes_with_everything_drawn_but_the_path():
    drawn = replace(EVERYTHING, **dict.fromkeys(VARIED_ACTION))
    replay_every(CollectConfig(7, 1, 3, TOOL, "pushes", drawn), 9)


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"embodiment": "arm"}, id="arm"),
        pytest.param({"timestep": 0.001, "sample_period": 0.04}, id="time step"),
        pytest.param({"watch_time": 1.3}, id="watched"),
        pytest.param({"camera": "rgbd"}, id="rgbd"),
        pytest.param({"watch_time": 1.0, "physics": Physics(table_edge=0.11)}, id="table edge"),
        pytest.param({"engine": "bullet"}, marks=WITHOUT_BULLET, id="bullet"),
    ],
)
def test_rows_of_every_setting(tmp_path, settings):
    simulation = replace(TOOL, **settings)
    replay_all(CollectConfig(1, 1, 0, simulation, "solids", path=PATH), tmp_path, every=2)


@pytest.mark.parametrize("error", [ExecutionOffset(), ExecutionOffset(0.002, -0.003, 0.05)])
def test_a_mesh_and_an_execution_error(tmp_path, error):
    corners = np.array([[0.1, 0.0], [0.02, 0.09], [-0.08, 0.05], [-0.07, -0.06], [0.04, -0.09]])
    low, high = np.pad(0.92 * corners, ((0, 0), (0, 1))), np.insert(corners, 2, 0.03, axis=1)
    hull = trimesh.convex.convex_hull(np.concatenate([low, high]))
    hull.export(tmp_path / "stone.stl")
    mesh = MeshObject.load(tmp_path / "stone.stl")
    made = simulate_lever_up(mesh, LeverUp.nearest(mesh, (0.1, 0.0), path=PATH), TOOL, execution_error=error)
    row = storage.to_table([storage.encode(made, object_id=0)]).to_pylist()[0]
    assert_same_bytes(storage.decode(row))


def test_a_direction_comes_back_with_its_last_bits():
    rng = np.random.default_rng(0)
    for _ in range(200):
        action = LeverUp((0.0, 0.0), rng.normal(size=2), PATH, SLIM)
        again = Action.from_dict(action.to_dict())
        assert again.direction.tobytes() == action.direction.tobytes()
        assert (type(again), again.path, again.tool) == (LeverUp, PATH, SLIM)


def test_recorded_interactions_cannot_be_replayed():
    made = factories.fake_interaction(np.random.default_rng(0), 7)
    made = replace(made, provenance=replace(made.provenance, source="recorded", engine=""))
    with pytest.raises(SimulationError, match="interaction 7 is recorded, not simulated"):
        replay(made)


GOOD = LeverUp.at_edge(PENTAGON, 0).to_dict()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"label": "kick"}, "unknown action 'kick'; available: lever-up"),
        ({"label": None}, "unknown action None"),
        ({"direction": [1.0, 1.0]}, r"direction \[1\.0, 1\.0\] has not the length 1"),
        ({"contact": [0.0, None]}, "contact .* expected two finite numbers"),
        ({"path": {"depth": 1.0}}, "action 'lever-up' cannot be read"),
        ({"path": GOOD["path"] | {"insertion": 9.0}}, "insertion = 9.0 is outside 0 to 0.1"),
        ({"path": None}, "action 'lever-up' cannot be read"),
        ({"tool": {"label": "spoon"}}, "unknown tool 'spoon'; available: screwdriver, rod"),
        ({"tool": {"label": "rod", "girth": 1.0}}, "tool 'rod' cannot be read"),
    ],
)
def test_damaged_actions_are_refused(change, message):
    with pytest.raises(ActionError, match=message):
        Action.from_dict(GOOD | change)
