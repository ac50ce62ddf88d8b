"""The contract of feature extractors.

A feature extractor turns the view of an object before the action into one vector, which the predictor reads at every
step (paper, section 3). Its work has three stages, each run only as often as it must be:

1. ``inputs``: arrays to one tensor, once per data set. Nothing learned, nothing random.
2. ``fit``: optional training of its own on the training part, before the predictor's; frozen afterwards.
3. ``forward``: inputs to features. Run at every training step if the extractor is trainable, else once.
"""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from foretrace.errors import TrainingError, shown
from foretrace.interactions.batch import Candidates, InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.registry import Registry, adds_anything

Option = bool | int | float | str
"""A setting of a feature extractor, as written into a checkpoint's ``config.json``."""

Precision = Literal["float32", "bfloat16"]
"""Number format of the convolutions during training."""


ImageName = Literal["mask", "height"]
"""An image of the view."""


@dataclass(frozen=True)
class FitPart:
    """One part of the data as a feature extractor's own training sees it."""

    inputs: Tensor
    """Inputs of the features, on the device to train on."""
    source: InteractionBatch | Dataset
    """The interactions."""

    @property
    def batch(self) -> InteractionBatch:
        """The interactions as arrays, for extractors that learn from observed effects."""
        return self.source if isinstance(self.source, InteractionBatch) else self.source.batch()


class TracedFeatures(nn.Module, ABC):
    """A feature extractor as a part of an exported network, which reads an image of the view."""

    name: ImageName
    """The image that it reads."""
    meaning: str
    """What that is, for whoever reads the file."""

    @abstractmethod
    def inputs(self, images: Shaped[Tensor, "batch 128 128"]) -> Shaped[Tensor, "batch ..."]:
        """Inputs of the extractor itself."""

    @abstractmethod
    def forward(self, images: Shaped[Tensor, "batch 128 128"]) -> Float[Tensor, "batch features"]:
        """The features, by the same operations for every image."""


class FeatureExtractor(nn.Module, ABC):
    """Computes one feature vector per interaction.

    A subclass passes the keyword arguments of its constructor on to this one, which keeps them as
    ``options``: with them, and the tensors of its ``state_dict``, a checkpoint makes the extractor again. Defining
    a subclass with a ``label`` registers it in FEATURES; ``class Base(FeatureExtractor, abstract=True)`` has none.
    """

    label: ClassVar[str]
    """Name in FEATURES, after the paper's figures."""
    oracle: ClassVar[bool] = False
    """Whether it reads what only the action's effect reveals, so that it cannot serve to imagine one."""

    learns: ClassVar[bool] = False
    """Whether `fit` learns anything, so that its result is worth keeping for further trainings."""

    def __init_subclass__(cls, abstract: bool = False, **more: Any) -> None:
        super().__init_subclass__(**more)
        if not abstract and adds_anything(cls):
            if "label" not in cls.__dict__:
                raise TypeError(f"{cls.__name__} needs a label of its own, or abstract=True")
            FEATURES.add(cls.label, cls)

    def __init__(self, **options: Option):
        super().__init__()
        self.options = options
        self.precision: Precision = "float32"
        """Number format of convolutions in training mode; evaluation is always in float32."""

    @property
    @abstractmethod
    def num_features(self) -> int:
        """Length of the feature vector; may be 0."""

    @property
    def trainable(self) -> bool:
        """Whether the predictor's training error is to be propagated into it."""
        return any(parameter.requires_grad for parameter in self.parameters())

    @abstractmethod
    def inputs(self, batch: InteractionBatch) -> Shaped[Tensor, "batch ..."]:
        """Prepare what ``forward`` reads: one row per interaction, on the CPU, nothing learned.

        Args:
            batch: Interactions in the action frame [m]. An extractor that is no oracle reads only what is
                known before the action: mask, height map, corners.
        """

    def fit(self, train: FitPart, validation: FitPart, *, seed: int, report: Callable[[str], None]) -> None:
        """Train on its own, before the predictor, and freeze; a hook, empty where there is nothing to train.

        An extractor that has such a training creates its parameters with ``requires_grad`` off, switches it
        on for this training alone, and is therefore not ``trainable`` in the predictor's.

        Args:
            train: The training part; nothing else may be learned from.
            validation: For choosing the best epoch.
            seed: Seed of every random draw.
            report: Takes a line on the progress.
        """

    def candidate_inputs(self, candidates: Candidates) -> Shaped[Tensor, "batch ..."]:
        """``inputs`` of one object for several actions; a hook for extractors that need to look only once.

        By default the view is resampled for each action.
        """
        return self.inputs(candidates.batch())

    def measure(self, inputs: Shaped[Tensor, "batch ..."]) -> dict[str, Float[np.ndarray, " batch"]]:
        """Further measures by which objects are compared with those learned from; a hook, empty by default.

        Returns:
            Values by names of `foretrace.imagined.domain.MEASURES`.
        """
        return {}

    def traced(self) -> "TracedFeatures | None":
        """The part of the extractor that an exported network contains; a hook.

        By default none: the exported network reads the features themselves.
        """
        return None

    @abstractmethod
    def forward(self, inputs: Shaped[Tensor, "batch ..."]) -> Float[Tensor, "batch features"]:
        """Compute the features, roughly of unit scale, in float32."""


FEATURES: Registry[type[FeatureExtractor]] = Registry("features", "foretrace.features", TrainingError)
"""Every feature extractor by its label in the paper's figures."""


def make_features(label: str, **options: Option) -> FeatureExtractor:
    """Make a feature extractor by its label.

    Args:
        label: A key of ``FEATURES``.
        **options: Settings of that extractor's constructor.

    Raises:
        TrainingError: The label or an option is unknown, or an option has a value of another type.
    """
    extractor = FEATURES.find(label)
    known = option_names(extractor)
    for name in options:
        if name not in known:
            raise TrainingError(f"{label} has no option {shown(name)}; it has: {', '.join(known) or 'none'}")
    try:
        return extractor(**options)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TrainingError(
            f"{label} cannot be made with {options} ({str(error).splitlines()[0]}): change or leave out an option"
        ) from error


class NoFeatures(FeatureExtractor):
    """The paper's baseline: the predictor is given nothing of the object but where it lies (section 5.2)."""

    label = "none"

    @property
    def num_features(self) -> int:
        """No features at all."""
        return 0

    def inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch 0"]:
        """Rows without columns."""
        return torch.zeros(len(batch), 0)

    def forward(self, inputs: Float[Tensor, "batch 0"]) -> Float[Tensor, "batch 0"]:
        """Hand the empty rows on."""
        return inputs


def option_names(extractor: type[FeatureExtractor]) -> list[str]:
    """The settings that an extractor's constructor takes."""
    return [
        name
        for name, parameter in inspect.signature(extractor.__init__).parameters.items()
        if name != "self" and parameter.kind is not inspect.Parameter.VAR_KEYWORD
    ]


def fast_precision(device: torch.device) -> Precision:
    """The number format in which a device trains convolutions fastest.

    bfloat16 where the hardware multiplies it natively (AMX or AVX512-BF16 on a CPU, where it halves the time
    of a training step; any CUDA device that supports it), else float32. The rule asks for the hardware's
    features and takes no timing, so that the same machine always trains the same model.
    """
    if device.type == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported() else "float32"
    capabilities = torch.cpu.get_capabilities()
    native = capabilities.get("amx_bf16") or capabilities.get("avx512_bf16")
    return "bfloat16" if native else "float32"
