"""What the autoencoders' codes retain of a mask (paper, section 3.2.2)."""

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from foretrace.errors import PredictionError
from foretrace.features.autoencoder import AutoencoderFeatures
from foretrace.interactions.dataset import InteractionBatch
from foretrace.pictures.scene import DPI, INK, STYLE
from foretrace.predictor import EffectPredictor

Masks = Bool[np.ndarray, "batch 128 128"]
BLANK, KEPT, LOST, ADDED = "#f2f4f7", "#7f8fa6", "#d55e00", "#0072b2"


def reconstruct_masks(predictor: EffectPredictor, batch: InteractionBatch) -> Masks:
    """Masks as the code of a predictor's autoencoder retains them: pixels more likely object than table.

    Raises:
        PredictionError: The predictor's features are not those of an autoencoder.
    """
    features = predictor.features
    if not isinstance(features, AutoencoderFeatures):
        raise PredictionError(
            f"features {features.label!r} have no code to restore a mask from: give a predictor with ae-256 or ae-512"
        )
    with torch.no_grad():
        restored = features.reconstruct(features.inputs(batch).to(predictor.device))
    return (restored[:, 0] > 0.5).cpu().numpy()


def overlap(one: Masks, other: Masks) -> Float[np.ndarray, " batch"]:
    """Intersection over union of two masks each; 1 where both are empty."""
    union = (one | other).sum(axis=(1, 2))
    return np.where(union == 0, 1.0, (one & other).sum(axis=(1, 2)) / np.maximum(union, 1))


def reconstruction_figure(masks: Masks, restored: Mapping[str, Masks]) -> Figure:
    """Masks above what each code made of them.

    Args:
        masks: As seen; one column each.
        restored: What was made of the same masks, by the code's name; one row each.
    """
    colors = ListedColormap([BLANK, KEPT, LOST, ADDED])
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(1.25 * len(masks) + 0.6, 1.35 * (1 + len(restored)) + 0.5), dpi=DPI)
        axes = figure.subplots(1 + len(restored), len(masks), squeeze=False)
        for row, (name, made) in enumerate({"mask": masks, **restored}.items()):
            scores = overlap(masks, made)
            for column, ax in enumerate(axes[row]):
                codes = (
                    masks[column] * 1 + (masks[column] & ~made[column]) + 3 * (made[column] & ~masks[column])
                )
                ax.imshow(codes, cmap=colors, vmin=-0.5, vmax=3.5, interpolation="nearest")
                ax.set(xticks=[], yticks=[])
                ax.spines[:].set_visible(False)
                if row:
                    ax.set_title(
                        f"IoU {scores[column]:.3f}", fontsize=7.5, fontweight="normal", loc="center", pad=2
                    )
            axes[row, 0].set_ylabel(name, color=INK, fontweight="bold")
        handles = [
            Patch(color=KEPT, label="object"),
            Patch(color=LOST, label="lost"),
            Patch(color=ADDED, label="added"),
        ]
        figure.legend(handles=handles, loc="lower center", ncols=3)
        figure.subplots_adjust(left=0.07, right=0.995, top=0.97, bottom=0.09, wspace=0.06, hspace=0.16)
    return figure
