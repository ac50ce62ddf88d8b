"""The examples run as they stand, say something sensible, and stay short."""

import io
import json
import os
import re
import runpy
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from engines_at_hand import WITHOUT_BULLET
from export_samples import fake_data
from foretrace.actions import LeverUp
from foretrace.errors import SimulationError
from foretrace.objects import paper_objects
from foretrace.predictor import LstmConfig, save_checkpoint
from foretrace.simulation.camera import take_rgbd

EXAMPLES = Path(__file__).parents[1] / "examples"
MAX_LINES = 60


def run_python(*arguments: str | Path) -> str:
    """What a program prints."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def run_here(example: str, *arguments: str | Path) -> str:
    """What an example prints that needs PyTorch, which is loaded here already."""
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        patch.setattr(sys, "argv", [example, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / example), run_name="__main__")
    return printed.getvalue()


@pytest.mark.parametrize("example", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_examples_are_short_and_say_what_they_do(example: Path) -> None:
    text = example.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MAX_LINES
    assert text.startswith('"""')


def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = json.loads((EXAMPLES / "getting_started.ipynb").read_text(encoding="utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code)
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {}
    for cell in code:
        exec(compile("".join(cell["source"]), cell["id"], "exec"), found)
    assert found["effect"].outcome == "levered"
    assert found["error"] < 0.01
    assert found["verdict"].cause == "tracker frozen"
    assert Image.open(tmp_path / "imagined.png").width > 600


def test_own_experiment(tmp_path: Path) -> None:
    printed = run_python(EXAMPLES / "own_experiment.py", tmp_path / "out")
    assert len(re.findall(r"^\| (0.3|0.8|1.2) \| \d+\.\d\d \|$", printed, re.MULTILINE)) == 3
    assert {"rows.csv", "summary.json", "report.md"} <= {file.name for file in (tmp_path / "out").iterdir()}


def test_predict_a_polygon_with_a_predictor(tmp_path: Path) -> None:
    predictor = LstmConfig(features="none").make(num_samples=60)
    predictor.set_normalisation(np.zeros(3), np.ones(3), 0.05 * np.arange(60))
    save_checkpoint(tmp_path, predictor)  # made quickly, and wrong
    printed = run_here("predict_a_polygon.py", tmp_path)
    assert "outcome: levered" in printed
    assert 20 < float(re.findall(r"tilt at the end: ([\d.]+)", printed)[0]) < 80
    assert len(re.findall(r"\d s   x", printed)) == 6
    assert 0 < float(re.findall(r"over the trajectory: ([\d.]+) cm", printed)[0]) < 100


@pytest.mark.parametrize(
    ("example", "printed"),
    [
        ("own_predictor.py", r"the centre of mass ends at \[0\.\d+, "),
        ("own_feature.py", r"^extent \+ LSTM: the centre of mass ends at \["),
    ],
)
def test_own_predictors_and_features(tmp_path: Path, example: str, printed: str, registered: None) -> None:
    data = fake_data(tmp_path / "data", num=20)
    assert re.search(printed, run_here(example, data, tmp_path / "run"))
    assert (tmp_path / "run" / "model.safetensors").is_file()


def test_own_object_from_picture(tmp_path: Path) -> None:
    printed = run_python(EXAMPLES / "own_object_from_picture.py", tmp_path / "picture.png")
    assert "outcome: levered" in printed
    assert int(re.findall(r"differ between picture and polygon: (\d+)", printed)[0]) < 30
    assert Image.open(tmp_path / "picture.png").width > 500


def test_own_mesh() -> None:
    printed = run_python(EXAMPLES / "own_mesh.py")
    assert "looks like millimetres: give --scale 0.001" in printed
    assert "mass: 189 g" in printed  # 600 kg/m^3 x 14 cm x 9 cm x 2.5 cm on average
    assert re.findall(r"^edge (\d): \w+", printed, re.MULTILINE) == ["0", "1", "2", "3"]


def test_read_a_data_set() -> None:
    lines = run_python(EXAMPLES / "read_a_data_set.py").splitlines()  # it makes a tiny data set itself
    assert lines[0].startswith("7 interactions: {")
    counts = {name: int(count) for name, count in re.findall(r"'(\w+)': (\d+)", lines[0])}
    assert sum(counts.values()) == 7
    assert f"masks ({counts['levered']}, 128, 128)" in lines[2]
    assert sum(line.split()[0].isdigit() for line in lines[4:-1]) == sum(counts.values())


def test_tool_path_sweep() -> None:
    rows = run_python(EXAMPLES / "tool_path_sweep.py").splitlines()[1:]
    assert len(rows) == 9
    outcomes = [row.split("deg")[1].split()[0] for row in rows]
    assert set(outcomes) <= {"levered", "slipped", "tumbled", "rolled", "missed"}
    assert "levered" in outcomes


def test_same_shadow(tmp_path: Path) -> None:
    printed = run_python(EXAMPLES / "same_shadow.py", tmp_path / "figure.png")
    rolled, tumbled, flat = (float(text) for text in re.findall(r"(-?[\d.]+) cm along", printed))
    assert "cylinder: rolled" in printed
    assert "box: tumbled" in printed
    assert rolled > 12 > tumbled > 4 > abs(flat)
    assert Image.open(tmp_path / "figure.png").width > 1500


def test_everyday_objects(tmp_path: Path) -> None:
    run_python(EXAMPLES / "everyday_objects.py", picture := tmp_path / "figure.png")
    drawn = np.asarray(Image.open(picture).convert("RGB"))
    assert drawn.shape[1] > 1000
    blue, orange = ((drawn == colour).all(axis=-1).mean() for colour in ([207, 227, 241], [213, 94, 0]))
    assert 0.05 < blue < 0.5
    assert 0.005 < orange < 0.05


def test_render_scene(tmp_path: Path) -> None:
    obj = paper_objects(0, 1)[0]
    try:
        take_rgbd(obj, LeverUp.at_edge(obj, 0))
    except SimulationError as error:
        pytest.skip(str(error))
    printed = run_python(EXAMPLES / "render_scene.py", tmp_path / "scene.png")
    assert "levered, at 4 moments" in printed
    assert np.ptp(np.asarray(Image.open(tmp_path / "scene.png"))) > 100


@WITHOUT_BULLET
def test_own_action(tmp_path: Path) -> None:
    printed = run_python(EXAMPLES / "own_action.py", tmp_path / "nudges")
    moved = re.findall(r"nudged, ([\d.]+) cm in MuJoCo, ([\d.]+) in Bullet; same again: True", printed)
    assert len(moved) == 3
    assert all(abs(float(mujoco) - float(bullet)) < 1 for mujoco, bullet in moved)


def test_the_ros_node_predicts_and_watches(monkeypatch) -> None:
    """ROS is not installed here: stand-ins for its modules take the messages."""
    sent: dict[str, list[str]] = {}

    class Node:
        def __init__(self, name: str) -> None:
            self.subscribed: dict[str, Any] = {}

        def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
            return SimpleNamespace(publish=lambda message: sent.setdefault(topic, []).append(message.data))

        def create_subscription(self, kind: Any, topic: str, work: Any, depth: int) -> None:
            self.subscribed[topic] = work

        def get_logger(self) -> Any:
            return SimpleNamespace(error=sent.setdefault("errors", []).append)

    for name, content in {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "geometry_msgs.msg": {"PoseStamped": object},
        "std_msgs.msg": {"String": SimpleNamespace},
    }.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**content))
    node = runpy.run_path(str(EXAMPLES / "ros2_node.py"))["ForetraceNode"]()
    predict, watch = (node.subscribed[f"foretrace/{name}"] for name in ("predict", "object_pose"))
    prism = {
        "kind": "prism",
        "corners": [[0.09, 0], [0.02, 0.08], [-0.07, 0.05], [-0.08, -0.04], [0.03, -0.08]],
    }
    predict(SimpleNamespace(data=json.dumps({"object": prism, "action": {"contact": [0, 0.08]}})))
    assert json.loads(sent["foretrace/imagined"][0])["outcomes"]["levered"] > 0
    for k in range(3):
        stamp = SimpleNamespace(sec=100, nanosec=50_000_000 * k)
        place, turn = SimpleNamespace(x=0.1, y=0.0, z=0.0), SimpleNamespace(w=1.0, x=0.0, y=0.0, z=0.0)
        pose = SimpleNamespace(position=place, orientation=turn)
        watch(SimpleNamespace(header=SimpleNamespace(stamp=stamp), pose=pose))
    assert [json.loads(each)["alarm"] for each in sent["foretrace/verdict"]] == [False] * 3
    assert json.loads(sent["foretrace/verdict"][2])["time"] == pytest.approx(0.1)
    predict(SimpleNamespace(data="{}"))
    assert "object" in sent["errors"][0]
