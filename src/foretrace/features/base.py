"""What a feature extractor is: the contract that every entry of FEATURES keeps.

A feature extractor turns what is known of an object before the action into one vector, which the predictor
reads at every step (paper, section 3). Its work has three stages, each paid for only as often as it must be:

1. ``inputs``: arrays to one tensor, once per data set. Nothing learned, nothing random.
2. ``fit``: optional training of its own on the training part, before the predictor's; frozen afterwards.
3. ``forward``: inputs to features. Run at every training step if the extractor is trainable, else once.
"""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from foretrace.interactions.dataset import InteractionBatch

Option = str | int | float | bool
"""A setting of a feature extractor, as written into a checkpoint's ``config.json``."""

Precision = Literal["float32", "bfloat16"]
"""Number format of the convolutions during training."""


@dataclass(frozen=True)
class FitPart:
    """One part of the data as a feature extractor's own training sees it."""

    inputs: Tensor
    """What ``inputs`` made of ``batch``, on the device to train on."""
    batch: InteractionBatch
    """The interactions themselves, for extractors that learn from observed effects."""


class FeatureExtractor(nn.Module, ABC):
    """Computes one feature vector per interaction.

    A subclass passes the keyword arguments of its constructor on to this one, which keeps them as
    ``options``: with them, and the tensors of its ``state_dict``, a checkpoint makes the extractor again.
    """

    label: ClassVar[str]
    """Name in FEATURES, after the paper's figures."""
    oracle: ClassVar[bool] = False
    """Whether it reads what only the action's effect reveals, so that it cannot serve to imagine one."""

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
        """Train on its own, before the predictor, and freeze; by default there is nothing to train.

        An extractor that has such a training creates its parameters with ``requires_grad`` off, switches it
        on for this training alone, and is therefore not ``trainable`` in the predictor's.

        Args:
            train: The training part; nothing else may be learned from.
            validation: For choosing the best epoch.
            seed: Seed of every random draw.
            report: Takes a line on the progress.
        """

    @abstractmethod
    def forward(self, inputs: Shaped[Tensor, "batch ..."]) -> Float[Tensor, "batch features"]:
        """Compute the features, roughly of unit scale, in float32."""


class NoFeatures(FeatureExtractor):
    """The paper's baseline: the predictor knows nothing of the object but where it lies (section 5.2)."""

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
