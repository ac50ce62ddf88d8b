"""Predictors from folders: with PyTorch where it is installed, else in ONNX Runtime."""

from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foretrace.errors import CheckpointError
from foretrace.files import as_path
from foretrace.imagined import Imaginer

if TYPE_CHECKING:
    from foretrace.predictor.base import EffectPredictor
    from foretrace.predictor.portable import OnnxPredictor

CONFIG = "config.json"
MODEL = "model.safetensors"
PORTABLE = "model.onnx"
"""The network as `foretrace export onnx` writes it."""
DEFAULT = "default"
"""Folder of the predictor that comes with the package."""


def default_checkpoint() -> Path:
    """The folder of the predictor that comes with the package.

    Raises:
        CheckpointError: None came with it.
    """
    path = Path(str(files("foretrace.predictor"))) / DEFAULT
    if not (path / CONFIG).is_file():
        raise CheckpointError(
            "this installation comes without a trained predictor: name the folder of a training, from `foretrace train`"
        )
    return path


def load_predictor(path: str | Path | None = None) -> "EffectPredictor":
    """Read a predictor from a folder that `save_checkpoint` or `train_predictor` wrote.

    Without PyTorch the folder's ``model.onnx`` is run in ONNX Runtime, if there is one: an `OnnxPredictor`, which
    imagines the same. The predictor that comes with the package has it.

    Args:
        path: The folder; by default that of the predictor that comes with the package.

    Raises:
        CheckpointError: A file is missing or damaged, of another version, or the tensors do not fit.
        MissingExtraError: PyTorch is needed and not installed.
    """
    folder = default_checkpoint() if path is None else as_path(path, CheckpointError)
    if find_spec("torch") is None and (folder / PORTABLE).is_file():
        portable: Any = load_portable(folder)
        return portable
    from foretrace.extras import named_extras

    with named_extras():
        from foretrace.predictor.checkpoint import read_predictor

    return read_predictor(folder)


def load_portable(folder: Path) -> "OnnxPredictor":
    """The predictor of a folder's ``model.onnx``, in ONNX Runtime.

    Raises:
        CheckpointError: It is missing, damaged, or of another predictor.
    """
    from foretrace.predictor.portable import OnnxPredictor

    return OnnxPredictor(folder / PORTABLE)


def load_imaginer(path: str | Path | None = None) -> Imaginer:
    """What imagines like the predictor of a folder, and starts soonest.

    Args:
        path: The folder. The predictor that comes with the package, the default, runs in ONNX Runtime.

    Raises:
        CheckpointError: As `load_predictor`.
    """
    if path is None and ((folder := default_checkpoint()) / PORTABLE).is_file():
        return load_portable(folder)
    return load_predictor(path)
