"""The twin: what it sees, what it simulates, and that it keeps the imaginers' contract."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from foretrace.actions import LeverUp, ToolPath
from foretrace.errors import PredictionError
from foretrace.geometry import transform_points
from foretrace.imagined import LEVELS
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.outline import count_contradictions, fit_outline
from foretrace.interactions.record import ExecutionOffset, Interaction, Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Bevel, Box, Cylinder, ObjectModel, Prism, Weighted, sample_dented, sample_prism
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.randomisation import Randomisation
from foretrace.trajectories import mean_distance
from foretrace.twin import TwinCalibration, TwinConfig, TwinImaginer, worlds
from foretrace.twin.gather import EDGES, gather
from foretrace.twin.outline import locate_object, match_corners, see_object
from foretrace.twin.worlds import MIRRORED, NAMES, Played, draw_shares

CONFIG = TwinConfig(worlds=8, workers=1)
TOOL = SimulationConfig(embodiment="tool")
PRISM = Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
OWN = LeverUp((0.0, 0.0), (1.0, 0.0))
"""The action of a view, in its frame."""
SAME = 2e-5
"""Contacts make this of the last bits of a pose that was worked out [m]."""
TOLD = {"friction": 0.8, "tool_friction": 0.3, "density": 600.0, "contact_error": 0.0}


def lever(obj: ObjectModel, edge: int = 2, config: SimulationConfig = TOOL, **path: float) -> Interaction:
    action = LeverUp.at_edge(obj, edge, 0.4, path=ToolPath.of(**path))
    return simulate_lever_up(obj, action, config)


@pytest.fixture(scope="module")
def made() -> list[Interaction]:
    """Lever-ups of polygons with the blade alone."""
    rng = np.random.default_rng(3)
    return [lever(sample_prism(rng, corners), edge) for corners in (3, 4, 6, 9) for edge in (0, 2)]


@pytest.fixture(scope="module")
def batch(made: list[Interaction]) -> InteractionBatch:
    return InteractionBatch.from_interactions(made)


def mirrored(batch: InteractionBatch) -> InteractionBatch:
    corners = batch.corners * [1.0, -1.0]
    for row, number in zip(corners, batch.num_corners, strict=True):
        row[:number] = row[:number][::-1].copy()
    return replace(
        batch,
        mask=batch.mask[:, :, ::-1].copy(),
        height=batch.height[:, :, ::-1].copy(),
        corners=corners,
        com=batch.com * [1.0, -1.0, 1.0],
    )


# --- what it sees -----------------------------------------------------------------------------------------


def test_corners_of_polygons_are_found_to_a_fraction_of_a_pixel():
    rng, apart = np.random.default_rng(0), []
    for _ in range(10):
        obj = sample_prism(rng, 5)
        action = LeverUp.at_edge(obj, 1)
        view = TopDownView.of(obj, action)
        T = action.T_action_object[:2]
        true = obj.corners @ T[:, :2].T + T[:, 3]
        found = fit_outline(view.mask)
        apart += np.linalg.norm(true[:, None] - found, axis=2).min(axis=1).tolist()
    assert np.median(apart) < 0.0008  # a quarter of a pixel


def test_an_outline_with_dents_is_followed_into_them():
    obj = sample_dented(np.random.default_rng(7))
    action = LeverUp.at_edge(obj, 3)
    view = TopDownView.of(obj, action)
    seen = see_object(view.mask, view.height)
    area, true = (np.abs(each._polygon.area) for each in (seen.model, obj))
    assert area == pytest.approx(true, rel=0.02)
    assert obj._polygon.convex_hull.area > 1.03 * true, "the shape has a dent"
    assert count_contradictions(fit_outline(view.mask), view.mask) <= 3


def test_a_lying_cylinder_is_told_from_a_box_by_its_heights():
    cylinder = Cylinder(0.021, 0.13)
    action = LeverUp.at_edge(cylinder, 0, 0.3)
    view = TopDownView.of(cylinder, action)
    seen = see_object(view.mask, view.height)
    assert isinstance(seen.model, Cylinder)
    assert seen.model.radius == pytest.approx(0.021, abs=1e-4)
    assert seen.model.length == pytest.approx(0.13, abs=0.0032)
    centre = transform_points(action.T_action_object, np.zeros((1, 3)))[0]
    assert seen.T_action_object[:2, 3] == pytest.approx(centre[:2], abs=0.0016)
    box = Box(0.13, 0.042, 0.042)
    flat = TopDownView.of(box, LeverUp.at_edge(box, 0, 0.3))
    found = see_object(flat.mask, flat.height).model
    assert type(found) is Prism
    assert found.height == pytest.approx(0.042, abs=1e-6)


def test_uneven_heights_are_pointed_out():
    view = TopDownView.of(PRISM, LeverUp.at_edge(PRISM, 0))
    height = view.height.copy()
    height[view.mask] *= np.linspace(0.4, 1.0, view.mask.sum())
    imagined = TwinImaginer(config=CONFIG).imagine(TopDownView(view.mask, height))
    assert any("flat top" in warning for warning in imagined.warnings)


def test_a_known_object_is_found_in_the_view():
    action = LeverUp.at_edge(PRISM, 1, 0.3)
    seen = locate_object(PRISM, TopDownView.of(PRISM, action).mask)
    assert np.abs(seen.T_action_object - action.T_action_object).max() < 0.0005
    other = Prism(0.5 * PRISM.corners)
    with pytest.raises(PredictionError, match="the known object fits"):
        locate_object(other, TopDownView.of(PRISM, action).mask)


def test_recorded_corners_tell_where_a_known_object_lies():
    action = LeverUp.at_edge(PRISM, 1, 0.3)
    T = action.T_action_object
    corners = transform_points(T, np.column_stack([PRISM.corners, np.zeros(5)]))[:, :2]
    seen = match_corners(PRISM, corners)
    assert seen is not None
    assert np.abs(seen.T_action_object - T).max() < 1e-12
    assert match_corners(PRISM, 1.01 * corners) is None


# --- what it simulates ------------------------------------------------------------------------------------


def test_a_world_is_the_simulation_itself(made):
    player = worlds.Player("mujoco", "tool", 0.002, 0.05, made[0].action.duration)
    for interaction in made:
        action = interaction.action
        played = worlds.play(
            player, worlds.World(interaction.object, action.T_action_object, action, Physics())
        )
        assert (played.com == interaction.effect.com_trajectory).all()
        assert played.outcome == interaction.effect.outcome
        assert played.support_points == pytest.approx(interaction.effect.support_points, nan_ok=True)


def test_an_execution_error_moves_the_blade_and_not_the_frame():
    action, error = LeverUp.at_edge(PRISM, 2, 0.4), ExecutionOffset(0.002, -0.001, 0.03)
    wanted = simulate_lever_up(PRISM, action, TOOL, execution_error=error).effect
    player = worlds.Player("mujoco", "tool", 0.002, 0.05, action.duration)
    world = worlds.World(PRISM, action.T_action_object, action, Physics(), error)
    played = worlds.play(player, world)
    assert np.abs(played.com - wanted.com_trajectory).max() < SAME
    assert played.support_points == pytest.approx(wanted.support_points, abs=SAME)
    undisturbed = worlds.play(player, replace(world, offset=ExecutionOffset()))
    assert np.abs(played.com - undisturbed.com).max() > 1e-4


def test_told_everything_and_the_object_it_is_the_simulation_itself(batch, made):
    off = []
    for row, interaction in enumerate(made):
        twin = TwinImaginer(config=CONFIG, object=interaction.object)
        imagined = twin.imagine_batch(batch[row])
        off.append(np.abs(imagined.com[0] - batch.com[row]).max())
        turned = np.abs((imagined.pose[0, :, 3:] * imagined.pose[0, :1, 3:]).sum(axis=1))
        own = interaction.effect.pose_trajectory[:, 3:]
        assert turned == pytest.approx(np.abs((own * own[0]).sum(axis=1)), abs=2e-4)
        assert imagined.futures.outcomes()[str(interaction.effect.outcome)][0] == 1.0
    # The last bits are each processor's own, and one of these lever-ups is sensitive to them.
    assert np.median(off) < SAME / 4
    assert max(off) < 2 * SAME


def test_the_arm_gives_way_as_the_recorded_one():
    config = SimulationConfig()
    record = InteractionBatch.from_interactions([lever(PRISM, 1, config)])
    arm, blade = (
        TwinImaginer(config=replace(CONFIG, embodiment=name), object=PRISM).imagine_batch(record).com
        for name in ("arm", "tool")
    )
    assert np.abs(arm - record.com).max() < SAME < 5 * SAME < np.abs(blade - record.com).max()


def test_from_a_view_alone_it_errs_by_less_than_a_millimetre(batch):
    imagined = TwinImaginer(config=CONFIG).imagine_batch(batch)
    truth = np.where(np.arange(60)[:, None] < batch.length[:, None, None], batch.com, np.nan)
    errors = np.asarray(mean_distance(imagined.com, truth))
    assert np.median(errors) < 0.0005
    best = np.array(imagined.futures.outcome)[imagined.futures.probability.argmax(axis=1)]
    assert (best == batch.outcome).all()


def test_path_and_constants_are_those_that_are_told():
    interaction = lever(
        PRISM, 1, replace(TOOL, physics=Physics(friction=0.5, density=900.0)), sweep=0.5, speed=1.2
    )
    record = InteractionBatch.from_interactions([interaction])
    twin = TwinImaginer(config=CONFIG, object=PRISM)
    count = len(interaction.effect.times)
    assert np.abs(twin.imagine_batch(record).com[0, :count] - record.com[0]).max() < SAME
    told = {**TOLD, "friction": 0.5, "density": 900.0}
    by_action = twin.imagine(interaction.view, interaction.action, context=told, com=record.com[0, 0])
    assert np.abs(by_action.com_trajectory[:count] - record.com[0]).max() < 0.002
    nominal = twin.imagine(interaction.view, OWN, context=told)
    assert np.abs(by_action.com_trajectory - nominal.com_trajectory).max() > 0.005


def test_a_told_bevel_is_that_of_the_object():
    sharp = Prism(PRISM.corners, PRISM.height, Bevel(0.009, 0.0024))
    action = LeverUp.at_edge(sharp, 2, 0.4)
    batch = InteractionBatch.from_interactions(
        [lever(sharp), lever(PRISM), lever(Weighted(sharp, (0.01, 0.0)))]
    )
    np.testing.assert_allclose(batch.bevel, [[0.009, 0.0024], [0.009, 0.003], [0.009, 0.0024]])
    twin, nominal = TwinImaginer(config=CONFIG), TOLD | {"bevel_width": 0.009, "bevel_height": 0.003}
    view = TopDownView(batch.mask[0], batch.height[0])
    alone = twin.imagine(view, action, context=nominal | {"bevel_height": 0.0024})
    assert alone.futures.probability.max() == 1.0  # simulated once
    off = mean_distance(twin.imagine_batch(batch).com, batch.com)
    without = mean_distance(
        twin.imagine_batch(replace(batch, bevel=np.full((3, 2), [0.009, 0.003]))).com, batch.com
    )
    assert off.max() < 0.5 * without[0]
    spread = twin.imagine(view, action, context=TOLD).futures.spread
    assert np.nanmax(spread) > 0.0005  # where it is not told, it varies
    assert np.isnan(alone.futures.spread).all()
    wide, narrow = (twin.imagine(view, action, context=TOLD | {"bevel_width": w}) for w in (0.012, 0.007))
    assert np.abs(wide.com_trajectory - narrow.com_trajectory).max() > 1e-4
    high = twin.imagine(view, action, context=nominal | {"bevel_height": 0.03})
    assert any("a bevel of 9 x 30 mm does not fit the object" in line for line in high.warnings)
    with pytest.raises(PredictionError, match=r"context bevel_width is 0\.5: give a value from 0 to 0\.1"):
        twin.imagine(view, action, context=nominal | {"bevel_width": 0.5})


def test_a_centre_of_mass_off_the_middle_is_taken_as_it_is():
    heavy = Weighted(PRISM, [0.015, -0.01])
    record = InteractionBatch.from_interactions([lever(heavy, 1)])
    found, even = TwinImaginer(config=CONFIG), TwinImaginer(config=CONFIG, object=PRISM)
    truth = np.where(np.arange(60)[:, None] < record.length[:, None, None], record.com, np.nan)
    errors = [float(mean_distance(each.imagine_batch(record).com, truth)[0]) for each in (found, even)]
    assert errors[0] < 0.002 < errors[1]


def test_candidates_are_played_one_by_one():
    twin = TwinImaginer(config=CONFIG)
    own = LeverUp.at_edge(PRISM, 0)
    T = own.T_action_object
    seen = TopDownView.of(PRISM, own)
    actions = []
    for edge in (0, 2, 3):
        action = LeverUp.at_edge(PRISM, edge)
        point = transform_points(T, np.array([[*action.contact, 0.0]]))[0, :2]
        actions.append(LeverUp(point, T[:2, :2] @ action.direction))
    many = twin.imagine_candidates(seen, actions)
    for row, edge in enumerate((0, 2, 3)):
        alone = twin.imagine(TopDownView.of(PRISM, LeverUp.at_edge(PRISM, edge)))
        assert np.abs(many.com[row] - alone.com_trajectory).max() < 0.003
        assert many[row].futures.outcomes() == alone.futures.outcomes()


# --- many worlds ------------------------------------------------------------------------------------------


def test_what_is_not_told_is_spread_over_futures(batch):
    imagined = TwinImaginer(config=CONFIG).imagine_batch(batch, context="unknown")
    futures = imagined.futures
    assert futures.probability.sum(axis=1) == pytest.approx(1.0)
    assert (futures.probability >= 0).all()
    assert len(futures.outcome) == EDGES * len(LeverUp.outcomes)
    assert imagined.com.shape == (len(batch), 60, 3)
    assert (imagined.com[:, 0] == batch.com[:, 0]).all()
    assert (futures.states[:, :, 0, :3] == batch.com[:, None, 0]).all()
    assert np.isfinite(futures.states).all()
    assert (futures.spread[:, :, 0] < 1e-12).all()
    assert (futures.spread.max(axis=(1, 2)) > 0.001).all()


def test_futures_cover_a_constant_unless_it_is_told():
    record = InteractionBatch.from_interactions([lever(PRISM, 1)])
    config = replace(CONFIG, ranges=Randomisation(friction=(0.5, 1.1)), outline_noise=0.0)
    twin = TwinImaginer(config=config)
    told, hidden = {"friction": 0.8}, {"density": 600.0}
    some, none = (twin.imagine_batch(record, context=each).futures.spread[0, 0] for each in (told, hidden))
    assert some.max() < 1e-9
    assert none.max() > 1e-4
    assert np.isnan(twin.imagine_batch(record).futures.spread).all()


def test_the_same_seed_gives_the_same_futures_and_another_one_others(batch):
    first, again, other = (
        TwinImaginer(config=replace(CONFIG, seed=seed))
        .imagine_batch(batch[:1], context="unknown")
        .futures.states
        for seed in (1, 1, 2)
    )
    assert (first == again).all()
    assert np.abs(first - other).max() > 1e-4


def test_many_worlds_among_processes_are_the_same(batch, monkeypatch):
    monkeypatch.setattr(worlds, "MANY", 8)
    here, there = (
        TwinImaginer(config=replace(CONFIG, workers=workers))
        .imagine_batch(batch[:2], context="unknown")
        .futures
        for workers in (1, 2)
    )
    assert (here.states == there.states).all()
    assert (here.probability == there.probability).all()


@pytest.mark.parametrize("nothing", [False, True], ids=["told", "not told"])
def test_mirror_images_have_mirrored_futures(batch, nothing):
    twin, image = TwinImaginer(config=CONFIG), mirrored(batch)
    one, other = (twin.imagine_batch(each, context="unknown" if nothing else None) for each in (batch, image))
    apart = np.linalg.norm(one.com - other.com * [1.0, -1.0, 1.0], axis=2).mean(axis=1)
    assert np.median(apart) < 0.0002
    assert np.abs(one.futures.probability - other.futures.probability).max() <= 0.25


def test_draws_come_in_mirrored_pairs_and_fill_the_ranges():
    shares = draw_shares(64, 0)
    assert shares.shape == (64, len(NAMES))
    assert ((shares >= 0) & (shares <= 1)).all()
    sides = np.isin(NAMES, MIRRORED)
    assert (shares[::2][:, ~sides] == shares[1::2][:, ~sides]).all()
    assert shares[::2][:, sides] + shares[1::2][:, sides] == pytest.approx(1.0)
    # Quasi-random: each half of a range holds half of the worlds.
    assert (np.abs((shares < 0.5).mean(axis=0) - 0.5) < 1e-9).all()


def test_only_what_is_not_told_varies():
    model = Prism(PRISM.corners)
    world = worlds.World(model, np.eye(4), LeverUp((0.0, 0.0), (1.0, 0.0)), Physics(friction=0.6))
    shares = draw_shares(8, 0)
    told = ("friction", "contact_error", "thickness_factor")
    drawn = [worlds.vary(world, told, TwinConfig().ranges, 0.0, each) for each in shares]
    assert {each.physics.friction for each in drawn} == {0.6}
    assert {each.offset for each in drawn} == {ExecutionOffset()}
    assert {each.model.height for each in drawn} == {model.height}
    assert (
        len({each.physics.density for each in drawn})
        == len({each.physics.tool_friction for each in drawn})
        == 4
    )
    assert all(0.2 <= each.physics.tool_friction <= 0.45 for each in drawn)
    free = [worlds.vary(world, (), TwinConfig().ranges, 0.001, each) for each in shares]
    assert len({each.offset for each in free}) == 8
    moved = [np.linalg.norm(each.model.corners - model.corners, axis=1) for each in free]
    assert 0.0002 < np.sqrt(np.mean(np.square(moved))) < 0.002


def test_futures_are_grouped_by_outcome_and_pivot_edge():
    time = 5
    rest = np.array([0.05, 0.0, 0.01])

    def motion(outcome: str, x: float, rise: float) -> Played:
        com = rest + np.outer(np.linspace(0, rise, time), [0.0, 0.0, 1.0])
        return Played(com, np.zeros((time, 3)), outcome, np.array([[x, -0.02], [x, 0.02]]))

    played = [motion("levered", 0.10, 0.02)] * 2 + [
        motion("levered", 0.13, 0.04),
        motion("levered", 0.101, 0.02),
    ]
    played += [motion("slipped", 0.10, 0.01)]
    found = gather(played, rest)
    assert found.probability[:EDGES].tolist() == [0.6, 0.2]
    assert found.probability.sum() == pytest.approx(1.0)
    assert found.states[0, -1, 2] == pytest.approx(0.03)
    assert found.states[1, -1, 2] == pytest.approx(0.05)
    assert found.support_points[1, :, 0] == pytest.approx(0.13)
    beside = gather(played[:1], rest + np.array([0.0, 0.01, 0.0]))
    assert beside.states[0, :, 1] == pytest.approx(0.01)


# --- how far it is off ------------------------------------------------------------------------------------


def test_calibrated_regions_hold_what_they_were_calibrated_on(batch, tmp_path):
    twin = TwinImaginer(config=CONFIG)
    assert np.isnan(twin.imagine_batch(batch[:1]).futures.spread).all()
    found = twin.calibrate(batch)
    futures = twin.imagine_batch(batch).futures
    radius = futures.radius(0.5)
    apart = np.linalg.norm(futures.com - batch.com[:, None], axis=-1)
    valid = np.arange(60) < batch.length[:, None, None]
    held = ((apart <= radius) | ~valid).all(axis=2).any(axis=1)
    assert len(batch) / 2 <= held.sum() < len(batch)
    found.save(tmp_path / "calibration.json")
    again = TwinImaginer(config=CONFIG, calibration=tmp_path / "calibration.json")
    assert again.imagine_batch(batch).futures.radius(0.5) == pytest.approx(radius, abs=1e-8, nan_ok=True)
    assert np.isinf(again.calibration.quantiles[-1])
    assert len(found.quantiles) == len(LEVELS)


@pytest.mark.parametrize("change", [{"version": 99}, {"error": [1.0]}, {"error": ["x"]}, {"format": "other"}])
def test_a_damaged_calibration_is_refused(change, tmp_path, batch):
    file = tmp_path / "calibration.json"
    TwinCalibration(3, np.arange(3) / 20, np.zeros(3), np.ones(len(LEVELS))).save(file)
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(PredictionError, match=r"calibration\.json"):
        TwinImaginer(calibration=file)


# --- what it refuses --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TwinImaginer(engine="ode"), "ode"),
        (lambda: TwinImaginer(engine="bullet", config=TwinConfig(embodiment="arm")), "embodiment"),
        (lambda: TwinImaginer(engine=3), "engine of type int"),
        (lambda: TwinImaginer(config="fast"), "config of type str"),
        (lambda: TwinImaginer(object=[(0, 0)]), "object of type list"),
        (lambda: TwinImaginer(calibration="nowhere.json"), "nowhere.json"),
        (lambda: TwinConfig(worlds=7), "even number"),
        (lambda: TwinConfig(worlds=0), "worlds is 0"),
        (lambda: TwinConfig(outline_noise=1.0), "outline_noise"),
        (lambda: TwinConfig(timestep=float("nan")), "timestep"),
        (lambda: TwinConfig(workers=0), "workers is 0"),
        (lambda: TwinConfig(seed=-1), "seed is -1"),
        (lambda: TwinConfig(sees_height="no"), "sees_height"),
        (lambda: TwinImaginer(config=TwinConfig(timestep=0.0013)), "timestep"),
    ],
)
def test_what_cannot_be_simulated_is_refused_in_a_line(make, message, untyped):
    with pytest.raises(PredictionError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_it_does_without_torch():
    code = "import foretrace, sys; foretrace.TwinImaginer(); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
