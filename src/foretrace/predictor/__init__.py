"""Predictors of an action's effect: networks, their training, their checkpoints."""

from foretrace.imagined import IMAGINERS, Futures, ImaginedBatch, ImaginedEffect, ObservedMotion
from foretrace.predictor.base import PREDICTORS, EffectPredictor
from foretrace.predictor.checkpoint import load_predictor, save_checkpoint
from foretrace.predictor.config import PredictorConfig, TrainConfig
from foretrace.predictor.lstm import LstmConfig, LstmPredictor
from foretrace.predictor.one_shot import OneShotConfig, OneShotPredictor
from foretrace.predictor.recalibration import recalibrate
from foretrace.predictor.run_folder import part_of, parts_of
from foretrace.predictor.training import fit_predictor, train_predictor

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
    "PredictorConfig",
    "TrainConfig",
    "fit_predictor",
    "load_predictor",
    "part_of",
    "parts_of",
    "recalibrate",
    "save_checkpoint",
    "train_predictor",
]


IMAGINERS.add("learned", lambda _: load_predictor())
