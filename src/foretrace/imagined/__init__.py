"""What an imaginer is and what it returns: the expected effect, all futures, their probabilities and regions.

Nothing here imports a learning library: a predictor that was trained is one kind of imaginer among others.
"""

from foretrace.imagined.belief import Belief
from foretrace.imagined.domain import estimate_com
from foretrace.imagined.futures import (
    FLOOR,
    LEVELS,
    MIN_PROBABILITY,
    Futures,
    ImaginedBatch,
    ImaginedEffect,
    conformal_scores,
    quantiles_of,
)
from foretrace.imagined.imaginer import IMAGINERS, STARTS, Imaginer, Scenes, Start
from foretrace.imagined.observed import ObservedMotion

__all__ = [
    "FLOOR",
    "IMAGINERS",
    "LEVELS",
    "MIN_PROBABILITY",
    "STARTS",
    "Belief",
    "Futures",
    "ImaginedBatch",
    "ImaginedEffect",
    "Imaginer",
    "ObservedMotion",
    "Scenes",
    "Start",
    "conformal_scores",
    "estimate_com",
    "quantiles_of",
]
