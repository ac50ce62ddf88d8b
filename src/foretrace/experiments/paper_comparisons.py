"""What the paper compares: which trainings each comparison needs, and their splits (sections 5.1 to 5.3)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from foretrace.errors import ResultsError
from foretrace.evaluation.claims import Cell
from foretrace.evaluation.experiment import Trial, checked_seeds, chosen
from foretrace.evaluation.statistics import TEST_TO_TRAIN
from foretrace.experiments.training import BASE
from foretrace.features import FEATURES, Option, Outline, PivotEdgeFeatures
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.splits import (
    PAPER_SIZES,
    Split,
    scaled_sizes,
    split_by_corner_count,
    split_by_object,
    split_by_seed,
)
from foretrace.predictor import PREDICTORS

SEEDS = tuple(range(10))
"""The paper's ten randomisation seeds."""


@dataclass(frozen=True)
class PaperTrial(Trial):
    """One training and its test."""

    experiment: str
    """Which of COMPARISONS."""
    features: str
    """What is compared: features of the paper's predictor, or the label of another predictor."""
    seed: int
    """Seed of the split and of the training."""
    setting: str
    """What is varied in the comparison."""


@dataclass(frozen=True)
class Comparison:
    """One of the paper's comparisons."""

    features: tuple[str, ...]
    """What is compared."""
    settings: tuple[str, ...]
    """What is varied."""
    split: Callable[[InteractionBatch, str, int, bool], Split]
    """Parts of the levered interactions, by setting and seed; in the paper's sizes, or proportions if true."""
    options: Mapping[str, Mapping[str, Option]] = field(default_factory=dict)
    """Options of features that make the difference, by label."""
    ratio: Callable[[str], float] = lambda setting: TEST_TO_TRAIN
    """Size of the test part divided by that of the training part, by setting, in data of the paper's recipe."""
    predictors: Mapping[str, tuple[str, Mapping[str, Option]]] = field(default_factory=dict)
    """Predictor and its options by what is compared, where that is neither features nor a predictor as it is."""
    of_corners: bool = False
    """Whether the choice of support corners is evaluated, and no predictor trained."""
    varies_steps: bool = False
    """Whether the setting is the number of states predicted per iteration."""
    varied: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings of predictor and training that a setting of the comparison stands for."""
    on_request: bool = False
    """Whether it is carried out only where it is named: it needs more data than the paper's, or many hours."""


def shuffled(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """The paper's usual split, whatever the setting; see `Comparison`."""
    return split_by_seed(len(batch), seed, None if proportional else PAPER_SIZES)


def _shuffled_or_by_object(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    if setting == "by-object":
        return split_by_object(batch.object_ids, seed)
    return shuffled(batch, setting, seed, proportional)


def _share_of_training(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """A share of the training part [%]; the smaller share is part of the larger."""
    whole = shuffled(batch, setting, seed, proportional)
    order = np.random.default_rng([seed, 1]).permutation(whole.train)
    return replace(whole, train=np.sort(order[: _percent(setting, len(order))]))


def _share_of_all(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """A share of all trains [%], 100 validate, all others test; the smaller training part is part of the larger."""
    order = np.random.default_rng(seed).permutation(len(batch))
    validation = scaled_sizes(len(batch))[1] if proportional else PAPER_SIZES[1]
    parts = np.split(order, [validation, validation + _percent(setting, len(batch))])
    return Split(train=np.sort(parts[1]), validation=np.sort(parts[0]), test=np.sort(parts[2]))


def _count_of_all(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """The setting is the size of the training part; 100 validate and 300 test, the same for all sizes."""
    _, validation, test = scaled_sizes(len(batch)) if proportional else PAPER_SIZES
    if (needed := int(setting) + validation + test) > len(batch):
        raise ResultsError(
            f"setting {setting} needs {needed} levered interactions, the data has {len(batch)}: simulate more objects, "
            "or choose smaller settings"
        )
    order = np.random.default_rng(seed).permutation(len(batch))
    parts = np.split(order, np.cumsum([validation, test, int(setting)]))
    return Split(train=np.sort(parts[2]), validation=np.sort(parts[0]), test=np.sort(parts[1]))


def _novel_corners(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    return split_by_corner_count(batch.num_corners, [int(count) for count in setting.split("&")], seed)


def _percent(setting: str, whole: int) -> int:
    return max(1, round(int(setting) / 100 * whole))


def _ratio_of_all(setting: str) -> float:
    """Of the paper's 1814 levered interactions, 100 validate."""
    train = int(setting) / 100
    return (1 - train - 100 / 1814) / train


def _ratio_of_corners(setting: str) -> float:
    """An object is levered at all its edges; of 3 to 10 corners, there are equally many objects."""
    test = sum(int(count) for count in setting.split("&")) / sum(range(3, 11))
    return test / ((1 - test) * 14 / 15)


CORNERS = ("3&4", "5&6", "7&8", "9&10")
"""Corner counts held out together (paper, figures 9b and 13)."""
SIZES = ("2", "4", "8", "16", "32", "64")
"""Training sizes of figure 11 [% of the data]."""
_SUPPORT = ("sp-pred", "sp-rule", "chance")
_SHAPE_CONTEXTS = ("sc-200", "sc-800", "sc-3200")
_PLAIN_SUPPORT: dict[str, dict[str, Option]] = {
    "sp-pred": {"aligned": False, "snapped": False, "epochs": 500, "batch_size": 32},
    "sp-rule": {"setback": 0.0, "half_width": 0.0},
}
_FEATURES = tuple(label for label in FEATURES if label not in (Outline.label, PivotEdgeFeatures.label))
_OTHERS = tuple(label for label in PREDICTORS if label != BASE)
"""Predictors that are compared as they are, each with its own features, as if they were other features."""
_ALL = (*_FEATURES, *_OTHERS)
ABLATIONS: dict[str, tuple[str, Mapping[str, Option]]] = {
    "one hinge": ("one-shot", {"pivot_edges": 1}),
    "one network": ("one-shot", {"ensemble": 1}),
    "no mirror": ("one-shot", {"mirrored": False}),
    "8 motions": ("one-shot", {"components": 8}),
    "none of these": ("one-shot", {"pivot_edges": 1, "ensemble": 1, "mirrored": False}),
}
"""What the direct trajectory predictor is without some of its parts."""
LONGER: dict[str, Mapping[str, Any]] = {
    "60 epochs": {"epochs": 60},
    "60 epochs, mirrored": {"epochs": 60, "mirrored": True},
}
"""Longer trainings of the paper's predictors; and also in the mirror."""

COMPARISONS: dict[str, Comparison] = {
    "support-points": Comparison(
        _SUPPORT, ("5", "10", "25", "50", "75", "100"), _share_of_training, of_corners=True,
        ratio=lambda setting: TEST_TO_TRAIN / (int(setting) / 100),
    ),
    "support-points-novel": Comparison(
        _SUPPORT, CORNERS, _novel_corners, ratio=_ratio_of_corners, of_corners=True
    ),
    "support-points-plain": Comparison(
        tuple(_PLAIN_SUPPORT), ("100",), _share_of_training, _PLAIN_SUPPORT, of_corners=True
    ),
    "features": Comparison(_ALL, ("shuffled", "by-object"), _shuffled_or_by_object),
    "half-plane": Comparison(
        _SHAPE_CONTEXTS, ("shuffled",), shuffled, {name: {"half_plane": True} for name in _SHAPE_CONTEXTS}
    ),
    "training-size": Comparison(_ALL, SIZES, _share_of_all, ratio=_ratio_of_all),
    "steps-ahead": Comparison(_FEATURES, ("2", "3", "4", "5"), shuffled, varies_steps=True),
    "novel-corners": Comparison(_ALL, CORNERS, _novel_corners, ratio=_ratio_of_corners),
    "more-data": Comparison(
        ("none", *_OTHERS), ("2000", "5000", "10000", "20000"), _count_of_all, on_request=True,
        ratio=lambda setting: PAPER_SIZES[2] / int(setting),
    ),
    "longer": Comparison(
        (*_FEATURES, PivotEdgeFeatures.label), tuple(LONGER), shuffled, varied=LONGER, on_request=True
    ),
    "ablation": Comparison(tuple(ABLATIONS), ("shuffled",), shuffled, predictors=ABLATIONS),
}  # fmt: skip
"""The paper's comparisons by name: figures 9a, 9b, 10, 11, 12 and 13.

Two ask what our choices change: in ``support-points-plain`` the network sees corners in the action frame and predicts
points as they are, and the rule lifts at the contact point; ``half-plane`` counts only what of an outline lies ahead of
the levered edge.

``longer``, on request, trains the paper's predictors for 60 epochs instead of 15, and also with mirror images, as the
direct trajectory predictor is trained; one of them observes that one's numbers. ``more-data``, on request, goes on from
figure 11 with a data set of more objects than the paper's. ``ablation`` takes parts away from the direct trajectory
predictor.

One state ahead, the first setting of figure 12, is ``features`` ``shuffled``.
"""


def ratio_of(cell: Cell) -> float:
    """Size of the test part divided by that of the training part, for `foretrace.evaluation.statistics.interval`."""
    comparison = COMPARISONS.get(cell.experiment)
    return TEST_TO_TRAIN if comparison is None else comparison.ratio(cell.setting)


def plan(
    experiments: Sequence[str] = (),
    features: Sequence[str] = (),
    settings: Sequence[str] = (),
    seeds: Sequence[int] = SEEDS,
) -> list[PaperTrial]:
    """The trials that the paper's comparisons consist of.

    Experiment by experiment, in each of them all that one seed asks for before the next seed: whenever it is
    interrupted, what is there can be compared. What is not named is compared in full, but for what is on request.

    Raises:
        ResultsError: One of them is unknown, or they do not go together.
    """
    usual = [name for name, comparison in COMPARISONS.items() if not comparison.on_request]
    names = chosen("experiment", experiments or usual, list(COMPARISONS))
    compared = [COMPARISONS[name] for name in names]
    labels = chosen("features", features, [label for c in compared for label in c.features])
    values = chosen("setting", settings, [setting for c in compared for setting in c.settings])
    trials = [
        PaperTrial(name, label, seed, setting)
        for name, comparison in zip(names, compared, strict=True)
        for seed in checked_seeds(seeds)
        for setting in comparison.settings
        if setting in values
        for label in comparison.features
        if label in labels
    ]
    if not trials:
        raise ResultsError(
            f"no training of {', '.join(names)} has features {', '.join(labels)} and setting {', '.join(values)}: "
            "choose what goes together"
        )
    return trials


def split_of(trial: PaperTrial, batch: InteractionBatch, proportional: bool = False) -> Split:
    """Parts of the levered interactions, in the paper's sizes or in its proportions."""
    return COMPARISONS[trial.experiment].split(batch, trial.setting, trial.seed, proportional)
