"""The examples run as they stand, say something sensible, and stay short."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import foretrace as ft
from foretrace.features import make_features
from foretrace.predictor import LstmPredictor, save_checkpoint

EXAMPLES = Path(__file__).parents[1] / "examples"
MAX_LINES = 60


def run_example(name: str, *arguments: str | Path) -> str:
    """What an example prints."""
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("examples") / "data"
    simulation = ft.SimulationConfig(embodiment="tool")
    ft.collect(ft.CollectConfig(objects=2, contacts_per_edge=1, simulation=simulation), folder, workers=1)
    return folder


@pytest.mark.parametrize("example", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_examples_are_short_and_say_what_they_do(example: Path) -> None:
    text = example.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MAX_LINES
    assert text.startswith('"""')


def test_predict_a_polygon_with_a_predictor(tmp_path: Path) -> None:
    predictor = LstmPredictor(make_features("none"), num_samples=60)
    predictor.set_normalisation(np.zeros(3), np.ones(3), 0.05 * np.arange(60))
    save_checkpoint(tmp_path, predictor)  # untrained: quick, and wrong
    printed = run_example("predict_a_polygon.py", tmp_path)
    assert "outcome: levered" in printed
    assert 20 < float(re.findall(r"tilt at the end: ([\d.]+)", printed)[0]) < 80
    assert len(re.findall(r"\d s   x", printed)) == 6
    assert 0 < float(re.findall(r"over the trajectory: ([\d.]+) cm", printed)[0]) < 100


def test_own_object_from_picture(tmp_path: Path) -> None:
    printed = run_example("own_object_from_picture.py", tmp_path / "picture.png")
    assert "outcome: levered" in printed
    assert int(re.findall(r"differ between picture and polygon: (\d+)", printed)[0]) < 30
    assert Image.open(tmp_path / "picture.png").width > 500


def test_own_mesh() -> None:
    printed = run_example("own_mesh.py")
    assert "check unit (metres) or scale" in printed
    assert "mass: 189 g" in printed  # 600 kg/m^3 x 14 cm x 9 cm x 2.5 cm on average
    assert re.findall(r"^edge (\d): \w+", printed, re.MULTILINE) == ["0", "1", "2", "3"]


def test_read_a_data_set(data: Path) -> None:
    printed = run_example("read_a_data_set.py", data)
    dataset = ft.Dataset.open(data)
    assert printed.startswith(f"{len(dataset)} interactions")
    assert f"masks ({len(dataset.where(outcome='levered'))}, 128, 128)" in printed


def test_tool_path_sweep() -> None:
    rows = run_example("tool_path_sweep.py").splitlines()[1:]
    assert len(rows) == 9
    outcomes = [row.split("deg")[1].split()[0] for row in rows]
    assert set(outcomes) <= set(map(str, ft.Outcome))
    assert "levered" in outcomes
