"""What is special about Bullet: margins, shapes, friction of pairs, one client, no arm, not installed."""

import sys
from pathlib import Path

import numpy as np
import pytest

from foretrace.actions import LeverUp, Screwdriver, ToolPath
from foretrace.cli import main
from foretrace.errors import SimulationError
from foretrace.geometry import quaternion_to_matrix
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.motions import GRAVITY, ContactParameters
from foretrace.interactions.record import Outcome, Physics
from foretrace.objects import NO_BEVEL, HullShape, Prism
from foretrace.objects.body import Body
from foretrace.simulation.bullet_engine import BulletEngine
from foretrace.simulation.bullet_world import COLLISION_MARGIN, World, connect
from foretrace.simulation.free_motion import simulate_free_motion
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up

pybullet = pytest.importorskip("pybullet", reason="pybullet is not installed")

L_SHAPE = Prism(np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.08], [0.08, 0.08], [0.08, 0.2], [0.0, 0.2]]))
SQUARE = Prism(np.array([[0.0, 0.0], [0.12, 0.0], [0.12, 0.12], [0.0, 0.12]]))


def test_the_gap_at_rest_is_far_below_the_bevels_height() -> None:
    obj = Body.of(SQUARE, 600.0)
    motion = simulate_free_motion(obj, [0, 0, 0, 1, 0, 0, 0], 1.0, engine="bullet")
    assert motion.poses[-1, 2] == pytest.approx(0, abs=2 * COLLISION_MARGIN)
    assert 0.01 * SQUARE.bevel.height > COLLISION_MARGIN


def test_mass_and_inertia_are_the_objects() -> None:
    world = World(0.002, GRAVITY)
    body = Body.of(L_SHAPE, 600.0)
    number = world.add_object(body, np.eye(4))
    info = world.bullet.getDynamicsInfo(number, -1)
    assert info[0] == pytest.approx(body.mass.mass)
    np.testing.assert_allclose(sorted(info[2]), np.linalg.eigvalsh(body.mass.inertia), rtol=1e-9)
    np.testing.assert_allclose(world.pose(number), [0, 0, 0, 1, 0, 0, 0], atol=1e-9)


def test_a_push_changes_the_momentum_by_force_times_time() -> None:
    world = World(0.002, (0.0, 0.0, 0.0))
    body = Body.of(L_SHAPE, 600.0)
    number = world.add_object(body, np.eye(4))
    for _ in range(5):
        world.push(number, np.array([3.0, -1.0, 0.5]))
        world.bullet.stepSimulation()
    world.bullet.stepSimulation()  # a push lasts one step
    speed = np.array([3.0, -1.0, 0.5]) * 5 * 0.002 / body.mass.mass
    np.testing.assert_allclose(world.velocity(number), [*speed, 0, 0, 0], rtol=1e-6, atol=1e-9)


def test_a_pinned_point_stays_while_the_object_turns_about_it() -> None:
    world = World(0.002, (0.0, 0.0, 0.0))
    start = np.eye(4)
    start[:2, 3] = 0.1, -0.2
    number = world.add_object(Body.of(L_SHAPE, 600.0), start)
    point = np.array([0.18, 0.02, 0.0])
    world.pin(number, point)
    for _ in range(200):
        world.push(number, np.array([0.3, 0.5, 0.0]))
        world.bullet.stepSimulation()
    pose = world.pose(number)
    here = pose[:3] + quaternion_to_matrix(pose[3:]) @ point
    np.testing.assert_allclose(here, start[:3, 3] + point, atol=1e-3)
    assert np.linalg.norm(pose[:3] - start[:3, 3]) > 0.05


@pytest.mark.parametrize("obj", [SQUARE, L_SHAPE], ids=["one hull", "several hulls"])
def test_collision_shapes_have_the_objects_size(obj: Prism) -> None:
    """Seen by rays: the top is where it should be, and the notch of the L is open."""
    world = World(0.002, GRAVITY)
    world.add_object(Body.of(obj, 600.0), np.eye(4))
    world.bullet.performCollisionDetection()
    points = np.array([[0.04, 0.04], [0.04, 0.10], [0.115, 0.04], [0.14, 0.14], [-0.005, 0.04]])
    inside = [obj.height_at(point[None])[0] > 0 for point in points]
    hits = world.bullet.rayTestBatch([[x, y, 1.0] for x, y in points], [[x, y, -1.0] for x, y in points])
    assert [hit[0] >= 0 for hit in hits] == inside
    for hit, expected in zip(hits, inside, strict=True):
        if expected:
            assert hit[3][2] == pytest.approx(obj.height, abs=2e-4)


def test_the_blade_has_its_dimensions() -> None:
    """A blade of 1 mm in Bullet's usual margin of 1 mm would have round edges and no inside."""
    world, tool = World(0.002, GRAVITY), Screwdriver()
    blade = world.add_tool(tool, 0.3, not_against=())
    ball = world.bullet.createMultiBody(
        0.01, world.bullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.001)
    )
    half = tool.blade_width / 2
    for position, distance in (
        ((-0.02, 0.0, 0.005), 0.005 - tool.blade_thickness - 0.001),
        ((-0.02, 0.0, -0.004), 0.003),
        ((0.004, 0.0, 0.0005), 0.003),
        ((-0.02, half + 0.004, 0.0005), 0.003),
        ((0.003, half + 0.004, 0.0005), 0.004),
    ):
        world.bullet.resetBasePositionAndOrientation(ball, position, [0, 0, 0, 1])
        closest = world.bullet.getClosestPoints(ball, blade, 0.02)
        assert min(point[8] for point in closest) == pytest.approx(distance, abs=5e-5)


@pytest.mark.parametrize(("table", "tool"), [(0.8, 0.3), (0.3, 0.8)])
def test_every_pair_has_its_own_friction(table: float, tool: float) -> None:
    """A box that slides on the table, and one on a blade that slides under it: acceleration and force tell."""
    motion = simulate_free_motion(
        Body.box((0.1, 0.1, 0.04), 0.3),
        [0, 0, 0.02, 1, 0, 0, 0],
        0.2,
        velocity=[1.0, 0, 0, 0, 0, 0],
        contact_parameters=ContactParameters(friction=table),
        engine="bullet",
    )
    assert 1.0 - motion.velocities[50, 0] == pytest.approx(table * 9.81 * 0.1, rel=0.03)
    world = World(0.002, GRAVITY)
    world.add_table(table)
    blade = world.add_tool(Screwdriver(), tool, not_against=(0,))
    body = world.add_object(Body.box((0.03, 0.002, 0.002), 0.01), np.eye(4))
    start = [-0.02, 0.0, Screwdriver().blade_thickness + 0.001 + COLLISION_MARGIN]
    world.bullet.resetBasePositionAndOrientation(body, start, [0, 0, 0, 1])
    # It lies on the blade, which is drawn away under it at 0.5 m/s: friction is at its limit.
    for _ in range(10):
        world.set_velocity(blade, np.array([-0.5, 0, 9.81 * 0.002, 0, 0, 0]))
        world.bullet.stepSimulation()
    contacts = world.bullet.getContactPoints(body, blade)
    normal, sideways = (sum(contact[i] for contact in contacts) for i in (9, 12))
    assert sideways == pytest.approx(tool * normal, rel=0.01)
    assert normal > 0


def test_one_client_serves_all_plays() -> None:
    def count() -> int:
        return sum(pybullet.getConnectionInfo(number)["isConnected"] for number in range(100))

    connect()
    before = count()
    for obj in (SQUARE, L_SHAPE):
        simulate_lever_up(obj, LeverUp.at_edge(obj, 0), SimulationConfig(engine="bullet", embodiment="tool"))
        simulate_free_motion(Body.of(obj, 600.0), [0, 0, 0, 1, 0, 0, 0], 0.01, engine="bullet")
    assert count() == before


def test_an_object_that_is_not_convex_is_levered_as_in_mujoco(capfd: pytest.CaptureFixture[str]) -> None:
    action = LeverUp.at_edge(L_SHAPE, 0)
    seen = [
        simulate_lever_up(L_SHAPE, action, SimulationConfig(engine=engine, embodiment="tool")).effect
        for engine in ("mujoco", "bullet")
    ]
    assert seen[0].outcome == seen[1].outcome == Outcome.LEVERED
    assert seen[0].support_corners == seen[1].support_corners
    assert np.linalg.norm(seen[0].com_trajectory - seen[1].com_trajectory, axis=1).mean() < 4e-3
    # Bullet says on standard output what it dislikes about a file.
    assert capfd.readouterr().out == ""


def test_a_sharp_rim_is_pushed_and_not_lifted() -> None:
    blunt = Prism(SQUARE.corners, bevel=NO_BEVEL)
    action = LeverUp.at_edge(blunt, 0, path=ToolPath(pitch=0.0))
    pose = action.T_action_object
    motion = BulletEngine().play(blunt, pose, action.tool, action.tool_motion, action.duration, Physics())
    assert motion.object_pose[20, 0] - motion.object_pose[0, 0] > 0.01


def test_the_arm_is_refused_with_the_remedy() -> None:
    with pytest.raises(
        SimulationError, match=r"no embodiment 'arm': choose embodiment tool \(--embodiment tool\)"
    ):
        SimulationConfig(engine="bullet")


def test_a_time_step_that_does_not_fit_is_refused() -> None:
    with pytest.raises(SimulationError, match=r"timestep = 0\.003 s does not divide 0\.05 s"):
        SimulationConfig(engine="bullet", embodiment="tool", timestep=0.003)


def test_without_pybullet_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(SimulationError, match=r"pip install 'foretrace\[bullet\]'"):
        connect.__wrapped__()


def test_shapes_that_bullet_cannot_build_are_refused() -> None:
    ball = Body.cylinder(0.03, 0.1, 0.2)
    mixed = Body(ball.mass, (*ball.shapes, *Body.box((0.1, 0.1, 0.1), 1.0).shapes))
    assert any(isinstance(shape, HullShape) for shape in mixed.shapes)
    with pytest.raises(SimulationError, match="from convex pieces or from one cylinder alone"):
        World(0.002, GRAVITY).add_object(mixed, np.eye(4))


def test_simulate_with_bullet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = f"simulate --out {tmp_path / 'a'} --objects 1 --contacts-per-edge 1 --engine bullet --workers 1".split()
    assert main(command) == 2
    assert "--embodiment tool" in capsys.readouterr().err
    assert main([*command, "--embodiment", "tool"]) == 0
    dataset = Dataset.open(tmp_path / "a")
    assert len(dataset) == 3
    assert dataset.with_id(1).provenance.engine == "bullet"
