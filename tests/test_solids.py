"""Boxes and lying cylinders: what they are, that they look alike from above, and that they move differently."""

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from foretrace.actions import LeverUp, ToolPath
from foretrace.errors import ShapeError, SimulationError
from foretrace.geometry import quaternion_to_matrix, tilt
from foretrace.interactions.record import Effect, Outcome, Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import (
    BEVEL,
    NO_BEVEL,
    Box,
    Cylinder,
    CylinderShape,
    HullShape,
    ObjectModel,
    Prism,
    look_alikes,
    object_from_dict,
    sample_box,
    sample_cylinder,
    sample_look_alikes,
)
from foretrace.objects.model import convex_mass_properties
from foretrace.simulation.camera import RgbdConfig, take_rgbd
from foretrace.simulation.engine import Motion
from foretrace.simulation.lever_up import SimulationConfig, effect_of, simulate_lever_up

WATCHED = SimulationConfig(embodiment="tool", watch_time=1.5)
RADIUS, LENGTH = 0.025, 0.12
CYLINDER, BOX, FLAT = look_alikes(Cylinder(RADIUS, LENGTH))
SIDE, END = 0, 1
"""Edges: a long side and an end."""
GRAVITY = 9.81
seeds = st.integers(0, 2**32 - 1)


def play(obj: ObjectModel, edge: int, fraction: float = 0.5, config: SimulationConfig = WATCHED) -> Effect:
    return simulate_lever_up(obj, LeverUp.at_edge(obj, edge, fraction), config).effect


def tilt_of(effect: Effect) -> np.ndarray:
    return np.rad2deg(tilt(quaternion_to_matrix(effect.pose_trajectory[:, 3:])))


# --- what they are ----------------------------------------------------------------------------------------


def test_a_cylinders_mass_properties_are_those_of_a_fine_polygonal_bar():
    cylinder = Cylinder(0.03, 0.14)
    exact, bar = cylinder.mass_properties(700.0), convex_mass_properties(cylinder.convex_pieces(), 700.0)
    assert exact.mass == pytest.approx(700 * np.pi * 0.03**2 * 0.14)
    np.testing.assert_allclose(exact.com, bar.com, atol=1e-12)
    np.testing.assert_allclose(exact.inertia, bar.inertia, rtol=0.004, atol=1e-12)
    assert bar.mass < exact.mass < 1.002 * bar.mass


def test_a_sharp_boxes_mass_properties():
    w, d, h = 0.14, 0.06, 0.05
    properties = Box(w, d, h, NO_BEVEL).mass_properties(600.0)
    assert properties.mass == pytest.approx(600 * w * d * h)
    np.testing.assert_allclose(properties.com, [0, 0, h / 2], atol=1e-15)
    inertia = properties.mass / 12 * np.diag([d**2 + h**2, w**2 + h**2, w**2 + d**2])
    np.testing.assert_allclose(properties.inertia, inertia, rtol=1e-9, atol=1e-15)


def test_a_bevelled_box_is_one_convex_piece():
    box = Box(0.14, 0.06, 0.05)
    assert box.bevel == BEVEL
    (piece,) = box.convex_pieces()
    w, d, b = 0.14, 0.06, BEVEL.width
    foot = (w - 2 * b) * (d - 2 * b)
    middle = (w - b) * (d - b)
    rim = BEVEL.height / 6 * (foot + 4 * middle + w * d)  # Simpson's rule is exact for a frustum
    assert ConvexHull(piece).volume == pytest.approx(w * d * (0.05 - BEVEL.height) + rim)
    np.testing.assert_allclose(np.abs(box.support_corners), [[w / 2 - b, d / 2 - b]] * 4)
    assert box.mass_properties(1.0).com[2] > 0.025


def test_engines_are_given_a_true_cylinder_and_hulls():
    (shape,) = Cylinder(0.03, 0.1).collision_shapes()
    assert isinstance(shape, CylinderShape)
    assert (shape.radius, shape.length) == (0.03, 0.1)
    np.testing.assert_allclose(shape.T_object_shape @ [0, 0, 0.05, 1], [0.05, 0, 0.03, 1])
    assert np.linalg.det(shape.T_object_shape) == pytest.approx(1.0)
    (hull,) = Box(0.1, 0.06, 0.06).collision_shapes()
    assert isinstance(hull, HullShape)
    assert Cylinder(0.03, 0.1).is_round
    assert not Box(0.1, 0.06, 0.06).is_round


def test_a_cylinders_height_is_its_curved_surface():
    cylinder = Cylinder(0.03, 0.1)
    points = np.array([[0.0, 0.0], [0.05, 0.0], [0.0, 0.018], [-0.04, -0.024], [0.0, 0.0301], [0.051, 0.0]])
    np.testing.assert_allclose(cylinder.height_at(points), [0.06, 0.06, 0.054, 0.048, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(cylinder.support_corners[:, 1], 0)
    np.testing.assert_array_equal(cylinder.support_corners[:, 0], [-0.05, 0.05, 0.05, -0.05])


@settings(max_examples=30)
@given(seeds, st.integers(0, 3), st.floats(0.01, 0.99))
def test_look_alikes_have_one_mask_and_different_heights(seed, edge, fraction):
    cylinder, box, flat = sample_look_alikes(np.random.default_rng(seed))
    actions = [LeverUp.at_edge(obj, edge, fraction) for obj in (cylinder, box, flat)]
    views = [TopDownView.of(obj, actions[0]) for obj in (cylinder, box, flat)]
    for action, view in zip(actions, views, strict=True):
        np.testing.assert_array_equal(action.contact, actions[0].contact)
        np.testing.assert_array_equal(view.mask, views[0].mask)
    assert views[0].mask.sum() > 30
    assert views[1].height.max() == pytest.approx(2 * cylinder.radius)
    assert views[0].height.max() == pytest.approx(2 * cylinder.radius, rel=0.02)
    # On average over its width a circle's upper half is (1 + pi / 4) / 2 of the box's height.
    mean = views[0].height[views[0].mask].mean() / box.height
    assert mean == pytest.approx((1 + np.pi / 4) / 2, abs=0.05)
    assert views[2].height.max() < 0.9 * views[0].height.max()


@pytest.mark.parametrize("sample", [sample_box, sample_cylinder])
def test_samples_are_of_many_sizes_and_reproducible(sample: Callable):
    made = [sample(np.random.default_rng(k)) for k in range(60)]
    assert sample(np.random.default_rng(7)).to_dict() == made[7].to_dict()
    sides = np.array([np.ptp(obj.corners, axis=0) for obj in made])
    assert (sides[:, 0] >= 1.2 * sides[:, 1]).all()
    assert sides.min() >= 0.024
    assert sides.max() <= 0.2
    heights = [obj.height for obj in made]
    assert max(heights) > 2 * min(heights)


@pytest.mark.parametrize("obj", [CYLINDER, BOX, Box(0.1, 0.05, 0.04, NO_BEVEL)])
def test_solids_survive_json_to_the_last_digit(obj: ObjectModel):
    again = object_from_dict(json.loads(json.dumps(obj.to_dict())))
    assert type(again) is type(obj)
    assert again.to_dict() == obj.to_dict()
    np.testing.assert_array_equal(again.convex_pieces()[0], obj.convex_pieces()[0])


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda: Cylinder(0.0, 0.1), "cylinder of radius 0.0: give a positive length in metres"),
        (lambda: Cylinder(0.02, np.nan), "cylinder of length nan"),
        (lambda: Cylinder(30.0, 120.0), "size 134.2 m: .* check unit"),
        (lambda: Box(0.1, -0.05, 0.05), "box of depth -0.05"),
        (lambda: Box(0.1, 0.05, 2.0), "height 2 m"),
        (lambda: Box(0.1, 0.012, 0.05, BEVEL), "leaves no bottom face"),
        (lambda: object_from_dict({"kind": "cylinder", "radius": 0.02}), "cylinder is not usable"),
        (lambda: object_from_dict({"kind": "ball"}), "available: .*cylinder"),
    ],
)
def test_bad_solids_are_refused(make: Callable, fault: str):
    with pytest.raises(ShapeError, match=fault) as caught:
        make()
    assert "\n" not in str(caught.value)


# --- what they do -----------------------------------------------------------------------------------------


def test_a_cylinder_levered_at_its_side_rolls_away_without_slipping():
    effect = play(CYLINDER, SIDE)
    assert effect.outcome == Outcome.ROLLED
    assert effect.slip_index is effect.fall_index is None
    assert effect.support_corners == ()
    assert np.isnan(effect.support_points).all()
    com = effect.com_trajectory
    assert com[-1, 0] - com[0, 0] > LENGTH
    np.testing.assert_allclose(com[:, 2], RADIUS, rtol=0.02)
    R = quaternion_to_matrix(effect.pose_trajectory[:, 3:])
    turn = R[1:] @ R[:-1].swapaxes(1, 2)
    spin = np.arctan2(turn[:, 0, 2], turn[:, 0, 0]) / 0.05
    speed = np.diff(com[:, 0]) / 0.05
    rolling = slice(20, None)  # the blade has let go
    assert speed[rolling].max() > 0.05
    np.testing.assert_allclose(spin[rolling] * RADIUS, speed[rolling], atol=0.001)
    # Coulomb's rolling resistance: a = (2 / 3) g b / r for a full cylinder, while it is fast.
    fast = np.flatnonzero(speed > 0.05)[-1]
    slowing = (speed[20] - speed[fast]) / (0.05 * (fast - 20))
    assert slowing == pytest.approx(2 / 3 * GRAVITY * Physics().rolling_friction / RADIUS, rel=0.1)


def test_rolling_friction_stops_it_sooner():
    rough = replace(WATCHED, physics=Physics(rolling_friction=5e-4))
    far, near = (play(CYLINDER, SIDE, config=c).com_trajectory[-1, 0] for c in (WATCHED, rough))
    assert near < 0.6 * far


def test_a_box_levered_at_its_side_tumbles_over_its_far_edge():
    effect = play(BOX, SIDE)
    assert effect.outcome == Outcome.TUMBLED
    assert effect.slip_index is None
    assert effect.support_corners == (2, 3)
    np.testing.assert_allclose(effect.support_points[:, 0], 2 * RADIUS - BOX.bevel.width, atol=1e-3)
    assert tilt_of(effect)[-1] == pytest.approx(90, abs=1.5)
    # It comes to lie on its far side.
    assert effect.com_trajectory[-1, 2] == pytest.approx(RADIUS, abs=1e-3)
    assert effect.com_trajectory[:, 2].max() > 1.2 * RADIUS
    assert effect.com_trajectory[-1, 0] > 2 * RADIUS


def test_a_box_levered_at_its_end_is_lifted_about_the_other_end():
    effect = play(BOX, END)
    assert effect.outcome == Outcome.LEVERED
    assert effect.support_corners == (0, 3)
    assert 20 < tilt_of(effect)[-1] < 80
    assert effect.com_trajectory[-1, 2] > 1.5 * RADIUS


def test_same_picture_three_fates():
    outcomes = [play(obj, SIDE, 0.4).outcome for obj in (CYLINDER, BOX, FLAT)]
    assert outcomes == [Outcome.ROLLED, Outcome.TUMBLED, Outcome.SLIPPED]


@pytest.mark.parametrize("table_edge", [None, 0.3])
@pytest.mark.parametrize("obj", [CYLINDER, BOX], ids=["cylinder", "box"])
def test_left_alone_they_rest(obj: ObjectModel, table_edge: float | None):
    still = ToolPath(insertion=0.0, sweep=0.0)
    config = replace(WATCHED, physics=Physics(table_edge=table_edge))
    effect = simulate_lever_up(obj, LeverUp.at_edge(obj, SIDE, path=still), config).effect
    assert effect.outcome == Outcome.MISSED
    assert len(effect.times) == 90
    assert np.abs(effect.com_trajectory - effect.com_trajectory[0]).max() < 3e-4
    assert np.abs(np.diff(effect.com_trajectory[20:], axis=0)).max() < 5e-6


@pytest.mark.parametrize(
    ("obj", "edge"), [(CYLINDER, SIDE), (BOX, SIDE), (BOX, END)], ids=["cylinder", "box", "end"]
)
def test_the_mirrored_lever_up_has_the_mirrored_effect(obj: ObjectModel, edge: int):
    one, other = play(obj, edge, 0.3), play(obj, edge, 0.7)
    assert one.outcome is other.outcome
    np.testing.assert_allclose(one.com_trajectory, other.com_trajectory * [1, -1, 1], atol=3e-3)
    assert np.abs(one.com_trajectory[:, 1]).max() > 5e-3 or edge == END


def test_a_cylinder_rolls_off_a_short_table_and_the_record_ends_above_the_floor():
    edge = 0.12
    effect = play(CYLINDER, SIDE, config=replace(WATCHED, physics=Physics(table_edge=edge)))
    whole = play(CYLINDER, SIDE)
    assert effect.outcome == Outcome.ROLLED
    k = effect.fall_index
    assert k is not None
    com = effect.com_trajectory
    assert com[k, 0] > edge
    assert (com[:k, 2] > 0).all()
    assert (np.diff(com[k:, 2]) < 0).all()
    assert -0.5 < com[-1, 2] < -0.2
    assert len(effect.times) == len(effect.pose_trajectory) == len(effect.tool_trajectory) < len(whole.times)
    before = com[: k - 1, 0] < edge - RADIUS  # on the board it rolls as on the endless table
    np.testing.assert_allclose(com[: k - 1][before], whole.com_trajectory[: k - 1][before], atol=2e-3)


def test_an_edge_out_of_reach_changes_nothing():
    near, far = play(BOX, SIDE), play(BOX, SIDE, config=replace(WATCHED, physics=Physics(table_edge=0.8)))
    assert far.outcome is near.outcome
    assert far.fall_index is None
    np.testing.assert_allclose(far.com_trajectory, near.com_trajectory, atol=2e-3)


def test_watching_on_only_adds_samples():
    short, long = play(BOX, END, config=replace(WATCHED, watch_time=0.0)), play(BOX, END)
    assert (len(short.times), len(long.times)) == (60, 90)
    np.testing.assert_array_equal(long.pose_trajectory[:60], short.pose_trajectory)


# --- how it is judged: constructed motions ----------------------------------------------------------------


def motion_of(turns_deg: list[float], com: np.ndarray, on_blade: str, height: float = RADIUS) -> Motion:
    """An object turned about the y axis, its centre of mass on a given path."""
    half = np.deg2rad(turns_deg) / 2
    pose = np.zeros((len(half), 7))
    pose[:, 3], pose[:, 5] = np.cos(half), np.sin(half)
    pose[:, :3] = com - quaternion_to_matrix(pose[:, 3:]) @ [0, 0, height]
    touches = np.array([c == "1" for c in on_blade])
    contacts = (np.zeros((0, 3)),) * len(half)
    return Motion(
        np.arange(len(half)) * 0.05, pose, pose, np.empty((len(half), 0)), touches, contacts, 0.0, False
    )


@pytest.mark.parametrize(
    ("turns", "rises", "touches", "outcome", "slip"),
    [
        ([0, 10, 40, 70, 100, 130], [0] * 6, "110000", Outcome.ROLLED, None),
        ([0, 170, 190, 350, 370, 400], [0] * 6, "000000", Outcome.ROLLED, None),
        ([0, 2, 5, 8, 12, 20], [0] * 6, "111110", Outcome.MISSED, None),
        ([0, 0, 0, 0, 0, 0], [0] * 6, "111111", Outcome.MISSED, None),
        ([0, 4, 8, 12, 16, 20], [0, 0.1, 0.3, 0.5, 0.7, 0.9], "111111", Outcome.LEVERED, None),
        ([0, 4, 8, 12, 5, 0], [0, 0.1, 0.3, 0.5, 0.2, 0], "111100", Outcome.SLIPPED, 4),
        ([0, 20, 45, 70, 95, 90], [0, 0.2, 0.3, 0.2, 0.1, 0], "111000", Outcome.TUMBLED, None),
        ([0, 20, 45, 70, 88, 88], [0, 0.2, 0.3, 0.2, 0, 0], "111000", Outcome.TUMBLED, None),
    ],
)
def test_outcomes_of_a_cylinder(turns, rises, touches, outcome, slip):
    com = np.column_stack([np.linspace(0, 0.05, 6), np.zeros(6), RADIUS * (1 + np.array(rises))])
    effect = effect_of(motion_of(turns, com, touches), CYLINDER, LeverUp.at_edge(CYLINDER, SIDE), Physics())
    assert effect.outcome == outcome
    assert effect.slip_index == slip


def test_spinning_flat_on_the_table_is_no_rolling():
    angle = np.deg2rad(np.arange(6) * 30.0) / 2
    pose = np.zeros((6, 7))
    pose[:, 3], pose[:, 6] = np.cos(angle), np.sin(angle)
    motion = replace(motion_of([0] * 6, np.tile([0, 0, RADIUS], (6, 1)), "111111"), object_pose=pose)
    assert effect_of(motion, CYLINDER, LeverUp.at_edge(CYLINDER, SIDE), Physics()).outcome == Outcome.MISSED


@pytest.mark.parametrize(
    ("depths", "kept"), [([0, -0.1, -0.4, -0.6, -0.7], 3), ([0, 0.0, 0.0, -0.1, -0.4], 5)]
)
def test_a_fall_is_noticed_and_the_record_cut(depths, kept):
    com = np.column_stack([np.arange(5) * 0.1, np.zeros(5), RADIUS + np.array(depths)])
    motion = motion_of([0, 60, 120, 180, 240], com, "00000")
    action = LeverUp.at_edge(CYLINDER, SIDE)
    effect = effect_of(motion, CYLINDER, action, Physics(table_edge=0.1))
    assert effect.fall_index == next(k for k, depth in enumerate(depths) if depth < -RADIUS)
    assert len(effect.times) == len(effect.com_trajectory) == len(effect.joint_trajectory) == kept
    assert effect_of(motion, CYLINDER, action, Physics()).fall_index is None  # nowhere to fall from


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"watch_time": -1.0}, "watch_time = -1.0 is outside 0 to 60"),
        ({"physics": Physics(table_edge=0.0)}, "table_edge = 0.0 m: give a distance"),
        ({"physics": Physics(density=1e30)}, "density = 1e\\+30 is outside 1 to 100000"),
        ({"physics": Physics(density=float("nan"))}, "density = nan is outside"),
        ({"physics": Physics(friction=-0.1)}, "friction = -0.1 is outside 0 to 10"),
        ({"physics": Physics(tool_friction=1e9)}, "tool_friction = 1000000000.0 is outside 0 to 10"),
        ({"physics": Physics(rolling_friction=1.0)}, "rolling_friction = 1.0 is outside .* lever arm"),
    ],
)
def test_impossible_settings_are_refused(wrong, message):
    with pytest.raises(SimulationError, match=message):
        SimulationConfig(**wrong)


# --- how it is seen ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("obj", [CYLINDER, BOX], ids=["cylinder", "box"])
def test_the_height_map_is_that_of_a_rendered_depth_image(obj: ObjectModel):
    action = LeverUp.at_edge(obj, SIDE, 0.4)
    try:
        # Straight above the object, so that no wall hides behind its upper rim.
        frame = take_rgbd(obj, action, RgbdConfig(position=(RADIUS, 0.0, 0.75), noise=0.0))
    except SimulationError as error:
        pytest.skip(str(error))
    rendered, exact = frame.view(), TopDownView.of(obj, action)
    assert (rendered.mask ^ exact.mask).sum() < 0.5 * np.count_nonzero(
        np.diff(exact.mask.astype(int)) != 0
    ) + 40
    inner = exact.height > 0.6 * obj.height  # away from where a pixel holds the rim
    inner &= rendered.mask
    assert inner.sum() > 300
    error = np.abs(rendered.height - exact.height)[inner]
    assert np.median(error) < 0.5e-3
    assert np.quantile(error, 0.9) < 1.5e-3
    crest = rendered.height[rendered.mask].max()
    assert crest == pytest.approx(obj.height, abs=1e-3)


def test_a_flat_prism_of_the_same_outline_is_flat():
    assert isinstance(FLAT, Prism)
    assert FLAT.height == 0.02
    assert np.ptp(FLAT.height_at(np.array([[0.0, 0.0], [0.05, 0.02]]))) == 0
