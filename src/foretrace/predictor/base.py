"""The contract of learned predictors: between training, checkpoints and everything that imagines effects."""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from foretrace.errors import CheckpointError, TrainingError, shown
from foretrace.features import Precision
from foretrace.files import as_path
from foretrace.imagined import Futures, ImaginedBatch, Imaginer, Scenes, Start
from foretrace.imagined.context import CONSTANTS
from foretrace.imagined.domain import Ranges, find_unusual, measure_context
from foretrace.interactions.batch import Candidates, InteractionBatch
from foretrace.interactions.record import Outcome
from foretrace.predictor.config import PredictorConfig
from foretrace.predictor.states import (
    Effects,
    StateKind,
    decode_poses,
    decode_turns,
    encode_states,
    rest_states,
    state_size,
    valid_lengths,
)
from foretrace.registry import Registry, adds_anything

if TYPE_CHECKING:
    from foretrace.predictor.traced import TracedPredictor

ROWS_AT_ONCE = 256
"""Images convolved together: bounds the memory that it takes."""


class EffectPredictor(Imaginer, nn.Module):
    """Imagines the effect of an action with a network that has learned from interactions (paper, section 3).

    A subclass has a ``label``, a ``config_class`` and two methods, `training_loss` and `roll_out`; everything between
    arrays in metres and normalised states is done here. Further methods are hooks, which do nothing or the usual unless
    they are overridden. Defining the subclass registers it in PREDICTORS, except with ``abstract=True`` behind the base
    class. The constructor takes ``(config, num_samples)``.

    Normalisation and sample times are tensors of the checkpoint, set once from the training part.

    Args:
        config: Its settings.
        num_samples: Samples in an imagined trajectory.
        state: What it predicts.
        outcomes: Outcomes that it distinguishes; none if it expects one thing to happen.
    """

    label: ClassVar[str]
    """Name in PREDICTORS and in checkpoints."""
    config_class: ClassVar[type[PredictorConfig]]
    """Class of its settings."""
    keeps_last_epoch: ClassVar[bool] = False
    """Whether the model of the last epoch is kept, instead of that of the least validation loss."""
    state_mean: Tensor
    state_scale: Tensor
    times: Tensor
    known_mean: Tensor
    known_scale: Tensor

    def __init_subclass__(cls, abstract: bool = False, **more: Any) -> None:
        super().__init_subclass__(**more)
        if abstract or not adds_anything(cls):
            return
        own = cls.__dict__.get("config_class")
        if (
            "label" not in cls.__dict__
            or not (isinstance(own, type) and issubclass(own, PredictorConfig))
            or own is PredictorConfig
        ):
            raise TypeError(
                f"{cls.__name__} needs a label and a config_class of its own, a PredictorConfig; or abstract=True"
            )
        if "predictor_class" in own.__dict__ and own.predictor_class.__qualname__ != cls.__qualname__:
            raise TypeError(
                f"{own.__name__} makes {own.predictor_class.__name__} already: give {cls.__name__} its own"
            )
        PREDICTORS.add(cls.label, cls)
        own.predictor_class = cls

    def __init__(
        self,
        config: PredictorConfig,
        num_samples: int,
        state: StateKind = "position",
        outcomes: Sequence[str] = (),
    ):
        super().__init__()
        self.config = config
        """Its settings."""
        self.features = config.make_features()
        """Features of the object that it is given."""
        self.outcomes = tuple(outcomes)
        """Outcomes that it distinguishes."""
        self.state: StateKind = state
        """What it predicts."""
        self.learned_from: tuple[str, ...] = (str(Outcome.LEVERED),)
        """Outcomes of its training part."""
        self.fine_tuned = False
        """Whether it is being trained although it was trained before."""
        self.ranges: Ranges = {}
        """Range of each of `foretrace.imagined.domain.MEASURES` in the training part; empty if unknown."""
        self.register_buffer("state_mean", torch.zeros(state_size(state)))
        self.register_buffer("state_scale", torch.ones(state_size(state)))
        self.register_buffer("times", torch.zeros(num_samples, dtype=torch.float64))
        self.context = config.context
        if self.context:  # without context it has the tensors of the oldest checkpoints; so are their names
            self.register_buffer("known_mean", torch.zeros(len(self.context)))
            self.register_buffer("known_scale", torch.ones(len(self.context)))
        self.marginal = config.hidden_share > 0
        self.optional = [k for k, name in enumerate(self.context) if self.marginal and name in CONSTANTS]
        """Columns of the context that need not be told; behind the context, the network is given whether they were."""

    # --- to be written ------------------------------------------------------------------------------------

    @abstractmethod
    def training_loss(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> Float[Tensor, ""]:
        """The error to minimise.

        ``features`` are those of the object and, behind them, the context: as from `add_context`.
        """

    @abstractmethod
    def roll_out(
        self, features: Float[Tensor, "batch inputs"], first: Float[Tensor, "batch state"]
    ) -> Float[Tensor, "batch time state"]:
        """The expected trajectories of normalised states from the first state alone, ``first`` included."""

    # --- hooks --------------------------------------------------------------------------------------------

    @property
    def display_name(self) -> str:
        """Name in figures and tables."""
        return f"{self.features.label} + {self.label}"

    @property
    def is_symmetric(self) -> bool:
        """Whether mirror images have mirrored motions, exactly; by default not."""
        return False

    @property
    def feature_weights(self) -> list[nn.Parameter]:
        """Weight matrices of the features, which decay with the number of features; none by default."""
        return []

    def lengths(self, batch: InteractionBatch) -> Int[np.ndarray, " batch"]:
        """Samples of each trajectory that are learned; by default up to where the object slipped."""
        return valid_lengths(batch)

    def prepare(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> None:
        """Take from the whole training part what is needed before the first step; by default nothing."""

    def finish(
        self,
        features: Float[Tensor, "batch inputs"],
        effects: Effects,
        other_features: Float[Tensor, "other inputs"],
        other_effects: Effects,
    ) -> None:
        """Take from training and validation part what is needed after the last step; by default nothing."""

    def calibrate(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> None:
        """Fit probabilities and prediction regions to interactions that were not learned from; a hook.

        Raises:
            TrainingError: By default: the predictor has none.
        """
        raise TrainingError(f"predictor {shown(self.label)} has no regions to calibrate: take one-shot")

    def set_precision(self, precision: Precision) -> None:
        """Fix the number format of the large products in training; evaluation is always in float32."""
        self.features.precision = precision

    def imagine_effects(
        self,
        features: Float[Tensor, "batch inputs"],
        com: Float[np.ndarray, "batch 3"],
        observed: Float[np.ndarray, "batch samples 6"] | None = None,
        start: Start = "observed",
    ) -> ImaginedBatch:
        """Effects from what `add_context` gives; by default one future each, that of `roll_out`.

        Args:
            features: Features and context.
            com: Centres of mass at rest in the action frame [m].
            observed: As `Scenes.observed`; only a predictor that ``observes`` is given any.
            start: As `Scenes.start`.
        """
        states = self.imagine_states(features, rest_states(com, self.state))
        pose = None if self.state == "position" else decode_poses(states)
        futures = Futures.point(states[..., :3], decode_turns(states), " or ".join(self.learned_from))
        return ImaginedBatch(self.sample_times, states[..., :3], pose, futures)

    def traced(self) -> "TracedPredictor":
        """The network that an export writes; by default one from features or image to the trajectory of `roll_out`."""
        from foretrace.predictor.traced import TracedTrajectory

        return TracedTrajectory(self)

    # --- final --------------------------------------------------------------------------------------------

    @final
    def save_pretrained(self, path: str | Path) -> None:
        """Write ``config.json``, ``model.safetensors`` and a card, ``README.md``, into a folder, as model hubs have it.

        Args:
            path: The folder; made if it does not exist. A card that it has is kept.

        Raises:
            CheckpointError: The folder cannot be made.
        """
        from foretrace.predictor.hub import save_pretrained

        save_pretrained(self, path)

    @final
    @classmethod
    def from_pretrained(cls, path: str | Path) -> "EffectPredictor":
        """Read a predictor from a folder that `save_pretrained` or a training wrote; nothing is fetched.

        Args:
            path: The folder.

        Raises:
            CheckpointError: A file is missing or damaged, tensors do not fit, or it is a predictor of another class.
        """
        from foretrace.predictor.checkpoint import read_predictor

        found = read_predictor(as_path(path, CheckpointError))
        if not isinstance(found, cls):
            raise CheckpointError(
                f"{path} is a predictor {shown(found.label)}, no {cls.__name__}: take "
                f"{type(found).__name__}.from_pretrained"
            )
        return found

    @final
    @property
    def name(self) -> str:
        """Name in messages."""
        return self.label

    @property
    def learned_outcomes(self) -> tuple[str, ...]:
        """Outcomes of its training part."""
        return self.learned_from

    @final
    @property
    def needs_effect(self) -> str | None:
        """Features that are observed during the action."""
        return f"features {shown(self.features.label)}" if self.features.oracle else None

    @final
    @property
    def sample_times(self) -> Float[np.ndarray, " time"]:
        """Times of the imagined samples [s]."""
        return self.times.cpu().numpy()

    @final
    @property
    def num_samples(self) -> int:
        """Samples in an imagined trajectory."""
        return len(self.times)

    @final
    @property
    def num_inputs(self) -> int:
        """Length of what the network is given: features of the object, and the context."""
        return self.features.num_features + len(self.context) + len(self.optional)

    @final
    @property
    def is_trained(self) -> bool:
        """Whether a training has begun: the times of samples come from its data."""
        return bool(self.times.any())

    @final
    @property
    def device(self) -> torch.device:
        """Where the predictor's tensors are."""
        return self.state_mean.device

    @final
    def imagine_scenes(self, scenes: Scenes) -> ImaginedBatch:
        """Imagine the effects in scenes, with warnings about objects that are unlike those learned from."""
        source = scenes.source
        inputs = (
            self.features.candidate_inputs(source)
            if isinstance(source, Candidates)
            else self.features.inputs(source)
        )
        features = self.add_context(self.compute_features(inputs), scenes.context)
        imagined = self.imagine_effects(features, scenes.com, scenes.observed, scenes.start)
        if not self.ranges:
            return imagined
        told = measure_context(self.context, scenes.context)
        unusual = find_unusual(scenes.measure() | self.features.measure(inputs) | told, self.ranges)
        return ImaginedBatch(imagined.times, imagined.com, imagined.pose, imagined.futures, unusual)

    @final
    def encode(self, batch: InteractionBatch) -> Float[np.ndarray, "batch time state"]:
        """States of trajectories in the action frame [m], zeros past their lengths.

        Of actions that were observed for a shorter time than the predictor imagines, the last samples are such zeros.
        """
        states = encode_states(batch, self.state, self.lengths(batch))
        return np.pad(states, ((0, 0), (0, self.num_samples - states.shape[1]), (0, 0)))

    @final
    def number_outcomes(self, batch: InteractionBatch) -> Int[np.ndarray, " batch"]:
        """Number of each interaction's outcome among those that it distinguishes.

        Raises:
            TrainingError: One that it does not distinguish.
        """
        if not self.outcomes:
            return np.zeros(len(batch), dtype=np.int64)
        if odd := sorted(set(batch.outcome.tolist()) - set(self.outcomes)):
            raise TrainingError(
                f"an interaction has the outcome {shown(odd[0])}, and the predictor distinguishes "
                f"{', '.join(self.outcomes)}: name it among the outcomes or leave the interaction out"
            )
        return np.array([self.outcomes.index(name) for name in batch.outcome.tolist()], dtype=np.int64)

    @final
    def set_normalisation(
        self,
        mean: Float[np.ndarray, " state"],
        scale: Float[np.ndarray, " state"],
        times: Float[np.ndarray, " time"],
    ) -> None:
        """Fix how states are normalised and when samples are taken [s]."""
        self.state_mean.copy_(torch.from_numpy(mean))
        self.state_scale.copy_(torch.from_numpy(scale))
        self.times.copy_(torch.from_numpy(times))

    @final
    def set_context(self, values: Float[np.ndarray, "batch context"]) -> None:
        """Fix how the context is standardised: by mean and deviation of the training part's."""
        if self.context:
            told = np.isfinite(values).any(axis=0)
            mean, scale = (
                np.where(told, found(np.where(told, values, 0.0), axis=0), 0.0)
                for found in (np.nanmean, np.nanstd)
            )
            self.known_mean.copy_(torch.from_numpy(mean))
            # A value that is the same everywhere tells nothing apart: it is only shifted.
            same = scale <= 1e-9 * np.maximum(np.abs(mean), 1e-9)
            self.known_scale.copy_(torch.from_numpy(np.where(same, 1.0, scale)))

    @final
    def add_context(
        self,
        features: Float[Tensor, "batch features"],
        values: Float[np.ndarray, "batch context"] | Float[Tensor, "batch context"] | None,
    ) -> Float[Tensor, "batch inputs"]:
        """Inputs of the network: features of objects, and behind them the context, standardised.

        Of a value that is not told (NaN) the network is given the mean, and that it was not told.
        """
        if not self.context:
            return features
        assert values is not None
        context = torch.as_tensor(values, dtype=torch.float32, device=self.device)
        standard = (context - self.known_mean) / self.known_scale
        if not self.optional:
            return torch.cat([features, standard], dim=1)
        told = ~context[:, self.optional].isnan()
        return torch.cat([features, torch.where(context.isnan(), 0.0, standard), told.float()], dim=1)

    @final
    def hide_context(self, inputs: Float[Tensor, "batch inputs"]) -> Float[Tensor, "batch inputs"]:
        """Inputs of which constants are hidden at random, as ``hidden_share`` of the settings asks for."""
        if not self.optional:
            return inputs
        rows, number = len(inputs), len(self.optional)
        chance = torch.rand(rows, 1, device=inputs.device)
        some = torch.rand(rows, number, device=inputs.device) < 0.5
        hidden = (chance < self.config.hidden_share / 2) | (some & (chance < self.config.hidden_share))
        return self.without_context(inputs, hidden)

    def augment(
        self, inputs: Float[Tensor, "batch inputs"], effects: Effects
    ) -> tuple[Float[Tensor, "batch inputs"], Effects]:
        """What one training step learns from: by default the interactions with some constants hidden.

        Args:
            inputs: Features and context, as from `add_context`.
            effects: The effects.
        """
        return self.hide_context(inputs), effects

    @final
    def without_context(
        self, inputs: Float[Tensor, "batch inputs"], hidden: Bool[Tensor, "batch optional"]
    ) -> Float[Tensor, "batch inputs"]:
        """Inputs of which the given constants are hidden."""
        inputs, number = inputs.clone(), len(self.optional)
        values = [self.features.num_features + column for column in self.optional]
        flags = range(inputs.shape[1] - number, inputs.shape[1])
        inputs[:, [*values, *flags]] *= ~hidden.repeat(1, 2)
        return inputs

    @final
    def normalise(self, states: Float[np.ndarray, "*batch state"]) -> Float[Tensor, "*batch state"]:
        """States in metres as the network is given them."""
        states32 = torch.as_tensor(states, dtype=torch.float32, device=self.device)
        return (states32 - self.state_mean) / self.state_scale

    @final
    def compute_features(
        self, inputs: Shaped[Tensor, "batch ..."], in_place: bool = False
    ) -> Float[Tensor, "batch features"]:
        """Features of prepared inputs, on the predictor's device, as they are outside training.

        Args:
            inputs: Inputs of the features.
            in_place: Whether features that are as large as their inputs may take their place.
        """
        with _evaluating(self):
            parts = inputs.split(ROWS_AT_ONCE)
            first = self.features(parts[0].to(self.device))
            if first.shape != (len(parts[0]), self.features.num_features):
                raise TrainingError(
                    f"features {shown(self.features.label)} have the shape {tuple(first.shape)} for {len(parts[0])} "
                    f"interactions: num_features is {self.features.num_features}"
                )
            if in_place and (first.shape, first.dtype) == (parts[0].shape, inputs.dtype):
                for part in parts:
                    part.copy_(self.features(part.to(self.device)))
                return inputs.to(self.device)
            return torch.cat([first, *(self.features(part.to(self.device)) for part in parts[1:])])

    @final
    def imagine_states(
        self, features: Float[Tensor, "batch inputs"], first: Float[np.ndarray, "batch state"]
    ) -> Float[np.ndarray, "batch time state"]:
        """Roll out states in the action frame [m] from what `add_context` gives and first states."""
        with _evaluating(self):
            rolled = self.roll_out(features, self.normalise(first))
            states = (rolled.double() * self.state_scale + self.state_mean).cpu().numpy()
        # The first state was given: hand it back as it came, not as float32 made of it.
        states[:, 0] = first
        return states


PREDICTORS: Registry[type[EffectPredictor]] = Registry("predictor", "foretrace.predictors", TrainingError)
"""Every predictor class by its label."""
PREDICTORS.declare("lstm", "foretrace.predictor.lstm")
PREDICTORS.declare("one-shot", "foretrace.predictor.one_shot")


@contextmanager
def _evaluating(module: nn.Module) -> Iterator[None]:
    """Without dropout and gradients for a while."""
    was_training = module.training
    if was_training:
        module.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        if was_training:
            module.train()
