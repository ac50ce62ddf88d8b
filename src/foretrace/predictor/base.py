"""What a predictor is: the contract between training, checkpoints and everybody who imagines effects."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn

from foretrace.errors import PredictionError
from foretrace.features import FeatureExtractor, Precision
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, TopDownView
from foretrace.predictor.known import check_names, given_values, observed_values
from foretrace.predictor.states import StateKind, decode_poses, rest_states, state_size

ROWS_AT_ONCE = 256
"""Images convolved together: bounds the memory that it takes."""

Start = Literal["observed", "estimated"]
"""Where a roll-out's first state comes from: the first recorded sample, or the view from above."""


@dataclass(frozen=True)
class ImaginedEffect:
    """The effect that a predictor expects of one action."""

    times: Float[np.ndarray, " time"]
    """Time of each sample [s], from the moment before the blade touches the object."""
    com_trajectory: Float[np.ndarray, "time 3"]
    """Centre of mass in the action frame [m]; the first row is the start that was given or estimated."""
    pose_trajectory: Float[np.ndarray, "time 7"] | None = None
    """Position of the centre of mass [m] and quaternion (w, x, y, z) of the rotation since rest, about the
    action frame's axes: the identity at first. None if the predictor knows positions only."""


@dataclass(frozen=True)
class ImaginedBatch:
    """The effects that a predictor expects of many actions."""

    times: Float[np.ndarray, " time"]
    """Time of each sample [s], common to all."""
    com: Float[np.ndarray, "batch time 3"]
    """Centres of mass in the action frame [m]."""
    pose: Float[np.ndarray, "batch time 7"] | None = None
    """As ``ImaginedEffect.pose_trajectory``, one per interaction."""

    def __len__(self) -> int:
        return len(self.com)

    def __getitem__(self, index: int) -> ImaginedEffect:
        return ImaginedEffect(self.times, self.com[index], None if self.pose is None else self.pose[index])


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
    """

    label: ClassVar[str]
    """Name in PREDICTORS."""
    state_mean: Tensor
    state_scale: Tensor
    times: Tensor
    known_mean: Tensor
    known_scale: Tensor

    def __init__(
        self, features: FeatureExtractor, state: StateKind, num_samples: int, known: Sequence[str] = ()
    ):
        super().__init__()
        self.features = features
        self.state: StateKind = state
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

    def prepare(
        self,
        features: Float[Tensor, "batch inputs"],
        states: Float[Tensor, "batch time state"],
        lengths: Int[Tensor, " batch"],
    ) -> None:
        """Take from the whole training part what is needed before the first step; by default nothing.

        The arguments are those of `training_loss`.
        """

    @abstractmethod
    def training_loss(
        self,
        features: Float[Tensor, "batch inputs"],
        states: Float[Tensor, "batch time state"],
        lengths: Int[Tensor, " batch"],
    ) -> Float[Tensor, ""]:
        """The error to minimise on normalised states, of which row ``i`` is valid up to ``lengths[i]``.

        ``features`` are those of the object and, behind them, what is known: as from `add_known`.
        """

    def validation_loss(self, off: Float[np.ndarray, "samples state"]) -> float:
        """What the best epoch has least of, from how far imagined normalised states are off: the mean square."""
        return float(np.mean(off**2))

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
    ) -> ImaginedEffect:
        """Imagine the effect of the action on the object in a view.

        Args:
            view: The object from above, in the action frame.
            com: Its centre of mass at rest in the action frame [m]. Estimated from the view if not given:
                above the centre of the mask's area, at half the object's greatest height.
            known: Values of the constants that the predictor was trained to know, by name [SI].

        Raises:
            PredictionError: The predictor's features are only known after the action; or a known value is missing,
                is not finite, or is none that the predictor knows.
        """
        if self.features.oracle:
            raise PredictionError(
                f"features {self.features.label!r} are observed during the action and cannot be had from "
                "a view: use a predictor with other features"
            )
        batch = InteractionBatch.from_views([view])
        start = estimate_com(batch) if com is None else np.asarray(com, dtype=float)[None]
        values = given_values(known, self.known)
        return self._imagine_from(self.features.inputs(batch), values, start)[0]

    def imagine_batch(self, batch: InteractionBatch, start: Start = "observed") -> ImaginedBatch:
        """Imagine the effects of many actions.

        Args:
            batch: The interactions; of their trajectories only the first sample is read, and not even that if
                ``start`` is ``estimated``. Their constants are read if the predictor knows them.
            start: Whether the roll-out starts from the recorded first state or from the view's estimate.

        Raises:
            PredictionError: A constant that the predictor knows is not recorded.
        """
        com = batch.com[:, 0] if start == "observed" else estimate_com(batch)
        return self._imagine_from(self.features.inputs(batch), observed_values(batch, self.known), com)

    def _imagine_from(
        self, inputs: Shaped[Tensor, "batch ..."], known: np.ndarray, com: np.ndarray
    ) -> ImaginedBatch:
        features = self.add_known(self.compute_features(inputs), known)
        states = self.imagine_states(features, rest_states(com, self.state))
        pose = decode_poses(states) if self.state == "pose" else None
        return ImaginedBatch(self.times.cpu().numpy(), states[..., :3], pose)

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
    module.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        module.train(was_training)


def estimate_com(batch: InteractionBatch) -> Float[np.ndarray, "batch 3"]:
    """Centres of mass at rest in the action frame [m], judged from the views.

    Above the centre of each mask's area, at half the object's greatest height: right for a prism of uniform
    density but for its bevel.
    """
    areas = batch.mask.sum(axis=(1, 2))
    if not areas.all():
        raise PredictionError(
            f"the mask of interaction {batch.ids[np.argmin(areas)]} is empty; nothing can be imagined"
        )
    rows = (batch.mask.sum(axis=2) * np.arange(batch.mask.shape[1])).sum(axis=1) / areas
    columns = (batch.mask.sum(axis=1) * np.arange(batch.mask.shape[2])).sum(axis=1) / areas
    points = (CONTACT_PIXEL - np.stack([rows, columns], axis=-1)) * METRES_PER_PIXEL
    return np.concatenate([points, batch.height.max(axis=(1, 2))[:, None] / 2], axis=-1)
