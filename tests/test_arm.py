"""The arm agrees with an independent implementation, and follows the blade's path."""

import mujoco
import numpy as np
import pytest

from foretrace.actions import LeverUp, Screwdriver, ToolPath, tool_transforms
from foretrace.errors import ActionError
from foretrace.geometry import pose_to_matrix
from foretrace.interactions.record import Physics
from foretrace.objects import Prism
from foretrace.simulation import arm
from foretrace.simulation.lever_up import simulate
from foretrace.simulation.scene import build_scene

SQUARE = Prism([(0.0, 0.0), (0.2, 0.0), (0.2, 0.1), (0.0, 0.1)])
ACTION = LeverUp.at_edge(SQUARE, 0)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_scene(None, Physics(), Screwdriver(), "arm", 0.002).compile()


def flange_in_base(model: mujoco.MjModel, q: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    site = model.site("flange").id
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = data.site_xmat[site].reshape(3, 3), data.site_xpos[site] - arm.BASE_POSITION
    return T


def test_forward_kinematics_agree_with_ur_analytic_ik(model: mujoco.MjModel) -> None:
    ur = pytest.importorskip("ur_analytic_ik")
    rng = np.random.default_rng(0)
    for q in rng.uniform(-np.pi, np.pi, size=(50, 6)):
        np.testing.assert_allclose(flange_in_base(model, q), ur.ur10.forward_kinematics(*q), atol=1e-6)


def test_inverse_kinematics_inverts_forward_kinematics(model: mujoco.MjModel) -> None:
    T = tool_transforms(ACTION.tool_motion(np.array([1.0])))[0]
    q = arm.solve_inverse_kinematics(model, T, np.array(arm.HOME))
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.site("tip").xpos, T[:3, 3], atol=1e-8)
    np.testing.assert_allclose(data.site("tip").xmat.reshape(3, 3), T[:3, :3], atol=1e-8)


def test_unreachable_pose_is_refused(model: mujoco.MjModel) -> None:
    T = pose_to_matrix(np.array([3.0, 0, 0, 1, 0, 0, 0]))
    with pytest.raises(ActionError, match=r"cannot bring the blade to \(3\.000"):
        arm.solve_inverse_kinematics(model, T, np.array(arm.HOME))


def test_too_fast_a_path_is_refused() -> None:
    hasty = LeverUp.at_edge(SQUARE, 0, path=ToolPath(lift_time=0.06))
    with pytest.raises(ActionError, match="over its limit"):
        simulate(SQUARE, hasty)


def test_the_arm_keeps_clear_of_the_table(model: mujoco.MjModel) -> None:
    """No link but the blade comes near the table anywhere on the path."""
    data = mujoco.MjData(model)
    q = np.array(arm.HOME)
    table = model.geom("table").id
    moving = [g for g in range(model.ngeom) if model.geom_contype[g] == 4 and not model.geom(g).name]
    for T in tool_transforms(ACTION.tool_motion(np.linspace(0, ACTION.duration, 15))):
        q = arm.solve_inverse_kinematics(model, T, q)
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        gaps = [mujoco.mj_geomDistance(model, data, table, g, 1.0, None) for g in moving]
        assert min(gaps) > 0.01


def test_resting_arm_does_not_sag(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    data.qpos[:] = data.ctrl[:] = arm.HOME
    for _ in range(500):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos, arm.HOME, atol=1e-6)


@pytest.mark.parametrize("field", ["insertion", "sweep", "pitch", "lift_time"])
def test_tool_path_refuses_values_out_of_range(field: str) -> None:
    with pytest.raises(ActionError, match=f"{field} = -3"):
        ToolPath(**{field: -3.0})


def test_tool_path_starts_and_ends_at_rest() -> None:
    path = ToolPath()
    ends = path.at(np.array([-1.0, 0.0, path.wait_time, path.duration, path.duration + 1]))
    np.testing.assert_allclose(ends[:3], ends[:1].repeat(3, axis=0))
    np.testing.assert_allclose(ends[3], ends[4])
    assert ends[3, 1] == pytest.approx(path.clearance + path.arc_radius * np.sin(path.sweep))
