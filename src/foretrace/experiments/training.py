"""How experiments make and train predictors."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from foretrace.errors import TrainingError
from foretrace.features import Option, make_features
from foretrace.files import short_hash
from foretrace.interactions.dataset import Dataset, InteractionBatch
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import Split
from foretrace.predictor import RECIPES, EffectPredictor, TrainConfig, train_predictor
from foretrace.predictor.checkpoint import default_checkpoint, settings_of
from foretrace.predictor.run_folder import MODEL, Progress
from foretrace.predictor.states import valid_lengths
from foretrace.predictor.training import fit_predictor

Device = Literal["auto", "cpu", "cuda"]
BASE = next(iter(RECIPES))
"""The predictor that is trained with each of the features that are compared: the paper's."""
_OF_THE_TRIAL = ("features", "feature_options", "steps_ahead", "known", "outcomes", "split", "seed")
_WHERE = ("device", "precision", "threads")


@dataclass(frozen=True)
class Recipe:
    """How a predictor is made and trained."""

    training: TrainConfig = field(default_factory=TrainConfig)

    @classmethod
    def of(cls, predictor: str) -> "Recipe":
        """What a kind of predictor is trained with by default.

        Raises:
            TrainingError: It is unknown.
        """
        if predictor not in RECIPES:
            raise TrainingError(f"unknown predictor {predictor!r}; available: {', '.join(RECIPES)}")
        return cls(RECIPES[predictor])

    @property
    def features(self) -> str:
        """What the predictor is told about an object."""
        return self.training.features

    @property
    def feature_options(self) -> dict[str, Option]:
        """Settings of the features."""
        return self.training.feature_options

    def change(self, options: Mapping[str, Option] | None = None, **settings: Any) -> "Recipe":
        """The same with other settings of predictor and training; None leaves one as it is.

        Args:
            options: Further settings of the predictor, by name.
            **settings: Settings, by name.
        """
        given = {name: value for name, value in settings.items() if value is not None}
        if options:
            given["predictor_options"] = {**self.training.predictor_options, **options}
        return Recipe(replace(self.training, **given))

    def describe(self) -> dict[str, Any]:
        """What decides the weights beside data and trial, JSON-able."""
        left_out = (*_OF_THE_TRIAL, *_WHERE)
        return {name: value for name, value in settings_of(self.training).items() if name not in left_out}

    def make(self, num_samples: int) -> EffectPredictor:
        """The untrained predictor of motions with this many samples."""
        return self.training.make_predictor(num_samples)

    def inputs(self, batch: InteractionBatch) -> Tensor:
        """Inputs of the features for a whole batch."""
        return make_features(self.training.features, **self.training.feature_options).inputs(batch)

    def fit(
        self, batch: InteractionBatch, split: Split, inputs: Tensor | None = None, fitted: Path | None = None
    ) -> tuple[EffectPredictor, Progress]:
        """Train in memory; as `foretrace.predictor.training.fit_predictor`."""
        return fit_predictor(batch, self.training, split, inputs=inputs, fitted=fitted)

    def train(self, batch: InteractionBatch, split: Split, out: Path) -> Path:
        """Train and keep the training in a folder, unless that is done; one that was cut short goes on."""
        return train_predictor(batch, self.training, out, split=split, progress=False)


def load_levered(data: str | Path) -> InteractionBatch:
    """The interactions of a data set that the paper learns from: levered, and at least two samples long."""
    batch = Dataset.open(data).where(outcome=str(Outcome.LEVERED)).batch()
    return batch[valid_lengths(batch) >= 2]


def weights_of(run: Path | None) -> str | None:
    """A checksum of a trained predictor's weights; None stands for the predictor that comes with foretrace."""
    folder = default_checkpoint() if run is None else run
    return short_hash((folder / MODEL).read_bytes()) if (folder / MODEL).is_file() else None
