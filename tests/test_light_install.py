"""What works without the extras, what is imported when, and the shipped predictor in ONNX Runtime."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pytest

import foretrace as ft
from foretrace.errors import CheckpointError
from foretrace.extras import EXTRA_OF, MissingExtraError, missing_extra, named_extras
from foretrace.objects import sample_prism
from foretrace.planning.candidates import Scene
from foretrace.predictor import LstmPredictor, OnnxPredictor, load_imaginer, load_predictor
from foretrace.predictor.loading import PORTABLE, default_checkpoint

ROOT = Path(__file__).parents[1]
NAMES = {
    "OpenGL": "pyopengl",
    "imageio_ffmpeg": "imageio-ffmpeg",
    "mujoco_warp": "mujoco-warp",
    "warp": "warp-lang",
}
"""Names of distributions where they are not those of modules."""
BARE = f"""
import importlib.abc
import sys

class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted(EXTRA_OF)}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Hidden())
import importlib.util
own = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in {sorted(EXTRA_OF)} else own(name, package)
"""
"""Begins a program that runs as if no extra were installed."""
TOUR = """
import os, sys, warnings
import foretrace as ft
from foretrace.cli import main

box = ft.Box(0.15, 0.13, 0.02)
action = ft.LeverUp.at_edge(box, 0)
predictor = ft.load_predictor()
assert type(predictor).__name__ == "OnnxPredictor", predictor
imagined = predictor.imagine(ft.TopDownView.of(box, action), action, context=ft.Belief(worlds=8))
print(ft.Monitor(imagined).update(0.0, [0, 0, 0, 1, 0, 0, 0]).message)
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    found = ft.plan(box, ft.goals.Lift(max_slip=0.5), config=ft.PlanConfig(spacing=0.05, refine=0))
print(told[0].message)
for attempt in (
    lambda: ft.simulate(box, action),
    lambda: ft.Dataset,
    lambda: ft.train_predictor,
    lambda: ft.load_predictor(os.getcwd()),
    lambda: ft.TwinImaginer(),
):
    try:
        attempt()
    except ft.ForetraceError as error:
        print(error)
assert main(["predict", "--example", "--out", "out"]) == 0
found.save("plan.json")
poses = found.imagined.object_poses(found.action.T_action_object)
with open("poses.csv", "w") as file:
    print("time_s,x_m,y_m,z_m,qw,qx,qy,qz", file=file)
    for time, pose in zip(found.imagined.times, poses):
        print(time, *pose, sep=",", file=file)
assert main(["monitor", "plan.json", "--poses", "poses.csv", "--out", "monitor.png"]) == 0
for command in (["train", "--help"], ["simulate", "--out", "d"], ["evaluate", "predictor", "r", "--data", "d"],
                ["demo"], ["studio"], ["serve"], ["monitor", "d", "0", "--out", "m.png"]):
    assert main(command) == 2, command
"""


def test_the_extras_are_those_of_the_package() -> None:
    content = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    words = re.compile(r"[\w-]+")
    extras = {
        name: {word.group().lower() for each in requirements if (word := words.match(each))}
        for name, requirements in content["optional-dependencies"].items()
    }
    core = {word.group().lower() for each in content["dependencies"] if (word := words.match(each))}
    for module, extra in EXTRA_OF.items():
        distribution = NAMES.get(module, module)
        assert distribution in extras[extra], (module, extra)
        assert distribution not in core
    everything = set(extras) - {"all", "dev", "docs", "warp"}  # Warp is large, and of use with a GPU alone
    (line,) = content["optional-dependencies"]["all"]
    assert set(re.findall(r"\w+", line)) - {"foretrace"} == everything


def test_core_works_without_the_extras_and_names_them(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", BARE + TOUR], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    needs = "this needs {}, which is not installed: pip install 'foretrace[{}]'".format
    assert lines[0] == "as imagined"
    assert lines[1] == f"the best candidates are not checked by the twin: {needs('mujoco', 'sim')}"
    wanted = [
        ("mujoco", "sim"),
        ("pyarrow", "sim"),
        ("torch", "train"),
        ("torch", "train"),
        ("mujoco", "sim"),
    ]
    assert lines[2:7] == [needs(*pair) for pair in wanted]
    told = done.stderr.splitlines()
    wanted = [
        ("torch", "train"),
        ("pyarrow", "sim"),
        ("pandas", "eval,sim,train"),
        ("pandas", "eval,sim,train"),
        ("pyarrow", "sim,studio"),
        ("uvicorn", "studio"),
        ("pyarrow", "sim"),
    ]
    assert told[-7:] == [f"foretrace: error: {needs(*pair)}" for pair in wanted]
    assert (tmp_path / "out/prediction.gif").stat().st_size > 100_000


@pytest.mark.parametrize(
    ("program", "unwanted"),
    [
        ("import foretrace", {"numpy"}),
        ("from foretrace.cli import main; main(['--help'])", {"numpy"}),
        (
            "from foretrace.cli import main; main(['predict', '--example', '--out', 'out', '--no-animation'])",
            {*EXTRA_OF, "scipy", "onnx"},
        ),
        (
            "import foretrace as ft; ft.plan, ft.Monitor, ft.identify, ft.load_predictor",
            {*EXTRA_OF, "matplotlib"},
        ),
    ],
)
def test_what_is_not_needed_is_not_imported(program: str, unwanted: set[str], tmp_path: Path) -> None:
    told = "\nimport sys; print(sorted({name.partition('.')[0] for name in sys.modules}))"
    done = subprocess.run(
        [sys.executable, "-c", program + told], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    assert not unwanted & set(ast.literal_eval(done.stdout.splitlines()[-1]))


def test_onnx_runtime_imagines_what_pytorch_imagines() -> None:
    ours, theirs = load_imaginer(), load_predictor()
    assert isinstance(ours, OnnxPredictor)
    assert not isinstance(theirs, OnnxPredictor)
    assert (ours.context, ours.marginal, ours.observes) == (theirs.context, theirs.marginal, theirs.observes)
    assert (ours.name, ours.display_name) == (theirs.name, theirs.display_name)
    rng = np.random.default_rng(3)
    contexts = (None, "unknown", {"friction": 0.6}, {"friction": 0.6, "tool_friction": 0.3, "density": 500.0})
    for number in range(12):
        prism = ft.Prism(sample_prism(rng, int(rng.integers(3, 11))).corners, 0.01 + 0.008 * number)
        action = ft.LeverUp.at_edge(
            prism, int(rng.integers(len(prism.corners))), float(rng.uniform(0.2, 0.8))
        )
        view, given = ft.TopDownView.of(prism, action), {"context": contexts[number % 4]}
        if number % 3:
            given["com"] = (action.T_action_object @ [*prism.mass_properties(1.0).com, 1.0])[:3]
        one, other = ours.imagine(view, action, **given), theirs.imagine(view, action, **given)
        assert one.warnings == other.warnings
        np.testing.assert_allclose(one.com_trajectory, other.com_trajectory, atol=1e-5, rtol=0)
        np.testing.assert_allclose(one.pose_trajectory, other.pose_trajectory, atol=1e-5, rtol=0)
        for name in ("probability", "spread", "support_points", "quantiles"):
            found, wanted = (getattr(each.futures, name) for each in (one, other))
            np.testing.assert_allclose(found, wanted, atol=1e-5, rtol=1e-4)
        assert one.futures.outcome == other.futures.outcome
        scene = Scene.of(prism)
        actions = scene.in_view([ft.LeverUp.at_edge(prism, edge) for edge in range(len(prism.corners))])
        many = [imaginer.imagine_candidates(scene.view, actions) for imaginer in (ours, theirs)]
        np.testing.assert_allclose(many[0].com, many[1].com, atol=1e-5, rtol=0)
        np.testing.assert_allclose(many[0].futures.probability, many[1].futures.probability, atol=1e-5)
        assert many[0].warnings == many[1].warnings


def test_samples_under_way_count_in_onnx_runtime_too() -> None:
    prism = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
    action = ft.LeverUp.at_edge(prism, 2)
    effect, view = ft.simulate(prism, action, embodiment="tool").effect, ft.TopDownView.of(prism, action)
    seen = ft.ObservedMotion.of(effect, until=1.0)
    one, other = (each.imagine(view, observed=seen) for each in (load_imaginer(), load_predictor()))
    np.testing.assert_allclose(one.com_trajectory, other.com_trajectory, atol=1e-5, rtol=0)


def test_files_that_are_no_predictor_are_refused(tmp_path: Path) -> None:
    whole = (default_checkpoint() / PORTABLE).read_bytes()
    cut = tmp_path / "cut.onnx"
    cut.write_bytes(whole[: len(whole) // 2])
    for file, message in ((tmp_path / "none.onnx", "does not exist"), (cut, "cannot be read")):
        with pytest.raises(CheckpointError, match=message):
            OnnxPredictor(file)


def test_a_folder_for_a_hub_is_read_again(tmp_path: Path) -> None:
    predictor = load_predictor()
    predictor.save_pretrained(tmp_path / "hub")
    files = {file.name for file in (tmp_path / "hub").iterdir()}
    assert files == {"README.md", "config.json", "model.safetensors"}
    card = (tmp_path / "hub/README.md").read_text(encoding="utf-8")
    assert card.startswith("---\nlibrary_name: foretrace\n")
    assert "| Weights | 755,250 |" in card
    again = ft.EffectPredictor.from_pretrained(tmp_path / "hub")
    assert again.learned_from == predictor.learned_from
    assert again.ranges == predictor.ranges
    for name, tensor in predictor.state_dict().items():
        assert tensor.equal(again.state_dict()[name])
    with pytest.raises(CheckpointError, match=r"one-shot', no LstmPredictor: take OneShotPredictor"):
        LstmPredictor.from_pretrained(tmp_path / "hub")
    with pytest.raises(CheckpointError, match="give the folder of a trained predictor"):
        ft.EffectPredictor.from_pretrained(tmp_path)
    (tmp_path / "hub/README.md").write_text("own")
    predictor.save_pretrained(tmp_path / "hub")
    assert (tmp_path / "hub/README.md").read_text() == "own"


def test_the_description_has_absolute_links() -> None:
    spec = spec_from_file_location("description", ROOT / ".ci/description.py")
    assert spec is not None
    assert spec.loader is not None
    description = module_from_spec(spec)
    spec.loader.exec_module(description)
    given = "![a](docs/a.png) [b](https://b.org/c) [d](#e) [f](docs/g.md#h)"
    wanted = "![a](https://u.org/m/docs/a.png) [b](https://b.org/c) [d](#e) [f](https://u.org/m/docs/g.md#h)"
    assert description.absolute(given, "https://u.org/m/") == wanted
    text = description.absolute((ROOT / "README.md").read_text(encoding="utf-8"), "https://u.org")
    assert not re.findall(r"\]\((?!https:|#)", text)


def test_other_failed_imports_stay_what_they_are() -> None:
    assert missing_extra(ModuleNotFoundError("no", name="numpy")) is None
    assert missing_extra(ImportError("cannot import name", name="torch")) is None
    with pytest.raises(ModuleNotFoundError, match="nowhere"), named_extras():
        import nowhere  # pyright: ignore  # noqa: F401
    with pytest.raises(MissingExtraError, match=r"foretrace\[gym\]"), named_extras():
        raise ModuleNotFoundError("no", name="gymnasium.spaces")
