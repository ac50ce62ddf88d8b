"""Rigid bodies on the table against mechanics in closed form, in every engine."""

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from engines_at_hand import WITHOUT_BULLET, every_engine
from foretrace.errors import SimulationError
from foretrace.geometry import quaternion_to_matrix
from foretrace.interactions.motions import ContactParameters
from foretrace.objects import MassProperties, Prism
from foretrace.objects.body import Body
from foretrace.simulation.free_motion import simulate_free_motion

PROGRAM = Path(__file__).parents[1] / "benchmarks" / "engines.py"
SPEC = importlib.util.spec_from_file_location("benchmark_engines", PROGRAM)
assert SPEC is not None
assert SPEC.loader is not None
benchmark = importlib.util.module_from_spec(SPEC)
sys.modules["benchmark_engines"] = benchmark
SPEC.loader.exec_module(benchmark)

LYING_FLAT = [0.0, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0]
BOX = Body.box((0.10, 0.08, 0.04), 0.3)


@every_engine
@pytest.mark.parametrize("row", benchmark.CHECKS, ids=lambda row: row[0].__name__)
def test_closed_form(row: tuple[Callable[..., tuple[float, float]], float, float], engine: str) -> None:
    """Steps of 2 ms miss by their own first order; Bullet also by how it keeps and opens contacts."""
    check, *tolerances = row
    measured, expected = check(engine, 0.002)
    assert measured == pytest.approx(expected, rel=tolerances[benchmark.ENGINES.index(engine)])


@every_engine
@pytest.mark.parametrize("check", [benchmark.free_fall, benchmark.tumble, benchmark.slide])
def test_half_the_time_step_halves_the_error(check: Callable[..., tuple[float, float]], engine: str) -> None:
    errors = [
        abs(measured / expected - 1) for measured, expected in (check(engine, dt) for dt in (0.002, 0.001))
    ]
    assert errors[1] < 0.75 * errors[0]


@WITHOUT_BULLET
def test_half_the_time_step_halves_bullets_error_in_rolling() -> None:
    errors = [
        check[0] / check[1] - 1 for check in (benchmark.roll_down("bullet", dt) for dt in (0.002, 0.001))
    ]
    assert 0 < errors[1] < 0.6 * errors[0]


@every_engine
def test_a_resting_box_stays(engine: str) -> None:
    motion = simulate_free_motion(BOX, LYING_FLAT, 3.0, engine=engine)
    np.testing.assert_allclose(motion.poses[:, :2], 0, atol=1e-4)
    # MuJoCo's contacts are springs: they give way by an eighth of a millimetre when the box is let go.
    np.testing.assert_allclose(motion.poses[:, 2], 0.02, atol=2e-4)
    np.testing.assert_allclose(motion.poses[:, 4:], 0, atol=2e-3)


@every_engine
def test_momentum_is_conserved_in_flight(engine: str) -> None:
    around = ContactParameters(gravity=(0.0, 0.0, 0.0))
    body = Body(MassProperties(0.3, np.array([0.01, -0.02, 0.005]), BOX.mass.inertia), BOX.shapes)
    start = [0.0, 0.0, 5.0, 0.8, 0.6, 0.0, 0.0]
    velocity = np.array([0.3, -0.1, 0.5, 3.0, 7.0, 2.0])
    motion = simulate_free_motion(
        body, start, 1.0, velocity=velocity, contact_parameters=around, engine=engine
    )
    np.testing.assert_allclose(motion.velocities[:, :3], velocity[None, :3].repeat(501, 0), atol=1e-9)
    R = quaternion_to_matrix(motion.poses[:, 3:])
    com = motion.poses[:, :3] + R @ body.mass.com
    np.testing.assert_allclose(com - com[0], np.outer(motion.times, velocity[:3]), atol=1e-9)
    momentum = np.einsum("tij,jk,tlk,tl->ti", R, body.mass.inertia, R, motion.velocities[:, 3:])
    drift = np.linalg.norm(momentum - momentum[0], axis=1).max() / np.linalg.norm(momentum[0])
    assert drift < 0.02  # first order in the time step; ten times less with a tenth of it


@every_engine
def test_sliding_never_gains_energy(engine: str) -> None:
    motion = simulate_free_motion(
        BOX,
        LYING_FLAT,
        0.5,
        velocity=[0.8, 0.3, 0, 0, 0, 4.0],
        contact_parameters=ContactParameters(0.3),
        engine=engine,
    )
    R = quaternion_to_matrix(motion.poses[:, 3:])
    spin = np.einsum("tji,tj->ti", R, motion.velocities[:, 3:])
    kinetic = 0.3 * (motion.velocities[:, :3] ** 2).sum(1) / 2 + (spin**2) @ np.diag(BOX.mass.inertia) / 2
    energy = kinetic + 0.3 * 9.81 * motion.poses[:, 2]
    # Up to half a per cent in a step is what corrections of a contact's depth put in, and soon lose again.
    assert np.diff(energy).max() < 5e-3 * kinetic[0]
    assert energy.max() < energy[0] + 1e-3 * kinetic[0]
    assert kinetic[-1] < 0.02 * kinetic[0]


@pytest.mark.parametrize("timestep", [0.001, 0.002])
def test_mujoco_returns_every_share_of_the_speed(timestep: float) -> None:
    cube, returned = Body.box([0.1, 0.1, 0.1], 0.3), []
    wanted = np.array([0, 0.05, 0.1, 0.13, 0.2, 0.3, 0.5, 0.8])
    for restitution in wanted:
        surface = ContactParameters(0.4, restitution=float(restitution))
        start = [0, 0, 0.25, 1, 0, 0, 0]
        motion = simulate_free_motion(cube, start, 0.3, contact_parameters=surface, timestep=timestep)
        speed = motion.velocities[:, 2]
        returned.append(speed[speed.argmin() :].max() / -speed.min())
    np.testing.assert_allclose(returned, wanted, atol=0.04)
    assert np.all(np.diff(returned) > 0)
    assert returned[0] < 0.02


@every_engine
def test_equal_arguments_give_equal_motions(engine: str) -> None:
    velocity = [1.0, 0.2, 0.0, 0.5, 0.0, 3.0]
    first, _, second = (
        simulate_free_motion(body, LYING_FLAT, 0.5, velocity=velocity, engine=engine)
        for body in (BOX, benchmark.TALL_BOX, BOX)
    )
    np.testing.assert_array_equal(first.poses, second.poses)
    np.testing.assert_array_equal(first.velocities, second.velocities)


@every_engine
def test_an_object_of_the_lever_ups_falls_on_its_bottom(engine: str) -> None:
    prism = Prism(np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.06], [0.06, 0.06], [0.06, 0.2], [0.0, 0.2]]))
    motion = simulate_free_motion(
        Body.of(prism, 600.0), [0.0, 0.0, 0.03, 1.0, 0.0, 0.0, 0.0], 1.0, engine=engine
    )
    assert motion.poses[-1, 2] == pytest.approx(0, abs=2e-4)
    np.testing.assert_allclose(quaternion_to_matrix(motion.poses[-1, 3:])[2], [0, 0, 1], atol=0.01)


def test_the_lowest_point() -> None:
    half = float(np.sqrt(0.5))
    cylinder = Body.cylinder(0.03, 0.10, 0.2)
    assert cylinder.lowest(np.array([0, 0, 0.03, half, half, 0, 0])) == pytest.approx(0)
    assert cylinder.lowest(np.array([0, 0, 0.06, 1, 0, 0, 0])) == pytest.approx(0.01)
    turn = np.pi / 8
    pose = np.array([0, 0, 0.07, np.cos(turn), 0, np.sin(turn), 0])
    assert BOX.lowest(pose) == pytest.approx(0.07 - (0.05 + 0.02) * half)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"engine": "ode"}, "unknown engine 'ode'; available: mujoco, bullet"),
        ({"start": [0, 0, 0, 2, 0, 0, 0]}, "has not the length 1"),
        ({"start": [0, 0, np.nan, 1, 0, 0, 0]}, "seven finite numbers"),
        ({"timestep": 0.0}, r"timestep = 0\.0 s"),
        ({"duration": -1.0}, "duration = -1"),
    ],
)
def test_bad_values_are_refused(change: dict[str, Any], message: str) -> None:
    settings = {"body": BOX, "start": LYING_FLAT, "duration": 0.1} | change
    with pytest.raises(SimulationError, match=message):
        simulate_free_motion(**settings)


@pytest.mark.parametrize(
    "settings", [{"friction": -0.1}, {"restitution": 1.5}, {"gravity": (0.0, 0.0, np.inf)}]
)
def test_bad_surroundings_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(SimulationError, match=next(iter(settings))):
        ContactParameters(**settings)


def test_impossible_bodies_are_refused() -> None:
    with pytest.raises(SimulationError, match="a body of mass 0 kg"):
        Body(MassProperties(0.0, np.zeros(3), np.eye(3)), BOX.shapes)
    with pytest.raises(SimulationError, match="no body has the principal inertia"):
        Body(MassProperties(1.0, np.zeros(3), np.diag([1.0, 1.0, 3.0])), BOX.shapes)
    with pytest.raises(SimulationError, match="4 vertices enclose no volume"):
        Body.hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), 1.0)
