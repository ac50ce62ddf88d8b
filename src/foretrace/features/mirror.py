"""Features of an object and of its mirror image, side by side."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from foretrace.features.base import FeatureExtractor, FitPart
from foretrace.interactions.batch import InteractionBatch


class MirroredFeatures(FeatureExtractor, abstract=True):
    """Features of each object, and behind them those of its mirror image along the action axis.

    What the extractor learns on its own it learns from the objects as they are.

    Args:
        features: The extractor for both.
    """

    def __init__(self, features: FeatureExtractor):
        super().__init__(**features.options, mirrored=True)
        self.features = features
        self.label = features.label  # pyright: ignore[reportAttributeAccessIssue]
        self.oracle, self.learns = features.oracle, features.learns  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def num_features(self) -> int:
        """Twice as many."""
        return 2 * self.features.num_features

    def inputs(self, batch: InteractionBatch) -> Shaped[Tensor, "batch 2 ..."]:
        """Inputs for objects and for their mirror images."""
        return torch.stack([self.features.inputs(each) for each in (batch, batch.mirrored())], dim=1)

    def fit(self, train: FitPart, validation: FitPart, *, seed: int, report: Callable[[str], None]) -> None:
        """Train the extractor on the objects as they are."""
        train, validation = (replace(part, inputs=part.inputs[:, 0]) for part in (train, validation))
        self.features.precision = self.precision
        self.features.fit(train, validation, seed=seed, report=report)

    def measure(self, inputs: Shaped[Tensor, "batch 2 ..."]) -> dict[str, Float[np.ndarray, " batch"]]:
        """Those of the objects as they are."""
        return self.features.measure(inputs[:, 0])

    def forward(self, inputs: Shaped[Tensor, "batch 2 ..."]) -> Float[Tensor, "batch features"]:
        """Both, one behind the other."""
        self.features.precision = self.precision
        return self.features(inputs.flatten(0, 1)).unflatten(0, (-1, 2)).flatten(1)
