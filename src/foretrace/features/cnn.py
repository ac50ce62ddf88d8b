"""Convolutional features, trained together with the predictor (paper, section 3.3)."""

from itertools import pairwise
from typing import TypeVar, get_args

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn
from torch.nn import functional as F

from foretrace.errors import TrainingError, shown
from foretrace.features.base import FeatureExtractor, ImageName, Option, TracedFeatures
from foretrace.features.shape_context import ShapeContext3200, shape_contexts
from foretrace.features.windows import convolve_unbranched, convolve_windows
from foretrace.interactions.batch import InteractionBatch

CHANNELS = (32, 64, 128, 256)
"""Channels of the four convolutions (paper, section 3.3)."""
HEIGHT_SCALE = 0.1
"""Heights are divided by this to be of unit scale [m]."""
NUM_RINGS, NUM_WEDGES = ShapeContext3200.num_rings, ShapeContext3200.num_wedges
"""Size of the shape-context matrix that is convolved."""
Module = TypeVar("Module", bound=nn.Module)


def initialise_rectified(module: Module) -> Module:
    """Draw the weights of layers that a ReLU follows so that signals keep their size (He et al., 2015).

    PyTorch's own start lets them shrink layer by layer: after five, the features hardly differ between objects.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
    return module


class ConvolutionStack(nn.Module):
    """3x3 convolutions, each followed by ReLU and 2x2 max-pooling, channels doubling from 32 to 256."""

    def __init__(self, in_channels: int = 1):
        super().__init__()
        sizes = (in_channels, *CHANNELS)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, kernel_size=3, padding=1) for before, after in pairwise(sizes)
        )
        initialise_rectified(self)
        # With channels last a CPU needs 0.6 of the time.
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def forward(self, images: Float[Tensor, "batch channels rows columns"]) -> Float[Tensor, "batch 256 r c"]:
        """Feature maps of a sixteenth of the images' size."""
        x = images.contiguous(memory_format=torch.channels_last)
        for convolution in self.convolutions:
            # Pooling and rectifying commute; pooling first leaves a quarter to rectify.
            x = F.relu(F.max_pool2d(convolution(x), 2))
        return x


class ConvolutionalFeatures(FeatureExtractor, abstract=True):
    """A stack of convolutions, flattened into one dense layer of rectified units with dropout.

    The paper leaves open what comes after the convolutions.

    Args:
        num_cells: Numbers in the stack's feature maps.
        width: Units of the dense layer.
        dropout: Fraction of them dropped at each training step.
        **options: All settings of the subclass.
    """

    def __init__(self, num_cells: int, width: int, dropout: float, **options: Option):
        super().__init__(width=width, dropout=dropout, **options)
        self.stack = ConvolutionStack()
        self.dense = initialise_rectified(nn.Linear(num_cells, width))
        self.dropout = nn.Dropout(dropout)

    @property
    def num_features(self) -> int:
        """Units of the dense layer."""
        return self.dense.out_features

    def forward(self, inputs: Shaped[Tensor, "batch 1 rows columns"]) -> Float[Tensor, "batch features"]:
        """Convolutions in ``precision`` while training, the dense layer always in float32."""
        reduced = self.training and self.precision == "bfloat16"
        with torch.autocast(inputs.device.type, dtype=torch.bfloat16, enabled=reduced):
            maps = self.maps(inputs)
        return self.dropout(F.relu(self.dense(maps.float().flatten(1))))

    def maps(self, inputs: Shaped[Tensor, "batch 1 rows columns"]) -> Shaped[Tensor, "batch 256 r c"]:
        """What the convolutions make of the inputs."""
        return self.stack(inputs.float())


class ImageCnn(ConvolutionalFeatures):
    """``im-cnn``: a convolutional network on the top-down view, whose last maps have 8x8x256 cells.

    Blank table around the object is not convolved: see `foretrace.features.windows`.

    Args:
        channel: What it looks at: the object's ``mask`` or its ``height`` map.
        width: Number of features.
        dropout: Fraction of the features dropped at each training step.
    """

    label = "im-cnn"

    def __init__(self, channel: ImageName = "mask", width: int = 128, dropout: float = 0.2):
        if channel not in get_args(ImageName):
            raise TrainingError(f"channel is {shown(channel)}: choose from {', '.join(get_args(ImageName))}")
        super().__init__(8 * 8 * CHANNELS[-1], width, dropout, channel=channel)
        self.channel: ImageName = channel

    def inputs(self, batch: InteractionBatch) -> Shaped[Tensor, "batch 1 128 128"]:
        """The masks as bytes (0 or 1), or the height maps in units of 10 cm."""
        if self.channel == "mask":
            return torch.from_numpy(batch.mask).to(torch.uint8)[:, None]
        return torch.from_numpy(batch.height).float()[:, None] / HEIGHT_SCALE

    def maps(self, inputs: Shaped[Tensor, "batch 1 128 128"]) -> Shaped[Tensor, "batch 256 8 8"]:
        """The maps of the window in which the object lies; nothing beside it."""
        return convolve_windows(inputs, self.stack, CHANNELS[-1])

    def traced(self) -> "TracedImageCnn":
        """All of it."""
        return TracedImageCnn(self)


class TracedImageCnn(TracedFeatures):
    """``im-cnn`` as a part of an exported network, always outside training."""

    def __init__(self, features: ImageCnn):
        super().__init__()
        self.features, self.name = features, features.channel
        self.meaning = {
            "mask": "view from above, 1 where the object is",
            "height": "view from above, heights [m], 0 beside the object",
        }[features.channel]
        self.scale = HEIGHT_SCALE if self.name == "height" else 1.0

    def inputs(self, images: Shaped[Tensor, "batch 128 128"]) -> Shaped[Tensor, "batch 1 128 128"]:
        """As `ImageCnn.inputs`."""
        return images[:, None] if self.name == "mask" else images[:, None] / HEIGHT_SCALE

    def forward(self, images: Shaped[Tensor, "batch 128 128"]) -> Float[Tensor, "batch features"]:
        """Every image is convolved whole and in its window, and one of the two is kept."""
        dense = self.features.dense
        maps = convolve_unbranched(images[:, None].to(dense.weight.dtype) / self.scale, self.features.stack)
        return F.relu(dense(maps.flatten(1)))


class ShapeContextCnn(ConvolutionalFeatures):
    """``sc-cnn``: a convolutional network on the shape-context matrix of ``sc-3200``.

    The paper does not say which of its matrices the network reads. This one has 40 rings x 80 wedges, so that
    four poolings leave 2x5x256 cells; of the smaller ones they would leave one row or nothing.

    Args:
        width: Number of features.
        dropout: Fraction of the features dropped at each training step.
    """

    label = "sc-cnn"

    def __init__(self, width: int = 128, dropout: float = 0.2):
        super().__init__((NUM_RINGS // 16) * (NUM_WEDGES // 16) * CHANNELS[-1], width, dropout)

    def inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch 1 40 80"]:
        """The matrices times their wedges: a cell that the outline crosses is about 1, as in a mask."""
        return shape_contexts(batch, NUM_RINGS, NUM_WEDGES)[:, None] * NUM_WEDGES
