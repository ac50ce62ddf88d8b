"""Joint paths for a real arm: they lead the blade where they should, and what is unsafe is refused."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import pytest

from foretrace import cli
from foretrace.actions import LeverUp, Screwdriver, ToolPath, tool_transforms
from foretrace.errors import RobotError
from foretrace.geometry import matrix_to_pose, pose_to_matrix
from foretrace.interactions.record import Physics
from foretrace.robot.checks import ArmLimits, check_path, check_start, refuse_unsafe
from foretrace.robot.controller import ArmState, UrController
from foretrace.robot.execution import WatchConfig, refuse_unready
from foretrace.robot.kinematics import ArmKinematics
from foretrace.robot.path import ArmPath, plan_approach, plan_lever_up, plan_retreat, read_base_pose
from foretrace.simulation import arm
from foretrace.simulation.scene import build_scene
from ur_controller import RunningController

ACTION = LeverUp((0.1, 0.2), (0.6, 0.8))
T_TABLE_BASE = pose_to_matrix(np.array([-0.4, -0.5, 0.03, np.cos(0.4), 0.0, 0.0, np.sin(0.4)]))
GOOD = np.array([2.9, -1.2, 2.3, -3.0, -1.5, 1.3])


@pytest.fixture(scope="module")
def kinematics() -> ArmKinematics:
    return ArmKinematics(Screwdriver())


@pytest.fixture(scope="module")
def legs(kinematics) -> list[ArmPath]:
    return plan_lever_up(kinematics, ACTION, T_TABLE_BASE, 0.5)


@pytest.fixture
def base_file(tmp_path) -> Path:
    file = tmp_path / "base.json"
    pose = matrix_to_pose(T_TABLE_BASE).tolist()
    file.write_text(json.dumps({"format": "foretrace-base-pose", "version": 1, "T_table_base": pose}))
    return file


def still(*joints: float) -> ArmPath:
    return ArmPath("test", np.tile(joints, (3, 1)))


def failures(path: ArmPath, kinematics: ArmKinematics, **limits: float) -> dict[str, str]:
    """Message of every check that fails, by the check's name."""
    found = {}
    for check in check_path(path, kinematics.along(path.joints), np.eye(4), ArmLimits(**limits)):
        if not check.passed:
            with pytest.raises(RobotError) as error:
                refuse_unsafe([check])
            found[check.name] = str(error.value)
    return found


def test_the_blade_follows_the_tool_path_on_the_table(legs):
    """With another library's forward kinematics, on a base that is turned, shifted and raised."""
    ur = pytest.importorskip("ur_analytic_ik")
    times = np.minimum(0.5 * legs[1].times, ToolPath().duration)
    wanted = np.linalg.inv(ACTION.T_action_object) @ tool_transforms(ACTION.tool_motion(times))
    flanges = np.array([ur.ur10.forward_kinematics(*q) for q in legs[1].joints])
    tips = T_TABLE_BASE @ flanges @ arm.T_flange_tip(Screwdriver())
    np.testing.assert_allclose(tips, wanted, atol=2e-5)


def test_legs_join_and_rest_at_their_ends(legs):
    np.testing.assert_allclose(legs[0].joints[-1], legs[1].joints[0], atol=1e-12)
    for leg in [plan_approach(GOOD, legs[0].joints[0]), *legs]:
        speeds = np.diff(leg.joints, axis=0) / arm.CONTROL_PERIOD
        assert np.abs(speeds[[0, -1]]).max() < 0.01


def test_the_retreat_sets_down_pulls_out_and_goes_up(kinematics, legs):
    set_down, retreat = plan_retreat(legs)
    assert (set_down.name, retreat.name) == ("set-down", "retreat")
    for before, leg in pairwise([legs[1], set_down, retreat]):
        np.testing.assert_allclose(before.joints[-1], leg.joints[0], atol=1e-12)
    T_action_base = ACTION.T_action_object @ T_TABLE_BASE
    tips = [
        np.array([T_action_base @ posture.T_base_tip for posture in kinematics.along(leg.joints)])[:, :3, 3]
        for leg in (set_down, retreat)
    ]
    path = ToolPath()
    lowered = np.flatnonzero(tips[0][:, 2] > tips[0][-1, 2] + 1e-4)[-1]
    # Lowered before it is pulled out; the pull is level, and ends before the contact.
    assert tips[0][lowered, 0] == pytest.approx(path.insertion, abs=1e-3)
    assert np.ptp(tips[0][lowered + 1 :, 2]) < 2e-4
    assert tips[0][-1, 0] == pytest.approx(-path.standoff, abs=1e-4)
    np.testing.assert_allclose(tips[1][-1] - tips[1][0], [-0.05, 0, 0.10], atol=1e-4)
    for leg in (set_down, retreat):
        refuse_unsafe(check_path(leg, kinematics.along(leg.joints), T_TABLE_BASE, ArmLimits()))


def test_speed_scales_time_alone(kinematics, legs):
    slow = plan_lever_up(kinematics, ACTION, T_TABLE_BASE, 0.1)
    for fast_leg, slow_leg in zip(legs, slow, strict=True):
        same = slow_leg.joints[::5][: len(fast_leg.joints)]
        np.testing.assert_allclose(fast_leg.joints[: len(same)], same, atol=1e-6)


@pytest.mark.parametrize("degrees", [0, 225])
def test_a_usual_lever_up_passes_all_checks(kinematics, degrees):
    direction = (np.cos(np.radians(degrees)), np.sin(np.radians(degrees)))
    legs = plan_lever_up(kinematics, LeverUp((0.75, 0.1), direction), np.eye(4), 1.0)
    for leg in legs:
        assert failures(leg, kinematics) == {}


@pytest.mark.parametrize(
    ("name", "path", "said"),
    [
        ("joint angle", still(*GOOD[:5], 6.25), "of wrist_3 is 6.25 rad at sample 0"),
        ("flange from base", still(0, -1.0, 0.3, 0.5, 1.5, 0), "at most 1.1"),
        ("flange from base axis", still(0, -1.9, 2.4, 0.5, 1.5, 0), "at least 0.35"),
        ("elbow singularity", still(0, -1.0, 0.1, 0.5, 1.5, 0), "is 0.09983 sine"),
        ("wrist singularity", still(*GOOD[:4], -0.1, 0), "is 0.09983 sine"),
        ("shoulder singularity", still(0, -2.2, 1.5, 0.5, 1.5, 0), "at least 0.15"),
        ("least singular value", still(*GOOD[:4], 0.0, 0), "at least 0.05"),
        ("arm above table", still(0, -0.2, 0.4, 0.0, 1.5, 0), "at least 0.01"),
        ("blade above table", still(0, -0.2, 0.4, 0.0, 1.5, 0), "at least 0"),
    ],
)
def test_each_unsafe_posture_is_refused(kinematics, name, path, said):
    assert said in failures(path, kinematics)[name]


def test_jumps_are_refused(kinematics):
    path = still(*GOOD)
    path.joints[1:, 2] += 0.02
    found = failures(path, kinematics)
    assert "of elbow is 2.5 rad/s at sample 0 (0.00 s), the limit is at most 1.571" in found["joint speed"]
    assert "of elbow is 312.5 rad/s2" in found["joint acceleration"]
    assert "m/s at sample 0" in found["blade tip speed"]


def test_numbers_that_are_not_finite_are_refused(kinematics):
    path = still(*GOOD)
    path.joints[1, 4] = np.nan
    with pytest.raises(RobotError, match="wrist_2 is not finite at sample 1"):
        check_path(path, kinematics.along(path.joints), np.eye(4), ArmLimits())


def test_a_base_that_is_lower_than_calibrated_puts_the_blade_into_the_table(kinematics, legs):
    lower = T_TABLE_BASE.copy()
    lower[2, 3] -= 0.001
    with pytest.raises(RobotError, match=r"descent: blade above table is -0\.0006 m"):
        refuse_unsafe(check_path(legs[0], kinematics.along(legs[0].joints), lower, ArmLimits()))


def test_clearance_agrees_with_the_collision_checker(kinematics):
    model = build_scene(None, Physics(), Screwdriver(), "arm", 0.002).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = GOOD
    mujoco.mj_kinematics(model, data)
    table, geoms = model.geom("table").id, range(3, model.ngeom)
    gaps = {model.geom(g).name: mujoco.mj_geomDistance(model, data, table, g, 1.0, None) for g in geoms}
    blade = gaps.pop("blade")
    unnamed = [
        mujoco.mj_geomDistance(model, data, table, g, 1.0, None) for g in geoms if not model.geom(g).name
    ]
    path = still(*GOOD)
    found = check_path(path, kinematics.along(path.joints), np.eye(4), ArmLimits())
    checks = {check.name: check.value for check in found}
    assert checks["blade above table"] == pytest.approx(blade, abs=1e-6)
    assert checks["arm above table"] == pytest.approx(min([*unnamed, *gaps.values()]), abs=1e-6)


def test_a_start_far_away_is_refused():
    check = check_start(plan_approach(GOOD + np.array([0, 0, 0, 2.0, 0, 0]), GOOD), ArmLimits())
    with pytest.raises(RobotError, match=r"way to the start of wrist_1 is 2 rad at sample 0"):
        refuse_unsafe([check])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "cannot be read as JSON .*: give a JSON file with T_table_base"),
        ("[]", "holds a list"),
        ('{"format": "foretrace-base-pose", "version": 2}', "version 2"),
        ('{"format": "foretrace-base-pose", "version": 1}', "entry T_table_base is missing"),
        (
            '{"format": "foretrace-base-pose", "version": 1, "T_table_base": [0, 0, 0, 1, 1, 0, 0]}',
            "unit quaternion",
        ),
        *(
            (f'{{"format": "foretrace-base-pose", "version": 1, "T_table_base": {pose}}}', "unit quaternion")
            for pose in (
                '[0, 0, "x", 1, 0, 0, 0]',
                '["0", "0", "0", "1", "0", "0", "0"]',
                "[0, 0, true, 1, 0, 0, 0]",
                "[0, 0, NaN, 1, 0, 0, 0]",
                "[0, 0, 1e400, 1, 0, 0, 0]",
                "[-850, 0, 0, 1, 0, 0, 0]",
                "[0, 0, 0, 1e200, 1e200, 0, 0]",
                "[[0, 0, 0, 1, 0, 0, 0]]",
                "{}",
                "7",
            )
        ),
    ],
)
def test_a_wrong_base_pose_is_refused(tmp_path, text, said):
    file = tmp_path / "base.json"
    file.write_text(text)
    with pytest.raises(RobotError, match=said):
        read_base_pose(file)


def test_a_base_pose_is_read(base_file):
    np.testing.assert_allclose(read_base_pose(base_file), T_TABLE_BASE, atol=1e-12)


@pytest.mark.parametrize("speed", [0.0, -0.1, 1.1, np.nan, 1e-12])
def test_a_wrong_speed_is_refused(kinematics, speed):
    with pytest.raises(RobotError, match=r"choose 0\.01 to 1"):
        plan_lever_up(kinematics, ACTION, T_TABLE_BASE, speed)


def test_a_path_without_end_is_refused(kinematics):
    slow = LeverUp((0.1, 0.2), (0.6, 0.8), ToolPath(lift_time=60.0))
    with pytest.raises(RobotError, match="takes 6325 s, more than 600 s: choose a higher speed"):
        plan_lever_up(kinematics, slow, T_TABLE_BASE, 0.01)


def test_wrong_watch_settings_are_refused():
    with pytest.raises(RobotError, match=r"timeout = 10.0 is outside 0\.05 to 2"):
        WatchConfig(timeout=10.0)
    with pytest.raises(RobotError, match="deviation = nan"):
        WatchConfig(deviation=np.nan)


def test_faults_are_named():
    good = ArmState(0.0, GOOD, np.zeros(6), 7, 1, False, False, True, 1.0)
    assert good.fault is None
    assert replace(good, robot_mode=5).fault == "robot mode 5 (idle)"
    assert replace(good, safety_mode=5).fault == "safety mode 5 (safeguard stop)"
    assert replace(good, safety_mode=3, protective_stop=True).fault == "protective stop"
    assert replace(good, safety_mode=7, emergency_stop=True).fault == "emergency stop"
    refuse_unready(replace(good, playing=False), "arm")
    for joints, scaling, said in (
        (np.full(6, np.nan), 1.0, "where no arm can be"),
        (np.full(6, 1e200), 1.0, "where no arm can be"),
        (GOOD, np.nan, "scales speeds to nan %"),
    ):
        with pytest.raises(RobotError, match=said):
            refuse_unready(replace(good, playing=False, joints=joints, speed_scaling=scaling), "arm")
    with pytest.raises(RobotError, match="arm is in protective stop: release it"):
        refuse_unready(replace(good, protective_stop=True), "arm")
    with pytest.raises(RobotError, match="arm runs a program: stop it"):
        refuse_unready(good, "arm")


def command(base: Path, out: Path, *more: str) -> list[str]:
    place = ["--contact", "0.1", "0.2", "--direction", "0.6", "0.8"]
    return ["robot", "--base", str(base), *place, "--out", str(out), *more]


def test_a_dry_run_opens_no_connection(base_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(UrController, "__init__", lambda *_: pytest.fail("a connection was opened"))
    with RunningController(GOOD) as controller:
        assert cli.main(command(base_file, tmp_path, "--host", controller.host, "--speed", "1")) == 0
    assert controller.facts.connections == 0
    printed = capsys.readouterr().out
    assert "dry run" in printed
    assert "REFUSED" not in printed
    rows = (tmp_path / "path.csv").read_text().splitlines()
    assert rows[0].startswith("time_s,leg,shoulder_pan_rad")
    assert [row.split(",")[1] for row in rows[1:]] == [
        *["descent"] * 251,
        *["lever-up"] * 370,
        *["set-down"] * 370,
        *["retreat"] * 251,
    ]
    checks = json.loads((tmp_path / "checks.json").read_text())
    assert all(check["passed"] for check in checks)
    assert {check["leg"] for check in checks} == {"descent", "lever-up", "set-down", "retreat"}
    assert cli.main(command(base_file, tmp_path, "--speed", "1", "--no-retreat")) == 0
    assert len((tmp_path / "path.csv").read_text().splitlines()) == 1 + 251 + 370


def test_a_refused_path_opens_no_connection(base_file, tmp_path, capsys):
    with RunningController(GOOD) as controller:
        options = ["--host", controller.host, "--execute", "--yes", "--speed", "1"]
        pose = json.loads(base_file.read_text())
        pose["T_table_base"][:2] = [-0.6, -0.9]
        base_file.write_text(json.dumps(pose))
        assert cli.main(command(base_file, tmp_path, *options)) == 2
    assert controller.facts.connections == 0
    captured = capsys.readouterr()
    assert "REFUSED" in captured.out
    assert captured.err.startswith("foretrace: error: descent: flange from base is 1.102 m at sample 250")
    assert len(captured.err.splitlines()) == 1


def test_a_correction_moves_the_path(kinematics, legs, base_file, tmp_path):
    options = ["--speed", "1", "--no-retreat", "--correction", "0.001", "-0.002", "0.003"]
    assert cli.main(command(base_file, tmp_path, *options)) == 0
    path = np.genfromtxt(tmp_path / "path.csv", delimiter=",", skip_header=1, usecols=range(2, 8))
    with_it, without = (T_TABLE_BASE @ kinematics.at(q).T_base_tip for q in (path[0], legs[0].joints[0]))
    np.testing.assert_allclose((with_it - without)[:3, 3], [-0.001, 0.002, -0.003], atol=1e-5)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--correction", "0", "0", "1.2"], "--correction 0.0 0.0 1.2: give metres, at most 0.01"),
        (["--correction", "nan", "0", "0"], "--correction nan 0.0 0.0: give metres"),
        (["--direction", "1e200", "1e200"], "direction [1e+200, 1e+200] is too long"),
        (["--direction", "1e-320", "0"], "direction [1e-320, 0.0] has no length"),
        (["--direction", "nan", "1"], "direction (nan, 1.0): expected two finite numbers"),
        (["--contact", "1e308", "1e308"], "contact [1e+308, 1e+308] lies 1e+308 m away"),
        (["--contact", "inf", "0"], "contact (inf, 0.0): expected two finite numbers"),
        (["--speed", "nan"], "speed nan: choose 0.01 to 1"),
        (["--speed", "1e-12"], "speed 1e-12: choose 0.01 to 1"),
        (["--lift-time", "inf"], "tool path: lift_time = inf is outside 0.05 to 60"),
        (["--timeout", "1e400"], "watch: timeout = inf is outside 0.05 to 2"),
        (["--height-error", "0"], "watch: height_error = 0.0 is outside 0.0001 to 0.005"),
        (["--host", "192.168.1.10:30004"], "has a port: leave it out"),
        (["--host", "http://192.168.1.10"], "is no name or address of a controller"),
        (["--host", "."], "is no name or address of a controller"),
        (["--host", f"{'x' * 64}.net"], "is no name or address of a controller"),
        (["--host", "arm\n"], "is no name or address of a controller"),
        (["--host", ""], "host '' is no name or address of a controller"),
        (["--host", "x" * 5000], "is no name or address of a controller"),
        (["--base", "nowhere.json"], "nowhere.json does not exist: give a JSON file with T_table_base"),
    ],
)
def test_bad_options_are_refused_in_one_line(base_file, tmp_path, capsys, options, said):
    assert cli.main(command(base_file, tmp_path, *options)) == 2
    captured = capsys.readouterr()
    assert said in captured.err
    assert len(captured.err.splitlines()) == 1
    assert len(captured.err) < 300


def test_executing_needs_a_host(base_file, tmp_path, capsys):
    assert cli.main(command(base_file, tmp_path, "--execute")) == 2
    assert "--execute needs --host" in capsys.readouterr().err


def test_nothing_moves_before_somebody_says_yes(base_file, tmp_path, capsys, monkeypatch):
    answers, given = iter(["yes", "y", "", EOFError()]), []

    def answer(_question):
        if isinstance(reply := next(answers), str):
            return reply
        raise reply

    def fake_execute(host, legs, kinematics, T_table_base, out, limits, watch, confirm, film, **more):
        assert more == {"correction": (0.0, 0.0, 0.0), "is_ur10": False, "pose_watch": None}
        assert (host, out, film, watch.timeout) == ("arm", tmp_path / "recording.csv", None, 0.3)
        assert [leg.name for leg in legs] == ["descent", "lever-up", "set-down", "retreat"]
        given.extend(confirm([]) for _ in range(3))
        confirm([])

    monkeypatch.setattr("builtins.input", answer)
    monkeypatch.setattr("foretrace.cli.robot.move", fake_execute)
    options = ["--execute", "--host", "arm", "--speed", "1", "--timeout", "0.3"]
    assert cli.main(command(base_file, tmp_path, *options)) == 2
    assert given == [True, False, False]
    assert "no terminal to confirm in" in capsys.readouterr().err


def test_help_says_that_no_arm_was_moved(capsys):
    with pytest.raises(SystemExit):
        cli.main(["robot", "--help"])
    assert "NEVER TRIED ON A REAL ARM" in " ".join(capsys.readouterr().out.split())
