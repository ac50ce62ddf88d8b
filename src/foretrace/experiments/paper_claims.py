"""What the paper says of its results, each sentence tested on a table of ours.

The paper gives most of its results as pictures, so what can be compared are orderings, and the few numbers of
its text. How a comparison is tested, and what it takes for a claim to hold: `foretrace.evaluation.claims`.
"""

from collections.abc import Callable, Iterable
from itertools import product
from typing import Any

import numpy as np

from foretrace.evaluation.claims import Cell, Check, Claim
from foretrace.experiments.paper_comparisons import CORNERS as PAIRS
from foretrace.experiments.paper_comparisons import SIZES

SHAPE_CONTEXTS = ("sc-200", "sc-800", "sc-3200")
AUTOENCODERS = ("ae-256", "ae-512")
UNSUPERVISED = SHAPE_CONTEXTS + AUTOENCODERS
SUPERVISED = ("sc-cnn", "im-cnn")
GENERIC = UNSUPERVISED + SUPERVISED
TASK_SPECIFIC = ("sp-pred", "sp-truth")
PAPER_FEATURES = ("none", *GENERIC, *TASK_SPECIFIC)
"""The paper's ten predictors, in the order of its figures."""
TOLERANCE = 0.02
"""How far an accuracy may lie below one that the paper calls reached or about so."""
GRACEFUL = 2.0
"""A degradation is graceful if the error on novel corner counts is less than this times the shuffled one."""


def _first_less_rest(values: np.ndarray) -> np.ndarray:
    """The first column less the mean of the others; a single column as it is."""
    rest = values[:, 1:].mean(axis=1) if values.shape[1] > 1 else 0.0
    return values[:, 0] - rest


def _rest_less_first(values: np.ndarray) -> np.ndarray:
    return -_first_less_rest(values)


def _first_less_worst(values: np.ndarray) -> np.ndarray:
    return values[:, 0] - values[:, 1:].max(axis=1)


def _range(values: np.ndarray) -> np.ndarray:
    return values.max(axis=1) - values.min(axis=1)


def _groups_apart(first: int) -> Callable[[np.ndarray], np.ndarray]:
    """Mean of the columns after the first ones, less the mean of the first ones."""
    return lambda values: values[:, first:].mean(axis=1) - values[:, :first].mean(axis=1)


def _deviations_apart(first: int) -> Callable[[np.ndarray], np.ndarray]:
    """The same for distances from the median over seeds, as in the test of Brown and Forsythe."""
    return lambda values: _groups_apart(first)(np.abs(values - np.median(values, axis=0)))


def _fall(values: np.ndarray) -> np.ndarray:
    """Fall of the first of several errors, less the mean fall of the others; columns come in pairs."""
    return _first_less_rest(values[:, 0::2] - values[:, 1::2])


def _degradation(values: np.ndarray) -> np.ndarray:
    """Mean error on the novel corner counts as a multiple of the shuffled one, which comes first in each five."""
    grouped = values.reshape(len(values), -1, 1 + len(PAIRS))
    return _first_less_rest(grouped[:, :, 1:].mean(axis=2) / grouped[:, :, 0])


def _unevenness(values: np.ndarray) -> np.ndarray:
    """Largest error over the held-out pairs as a multiple of the smallest one; columns come in fours."""
    grouped = values.reshape(len(values), -1, len(PAIRS))
    return _first_less_rest(grouped.max(axis=2) / grouped.min(axis=2))


def _cells(
    experiment: str, names: Iterable[str], settings: Iterable[str], metric: str = "full"
) -> tuple[Cell, ...]:
    """Settings of the first name, then those of the next one."""
    return tuple(Cell(experiment, name, setting, metric) for name, setting in product(names, settings))


def _shuffled(*names: str) -> tuple[Cell, ...]:
    return _cells("features", names, ["shuffled"])


def _novel(*names: str) -> tuple[Cell, ...]:
    return _cells("novel-corners", names, PAIRS)


def _sized(names: Iterable[str], *sizes: str) -> tuple[Cell, ...]:
    return _cells("training-size", names, sizes)


def _accuracy(*names: str, share: str = "100") -> tuple[Cell, ...]:
    return _cells("support-points", names, [share], "accuracy")


def _novel_accuracy(*pairs: str) -> tuple[Cell, ...]:
    return _cells("support-points-novel", ["sp-pred"], pairs, "accuracy")


def _others(names: Iterable[str], *left_out: str) -> list[str]:
    return [name for name in names if name not in left_out]


def _more(
    cells: tuple[Cell, ...], label: str = "{0} minus {1}", above: float | None = 0.0, **unit: Any
) -> Check:
    """Whether the first cell holds more than the mean of the others, under a label with their features."""
    names = [cell.features for cell in cells]
    return Check(label.format(*names), cells, _first_less_rest, above=above, **unit)


SUPPORT_POINT_CLAIMS = (
    Claim(
        "support-points-all", "5.1", "Our model reaches up to 93 % accuracy predicting the true support points.",
        "Accuracy of sp-pred with all the training data is not below 93 % by two points.",
        (
            _more(_accuracy("sp-pred"), "{0}", 0.93 - TOLERANCE, unit="%"),
            _more(_accuracy("sp-pred", "sp-rule"), above=None, unit="%"),
        ),
    ),
    Claim(
        "support-points-half", "5.1", "It can reach around 90 % accuracy using nearly 50 % of the training data.",
        "Accuracy of sp-pred with half the training data is not below 90 % by two points.",
        (_more(_accuracy("sp-pred", share="50"), "{0}", 0.90 - TOLERANCE, unit="%"),),
    ),
    Claim(
        "support-points-chance", "5.1", "A random guess has an accuracy of 23 %, so the model has learned.",
        "sp-pred with all the training data is right more often than chance. Whether chance is the paper's does "
        "not decide: it depends on the corner counts.",
        (
            _more(_accuracy("sp-pred", "chance"), unit="%"),
            _more(_accuracy("chance"), "{0}", None, unit="%"),
        ),
    ),
    Claim(
        "support-points-novel", "5.1", "Around 89 % accuracy for novel shapes, close to the full model's.",
        "Mean accuracy of sp-pred over the four held-out pairs is not below 89 % by two points.",
        (
            Check("sp-pred, mean of the pairs", _novel_accuracy(*PAIRS),
                  lambda values: values.mean(axis=1), above=0.89 - TOLERANCE, unit="%"),
            *(_more(_novel_accuracy(pair), f"sp-pred, {pair}", None, unit="%") for pair in PAIRS),
        ),
    ),
)  # fmt: skip

FEATURE_CLAIMS = (
    Claim(
        "features-help", "5.2", "The error decreases through unsupervised generic features, and further with others.",
        "No-feature's error is larger than that of each other predictor.",
        (
            *(_more(_shuffled("none", name)) for name in PAPER_FEATURES[1:]),
            _more(_shuffled("none", "sp-rule"), above=None),
        ),
    ),
    Claim(
        "supervised-better", "5.2", "The error further decreases if supervised features such as Im-CNN's are used.",
        "The mean error of the five unsupervised predictors is larger than that of the two supervised ones; single "
        "predictors do not decide.",
        (
            Check("unsupervised minus supervised", _shuffled(*SUPERVISED, *UNSUPERVISED), _groups_apart(2), above=0.0),
            *(_more(_shuffled(other, name), above=None) for name in SUPERVISED for other in UNSUPERVISED),
        ),
    ),
    Claim(
        "im-cnn-best-generic", "5.3", "Among the general models, Im-CNN achieves the best accuracy.",
        "Each other generic predictor has a larger error than im-cnn.",
        tuple(_more(_shuffled(name, "im-cnn")) for name in _others(GENERIC, "im-cnn")),
    ),
    Claim(
        "supervised-steadier", "5.2", "Models using unsupervised features have higher variance on error.",
        "The mean distance of an error from its median over the seeds is larger with unsupervised features than "
        "with supervised ones (Brown and Forsythe's comparison); standard deviations are in summary.json.",
        (Check("deviation, unsupervised minus supervised", _shuffled(*SUPERVISED, *UNSUPERVISED),
               _deviations_apart(2), above=0.0),),
    ),
    Claim(
        "support-points-best", "5.2", "The best accuracy is obtained with real or predicted support points.",
        "Each other predictor of the paper has a larger error than sp-pred and than sp-truth.",
        tuple(
            _more(_shuffled(other, name))
            for name in TASK_SPECIFIC for other in _others(PAPER_FEATURES, *TASK_SPECIFIC)
        ),
    ),
    Claim(
        "steps-ahead", "5.2", "The number of states predicted per iteration changes the error by less than 5 mm.",
        "For each predictor, the largest error over n = 1 to 5 less the smallest one is below 0.5 cm.",
        tuple(
            Check(f"{name}, largest minus smallest", _shuffled(name) + _cells("steps-ahead", [name], "2345"), _range,
                  below=0.5)
            for name in PAPER_FEATURES
        ),
    ),
)  # fmt: skip

_FAST = (*AUTOENCODERS, *SUPERVISED)
_SLOW = (*SHAPE_CONTEXTS, *TASK_SPECIFIC)
SIZE_CLAIMS = (
    Claim(
        "errors-fall", "5.2", "Errors decrease as the training size increases.",
        "For each predictor the error at 2 % of the data is larger than at 64 %; no-feature does not decide.",
        tuple(
            _more(_sized([name], "2", "64"), "{0}, 2 % minus 64 %", None if name == "none" else 0.0)
            for name in PAPER_FEATURES
        ),
    ),
    Claim(
        "networks-fall-fastest", "5.2", "Errors for CNN and especially autoencoder models quickly decrease.",
        "From 2 % to 64 % of the data, the error of each of them falls by more than the mean over shape contexts and "
        "support points.",
        tuple(
            Check(f"fall of {name} minus mean fall of the others",
                  _sized([name, *_SLOW], "2", "64"), _fall, above=0.0)
            for name in _FAST
        ),
    ),
    Claim(
        "good-with-little-data", "5.2", "SP_truth and SP_pred perform well even with small amount of data.",
        "At 2 % of the data the mean error of the generic predictors is larger than that of sp-pred and of sp-truth.",
        tuple(
            Check(f"generic minus {name}, 2 %", _sized([name, *GENERIC], "2"),
                  _rest_less_first, above=0.0)
            for name in TASK_SPECIFIC
        ),
    ),
    Claim(
        "im-cnn-catches-up", "5.2", "Im-CNN catches up only with sufficient number of training data.",
        "The error of im-cnn falls from 2 % to 64 % of the data by more than the mean of sp-pred and sp-truth; what is "
        "left of its distance does not decide.",
        (
            Check("fall of im-cnn minus mean fall of support points",
                  _sized(["im-cnn", *TASK_SPECIFIC], "2", "64"), _fall, above=0.0),
            *(_more(_sized(["im-cnn", *TASK_SPECIFIC], size), f"im-cnn minus support points, {size} %", None)
              for size in SIZES),
        ),
    ),
)  # fmt: skip

NOVEL_CLAIMS = (
    Claim(
        "graceful", "5.3", "Overall, performance degradation on novel shapes is graceful in all models.",
        "For each predictor the mean error over the held-out pairs is less than twice the shuffled one.",
        tuple(
            Check(f"{name}, novel / shuffled", _shuffled(name) + _novel(name), _degradation,
                  below=GRACEFUL, unit="times")
            for name in PAPER_FEATURES
        ),
    ),
    Claim(
        "cnn-stable", "5.3", "Im-CNN and Sc-CNN are stable across the different generalization test sets.",
        "The largest error over the pairs divided by the smallest one is lower for each of them than for the mean of "
        "the other predictors with features; each one's quotient does not decide.",
        tuple(
            Check(f"largest / smallest, {name} minus mean of the others",
                  _novel(name, *UNSUPERVISED, *TASK_SPECIFIC), _unevenness,
                  below=0.0, unit="times")
            for name in SUPERVISED
        ) + tuple(
            Check(f"{name}, largest / smallest", _novel(name), _unevenness, unit="times")
            for name in PAPER_FEATURES
        ),
    ),
    Claim(
        "poor-on-triangles", "5.3", "SP_truth, SP_pred and autoencoder generalize poorly to triangles and rectangles.",
        "The error of each of them on 3&4 is larger than on each other pair.",
        tuple(
            Check(f"{name}, 3&4 minus worst other pair", _novel(name), _first_less_worst, above=0.0)
            for name in (*TASK_SPECIFIC, *AUTOENCODERS)
        ),
    ),
    Claim(
        "sc-800-fails", "5.3", "The best performing shape context feature, Sc-800, fails in generalization tests.",
        "Its error on novel corner counts, as a multiple of the shuffled one, is larger than for the mean of the other "
        "predictors with features. Whether it is the best shape context does not decide.",
        (
            Check("novel / shuffled, sc-800 minus mean of the others",
                  sum((_shuffled(each) + _novel(each)
                       for each in ("sc-800", *_others(PAPER_FEATURES, "none", "sc-800"))), ()),
                  _degradation, above=0.0, unit="times"),
            *(_more(_shuffled(name, "sc-800"), "{0} minus {1}, shuffled", None) for name in ("sc-200", "sc-3200")),
        ),
    ),
    Claim(
        "im-cnn-generalizes-best", "5.3", "Among the general models, Im-CNN achieves the best generalization.",
        "Each other generic predictor has a larger mean error over the held-out pairs than im-cnn.",
        tuple(
            Check(f"{name} minus im-cnn, mean of the pairs", _novel("im-cnn", name), _groups_apart(4),
                  above=0.0)
            for name in _others(GENERIC, "im-cnn")
        ),
    ),
)  # fmt: skip

CLAIMS = SUPPORT_POINT_CLAIMS + FEATURE_CLAIMS + SIZE_CLAIMS + NOVEL_CLAIMS
"""Every claim of the paper's sections 5.1 to 5.3 that a table can be asked about."""
