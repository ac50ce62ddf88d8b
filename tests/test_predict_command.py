"""`foretrace predict`: its example, the moving object, the table of a motion, and many predictions at once."""

import csv
import io
import json
import re
import shlex
import shutil
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import foretrace as ft
from foretrace import cli
from foretrace.geometry import quaternion_to_matrix, rotation_vector_to_quaternion
from foretrace.imagined import Imaginer
from foretrace.imagined.futures import carried_poses
from foretrace.imagined.observed import rotations_since_rest
from foretrace.perception.example import CONTACT, HEIGHT, MASK, SCALE
from foretrace.pictures import animation
from foretrace.pictures.prediction import scene_of
from foretrace.predictor import load_imaginer
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up

ASSETS = Path(ft.__file__).parent / "assets/example"
OBJECT = ["--image", str(ASSETS / MASK), "--scale", str(SCALE), "--height", str(HEIGHT)]


def table(file: Path) -> list[dict[str, str]]:
    with open(file, newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A folder in which the example was predicted, and what that printed."""
    folder = tmp_path_factory.mktemp("example")
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.chdir(folder)
        assert cli.main(["predict", "--example"]) == 0
    return folder, out.getvalue(), err.getvalue()


def test_the_example_works_in_an_empty_folder_and_so_do_the_commands_it_prints(
    example: tuple[Path, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, printed, told = example
    monkeypatch.chdir(folder)
    assert told == "", "the example is nothing unusual"
    assert "outcome: levered over 99" in printed
    own = json.loads(Path("prediction/trajectory.json").read_text())
    commands = re.findall(r"^  foretrace (.*?[^\\])$", printed, re.MULTILINE | re.DOTALL)
    assert len(commands) == 2
    for command in commands:
        words = shlex.split(command.replace("\\\n", " "))
        assert cli.main([*words, "--no-animation", "--out", "again"]) == 0
        again = json.loads(Path("again/trajectory.json").read_text())
        ends = np.array([np.array(each["com_trajectory"])[59] for each in (own, again)])
        # The photograph's outline is found to a pixel or two.
        assert np.linalg.norm(ends[1] - ends[0]) < (0.01 if "--photo" in words else 1e-9)
    assert Path("again/overlay.png").stat().st_size > 100_000


def test_the_object_moves_in_the_animation(example: tuple[Path, str, str]) -> None:
    folder = example[0] / "prediction"
    with Image.open(folder / "prediction.gif") as image:
        assert image.n_frames == 60, "to the action's end, 2.95 s"
        first = np.asarray(image.convert("RGB"), dtype=int)[60:340, :540]
        image.seek(59)
        last = np.asarray(image.convert("RGB"), dtype=int)[60:340, :540]
    # A body's worth of pixels has changed, not a dot's.
    assert np.count_nonzero(np.abs(last - first).max(axis=2) > 20) > 8000
    rows = table(folder / "trajectory.csv")
    assert list(rows[0]) == ["time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]
    turned = np.array([[float(row[name]) for name in ("qw", "qx", "qy", "qz")] for row in rows])
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1.0, atol=1e-9)
    angles = 2 * np.degrees(np.arctan2(np.linalg.norm(turned[:, 1:], axis=1), np.abs(turned[:, 0])))
    assert angles[0] < 0.1
    assert 30 < angles[-1] < 70


def test_the_simulated_object_moves_and_the_prediction_beside_it() -> None:
    prism = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
    action = ft.LeverUp.at_edge(prism, 2, 0.4)
    imagined = load_imaginer().imagine(ft.TopDownView.of(prism, action), action)
    truth = simulate_lever_up(prism, action, SimulationConfig(embodiment="tool"))
    scene = scene_of(prism, action, imagined, "one-shot", truth)
    np.testing.assert_array_equal(scene.pose, truth.effect.pose_trajectory)
    (ghost,) = scene.ghosts
    assert np.linalg.norm(ghost.pose[-1, :3] - scene.pose[-1, :3]) < 0.01
    alone, beside = (next(animation.frames(replace(scene, ghosts=each))) for each in ((), scene.ghosts))
    assert np.count_nonzero((alone != beside).any(axis=2)) > 200


def test_poses_of_the_object_are_those_of_its_frame() -> None:
    prism = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
    action = ft.LeverUp.at_edge(prism, 2, 0.4)
    effect = simulate_lever_up(prism, action, SimulationConfig(embodiment="tool")).effect
    quaternions = rotation_vector_to_quaternion(rotations_since_rest(effect.pose_trajectory))
    moved = np.column_stack([effect.com_trajectory, quaternions])
    found = carried_poses(moved, action.T_action_object)
    np.testing.assert_allclose(found[:, :3], effect.pose_trajectory[:, :3], atol=1e-4)
    wanted = quaternion_to_matrix(effect.pose_trajectory[:, 3:])
    np.testing.assert_allclose(quaternion_to_matrix(found[:, 3:]), wanted, atol=1e-3)


def test_many_contacts_and_images_give_the_predictions_of_one_by_one(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name in ("b.png", "a.png"):
        shutil.copy(ASSETS / MASK, images / name)
    (images / "notes.txt").write_text("no image")
    many = ["predict", "--images", str(images), *OBJECT[2:], "--out", str(tmp_path)]
    assert cli.main([*many, "--contacts", "12"]) == 0
    rows = table(tmp_path / "predictions.csv")
    assert [row["object"] for row in rows] == ["a.png"] * 12 + ["b.png"] * 12
    assert len({row["contact_x_m"] for row in rows}) > 10
    contact = [str(value) for value in CONTACT]
    assert cli.main([*many, "--contact", *contact]) == 0
    (row, other) = table(tmp_path / "predictions.csv")
    assert {**row, "object": ""} == {**other, "object": ""}
    one = [*OBJECT, "--contact", *contact, "--no-animation", "--out", str(tmp_path)]
    assert cli.main(["predict", *one]) == 0
    content = json.loads((tmp_path / "trajectory.json").read_text())
    path = np.array(content["com_trajectory"])[:60]
    assert row["outcome"] == "levered"
    assert float(row["probability"]) == pytest.approx(content["outcomes"]["levered"], abs=0.01)
    # One view serves all contacts: its pixels lie otherwise.
    assert float(row["rise_m"]) == pytest.approx(path[-1, 2] - path[0, 2], abs=0.002)
    moved = np.hypot(float(row["moved_x_m"]), float(row["moved_y_m"]))
    assert moved == pytest.approx(np.linalg.norm((path[-1] - path[0])[:2]), abs=0.002)
    assert float(row["moved_x_m"]) > 0.02, "away from the blade, in the image's frame"


def test_images_that_cannot_be_used_are_told_and_the_others_predicted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name in ("b.png", "d.png"):
        shutil.copy(ASSETS / MASK, images / name)
    (images / "a.png").write_text("no image")
    Image.new("L", (200, 200)).save(images / "c.png")
    (images / "e.png").mkdir()
    many = ["predict", "--images", str(images), *OBJECT[2:], "--contacts", "3", "--out", str(tmp_path)]
    assert cli.main(many) == 1
    assert [row["object"] for row in table(tmp_path / "predictions.csv")] == ["b.png"] * 3 + ["d.png"] * 3
    told = capsys.readouterr().err.splitlines()
    assert [Path(line.split(": ")[1].split(" ")[0]).name for line in told[:-1]] == ["a.png", "c.png", "e.png"]
    assert told[-1] == "foretrace: 3 of 5 images cannot be used and have no row: mend or remove them"
    for name in ("b.png", "d.png"):
        (images / name).unlink()
    (tmp_path / "predictions.csv").unlink()
    assert cli.main(many) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 4
    assert "3 of 3 images cannot be used" in told[-1]
    assert not (tmp_path / "predictions.csv").exists()


def test_the_bevel_is_the_object_s_and_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["predict", *OBJECT, "--contact", *map(str, CONTACT), "--no-animation", "--out"]
    assert cli.main([*command, str(tmp_path / "own"), "--bevel-height", "0.0024", "--compare"]) == 0
    assert cli.main([*command, str(tmp_path / "nominal")]) == 0
    own, nominal = (
        json.loads((tmp_path / name / "trajectory.json").read_text()) for name in ("own", "nominal")
    )
    assert (own["object"]["bevel"][1], nominal["object"]["bevel"][1]) == (0.0024, 0.003)
    assert own["simulated"]["outcome"] == "levered"
    apart = np.abs(np.subtract(own["com_trajectory"], nominal["com_trajectory"])).max()
    assert 0.0002 < apart < 0.02
    capsys.readouterr()
    assert cli.main([*command, str(tmp_path / "high"), "--bevel-height", "0.5"]) == 2
    assert (
        "bevel of height 0.5 m on an object of height 0.018 m: give a smaller --bevel-height, or leave it out"
        in (" ".join(capsys.readouterr().err.split()))
    )
    box = tmp_path / "box.stl"
    trimesh.creation.box((0.1, 0.08, 0.03)).export(box)
    assert (
        cli.main(
            ["predict", "--mesh", str(box), "--edge", "0", "--bevel-width", "0.005", "--out", str(tmp_path)]
        )
        == 2
    )
    assert "--bevel-width is for outlines" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--example", "--edge", "1"], "--example has object and contact: leave out --edge"),
        (["--example", "--contacts", "3"], "leave out --contacts"),
        ([*OBJECT, "--contacts", "0"], "--contacts is 0: give a number from 1 to 10000"),
        ([*OBJECT, "--contacts", "3", "--edge", "1"], "leave out --edge, --fraction and --contact"),
        ([*OBJECT, "--contacts", "3", "--compare"], "go without --compare"),
        ([*OBJECT, "--images", "{folder}", "--contacts", "3"], "leave out --polygon, --image and --mesh"),
        (["--images", "{folder}/none", "--scale", "0.1", "--contacts", "3"], "is no folder"),
        (["--images", "{folder}", "--scale", "0.1", "--contacts", "3"], "has no images (.png"),
        (["--images", "{assets}", "--contacts", "3"], "--image needs --scale"),
    ],
)
def test_what_cannot_be_predicted_is_refused(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    only_mask = tmp_path / "assets"
    only_mask.mkdir()
    shutil.copy(ASSETS / MASK, only_mask)
    (tmp_path / "empty").mkdir()
    words = [word.format(folder=tmp_path / "empty", assets=only_mask) for word in options]
    assert cli.main(["predict", *words, "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1


@pytest.mark.parametrize(("outline", "height", "wide", "high"), [
    ("0 0\n0.15 0\n0.15 0.016\n0 0.016\n", 0.02, 0.004, 0.004 / 3),
    ("0 0\n0.15 0\n0.15 0.14\n0 0.14\n", 0.003, 0.0045, 0.0015),
    ("0 0\n0.15 0\n0.15 0.14\n0 0.14\n", 0.02, 0.009, 0.003),
])  # fmt: skip
@pytest.mark.parametrize("many", [False, True])
def test_a_slender_or_thin_outline_has_the_bevel_that_it_bears(
    tmp_path, monkeypatch, outline, height, wide, high, many
):
    (tmp_path / "outline.txt").write_text(outline)
    told = []
    name = "imagine_candidates" if many else "imagine"
    own = getattr(Imaginer, name)
    monkeypatch.setattr(
        Imaginer, name, lambda *args, **known: told.append(known["context"]) or own(*args, **known)
    )
    at = ["--contacts", "2"] if many else ["--edge", "0", "--no-animation"]
    words = ["predict", "--polygon", str(tmp_path / "outline.txt"), "--height", str(height), *at]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 0
    assert [told[0][name] for name in ("bevel_width", "bevel_height")] == pytest.approx([wide, high])


@pytest.mark.parametrize(
    ("speed", "words"), [("0.3", "takes 8.32 s, of which the first 5.6 s are imagined"), ("0.6", "")]
)
def test_an_action_that_is_cut_short_is_pointed_out(tmp_path, capsys, speed, words):
    (tmp_path / "outline.txt").write_text("0 0\n0.15 0\n0.15 0.14\n0 0.14\n")
    command = ["predict", "--polygon", str(tmp_path / "outline.txt"), "--edge", "0", "--no-animation"]
    assert cli.main([*command, "--speed", speed, "--out", str(tmp_path)]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert words in said
    assert ("of which the first" in said) == bool(words)
