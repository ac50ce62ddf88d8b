"""Features learned from the images alone: convolutional autoencoders (paper, section 3.2.2)."""

from collections.abc import Callable
from itertools import pairwise
from typing import ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from foretrace.errors import TrainingError
from foretrace.features.base import FeatureExtractor, FitPart
from foretrace.features.cnn import initialise_rectified
from foretrace.features.fitting import FitConfig, fit_network
from foretrace.features.windows import convolve_windows, crop, find_windows, paste
from foretrace.interactions.batch import InteractionBatch

ROWS_AT_ONCE = 32
"""Images encoded together: 128 channels of the full size are 8 MiB an image."""


class Autoencoder(nn.Module):
    """Four 3x3 convolutions with max-pooling to 8x8, and as many with upsampling back to 128x128.

    Every convolution but the last is followed by a ReLU; the last gives the logit of each pixel.

    Args:
        width: Channels of the first two convolutions; the third has half as many.
        code_channels: Channels of the fourth, of which the code consists.
    """

    def __init__(self, width: int, code_channels: int):
        super().__init__()
        down = (1, width, width, width // 2, code_channels)
        up = (code_channels, *down[:0:-1])
        self.encoder = nn.ModuleList(nn.Conv2d(a, b, kernel_size=3, padding=1) for a, b in pairwise(down))
        self.decoder = nn.ModuleList(nn.Conv2d(a, b, kernel_size=3, padding=1) for a, b in pairwise(up))
        self.output = nn.Conv2d(width, 1, kernel_size=3, padding=1)
        initialise_rectified(self)
        # With channels last a CPU needs 0.6 of the time.
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def encode(
        self, images: Float[Tensor, "batch 1 height width"]
    ) -> Float[Tensor, "batch code rows columns"]:
        """The activation of the bottleneck, of a sixteenth of the images' size."""
        x = images.contiguous(memory_format=torch.channels_last)
        for convolution in self.encoder:
            x = F.relu(F.max_pool2d(convolution(x), 2))
        return x

    def decode(
        self, codes: Float[Tensor, "batch code rows columns"]
    ) -> Float[Tensor, "batch 1 height width"]:
        """Logits of the pixels."""
        x = codes
        for convolution in self.decoder:
            x = F.interpolate(F.relu(convolution(x)), scale_factor=2)
        return self.output(x)

    def forward(self, images: Float[Tensor, "batch 1 height width"]) -> Float[Tensor, "batch 1 height width"]:
        """Logits of the pixels after the bottleneck."""
        return self.decode(self.encode(images))


class AutoencoderFeatures(FeatureExtractor, abstract=True):
    """The code of an autoencoder of the masks (paper, section 3.2.2); its entries define the code's size.

    It learns to restore the masks of the training part, by binary cross-entropy, before the predictor is
    trained; then it is frozen. The code is divided by its root mean square over the training part.

    Args:
        epochs: Passes over the training part.
        batch_size: Images per optimiser step.
        learning_rate: Adam's largest learning rate; it rises to it and falls to 0.
        min_steps: Optimiser steps, at least: few images are passed over more often.
        width: Channels of the first two convolutions, 128 in the paper; the third has half as many.
    """

    learns = True
    code_channels: ClassVar[int]
    """Channels of the 8x8 bottleneck."""
    code_scale: Tensor

    def __init__(
        self,
        epochs: int = 2,
        batch_size: int = 16,
        learning_rate: float = 2e-3,
        min_steps: int = 120,
        width: int = 128,
    ):
        if width < 2:
            raise TrainingError(f"width must be at least 2, not {width}: the paper has 128")
        super().__init__(
            epochs=epochs,
            batch_size=batch_size,
            learning_rate=learning_rate,
            min_steps=min_steps,
            width=width,
        )
        self.config = FitConfig(epochs, batch_size, learning_rate, annealed=True, min_steps=min_steps)
        self.network = Autoencoder(width, self.code_channels).requires_grad_(False)
        self.register_buffer("code_scale", torch.ones(()))

    @property
    def num_features(self) -> int:
        """Numbers in the code."""
        return 8 * 8 * self.code_channels

    def inputs(self, batch: InteractionBatch) -> UInt8[Tensor, "batch 1 128 128"]:
        """The masks as bytes, 0 or 1."""
        return torch.from_numpy(batch.mask).to(torch.uint8)[:, None]

    def fit(self, train: FitPart, validation: FitPart, *, seed: int, report: Callable[[str], None]) -> None:
        """Learn to restore the training part's masks; effects are not looked at."""
        fit_network(
            self.network,
            lambda rows: self._loss(train.inputs[rows], self.precision == "bfloat16"),
            lambda: self._mean_loss(validation.inputs),
            len(train.inputs),
            self.config,
            name=self.label,
            seed=seed,
            report=report,
        )
        scale = self._codes(train.inputs).square().mean().sqrt()
        if not scale > 0:
            raise TrainingError(
                f"{self.label}: every code is 0 after training, so the masks cannot be told apart: train "
                f"longer than {self.config.epochs} epochs, with a learning rate below "
                f"{self.config.learning_rate}, or with another seed"
            )
        self.code_scale.copy_(scale)

    def forward(self, inputs: UInt8[Tensor, "batch 1 128 128"]) -> Float[Tensor, "batch features"]:
        """The flat code, always in float32."""
        return self._codes(inputs).flatten(1) / self.code_scale

    def reconstruct(self, inputs: UInt8[Tensor, "batch 1 128 128"]) -> Float[Tensor, "batch 1 128 128"]:
        """The masks as the code retains them: each pixel's probability of showing the object."""
        parts = []
        for images in inputs.split(ROWS_AT_ONCE):
            restored = torch.zeros_like(images, dtype=torch.float32)
            for part in find_windows(images):
                paste(restored, part, torch.sigmoid(self.network(crop(images, part).float())))
            parts.append(restored)
        return torch.cat(parts)

    def _codes(self, inputs: Tensor) -> Tensor:
        encode, channels = self.network.encode, self.code_channels
        return torch.cat([convolve_windows(part, encode, channels) for part in inputs.split(ROWS_AT_ONCE)])

    def _loss(self, images: Tensor, reduced: bool = False) -> Tensor:
        """Mean over the pixels of the images; those beside the windows count as restored."""
        total = torch.zeros((), device=images.device)
        for part in find_windows(images):
            target = crop(images, part).float()
            with torch.autocast(images.device.type, dtype=torch.bfloat16, enabled=reduced):
                logits = self.network(target)
            total = total + F.binary_cross_entropy_with_logits(logits.float(), target, reduction="sum")
        return total / images.numel()

    def _mean_loss(self, images: Tensor) -> float:
        losses = [self._loss(part) * len(part) for part in images.split(ROWS_AT_ONCE)]
        return float(torch.stack(losses).sum()) / len(images)


class Autoencoder256(AutoencoderFeatures):
    """``ae-256``: a code of 8 x 8 x 4."""

    label = "ae-256"
    code_channels = 4


class Autoencoder512(AutoencoderFeatures):
    """``ae-512``: a code of 8 x 8 x 8."""

    label = "ae-512"
    code_channels = 8
