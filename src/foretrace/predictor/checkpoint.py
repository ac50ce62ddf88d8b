"""Predictors on disk: ``config.json`` and ``model.safetensors``. Nothing is ever unpickled."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from foretrace.errors import CheckpointError, TrainingError
from foretrace.features import make_features
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.domain import read_ranges
from foretrace.predictor.files import write_json, write_tensors
from foretrace.predictor.lstm import LstmConfig, LstmPredictor
from foretrace.predictor.one_shot import OneShotConfig, OneShotPredictor

FORMAT = "foretrace-predictor"
FORMAT_VERSION = 1
CONFIG = "config.json"
MODEL = "model.safetensors"
DEFAULT = "default"
"""Folder of the predictor that comes with the package."""
RANGES = "ranges"
"""Entry of ``config.json`` that is there only once the training is finished."""
PREDICTORS: dict[str, tuple[Callable[..., EffectPredictor], type[LstmConfig] | type[OneShotConfig]]] = {
    LstmPredictor.label: (LstmPredictor, LstmConfig),
    OneShotPredictor.label: (OneShotPredictor, OneShotConfig),
}
"""Every kind of predictor by its label, with the class of its settings."""
ADDED_SETTINGS: dict[str, Any] = {"known": (), "predictor": "lstm", "predictor_options": {}}
"""Settings that older checkpoints and results do not name, and what they were in effect."""


def settings_of(config: Any) -> dict[str, Any]:
    """The settings in a dataclass by name; those that were added later only where they make a difference.

    So what was written before they were added equals what would be written now.
    """
    return {
        name: value
        for name, value in asdict(config).items()
        if name not in ADDED_SETTINGS or value != ADDED_SETTINGS[name]
    }


def describe(predictor: EffectPredictor) -> dict[str, Any]:
    """What ``config.json`` must say for the predictor to be made again, and what it knows of its training part."""
    ranges = {RANGES: predictor.ranges} if predictor.ranges else {}
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "predictor": predictor.label,
        "settings": settings_of(predictor.config),
        "features": {"label": predictor.features.label, "options": predictor.features.options},
        "num_samples": predictor.num_samples,
    } | ranges


def save_checkpoint(
    directory: str | Path, predictor: EffectPredictor, training: Mapping[str, Any] | None = None
) -> None:
    """Write a predictor into a folder.

    Args:
        directory: The folder; made if it is not there.
        predictor: The predictor.
        training: How it was trained, kept in ``config.json`` for the record.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    write_tensors(directory / MODEL, predictor.state_dict())
    write_json(directory / CONFIG, describe(predictor) | {"training": dict(training or {})})


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


def load_predictor(path: str | Path | None = None) -> EffectPredictor:
    """Read a predictor from a folder that `save_checkpoint` or `train_predictor` wrote.

    Args:
        path: The folder; by default that of the predictor that comes with the package.

    Raises:
        CheckpointError: A file is missing or damaged, of another version, or the tensors do not fit.
    """
    path = default_checkpoint() if path is None else Path(path)
    config = read_config(path)
    model = path / MODEL
    if not model.is_file():
        raise CheckpointError(
            f"{model} is missing: the training has not finished an epoch yet, or the copy is partial"
        )
    tensors = read_tensors(model)
    # Its first weights are drawn only to be replaced: the caller's random numbers must not notice.
    with torch.random.fork_rng(devices=[]):
        predictor = _make(config, path / CONFIG)
    load_tensors(predictor, tensors, model)
    return predictor.eval()


def read_config(path: Path) -> dict[str, Any]:
    """The contents of a checkpoint's ``config.json``.

    Raises:
        CheckpointError: It is missing, damaged or of another version.
    """
    file = path / CONFIG
    if not file.is_file():
        raise CheckpointError(f"{file} is missing: {path} is not the folder of a trained predictor")
    try:
        config = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise CheckpointError(f"{file} is not JSON ({error}): copy it again or train anew") from error
    if not isinstance(config, dict) or config.get("format") != FORMAT:
        raise CheckpointError(
            f"{file} does not describe a {FORMAT}: {path} is not the folder of a trained predictor"
        )
    if config.get("version") != FORMAT_VERSION:
        raise CheckpointError(
            f"{file} has format version {config.get('version')!r}, this foretrace reads {FORMAT_VERSION}: "
            "use the foretrace that wrote it, or train anew"
        )
    return config


def read_tensors(file: Path) -> dict[str, Tensor]:
    """The tensors of a safetensors file.

    Raises:
        CheckpointError: It is damaged.
    """
    try:
        return load_file(file)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"{file} cannot be read ({error}): remove it, copy it again or train anew"
        ) from error


def load_tensors(module: nn.Module, tensors: Mapping[str, Tensor], file: Path) -> None:
    """Fill a module's parameters and buffers, all of them and no others.

    Raises:
        CheckpointError: A tensor is missing, unexpected, or of another shape or type.
    """
    expected = module.state_dict()
    advice = f"it does not belong to its {CONFIG}"
    if missing := sorted(expected.keys() - tensors.keys()):
        raise CheckpointError(f"{file} lacks the tensors {', '.join(missing)}: {advice}")
    if extra := sorted(tensors.keys() - expected.keys()):
        raise CheckpointError(f"{file} has unexpected tensors {', '.join(extra)}: {advice}")
    for name, tensor in tensors.items():
        wanted = expected[name]
        if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
            raise CheckpointError(
                f"{file}: {name} is {tuple(tensor.shape)} {tensor.dtype}, its {CONFIG} asks for "
                f"{tuple(wanted.shape)} {wanted.dtype}"
            )
    module.load_state_dict(dict(tensors))


def _make(config: Mapping[str, Any], file: Path) -> EffectPredictor:
    """The predictor that a configuration describes, untrained."""
    if config.get("predictor") not in PREDICTORS:
        raise CheckpointError(
            f"{file}: unknown predictor {config.get('predictor')!r}; available: {', '.join(PREDICTORS)}"
        )
    kind, settings_kind = PREDICTORS[config["predictor"]]
    known = {f.name for f in fields(settings_kind)}
    try:
        settings, features, num_samples = config["settings"], config["features"], config["num_samples"]
        settings = {name: value for name, value in ADDED_SETTINGS.items() if name in known} | settings
        if odd := sorted(known ^ settings.keys()):
            raise CheckpointError(f"{file}: missing or unknown settings {', '.join(odd)}; train anew")
        extractor = make_features(features["label"], **features["options"])
        tuples = {name: tuple(value) for name, value in settings.items() if isinstance(value, list)}
        predictor = kind(extractor, num_samples, settings_kind(**settings | tuples))
        predictor.ranges = read_ranges(config.get(RANGES))
        return predictor
    except TrainingError as error:
        raise CheckpointError(f"{file}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{file} is incomplete ({error!r}): copy it again or train anew") from error
