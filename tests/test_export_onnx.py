import io
import json
import re
from contextlib import redirect_stdout

import numpy as np
import pytest
import torch

from factories import fake_batch
from foretrace import cli
from foretrace.errors import ExportError
from foretrace.export import onnx as exporting
from foretrace.export.networks import draw_inputs, network_of
from foretrace.features import ImageCnn
from foretrace.features.windows import convolve_unbranched, convolve_windows
from foretrace.geometry import quaternion_to_matrix, rotation_vector_to_quaternion
from foretrace.imagined import STARTS, estimate_com
from foretrace.predictor import (
    LstmConfig,
    LstmPredictor,
    OneShotConfig,
    OneShotPredictor,
    load_predictor,
    save_checkpoint,
)
from foretrace.predictor.loading import PORTABLE, default_checkpoint
from foretrace.predictor.states import state_size
from test_examples import EXAMPLES, run_here, run_python

onnxruntime = pytest.importorskip("onnxruntime")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
SAMPLES = 5


@pytest.fixture(autouse=True, scope="module")
def _one_thread():
    torch.set_num_threads(1)


def shake(predictor, seed: int = 0):
    """An untrained predictor as if it had learned something: no tensor is left at 0 or 1."""
    rng = np.random.default_rng(seed)
    state = {}
    for name, tensor in predictor.state_dict().items():
        noise = torch.from_numpy(rng.normal(size=tuple(tensor.shape))).to(tensor)
        if name == "covariance":
            state[name] = torch.eye(tensor.shape[-1]) + 0.1 * noise @ noise.mT
        elif name in ("state_scale", "value_scale", "known_scale", "quantiles"):
            state[name] = 0.1 + noise.abs()
        elif name == "parity":
            state[name] = noise.sign()
        elif name in ("times", "slots"):
            state[name] = (0.05 if name == "times" else 0.04) * torch.arange(len(tensor)).to(tensor)
        else:
            state[name] = (
                tensor + (0.01 if name.endswith("motions") or name == "mean_motion" else 0.2) * noise
            )
    predictor.load_state_dict(state)
    return predictor.eval()


def one_shot() -> OneShotPredictor:
    torch.manual_seed(0)
    config = OneShotConfig(
        feature_options={"heights": True}, context=("friction", "density", "speed"), hidden_share=0.5, hidden=8,
        layers=2, ensemble=2, components=4, outcomes=("levered", "slipped"), phase_time=True,
    )  # fmt: skip
    return shake(OneShotPredictor(config, SAMPLES))


def image_cnn() -> LstmPredictor:
    torch.manual_seed(0)
    config = LstmConfig(feature_options={"width": 8}, state="pose", hidden=8, context=("friction",))
    predictor = LstmPredictor(config, SAMPLES)
    size = state_size("pose")
    predictor.set_normalisation(np.full(size, 0.01), np.full(size, 0.3), 0.05 * np.arange(SAMPLES))
    return predictor.eval()


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """A one-shot predictor, the file that the command exports it to, and what it prints."""
    folder = tmp_path_factory.mktemp("onnx")
    predictor, file = one_shot(), folder / "model.onnx"
    save_checkpoint(folder / "run", predictor)
    printed = io.StringIO()
    with redirect_stdout(printed):
        assert cli.main(["export", "onnx", str(folder / "run"), "--out", str(file)]) == 0
    return predictor, file, printed.getvalue()


@pytest.fixture(scope="module")
def views():
    return fake_batch(np.random.default_rng(0), 6, num_samples=SAMPLES)


def test_a_distribution_is_that_of_the_predictor(command, views):
    predictor, file, _ = command
    session = onnxruntime.InferenceSession(file)
    names = [output.name for output in session.get_outputs()]
    for rows in (slice(0, 1), slice(1, 4), slice(0, 6)):
        features, com = predictor.features.inputs(views[rows]), estimate_com(views[rows])
        context = np.full((len(com), 3), [0.5, np.nan, 1.1], np.float32)  # the density is not told
        context[1:, 2] = np.linspace(0.7, 1.4, len(com) - 1)
        inputs = {"features": features.numpy(), "com": com.astype(np.float32), "context": context}
        said = dict(zip(names, session.run(None, inputs), strict=True))
        futures = predictor.imagine_effects(predictor.add_context(features, context), com).futures
        np.testing.assert_allclose(said["probability"], futures.probability, atol=1e-6)
        np.testing.assert_allclose(said["com_trajectory"], futures.com, atol=1e-6)
        np.testing.assert_allclose(said["spread"], futures.spread, rtol=1e-4)
        np.testing.assert_allclose(said["support_points"], futures.support_points, atol=1e-6)
        turned = quaternion_to_matrix(rotation_vector_to_quaternion(said["rotation_vector"].astype(float)))
        np.testing.assert_allclose(turned, quaternion_to_matrix(futures.pose[..., 3:]), atol=1e-5)
    assert futures.probability.std() > 0.01
    assert np.ptp(futures.com, axis=(0, 1, 2)).min() > 0.001


def test_the_command_says_what_it_measured_and_the_example_runs(command):
    _, file, printed = command
    measured = re.findall(
        r"^returns (\w+): .*; at most (\d\.\de-\d+) from float64, PyTorch's float32 \d\.\de-\d+$",
        printed,
        re.MULTILINE,
    )
    assert [name for name, _ in measured][:2] == ["probability", "com_trajectory"]
    assert 0 < max(float(number) for _, number in measured) <= exporting.TOLERANCE
    said = run_python(EXAMPLES / "run_onnx.py", file)
    assert re.search(r"^\d+%: give or take \d\.\d+ m,\nthe centre of mass ends at \[", said)


def test_a_file_tells_what_it_is(command):
    predictor, file, _ = command
    model = onnx.load(file)
    facts = {p.key.removeprefix("foretrace."): json.loads(p.value) for p in model.metadata_props}
    assert facts["futures"] == ["levered", "slipped", "levered", "slipped"]
    assert facts["times"] == predictor.times.tolist()
    assert facts["predictor"] == "one-shot"
    kinds = [f"start {start}, context {told}" for start in STARTS for told in ("told", "unknown")]
    assert list(facts["quantiles"]) == kinds
    for found, wanted in zip(facts["quantiles"].values(), predictor.quantiles.flatten(0, 1), strict=True):
        assert found == pytest.approx(wanted.tolist())
    assert facts["config"]["feature_options"] == {"heights": True}
    assert facts["frame"].startswith("action: origin at the contact point")
    assert {i.name: i.doc_string for i in model.graph.input} == network_of(predictor).inputs
    assert all(value.type.tensor_type.shape.dim[0].dim_param == "batch" for value in model.graph.output)
    assert "Cholesky" not in "".join(node.op_type for node in model.graph.node)


def test_a_network_of_views_is_exported_with_its_convolutions(tmp_path, monkeypatch):
    predictor = image_cnn()
    monkeypatch.setattr(exporting, "BATCHES", (1, 5))
    written = exporting.export_onnx(predictor, tmp_path / "model.onnx")
    assert list(written.inputs) == ["mask", "com", "context"]
    assert list(written.outputs) == ["com_trajectory", "rotation_matrix"]
    assert max(difference.file for difference in written.differences.values()) <= exporting.TOLERANCE
    session = onnxruntime.InferenceSession(written.path)
    batch = fake_batch(np.random.default_rng(1), 3, num_samples=SAMPLES)
    com = estimate_com(batch).astype(np.float32)
    inputs = {
        "mask": batch.mask.astype(np.uint8),
        "com": com,
        "context": batch.parameters["friction"][:, None].astype("f4"),
    }
    path, rotation = session.run(None, inputs)
    imagined = predictor.imagine_batch(batch, "estimated")
    np.testing.assert_allclose(path, imagined.com, atol=1e-5)
    np.testing.assert_allclose(rotation, quaternion_to_matrix(imagined.pose[..., 3:]), atol=1e-5)

    assert "the centre of mass ends at [" in run_here("run_onnx.py", written.path)


@pytest.mark.parametrize("content", ["missing", "text", "another model"])
def test_the_example_refuses_in_one_line_what_is_no_predictor(content, tmp_path):
    file = tmp_path / "model.onnx"
    if content == "text":
        file.write_text("hello")
    elif content == "another model":
        same = onnx.helper.make_node("Identity", ["x"], ["y"])
        ports = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1]) for name in "xy"]
        graph = onnx.helper.make_graph([same], "same", ports[:1], ports[1:])
        opset = [onnx.helper.make_opsetid("", 18)]
        onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=8), file)
    told = "is missing or no predictor: give a file that `foretrace export onnx` wrote"
    with pytest.raises(SystemExit) as ended:
        run_here("run_onnx.py", file)
    assert ended.value.code == f"{file} {told}"  # Python writes it to standard error, and ends with 1


@pytest.mark.slow
def test_the_file_of_the_package_is_that_of_its_predictor():
    """Its noise is badly conditioned: file and PyTorch both stray from float64."""
    network = network_of(load_predictor())
    written = exporting.compare(network, default_checkpoint() / PORTABLE, np.random.default_rng(0))
    assert set(written) == set(network.outputs)
    assert re.search(r"^\d+%: .*\nthe centre of mass ends at \[", run_here("run_onnx.py"))


@pytest.mark.slow
@pytest.mark.parametrize("label", ["sc-200", "sp-truth"])
def test_the_example_runs_with_other_features(label, tmp_path):
    predictor = LstmPredictor(LstmConfig(features=label, state="position", hidden=4), 2)
    predictor.eval()
    written = exporting.export_onnx(predictor, tmp_path / "model.onnx")
    said = run_here("run_onnx.py", written.path)
    assert ("zeros stand in" in said) == (label == "sp-truth")
    assert "the centre of mass ends at [" in said


@pytest.mark.parametrize(
    ("label", "state"),
    [("none", "position"), ("sc-200", "pose"), ("sp-truth", "position"), ("none", "turn")],
)
def test_other_features_are_inputs(label, state):
    predictor = LstmPredictor(LstmConfig(features=label, state=state, hidden=4), SAMPLES)
    predictor.eval()
    network = network_of(predictor)
    rng = np.random.default_rng(0)
    for noise in (False, True):
        inputs = draw_inputs(network, rng, 3, noise)
        assert inputs["features"].shape == (3, predictor.features.num_features)
        with torch.no_grad():
            said = network(*map(torch.from_numpy, inputs.values()))
        for tensor, expected in zip(said, network.imagine(inputs).values(), strict=True):
            np.testing.assert_allclose(tensor, expected, atol=1e-5)


def test_convolving_without_branches_gives_the_same_maps():
    network = ImageCnn(width=4)
    images = torch.zeros(5, 1, 128, 128)
    images[0, 0, 33:96, 100:128] = 1
    images[1, 0, 40:96, 30:90] = torch.rand(56, 60)
    images[2, 0, 60:70, 5:125] = 1  # too wide for a window
    images[4] = 1
    with torch.no_grad():
        wanted = convolve_windows(images, network.stack, 256)
        torch.testing.assert_close(convolve_unbranched(images, network.stack), wanted)


@pytest.mark.parametrize(
    ("change", "message"),
    [(1e-4, r"0\.000\d+ away from float64, PyTorch's \d\.\d+e-0\d:"), (np.nan, "nan away")],
)
def test_a_file_that_says_something_else_is_refused(command, change, message):
    _, file, _ = command
    other = one_shot()
    other.mean_motion += change
    with pytest.raises(ExportError, match=f"com_trajectory of the exported network is {message}"):
        exporting.compare(network_of(other), file, np.random.default_rng(0))


def test_rounding_of_noise_excuses_no_difference_for_views(command, monkeypatch):
    _, file, _ = command
    noisy = []

    def draw(network, rng, number, noise):
        noisy.append(noise)
        return draw_inputs(network, rng, number, noise)

    def difference(name, found, wanted, own):
        return 1e-4 if found is not own else 1e-2 if noisy[-1] else 1e-6

    monkeypatch.setattr(exporting, "draw_inputs", draw)
    monkeypatch.setattr(exporting, "_difference", difference)
    with pytest.raises(ExportError, match=r"0\.0001 away from float64, PyTorch's 1e-06"):
        exporting.compare(network_of(one_shot()), file, np.random.default_rng(0))


def test_nothing_is_overwritten_and_a_missing_library_is_named(tmp_path, monkeypatch):
    there = tmp_path / "model.onnx"
    there.write_text("mine")
    with pytest.raises(ExportError, match="exists already"):
        exporting.export_onnx(one_shot(), there)
    monkeypatch.setattr(exporting, "LIBRARIES", ("onnx", "a_library_that_is_not_there"))
    message = re.escape(
        "a_library_that_is_not_there is not installed; install it with `pip install 'foretrace[onnx]'`"
    )
    with pytest.raises(ExportError, match=message):
        exporting.export_onnx(one_shot(), tmp_path / "other.onnx")
    assert there.read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["model.onnx"]
