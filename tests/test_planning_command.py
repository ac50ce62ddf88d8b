"""`foretrace plan`: from files, data sets and photographs to a plan, and from there to the robot."""

import json
from pathlib import Path

import numpy as np
import pytest

import foretrace as ft
from engines_at_hand import WITHOUT_BULLET
from foretrace.cli import main
from foretrace.geometry import invert_transform
from foretrace.interactions.recording_folder import read_image
from foretrace.simulation.recording import RecordingTruth
from recorded_scene import PRISM

OUTLINE = "0.09 0\n0.02 0.08\n-0.07 0.05\n-0.08 -0.04\n0.03 -0.08\n"
QUICK = ["--refine", "0", "--check", "0"]


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outline.txt").write_text(OUTLINE)
    base = {"format": "foretrace-base-pose", "version": 1, "T_table_base": [-0.75, 0, 0, 1, 0, 0, 0]}
    (tmp_path / "base.json").write_text(json.dumps(base))
    (tmp_path / "far.json").write_text(json.dumps({**base, "T_table_base": [-3, 0, 0, 1, 0, 0, 0]}))
    return tmp_path


def run(words: str) -> int:
    return main(words.split())


def test_polygon_to_plan_to_robot(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = "plan --polygon outline.txt --goal lift --max-slip 0.05 --pose 0.02 0.01 0.4 --base base.json"
    assert main([*command.split(), *QUICK]) == 0
    told = capsys.readouterr().out
    assert "goal: Lift(" in told
    assert "on the table: x" in told
    found = ft.Plan.open("plan/plan.json")
    assert read_image(Path("plan/plan.png")).shape[0] > 300
    assert run("robot plan/plan.json --base base.json --out slow") == 0
    checks = json.loads(Path("slow/checks.json").read_text())
    assert all(check["passed"] for check in checks)
    path = np.genfromtxt("slow/path.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    lever = path[path["leg"] == "lever-up"]
    start = found.table_action.contact - found.action.path.standoff * found.table_action.direction
    np.testing.assert_allclose([lever["tip_x_m"][0], lever["tip_y_m"][0]], start, atol=1e-4)
    capsys.readouterr()
    assert run("predict plan/plan.json --out shown") == 0
    assert Path("shown/plan.png").exists()
    assert "goal: Lift(" in capsys.readouterr().out


def test_the_next_lever_up_is_chosen_by_what_it_tells(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = "plan --polygon outline.txt --goal learn --spacing 0.08 --directions 1 --refine 0"
    assert run(command) == 0
    assert "goal: Learn(" in capsys.readouterr().out
    first = ft.Plan.open("plan/plan.json")
    known = {name: (value, value) for name, value in ft.Belief().mean.items()}
    ft.Belief(known).save("known.json")
    assert run(f"{command} --belief known.json --out again") == 0
    again = ft.Plan.open("again/plan.json")
    assert again.cost == pytest.approx(0, abs=0.05)  # nothing is left to learn
    assert first.cost < -1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--goal learn --friction 0.8", "leave out --friction"),
        ("--goal lift --belief none.json", "none.json"),
        ("--goal learn --unknown", "leave out --unknown"),
        ("--goal learn --steps 2", "leave out --every and --steps"),
        ("--goal learn --angle 0.3", "--angle goes with --goal tilt or turn"),
    ],
)
def test_a_belief_in_place_of_values(
    files: Path, capsys: pytest.CaptureFixture[str], options: str, words: str
) -> None:
    assert run(f"plan --polygon outline.txt {options}") == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_the_bevel_is_the_object_s_and_is_told(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = f"plan --polygon outline.txt {' '.join(QUICK)}"
    assert run(f"{words} --bevel-width 0.008 --bevel-height 0.0025") == 0
    found = ft.Plan.open("plan/plan.json")
    assert (found.object.bevel.width, found.object.bevel.height) == (0.008, 0.0025)
    assert found.imagined.context["bevel_width"] == pytest.approx(0.008)
    assert found.imagined.context["friction"] == pytest.approx(0.8)
    assert run(f"{words} --bevel-width 0.5") == 2
    assert (
        "leaves no bottom face (widest inner circle has radius 0.06685 m): give a smaller --bevel-width"
        in (" ".join(capsys.readouterr().err.split()))
    )
    assert run("plan --data none --every --bevel-width 0.008") == 2
    assert "leave out --bevel-width, or --every" in " ".join(capsys.readouterr().err.split())


def test_pushes_in_a_row(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = "plan --polygon outline.txt --action push --goal move-to --position 0.09 0.06 --turn 0.6"
    assert run(f"{command} --steps 3 --spacing 0.04 --refine 1 --samples 16 --tool-friction 0.25") == 0
    told = capsys.readouterr().out
    assert "push 1: contact x" in told
    assert "in its frame at the start" in told
    content = json.loads(Path("plan/sequence.json").read_text())
    first = ft.Plan.open("plan/plan.json")
    assert content["actions"][0] == first.action.to_dict()
    assert len(content["T_start_object"]) == len(content["actions"]) + 1
    assert run("robot plan/plan.json --base base.json") == 2
    refused = capsys.readouterr().err
    assert "does not know where the object lies on the table: plan with --photo or --pose X Y TURN" in refused
    assert run(f"{command} --steps 3 --base base.json --pose 0 0 0") == 2
    assert "--base goes with one action" in capsys.readouterr().err
    assert run(f"{command} --tool-friction 30") == 2
    assert "tool_friction is 30.0: give a value from 0 to 10" in capsys.readouterr().err
    assert run(f"{command} --friction 0.5") == 2
    assert "--friction: the sliding twin imaginer is not conditioned on it" in capsys.readouterr().err
    assert run(f"{command} somewhere") == 2
    assert "somewhere imagines its own action, once: leave it out" in capsys.readouterr().err


def test_a_plan_leaves_no_sequence_of_an_earlier_one(files: Path) -> None:
    Path("plan").mkdir()
    Path("plan/sequence.json").write_text("{}")
    assert main(["plan", "--polygon", "outline.txt", *QUICK]) == 0
    assert sorted(file.name for file in Path("plan").iterdir()) == ["plan.json", "plan.png"]


def test_object_of_a_data_set(files: Path) -> None:
    tool = ft.SimulationConfig(embodiment="tool")
    ft.collect(ft.CollectConfig(1, 1, simulation=tool), "data", workers=1)
    assert main(["plan", "--data", "data", "--id", "0", "--goal", "tumble", *QUICK]) == 0
    found = ft.Plan.open("plan/plan.json")
    assert found.object is not None
    np.testing.assert_allclose(found.object.corners, ft.Dataset.open("data").with_id(0).object.corners)


def test_what_is_told_and_what_is_avoided_change_the_plan(files: Path) -> None:
    Path("zone.txt").write_text("-0.3 -0.3\n-0.1 -0.3\n-0.1 0.3\n-0.3 0.3\n")
    whole = ["plan", "--polygon", "outline.txt", "--goal", "move", "--direction", "1", "0", *QUICK]
    assert main([*whole, "--out", "free"]) == 0
    assert main([*whole, "--avoid", "zone.txt", "--keep-upright", "--out", "kept"]) == 0
    free, kept = (ft.Plan.open(f"{name}/plan.json") for name in ("free", "kept"))
    assert free.action.contact[0] < -0.05 < kept.action.contact[0]
    assert kept.chances["entering the zone"] <= 0.05
    assert main([*whole, "--friction", "0.5", "--unknown", "--out", "told"]) == 0
    told = ft.Plan.open("told/plan.json").imagined.context
    assert told["friction"] == 0.5
    assert np.isnan(told["density"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("", "no object given"),
        ("--polygon outline.txt --goal tilt", "--goal tilt needs --angle"),
        ("--polygon outline.txt --angle 0.5", "--angle goes with --goal tilt"),
        ("--polygon outline.txt --goal turn-over", "either --edge or --direction"),
        ("--polygon outline.txt --goal turn-over --edge 9", "with 5 edges"),
        ("--polygon outline.txt --goal lift --max-slip 3", "max_slip is 3.0"),
        ("--polygon outline.txt --base base.json", "--pose X Y TURN"),
        ("--polygon outline.txt --base far.json --pose 0 0 0", "the robot reaches none"),
        ("--polygon outline.txt --base base.json --pose 0 0 0 --speed 7", "speed 7.0"),
        ("--polygon outline.txt --data data", "--data and --id go together"),
        ("--polygon outline.txt --data data --id 0", "leave out the other ways"),
        ("--polygon outline.txt --contact-px 3 4", "--contact-px goes with --photo"),
        ("--polygon outline.txt --density -1", "--density is -1.0"),
        ("--polygon outline.txt --cone 7", "cone = 7.0"),
        ("--photo p.jpg --pose 0 0 0", "leave --pose out"),
        ("--photo p.jpg --polygon outline.txt", "leave out the other ways"),
        ("--photo p.jpg", "does not exist"),
        ("--polygon outline.txt --avoid outline.txt", "lies in the zone"),
    ],
)
def test_mistakes_are_told_in_one_line(
    files: Path, capsys: pytest.CaptureFixture[str], options: str, message: str
) -> None:
    assert main(["plan", *options.split(), *QUICK]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert message in told[0]


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("robot --base base.json", "give a plan.json"),
        ("robot plan/plan.json --base base.json", "where the object lies"),
        ("robot plan/plan.json --base base.json --contact 0 0", "leave out --contact"),
        ("robot outline.txt --base base.json", "cannot be read as JSON"),
        ("predict plan/plan.json --edge 0", "leave out --edge"),
    ],
)
def test_mistakes_with_a_plan(
    files: Path, capsys: pytest.CaptureFixture[str], command: str, message: str
) -> None:
    assert main(["plan", "--polygon", "outline.txt", *QUICK]) == 0
    capsys.readouterr()
    assert run(command) == 2
    assert message in capsys.readouterr().err


def chain(folder: Path, *options: str) -> ft.Plan:
    """The plan from the first photograph of a recording."""
    command = ["plan", "--photo", str(folder / "colour-00000.jpg"), "--height", str(PRISM.height)]
    assert main([*command, "--goal", "lift", *options]) == 0
    return ft.Plan.open("plan/plan.json")


def true_action(found: ft.Plan, truth: RecordingTruth) -> ft.LeverUp:
    """The plan's lever-up in the frame of the object that was photographed."""
    T = invert_transform(truth.T_table_object[0])
    placed = found.table_action
    return ft.LeverUp(T[:2, :2] @ placed.contact + T[:2, 3], T[:2, :2] @ placed.direction)


@pytest.mark.slow
@WITHOUT_BULLET
def test_photograph_to_plan_to_the_real_object(recorded: tuple[Path, RecordingTruth], files: Path) -> None:
    """What is planned from a photograph happens to the object that was photographed: with the whole arm, and in an
    engine with other physics."""
    folder, truth = recorded
    found = chain(folder, "--background", str(folder / "background.png"), "--base", "base.json")
    assert Path("plan/overlay.png").exists()
    action = true_action(found, truth)
    action.check_contact(PRISM)
    assert run("robot plan/plan.json --base base.json --out path") == 0
    other = ft.Physics(friction=0.6, tool_friction=0.4)
    for settings in ({"embodiment": "arm"}, {"engine": "bullet", "embodiment": "tool", "physics": other}):
        effect = ft.simulate_lever_up(PRISM, action, ft.SimulationConfig(**settings)).effect
        assert effect.outcome == "levered"
        rise = effect.com_trajectory[-1, 2] - effect.com_trajectory[0, 2]
        assert rise == pytest.approx(-0.1 * found.cost, abs=0.01)


@pytest.mark.slow
def test_photograph_without_a_contact_shows_the_largest_object(
    recorded: tuple[Path, RecordingTruth], files: Path
) -> None:
    folder, truth = recorded
    found = chain(folder, "--depth", str(folder / "depth-00000.png"), "--no-flat", *QUICK)
    true_action(found, truth).check_contact(PRISM)
    assert found.object is None
