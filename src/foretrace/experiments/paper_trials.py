"""What the paper compares: which trainings each comparison needs, and their splits (sections 5.1 to 5.3)."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from foretrace.errors import ResultsError
from foretrace.evaluation.results import Trial
from foretrace.features import FEATURES, Option, Outline
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.splits import (
    PAPER_SIZES,
    Split,
    scaled_sizes,
    split_by_corner_count,
    split_by_object,
    split_by_seed,
)
from foretrace.predictor import OneShotPredictor

SEEDS = tuple(range(10))
"""The paper's ten randomisation seeds."""


@dataclass(frozen=True)
class Experiment:
    """One of the paper's comparisons."""

    features: tuple[str, ...]
    """What is compared."""
    settings: tuple[str, ...]
    """What is varied."""
    split: Callable[[InteractionBatch, str, int, bool], Split]
    """Parts of the levered interactions, by setting and seed; in the paper's sizes, or proportions if true."""
    options: Mapping[str, Mapping[str, Option]] = field(default_factory=dict)
    """Options of features that make the difference, by label."""
    names_corners: bool = False
    """Whether naming the support corners is judged, and no predictor trained."""
    varies_steps: bool = False
    """Whether the setting is the number of states predicted per iteration."""
    on_request: bool = False
    """Whether it is only carried out where somebody names it: it needs more data than the paper's."""


def shuffled(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """The paper's usual split, whatever the setting; see `Experiment`."""
    return split_by_seed(len(batch), seed, None if proportional else PAPER_SIZES)


def _shuffled_or_by_object(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    if setting == "by-object":
        return split_by_object(batch.object_ids, seed)
    return shuffled(batch, setting, seed, proportional)


def _share_of_training(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """So many percent of the training part; the smaller share is part of the larger."""
    whole = shuffled(batch, setting, seed, proportional)
    order = np.random.default_rng([seed, 1]).permutation(whole.train)
    return replace(whole, train=np.sort(order[: _percent(setting, len(order))]))


def _share_of_all(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """So many percent train, 100 validate, all others test; the smaller training part is part of the larger."""
    order = np.random.default_rng(seed).permutation(len(batch))
    validation = scaled_sizes(len(batch))[1] if proportional else PAPER_SIZES[1]
    parts = np.split(order, [validation, validation + _percent(setting, len(batch))])
    return Split(train=np.sort(parts[1]), validation=np.sort(parts[0]), test=np.sort(parts[2]))


def _count_of_all(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    """So many train, and 100 validate and 300 test, the same for all; the smaller part is part of the larger."""
    _, validation, test = scaled_sizes(len(batch)) if proportional else PAPER_SIZES
    if (needed := int(setting) + validation + test) > len(batch):
        raise ResultsError(
            f"setting {setting} needs {needed} levered interactions, the data has {len(batch)}: simulate more objects, "
            "or choose smaller settings"
        )
    order = np.random.default_rng(seed).permutation(len(batch))
    ends = np.cumsum([validation, test, int(setting)])
    return Split(
        train=np.sort(order[ends[1] : ends[2]]),
        validation=np.sort(order[: ends[0]]),
        test=np.sort(order[ends[0] : ends[1]]),
    )


def _novel_corners(batch: InteractionBatch, setting: str, seed: int, proportional: bool) -> Split:
    return split_by_corner_count(batch.num_corners, [int(count) for count in setting.split("&")], seed)


def _percent(setting: str, whole: int) -> int:
    return max(1, round(int(setting) / 100 * whole))


_CORNERS = ("3&4", "5&6", "7&8", "9&10")
_SUPPORT = ("sp-pred", "sp-rule", "chance")
_SHAPE_CONTEXTS = ("sc-200", "sc-800", "sc-3200")
_PLAIN_SUPPORT: dict[str, dict[str, Option]] = {
    "sp-pred": {"aligned": False, "snapped": False, "epochs": 500, "batch_size": 32},
    "sp-rule": {"setback": 0.0, "half_width": 0.0},
}
_ALL = tuple(label for label in FEATURES if label != Outline.label)
ONE_SHOT = OneShotPredictor.label
"""Compared as if it was another feature: the predictor of whole motions, which reads outlines."""
ABLATIONS: dict[str, dict[str, Option]] = {
    "one hinge": {"hinges": 1},
    "one network": {"members": 1},
    "no mirror": {"mirrored": False},
    "8 motions": {"motions": 8},
}
"""What the predictor of whole motions is without one of its parts, by its options."""

EXPERIMENTS: dict[str, Experiment] = {
    "support-points": Experiment(
        _SUPPORT, ("5", "10", "25", "50", "75", "100"), _share_of_training, names_corners=True
    ),
    "support-points-novel": Experiment(_SUPPORT, _CORNERS, _novel_corners, names_corners=True),
    "support-points-plain": Experiment(
        tuple(_PLAIN_SUPPORT), ("100",), _share_of_training, _PLAIN_SUPPORT, names_corners=True
    ),
    "features": Experiment((*_ALL, ONE_SHOT), ("shuffled", "by-object"), _shuffled_or_by_object),
    "half-plane": Experiment(
        _SHAPE_CONTEXTS, ("shuffled",), shuffled, {name: {"half_plane": True} for name in _SHAPE_CONTEXTS}
    ),
    "training-size": Experiment((*_ALL, ONE_SHOT), ("2", "4", "8", "16", "32", "64"), _share_of_all),
    "steps-ahead": Experiment(_ALL, ("2", "3", "4", "5"), shuffled, varies_steps=True),
    "novel-corners": Experiment((*_ALL, ONE_SHOT), _CORNERS, _novel_corners),
    "more-data": Experiment(
        ("none", ONE_SHOT), ("2000", "5000", "10000", "20000"), _count_of_all, on_request=True
    ),
    "ablation": Experiment(tuple(ABLATIONS), ("shuffled",), shuffled),
}
"""The paper's comparisons by name: figures 9a, 9b, 10, 11, 12 and 13.

Two ask what our choices change: in ``support-points-plain`` the network sees corners in the action frame and says
points as they are, and the rule lifts at the contact point; ``half-plane`` counts only what of an outline lies ahead of
the levered edge.

``more-data``, on request, goes on from figure 11 with a data set of more objects than the paper's. ``ablation`` takes
parts away from the predictor of whole motions.

One state ahead, the first setting of figure 12, is ``features`` ``shuffled``.
"""


def plan(
    experiments: Iterable[str] | None = None,
    features: Iterable[str] | None = None,
    settings: Iterable[str] | None = None,
    seeds: Iterable[int] = SEEDS,
) -> list[Trial]:
    """The trials that the paper's comparisons consist of.

    Experiment by experiment, in each of them all that one seed asks for before the next seed: whenever it is
    interrupted, what is there can be compared.

    Args:
        experiments: Which of EXPERIMENTS, in this order; by default all but those on request.
        features: Which features; all by default.
        settings: Which settings; all by default.
        seeds: Seeds of splits and trainings.

    Raises:
        ResultsError: One of them is unknown, or they do not go together.
    """
    usual = [name for name, experiment in EXPERIMENTS.items() if not experiment.on_request]
    names = _chosen("experiment", usual if experiments is None else experiments, list(EXPERIMENTS))
    compared = [EXPERIMENTS[name] for name in names]
    labels = _chosen("features", features, [label for e in compared for label in e.features])
    values = _chosen("setting", settings, [setting for e in compared for setting in e.settings])
    seeds = list(dict.fromkeys(seeds))
    if wrong := [seed for seed in seeds if seed < 0]:
        raise ResultsError(f"seed {wrong[0]} is negative: choose seeds from 0")
    trials = [
        Trial(name, label, seed, setting)
        for name, experiment in zip(names, compared, strict=True)
        for seed in seeds
        for setting in experiment.settings
        if setting in values
        for label in experiment.features
        if label in labels
    ]
    if not trials:
        raise ResultsError(
            f"no training of {', '.join(names)} has features {', '.join(labels)}, setting {', '.join(values)} and a "
            "seed: choose what goes together"
        )
    return trials


def _chosen(kind: str, wanted: Iterable[str] | None, known: list[str]) -> list[str]:
    wanted = list(dict.fromkeys(known if wanted is None else wanted))
    if unknown := [name for name in wanted if name not in known]:
        raise ResultsError(f"{kind} {unknown[0]!r} is unknown: choose from {', '.join(dict.fromkeys(known))}")
    return wanted


def split_of(trial: Trial, batch: InteractionBatch, proportional: bool = False) -> Split:
    """Training, validation and test part of a trial.

    Args:
        trial: The trial.
        batch: The levered interactions.
        proportional: Take the paper's proportions instead of its 1400, 100 and 300 interactions.
    """
    return EXPERIMENTS[trial.experiment].split(batch, trial.setting, trial.seed, proportional)
