"""Predictors on disk: ``config.json`` and ``model.safetensors``. Nothing is ever unpickled."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import torch
from msgspec import Meta
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from foretrace.errors import CheckpointError, TrainingError, shown
from foretrace.files import as_json, as_path, make_folder, read_versioned, write_bytes, write_json
from foretrace.imagined.domain import known_ranges
from foretrace.interactions.record import Outcome
from foretrace.predictor.base import PREDICTORS, EffectPredictor
from foretrace.predictor.config import TrainConfig, check_outcomes
from foretrace.predictor.loading import CONFIG, MODEL
from foretrace.schema import Vector2, conform

FORMAT = "foretrace-predictor"
FORMAT_VERSION = 2
RANGES = "ranges"
"""Entry of ``config.json`` that is there only once the training is finished."""
CALIBRATION = "calibration"
"""Entry of ``config.json`` about the interactions that regions were calibrated on after the training."""
UNBOUNDED = "quantiles"
"""Tensors in which infinity is the size of a region that holds everything; nowhere else is it a number."""


class PredictorEntries(TypedDict):
    """Schema of ``config.json``."""

    predictor: str
    config: dict[str, Any]
    num_samples: Annotated[int, Meta(ge=2, le=1_000_000)]
    outcomes: list[str]
    ranges: NotRequired[dict[str, Vector2]]
    training: NotRequired[dict[str, Any]]
    calibration: NotRequired[dict[str, Any]]


class OldFeatures(TypedDict):
    """Schema of the features in version 1."""

    label: str
    options: dict[str, Any]


class OldEntries(TypedDict):
    """Schema of version 1."""

    predictor: str
    settings: dict[str, Any]
    features: OldFeatures
    num_samples: int
    ranges: NotRequired[dict[str, Vector2]]
    training: NotRequired[dict[str, Any]]


RENAMED = {"known": "context", "members": "ensemble", "motions": "components", "hinges": "pivot_edges"}
"""Settings of version 1 by their names in version 2."""


def describe(predictor: EffectPredictor) -> dict[str, Any]:
    """Contents of ``config.json`` from which the predictor is made again, and facts about its training part."""
    ranges = {RANGES: dict(predictor.ranges)} if predictor.ranges else {}
    description = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "predictor": predictor.label,
        "config": asdict(predictor.config),
        "num_samples": predictor.num_samples,
        "outcomes": predictor.learned_from,
    }
    return as_json(description | ranges)


def save_checkpoint(
    directory: str | Path, predictor: EffectPredictor, training: Mapping[str, Any] | None = None
) -> None:
    """Write a predictor into a folder.

    Args:
        directory: The folder; made if it does not exist.
        predictor: The predictor.
        training: How it was trained, kept in ``config.json`` for the record.
    """
    directory = as_path(directory, CheckpointError)
    make_folder(directory, CheckpointError)
    write_tensors(directory / MODEL, predictor.state_dict())
    write_json(directory / CONFIG, describe(predictor) | {"training": dict(training or {})})


def read_predictor(path: Path) -> EffectPredictor:
    """Read a predictor from a folder that `save_checkpoint` or `train_predictor` wrote.

    Raises:
        CheckpointError: A file is missing or damaged, of another version, or the tensors do not fit.
    """
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
    load_tensors(predictor, _renewed(tensors, predictor), model)
    return predictor.eval()


def _renewed(tensors: dict[str, Tensor], predictor: EffectPredictor) -> dict[str, Tensor]:
    """Tensors of an earlier version in the form of today's.

    Quantiles were those of an observed start alone, and probabilities had no temperature.
    """
    wanted = predictor.state_dict()
    if (found := tensors.get(UNBOUNDED)) is None or UNBOUNDED not in wanted or found.ndim != 1:
        return tensors
    renewed = {name: wanted[name] for name in ("temperature", "start_error") if name not in tensors}
    return tensors | renewed | {UNBOUNDED: found.expand_as(wanted[UNBOUNDED])}


def read_config(path: Path) -> PredictorEntries:
    """The contents of a checkpoint's ``config.json``, in the form of `FORMAT_VERSION`.

    Raises:
        CheckpointError: It is missing, damaged or of another version.
    """
    file = path / CONFIG
    remedy = "give the folder of a trained predictor, copy it again or train anew"
    config = read_versioned(
        file, dict[str, Any], FORMAT, FORMAT_VERSION, CheckpointError, remedy, key="version", older=(1,)
    )
    if config["version"] != FORMAT_VERSION:
        config = _upgrade(conform(config, OldEntries, str(file), CheckpointError, remedy))
    return conform(config, PredictorEntries, str(file), CheckpointError, remedy)


def _upgrade(old: OldEntries) -> dict[str, Any]:
    """A configuration of version 1 as one of version 2."""
    settings = {RENAMED.get(name, name): value for name, value in old["settings"].items()}
    features, training = old["features"], old.get("training", {})
    loop = [*(field.name for field in fields(TrainConfig)), "data", "rows"]
    config = {"features": features["label"], "feature_options": features["options"], "context": []} | settings
    return {
        **{"format": FORMAT, "version": FORMAT_VERSION, "predictor": old["predictor"], "config": config},
        "num_samples": old["num_samples"],
        "outcomes": training.get("outcomes", settings.get("outcomes", [str(Outcome.LEVERED)])),
        **({"ranges": old["ranges"]} if "ranges" in old else {}),
        "training": {name: training[name] for name in loop if name in training},
    }


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    """Write a safetensors file atomically."""
    # By way of memory: the library's own error for a full disk is none of the system's.
    write_bytes(path, save({name: t.detach().cpu().contiguous() for name, t in tensors.items()}, metadata))


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
        CheckpointError: A tensor is missing, unexpected, of another shape or type, or holds what is no number.
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
        if (tensor if name.endswith(UNBOUNDED) else tensor.float() * 0).isnan().any():
            raise CheckpointError(f"{file}: {name} holds NaN or infinity: copy it again or train anew")
    module.load_state_dict(dict(tensors))


def _make(content: PredictorEntries, file: Path) -> EffectPredictor:
    """The predictor that a configuration describes, untrained."""
    settings = content["config"]
    try:
        config_class = PREDICTORS.find(content["predictor"]).config_class
        if odd := sorted(
            {field.name for field in fields(config_class)} ^ (settings.keys() | {*config_class.added})
        ):
            raise CheckpointError(f"{file}: missing or unknown settings {', '.join(odd)}; train anew")
        tuples: dict[str, Any] = {
            name: tuple(value) for name, value in settings.items() if isinstance(value, list)
        }
        predictor = config_class(**settings | tuples).make(content["num_samples"])
        check_outcomes(content["outcomes"])
        predictor.learned_from = tuple(content["outcomes"])
        predictor.ranges = known_ranges(content.get("ranges", {}))
        return predictor
    except TrainingError as error:
        raise CheckpointError(f"{file}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(
            f"{file}: its config cannot be used ({shown(error)}): copy it again or train anew"
        ) from error
