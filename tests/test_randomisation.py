import json
from collections import Counter
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
import pytest
from rich.console import Console

import factories
from engines_at_hand import WITHOUT_BULLET
from foretrace.actions import LeverUp, PushPath, ToolPath
from foretrace.actions.lever_up import VARIED_ACTION
from foretrace.cli import main
from foretrace.errors import ActionError, DatasetError, ShapeError, SimulationError
from foretrace.geometry import transform_points
from foretrace.interactions import storage
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.description import describe_dataset
from foretrace.interactions.doctor import examine
from foretrace.interactions.record import NO_OFFSET, ExecutionOffset, Interaction, Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import NO_BEVEL, Box, Cylinder, Prism
from foretrace.simulation.collect import CollectConfig, collect, planned_trial, simulate_trial, trial
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.randomisation import (
    FACTORS,
    LARGEST,
    NOTHING,
    RANDOMISED,
    RANGES,
    Randomisation,
)

TOOL = SimulationConfig(embodiment="tool")
PLAIN = CollectConfig(objects=8, simulation=TOOL)
VARIED = replace(PLAIN, randomisation=RANDOMISED)
EVERYTHING = replace(RANDOMISED, **VARIED_ACTION)
DRAWN = [name for name in RANGES if name != "distance"]  # of lever-ups
PENTAGON = Prism([[0.1, 0.0], [0.02, 0.09], [-0.08, 0.05], [-0.07, -0.06], [0.04, -0.09]])


def fake_trial(config: CollectConfig, id: int) -> Interaction:
    """What is drawn for a trial, without its physics."""
    one = planned_trial(config, id)
    made = factories.fake_lever_up(one.obj, one.action, id=id, seed=one.seed)
    return replace(made, physics=one.config.physics, execution_error=one.execution_error)


def drawn(randomisation: Randomisation, seed: int) -> dict[str, float]:
    """What one lever-up of a prism gets."""
    obj, physics, path, error = randomisation.vary(
        PENTAGON, Physics(), ToolPath(), np.random.default_rng(seed)
    )
    assert isinstance(obj, Prism)
    return {
        "friction": physics.friction,
        "tool_friction": physics.tool_friction,
        "density": physics.density,
        "thickness_factor": obj.height / PENTAGON.height,
        "bevel_width_factor": obj.bevel.width / PENTAGON.bevel.width,
        "bevel_height_factor": obj.bevel.height / PENTAGON.bevel.height,
        **{f"execution_{name}": value for name, value in asdict(error).items()},
        **path.parameters(),
    }


@pytest.fixture(scope="module")
def varied(tmp_path_factory):
    folder = tmp_path_factory.mktemp("varied") / "data"
    collect(VARIED, folder, workers=1, console=Console(quiet=True), simulate=fake_trial)
    return folder


# --- what is drawn --------------------------------------------------------------------------------------------


def test_draws_fill_their_ranges_and_stay_within():
    every = [drawn(EVERYTHING, seed) for seed in range(300)]
    limits = {name: getattr(EVERYTHING, name) for name in DRAWN}
    limits |= {name: (-getattr(RANDOMISED, name), getattr(RANDOMISED, name)) for name in LARGEST}
    others = {"com_offset", "execution_share", "distance"}
    assert limits.keys() | others == {field.name for field in fields(Randomisation)}
    values = {name: np.array([each[name] for each in every]) for name in limits}
    for name, (low, high) in limits.items():
        margin = 0.05 * (high - low)
        assert low - 1e-12 <= values[name].min() < low + margin, name
        assert high - margin < values[name].max() <= high + 1e-12, name
    correlations = np.corrcoef(np.stack(list(values.values()))) - np.eye(len(values))
    assert np.abs(correlations).max() < 0.25


@pytest.mark.parametrize("name", [*DRAWN, *LARGEST])
def test_what_is_drawn_for_one_quantity_does_not_depend_on_the_others(name):
    alone = Randomisation(**{name: getattr(EVERYTHING, name)})
    expected = drawn(NOTHING, 5) | {name: drawn(EVERYTHING, 5)[name]}
    assert drawn(alone, 5) == pytest.approx(expected)
    assert drawn(alone, 5)[name] != drawn(NOTHING, 5)[name]


def test_what_was_drawn_before_the_action_varied_is_drawn_still():
    numbers = drawn(RANDOMISED, 5)
    shares = np.random.default_rng(5).random(9)
    assert numbers["friction"] == 0.5 + shares[0] * (1.1 - 0.5)
    assert numbers["execution_turn"] == np.deg2rad(3.0) * (2 * shares[8] - 1)
    assert numbers.items() >= LeverUp.nominal_parameters().items()


def test_long_and_short_pushes_end_at_the_same_time():
    drawn = Randomisation(distance=(0.01, 0.08))
    paths = [
        drawn.vary(PENTAGON, Physics(), PushPath(), np.random.default_rng(seed))[2] for seed in range(100)
    ]
    distances = [path.distance for path in paths]
    assert min(distances) < 0.015
    assert max(distances) > 0.075
    for path in paths:
        assert path.duration == pytest.approx(PushPath(distance=0.08).duration)
    with pytest.raises(SimulationError, match="insertion cannot be drawn of a PushPath"):
        replace(drawn, insertion=(0.01, 0.02)).vary(PENTAGON, Physics(), PushPath(), np.random.default_rng(0))


@dataclass(frozen=True)
class OwnPath:
    """The path of an action of another package."""

    distance: float = 0.06


def test_paths_of_other_packages_are_not_drawn(monkeypatch, tmp_path, capsys):
    rng = np.random.default_rng(0)
    assert RANDOMISED.vary(PENTAGON, Physics(), OwnPath(), rng)[2] == OwnPath()
    with pytest.raises(SimulationError, match="distance cannot be drawn of a OwnPath: leave it out"):
        Randomisation(distance=(0.01, 0.02)).vary(PENTAGON, Physics(), OwnPath(), rng)
    monkeypatch.setattr(LeverUp, "varied", {})
    assert main(["simulate", "--vary-action", "--out", str(tmp_path / "out")]) == 2
    assert "and recipe 'paper' has a lever-up: leave it out" in capsys.readouterr().err


def test_fast_and_slow_blades_end_at_the_same_time():
    for seed in range(20):
        path = EVERYTHING.vary(PENTAGON, Physics(), ToolPath(), np.random.default_rng(seed))[2]
        assert path.duration == pytest.approx(ToolPath().faster(2 / 3).duration, abs=1e-12)
        assert path.hold_time >= ToolPath().hold_time - 1e-12
        ratio = path.lift_time / path.insert_time
        assert ratio == pytest.approx(ToolPath().lift_time / ToolPath().insert_time)


def test_objects_without_thickness_or_bevel_stay_as_they_are():
    shape = Randomisation(**{name: (0.5, 0.9) for name in FACTORS})
    rng = np.random.default_rng(0)
    cylinder = Cylinder(0.02, 0.1)
    rest = (Physics(), ToolPath(), rng)
    assert shape.vary(cylinder, *rest)[0] is cylinder
    assert NOTHING.vary(PENTAGON, *rest)[0] is PENTAGON
    box = shape.vary(Box(0.1, 0.06, 0.04), *rest)[0]
    assert isinstance(box, Box)
    assert (box.width, box.depth) == (0.1, 0.06)
    assert 0.02 <= box.height <= 0.036
    sharp = shape.vary(Prism(PENTAGON.corners, 0.02, NO_BEVEL), *rest)[0]
    assert isinstance(sharp, Prism)
    assert sharp.bevel == NO_BEVEL


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("friction", (1.0, 0.5)),
        ("tool_friction", (0.0, 0.5)),
        ("density", (float("nan"), 900.0)),
        ("thickness_factor", (0.5, float("inf"))),
        ("insertion", (0.03, 0.01)),
        ("speed", (0.0, 1.0)),
        ("execution_ahead", 0.02),
        ("execution_left", -0.001),
        ("execution_turn", float("nan")),
    ],
)
def test_impossible_randomisations_are_refused(setting, value):
    with pytest.raises(SimulationError, match=f"randomisation: {setting} = "):
        Randomisation(**{setting: value})


def test_a_shape_that_cannot_be_is_refused_and_its_trial_named(tmp_path):
    flat = replace(PLAIN, randomisation=Randomisation(thickness_factor=(0.1, 0.1)))
    with pytest.raises(ShapeError, match="bevel of height"):
        simulate_trial(flat, 0)
    with pytest.raises(SimulationError, match="trial 0 cannot be simulated: bevel of height"):
        collect(flat, tmp_path, workers=1, console=Console(quiet=True))


# --- trials and data sets -------------------------------------------------------------------------------------


def test_objects_and_actions_are_those_of_the_plain_data_set():
    for id in (0, 17, 60):
        plain, varied = fake_trial(PLAIN, id), fake_trial(VARIED, id)
        np.testing.assert_array_equal(plain.object.corners, varied.object.corners)
        np.testing.assert_array_equal(plain.action.contact, varied.action.contact)
        assert plain.provenance.seed == varied.provenance.seed
        assert plain.execution_error == NO_OFFSET
        assert plain.physics == Physics()
        assert varied.physics != fake_trial(VARIED, id + 1).physics
        assert varied.physics == fake_trial(replace(VARIED, objects=16), id).physics
        assert varied.physics != fake_trial(replace(VARIED, seed=1), id).physics


def test_a_plain_trial_is_simulated_as_if_there_were_no_randomisation():
    obj, action, seed = trial(PLAIN, 11)
    alone = simulate_lever_up(obj, action, TOOL, seed=seed, id=11)
    found = simulate_trial(PLAIN, 11)
    for field in fields(found.effect):
        expected, value = getattr(alone.effect, field.name), getattr(found.effect, field.name)
        np.testing.assert_array_equal(value, expected, err_msg=field.name)


def test_what_was_drawn_is_recorded(varied):
    dataset = Dataset.open(varied)
    again = fake_trial(VARIED, 42)
    stored = dataset.with_id(42)
    assert stored.physics == again.physics
    assert stored.execution_error == again.execution_error != NO_OFFSET
    assert stored.object.to_dict() == again.object.to_dict()
    assert storage.read_manifest(varied)["configuration"]["randomisation"]["friction"] == [0.5, 1.1]
    numbers = dataset.table["object_id"].to_pylist()
    assert Counter(numbers) == {k: 2 * (3 + k) for k in range(8)}
    assert np.ptp(dataset.batch().parameters["friction"]) > 0.5


def test_describe_and_doctor_know_what_varies(varied, tmp_path, capsys):
    file = tmp_path / "figures.json"
    assert main(["data", str(varied), "--out", str(file)]) == 0
    assert "tool friction" in capsys.readouterr().out
    figures = json.loads(file.read_text())
    expected = {*storage.PHYSICS_COLUMNS[:3], "height", "bevel_width", "bevel_height", *LARGEST}
    assert figures["varies"].keys() == expected
    low, high = figures["varies"]["height"]
    assert 0.015 <= low < 0.016 < 0.024 < high <= 0.025
    assert examine(varied).findings == ()
    collect(
        replace(PLAIN, objects=1),
        tmp_path / "plain",
        workers=1,
        console=Console(quiet=True),
        simulate=fake_trial,
    )
    assert describe_dataset(Dataset.open(tmp_path / "plain")[:5])["varies"] == {}
    manifest = storage.read_manifest(varied)
    for name in manifest["shards"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((varied / name).read_bytes())
    manifest["configuration"]["randomisation"] |= {"friction": [0.5, 0.51], "execution_left": 1e-4}
    storage.write_manifest(tmp_path, manifest)
    problems = [finding.problem for finding in examine(tmp_path).findings]
    assert any("friction = " in p and "was not drawn from 0.5 to 0.51" in p for p in problems)
    assert any("execution_left = " in p and "from -0.0001 to 0.0001" in p for p in problems)


def test_a_plain_folder_is_not_gone_on_with_randomised(tmp_path):
    collect(replace(PLAIN, objects=1), tmp_path, workers=1, console=Console(quiet=True), simulate=fake_trial)
    with pytest.raises(
        DatasetError, match=r"begun with randomisation\.bevel_height_factor = None, asked for"
    ):
        collect(
            replace(VARIED, objects=1), tmp_path, workers=1, console=Console(quiet=True), simulate=fake_trial
        )


def test_simulate_randomise_from_the_command_line(tmp_path):
    out = tmp_path / "data"
    options = ["--objects", "1", "--contacts-per-edge", "1", "--embodiment", "tool", "--workers", "1"]
    assert main(["simulate", "--out", str(out), *options, "--randomise"]) == 0
    dataset = Dataset.open(out)
    assert len(set(dataset.table["friction"].to_pylist())) == len(dataset) == 3
    configuration = json.loads(json.dumps(asdict(RANDOMISED)))
    assert dataset.manifest["configuration"]["randomisation"] == configuration


def test_simulate_vary_action_from_the_command_line(tmp_path):
    options = ["--objects", "1", "--contacts-per-edge", "1", "--embodiment", "tool", "--workers", "1"]
    command = ["simulate", *options, "--vary-action"]
    assert main([*command, "--out", str(tmp_path / "action")]) == 0
    assert main([*command, "--out", str(tmp_path / "both"), "--randomise"]) == 0
    action, both = (Dataset.open(tmp_path / name) for name in ("action", "both"))
    assert {len(row.effect.times) for row in action} == {round(ToolPath().faster(2 / 3).duration / 0.05) + 1}
    assert [row.action.path for row in action] == [row.action.path for row in both]
    assert len({row.action.path for row in action}) == 3
    assert {row.physics for row in action} == {Physics()}
    assert len({row.physics for row in both}) == 3
    for row in action:
        path = row.action.path
        tip = row.effect.tool_trajectory[:, :3]
        np.testing.assert_allclose(tip[:, [0, 2]], path.at(row.effect.times)[:, :2], atol=1e-3)
    assert examine(tmp_path / "both").findings == ()
    assert describe_dataset(action)["varies"].keys() == set(VARIED_ACTION)


def test_a_path_that_cannot_be_is_refused_and_its_trial_named(tmp_path):
    deep = replace(PLAIN, randomisation=Randomisation(insertion=(0.2, 0.2)))
    with pytest.raises(
        SimulationError, match=r"trial 0 cannot be simulated: tool path: insertion = 0\.2 is outside"
    ):
        collect(deep, tmp_path, workers=1, console=Console(quiet=True))


@WITHOUT_BULLET
def test_the_manifest_names_the_engines_own_library(tmp_path):
    bullet = replace(PLAIN, simulation=SimulationConfig(engine="bullet", embodiment="tool"))
    for config, library, other in ((bullet, "pybullet", "mujoco"), (PLAIN, "mujoco", "pybullet")):
        folder = tmp_path / library
        collect(config, folder, workers=1, console=Console(quiet=True), simulate=fake_trial)
        versions = storage.read_manifest(folder)["versions"]
        assert library in versions
        assert other not in versions


# --- execution errors -----------------------------------------------------------------------------------------


def test_an_execution_error_is_recorded_in_the_commanded_frame():
    action = LeverUp.at_edge(PENTAGON, 1)
    error = ExecutionOffset(0.002, -0.003, 0.05)
    commanded = simulate_lever_up(PENTAGON, action, TOOL, execution_error=error)
    done = simulate_lever_up(PENTAGON, action.moved(0.002, -0.003, 0.05), TOOL)
    np.testing.assert_array_equal(commanded.view.mask, TopDownView.of(PENTAGON, action).mask)
    com = transform_points(action.T_action_object, PENTAGON.mass_properties(1.0).com[None])[0]
    np.testing.assert_allclose(commanded.effect.com_trajectory[0], com, atol=1e-4)
    # The same motion of the same object, seen from another frame.
    T_commanded_executed = action.T_action_object @ np.linalg.inv(done.action.T_action_object)
    for name in ("pose_trajectory", "tool_trajectory", "com_trajectory"):
        there = transform_points(T_commanded_executed, getattr(done.effect, name)[:, :3])
        np.testing.assert_allclose(getattr(commanded.effect, name)[:, :3], there, atol=1e-12)
    np.testing.assert_allclose(commanded.effect.tool_trajectory[0, :2], [-0.006, -0.003], atol=1e-3)
    corners = transform_points(
        action.T_action_object, np.column_stack([PENTAGON.support_corners, np.zeros(5)])
    )
    pair = corners[list(commanded.effect.support_corners), :2]
    np.testing.assert_allclose(commanded.effect.support_points, pair, atol=1e-12)
    assert commanded.effect.outcome == done.effect.outcome
    assert commanded.execution_error == error


def test_the_commanded_contact_must_lie_on_the_outline_however_the_blade_errs():
    with pytest.raises(ActionError, match="from the object's outline"):
        simulate_lever_up(
            PENTAGON, LeverUp((0.0, 0.0), (1.0, 0.0)), TOOL, execution_error=ExecutionOffset(0.001)
        )
