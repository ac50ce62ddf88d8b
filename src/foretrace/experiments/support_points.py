"""How often support corners are named right before the action: predicted, by rule, by chance (paper, section 5.1)."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from foretrace.errors import TrainingError, shown
from foretrace.features import FeatureExtractor, FitPart, Option, make_features
from foretrace.features.support_points import (
    hull_and_com,
    is_correct,
    order_points,
    points_of,
)
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.splits import Split

CHOICES = ("sp-pred", "sp-rule", "chance")
"""Whose answers can be judged."""


def support_point_metrics(
    features: str, batch: InteractionBatch, split: Split, seed: int, **options: Option
) -> dict[str, float]:
    """Share of a test part's interactions of which both support corners are named right.

    ``chance`` draws one edge of the convex hull, all alike but for the levered one, and its metrics are
    expected values: 1 / (n - 1) for an object of n corners. The paper's 23 % is their mean over 3 to 10
    corners, ``accuracy_balanced``; over interactions, two for each edge of an object, it is 19 %.

    Args:
        features: One of CHOICES. ``sp-pred`` is fitted to the training part; its validation part chooses the
            epoch.
        batch: Interactions, those without observed support points are left out.
        split: Which of them are for training, validation and test.
        seed: Seed of the fit. PyTorch's own random state stays as it was.
        **options: Settings of the feature extractor.

    Returns:
        ``accuracy``: with the object's corners; ``accuracy_3`` and so on: for objects with that number of corners;
        ``accuracy_balanced``: the mean of those; ``accuracy_from_mask``: with corners from the mask alone.

    Raises:
        TrainingError: Unknown features, or no support point of the test part (or for ``sp-pred`` the training
            part) was observed.
    """
    if features not in CHOICES:
        raise TrainingError(
            f"unknown features {shown(features)} for support points: choose {', '.join(CHOICES)}"
        )
    test = batch[split.test]
    test = test[np.isfinite(test.support_points).all(axis=(1, 2))]
    if len(test) == 0:
        raise TrainingError(
            f"none of the {len(split.test)} test interactions has observed support points: add levered ones"
        )
    seen = replace(test, corners=np.full_like(test.corners, np.nan))
    if features == "chance":
        right, right_from_mask = _chances(test, test), _chances(seen, test)
    else:
        extractor = _fitted(features, batch, split, seed, options)
        right, right_from_mask = (
            is_correct(points_of(extractor(extractor.inputs(known))), test.corners, test.support_points)
            for known in (test, seen)
        )
    counts = np.unique(test.num_corners).tolist()
    by_count = {f"accuracy_{n}": float(right[test.num_corners == n].mean()) for n in counts}
    return {
        "accuracy": float(right.mean()),
        "accuracy_from_mask": float(right_from_mask.mean()),
        "accuracy_balanced": float(np.mean(list(by_count.values()))),
        **by_count,
    }


def _fitted(
    features: str, batch: InteractionBatch, split: Split, seed: int, options: Mapping[str, Option]
) -> FeatureExtractor:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        extractor = make_features(features, **options)
        train, validation = (
            FitPart(extractor.inputs(part), part) for part in (batch[split.train], batch[split.validation])
        )
        extractor.fit(train, validation, seed=seed, report=lambda line: None)
    return extractor


def _chances(known: InteractionBatch, truth: InteractionBatch) -> Float[np.ndarray, " test"]:
    """How probably an edge drawn at random is the right one, the levered one excluded."""
    chances = np.zeros(len(truth))
    for row in range(len(truth)):
        hull = hull_and_com(known, row)[0]
        edges = np.stack([hull, np.roll(hull, -1, axis=0)], axis=1)  # (edges, 2, 2)
        along = edges[:, 1] - edges[:, 0]
        # The contact point, which is the origin, lies on the levered edge.
        nearest = np.clip(-(edges[:, 0] * along).sum(-1) / (along**2).sum(-1), 0, 1)
        levered = np.linalg.norm(edges[:, 0] + nearest[:, None] * along, axis=-1).argmin()
        others = order_points(np.delete(edges, levered, axis=0))
        one = truth[np.full(len(others), row)]
        chances[row] = is_correct(others, one.corners, one.support_points).mean()
    return chances
