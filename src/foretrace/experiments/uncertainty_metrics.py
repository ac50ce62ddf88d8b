"""What is measured of several futures: outcomes, errors, regions, samples, and the rest of a motion that is under way.

Samples have proper scores (Gneiting and Raftery, 2007, "Strictly proper scoring rules, prediction, and estimation"): a
forecast that states what it believes has the best expected score. Beside the predictor's own samples, those of a
Gaussian of constant width are scored. A forecast without any spread scores its mean error.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
import scoringrules
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foretrace.evaluation.metrics import METRICS
from foretrace.imagined import LEVELS, Futures, ImaginedBatch
from foretrace.imagined.context import recorded_context
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.splits import Split
from foretrace.predictor import OneShotPredictor
from foretrace.predictor.mixture import Mixture
from foretrace.predictor.states import decode_poses, encode_states
from foretrace.trajectories import mean_distance, rotation_error

FORECASTS = {
    "mixture": "the predictor's futures",
    "gaussian": "constant Gaussian, most likely width",
    "sharp": "constant Gaussian, width of the best CRPS",
}
"""Whose samples are scored, in words."""
SCORES = {
    "energy_full": "Energy score, whole motion [cm]",
    "energy_final": "Energy score, final position [cm]",
    "crps": "CRPS, per coordinate [cm]",
}
"""Scores, in words; less is better."""
WIDTHS = np.geomspace(1e-5, 1.0, 201)
"""Standard deviations among which that of the best CRPS is sought [m]."""
SHOWN_LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Levels of the regions that tables tell of."""
OBSERVED = (0, 10, 15, 20, 25, 30, 40)
"""How many samples of a motion are known when the rest of it is predicted."""
MOVED = 0.001
"""An object moves once its centre of mass is so far from where it was at rest [m]."""
BEGINNINGS = ("record", "moving")
"""From where observed samples are counted: the record's start, or the first sample of an object that moves."""
UNLIKE = "unlike_"
"""Begins the names of metrics of interactions with other physics than those learned from."""
ALL = "all"
"""The group of all interactions; others are named like their outcomes."""
CM = 100.0

Found = list[tuple[str, str, float, float]]
"""Rows of the results: metric, group, level (NaN where there is none), value."""


@dataclass(frozen=True)
class Part:
    """Some interactions, prepared for a predictor."""

    batch: InteractionBatch
    features: Tensor
    """(batch, inputs)."""
    states: Float[np.ndarray, "batch time 6"]
    """What happened: positions in the action frame [m], rotation vectors since rest [rad]; 0 past the end."""
    valid: Bool[np.ndarray, "batch time"]
    """The samples of whole records."""

    @classmethod
    def of(cls, predictor: OneShotPredictor, batch: InteractionBatch) -> "Part":
        """As prepared for a predictor."""
        features = predictor.compute_features(predictor.features.inputs(batch))
        features = predictor.add_context(features, recorded_context(batch, predictor.context))
        valid = np.arange(batch.com.shape[1]) < batch.length[:, None]
        return cls(batch, features, encode_states(batch, predictor.state, batch.length), valid)

    def __len__(self) -> int:
        return len(self.batch)

    @property
    def com(self) -> Float[np.ndarray, "batch time 3"]:
        """Where centres of mass were [m]."""
        return self.states[..., :3]

    @property
    def groups(self) -> dict[str, Bool[np.ndarray, " batch"]]:
        """Members of each group: all, and those of each outcome."""
        names = np.unique(self.batch.outcome).tolist()
        return {ALL: np.ones(len(self), dtype=bool)} | {name: self.batch.outcome == name for name in names}

    def imagine(
        self, predictor: OneShotPredictor, rows: np.ndarray | None = None, observed: int = 0
    ) -> ImaginedBatch:
        """Effects of some rows (by default all) after their first samples were observed."""
        rows = np.arange(len(self)) if rows is None else rows
        seen = self.states[rows, :observed] if observed else None
        return predictor.imagine_effects(self.features[rows], self.com[rows, 0], seen)

    def mixture(self, predictor: OneShotPredictor) -> Mixture:
        """The prediction before anything was observed."""
        start = torch.as_tensor(self.com[:, 0], dtype=torch.float32, device=predictor.device)
        with torch.no_grad():
            return predictor.mixture(self.features, start)

    def means(self, metric: str, values: np.ndarray, level: float = np.nan) -> Found:
        """Rows of a metric: the mean of its values over each group, one value for each interaction."""
        return [(metric, name, level, float(np.mean(values[mine]))) for name, mine in self.groups.items()]


def measure(
    predictor: OneShotPredictor,
    batch: InteractionBatch,
    split: Split,
    seed: int,
    samples: int = 100,
    unlike: InteractionBatch | None = None,
) -> pd.DataFrame:
    """All that is measured of one predictor.

    Args:
        predictor: The predictor.
        batch: The interactions.
        split: Those of its training. The validation part fits the forecasts that its samples are compared with.
        seed: Seed of the samples.
        samples: Motions drawn at random for each interaction.
        unlike: Interactions with other physics than those learned from, sampled alike. Of these, only the gain by
            observed samples is measured; their metrics begin with `UNLIKE`.

    Returns:
        ``metric``, ``group`` (`ALL` or an outcome; of ``confusion``, what happened and what was
        predicted), ``level`` (of a region, or the number of observed samples; else NaN), ``value``. The page on
        uncertainty explains the metrics.
    """
    test, validation = (Part.of(predictor, batch[rows]) for rows in (split.test, split.validation))
    parts = {"train": split.train, "validation": split.validation, "test": split.test}
    found = [
        (f"count_{name}", outcome, np.nan, float(np.sum(batch.outcome[rows] == outcome)))
        for outcome in predictor.outcomes
        for name, rows in parts.items()
    ]
    imagined = test.imagine(predictor)
    found += evaluate_outcomes(futures_of(imagined).outcomes(), test.batch.outcome)
    found += evaluate_errors(imagined, test)
    found += evaluate_regions(futures_of(imagined), test)
    mixture = test.mixture(predictor)
    deviations = constant_deviations(validation.imagine(predictor).com - validation.com, validation.valid)
    for name, drawn in draw(mixture, imagined.com, deviations, samples, seed):
        for metric, values in score(drawn, test.com, test.valid).items():
            found += test.means(f"{name}_{metric}", values)
    found += evaluate_observed(predictor, test)
    if unlike is not None:
        other = Part.of(predictor, unlike[np.isin(unlike.outcome, predictor.outcomes)])
        found += [(UNLIKE + metric, *row) for metric, *row in evaluate_observed(predictor, other)]
    return pd.DataFrame(found, columns=["metric", "group", "level", "value"])


def futures_of(imagined: ImaginedBatch) -> Futures:
    """All that may happen."""
    assert imagined.futures is not None
    return imagined.futures


def evaluate_outcomes(predicted: Mapping[str, Float[np.ndarray, " batch"]], truth: np.ndarray) -> Found:
    """Whether the most probable outcome is what happened.

    Returns:
        ``confusion``: how often of two outcomes the first happened and the second was most probable. ``f1`` of each
        outcome that happened or was predicted, and their mean ``macro_f1``. ``accuracy``, and that of always predicting
        the most common outcome, ``accuracy_of_most_common``. ``brier``: the squared distance of the probabilities from
        what happened (Brier, 1950), summed over outcomes.
    """
    names = list(predicted)
    best = np.array(names)[np.argmax(list(predicted.values()), axis=0)]
    counts = {(a, b): int(np.sum((truth == a) & (best == b))) for a in names for b in names}
    found: Found = [("confusion", f"{a}, predicted {b}", np.nan, float(n)) for (a, b), n in counts.items()]
    f1 = {}
    for name in names:
        hits, happened, claimed = counts[name, name], np.sum(truth == name), np.sum(best == name)
        if happened + claimed:
            f1[name] = 2 * hits / float(happened + claimed)
    found += [("f1", name, np.nan, value) for name, value in f1.items()]
    brier = sum((probability - (truth == name)) ** 2 for name, probability in predicted.items())
    common = max(np.mean(truth == name) for name in names)
    overall = {"macro_f1": np.mean(list(f1.values())), "accuracy": np.mean(best == truth)}
    overall |= {"accuracy_of_most_common": common, "brier": np.mean(brier)}
    return found + [(metric, ALL, np.nan, float(value)) for metric, value in overall.items()]


def evaluate_errors(imagined: ImaginedBatch, part: Part) -> Found:
    """Errors of the most probable future, and of the nearest of those that count.

    Returns:
        ``full`` and ``final`` [cm], means; ``full_median``; ``until_slip_full`` and ``until_slip_final``: the same up
        to where the object slipped; ``nearest_full`` and ``nearest_final`` [cm]: the least of all futures that count;
        ``futures``: how many those are. ``rotation`` [degrees]: the median over interactions of the mean angle, and
        ``final_rotation``.
    """
    futures = futures_of(imagined)
    until_slip = part.valid & (np.arange(part.com.shape[1]) < part.batch.slip_index[:, None])
    found = part.means("futures", futures.counted.sum(axis=1).astype(float))
    for name, distance in METRICS.items():
        truth = _known(part.com, part.valid)
        error = CM * np.asarray(distance(imagined.com, truth))
        slip = CM * np.asarray(distance(imagined.com, _known(part.com, until_slip)))
        each = CM * np.asarray(distance(futures.com, np.broadcast_to(truth[:, None], futures.com.shape)))
        nearest = np.where(futures.counted, each, np.inf).min(axis=1)
        found += part.means(name, error) + part.means(f"until_slip_{name}", slip)
        found += part.means(f"nearest_{name}", nearest)
        if name == "full":
            found += _medians(part, "full_median", error)
    assert imagined.pose is not None
    turned = np.degrees(rotation_error(imagined.pose[..., 3:], decode_poses(part.states)[..., 3:]))
    found += _medians(part, "rotation", np.nanmean(np.where(part.valid, turned, np.nan), axis=1))
    return found + _medians(part, "final_rotation", turned[np.arange(len(part)), part.batch.length - 1])


def evaluate_regions(futures: Futures, part: Part) -> Found:
    """How often whole motions stay within regions, and how wide these are.

    Returns:
        ``coverage`` at all `LEVELS`: the share of motions that never leave one of the tubes. ``tube`` [cm] at
        `SHOWN_LEVELS`: the tube's radius about the most probable future, averaged over time; the median.
    """
    apart = np.linalg.norm(futures.com - part.com[:, None], axis=-1) * part.valid[:, None]
    rows, best = np.arange(len(part)), futures.probability.argmax(axis=1)
    found: Found = []
    for level in LEVELS.tolist():
        radius = futures.radius(level)  # NaN for a future that does not count: nothing is within it
        inside = (apart <= radius).all(axis=2).any(axis=1)
        found += part.means("coverage", inside.astype(float), level)
        if level in SHOWN_LEVELS:
            wide = np.where(part.valid, radius[rows, best], 0.0).sum(axis=1) / part.batch.length
            found += _medians(part, "tube", CM * wide, level)
    return found


def evaluate_observed(predictor: OneShotPredictor, part: Part) -> Found:
    """Errors of the rest of motions of which the first samples were observed.

    Returns:
        For both `BEGINNINGS`, with their names in front: ``rest`` [cm], the mean error of the most probable future over
        the samples that were not observed; ``rest_unobserved``, of the prediction before, over the same samples;
        ``rest_ratio``, the first divided by the second; ``rest_count``, interactions that have a rest; ``macro_f1``.
    """
    unobserved = part.imagine(predictor).com
    away = np.linalg.norm(part.com - part.com[:, :1], axis=2) * part.valid
    moves = {"record": np.zeros(len(part), dtype=int), "moving": _first(away > MOVED)}
    found: Found = []
    for beginning in BEGINNINGS:
        for level in OBSERVED:
            known = moves[beginning] + level
            usable = np.flatnonzero(known < part.batch.length)
            if len(usable) == 0:
                continue
            given, outcomes = _given(predictor, part, usable, known[usable])
            rest = part.valid[usable] & (np.arange(part.com.shape[1]) >= known[usable, None])
            truth = _known(part.com[usable], rest)
            after, before = (
                CM * np.asarray(mean_distance(com, truth)) for com in (given, unobserved[usable])
            )
            for name, members in part.groups.items():
                mine = members[usable]
                if not mine.any():
                    continue
                values = {"rest": np.mean(after[mine]), "rest_unobserved": np.mean(before[mine])}
                values |= {"rest_ratio": values["rest"] / values["rest_unobserved"], "rest_count": mine.sum()}
                found += [(f"{beginning}_{m}", name, float(level), float(v)) for m, v in values.items()]
            scores = evaluate_outcomes(outcomes, part.batch.outcome[usable])
            found += [(f"{beginning}_{m}", g, float(level), v) for m, g, _, v in scores if m == "macro_f1"]
    return found


def _given(
    predictor: OneShotPredictor, part: Part, rows: Int[np.ndarray, " n"], known: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n time 3"], dict[str, Float[np.ndarray, " n"]]]:
    """Most probable motions [m] and probabilities of outcomes after ``known`` samples of each were observed."""
    com = np.empty((len(rows), *part.com.shape[1:]))
    outcomes = {name: np.empty(len(rows)) for name in predictor.outcomes}
    for number in np.unique(known).tolist():
        mine = known == number
        imagined = part.imagine(predictor, rows[mine], number)
        com[mine] = imagined.com
        for name, probability in futures_of(imagined).outcomes().items():
            outcomes[name][mine] = probability
    return com, outcomes


def _first(true: Bool[np.ndarray, "batch time"]) -> Int[np.ndarray, " batch"]:
    """The first sample at which something is true; past the end where it never is."""
    return np.where(true.any(axis=1), true.argmax(axis=1), true.shape[1])


def _known(com: Float[np.ndarray, "batch time 3"], valid: np.ndarray) -> Float[np.ndarray, "batch time 3"]:
    """NaN where nothing is judged."""
    return np.where(valid[..., None], com, np.nan)


def _medians(part: Part, metric: str, values: np.ndarray, level: float = np.nan) -> Found:
    return [(metric, name, level, float(np.median(values[mine]))) for name, mine in part.groups.items()]


def constant_deviations(
    off: Float[np.ndarray, "batch time 3"], valid: Bool[np.ndarray, "batch time"]
) -> dict[str, Float[np.ndarray, " time"]]:
    """Standard deviations of coordinates, sample by sample, that fit errors best [m].

    Args:
        off: Errors of the validation part [m].
        valid: Which of them count. A sample that none has gets the deviation of the one before.

    Returns:
        ``gaussian``: the most likely one, the root mean square. ``sharp``: the one with the least mean CRPS, less
        impressed by a few large errors.
    """
    count = valid.sum(axis=0)
    last = np.maximum.accumulate(np.where(count, np.arange(len(count)), 0))
    weight = valid / np.maximum(count, 1)
    square = np.sum(np.where(valid[..., None], off, 0.0) ** 2, axis=2) / 3
    found = np.empty((len(WIDTHS), len(count)))
    for each, width in zip(found, WIDTHS, strict=True):
        crps = scoringrules.crps_normal(np.where(valid[..., None], off, 0.0), 0.0, width, backend="numpy")
        each[:] = (np.mean(crps, axis=2) * weight).sum(axis=0)
    likely = np.sqrt((square * weight).sum(axis=0))
    return {"gaussian": likely[last], "sharp": WIDTHS[found.argmin(axis=0)][last]}


def draw(
    mixture: Mixture,
    com: Float[np.ndarray, "batch time 3"],
    deviations: dict[str, Float[np.ndarray, " time"]],
    num: int,
    seed: int,
) -> Iterator[tuple[str, Float[np.ndarray, "batch num time 3"]]]:
    """Samples of each of `FORECASTS`, by name.

    Args:
        mixture: The prediction.
        com: Its most probable motions [m], about which the constant Gaussians lie. Errors grow along a motion and do
            not jitter: one draw for each coordinate shifts all samples, each by its own deviation.
        deviations: As from `constant_deviations`.
        num: Motions for each interaction.
        seed: Seed of the draw.
    """
    generator = torch.Generator().manual_seed(seed)
    yield "mixture", mixture.sample(num, generator)[..., :3].double().cpu().numpy()
    z = np.random.default_rng(seed).standard_normal((len(com), num, 1, 3))
    for name, deviation in deviations.items():
        yield name, com[:, None] + z * deviation[:, None]


def score(
    drawn: Float[np.ndarray, "batch num time 3"],
    com: Float[np.ndarray, "batch time 3"],
    valid: Bool[np.ndarray, "batch time"],
) -> dict[str, Float[np.ndarray, " batch"]]:
    """`SCORES` of samples [cm], one number per interaction; the estimates are not biased by the number of samples.

    Args:
        drawn: Motions drawn at random [m].
        com: What happened [m].
        valid: The samples that count. Motions are as far apart as the root mean square over them.
    """
    found = {name: np.empty(len(com)) for name in SCORES}
    for row, (sample, truth, mine) in enumerate(zip(drawn, com, valid, strict=True)):
        sample, truth = CM * sample[:, mine], CM * truth[mine]  # (num, time, 3), (time, 3)
        motions, motion = (
            each / len(truth) ** 0.5 for each in (sample.reshape(len(sample), -1), truth.ravel())
        )
        found["energy_full"][row] = _energy(motions, motion)
        found["energy_final"][row] = _energy(sample[:, -1], truth[-1])
        crps = scoringrules.crps_ensemble(truth, sample, m_axis=0, estimator="pwm", backend="numpy")
        found["crps"][row] = np.mean(crps)
    return found


def _energy(sample: Float[np.ndarray, "num dims"], truth: Float[np.ndarray, " dims"]) -> float:
    return float(np.asarray(scoringrules.es_ensemble(truth, sample, estimator="fair", backend="numpy")))
