"""Flat objects with round outlines: what is drawn, where they are levered, and that they are lifted, not rolled."""

import json
from collections.abc import Callable

import numpy as np
import pytest
import shapely

from foretrace.actions import LeverUp, Screwdriver, sample_reachable_contacts
from foretrace.geometry import is_convex, quaternion_to_matrix, tilt
from foretrace.interactions.record import Outcome
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import (
    Prism,
    object_from_dict,
    sample_dented,
    sample_organic,
    sample_oval,
    sample_rounded,
)
from foretrace.objects.flat import HALF_LENGTHS, HEIGHTS
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up

FAMILIES = (sample_oval, sample_rounded, sample_organic, sample_dented)
WATCHED = SimulationConfig(embodiment="tool", watch_time=1.5)


def draw(sample: Callable, count: int = 24) -> list[Prism]:
    return [sample(np.random.default_rng([4, k])) for k in range(count)]


@pytest.mark.parametrize("sample", FAMILIES)
def test_samples_differ_stand_on_one_face_and_survive_json(sample: Callable):
    objects = draw(sample)
    assert [obj.to_dict() for obj in objects] == [obj.to_dict() for obj in draw(sample)]
    assert len({json.dumps(obj.to_dict()) for obj in objects}) == len(objects)
    for obj in objects:
        assert len(obj.corners) > 15
        assert HEIGHTS[0] <= obj.height <= HEIGHTS[1]
        assert 2 * HALF_LENGTHS[0] * 0.5 < obj.size < 2 * HALF_LENGTHS[1] * 1.4
        np.testing.assert_allclose(
            shapely.get_coordinates(shapely.Polygon(obj.corners).centroid), 0, atol=1e-9
        )
        assert isinstance(
            shapely.Polygon(obj.corners).buffer(-obj.bevel.width, join_style="mitre"), shapely.Polygon
        )
        again = object_from_dict(json.loads(json.dumps(obj.to_dict())))
        assert again.to_dict() == obj.to_dict()
        volume = obj.mass_properties(1.0).mass
        assert 0.7 < volume / (shapely.Polygon(obj.corners).area * obj.height) < 1.0
    assert max(obj.size for obj in objects) > 1.7 * min(obj.size for obj in objects)


def test_ovals_and_rounded_ones_are_convex_dented_ones_are_not():
    assert all(is_convex(obj.corners) for sample in (sample_oval, sample_rounded) for obj in draw(sample))
    assert not any(is_convex(obj.corners) for obj in draw(sample_dented))
    assert 0 < sum(is_convex(obj.corners) for obj in draw(sample_organic)) < 24


def test_contacts_spread_over_the_outline_where_a_blade_gets():
    half = Screwdriver().blade_width / 2
    for obj in draw(sample_dented, 8):
        actions = sample_reachable_contacts(obj, np.random.default_rng(1), 40)
        outline = shapely.Polygon(obj.corners)
        angles = np.sort([np.arctan2(*action.contact[::-1]) for action in actions])
        assert np.diff(angles, append=angles[0] + 2 * np.pi).max() < np.deg2rad(75)
        for action in actions:
            assert shapely.distance(outline.exterior, shapely.Point(action.contact)) < 1e-9
            across = half * np.array([-action.direction[1], action.direction[0]])
            for side in (-across, across):
                way = [action.contact + side - distance * action.direction for distance in (0.002, 0.3)]
                assert not shapely.intersects(outline, shapely.LineString(way))


def test_no_contact_deep_in_a_narrow_slit():
    slit = Prism(
        [
            (-0.05, -0.04),
            (0.05, -0.04),
            (0.05, 0.04),
            (0.002, 0.04),
            (0.0, 0.0),
            (-0.002, 0.04),
            (-0.05, 0.04),
        ]
    )
    actions = sample_reachable_contacts(slit, np.random.default_rng(0), 60)
    x, y = np.array([action.contact for action in actions]).T
    assert not ((np.abs(x) < 0.003) & (y < 0.038)).any()
    assert len({tuple(np.round(action.direction, 6)) for action in actions}) == 4


@pytest.mark.parametrize(("height", "share"), [(0.01, 0.5), (0.03, 0.5)])
def test_a_disc_levered_at_its_rim_is_lifted_and_does_not_roll(height: float, share: float):
    angles = 2 * np.pi * np.arange(64) / 64
    disc = Prism(0.09 * np.column_stack([np.cos(angles), np.sin(angles)]), height)
    effect = simulate_lever_up(disc, LeverUp.at_edge(disc, 10, share), WATCHED).effect
    assert effect.outcome == Outcome.LEVERED
    tilts = np.rad2deg(tilt(quaternion_to_matrix(effect.pose_trajectory[:, 3:])))
    assert 20 < tilts.max() < 60
    # It turns about the far rim: nothing moves it sideways.
    assert np.abs(effect.com_trajectory[:, 1]).max() < 0.002
    np.testing.assert_allclose(effect.support_points[:, 0], 0.18 - disc.bevel.width, atol=0.003)


@pytest.mark.parametrize("sample", FAMILIES)
def test_nothing_round_and_flat_rolls(sample: Callable):
    for k, obj in enumerate(draw(sample, 4)):
        (action,) = sample_reachable_contacts(obj, np.random.default_rng(k), 1)
        made = simulate_lever_up(obj, action, WATCHED)
        assert made.effect.outcome in (Outcome.LEVERED, Outcome.SLIPPED, Outcome.TUMBLED)
        np.testing.assert_array_equal(made.view.mask, TopDownView.of(obj, action).mask)
        assert made.effect.com_trajectory[:, 2].max() > 1.2 * obj.mass_properties(1.0).com[2]
