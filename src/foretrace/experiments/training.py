"""How experiments make and train predictors."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from foretrace.errors import TrainingError, shown
from foretrace.files import short_hash
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import Split
from foretrace.predictor import (
    PREDICTORS,
    EffectPredictor,
    LstmPredictor,
    PredictorConfig,
    TrainConfig,
    fit_predictor,
    train_predictor,
)
from foretrace.predictor.loading import default_checkpoint
from foretrace.predictor.run_folder import MODEL, Progress
from foretrace.predictor.states import valid_lengths
from foretrace.predictor.training import RUNTIME

BASE = LstmPredictor.label
"""The paper's predictor, which is trained with each of the features that are compared."""
OF_THE_TRIAL = ("features", "feature_options", "steps_ahead", "context", "outcomes", "split", "seed")


@dataclass(frozen=True)
class Recipe:
    """How a predictor is made and trained."""

    predictor: PredictorConfig
    """Its settings."""
    training: TrainConfig
    """Settings of the loop."""

    @classmethod
    def of(cls, label: str) -> "Recipe":
        """The default settings of a predictor, and the training that they recommend.

        Raises:
            TrainingError: It is unknown.
        """
        config = PREDICTORS.find(label).config_class()
        return cls(config, config.training)

    @property
    def features(self) -> str:
        """Features of the object."""
        return self.predictor.features

    @property
    def feature_options(self) -> Mapping[str, Any]:
        """Settings of the features."""
        return self.predictor.feature_options

    def change(self, **settings: Any) -> "Recipe":
        """The same with other settings of predictor or training, by name; None leaves one as it is.

        Raises:
            TrainingError: Neither has such a setting.
        """
        given = {name: value for name, value in settings.items() if value is not None}
        own, loop = ({each.name for each in fields(part)} for part in (self.predictor, self.training))
        if odd := [name for name in given if name not in own | loop]:
            raise TrainingError(
                f"neither the predictor nor its training has a setting {shown(odd[0])}: leave it out"
            )
        return Recipe(
            replace(self.predictor, **{name: value for name, value in given.items() if name in own}),
            replace(self.training, **{name: value for name, value in given.items() if name in loop}),
        )

    def describe(self) -> dict[str, Any]:
        """What decides the weights beside data and trial, JSON-able."""
        predictor, training = asdict(self.predictor), asdict(self.training)
        # A setting that is younger than kept results is named only where it is not what it was for these.
        unchanged = {
            name for name in self.predictor.added if predictor[name] == getattr(type(self.predictor), name)
        }
        left_out = {*OF_THE_TRIAL, *RUNTIME, *unchanged}
        return {
            "predictor": {name: value for name, value in predictor.items() if name not in left_out},
            "training": {name: value for name, value in training.items() if name not in left_out},
        }

    def make(self, num_samples: int) -> EffectPredictor:
        """The untrained predictor of motions with this many samples."""
        return self.predictor.make(num_samples)

    def inputs(self, batch: InteractionBatch) -> Tensor:
        """Inputs of the features for a whole batch."""
        return self.predictor.make_features().inputs(batch)

    def fit(
        self, batch: InteractionBatch, split: Split, inputs: Tensor | None = None, fitted: Path | None = None
    ) -> tuple[EffectPredictor, Progress]:
        """Train in memory; as `foretrace.predictor.fit_predictor`."""
        return fit_predictor(batch, self.predictor, split, self._training, inputs=inputs, fitted=fitted)

    def train(self, batch: InteractionBatch, split: Split, out: Path) -> Path:
        """Train and keep the training in a folder, unless that is done; one that was cut short goes on."""
        return train_predictor(batch, self.predictor, out, self._training, split=split, progress=False)

    @property
    def _training(self) -> TrainConfig:
        """With the threads that the process has: as many as the experiment is run with."""
        return replace(self.training, threads=self.training.threads or torch.get_num_threads())


def load_levered(data: str | Path) -> InteractionBatch:
    """The interactions of a data set that the paper learns from: levered, and at least two samples long."""
    batch = Dataset.open(data).where(outcome=str(Outcome.LEVERED)).batch()
    return batch[valid_lengths(batch) >= 2]


def weights_of(run: Path | None) -> str | None:
    """A checksum of a trained predictor's weights; None stands for the predictor that comes with foretrace."""
    folder = default_checkpoint() if run is None else run
    return short_hash([(folder / MODEL).read_bytes()]) if (folder / MODEL).is_file() else None
