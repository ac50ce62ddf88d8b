import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foretrace.actions import CORNER_MARGIN, LeverUp, ToolPath, sample_contacts
from foretrace.errors import ActionError
from foretrace.geometry import inward_normals, transform_points
from foretrace.objects import NO_BEVEL, Prism, sample_prism

SQUARE = Prism(np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.1], [0.0, 0.1]]))


def test_at_edge_lies_on_the_edge_and_pushes_inwards():
    action = LeverUp.at_edge(SQUARE, edge=1, fraction=0.25)
    np.testing.assert_allclose(action.contact, [0.2, 0.025])
    np.testing.assert_allclose(action.direction, [-1.0, 0.0])
    last = LeverUp.at_edge(SQUARE, edge=3)
    np.testing.assert_allclose(last.contact, [0.0, 0.05])
    np.testing.assert_allclose(last.direction, [1.0, 0.0])


@pytest.mark.parametrize("edge", [-1, 4, 100])
def test_unknown_edge_is_refused(edge):
    with pytest.raises(ActionError, match=rf"edge {edge} .*4 edges: choose 0 to 3"):
        LeverUp.at_edge(SQUARE, edge)


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1, 1.5, np.nan])
def test_fraction_off_the_edge_is_refused(fraction):
    with pytest.raises(ActionError, match="fraction"):
        LeverUp.at_edge(SQUARE, 0, fraction)


def test_direction_is_normalised_and_values_are_frozen():
    action = LeverUp(contact=(1, 2), direction=(3, 4))
    np.testing.assert_allclose(action.direction, [0.6, 0.8])
    with pytest.raises(ValueError, match="read-only"):
        action.contact[0] = 5.0


@pytest.mark.parametrize(
    ("contact", "direction", "fault"),
    [
        ((0.0, 0.0), (0.0, 0.0), "no length"),
        ((0.0, 0.0), (np.nan, 1.0), "finite"),
        ((np.inf, 0.0), (1.0, 0.0), "finite"),
        ((0.0, 0.0, 0.0), (1.0, 0.0), "two finite numbers"),
    ],
)
def test_unusable_actions_are_refused(contact, direction, fault):
    with pytest.raises(ActionError, match=fault):
        LeverUp(contact=contact, direction=direction)


def test_nearest_snaps_to_the_outline():
    action = LeverUp.nearest(SQUARE, (0.05, -0.015))
    np.testing.assert_allclose(action.contact, [0.05, 0.0], atol=1e-12)
    np.testing.assert_allclose(action.direction, [0.0, 1.0])
    inside = LeverUp.nearest(SQUARE, (0.195, 0.05))
    np.testing.assert_allclose(inside.contact, [0.2, 0.05])


def test_nearest_keeps_off_the_corners():
    # Beyond corner 1, but more to the right of it than below: edge 1 faces the point.
    action = LeverUp.nearest(SQUARE, (0.215, -0.005))
    np.testing.assert_allclose(action.contact, [0.2, CORNER_MARGIN])
    np.testing.assert_allclose(action.direction, [-1.0, 0.0])


def test_nearest_on_an_edge_shorter_than_the_margin():
    corners = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1], [-0.0004, 0.0999]])
    action = LeverUp.nearest(Prism(corners, bevel=NO_BEVEL), (-0.0005, 0.1005))
    assert np.isfinite(action.contact).all()


@pytest.mark.parametrize("point", [(0.05, -0.0201), (70.0, 0.0), (0.1, 0.05), (1e200, 1e200)])
def test_nearest_refuses_what_is_far_from_the_outline(point):
    with pytest.raises(ActionError, match=r"m from the outline, whose nearest place is \(.*\): choose one"):
        LeverUp.nearest(SQUARE, point)


def test_nearest_names_the_nearest_place():
    contact = LeverUp.nearest(SQUARE, (0.05, -0.01)).contact
    with pytest.raises(ActionError, match=rf"nearest place is \({contact[0]:.4g}, {contact[1]:.4g}\): "):
        LeverUp.nearest(SQUARE, (0.05, -0.03))


def test_nearest_refuses_nan():
    with pytest.raises(ActionError, match="nan"):
        LeverUp.nearest(SQUARE, (np.nan, 0.0))


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(3, 10))
def test_action_frame_has_contact_at_origin_and_direction_along_x(seed, num_corners):
    rng = np.random.default_rng(seed)
    prism = sample_prism(rng, num_corners)
    for action in sample_contacts(prism, rng):
        ahead = np.array([[*action.contact, 0.3], [*(action.contact + action.direction), 0.3]])
        moved = transform_points(action.T_action_object, ahead)
        np.testing.assert_allclose(moved, [[0.0, 0.0, 0.3], [1.0, 0.0, 0.3]], atol=1e-12)
        assert np.linalg.det(action.T_action_object) == pytest.approx(1.0)
        # The object lies ahead of an inward normal, as the polygon is convex.
        corners = transform_points(action.T_action_object, np.pad(prism.corners, ((0, 0), (0, 1))))
        assert corners[:, 0].min() > -1e-12


def test_sampled_contacts_are_uniform_on_every_edge():
    rng = np.random.default_rng(0)
    actions = sample_contacts(SQUARE, rng, per_edge=500)
    assert len(actions) == 4 * 500
    normals = np.repeat(inward_normals(SQUARE.corners), 500, axis=0)
    np.testing.assert_allclose([a.direction for a in actions], normals)
    fractions = np.array([a.contact[0] for a in actions[:500]]) / 0.2
    np.testing.assert_allclose(np.histogram(fractions, 5, (0, 1))[0], 100, atol=40)
    assert len(sample_contacts(SQUARE, rng)) == 8


def test_nearest_finds_sampled_contacts_again():
    prism = sample_prism(np.random.default_rng(3), 7)
    for action in sample_contacts(prism, np.random.default_rng(4)):
        found = LeverUp.nearest(prism, action.contact)
        assert np.linalg.norm(found.contact - action.contact) < CORNER_MARGIN * 1.5


def test_moved_actions():
    action = LeverUp((0.0, 0.0), (0.0, 1.0)).moved(ahead=0.003, left=0.001, turn=np.pi / 2)
    np.testing.assert_allclose(action.contact, [-0.001, 0.003], atol=1e-12)
    np.testing.assert_allclose(action.direction, [-1.0, 0.0], atol=1e-12)


@given(
    st.floats(0.0, 0.1),
    st.floats(0.02, 1.0),
    st.floats(0.0, np.pi / 2),
    st.floats(0.1, 5.0),
    st.floats(0.0, 0.6),
)
def test_parameters_are_what_their_path_does(insertion, arc_radius, sweep, speed, phase):
    path = ToolPath.of(insertion=insertion, arc_radius=arc_radius, sweep=sweep, speed=speed)
    found = path.parameters()
    assert found.pop("speed") == pytest.approx(speed, rel=1e-12)
    assert found == {"insertion": insertion, "arc_radius": arc_radius, "sweep": sweep}
    # The same places, sooner by the speed.
    nominal = ToolPath.of(insertion=insertion, arc_radius=arc_radius, sweep=sweep)
    moment = phase * (nominal.insert_time + nominal.lift_time)
    times = np.array([nominal.wait_time + moment, path.wait_time + moment / speed])
    np.testing.assert_allclose(nominal.at(times[:1]), path.at(times[1:]), atol=1e-9)


def test_nominal_parameters_are_those_of_the_default_path():
    assert LeverUp.nominal_parameters() == ToolPath().parameters()
    assert ToolPath.of(**LeverUp.nominal_parameters()) == ToolPath()
    assert LeverUp.at_edge(SQUARE, 0).path == ToolPath()


@pytest.mark.parametrize(
    ("parameters", "fault"),
    [
        ({"speed": 0.0}, "speed = 0.0 times the nominal one: give a number above 0"),
        ({"speed": float("nan")}, "speed = nan"),
        ({"speed": 100.0}, "insert_time = 0.006 is outside 0.05 to 60"),
        ({"insertion": 0.2}, "insertion = 0.2 is outside 0 to 0.1"),
    ],
)
def test_paths_that_cannot_be_are_refused(parameters, fault):
    with pytest.raises(ActionError, match=fault):
        ToolPath.of(**parameters)
