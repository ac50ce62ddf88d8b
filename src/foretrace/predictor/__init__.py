"""Predictors of an action's effect: networks, their training, their checkpoints.

The names below are imported on first use: a predictor that runs in ONNX Runtime needs no PyTorch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from foretrace.imagined import IMAGINERS, Futures, ImaginedBatch, ImaginedEffect, ObservedMotion
from foretrace.predictor.loading import load_imaginer, load_predictor

if TYPE_CHECKING:
    from foretrace.predictor.base import PREDICTORS, EffectPredictor
    from foretrace.predictor.checkpoint import save_checkpoint
    from foretrace.predictor.config import PredictorConfig, TrainConfig
    from foretrace.predictor.lstm import LstmConfig, LstmPredictor
    from foretrace.predictor.one_shot import OneShotConfig, OneShotPredictor
    from foretrace.predictor.portable import OnnxPredictor
    from foretrace.predictor.recalibration import recalibrate
    from foretrace.predictor.run_folder import part_of, parts_of
    from foretrace.predictor.training import fit_predictor, train_predictor

_HOMES = {
    "base": ("PREDICTORS", "EffectPredictor"),
    "checkpoint": ("save_checkpoint",),
    "config": ("PredictorConfig", "TrainConfig"),
    "lstm": ("LstmConfig", "LstmPredictor"),
    "one_shot": ("OneShotConfig", "OneShotPredictor"),
    "portable": ("OnnxPredictor",),
    "recalibration": ("recalibrate",),
    "run_folder": ("part_of", "parts_of"),
    "training": ("fit_predictor", "train_predictor"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "PREDICTORS",
    "EffectPredictor",
    "Futures",
    "ImaginedBatch",
    "ImaginedEffect",
    "LstmConfig",
    "LstmPredictor",
    "ObservedMotion",
    "OneShotConfig",
    "OneShotPredictor",
    "OnnxPredictor",
    "PredictorConfig",
    "TrainConfig",
    "fit_predictor",
    "load_imaginer",
    "load_predictor",
    "part_of",
    "parts_of",
    "recalibrate",
    "save_checkpoint",
    "train_predictor",
]


IMAGINERS.add("learned", lambda _: load_imaginer())


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'foretrace.predictor' has no attribute {name!r}")
    from foretrace.extras import named_extras

    with named_extras():
        value = getattr(import_module(f"foretrace.predictor.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value
