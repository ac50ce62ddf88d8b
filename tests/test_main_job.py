"""The command line end to end on small data, and the built wheel."""

import json
import subprocess
import sys
import venv
import zipfile
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import trimesh
from PIL import Image

from foretrace import cli
from foretrace.cli import demo
from foretrace.evaluation.metrics import at_times
from foretrace.pictures import animation
from foretrace.predictor import Futures, ImaginedBatch

ROOT = Path(__file__).parents[1]
SMALL_TRAINING = [
    *("train", "--features", "im-cnn", "--hidden", "8", "--epochs", "2", "--min-steps", "1"),
    *("--device", "cpu", "--threads", "1"),
]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("main-job") / "data"
    command = ["simulate", "--out", str(folder), "--objects", "8", "--contacts-per-edge", "1"]
    assert cli.main([*command, "--embodiment", "tool", "--workers", "1"]) == 0
    return folder


@pytest.fixture(scope="module")
def run(data: Path) -> Path:
    out = data.parent / "run"
    assert cli.main([*SMALL_TRAINING, "--data", str(data), "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def polygon(data: Path) -> Path:
    file = data.parent / "corners.txt"
    file.write_text("# a kite\n0.09 0.0\n0.0, 0.08\n-0.07 0.0\n0.0 -0.08\n")
    return file


def error_of(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that a refused command prints."""
    capsys.readouterr()
    assert cli.main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


def test_evaluate_prints_and_writes_the_paper_errors(
    run: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "errors"
    assert cli.main(["evaluate", "predictor", str(run), "--data", str(data), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "all, start from view" in printed
    assert max(len(line) for line in printed.splitlines() if line.startswith("|")) <= 80
    assert printed.splitlines()[-1].startswith(str(out))
    rows = pd.read_csv(out / "rows.csv")
    overall = rows[(rows["group"] == "all") & (rows["start"] == "observed")]
    assert set(overall["metric"]) == {"full", "final"}
    assert (overall["mean_cm"] > 0).all()
    assert overall["count"].iloc[0] == len(json.loads((run / "split.json").read_text())["test"])


def test_evaluate_judges_by_data_that_the_training_never_saw(run: Path, data: Path, tmp_path: Path) -> None:
    out = tmp_path / "errors"
    command = ["evaluate", "predictor", str(run), "--data", str(data), "--part", "all", "--out", str(out)]
    assert cli.main(command) == 0
    rows = pd.read_csv(out / "rows.csv")
    assert rows.loc[rows["group"] == "all", "count"].iloc[0] == 52


def test_imagined_paths_are_compared_at_the_times_of_the_data() -> None:
    times = np.linspace(0, 1, 11)
    com = np.repeat((times**2)[None, :, None], 3, axis=2)
    imagined = ImaginedBatch(times, com, None, Futures.point(com, None, "levered"))
    np.testing.assert_array_equal(at_times(imagined, times), imagined.com)
    np.testing.assert_array_equal(at_times(imagined, times[:5]), imagined.com[:, :5])
    between = at_times(imagined, np.array([0.05, 0.1, 1.0, 1.1]))
    np.testing.assert_allclose(between[0, :3, 0], [0.005, 0.01, 1.0])
    assert np.isnan(between[0, 3]).all()


def test_describe_writes_figures(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    assert cli.main(["data", str(data), "--out", str(out)]) == 0
    figures = json.loads(out.read_text())
    assert figures["interactions"] == sum(figures["outcomes"].values()) == 52
    assert 20 < figures["median_final_tilt_deg"] < 80


def test_predict_a_polygon_and_compare(
    run: Path, polygon: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "prediction"
    command = ["predict", str(run), "--polygon", str(polygon), "--edge", "0", "--compare"]
    assert cli.main([*command, "--no-animation", "--out", str(out)]) == 0
    assert "cm over the trajectory" in capsys.readouterr().out
    content = json.loads((out / "trajectory.json").read_text())
    table = pd.read_csv(out / "trajectory.csv")
    np.testing.assert_allclose(table[["x_m", "y_m", "z_m"]], content["com_trajectory"])
    assert len(content["com_trajectory"]) == len(content["times"]) == 60
    # The first row is the centre of mass at rest, in the action frame.
    np.testing.assert_allclose(
        content["com_trajectory"][0], content["simulated"]["com_trajectory"][0], atol=1e-5
    )
    assert Image.open(out / "prediction.png").width > 1000


def test_predict_an_image_with_animation(run: Path, tmp_path: Path) -> None:
    picture = np.zeros((200, 200), np.uint8)
    cv2.rectangle(picture, (40, 60), (160, 140), 255, -1)
    cv2.imwrite(str(tmp_path / "mask.png"), picture)
    command = ["predict", str(run), "--image", str(tmp_path / "mask.png"), "--scale", "0.001"]
    assert cli.main([*command, "--contact", "0", "0.05", "--out", str(tmp_path / "out")]) == 0
    assert Image.open(tmp_path / "out" / "prediction.gif").n_frames > 20
    assert json.loads((tmp_path / "out" / "trajectory.json").read_text())["direction"] == pytest.approx(
        [0, -1]
    )


def test_predict_a_mesh(run: Path, tmp_path: Path) -> None:
    trimesh.creation.box((0.16, 0.1, 0.03)).export(tmp_path / "box.stl")
    command = ["predict", str(run), "--mesh", str(tmp_path / "box.stl"), "--edge", "1", "--no-animation"]
    assert cli.main([*command, "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "trajectory.csv").is_file()


def test_wrong_input_is_one_clear_line(
    run: Path, data: Path, polygon: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.txt"
    bad.write_text("1 2 3\n4 5 6\n")
    empty = tmp_path / "empty.txt"
    empty.write_text("# no corners yet\n")
    crossed = tmp_path / "crossed.txt"
    crossed.write_text("0 0\n0.1 0.1\n0.1 0\n0 0.1\n")
    shape = ["--polygon", str(polygon)]
    cases = {
        "no object given": ["predict", str(run), "--edge", "0"],
        "either --edge": ["predict", str(run), *shape],
        "--hull goes with --photo": ["predict", str(run), *shape, "--edge", "0", "--hull"],
        "--photo shows the object": ["predict", str(run), *shape, "--photo", str(polygon)],
        "choose 0 to 3": ["predict", str(run), *shape, "--edge", "4"],
        "between 0 and 1": ["predict", str(run), *shape, "--edge", "0", "--fraction", "1.5"],
        "holds no corners": ["predict", str(run), "--polygon", str(empty), "--edge", "0"],
        "3 numbers per line": ["predict", str(run), "--polygon", str(bad), "--edge", "0"],
        "Self-intersection": ["predict", str(run), "--polygon", str(crossed), "--edge", "0"],
        "none.txt does not exist": [
            "predict",
            str(run),
            "--polygon",
            str(tmp_path / "none.txt"),
            "--edge",
            "0",
        ],
        "needs --scale": ["predict", str(run), "--image", str(polygon), "--edge", "0"],
        "cannot read an image": ["predict", str(run), "--image", *shape[1:], "--scale", "1", "--edge", "0"],
        "seed is -1": ["train", "--data", str(data), "--out", str(tmp_path / "r"), "--seed", "-1"],
        "threads is 0": ["train", "--data", str(data), "--out", str(tmp_path / "r"), "--threads", "0"],
        "density is 1e-30": ["predict", *shape, "--edge", "0", "--compare", "--density", "1e-30"],
        "--seconds is nan": ["capture", str(tmp_path / "film"), "--seconds", "nan"],
        "none, im-cnn": ["train", "--data", str(data), "--out", str(tmp_path / "r"), "--features", "sift"],
        str(tmp_path / "empty"): ["predict", str(tmp_path / "empty"), *shape, "--edge", "0"],
        "give the folder of a trained predictor": ["evaluate", "predictor", str(data), "--data", str(data)],
    }
    for expected, arguments in cases.items():
        assert expected in error_of(arguments, capsys), arguments


def test_a_finished_training_is_not_repeated(run: Path, data: Path) -> None:
    before = (run / "model.safetensors").read_bytes()
    assert cli.main([*SMALL_TRAINING, "--data", str(data), "--out", str(run)]) == 0
    assert (run / "model.safetensors").read_bytes() == before


def test_a_card_is_written_for_a_finished_training(run: Path, data: Path) -> None:
    assert cli.main([*SMALL_TRAINING, "--data", str(data), "--out", str(run), "--card"]) == 0
    assert (run / "MODEL_CARD.md").read_text().startswith("# Model card: lstm predictor")


def test_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    every_frame = animation.frames
    monkeypatch.setattr(animation, "frames", lambda scene: islice(every_frame(scene), 2))
    monkeypatch.setattr(demo, "HELD_OUT_CORNERS", (6,))
    small = ["--objects", "8", "--contacts-per-edge", "1", "--epochs", "1", "--min-steps", "1"]
    assert cli.main(["demo", "--out", str(tmp_path), "--workers", "1", *small]) == 0
    printed = capsys.readouterr().out
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert printed.splitlines()[-1] == str(tmp_path / "index.html")
    names = ("interactions", "predictions", "shipped", "plan-lift", "plan-move", "monitor")
    for name in (*(f"{name}.png" for name in names), "prediction.gif"):
        assert (tmp_path / name).stat().st_size > 10_000
        assert f'src="{name}"' in page
    assert (tmp_path / "runs/one-shot/model.safetensors").is_file()


@pytest.mark.slow
def test_the_built_wheel_holds_everything(tmp_path: Path) -> None:
    """A wheel built from the checkout runs without it, and carries its assets."""
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--wheel-dir", str(tmp_path), str(ROOT)], check=True)
    (wheel,) = tmp_path.glob("foretrace-*.whl")
    environment = tmp_path / "venv"
    venv.create(environment, system_site_packages=False, with_pip=False)
    (packages,) = environment.glob("lib/python*/site-packages")
    # The dependencies are this environment's; only foretrace itself comes from the wheel.
    trimesh_home = Path(trimesh.__file__).parents[1]
    (packages / "dependencies.pth").write_text(f"{trimesh_home}\n")
    zipfile.ZipFile(wheel).extractall(packages)
    program = (
        "import foretrace as ft, foretrace.cli.demo as d; from pathlib import Path;"
        "print(ft.__file__); assert (Path(ft.__file__).parent / 'assets' / 'racket.png').is_file();"
        "p = ft.Prism([[0, 0], [.1, 0], [.1, .1], [0, .1]]); a = ft.LeverUp.at_edge(p, 0);"
        "print(ft.simulate(p, a, embodiment='tool').effect.outcome)"
    )
    if (ROOT / "src/foretrace/predictor/default").is_dir():
        shipped = (
            "v = ft.TopDownView.of(p, a); assert ft.load_predictor().imagine(v).com_trajectory.shape[1] == 3;"
        )
        program = program.replace("print(ft.simulate", f"{shipped}print(ft.simulate")
    python = environment / "bin" / "python"
    done = subprocess.run(
        [python, "-I", "-c", program], check=True, capture_output=True, text=True, cwd=tmp_path
    )
    assert str(packages) in done.stdout
    assert done.stdout.splitlines()[-1] in ("levered", "slipped")
