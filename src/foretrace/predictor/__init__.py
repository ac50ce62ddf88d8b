"""Predictors of an action's effect: networks, their training, their checkpoints."""

from foretrace.imagined import Futures, ImaginedBatch, ImaginedEffect
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.checkpoint import PREDICTORS, load_predictor, save_checkpoint
from foretrace.predictor.lstm import LstmConfig, LstmPredictor
from foretrace.predictor.one_shot import OneShotConfig, OneShotPredictor
from foretrace.predictor.run_folder import part_of, parts_of
from foretrace.predictor.training import RECIPES, TrainConfig, train_predictor

__all__ = [
    "PREDICTORS",
    "RECIPES",
    "EffectPredictor",
    "Futures",
    "ImaginedBatch",
    "ImaginedEffect",
    "LstmConfig",
    "LstmPredictor",
    "OneShotConfig",
    "OneShotPredictor",
    "TrainConfig",
    "load_predictor",
    "part_of",
    "parts_of",
    "save_checkpoint",
    "train_predictor",
]
