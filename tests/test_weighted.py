"""Objects whose centre of mass lies off, and views on pixel grids of their own."""

from dataclasses import replace

import numpy as np
import pytest

import foretrace as ft
from foretrace.errors import ShapeError
from foretrace.geometry import transform_points
from foretrace.interactions.record import NO_OFFSET
from foretrace.objects import object_from_dict
from foretrace.objects.body import Body
from foretrace.objects.surface import triangles_of
from foretrace.simulation.collect import CollectConfig, simulate_trial
from foretrace.simulation.lever_up import SimulationConfig
from foretrace.simulation.randomisation import RANDOMISED, Randomisation

BOX = ft.Box(0.15, 0.12, 0.02)
TOOL = SimulationConfig(embodiment="tool")


def test_mass_lies_off_and_everything_else_stays():
    even, off = BOX.mass_properties(600.0), ft.Weighted(BOX, (0.02, -0.01)).mass_properties(600.0)
    assert off.mass == even.mass
    np.testing.assert_allclose(off.com - even.com, [0.02, -0.01, 0.0], atol=1e-15)
    weighted = ft.Weighted(BOX, (0.02, -0.01))
    np.testing.assert_array_equal(triangles_of(weighted)[0], triangles_of(BOX)[0])
    assert weighted.shape is BOX
    assert weighted.height == BOX.height


def test_inertia_is_that_of_two_parts():
    """Half of the mass spread evenly and half in a core of a third of the size, put together from boxes."""
    block = ft.Box(0.15, 0.12, 0.03, ft.objects.NO_BEVEL)
    offset = np.array([0.015, 0.01])
    parts = [
        (Body.box((0.15, 0.12, 0.03), 1.0).mass.inertia, -offset),
        (Body.box((0.05, 0.04, 0.01), 1.0).mass.inertia, offset),
    ]
    inertia = np.zeros((3, 3))
    for own, place in parts:
        x, y = place
        inertia += own + np.array([[y * y, -x * y, 0], [-x * y, x * x, 0], [0, 0, x * x + y * y]])
    density = 2.0 / (0.15 * 0.12 * 0.03)
    np.testing.assert_allclose(
        ft.Weighted(block, offset).mass_properties(density).inertia, inertia, rtol=1e-9, atol=1e-12
    )


def test_a_weighted_object_survives_its_description():
    weighted = ft.Weighted(BOX, (0.02, -0.01))
    back = object_from_dict(weighted.to_dict())
    assert back.to_dict() == weighted.to_dict()
    with pytest.raises(ShapeError, match=r"com_offset of .* at most 0.2 m"):
        ft.Weighted(BOX, (1.0, 0.0))
    with pytest.raises(ShapeError, match="give Box and one offset"):
        ft.Weighted(weighted, (0.01, 0.0))


def test_the_heavy_side_lags_behind():
    """Levered at the middle of an edge: the object turns about its heavy side, and the other way in the mirror."""
    action = ft.LeverUp.at_edge(BOX, 0)
    left = action.T_action_object[:2, :2].T @ [0.0, 0.02]
    even, one, other = (
        ft.simulate(ft.Weighted(BOX, by * left), action, embodiment="tool").effect.com_trajectory[-1]
        for by in (0.0, 1.0, -1.0)
    )
    assert abs(even[1]) < 1e-4
    assert one[1] > 0.015
    np.testing.assert_allclose(one, other * [1, -1, 1], atol=1e-4)


def test_half_of_randomised_objects_lie_off():
    config = CollectConfig(objects=16, simulation=TOOL, randomisation=Randomisation(com_offset=1 / 3))
    plain = CollectConfig(objects=16, simulation=TOOL)
    kinds = [simulate_trial(config, id).object.kind for id in range(0, 200, 10)]
    assert 5 <= kinds.count("weighted") <= 15
    id = 10 * kinds.index("prism")
    one, other = (simulate_trial(each, id).effect.com_trajectory for each in (config, plain))
    np.testing.assert_array_equal(one, other)


def test_a_grid_of_its_own_shows_the_same_object():
    action = ft.LeverUp.at_edge(BOX, 1, 0.3)
    exact = ft.TopDownView.of(BOX, action)
    seen = [ft.simulate(BOX, action, embodiment="tool", camera="grid", seed=seed).view for seed in range(8)]
    assert len({view.mask.tobytes() for view in seen}) == 8
    area = np.mean([view.mask.sum() for view in seen])
    assert area == pytest.approx(BOX._polygon.area / exact.metres_per_pixel**2, rel=0.01)
    for view in seen:
        assert (view.mask ^ exact.mask).sum() < 0.7 * len(exact.contour())
        np.testing.assert_allclose(view.height[view.mask], BOX.height, rtol=1e-5)
    middle = transform_points(action.T_action_object, np.array([[0.0, 0.0, 0.0]]))[0, :2]
    centres = [view.to_metres(np.argwhere(view.mask).astype(float)).mean(axis=0) for view in seen]
    assert np.abs(np.mean(centres, axis=0) - middle).max() < 3e-4


def test_a_share_of_the_lever_ups_is_exact():
    config = CollectConfig(
        objects=16, simulation=TOOL, randomisation=replace(RANDOMISED, execution_share=0.5)
    )
    every = [simulate_trial(config, id) for id in range(0, 200, 10)]
    exact = [each.execution_error == NO_OFFSET for each in every]
    assert 5 <= sum(exact) <= 15
    batch = ft.InteractionBatch.from_interactions(every)
    np.testing.assert_array_equal(batch.parameters["contact_error"] == 0, exact)
