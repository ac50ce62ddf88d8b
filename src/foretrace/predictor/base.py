"""What a predictor is: the contract between training, checkpoints and everybody who imagines effects."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn

from foretrace.errors import PredictionError, TrainingError
from foretrace.features import FeatureExtractor, Outline, Precision
from foretrace.features.outline import count_corners
from foretrace.geometry import continuous_rotation_vectors, quaternion_to_matrix
from foretrace.imagined import ImaginedBatch, ImaginedEffect
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, TopDownView
from foretrace.predictor.context import check_names, given_values, observed_values
from foretrace.predictor.domain import Ranges, check_view, find_unusual, measure
from foretrace.predictor.states import (
    Effects,
    StateKind,
    decode_poses,
    encode_states,
    rest_states,
    state_size,
    valid_lengths,
)

ROWS_AT_ONCE = 256
"""Images convolved together: bounds the memory that it takes."""

Start = Literal["observed", "estimated"]
"""Where a roll-out's first state comes from: the first recorded sample, or the view from above."""
STARTS: tuple[Start, ...] = ("observed", "estimated")


class EffectPredictor(nn.Module, ABC):
    """Imagines the effect of an action on an object seen from above (paper, section 3).

    A subclass has a label, a configuration that rebuilds it, a training loss and a roll-out; everything
    between arrays in metres and normalised states is done here. Normalisation and sample times are tensors
    of the checkpoint, set once by ``set_normalisation`` from the training part.

    Args:
        features: What it knows about the object.
        state: What it predicts.
        num_samples: Samples in an imagined trajectory.
        known: Physical constants that it is told beside the view: some of `known.KNOWN`.
        outcomes: Outcomes that it tells apart; none if it expects but one thing to happen.
    """

    label: ClassVar[str]
    """Name in PREDICTORS."""
    keeps_last_epoch: ClassVar[bool] = False
    """Whether the model of the last epoch is kept, instead of that of the least validation loss."""
    state_mean: Tensor
    state_scale: Tensor
    times: Tensor
    known_mean: Tensor
    known_scale: Tensor

    def __init__(
        self,
        features: FeatureExtractor,
        state: StateKind,
        num_samples: int,
        known: Sequence[str] = (),
        outcomes: Sequence[str] = (),
    ):
        super().__init__()
        self.features = features
        self.outcomes = tuple(outcomes)
        self.state: StateKind = state
        self.ranges: Ranges = {}
        """Between which values the training part lies, by the names of `domain.MEASURES`; empty if not known."""
        self.register_buffer("state_mean", torch.zeros(state_size(state)))
        self.register_buffer("state_scale", torch.ones(state_size(state)))
        self.register_buffer("times", torch.zeros(num_samples, dtype=torch.float64))
        self.known = check_names(known)
        if self.known:  # a predictor that knows nothing has the tensors of older checkpoints
            self.register_buffer("known_mean", torch.zeros(len(known)))
            self.register_buffer("known_scale", torch.ones(len(known)))

    @property
    @abstractmethod
    def config(self) -> Any:
        """The frozen dataclass of settings that this predictor was made with."""

    def lengths(self, batch: InteractionBatch) -> Int[np.ndarray, " batch"]:
        """Samples of each trajectory that are learned: up to where the object slipped."""
        return valid_lengths(batch)

    def encode(self, batch: InteractionBatch) -> Float[np.ndarray, "batch time state"]:
        """What is learned of trajectories: states in the action frame [m], zeros past their lengths."""
        return encode_states(batch, self.state, self.lengths(batch))

    def number_outcomes(self, batch: InteractionBatch) -> Int[np.ndarray, " batch"]:
        """Which of its outcomes became of each interaction.

        Raises:
            TrainingError: One that it does not tell apart.
        """
        if not self.outcomes:
            return np.zeros(len(batch), dtype=np.int64)
        if odd := sorted(set(batch.outcome.tolist()) - set(self.outcomes)):
            raise TrainingError(
                f"an interaction has the outcome {odd[0]!r}, and the predictor is to learn "
                f"{', '.join(self.outcomes)}: name it among the outcomes or leave the interaction out"
            )
        return np.array([self.outcomes.index(name) for name in batch.outcome.tolist()], dtype=np.int64)

    def prepare(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> None:
        """Take from the whole training part what is needed before the first step; by default nothing."""

    @abstractmethod
    def training_loss(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> Float[Tensor, ""]:
        """The error to minimise.

        ``features`` are those of the object and, behind them, what is known: as from `add_known`.
        """

    def finish(
        self,
        features: Float[Tensor, "batch inputs"],
        effects: Effects,
        other_features: Float[Tensor, "other inputs"],
        other_effects: Effects,
    ) -> None:
        """Take from training and validation part what is needed after the last step; by default nothing."""

    @abstractmethod
    def roll_out(
        self, features: Float[Tensor, "batch inputs"], first: Float[Tensor, "batch state"]
    ) -> Float[Tensor, "batch time state"]:
        """Whole trajectories of normalised states from the first state alone, ``first`` included."""

    @property
    @abstractmethod
    def feature_weights(self) -> list[nn.Parameter]:
        """The weight matrices that features are multiplied with."""

    @property
    def num_samples(self) -> int:
        """Samples in an imagined trajectory."""
        return len(self.times)

    @property
    def num_inputs(self) -> int:
        """Features of the object, and what is known."""
        return self.features.num_features + len(self.known)

    @property
    def device(self) -> torch.device:
        """Where the predictor's tensors are."""
        return self.state_mean.device

    def set_precision(self, precision: Precision) -> None:
        """Fix the number format of the large products in training; evaluation is always in float32."""
        self.features.precision = precision

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

    def set_known(self, values: Float[np.ndarray, "batch known"]) -> None:
        """Fix how known values are standardised: by mean and deviation of the training part's."""
        if self.known:
            mean, scale = values.mean(axis=0), values.std(axis=0)
            self.known_mean.copy_(torch.from_numpy(mean))
            # What is the same everywhere tells nothing apart: it is only shifted.
            same = scale <= 1e-9 * np.abs(mean)
            self.known_scale.copy_(torch.from_numpy(np.where(same, 1.0, scale)))

    def add_known(
        self, features: Float[Tensor, "batch features"], values: Float[np.ndarray, "batch known"]
    ) -> Float[Tensor, "batch inputs"]:
        """What the network is given: features of objects, and behind them known values, standardised."""
        if not self.known:
            return features
        known = torch.as_tensor(values, dtype=torch.float32, device=self.device)
        return torch.cat([features, (known - self.known_mean) / self.known_scale], dim=1)

    def normalise(self, states: Float[np.ndarray, "*batch state"]) -> Float[Tensor, "*batch state"]:
        """States in metres as the network sees them."""
        states32 = torch.as_tensor(states, dtype=torch.float32, device=self.device)
        return (states32 - self.state_mean) / self.state_scale

    def imagine(
        self,
        view: TopDownView,
        com: Float[np.ndarray, "3"] | None = None,
        known: Mapping[str, float] | None = None,
        observed: Float[np.ndarray, "samples 7"] | None = None,
    ) -> ImaginedEffect:
        """Imagine the effect of the action on the object in a view.

        Args:
            view: The object from above, in the action frame.
            com: Its centre of mass at rest in the action frame [m]. Estimated from the view if not given:
                above the centre of the mask's area, at half the object's greatest height.
            known: Values of the constants that the predictor was trained to know, by name [SI].
            observed: The motion's first samples, at the first of the predictor's times, where it is under way
                already: rows as of ``ImaginedEffect.pose_trajectory``. The first one is at rest.

        Raises:
            PredictionError: The view does not show one object that is levered at its rim, see `check_view`; or the
                predictor's features are only known after the action; or a known value is missing, is not finite, or
                is none that the predictor knows; or the predictor makes no use of samples, or they are too many.
        """
        if self.features.oracle:
            raise PredictionError(
                f"features {self.features.label!r} are observed during the action and cannot be had from "
                "a view: use a predictor with other features"
            )
        check_view(view)
        batch = InteractionBatch.from_views([view])
        seen = None if observed is None else self._check_observed(np.asarray(observed, dtype=float))
        if com is None:
            com = estimate_com(batch)[0] if seen is None else seen[0, :3]
        start = np.asarray(com, dtype=float)[None]
        if not np.isfinite(start).all():
            raise PredictionError(f"com is {start[0]}: give a finite centre of mass [m], or none")
        values = given_values(known, self.known)
        inputs = self.features.inputs(batch)
        warnings = self._find_unusual(batch, start, inputs)
        features = self.compute_features(inputs)
        seen = None if seen is None else seen[None]
        imagined = self.imagine_effects(self.add_known(features, values), start, seen)
        return replace(imagined, warnings=warnings)[0]

    def imagine_batch(
        self, batch: InteractionBatch, start: Start = "observed", observed: int = 0
    ) -> ImaginedBatch:
        """Imagine the effects of many actions.

        Args:
            batch: The interactions; of their trajectories only the first sample is read, and not even that if
                ``start`` is ``estimated``. Their constants are read if the predictor knows them.
            start: Whether the roll-out starts from the recorded first state or from the view's estimate.
            observed: How many samples of the motions are known already.

        Raises:
            PredictionError: A constant that the predictor knows is not recorded; or the predictor makes no use of
                observed samples, or they are too many.
        """
        com = batch.com[:, 0] if start == "observed" else estimate_com(batch)
        inputs = self.features.inputs(batch)
        warnings = self._find_unusual(batch, com, inputs)
        features = self.add_known(self.compute_features(inputs), observed_values(batch, self.known))
        seen = None
        if observed:
            unturned = np.broadcast_to([0.0, 0, 0, 1, 0, 0, 0], (observed, 7))
            self._check_observed(unturned)
            if (short := batch.length < observed).any():
                raise PredictionError(
                    f"interaction {batch.ids[short][0]} has {batch.length[short][0]} samples, fewer than the "
                    f"{observed} to be observed: leave it out or observe fewer"
                )
            seen = encode_states(batch, self.state, batch.length)[:, :observed]
        return replace(self.imagine_effects(features, com, seen), warnings=warnings)

    def measure(
        self,
        batch: InteractionBatch,
        com: Float[np.ndarray, "batch 3"],
        inputs: Shaped[Tensor, "batch ..."],
    ) -> dict[str, Float[np.ndarray, " batch"]]:
        """What objects are compared by with those learned from, see `domain.measure`.

        ``inputs`` are those of the features.
        """
        corners = count_corners(inputs).cpu().numpy() if isinstance(self.features, Outline) else None
        return measure(batch, com, corners)

    def _find_unusual(
        self, batch: InteractionBatch, com: np.ndarray, inputs: Tensor
    ) -> tuple[tuple[str, ...], ...]:
        return find_unusual(self.measure(batch, com, inputs), self.ranges) if self.ranges else ()

    def imagine_effects(
        self,
        features: Float[Tensor, "batch inputs"],
        com: Float[np.ndarray, "batch 3"],
        observed: Float[np.ndarray, "batch samples state"] | None = None,
    ) -> ImaginedBatch:
        """Effects from what `add_known` gives, centres of mass at rest [m] and observed states."""
        states = self.imagine_states(features, rest_states(com, self.state))
        pose = None if self.state == "position" else decode_poses(states)
        return ImaginedBatch(self.times.cpu().numpy(), states[..., :3], pose)

    def _check_observed(self, poses: Float[np.ndarray, "samples 7"]) -> Float[np.ndarray, "samples state"]:
        """Observed poses as states."""
        if type(self).imagine_effects is EffectPredictor.imagine_effects:
            raise PredictionError(
                f"the {self.label} predictor makes no use of observed samples: leave them out or use another one"
            )
        if poses.ndim != 2 or poses.shape[1] != 7 or not 1 <= len(poses) < self.num_samples:
            raise PredictionError(
                f"observed samples of shape {poses.shape}: give rows of 7 numbers, from 1 to {self.num_samples - 1}"
            )
        if not np.isfinite(poses).all():
            raise PredictionError("an observed sample is not finite: leave out what comes from it on")
        return np.concatenate(
            [poses[:, :3], continuous_rotation_vectors(quaternion_to_matrix(poses[:, 3:]))], axis=1
        )

    def compute_features(self, inputs: Shaped[Tensor, "batch ..."]) -> Float[Tensor, "batch features"]:
        """Features of prepared inputs, on the predictor's device, as they are outside training."""
        with _evaluating(self):
            return torch.cat([self.features(part.to(self.device)) for part in inputs.split(ROWS_AT_ONCE)])

    def imagine_states(
        self, features: Float[Tensor, "batch inputs"], first: Float[np.ndarray, "batch state"]
    ) -> Float[np.ndarray, "batch time state"]:
        """Roll out states in the action frame [m] from what `add_known` gives and first states."""
        with _evaluating(self):
            rolled = self.roll_out(features, self.normalise(first))
            states = (rolled.double() * self.state_scale + self.state_mean).cpu().numpy()
        # The first state was given: hand it back as it came, not as float32 made of it.
        states[:, 0] = first
        return states


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


def estimate_com(batch: InteractionBatch) -> Float[np.ndarray, "batch 3"]:
    """Centres of mass at rest in the action frame [m], judged from the views.

    Above the centre of each mask's area, at half the object's greatest height: right for a prism of uniform
    density but for its bevel.
    """
    across, along = batch.mask.sum(axis=2), batch.mask.sum(axis=1)
    areas = across.sum(axis=1)
    if not areas.all():
        raise PredictionError(
            f"the mask of interaction {batch.ids[np.argmin(areas)]} is empty; nothing can be imagined"
        )
    rows, columns = (counts @ np.arange(counts.shape[1]) / areas for counts in (across, along))
    points = (CONTACT_PIXEL - np.stack([rows, columns], axis=-1)) * METRES_PER_PIXEL
    return np.concatenate([points, batch.height.max(axis=(1, 2))[:, None] / 2], axis=-1)
