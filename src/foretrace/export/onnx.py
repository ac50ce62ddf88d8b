"""A predictor's network as an ONNX file, for programs without PyTorch; checked against PyTorch."""

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

import foretrace
from foretrace.errors import ExportError, shown
from foretrace.export.delivery import require
from foretrace.export.networks import draw_inputs, network_of
from foretrace.files import atomic_path
from foretrace.geometry import quaternion_to_matrix, rotation_vector_to_quaternion
from foretrace.predictor import EffectPredictor
from foretrace.predictor.checkpoint import describe
from foretrace.predictor.traced import TracedPredictor

LIBRARIES = ("onnx", "onnxscript", "onnxruntime")
EXTRA = "onnx"
OPSET = 20
TOLERANCE = 1e-5
"""Distance of a file's outputs from those in float64 that needs no reason: of positions [m], probabilities, entries of
rotation matrices; of spreads [m] where a future is probable enough to count, and only up to ``LARGEST_SPREAD``."""
ROUNDING = 5.0
"""Where PyTorch's own outputs in float32 are farther from those in float64, largest ratio of the file's distance to
theirs."""
LARGEST_ROUNDING = 1e-3
"""Largest distance of PyTorch's outputs for views: beyond, the exported network is not the predictor's. Noise is badly
conditioned, and rounding alone moves its outputs farther."""
LARGEST_SPREAD = 1.0
"""Largest spread that is compared [m]: beyond it, its size does not matter."""
BATCHES = (1, 2, 7, 32)
"""Numbers of lever-ups at once that are compared."""


class Difference(NamedTuple):
    """Largest differences of an output from the same network in float64, as ``TOLERANCE`` counts them."""

    file: float
    """Of the file, in ONNX Runtime."""
    pytorch: float
    """Of the predictor in PyTorch, in float32."""

    def is_rounding(self, largest: float) -> bool:
        """Whether the file is as good as PyTorch, whose distance is below the largest; NaN is no rounding."""
        return self.pytorch < largest and self.file <= max(TOLERANCE, ROUNDING * self.pytorch)


@dataclass(frozen=True)
class Exported:
    """An export that has been written."""

    path: Path
    """The file."""
    inputs: dict[str, str]
    """Meaning of each input by name."""
    outputs: dict[str, str]
    """Meaning of each output."""
    differences: dict[str, Difference]
    """Largest differences of each output from float64."""


def export_onnx(predictor: EffectPredictor, out: Path, seed: int = 0) -> Exported:
    """Write a predictor's network, and compare the file's outputs with those of PyTorch.

    Args:
        predictor: The predictor.
        out: The file; it appears under its name only if the two agree.
        seed: Seed of the inputs that are compared.

    Raises:
        ExportError: A library is missing, the file exists or cannot be written, the network cannot be exported, or
            the file's outputs differ.
    """
    for library in LIBRARIES:
        require(library, EXTRA)
    if out.exists() or out.is_symlink():
        raise ExportError(f"{out} exists already and is not overwritten: choose another --out, or remove it")
    network = network_of(predictor)
    rng = np.random.default_rng(seed)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(out) as draft:
            _write(network, draft, rng)
            differences = compare(network, draft, rng)
    except OSError as error:
        raise ExportError(f"cannot write {out} ({error.strerror}): choose another --out") from error
    return Exported(out, network.inputs, network.outputs, differences)


def compare(network: TracedPredictor, file: Path, rng: np.random.Generator) -> dict[str, Difference]:
    """Largest differences of each output of ONNX Runtime and PyTorch from float64, over views of prisms and noise.

    Raises:
        ExportError: The file's outputs differ by more than rounding, for views or for noise.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    exact = deepcopy(network).double()
    overall = dict.fromkeys(network.outputs, Difference(0.0, 0.0))
    for noise in (False, True):
        worst = dict.fromkeys(network.outputs, Difference(0.0, 0.0))
        for number in BATCHES:
            inputs = draw_inputs(network, rng, number, noise)
            found = map(np.asarray, session.run(None, inputs))
            with torch.no_grad():
                reference = exact(*(_widen(values) for values in inputs.values()))
            own = network.imagine(inputs)
            for name, said, wanted in zip(network.outputs, found, reference, strict=True):
                pair = (_difference(name, values, wanted.numpy(), own[name]) for values in (said, own[name]))
                worst[name] = Difference(*np.maximum(worst[name], tuple(pair)).tolist())
        for name, difference in worst.items():
            if not difference.is_rounding(np.inf if noise else LARGEST_ROUNDING):
                raise ExportError(
                    f"{name} of the exported network is {difference.file:.2g} away from float64, PyTorch's "
                    f"{difference.pytorch:.2g}: nothing was written; try other versions of onnx and onnxruntime"
                )
            overall[name] = Difference(*map(max, overall[name], difference))
    return overall


def _widen(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.astype(float) if values.dtype.kind == "f" else values)


def _difference(name: str, found: np.ndarray, wanted: np.ndarray, own: np.ndarray) -> float:
    """Largest difference between two outputs; PyTorch's own one says which spreads count."""
    if name == "rotation_vector":  # quaternions and axes jump at half a turn, matrices do not
        found, wanted = (each if each is own else _matrix(each) for each in (found, wanted))
    if name == "spread":  # infinite where it does not count
        found, wanted = (
            np.where(np.isinf(own), 0, np.minimum(each, LARGEST_SPREAD)) for each in (found, wanted)
        )
    return float(np.max(np.abs(found - wanted)))


def _matrix(vector: np.ndarray) -> np.ndarray:
    return quaternion_to_matrix(rotation_vector_to_quaternion(vector.astype(float)))


def _write(network: TracedPredictor, file: Path, rng: np.random.Generator) -> None:
    import onnx

    # A batch of one would be taken for a constant.
    example = tuple(torch.from_numpy(values) for values in draw_inputs(network, rng, 2, noise=False).values())
    batch = torch.export.Dim("batch")
    try:
        with _quiet(), torch.no_grad():
            traced = torch.export.export(
                network, example, dynamic_shapes=tuple({0: batch} for _ in example), strict=False
            )
            program = torch.onnx.export(
                traced,
                input_names=list(network.inputs),
                output_names=list(network.outputs),
                opset_version=OPSET,
                dynamo=True,
                verbose=False,
            )
    except (RuntimeError, ValueError) as error:
        raise ExportError(
            f"the {network.predictor.label} network with features {shown(network.predictor.features.label)} cannot be "
            f"exported: {str(error).strip().splitlines()[0]}"
        ) from error
    assert program is not None
    model = program.model_proto
    graph = model.graph
    for values, meanings in ((graph.input, network.inputs), (graph.output, network.outputs)):
        for value in values:
            value.type.tensor_type.shape.dim[0].dim_param = "batch"
            value.doc_string = meanings[value.name]
    model.producer_name, model.producer_version = "foretrace", foretrace.__version__
    config = describe(network.predictor)
    del config["format"], config["version"]
    facts = config | network.facts() | {"inputs": network.inputs, "outputs": network.outputs}
    onnx.helper.set_model_props(
        model, {f"foretrace.{name}": json.dumps(fact) for name, fact in facts.items()}
    )
    onnx.checker.check_model(model)
    onnx.save(model, file)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's remarks on optional libraries."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
